"""What `canopy paper NAME` does for every paper: parts, files, work in parallel, progress.

Each paper is a function that `pyproject.toml` lists as an entry point of the group ``canopy.papers``:
so the command line, one floor below, finds it by name.
"""

import csv
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Self, TypeVar

import msgspec

from protocol.errors import InputError
from protocol.lifeline import PARENT, tie_to_supervisor

WORKERS = 2
LINE_S = 5.0
"""Without a terminal, progress is a line now and then."""

Case = TypeVar("Case")
Result = TypeVar("Result")
Show = Callable[[int, int], object]
"""Is told how many are done, and of how many."""


def check_parts(only: Iterable[str], parts: Collection[str]) -> None:
    """Refuse parts that a paper does not have.

    Raises:
        InputError: If there is one.
    """
    for name in only:
        if name not in parts:
            known = ", ".join(parts)
            raise InputError(f"--only {name}: no such part of the paper; expected one of {known}")


def in_parallel(
    function: Callable[[Case], Result],
    cases: Sequence[Case],
    show: Show = lambda _done, _total: None,
    *,
    workers: int | None = None,
    chunk: int = 1,
) -> list[Result]:
    """Return what a function makes of each case, in their order.

    Args:
        function: to be called, which another process can find by its name.
        cases: what it is called with.
        show: called after each.
        workers: in how many processes; 1: in this one; default: `WORKERS`.
        chunk: how many cases a process gets at once.
    """
    count = WORKERS if workers is None else workers
    if count == 1:
        return _collect(map(function, cases), len(cases), show)
    pool = ProcessPoolExecutor(
        count,
        # Not a fork: this process may have threads.
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_begin_work,
        initargs=(os.getpid(),),
    )
    try:
        return _collect(pool.map(function, cases, chunksize=chunk), len(cases), show)
    finally:
        pool.shutdown(cancel_futures=True)


def _collect(results: Iterable[Result], total: int, show: Show) -> list[Result]:
    collected = []
    for result in results:
        collected.append(result)
        show(len(collected), total)
    return collected


def _begin_work(parent: int) -> None:
    """Live no longer than the parent, and leave Ctrl-C to it."""
    os.environ[PARENT] = str(parent)
    tie_to_supervisor()
    signal.signal(signal.SIGINT, signal.SIG_IGN)


# Files.


@contextmanager
def files_of(paper: str, out: Path | None) -> Iterator[Path]:
    """Make the folder for a paper's files, by default ``runs/paper-NAME``.

    Raises:
        InputError: If it cannot be made, or a file in it cannot be written.
    """
    folder = Path("runs", f"paper-{paper}") if out is None else out
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield folder
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise InputError(f"--out {folder}: {error.filename}: {reason}") from None


def write_json(path: Path, numbers: object) -> None:
    """Write numbers for programs, indented."""
    path.write_bytes(msgspec.json.format(msgspec.json.encode(numbers)) + b"\n")


def write_csv(path: Path, header: Iterable[str], lines: Iterable[Iterable[object]]) -> None:
    """Write a table for spreadsheets."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(lines)


def print_json(paper: str, folder: Path, parts: Mapping[str, object]) -> None:
    """Print the numbers of all parts as one JSON object."""
    said = {"paper": paper, "folder": str(folder), "parts": parts}
    print(msgspec.json.encode(said).decode())


# Progress.


class Tally:
    """How far a part is, on stderr: redrawn in a terminal, a line now and then elsewhere."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._live = sys.stderr.isatty()
        self._started = time.monotonic()
        self._next_line = self._started + LINE_S
        self._done = 0

    def __enter__(self) -> Self:
        """Begin to count."""
        return self

    def __exit__(self, *_: object) -> None:
        """Leave a last line."""
        spent = time.monotonic() - self._started
        self._say(f"{self._name}: {self._done} runs, {spent:.1f} s", end="\n")

    def show(self, done: int, total: int) -> None:
        """Say that so many runs are done."""
        self._done = done
        if self._live:
            self._say(f"{self._name}: {done} of {total} runs", end="")
        elif time.monotonic() >= self._next_line:
            self._next_line = time.monotonic() + LINE_S
            self._say(f"{self._name}: {done} of {total} runs", end="\n")

    def _say(self, line: str, end: str) -> None:
        start = "\r\x1b[K" if self._live else ""
        print(start + line, end=end, file=sys.stderr, flush=True)
