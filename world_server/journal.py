"""The journal: every input of the world, written before any reply that depends on it.

An append-only file. Each record is 12 bytes of header (length of the body, CRC-32 of the body, CRC-32
of these two) and a msgpack body. The header has a checksum of its own, so that a damaged length is
told from a record that a crash cut short: the latter can only be the last and is dropped, anything
else is refused with file and offset.

``durability = "process"`` hands each record to the kernel, which survives kill -9 of any process;
``"power"`` flushes it to the disk as well, which survives loss of power.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from struct import Struct as Layout
from typing import Any, Literal
from zlib import compress, crc32, decompress

from msgspec import Struct

from protocol.codec import decoder_of, encode
from protocol.errors import JournalError, MessageError
from protocol.graph import PortGraph
from protocol.grid import Grid
from protocol.messages import SCHEMA_VERSION, AnyRequest, TagWrite
from protocol.scenario import Scenario, from_tree
from protocol.trace import LossCause

MAGIC = b"canopy journal 1\n"
_HEADER = Layout("<III")
_SUMS = Layout("<II")
RECORD_BYTES_MAX = 1 << 30


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


AnyRecord = Opening | Incarnation | Joined | WaveRecord | OldTags | Closing


class Journal:
    """A journal open for appending."""

    def __init__(self, path: Path, durability: Literal["process", "power"] = "process") -> None:
        """Open ``path``, new or to be continued behind its last whole record.

        Raises:
            JournalError: If what is there already is damaged.
        """
        size = path.stat().st_size if path.exists() else 0
        end = 0
        if size:
            for _, offset in scan(path):
                end = offset
        self._path = path
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o644)
        self._flush = durability == "power"
        os.ftruncate(self._descriptor, end)
        os.lseek(self._descriptor, end, os.SEEK_SET)
        if not end:
            os.write(self._descriptor, MAGIC)

    def append(self, record: AnyRecord) -> None:
        """Write one record; when this returns it is as durable as was asked for."""
        body = encode(record)
        sums = _SUMS.pack(len(body), crc32(body))
        record_bytes = sums + crc32(sums).to_bytes(4, "little") + body
        if os.write(self._descriptor, record_bytes) != len(record_bytes):
            # Nothing may follow half a record: as it is the last, a reader drops it.
            raise JournalError(f"{self._path}: the disk took half a record; is it full?")
        if self._flush:
            os.fdatasync(self._descriptor)

    def close(self) -> None:
        """Close the file."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def scan(path: Path) -> Iterator[tuple[AnyRecord, int]]:
    """Read a journal: each record, and the offset behind it.

    A record that a crash cut short at the very end is left out.

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
        offset = len(MAGIC)
        while len(header := file.read(_HEADER.size)) == _HEADER.size:
            length, body_sum, header_sum = _HEADER.unpack(header)
            if crc32(header[:8]) != header_sum:
                raise JournalError(f"{path}: offset {offset}: damaged header of a record")
            body = file.read(length)
            if len(body) < length:
                return
            if crc32(body) != body_sum:
                raise JournalError(f"{path}: offset {offset}: damaged record of {length} bytes")
            try:
                record = decode(body)
            except MessageError as error:
                raise JournalError(f"{path}: offset {offset}: {error}") from None
            offset += _HEADER.size + length
            yield record, offset
