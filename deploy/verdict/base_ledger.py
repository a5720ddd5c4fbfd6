"""What the ledgers of graphs and of grids have in common: one pass over a trace, event by event.

Memory is bounded by the place and the team, not by the length of the run.

Both kinds of place are given as tables of *darts*. A dart is an exit of a place, by its number among
all exits of all places. The tables say where it leads, and the entry there.

What a robot cannot do (`BaseLedger.violations`): be where it has not walked to, take a port that is
not there, arrive before or after its time, act out of turn, or act after it stopped or was lost. Nor
does a device fail but when the scenario has it fail (`BaseLedger.tag_faults`).

A robot that asked to move has moved if and only if its next event is where the dart leads. It arrived
at the time of that event: arrivals act in the instant in which they arrive, and that holds for a robot
lost in that instant, too. A robot lost on its way (no place) has not arrived. Starts are visited at
time 0 by the lowest robot there.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from math import inf
from typing import ClassVar, Protocol

from msgspec import Struct

from protocol.faults import TAG_WORDS, Fault
from protocol.messages import Move, Stop, Wait, WaitForNews
from protocol.scenario import Scenario
from protocol.trace import DEVICE_FAULTS, NOBODY, Event

ROUNDING = 1e-12
"""Relative slack for a move with jitter: the bounds of the jitter are rounded, like its draws."""

PlaceName = str | tuple[int, int]
"""What people call a place: the name of a vertex, or row and column of a sub-cell."""


class Durations(Protocol):
    """How long each dart takes."""

    def __getitem__(self, dart: int, /) -> float:
        """Return the duration of a move along ``dart``."""
        ...


class Loss(Struct, frozen=True, gc=False):
    """How a robot was lost.

    Attributes:
        time: virtual time.
        cause: ``"killed"``, ``"refused"`` or ``"failed"``.
        place: where its body stands; ``None`` if it was lost on its way.
        dart: the dart it was on; ``None`` if it stood somewhere.
    """

    time: float
    cause: str
    place: int | None
    dart: int | None


class Track:
    """What a ledger knows about one robot.

    Attributes:
        start: its start place.
        moves: moves that it made; one that is under way is not made yet.
        requests: its requests that were applied.
        returned_at: when it last arrived at its start; 0 if it never did.
        stopped_at: when it stopped, or ``None``.
        loss: how it was lost, or ``None``.
        uses: on graphs, how often it crossed each dart.
    """

    __slots__ = (
        "dart",
        "durations",
        "earliest",
        "entry",
        "latest",
        "loss",
        "moves",
        "place",
        "requests",
        "returned_at",
        "start",
        "stopped_at",
        "turn",
        "uses",
    )

    def __init__(self, start: int, durations: Durations) -> None:
        self.start = start
        self.moves = 0
        self.requests = 0
        self.returned_at = 0.0
        self.stopped_at: float | None = None
        self.loss: Loss | None = None
        self.uses: dict[int, int] = {}
        # Where and when its next event must be; the dart that it is on, or -1; its last round.
        self.place = start
        self.entry: int | None = None
        self.earliest = 0.0
        self.latest = 0.0
        self.dart = -1
        self.turn = 0
        self.durations = durations

    @property
    def alive(self) -> bool:
        """Whether it has neither stopped nor been lost."""
        return self.stopped_at is None and self.loss is None


class BaseLedger(ABC):
    """Counts what a trace tells.

    Attributes:
        unit, units: what a place is called, one and many.
        starts: start place of each robot.
        robots: what is known about each robot.
        first_visits: for each visited place the robot that came first, and when.
        coverage_time: time of the last first visit.
        device_bytes_max: size of the largest tag that was written.
        messages: number of radio messages that were sent.
        message_bytes: their sizes, added up.
        tag_faults: each failure of a device: when, at which place, and what became of it.
        checksums: whether devices notice that their tag was corrupted.
        last_time: time of the last event.
        violations: number of things that cannot be.
        first_violation: the first of them, in words.
    """

    __slots__ = (
        "_back",
        "_capacity",
        "_far",
        "_first_dart",
        "_jitter_high",
        "_jitter_low",
        "_last",
        "_may_be",
        "_round",
        "_scheduled",
        "_taken_for",
        "_team",
        "_turn",
        "_wave",
        "checksums",
        "coverage_time",
        "device_bytes_max",
        "first_violation",
        "first_visits",
        "last_time",
        "message_bytes",
        "messages",
        "robots",
        "starts",
        "tag_faults",
        "violations",
    )

    unit: ClassVar[str]
    units: ClassVar[str]

    def __init__(
        self,
        starts: Sequence[int],
        scenario: Scenario | None,
        *,
        first_dart: Sequence[int],
        far: Sequence[int],
        back: Sequence[int],
        durations: Sequence[Durations],
    ) -> None:
        """Open the ledger.

        Args:
            starts: start place of each robot.
            scenario: what is played; ``None``: the duration of moves, the size of tags and the
                failures of devices are not checked.
            first_dart: the first dart of each place, and one number more.
            far: where each dart leads.
            back: by which port one arrives there.
            durations: for each robot how long each dart takes it, without jitter.
        """
        self.starts = tuple(starts)
        self._team = len(self.starts)
        self._first_dart = first_dart
        self._far = far
        self._back = back
        self._capacity = inf if scenario is None else scenario.device.capacity
        self._jitter_low, self._jitter_high = _jitter(scenario)
        self.robots = list(map(Track, self.starts, durations))
        self.first_visits: dict[int, tuple[int, float]] = {}
        for robot, start in enumerate(self.starts):
            self.first_visits.setdefault(start, (robot, 0.0))
        self.coverage_time = 0.0
        self.device_bytes_max = 0
        self.messages = 0
        self.message_bytes = 0
        self.tag_faults: list[tuple[float, int, str]] = []
        self.checksums = scenario is None or scenario.device.checksum
        # Which scheduled failure each one may be, and which it is taken for, by their numbers.
        self._scheduled: list[Fault] | None = None
        if scenario is not None:
            self._scheduled = [fault for fault in scenario.faults if fault.word in TAG_WORDS]
        self._may_be: list[list[int]] = []
        self._taken_for: dict[int, int] = {}
        self.violations = 0
        self.first_violation: str | None = None
        # The wave of the last event, and the last robot in it that made a request.
        self.last_time = 0.0
        self._round = -2
        self._wave = -1
        self._last = -1
        self._turn = 0  # counts the rounds of all instants

    # What a graph and a grid do each in their own way.

    @abstractmethod
    def name(self, place: int) -> PlaceName:
        """Return what people call a place."""

    @abstractmethod
    def _cross(self, robot: int, track: Track, dart: int, time: float) -> None:
        """Book an arrival by ``dart`` at the place of ``track``."""

    def _diverted(self, track: Track, place: int, entry: int | None) -> bool:  # noqa: ARG002
        """Tell whether a robot that is on its way may end up somewhere else; if so, it is there."""
        return False

    # One pass. Called for each step of a run, hence one long function.

    def observe(self, event: Event) -> None:
        """Take in the next event of the trace."""
        time = event.time
        robot = event.robot
        what = event.what
        if event.wave != self._wave or time != self.last_time or event.round != self._round:
            self._open_wave(event, time)
        if robot == NOBODY and type(what) is str:
            self._fail_device(event)
            return
        if not 0 <= robot < self._team:
            self._violation(event, f"there are robots 0 to {self._team - 1}")
            return
        track = self.robots[robot]
        if type(what) is str:
            self._lose(event, track, what)
            return
        place = event.place
        if (
            not track.earliest <= time <= track.latest
            or place != track.place
            or event.entry != track.entry
            or robot <= self._last
            or track.turn == self._turn
        ) and not self._mend(event, track):
            return
        assert place is not None
        assert not isinstance(what, str)
        self._last = robot
        track.turn = self._turn
        track.requests += 1

        dart = track.dart
        if dart >= 0:
            track.dart = -1
            self._cross(robot, track, dart, time)

        if (tag := what.tag) is not None and len(tag) > self.device_bytes_max:
            self._grow(event, len(tag))
        if what.messages:
            self._count(what.messages)

        if type(what) is Move:
            exit_ = what.exit
            dart = self._first_dart[place] + exit_
            if exit_ < 0 or dart >= self._first_dart[place + 1]:
                ports = self._first_dart[place + 1] - self._first_dart[place]
                self._violation(event, f"there are ports 0 to {ports - 1}")
                track.earliest = track.latest = time
                return
            track.dart = dart
            track.place, track.entry = self._far[dart], self._back[dart]
            duration = track.durations[dart]
            track.earliest = time + duration * self._jitter_low
            track.latest = time + duration * self._jitter_high
        elif type(what) is Wait:
            track.earliest = track.latest = time + what.duration
        elif type(what) is WaitForNews:
            track.earliest = time
            track.latest = inf if what.at_most is None else time + what.at_most
        elif type(what) is Stop:
            track.latest = -inf
            track.stopped_at = time
        else:
            track.earliest = track.latest = time

    def _count(self, messages: Sequence[bytes]) -> None:
        self.messages += len(messages)
        self.message_bytes += sum(map(len, messages))

    def _open_wave(self, event: Event, time: float) -> None:
        """Go to the wave of ``event``, which must not be an earlier one."""
        before = self.last_time
        round_, wave = event.round, event.wave
        if time > before or (time == before and round_ > self._round):
            self._turn += 1
        elif not (time == before and round_ == self._round and wave > self._wave):
            self._violation(event, "comes after a later event")
            self._turn += 1
        self.last_time = time
        self._round = round_
        self._wave = wave
        self._last = -1

    def _lose(self, event: Event, track: Track, cause: str) -> None:
        time, place = event.time, event.place
        if not track.alive:
            self._violation(event, "it was out of the run already")
            return
        if self._last >= 0 and cause != "refused":
            self._violation(event, "losses come before the requests of their wave")
        if time > track.latest:
            self._violation(event, f"expected by t={track.latest:g}")
        dart: int | None = None
        if place is None:
            if track.dart < 0:
                self._violation(event, "it was not on its way")
                place = track.place
            else:
                dart = track.dart
        elif (place, event.entry) != (track.place, track.entry) and not self._diverted(
            track, place, event.entry
        ):
            self._violation(event, self._expected(track))
        elif track.dart >= 0:
            if time < track.earliest:
                self._violation(event, f"expected from t={track.earliest:g}")
            self._cross(event.robot, track, track.dart, time)
        track.dart = -1
        track.latest = -inf
        track.loss = Loss(time, cause, place, dart)

    def _fail_device(self, event: Event) -> None:
        place, what = event.place, event.what
        if place is None or not 0 <= place < len(self._first_dart) - 1:
            self._violation(event, "there is no such device")
            return
        self.tag_faults.append((event.time, place, str(what)))
        if self._last >= 0:
            self._violation(event, "devices fail before the requests of their wave")
        if self._scheduled is None:
            return
        faults = enumerate(self._scheduled)
        self._may_be.append([index for index, fault in faults if self._is_due(fault, event)])
        if not self._take(len(self._may_be) - 1, set()):
            self._may_be.pop()
            self._violation(event, "the scenario has no such fault")

    def _take(self, number: int, seen: set[int]) -> bool:
        """Take failure ``number`` for a scheduled one of its own; others may have to be another."""
        for index in self._may_be[number]:
            if index not in seen:
                seen.add(index)
                other = self._taken_for.get(index)
                if other is None or self._take(other, seen):
                    self._taken_for[index] = number
                    return True
        return False

    def _is_due(self, fault: Fault, event: Event) -> bool:
        """Tell whether a scheduled fault strikes as ``event`` has it.

        A fault of a round that its instant does not have strikes after the last one.
        """
        if fault.place != event.place or DEVICE_FAULTS[fault.word] != event.what:
            return False
        if fault.trigger is None:
            return fault.at == event.time and event.wave == -1 and event.round <= fault.round
        robot, number = fault.trigger
        track = self.robots[robot]
        early = track.alive and event.time < track.earliest
        return track.requests + 1 == number and event.wave >= 0 and not early

    # What cannot be.

    def _mend(self, event: Event, track: Track) -> bool:
        """Say what is wrong with a request, and tell whether it can be counted all the same."""
        time, place, entry = event.time, event.place, event.entry
        if not track.alive:
            self._violation(event, "it is out of the run")
            return False
        if place is None or not 0 <= place < len(self._first_dart) - 1:
            self._violation(event, self._expected(track))
            return False
        if (place, entry) != (track.place, track.entry) and not self._diverted(track, place, entry):
            self._violation(event, self._expected(track))
            track.place, track.entry, track.dart = place, entry, -1
        elif not track.earliest <= time <= track.latest:
            expected = f"t={track.earliest:g}"
            if track.latest != track.earliest:
                expected += f" to {track.latest:g}"
            self._violation(event, f"expected {expected}")
        elif track.turn == self._turn:
            self._violation(event, "it acts twice in a round")
        elif event.robot <= self._last:
            self._violation(event, f"it acts after robot {self._last} of the same wave")
        return True

    def _expected(self, track: Track) -> str:
        return f"expected at {in_words(self.name(track.place))}, entry {track.entry}"

    def _grow(self, event: Event, size: int) -> None:
        self.device_bytes_max = size
        if size > self._capacity:
            self._violation(event, f"a tag of {size} bytes; the device holds {self._capacity}")

    def _violation(self, event: Event, detail: str) -> None:
        self.violations += 1
        if self.first_violation is None:
            self.first_violation = f"{event}: {detail}"

    # What the trace tells, so far.

    @property
    def alive(self) -> list[int]:
        """The robots that have neither stopped nor been lost."""
        return [robot for robot, track in enumerate(self.robots) if track.alive]

    @property
    def survivors(self) -> list[int]:
        """The robots that were not lost."""
        return [robot for robot, track in enumerate(self.robots) if track.loss is None]

    @property
    def losses(self) -> dict[int, Loss]:
        """How each lost robot was lost."""
        tracks = enumerate(self.robots)
        return {robot: track.loss for robot, track in tracks if track.loss is not None}

    @property
    def steps(self) -> int:
        """Moves made, all robots."""
        return sum(track.moves for track in self.robots)

    @property
    def events(self) -> int:
        """Requests that were applied, losses, and failures of devices."""
        lost = sum(track.loss is not None for track in self.robots)
        return sum(track.requests for track in self.robots) + lost + len(self.tag_faults)

    @property
    def wrong_tags(self) -> bool:
        """Whether a tag was corrupted and its device did not notice."""
        return not self.checksums and any(what == "corrupted" for _, _, what in self.tag_faults)

    @property
    def makespan(self) -> float | None:
        """When the last live robot stopped.

        ``None`` while a robot is alive, so also for a run that stalled. Where all robots were lost
        the run ended with the last of them.
        """
        if self.alive:
            return None
        stops = [track.stopped_at for track in self.robots if track.stopped_at is not None]
        return max(stops) if stops else self.last_time

    def place(self, robot: int) -> int | None:
        """Return where ``robot`` stands; ``None`` if it is, or was lost, on its way."""
        track = self.robots[robot]
        if track.loss is not None:
            return track.loss.place
        return track.place if track.dart < 0 else None


def in_words(name: PlaceName) -> str:
    """Return what people call a place as text."""
    return name if isinstance(name, str) else str(list(name))


def speeds_of(scenario: Scenario | None, team: int) -> tuple[float | None, ...]:
    """Return the speed of each robot; ``None`` where every move takes one tick."""
    if scenario is None or scenario.clock.mode == "lockstep":
        return (None,) * team
    speed = scenario.team.speed
    return speed if isinstance(speed, tuple) else (speed,) * team


def _jitter(scenario: Scenario | None) -> tuple[float, float]:
    """Return the least and the greatest factor of a duration."""
    jitter = "exponential" if scenario is None else scenario.clock.jitter
    if isinstance(jitter, str):
        return 0.0, inf
    if jitter == 0:
        return 1.0, 1.0
    return (1.0 - jitter) * (1 - ROUNDING), (1.0 + jitter) * (1 + ROUNDING)
