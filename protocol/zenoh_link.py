"""The one door to Zenoh.

Three ways to talk, each where it was measured to be the cheapest:

- the step: publish/subscribe on keys declared once, numbered, repeated until answered (`RobotLine`);
- rare calls: queries (`Link.ask`, `Link.answer`);
- life and death: liveliness tokens (`Link.announce`, `Link.watch`).

Everything a process must hear on its step path comes by one blocking `Inbox`, read by a thread of its
own; the event loop beside it keeps signals, timers and the end (`run_beside_loop`). A hand-over of each
message to the event loop cost a quarter of the throughput.

A link is always closed: a session left open can hang the exit of its process.
"""

import asyncio
import contextlib
import json
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Coroutine, Iterator, Sequence
from typing import Any, Literal, NoReturn, Self, TypeVar

import zenoh
from msgspec import Struct

from protocol.codec import decoder_of, encode
from protocol.errors import (
    CanopyError,
    FencedError,
    JoinError,
    MachineError,
    OutcomeUnknownError,
    RunError,
)
from protocol.keys import Keys
from protocol.messages import (
    SCHEMA_VERSION,
    Again,
    AnyReply,
    AnyRequest,
    Briefing,
    Join,
    NumberedReply,
    NumberedRequest,
    Refusal,
)

T = TypeVar("T")

REPEAT_S = 0.1
"""An unanswered request is repeated after this time at first."""

REPEAT_MAX_S = 1.6
"""The pause between repeats doubles up to this."""

_INBOX_SIZE = 4096


class Credentials(Struct, frozen=True):
    """A user of a run's router and its password."""

    user: str
    password: str


PASSWORD = "CANOPY_PASSWORD"  # noqa: S105  the name of a variable
"""Environment variable that holds the password of a process."""


def credentials_of(user: str) -> Credentials | None:
    """Return the credentials that the environment gives this process; ``None``: it gives none."""
    password = os.environ.get(PASSWORD)
    return None if password is None else Credentials(user, password)


class LinkConfig(Struct, frozen=True):
    """How a process talks.

    Attributes:
        run: name of the run.
        port: TCP port of the router on ``host``.
        mode: ``"router"`` listens and routes, ``"client"`` connects.
        credentials: who this process is; ``None`` in a run without access control.
        users: router only: file of those who may connect, a line ``user:password`` each; ``None``:
            everybody may do anything.
        robots: router only: number of robots, for access control.
        patience_s: after this silence the others take this process for gone. Half of it is the lease
            of its connection, the other half the time in which it may come back.
        host: where the router is.
    """

    run: str
    port: int
    mode: Literal["router", "client"] = "client"
    credentials: Credentials | None = None
    users: str | None = None
    robots: int = 0
    patience_s: float = 5.0
    host: str = "127.0.0.1"

    @property
    def keys(self) -> Keys:
        """The keys of the run."""
        return Keys(self.run)


class Inbox:
    """What arrives on one key expression, in order, read by blocking."""

    def __init__(self, subscriber: Any) -> None:  # noqa: ANN401  zenoh has no precise types
        self._receive = subscriber.recv

    def receive(self) -> tuple[str, bytes]:
        """Wait for the next message and return its key and bytes.

        Raises:
            RunError: If the link was closed meanwhile.
        """
        try:
            sample = self._receive()
        except zenoh.ZError as error:
            raise RunError(f"the link was closed: {error}") from None
        return str(sample.key_expr), sample.payload.to_bytes()

    def receive_bytes(self) -> bytes:
        """Wait for the next message and return its bytes only.

        Raises:
            RunError: If the link was closed meanwhile.
        """
        try:
            payload: bytes = self._receive().payload.to_bytes()
        except zenoh.ZError as error:
            raise RunError(f"the link was closed: {error}") from None
        return payload


class Link:
    """One Zenoh session. Use it as a context manager; it is closed on every way out."""

    def __init__(self, config: LinkConfig) -> None:
        """Open the session.

        Raises:
            MachineError: If the router's port is taken.
            RunError: If the router cannot be reached or refuses the credentials.
        """
        self.config = config
        self.keys = config.keys
        try:
            self._session = zenoh.open(_zenoh_config(config))
        except zenoh.ZError as error:
            where = f"{config.host}:{config.port}"
            if config.mode == "router":
                raise MachineError(
                    f"cannot listen on {where} ({_short(error)}); choose another [network] port"
                ) from None
            raise RunError(
                f"cannot reach the router on {where}, or it refuses this process: {_short(error)}"
            ) from None
        self._held: list[Any] = []

    def __enter__(self) -> Self:
        """Return the link itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the session."""
        self.close()

    def close(self) -> None:
        """Close the session; what blocks on an inbox is released."""
        self._held.clear()
        with contextlib.suppress(zenoh.ZError):
            self._session.close()  # type: ignore[no-untyped-call]

    def publisher(self, key: str, *, express: bool = False) -> Callable[[bytes], None]:
        """Declare a publisher and return its put.

        ``express`` sends each message by itself: quicker for a lone ping-pong, slower for a fan-out.
        """
        publisher = self._session.declare_publisher(
            key, congestion_control=zenoh.CongestionControl.BLOCK, express=express
        )
        self._held.append(publisher)

        send = publisher.put

        def put(payload: bytes) -> None:
            try:  # noqa: SIM105  on the step path, where `suppress` costs more than the rest
                send(payload)
            except zenoh.ZError:
                pass  # lost like a lost message: it is repeated

        return put

    def inbox(self, key: str) -> Inbox:
        """Subscribe to ``key`` and return where its messages arrive."""
        subscriber = self._session.declare_subscriber(key, zenoh.handlers.FifoChannel(_INBOX_SIZE))
        self._held.append(subscriber)
        return Inbox(subscriber)

    def subscribe(self, key: str, heard: Callable[[bytes], None]) -> None:
        """Call ``heard`` on a thread of Zenoh's with each message; it must not block."""
        self._held.append(
            self._session.declare_subscriber(key, lambda sample: heard(sample.payload.to_bytes()))
        )

    def answer(self, key: str, respond: Callable[[str, bytes], bytes]) -> None:
        """Answer queries on ``key`` with what ``respond`` makes of their key and payload."""

        def handle(query: Any) -> None:  # noqa: ANN401
            with query:
                payload = b"" if query.payload is None else query.payload.to_bytes()
                query.reply(query.key_expr, respond(str(query.key_expr), payload))

        self._held.append(self._session.declare_queryable(key, handle))

    def ask(self, key: str, payload: bytes, timeout_s: float) -> bytes:
        """Ask whoever answers queries on ``key``.

        Raises:
            OutcomeUnknownError: If no answer came; the question may or may not have been heard.
        """
        with contextlib.suppress(zenoh.ZError):
            for reply in self._session.get(key, payload=payload, timeout=timeout_s):
                if reply.ok is not None:
                    answer: bytes = reply.ok.payload.to_bytes()
                    return answer
        raise OutcomeUnknownError(f"no answer on {key} within {timeout_s:g} s")

    def announce(self, key: str) -> None:
        """Hold a liveliness token until the link closes or the process dies."""
        self._held.append(self._session.liveliness().declare_token(key))

    def watch(self, key: str, changed: Callable[[str, bool], None]) -> None:
        """Call ``changed`` on a thread of Zenoh's with each token that appears (True) or ends."""
        self._held.append(
            self._session.liveliness().declare_subscriber(
                key,
                lambda sample: changed(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT),
                history=True,
            )
        )


class RobotLine:
    """A robot's line to the world: one request at a time, numbered, repeated until answered."""

    def __init__(self, link: Link, robot: int, process: str = "", answered: int = 0) -> None:
        """Join the run, or join it again.

        Args:
            link: our session.
            robot: the identity to join under.
            process: what tells this process from any other; one that died and came back gives the
                same text as before.
            answered: how many requests were answered in its earlier lives.

        Raises:
            JoinError: If the world refuses.
            OutcomeUnknownError: If no world answers in time.
        """
        join = encode(Join(SCHEMA_VERSION, robot, process or os.urandom(8).hex()))
        decode = decoder_of(Briefing | Refusal)  # type: ignore[arg-type]  # a union is a type here
        answer: Any = decode(_insist(link, link.keys.join(robot), join))
        if isinstance(answer, Refusal):
            raise JoinError(answer.detail)
        self.briefing: Briefing = answer
        nonce = answer.nonce
        self._link = link
        self._inbox = link.inbox(link.keys.replies(robot, nonce))
        self._put = link.publisher(link.keys.requests(robot, nonce), express=True)
        self._decode = decoder_of(NumberedReply)
        self._seq = answered
        self._open: bytes | None = None
        self._repeat_at = 0.0
        self._pause_s = REPEAT_S
        link.announce(link.keys.alive(robot, nonce))

    def request(self, request: AnyRequest) -> AnyReply:
        """Ask the world for ``request`` and wait for the reply, however long it takes.

        Raises:
            FencedError: If the world has declared this robot lost.
            MessageError: If the reply is no message of this protocol.
        """
        return self._exchange(encode(NumberedRequest(self._seq + 1, request)))

    def fail(self) -> None:
        """Tell the world that the algorithm has failed, and wait until it has taken that down.

        It bears the number of the request that never came; there can be no other after it.

        Raises:
            FencedError: If the world has declared this robot lost.
        """
        robot, nonce = self.briefing.robot, self.briefing.nonce
        self._put = self._link.publisher(self._link.keys.failed(robot, nonce), express=True)
        self._exchange(encode(self._seq + 1))

    def _exchange(self, payload: bytes) -> AnyReply:
        self._seq = seq = self._seq + 1
        self._pause_s = REPEAT_S
        self._repeat_at = time.monotonic() + REPEAT_S
        self._open = payload
        self._put(payload)
        while True:
            reply = self._decode(self._inbox.receive_bytes())
            answer = reply.reply
            if isinstance(answer, Again):
                self._put(payload)  # it, or its answer, may have been lost while the world was away
            elif reply.seq == seq:  # anything else answers a repeat of an older request
                break
        self._open = None
        if isinstance(answer, Refusal) and answer.error == FencedError.__name__:
            raise FencedError(answer.detail)
        return answer

    def repeat_if_due(self) -> None:
        """Repeat the open request if it has gone unanswered for long; call it by a timer."""
        payload = self._open
        now = time.monotonic()
        if payload is not None and now >= self._repeat_at:
            self._pause_s = min(2 * self._pause_s, REPEAT_MAX_S)
            self._repeat_at = now + self._pause_s
            self._put(payload)


def _insist(link: Link, key: str, payload: bytes, patience_s: float = 30.0) -> bytes:
    """Ask until somebody answers.

    Raises:
        OutcomeUnknownError: If nobody does within ``patience_s``.
    """
    deadline = time.monotonic() + patience_s
    while True:
        asked = time.monotonic()
        try:
            return link.ask(key, payload, timeout_s=1.0)
        except OutcomeUnknownError:
            if time.monotonic() >= deadline:
                raise
            # An empty answer comes at once while nobody has declared the key yet.
            time.sleep(max(0.0, 0.02 - (time.monotonic() - asked)))


async def run_beside_loop(
    link: Link,
    work: Callable[[], T],
    *,
    every_s: float = 0.1,
    tick: Callable[[], None] | None = None,
) -> T | None:
    """Run blocking ``work`` in a thread beside the event loop, and close the link at the end.

    SIGTERM closes the link, which releases ``work``. ``tick`` is called by the clock, every
    ``every_s``, whatever the queues do.

    Returns:
        What ``work`` returns; ``None`` if the process was told to end first.

    Raises:
        Exception: Whatever ``work`` raises.
    """
    loop = asyncio.get_running_loop()
    done: asyncio.Future[T | None] = loop.create_future()

    def finish(result: T | None, error: BaseException | None) -> None:
        if not done.done():
            if error is None:
                done.set_result(result)
            else:
                done.set_exception(error)

    def body() -> None:
        try:
            result = work()
        except BaseException as error:  # noqa: BLE001  carried over to the loop
            loop.call_soon_threadsafe(finish, None, error)
        else:
            loop.call_soon_threadsafe(finish, result, None)

    def tick_again() -> None:
        # A bare timer: with many processes on few cores a heavier one shows in the throughput.
        if tick is not None and not done.done():
            loop.call_later(every_s, tick_again)
            tick()

    loop.add_signal_handler(signal.SIGTERM, finish, None, None)
    threading.Thread(target=body, daemon=True, name="step").start()
    loop.call_later(every_s, tick_again)
    try:
        return await done
    finally:
        link.close()


def run_process(name: str, main: Coroutine[Any, Any, int | None]) -> NoReturn:
    """Run the shell of a process to its end and exit.

    An error of ours is one line on stderr and exit code 2: starting the process again would not
    help. The exit is hard, because the step thread may still block in Zenoh.
    """
    code: int | None = 2
    try:
        code = asyncio.run(main)
    except CanopyError as error:
        sys.stderr.write(f"{name}: {error}\n")
    sys.stderr.flush()
    os._exit(code or 0)


def age_s() -> float:
    """Return how long ago this process was started, seconds (to 10 ms)."""
    with open("/proc/self/stat", encoding="ascii") as stat:  # noqa: PTH123  no need of a path
        started = int(stat.read().rpartition(")")[2].split()[19]) / os.sysconf("SC_CLK_TCK")
    return max(0.0, time.clock_gettime(time.CLOCK_BOOTTIME) - started)


def free_port(port: int = 0) -> int:
    """Return ``port`` if it is free, or for 0 a free one outside the ephemeral range.

    Raises:
        MachineError: If ``port`` is taken, or none can be found.
    """
    candidates: Iterator[int] | Sequence[int] = (port,)
    if port == 0:
        start = int.from_bytes(os.urandom(2), "little") % 8000
        candidates = (20000 + (start + 7 * step) % 8000 for step in range(200))
    for candidate in candidates:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(("127.0.0.1", candidate))
            except OSError:
                continue
            return candidate
    raise MachineError(
        f"field `network.port`: port {port} on 127.0.0.1 is already in use; choose another, or 0"
        if port
        else "no free port between 20000 and 28000 on 127.0.0.1"
    )


# Zenoh's configuration.


def _short(error: Exception) -> str:
    return str(error).split(" at /")[0].splitlines()[0]


def _zenoh_config(config: LinkConfig) -> Any:  # noqa: ANN401
    endpoint = f"tcp/{config.host}:{config.port}"
    settings: dict[str, Any] = {
        "mode": config.mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        # Each kill -9 of a process with shared memory would leave 17 MB in /dev/shm.
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": int(config.patience_s * 500),
        "transport/link/tx/keep_alive": 4,
    }
    if config.mode == "router":
        settings["listen/endpoints"] = [endpoint]
    else:
        settings["listen/endpoints"] = []
        settings["connect/endpoints"] = [endpoint]
        settings["connect/timeout_ms"] = 10_000
        settings["connect/retry"] = {
            "period_init_ms": 100,
            "period_max_ms": 100,
            "period_increase_factor": 1,
        }
    if config.credentials is not None:
        settings["transport/auth/usrpwd/user"] = config.credentials.user
        settings["transport/auth/usrpwd/password"] = config.credentials.password
    if config.users is not None:
        settings["transport/auth/usrpwd/dictionary_file"] = config.users
        settings["access_control"] = _access_control(config)
    made = zenoh.Config()
    for key, value in settings.items():
        made.insert_json5(key, json.dumps(value))
    return made


def _access_control(config: LinkConfig) -> dict[str, Any]:
    """Say who may use which keys: a robot its own, the store its own, and nothing else."""
    keys = config.keys
    own_messages = ["put", "declare_subscriber", "query", "reply", "declare_queryable"]
    rules: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []

    def allow(name: str, flows: list[str], messages: list[str], key_exprs: list[str]) -> str:
        rule = {"id": name, "permission": "allow", "flows": flows, "messages": messages}
        rules.append({**rule, "key_exprs": key_exprs})
        return name

    def grant(user: str, rule_names: list[str]) -> None:
        subjects.append({"id": user, "usernames": [user]})
        policies.append({"rules": rule_names, "subjects": [user]})

    both = ["ingress", "egress"]
    # Easily missed: without it a client never learns that the world listens, and sends nothing.
    world_listens = allow(
        "world-listens",
        ["egress"],
        ["declare_subscriber", "declare_queryable"],
        [keys.world_in, keys.join("*")],
    )
    for robot in range(config.robots):
        own = [keys.requests(robot), keys.failed(robot), keys.replies(robot), keys.join(robot)]
        grant(
            f"robot-{robot}",
            [
                allow(f"robot-{robot}-own", both, own_messages, own),
                allow(
                    f"robot-{robot}-alive", ["ingress"], ["liveliness_token"], [keys.alive(robot)]
                ),
                world_listens,
            ],
        )
    for user, own in (
        ("bookkeeping", [keys.store_requests, keys.store_replies]),
        ("supervisor", [keys.world_reports, keys.supervisor_reports]),
    ):
        grant(user, [allow(f"{user}-own", both, own_messages, own), world_listens])
    everything = ["put", "delete", "declare_subscriber", "query", "reply", "declare_queryable"]
    everything += ["liveliness_token", "declare_liveliness_subscriber", "liveliness_query"]
    grant("world", [allow("world-all", both, everything, [f"{keys.root}/**"])])
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }
