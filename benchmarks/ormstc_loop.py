"""The floor of ORMSTC in-process: the same rules written by hand, with no framework at all.

No coroutines, no world, no sensing, no losses: lists and one loop, as one would write it for this
experiment only. `shared` has one map for the whole team; in `copies` each robot keeps its own, from
messages, as the algorithm demands. Both take the same steps as the real thing, which the benchmark
checks by the tick in which the last lap closes and the number of moves.
"""

from collections.abc import Sequence

from agents.algorithms.stc import AWAY, BEFORE, BEHIND, OPPOSITE, located, number
from protocol.grid import Cell, Grid


def shared(grid: Grid, starts: Sequence[Cell]) -> tuple[int, int]:
    """Cover a grid, the whole team on one map.

    Returns:
        The tick in which the last lap closes, and the moves made.
    """
    free = {number(cell) for cell in grid.complete_cells()}
    at = [located(start) for start in starts]
    goal = list(at)
    owner = {cell: robot for robot, (cell, _) in enumerate(at)}
    edges = [{cell: 0} for cell, _ in at]
    active = [robot for robot, (cell, _) in enumerate(at) if owner[cell] == robot]
    tick = moves = 0
    while active:
        tick += 1
        claims: dict[int, int] = {}
        for robot in active:
            cell, corner = at[robot]
            beside = cell + AWAY[corner]
            if not edges[robot][cell] >> corner & 1 and beside in free and beside not in owner:
                claims[beside] = robot  # ids ascend: the highest stays
        owner.update(claims)
        for robot in active:
            cell, corner = at[robot]
            beside = cell + AWAY[corner]
            mine = edges[robot]
            if claims.get(beside) == robot:
                mine[cell] |= 1 << corner
                mine[beside] = 1 << OPPOSITE[corner]
            if mine[cell] >> corner & 1:
                at[robot] = (beside, BEHIND[corner])
            else:
                at[robot] = (cell, BEFORE[corner])
        moves += len(active)
        active = [robot for robot in active if at[robot] != goal[robot]]
    return tick, moves


def copies(grid: Grid, starts: Sequence[Cell]) -> tuple[int, int]:
    """Cover a grid, each robot on a map of its own, which it knows from messages.

    Returns:
        The tick in which the last lap closes, and the moves made.
    """
    free = {number(cell) for cell in grid.complete_cells()}
    at = [located(start) for start in starts]
    goal = list(at)
    team = range(len(starts))
    owners = [{cell: robot for robot, (cell, _) in enumerate(at)} for _ in team]
    edges = [{cell: 0} for cell, _ in at]
    active = [robot for robot, (cell, _) in enumerate(at) if owners[0][cell] == robot]
    heard: list[list[tuple[int, int, int]]] = [[] for _ in team]
    tick = moves = 0
    while active:
        tick += 1
        wanted: dict[int, int] = {}
        for robot in active:
            cell, corner = at[robot]
            beside = cell + AWAY[corner]
            mine = owners[robot]
            for _, cell_, other in heard[robot]:
                if mine.get(cell_, -1) < other:
                    mine[cell_] = other
            heard[robot].clear()
            if not edges[robot][cell] >> corner & 1 and beside in free and beside not in mine:
                wanted[robot] = beside
        for robot, beside in wanted.items():
            owners[robot][beside] = robot
            for other in team:
                if other != robot:
                    heard[other].append((tick, beside, robot))
        for robot in active:
            cell, corner = at[robot]
            beside = cell + AWAY[corner]
            tree = edges[robot]
            if robot in wanted:
                mine = owners[robot]
                for _, cell_, other in heard[robot]:
                    if mine.get(cell_, -1) < other:
                        mine[cell_] = other
                heard[robot].clear()
                if mine[beside] == robot:
                    tree[cell] |= 1 << corner
                    tree[beside] = 1 << OPPOSITE[corner]
            if tree[cell] >> corner & 1:
                at[robot] = (beside, BEHIND[corner])
            else:
                at[robot] = (cell, BEFORE[corner])
        moves += len(active)
        active = [robot for robot in active if at[robot] != goal[robot]]
    return tick, moves
