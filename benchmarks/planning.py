"""Offline planning: Create_Tree, Opt_MSTC, and how both grow with the map.

    python -m benchmarks.planning [--repeats 9]

Processor time, each variant beside its reference in plain Python in the same repeat; medians.
"""

import argparse
import resource
import time
from collections.abc import Callable
from statistics import median

from agents.algorithms.stc import located, number
from agents.planning.bridges import Bridges, best_of_tries
from agents.planning.create_tree import grow_forest
from agents.planning.splits import opt_mstc
from agents.planning.tour import Places, circumnavigate
from agents.planning.trees import Sets
from benchmarks.table import print_table
from deploy.plan import Wanted, plan
from protocol.grid import Cell, Grid
from protocol.seeds import Stream, spawn

SIDES = (64, 128, 256, 512)


def create_tree(cells: list[int], starts: list[Cell], tries: int) -> int:
    """Return the largest gap that Create_Tree leaves."""
    forest = grow_forest(cells, [located(start)[0] for start in starts], "manhattan")
    return best_of_tries(Bridges(forest, starts), tries, spawn(1, "bridges")).d_max


def create_tree_by_hand(cells: list[int], starts: list[Cell], tries: int) -> int:
    """Do the same as the paper says: shuffle, join, and go around the whole tree each time."""
    forest = grow_forest(cells, [located(start)[0] for start in starts], "manhattan")
    bridges = Bridges(forest, starts)
    order = list(range(len(bridges)))
    ends = bridges.ends.tolist()
    rng: Stream = spawn(1, "bridges")
    best = 4 * len(cells)
    for _ in range(tries):
        rng.shuffle(order)
        sets = Sets(range(bridges.subtrees))
        chosen = [bridge for bridge in order if sets.unite(*ends[bridge])]
        tour = circumnavigate(bridges.join(chosen), starts[0])
        best = min(best, max(Places(tour, starts).gaps))
    return best


def opt_by_hand(gaps: list[int]) -> int:
    """Bisect the coverage time, and try each number of sub-cells behind the first robot."""
    low, high = 0, max(gaps) - 1
    while low < high:
        middle = (low + high) // 2
        if any(_holds(gaps, middle, back) for back in range(middle + 1)):
            high = middle
        else:
            low = middle + 1
    return high


def _holds(gaps: list[int], limit: int, first: int) -> bool:
    back = first
    for gap in gaps:
        if back > limit:
            return False
        ahead = limit - 2 * back if 3 * back <= limit else (limit - back) // 2
        back = max(0, gap - 1 - ahead)
    return back <= first


def _seconds(run: Callable[[], object]) -> float:
    before = time.process_time()
    run()
    return time.process_time() - before


def _compare(
    title: str, ours: Callable[[], int], by_hand: Callable[[], int], repeats: int, target_ms: int
) -> None:
    pairs = [(_seconds(ours), _seconds(by_hand)) for _ in range(repeats)]
    rows = [
        ("Canopy", f"{1e3 * median(pair[0] for pair in pairs):.2f}", "1.00"),
        (
            "by hand",
            f"{1e3 * median(pair[1] for pair in pairs):.2f}",
            f"{median(other / one for one, other in pairs):.1f}",
        ),
    ]
    print_table(title, ("", "ms", "times Canopy"), rows, f"target: at most {target_ms} ms")


def main() -> None:
    """Measure and print tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=9)
    repeats = parser.parse_args().repeats

    cells = [number((row, col)) for row in range(20) for col in range(30)]
    places = [(row, col) for row in range(40) for col in range(60)]
    starts = spawn(1, "starts").sample(places, 30)
    _compare(
        "Create_Tree, 20 x 30 coarse cells, 30 robots, 900 bridge sets",
        lambda: create_tree(cells, starts, 900),
        lambda: create_tree_by_hand(cells, starts, 900),
        repeats,
        100,
    )

    cuts = sorted(spawn(1, "gaps").sample(range(1, 10_000), 99))
    gaps = [far - near for near, far in zip([0, *cuts], [*cuts, 10_000], strict=True)]
    assert opt_mstc(gaps).moves == opt_by_hand(gaps)
    _compare(
        "Opt_MSTC, 10,000 sub-cells, 100 robots",
        lambda: opt_mstc(gaps).moves,
        lambda: opt_by_hand(gaps),
        repeats,
        20,
    )

    rows = []
    for side in SIDES:
        grid = Grid(2 * side, 2 * side, bytes(4 * side * side))
        wanted = Wanted(robots=100, seed=1)
        spent_s = _seconds(lambda grid=grid, wanted=wanted: plan(grid, wanted))  # type: ignore[misc]  # bound now
        memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        share_us = f"{spent_s / side**2 * 1e6:.1f}"
        rows.append((f"{side} x {side}", f"{spent_s:.1f}", share_us, f"{memory_mb:.0f}"))
    print_table(
        "create-tree+opt-mstc with walks, 100 robots, 10,000 bridge sets, no obstacles",
        ("coarse cells", "s", "us a coarse cell", "MB"),
        rows,
        "targets: near linear, at most 60 s and 2048 MB",
    )


if __name__ == "__main__":
    main()
