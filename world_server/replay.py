"""Replay: state is a pure function of the journal."""

from collections.abc import Callable
from math import inf
from pathlib import Path

from msgspec import Struct

from protocol.errors import JournalError, ReplayError
from protocol.messages import SCHEMA_VERSION
from protocol.scenario import Scenario
from protocol.trace import Event, Observer, TraceDigest
from world_server.journal import AnyRecord, Closing, Joined, OldTags, Opening, WaveRecord, scan
from world_server.terrain import terrain_of
from world_server.world import Answers, End, KillOrder, Output, TagsWanted, Wave, World


class Replayed(Struct):
    """A run, replayed as far as its journal goes.

    Attributes:
        opening: the first record.
        scenario: what was played.
        world: the world in its last state.
        output: what the world asks for next; an `End` if the run came to its end.
        closing: the last record; ``None`` for a run that was cut off.
        trace_sha256: digest of the replayed trace.
    """

    opening: Opening
    scenario: Scenario
    world: World
    output: Output
    closing: Closing | None
    trace_sha256: str


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
    observe: Observer | None = None,
    until: float = inf,
    on_write: Callable[[int, int, bytes], None] | None = None,
    on_wave: Callable[[Wave, WaveRecord], None] | None = None,
    on_joined: Callable[[Joined], None] | None = None,
    until_asked: bool = False,
) -> Replayed:
    """Simulate a run again from its journal.

    Args:
        path: the journal.
        observe: called with each event.
        until: stop before the first instant later than this virtual time.
        on_write: as for `World`.
        on_wave: called before each wave is applied.
        on_joined: called for each robot that joined.
        until_asked: leave a kill order at the end of the journal open, for a world that goes on.

    Raises:
        JournalError: If the journal is damaged.
        ReplayError: If the journal does not fit the world, or the traces differ.
    """
    opening = read_opening(path)
    scenario = opening.checked_scenario()
    digest = TraceDigest()
    terrain = terrain_of(opening.ground.restored(), scenario)
    world = World(
        scenario, terrain, opening.starts, observe=_both(digest, observe), on_write=on_write
    )
    output = world.begin()
    closing: Closing | None = None
    for record, offset in scan(path):
        if isinstance(record, Joined):
            if on_joined is not None:
                on_joined(record)
        elif isinstance(record, WaveRecord | OldTags):
            output = _after_kills(world, output, until)
            if world.time > until:
                break
            if isinstance(output, Wave) and isinstance(record, WaveRecord):
                if len(record.requests) != len(output.robots):
                    raise _misfit(path, offset, record, output)
                if on_wave is not None:
                    on_wave(output, record)
                output = world.resume(Answers(record.requests, record.lost))
            elif isinstance(output, TagsWanted) and isinstance(record, OldTags):
                output = world.resume(record.tags)
            else:
                raise _misfit(path, offset, record, output)
        elif isinstance(record, Closing):
            closing = record
    if not until_asked:
        output = _after_kills(world, output, until)
    found = digest.hexdigest()
    whole = closing is not None and isinstance(output, End)
    if closing is not None and whole and found != closing.trace_sha256:
        raise ReplayError(f"{path}: recorded trace {closing.trace_sha256}, replayed {found}")
    return Replayed(opening, scenario, world, output, closing, found)


def _both(digest: TraceDigest, observe: Observer | None) -> Observer:
    if observe is None:
        return digest

    def both(event: Event) -> None:
        digest(event)
        observe(event)

    return both


def _after_kills(world: World, output: Output, until: float) -> Output:
    """Carry on behind kills up to a time: one that was ordered was done."""
    while isinstance(output, KillOrder) and world.time <= until:
        output = world.resume(None)
    return output


def _misfit(path: Path, offset: int, record: AnyRecord, output: Output) -> ReplayError:
    wanted = type(output).__name__
    return ReplayError(
        f"{path}: before offset {offset}: {type(record).__name__} where {wanted} fits"
    )
