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
- *Damage.* SQLite guards its log with checksums, but not the pages of the file. So each row ends
  with a checksum of what stands in it, and the row of the run also has a digest of all tags: it
  finds rows that are whole but gone, or older or newer than the wave says (a log that lost its end
  after a part of it had been moved into the file). All of this is checked on opening, and each row
  again when it is read. What fails is refused; nothing is repaired.
"""

import sqlite3
from collections.abc import Iterable, Sequence
from pathlib import Path
from struct import Struct as Layout
from typing import Any, Literal, NoReturn
from zlib import crc32

from msgspec.structs import astuple

from bookkeeping.store import (
    NUMBER_MAX,
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

FILE_VERSION = 2
"""Version of the tables below."""

_SYNCHRONOUS: dict[Durability, str] = {"process": "NORMAL", "power": "FULL"}

_TABLES = {
    "run": (
        "CREATE TABLE run (name TEXT NOT NULL, incarnation INTEGER NOT NULL, wave INTEGER NOT NULL,"
        " tag_format TEXT NOT NULL, digest INTEGER NOT NULL, checksum INTEGER NOT NULL)"
    ),
    "tag": (
        "CREATE TABLE tag (place INTEGER PRIMARY KEY, revision INTEGER NOT NULL, tag BLOB NOT NULL,"
        " checksum INTEGER NOT NULL)"
    ),
}

_UPSERT = (
    "INSERT INTO tag VALUES (?, ?, ?, ?) ON CONFLICT (place) DO UPDATE SET revision ="
    " excluded.revision, tag = excluded.tag, checksum = excluded.checksum"
    " WHERE excluded.revision > revision"
)

_PAGE_BYTES_MIN = 512

_TAG_NUMBERS = Layout("<qq")
_RUN_NUMBERS = Layout("<qqq")

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


def _tag_checksum(place: int, revision: int, tag: bytes) -> int:
    """Return the checksum of a row of table ``tag``, a CRC-32."""
    return crc32(_TAG_NUMBERS.pack(place, revision) + tag)


def _is_whole(row: Sequence[Any]) -> bool:
    """Return whether a row of table ``tag`` is what was written."""
    place, revision, tag, checksum = row
    return (
        isinstance(revision, int)
        and isinstance(tag, bytes)
        and bool(checksum == _tag_checksum(place, revision, tag))
    )


def _words_checksum(name: str, tag_format: str) -> int:
    """Return the part of the run's checksum that stays the same as long as the run lasts."""
    return crc32(f"{name}\0{tag_format}".encode())


def _squares(checksums: Iterable[int]) -> int:
    """Return what these rows add to the digest, before it is cut to 63 bits.

    Squares, because a CRC is linear: the same change of two tags would cancel out in a plain sum.
    """
    return sum([checksum * checksum for checksum in checksums])


def _has_lost_its_head(path: Path) -> bool:
    """Return whether SQLite would take what is left of a file for a new one.

    It does so below the size of the smallest page, and then deletes the log of an empty file.
    """
    try:
        size = path.stat().st_size
        log = path.with_name(f"{path.name}-wal")
        return 0 < size < _PAGE_BYTES_MIN or (size == 0 and log.stat().st_size > 0)
    except OSError:  # nothing is there; or the opening will say what is wrong
        return False


def tag_format_left(path: Path) -> str | None:
    """Return the format of the tags in a file, without changing it; ``None`` if it is no store.

    Checksums are left to the opening of the store.
    """
    try:
        database = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, timeout=0)
    except sqlite3.Error:
        return None
    try:
        row: tuple[str] | None = database.execute("SELECT tag_format FROM run").fetchone()
    except (sqlite3.Error, UnicodeDecodeError):
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
        self._words = _words_checksum("", "")
        self._checksums: dict[int, int] = {}  # of each tag, by place
        self._digest = 0
        if _has_lost_its_head(self._path):
            raise self._damaged("it has lost its first page")
        try:
            # Autocommit: transactions are written out below. The thread check is off because a
            # process may open the store in one thread and use it in another.
            self._database = sqlite3.connect(
                self._path, timeout=0, isolation_level=None, check_same_thread=False
            )
            # A damaged text must reach its checksum, not fail on the way.
            self._database.text_factory = lambda text: text.decode(errors="replace")
        except sqlite3.Error as error:
            raise self._failure(error) from error
        try:
            self._open(durability)
            self._enter(run, fresh=fresh, tag_format=tag_format)
        except sqlite3.Error as error:
            self._database.close()
            raise self._failure(error) from error
        except UnicodeDecodeError as error:
            # SQLite's own words quote a damaged definition of a table.
            self._database.close()
            raise self._damaged("its tables are not those of a store") from error
        except BaseException:
            self._database.close()
            raise

    def hello(self, incarnation: int) -> int:
        """Let a world server introduce itself; see `Store.hello`."""
        check_incarnation(incarnation, self._incarnation)
        try:
            self._database.execute(
                "UPDATE run SET incarnation = ?, checksum = ?",
                (incarnation, self._run_checksum(incarnation, self._wave, self._digest)),
            )
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
        check_writes(batch, self._capacity_bytes, self._wave)
        rows = [
            (place, revision, tag, _tag_checksum(place, revision, tag))
            for place, revision, tag in map(astuple, writes)
        ]
        changes = {row[0]: row[3] for row in rows}
        digest = self._digest_after(changes)
        database = self._database
        try:
            database.execute("BEGIN IMMEDIATE")
            changed = database.executemany(_UPSERT, rows).rowcount
            if writes and changed != len(writes):
                self._refuse(writes)
            database.execute(
                "UPDATE run SET wave = ?, digest = ?, checksum = ?",
                (wave, digest, self._run_checksum(self._incarnation, wave, digest)),
            )
            database.execute("COMMIT")
        except sqlite3.Error as error:
            self._undo()
            raise self._failure(error) from error
        except BaseException:
            self._undo()
            raise
        self._wave = wave
        self._checksums.update(changes)
        self._digest = digest
        return wave

    def read(self, places: Sequence[int]) -> tuple[TagWrite, ...]:
        """Read tags as they are now; see `Store.read`."""
        check_places(places)
        execute = self._database.execute
        select = "SELECT * FROM tag WHERE place = ?"
        try:
            rows = [execute(select, (place,)).fetchone() for place in places]
        except sqlite3.Error as error:
            raise self._failure(error) from error
        found = zip(places, rows, strict=True)
        return tuple(
            self._checked(place, row)
            for place, row in found
            if row is not None or place in self._checksums
        )

    def tags(self) -> dict[int, TagWrite]:
        """Read all tags; see `Store.tags`."""
        try:
            rows = self._database.execute("SELECT * FROM tag ORDER BY place").fetchall()
        except sqlite3.Error as error:
            raise self._failure(error) from error
        tags = {row[0]: self._checked(row[0], row) for row in rows}
        if len(tags) != len(self._checksums):
            raise self._damaged(f"{len(tags)} tags in it; expected {len(self._checksums)}")
        return tags

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
        tables = dict(database.execute("SELECT name, sql FROM sqlite_master"))
        # A crash between the change to WAL and the first commit leaves an empty database.
        new = kind == version == len(tables) == 0
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
            for statement in _TABLES.values():
                database.execute(statement)
            checksum = self._run_checksum(0, 0, 0)
            database.execute("INSERT INTO run VALUES ('', 0, 0, '', 0, ?)", (checksum,))
            database.execute(f"PRAGMA application_id = {APPLICATION_ID}")
            database.execute(f"PRAGMA user_version = {FILE_VERSION}")
        elif tables != _TABLES:
            raise self._damaged("its tables are not those of a store")
        database.execute("COMMIT")
        (verdict,) = database.execute("PRAGMA quick_check(1)").fetchone()
        if verdict != "ok":
            raise self._damaged(verdict)

    def _enter(self, run: str, *, fresh: bool, tag_format: str) -> None:
        """Resume the run that is there, or begin a new one, in one transaction."""
        database = self._database
        name, incarnation, wave, left = self._check_all()
        resumed = name == run
        database.execute("BEGIN IMMEDIATE")
        if not resumed:
            incarnation = wave = 0
            if fresh:
                database.execute("DELETE FROM tag")
                self._checksums = {}
                self._digest = 0
            elif left != tag_format and self._checksums:
                raise StoreError(
                    f"{self._path}: its tags are of format {left!r}, this run needs {tag_format!r}: "
                    "start fresh, or with the team that left them"
                )
            self._words = _words_checksum(run, tag_format)
            database.execute(
                "UPDATE run SET name = ?, incarnation = 0, wave = 0, tag_format = ?, digest = ?,"
                " checksum = ?",
                (run, tag_format, self._digest, self._run_checksum(0, 0, self._digest)),
            )
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

    def _check_all(self) -> tuple[str, int, int, str]:
        """Check every row, and the tags together against the digest.

        Returns:
            Name, incarnation and wave of the last run, and the format of its tags.
        """
        rows = self._database.execute("SELECT * FROM run").fetchall()
        if len(rows) != 1:
            raise self._damaged("no run in it")
        ((name, incarnation, wave, tag_format, digest, checksum),) = rows
        self._words = _words_checksum(str(name), str(tag_format))
        numbers = (incarnation, wave, digest)
        if not all(isinstance(number, int) for number in numbers) or (
            checksum != self._run_checksum(*numbers)
        ):
            raise self._damaged("the checksum of the run is wrong")
        for row in self._database.execute("SELECT * FROM tag"):
            if not _is_whole(row):
                raise self._damaged(f"place {row[0]}: the checksum of the tag is wrong")
            self._checksums[row[0]] = row[3]
        self._digest = _squares(self._checksums.values()) & NUMBER_MAX
        if self._digest != digest:
            raise self._damaged(f"its tags are not those of wave {wave}")
        return name, incarnation, wave, tag_format

    def _checked(self, place: int, row: Sequence[Any] | None) -> TagWrite:
        """Give the tag in a row, if it is the one that was written last."""
        if row is None or not _is_whole(row) or row[3] != self._checksums.get(place):
            raise self._damaged(f"place {place}: the tag is not the one that was written")
        return TagWrite(*row[:3])

    def _run_checksum(self, incarnation: int, wave: int, digest: int) -> int:
        """Return the checksum of the row of the run, a CRC-32."""
        return crc32(_RUN_NUMBERS.pack(incarnation, wave, digest), self._words)

    def _digest_after(self, changes: dict[int, int]) -> int:
        """Return the digest of all tags once some of them have these checksums, by place."""
        known = self._checksums
        replaced = [known.get(place, 0) for place in changes]
        return (self._digest + _squares(changes.values()) - _squares(replaced)) & NUMBER_MAX

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

    def _damaged(self, found: str) -> StoreError:
        """Say that the file is damaged, where, and what to do."""
        return StoreError(f"{self._path}: {_FIXES['SQLITE_CORRUPT']} ({found})")

    def _failure(self, error: sqlite3.Error) -> StoreError:
        """Say in our words what SQLite met, with the file and a fix."""
        # Extended codes are "SQLITE_IOERR_WRITE"; errors of the module itself carry none.
        name = "_".join(getattr(error, "sqlite_errorname", "").split("_")[:2])
        fix = _FIXES.get(name)
        return StoreError(
            f"{self._path}: {error}" if fix is None else f"{self._path}: {fix} ({error})"
        )
