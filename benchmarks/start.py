"""Memory of a robot process, and the time from the command to the first instant.

    python -m benchmarks.start [--repeats 3]

The floor of the start: as many bare Python processes, started one after another, until each has
opened a session with a router.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median

from benchmarks.table import print_table
from protocol.errors import JournalError
from protocol.zenoh_link import Link, LinkConfig, free_port
from world_server.journal import WaveRecord, scan

ROBOTS = 16
BARE = """
import sys
from protocol.zenoh_link import Link, LinkConfig
with Link(LinkConfig("bare", int(sys.argv[1]))):
    print("open", flush=True)
    sys.stdin.readline()
"""


def bare_s(processes: int) -> float:
    """Return the seconds until so many bare processes have a session open."""
    port = free_port()
    with Link(LinkConfig("bare", port, "router")):
        before = time.perf_counter()
        started = [
            subprocess.Popen(
                [sys.executable, "-c", BARE, str(port)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            for _ in range(processes)
        ]
        for process in started:
            assert process.stdout is not None
            process.stdout.readline()
        seconds = time.perf_counter() - before
        for process in started:
            process.communicate("\n")
    return seconds


@contextmanager
def running(folder: Path, robots: int) -> Iterator[float]:
    """Start a run and yield the seconds until its first instant; end it afterwards."""
    scenario = folder / "start.toml"
    scenario.write_text(
        f'algorithm = "mr-dfs"\n[team]\nrobots = {robots}\n'
        '[world]\ngenerate = {kind = "nary-tree", branching = 7, radius = 5}\n'
    )
    out = folder / "run"
    before = time.perf_counter()
    command = [sys.executable, "-m", "deploy.cli", "run", str(scenario), "--out", str(out)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        while not _has_begun(out / "journal"):
            time.sleep(0.002)
        try:
            yield time.perf_counter() - before
        finally:
            process.terminate()


def _has_begun(journal: Path) -> bool:
    try:
        return any(isinstance(record, WaveRecord) for record, _ in scan(journal))
    except JournalError:
        return False


def resident_mb(pid: int) -> tuple[float, float]:
    """Return the resident memory of a process, and its share of what is shared."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    found = {line.split()[0]: int(line.split()[1]) for line in lines[1:]}
    return found["Rss:"] / 1024, found["Pss:"] / 1024


def main() -> None:
    """Measure and print tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    starts: list[float] = []
    floors: list[float] = []
    memory: dict[str, tuple[float, float]] = {}
    for _ in range(arguments.repeats):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            with running(folder, ROBOTS) as seconds:
                starts.append(seconds)
                pids = json.loads((folder / "run" / "processes.json").read_text())
                memory = {
                    name: resident_mb(pids[name]) for name in ("robot:0", "world", "bookkeeping")
                }
        floors.append(bare_s(ROBOTS + 2))
    ratio = median(a / b for a, b in zip(starts, floors, strict=True))
    print_table(
        f"start: {ROBOTS} robots from the command to the first instant",
        ("Canopy s", f"{ROBOTS + 2} bare processes s", "ratio"),
        [(f"{median(starts):.2f}", f"{median(floors):.2f}", f"{ratio:.2f}")],
        "target: at most 3",
    )
    print_table(
        "memory",
        ("process", "resident MB", "proportional MB"),
        [(name, f"{rss:.1f}", f"{pss:.1f}") for name, (rss, pss) in memory.items()],
        "target: a robot at most 42 MB resident",
    )


if __name__ == "__main__":
    main()
