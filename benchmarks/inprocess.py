"""The in-process engine against MR-DFS written by hand, on the 7-ary tree of radius 5, 15 robots.

    python -m benchmarks.inprocess [--repeats 9]

Processor time, the variants one after another in each repeat, medians of the ratios.
"""

import argparse
import time
from collections.abc import Callable
from statistics import median

from benchmarks.hand_loop import plain, tuned
from benchmarks.table import print_table
from deploy.inprocess import play
from deploy.setting import Setting, prepare
from protocol.scenario import from_tree
from protocol.trace import Observer, TraceDigest
from world_server.terrain import GraphTerrain
from world_server.world import World


def setting(robots: int, radius: int = 5) -> Setting:
    """Return MR-DFS on the 7-ary tree (Brass et al. 2011, Fig. 9)."""
    world = {"generate": {"kind": "nary-tree", "branching": 7, "radius": radius}}
    tree = {"algorithm": "mr-dfs", "world": world, "team": {"robots": robots}}
    return prepare(from_tree(tree, "benchmark"))


def played(setting_: Setting, observe: Observer | None) -> tuple[int, int]:
    """Play a run; return its makespan and the moves made."""
    terrain = GraphTerrain(setting_.graph)
    world = World(setting_.scenario, terrain, setting_.starts, observe=observe)
    play(setting_.scenario, world, setting_.algorithm)
    return int(world.time), world.progress().steps


def _seconds(run: Callable[[], object]) -> float:
    before = time.process_time()
    run()
    return time.process_time() - before


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=9)
    arguments = parser.parse_args()
    at_hand = setting(15)
    graph, team = at_hand.graph, len(at_hand.starts)
    runs: dict[str, Callable[[], tuple[int, int]]] = {
        "by hand, as the paper says it": lambda: plain(graph, team),
        "by hand, tuned": lambda: tuned(graph, team),
        "Canopy, no trace": lambda: played(at_hand, None),
        "Canopy, trace and digest": lambda: played(at_hand, TraceDigest()),
    }
    assert len({run() for run in runs.values()}) == 1, "not the same steps"
    moves = played(at_hand, None)[1]
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(arguments.repeats):
        for name, run in runs.items():
            times[name].append(_seconds(run))
    floors = list(runs)[:2]
    print_table(
        f"in-process: {moves} moves of 15 robots, 7-ary tree of radius 5",
        ("", "us a move", *(f"of {floor}" for floor in floors)),
        [
            (
                name,
                f"{median(spent) / moves * 1e6:.2f}",
                *(
                    f"{median(a / b for a, b in zip(times[floor], spent, strict=True)):.2f}"
                    for floor in floors
                ),
            )
            for name, spent in times.items()
        ],
        "targets, of the loop by hand: 0.4 without the trace (aim: 0.5), 0.3 with it",
    )


if __name__ == "__main__":
    main()
