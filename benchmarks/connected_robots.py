"""A connected team as robots in one process, against a bare loop over the pure rule.

    python -m benchmarks.connected_robots [--repeats 3] [--height 15]

Perfect binary trees, 60 robots, COCTA: every robot has a copy of the team's state, looks around, and
hears a digest in each tick. Processor time, one after the other in each repeat; medians.
"""

import argparse
import time
from collections.abc import Callable
from statistics import median

from agents.algorithms.connected_rule import Team, ticks_taken
from agents.algorithms.connected_splits import paper_splits
from agents.planning.rooted_tree import perfect_tree
from benchmarks.inprocess import played
from benchmarks.table import print_table
from deploy.setting import Setting, prepare
from protocol.scenario import from_tree
from protocol.trace import TraceDigest

ROBOTS = 60


def setting(height: int) -> Setting:
    """Return COCTA on a perfect binary tree."""
    splits = list(paper_splits(2, height, ROBOTS))
    world = {"generate": {"kind": "nary-tree", "branching": 2, "radius": height}}
    tree = {
        "algorithm": "cocta",
        "algorithm_options": {"splits": splits},
        "world": world,
        "team": {"robots": ROBOTS},
    }
    return prepare(from_tree(tree, "benchmark"))


def _seconds(run: Callable[[], int | None]) -> tuple[float, int | None]:
    before = time.process_time()
    ticks = run()
    return time.process_time() - before, ticks


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--height", type=int, default=15)
    arguments = parser.parse_args()
    at_hand = setting(arguments.height)
    tree = perfect_tree(2, arguments.height)
    splits = paper_splits(2, arguments.height, ROBOTS)
    runs: dict[str, Callable[[], int | None]] = {
        "the rule alone": lambda: ticks_taken(Team(tree, ROBOTS, "cocta", splits), 2 * len(tree)),
        "robots, no trace": lambda: played(at_hand, None)[0],
        "robots, trace and digest": lambda: played(at_hand, TraceDigest())[0],
    }
    spent: dict[str, list[float]] = {name: [] for name in runs}
    ticks = set()
    for _ in range(arguments.repeats):
        for name, run in runs.items():
            seconds, taken = _seconds(run)
            spent[name].append(seconds)
            ticks.add(taken)
    assert len(ticks) == 1, "not the same run"
    floor = spent["the rule alone"]
    print_table(
        f"in-process: {ROBOTS} robots on {len(tree)} vertices, {ticks.pop()} ticks, COCTA",
        ("", "seconds", "times the rule"),
        [
            (
                name,
                f"{median(times):.2f}",
                f"{median(b / a for a, b in zip(floor, times, strict=True)):.2f}",
            )
            for name, times in spent.items()
        ],
        "target: at most 4 times the rule",
    )


if __name__ == "__main__":
    main()
