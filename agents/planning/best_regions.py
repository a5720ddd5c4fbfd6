"""A connected region for each robot, balanced by pushing blocks along the graph of regions.

A *block* is a connected set of free sub-cells within one 2 x 2 square: a complete coarse cell, or what
is left of one (two diagonal sub-cells are two blocks). The squares need not be aligned to the corner
of the grid: of the four alignments that with the most complete squares is taken. Going around all
sub-cells of a block costs its *weight*; going around two neighbouring blocks together costs nothing
more where they share two sub-cell borders (a *smooth* join, the usual one), else 2.

A region holds its robot's start. Regions may overlap: a robot that is shut in by others has a way
through them, which it pays for like everybody else. A block is never without a region that holds it.
"""

from collections import deque
from collections.abc import Callable, Sequence
from heapq import heapify, heappop, heappush
from itertools import pairwise
from math import exp

import numpy as np
import numpy.typing as npt

from protocol.seeds import Stream

PRICE = 0.1
"""What it costs in `anneal` to hold a block, where a block that nobody holds costs 1."""

PATIENCE = 25
"""So many rounds of `balance` in a row may bring nothing."""

FEW = 100
"""`mend` leaves it be where more blocks than this are missing: it would take long."""

SEARCH = 60
"""So many blocks are looked at to see whether a region holds together without one of its blocks."""


class Blocks:
    """The blocks of a grid and how they are joined.

    A sub-cell is a number, ``(row + 1) * stride + col + 1``: a border of blocked cells lies around.

    Attributes:
        stride: sub-cells from one row to the next.
        of: block of each sub-cell, -1 where it is blocked.
        cells: sub-cells of each block.
        weight: moves of a closed walk around each block.
        near: neighbours of each block.
        smooth: of each block, the neighbours whose join is free.
    """

    __slots__ = ("cells", "near", "of", "smooth", "stride", "weight")

    def __init__(self, free: npt.NDArray[np.bool_]) -> None:
        """Cut a grid into blocks.

        Args:
            free: ``(rows, cols)`` bool; True where a sub-cell is free.
        """
        open_ = np.pad(free, 1)
        self.stride = int(open_.shape[1])
        square = _squares(open_)
        whole = np.bincount(square[open_], minlength=int(square.max()) + 1)
        count = whole[square]
        # Two cells of a square that do not touch: then the lower one is a block of its own.
        side = np.zeros_like(open_)
        for axis in (0, 1):
            pair = open_ & np.roll(open_, -1, axis) & (square == np.roll(square, -1, axis))
            side |= pair | np.roll(pair, 1, axis)
        alone = open_ & (count == 2) & ~side
        key = 2 * square
        key[alone & (square == np.roll(square, 1, 1))] += 1
        names, numbers = np.unique(key[open_], return_inverse=True)
        of = np.full(open_.shape, -1, np.int64)
        of[open_] = numbers.reshape(-1)
        flat = of.reshape(-1)
        self.of: list[int] = flat.tolist()
        self.cells: list[list[int]] = [[] for _ in names]
        for cell in np.flatnonzero(flat >= 0).tolist():
            self.cells[self.of[cell]].append(cell)
        self.weight = [(0, 2, 4, 4)[len(cells) - 1] for cells in self.cells]
        self.near: list[list[int]] = [[] for _ in names]
        self.smooth: list[list[int]] = [[] for _ in names]
        self._join(flat)

    def _join(self, flat: npt.NDArray[np.int64]) -> None:
        blocks = len(self.cells)
        keys = []
        for step in (1, self.stride):
            one, other = flat[:-step], flat[step:]
            border = (one >= 0) & (other >= 0) & (one != other)
            one, other = one[border], other[border]
            keys.append(np.minimum(one, other) * blocks + np.maximum(one, other))
        joins, borders = np.unique(np.concatenate(keys), return_counts=True)
        for join, shared in zip(joins.tolist(), borders.tolist(), strict=True):
            one_, other_ = divmod(join, blocks)
            self.near[one_].append(other_)
            self.near[other_].append(one_)
            if shared > 1:
                self.smooth[one_].append(other_)
                self.smooth[other_].append(one_)


def _squares(open_: npt.NDArray[np.bool_]) -> npt.NDArray[np.int64]:
    """Return the number of each cell's 2 x 2 square, in the alignment with the most complete ones."""
    rows, cols = open_.shape
    corner = open_[:-1, :-1] & open_[1:, :-1] & open_[:-1, 1:] & open_[1:, 1:]
    # The border shifts the grid by one: squares aligned to its corner begin at odd rows and columns.
    offsets = [(1, 1), (0, 1), (1, 0), (0, 0)]
    best = max(offsets, key=lambda at: int(corner[at[0] :: 2, at[1] :: 2].sum()))
    row = (np.arange(rows, dtype=np.int64) + best[0]) // 2
    col = (np.arange(cols, dtype=np.int64) + best[1]) // 2
    number: npt.NDArray[np.int64] = row[:, None] * (cols + 1) + col[None, :]
    return number


class Regions:
    """Who goes around which blocks.

    Attributes:
        held: the blocks of each robot.
        holders: the robots of each block.
        cost: how many moves it takes each robot to go around its blocks; see `reckon`.
    """

    __slots__ = ("blocks", "cost", "held", "holders", "roots")

    def __init__(self, blocks: Blocks, roots: Sequence[int]) -> None:
        """Begin with the blocks that the robots stand in."""
        self.blocks = blocks
        self.roots = list(roots)
        self.held: list[set[int]] = [set() for _ in roots]
        self.holders: list[list[int]] = [[] for _ in blocks.cells]
        self.cost = [0] * len(roots)
        for robot, root in enumerate(roots):
            self.add(robot, root)

    def price(self, robot: int, block: int) -> int:
        """Return what a block costs a robot that holds neighbours of it."""
        held = self.held[robot]
        for other in self.blocks.smooth[block]:
            if other in held:
                return self.blocks.weight[block]
        return self.blocks.weight[block] + (2 if len(held) > 0 else 0)

    def add(self, robot: int, block: int) -> None:
        """Give a robot a block."""
        self.cost[robot] += self.price(robot, block)
        self.held[robot].add(block)
        self.holders[block].append(robot)

    def drop(self, robot: int, block: int) -> None:
        """Take a block from a robot."""
        self.held[robot].remove(block)
        self.holders[block].remove(robot)
        self.cost[robot] -= self.price(robot, block)

    def is_spare(self, robot: int, block: int) -> bool:
        """Tell whether a robot's region surely holds together without a block."""
        if block == self.roots[robot]:
            return False
        held = self.held[robot]
        near = self.blocks.near
        ends = [other for other in near[block] if other in held]
        if len(ends) < 2:
            return True
        missing = set(ends[1:])
        seen = {block, ends[0]}
        ahead = deque([ends[0]])
        while ahead and len(seen) < SEARCH:
            for other in near[ahead.popleft()]:
                if other in held and other not in seen:
                    seen.add(other)
                    ahead.append(other)
                    missing.discard(other)
                    if not missing:
                        return True
        return False

    def copy(self) -> list[set[int]]:
        """Return the blocks of each robot."""
        return [set(blocks) for blocks in self.held]

    def restore(self, held: list[set[int]]) -> None:
        """Take regions up as `copy` returned them."""
        for robot, wanted in enumerate(held):
            for block in self.held[robot] - wanted:
                self.holders[block].remove(robot)
            for block in wanted - self.held[robot]:
                self.holders[block].append(robot)
            self.held[robot] = set(wanted)
        self.reckon()

    def strip(self, robot: int) -> None:
        """Take everything but its root from a robot."""
        root = self.roots[robot]
        for block in self.held[robot]:
            if block != root:
                self.holders[block].remove(robot)
        self.held[robot] = {root}
        self.cost[robot] = self.blocks.weight[root]

    def reckon(self) -> None:
        """Set all costs right: `add` and `drop` do not know of joins further away."""
        smooth, weight = self.blocks.smooth, self.blocks.weight
        for robot, held in enumerate(self.held):
            cost = -2
            left = set(held)
            while left:
                cost += 2
                ahead = [left.pop()]
                while ahead:
                    block = ahead.pop()
                    cost += weight[block]
                    for other in smooth[block]:
                        if other in left:
                            left.remove(other)
                            ahead.append(other)
            self.cost[robot] = cost


def grow(regions: Regions, rng: Stream, *, dig: bool) -> None:
    """Let all regions grow, always the cheapest one, until every block within reach is held.

    Args:
        regions: where each robot holds its root alone.
        rng: shuffles which neighbour comes first.
        dig: a robot that is shut in digs a way to the nearest free block through other regions, as
            soon as it is behind by what the way costs; otherwise it grows no more.
    """
    blocks = regions.blocks
    robots = range(len(regions.roots))
    fringe = [deque([root]) for root in regions.roots]
    heap = [(cost, robot) for robot, cost in enumerate(regions.cost)]
    heapify(heap)
    ways: dict[int, list[int]] = {}
    for robot in robots:
        rng.shuffle(blocks.near[regions.roots[robot]])
    while heap:
        cost, robot = heappop(heap)
        if robot in ways:
            way = ways.pop(robot)
            if regions.holders[way[-1]]:
                way = _dig(regions, robot)
            for block in way:
                regions.add(robot, block)
            fringe[robot].extend(reversed(way))
            if way:
                heappush(heap, (regions.cost[robot], robot))
            continue
        block = _free_neighbour(regions, fringe[robot])
        if block >= 0:
            regions.add(robot, block)
            fringe[robot].append(block)
            heappush(heap, (regions.cost[robot], robot))
            continue
        way = _dig(regions, robot) if dig else []
        if way:
            ways[robot] = way
            heappush(heap, (cost + 4 * len(way), robot))


def _free_neighbour(regions: Regions, fringe: deque[int]) -> int:
    """Return a block nobody holds beside the first of ``fringe`` that has one, -1 if none has."""
    while fringe:
        for block in regions.blocks.near[fringe[0]]:
            if not regions.holders[block]:
                return block
        fringe.popleft()
    return -1


def _dig(regions: Regions, robot: int) -> list[int]:
    """Return a shortest way from a region to a block that nobody holds, empty if there is none."""
    came = dict.fromkeys(regions.held[robot], -1)
    ahead = deque(sorted(came))
    while ahead:
        block = ahead.popleft()
        for other in regions.blocks.near[block]:
            if other in came:
                continue
            came[other] = block
            if not regions.holders[other]:
                way = []
                at = other
                while came[at] >= 0:
                    way.append(at)
                    at = came[at]
                return way[::-1]
            ahead.append(other)
    return []


def prune(regions: Regions) -> None:
    """Drop blocks that another robot holds as well, the most expensive robots first."""
    for robot in sorted(range(len(regions.cost)), key=lambda one: -regions.cost[one]):
        ahead = sorted(block for block in regions.held[robot] if len(regions.holders[block]) > 1)
        while ahead:
            block = ahead.pop()
            if (
                block in regions.held[robot]
                and len(regions.holders[block]) > 1
                and regions.is_spare(robot, block)
            ):
                regions.drop(robot, block)
                ahead.extend(
                    other for other in regions.blocks.near[block] if other in regions.held[robot]
                )


def borders(regions: Regions) -> dict[tuple[int, int], list[int]]:
    """Return, for each robot and each neighbour of it, the blocks that it could hand over."""
    holders = regions.holders
    found: dict[tuple[int, int], list[int]] = {}
    for block, givers in enumerate(holders):
        if len(givers) != 1:
            continue
        giver = givers[0]
        takers = {taker for other in regions.blocks.near[block] for taker in holders[other]}
        for taker in takers:
            if taker != giver:
                found.setdefault((giver, taker), []).append(block)
    return found


def balance(regions: Regions, rng: Stream, goes_on: Callable[[], bool]) -> int:
    """Even out the costs: each round solves for the flow between neighbours that would do it.

    Flow along the border of two regions is what diffuses until all costs are equal: with the borders as
    conductors, it is the gradient of a potential that solves the Laplace equation with the excess costs
    as sources. Conductors that turn out to let nothing pass lose weight.

    Args:
        regions: they hold every block.
        rng: shuffles borders.
        goes_on: asked before each round.

    Returns:
        The cost of the most expensive region; the regions of that moment are kept.
    """
    best = _score(regions.cost)
    kept = regions.copy()
    stiff: dict[tuple[int, int], float] = {}
    idle = 0
    while idle <= PATIENCE and goes_on():
        found = borders(regions)
        flows = _flows(regions.cost, found, stiff)
        if not flows:
            break
        for giver, taker, amount in flows:
            passed = _hand_over(regions, giver, taker, found[giver, taker], amount, rng)
            weight = stiff.get((giver, taker), 1.0)
            stiff[giver, taker] = min(1.0, 1.5 * weight) if passed else max(0.05, 0.5 * weight)
        prune(regions)
        regions.reckon()
        score = _score(regions.cost)
        if score < best:
            best, kept, idle = score, regions.copy(), 0
        else:
            idle += 1
    regions.restore(kept)
    return best[0]


def _score(costs: list[int]) -> tuple[int, int]:
    return max(costs), sum(cost * cost for cost in costs)


def _flows(
    costs: list[int],
    found: dict[tuple[int, int], list[int]],
    stiff: dict[tuple[int, int], float],
) -> list[tuple[int, int, float]]:
    """Return giver, taker and amount of what should pass each border, the largest amount first."""
    robots = len(costs)
    pairs = sorted({(min(pair), max(pair)) for pair in found})
    if not pairs:
        return []
    laplacian = np.zeros((robots, robots))
    weights = []
    for one, other in pairs:
        length = len(found.get((one, other), ())) + len(found.get((other, one), ()))
        weight = min(8, length) * min(stiff.get((one, other), 1.0), stiff.get((other, one), 1.0))
        weights.append(weight)
        laplacian[one, other] -= weight
        laplacian[other, one] -= weight
        laplacian[one, one] += weight
        laplacian[other, other] += weight
    # Levels are only known up to a constant for each connected part: a trace of leakage fixes that.
    laplacian += 1e-6 * np.eye(robots)
    excess = np.array(costs, float) - sum(costs) / robots
    level: list[float] = np.linalg.solve(laplacian, excess).tolist()
    flows = []
    for (one, other), weight in zip(pairs, weights, strict=True):
        amount = weight * (level[one] - level[other])
        giver, taker = (one, other) if amount > 0 else (other, one)
        if abs(amount) >= 1 and (giver, taker) in found:
            flows.append((giver, taker, abs(amount)))
    flows.sort(key=lambda flow: -flow[2])
    return flows


def _hand_over(
    regions: Regions, giver: int, taker: int, border: list[int], amount: float, rng: Stream
) -> bool:
    """Hand over blocks from the border inwards until their cost reaches ``amount``."""
    order = border[:]
    rng.shuffle(order)
    ahead = deque(order)
    tries = dict.fromkeys(order, 2)
    held, taken = regions.held[giver], regions.held[taker]
    near = regions.blocks.near
    passed = 0
    while ahead:
        block = ahead.popleft()
        # Blocks have changed hands since the border was drawn.
        if block not in held or block in taken or taken.isdisjoint(near[block]):
            continue
        price = regions.price(taker, block)
        if passed + 0.5 * price > amount:
            break
        tries[block] -= 1
        if len(regions.holders[block]) == 1 and regions.is_spare(giver, block):
            regions.drop(giver, block)
            regions.add(taker, block)
            passed += price
            for other in near[block]:
                if other in held and tries.setdefault(other, 2) > 0:
                    ahead.append(other)
        elif tries[block] > 0:
            ahead.append(block)
    return passed > 0


def mend(regions: Regions, limit: int) -> bool:
    """Let regions that are cheaper than the limit reach out for blocks that nobody holds.

    Returns:
        Whether every block is held and no region costs more than the limit.
    """
    near = regions.blocks.near
    missed = [block for block, robots in enumerate(regions.holders) if not robots]
    for block in missed if len(missed) <= FEW else ():
        if regions.holders[block]:
            continue
        spare = limit - min(regions.cost)
        came = {block: block}
        ahead = [block]
        moves = 0
        while ahead and moves <= spare:
            taker = _cheapest(regions, ahead)
            if taker >= 0 and _least(regions, taker) + moves <= limit:
                robot = min(regions.holders[taker], key=lambda one: regions.cost[one])
                while came[taker] != taker:
                    taker = came[taker]
                    if taker not in regions.held[robot]:
                        regions.add(robot, taker)
                break
            moves += 4
            behind, ahead = ahead, []
            for at in behind:
                for other in near[at]:
                    if other not in came:
                        came[other] = at
                        ahead.append(other)
    regions.reckon()
    return all(regions.holders) and max(regions.cost) <= limit


def _cheapest(regions: Regions, blocks: Sequence[int]) -> int:
    """Return the block whose holder costs least, -1 if none is held."""
    held = [block for block in blocks if regions.holders[block]]
    return min(held, key=lambda block: _least(regions, block), default=-1)


def _least(regions: Regions, block: int) -> int:
    """Return the cost of the cheapest robot that holds a block."""
    return min(regions.cost[robot] for robot in regions.holders[block])


def around(blocks: Blocks, held: set[int], start: int) -> list[int]:
    """Return a closed walk around a region.

    The blocks are joined to a spanning tree, smoothly where possible. A join takes the two borders of
    the squares away and leads across instead, or crosses one border there and back; so the moves of
    the walk are a connected graph with even degrees, and the walk is an Euler circuit of it.

    Args:
        blocks: the grid.
        held: blocks that hold together.
        start: sub-cell of one of them, where the walk begins and ends.

    Returns:
        The sub-cells in the order of the walk, ``start`` first and last.
    """
    of, stride = blocks.of, blocks.stride
    moves: dict[int, list[int]] = {}
    for block in held:
        cells = blocks.cells[block]
        copies = 1 if len(cells) == 4 else 2
        for cell in cells:
            moves[cell] = [
                cell + step
                for step in (1, stride, -1, -stride)
                if of[cell + step] == block
                for _ in range(copies)
            ]
    root = of[start]
    joined = {root}
    easy, hard = [root], [root]
    while easy or hard:
        smoothly = bool(easy)
        block = easy.pop() if easy else hard.pop()
        for other in (blocks.smooth if smoothly else blocks.near)[block]:
            if other in held and other not in joined:
                joined.add(other)
                _join(blocks, moves, block, other)
                easy.append(other)
                hard.append(other)
                if not smoothly:
                    hard.append(block)
                    break
    for _ in range(3):
        if not _close_loops(moves, stride):
            break
    return _circuit(moves, start)


def _close_loops(moves: dict[int, list[int]], stride: int) -> bool:
    """Replace ways there and back by loops: where both ends of one are neighbours, go around once.

    Taking one of the two moves away along the way and adding one between its ends leaves all degrees
    even and the graph connected.

    Returns:
        Whether anything was gained.
    """
    # The moves made twice are a forest, or nearly: where they are not, only some loops are found.
    up: dict[int, int] = {}
    depth: dict[int, int] = {}
    for root in moves:
        if root not in depth:
            up[root], depth[root] = root, 0
            ahead = [root]
            while ahead:
                cell = ahead.pop()
                for next_ in set(moves[cell]):
                    if next_ not in depth and moves[cell].count(next_) == 2:
                        up[next_], depth[next_] = cell, depth[cell] + 1
                        ahead.append(next_)
    loops = []
    for cell, next_cells in moves.items():
        for next_ in (cell + 1, cell + stride):
            if next_ in moves and next_ not in next_cells:
                way = tree_way(cell, next_, up, depth)
                if len(way) > 2:
                    loops.append((-len(way), cell, way))
    loops.sort()
    gained = False
    for _, _, way in loops:
        if way[0] in moves[way[-1]]:
            continue
        if all(moves[one].count(other) == 2 for one, other in pairwise(way)):
            for one, other in pairwise(way):
                moves[one].remove(other)
                moves[other].remove(one)
            moves[way[0]].append(way[-1])
            moves[way[-1]].append(way[0])
            gained = True
    return gained


def tree_way(one: int, other: int, up: dict[int, int], depth: dict[int, int]) -> list[int]:
    """Return the cells from one to another in a forest, empty if they are in different trees."""
    head, tail = [one], [other]
    while head[-1] != tail[-1]:
        longer = head if depth[head[-1]] >= depth[tail[-1]] else tail
        cell = longer[-1]
        if up[cell] == cell:
            return []
        longer.append(up[cell])
    return head + tail[-2::-1]


def _join(blocks: Blocks, moves: dict[int, list[int]], one: int, other: int) -> None:
    """Make one connected graph of the moves in two neighbouring blocks."""
    of, stride = blocks.of, blocks.stride
    for cell in blocks.cells[one]:
        for step in (1, stride, -1, -stride):
            across = cell + step
            if of[across] != other:
                continue
            side = stride if step in (1, -1) else 1
            if of[cell + side] == one and of[across + side] == other:
                for end, partner in ((cell, cell + side), (across, across + side)):
                    moves[end].remove(partner)
                    moves[partner].remove(end)
                moves[cell + side].append(across + side)
                moves[across + side].append(cell + side)
                moves[cell].append(across)
                moves[across].append(cell)
                return
    for cell in blocks.cells[one]:
        for step in (1, stride, -1, -stride):
            across = cell + step
            if of[across] == other:
                moves[cell] += [across, across]
                moves[across] += [cell, cell]
                return


def _circuit(moves: dict[int, list[int]], start: int) -> list[int]:
    """Return an Euler circuit; uses ``moves`` up."""
    ahead = [start]
    circuit = []
    while ahead:
        cell = ahead[-1]
        if moves[cell]:
            next_ = moves[cell].pop()
            moves[next_].remove(cell)
            ahead.append(next_)
        else:
            circuit.append(ahead.pop())
    return circuit


def anneal(regions: Regions, limit: int, rng: Stream, steps: int, heat: float) -> bool:
    """Search for regions whose costs stay within a limit.

    Blocks are added at the fringe of a region and dropped where it holds together without them; a
    block that nobody holds costs 1, each holding `PRICE`. Where the regions held too much before, they
    may leave blocks without a region.

    Args:
        regions: what to begin with; they change.
        limit: no region grows beyond this cost.
        rng: draws the moves.
        steps: moves tried at most.
        heat: a rise of the cost by this much is accepted once in e times.

    Returns:
        Whether it was found; then the regions hold every block.
    """
    near, weight = regions.blocks.near, regions.blocks.weight
    held, holders, cost = regions.held, regions.holders, regions.cost
    regions.reckon()
    random = rng.random
    missed = sum(not robots for robots in holders)
    blocks = len(holders)
    over = sum(one > limit for one in cost)
    for _ in range(steps):
        block = int(random() * blocks)
        here = holders[block]
        if not here:
            continue
        robot = here[int(random() * len(here))]
        if random() < 0.5:
            fringe = near[block]
            other = fringe[int(random() * len(fringe))] if fringe else block
            if other in held[robot] or cost[robot] + weight[other] > limit:
                continue
            rise = PRICE - (not holders[other])
            if rise > 0 and random() >= exp(-rise / heat):
                continue
            missed -= not holders[other]
            regions.add(robot, other)
        else:
            # A robot beyond the limit gives away whatever it can.
            rise = (len(here) == 1) - (PRICE if cost[robot] <= limit else 2)
            if rise > 0 and random() >= exp(-rise / heat):
                continue
            if not regions.is_spare(robot, block):
                continue
            over -= cost[robot] > limit
            regions.drop(robot, block)
            over += cost[robot] > limit
            missed += not here
        if not missed and not over:
            return True
    return False
