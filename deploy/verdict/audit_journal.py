"""The audit of the journal and of the memories of robots: both against the trace, and each other."""

from array import array
from pathlib import Path
from typing import Any
from zlib import crc32

import msgspec

from deploy.run_dir import RunDir
from deploy.verdict.audit_findings import UNREADABLE, Findings, bodies, decode, encode, skipped
from deploy.verdict.guarantees import Guarantee
from protocol.errors import JournalError
from protocol.messages import AnyRequest, Stop
from protocol.scenario import Scenario, from_tree
from protocol.trace import Event

_JOURNAL_MAGIC = b"canopy journal 1\n"
_BLANK = encode(None)
_decode_parts = msgspec.msgpack.Decoder(list[msgspec.Raw]).decode


class Opening(msgspec.Struct, frozen=True):
    """What the first record of a journal says."""

    run: str
    scenario: Scenario
    ground: list[Any]
    starts: tuple[int, ...]


class JournalAudit:
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
        self.opening: Opening | None = None
        self.joined: dict[int, str] = {}
        self.old_tags: dict[int, tuple[int, bytes]] = {}
        self.closed: str | None = None
        self.inputs = 1
        self.inputs_before = 1
        self._wrong = Findings()
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
            self._records = bodies(path, _JOURNAL_MAGIC, path.stat().st_size)
            self._open()
        except UNREADABLE as error:
            self._wrong.add(f"no opening: {str(error) or 'the journal is empty'}")
            self._ended = self._damaged = True

    def _open(self) -> None:
        kind, _, run, _, tree, ground, starts = decode(next(self._records))
        if kind != "opening":
            raise ValueError(f"it begins with a record of kind {kind}")
        self.opening = Opening(run, from_tree(tree, "the journal"), ground, tuple(starts))

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
        elif entries[at] != encode(request) and decode(entries[at]) != decode(encode(request)):
            found = decode(entries[at])
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
            self._wrong.add(f"wave {self._waves}: {decode(left[0])} is not in the trace")
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
            except UNREADABLE as error:
                self._wrong.add(str(error))
                self._ended = self._damaged = True
        return self._head

    def _read(self, body: bytes) -> list[Any] | None:
        """Take a record in; return it if it is a wave, or the kill of a robot."""
        parts = _decode_parts(body)
        kind = decode(parts[0])
        if self.closed is not None and kind != "incarnation":
            self._wrong.add(f"a record of kind {kind} behind the closing")
        match kind:
            case "wave":
                entries = list(map(bytes, _decode_parts(parts[1])))
                return ["wave", entries, dict(decode(parts[2]))]
            case "incarnation":
                self._lives += 1
                number = decode(parts[1])
                if number != self._lives:
                    self._wrong.add(f"life {self._lives} of the world is numbered {number}")
            case "joined":
                self._join(*map(decode, parts[1:]))
            case "old_tags":
                self.inputs += 1
                for place, revision, tag in (old[-3:] for old in decode(parts[1])):
                    self.old_tags[place] = revision, tag
            case "carried_out":
                return self._carry_out(decode(parts[1]))
            case "closing":
                self.closed = decode(parts[1])
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
        lives = "1 life" if self._lives == 1 else f"{self._lives} lives"
        return self._wrong.guarantee(
            "the journal is whole",
            f"{end}; {lives}, {len(self.joined)} joins, {self._waves} waves with "
            f"{self._applied} requests of the trace; besides, as is allowed: {self._refused} refused, "
            f"{self._blank} of robots that were lost meanwhile, {self._kills} kills by order",
        )


class MemoryAudit:
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

    def report(self, name: str, journal: JournalAudit, *, whole: bool) -> Guarantee:
        """Judge, once the trace has been seen whole."""
        if not whole and not any(path.exists() for path in self._paths):
            return skipped(name, "only the journal is here, without the memories of the robots")
        wrong, replies = Findings(), 0
        for robot in range(len(self._paths)):
            replies += self._check(robot, journal, wrong)
        robots = len(journal.joined)
        return wrong.guarantee(name, f"{replies} replies kept by {robots} robots that joined")

    def _check(self, robot: int, journal: JournalAudit, wrong: Findings) -> int:
        """Check one memory; return how many replies it holds."""
        size, process = self._sizes[robot], journal.joined.get(robot)
        path, digests = self._paths[robot], self._digests[robot]
        if size is None:
            if process is not None and journal.closed is not None:
                wrong.add(f"robot {robot} joined, and has no memory")
            return 0
        replies = -1  # the text by which it joined comes first
        try:
            for replies, body in enumerate(bodies(path, b"", size)):
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
