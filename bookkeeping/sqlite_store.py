"""The store in one SQLite file: embedded, one writer, a transaction a batch.

Rules in `bookkeeping.store`; here is how they are kept.

- *Group commit.* The batch is the group: one transaction writes the tags and, in the one row of
  table ``run``, the wave. A single upsert does the work and the check of a revision at once: a row
  that does not change is a write that would not raise it, and the transaction is undone.
- *Durability* ``"process"``: survives kill -9 of any process. A commit in WAL mode writes its
  pages to the kernel before it returns, and what the kernel has does not die with the process; so
  no flush is needed, and ``synchronous=NORMAL`` makes none on commit (it flushes only when the log
  is moved into the file, once in about 1000 pages). ``OFF`` would survive kill -9 as well and
  saves only those few flushes, but after a loss of power it may leave a broken file, where NORMAL
  leaves a whole one that lacks the latest batches.
- *Durability* ``"power"``: ``synchronous=FULL`` flushes the log on every commit.
- *One process.* ``locking_mode=EXCLUSIVE`` holds the file from opening to closing; with a timeout
  of 0 a second process is refused at once. The kernel drops the lock of a killed process. It also
  makes SQLite keep its WAL index in the heap, so there is no ``-shm`` file at all, and each commit
  saves the locking.
- *Another's file.* Kind (``application_id``) and version (``user_version``) are read before
  anything is written, so a database that is not ours stays as it was.
"""

import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NoReturn

from msgspec.structs import astuple

from bookkeeping.store import (
    Store,
    check_incarnation,
    check_left,
    check_opening,
    check_places,
    check_revisions,
    check_writes,
)
from protocol.errors import StoreError
from protocol.messages import Batch, TagWrite

Durability = Literal["process", "power"]
"""What an acknowledged batch survives: kill -9 of any process, or loss of power too."""

APPLICATION_ID = 0x43_41_4E_50
"""Marks a file as ours ("CANP")."""

FILE_VERSION = 1
"""Version of the tables below."""

_SYNCHRONOUS: dict[Durability, str] = {"process": "NORMAL", "power": "FULL"}

_TABLES = (
    "CREATE TABLE tag (place INTEGER PRIMARY KEY, revision INTEGER NOT NULL, tag BLOB NOT NULL)",
    (
        "CREATE TABLE run (name TEXT NOT NULL, incarnation INTEGER NOT NULL, wave INTEGER NOT NULL,"
        " tag_format TEXT NOT NULL)"
    ),
    "INSERT INTO run VALUES ('', 0, 0, '')",
    f"PRAGMA application_id = {APPLICATION_ID}",
    f"PRAGMA user_version = {FILE_VERSION}",
)

_UPSERT = (
    "INSERT INTO tag VALUES (?, ?, ?) ON CONFLICT (place) DO UPDATE"
    " SET revision = excluded.revision, tag = excluded.tag WHERE excluded.revision > revision"
)

_FIXES = {
    "SQLITE_BUSY": "another process has it open: end that one first, or give another file",
    "SQLITE_CANTOPEN": "it cannot be opened: does its folder exist, and is it no folder itself?",
    "SQLITE_PERM": "access is not permitted: check who owns it",
    "SQLITE_READONLY": "it may not be written: check the permissions of the file and its folder",
    "SQLITE_FULL": "the disk is full: make room",
    "SQLITE_IOERR": "the disk failed: check it",
    "SQLITE_NOTADB": "it is no SQLite database: give another file",
    "SQLITE_CORRUPT": "it is damaged: restore a copy, or move it away to start on blank devices",
}


def tag_format_left(path: Path) -> str | None:
    """Return the format of the tags in a file, without changing it; ``None`` if it is no store."""
    try:
        database = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, timeout=0)
    except sqlite3.Error:
        return None
    try:
        row: tuple[str] | None = database.execute("SELECT tag_format FROM run").fetchone()
    except sqlite3.Error:
        return None
    finally:
        database.close()
    return None if row is None else row[0]


class SqliteStore(Store):
    """The store in an SQLite file. For one thread at a time, whichever opened it."""

    def __init__(
        self,
        path: Path | str,
        *,
        run: str,
        capacity_bytes: int,
        fresh: bool,
        durability: Durability,
        tag_format: str = "",
    ) -> None:
        """Open or create the file and enter the run, durably.

        Args:
            path: the file.
            run: name of the run; the same name again resumes after a crash.
            capacity_bytes: capacity of each device.
            fresh: whether a new run erases the tags of the one before.
            durability: what an acknowledged batch survives.
            tag_format: what the bytes of a tag mean: a run that keeps tags must name the same.

        Raises:
            StoreError: If the tags that are kept have another format, if the file is of another
                kind or newer, damaged, open elsewhere or inaccessible, if a tag in it exceeds the
                capacity, or if the capacity is negative or the run has no name. The message names
                the file and a fix.
        """
        check_opening(run, capacity_bytes)
        self._path = Path(path)
        self._capacity_bytes = capacity_bytes
        self._incarnation = 0
        self._wave = 0
        try:
            # Autocommit: transactions are written out below. The thread check is off because a
            # process may open the store in one thread and use it in another.
            self._database = sqlite3.connect(
                self._path, timeout=0, isolation_level=None, check_same_thread=False
            )
        except sqlite3.Error as error:
            raise self._failure(error) from error
        try:
            self._open(durability)
            self._enter(run, fresh=fresh, tag_format=tag_format)
        except sqlite3.Error as error:
            self._database.close()
            raise self._failure(error) from error
        except BaseException:
            self._database.close()
            raise

    def hello(self, incarnation: int) -> int:
        """Let a world server introduce itself; see `Store.hello`."""
        check_incarnation(incarnation, self._incarnation)
        try:
            self._database.execute("UPDATE run SET incarnation = ?", (incarnation,))
        except sqlite3.Error as error:
            raise self._failure(error) from error
        self._incarnation = incarnation
        return self._wave

    def apply(self, batch: Batch) -> int:
        """Apply a batch once; see `Store.apply`."""
        if batch.incarnation != self._incarnation:
            self.hello(batch.incarnation)
        wave = batch.wave
        if wave <= self._wave:
            return self.hello(batch.incarnation)  # asks the file, so a closed store says so
        writes = batch.writes
        check_writes(batch, self._capacity_bytes)
        database = self._database
        try:
            database.execute("BEGIN IMMEDIATE")
            # The fields of a TagWrite are the columns of the table, in order.
            changed = database.executemany(_UPSERT, map(astuple, writes)).rowcount
            if writes and changed != len(writes):
                self._refuse(writes)
            database.execute("UPDATE run SET wave = ?", (wave,))
            database.execute("COMMIT")
        except sqlite3.Error as error:
            self._undo()
            raise self._failure(error) from error
        except BaseException:
            self._undo()
            raise
        self._wave = wave
        return wave

    def read(self, places: Sequence[int]) -> tuple[TagWrite, ...]:
        """Read tags as they are now; see `Store.read`."""
        check_places(places)
        execute = self._database.execute
        select = "SELECT place, revision, tag FROM tag WHERE place = ?"
        try:
            rows = [execute(select, (place,)).fetchone() for place in places]
        except sqlite3.Error as error:
            raise self._failure(error) from error
        return tuple(TagWrite(*row) for row in rows if row is not None)

    def tags(self) -> dict[int, TagWrite]:
        """Read all tags; see `Store.tags`."""
        select = "SELECT place, revision, tag FROM tag ORDER BY place"
        try:
            rows = self._database.execute(select).fetchall()
        except sqlite3.Error as error:
            raise self._failure(error) from error
        return {row[0]: TagWrite(*row) for row in rows}

    def close(self) -> None:
        """Close the file, with nothing left beside it; see `Store.close`."""
        try:
            self._database.close()
        except sqlite3.Error as error:
            raise self._failure(error) from error

    def _open(self, durability: Durability) -> None:
        """Take the file, make sure that it is ours and whole, create its tables if it is new."""
        database = self._database
        database.execute("PRAGMA locking_mode = EXCLUSIVE")
        (kind,) = database.execute("PRAGMA application_id").fetchone()
        (version,) = database.execute("PRAGMA user_version").fetchone()
        (tables,) = database.execute("SELECT count(*) FROM sqlite_master").fetchone()
        # A crash between the change to WAL and the first commit leaves an empty database.
        new = kind == version == tables == 0
        if not new and kind != APPLICATION_ID:
            raise StoreError(
                f"{self._path}: a database of another program (application id {kind}; expected "
                f"{APPLICATION_ID}): give another file"
            )
        if not new and version != FILE_VERSION:
            raise StoreError(
                f"{self._path}: written in version {version} of the tables; expected version "
                f"{FILE_VERSION}: use the Canopy that wrote it, or give another file"
            )
        (mode,) = database.execute("PRAGMA journal_mode = WAL").fetchone()
        if mode != "wal":
            raise StoreError(
                f"{self._path}: no write-ahead log here (journal mode {mode}): give a file on a "
                "local file system"
            )
        database.execute(f"PRAGMA synchronous = {_SYNCHRONOUS[durability]}")
        # In this locking mode the first write takes the lock and keeps it.
        database.execute("BEGIN IMMEDIATE")
        if new:
            for statement in _TABLES:
                database.execute(statement)
        database.execute("COMMIT")
        (verdict,) = database.execute("PRAGMA quick_check(1)").fetchone()
        if verdict != "ok":
            raise StoreError(f"{self._path}: {_FIXES['SQLITE_CORRUPT']} ({verdict})")

    def _enter(self, run: str, *, fresh: bool, tag_format: str) -> None:
        """Resume the run that is there, or begin a new one, in one transaction."""
        database = self._database
        rows = database.execute("SELECT name, incarnation, wave, tag_format FROM run").fetchall()
        if len(rows) != 1:
            raise StoreError(f"{self._path}: {_FIXES['SQLITE_CORRUPT']} (no run in it)")
        ((name, incarnation, wave, left),) = rows
        resumed = name == run
        database.execute("BEGIN IMMEDIATE")
        if not resumed:
            incarnation = wave = 0
            if fresh:
                database.execute("DELETE FROM tag")
            elif left != tag_format and database.execute("SELECT 1 FROM tag").fetchone():
                raise StoreError(
                    f"{self._path}: its tags are of format {left!r}, this run needs {tag_format!r}: "
                    "start fresh, or with the team that left them"
                )
            update = "UPDATE run SET name = ?, incarnation = 0, wave = 0, tag_format = ?"
            database.execute(update, (run, tag_format))
        longest = database.execute(
            "SELECT place, length(tag) FROM tag ORDER BY length(tag) DESC, place LIMIT 1"
        ).fetchone()
        if longest is not None:
            try:
                check_left(longest[0], longest[1], self._capacity_bytes)
            except StoreError as error:
                raise StoreError(f"{self._path}: {error}") from None
        database.execute("COMMIT")
        self._incarnation = incarnation
        self._wave = wave

    def _refuse(self, writes: Sequence[TagWrite]) -> NoReturn:
        """Undo a batch of which a write did not take effect, and say which."""
        self._database.execute("ROLLBACK")
        check_revisions(writes, self._revision)
        raise StoreError(f"{self._path}: a write did not take effect, for no reason known here")

    def _revision(self, place: int) -> int:
        select = "SELECT revision FROM tag WHERE place = ?"
        row: tuple[int] | None = self._database.execute(select, (place,)).fetchone()
        return 0 if row is None else row[0]

    def _undo(self) -> None:
        """End a transaction that failed; SQLite may have done so by itself."""
        try:
            if self._database.in_transaction:
                self._database.execute("ROLLBACK")
        except sqlite3.Error:
            # The failure that led here is the one to tell; the next BEGIN will fail too.
            return

    def _failure(self, error: sqlite3.Error) -> StoreError:
        """Say in our words what SQLite met, with the file and a fix."""
        # Extended codes are "SQLITE_IOERR_WRITE"; errors of the module itself carry none.
        name = "_".join(getattr(error, "sqlite_errorname", "").split("_")[:2])
        fix = _FIXES.get(name)
        return StoreError(
            f"{self._path}: {error}" if fix is None else f"{self._path}: {fix} ({error})"
        )
