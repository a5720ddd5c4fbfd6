"""The journal: every input of the world, written before any reply that depends on it.

An append-only file of records (`protocol.records`), each of them msgpack. One that a crash cut short
can only be the last and is dropped; anything else that is damaged is refused with file and offset.
Who appends holds the file as long as it lives, so that two world servers cannot share a run.

``durability = "process"`` hands each record to the kernel, which survives kill -9 of any process;
``"power"`` flushes it to the disk as well, which survives loss of power.
"""

import os
from collections.abc import Iterator
from fcntl import LOCK_EX, LOCK_NB, flock
from pathlib import Path
from typing import Any, Literal
from zlib import compress, crc32, decompress

from msgspec import Struct

from protocol.codec import decoder_of, encode
from protocol.errors import JournalError, MessageError
from protocol.graph import PortGraph
from protocol.grid import Grid
from protocol.messages import SCHEMA_VERSION, AnyRequest, TagWrite
from protocol.records import framed, read_records
from protocol.scenario import Scenario, from_tree
from protocol.trace import LossCause

MAGIC = b"canopy journal 1\n"
RECORD_BYTES_MAX = 1 << 30
_READ_BYTES = 1 << 20


class Record(Struct, frozen=True, array_like=True, forbid_unknown_fields=True, gc=False):
    """Root of all records."""


class GraphRecord(Record, frozen=True, tag="graph"):
    """A port graph, as it was built."""

    names: tuple[str, ...]
    ends: tuple[tuple[int, int], ...]
    lengths: tuple[float | None, ...]
    positions: tuple[tuple[float, float], ...] | None

    def restored(self) -> PortGraph:
        """Return the graph."""
        return PortGraph(self.names, self.ends, self.lengths, self.positions)


class GridRecord(Record, frozen=True, tag="grid"):
    """A grid; ``cells`` are those of `Grid.cells`, compressed."""

    rows: int
    cols: int
    cell_m: float
    cells: bytes

    def restored(self) -> Grid:
        """Return the grid."""
        return Grid(self.rows, self.cols, decompress(self.cells), self.cell_m)


class Opening(Record, frozen=True, tag="opening"):
    """The first record: all that a replay needs to know.

    Attributes:
        schema: SCHEMA_VERSION of the writer.
        run: name of the run.
        engine: which engine played it.
        scenario: the scenario as plain values.
        ground: the graph or the grid.
        starts: start place of each robot.
    """

    schema: int
    run: str
    engine: str
    scenario: dict[str, Any]
    ground: GraphRecord | GridRecord
    starts: tuple[int, ...]

    def checked_scenario(self) -> Scenario:
        """Return the scenario of the run."""
        return from_tree(self.scenario, f"journal of run {self.run}")


def opening(
    run: str,
    engine: str,
    scenario: dict[str, Any],
    ground: PortGraph | Grid,
    starts: tuple[int, ...],
) -> Opening:
    """Return the first record of a run."""
    record: GraphRecord | GridRecord
    if isinstance(ground, Grid):
        record = GridRecord(ground.rows, ground.cols, ground.cell_m, compress(ground.cells()))
    else:
        record = GraphRecord(ground.names, ground.ends, ground.lengths, ground.positions)
    return Opening(SCHEMA_VERSION, run, engine, scenario, record, starts)


class Incarnation(Record, frozen=True, tag="incarnation"):
    """A world process took the run over; ``number`` counts them from 1."""

    number: int


class Joined(Record, frozen=True, tag="joined"):
    """A process became robot ``robot`` under ``nonce``."""

    robot: int
    process: str
    nonce: str


class WaveRecord(Record, frozen=True, tag="wave"):
    """The input to one wave; ``requests`` in the order of its robots."""

    requests: list[AnyRequest | None]
    lost: tuple[tuple[int, LossCause], ...] = ()


class OldTags(Record, frozen=True, tag="old_tags"):
    """Tags that an earlier run left, as they were read."""

    tags: tuple[TagWrite, ...]


class CarriedOut(Record, frozen=True, tag="carried_out"):
    """What the world ordered on account of fault number ``fault`` was done; it goes on.

    Where there is none (in-process) the next record implies it.
    """

    fault: int


class Closing(Record, frozen=True, tag="closing"):
    """The last record of a run that ended.

    Attributes:
        status: how it ended.
        trace_sha256: SHA-256 of its trace.
        play_s: real seconds from the first instant to the end, in the last life of the world.
    """

    status: Literal["over", "stalled"]
    trace_sha256: str
    play_s: float


AnyRecord = Opening | Incarnation | Joined | WaveRecord | OldTags | CarriedOut | Closing


def hold(path: Path, *, create: bool = False) -> int:
    """Hold a journal, against any other process and any other `Journal`, until it is closed.

    Returns:
        Its descriptor, open for writing.

    Raises:
        JournalError: If it cannot be opened, or another holds it.
    """
    flags = os.O_WRONLY | os.O_CLOEXEC | (os.O_CREAT if create else 0)
    try:
        descriptor = os.open(path, flags, 0o644)
    except OSError as error:
        raise JournalError(f"{path}: {error.strerror or error}; expected a journal") from None
    try:
        flock(descriptor, LOCK_EX | LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise JournalError(f"{path}: another world server is alive on this run") from None
    return descriptor


class Journal:
    """A journal open for appending."""

    def __init__(
        self,
        path: Path,
        durability: Literal["process", "power"] = "process",
        *,
        held: int | None = None,
        end: int | None = None,
    ) -> None:
        """Open ``path``, new or to be continued behind its last whole record.

        Args:
            path: the file.
            durability: what each record survives once it is written.
            held: its descriptor, where the caller holds it already; closed in any case by `close`.
            end: offset behind its last whole record, where the caller has just read that.

        Raises:
            JournalError: If what is there already is damaged, or another holds it.
        """
        self._path = path
        self._flush = durability == "power"
        self._descriptor = hold(path, create=True) if held is None else held
        if end is None:
            end = 0
            try:
                for _, offset in scan(path):
                    end = offset
            except JournalError:
                self.close()
                raise
        os.ftruncate(self._descriptor, end)
        os.lseek(self._descriptor, end, os.SEEK_SET)
        if not end:
            os.write(self._descriptor, MAGIC)

    @property
    def end(self) -> int:
        """Offset behind the last record."""
        return os.lseek(self._descriptor, 0, os.SEEK_CUR)

    def append(self, record: AnyRecord) -> None:
        """Write one record; when this returns it is as durable as was asked for."""
        record_bytes = framed(encode(record))
        try:
            written = os.write(self._descriptor, record_bytes)
        except OSError as error:
            raise JournalError(f"{self._path}: {error.strerror}; is the disk full?") from None
        if written != len(record_bytes):
            # Nothing may follow half a record: as it is the last, a reader drops it.
            raise JournalError(f"{self._path}: the disk took half a record; is it full?")
        if self._flush:
            os.fdatasync(self._descriptor)

    def close(self) -> None:
        """Close the file."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def scan(path: Path, start: int = 0) -> Iterator[tuple[AnyRecord, int]]:
    """Read a journal: each record, and the offset behind it.

    A record that a crash cut short at the very end is left out.

    Args:
        path: the file.
        start: offset behind the last record that is not asked for; 0: begin with the first.

    Raises:
        JournalError: If the file is no journal or a record is damaged.
    """
    decode: Any = decoder_of(AnyRecord, RECORD_BYTES_MAX)  # type: ignore[arg-type]
    try:
        file = path.open("rb")
    except OSError as error:
        raise JournalError(f"{path}: {error.strerror or error}; expected a journal") from None
    with file:
        magic = file.read(len(MAGIC))
        if magic != MAGIC:
            if MAGIC.startswith(magic):  # a crash at birth
                return
            raise JournalError(f"{path}: offset 0: no Canopy journal of this version")
        behind = max(start, len(MAGIC))
        file.seek(behind)
        for body, end in read_records(file, path, behind):
            try:
                record = decode(body)
            except MessageError as error:
                raise JournalError(f"{path}: offset {behind}: {error}") from None
            behind = end
            yield record, end


def checksum(path: Path, start: int, end: int, before: int = 0) -> int | None:
    """Return the CRC-32 of the bytes of a file from ``start`` to ``end``.

    It goes on from ``before``, that of the bytes up to ``start``. ``None``: there are not so many.
    """
    found = before
    with path.open("rb") as file:
        file.seek(start)
        while start < end:
            part = file.read(min(_READ_BYTES, end - start))
            if not part:
                return None
            found = crc32(part, found)
            start += len(part)
    return found
