"""The processes engine: one process per robot, the world server, the store, and the router.

The supervisor (this process) writes the opening of the journal, starts everything, has the nemesis
carry out the faults that the world orders, and ends everything. What happened stands in the journal.
"""

import asyncio
import contextlib
import os
import secrets
import signal
import time
from collections.abc import Callable, Mapping
from typing import Any

from msgspec import Struct

from agents.node import FAILED, NOT_JOINED
from deploy.nemesis import FaultStory, Nemesis, proxied
from deploy.proxy import Proxy
from deploy.run_dir import RunDir
from deploy.setting import Setting, tag_format_of
from deploy.skew import clear, environment_of
from deploy.supervisor import Supervisor
from protocol.codec import decoder_of, encode
from protocol.errors import MessageError
from protocol.messages import (
    AnyReport,
    AnyWord,
    Ended,
    FaultOrder,
    KillOrder,
    Progress,
    Reaped,
    Up,
    WentOn,
)
from protocol.scenario import to_tree
from protocol.zenoh_link import PASSWORD, Credentials, Link, LinkConfig, free_port
from world_server.journal import Journal, opening

REMIND_S = 0.5
"""What the world may have missed is repeated this often."""

SETTLE_S = 0.2
"""After the end the world has so long to say when the run went on after the last faults."""

ROBOTS_LEAVE_S = 5.0
"""Robots that have been told of the end are gone after this time, or are killed."""


class Played(Struct):
    """What a journal does not tell of a run.

    Attributes:
        restarts: how often each piece of infrastructure, and each robot that is started again, was.
        failures: for each robot whose process failed by itself what it wrote last.
        stories: what became of each fault that the nemesis carried out, by its number.
        phases: for each life of the world how long the parts of its start took, seconds.
    """

    restarts: dict[str, int]
    failures: dict[int, str]
    stories: dict[int, FaultStory]
    phases: dict[int, dict[str, float]]

    def told(self, start_s: float) -> dict[str, Any]:
        """Return what the verdict is to be told: the arguments of `judge_journal` of these names.

        Args:
            start_s: when the run began, by the monotonic clock.
        """
        struck: dict[int, tuple[float, float | None]] = {}
        for number, story in self.stories.items():
            if story.struck_s is not None:
                on_s = None if story.went_on_s is None else max(0, story.went_on_s - story.struck_s)
                struck[number] = (story.struck_s - start_s, on_s)
        return {"restarts": self.restarts, "failures": self.failures, "struck": struck}


async def play(
    setting: Setting,
    run_dir: RunDir,
    run: str,
    show: Callable[[Progress], None],
    say: Callable[[str], None] = lambda _: None,
    *,
    snapshot_every: int | None = None,
) -> Played:
    """Play a run to its end.

    Args:
        setting: what is played.
        run_dir: where; the journal is written there.
        run: name of the run, unlike that of any other.
        show: called now and then with how far the run is.
        say: called with each line that the user should see.
        snapshot_every: requests between two snapshots of the world; default: as the world finds.

    Raises:
        MachineError: If the port is taken.
        RunError: If the run could not be carried to its end.
    """
    scenario = setting.scenario
    robots = scenario.team.robots
    port = free_port(scenario.network.port)
    journal = Journal(run_dir.journal, scenario.durability)
    journal.append(opening(run, "processes", to_tree(scenario), setting.ground, setting.starts))
    journal.close()
    passwords = _write_users(run_dir, robots)
    supervisor = Supervisor(run_dir.logs, run_dir.write_processes)
    names = {name for fault in scenario.faults for name in proxied(fault, robots)}
    proxies = {name: Proxy(port) for name in sorted(names)}
    try:
        ports = {name: await proxy.open() for name, proxy in proxies.items()}
        launch = _Launch(setting, run_dir, run, port, ports, supervisor, passwords)
        launch.snapshot_every = snapshot_every
        await launch.infrastructure()
        config = LinkConfig(
            run, port, credentials=Credentials("supervisor", passwords["supervisor"])
        )
        opened: asyncio.Task[Link] = asyncio.create_task(asyncio.to_thread(Link, config))
        with await _first(opened, supervisor) as link:
            team = _Team(link, supervisor, show)
            nemesis = Nemesis(scenario, run_dir, supervisor, proxies, tell=team.tell, say=say)
            team.nemesis = nemesis
            for robot in range(robots):
                await launch.robot(robot, team)
            try:
                await team.play()
            finally:
                await nemesis.heal()
            processes = [f"robot:{robot}" for robot in range(robots)]
            if team.status == "stalled" or not await supervisor.wait_for(processes, ROBOTS_LEAVE_S):
                await supervisor.end(processes)
            await supervisor.end()
    finally:
        try:
            await supervisor.end()
        finally:
            supervisor.end_now()
            for proxy in proxies.values():
                await proxy.close()
            run_dir.remove_processes()
    return Played(dict(supervisor.restarts), team.failures, nemesis.stories, team.phases)


async def _first(opened: "asyncio.Task[Link]", supervisor: Supervisor) -> Link:
    """Wait for our own link, or for the news that there will never be a router."""
    crashed = asyncio.ensure_future(supervisor.crash_loop())
    await asyncio.wait([opened, crashed], return_when=asyncio.FIRST_COMPLETED)
    if crashed.done():
        opened.add_done_callback(_close_quietly)
        crashed.result()
    crashed.cancel()
    return await opened


def _close_quietly(opened: "asyncio.Task[Link]") -> None:
    if not opened.cancelled() and opened.exception() is None:
        opened.result().close()


def _write_users(run_dir: RunDir, robots: int) -> dict[str, str]:
    """Draw a password for each process and write them where only we can read them."""
    names = ["world", "bookkeeping", "supervisor", *(f"robot-{robot}" for robot in range(robots))]
    passwords = {name: secrets.token_hex(16) for name in names}
    descriptor = os.open(run_dir.users, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    with os.fdopen(descriptor, "w", encoding="utf-8") as file:
        file.writelines(f"{name}:{password}\n" for name, password in passwords.items())
    return passwords


class _Launch:
    """How each process of a run is started.

    Attributes:
        snapshot_every: requests between two snapshots of the world; ``None``: as it finds.
    """

    snapshot_every: int | None = None

    def __init__(
        self,
        setting: Setting,
        run_dir: RunDir,
        run: str,
        port: int,
        ports: Mapping[str, int],
        supervisor: Supervisor,
        passwords: Mapping[str, str],
    ) -> None:
        self._setting = setting
        self._run_dir = run_dir
        self._run = run
        self._port = port
        self._ports = ports
        self._supervisor = supervisor
        self._passwords = passwords

    async def _start(self, name: str, command: list[str], **more: Any) -> None:  # noqa: ANN401
        """Start a process with its password, and with the clock that its faults shift."""
        environment = {}
        password = self._passwords.get(name.replace(":", "-"))
        if password is not None:
            environment[PASSWORD] = password
        if any(fault.skew == name for fault in self._setting.scenario.faults):
            environment |= environment_of(self._run_dir.clock_shift(name))
            more["reaped"] = clear
        await self._supervisor.start(name, command, environment=environment, **more)

    def _way(self, name: str) -> list[str]:
        """Return the arguments that say how a process reaches the router."""
        return ["--run", self._run, "--port", str(self._ports.get(name, self._port))]

    async def infrastructure(self) -> None:
        """Start the router, the world server and the store, as far as there are to be any."""
        scenario, start = self._setting.scenario, self._start
        team = ["--robots", str(scenario.team.robots)]
        folder = str(self._run_dir.path)
        router = scenario.network.router
        if router == "separate":
            command = ["-m", "deploy.router", folder, *self._way("router"), *team]
            await start("router", command, restart="always")
        command = ["-m", "world_server.node", folder, *self._way("world"), *team]
        command += ["--router", router]
        if self.snapshot_every is not None:
            command += ["--snapshot-every", str(self.snapshot_every)]
        await start("world", command, restart="always")
        if scenario.device.capacity:
            database = scenario.bookkeeping.database or str(self._run_dir.database)
            keep = [] if scenario.bookkeeping.fresh else ["--keep-tags"]
            capacity = ["--capacity-bytes", str(scenario.device.capacity)]
            durability = ["--durability", scenario.durability]
            keep += ["--tag-format", tag_format_of(scenario)]
            way = self._way("bookkeeping")
            await start(
                "bookkeeping",
                ["-m", "bookkeeping.node", database, *way, *capacity, *durability, *keep],
                restart="always",
            )

    async def robot(self, robot: int, team: "_Team") -> None:
        """Start the process of one robot."""
        scenario, name = self._setting.scenario, f"robot:{robot}"
        comes_back = scenario.team.on_crash == "restart"
        command = ["-m", "agents.node", "--robot", str(robot), *self._way(name)]
        command += ["--patience", str(scenario.network.patience_s)]
        if comes_back:
            command += ["--memory", str(self._run_dir.memory(robot))]
        await self._start(
            name,
            command,
            restart="killed" if comes_back else "never",
            ended=lambda code: team.ended(robot, code),
        )


class _Team:
    """The supervisor's part in the talk with the world.

    Attributes:
        status: how the run ended; ``None`` while it lasts.
        failures: what robots that failed by themselves wrote last.
        phases: for each life of the world how long the parts of its start took.
        nemesis: carries out faults.
    """

    nemesis: Nemesis

    def __init__(
        self, link: Link, supervisor: Supervisor, show: Callable[[Progress], None]
    ) -> None:
        self.status: str | None = None
        self.failures: dict[int, str] = {}
        self.phases: dict[int, dict[str, float]] = {}
        self._supervisor = supervisor
        self._show = show
        self._reaped: set[int] = set()
        self._ordered: dict[int, int] = {}  # by robot: the fault that is to kill it
        self._over = asyncio.Event()
        self._decode: Any = decoder_of(AnyReport)  # type: ignore[arg-type]
        self._put = link.publisher(link.keys.supervisor_reports)
        loop = asyncio.get_running_loop()

        def heard(payload: bytes) -> None:
            loop.call_soon_threadsafe(self._heard, payload)

        link.subscribe(link.keys.world_reports, heard)

    def tell(self, word: AnyWord) -> None:
        """Say something to the world; it may get lost, and is repeated."""
        self._put(encode(word))

    def ended(self, robot: int, code: int) -> None:
        """Take in that a robot's process ended, and keep why if it was its own doing."""
        # One that is to be killed may first be told so by a world that has come back.
        if code in (FAILED, NOT_JOINED) and robot not in self._ordered:
            self.failures[robot] = self._supervisor.log_of(f"robot:{robot}")
        self.reap(robot)

    def reap(self, robot: int) -> None:
        """Tell the world that a robot's process is dead."""
        self._reaped.add(robot)
        self.tell(Reaped(robot))
        if robot in self._ordered:
            self.nemesis.robot_killed(self._ordered[robot])

    async def play(self) -> None:
        """Wait for the end of the run, and repeat by the clock what the world may have missed."""
        crashed = asyncio.ensure_future(self._supervisor.crash_loop())
        over = asyncio.ensure_future(self._over.wait())
        try:
            while not over.done():
                await asyncio.wait([over, crashed], timeout=REMIND_S, return_when="FIRST_COMPLETED")
                if crashed.done():
                    crashed.result()
                self._remind()
            until = time.monotonic() + SETTLE_S
            while not self.nemesis.settled() and time.monotonic() < until:
                self.nemesis.remind()
                await asyncio.sleep(SETTLE_S / 10)
        finally:
            for task in (crashed, over):
                task.cancel()
                with contextlib.suppress(asyncio.CancelledError, Exception):
                    await task

    def _remind(self) -> None:
        for robot in self._reaped:
            self.tell(Reaped(robot))
        self.nemesis.remind()

    def _heard(self, payload: bytes) -> None:
        with contextlib.suppress(MessageError):
            report: AnyReport = self._decode(payload)
            match report:
                case KillOrder(fault=fault, robot=robot):
                    self._ordered[robot] = fault
                    if not self._supervisor.kill(f"robot:{robot}", signal.SIGKILL):
                        self.reap(robot)
                case FaultOrder(fault=fault):
                    self.nemesis.order(fault)
                case WentOn(fault=fault, at_s=at_s):
                    self.nemesis.went_on(fault, at_s)
                case Up(incarnation=incarnation, phases=phases):
                    if incarnation not in self.phases:
                        self.phases[incarnation] = phases
                        self._remind()
                case Progress() as progress:
                    self._show(progress)
                case Ended(status=status):
                    self.status = status
                    self._over.set()
