"""ORMSTC in-process against the same rules written by hand: 20 x 30 coarse cells, 10 robots.

    python -m benchmarks.ormstc [--repeats 15]

Processor time, the variants one after another in each repeat, medians of the ratios. Then a game map
of 481 x 530 sub-cells with 16 robots, once: its time and the memory it takes.
"""

import argparse
import resource
import time
from collections.abc import Callable
from statistics import median

from benchmarks.ormstc_loop import copies, shared
from benchmarks.table import print_table
from deploy.inprocess import play
from deploy.setting import Setting, prepare
from protocol.grid import Grid
from protocol.scenario import from_tree
from protocol.trace import Observer, TraceDigest
from world_server.terrain import terrain_of
from world_server.world import World


def setting(rows: int, cols: int, obstacles: int, robots: int) -> Setting:
    """Return ORMSTC on a grid with random obstacles (Agmon et al. 2008, Sec. 3.4)."""
    kind = {"kind": "random-obstacles", "rows": rows, "cols": cols, "obstacles": obstacles}
    tree = {"algorithm": "ormstc", "world": {"generate": kind}, "team": {"robots": robots}}
    return prepare(from_tree({**tree, "seed": 1}, "benchmark"))


def played(at_hand: Setting, observe: Observer | None) -> tuple[int, int]:
    """Play a run; return the tick in which the last lap closed and the moves made."""
    terrain = terrain_of(at_hand.ground, at_hand.scenario)
    world = World(at_hand.scenario, terrain, at_hand.starts, observe=observe)
    play(at_hand.scenario, world, at_hand.algorithm)
    return int(world.time), world.progress().steps


def _seconds(run: Callable[[], object]) -> float:
    before = time.process_time()
    run()
    return time.process_time() - before


def main() -> None:
    """Measure and print tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=15)
    arguments = parser.parse_args()
    at_hand = setting(20, 30, 60, 10)
    grid = at_hand.ground
    assert isinstance(grid, Grid)
    starts = [grid.position(start) for start in at_hand.starts]
    runs: dict[str, Callable[[], tuple[int, int]]] = {
        "by hand, one map for all": lambda: shared(grid, starts),
        "by hand, a map each": lambda: copies(grid, starts),
        "Canopy, no trace": lambda: played(at_hand, None),
        "Canopy, trace and digest": lambda: played(at_hand, TraceDigest()),
    }
    found = {run() for run in runs.values()}
    assert len(found) == 1, f"not the same steps: {found}"
    moves = played(at_hand, None)[1]
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(arguments.repeats):
        for name, run in runs.items():
            times[name].append(_seconds(run))
    first, second = list(runs)[:2]
    rows = [
        (
            name,
            f"{median(spent) / moves * 1e6:.2f}",
            *(
                f"{median(a / b for a, b in zip(spent, times[floor], strict=True)):.2f}"
                for floor in (first, second)
            ),
        )
        for name, spent in times.items()
    ]
    print_table(
        f"ORMSTC, 20 x 30 coarse cells, 60 obstacles, 10 robots, {moves} moves",
        ("", "us a move", "times one map", "times a map each"),
        rows,
        "target: at most 2 times a bare loop of the same rules",
    )
    large = setting(240, 265, 15_000, 16)
    spent_s = _seconds(lambda: played(large, TraceDigest()))
    memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print_table(
        f"ORMSTC, 480 x 530 sub-cells, {large.to_cover} of them free, 16 robots",
        ("", "s", "MB"),
        [("Canopy, trace and digest", f"{spent_s:.1f}", f"{memory_mb:.0f}")],
        "targets: at most 60 s and 600 MB",
    )


if __name__ == "__main__":
    main()
