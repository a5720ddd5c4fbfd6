"""The trace: the canonical list of what happened, and its digest.

An event is one request that was applied, or one loss, in the order (time, round, wave, robot). Two
runs of one scenario are the same run if and only if their traces are the same bytes. Events are
encoded by the world alone, so engines cannot differ by how a robot spells its request.
"""

from collections.abc import Callable, Iterable
from hashlib import sha256
from itertools import zip_longest
from typing import Literal

from msgspec import Struct

from protocol.codec import encode
from protocol.messages import AnyRequest, Look, Move, Wait, WaitForNews

LossCause = Literal["killed", "refused", "failed"]

DEVICE_FAULTS = {"erase_tag": "erased", "corrupt_tag": "corrupted", "destroy_tag": "destroyed"}
"""What becomes of a device, by the word of the fault."""

NOBODY = -1
"""The robot of an event that is no robot's: a device failed."""


class Event(Struct, frozen=True, array_like=True, gc=False):
    """One line of the trace.

    Attributes:
        time: virtual time.
        round: round of the instant; -1 for the opening looks.
        wave: wave of the round; -1 for a loss between waves.
        robot: who; ``NOBODY`` where a device failed.
        place: where its body stands; ``None`` if it was lost on its way.
        entry: port by which it came to that place; ``None`` at its start.
        what: the request that was applied, or why the robot was lost, or what became of the device.
        digest: CRC-32 of the encoded sight that the request answers; 0 where there is none.
    """

    time: float
    round: int
    wave: int
    robot: int
    place: int | None
    entry: int | None
    what: AnyRequest | str
    digest: int

    def __str__(self) -> str:
        where = "on its way" if self.place is None else f"at {self.place}"
        if self.robot == NOBODY:
            return f"t={self.time:g} round={self.round} wave={self.wave} device {where} {self.what}"
        return (
            f"t={self.time:g} round={self.round} wave={self.wave} robot={self.robot} {where} "
            f"entry={self.entry} {describe(self.what)} sight={self.digest:08x}"
        )


Observer = Callable[[Event], None]


def describe(what: AnyRequest | str) -> str:
    """Return a request, or the cause of a loss, in a few words."""
    if isinstance(what, str):
        return f"lost ({what})"
    words = [type(what).__name__.lower()]
    if isinstance(what, Move):
        words.append(f"exit={what.exit}")
    elif isinstance(what, Wait):
        words.append(f"duration={what.duration:g}")
    elif isinstance(what, WaitForNews):
        words += [] if what.at_most is None else [f"at_most={what.at_most:g}"]
        words += [] if what.words == 1 else [f"words={what.words}"]
    if isinstance(what, Look | Move) and what.gaze is not None:
        words.append(f"gaze={what.gaze}")
    if what.tag is not None:
        words.append(f"tag={what.tag.hex() or 'blank'}")
    if what.messages:
        words.append(f"messages={[message.hex() for message in what.messages]}")
    return " ".join(words)


CHUNK_BYTES = 1 << 16
"""More than so many bytes of encoded events are one link of the chain."""


class DigestState(Struct, frozen=True, array_like=True, forbid_unknown_fields=True, gc=False):
    """A digest half-way: the last link of its chain, and the events behind that."""

    link: bytes
    rest: bytes


class TraceDigest:
    """SHA-256 over the encoded events, in order, as a chain: so it can be saved half-way.

    The bytes of the events are cut behind the event with which they exceed ``CHUNK_BYTES``, then
    anew. Each link is the SHA-256 of the link before (nothing before the first) and of its chunk; the
    digest is that of the last link and of what is left. So that of a short trace is the SHA-256 of
    its bytes.

    Attributes:
        later: takes in the next event as calling the digest does, but leaves it to be hashed by
            `catch_up`; it costs next to nothing.
    """

    __slots__ = ("_buffer", "_link", "_waiting", "later")

    def __init__(self, state: DigestState | None = None) -> None:
        """Begin with no event, or where ``state`` was saved."""
        self._link = b"" if state is None else state.link
        self._buffer = bytearray(b"" if state is None else state.rest)
        self._waiting: list[Event] = []
        self.later: Observer = self._waiting.append

    def __call__(self, event: Event) -> None:
        """Take in the next event."""
        if self._waiting:
            self.catch_up()
        # One hash for many events: a call of it costs more than hashing a line.
        self._buffer += encode(event)
        if len(self._buffer) > CHUNK_BYTES:
            self._link = sha256(self._link + self._buffer).digest()
            self._buffer.clear()

    def catch_up(self) -> None:
        """Hash the events that `later` took in."""
        buffer = self._buffer
        for event in self._waiting:
            buffer += encode(event)
            if len(buffer) > CHUNK_BYTES:
                self._link = sha256(self._link + buffer).digest()
                buffer.clear()
        self._waiting.clear()

    def hexdigest(self) -> str:
        """Return the digest of all events so far."""
        self.catch_up()
        return sha256(self._link + self._buffer).hexdigest()

    def state(self) -> DigestState:
        """Return what goes on as this digest does."""
        self.catch_up()
        return DigestState(self._link, bytes(self._buffer))


def first_difference(left: Iterable[Event], right: Iterable[Event]) -> str | None:
    """Return the first place where two traces part, as text; ``None`` where they are equal."""
    for number, (a, b) in enumerate(zip_longest(left, right)):
        if a != b:
            shown = ["(ends)" if event is None else str(event) for event in (a, b)]
            return f"event {number}:\n  left:  {shown[0]}\n  right: {shown[1]}"
    return None
