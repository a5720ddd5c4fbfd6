"""The floors of the processes engine: the bare exchange of equal messages, with no logic behind it.

    python -m benchmarks.floor robot PORT ROBOT FOLDER     what a robot of the floor is
    python -m benchmarks.floor store PORT FOLDER           a store that only acknowledges

Both ends block on their subscriber, with Zenoh set up as a run sets it up (embedded router, access
control, declared publishers). Floor 1 replays the waves between robots and world; floor 2 sends one
batch a round to a store as well, with at most one unacknowledged.
"""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
from msgspec import Struct

from protocol.zenoh_link import PASSWORD, Credentials, Link, LinkConfig, credentials_of, free_port

RUN = "floor"
END = b"end"


class Exchange(Struct, frozen=True):
    """One wave as it went over the wire.

    Attributes:
        robots: whose turn it was.
        replies: the bytes sent to each.
        batch: bytes for the store after this wave, if a round ended with it.
    """

    robots: tuple[int, ...]
    replies: tuple[bytes, ...]
    batch: bytes | None


def robot(port: int, number: int, folder: Path) -> None:
    """Answer each message with as many bytes as the recorded request had."""
    sizes: list[int] = msgspec.msgpack.decode((folder / f"robot-{number}").read_bytes())
    bodies = [bytes(size) for size in sizes]
    with Link(LinkConfig(RUN, port, credentials=credentials_of(f"robot-{number}"))) as link:
        inbox = link.inbox(link.keys.replies(number, "0"))
        put = link.publisher(link.keys.requests(number, "0"), express=True)
        put(bodies[0])
        for body in [*bodies[1:], b""]:
            if inbox.receive_bytes() == END:
                break
            put(body)


def store(port: int) -> None:
    """Acknowledge each batch."""
    with Link(LinkConfig(RUN, port, credentials=credentials_of("bookkeeping"))) as link:
        inbox = link.inbox(link.keys.store_requests)
        put = link.publisher(link.keys.store_replies)
        put(b"ready")
        while inbox.receive_bytes() != END:
            put(b"done")


def measure(
    exchanges: list[Exchange], request_sizes: list[list[int]], folder: Path, *, with_store: bool
) -> float:
    """Replay recorded waves and return the seconds that took."""
    robots = len(request_sizes)
    for number, sizes in enumerate(request_sizes):
        (folder / f"robot-{number}").write_bytes(msgspec.msgpack.encode(sizes))
    names = ["world", "bookkeeping", *(f"robot-{number}" for number in range(robots))]
    (folder / "users").write_text("".join(f"{name}:{name}\n" for name in names))
    port = free_port()
    config = LinkConfig(
        RUN, port, "router", Credentials("world", "world"), str(folder / "users"), robots
    )
    with Link(config) as link, _processes(port, robots, folder, with_store=with_store):
        inbox = link.inbox(link.keys.world_in)
        express = robots == 1
        puts = [
            link.publisher(link.keys.replies(number, "0"), express=express)
            for number in range(robots)
        ]
        put_store = link.publisher(link.keys.store_requests)
        for _ in range(robots + with_store):
            inbox.receive()
        unacknowledged = 0
        started = time.perf_counter()
        for exchange in exchanges:
            for number, reply in zip(exchange.robots, exchange.replies, strict=True):
                puts[number](reply)
            missing = len(exchange.robots)
            while missing:
                from_store = inbox.receive()[0].endswith("/bookkeeping")
                unacknowledged -= from_store
                missing -= not from_store
            if with_store and exchange.batch is not None:
                while unacknowledged:  # one batch in flight, as the real store has
                    inbox.receive()
                    unacknowledged -= 1
                put_store(exchange.batch)
                unacknowledged += 1
        seconds = time.perf_counter() - started
        for put in (*puts, put_store):
            put(END)
    return seconds


@contextmanager
def _processes(port: int, robots: int, folder: Path, *, with_store: bool) -> Iterator[None]:
    commands = [("bookkeeping", ["store", str(port), str(folder)])] if with_store else []
    commands += [
        (f"robot-{number}", ["robot", str(port), str(number), str(folder)])
        for number in range(robots)
    ]
    started = [
        subprocess.Popen(
            [sys.executable, "-m", "benchmarks.floor", *command],
            env={**os.environ, PASSWORD: name},
        )
        for name, command in commands
    ]
    try:
        yield
        for process in started:
            process.wait(timeout=20)
    finally:
        for process in started:
            process.kill()
            process.wait()


def main() -> None:
    """Be one of the floor's processes."""
    if sys.argv[1] == "robot":
        robot(int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4]))
    else:
        store(int(sys.argv[2]))


if __name__ == "__main__":
    main()
