"""One tour around everything, cut into parts: a plan for starts so crowded that regions fail.

Every robot goes from its start to its part of the tour and back from its end, along the shortest ways
from a *hub*, the start of one of them. Where starts are close to each other this is never much worse
than twice the distance to the farthest sub-cell more than an even share.

Paper:
    Frederickson, Hecht and Kim 1978, k-SPLITOUR. Departures: robots start at different places, and
    the least possible limit is found by bisection instead of set beforehand.
"""

from bisect import bisect_right
from collections.abc import Sequence

from agents.planning.best_regions import Blocks, around, tree_way


def split(blocks: Blocks, starts: Sequence[int]) -> list[list[int]]:
    """Return closed walks that cover every block within reach.

    Args:
        blocks: the grid.
        starts: sub-cell of each robot, by number.
    """
    walks: list[list[int]] = [[start] for start in starts]
    part: dict[int, int] = {}
    crews: list[list[int]] = []
    for robot, start in enumerate(starts):
        root = blocks.of[start]
        if root not in part:
            part.update(dict.fromkeys(_reached(blocks, root), len(crews)))
            crews.append([])
        crews[part[root]].append(robot)
    for name, crew in enumerate(crews):
        hub = starts[crew[0]]
        tour = around(blocks, {block for block, one in part.items() if one == name}, hub)
        up, depth = _ways(blocks, hub)
        reach = [place + depth[cell] for place, cell in enumerate(tour)]
        far = [depth[starts[robot]] for robot in crew]
        low, high = 0, len(tour) + 4 * max(depth.values())
        while low < high:
            middle = (low + high) // 2
            if len(_cuts(tour, reach, depth, far, middle)) > 0:
                high = middle
            else:
                low = middle + 1
        cuts = _cuts(tour, reach, depth, far, low)
        for robot, (begin, end) in zip(crew, cuts, strict=False):
            if begin < end:
                out = tree_way(starts[robot], tour[begin], up, depth)
                home = tree_way(tour[end - 1], starts[robot], up, depth)
                walks[robot] = out[:-1] + tour[begin:end] + home[1:]
    return walks


def _cuts(
    tour: list[int], reach: list[int], depth: dict[int, int], far: list[int], limit: int
) -> list[tuple[int, int]]:
    """Return where each robot's part begins and ends, or nothing if the limit is too low.

    No step changes the distance to the hub by more than one, so ``reach`` never falls and the farthest
    end within the limit is found by bisection.
    """
    cuts = []
    begin = 0
    for away in far:
        if begin < len(tour):
            left = limit - 2 * away - depth[tour[begin]] + begin
            end = bisect_right(reach, left, lo=begin)
            cuts.append((begin, end))
            begin = end
    return cuts if begin == len(tour) else []


def _reached(blocks: Blocks, root: int) -> list[int]:
    seen = {root}
    ahead = [root]
    for block in ahead:
        for other in blocks.near[block]:
            if other not in seen:
                seen.add(other)
                ahead.append(other)
    return ahead


def _ways(blocks: Blocks, hub: int) -> tuple[dict[int, int], dict[int, int]]:
    """Return, for each sub-cell, the next one on a shortest way to the hub, and its moves."""
    up, depth = {hub: hub}, {hub: 0}
    ahead = [hub]
    for cell in ahead:
        for next_ in (cell + 1, cell - 1, cell + blocks.stride, cell - blocks.stride):
            if blocks.of[next_] >= 0 and next_ not in depth:
                up[next_], depth[next_] = cell, depth[cell] + 1
                ahead.append(next_)
    return up, depth
