"""Snapshots: the state of a run now and then, so that recovery takes no longer the longer a run lasts.

``RUN_DIR/snapshot`` holds the newest one. It stands for the journal up to an offset and bears the
checksum of all bytes up to there: so it is used only with the journal it was taken of, and a journal
that was damaged behind us is found out without being replayed. What is cut short, damaged or of
another run is no snapshot; the journal, which is the authority, is replayed as a whole then.

A snapshot is taken between two instants and written while the robots think.
"""

import os
from pathlib import Path
from typing import Any, Literal

from msgspec.structs import replace

from protocol.codec import decoder_of, encode
from protocol.errors import JournalError, MessageError
from protocol.messages import SCHEMA_VERSION
from protocol.records import framed, read_records
from protocol.trace import DigestState
from world_server.journal import RECORD_BYTES_MAX, Joined, checksum
from world_server.state import State, WorldState
from world_server.write_behind import UnacknowledgedState

MAGIC = b"canopy snapshot 1\n"

EVERY_REQUESTS = 1 << 15
"""A snapshot is taken each time that so many requests were applied, ..."""

BYTES_PER_REQUEST = 48
"""... or so many that the last snapshot has at most this many bytes for each of them: to take and to
write a byte costs 4 to 10 ns, so that is a hundredth or so of what processes need for a request."""


class Snapshot(State, frozen=True):
    """A run between two instants.

    Attributes:
        schema: SCHEMA_VERSION of the writer.
        run: name of the run.
        journal_bytes: how much of the journal it stands for.
        journal_sum: CRC-32 of that.
        incarnations: lives of the world server so far.
        joined: who has joined.
        world: the world.
        trace: digest of the trace so far.
        unacknowledged: what the store has not acknowledged.
    """

    schema: int
    run: str
    journal_bytes: int
    journal_sum: int
    incarnations: int
    joined: tuple[Joined, ...]
    world: WorldState
    trace: DigestState
    unacknowledged: UnacknowledgedState


def snapshot_of(run_dir: Path) -> Path:
    """Return where the snapshot of a run is."""
    return run_dir / "snapshot"


def read_snapshot(path: Path, run: str, journal: Path) -> Snapshot | None:
    """Return a snapshot that can stand for the beginning of a journal; ``None``: there is none.

    Raises:
        JournalError: If there is one that cannot.
    """
    decode: Any = decoder_of(Snapshot, RECORD_BYTES_MAX)
    try:
        file = path.open("rb")
    except FileNotFoundError:
        return None
    with file:
        if file.read(len(MAGIC)) != MAGIC:
            raise JournalError(f"{path}: offset 0: no Canopy snapshot of this version")
        bodies = [body for body, _ in read_records(file, path, len(MAGIC))]
    if len(bodies) != 1:
        raise JournalError(f"{path}: {len(bodies)} whole records; expected one")
    try:
        found: Snapshot = decode(bodies[0])
    except MessageError as error:
        raise JournalError(f"{path}: {error}") from None
    if (found.schema, found.run) != (SCHEMA_VERSION, run):
        raise JournalError(
            f"{path}: of run {found.run} by schema {found.schema}; expected {run}, {SCHEMA_VERSION}"
        )
    if checksum(journal, 0, found.journal_bytes) != found.journal_sum:
        raise JournalError(
            f"{path}: does not fit the first {found.journal_bytes} bytes of {journal.name}"
        )
    return found


class SnapshotFile:
    """The snapshot of a run that goes on."""

    def __init__(
        self,
        path: Path,
        journal: Path,
        *,
        every_requests: int = EVERY_REQUESTS,
        durability: Literal["process", "power"] = "process",
        last: Snapshot | None = None,
    ) -> None:
        """Begin with no snapshot in hand.

        Args:
            path: where it is to be.
            journal: of the run.
            every_requests: how many requests lie between two snapshots at least.
            durability: as of the journal.
            last: the one that is there, if it fits.
        """
        self._path = path
        self._temporary = path.with_name(path.name + ".new")
        self._journal = journal
        self._every_requests = every_requests
        self._flush = durability == "power"
        self._summed = (0, 0) if last is None else (last.journal_bytes, last.journal_sum)
        self._in_hand: Snapshot | None = None
        self._requests_left = every_requests

    def due(self, requests: int) -> bool:
        """Count so many requests more; tell whether it is time for the next snapshot."""
        self._requests_left -= requests
        return self._requests_left <= 0

    def take(self, snapshot: Snapshot) -> None:
        """Keep a snapshot, without the checksum of its journal, to be written by `write`."""
        self._in_hand = snapshot

    def write(self) -> None:
        """Write the snapshot in hand, if there is one; it takes the place of the last at once."""
        snapshot, self._in_hand = self._in_hand, None
        if snapshot is None:
            return
        before, sum_before = self._summed
        journal_sum = checksum(self._journal, before, snapshot.journal_bytes, sum_before)
        if journal_sum is None:
            raise JournalError(f"{self._journal}: shorter than what was written to it")
        self._summed = (snapshot.journal_bytes, journal_sum)
        body = encode(replace(snapshot, journal_sum=journal_sum))
        self._requests_left = max(self._every_requests, len(body) // BYTES_PER_REQUEST)
        with self._temporary.open("wb") as file:
            file.write(MAGIC)
            file.write(framed(body))
            if self._flush:
                file.flush()
                os.fsync(file.fileno())
        self._temporary.replace(self._path)
        if self._flush:
            folder = os.open(self._path.parent, os.O_RDONLY | os.O_CLOEXEC)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)

    def remove(self) -> None:
        """Remove what is there: the run is over."""
        self._temporary.unlink(missing_ok=True)
        self._path.unlink(missing_ok=True)
