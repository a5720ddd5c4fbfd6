"""Radio: whom a message reaches.

The world carries every message; robots have no other link to each other. A message is delivered to
those in reach at the instant of sending. Each reach is a class of its own, so that a further one is
one class more.
"""

from collections.abc import Sequence
from typing import Protocol, TypeVar


class Antenna(Protocol):
    """What a reach needs to know of a robot.

    Attributes:
        place: where it stands, or where it left from.
    """

    place: int

    @property
    def left_at(self) -> float:
        """When it left its place; infinite while it stands there."""


class NoRadio:
    """Nobody hears anything."""

    def hears(self, sender: Antenna, receiver: Antenna, time: float) -> bool:  # noqa: ARG002  as the others
        """Tell whether ``receiver`` hears ``sender`` at ``time``."""
        return False


class SamePlaceRadio:
    """Robots at one place hear each other (Brass et al. 2011, Sec. III)."""

    def hears(self, sender: Antenna, receiver: Antenna, time: float) -> bool:
        """Tell whether ``receiver`` hears ``sender`` at ``time``."""
        # Who leaves in this very instant has not gone anywhere yet.
        return sender.place == receiver.place and min(sender.left_at, receiver.left_at) >= time


class GlobalRadio:
    """Everybody hears everybody, also on the way."""

    def hears(self, sender: Antenna, receiver: Antenna, time: float) -> bool:  # noqa: ARG002  as the others
        """Tell whether ``receiver`` hears ``sender`` at ``time``."""
        return True


Radio = NoRadio | SamePlaceRadio | GlobalRadio

RADIOS: dict[str, type[Radio]] = {
    "none": NoRadio,
    "same-place": SamePlaceRadio,
    "global": GlobalRadio,
}


A = TypeVar("A", bound=Antenna)


def in_reach(radio: Radio, sender: A, others: Sequence[A], time: float) -> list[A]:
    """Return those of ``others`` that hear ``sender`` now."""
    return [other for other in others if other is not sender and radio.hears(sender, other, time)]
