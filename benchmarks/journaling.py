"""What the journal costs: the same run with it and without it.

    python -m benchmarks.journaling [--robots 1 16] [--repeats 5]

Both runs of a pair are played one after the other, so that both meet the same machine; the median of
the ratios is what counts.
"""

import argparse
import asyncio
import tempfile
import uuid
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.processes import setting_for
from benchmarks.table import print_table
from deploy import processes
from deploy.run_dir import RunDir
from deploy.setting import Setting
from deploy.supervisor import Supervisor
from world_server.journal import Closing, scan


class WithoutJournal(Supervisor):
    """A supervisor whose world servers do not write their waves down."""

    async def start(self, name: str, command: Sequence[str], **more: Any) -> None:
        """Start a process, and for the world server the one that writes less."""
        swapped = {"world_server.node": "benchmarks.world_without_journal"}
        await super().start(name, [swapped.get(word, word) for word in command], **more)


def play_s(setting: Setting, folder: Path, supervisor: type[Supervisor]) -> float:
    """Play the run and return the seconds from its first instant to its end."""
    run_dir = RunDir.create(folder / uuid.uuid4().hex, "benchmark")
    vars(processes)["Supervisor"] = supervisor
    name = f"benchmark-{uuid.uuid4().hex[:8]}"
    asyncio.run(processes.play(setting, run_dir, name, lambda _: None))
    return next(record.play_s for record, _ in scan(run_dir.journal) if isinstance(record, Closing))


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, nargs="+", default=[1, 16])
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    rows = []
    for robots in arguments.robots:
        setting = setting_for(robots, "mr-dfs")
        pairs = []
        with tempfile.TemporaryDirectory() as name:
            for _ in range(arguments.repeats):
                with_it = play_s(setting, Path(name), Supervisor)
                pairs.append((with_it, play_s(setting, Path(name), WithoutJournal)))
        costs = sorted(100 * (with_it / without - 1) for with_it, without in pairs)
        rows.append(
            (
                robots,
                *(f"{median(column):.2f}" for column in zip(*pairs, strict=True)),
                f"{median(costs):.1f}",
                f"{costs[0]:.1f}",
                f"{costs[-1]:.1f}",
            )
        )
    head = ("robots", "with, s", "without, s", "cost, %", "least", "most")
    note = "target: at 16 robots at most 15 %"
    print_table("journaling: the same run with and without a journal", head, rows, note)


if __name__ == "__main__":
    main()
