"""The floor of the in-process engine: MR-DFS written by hand, with no framework at all.

No messages, no world, no coroutine, no tags in bytes: lists and one loop, as one would write it for
this experiment only (lockstep, no losses). It takes the same steps as the real thing; the benchmark
compares the times of all stops.
"""

from protocol.graph import PortGraph


def hand_written_mr_dfs(graph: PortGraph, team_size: int) -> tuple[int, int]:
    """Explore ``graph`` from vertex 0; return the tick of the last stop and the moves made."""
    far, back = graph.far, graph.back
    closed_mark = team_size + 1
    marks = [[0] * len(ports) for ports in far]
    place = [0] * team_size
    port: list[int | None] = [None] * team_size
    entry: list[dict[int, int | None]] = [{0: None} for _ in range(team_size)]
    open_: list[dict[int, int | None]] = [{0: None} for _ in range(team_size)]
    active = list(range(team_size))
    tick = moves = 0
    while True:
        bounced = set()
        for robot in active:
            here, came = place[robot], port[robot]
            if here not in entry[robot]:
                entry[robot][here] = came
                open_[robot][here] = None
            elif open_[robot][here] == came:
                open_[robot][here] = None
            else:
                bounced.add(robot)
            if came is not None:
                marks[here][came] = closed_mark
        still = []
        for robot in active:
            here = place[robot]
            if robot in bounced:
                exit_ = port[robot]
            else:
                row = marks[here]
                fewest = min(row)
                if fewest < closed_mark:
                    exit_ = row.index(fewest)
                    row[exit_] += 1
                else:
                    exit_ = entry[robot][here]
                open_[robot][here] = exit_
            if exit_ is None:
                continue
            place[robot] = far[here][exit_]
            port[robot] = back[here][exit_]
            moves += 1
            still.append(robot)
        active = still
        if not active:
            return tick, moves
        tick += 1
