"""The Body: all that a robot algorithm can do, and the hand that drives it.

An algorithm is a coroutine over its Body, driven by `coroutine.send`, never by an event loop. One
await is one request: one message on the wire, one line of the trace, one possible moment of death.
"""

from collections.abc import Callable, Coroutine, Generator
from traceback import walk_tb
from types import coroutine
from typing import Any, get_args

from protocol.errors import AlgorithmError
from protocol.messages import (
    PAYLOAD_BYTES_MAX,
    AnyRequest,
    Briefing,
    Exchange,
    Look,
    Move,
    Sight,
    Stop,
    Wait,
    WaitForNews,
    Write,
)
from protocol.seeds import Stream, spawn

Ask = Generator[AnyRequest, Any, Any]
"""What every method of a Body returns: to be awaited, and answered with what the robot sees next."""


class Body:
    """What one robot can do, and what it knows from the beginning.

    Attributes:
        robot: its own id.
        team_size: number of robots that set out (the papers' k).
        briefing: everything it was told beforehand.
        rng: its own random stream; the only randomness an algorithm may use.
    """

    __slots__ = ("briefing", "rng", "robot", "team_size")

    def __init__(self, briefing: Briefing) -> None:
        self.briefing = briefing
        self.robot = briefing.robot
        self.team_size = briefing.team_size
        self.rng: Stream = spawn(briefing.seed, "robot", briefing.robot)

    @coroutine
    def look(self, *, gaze: int | None = None, messages: tuple[bytes, ...] = ()) -> Ask:
        """See this place (free).

        ``gaze`` is the direction to look in, on a grid.
        """
        _check(None, messages)
        if gaze is not None:
            _check_gaze(gaze)
        return (yield Look(None, messages, gaze))

    @coroutine
    def write(self, tag: bytes, messages: tuple[bytes, ...] = ()) -> Ask:
        """Write the tag of this place and see it in the next round (free)."""
        _check(tag, messages)
        return (yield Write(tag, messages))

    @coroutine
    def exchange(self, *messages: bytes) -> Ask:
        """Send messages and see what has come by the next round (free)."""
        _check(None, messages)
        return (yield Exchange(None, messages))

    @coroutine
    def move(
        self,
        exit_: int,
        *,
        gaze: int | None = None,
        tag: bytes | None = None,
        messages: tuple[bytes, ...] = (),
    ) -> Ask:
        """Write the tag if one is given, leave by port ``exit_`` and arrive (one move).

        ``gaze`` is the direction to look in there, on a grid.
        """
        if exit_.__class__ is not int or not -EXIT_MAX < exit_ < EXIT_MAX:
            raise AlgorithmError(f"move by exit {exit_!r}; expected the number of a port")
        if gaze is not None:
            _check_gaze(gaze)
        if messages or tag.__class__ not in PLAIN_TAGS or (tag and len(tag) > TAG_BYTES_UNCHECKED):
            _check(tag, messages)
        return (yield Move(tag, messages, exit_, gaze))

    @coroutine
    def wait(
        self,
        duration: float = 1.0,
        *,
        tag: bytes | None = None,
        messages: tuple[bytes, ...] = (),
    ) -> Ask:
        """Stay for ``duration`` time units (that many ticks in lockstep)."""
        if messages != () or tag is not None:
            _check(tag, messages)
        return (yield Wait(tag, messages, _time(duration)))

    @coroutine
    def wait_for_news(
        self,
        *,
        at_most: float | None = None,
        words: int = 1,
        tag: bytes | None = None,
        messages: tuple[bytes, ...] = (),
    ) -> Ask:
        """Stay until a message, a loss notice or a change of the tag here (as long as it takes).

        ``at_most`` bounds the wait (time units; whole ticks in lockstep). Fewer than ``words``
        messages do not end it, so that who awaits several is not woken by each.
        """
        _check(tag, messages)
        if words < 1:
            raise AlgorithmError(f"wait for {words} words; expected at least 1")
        until = None if at_most is None else _time(at_most)
        return (yield WaitForNews(tag, messages, until, words))

    def last_words(self, *, tag: bytes | None = None, messages: tuple[bytes, ...] = ()) -> Stop:
        """Return what the algorithm returns to stop with a last tag or message (free).

        An algorithm that returns ``None`` stops without.
        """
        _check(tag, messages)
        return Stop(tag, messages)


EXIT_MAX = 1 << 31
"""No vertex has more ports."""

PLAIN_TAGS = (bytes, None.__class__)

TAG_BYTES_UNCHECKED = 4096
"""A tag of at most this size fits a message, so that a plain move needs no closer look."""


def _check(tag: object, messages: object) -> None:
    """Refuse here what could not travel, so that all engines refuse it alike.

    Raises:
        AlgorithmError: If the tag is no bytes or a message is none, or both are too long.
    """
    if tag is not None and not isinstance(tag, bytes):
        raise AlgorithmError(f"tag {tag!r}; expected bytes")
    if not isinstance(messages, tuple) or not all(isinstance(one, bytes) for one in messages):
        raise AlgorithmError(f"messages {messages!r}; expected a tuple of bytes")
    size = sum(map(len, messages)) + len(tag or b"") + 16 * len(messages)
    if size > PAYLOAD_BYTES_MAX // 2:
        raise AlgorithmError(f"request of {size} bytes; expected at most {PAYLOAD_BYTES_MAX // 2}")


def _check_gaze(gaze: object) -> None:
    """Refuse a direction that is no number.

    Raises:
        AlgorithmError: If it is none.
    """
    if gaze.__class__ is not int or not -EXIT_MAX < gaze < EXIT_MAX:
        raise AlgorithmError(f"gaze {gaze!r}; expected the number of a direction, 0 to 3")


def _time(duration: float) -> float:
    """Return a duration as a float.

    Raises:
        AlgorithmError: If it is no number.
    """
    if isinstance(duration, bool) or not isinstance(duration, int | float):
        raise AlgorithmError(f"wait of {duration!r}; expected a number")
    return float(duration)


NO_LOOP = ("no running event loop", "There is no current event loop")
"""How asyncio says that nobody runs a loop."""

REQUEST_TYPES = frozenset(get_args(AnyRequest))
Algorithm = Callable[[Body], Coroutine[AnyRequest, Sight, Stop | None]]


class Driver:
    """Drives one algorithm by hand: a sight in, the next request out.

    Attributes:
        send: the bare hand, for those who cannot afford `next_request` and do its checks themselves.
    """

    __slots__ = ("_coroutine", "_name", "send")

    def __init__(self, algorithm: Algorithm, body: Body) -> None:
        self._name = getattr(algorithm, "__qualname__", str(algorithm))
        coroutine = algorithm(body)
        if not isinstance(coroutine, Coroutine):
            raise AlgorithmError(f"{self._name} is no coroutine function; expected `async def`")
        self._coroutine = coroutine
        self.send: Callable[[Sight | None], AnyRequest] = coroutine.send  # type: ignore[assignment]

    def next_request(self, sight: Sight | None) -> AnyRequest:
        """Give the algorithm what it sees (``None``: the beginning) and return what it asks next.

        Raises:
            AlgorithmError: If the algorithm awaits something that is not of its Body.
            Exception: Whatever the algorithm itself raises.
        """
        try:
            request = self.send(sight)
        except StopIteration as stop:
            return self.last_request(stop)
        except RuntimeError as error:
            foreign = self.foreign_loop(error)
            if foreign is None:
                raise
            raise foreign from error
        if request.__class__ not in REQUEST_TYPES:
            raise self.foreign_await(request)
        return request

    def last_request(self, stop: StopIteration) -> Stop:
        """Return the stop of an algorithm that has returned.

        Raises:
            AlgorithmError: If it returned something else than its last words.
        """
        last = Stop() if stop.value is None else stop.value
        if type(last) is not Stop:
            expected = "expected None or body.last_words(...)"
            raise AlgorithmError(f"{self._name} returned {last!r}; {expected}")
        return last

    def foreign_await(self, request: object) -> AlgorithmError:
        """Return the error of an algorithm that awaits ``request``, which is no request."""
        frame = self._coroutine.cr_frame  # type: ignore[attr-defined]
        return self._foreign(frame and frame.f_lineno, repr(request))

    def foreign_loop(self, error: RuntimeError) -> AlgorithmError | None:
        """Return the error of an algorithm that ended with ``error`` as it looked for an event loop.

        ``None`` if it ended with something else.
        """
        if not str(error).startswith(NO_LOOP):
            return None
        code = self._coroutine.cr_code  # type: ignore[attr-defined]
        frames = walk_tb(error.__traceback__)
        line = next((line for frame, line in frames if frame.f_code is code), None)
        return self._foreign(line, str(error))

    def _foreign(self, line: int | None, what: str) -> AlgorithmError:
        where = self._name if line is None else f"{self._name} near line {line}"
        return AlgorithmError(
            f"{where} awaits something that is not of its Body ({what}); "
            "an algorithm awaits only body.look(), body.move(...) and their like"
        )

    def close(self) -> None:
        """End the algorithm where it stands; it never resumes."""
        self._coroutine.close()
