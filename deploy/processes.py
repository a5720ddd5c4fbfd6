"""The processes engine: one process per robot, the world server, the store, and the router.

The supervisor (this process) writes the opening of the journal, starts everything, carries out the
kills that the world orders, and ends everything. What happened stands in the journal.
"""

import asyncio
import contextlib
import os
import secrets
import signal
from collections.abc import Callable
from typing import Any

from agents.node import FAILED, NOT_JOINED
from deploy.run_dir import RunDir
from deploy.setting import Setting, tag_format_of
from deploy.supervisor import Supervisor
from protocol.codec import decoder_of, encode
from protocol.errors import MessageError
from protocol.messages import AnyReport, Ended, KillOrder, Progress, Reaped
from protocol.scenario import to_tree
from protocol.zenoh_link import PASSWORD, Credentials, Link, LinkConfig, free_port
from world_server.journal import Journal, opening

ROBOTS_LEAVE_S = 5.0
"""Robots that have been told of the end are gone after this time, or are killed."""


async def play(
    setting: Setting, run_dir: RunDir, run: str, show: Callable[[Progress], None]
) -> tuple[dict[str, int], dict[int, str]]:
    """Play a run to its end.

    Args:
        setting: what is played.
        run_dir: where; the journal is written there.
        run: name of the run, unlike that of any other.
        show: called now and then with how far the run is.

    Returns:
        How often each piece of infrastructure had to be started again, and for each robot whose
        process failed by itself what it wrote last.

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
    try:
        await _start(setting, run_dir, run, port, supervisor, passwords)
        config = LinkConfig(
            run, port, credentials=Credentials("supervisor", passwords["supervisor"])
        )
        opened: asyncio.Task[Link] = asyncio.create_task(asyncio.to_thread(Link, config))
        with await _first(opened, supervisor) as link:
            team = _Team(link, supervisor, show)
            for robot in range(robots):
                await _start_robot(setting, run, port, robot, supervisor, passwords, team)
            await team.play()
            names = [f"robot:{robot}" for robot in range(robots)]
            if team.status == "stalled" or not await supervisor.wait_for(names, ROBOTS_LEAVE_S):
                await supervisor.end(names)
            await supervisor.end()
    finally:
        try:
            await supervisor.end()
        finally:
            supervisor.end_now()
            run_dir.remove_processes()
    return dict(supervisor.restarts), team.failures


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


async def _start(
    setting: Setting,
    run_dir: RunDir,
    run: str,
    port: int,
    supervisor: Supervisor,
    passwords: dict[str, str],
) -> None:
    """Start the infrastructure."""
    scenario = setting.scenario
    shared = ["--run", run, "--port", str(port)]
    team = ["--robots", str(scenario.team.robots)]
    folder = str(run_dir.path)
    if scenario.network.router == "separate":
        await supervisor.start(
            "router", ["-m", "deploy.router", folder, *shared, *team], restart=True
        )
    await supervisor.start(
        "world",
        ["-m", "world_server.node", folder, *shared, *team, "--router", scenario.network.router],
        environment={PASSWORD: passwords["world"]},
        restart=True,
    )
    if scenario.device.capacity:
        database = scenario.bookkeeping.database or str(run_dir.database)
        keep = [] if scenario.bookkeeping.fresh else ["--keep-tags"]
        capacity = ["--capacity-bytes", str(scenario.device.capacity)]
        durability = ["--durability", scenario.durability]
        keep += ["--tag-format", tag_format_of(scenario)]
        await supervisor.start(
            "bookkeeping",
            ["-m", "bookkeeping.node", database, *shared, *capacity, *durability, *keep],
            environment={PASSWORD: passwords["bookkeeping"]},
            restart=True,
        )


async def _start_robot(
    setting: Setting,
    run: str,
    port: int,
    robot: int,
    supervisor: Supervisor,
    passwords: dict[str, str],
    team: "_Team",
) -> None:
    patience = str(setting.scenario.network.patience_s)
    shared = ["--run", run, "--port", str(port), "--patience", patience]
    await supervisor.start(
        f"robot:{robot}",
        ["-m", "agents.node", "--robot", str(robot), *shared],
        environment={PASSWORD: passwords[f"robot-{robot}"]},
        ended=lambda code: team.ended(robot, code),
    )


class _Team:
    """The supervisor's part in the talk with the world."""

    def __init__(
        self, link: Link, supervisor: Supervisor, show: Callable[[Progress], None]
    ) -> None:
        self.status: str | None = None
        self.failures: dict[int, str] = {}
        self._supervisor = supervisor
        self._show = show
        self._reaped: set[int] = set()
        self._over = asyncio.Event()
        self._decode: Any = decoder_of(AnyReport)  # type: ignore[arg-type]
        self._put = link.publisher(link.keys.supervisor_reports)
        loop = asyncio.get_running_loop()

        def heard(payload: bytes) -> None:
            loop.call_soon_threadsafe(self._heard, payload)

        link.subscribe(link.keys.world_reports, heard)

    def ended(self, robot: int, code: int) -> None:
        """Take in that a robot's process ended, and keep why if it was its own doing."""
        if code in (FAILED, NOT_JOINED):
            self.failures[robot] = self._supervisor.log_of(f"robot:{robot}")
        self.reap(robot)

    def reap(self, robot: int) -> None:
        """Tell the world that a robot's process is dead."""
        self._reaped.add(robot)
        self._put(encode(Reaped(robot)))

    async def play(self) -> None:
        """Wait for the end of the run, and repeat by the clock what the world may have missed."""
        crashed = asyncio.ensure_future(self._supervisor.crash_loop())
        over = asyncio.ensure_future(self._over.wait())
        try:
            while not over.done():
                await asyncio.wait([over, crashed], timeout=0.5, return_when="FIRST_COMPLETED")
                if crashed.done():
                    crashed.result()
                for robot in self._reaped:
                    self._put(encode(Reaped(robot)))
        finally:
            for task in (crashed, over):
                task.cancel()
                with contextlib.suppress(asyncio.CancelledError, Exception):
                    await task

    def _heard(self, payload: bytes) -> None:
        with contextlib.suppress(MessageError):
            report = self._decode(payload)
            if isinstance(report, KillOrder):
                if not self._supervisor.kill(f"robot:{report.robot}", signal.SIGKILL):
                    self.reap(report.robot)
            elif isinstance(report, Progress):
                self._show(report)
            elif isinstance(report, Ended):
                self.status = report.status
                self._over.set()
