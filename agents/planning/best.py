"""The best walks that a given time allows, for a team that covers a grid known beforehand.

Unlike the coverage algorithms, this is an optimiser: it knows the whole grid, also sub-cells outside
complete coarse cells, and robots do not stand in each other's way. Three stages, each of which
improves on what it is given as long as time allows:

1. Regions (`agents.planning.best_regions`): blocks of 2 x 2 sub-cells are divided among the robots.
   Regions grow and are balanced by flows along their borders; then annealing lowers the largest cost,
   and lets robots reach their part through others where starts are crowded.
2. Tours (`agents.planning.best_walks`): walks around the regions, annealed sub-cell by sub-cell.
3. Coverage: the way back covers nothing new. Each walk is cut after its last useful visit and
   annealed once more, with the length of the tours as a limit where robots have to return.

No peer's algorithm is followed: spanning tree coverage (Gabriely and Rimon) is where the walks begin,
and the limit that annealing lowers step by step replaces an explicit minimisation of the maximum.
"""

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from agents.planning.best_regions import Blocks, Regions, anneal, around, balance, grow, mend, prune
from agents.planning.best_split import split
from agents.planning.best_walks import Search, Team, Walk
from protocol.grid import Cell
from protocol.seeds import Stream, spawn

STEP_S = 0.7e-6
"""What a step of annealing takes, in seconds, where there is no clock."""

CHUNK = 20_000
"""So many steps between two looks at the clock."""

GROWN_UNTIL, REGIONS_UNTIL, TOURS_UNTIL, OPEN_TOURS_UNTIL = 0.15, 0.45, 0.85, 0.6
"""The part of the budget at which each stage ends: without return, tours matter less."""

REGIONS_HEAT = (0.2, 0.05)
"""Heat at the beginning and the end of each annealing of regions."""

FIRST_HEAT, HOTTEST, COLDEST = 0.15, 0.25, 0.06
"""Heat at the beginning of the first annealing of walks and of the last, and at the end of all."""

SPLIT = 1.2
"""If the longest walk around a region is longer than this many bounds, one tour is split as well."""

AMBITION = 0.5
"""How far from the longest walk to the mean a search aims at first; half as far if it fails."""

MENDING = 0.6
"""From this part of an annealing on, what is left out is added wherever there is room for it."""

FIRST_STEPS = 150
"""Steps a sub-cell in the first annealing of walks."""

TABLE = 6_000_000
"""Ways back are looked up in tables if they have no more entries than this."""


class Budget:
    """How much of the time is used: by a clock, or by counting steps."""

    __slots__ = ("_budget_s", "_clock", "_counted_s", "_start_s")

    def __init__(self, budget_s: float, clock: Callable[[], float] | None) -> None:
        self._budget_s = max(budget_s, 1e-9)
        self._clock = clock
        self._start_s = clock() if clock else 0.0
        self._counted_s = 0.0

    def count(self, steps: int) -> None:
        """Count steps of annealing, or of anything that takes as long."""
        self._counted_s += steps * STEP_S

    @property
    def used(self) -> float:
        """The part of the budget that is used, 1 when it is all gone."""
        spent_s = self._clock() - self._start_s if self._clock else self._counted_s
        return spent_s / self._budget_s


class Problem:
    """A grid and where its robots start.

    Attributes:
        blocks: those within reach.
        starts: sub-cell of each robot, by number.
        free: whether each sub-cell is within reach.
        tour_bound, cover_bound: no longest tour is shorter, no coverage time earlier.
    """

    __slots__ = ("blocks", "cover_bound", "free", "starts", "tour_bound")

    def __init__(self, free: Sequence[Sequence[bool]], starts: Sequence[Cell]) -> None:
        """Find out what is within reach.

        Args:
            free: ``(rows, cols)``; True where a sub-cell is free.
            starts: row and column where each robot starts.

        Raises:
            ValueError: If the rows have different lengths, or a start is not a free sub-cell.
        """
        if len({len(row) for row in free}) != 1:
            raise ValueError("free: give at least one row, all of the same length")
        grid = np.array([list(row) for row in free], dtype=np.bool_).reshape(len(free), -1)
        rows, cols = grid.shape
        for start in starts:
            if not (0 <= start[0] < rows and 0 <= start[1] < cols and grid[start]):
                raise ValueError(f"starts: {start} is not a free sub-cell of the grid")
        stride = int(cols) + 2
        self.starts = [(row + 1) * stride + col + 1 for row, col in starts]
        open_: list[bool] = np.pad(grid, 1).reshape(-1).tolist()
        away = distances(open_, stride, self.starts)
        self.free = [moves >= 0 for moves in away]
        self.blocks = Blocks(np.array(self.free).reshape(rows + 2, stride)[1:-1, 1:-1])
        self.tour_bound, self.cover_bound = self._bounds(max(away))

    def _bounds(self, farthest: int) -> tuple[int, int]:
        """Each connected part of the grid is shared by the robots in it; somebody goes farthest."""
        robots: dict[int, int] = {}
        part = [-1] * len(self.free)
        cells: list[int] = []
        for start in self.starts:
            if part[start] < 0:
                reached = flood(self.free, self.blocks.stride, start, part, len(cells))
                cells.append(reached)
            robots[part[start]] = robots.get(part[start], 0) + 1
        share = max(-(-cells[one] // count) for one, count in robots.items())
        tour = 2 * farthest if share < 2 else max(2 * farthest, share + share % 2)
        return tour, max(farthest, share - 1)


def flood(free: Sequence[bool], stride: int, start: int, part: list[int], name: int) -> int:
    """Write ``name`` to all that is connected with a sub-cell; return how many that are."""
    part[start] = name
    ahead = [start]
    count = 0
    while ahead:
        at = ahead.pop()
        count += 1
        for cell in (at + 1, at - 1, at + stride, at - stride):
            if free[cell] and part[cell] < 0:
                part[cell] = name
                ahead.append(cell)
    return count


def distances(free: Sequence[bool], stride: int, starts: Sequence[int]) -> list[int]:
    """Return the moves from the nearest start to each sub-cell, -1 where none leads there."""
    away = [-1] * len(free)
    ahead = list(dict.fromkeys(starts))
    for start in ahead:
        away[start] = 0
    moves = 0
    while ahead:
        moves += 1
        behind, ahead = ahead, []
        for at in behind:
            for cell in (at + 1, at - 1, at + stride, at - stride):
                if free[cell] and away[cell] < 0:
                    away[cell] = moves
                    ahead.append(cell)
    return away


def plan_best(
    free: Sequence[Sequence[bool]],
    starts: Sequence[Cell],
    *,
    budget_s: float,
    seed: int,
    closed: bool = True,
    clock: Callable[[], float] | None = None,
) -> list[list[Cell]]:
    """Plan walks that cover all that any robot can reach.

    The longest walk is as short as possible; among those, the coverage time is. Robots may share
    sub-cells, at their start and on their way.

    Args:
        free: ``(rows, cols)``; True where a sub-cell is free.
        starts: row and column where each robot starts.
        budget_s: how long to improve the walks, in seconds of the clock.
        seed: of all random choices.
        closed: robots return to their starts. If not, only the coverage time counts.
        clock: tells the time in seconds. Without one, steps are counted that take no longer than
            ``budget_s`` on a fast machine, and the result is the same each time.

    Returns:
        The walk of each robot: neighbouring free sub-cells, its start first, and last too if closed.

    Raises:
        ValueError: If the rows have different lengths, or a start is not a free sub-cell.
    """
    if not starts:
        return []
    budget = Budget(budget_s, clock)
    problem = Problem(free, starts)
    regions, others = divide(problem, budget, seed)
    walks = [
        around(problem.blocks, held, start)
        for held, start in zip(regions, problem.starts, strict=True)
    ]
    if _longest(walks) > SPLIT * problem.tour_bound:
        walks = min(walks, split(problem.blocks, problem.starts), key=_longest)
    walks = shorten(
        problem, walks, others, budget, seed, until=TOURS_UNTIL if closed else OPEN_TOURS_UNTIL
    )
    walks = hasten(problem, walks, budget, seed, closed=closed)
    stride = problem.blocks.stride
    return [[(cell // stride - 1, cell % stride - 1) for cell in walk] for walk in walks]


Held = list[set[int]]
"""The blocks of each robot."""


def divide(problem: Problem, budget: Budget, seed: int) -> tuple[Held, list[Held]]:
    """Divide the blocks among the robots.

    Regions are grown several times, and the best are annealed to lower and lower limits. Every other
    time after a failure two robots begin anew, which is what gets a search in a maze unstuck.

    Returns:
        The best regions, and some with a lower cost that leave a few blocks out.
    """
    blocks = problem.blocks
    roots = [blocks.of[start] for start in problem.starts]
    size = len(blocks.cells)

    def goes_on(until: float) -> bool:
        budget.count(5 * size)
        return budget.used < until

    best: Regions | None = None
    for attempt in range(8):
        if best and (max(best.cost) <= problem.tour_bound or not goes_on(GROWN_UNTIL)):
            break
        regions = _grown(problem, roots, seed, attempt, dig=attempt % 2 == 1)
        balance(regions, spawn(seed, "balance", attempt), lambda: goes_on(GROWN_UNTIL))
        if best is None or max(regions.cost) < max(best.cost):
            best = regions
    assert best is not None
    regions = best
    found = regions.copy()
    cost = max(regions.cost)
    near_misses: list[tuple[int, int, Held]] = []
    attempt = failures = 0
    while budget.used < REGIONS_UNTIL and cost - 4 >= problem.tour_bound:
        attempt += 1
        rng = spawn(seed, "regions", attempt)
        if failures % 2:
            for robot in rng.sample(range(len(roots)), min(2, len(roots))):
                regions.strip(robot)
        step = 4 if failures else max(4, (cost - problem.tour_bound) // 8)
        if _annealed(regions, cost - step, budget, 300 * size, rng):
            found, cost, failures = regions.copy(), min(max(regions.cost), cost - 4), 0
            near_misses.clear()
            continue
        failures += 1
        missed = sum(not holders for holders in regions.holders)
        near_misses.append((missed, -attempt, regions.copy()))
        near_misses = sorted(near_misses)[:2]
        regions.restore(near_misses[0][-1])
    return found, [held for missed, _, held in near_misses if missed < 0.1 * size]


def _grown(problem: Problem, roots: list[int], seed: int, attempt: int, *, dig: bool) -> Regions:
    regions = Regions(problem.blocks, roots)
    grow(regions, spawn(seed, "grow", attempt), dig=dig)
    prune(regions)
    return regions


def _annealed(regions: Regions, limit: int, budget: Budget, steps: int, rng: Stream) -> bool:
    chunk = max(CHUNK, 2 * len(regions.holders))
    hot, cold = REGIONS_HEAT
    for done in range(0, steps, chunk):
        budget.count(chunk)
        if anneal(regions, limit, rng, chunk, hot * (cold / hot) ** (done / steps)):
            return True
        if budget.used > REGIONS_UNTIL:
            break
    left_out = regions.copy()
    if mend(regions, limit):
        return True
    regions.restore(left_out)
    return False


def shorten(
    problem: Problem, walks: list[Walk], others: list[Held], budget: Budget, seed: int, until: float
) -> list[Walk]:
    """Shorten the longest of closed walks.

    Args:
        problem: the grid.
        walks: of the regions.
        others: regions that begin nearer to what is searched for, but leave something out.
        budget: what time is left.
        seed: of all random choices.
        until: the part of the budget to stop at.
    """
    best = walks
    blocks, starts = problem.blocks, problem.starts
    ambition = AMBITION
    attempt = 0
    while budget.used < until and _longest(best) > problem.tour_bound:
        which = attempt % (len(others) + 1)
        begin = best
        if which:
            pairs = zip(others[which - 1], starts, strict=True)
            begin = [around(blocks, held, start) for held, start in pairs]
        search = Search(
            Team(problem.free, begin),
            problem.free,
            blocks.stride,
            spawn(seed, "tours", attempt),
            price=_price(best, problem.tour_bound),
            closed=True,
        )
        search.aim(_aim(best, problem.tour_bound, ambition, 2))
        found = best
        for found in _cycle(search, attempt // (len(others) + 1), budget, until):
            if _longest(found) <= problem.tour_bound:
                return found
            search.aim(_aim(found, problem.tour_bound, ambition, 2))
        if found is best:
            ambition /= 2
        best = found
        attempt += 1
    return best


def _aim(walks: Sequence[Walk], bound: int, ambition: float, step: int) -> int:
    """Return how long the longest walk is to be next: by some steps shorter, towards the mean."""
    longest = _longest(walks)
    mean = sum(map(len, walks)) / len(walks)
    return longest - step * max(1, int(ambition * (longest - max(bound, mean)) / step))


def _price(walks: Sequence[Walk], bound: int) -> float:
    """Return the price of a move: a higher one where hardly any can be spared."""
    return 0.3 if _longest(walks) < 1.03 * bound + 2 else 0.15


def hasten(
    problem: Problem, walks: list[Walk], budget: Budget, seed: int, *, closed: bool
) -> list[Walk]:
    """Cover earlier, with tours no longer than they are.

    Args:
        problem: the grid.
        walks: closed ones.
        budget: what time is left.
        seed: of all random choices.
        closed: robots return to their starts.
    """
    tour = _longest(walks)
    oriented = [_oriented(walk, shared) for walk, shared in _with_shared(walks, len(problem.free))]
    best = cut(oriented)
    back: list[list[int]] | None = None
    stride = problem.blocks.stride
    if closed:
        if len(problem.free) * len(walks) > TABLE:
            return oriented
        back = [distances(problem.free, stride, [start]) for start in problem.starts]
    ambition = AMBITION
    attempt = 0
    while budget.used < 1 and _longest(best) > problem.cover_bound:
        search = Search(
            Team(problem.free, best),
            problem.free,
            stride,
            spawn(seed, "cover", attempt),
            price=_price(best, problem.cover_bound),
            back=back,
            return_limit=tour,
            closed=False,
        )
        search.aim(_aim(best, problem.cover_bound, ambition, 1))
        found = best
        for found in _cycle(search, attempt, budget, 1):
            if _longest(found) <= problem.cover_bound:
                break
            search.aim(_aim(found, problem.cover_bound, ambition, 1))
        if found is best:
            ambition /= 2
        best = found
        attempt += 1
    if back is None:
        return best
    return [_returned(walk, away, stride) for walk, away in zip(best, back, strict=True)]


def _cycle(search: Search, attempt: int, budget: Budget, until: float) -> Iterator[list[Walk]]:
    """Anneal from hot to cold, each attempt longer and hotter; yield what is found on the way."""
    hot = min(HOTTEST, FIRST_HEAT * 1.2**attempt)
    steps = int(FIRST_STEPS * 1.3**attempt) * len(search.team.live)
    begin = budget.used
    for done in range(0, steps, CHUNK):
        if budget.used >= until:
            return
        # Whatever ends first, the steps or the time: it ends cold.
        part = max(done / steps, (budget.used - begin) / (until - begin))
        if search.run(CHUNK, hot * (COLDEST / hot) ** part) or (part > MENDING and search.mend()):
            yield search.team.walks()
        budget.count(CHUNK)


def _longest(walks: Sequence[Walk]) -> int:
    return max(map(len, walks)) - 1


def _with_shared(walks: Sequence[Walk], cells: int) -> Iterator[tuple[Walk, list[bool]]]:
    """Yield each walk, and whether each sub-cell is visited by several robots."""
    robots = [0] * cells
    for walk in walks:
        for cell in set(walk):
            robots[cell] += 1
    shared = [count > 1 for count in robots]
    for walk in walks:
        yield walk, shared


def _oriented(walk: Walk, shared: Sequence[bool]) -> Walk:
    """Return a walk in that direction which ends with the longer stretch of nothing new."""

    def useful(one: Walk) -> int:
        seen: set[int] = set()
        last = 0
        for moves, cell in enumerate(one):
            if cell not in seen and not shared[cell]:
                last = moves
            seen.add(cell)
        return last

    return min((walk, walk[::-1]), key=useful)


def cut(walks: Sequence[Walk]) -> list[Walk]:
    """Cut each walk after the last sub-cell that it is the first to visit."""
    first: dict[int, tuple[int, int]] = {}
    for robot, walk in enumerate(walks):
        for moves, cell in enumerate(walk):
            if cell not in first or moves < first[cell][0]:
                first[cell] = (moves, robot)
    ends = [0] * len(walks)
    for moves, robot in first.values():
        ends[robot] = max(ends[robot], moves)
    return [walk[: end + 1] for walk, end in zip(walks, ends, strict=True)]


def _returned(walk: Walk, away: Sequence[int], stride: int) -> Walk:
    """Return a walk and a shortest way back from its end."""
    walk = walk[:]
    while away[walk[-1]]:
        at = walk[-1]
        walk.append(
            next(
                cell
                for cell in (at + 1, at - 1, at + stride, at - stride)
                if away[cell] == away[at] - 1
            )
        )
    return walk
