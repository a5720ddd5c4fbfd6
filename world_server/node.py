"""The world server's process: Zenoh on one side, the pure world and its journal on the other.

    python -m world_server.node RUN_DIR --port PORT [--router separate] [--snapshot-every REQUESTS]

The run's folder holds the journal; its first record, the opening, says what is to be played. One
thread does the steps: it publishes the replies of a wave, waits until every robot of the wave has
answered or is lost, commits, and goes on. Everything it must hear comes by one inbox. The event loop
beside it keeps the time: it wakes the step thread now and then, for what must be repeated.
"""

import argparse
import gc
import secrets
import sys
import threading
import time
from collections import deque
from math import inf
from pathlib import Path
from typing import Any, Literal

from protocol.codec import decoder_of, encode
from protocol.errors import FencedError, MessageError, RunError, StoreError
from protocol.lifeline import tie_to_supervisor
from protocol.messages import (
    SCHEMA_VERSION,
    Again,
    AnyReply,
    AnyRequest,
    AnyStoreReply,
    AnyWord,
    BatchReply,
    Ended,
    FaultOrder,
    Hello,
    HelloReply,
    Join,
    KillOrder,
    NumberedReply,
    NumberedRequest,
    ReadTags,
    ReadTagsReply,
    Reaped,
    Refusal,
    Stop,
    Stopped,
    Struck,
    TagWrite,
    Taken,
    Up,
    WentOn,
)
from protocol.trace import LossCause
from protocol.zenoh_link import (
    Link,
    LinkConfig,
    age_s,
    credentials_of,
    run_beside_loop,
    run_process,
)
from world_server import world as core
from world_server.journal import (
    CarriedOut,
    Closing,
    Incarnation,
    Joined,
    OldTags,
    WaveRecord,
)
from world_server.replay import Recovered, Replayed, all_writes, recover
from world_server.snapshot import EVERY_REQUESTS, Snapshot, SnapshotFile, snapshot_of
from world_server.state import WorldState
from world_server.watch import Absences, FaultsUnderWay

ANNOUNCE_S = 2.0
"""A new life of the world says so for this long: those it speaks to may still be finding back."""

PROGRESS_S = 0.1
"""Progress is reported this often."""


_decode_request = decoder_of(NumberedRequest)
_decode_number = decoder_of(int)
_decode_join = decoder_of(Join)
_decode_word: Any = decoder_of(AnyWord)  # type: ignore[arg-type]  # a union is a type here
_decode_store: Any = decoder_of(AnyStoreReply)  # type: ignore[arg-type]


class Seat:
    """What the shell keeps of one robot.

    Attributes:
        process: text that tells the process from any other; empty before it has joined.
        nonce: what its keys and its token carry.
        received: number of the last request that came.
        request: that request, until its wave is committed.
        reply: the last reply, encoded, and the number it answers.
        put: publishes to the robot.
    """

    __slots__ = ("answered", "nonce", "process", "put", "received", "reply", "request")

    def __init__(self) -> None:
        self.process = ""
        self.nonce = ""
        self.received = 0
        self.answered = 0
        self.request: AnyRequest | None = None
        self.reply = b""
        self.put: Any = None


class WorldNode:
    """One life of a world server."""

    def __init__(
        self,
        run_dir: Path,
        link: Link,
        *,
        snapshot_every: int = EVERY_REQUESTS,
        python_s: float = 0.0,
    ) -> None:
        """Recover what the journal holds and declare all keys; ``python_s``: what came before."""
        linked_s = age_s()
        self._link = link
        self._keys = link.keys
        recovered = take_over(run_dir, self._keys.run)
        replayed = recovered.replayed
        self._scenario, self._world = replayed.scenario, replayed.world
        self._output, self._closing = replayed.output, replayed.closing
        self._digest, self._store = replayed.digest, recovered.store
        self._incarnation = self._store.incarnation
        self._seats = _seats_of(replayed)
        self._has_store = self._scenario.device.capacity > 0
        self._journal_path = run_dir / "journal"
        self._journal = recovered.journal
        self._journal.append(Incarnation(self._incarnation))
        self._snapshots = SnapshotFile(
            snapshot_of(run_dir),
            self._journal_path,
            every_requests=snapshot_every,
            durability=self._scenario.durability,
            last=recovered.snapshot,
        )
        if self._incarnation > 1 or recovered.misfit:
            print(_in_words(recovered), file=sys.stderr)
        self._journal_lock = threading.Lock()
        self._started = self._last_join = time.monotonic()
        # What was heard and is not yet part of an input.
        self._missing: set[int] = set()
        self._new_losses: dict[int, LossCause] = {}
        self._dead: set[int] = set()
        self._told: dict[int, Refusal] = {}
        network, restart = self._scenario.network, self._scenario.team.on_crash == "restart"
        self._away = Absences(network.patience_s if restart else network.patience_s / 2)
        self._faults = FaultsUnderWay(expected=bool(self._scenario.faults))
        self._tokens: deque[tuple[str, bool]] = deque()
        self._hello: int | None = None
        self._old_tags: ReadTagsReply | None = None
        self._senders: dict[str, tuple[str, int, str]] = {}
        self._wake_pending = False
        self._next_progress = 0.0
        self._inbox = link.inbox(self._keys.world_in)
        self._put_wake = link.publisher(self._keys.wake)
        self._put_report = link.publisher(self._keys.world_reports)
        self._put_store = link.publisher(self._keys.store_requests)
        for robot, seat in enumerate(self._seats):
            if seat.nonce:
                self._declare(robot, seat)
                self._away.gone(robot, self._started, network.patience_s)
        self._announced_until = self._started + ANNOUNCE_S
        self._shaky_until = self._announced_until if self._incarnation > 1 else 0.0
        self._up = encode(
            Up(
                self._incarnation,
                {"python": python_s, "link": linked_s - python_s, "replay": age_s() - linked_s},
            )
        )
        link.watch(self._keys.alive(), self._token_changed)
        link.answer(self._keys.join("*"), self._join)

    # Before the first step.

    def _declare(self, robot: int, seat: Seat) -> None:
        seat.put = self._link.publisher(
            self._keys.replies(robot, seat.nonce), express=len(self._seats) == 1
        )

    # On threads of Zenoh's.

    def _join(self, key: str, payload: bytes) -> bytes:
        """Answer a process that wants to be a robot."""
        try:
            robot = self._keys.joining(key)
            join = _decode_join(payload)
            if join.schema != SCHEMA_VERSION:
                raise MessageError(f"schema {join.schema}; this run speaks {SCHEMA_VERSION}")
            if join.robot != robot or not 0 <= robot < len(self._seats):
                raise MessageError(f"no robot {join.robot} may join on {key}")
        except MessageError as error:
            return encode(Refusal("JoinError", str(error)))
        with self._journal_lock:
            seat = self._seats[robot]
            if seat.process and seat.process != join.process:
                return encode(Refusal("JoinError", f"robot {robot} has joined already"))
            if robot in self._dead:
                return encode(Refusal("JoinError", f"robot {robot} is lost"))
            if not seat.process:
                nonce = secrets.token_hex(8)
                self._journal.append(Joined(robot, join.process, nonce))
                seat.nonce = nonce
                self._declare(robot, seat)
                seat.process = join.process
                self._last_join = time.monotonic()
        return encode(self._world.briefing(robot, seat.nonce))

    def _token_changed(self, key: str, alive: bool) -> None:  # noqa: FBT001  called by the link
        self._tokens.append((key, alive))
        self.wake()

    def wake(self) -> None:
        """Let the step thread look up, for what must be repeated or has changed."""
        if not self._wake_pending:
            self._wake_pending = True
            self._put_wake(b"")

    def tick(self) -> None:
        """Wake the step thread by the clock, even if an earlier reminder was lost."""
        self._wake_pending = False
        self.wake()

    # The step thread.

    def serve(self) -> None:
        """Play the run to its end; then answer repeats until the link is closed."""
        if self._has_store:
            self._await(lambda: self._hello is not None, self._say_hello)
            assert self._hello is not None
            if self._hello < self._store.known_wave:
                print("the store has lost its end; it gets all writes again", file=sys.stderr)
                self._store = all_writes(self._journal_path, self._incarnation)
                self._world.on_write = self._store.written
            self._store.resume(self._hello)
        output = self._output
        while not isinstance(output, core.End):
            if isinstance(output, core.Wave):
                opening = output.round < 0
                output = self._serve_wave(output)
                if opening:
                    self._started = time.monotonic()
            elif isinstance(output, core.KillOrder):
                output = self._carry_out(output)
            elif isinstance(output, core.FaultOrder):
                output = self._order(output.fault)
            else:
                tags = self._read_old_tags(output.places)
                # What the store holds now may be newer than what the earlier run left: a replay
                # needs what was read.
                output = self._go_on(OldTags(tags), tags)
            if self._world.refusals:
                self._tell_refused()
        self._store.flush()
        self._send_batches()
        self._await(lambda: not self._has_store or self._store.idle, self._send_batches)
        if self._closing is None:
            play_s = time.monotonic() - self._started
            self._closing = Closing(output.status, self._digest.hexdigest(), play_s)
            with self._journal_lock:
                self._journal.append(self._closing)
        ended = encode(Ended(output.status))
        try:
            self._await(lambda: False, lambda: self._put_report(ended))
        except RunError:
            self._journal.close()

    def leave(self) -> None:
        """Tidy up behind a run that is over."""
        if self._closing is not None:
            self._snapshots.remove()

    def _serve_wave(self, wave: core.Wave) -> core.Output:
        seats = self._seats
        missing = self._missing
        for robot, sight in zip(wave.robots, wave.sights, strict=True):
            if seats[robot].request is not None:
                continue  # it came while this life of ours began: the last one sent the sight
            if sight is not None:
                self._reply(robot, sight)
            if robot not in self._new_losses:
                missing.add(robot)
        # While the robots think: what no reply depends on.
        self._digest.catch_up()
        if self._has_store:
            self._send_batches()
        self._keep_snapshot(len(wave.robots))
        while missing:
            self._hear()
        lost: tuple[tuple[int, LossCause], ...] = ()
        requests: list[AnyRequest | None] = [seats[robot].request for robot in wave.robots]
        if self._new_losses:
            lost = tuple(sorted(self._new_losses.items()))
            requests = [
                None if robot in self._new_losses else request
                for robot, request in zip(wave.robots, requests, strict=True)
            ]
            self._new_losses.clear()
        with self._journal_lock:
            self._journal.append(WaveRecord(requests, lost))
        if self._faults.waiting:
            for fault, at_s in self._faults.committed(time.monotonic()).items():
                self._put_report(encode(WentOn(fault, at_s)))
        self._store.next_wave()
        output = self._world.resume(core.Answers(requests, lost))
        for robot, request in zip(wave.robots, requests, strict=True):
            seats[robot].request = None
            if request.__class__ is Stop and self._world.bodies[robot].state == core.STOPPED:
                self._reply(robot, Stopped())
        for robot, _ in lost:
            if robot in self._told:
                self._reply(robot, self._told[robot])
        return output

    def _take_snapshot(self, state: WorldState) -> None:
        """Keep the state of the run between two instants, to be written while the robots think."""
        with self._journal_lock:
            joined = [
                Joined(robot, seat.process, seat.nonce)
                for robot, seat in enumerate(self._seats)
                if seat.process
            ]
            self._snapshots.take(
                Snapshot(
                    SCHEMA_VERSION,
                    self._keys.run,
                    self._journal.end,
                    0,
                    self._incarnation,
                    tuple(joined),
                    state,
                    self._digest.state(),
                    self._store.state(),
                )
            )

    def _keep_snapshot(self, requests: int) -> None:
        """Write the snapshot in hand; if it is time for one more, have it taken."""
        try:
            self._snapshots.write()
        except OSError as error:  # the journal is what counts
            print(f"no snapshot: {error}", file=sys.stderr)
        if self._snapshots.due(requests):
            self._world.when_quiet(self._take_snapshot)

    def _tell_refused(self) -> None:
        """Tell each robot that broke a rule, in the last wave or by one round too many."""
        for robot, refusal in self._world.refusals.items():
            if robot not in self._told:
                self._told[robot] = refusal
                self._reply(robot, refusal)

    def _carry_out(self, order: core.KillOrder) -> core.Output:
        payload = encode(KillOrder(order.fault, order.robot))
        self._await(lambda: order.robot in self._dead, lambda: self._put_report(payload))
        self._new_losses.pop(order.robot, None)
        self._told.pop(order.robot, None)
        self._seats[order.robot].request = None
        return self._go_on(CarriedOut(order.fault), None)

    def _order(self, fault: int) -> core.Output:
        """Have a fault carried out; if it is to be later, the run goes on meanwhile."""
        payload = encode(FaultOrder(fault))
        self._await(lambda: fault in self._faults.taken, lambda: self._put_report(payload))
        return self._go_on(CarriedOut(fault), None)

    def _go_on(self, record: CarriedOut | OldTags, given: core.Input) -> core.Output:
        """Commit what the world is given, and give it."""
        with self._journal_lock:
            self._journal.append(record)
        self._store.next_wave()
        return self._world.resume(given)

    def _read_old_tags(self, places: tuple[int, ...]) -> tuple[TagWrite, ...]:
        number = self._store.last_wave
        question = encode(ReadTags(number, places, self._incarnation))
        self._old_tags = None
        self._await(
            lambda: self._old_tags is not None and self._old_tags.number == number,
            lambda: self._put_store(question),
        )
        assert self._old_tags is not None
        return self._old_tags.tags

    def _await(self, done: Any, ask: Any) -> None:  # noqa: ANN401  two plain functions
        """Ask, and hear whatever comes, until it is done; ask again by the clock."""
        ask_again = 0.0
        while not done():
            if time.monotonic() >= ask_again:
                ask_again = time.monotonic() + 0.1
                ask()
                continue
            self._hear()

    def _reply(self, robot: int, reply: AnyReply) -> None:
        seat = self._seats[robot]
        seat.answered = seat.received
        seat.reply = encode(NumberedReply(seat.received, reply))
        if seat.put is not None:
            seat.put(seat.reply)

    # What comes in.

    def _hear(self) -> None:
        """Wait for one message and take it in."""
        key, payload = self._inbox.receive()
        sender = self._senders.get(key)
        try:
            if sender is None:
                sender = self._senders[key] = self._keys.sender(key)
            kind, robot, nonce = sender
            if kind in ("robot", "failed"):
                if self._away:
                    self._away.back(robot)
                self._heard_robot(kind, robot, nonce, payload)
            elif kind == "wake":
                self._woken()
            elif kind == "bookkeeping":
                self._heard_store(_decode_store(payload))
            else:
                self._heard_word(_decode_word(payload))
        except MessageError as error:
            print(f"ignored: {error}", file=sys.stderr)

    def _heard_robot(self, kind: str, robot: int, nonce: str, payload: bytes) -> None:
        if robot >= len(self._seats) or self._seats[robot].nonce != nonce:
            return  # nobody that joined speaks there
        seat = self._seats[robot]
        if robot in self._new_losses:
            return  # what it is told follows the commit; until then it repeats itself
        seq, request, fault = seat.received + 1, None, ""
        try:
            if kind == "robot":
                numbered = _decode_request(payload)
                seq, request = numbered.seq, numbered.request
            else:
                seq = _decode_number(payload)
        except MessageError as error:
            fault = str(error)
        if robot in self._dead or self._world.bodies[robot].state == core.LOST:
            if seq == seat.received and robot in self._told:
                seat.put(seat.reply)
            elif seq >= seat.received:
                seat.received = seq
                self._reply(robot, Refusal(FencedError.__name__, f"robot {robot} is lost"))
        elif seq <= seat.received:
            if seq == seat.received == seat.answered and seat.put is not None and seat.reply:
                seat.put(seat.reply)
        elif fault:
            self._fail(robot, seq, Refusal("MessageError", fault))
        elif seq > seat.received + 1:
            fault = f"request {seq} follows {seat.received}"
            self._fail(robot, seq, Refusal("MessageError", fault))
        elif seat.answered != seat.received:
            self._heard_early(robot, seq)
        elif request is None:
            self._fail(robot, seq, Refusal("AlgorithmError", "as the robot said itself"))
        else:
            seat.received = seq
            seat.request = request
            self._missing.discard(robot)

    def _heard_early(self, robot: int, seq: int) -> None:
        """Hear a request while the one before has no answer yet."""
        if self._incarnation == 1 or not self._faults.young:
            fault = f"request {seq} before {self._seats[robot].received} was answered"
            self._fail(robot, seq, Refusal("MessageError", fault))
        # Else our last life did answer, behind a fault that we are still to ask for: it is repeated.

    def _fail(self, robot: int, seq: int, refusal: Refusal) -> None:
        """Refuse what no sound robot would send; it is out of the run, and told so by number."""
        if self._world.bodies[robot].state < core.STOPPED:
            self._seats[robot].received = seq
            self._told[robot] = refusal
            self._heard_lost(robot, "failed")

    def _heard_lost(self, robot: int, cause: LossCause) -> None:
        if self._world.bodies[robot].state < core.STOPPED:
            self._new_losses.setdefault(robot, cause)
            self._missing.discard(robot)

    def _heard_word(self, word: AnyWord) -> None:
        match word:
            case Reaped(robot=robot):
                self._heard_dead(robot)
            case Taken(fault=fault):
                self._faults.taken.add(fault)
            case Struck(fault=fault, at_s=at_s):
                went_on_s = self._faults.struck(fault, at_s)
                if went_on_s is not None:
                    self._put_report(encode(WentOn(fault, went_on_s)))

    def _heard_dead(self, robot: int) -> None:
        if 0 <= robot < len(self._seats):
            self._dead.add(robot)
            self._heard_lost(robot, "killed")

    def _woken(self) -> None:
        self._wake_pending = False
        now = time.monotonic()
        while self._tokens:
            self._token_heard(*self._tokens.popleft(), now)
        for robot in self._away.overdue(now):
            self._heard_dead(robot)
        if now < self._announced_until:
            self._put_report(self._up)
        if now < self._shaky_until:
            for robot in self._missing:
                self._ask_again(robot)
        if self._has_store:
            self._send_batches()
        if now >= self._last_join + self._scenario.network.join_patience_s:
            self._last_join = inf
            for robot, seat in enumerate(self._seats):
                if not seat.process:
                    self._heard_dead(robot)
        if now >= self._next_progress:
            self._next_progress = now + PROGRESS_S
            self._put_report(encode(self._world.progress()))

    def _token_heard(self, key: str, alive: bool, now: float) -> None:  # noqa: FBT001  as it comes
        _, robot, nonce = self._keys.sender(key)
        if robot >= len(self._seats) or self._seats[robot].nonce != nonce:
            return
        if not alive:
            self._away.gone(robot, now)
        elif self._away.back(robot):
            self._shaky_until = now + ANNOUNCE_S

    def _ask_again(self, robot: int) -> None:
        """Ask a robot for its open request at once: by itself it would repeat it, but later."""
        seat = self._seats[robot]
        if seat.put is not None:
            seat.put(encode(NumberedReply(seat.received, Again())))

    # The store.

    def _say_hello(self) -> None:
        self._put_store(encode(Hello(SCHEMA_VERSION, self._incarnation)))

    def _send_batches(self) -> None:
        now = time.monotonic()
        due = self._store.due_s()
        batch = self._store.take(now)
        if batch is None and due is not None and due <= now:
            batch = self._store.repeat(now)
        if batch is not None:
            self._put_store(encode(batch))

    def _heard_store(self, reply: AnyStoreReply) -> None:
        if reply.incarnation != self._incarnation:
            return  # an answer to an earlier life of ours
        if isinstance(reply, BatchReply):
            self._store.acknowledged(reply.wave)
            self._send_batches()
        elif isinstance(reply, HelloReply):
            if self._hello is None:
                self._hello = reply.wave
        elif isinstance(reply, ReadTagsReply):
            self._old_tags = reply
        else:
            raise StoreError(reply.detail)


def take_over(run_dir: Path, run: str) -> Recovered:
    """Recover a run in a process that lives for it alone.

    Nothing of it is garbage, now or later; to look through a large map for some would take as long
    again as to read it.

    Raises:
        JournalError: As `recover` does.
        ReplayError: As `recover` does.
    """
    gc.disable()
    try:
        return recover(run_dir, run)
    finally:
        gc.freeze()
        gc.enable()


def _seats_of(replayed: Replayed) -> list[Seat]:
    """Return what an earlier life would know of the robots, less what was never committed."""
    seats = [Seat() for _ in replayed.world.bodies]
    for robot, (seat, body) in enumerate(zip(seats, replayed.world.bodies, strict=True)):
        if robot in replayed.joined:
            joined = replayed.joined[robot]
            seat.process, seat.nonce = joined.process, joined.nonce
        seat.received = seat.answered = body.requests
        if body.state not in (core.STOPPED, core.LOST, core.IN_TURN):
            seat.answered -= 1
        if body.state == core.STOPPED:
            seat.reply = encode(NumberedReply(body.requests, Stopped()))
    return seats


def _in_words(recovered: Recovered) -> str:
    snapshot, replayed = recovered.snapshot, recovered.replayed
    begin = 0 if snapshot is None else snapshot.journal_bytes
    words = f"life {recovered.store.incarnation}: replayed the journal from byte {begin} to "
    words += f"{replayed.end}"
    return f"{words}; the snapshot was not used: {recovered.misfit}" if recovered.misfit else words


async def _main(arguments: argparse.Namespace) -> None:
    run_dir: Path = arguments.run_dir
    embedded: bool = arguments.router == "embedded"
    mode: Literal["router", "client"] = "router" if embedded else "client"
    users = run_dir / "users"
    config = LinkConfig(
        arguments.run,
        arguments.port,
        mode,
        credentials_of("world"),
        str(users) if embedded and users.exists() else None,
        arguments.robots,
    )
    with Link(config) as link:
        node = WorldNode(
            run_dir, link, snapshot_every=arguments.snapshot_every, python_s=arguments.python_s
        )
        await run_beside_loop(link, node.serve, tick=node.tick)
        node.leave()


def main() -> None:
    """Run the world server's process."""
    tie_to_supervisor()
    python_s = age_s()
    parser = argparse.ArgumentParser(prog="world_server.node", description=__doc__)
    parser.add_argument("run_dir", type=Path, help="folder of the run, with its journal")
    parser.add_argument("--run", required=True, help="name of the run")
    parser.add_argument("--port", type=int, required=True, help="port of the router")
    parser.add_argument("--robots", type=int, required=True, help="number of robots")
    parser.add_argument("--router", choices=("embedded", "separate"), default="embedded")
    parser.add_argument(
        "--snapshot-every",
        type=int,
        default=EVERY_REQUESTS,
        help="requests between two snapshots at least",
    )
    arguments = parser.parse_args(namespace=argparse.Namespace(python_s=python_s))
    run_process("world", _main(arguments))


if __name__ == "__main__":
    main()
