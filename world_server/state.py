"""What determines the future of a world, as plain values: what a snapshot keeps of it.

Robots are named by their numbers, places that nobody has written to are left out, and what follows
from the scenario alone (lengths, reaches, faults that are still to come) is not here.
"""

from collections.abc import Iterable
from itertools import compress
from struct import Struct as Layout

from msgspec import Struct

from protocol.grid import Cell
from protocol.messages import AnySight, Refusal
from protocol.seeds import Stream


class State(Struct, frozen=True, array_like=True, forbid_unknown_fields=True, gc=False):
    """Root of all parts of a state."""


# Random streams.

_WORDS = Layout("<625I")


class StreamState(State, frozen=True):
    """Where a random stream stands: the words of its generator, and a normal variate it has in hand."""

    words: bytes
    next_gauss: float | None


def states_of(streams: Iterable[Stream]) -> list[StreamState]:
    """Return where each of some random streams stands."""
    states = []
    for stream in streams:
        _, words, next_gauss = stream.getstate()
        states.append(StreamState(_WORDS.pack(*words), next_gauss))
    return states


def put_back(streams: Iterable[Stream], states: Iterable[StreamState]) -> None:
    """Let random streams go on from where others stood.

    Raises:
        ValueError: If there are more of the ones than of the others.
    """
    for stream, state in zip(streams, states, strict=True):
        version = stream.getstate()[0]
        stream.setstate((version, _WORDS.unpack(state.words), state.next_gauss))


# Tags.


class TagsState(State, frozen=True):
    """The tags of devices, by columns: there may be very many.

    Attributes:
        places: those that were written to; ``None``: these are all places.
        revisions: how often each of them was written.
        tags: what they hold.
    """

    places: list[int] | None
    revisions: list[int]
    tags: list[bytes]


def tags_state(revisions: list[int], tags: list[bytes]) -> TagsState:
    """Return the tags of all places; those that were never written are blank."""
    if 4 * revisions.count(0) < 3 * len(revisions):
        return TagsState(None, revisions.copy(), tags.copy())
    places = list(compress(range(len(revisions)), revisions))
    return TagsState(places, list(compress(revisions, revisions)), list(compress(tags, revisions)))


def put_tags_back(state: TagsState, revisions: list[int], tags: list[bytes]) -> None:
    """Put tags back where all are blank."""
    places = range(len(tags)) if state.places is None else state.places
    for place, revision, tag in zip(places, state.revisions, state.tags, strict=True):
        revisions[place], tags[place] = revision, tag


# A world between two instants.


class BodyState(State, frozen=True):
    """A robot, with the fields of `world_server.world.Body`."""

    place: int
    entry: int | None
    gaze: int | None
    state: int
    destination: tuple[int, int]
    due: float
    sight: AnySight | None
    requests: int
    inbox: tuple[tuple[int, bytes], ...]
    losses: tuple[int, ...]
    lost_at: float | None
    stopped_at: float | None
    words: int


class SteeringState(State, frozen=True):
    """What comes between robots and where they want to go.

    Attributes:
        errors: how far each robot is off the middle of its sub-cell, down and right, sub-cells.
        bodies_at: by place: how many bodies take it up.
        believed: where each robot takes itself to be, if it adds up its own moves.
        streams: those that errors are drawn from.
    """

    errors: list[tuple[float, float]]
    bodies_at: dict[int, int]
    believed: list[Cell] | None
    streams: list[StreamState]


class WorldState(State, frozen=True):
    """A world between two instants, when nobody is in turn.

    Attributes:
        time: virtual time of the last instant.
        bodies: the robots, by id.
        tags: the devices that are not as new.
        destroyed: places whose device is no more.
        unseen: places whose old tags were not asked for yet; ``None`` where there are no old tags.
        refusals: what each robot that broke a rule was told.
        struck: numbers of the faults that were due, and when.
        faults_left: how many of the faults that strike at a time are still to come.
        at_request: robot and number of each request in place of which a fault is still to strike.
        agenda: robots whose way or wait ends, by time, in order.
        in_air: receiver, sender and bytes of each message on its way, by time, in order.
        resting: robots that wait or have stopped, by place.
        visited: places that a robot has been at.
        moves: how many moves arrived.
        jitter: streams of the clock.
        ether: streams of the radio.
        steering: motion on grids, where it is not exact.
    """

    time: float
    bodies: list[BodyState]
    tags: TagsState
    destroyed: set[int]
    unseen: set[int] | None
    refusals: dict[int, Refusal]
    struck: list[tuple[int, float]]
    faults_left: int
    at_request: list[tuple[int, int]]
    agenda: list[tuple[float, list[int]]]
    in_air: list[tuple[float, list[tuple[int, int, bytes]]]]
    resting: dict[int, list[int]]
    visited: set[int]
    moves: int
    jitter: list[StreamState]
    ether: list[StreamState]
    steering: SteeringState | None
