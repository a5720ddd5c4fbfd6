"""What `canopy paper connected` does: the experiments on connected coverage, with figures and tables.

Sinay et al. 2017, Sec. 4.4 and 5. Each run is simulated by its rule alone, without a world:

table    chosen runs, against the numbers of the specification
robots   Figures 4a to 4c and 4e to 4g: by the number of robots, on perfect trees
heights  Figures 4d and 4h: by the height of a perfect binary tree, 60 robots
general  Figures 4i to 4l: binary trees from which subtrees were cut at random, 60 robots
office   Figure 5a: a corridor with rooms, a ternary tree of height 7, few robots
graphs   not in the paper: breadth-first trees of real places, from ``$CANOPY_SHARED/maps/graphs``

The paper's curves are those of its own simulator, in which a robot may cross several edges in a tick
(``in place``, `experiments.inplace`). Beside them stand the ticks that robots need, one edge each. SF
is the speedup factor 2 (n - 1) / T. Into the folder go for each part ``PART.png``, ``PART.csv`` (a line
for each run) and ``PART.json``.
"""

import os
import sys
from collections.abc import Iterator, Sequence
from itertools import product
from math import ceil
from pathlib import Path
from statistics import mean
from typing import Literal, NamedTuple

from msgspec import Struct

from agents.algorithms.connected_rule import Team, Variant, ticks_taken
from agents.algorithms.connected_splits import Splits, choose_splits
from agents.planning.rooted_tree import vertices_of_perfect
from experiments.command import (
    Tally,
    check_parts,
    files_of,
    in_parallel,
    print_json,
    write_csv,
    write_json,
)
from experiments.connected_figures import FIGURES
from experiments.connected_trees import AnyTree, Cut, Holes, Office, Perfect, Place, tree_of
from experiments.inplace import inplace_ticks
from protocol.errors import InputError

Model = Literal["pipe", "in place"]
"""One edge a robot and tick, or the paper's simulator."""

BOTH: tuple[Variant, Variant] = ("ncocta", "cocta")
MODELS: tuple[Model, Model] = ("pipe", "in place")
CUTS = 10
"""Random trees for each height and number of cut subtrees, as in the paper."""


# Runs.


class Case(NamedTuple):
    """One run."""

    tree: AnyTree
    robots: int
    variant: Variant
    model: Model = "pipe"
    splits: Splits = "paper"

    @property
    def curve(self) -> str:
        """What the run is called in tables and figures."""
        words = [self.variant.upper()]
        words += ["best splits"] if self.splits == "best" else []
        words += ["in place"] if self.model == "in place" else []
        return ", ".join(words)


class Measured(NamedTuple):
    """What one run came to.

    Attributes:
        vertices, height: of the tree.
        ticks: until all were back; ``None`` if the team came to a stand.
    """

    vertices: int
    height: int
    ticks: int | None


def measure(case: Case) -> Measured:
    """Simulate one run."""
    tree = tree_of(case.tree)
    splits = choose_splits(tree, case.robots, case.variant, case.splits)
    if case.model == "pipe":
        team = Team(tree, case.robots, case.variant, splits)
        ticks = ticks_taken(team, 2 * len(tree))
    else:
        ticks = inplace_ticks(tree, case.robots, case.variant, splits)
    return Measured(len(tree), tree.height, ticks)


class Point(NamedTuple):
    """One run, and where it belongs.

    Attributes:
        panel: part of the figure.
        x: on its horizontal axis.
        case: the run.
        specified: the ticks of the specification, if it gives them.
    """

    panel: str
    x: int
    case: Case
    specified: int | None = None


class Row(Struct, frozen=True, kw_only=True):
    """The means over the runs at one point of a curve.

    Attributes:
        panel, curve, x: where it belongs.
        runs: how many.
        robots: number of robots.
        vertices: of the trees.
        ticks: of those that ended; ``None`` if one did not.
        speedup: the speedup factor, 2 (n - 1) / T.
        lower_bound: the largest of 2 (n - 1) / k, rounded up, and 2 H.
        specified: the ticks of the specification, if it gives them.
    """

    panel: str
    curve: str
    x: int
    runs: int
    robots: int
    vertices: float
    ticks: float | None
    speedup: float | None
    lower_bound: float
    specified: int | None

    @property
    def differs(self) -> bool:
        """Whether the number is another one than the specification's."""
        return self.specified is not None and self.ticks != self.specified


def rows_of(points: Sequence[Point], results: Sequence[Measured]) -> list[Row]:
    """Average the runs at each point."""
    groups: dict[tuple[str, str, int], list[tuple[Point, Measured]]] = {}
    for point, result in zip(points, results, strict=True):
        key = (point.panel, point.case.curve, point.x)
        groups.setdefault(key, []).append((point, result))
    rows = []
    for (panel, curve, x), group in groups.items():
        first, found = group[0][0], [result for _, result in group]
        ended = [(2 * (one.vertices - 1), one.ticks) for one in found if one.ticks is not None]
        robots, whole = first.case.robots, len(ended) == len(found)
        rows.append(
            Row(
                panel=panel,
                curve=curve,
                x=x,
                runs=len(found),
                robots=robots,
                vertices=mean(one.vertices for one in found),
                ticks=mean(ticks for _, ticks in ended) if whole else None,
                speedup=mean(alone / max(1, ticks) for alone, ticks in ended) if whole else None,
                lower_bound=mean(
                    max(ceil(2 * (one.vertices - 1) / robots), 2 * one.height) for one in found
                ),
                specified=first.specified,
            )
        )
    return rows


# Parts.

SPECIFIED: dict[tuple[Perfect | Holes, int, tuple[int, ...]], tuple[int, int, int, int]] = {
    (Perfect(2, 3), 7, (3,)): (10, 10, 8, 8),
    (Perfect(2, 3), 11, (3, 2)): (7, 7, 5, 5),
    (Perfect(3, 7), 3, ()): (6558, 3643, 6558, 3642),
    (Perfect(3, 7), 16, (5,)): (1158, 1124, 1113, 1113),
    (Perfect(3, 7), 20, (5,)): (1158, 999, 1113, 766),
    (Perfect(3, 7), 30, (5,)): (1158, 686, 1113, 456),
    (Perfect(3, 7), 57, (5,)): (1158, 433, 1113, 280),
    (Perfect(3, 7), 58, (7, 6)): (372, 372, 366, 366),
    (Perfect(3, 8), 16, (5,)): (3480, 3368, 3345, 3345),
    (Perfect(3, 8), 60, (7, 6)): (1122, 1101, 1101, 1066),
    (Perfect(2, 15), 30, (5,)): (40956, 20479, 35836, 15356),
    (Perfect(2, 15), 60, (8, 7)): (17916, 10562, 16892, 7996),
    (Perfect(2, 15), 120, (10, 9, 8)): (8668, 5571, 8348, 4156),
    (Perfect(4, 8), 60, (5,)): (22312, 8971, 21992, 5448),
    (Perfect(4, 8), 101, (7, 6)): (5500, 5485, 5472, 5472),
    (Holes(Perfect(2, 10), 4, 4, 1), 60, (8, 7)): (432, 260, 400, 195),
    (Holes(Perfect(3, 7), 2, 3, 2), 20, (5,)): (807, 693, 762, 529),
}
"""Ticks by tree, robots and split heights: NCOCTA and COCTA, then the same in place."""

SPECIFIED_HEIGHTS: dict[tuple[Variant, Model], tuple[int, ...]] = {
    ("ncocta", "pipe"): (136, 276, 556, 1116, 2236, 4476, 8956, 17916),
    ("cocta", "pipe"): (83, 167, 332, 662, 1322, 2642, 5282, 10562),
    ("cocta", "in place"): (59, 123, 247, 496, 996, 1996, 3996, 7996),
}
"""Ticks of 60 robots on perfect binary trees of heights 8, 9, ..."""

TEAMS = (3, 5, 10, 11, 15, 16, 20, 21, 25, 30, 31, 40, 50, 58, 60, 71, 80, 100, 101, 120)
"""With the least teams for one, two and three splits on each of the trees."""


def table(*, quick: bool, cuts: int) -> Iterator[Point]:  # noqa: ARG001  as the other parts
    """List the runs for which the specification has numbers."""
    for (tree, robots, splits), numbers in SPECIFIED.items():
        whole = tree.whole if isinstance(tree, Holes) else tree
        if quick and vertices_of_perfect(*whole) > 10_000:
            continue
        name = f"{'holes ' if whole is not tree else ''}{whole.arity}:{whole.height}"
        kinds = product(MODELS, BOTH)
        for (model, variant), ticks in zip(kinds, numbers, strict=True):
            yield Point(name, robots, Case(tree, robots, variant, model, splits), ticks)


def robots(*, quick: bool, cuts: int) -> Iterator[Point]:  # noqa: ARG001  as the other parts
    """List the runs by the number of robots."""
    for tree in (
        (Perfect(2, 8), Perfect(3, 5), Perfect(4, 4))
        if quick
        else (Perfect(2, 15), Perfect(3, 8), Perfect(4, 8))
    ):
        name = f"{tree.arity}-ary tree, H = {tree.height}"
        for team in (5, 20, 60) if quick else TEAMS:
            for model, variant in product(MODELS, BOTH):
                yield Point(name, team, Case(tree, team, variant, model))


def heights(*, quick: bool, cuts: int) -> Iterator[Point]:  # noqa: ARG001  as the other parts
    """List the runs by the height of the tree."""
    for height in range(8, 11 if quick else 16):
        for model, variant in product(MODELS, BOTH):
            numbers = SPECIFIED_HEIGHTS.get((variant, model))
            case = Case(Perfect(2, height), 60, variant, model)
            ticks = None if numbers is None else numbers[height - 8]
            yield Point("2-ary tree, 60 robots", height, case, ticks)


def general(*, quick: bool, cuts: int) -> Iterator[Point]:
    """List the runs on trees that are not perfect."""
    for height in (10,) if quick else (10, 12):
        for count in (0, 3, 6) if quick else range(7):
            for at, number in product((2, 5) if quick else range(1, 8), range(cuts)):
                tree = Cut(Perfect(2, height), at, count, number)
                for model in MODELS:
                    yield Point(f"2-ary tree, H = {height}", count, Case(tree, 60, "cocta", model))


def office(*, quick: bool, cuts: int) -> Iterator[Point]:  # noqa: ARG001  as the other parts
    """List the runs in an office."""
    for team in (1, 2, 3, 4):
        for model, variant in product(MODELS, BOTH):
            yield Point("office, 3-ary tree, H = 7", team, Case(Office(7), team, variant, model))


def graphs(*, quick: bool, cuts: int) -> Iterator[Point]:  # noqa: ARG001  as the other parts
    """List the runs on graphs of real places; there are none where these are absent."""
    for path in sorted(shared_graphs().rglob("*.edges")):
        for team in (5, 20) if quick else (1, 3, 5, 10, 20, 40, 60):
            yield Point(path.stem, team, Case(Place(str(path)), team, "ncocta"))
            yield Point(path.stem, team, Case(Place(str(path)), team, "cocta"))
            if not quick:
                yield Point(path.stem, team, Case(Place(str(path)), team, "cocta", splits="best"))


def shared_graphs() -> Path:
    """Return the folder of the graphs, whether it is there or not."""
    return Path(os.environ.get("CANOPY_SHARED") or "../shared", "maps", "graphs")


PARTS = {
    "table": table,
    "robots": robots,
    "heights": heights,
    "general": general,
    "office": office,
    "graphs": graphs,
}
"""The runs of each part, by its name."""


def connected(
    *, out: Path | None, only: Sequence[str], quick: bool, inputs: int | None, as_json: bool
) -> int:
    """Compute the experiments on connected coverage; return 1 if a specified number differs, else 0.

    Args:
        out: folder for the files; default: ``runs/paper-connected``.
        only: parts; none: all.
        quick: few runs, and small trees.
        inputs: random trees of the part ``general`` for each height and number of cuts (10).
        as_json: print the numbers as one JSON object, and no tables.

    Raises:
        InputError: If there is no such part, or the files cannot be written.
    """
    check_parts(only, PARTS)
    if "graphs" in only and not shared_graphs().is_dir():
        raise InputError(f"--only graphs: no folder {shared_graphs()}; point CANOPY_SHARED at it")
    numbers: dict[str, list[Row]] = {}
    with files_of("connected", out) as folder:
        for part, listed in PARTS.items():
            points: list[Point] = []
            if part in (only or PARTS):
                points += listed(quick=quick, cuts=inputs or (2 if quick else CUTS))
            if points:
                with Tally(part) as tally:
                    cases = [point.case for point in points]
                    results = in_parallel(measure, cases, tally.show, chunk=4)
                numbers[part] = rows_of(points, results)
                write(folder, part, points, results, numbers[part])
    if as_json:
        print_json("connected", folder, numbers)
    else:
        for part, rows in numbers.items():
            print_rows(part, rows)
        print(f"\nfigures and numbers in {folder}")
    return 1 if any(row.differs for rows in numbers.values() for row in rows) else 0


def write(
    folder: Path,
    part: str,
    points: Sequence[Point],
    results: Sequence[Measured],
    rows: Sequence[Row],
) -> None:
    """Write the figure of a part and its numbers."""
    FIGURES[part](rows, folder / f"{part}.png")
    write_json(folder / f"{part}.json", rows)
    header = ("panel", "curve", "x", "tree", "robots", "specified", *Measured._fields)
    lines = (
        (panel, case.curve, x, name_of(case.tree), case.robots, specified, *result)
        for (panel, x, case, specified), result in zip(points, results, strict=True)
    )
    write_csv(folder / f"{part}.csv", header, lines)


def name_of(tree: AnyTree) -> str:
    """Return what a tree is made of, for tables."""
    return f"{type(tree).__name__}{tuple(tree)}"


def print_rows(part: str, rows: Sequence[Row]) -> None:
    """Print a table on stdout."""
    print(f"\n{part}: ticks, and the speedup factor")
    width = max(len(row.panel) for row in rows)
    print(
        f"  {'':{width}} {'':>22} {'x':>4} {'robots':>6} {'n':>7} {'ticks':>8} {'SF':>6} ", end=""
    )
    print(f"{'at least':>8} {'specified':>9}")
    for row in rows:
        ticks = "stands" if row.ticks is None else f"{row.ticks:.6g}"
        speedup = "" if row.speedup is None else f"{row.speedup:.2f}"
        specified = "" if row.specified is None else f"{row.specified}"
        print(
            f"  {row.panel:{width}} {row.curve:>22} {row.x:4} {row.robots:6} {row.vertices:7.6g}"
            f" {ticks:>8} {speedup:>6} {row.lower_bound:8.6g} {specified:>9}"
            f"{' DIFFERS' if row.differs else ''}"
        )
    sys.stdout.flush()
