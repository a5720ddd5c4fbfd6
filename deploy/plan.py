"""What `canopy plan` does: a map and starts become a walk for each robot, before anything moves.

Trees (`agents.planning.trees`, `agents.planning.create_tree`) cover the complete coarse cells of one
connected part of the map; the algorithm ``best`` covers all free sub-cells that can be reached.
"""

import math
import re
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from msgspec import UNSET, Struct, UnsetType, json
from msgspec.structs import asdict

from agents.algorithms.stc import AWAY, SPAN, Tree, located, number, row_and_column, sub_cell
from agents.planning.create_tree import DISTANCES, Forest, grow_forest
from agents.planning.splits import SPLITS
from agents.planning.tour import Places, circumnavigate
from agents.planning.trees import TREES, Sets, component
from agents.planning.walks import closed_walks, first_visits, open_walks
from protocol.errors import InputError
from protocol.grid import EAST, SOUTH, Cell, Grid, sub_cells
from protocol.seeds import spawn

CREATE_TREE = "create-tree"
BEST = "best"
MOST_SETS = 1_000_000
"""So many bridge sets are evaluated at most when all are asked for."""
SHOWN = 40
"""Robots in the table for people."""
DIGITS = "0123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ"

Say = Callable[[str], object]


def algorithms() -> list[str]:
    """Return the names of all algorithms."""
    names = [f"{tree}+{split}" for tree in (*TREES, CREATE_TREE) for split in SPLITS]
    # A part of its own, which an installation may lack.
    return [*names, BEST] if find_spec("agents.planning.best") else names


@dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """What is to be planned.

    Attributes:
        algorithm: one of `algorithms`; of a given tree the split alone will do.
        robots: how many; ``None``: as many as there are starts.
        starts: sub-cells as text, ``r,c r,c``; ``None``: drawn from the seed.
        seed: of everything that is drawn.
        tree: file with the tree to use, instead of that of the algorithm.
        distance: between the tips of Create_Tree.
        tries: bridge sets to draw: a number, ``alpha`` (k to the alpha) or ``max`` (at least N).
        alpha: see ``tries``.
        all_bridges: whether to evaluate all bridge sets instead.
        is_open: whether walks end where the last sub-cell is covered.
        budget_s: how long ``best`` may search, of processor time, about.
    """

    algorithm: str = "create-tree+opt-mstc"
    robots: int | None = None
    starts: str | None = None
    seed: int = 0
    tree: Path | None = None
    distance: str = "manhattan"
    tries: str = "alpha"
    alpha: float = 2.0
    all_bridges: bool = False
    is_open: bool = False
    budget_s: float = 10.0


class TreeFacts(Struct, frozen=True, kw_only=True):
    """What Create_Tree says of its tree; most of it only if all bridge sets were asked for.

    Attributes:
        subtree_sizes: coarse cells of each subtree, in the order of their first robots.
        growths: how often subtrees walked, were hilled, and branched.
        tries: bridge sets that were evaluated.
        bridges: edges between subtrees.
        bridge_sets: ways to join the subtrees by them.
        d_max_best, d_max_worst: the largest distance with the best and the worst of those.
        opt_best: the least coverage time of Opt_MSTC with any of them.
        owner: the coarse cells, row by row: the subtree of each, or ``#``.
    """

    subtree_sizes: list[int]
    growths: tuple[int, int, int] | UnsetType = UNSET
    tries: int | UnsetType = UNSET
    bridges: int | UnsetType = UNSET
    bridge_sets: int | UnsetType = UNSET
    d_max_best: int | UnsetType = UNSET
    d_max_worst: int | UnsetType = UNSET
    opt_best: int | UnsetType = UNSET
    owner: list[str] | UnsetType = UNSET


class PlanFacts(TreeFacts, frozen=True, kw_only=True):
    """A plan in numbers; times and lengths in moves.

    Attributes:
        algorithm: its name.
        robots: how many.
        cells: sub-cells covered, the papers' N.
        tour: the longest walk with its way home.
        coverage_time: when the last sub-cell is visited first, if all robots move at once.
        lower_bound: N / k, rounded up: a closed walk has as many moves as sub-cells or more.
        distances: moves along the tour to the next robot, in the order of the tour; none for ``best``.
        order: robots in that order, robot 0 first.
        walks: length of each walk, by robot, with the way home unless they are open.
        starts: start of each robot.
        seconds: how long planning took.
    """

    algorithm: str
    robots: int
    cells: int
    tour: int
    coverage_time: int
    lower_bound: int
    distances: list[int]
    order: list[int]
    walks: list[int]
    starts: list[Cell]
    seconds: float


class Plan(NamedTuple):
    """A plan.

    Attributes:
        facts: it in numbers.
        walks: the sub-cells of each robot's walk, from its start.
        edges: of the tree: two coarse cells, and the robot that covers beside it.
    """

    facts: PlanFacts
    walks: list[list[Cell]]
    edges: list[tuple[Cell, Cell, int]]


def plan(grid: Grid, wanted: Wanted, say: Say = lambda _: None) -> Plan:
    """Plan a coverage.

    Args:
        grid: the map.
        wanted: what is to be planned.
        say: is told now and then how far it is.

    Raises:
        InputError: If something wanted does not fit the map or is not known.
    """
    began = time.perf_counter()
    tree_name, split_name = _names(wanted)
    if tree_name == BEST:
        made = _best(grid, wanted, say)
    else:
        made = _on_tree(grid, wanted, tree_name, split_name, say)
    closed = made.walks
    if not made.is_closed:
        say("finding the ways home")
        closed = closed_walks(made.walks)
    walks = made.walks if wanted.is_open else closed
    visits = first_visits(walks)
    facts = PlanFacts(
        algorithm=wanted.algorithm,
        robots=len(walks),
        cells=len(visits),
        tour=max(map(len, closed)) - 1,
        coverage_time=max(visits.values()),
        lower_bound=-(-len(visits) // len(walks)),
        distances=made.distances,
        order=made.order,
        walks=[len(walk) - 1 for walk in walks],
        starts=[walk[0] for walk in walks],
        seconds=round(time.perf_counter() - began, 6),
        **asdict(made.tree_facts),
    )
    return Plan(facts, walks, made.edges)


def describe(found: Plan) -> Iterator[str]:
    """Say in lines what a plan comes to."""
    facts = found.facts
    yield f"{facts.algorithm}: {facts.robots} robots cover {facts.cells} sub-cells"
    yield f"  coverage time  {facts.coverage_time} moves"
    yield f"  longest walk   {facts.tour} moves with the way home; at least {facts.lower_bound}"
    if facts.bridge_sets is not UNSET:
        yield (
            f"  bridge sets    {facts.bridge_sets} of {facts.bridges} bridges: largest distance "
            f"{facts.d_max_best} to {facts.d_max_worst}; Opt {facts.opt_best}"
        )
    gaps = dict(zip(facts.order, facts.distances, strict=True))
    covered = _shares(found.walks)
    yield f"  {'robot':>7}  {'start':>11}  {'covers':>8}  {'walk':>8}" + "  to the next" * bool(
        gaps
    )
    for robot, walk in enumerate(facts.walks[:SHOWN]):
        row, col = facts.starts[robot]
        line = f"  {robot:>7}  {f'{row},{col}':>11}  {covered[robot]:>8}  {walk:>8}"
        yield line + (f"  {gaps[robot]:>11}" if gaps else "")
    if facts.robots > SHOWN:
        yield f"  and {facts.robots - SHOWN} more"


def draw_plan(grid: Grid, found: Plan, picture: Path, name: str) -> None:
    """Draw the tree, each robot's part in its colour, and the starts.

    Args:
        grid: the map.
        found: the plan.
        picture: the file to write.
        name: of the map.

    Raises:
        ValueError: If the suffix is unknown.
        OSError: If the picture cannot be written.
    """
    from deploy.picture_grid import draw_grid_run

    facts = found.facts
    firsts = _first_visitors(found.walks)
    draw_grid_run(
        grid,
        picture,
        title=f"{name}: {facts.algorithm}",
        subtitle=(
            f"{facts.robots} robots, {facts.cells} sub-cells; coverage time {facts.coverage_time}, "
            f"longest walk with the way home {facts.tour} moves"
        ),
        starts=facts.starts,
        first_visits={grid.place(*cell): first for cell, first in firsts.items()},
        owners={},
        edges=found.edges,
        lost={},
        stopped={},
        team_size=facts.robots,
    )


def _first_visitors(walks: Sequence[Sequence[Cell]]) -> dict[Cell, tuple[int, float]]:
    """Return for each sub-cell the robot that comes first, and when."""
    firsts: dict[Cell, tuple[int, float]] = {}
    for robot, walk in enumerate(walks):
        for at, cell in enumerate(walk):
            if cell not in firsts or at < firsts[cell][1]:
                firsts[cell] = (robot, float(at))
    return firsts


def _shares(walks: Sequence[Sequence[Cell]]) -> list[int]:
    """Return in how many sub-cells each robot comes first."""
    shares = [0] * len(walks)
    for robot, _ in _first_visitors(walks).values():
        shares[robot] += 1
    return shares


# What is planned.


class _Made(NamedTuple):
    walks: list[list[Cell]]
    is_closed: bool
    distances: list[int]
    order: list[int]
    edges: list[tuple[Cell, Cell, int]]
    tree_facts: TreeFacts


def _on_tree(grid: Grid, wanted: Wanted, tree_name: str, split_name: str, say: Say) -> _Made:
    """Plan with a tree and a split of its tour."""
    cells, starts = _coarse(grid, wanted)
    tree_facts = TreeFacts(subtree_sizes=[])
    say(f"building a tree of {len(cells)} coarse cells")
    if wanted.tree is not None:
        tree = _read_tree(wanted.tree, grid, cells)
    elif tree_name == CREATE_TREE:
        tree, tree_facts = _create_tree(grid, cells, starts, wanted, say)
    else:
        tree = TREES[tree_name](cells, spawn(wanted.seed, "tree"))
    say(f"going around {4 * len(cells)} sub-cells")
    tour = circumnavigate(tree, starts[0])
    places = Places(tour, starts)
    walks = open_walks(tour, places, SPLITS[split_name](places.gaps))
    covers = {cell: robot for robot, walk in enumerate(walks) for cell in walk}
    edges = [
        (row_and_column(cell), row_and_column(cell + AWAY[way]), covers[sub_cell(cell, way)])
        for cell in cells
        for way in (EAST, SOUTH)
        if tree.edges[cell] >> way & 1
    ]
    return _Made(walks, False, places.gaps, places.order, edges, tree_facts)


def _create_tree(
    grid: Grid, cells: Sequence[int], starts: Sequence[Cell], wanted: Wanted, say: Say
) -> tuple[Tree, TreeFacts]:
    from agents.planning.bridges import Bridges, best_of_all, best_of_tries, count_spanning_sets

    forest = grow_forest(cells, [located(start)[0] for start in starts], wanted.distance)
    bridges = Bridges(forest, starts)
    if not wanted.all_bridges:
        tries = _tries(wanted, len(starts), 4 * len(cells))
        if bridges.subtrees == 1:
            tries = 1
        say(f"joining {bridges.subtrees} subtrees by {len(bridges)} bridges, {tries} tries")
        best = best_of_tries(bridges, tries, spawn(wanted.seed, "bridges"), say)
        return bridges.join(best.bridge_set), TreeFacts(
            subtree_sizes=forest.sizes, growths=forest.growths, tries=best.sets
        )
    whole = best_of_all(bridges, MOST_SETS)
    if whole is None:
        ends = [(int(one), int(other)) for one, other in bridges.ends]
        count = count_spanning_sets(bridges.subtrees, ends)
        raise InputError(
            f"--all-bridges: there are {_about(count)} bridge sets, expected at most {MOST_SETS}; "
            "leave it out to draw some of them"
        )
    return bridges.join(whole.best.bridge_set), TreeFacts(
        subtree_sizes=forest.sizes,
        growths=forest.growths,
        tries=whole.best.sets,
        bridges=len(bridges),
        bridge_sets=whole.best.sets,
        d_max_best=whole.best.d_max,
        d_max_worst=whole.d_max_worst,
        opt_best=whole.opt_best,
        owner=_owner_rows(grid, forest),
    )


def _best(grid: Grid, wanted: Wanted, say: Say) -> _Made:
    """Plan by search, without a tree."""
    from agents.planning.best import plan_best

    if wanted.tree is not None:
        raise InputError(
            "--tree: the algorithm best has no tree; expected TREE+SPLIT, or no --tree"
        )
    starts = _starts(grid, wanted, sorted(map(number, _largest(grid))), is_coarse=False)
    reached = grid.reachable(starts[:1])
    for robot, start in enumerate(starts):
        if start not in reached:
            raise _apart(robot, start, starts[0])
    if not 0 < wanted.budget_s < math.inf:
        raise InputError(f"--budget: found {wanted.budget_s:g}, expected seconds above 0")
    free = [[(row, col) in reached for col in range(grid.cols)] for row in range(grid.rows)]
    say(f"searching for {wanted.budget_s:g} s")
    walks = plan_best(
        free, starts, budget_s=wanted.budget_s, seed=wanted.seed, closed=not wanted.is_open
    )
    return _Made(walks, not wanted.is_open, [], [], [], TreeFacts(subtree_sizes=[]))


def _names(wanted: Wanted) -> tuple[str, str]:
    """Return the names of tree and split, or `BEST` and nothing."""
    name, known = wanted.algorithm, algorithms()
    is_split = wanted.tree is not None and name in SPLITS
    if name not in known and not is_split:
        trees, splits = ", ".join((*TREES, CREATE_TREE)), ", ".join(SPLITS)
        others = [*([BEST] if BEST in known else []), "parent-child"]
        raise InputError(
            f"--algorithm: found {name!r}, expected TREE+SPLIT, {' or '.join(others)}; TREE is one of "
            f"{trees}, SPLIT one of {splits}"
        )
    tree, _, split = name.rpartition("+") if name != BEST else (BEST, "", "")
    if wanted.all_bridges and (tree != CREATE_TREE or wanted.tree is not None):
        raise InputError("--all-bridges: only create-tree has bridges; expected create-tree+SPLIT")
    if wanted.distance not in DISTANCES:
        known_distances = ", ".join(DISTANCES)
        raise InputError(f"--distance: found {wanted.distance!r}, expected {known_distances}")
    return tree, split


def _tries(wanted: Wanted, robots: int, covered: int) -> int:
    """Return how many bridge sets to draw."""
    if wanted.tries.isdecimal() and int(wanted.tries):
        return int(wanted.tries)
    if wanted.tries not in {"alpha", "max"}:
        raise InputError(
            f"--tries: found {wanted.tries!r}, expected a whole number from 1, alpha or max"
        )
    if not 0 <= wanted.alpha <= 4:
        raise InputError(f"--alpha: found {wanted.alpha:g}, expected 0 to 4")
    power = max(1, round(float(robots**wanted.alpha)))
    return max(power, covered) if wanted.tries == "max" else power


# The map and the starts.


def _coarse(grid: Grid, wanted: Wanted) -> tuple[list[int], list[Cell]]:
    """Return the coarse cells to cover, row by row, and the starts."""
    largest = sorted(map(number, _largest(grid)))
    if not largest:
        raise InputError(
            "MAP: no complete coarse cell, that is 2 x 2 free sub-cells aligned to even rows and "
            "columns; expected one at least (--cell-m sets the size of sub-cells)"
        )
    starts = _starts(grid, wanted, largest, is_coarse=True)
    first = located(starts[0])[0]
    free = set(largest)
    cells = largest
    if first not in free:
        cells = component([number(cell) for cell in grid.complete_cells()], first)
        free = set(cells)
    for robot, start in enumerate(starts):
        if located(start)[0] not in free:
            raise _apart(robot, start, starts[0])
    return cells, starts


def _largest(grid: Grid) -> list[Cell]:
    """Return the largest connected part of the complete coarse cells; of equals the first."""
    whole = grid.complete_cells()
    seen: set[Cell] = set()
    largest: set[Cell] = set()
    for cell in whole:
        if cell not in seen:
            part = grid.reachable_cells([cell])
            seen |= part
            largest = max(largest, part, key=len)
    return list(largest)


def _starts(grid: Grid, wanted: Wanted, largest: Sequence[int], *, is_coarse: bool) -> list[Cell]:
    """Return the start of each robot: as given, or drawn in the largest part.

    Raises:
        InputError: If robots cannot start there.
    """
    if wanted.starts is None:
        if wanted.robots is None:
            raise InputError("--robots: how many? Expected --robots K, or --starts 'r,c r,c ...'")
        among = [at for cell in largest for at in sub_cells(row_and_column(cell))]
        if wanted.robots > len(among):
            raise InputError(
                f"--robots: found {wanted.robots}, expected at most {len(among)}, one for each "
                "sub-cell of the largest connected part"
            )
        return spawn(wanted.seed, "starts").sample(among, wanted.robots)
    starts = [
        _start(grid, robot, word, is_coarse=is_coarse)
        for robot, word in enumerate(wanted.starts.split())
    ]
    if not starts:
        raise InputError("--starts: found none, expected 'r,c r,c ...', a sub-cell for each robot")
    if wanted.robots not in {None, len(starts)}:
        raise InputError(
            f"--robots: found {wanted.robots} with {len(starts)} --starts; expected one of both"
        )
    robots: dict[Cell, int] = {}
    for robot, start in enumerate(starts):
        if start in robots:
            raise InputError(
                f"--starts: robots {robots[start]} and {robot} both start on {_text(start)}; "
                "expected a sub-cell of its own for each"
            )
        robots[start] = robot
    return starts


def _start(grid: Grid, robot: int, word: str, *, is_coarse: bool) -> Cell:
    """Read one start."""
    found = re.fullmatch(r"(-?\d{1,9}),(-?\d{1,9})", word)
    if found is None:
        raise InputError(f"--starts: robot {robot}: found {word!r}, expected ROW,COLUMN")
    row, col = int(found[1]), int(found[2])
    if not (0 <= row < grid.rows and 0 <= col < grid.cols):
        raise InputError(
            f"--starts: robot {robot}: {word} lies outside; expected rows 0 to {grid.rows - 1}, "
            f"columns 0 to {grid.cols - 1}"
        )
    if not grid.is_free(row, col):
        raise InputError(f"--starts: robot {robot}: {word} is blocked; expected a free sub-cell")
    if is_coarse and not grid.is_complete(row // 2, col // 2):
        raise InputError(
            f"--starts: robot {robot}: {word} lies in a coarse cell that is partly blocked; "
            "expected one whose four sub-cells are free"
        )
    return row, col


def _apart(robot: int, start: Cell, other: Cell) -> InputError:
    return InputError(
        f"--starts: robot {robot}: {_text(start)} is not connected with robot 0 at {_text(other)}; "
        "expected all robots in one connected part"
    )


def _read_tree(path: Path, grid: Grid, cells: Sequence[int]) -> Tree:
    """Read a spanning tree from a file.

    Raises:
        InputError: If it cannot be read, or is no spanning tree of the cells.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"--tree {path}: {error}") from None
    tree = Tree()
    for cell in cells:
        tree.root(cell)
    sets = Sets(cells)
    joined = 0
    for at, line in enumerate(lines, 1):
        words = re.split("[#;]", line, maxsplit=1)[0].split()
        for word in words[1:] if words[:1] == ["tree"] else words:
            where = f"--tree {path}, line {at}: edge {word}"
            one, other = _edge(where, word)
            for end in (one, other):
                if not grid.is_complete(*end):
                    raise InputError(f"{where}: {_text(end)} is no free coarse cell of the map")
                if number(end) not in tree:
                    raise InputError(f"{where}: {_text(end)} is not connected with the robots")
            away = number(other) - number(one)
            if away not in AWAY:
                raise InputError(f"{where}: these are no neighbours; expected two side by side")
            if not sets.unite(number(one), number(other)):
                raise InputError(f"{where}: closes a cycle; expected a tree")
            tree.join(number(one), AWAY.index(away))
            joined += 1
    if joined < len(cells) - 1:
        raise InputError(
            f"--tree {path}: {joined} edges leave coarse cells apart; expected a tree of all "
            f"{len(cells)}, which has {len(cells) - 1}"
        )
    return tree


def _edge(where: str, word: str) -> tuple[Cell, Cell]:
    """Read the two coarse cells of an edge."""
    found = re.fullmatch(r"(\d{1,6}),(\d{1,6})-(\d{1,6}),(\d{1,6})", word)
    if found is None:
        raise InputError(f"{where}: expected ROW,COLUMN-ROW,COLUMN, two coarse cells")
    one, other = (int(found[1]), int(found[2])), (int(found[3]), int(found[4]))
    return one, other


def _owner_rows(grid: Grid, forest: Forest) -> list[str]:
    """Return rows of coarse cells, each with the digit of its subtree."""
    marks = {cell: DIGITS[subtree % len(DIGITS)] for cell, subtree in forest.owner.items()}
    rows, cols = range(grid.rows // 2), range(grid.cols // 2)
    return ["".join(marks.get(row * SPAN + col, "#") for col in cols) for row in rows]


def _text(cell: Cell) -> str:
    return f"{cell[0]},{cell[1]}"


def _about(count: int) -> str:
    return str(count) if count < 10**9 else f"about 10^{len(str(count)) - 1}"


def write_paths(path: Path, walks: Iterable[Sequence[Cell]]) -> None:
    """Write walks as a JSON list of lists of ``[row, column]``.

    Raises:
        OSError: If the file cannot be written.
    """
    path.write_bytes(json.encode(list(walks)) + b"\n")
