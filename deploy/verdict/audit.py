"""The audit: what a run left in its folder, held against its trace by code that is none of the run's.

Three witnesses tell of a run by processes: the journal of the world server, the memories of robots
that come back, and the store. The trace is replayed from the journal, so a reader that errs, or a
world that forgets, could take its own mistake for the truth. Hence the audit parses each file by
itself (frames by hand, msgpack into plain values, the store with plain SQL) and follows the trace with
a model of its own of places, moves and tags. What it takes to be right:

- *Journal and trace.* The entries of a wave record belong to its robots, in order. Each that is not
  blank is in the trace once: as a request that was applied, or as the loss of a robot whose request was
  refused. A blank belongs to one of the record's losses; each loss is in the trace, unless that robot
  was out of the run before. A kill by order has a record of its own. A loss by too many free requests
  (wave -1) has none: it follows from the waves before.
- *Journal and memory.* A robot keeps each sight before it asks for more. So it has as many as it made
  requests, or one less; one less if it stopped, which no sight answers.
- *Trace and store.* Each tag that a request brings counts one revision; a device that was destroyed
  takes none. A device that fails counts one, too, and is blank then; a corrupted tag that nothing
  checks differs in a few bits. What an earlier run left is what the journal says was read.

Two things are not wrong: a record cut short at the end of a file, which a crash explains; and lives of
the world that began behind the closing.
"""

import sqlite3
from array import array
from collections.abc import Iterator, Sequence
from contextlib import closing
from math import inf
from pathlib import Path
from struct import Struct as Layout
from typing import Any, Protocol
from zlib import crc32, decompress

import msgspec

from deploy.run_dir import RunDir
from deploy.verdict.guarantees import Guarantee
from protocol.errors import InputError, JournalError
from protocol.messages import AnyRequest, Exchange, Look, Move, Stop, Wait, WaitForNews, Write
from protocol.scenario import Scenario, from_tree
from protocol.trace import NOBODY, Event

SOURCE = "Canopy: an audit of the run's folder"

_JOURNAL_MAGIC = b"canopy journal 1\n"
_HEADER = Layout("<III")
_BLANK = msgspec.msgpack.encode(None)
_CORRUPT_BITS_MAX = 4
"""In so many bits at most a corrupted tag differs from the one that was written."""

_UNREADABLE = (
    OSError,
    InputError,
    JournalError,
    LookupError,
    TypeError,
    ValueError,
    StopIteration,
    msgspec.DecodeError,
)
"""What a record that is not as it should be may raise."""

_encode = msgspec.msgpack.Encoder().encode
_decode = msgspec.msgpack.decode
_decode_parts = msgspec.msgpack.Decoder(list[msgspec.Raw]).decode

Tag = tuple[int, bytes, int]
"""What a device holds: revision, tag, and in how many bits the tag may differ."""


class Audit:
    """An audit of one run by processes.

    Everything is looked at as far as it went when the audit began: a run that is not over goes on.
    """

    def __init__(self, run_dir: Path) -> None:
        """Open the folder of a run."""
        folder = RunDir(run_dir)
        self._whole = folder.logs.is_dir()  # else only the journal was copied here
        self._journal = _Journal(folder.journal)
        self._motion: _Motion | None = None
        self._memories: _Memories | None = None
        self._tags: _Tags | None = None
        opening = self._journal.opening
        if opening is not None:
            scenario = opening.scenario
            self._motion = _Motion(opening)
            if scenario.team.on_crash == "restart":
                self._memories = _Memories(folder, len(opening.starts))
            if scenario.device.capacity:
                self._tags = _Tags(scenario, folder)

    def observe(self, event: Event) -> None:
        """Take in the next event of the trace."""
        motion, tags, journal = self._motion, self._tags, self._journal
        if motion is None:
            return  # without an opening there is nothing to hold it against
        what = event.what
        if isinstance(what, str):
            if event.robot != NOBODY:
                journal.lost(event, what)
                motion.lost(event)
            elif tags is not None:
                tags.failed(event, what, journal)
            return
        journal.applied(event, what)
        motion.applied(event, what)
        if self._memories is not None:
            self._memories.applied(event, what)
        if what.tag is not None and tags is not None:
            tags.written(event, what.tag, journal)

    def report(self) -> list[Guarantee]:
        """Judge, once the trace has been seen whole."""
        journal = self._journal
        whole = journal.report()
        none_missing, store = "nothing acknowledged is missing", "the store holds the last tags"
        once = "no request applied twice, no robot in two places"
        if self._motion is None:
            why = "the journal has no opening that can be read"
            return [whole, *(_skipped(name, why) for name in (none_missing, once, store))]
        reports = [whole]
        if self._memories is None:
            reports.append(_skipped(none_missing, "robots that die do not come back in this run"))
        else:
            reports.append(self._memories.report(none_missing, journal, whole=self._whole))
        reports.append(self._motion.report(once))
        if self._tags is None:
            reports.append(_skipped(store, "there are no devices"))
        else:
            reports.append(self._tags.report(store, journal, whole=self._whole))
        return reports


class _Findings:
    """What is wrong with one guarantee: how much, and the first of it in words."""

    def __init__(self) -> None:
        self.count = 0
        self.first = ""

    def add(self, words: str) -> None:
        self.count += 1
        self.first = self.first or words

    def guarantee(self, name: str, detail: str) -> Guarantee:
        """Return the verdict; ``detail`` says what was looked at."""
        if self.count:
            others = f" (and {self.count - 1} more, which may follow from it)"
            detail = f"{self.first}{others if self.count > 1 else ''}; {detail}"
        return Guarantee(name, SOURCE, not self.count, detail)


def _skipped(name: str, why: str) -> Guarantee:
    return Guarantee(name, SOURCE, None, why)


def _bodies(path: Path, magic: bytes, end: int) -> Iterator[bytes]:
    """Yield the body of each whole record in the first ``end`` bytes of a file.

    Raises:
        JournalError: If a checksum is wrong.
    """
    with path.open("rb") as file:
        if file.read(len(magic)) != magic:
            raise JournalError(f"{path.name} does not begin as it should")
        offset = len(magic)
        while offset + _HEADER.size <= end:
            header = file.read(_HEADER.size)
            length, body_sum, header_sum = _HEADER.unpack(header)
            if crc32(header[:8]) != header_sum:
                raise JournalError(f"{path.name}, byte {offset}: a wrong sum of a record's header")
            if offset + _HEADER.size + length > end:
                return
            body = file.read(length)
            if crc32(body) != body_sum:
                raise JournalError(f"{path.name}, byte {offset}: a wrong sum of a record")
            offset += _HEADER.size + length
            yield body


# The journal.


class _Opening(msgspec.Struct, frozen=True):
    """What the first record of a journal says."""

    run: str
    scenario: Scenario
    ground: list[Any]
    starts: tuple[int, ...]


class _Journal:
    """The journal, read as far as the trace has come.

    Attributes:
        opening: what its first record says; ``None`` if that cannot be read.
        joined: for each robot that has joined, by which text.
        old_tags: what an earlier run left, as far as it was read: revision and tag by place.
        closed: how the run ended; ``None``: it did not.
        inputs: what the world was given so far, its beginning included; the store counts by this.
        inputs_before: what it was given up to the wave, or kill, that the last event belongs to.
    """

    def __init__(self, path: Path) -> None:
        self.opening: _Opening | None = None
        self.joined: dict[int, str] = {}
        self.old_tags: dict[int, tuple[int, bytes]] = {}
        self.closed: str | None = None
        self.inputs = 1
        self.inputs_before = 1
        self._wrong = _Findings()
        self._nonces: set[str] = set()
        self._carried_out: set[int] = set()
        self._out: set[int] = set()
        self._lives = self._waves = self._applied = self._refused = self._blank = self._kills = 0
        # The next wave or kill, unless it is still to be read; and whether there are no more.
        self._head: list[Any] | None = None
        self._ended = self._damaged = False
        # The wave of the last event: when it was, what it holds, what of that was in the trace.
        self._key: tuple[float, int, int] | None = None
        self._entries: list[bytes] = []
        self._at = 0
        self._losses: dict[int, str] = {}
        try:
            self._records = _bodies(path, _JOURNAL_MAGIC, path.stat().st_size)
            self._open()
        except _UNREADABLE as error:
            self._wrong.add(f"no opening: {str(error) or 'the journal is empty'}")
            self._ended = self._damaged = True

    def _open(self) -> None:
        kind, _, run, _, tree, ground, starts = _decode(next(self._records))
        if kind != "opening":
            raise ValueError(f"it begins with a record of kind {kind}")
        self.opening = _Opening(run, from_tree(tree, "the journal"), ground, tuple(starts))

    # What the trace tells.

    def applied(self, event: Event, request: AnyRequest) -> None:
        """Find a request in the wave of the event."""
        if (event.time, event.round, event.wave) != self._key and not self._turn_to(event):
            return
        entries, at = self._entries, self._at
        while at < len(entries) and entries[at] == _BLANK:
            at += 1
        self._at = at + 1
        self._applied += 1
        if at >= len(entries):
            self._wrong.add(f"{event}: not in wave {self._waves} of the journal")
        elif entries[at] != _encode(request) and _decode(entries[at]) != _decode(_encode(request)):
            found = _decode(entries[at])
            self._wrong.add(f"{event}: wave {self._waves} of the journal has {found} there")
        if event.robot not in self.joined:
            self._wrong.add(f"{event}: nobody had joined as that robot")
        if request.__class__ is Stop:
            self._out.add(event.robot)

    def lost(self, event: Event, cause: str) -> None:
        """Find a loss in the journal."""
        robot, key = event.robot, (event.time, event.round, event.wave)
        self._out.add(robot)
        if cause == "refused":
            self._refuse(event)
            return
        if key != self._key or robot not in self._losses:
            head = self._peek()
            if head is None:
                self._beyond(event)
                return
            if head[0] == "carried_out":
                self._take()
                self._kills += 1
                if cause != "killed" or head[1] != robot:
                    self._wrong.add(f"{event}: the journal has robot {head[1]} killed there")
                return
            if not self._turn_to(event):
                return
        if self._losses.pop(robot, None) != cause:
            self._wrong.add(f"{event}: not among the losses of wave {self._waves} of the journal")

    def _refuse(self, event: Event) -> None:
        """Find the request for which a robot was refused; too many requests follow from others."""
        self._refused += 1
        if event.wave < 0:
            return
        if (event.time, event.round, event.wave) != self._key and not self._turn_to(event):
            return
        entries = self._entries
        while self._at < len(entries) and entries[self._at] == _BLANK:
            self._at += 1
        if self._at >= len(entries):
            self._wrong.add(f"{event}: no request of it in wave {self._waves} of the journal")
        self._at += 1

    def span(self) -> tuple[int, int]:
        """Return how much the world had been given when a device failed: at least, at most.

        Orders of other faults at the same moment may have come before or after.
        """
        self._peek()
        return self.inputs_before, self.inputs

    # What the journal tells.

    def _turn_to(self, event: Event) -> bool:
        """Take up the wave that an event begins; tell whether there is one."""
        self._finish_wave()
        while (head := self._peek()) is not None and head[0] == "carried_out":
            self._wrong.add(f"{event}: the journal has robot {head[1]} killed before that")
            self._take()
        if head is None:
            self._key = None
            self._beyond(event)
            return False
        self._take()
        self._key = (event.time, event.round, event.wave)
        self._waves += 1
        self._entries, self._at, self._losses = head[1], 0, head[2]
        blank = self._entries.count(_BLANK)
        self._blank += blank
        if blank > len(self._losses):
            self._wrong.add(
                f"wave {self._waves}: {blank} robots without a request, {len(self._losses)} lost"
            )
        return True

    def _beyond(self, event: Event) -> None:
        """Meet an event for which there is no record; a run that goes on may be further by now."""
        if self.closed is not None:
            self._wrong.add(f"{event}: the journal ends before that")

    def _finish_wave(self) -> None:
        """Check that nothing is left of the wave."""
        left = [entry for entry in self._entries[self._at :] if entry != _BLANK]
        if left:
            self._wrong.add(f"wave {self._waves}: {_decode(left[0])} is not in the trace")
        self._wrong_losses()
        self._entries, self._at, self._losses = [], 0, {}

    def _wrong_losses(self) -> None:
        for robot, cause in self._losses.items():
            if robot not in self._out:
                self._wrong.add(f"wave {self._waves}: robot {robot} {cause}, but not in the trace")

    def _take(self) -> None:
        """Have done with the next wave or kill."""
        self._head = None
        self.inputs += 1
        self.inputs_before = self.inputs

    def _peek(self) -> list[Any] | None:
        """Return the next wave or kill, and take in all that stands before it."""
        while self._head is None and not self._ended:
            try:
                body = next(self._records, None)
                if body is None:
                    self._ended = True
                else:
                    self._head = self._read(body)
            except _UNREADABLE as error:
                self._wrong.add(str(error))
                self._ended = self._damaged = True
        return self._head

    def _read(self, body: bytes) -> list[Any] | None:
        """Take a record in; return it if it is a wave, or the kill of a robot."""
        parts = _decode_parts(body)
        kind = _decode(parts[0])
        if self.closed is not None and kind != "incarnation":
            self._wrong.add(f"a record of kind {kind} behind the closing")
        match kind:
            case "wave":
                entries = list(map(bytes, _decode_parts(parts[1])))
                return ["wave", entries, dict(_decode(parts[2]))]
            case "incarnation":
                self._lives += 1
                number = _decode(parts[1])
                if number != self._lives:
                    self._wrong.add(f"life {self._lives} of the world is numbered {number}")
            case "joined":
                self._join(*map(_decode, parts[1:]))
            case "old_tags":
                self.inputs += 1
                for place, revision, tag in (old[-3:] for old in _decode(parts[1])):
                    self.old_tags[place] = revision, tag
            case "carried_out":
                return self._carry_out(_decode(parts[1]))
            case "closing":
                self.closed = _decode(parts[1])
            case _:
                self._wrong.add(f"a record of kind {kind} in the midst")
        return None

    def _join(self, robot: int, process: str, nonce: str) -> None:
        assert self.opening is not None
        if robot in self.joined:
            self._wrong.add(f"robot {robot} joined twice")
        if not 0 <= robot < len(self.opening.starts):
            self._wrong.add(f"robot {robot} joined; there is none")
        if not nonce or nonce in self._nonces:
            self._wrong.add(f"robot {robot} joined under a nonce that is not its own")
        self._nonces.add(nonce)
        self.joined[robot] = process

    def _carry_out(self, fault: int) -> list[Any] | None:
        """Take in that an order was carried out; return it if it was the kill of a robot."""
        assert self.opening is not None
        scenario = self.opening.scenario
        if fault in self._carried_out or not 0 <= fault < len(scenario.faults):
            self._wrong.add(f"fault {fault} was carried out twice, or is none")
        else:
            self._carried_out.add(fault)
            robot = scenario.faults[fault].robot
            if robot is not None and scenario.team.on_crash == "lost":
                return ["carried_out", robot]
        self.inputs += 1
        return None

    def report(self) -> Guarantee:
        """Judge the journal, once the trace has been seen whole."""
        self._finish_wave()
        left = 0
        while self._peek() is not None:
            left += 1
            self._take()
        if left:
            self._wrong.add(f"{left} waves or kills at the end are not in the trace")
        if not self._damaged and self.opening is not None:
            alive = len(self.opening.starts) - len(self._out)
            if (self.closed == "over" and alive) or (self.closed == "stalled" and not alive):
                self._wrong.add(f"closed as {self.closed} with {alive} robots alive")
        end = "not closed" if self.closed is None else f"closed as {self.closed}"
        return self._wrong.guarantee(
            "the journal is whole",
            f"{end}; {self._lives} lives, {len(self.joined)} joins, {self._waves} waves with "
            f"{self._applied} requests of the trace; besides, as is allowed: {self._refused} refused, "
            f"{self._blank} of robots that were lost meanwhile, {self._kills} kills by order",
        )


# The memories of robots.


class _Memories:
    """What robots remember, held against the sights of the trace."""

    def __init__(self, folder: RunDir, robots: int) -> None:
        self._paths = [folder.memory(robot) for robot in range(robots)]
        # A run that is not over writes on: what counts is what was there before its trace was read.
        self._sizes = [path.stat().st_size if path.exists() else None for path in self._paths]
        self._digests = [array("I") for _ in range(robots)]
        self._stopped: set[int] = set()

    def applied(self, event: Event, request: AnyRequest) -> None:
        """Take in the digest of the sight that a request answers."""
        if 0 <= event.robot < len(self._digests):
            self._digests[event.robot].append(event.digest)
            if request.__class__ is Stop:
                self._stopped.add(event.robot)

    def report(self, name: str, journal: _Journal, *, whole: bool) -> Guarantee:
        """Judge, once the trace has been seen whole."""
        if not whole and not any(path.exists() for path in self._paths):
            return _skipped(name, "only the journal is here, without the memories of the robots")
        wrong, replies = _Findings(), 0
        for robot in range(len(self._paths)):
            replies += self._check(robot, journal, wrong)
        robots = len(journal.joined)
        return wrong.guarantee(name, f"{replies} replies kept by {robots} robots that joined")

    def _check(self, robot: int, journal: _Journal, wrong: _Findings) -> int:
        """Check one memory; return how many replies it holds."""
        size, process = self._sizes[robot], journal.joined.get(robot)
        path, digests = self._paths[robot], self._digests[robot]
        if size is None:
            if process is not None and journal.closed is not None:
                wrong.add(f"robot {robot} joined, and has no memory")
            return 0
        replies = -1  # the text by which it joined comes first
        try:
            for replies, body in enumerate(_bodies(path, b"", size)):
                if not replies:
                    if process is not None and body != process.encode():
                        wrong.add(f"{path.name}: joined as {process}, remembers {body!r}")
                elif replies < len(digests) and crc32(body) != digests[replies]:
                    wrong.add(
                        f"{path.name}: reply {replies} is {crc32(body):08x}, the trace has "
                        f"{digests[replies]:08x}"
                    )
        except (OSError, JournalError) as error:
            wrong.add(str(error))
            return max(replies, 0)
        if replies < 0 and process is not None and journal.closed is not None:
            wrong.add(f"{path.name}: joined as {process}, remembers nothing")
        replies = max(replies, 0)
        requests = len(digests)
        at_most = requests - 1 if robot in self._stopped else requests
        if replies > at_most or (replies < requests - 1 and journal.closed is not None):
            end = ", the last a stop" if robot in self._stopped else ""
            wrong.add(f"{path.name}: {replies} replies to {requests} requests{end}")
        return replies


# Places and moves.


class _Ground(Protocol):
    """Where one gets to."""

    def __len__(self) -> int:
        """Return the number of places."""
        ...

    def leads(self, left: int, exit_: int, place: int, entry: int | None) -> bool:
        """Tell whether who leaves ``left`` by ``exit_`` may arrive at ``place`` by ``entry``."""
        ...


class _Graph:
    """A port graph: ports are numbered by incident edge in the order of the edges."""

    def __init__(self, names: Sequence[str], ends: Sequence[tuple[int, int]]) -> None:
        self._ways: list[list[tuple[int, int]]] = [[] for _ in names]
        for u, v in ends:
            port_u = len(self._ways[u])
            self._ways[u].append((v, len(self._ways[v]) + (u == v)))
            self._ways[v].append((u, port_u))

    def __len__(self) -> int:
        return len(self._ways)

    def leads(self, left: int, exit_: int, place: int, entry: int | None) -> bool:
        ways = self._ways[left]
        return 0 <= exit_ < len(ways) and ways[exit_] == (place, entry)


class _Grid:
    """A grid with a border behind its last column and row.

    Whoever goes against a blocked cell comes back by the exit that it took, and so does, where bodies
    block each other, who goes against one; where motion drifts one may end in any free cell.
    """

    def __init__(self, rows: int, cols: int, blocked: bytes, scenario: Scenario) -> None:
        self._rows, self._cols, self._blocked = rows, cols, blocked
        self._bumps = scenario.world.bodies == "block"
        self._drifts = scenario.sensing.drift > 0

    def __len__(self) -> int:
        return (self._rows + 1) * (self._cols + 1)

    def leads(self, left: int, exit_: int, place: int, entry: int | None) -> bool:
        if not 0 <= exit_ < 4:
            return False
        row, col = divmod(left, self._cols + 1)
        down, right = ((-1, 0), (0, 1), (1, 0), (0, -1))[exit_]
        free = self._is_free(row + down, col + right)
        if not free or (self._bumps and entry == exit_):
            return (place, entry) == (left, exit_)
        to = (row + down) * (self._cols + 1) + col + right
        arrived = place == to or (self._drifts and self._is_free(*divmod(place, self._cols + 1)))
        return arrived and entry == (exit_ + 2) % 4

    def _is_free(self, row: int, col: int) -> bool:
        inside = 0 <= row < self._rows and 0 <= col < self._cols
        return inside and not self._blocked[row * self._cols + col]


def _ground_of(opening: _Opening) -> _Ground:
    kind, *fields = opening.ground
    if kind == "graph":
        return _Graph(fields[0], fields[1])
    return _Grid(fields[0], fields[1], decompress(fields[3]), opening.scenario)


class _Robot:
    """Where a robot is, as its requests tell.

    Attributes:
        place, entry: where it made its last request, and by which port it had come there.
        exit: by which port it left then; -1: it stayed.
        time, round: when that was.
        earliest, latest: when its next request may be.
        out: why it can make no more; empty while it can.
    """

    __slots__ = ("earliest", "entry", "exit", "latest", "out", "place", "round", "time")

    def __init__(self, place: int) -> None:
        self.place = place
        self.entry: int | None = None
        self.exit = -1
        self.time, self.round = 0.0, -2
        self.earliest = self.latest = 0.0
        self.out = ""


class _Motion:
    """Follows each robot through the trace."""

    def __init__(self, opening: _Opening) -> None:
        self._ground = _ground_of(opening)
        self._tick = opening.scenario.clock.mode == "lockstep"
        self._robots = list(map(_Robot, opening.starts))
        self._time = 0.0
        self._requests = 0
        self._wrong = _Findings()

    def applied(self, event: Event, request: AnyRequest) -> None:
        """Let a robot make a request."""
        robot = self._robot(event)
        if robot is None:
            return
        time, place = event.time, event.place
        self._requests += 1
        if (time, event.round) <= (robot.time, robot.round):
            self._wrong.add(f"{event}: it acted at t={robot.time:g} in round {robot.round} already")
        elif not robot.earliest <= time <= robot.latest:
            expected = f"t={robot.earliest:g} to {robot.latest:g}"
            self._wrong.add(f"{event}: expected at {expected}")
        if place is None or not self._arrives(robot, place, event.entry):
            self._wrong.add(f"{event}: {_whereabouts(robot)}")
            if place is None or not 0 <= place < len(self._ground):
                return
        robot.place, robot.entry = place, event.entry
        robot.time, robot.round, robot.exit = time, event.round, -1
        robot.earliest = robot.latest = time
        match request:
            case Move(exit=exit_):
                robot.exit = exit_
                robot.latest = inf
                if self._tick:
                    robot.earliest = robot.latest = time + 1.0
            case Wait(duration=duration):
                robot.earliest = robot.latest = time + duration
            case WaitForNews(at_most=at_most):
                robot.latest = inf if at_most is None else time + at_most
            case Stop():
                robot.out = "it had stopped"
            case Look() | Write() | Exchange():
                pass  # these take no time

    def lost(self, event: Event) -> None:
        """Let a robot be lost; on its way it has no place."""
        robot = self._robot(event)
        if robot is None:
            return
        if event.time < robot.time:
            self._wrong.add(f"{event}: it acted at t={robot.time:g} already")
        on_its_way = event.place is None and robot.exit >= 0
        if not on_its_way and (
            event.place is None or not self._arrives(robot, event.place, event.entry)
        ):
            self._wrong.add(f"{event}: {_whereabouts(robot)}")
        robot.out = "it had been lost"

    def _robot(self, event: Event) -> _Robot | None:
        """Return the robot of an event, if it can act at all."""
        if event.time < self._time:
            self._wrong.add(f"{event}: comes after t={self._time:g}")
        self._time = event.time
        if not 0 <= event.robot < len(self._robots):
            self._wrong.add(f"{event}: there is no such robot")
            return None
        robot = self._robots[event.robot]
        if robot.out:
            self._wrong.add(f"{event}: {robot.out}")
            return None
        return robot

    def _arrives(self, robot: _Robot, place: int, entry: int | None) -> bool:
        """Tell whether a robot can be at a place by now."""
        if robot.exit < 0:
            return place == robot.place and entry == robot.entry
        return self._ground.leads(robot.place, robot.exit, place, entry)

    def report(self, name: str) -> Guarantee:
        """Judge, once the trace has been seen whole."""
        return self._wrong.guarantee(
            name, f"{self._requests} requests of {len(self._robots)} robots follow each other"
        )


def _whereabouts(robot: _Robot) -> str:
    if robot.exit < 0:
        return f"it stood at {robot.place}, entry {robot.entry}"
    return f"it had left {robot.place} by exit {robot.exit}, which does not lead there"


# Tags.


class _Tags:
    """The tag of each place that was written, as the trace tells."""

    def __init__(self, scenario: Scenario, folder: RunDir) -> None:
        named = scenario.bookkeeping.database
        self._path = folder.database if named is None else Path(named)
        self._elsewhere = named is not None
        self._fresh = scenario.bookkeeping.fresh
        self._checked = scenario.device.checksum
        self._tags: dict[int, Tag] = {}
        self._destroyed: set[int] = set()
        self._writes = 0
        self._last = (0, 0)  # number of the input that brought the last write: at least, at most

    def written(self, event: Event, tag: bytes, journal: _Journal) -> None:
        """Let a request write a tag."""
        place = event.place
        if place is None or place in self._destroyed:
            return
        self._write(place, (self._at(place, journal)[0] + 1, tag, 0))
        self._last = (journal.inputs_before, journal.inputs_before)

    def failed(self, event: Event, what: str, journal: _Journal) -> None:
        """Let a device fail."""
        place = event.place
        if place is None or place in self._destroyed:
            return
        self._last = journal.span()  # has read the old tag, too
        revision, tag, bits = self._at(place, journal)
        if what == "corrupted" and not self._checked:
            self._write(place, (revision + 1, tag, bits + _CORRUPT_BITS_MAX))
        else:
            self._write(place, (revision + 1, b"", 0))
        if what == "destroyed":
            self._destroyed.add(place)

    def _write(self, place: int, tag: Tag) -> None:
        self._tags[place] = tag
        self._writes += 1

    def _at(self, place: int, journal: _Journal) -> Tag:
        found = self._tags.get(place)
        return (*journal.old_tags.get(place, (0, b"")), 0) if found is None else found

    def report(self, name: str, journal: _Journal, *, whole: bool) -> Guarantee:
        """Judge, once the trace has been seen whole."""
        if journal.closed is None:
            return _skipped(name, "the run is not over, and the store may be behind")
        wrong = _Findings()
        if not self._path.exists():
            if self._elsewhere or not whole:
                return _skipped(name, f"{self._path} is not here any more")
            wrong.add(f"{self._path.name} is gone from the run's folder")
            return wrong.guarantee(name, f"{len(self._tags)} tags expected")
        assert journal.opening is not None
        try:
            with closing(self._open()) as database:
                (row,) = database.execute("SELECT name, wave FROM run").fetchall()
                found = database.execute("SELECT place, revision, tag FROM tag").fetchall()
        except (sqlite3.Error, ValueError) as error:
            if getattr(error, "sqlite_errorname", "").startswith("SQLITE_BUSY"):
                return _skipped(name, f"{self._path} is in use")
            wrong.add(f"{self._path.name} cannot be read: {error}")
            return wrong.guarantee(name, f"{len(self._tags)} tags expected")
        run, wave = row
        if run != journal.opening.run:
            if self._elsewhere:
                return _skipped(name, f"{self._path} holds the tags of another run by now: {run}")
            wrong.add(f"it is of run {run}")
        at_least, at_most = self._last
        if not at_least <= wave <= at_most:
            numbers = f"{at_least}" if at_least == at_most else f"{at_least} to {at_most}"
            wrong.add(f"it is at wave {wave}, and the last write was in wave {numbers}")
        self._compare({place: (revision, tag) for place, revision, tag in found}, journal, wrong)
        return wrong.guarantee(
            name,
            f"{len(self._tags)} places written, {self._writes} writes, the last in wave {wave}",
        )

    def _open(self) -> sqlite3.Connection:
        """Open the store, to be read only.

        Without a log the file is all there is, and SQLite is told to put nothing beside it.
        """
        log = Path(f"{self._path}-wal")
        mode = "mode=ro" if log.exists() and log.stat().st_size else "mode=ro&immutable=1"
        return sqlite3.connect(f"{self._path.absolute().as_uri()}?{mode}", uri=True, timeout=0)

    def _compare(
        self, found: dict[int, tuple[Any, Any]], journal: _Journal, wrong: _Findings
    ) -> None:
        """Compare the tags in the store with those of the trace, and of an earlier run."""
        expected = {place: (*old, 0) for place, old in journal.old_tags.items()} | self._tags
        for place, (revision, tag, bits) in sorted(expected.items()):
            if place not in found:
                wrong.add(f"place {place}: no tag, expected revision {revision}")
                continue
            stored_revision, stored = found[place]
            if stored_revision != revision:
                wrong.add(f"place {place}: revision {stored_revision}, expected {revision}")
            elif not isinstance(stored, bytes) or not _alike(stored, tag, bits):
                wrong.add(f"place {place}: tag {stored!r}, expected {tag!r}")
        if self._fresh:
            for place in sorted(found.keys() - expected.keys()):
                wrong.add(f"place {place}: a tag that nobody wrote")


def _alike(tag: bytes, other: bytes, bits: int) -> bool:
    """Tell whether two tags differ in so many bits at most."""
    if len(tag) != len(other):
        return False
    differing = int.from_bytes(tag, "little") ^ int.from_bytes(other, "little")
    return differing.bit_count() <= bits
