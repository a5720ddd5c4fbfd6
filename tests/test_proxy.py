"""The fault proxy: what it holds, what it lets pass, and that nothing of it is left behind."""

import asyncio
import os
import socket
import struct
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import ExitStack, asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deploy import proxy as proxy_module
from deploy.proxy import HELD_MAX_BYTES, Proxy, _End, _Sign
from protocol.errors import MachineError
from protocol.seeds import spawn
from protocol.zenoh_link import Link, LinkConfig, free_port
from tests.runs import free

WAIT_S = 30.0
READ_BYTES = 256 * 1024
"""The event loop reads no more than this at once."""


async def eventually(condition: Callable[[], object]) -> None:
    """Let the event loop turn until something is so."""
    while not condition():  # noqa: ASYNC110  each turn may make it so, and there is no event for it
        await asyncio.sleep(0)


async def turns(number: int) -> None:
    for _ in range(number):
        await asyncio.sleep(0)


class Talk:
    """A socket that talks without blocking the loop."""

    def __init__(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        self.sock = sock
        self._loop = asyncio.get_running_loop()

    async def say(self, data: bytes) -> None:
        await self._loop.sock_sendall(self.sock, data)

    def say_end(self) -> None:
        self.sock.shutdown(socket.SHUT_WR)

    async def hear(self, size: int) -> bytes:
        """Read so many bytes, fewer only if the peer has ended."""
        heard = bytearray()
        while len(heard) < size:
            data = await self._loop.sock_recv(self.sock, min(size - len(heard), 1 << 20))
            if not data:
                break
            heard += data
        return bytes(heard)

    async def hear_some(self) -> bytes:
        return await self._loop.sock_recv(self.sock, READ_BYTES)

    async def hear_all(self) -> bytes:
        return await self.hear(1 << 40)

    async def hears_reset(self) -> bool:
        with pytest.raises(ConnectionResetError):
            await self.hear_all()
        return True

    def hears_nothing(self) -> bool:
        with suppress(BlockingIOError):
            self.sock.recv(1, socket.MSG_PEEK)
            return False
        return True

    def close(self) -> None:
        self.sock.close()

    def reset(self) -> None:
        self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.sock.close()


class Bench:
    """A proxy, what it stands before, and the clients that a test makes."""

    def __init__(self, stack: ExitStack) -> None:
        self._stack = stack
        self._loop = asyncio.get_running_loop()
        self.target_port = free_port()
        self.target: socket.socket | None = None
        self.start_target()
        self.proxy = Proxy(self.target_port)
        self.port = 0

    def start_target(self) -> None:
        self.target = self._stack.enter_context(socket.socket())
        self.target.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.target.setblocking(False)
        self.target.bind(("127.0.0.1", self.target_port))
        self.target.listen(256)

    def stop_target(self) -> None:
        assert self.target is not None
        self.target.close()

    async def client(self) -> Talk:
        talk = Talk(self._stack.enter_context(socket.socket()))
        await self._loop.sock_connect(talk.sock, ("127.0.0.1", self.port))
        return talk

    async def accepted(self) -> Talk:
        assert self.target is not None
        sock, _ = await self._loop.sock_accept(self.target)
        return Talk(self._stack.enter_context(sock))

    async def pair(self) -> tuple[Talk, Talk]:
        """Return both sides of a new connection through the proxy."""
        client = await self.client()
        return client, await self.accepted()

    def ends(self) -> set[_End]:
        """Return both ends of every connection, also of one that waits for the target."""
        return {end for known in self.proxy._ends for end in (known, known.other)}

    def held(self) -> int:
        """Return how many bytes wait in the proxy, towards the target and back."""
        return sum(end._held_bytes for end in self.ends())

    def an_end_waits(self) -> bool:
        """Tell whether the end of some bytes waits in the proxy."""
        return any(piece is _Sign.END for end in self.ends() for _, piece in end._held)


def sockets() -> int:
    count = 0
    for descriptor in Path("/proc/self/fd").iterdir():
        with suppress(FileNotFoundError):
            count += descriptor.readlink().name.startswith("socket:")
    return count


@asynccontextmanager
async def bench() -> AsyncIterator[Bench]:
    """A proxy before a listening target; afterwards nothing of it may be left."""
    complaints: list[dict[str, object]] = []
    loop: Any = asyncio.get_running_loop()
    loop.set_exception_handler(lambda _, said: complaints.append(said))
    before, tasks = sockets(), asyncio.all_tasks()
    async with asyncio.timeout(WAIT_S):
        with ExitStack() as stack:
            made = Bench(stack)
            made.port = await made.proxy.open()
            try:
                yield made
            finally:
                await made.proxy.close()
            assert asyncio.all_tasks() == tasks
            assert not made.proxy._ends
            assert free(made.port)
    assert sockets() == before
    assert [timer for timer in loop._scheduled if not timer.cancelled()] == []
    assert complaints == []


@pytest.fixture(autouse=True)
def nothing_to_warn_of(caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    yield
    assert [record for record in caplog.records if record.name == "asyncio"] == []


# Without a fault.


async def test_bytes_pass_in_both_directions_at_once():
    data = spawn(0, "bytes").randbytes(8 << 20)
    async with bench() as made:
        client, router = await made.pair()
        *_, there, back = await asyncio.gather(
            client.say(data), router.say(data[::-1]), router.hear(len(data)), client.hear(len(data))
        )
        assert there == data
        assert back == data[::-1]
        assert made.held() == 0


async def test_it_listens_outside_the_ephemeral_range():
    async with bench() as made:
        assert 20000 <= made.port < 28000
        assert not free(made.port)


async def test_a_port_that_was_just_taken_is_passed_over(monkeypatch: pytest.MonkeyPatch):
    with socket.socket() as taken:
        # As `free_port` looks: a port that was just closed is free.
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        taken.bind(("127.0.0.1", free_port()))
        taken.listen()
        ports = [taken.getsockname()[1], free_port()]
        monkeypatch.setattr(proxy_module, "free_port", iter(ports).__next__)
        proxy = Proxy(1)
        assert await proxy.open() == ports[1]
        await proxy.close()
        monkeypatch.setattr(proxy_module, "free_port", lambda: ports[0])
        with pytest.raises(MachineError, match=r"^cannot listen on 127\.0\.0\.1"):
            await Proxy(1).open()


async def test_one_who_does_not_listen_slows_the_other_down():
    data = spawn(1, "bytes").randbytes(32 << 20)
    async with bench() as made:
        client, router = await made.pair()
        saying = asyncio.create_task(client.say(data))
        await eventually(lambda: made.held() > HELD_MAX_BYTES)
        await turns(50)
        assert made.held() <= HELD_MAX_BYTES + READ_BYTES
        assert await router.hear(len(data)) == data
        await saying


async def fill(made: Bench, client: Talk) -> bytes:
    """Say just more than the sockets on the way to the target take, and return it."""

    def beyond() -> list[bool]:
        return [
            end._blocked
            for end in made.proxy._ends
            if end._transport is not None and end._transport.get_write_buffer_size()
        ]

    source, said = spawn(5, "bytes"), b""
    while not beyond():
        data = source.randbytes(10_000)
        await client.say(data)
        said += data
        await turns(1)
    # The first byte that a socket does not take stops the rest, so that a cut finds it.
    assert beyond() == [True]
    return said


async def test_the_last_end_closes_when_the_last_bytes_have_left():
    async with bench() as made:
        client, router = await made.pair()
        router.say_end()
        assert await client.hear_all() == b""
        said = await fill(made, client)
        client.say_end()
        await eventually(made.an_end_waits)
        assert await router.hear_all() == said
        await eventually(lambda: not made.proxy._ends)


async def test_what_comes_while_a_socket_is_about_to_go_on_waits_its_turn():
    async with bench() as made:
        client, router = await made.pair()
        await client.say(b"1")
        assert await router.hear(1) == b"1"
        for end in made.proxy._ends:
            end.pause_writing()
            end.send(b"2")
            end.resume_writing()
            end.send(b"3")
        assert await router.hear(2) == b"23"
        assert await client.hear(2) == b"23"


async def test_each_direction_ends_by_itself():
    async with bench() as made:
        client, router = await made.pair()
        await client.say(b"a question")
        client.say_end()
        assert await router.hear_all() == b"a question"
        await router.say(b"an answer, ")
        assert await client.hear(11) == b"an answer, "
        await router.say(b"and all of it")
        router.say_end()
        assert await client.hear_all() == b"and all of it"
        await eventually(lambda: not made.proxy._ends)


async def test_an_end_waits_for_the_bytes_before_it():
    data = spawn(2, "bytes").randbytes(16 << 20)
    async with bench() as made:
        client, router = await made.pair()
        saying = asyncio.create_task(client.say(data))
        router.say_end()
        assert await client.hear_all() == b""
        await eventually(lambda: made.held() > HELD_MAX_BYTES)
        heard = await router.hear(len(data))
        await saying
        client.close()
        assert heard + await router.hear_all() == data
        await eventually(lambda: not made.proxy._ends)


@pytest.mark.parametrize("first", ["client", "router"])
async def test_a_reset_is_passed_on(first: str):
    async with bench() as made:
        client, router = await made.pair()
        resets, hears = (client, router) if first == "client" else (router, client)
        resets.reset()
        assert await hears.hears_reset()
        await eventually(lambda: not made.proxy._ends)


async def test_a_reset_does_not_wait_for_one_who_does_not_listen():
    async with bench() as made:
        client, router = await made.pair()
        await fill(made, client)
        client.reset()
        await eventually(lambda: not made.proxy._ends)
        assert await router.hears_reset()


async def test_bytes_for_one_who_is_gone_reset_the_other():
    async with bench() as made:
        client, router = await made.pair()
        client.close()
        assert await router.hear_all() == b""
        with pytest.raises((ConnectionResetError, BrokenPipeError)):  # noqa: PT012  says until it hears
            while True:
                await router.say(b"still there?")
                await turns(1)
        await eventually(lambda: not made.proxy._ends)


# A cut.


async def test_a_cut_holds_both_directions_and_a_heal_lets_go():
    async with bench() as made:
        client, router = await made.pair()
        await client.say(b"before ")
        assert await router.hear(7) == b"before "
        made.proxy.cut()
        await client.say(b"there")
        await router.say(b"back")
        await eventually(lambda: made.held() == 9)
        await turns(20)
        assert client.hears_nothing()
        assert router.hears_nothing()
        made.proxy.heal()
        assert await router.hear(5) == b"there"
        assert await client.hear(4) == b"back"
        await client.say(b"after")
        assert await router.hear(5) == b"after"
        assert made.held() == 0


async def test_a_cut_while_bytes_flow_loses_none():
    data = spawn(3, "bytes").randbytes(24 << 20)
    async with bench() as made:
        client, router = await made.pair()
        saying = asyncio.gather(client.say(data), router.say(data[::-1]))
        heard = [await router.hear(1 << 20), await client.hear(1 << 20)]
        for _ in range(3):
            made.proxy.cut()
            await eventually(lambda: made.held() > 2 * HELD_MAX_BYTES)
            await turns(50)
            assert made.held() <= 2 * (HELD_MAX_BYTES + READ_BYTES)
            assert not saying.done()
            made.proxy.heal()
            heard[0] += await router.hear(4 << 20)
            heard[1] += await client.hear(4 << 20)
        left = len(data) - len(heard[0])
        there, back = await asyncio.gather(router.hear(left), client.hear(left))
        assert heard[0] + there == data
        assert heard[1] + back == data[::-1]
        await saying


async def test_after_a_cut_only_what_has_left_arrives():
    data = spawn(4, "bytes").randbytes(16 << 20)
    async with bench() as made:
        client, router = await made.pair()
        saying = asyncio.create_task(client.say(data))
        heard = await router.hear(1 << 20)
        made.proxy.cut()
        # Whatever the sockets had taken comes to an end, with most of the bytes still to come.
        await eventually(lambda: made.held() > HELD_MAX_BYTES)
        ends = list(made.proxy._ends)
        while not router.hears_nothing() or any(end._blocked for end in ends):
            heard += await router.hear_some()
        await turns(20)
        assert router.hears_nothing()
        assert len(heard) < len(data) - HELD_MAX_BYTES
        assert made.held() > HELD_MAX_BYTES
        made.proxy.heal()
        assert heard + await router.hear(len(data) - len(heard)) == data
        await saying


async def test_a_connection_made_in_a_cut_reaches_the_target_at_the_heal():
    async with bench() as made:
        made.proxy.cut()
        clients = [await made.client() for _ in range(3)]
        for number, client in enumerate(clients):
            await client.say(b"%d" % number)
        await eventually(lambda: made.held() == 3)
        assert made.target is not None
        with pytest.raises(BlockingIOError):
            made.target.accept()
        made.proxy.heal()
        routers = [await made.accepted() for _ in range(3)]
        assert sorted([await router.hear(1) for router in routers]) == [b"0", b"1", b"2"]


@pytest.mark.parametrize("first", ["client", "router"])
async def test_an_end_in_a_cut_is_heard_of_after_it(first: str):
    async with bench() as made:
        client, router = await made.pair()
        says, hears = (client, router) if first == "client" else (router, client)
        made.proxy.cut()
        await says.say(b"last words")
        says.close()
        await eventually(made.an_end_waits)
        await turns(20)
        assert hears.hears_nothing()
        made.proxy.heal()
        assert await hears.hear_all() == b"last words"


@pytest.mark.parametrize("first", ["client", "router"])
async def test_a_reset_in_a_cut_is_heard_of_after_it_and_drops_what_was_held(first: str):
    async with bench() as made:
        client, router = await made.pair()
        says, hears = (client, router) if first == "client" else (router, client)
        made.proxy.cut()
        await says.say(b"never mind")
        await eventually(lambda: made.held() == 10)
        says.reset()
        await eventually(lambda: len(made.proxy._ends) == 1)
        assert made.held() == 0
        await turns(20)
        assert hears.hears_nothing()
        made.proxy.heal()
        assert await hears.hears_reset()


async def test_the_target_never_hears_of_a_client_that_gives_up_in_a_cut():
    async with bench() as made:
        made.proxy.cut()
        for _ in range(3):
            client = await made.client()
            await client.say(b"anybody?")
            await eventually(lambda: made.held() == 8)
            client.reset()
            await eventually(lambda: not made.proxy._ends)
        made.proxy.heal()
        client, router = await made.pair()  # of all these the first to be accepted
        await client.say(b"now")
        assert await router.hear(3) == b"now"


async def test_a_reset_that_nobody_has_heard_yet_is_no_trouble_to_an_end():
    async with bench() as made:
        client, router = await made.pair()
        made.proxy.cut()
        saying = asyncio.create_task(router.say(bytes(32 << 20)))
        await eventually(lambda: made.held() > HELD_MAX_BYTES)  # the router is not read any more
        saying.cancel()
        await asyncio.wait([saying])
        router.reset()
        client.say_end()
        await eventually(made.an_end_waits)
        made.proxy.heal()
        assert await client.hears_reset()


async def test_what_is_due_in_a_cut_waits_for_the_heal():
    async with bench() as made:
        client, router = await made.pair()
        clock = asyncio.get_running_loop().time
        made.proxy.delay(0.005, 0.0, 0)
        await client.say(b"due soon")
        await eventually(lambda: made.held() == 8)
        made.proxy.cut()
        due = clock() + 0.005
        await eventually(lambda: clock() > due)
        await turns(20)
        assert router.hears_nothing()
        made.proxy.heal()
        assert await router.hear(8) == b"due soon"


# A delay.


async def test_each_chunk_is_late_by_its_draw_and_none_overtakes():
    async with bench() as made:
        client, router = await made.pair()
        made.proxy.delay(1000.0, 900.0, spawn(7, "late"))
        draws, clock = spawn(7, "late"), asyncio.get_running_loop().time
        earliest, latest = 0.0, 0.0
        bounds = []
        for size in range(1, 30):
            draw = draws.uniform(100.0, 1900.0)
            earliest = max(earliest, clock() + draw)
            await client.say(b"x" * size)
            await eventually(lambda: made.held() == size * (size + 1) // 2)  # noqa: B023  awaited here
            latest = max(latest, clock() + draw)
            bounds.append((earliest, latest))
        (far,) = [end for end in made.proxy._ends if end._held]
        assert all(
            low <= due <= high for (low, high), (due, _) in zip(bounds, far._held, strict=True)
        )
        assert router.hears_nothing()
        made.proxy.heal()  # ends the delay, too
        assert await router.hear(435) == b"x" * 435
        await client.say(b"at once")
        assert await router.hear(7) == b"at once"


async def test_nothing_arrives_before_its_time():
    async with bench() as made:
        client, router = await made.pair()
        clock = asyncio.get_running_loop().time
        made.proxy.delay(0.03, 0.01, 5)
        draws = spawn(5, "delay")
        for _ in range(3):
            for says, hears in ((client, router), (router, client)):
                sent = clock()
                await says.say(b"tick")
                assert await hears.hear(4) == b"tick"
                assert clock() >= sent + draws.uniform(0.02, 0.04)


async def test_a_delay_below_zero_is_none():
    async with bench() as made:
        client, router = await made.pair()
        made.proxy.delay(-1000.0, 0.0, 0)
        await client.say(b"quick")
        assert await router.hear(5) == b"quick"


async def test_an_end_is_as_late_as_bytes():
    async with bench() as made:
        client, router = await made.pair()
        made.proxy.delay(1000.0, 0.0, 0)
        client.say_end()
        await eventually(made.an_end_waits)
        await turns(20)
        assert router.hears_nothing()
        made.proxy.heal()
        assert await router.hear_all() == b""


async def test_a_shorter_delay_does_not_overtake_a_longer_one():
    async with bench() as made:
        client, router = await made.pair()
        made.proxy.delay(1000.0, 0.0, 0)
        await client.say(b"one ")
        await eventually(lambda: made.held() == 4)
        made.proxy.delay(0.0, 0.0, 0)
        await client.say(b"two")
        await eventually(lambda: made.held() == 7)
        await turns(20)
        assert router.hears_nothing()
        made.proxy.heal()
        assert await router.hear(7) == b"one two"


# Whatever happens.


WAYS = st.sampled_from(["there", "back"])
STEPS = st.lists(
    st.tuples(
        st.one_of(
            st.tuples(WAYS, st.integers(1, 400)),
            st.tuples(WAYS, st.integers(10_000, 1_500_000)),
            st.tuples(st.sampled_from(["cut", "heal"]), st.just(0)),
            st.tuples(st.just("delay"), st.sampled_from([0, 1, 5, 10_000_000])),
        ),
        st.integers(0, 40),
    ),
    max_size=25,
)


@given(steps=STEPS, seed=st.integers(0, 1000))
@settings(max_examples=100)
def test_all_bytes_arrive_in_order_after_any_faults(
    steps: list[tuple[tuple[str, int], int]], seed: int
):
    said = {"there": b"", "back": b""}

    async def play() -> None:
        source = spawn(seed, "bytes")
        async with bench() as made:
            client, router = await made.pair()
            mouths = {"there": client, "back": router}
            queues: dict[str, asyncio.Queue[bytes]] = {way: asyncio.Queue() for way in mouths}

            async def talk(way: str) -> None:
                while data := await queues[way].get():
                    await mouths[way].say(data)
                mouths[way].say_end()

            talking = [asyncio.create_task(talk(way)) for way in mouths]
            hearing = asyncio.gather(router.hear_all(), client.hear_all())
            for (what, number), pause in steps:
                if what in said:
                    data = source.randbytes(number)
                    said[what] += data
                    queues[what].put_nowait(data)
                elif what == "delay":
                    made.proxy.delay(number / 1000, number / 1000, seed)
                else:
                    {"cut": made.proxy.cut, "heal": made.proxy.heal}[what]()
                await turns(pause)
            for queue in queues.values():
                queue.put_nowait(b"")
            made.proxy.heal()
            assert tuple(await hearing) == (said["there"], said["back"])
            await asyncio.gather(*talking)

    asyncio.run(play())


# The target's own life.


async def test_without_a_target_a_client_is_reset_at_once_and_may_try_again():
    async with bench() as made:
        made.stop_target()
        for _ in range(3):
            client = await made.client()
            assert await client.hears_reset()
        made.start_target()
        client, router = await made.pair()
        await client.say(b"there you are")
        assert await router.hear(13) == b"there you are"


async def test_a_target_that_dies_in_a_cut_is_missed_after_it():
    async with bench() as made:
        client, router = await made.pair()
        made.proxy.cut()
        late = await made.client()
        router.reset()
        made.stop_target()
        await eventually(lambda: len(made.proxy._ends) == 2)  # both clients' ends
        await turns(20)
        assert client.hears_nothing()
        assert late.hears_nothing()
        made.proxy.heal()
        assert await client.hears_reset()
        assert await late.hears_reset()


async def test_a_restarted_target_is_reached_anew():
    async with bench() as made:
        client, router = await made.pair()
        made.stop_target()
        router.close()
        assert await client.hear_all() == b""
        made.start_target()
        client, router = await made.pair()
        await router.say(b"new")
        assert await client.hear(3) == b"new"


# Many, and the end.


async def test_many_connections_are_cut_and_healed_together():
    async with bench() as made:
        pairs = [await made.pair() for _ in range(100)]
        made.proxy.cut()
        for number, (client, router) in enumerate(pairs):
            await client.say(b"there %3d" % number)
            await router.say(b"back %3d" % number)
        await eventually(lambda: made.held() == 100 * (9 + 8))
        made.proxy.heal()
        for number, (client, router) in enumerate(pairs):
            assert await router.hear(9) == b"there %3d" % number
            assert await client.hear(8) == b"back %3d" % number


Trouble = Callable[[Bench, Talk, Talk], Awaitable[None]]


async def in_peace(_made: Bench, client: Talk, _router: Talk) -> None:
    await client.say(b"on its way")


async def in_a_cut(made: Bench, client: Talk, router: Talk) -> None:
    made.proxy.cut()
    await client.say(b"held")
    router.close()
    await made.client()
    await eventually(lambda: made.held() == 4)


async def late(made: Bench, client: Talk, _router: Talk) -> None:
    made.proxy.delay(1000.0, 0.0, 0)
    await client.say(b"late")
    await eventually(lambda: made.held() == 4)


async def crowded(made: Bench, client: Talk, _router: Talk) -> None:
    saying = asyncio.create_task(client.say(bytes(32 << 20)))
    await eventually(lambda: made.held() > HELD_MAX_BYTES)
    saying.cancel()
    await asyncio.wait([saying])


async def half_closed(made: Bench, client: Talk, router: Talk) -> None:
    client.say_end()
    assert await router.hear_all() == b""


async def just_connected(made: Bench, _client: Talk, _router: Talk) -> None:
    await made.client()


async def just_accepted(made: Bench, _client: Talk, _router: Talk) -> None:
    known = len(made.proxy._ends)
    await made.client()
    await eventually(lambda: len(made.proxy._ends) > known)


async def unanswered(made: Bench, _client: Talk, _router: Talk) -> None:
    assert made.target is not None
    made.target.listen(0)  # it answers no more than one
    for _ in range(3):
        await made.client()
    await turns(50)
    assert made.proxy._dials


async def just_healed(made: Bench, client: Talk, _router: Talk) -> None:
    made.proxy.cut()
    await client.say(b"held")
    await made.client()
    await eventually(lambda: made.held() == 4)
    made.proxy.heal()


async def closed_already(made: Bench, _client: Talk, _router: Talk) -> None:
    await made.proxy.close()


@pytest.mark.parametrize(
    "trouble",
    [
        in_peace,
        in_a_cut,
        late,
        crowded,
        half_closed,
        just_connected,
        just_accepted,
        unanswered,
        just_healed,
        closed_already,
    ],
)
async def test_closing_leaves_nothing_behind(trouble: Trouble):
    async with bench() as made:
        client, router = await made.pair()
        await trouble(made, client, router)
        await made.proxy.close()
        with suppress(ConnectionResetError):
            await client.hear_all()
        with pytest.raises(ConnectionRefusedError):
            await made.client()
        made.proxy.heal()  # too late to do anything
        assert asyncio.all_tasks() == {asyncio.current_task()}


@pytest.mark.parametrize("rounds", range(10))
@pytest.mark.parametrize("is_cut", [False, True])
async def test_closing_at_any_moment_of_a_connection_leaves_nothing_behind(
    rounds: int, is_cut: bool
):
    async with bench() as made:
        if is_cut:
            made.proxy.cut()
        # Connected by the kernel while the loop rests, so that each turn is seen.
        with ExitStack() as stack:
            for _ in range(3):
                stack.enter_context(socket.create_connection(("127.0.0.1", made.port)))
            await turns(rounds)
            await made.proxy.close()
            assert asyncio.all_tasks() == {asyncio.current_task()}
            assert not made.proxy._ends


async def test_a_proxy_that_was_never_opened_can_be_closed():
    await Proxy(1).close()


# Zenoh through it.


@asynccontextmanager
async def sessions(patience_s: float) -> AsyncIterator[tuple[Proxy, Link, Link]]:
    """A router, and a client of it behind a proxy."""
    run, port = f"test-{os.urandom(6).hex()}", free_port()
    proxy = Proxy(port)
    async with asyncio.timeout(WAIT_S):
        try:
            with Link(LinkConfig(run, port, "router", patience_s=patience_s)) as router:
                behind = LinkConfig(run, await proxy.open(), patience_s=patience_s)
                client = await asyncio.to_thread(Link, behind)
                try:
                    yield proxy, router, client
                finally:
                    # The loop must turn meanwhile: a link says goodbye, and waits to be heard.
                    proxy.heal()
                    await asyncio.to_thread(client.close)
        finally:
            await proxy.close()


async def test_a_zenoh_session_is_cut_and_healed_without_loss():
    async with sessions(patience_s=10.0) as (proxy, router, client):
        loop = asyncio.get_running_loop()
        key = client.keys.requests(0, "aa")
        heard: asyncio.Queue[bytes] = asyncio.Queue()

        def hear(data: bytes) -> None:
            loop.call_soon_threadsafe(heard.put_nowait, data)

        router.subscribe(key, hear)
        put = client.publisher(key, express=True)
        # The client sends nothing until it knows that somebody listens.
        while heard.empty():
            await asyncio.to_thread(put, b"first")
            await turns(100)
        put(b"0")
        while await heard.get() != b"0":
            pass
        proxy.cut()
        numbers = [b"%d" % number for number in range(1, 200)]
        for number in numbers:
            put(number)
        await eventually(lambda: sum(end._held_bytes for end in proxy._ends) > 199)
        await turns(100)
        assert heard.empty()
        proxy.heal()
        assert [await heard.get() for _ in numbers] == numbers


@pytest.mark.slow
async def test_a_token_ends_in_a_long_cut_and_comes_back():
    async with sessions(patience_s=1.0) as (proxy, router, client):
        loop = asyncio.get_running_loop()
        key = client.keys.alive(0, "aa")
        news: asyncio.Queue[tuple[str, bool]] = asyncio.Queue()

        def changed(token: str, there: bool) -> None:
            loop.call_soon_threadsafe(news.put_nowait, (token, there))

        router.watch(key, changed)
        client.announce(key)
        assert await news.get() == (key, True)
        for _ in range(2):
            proxy.cut()
            assert await news.get() == (key, False)
            proxy.heal()
            assert await news.get() == (key, True)
