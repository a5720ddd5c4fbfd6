"""Faults: what may happen to a run, in the words of a scenario."""

from collections.abc import Iterator
from math import inf, isfinite
from typing import Annotated, Literal

from msgspec import Meta

from protocol.section import Count, Misfit, Natural, Seconds, Section, Start


class Fault(Section, frozen=True, kw_only=True):
    """One scheduled fault: one word for what happens and to whom, and when it strikes.

    ``at`` is a virtual time, ``at_request`` the moment at which a robot would have made that request;
    ``after_s`` adds real seconds during which the run goes on, so that the fault strikes in the midst
    of things. Processes are ``"robot:3"``, ``"world"``, ``"bookkeeping"`` and, where it is a process of
    its own, ``"router"``. Faults of infrastructure, of the network and of clocks leave the trace as it
    is; the in-process engine has none of these and passes them over.
    """

    kill: str | None = None
    #: Kill -9 of a process. A robot is lost then (but see ``team.on_crash``); all others come back.
    pause: str | None = None  #: Freeze a process for ``for_s``.
    partition: str | tuple[str, ...] | None = None
    #: Cut a process, several, or ``"halves"`` (the upper half of the team) off from the
    #: router for ``for_s``.
    delay: str | tuple[str, ...] | None = None
    #: Let all that goes to and from these be late by ``delay_s``, for ``for_s``.
    skew: str | None = None  #: Shift the wall clock of a process by ``by_s``.
    erase_tag: Start | None = None  #: The tag of this vertex is blank until it is written again.
    corrupt_tag: Start | None = None  #: Some bits of the tag of this vertex flip.
    destroy_tag: Start | None = None  #: The device of this vertex is blank for ever.
    tear: Literal["journal"] | None = None
    #: Kill the world as it writes: half a record is left at the end of its journal.
    flip: Literal["journal", "bookkeeping"] | None = None
    #: Flip a bit in the middle of that file and kill who owns it: unless it hits bytes that mean
    #: nothing this is noticed, and ends the run.
    at: Annotated[float, Meta(ge=0)] | None = None  #: Virtual time at which it strikes.
    round: Natural = 0
    #: With ``at``: after how many rounds of that instant; 0: before anybody there acts.
    at_request: Count | None = None  #: In place of the robot's n-th request.
    of: str | None = None
    #: With ``at_request``: whose, such as ``"robot:3"``. Default: of the robot that the fault strikes.
    after_s: Seconds = 0.0  #: Real seconds later; not for the loss of a robot, nor for tags.
    for_s: Annotated[float, Meta(gt=0)] = 0.5  #: How long it lasts, real seconds.
    delay_s: Seconds = 0.05  #: With ``delay``: how late, real seconds.
    jitter_s: Seconds = 0.0  #: With ``delay``: more or less, up to this.
    by_s: float = 3600.0  #: With ``skew``: by how much, seconds; below 0: it goes back.

    @property
    def word(self) -> str:
        """What happens: the name of the field that says it."""
        return next(word for word in FAULT_WORDS if getattr(self, word) is not None)

    @property
    def targets(self) -> tuple[str, ...]:
        """The processes, files or vertices that it happens to, as the scenario spells them."""
        found = getattr(self, self.word)
        many = isinstance(found, tuple) and self.word not in TAG_WORDS
        return tuple(map(str, found)) if many else (str(found),)

    @property
    def robot(self) -> int | None:
        """The robot that it kills."""
        return robot_of(self.kill)

    @property
    def trigger(self) -> tuple[int, int] | None:
        """The robot and the number of its request in place of which the fault strikes."""
        if self.at_request is None:
            return None
        whose = self.of if self.of is not None else self.targets[0]
        robot = robot_of(whose)
        assert robot is not None
        return robot, self.at_request

    @property
    def place(self) -> int | None:
        """The place whose tag it strikes, by number; only where the scenario was prepared."""
        if self.word not in TAG_WORDS:
            return None
        place = getattr(self, self.word)
        assert isinstance(place, int)
        return place

    def __str__(self) -> str:
        when = f"at request {self.at_request}" if self.at is None else f"at t={self.at:g}"
        if self.at is None and self.of is not None:
            when += f" of {self.of}"
        when += f", round {self.round}" if self.round else ""
        when += f", {self.after_s:g} s later" if self.after_s else ""
        return f"{self.what} {when}"

    @property
    def what(self) -> str:
        """What happens to whom, in a few words."""
        words = f"{self.word} {', '.join(self.targets)}".replace("_tag", " tag of")
        if self.word == "delay":
            words += f" by {self.delay_s:g} s"
        if self.word == "skew":
            words += f" by {self.by_s:g} s"
        return f"{words} for {self.for_s:g} s" if self.word in LASTING_WORDS else words


TAG_WORDS = ("erase_tag", "corrupt_tag", "destroy_tag")
"""Faults of devices, which the world itself carries out; in every engine, and in the trace."""

LASTING_WORDS = ("pause", "partition", "delay")
"""Faults that last, and then pass by themselves."""

FAULT_WORDS = ("kill", *LASTING_WORDS, "skew", *TAG_WORDS, "tear", "flip")


def robot_of(process: str | None) -> int | None:
    """Return the number of the robot that a process is; ``None`` if it is none."""
    kind, colon, number = (process or "").partition(":")
    known = kind == "robot" and colon and number.isdecimal() and str(int(number)) == number
    return int(number) if known else None


def misfits_of(fault: Fault, robots: int, *, restart: bool, separate: bool) -> Iterator[Misfit]:
    """Check what types alone do not say.

    Args:
        fault: a fault of a scenario.
        robots: number of robots.
        restart: whether a robot's process that dies is started again.
        separate: whether the router is a process of its own.

    Yields:
        Each field that does not fit, as ``.name``.
    """
    words = [word for word in FAULT_WORDS if getattr(fault, word) is not None]
    if len(words) != 1:
        yield "", words or "none", f"exactly one of {', '.join(FAULT_WORDS)}"
        return
    word = fault.word
    if not getattr(fault, word) and isinstance(getattr(fault, word), tuple):
        yield f".{word}", [], "at least one process"
        return
    yield from _target_misfits(fault, robots, separate=separate)
    if (fault.at is None) == (fault.at_request is None):
        yield "", fault.what, "one of `at` and `at_request`"
    if fault.at == inf:
        yield ".at", fault.at, "a finite time"
    for name in ("after_s", "for_s", "delay_s", "jitter_s", "by_s"):
        if not isfinite(getattr(fault, name)):
            yield f".{name}", getattr(fault, name), "a finite time"
    if fault.at_request is not None:
        if fault.round:
            yield ".round", fault.round, "no round with `at_request`"
        whose = robot_of(fault.of if fault.of is not None else fault.targets[0])
        if whose is None or whose >= robots:
            yield ".of", fault.of or "none", f'"robot:0" to "robot:{robots - 1}"'
        if fault.robot is not None and fault.robot != whose and not restart:
            yield ".of", fault.of, f"{fault.kill!r}: the loss takes the place of its request"
    elif fault.of is not None:
        yield ".of", fault.of, "nothing without `at_request`"
    loss = fault.robot is not None and not restart
    if fault.after_s and (loss or word in TAG_WORDS):
        yield ".after_s", fault.after_s, "0: this fault is part of the trace"
    if fault.jitter_s > fault.delay_s:
        yield ".jitter_s", fault.jitter_s, "at most `delay_s`"


def _target_misfits(fault: Fault, robots: int, *, separate: bool) -> Iterator[Misfit]:
    """Check that what a fault strikes is there."""
    word = fault.word
    if word in TAG_WORDS or word in ("tear", "flip"):
        return
    many = word in ("partition", "delay")
    names = ["world", "bookkeeping", *(["router"] if separate else [])]
    if many and not separate:
        names.remove("world")  # it is the router then
    if many and separate:
        names.remove("router")
    for target in fault.targets:
        robot = robot_of(target)
        if (robot is not None and robot < robots) or target in names:
            continue
        if word == "partition" and target == "halves":
            continue
        expected = f'"robot:0" to "robot:{robots - 1}", ' + ", ".join(f'"{one}"' for one in names)
        if target == "router" and not separate:
            expected += '; with `network.router = "separate"` also "router"'
        yield f".{word}", target, expected
