"""Virtual time: how long things take, and what happens next.

Time is float64 everywhere (6 and 6.0 encode differently), computed only as now + duration; events of
one instant are those whose times are exactly equal.
"""

from collections.abc import Callable, Iterable, Sequence
from heapq import heappop, heappush
from math import isfinite
from operator import itemgetter
from typing import Generic, TypeVar

from protocol.errors import DurationError
from protocol.scenario import Scenario
from protocol.seeds import Stream, spawn

T = TypeVar("T")
Length = Callable[[int, int], float | None]
"""The length of the edge behind an exit of a place; ``None`` where it is not known."""


class Lockstep:
    """Every move takes one tick, a wait a whole number of them (the papers' model).

    Attributes:
        tick: how long each move takes; ``None`` where that depends on the move.
        streams: what it draws from.
    """

    tick: float | None = 1.0
    streams: Sequence[Stream] = ()

    def move_duration(self, robot: int, place: int, exit_: int) -> float:  # noqa: ARG002  any clock's
        """Return 1.0, whatever the robot and the edge."""
        return 1.0

    def wait_duration(self, duration: float) -> float:
        """Return ``duration`` if it is a whole number of ticks.

        Raises:
            DurationError: If it is not, or is not positive and finite.
        """
        if not (isfinite(duration) and duration >= 1 and duration == int(duration)):
            raise DurationError(f"wait of {duration}; in lockstep expected 1, 2, 3, ... ticks")
        return float(duration)


class EventClock:
    """A move takes edge length / speed, times a seeded jitter of its own.

    A missing length, or 0, reads as 1. Asynchronous in virtual time, and exactly repeatable: each
    robot draws from a random stream of its own, once a move.

    Attributes:
        tick: as of `Lockstep`.
        streams: what it draws from, by robot; none without jitter.
    """

    tick: float | None = None

    def __init__(self, scenario: Scenario, length: Length) -> None:
        self._length = length
        robots = scenario.team.robots
        speed = scenario.team.speed
        self._speeds = speed if isinstance(speed, tuple) else (speed,) * robots
        self._factor = _jitter(scenario.clock.jitter)
        drawn = () if self._factor is None else range(robots)
        self.streams: Sequence[Stream] = [spawn(scenario.seed, "jitter", robot) for robot in drawn]

    def move_duration(self, robot: int, place: int, exit_: int) -> float:
        """Return how long this move of ``robot`` takes, by ``exit_`` of ``place``."""
        duration = (self._length(place, exit_) or 1.0) / self._speeds[robot]
        return duration if self._factor is None else duration * self._factor(self.streams[robot])

    def wait_duration(self, duration: float) -> float:
        """Return ``duration``.

        Raises:
            DurationError: If it is not positive and finite.
        """
        if not (isfinite(duration) and duration > 0):
            raise DurationError(f"wait of {duration}; expected a positive, finite time")
        return float(duration)


def _jitter(jitter: float | str) -> Callable[[Stream], float] | None:
    if jitter == "exponential":
        return lambda stream: stream.expovariate(1.0)
    if isinstance(jitter, str) or jitter == 0:
        return None
    low, high = 1.0 - jitter, 1.0 + jitter
    return lambda stream: stream.uniform(low, high)


def clock_of(scenario: Scenario, length: Length) -> Lockstep | EventClock:
    """Build the clock that the scenario asks for."""
    return EventClock(scenario, length) if scenario.clock.mode == "event" else Lockstep()


class Agenda(Generic[T]):
    """What is to happen, by time: one heap entry for each distinct time."""

    __slots__ = ("_at", "_times")

    def __init__(self, planned: Iterable[tuple[float, list[T]]] = ()) -> None:
        """Begin with what is planned, in order of time."""
        self._at: dict[float, list[T]] = dict(planned)
        self._times = list(self._at)  # in order, hence a heap

    def planned(self) -> list[tuple[float, list[T]]]:
        """Return what is to happen, in order of time."""
        return sorted(self._at.items(), key=itemgetter(0))

    def at(self, time: float) -> list[T]:
        """Return the list of what happens at ``time``, to be appended to."""
        items = self._at.get(time)
        if items is None:
            items = self._at[time] = []
            heappush(self._times, time)
        return items

    def next_time(self) -> float | None:
        """Return the earliest time at which something happens, or ``None``."""
        return self._times[0] if self._times else None

    def take(self, time: float) -> list[T]:
        """Remove and return what happens at ``time``, which is no later than `next_time`."""
        if self._times and self._times[0] == time:
            heappop(self._times)
            return self._at.pop(time)
        return []
