"""The link: sessions, the numbered step, who may say what, the world's shell and the store's."""

import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from agents.node import FAILED, NOT_JOINED, live
from bookkeeping.sqlite_store import SqliteStore
from deploy import processes
from deploy.judged import judge_journal
from deploy.run_dir import RunDir
from deploy.setting import tag_format_of
from protocol import zenoh_link
from protocol.codec import decoder_of, encode
from protocol.errors import (
    FencedError,
    JoinError,
    MachineError,
    MessageError,
    OutcomeUnknownError,
    RunError,
)
from protocol.messages import (
    PAYLOAD_BYTES_MAX,
    SCHEMA_VERSION,
    AnyReply,
    Briefing,
    Join,
    Look,
    Move,
    NumberedReply,
    NumberedRequest,
    Refusal,
    Sight,
    Stop,
    Stopped,
    Write,
)
from protocol.scenario import to_tree
from protocol.zenoh_link import PASSWORD, Credentials, Link, LinkConfig, RobotLine, free_port
from tests.play import graph_of
from tests.runs import free, play, run_cli, setting_of, started_cli, until, write_scenario
from world_server.journal import Closing, Journal, opening, scan
from world_server.node import WorldNode
from world_server.replay import read_opening, replay

SMALL = graph_of("01 12 23 34 40 13")
WAIT_S = 20.0


@pytest.fixture
def run_name() -> str:
    return f"test-{os.urandom(6).hex()}"


@contextmanager
def linked(run: str, clients: int = 1) -> Iterator[tuple[Link, ...]]:
    """A router and its clients, all without access control."""
    port = free_port()
    with ExitStack() as stack:
        yield tuple(
            stack.enter_context(Link(LinkConfig(run, port, "client" if number else "router")))
            for number in range(clients + 1)
        )


class InThread:
    """Something that blocks, done in a thread of its own; `result` waits for it and raises."""

    def __init__(self, work: Callable[[], Any]) -> None:
        self._outcome: list[tuple[Any, BaseException | None]] = []

        def body() -> None:
            try:
                self._outcome.append((work(), None))
            except BaseException as error:  # noqa: BLE001  carried over
                self._outcome.append((None, error))

        self._thread = threading.Thread(target=body, daemon=True)
        self._thread.start()

    def result(self) -> Any:
        self._thread.join(WAIT_S)
        assert self._outcome, "it blocks still"
        value, error = self._outcome[0]
        if error is not None:
            raise error
        return value


# Ports and sessions.


def test_a_free_port_lies_outside_the_ephemeral_range():
    low = int(Path("/proc/sys/net/ipv4/ip_local_port_range").read_text().split()[0])
    port = free_port()
    assert 20000 <= port < 28000 < low
    assert free(port)
    assert free_port(port) == port


def test_a_port_in_use_is_told_in_one_line(run_name: str):
    with socket.socket() as taken:
        # As `free_port` looks: a port that was just closed is free.
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        taken.bind(("127.0.0.1", free_port()))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(MachineError, match=rf"^field `network.port`: port {port} .*choose.*$"):
            free_port(port)
        with pytest.raises(MachineError, match=rf"^cannot listen on .*:{port} .*choose.*$") as told:
            Link(LinkConfig(run_name, port, "router"))
        assert "\n" not in str(told.value)


def test_a_link_closes_on_every_way_out(run_name: str):
    port = free_port()

    def fails() -> None:
        with Link(LinkConfig(run_name, port, "router")):
            assert not free(port)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fails()
    until(lambda: free(port), "a free port")


def test_closing_a_link_releases_what_blocks_on_it(run_name: str):
    with linked(run_name) as (_, client):
        inbox = client.inbox(client.keys.replies(0, "aa"))
        blocked = InThread(inbox.receive)
        bare = InThread(client.inbox(client.keys.replies(1, "aa")).receive_bytes)
        client.close()
        for waiting in (blocked, bare):
            with pytest.raises(RunError, match="the link was closed"):
                waiting.result()
        client.close()  # once more does no harm


def test_a_put_on_a_closed_link_is_a_lost_message(run_name: str):
    with linked(run_name) as (_, client):
        put = client.publisher(client.keys.requests(0, "aa"))
        client.close()
        put(b"lost")


def test_a_question_without_an_answer_has_an_unknown_outcome(run_name: str):
    with linked(run_name) as (router, client):
        with pytest.raises(OutcomeUnknownError) as nobody:
            client.ask(client.keys.join(0), b"?", 1.0)
        assert nobody.value.definite is False
        heard, enough = threading.Event(), threading.Event()

        def late(_: str, payload: bytes) -> bytes:
            heard.set()
            enough.wait(WAIT_S)
            return payload

        router.answer(router.keys.join("*"), late)
        try:
            until(lambda: asked_in_vain(client) and heard.is_set(), "a question that is heard")
        finally:
            enough.set()


def asked_in_vain(client: Link) -> bool:
    with pytest.raises(OutcomeUnknownError):
        client.ask(client.keys.join(0), b"?", 0.2)
    return True


@pytest.mark.slow
def test_a_router_that_is_not_there_is_told_in_one_line(run_name: str):
    with pytest.raises(RunError, match=r"^cannot reach the router on 127.0.0.1:\d+, .*$"):
        Link(LinkConfig(run_name, free_port()))


# The robot's line, with a world that does as it is told.


class FakeWorld:
    """Hears requests and sends what a test says."""

    def __init__(self, link: Link, answer: Any = None) -> None:
        self._decode = decoder_of(NumberedRequest)
        briefing = Briefing(0, 1, 0, "none", {}, 0, "global", blank_tags=True, nonce="ab12")
        self._answer = encode(answer or briefing)
        self.inbox = link.inbox(link.keys.world_in)
        self._put = link.publisher(link.keys.replies(0, "ab12"))
        link.answer(link.keys.join("*"), lambda _, __: self._answer)

    def heard(self) -> NumberedRequest:
        """Wait for the next request."""
        key, payload = InThread(self.inbox.receive).result()
        assert key.endswith("/robot/0/ab12")
        return self._decode(payload)

    def send(self, seq: int, reply: AnyReply) -> None:
        self._put(encode(NumberedReply(seq, reply)))

    def send_bytes(self, payload: bytes) -> None:
        self._put(payload)


class Clock:
    """Time as a test says; what sleeps only passes it."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, duration_s: float) -> None:
        self.now += duration_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(zenoh_link, "time", made)
    return made


@pytest.fixture
def line(run_name: str, clock: Clock) -> Iterator[tuple[RobotLine, FakeWorld, list[bytes]]]:
    """A robot that has joined, its world, and all that it has sent."""
    with linked(run_name) as (router, client):
        world = FakeWorld(router)
        made = InThread(lambda: RobotLine(client, 0)).result()
        sent: list[bytes] = []
        put = made._put

        def spied(payload: bytes) -> None:
            sent.append(payload)
            put(payload)

        made._put = spied
        yield made, world, sent


def a_sight(time: float) -> Sight:
    return Sight(time, 0, None, 2, b"", 0, alone=True)


def test_requests_are_numbered_and_answered_one_by_one(line):
    robot, world, _ = line
    for seq in (1, 2, 3):
        asked = InThread(partial(robot.request, Move(None, (), seq)))
        assert world.heard() == NumberedRequest(seq, Move(None, (), seq))
        world.send(seq, a_sight(seq))
        assert asked.result() == a_sight(seq)


def test_an_unanswered_request_is_repeated_by_the_clock_under_its_number(line, clock: Clock):
    robot, world, sent = line
    asked = InThread(lambda: robot.request(Look()))
    assert world.heard() == NumberedRequest(1, Look())
    pauses = [0.1, 0.2, 0.4, 0.8, 1.6, 1.6, 1.6]
    for repeats, pause in enumerate(pauses, start=1):
        clock.now += 0.99 * pause
        robot.repeat_if_due()
        assert len(sent) == repeats  # not yet
        clock.now += 0.02 * pause
        robot.repeat_if_due()
        robot.repeat_if_due()  # only once
        assert len(sent) == repeats + 1
        assert world.heard() == NumberedRequest(1, Look())
    world.send(1, a_sight(0))
    assert asked.result() == a_sight(0)
    clock.now += 100
    robot.repeat_if_due()
    assert len(set(sent)) == 1
    assert len(sent) == len(pauses) + 1  # answered: nothing is due any more


def test_the_pauses_begin_anew_with_each_request(line, clock: Clock):
    robot, world, sent = line
    for seq in (1, 2):
        asked = InThread(lambda: robot.request(Look()))
        world.heard()
        for _ in range(3):
            clock.now += 0.9
            robot.repeat_if_due()
        world.send(seq, a_sight(seq))
        asked.result()
    assert len(sent) == 8


def test_repeated_replies_are_passed_over_and_never_answered(line):
    """Or two sides would echo for ever."""
    robot, world, sent = line
    asked = InThread(lambda: robot.request(Look()))
    world.heard()
    for _ in range(50):
        world.send(1, a_sight(0))
    assert asked.result() == a_sight(0)
    asked = InThread(lambda: robot.request(Look()))
    assert world.heard().seq == 2
    for stale in (1, 1, 0, 3, 99):
        world.send(stale, a_sight(stale))
    world.send(2, a_sight(2))
    assert asked.result() == a_sight(2)
    assert len(sent) == 2


def test_a_fenced_robot_is_told_so(line):
    robot, world, _ = line
    asked = InThread(lambda: robot.request(Look()))
    world.heard()
    world.send(1, Refusal("FencedError", "robot 0 is lost"))
    with pytest.raises(FencedError, match="robot 0 is lost"):
        asked.result()


def test_other_refusals_are_replies(line):
    robot, world, _ = line
    asked = InThread(lambda: robot.request(Look()))
    world.heard()
    world.send(1, Refusal("ExitError", "no such exit"))
    assert asked.result() == Refusal("ExitError", "no such exit")


def test_a_reply_that_is_none_is_refused(line):
    robot, world, _ = line
    asked = InThread(lambda: robot.request(Look()))
    world.heard()
    world.send_bytes(b"\xc1")
    with pytest.raises(MessageError):
        asked.result()


def test_a_robot_that_may_not_join_is_told_why(run_name: str):
    with linked(run_name) as (router, client):
        FakeWorld(router, Refusal("JoinError", "robot 0 has joined already"))
        with pytest.raises(JoinError, match="robot 0 has joined already"):
            InThread(lambda: RobotLine(client, 0)).result()


def test_a_robot_waits_for_a_world_that_comes_late(run_name: str):
    with linked(run_name) as (router, client):
        joining = InThread(lambda: RobotLine(client, 0))
        FakeWorld(router)
        assert joining.result().briefing.nonce == "ab12"


# Who may say what.


class Guarded:
    """A router with the users of a run of two robots, as the processes engine writes them."""

    def __init__(self, run: str, folder: Path, stack: ExitStack) -> None:
        self.run, self.port, self._stack = run, free_port(), stack
        run_dir = RunDir.create(folder / "guarded", run)
        self._passwords = processes._write_users(run_dir, 2)
        self.users = run_dir.users
        self.world = stack.enter_context(
            Link(
                LinkConfig(
                    *(run, self.port, "router"),
                    credentials=Credentials("world", self._passwords["world"]),
                    users=str(run_dir.users),
                    robots=2,
                )
            )
        )
        self.keys = self.world.keys

    def link(self, user: str, password: str | None = None) -> Link:
        credentials = Credentials(user, password or self._passwords[user])
        return self._stack.enter_context(
            Link(LinkConfig(self.run, self.port, credentials=credentials))
        )


@pytest.fixture
def guarded(run_name: str, tmp_path: Path) -> Iterator[Guarded]:
    with ExitStack() as stack:
        yield Guarded(run_name, tmp_path, stack)


def test_only_we_can_read_the_passwords(guarded: Guarded):
    assert guarded.users.stat().st_mode & 0o777 == 0o600
    passwords = [line.split(":")[1] for line in guarded.users.read_text().split()]
    assert len(passwords) == len(set(passwords)) == 5


FORBIDDEN_TO_PUT: list[Callable[[Any], str]] = [
    lambda keys: keys.requests(0, "aa"),
    lambda keys: keys.failed(0, "aa"),
    lambda keys: keys.supervisor_reports,
    lambda keys: keys.store_replies,
    lambda keys: keys.wake,
    lambda keys: f"{keys.root}/world/in/robot/2/aa",
]


def test_a_robot_speaks_only_as_itself(guarded: Guarded):
    keys = guarded.keys
    inbox = guarded.world.inbox(keys.world_in)
    robot = guarded.link("robot-1")
    for key in [*(forbidden(keys) for forbidden in FORBIDDEN_TO_PUT), keys.store_requests]:
        robot.publisher(key)(b"forged")
    robot.publisher(f"{keys.root}/**")(b"forged")
    own = robot.publisher(keys.requests(1, "bb"))
    # A session keeps the order: when its own word is heard, the others were not let through.
    heard = hear_after(inbox, lambda: own(b"own"))
    assert heard == (keys.requests(1, "bb"), b"own")
    failed = robot.publisher(keys.failed(1, "bb"))
    failed(b"own failure")
    while heard[1] == b"own":
        heard = InThread(inbox.receive).result()
    assert heard == (keys.failed(1, "bb"), b"own failure")


def hear_after(inbox: zenoh_link.Inbox, say: Callable[[], None]) -> tuple[str, bytes]:
    """Say something until anything is heard: a new session needs a moment to be known."""
    waiting = InThread(inbox.receive)

    def said_and_heard() -> bool:
        say()
        return bool(waiting._outcome)

    until(said_and_heard, "a message")
    heard: tuple[str, bytes] = waiting.result()
    return heard


def test_a_robot_hears_only_what_is_for_it(guarded: Guarded):
    keys = guarded.keys
    robot = guarded.link("robot-1")
    overheard: list[bytes] = []
    for key in (
        keys.replies(0, "aa"),
        keys.replies(0),
        keys.replies("*"),
        keys.store_requests,
        keys.store_replies,
        keys.world_in,
        keys.world_reports,
        keys.requests(0),
        f"{keys.root}/**",
        "**",
    ):
        robot.subscribe(key, overheard.append)
    own = robot.inbox(keys.replies(1, "bb"))
    secret = [
        guarded.world.publisher(key)
        for key in (
            keys.replies(0, "aa"),
            keys.store_requests,
            keys.store_replies,
            keys.world_reports,
            keys.requests(0, "aa"),
        )
    ]
    mine = guarded.world.publisher(keys.replies(1, "bb"))

    def say() -> None:
        for put in secret:
            put(b"secret")
        mine(b"for robot 1")

    assert hear_after(own, say) == (keys.replies(1, "bb"), b"for robot 1")
    assert b"secret" not in overheard


def test_a_robot_cannot_forge_the_life_of_another(guarded: Guarded):
    keys = guarded.keys
    seen: list[tuple[str, bool]] = []
    guarded.world.watch(keys.alive(), lambda key, alive: seen.append((key, alive)))
    robot = guarded.link("robot-1")
    robot.announce(keys.alive(0, "aa"))
    robot.announce(keys.alive(1, "bb"))
    until(lambda: bool(seen), "the token of robot 1")
    assert seen == [(keys.alive(1, "bb"), True)]
    robot.close()
    until(lambda: len(seen) > 1, "the end of the token")
    assert seen[1:] == [(keys.alive(1, "bb"), False)]


def test_a_robot_cannot_join_as_another_nor_let_others_join(guarded: Guarded):
    keys = guarded.keys
    asked: list[str] = []

    def respond(key: str, _: bytes) -> bytes:
        asked.append(key)
        return b"world"

    robot = guarded.link("robot-1")
    other = guarded.link("robot-0")
    # In a session of its own: what a session asks itself passes no router.
    guarded.link("robot-1").answer(keys.join(0), lambda *_: b"forged")
    guarded.world.answer(keys.join("*"), respond)
    until(lambda: answered(robot, keys.join(1)) == b"world", "an answer to robot 1")
    asked.clear()
    assert answered(robot, keys.join(0)) is None
    assert asked == []
    until(lambda: answered(other, keys.join(0)) is not None, "an answer to robot 0")
    assert answered(other, keys.join(0)) == b"world"


def answered(link: Link, key: str) -> bytes | None:
    try:
        return link.ask(key, b"?", 1.0)
    except OutcomeUnknownError:
        return None


def test_the_store_is_asked_by_the_world_alone(guarded: Guarded):
    keys = guarded.keys
    store = guarded.link("bookkeeping")
    inbox = store.inbox(keys.store_requests)
    for user in ("robot-1", "supervisor"):
        guarded.link(user).publisher(keys.store_requests)(b"forged")
    put = guarded.world.publisher(keys.store_requests)
    assert hear_after(inbox, lambda: put(b"batch")) == (keys.store_requests, b"batch")
    # And the store speaks to the world only as itself.
    heard = guarded.world.inbox(keys.world_in)
    store.publisher(keys.requests(0, "aa"))(b"forged")
    reply = store.publisher(keys.store_replies)
    assert hear_after(heard, lambda: reply(b"done")) == (keys.store_replies, b"done")


@pytest.mark.slow
@pytest.mark.parametrize(("user", "password"), [("robot-1", "wrong"), ("stranger", "wrong")])
def test_a_wrong_password_opens_nothing(guarded: Guarded, user: str, password: str):
    with pytest.raises(RunError, match="or it refuses this process"):
        guarded.link(user, password)


# The world's shell.


class Shell:
    """A world server in this process, for robots without devices, and its link."""

    def __init__(self, run: str, folder: Path, stack: ExitStack, **fields: Any) -> None:
        fields = {"algorithm": "tests.robots:wanderer", "device": {"capacity_bytes": 0}, **fields}
        setting = setting_of(SMALL, 3, **fields)
        self.run, self.port, self._stack = run, free_port(), stack
        self.run_dir = RunDir.create(folder / "shell", run)
        journal = Journal(self.run_dir.journal)
        tree = to_tree(setting.scenario)
        journal.append(opening(run, "processes", tree, setting.graph, setting.starts))
        journal.close()
        self.link = stack.enter_context(Link(LinkConfig(run, self.port, "router")))
        self.node = WorldNode(self.run_dir.path, self.link)
        self._over = threading.Event()
        stack.callback(self._over.set)
        self._ticking = threading.Thread(target=self._tick, daemon=True)
        self._ticking.start()
        self.serving = InThread(self.node.serve)

    def _tick(self) -> None:
        while not self._over.wait(0.05):
            self.node.tick()

    def client(self) -> Link:
        return self._stack.enter_context(Link(LinkConfig(self.run, self.port)))

    def robot(self, robot: int) -> RobotLine:
        joined: RobotLine = InThread(lambda: RobotLine(self.client(), robot)).result()
        return joined

    def sound(self, robot: int) -> InThread:
        """A robot that plays its part, with a clock of its own for repeats."""
        line = self.robot(robot)
        return InThread(lambda: live(line))

    def closed(self) -> Closing:
        """Wait for the end of the run, and end this world."""
        until(lambda: self._last() is not None, "the end of the run")
        found = self._last()
        assert found is not None
        self._over.set()
        self._ticking.join()
        self.link.close()
        self.serving.result()
        return found

    def _last(self) -> Closing | None:
        *_, (record, _) = scan(self.run_dir.journal)
        return record if isinstance(record, Closing) else None


@pytest.fixture
def shell(run_name: str, tmp_path: Path) -> Iterator[Shell]:
    with ExitStack() as stack:
        yield Shell(run_name, tmp_path, stack)


def refusal_of(line: RobotLine) -> tuple[int, Refusal]:
    """Wait for the next reply, which must be a refusal, and return its number and what it says."""
    reply = line._decode(InThread(line._inbox.receive_bytes).result())
    assert isinstance(reply.reply, Refusal), reply
    return reply.seq, reply.reply


LOOK = NumberedRequest(1, Look())
NONSENSE = {
    "no msgpack": ([b"\xc1"], 1, "not a message of this protocol"),
    "nothing": ([b""], 1, "not a message of this protocol"),
    "cut short": ([encode(LOOK)[:-1]], 1, "not a message of this protocol"),
    "trailing bytes": ([encode(LOOK) + b"\x00"], 1, "not a message of this protocol"),
    "another message": ([encode(Join(SCHEMA_VERSION, 1, "x"))], 1, "not a message"),
    "unknown request": ([encode(["request", 1, ["fly"]])], 1, "not a message"),
    "unknown field": ([encode(["request", 1, ["look", None, [], None, 7]])], 1, "not a message"),
    "wrong type": ([encode(["request", 1, ["move", None, [], "north"]])], 1, "Expected `int`"),
    "number ahead": ([encode(NumberedRequest(3, Look()))], 3, "request 3 follows 0"),
    "too early": (
        [encode(LOOK), encode(NumberedRequest(2, Stop()))],
        2,
        "request 2 before 1 was answered",
    ),
    "oversized": (
        [encode(NumberedRequest(1, Write(bytes(PAYLOAD_BYTES_MAX))))],
        1,
        f"at most {PAYLOAD_BYTES_MAX} are allowed",
    ),
}


@pytest.mark.parametrize("name", NONSENSE)
def test_a_robot_that_sends_nonsense_is_refused_and_lost(name: str, shell: Shell):
    payloads, number, reason = NONSENSE[name]
    bad = shell.robot(1)
    for payload in payloads:
        bad._put(payload)
    others = [shell.sound(0), shell.sound(2)]
    seq, refusal = refusal_of(bad)
    assert seq == number
    assert refusal.error == "MessageError"
    assert reason in refusal.detail
    assert [other.result() for other in others] == [0, 0]
    bad._put(payloads[-1])  # it insists: it is told the same, or that it is lost
    _, again = refusal_of(bad)
    assert again in (refusal, Refusal("FencedError", "robot 1 is lost"))
    shell.closed()
    result = judge_journal(shell.run_dir.journal).result
    assert result.robots_lost == [1]
    assert result.per_robot[1].lost_by == "failed"
    assert [robot.stopped_at is not None for robot in result.per_robot] == [True, False, True]


def test_nonsense_in_the_middle_of_a_run(shell: Shell):
    others = [shell.sound(0), shell.sound(2)]
    bad = shell.robot(1)
    InThread(lambda: bad.request(Look())).result()
    bad._put(encode(NumberedRequest(2, Move(None, (), 0)))[:-2])
    assert refusal_of(bad)[0] == 2
    assert [other.result() for other in others] == [0, 0]
    shell.closed()
    assert judge_journal(shell.run_dir.journal).result.robots_lost == [1]


def test_a_robot_that_fails_says_so_and_is_lost_for_that(run_name: str, tmp_path: Path):
    with ExitStack() as stack:
        shell = Shell(run_name, tmp_path, stack, algorithm="tests.robots:raises")
        robots = [shell.sound(robot) for robot in range(3)]
        assert [robot.result() for robot in robots] == [0, FAILED, 0]
        shell.closed()
    result = judge_journal(shell.run_dir.journal).result
    assert result.per_robot[1].lost_by == "failed"


def test_a_repeated_request_gets_the_same_reply_and_happens_once(shell: Shell):
    others = [shell.sound(0), shell.sound(2)]
    line = shell.robot(1)
    sight = InThread(lambda: line.request(Look())).result()
    for _ in range(3):
        line._put(encode(LOOK))
        again = line._decode(InThread(line._inbox.receive_bytes).result())
        assert again == NumberedReply(1, sight)
    stopped = InThread(lambda: line.request(Stop())).result()
    assert stopped == Stopped()
    line._put(encode(NumberedRequest(2, Stop())))
    assert line._decode(InThread(line._inbox.receive_bytes).result()) == NumberedReply(2, stopped)
    assert [other.result() for other in others] == [0, 0]
    shell.closed()
    assert judge_journal(shell.run_dir.journal).result.per_robot[1].requests == 2


def test_who_may_join(shell: Shell):
    client = shell.client()
    decode: Any = decoder_of(Briefing | Refusal)  # type: ignore[arg-type]

    def join(payload: bytes, key: int = 1) -> Briefing | Refusal:
        answer: Briefing | Refusal = decode(
            zenoh_link._insist(client, client.keys.join(key), payload)
        )
        return answer

    for payload, key, reason in (
        (b"\xc1", 1, "not a message"),
        (encode(Join(SCHEMA_VERSION + 1, 1, "me")), 1, f"this run speaks {SCHEMA_VERSION}"),
        (encode(Join(SCHEMA_VERSION, 2, "me")), 1, "no robot 2 may join"),
        (encode(Join(SCHEMA_VERSION, 3, "me")), 3, "no robot 3 may join"),
        (encode(Join(SCHEMA_VERSION, -1, "me")), 1, "no robot -1 may join"),
    ):
        refused = join(payload, key)
        assert isinstance(refused, Refusal)
        assert refused.error == "JoinError"
        assert reason in refused.detail
    first = join(encode(Join(SCHEMA_VERSION, 1, "me")))
    assert isinstance(first, Briefing)
    assert join(encode(Join(SCHEMA_VERSION, 1, "me"))) == first  # its answer may have been lost
    assert join(encode(Join(SCHEMA_VERSION, 1, "another"))) == Refusal(
        "JoinError", "robot 1 has joined already"
    )


def test_a_second_process_under_a_taken_identity_is_refused(tmp_path: Path):
    port = free_port()
    scenario = tmp_path / "cave.toml"
    scenario.write_text(
        'algorithm = "mr-dfs"\nteam = {robots = 3}\n'
        'world = {generate = {kind = "cave", vertices = 1000, loops = 8}}\n'
        f"network = {{port = {port}}}\n"
    )
    with started_cli(
        scenario, "--json", "--no-picture", cwd=tmp_path, folder=tmp_path / "run"
    ) as run:
        run.all_there(3)
        run.plays()
        users = dict(line.split(":") for line in (run.folder / "users").read_text().splitlines())
        name = read_opening(run.journal).run
        command = [sys.executable, "-m", "agents.node", "--run", name, "--port", str(port)]
        second = subprocess.run(
            [*command, "--robot", "1"],
            env={**os.environ, PASSWORD: users["robot-1"]},
            capture_output=True,
            text=True,
            timeout=WAIT_S,
            check=False,
        )
        assert run.process.poll() is None, "the run was over too soon to tell"
        said = run.finish()
    assert second.returncode == NOT_JOINED == 2
    assert second.stderr == "JoinError: robot 1 has joined already\n"
    assert said.code == 0, said
    assert said.result["robots_lost"] == []


# The store.


def test_the_store_ends_with_the_tags_of_the_world(tmp_path: Path):
    for fields in ({}, {"faults": [{"kill": "robot:1", "at": 3}]}, {"durability": "power"}):
        setting = setting_of(SMALL, 3, **fields)
        run = play(setting, tmp_path, "processes")
        check_tags_left(run.folder, tag_format_of(setting.scenario))


def check_tags_left(folder: RunDir, tag_format: str) -> None:
    world = replay(folder.journal).world
    expected = {
        place: (world.revisions[place], world.tags[place])
        for place in range(len(world.tags))
        if world.revisions[place]
    }
    assert expected
    with SqliteStore(
        folder.database,
        run="a look",
        capacity_bytes=888,
        fresh=False,
        durability="process",
        tag_format=tag_format,
    ) as store:
        found = {place: (tag.revision, tag.tag) for place, tag in store.tags().items()}
    assert found == expected


@pytest.mark.parametrize("second", ["processes", "inprocess"])
def test_a_run_starts_on_the_tags_of_an_earlier_one(second: str, tmp_path: Path):
    scenario = write_scenario(tmp_path)
    database = ("--set", f"bookkeeping.database={tmp_path / 'tags.db'}")
    options = ("--json", "--no-picture", *database)
    first = run_cli("run", scenario, *options, "--out", tmp_path / "1", cwd=tmp_path)
    assert first.code == 0, first
    said = run_cli(
        *("run", scenario, *options, "--set", "bookkeeping.fresh=false"),
        *("--engine", second, "--out", tmp_path / "2"),
        cwd=tmp_path,
    )
    assert said.code == 0, said
    assert said.result["complete"] is True
    assert said.result["trace_sha256"] != first.result["trace_sha256"]
    world = replay(RunDir(tmp_path / "2").journal).world
    assert min(world.revisions) > 1  # they count on
    replayed = run_cli("replay", tmp_path / "2", "--json", cwd=tmp_path)
    assert replayed.result["trace_sha256"] == said.result["trace_sha256"]
    assert not (tmp_path / "2" / "bookkeeping.db").exists()


def test_both_engines_start_alike_on_the_tags_of_an_earlier_run(tmp_path: Path):
    scenario = write_scenario(tmp_path)
    traces = []
    for engine in ("processes", "inprocess"):
        database = tmp_path / f"{engine}.db"
        for fresh in ("true", "false"):
            said = run_cli(
                *("run", scenario, "--json", "--no-picture", "--engine", engine),
                *("--set", f"bookkeeping.database={database}"),
                *("--set", f"bookkeeping.fresh={fresh}"),
                *("--out", tmp_path / f"{engine}-{fresh}"),
                cwd=tmp_path,
            )
            assert said.code == 0, said
        traces.append(said.result["trace_sha256"])
    assert traces[0] == traces[1]
