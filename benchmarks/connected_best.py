"""Plans for connected teams: ticks of NCOCTA, COCTA and cocta-best beside what is possible at all.

    python -m benchmarks.connected_best [--effort 5000] [--robots 5 20 60]

Ticks are exact, the same on every machine. ``bound`` and, on small trees, ``optimum`` are those of
`agents.planning.optimal_connected`. ``cost`` is the processor time of a plan, COCTA's best splits
included, in runs of COCTA: both in the same process, one after the other.
"""

import argparse
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import geometric_mean

from agents.algorithms.connected_rule import Team, Variant, ticks_taken
from agents.algorithms.connected_splits import paper_splits
from agents.planning.connected_best import cocta_plan, plan_connected
from agents.planning.optimal_connected import lower_bound, optimum
from agents.planning.rooted_tree import RootedTree, tree_of_parents
from benchmarks.table import print_table
from experiments.connected_trees import Holes, Perfect, Place
from protocol.seeds import spawn

Case = tuple[str, RootedTree, int]
"""A name, a tree, and how many robots there are."""

PERFECT = (
    (2, 3, (7, 11)),
    (3, 7, (3, 16, 20, 30, 57, 58)),
    (3, 8, (16, 60)),
    *((2, height, (60,)) for height in range(8, 13)),
)
HOLES = ((Holes(Perfect(2, 10), 4, 4, 1), 60), (Holes(Perfect(3, 7), 2, 3, 2), 20))
RANDOM = (("any", None), ("reach 20", 20), ("reach 5", 5))
SMALL = ((8, (2, 3, 4)), (11, (2, 3, 4)))


def perfect_cases() -> Iterator[Case]:
    """Yield perfect trees, and some with holes."""
    for arity, height, teams in PERFECT:
        tree = Perfect(arity, height).made()
        yield from ((f"{arity}-ary, H = {height}", tree, robots) for robots in teams)
    for holes, robots in HOLES:
        yield f"holes, {holes.whole.arity}-ary", holes.made(), robots


def random_tree(vertices: int, reach: int | None) -> RootedTree:
    """Return a tree; parents have numbers lower by no more than the reach: the less, the deeper."""
    rng = spawn(vertices, "tree", reach or vertices)
    lowest = [max(0, child - (reach or vertices)) for child in range(vertices)]
    return tree_of_parents(
        [None, *(rng.randrange(lowest[child], child) for child in range(1, vertices))]
    )


def random_cases(teams: list[int]) -> Iterator[Case]:
    """Yield random trees of several shapes."""
    for vertices in (30, 200, 2000):
        for shape, reach in RANDOM:
            tree = random_tree(vertices, reach)
            yield from ((shape, tree, robots) for robots in (2, *teams) if robots <= vertices // 3)


def small_cases() -> Iterator[Case]:
    """Yield trees for which the optimum can be found."""
    for vertices, teams in SMALL:
        for shape, reach in (("any", None), ("reach 4", 4), ("reach 2", 2)):
            tree = random_tree(vertices, reach)
            yield from ((shape, tree, robots) for robots in teams)


def graph_cases(teams: list[int]) -> Iterator[Case]:
    """Yield breadth-first trees of the shared graphs; none where they are absent."""
    root = Path(__file__).parents[1]
    folder = Path(os.environ.get("CANOPY_SHARED") or root.parent / "shared") / "maps" / "graphs"
    for path in sorted(folder.glob("*/*.edges")):
        tree = Place(str(path)).made()
        for robots in teams:
            yield path.stem[:20], tree, robots


def _timed(run: Callable[[], int]) -> tuple[int, float]:
    before = time.process_time()
    result = run()
    return result, time.process_time() - before


def ticks_of(tree: RootedTree, robots: int, variant: Variant) -> int:
    """Return the ticks with the splits of the paper."""
    splits = paper_splits(tree.arity, tree.height, robots)
    ticks = ticks_taken(Team(tree, robots, variant, splits), 2 * len(tree))
    assert ticks is not None
    return ticks


def compare(title: str, cases: Iterator[Case], effort: int) -> None:
    """Print a table, a row for each case."""
    rows = []
    saved = []
    for name, tree, robots in cases:
        printed, one_s = _timed(lambda tree=tree, k=robots: ticks_of(tree, k, "cocta"))  # type: ignore[misc]  # bound now
        best = cocta_plan(tree, robots, effort).ticks
        ticks, plan_s = _timed(
            lambda tree=tree, k=robots: plan_connected(tree, k, effort).ticks  # type: ignore[misc]  # bound now
        )
        saved.append(best / ticks)
        rows.append(
            (
                name,
                len(tree),
                robots,
                ticks_of(tree, robots, "ncocta"),
                printed,
                best,
                ticks,
                optimum(tree, robots) if len(tree) < 12 else "",
                lower_bound(tree, robots),
                f"{best / ticks:.2f}",
                f"{plan_s / one_s:.0f}",
            )
        )
    if rows:
        head = ("n", "k", "NCOCTA", "COCTA", "best-splits", "cocta-best", "optimum", "bound")
        note = f"gain over COCTA's best splits: {geometric_mean(saved):.2f} (geometric mean)"
        print_table(title, ("", *head, "gain", "cost"), rows, note)


def main() -> None:
    """Plan and print tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--effort", type=int, default=5000)
    parser.add_argument("--robots", type=int, nargs="+", default=[5, 20, 60])
    wanted = parser.parse_args()
    compare("small random trees", small_cases(), wanted.effort)
    compare("perfect trees, and some with holes", perfect_cases(), wanted.effort)
    compare("random trees", random_cases(wanted.robots), wanted.effort)
    compare("breadth-first trees of graphs", graph_cases(wanted.robots), wanted.effort)


if __name__ == "__main__":
    main()
