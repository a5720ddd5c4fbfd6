"""How long a run stands still when one of its processes is killed.

    python -m benchmarks.recovery [--kills 15] [--robots 8]

From kill -9 to the first new step: the moment of the kill is the nemesis's, that of the step the
commit of the first wave after it, both by one clock. For the world the shares of its start are shown
beside; the rest is the supervisor that notices, and robots that find back. The floor is the bare start
of Python with the same imports, and of a Zenoh router, in the same run.
"""

import argparse
import asyncio
import subprocess
import sys
import tempfile
import time
import uuid
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.table import print_table
from deploy import processes
from deploy.run_dir import RunDir
from deploy.setting import prepare
from protocol.scenario import from_tree
from protocol.zenoh_link import free_port

BARE = """
import sys, time
import world_server.node, zenoh
from protocol.zenoh_link import Link, LinkConfig
with Link(LinkConfig("bare", int(sys.argv[1]), "router")):
    pass
"""
"""What a world server that has nothing to do would be."""


def played(robots: int, victim: str, kills: int, router: str, folder: Path) -> processes.Played:
    """Play a run in which ``victim`` is killed again and again."""
    faults: list[dict[str, Any]] = [
        {"kill": f"robot:{number}" if victim == "robot" else victim, "at": 20.0 + 40 * number}
        for number in range(min(kills, robots - 1) if victim == "robot" else kills)
    ]
    tree = {
        "algorithm": "mr-dfs",
        "world": {"generate": {"kind": "nary-tree", "branching": 7, "radius": 4}},
        "team": {"robots": robots},
        "network": {"router": router},
        "faults": faults,
    }
    setting = prepare(from_tree(tree, "benchmark"))
    run_dir = RunDir.create(folder / uuid.uuid4().hex, "benchmark")
    name = f"benchmark-{uuid.uuid4().hex[:8]}"
    return asyncio.run(processes.play(setting, run_dir, name, lambda _: None))


def bare_start_s() -> float:
    """Return how long Python, the imports of a world server and a router take to start and end."""
    command = [sys.executable, "-c", BARE, str(free_port())]
    started = time.perf_counter()
    subprocess.run(command, check=True)
    return time.perf_counter() - started


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=15)
    parser.add_argument("--robots", type=int, default=8)
    arguments = parser.parse_args()
    kinds = (
        ("robot", "embedded", 50),
        ("world", "embedded", 400),
        ("world", "separate", 400),
        ("bookkeeping", "embedded", 5),
        ("router", "separate", 500),
    )
    rows: list[tuple[str, ...]] = []
    with tempfile.TemporaryDirectory() as name:
        for victim, router, most_ms in kinds:
            bare_s = median(bare_start_s() for _ in range(5))
            team = max(arguments.robots, arguments.kills + 1)
            robots = team if victim == "robot" else arguments.robots
            run = played(robots, victim, arguments.kills, router, Path(name))
            stopped = sorted(
                1000 * (story.went_on_s - story.struck_s)
                for story in run.stories.values()
                if story.struck_s is not None and story.went_on_s is not None
            )
            lives = [phases for life, phases in run.phases.items() if life > 1]
            shares = [
                f"{1000 * median(phases[part] for phases in lives):.0f}" if lives else ""
                for part in ("python", "link", "replay")
            ]
            rows.append(
                (
                    victim,
                    router,
                    str(len(stopped)),
                    f"{median(stopped):.1f}",
                    f"{stopped[0]:.1f}",
                    f"{stopped[-1]:.1f}",
                    str(most_ms),
                    *shares,
                    f"{median(stopped) / (1000 * bare_s):.2f}",
                )
            )
    head = ("killed", "router", "kills", "median", "least", "most", "target")
    print_table(
        "recovery: ms from kill -9 to the first new step",
        (*head, "python", "link", "replay", "of a bare start"),
        rows,
        "python, link, replay: shares of a new world; of a bare start: Python with the same imports "
        "and a router, nothing else",
    )


if __name__ == "__main__":
    main()
