"""The way of one process to the router, with faults on it: partition and delay.

A process that a fault of the scenario may cut off or slow down is given the port of a proxy of its own
instead of the router's. The proxy runs on the supervisor's event loop:

    process -- near end | far end -- router

TCP turns loss into delay, so a cut holds bytes and loses none; loss on the radio is the world's affair.
What a connection says (bytes, their end, a reset) waits at the end by which it leaves, in the order in
which it came. Nothing overtakes, and neither side learns of anything before the faults let it pass, not
even of the other's death.
"""

import asyncio
import contextlib
import socket
import struct
from collections import deque
from collections.abc import Callable, Coroutine
from enum import Enum, auto
from typing import Any

from protocol.errors import MachineError
from protocol.seeds import Stream, spawn
from protocol.zenoh_link import free_port

HELD_MAX_BYTES = 1 << 20
"""While more than this waits in one direction of a connection, its source is not read."""

_BACKLOG = 128
_PORTS_TRIED = 10
_LINGER_NOT = struct.pack("ii", 1, 0)


class _Sign(Enum):
    """What a connection says besides bytes."""

    END = auto()  # no more bytes this way; the other way stays open
    RESET = auto()


class _Faults:
    """What is wrong with the way at present; all ends of a proxy look at the same."""

    def __init__(self) -> None:
        self.cut = False
        self.lateness: Callable[[], float] | None = None

    def due(self, now: float) -> float:
        """Say when what arrives ``now`` may leave, by the loop's clock in seconds."""
        return now if self.lateness is None else now + self.lateness()


class _End(asyncio.Protocol):
    """One of the two sockets of a connection, and what waits to leave by it.

    Attributes:
        other: the end on the other side of the proxy.
        finished: the end of the bytes has left by this end.
    """

    other: "_End"

    def __init__(self, faults: _Faults, gone: Callable[["_End"], None]) -> None:
        self.finished = False
        self._loop = asyncio.get_running_loop()
        self._faults = faults
        self._gone = gone
        self._transport: asyncio.Transport | None = None
        self._closed = False
        self._blocked = False
        self._held: deque[tuple[float, bytes | _Sign]] = deque()
        self._held_bytes = 0
        self._timer: asyncio.Handle | None = None

    # What the socket says.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin to let leave what waits."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        # No more than one chunk beyond our reach when a cut comes, and an end of the bytes that is
        # passed on to an empty buffer, at once.
        transport.set_write_buffer_limits(0)
        self.flow()

    def data_received(self, data: bytes) -> None:
        """Pass bytes to the other end."""
        self.other.send(data)

    def eof_received(self) -> bool:
        """Pass the end of the bytes to the other end; keep the socket for the other direction."""
        self.other.send(_Sign.END)
        return True

    def connection_lost(self, exc: Exception | None) -> None:
        """Pass a reset to the other end, unless it was us who closed the socket."""
        self._closed = True
        self._clear()
        if exc is not None:
            self.other.send(_Sign.RESET)
        self._gone(self)

    def pause_writing(self) -> None:
        """Send no more for now."""
        self._blocked = True

    def resume_writing(self) -> None:
        """Go on: from the loop, as a transport must not be closed while it calls us."""
        self._blocked = False
        self._wake()

    # What the rest of the proxy says.

    def send(self, piece: bytes | _Sign) -> None:
        """Let ``piece`` leave by this end, after all that waits, once the faults let it."""
        faults = self._faults
        if not self._held and not faults.cut and faults.lateness is None and self._ready():
            self._leave(piece)
            return
        if self._closed:
            return
        if piece is _Sign.RESET:
            # Nobody is left whose bytes these are, nor does a reset wait for those in the socket.
            self._clear()
            self._blocked = False
        due = faults.due(self._loop.time())
        if self._held:
            due = max(due, self._held[-1][0])
        self._held.append((due, piece))
        if isinstance(piece, bytes):
            self._held_bytes += len(piece)
        self._choke()
        self._wake()

    def flow(self) -> None:
        """Let leave what is due, as long as the socket takes it."""
        self._timer = None
        now = self._loop.time()
        while self._held and self._held[0][0] <= now and not self._faults.cut and self._ready():
            _, piece = self._held.popleft()
            if isinstance(piece, bytes):
                self._held_bytes -= len(piece)
            self._leave(piece)
        self._choke()
        self._wake()

    def hurry(self) -> None:
        """Let leave all that waits, however late it should have been."""
        self._held = deque((0.0, piece) for _, piece in self._held)
        if self._timer is not None:
            self._timer.cancel()
        self.flow()

    def listen(self, *, on: bool) -> None:
        """Read from the socket, or let it wait."""
        if self._transport is not None:
            if on:
                self._transport.resume_reading()
            else:
                self._transport.pause_reading()

    def close(self) -> None:
        """Close the socket after what has left already."""
        if self._transport is not None:
            self._transport.close()

    def abort(self) -> None:
        """Close the socket now, with all that waits."""
        if self._transport is not None:
            self._transport.abort()

    # Within.

    def _ready(self) -> bool:
        transport = self._transport
        return transport is not None and not self._blocked and not transport.is_closing()

    def _leave(self, piece: bytes | _Sign) -> None:
        transport = self._transport
        assert transport is not None
        if isinstance(piece, bytes):
            transport.write(piece)
        elif piece is _Sign.RESET:
            self._reset(transport)
        else:
            try:
                transport.write_eof()
            except OSError:  # a reset that we have not heard of yet
                self._reset(transport)
                self.other.send(_Sign.RESET)
                return
            self.finished = True
            if self.other.finished:
                self.close()
                self.other.close()

    def _reset(self, transport: asyncio.Transport) -> None:
        # Closed without lingering, a socket tells its peer of a reset, not of an orderly end.
        with contextlib.suppress(OSError):
            transport.get_extra_info("socket").setsockopt(
                socket.SOL_SOCKET, socket.SO_LINGER, _LINGER_NOT
            )
        transport.abort()

    def _choke(self) -> None:
        self.other.listen(on=self._held_bytes <= HELD_MAX_BYTES)

    def _wake(self) -> None:
        """Call `flow` when the first of what waits is due; what blocks it now will call again."""
        if self._timer is None and self._held and not self._faults.cut and self._ready():
            self._timer = self._loop.call_at(self._held[0][0], self.flow)

    def _clear(self) -> None:
        self._held.clear()
        self._held_bytes = 0
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


class Proxy:
    """One process's way to the router; without a fault it passes on everything at once.

    It is opened once, used from the event loop that opened it, and always closed.
    """

    def __init__(self, target_port: int, *, host: str = "127.0.0.1") -> None:
        """Open nothing yet.

        Args:
            target_port: TCP port of the router.
            host: where the router is, and where the proxy listens.
        """
        self._host = host
        self._target_port = target_port
        self._faults = _Faults()
        self._listener: socket.socket | None = None
        # Those with a socket.
        self._ends: set[_End] = set()
        self._no_ends = asyncio.Event()
        self._no_ends.set()
        self._undialled: list[_End] = []
        self._admissions: set[asyncio.Task[None]] = set()
        self._dials: set[asyncio.Task[None]] = set()

    async def open(self) -> int:
        """Listen on a free port outside the ephemeral range and return it.

        A connection is made to the router for each that is accepted. If the router refuses, the
        client's is reset at once: it sees what it would see without a proxy, and tries again.

        Raises:
            MachineError: If there is no free port.
        """
        for _ in range(_PORTS_TRIED):
            port = free_port()
            with contextlib.suppress(OSError):  # somebody else was quicker
                self._listener = listener = socket.create_server(
                    (self._host, port), backlog=_BACKLOG
                )
                listener.setblocking(False)
                asyncio.get_running_loop().add_reader(listener, self._accept, listener)
                return port
        raise MachineError(f"cannot listen on {self._host}: each of {_PORTS_TRIED} ports is taken")

    def cut(self) -> None:
        """Let nothing pass, in either direction, until `heal`.

        Connections stay open, and new ones are accepted, but nothing of them reaches the router. What
        is sent is held up to `HELD_MAX_BYTES`, then the senders wait. If a connection ends, the other
        side learns of it at the heal only. What has left the proxy, into the buffers of the
        sockets, still arrives.
        """
        self._faults.cut = True

    def heal(self) -> None:
        """End the cut and the delays: what was held leaves now, in its order.

        What a connection that was reset meanwhile had left to say is dropped.
        """
        self._faults.cut = False
        self._faults.lateness = None
        self._dial()
        for end in list(self._ends):
            end.hurry()

    def delay(self, delay_s: float, jitter_s: float, seed: int | Stream) -> None:
        """Make each chunk late, until `heal`.

        A chunk is what one read gives, and leaves no earlier than the one before it. In a cut this
        changes nothing: nothing passes, and `heal` ends both.

        Args:
            delay_s: how late a chunk is on average.
            jitter_s: it is late by a uniform draw from delay minus jitter to delay plus jitter; a
                draw below zero is no delay.
            seed: of the draws, or their stream.
        """
        stream = spawn(seed, "delay") if isinstance(seed, int) else seed
        self._faults.lateness = lambda: stream.uniform(delay_s - jitter_s, delay_s + jitter_s)

    async def close(self) -> None:
        """Close every socket, whatever it still holds; returns when all are closed."""
        if self._listener is not None:
            asyncio.get_running_loop().remove_reader(self._listener)
            self._listener.close()
            self._listener = None
        self._undialled.clear()
        for dial in self._dials:
            dial.cancel()
        await asyncio.gather(*self._admissions, *self._dials, return_exceptions=True)
        for end in list(self._ends):
            end.abort()
        await self._no_ends.wait()

    def _accept(self, listener: socket.socket) -> None:
        # By hand: a server of asyncio's that is closed while it accepts loses track of a socket.
        try:
            sock, _ = listener.accept()
        except (BlockingIOError, ConnectionAbortedError):  # the client is gone already
            return
        near, far = _End(self._faults, self._gone), _End(self._faults, self._gone)
        near.other, far.other = far, near
        self._start(self._admissions, self._admit(near, sock))
        self._undialled.append(far)
        if not self._faults.cut:
            self._dial()

    def _dial(self) -> None:
        """Connect what waits for the router."""
        for far in self._undialled:
            self._start(self._dials, self._connect(far))
        self._undialled.clear()

    async def _admit(self, near: _End, sock: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        await loop.connect_accepted_socket(lambda: self._add(near), sock)

    async def _connect(self, far: _End) -> None:
        loop = asyncio.get_running_loop()
        try:
            await loop.create_connection(lambda: self._add(far), self._host, self._target_port)
        except OSError:
            far.other.send(_Sign.RESET)

    @staticmethod
    def _start(tasks: set[asyncio.Task[None]], work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)
        tasks.add(task)
        task.add_done_callback(tasks.discard)

    def _add(self, end: _End) -> _End:
        self._ends.add(end)
        self._no_ends.clear()
        return end

    def _gone(self, end: _End) -> None:
        self._ends.discard(end)
        if end.other in self._undialled:  # its client gave up in a cut
            self._undialled.remove(end.other)
        if not self._ends:
            self._no_ends.set()
