"""Radio: whom a message reaches.

The world carries every message; robots have no other link to each other. A message is meant for
those in reach at the instant of sending; what becomes of it on the way (latency, loss, duplicates) is
drawn from the seed. Each reach is a class of its own, so that a further one is one class more.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Protocol, TypeVar

from protocol.grid import Grid
from protocol.line_of_sight import in_sight
from protocol.scenario import Scenario
from protocol.seeds import spawn
from world_server.sensing import in_sub_cells
from world_server.terrain import GridTerrain, Terrain


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


class AdjacentRadio:
    """Robots hear each other up to a number of moves; others may pass on what they hear.

    A robot under way is where it left from.

    Attributes:
        relay: whether others pass on what they hear.
    """

    def __init__(self, terrain: Terrain, hops: int, *, relay: bool) -> None:
        self.relay = relay
        self._terrain = terrain
        self._hops = hops
        self._near: dict[int, frozenset[int]] = {}

    def hears(self, sender: Antenna, receiver: Antenna, time: float) -> bool:  # noqa: ARG002  as the others
        """Tell whether ``receiver`` hears ``sender`` at ``time``, without help of others."""
        return receiver.place in self._near_to(sender.place)

    def relayed(self, sender: Antenna, places: set[int]) -> set[int]:
        """Return those of the places of other robots that a message gets to from one to the next."""
        waiting = set(places)
        ahead = [sender.place]
        while ahead and waiting:
            found = self._near_to(ahead.pop()) & waiting
            waiting -= found
            ahead += found
        return places - waiting

    def _near_to(self, place: int) -> frozenset[int]:
        """Return the places in reach of a place, itself among them."""
        near = self._near.get(place)
        if near is None:
            reached = level = {place}
            for _ in range(self._hops):
                level = {far for at in level for far in self._terrain.neighbours(at)} - reached
                reached = reached | level
            near = self._near[place] = frozenset(reached)
        return near


class RadiusRadio:
    """Robots hear each other up to a distance; obstacles may be in the way.

    A robot under way is where it left from.
    """

    def __init__(self, grid: Grid, radius_m: float, *, line_of_sight: bool) -> None:
        self._grid = grid
        self._squared = in_sub_cells(radius_m, grid) ** 2
        # Most robots stand where they stood when they were asked about last.
        self._in_sight = lru_cache(maxsize=1 << 16)(self._looks) if line_of_sight else None

    def hears(self, sender: Antenna, receiver: Antenna, time: float) -> bool:  # noqa: ARG002  as the others
        """Tell whether ``receiver`` hears ``sender`` at ``time``."""
        one, other = self._grid.position(sender.place), self._grid.position(receiver.place)
        if (one[0] - other[0]) ** 2 + (one[1] - other[1]) ** 2 > self._squared:
            return False
        return self._in_sight is None or self._in_sight(sender.place, receiver.place)

    def _looks(self, place: int, far: int) -> bool:
        return in_sight(self._grid, self._grid.position(place), self._grid.position(far))


Radio = NoRadio | SamePlaceRadio | GlobalRadio | AdjacentRadio | RadiusRadio


def radio_of(scenario: Scenario, terrain: Terrain) -> Radio:
    """Build the radio that the scenario asks for."""
    radio = scenario.radio
    match radio.reach:
        case None | "none":
            return NoRadio()
        case "same-place":
            return SamePlaceRadio()
        case "global":
            return GlobalRadio()
        case "adjacent":
            return AdjacentRadio(terrain, radio.hops, relay=bool(radio.relay))
        case "radius":
            assert isinstance(terrain, GridTerrain)
            assert radio.radius_m is not None
            hidden = bool(radio.line_of_sight)
            return RadiusRadio(terrain.grid, radio.radius_m, line_of_sight=hidden)


class Ether:
    """What becomes of messages on their way: how many copies arrive, drawn from the seed.

    Attributes:
        stream: what it draws from.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._loss = scenario.radio.loss
        self._duplicate = scenario.radio.duplicate
        self.stream = spawn(scenario.seed, "radio")

    def copies(self) -> int:
        """Return how many copies of the next message its next hearer gets: 0, 1 or 2."""
        if self.stream.random() < self._loss:
            return 0
        return 2 if self.stream.random() < self._duplicate else 1


def ether_of(scenario: Scenario) -> Ether | None:
    """Return what becomes of messages; ``None``: each arrives at once, and once."""
    radio = scenario.radio
    return Ether(scenario) if radio.latency or radio.loss or radio.duplicate else None


A = TypeVar("A", bound=Antenna)


def in_reach(radio: Radio, sender: A, others: Sequence[A], time: float) -> list[A]:
    """Return those of ``others`` that hear ``sender`` now."""
    if isinstance(radio, AdjacentRadio) and radio.relay:
        places = radio.relayed(sender, {other.place for other in others})
        return [other for other in others if other is not sender and other.place in places]
    return [other for other in others if other is not sender and radio.hears(sender, other, time)]
