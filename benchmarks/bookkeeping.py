"""Values a second that the bookkeeping store applies, against bare SQLite in the same run.

The floor is a hand-written loop of transactions of the same size into the same three columns,
with the same journal and flushing and values made beforehand: no checks, no wave, no messages.
The second floor also writes one number in the transaction, which is what "applied once" costs any
store: it shows in batches of one.

    python -m benchmarks.bookkeeping [--seconds S] [--tag-bytes N] [--folder DIR]

(As a module: run as a file, its name would hide the package of the same name.)
"""

import argparse
import sqlite3
import statistics
import tempfile
from collections.abc import Callable
from operator import truediv
from pathlib import Path
from time import perf_counter
from typing import TypeVar

from bookkeeping.sqlite_store import Durability, SqliteStore
from protocol.messages import Batch, TagWrite

Row = tuple[int, int, bytes]
T = TypeVar("T")

PLACES = 4096
SIZES = (1, 64, 256)
ROUNDS = 5
DURABILITIES: tuple[Durability, ...] = ("process", "power")


def rows_of(wave: int, size: int, tag: bytes) -> list[Row]:
    """The writes of a wave: places scattered over the map, revisions that grow."""
    return [((wave * size + i) * 1049 % PLACES, wave, tag) for i in range(size)]


def floor(
    path: Path, durability: Durability, *, numbered: bool
) -> tuple[Callable[[list[Row]], object], sqlite3.Connection]:
    """Bare SQLite: what any store in a file must pay at least."""
    database = sqlite3.connect(path, isolation_level=None)
    database.execute("PRAGMA locking_mode = EXCLUSIVE")
    database.execute("PRAGMA journal_mode = WAL")
    database.execute(f"PRAGMA synchronous = {'FULL' if durability == 'power' else 'NORMAL'}")
    database.execute("CREATE TABLE t (place INTEGER PRIMARY KEY, revision INTEGER, tag BLOB)")

    database.execute("CREATE TABLE n (wave INTEGER)")
    database.execute("INSERT INTO n VALUES (0)")

    def apply(rows: list[Row]) -> None:
        database.execute("BEGIN")
        database.executemany("INSERT OR REPLACE INTO t VALUES (?, ?, ?)", rows)
        if numbered:
            database.execute("UPDATE n SET wave = ?", (rows[0][1],))
        database.execute("COMMIT")

    return apply, database


def values_per_s(
    apply: Callable[[T], object], batches: list[T], size: int, seconds: float
) -> float:
    """Apply batches until the time is over (or they are)."""
    done = 0
    start = perf_counter()
    end = start + seconds
    for message in batches:
        apply(message)
        done += size
        if perf_counter() >= end:
            break
    del batches[: done // size]
    return done / (perf_counter() - start)


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description="bookkeeping store against bare SQLite")
    parser.add_argument("--seconds", type=float, default=12.0, help="for everything together")
    parser.add_argument("--tag-bytes", type=int, default=64)
    parser.add_argument("--folder", type=Path, default=None, help="on which disk")
    options = parser.parse_args()
    tag = bytes(options.tag_bytes)
    slot_s = options.seconds / (len(DURABILITIES) * len(SIZES) * ROUNDS * 3)
    print(f"values/s, tags of {len(tag)} bytes, median of {ROUNDS} interleaved rounds\n")
    print(
        f"{'durability':12}{'batch':>6}{'store':>12}{'floor':>12}{'ratio':>8}"
        f"{'floor + number':>16}{'ratio':>8}"
    )
    for durability in DURABILITIES:
        for size in SIZES:
            with tempfile.TemporaryDirectory(dir=options.folder) as folder:
                measure(Path(folder), durability, size, tag, slot_s)


def measure(folder: Path, durability: Durability, size: int, tag: bytes, slot_s: float) -> None:
    """Measure store and floor turn by turn, so that both meet the same disk."""
    count = max(50, int(2_400_000 * slot_s * ROUNDS / (size + 8)))
    rows = [rows_of(wave, size, tag) for wave in range(1, count + 1)]
    more_rows = list(rows)
    messages = [
        Batch(1, wave, tuple(TagWrite(*row) for row in of_wave))
        for wave, of_wave in enumerate(rows, 1)
    ]
    store = SqliteStore(
        folder / "store", run="r", capacity_bytes=len(tag), fresh=True, durability=durability
    )
    apply_bare, bare = floor(folder / "floor", durability, numbered=False)
    apply_numbered, numbered = floor(folder / "numbered", durability, numbered=True)
    ours, floors, numbered_floors = [], [], []
    with store:
        for _ in range(ROUNDS):
            ours.append(values_per_s(store.apply, messages, size, slot_s))
            floors.append(values_per_s(apply_bare, rows, size, slot_s))
            numbered_floors.append(values_per_s(apply_numbered, more_rows, size, slot_s))
    bare.close()
    numbered.close()
    ratios = [statistics.median(map(truediv, ours, other)) for other in (floors, numbered_floors)]
    print(
        f"{durability:12}{size:6}{statistics.median(ours):12,.0f}{statistics.median(floors):12,.0f}"
        f"{ratios[0]:8.2f}{statistics.median(numbered_floors):16,.0f}{ratios[1]:8.2f}"
    )


if __name__ == "__main__":
    main()
