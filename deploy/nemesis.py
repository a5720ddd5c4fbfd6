"""The nemesis: carries out the faults of a run that are none of the world's own.

The world says when a fault is due (`FaultOrder`, or `KillOrder` for the loss of a robot) and repeats
itself until it hears that the fault was taken down, over its own death too; so a fault is known by its
number, and strikes once. Each ends by itself, and all that has not is healed before the run ends. What
struck, when, and how long it took until the run went on, is kept for the result.
"""

import asyncio
import os
import signal
import time
from collections.abc import Callable, Mapping

from msgspec import Struct

from deploy.proxy import Proxy
from deploy.run_dir import RunDir
from deploy.skew import set_clock
from deploy.supervisor import Supervisor
from protocol.faults import Fault
from protocol.messages import AnyWord, Struck, Taken
from protocol.records import framed
from protocol.scenario import Scenario
from protocol.seeds import Stream, spawn

TRY_AGAIN_S = 0.005
"""A process that is just being started again is struck when it is there."""

GIVE_UP_S = 5.0
"""A fault whose victim does not appear for so long does not strike."""


class FaultStory(Struct):
    """What became of one fault.

    Attributes:
        due_s: when the world gave the order.
        struck_s: when it struck; ``None``: it did not.
        went_on_s: when the first wave after it was committed; ``None``: none was.

    All by the monotonic clock, seconds.
    """

    due_s: float
    struck_s: float | None = None
    went_on_s: float | None = None


class Nemesis:
    """Carries out the faults of one run.

    Attributes:
        stories: what became of each fault that was due, by its number.
    """

    def __init__(
        self,
        scenario: Scenario,
        run_dir: RunDir,
        supervisor: Supervisor,
        proxies: Mapping[str, Proxy],
        *,
        tell: Callable[[AnyWord], None],
        say: Callable[[str], None],
    ) -> None:
        """Do nothing yet.

        Args:
            scenario: whose faults these are.
            run_dir: holds the files that they damage.
            supervisor: has the processes.
            proxies: the ways to the router that can be cut or slowed down, by process.
            tell: speaks to the world.
            say: shows a line to the user.
        """
        self.stories: dict[int, FaultStory] = {}
        self._scenario = scenario
        self._run_dir = run_dir
        self._supervisor = supervisor
        self._ways = {name: _Way(proxy) for name, proxy in proxies.items()}
        self._tell = tell
        self._say = say
        self._acts: set[asyncio.Task[None]] = set()
        self._frozen: set[str] = set()
        self._taken: set[int] = set()
        self._log_line(f"seed {scenario.seed}, {len(scenario.faults)} faults")

    # What the world says.

    def order(self, number: int) -> None:
        """Take down a fault that is due; the world waits until it strikes, or for its delay."""
        if number not in self.stories:
            self.stories[number] = FaultStory(time.monotonic())
            self._log_line(f"fault {number} is due: {self._scenario.faults[number]}")
            act = asyncio.get_running_loop().create_task(self._act(number))
            self._acts.add(act)
            act.add_done_callback(self._acts.discard)
        elif number in self._taken:
            self._tell(Taken(number))

    def robot_killed(self, number: int) -> None:
        """Take down that a robot's process was killed, as the world had ordered."""
        if number not in self.stories:
            self.stories[number] = FaultStory(time.monotonic())
            self._struck(number)

    def went_on(self, number: int, at_s: float) -> None:
        """Take down when the run went on after a fault."""
        story = self.stories.get(number)
        if story is not None and story.struck_s is not None and story.went_on_s is None:
            story.went_on_s = at_s
            after_s = max(0.0, at_s - story.struck_s)
            self._say(f"  {self._scenario.faults[number]}: went on after {after_s:.3f} s")
            self._log_line(f"fault {number}: went on after {after_s:.3f} s")

    def remind(self) -> None:
        """Repeat to the world what it has not answered yet."""
        for number, story in self.stories.items():
            if story.struck_s is not None and story.went_on_s is None:
                self._tell(Struck(number, story.struck_s))

    def settled(self) -> bool:
        """Tell whether it is known for each fault that struck when the run went on."""
        return all(
            story.went_on_s is not None
            for story in self.stories.values()
            if story.struck_s is not None
        )

    async def heal(self) -> None:
        """End all that lasts, and let nothing strike any more."""
        for act in self._acts:
            act.cancel()
        await asyncio.gather(*self._acts, return_exceptions=True)
        for name in list(self._frozen):
            self._thaw(name)
        for way in self._ways.values():
            way.heal()
        self._log_line("all healed")

    def _log_line(self, line: str) -> None:
        with (self._run_dir.logs / "nemesis.log").open("a", encoding="utf-8") as log:
            log.write(f"{time.monotonic():.3f} {line}\n")

    # The faults.

    async def _act(self, number: int) -> None:
        fault = self._scenario.faults[number]
        if fault.after_s:
            self._take(number)
            await asyncio.sleep(fault.after_s)
        await self._strike(number, fault)
        self._take(number)  # also if there was nothing to strike

    def _take(self, number: int) -> None:
        self._taken.add(number)
        self._tell(Taken(number))

    async def _strike(self, number: int, fault: Fault) -> None:
        rng = spawn(self._scenario.seed, "nemesis", number)
        match fault.word:
            case "kill":
                await self._kill(number, fault.targets[0])
            case "tear":
                await self._kill(number, "world", lambda: self._tear(rng))
            case "flip":
                await self._flip(number, fault, rng)
            case "pause":
                await self._pause(number, fault)
            case "skew":
                set_clock(self._run_dir.clock_shift(fault.targets[0]), fault.by_s)
                self._struck(number)
            case "partition" | "delay":
                await self._meddle(number, fault, rng)
            case _:
                raise AssertionError(f"{fault.what} is no fault for the nemesis")

    def _struck(self, number: int) -> None:
        now = time.monotonic()
        self.stories[number].struck_s = now
        self._log_line(f"fault {number} strikes: {self._scenario.faults[number].what}")
        self._take(number)
        self._tell(Struck(number, now))

    async def _signal(self, name: str, sign: signal.Signals) -> bool:
        """Send a signal to a process as soon as it is there."""
        give_up = time.monotonic() + GIVE_UP_S
        while not self._supervisor.kill(name, sign):
            if name.startswith("robot") or time.monotonic() > give_up:
                return False
            await asyncio.sleep(TRY_AGAIN_S)
        return True

    async def _kill(
        self, number: int, name: str, before_restart: Callable[[], None] | None = None
    ) -> None:
        if before_restart is not None:
            self._supervisor.before_restart(name, before_restart)
        if await self._signal(name, signal.SIGKILL):
            self._struck(number)

    def _tear(self, rng: Stream) -> None:
        """Leave half a record at the end of the journal, as a world does that dies while it writes."""
        record = framed(rng.randbytes(rng.randint(1, 64)))
        with self._run_dir.journal.open("ab") as journal:
            journal.write(record[: rng.randrange(1, len(record))])

    async def _flip(self, number: int, fault: Fault, rng: Stream) -> None:
        journal = fault.flip == "journal"
        path = self._run_dir.journal if journal else self._run_dir.database
        if not journal and self._scenario.bookkeeping.database is not None:
            path = path.__class__(self._scenario.bookkeeping.database)

        def flip() -> None:
            size = path.stat().st_size
            with path.open("r+b") as file:
                file.seek(rng.randrange(size // 4, max(size // 4 + 1, 3 * size // 4)))
                byte = file.read(1)
                file.seek(-1, os.SEEK_CUR)
                file.write(bytes((byte[0] ^ 1 << rng.randrange(8),)))

        await self._kill(number, "world" if journal else "bookkeeping", flip)

    async def _pause(self, number: int, fault: Fault) -> None:
        name = fault.targets[0]
        if await self._signal(name, signal.SIGSTOP):
            self._frozen.add(name)
            self._struck(number)
            await asyncio.sleep(fault.for_s)
            self._thaw(name)

    def _thaw(self, name: str) -> None:
        self._log_line(f"resume {name}")
        self._frozen.discard(name)
        self._supervisor.kill(name, signal.SIGCONT)

    async def _meddle(self, number: int, fault: Fault, rng: Stream) -> None:
        """Cut some off, or slow them down, for a while."""
        ways = [self._ways[name] for name in proxied(fault, self._scenario.team.robots)]
        for way in ways:
            way.begin(number, fault, spawn(rng.getrandbits(32), "delay"))
        self._struck(number)
        await asyncio.sleep(fault.for_s)
        for way in ways:
            way.end(number)
        self._log_line(f"fault {number} is over")


class _Way:
    """A process's way to the router, and the faults that meddle with it now."""

    def __init__(self, proxy: Proxy) -> None:
        self._proxy = proxy
        self._faults: dict[int, tuple[Fault, Stream]] = {}

    def begin(self, number: int, fault: Fault, stream: Stream) -> None:
        """Let one more fault meddle with it."""
        self._faults[number] = fault, stream
        if fault.word == "partition":
            self._proxy.cut()
        else:
            self._proxy.delay(fault.delay_s, fault.jitter_s, stream)

    def end(self, number: int) -> None:
        """End one fault; the others go on."""
        del self._faults[number]
        if not any(fault.word == "partition" for fault, _ in self._faults.values()):
            self._proxy.heal()  # which ends delays as well
            for fault, stream in self._faults.values():
                self._proxy.delay(fault.delay_s, fault.jitter_s, stream)

    def heal(self) -> None:
        """End all faults."""
        self._faults.clear()
        self._proxy.heal()


def proxied(fault: Fault, robots: int) -> list[str]:
    """Return the processes whose way to the router a fault meddles with."""
    if fault.word not in ("partition", "delay"):
        return []
    names: list[str] = []
    for target in fault.targets:
        if target == "halves":
            names += (f"robot:{robot}" for robot in range(robots // 2, robots))
        else:
            names.append(target)
    return names
