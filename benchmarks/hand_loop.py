"""The floor of the in-process engine: MR-DFS written by hand, with no framework at all.

No messages, no world, no coroutines, no tags in bytes: lists and one loop, as one would write it for
this experiment only (lockstep, no losses). Both take the same steps as the real thing, which the
benchmark checks by the tick of the last stop and the number of moves.
"""

from protocol.graph import PortGraph


def plain(graph: PortGraph, team_size: int) -> tuple[int, int]:
    """Explore from vertex 0, the rules written down as they stand in the paper.

    Returns:
        The tick of the last stop, and the moves made.
    """
    closed = [[False] * len(ports) for ports in graph.far]
    departures = [[0] * len(ports) for ports in graph.far]
    place = [0] * team_size
    port: list[int | None] = [None] * team_size
    entry: list[dict[int, int | None]] = [{} for _ in range(team_size)]
    open_: list[dict[int, int | None]] = [{} for _ in range(team_size)]
    active = list(range(team_size))
    tick = moves = 0
    while True:
        bounced = set()
        for robot in active:
            here, came_by = place[robot], port[robot]
            if here not in entry[robot]:
                entry[robot][here] = came_by
            elif open_[robot][here] != came_by:
                bounced.add(robot)
            if came_by is not None:
                closed[here][came_by] = True
        still_active = []
        for robot in active:
            here = place[robot]
            if robot in bounced:
                exit_ = port[robot]
            else:
                eligible = [p for p, done in enumerate(closed[here]) if not done]
                if eligible:
                    exit_ = min(eligible, key=departures[here].__getitem__)
                    departures[here][exit_] += 1
                else:
                    exit_ = entry[robot][here]
                open_[robot][here] = exit_
            if exit_ is not None:
                place[robot] = graph.far[here][exit_]
                port[robot] = graph.back[here][exit_]
                moves += 1
                still_active.append(robot)
        active = still_active
        if not active:
            return tick, moves
        tick += 1


def tuned(graph: PortGraph, team_size: int) -> tuple[int, int]:
    """The same, tuned: one mark a port, so that C code finds the exit; everything in locals.

    Returns:
        The tick of the last stop, and the moves made.
    """
    far, back = graph.far, graph.back
    closed = team_size + 1
    marks = [[0] * len(ports) for ports in far]
    place = [0] * team_size
    port: list[int | None] = [None] * team_size
    entry: list[dict[int, int | None]] = [{} for _ in range(team_size)]
    open_: list[dict[int, int | None]] = [{} for _ in range(team_size)]
    active = list(range(team_size))
    tick = moves = 0
    while True:
        bounced = set()
        for robot in active:
            here, came_by = place[robot], port[robot]
            if here not in entry[robot]:
                entry[robot][here] = came_by
            elif open_[robot][here] != came_by:
                bounced.add(robot)
            if came_by is not None:
                marks[here][came_by] = closed
        still_active = []
        for robot in active:
            here = place[robot]
            if robot in bounced:
                exit_ = port[robot]
            else:
                row = marks[here]
                fewest = min(row)
                if fewest < closed:
                    exit_ = row.index(fewest)
                    row[exit_] += 1
                else:
                    exit_ = entry[robot][here]
                open_[robot][here] = exit_
            if exit_ is not None:
                place[robot] = far[here][exit_]
                port[robot] = back[here][exit_]
                moves += 1
                still_active.append(robot)
        active = still_active
        if not active:
            return tick, moves
        tick += 1
