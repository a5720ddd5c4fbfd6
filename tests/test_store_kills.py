"""Kill -9 of a store at any moment, on one file: nothing acknowledged is lost, nothing is done twice.

A wave's writes follow from its number, so whoever looks at the file knows what each batch left.
"""

import inspect
import os
import queue
import random
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from bookkeeping.sqlite_store import SqliteStore
from protocol.codec import decoder_of, encode
from protocol.errors import StoreError
from protocol.lifeline import PARENT
from protocol.messages import (
    SCHEMA_VERSION,
    AnyStoreReply,
    AnyStoreRequest,
    Batch,
    BatchReply,
    Hello,
    HelloReply,
    TagWrite,
)
from protocol.zenoh_link import Link, LinkConfig, free_port

ROOT = Path(__file__).resolve().parent.parent
CAPACITY_BYTES = 400
PLACES = 60
WAIT_S = 20
IN_FLIGHT = 8


def writes_of(wave: int) -> list[tuple[int, bytes]]:
    """Places and tags of a wave: any number of writes, up to the large batches of a busy world."""
    rng = random.Random(wave)
    size = rng.choice((1, 1, 3, 20, PLACES))
    return [
        (place, rng.randbytes(rng.randint(0, 400))) for place in rng.sample(range(PLACES), size)
    ]


def batch_after(tags: dict[int, TagWrite], wave: int, incarnation: int) -> Batch:
    """The batch of a wave, on the tags before it; they become those after it."""
    writes = tuple(
        TagWrite(place, tags[place].revision + 1 if place in tags else 1, tag)
        for place, tag in writes_of(wave)
    )
    tags.update({write.place: write for write in writes})
    return Batch(incarnation, wave, writes)


def opened(path: Path, run: str) -> SqliteStore:
    # Fresh means nothing to a run that goes on: it must not erase what it wrote.
    return SqliteStore(
        path, run=run, capacity_bytes=CAPACITY_BYTES, fresh=True, durability="process"
    )


class Ledger:
    """What is known of a file, and the look at it after each death.

    Attributes:
        path: the file.
        run: name of the run, the same for all processes.
        wave: the last one that was found in the file.
        tags: all tags after it.
        round: number of the life of the store, and of the world that speaks to it.
    """

    def __init__(self, path: Path, run: str) -> None:
        self.path = path
        self.run = run
        self.wave = 0
        self.tags: dict[int, TagWrite] = {}
        self.round = 0

    def check(self, acknowledged: int | None, ahead: int) -> None:
        """Open the file; it must hold what was acknowledged, and whole batches in order.

        Args:
            acknowledged: the last wave that the store has answered in this round; ``None``: it has
                not even answered hello.
            ahead: how many waves may be there besides.
        """
        with opened(self.path, self.run) as store:
            if acknowledged is None:
                acknowledged = self.wave
            else:
                with pytest.raises(StoreError, match="refused"):
                    store.hello(self.round - 1)
            wave = store.hello(self.round)
            assert acknowledged <= wave <= acknowledged + ahead
            last = Batch(self.round, wave, ())
            while self.wave < wave:
                self.wave += 1
                last = batch_after(self.tags, self.wave, self.round)
            # Revisions count the writes: so nothing was applied twice, ...
            assert store.tags() == self.tags
            # ... and a batch that comes once more still is not.
            assert store.apply(last) == wave
            assert store.tags() == self.tags


# The store alone. The child says how far it is: "up", then the wave at hello, then each wave.
# It gets the text of our functions: importing this module would take longer than it lives.

CHILD = f"""
import os, random, sys
from bookkeeping.sqlite_store import SqliteStore
from protocol.messages import Batch, TagWrite
CAPACITY_BYTES, PLACES = {CAPACITY_BYTES}, {PLACES}
Path = str
{inspect.getsource(writes_of)}
{inspect.getsource(batch_after)}
{inspect.getsource(opened)}
path, run, incarnation = sys.argv[1], sys.argv[2], int(sys.argv[3])
os.write(1, b"up\\n")
store = opened(path, run)
wave = store.hello(incarnation)
os.write(1, b"%d\\n" % wave)
tags = store.tags()
while True:
    wave += 1
    batch = batch_after(tags, wave, incarnation)
    assert store.apply(batch) == wave
    os.write(1, b"%d\\n" % wave)
    if wave % 7 == 0:
        assert store.apply(batch) == wave
    if wave % 90 == 0:
        store.close()
        store = opened(path, run)
"""


def spin(turns: int) -> None:
    """Let some of the other process's time pass."""
    for _ in range(turns):
        pass


def kill_store(ledger: Ledger, rng: random.Random) -> None:
    """Let a store write, kill it after so many lines and a while, and look at what is there."""
    ledger.round += 1
    command = [sys.executable, "-c", CHILD, str(ledger.path), ledger.run, str(ledger.round)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        try:
            said = [child.stdout.readline() for _ in range(rng.choice((1, 1, 2, 3, 10, 60, 300)))]
            spin(rng.randrange(20_000))
        finally:
            os.kill(child.pid, signal.SIGKILL)
        said += child.stdout.readlines()
    assert child.returncode == -signal.SIGKILL
    # At most the one wave under way is there besides.
    ledger.check(int(said[-1]) if len(said) > 1 else None, ahead=1)


# The whole process, asked over the link as the world server asks it, but more in flight at a time.


class World:
    """A world server's side of the link."""

    def __init__(self, link: Link) -> None:
        self._put = link.publisher(link.keys.store_requests)
        self._decode: Any = decoder_of(AnyStoreReply)  # type: ignore[arg-type]
        self._replies: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        link.subscribe(link.keys.store_replies, self._replies.put)

    def ask(self, request: AnyStoreRequest) -> None:
        """Send a request."""
        self._put(encode(request))

    def hear(self, timeout_s: float) -> HelloReply | BatchReply | None:
        """Wait for a reply, so long at most (0: take what is there)."""
        try:
            payload = self._replies.get(block=timeout_s > 0, timeout=timeout_s)
        except queue.Empty:
            return None
        reply = self._decode(payload)
        assert isinstance(reply, HelloReply | BatchReply), reply
        return reply


@contextmanager
def world_of(run: str) -> Iterator[tuple[World, int]]:
    """A router with the world on it, and its port."""
    port = free_port()
    with Link(LinkConfig(run, port, "router")) as link:
        yield World(link), port


def kill_node(ledger: Ledger, rng: random.Random, world: World, port: int) -> None:
    """Let the process of the store write, kill it after so many replies, and look."""
    ledger.round += 1
    command = [sys.executable, "-m", "bookkeeping.node", str(ledger.path), "--run", ledger.run]
    command += ["--port", str(port), "--capacity-bytes", str(CAPACITY_BYTES)]
    environment = {**os.environ, PARENT: str(os.getpid())}
    with subprocess.Popen(command, cwd=ROOT, env=environment) as node:
        try:
            acknowledged = ask_node(ledger, rng.choice((0, 1, 5, 40)), world)
            spin(rng.randrange(20_000))
        finally:
            os.kill(node.pid, signal.SIGKILL)
    assert node.returncode == -signal.SIGKILL
    while (reply := world.hear(0)) is not None:
        acknowledged = max(acknowledged, reply.wave)
    ledger.check(acknowledged, ahead=IN_FLIGHT)


def ask_node(ledger: Ledger, replies: int, world: World) -> int:
    """Say hello, then send batches until so many are acknowledged; return the last that is."""
    reply = None
    for _ in range(100 * WAIT_S):  # nobody hears the first ones
        world.ask(Hello(SCHEMA_VERSION, ledger.round))
        reply = world.hear(0.01)
        if isinstance(reply, HelloReply):
            break
    assert isinstance(reply, HelloReply), "the store does not answer"
    assert reply.wave == ledger.wave
    acknowledged = sent = ledger.wave
    tags = dict(ledger.tags)
    while acknowledged < ledger.wave + replies or sent == ledger.wave:
        while sent < acknowledged + IN_FLIGHT:
            sent += 1
            world.ask(batch_after(tags, sent, ledger.round))
        if replies:
            reply = world.hear(WAIT_S)
            assert reply is not None, "the store does not answer"
            acknowledged = max(acknowledged, reply.wave)
    return acknowledged


# The tests.


def kill_rounds(path: Path, rounds: int, node_every: int, seed: int) -> None:
    """Kill again and again on one file; every so many times the whole process."""
    rng = random.Random(seed)
    ledger = Ledger(path, f"test-{os.urandom(6).hex()}")
    with world_of(ledger.run) as (world, port):
        for number in range(1, rounds + 1):
            if number % node_every == 0:
                kill_node(ledger, rng, world, port)
            else:
                kill_store(ledger, rng)
    assert ledger.wave > rounds  # or they did nothing


def test_kill_9_loses_nothing_acknowledged(tmp_path: Path) -> None:
    kill_rounds(tmp_path / "tags.sqlite", rounds=12, node_every=6, seed=1)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_kill_9_loses_nothing_acknowledged_in_many_rounds(tmp_path: Path) -> None:
    kill_rounds(tmp_path / "tags.sqlite", rounds=200, node_every=8, seed=2)
