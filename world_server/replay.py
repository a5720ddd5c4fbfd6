"""Replay: state is a pure function of the journal; and recovery, which begins at a snapshot."""

from collections.abc import Callable
from math import inf
from os import close
from pathlib import Path

from msgspec import Struct

from protocol.errors import JournalError, ReplayError
from protocol.messages import SCHEMA_VERSION
from protocol.scenario import Scenario
from protocol.trace import Event, Observer, TraceDigest
from world_server.journal import (
    CarriedOut,
    Closing,
    Incarnation,
    Joined,
    Journal,
    OldTags,
    Opening,
    WaveRecord,
    hold,
    scan,
)
from world_server.snapshot import Snapshot, read_snapshot, snapshot_of
from world_server.terrain import terrain_of
from world_server.world import Answers, End, FaultOrder, KillOrder, Output, TagsWanted, Wave, World
from world_server.write_behind import WriteBehind


class Replayed(Struct):
    """A run, replayed as far as its journal goes.

    Attributes:
        opening: the first record.
        scenario: what was played.
        world: the world in its last state.
        output: what the world asks for next; an `End` if the run came to its end.
        closing: the last record; ``None`` for a run that was cut off.
        trace_sha256: digest of the replayed trace.
        digest: that digest, for a world that goes on.
        incarnations: lives of the world server.
        joined: who has joined, by robot.
        end: offset behind the last whole record.
    """

    opening: Opening
    scenario: Scenario
    world: World
    output: Output
    closing: Closing | None
    trace_sha256: str
    digest: TraceDigest
    incarnations: int
    joined: dict[int, Joined]
    end: int


def read_opening(path: Path) -> Opening:
    """Return the first record of a journal.

    Raises:
        JournalError: If there is none.
    """
    for record, _ in scan(path):
        if isinstance(record, Opening):
            if record.schema != SCHEMA_VERSION:
                raise JournalError(
                    f"{path}: written by schema {record.schema}; this is {SCHEMA_VERSION}"
                )
            return record
        break
    raise JournalError(f"{path}: no opening record; the run never began")


def replay(
    path: Path,
    *,
    snapshot: Snapshot | None = None,
    observe: Observer | None = None,
    until: float = inf,
    on_write: Callable[[int, int, bytes], None] | None = None,
    on_input: Callable[[], None] | None = None,
    until_asked: bool = False,
) -> Replayed:
    """Simulate a run again from its journal.

    Args:
        path: the journal.
        snapshot: state of the run to begin at; by default its beginning.
        observe: called with each event.
        until: stop before the first instant later than this virtual time.
        on_write: as for `World`.
        on_input: called each time before the world is given something; also before it begins, but
            not where it goes on from a snapshot.
        until_asked: leave an order at the end of the journal open, for a world that goes on.

    Raises:
        JournalError: If the journal is damaged.
        ReplayError: If the journal does not fit the world, or the traces differ.
    """
    opening = read_opening(path)
    scenario = opening.checked_scenario()
    digest = TraceDigest(None if snapshot is None else snapshot.trace)
    terrain = terrain_of(opening.ground.restored(), scenario)
    world = World(
        scenario, terrain, opening.starts, observe=_both(digest, observe), on_write=on_write
    )
    told = on_input or _nobody
    joined: dict[int, Joined] = {}
    incarnations = end = 0
    if snapshot is None:
        told()
    else:
        world.restore(snapshot.world)
        joined = {one.robot: one for one in snapshot.joined}
        incarnations, end = snapshot.incarnations, snapshot.journal_bytes
    output = world.begin()
    closing: Closing | None = None
    for record, offset in scan(path, end):
        if isinstance(record, WaveRecord | OldTags | CarriedOut):
            if not isinstance(record, CarriedOut):
                output = _after_orders(world, output, until, told)
            if world.time > until:
                break
            told()
            output = _fed(path, offset, record, world, output)
            digest.catch_up()
        elif isinstance(record, Joined):
            joined[record.robot] = record
        elif isinstance(record, Incarnation):
            incarnations += 1
        elif isinstance(record, Closing):
            closing = record
        end = offset
    if not until_asked:
        output = _after_orders(world, output, until, told)
    found = digest.hexdigest()
    whole = closing is not None and isinstance(output, End)
    if closing is not None and whole and found != closing.trace_sha256:
        raise ReplayError(f"{path}: recorded trace {closing.trace_sha256}, replayed {found}")
    return Replayed(
        opening, scenario, world, output, closing, found, digest, incarnations, joined, end
    )


def _nobody() -> None:
    """Tell nobody."""


def _both(digest: TraceDigest, observe: Observer | None) -> Observer:
    later = digest.later
    if observe is None:
        return later

    def both(event: Event) -> None:
        later(event)
        observe(event)

    return both


def _after_orders(world: World, output: Output, until: float, told: Callable[[], None]) -> Output:
    """Carry on behind orders up to a time: what was ordered was done."""
    while isinstance(output, KillOrder | FaultOrder) and world.time <= until:
        told()
        output = world.resume(None)
    return output


def _fed(
    path: Path, offset: int, record: WaveRecord | OldTags | CarriedOut, world: World, output: Output
) -> Output:
    """Give the world what a record holds; return what it asks for next.

    Raises:
        ReplayError: If it had asked for something else.
    """
    match record, output:
        case WaveRecord(), Wave() if len(record.requests) == len(output.robots):
            return world.resume(Answers(record.requests, record.lost))
        case OldTags(), TagsWanted():
            return world.resume(record.tags)
        case CarriedOut(), KillOrder() | FaultOrder() if record.fault == output.fault:
            return world.resume(None)
    wanted = type(output).__name__
    raise ReplayError(
        f"{path}: before offset {offset}: {type(record).__name__} where {wanted} fits"
    )


# A world that goes on.


class Recovered(Struct):
    """A run that a world server takes over.

    Attributes:
        replayed: the run so far.
        journal: held, and open behind its last record.
        store: all writes that the store may not have.
        snapshot: what recovery began at; ``None``: the beginning of the journal.
        misfit: why a snapshot that was there was not used; empty: there was none, or it was.
    """

    replayed: Replayed
    journal: Journal
    store: WriteBehind
    snapshot: Snapshot | None
    misfit: str


def recover(run_dir: Path, run: str) -> Recovered:
    """Hold the journal of a run and replay it, from the snapshot on if there is one that fits.

    The journal is read once. From the world's next outputs on the events go to
    ``replayed.digest.later``, the writes to ``store.written``.

    Raises:
        JournalError: If the journal is damaged, or another world server holds it.
        ReplayError: If the journal does not fit the world.
    """
    path = run_dir / "journal"
    held = hold(path)
    try:
        snapshot, misfit = None, ""
        try:
            snapshot = read_snapshot(snapshot_of(run_dir), run, path)
            replayed, store = _replayed_for_life(path, snapshot)
        except (JournalError, ReplayError) as error:
            if not snapshot_of(run_dir).exists():
                raise
            # The journal is the authority: if it is at fault itself, that shows now.
            snapshot, misfit = None, str(error)
            replayed, store = _replayed_for_life(path, None)
        durability = replayed.scenario.durability
        journal = Journal(path, durability, held=held, end=replayed.end)
    except BaseException:
        close(held)
        raise
    return Recovered(replayed, journal, store, snapshot, misfit)


def all_writes(path: Path, incarnation: int) -> WriteBehind:
    """Return all writes of a run, for a store that has less than a snapshot took for granted."""
    store = WriteBehind(incarnation)
    replay(path, on_write=store.written, on_input=store.next_wave, until_asked=True)
    return store


def _replayed_for_life(path: Path, snapshot: Snapshot | None) -> tuple[Replayed, WriteBehind]:
    store = WriteBehind()
    if snapshot is not None:
        store.restore(snapshot.unacknowledged)
    replayed = replay(
        path,
        snapshot=snapshot,
        on_write=store.written,
        on_input=store.next_wave,
        until_asked=True,
    )
    store.incarnation = replayed.incarnations + 1
    return replayed, store
