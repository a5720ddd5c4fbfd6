"""All benchmarks, one after another: `make bench`."""

import subprocess
import sys

BENCHMARKS = (
    "inprocess",
    "ormstc",
    "flat",
    "start",
    "bookkeeping",
    "journaling",
    "recovery",
    "recovery_length",
    "processes",
    "planning",
    "parent_child",
    "sight",
    "connected",
    "connected_best",
    "connected_robots",
)


def main() -> int:
    """Run them all; return the number that failed."""
    return sum(
        subprocess.run([sys.executable, "-m", f"benchmarks.{name}"], check=False).returncode != 0
        for name in BENCHMARKS
    )


if __name__ == "__main__":
    sys.exit(main())
