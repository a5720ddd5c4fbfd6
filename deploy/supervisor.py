"""The supervisor: starts processes, watches them, restarts infrastructure, ends everything.

Nothing outlives it: each process ties itself to the supervisor's life by the kernel (see
`protocol.lifeline`), and on every way out the supervisor kills what is left and reaps it.
Infrastructure that dies is started again, robots never: a dead robot is a lost robot.
"""

import asyncio
import contextlib
import os
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from protocol.errors import RunError
from protocol.lifeline import PARENT

RESTARTS_MAX = 20
"""A process that needs more restarts than this is in a crash loop."""

GRACE_S = 3.0
"""A process that was told to end is killed after this time."""


class Supervisor:
    """All processes of one run.

    Attributes:
        restarts: how often each piece of infrastructure was started again, 0 included.
    """

    def __init__(self, logs: Path, changed: Callable[[Mapping[str, int]], None]) -> None:
        """Start nothing yet.

        Args:
            logs: folder for what the processes write.
            changed: called with the pids of all living processes when they change.
        """
        self.restarts: dict[str, int] = {}
        self._logs = logs
        self._changed = changed
        self._processes: dict[str, asyncio.subprocess.Process] = {}
        self._watches: set[asyncio.Task[None]] = set()
        self._ending = False
        self._crash_loop: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    async def start(
        self,
        name: str,
        command: Sequence[str],
        *,
        environment: Mapping[str, str] | None = None,
        restart: bool = False,
        ended: Callable[[int], None] | None = None,
    ) -> None:
        """Start a Python process and watch it.

        Args:
            name: as in ``processes.json``.
            command: what follows the Python interpreter.
            environment: variables besides our own.
            restart: start it again when it dies.
            ended: called with the exit code each time it ends.
        """
        if restart:
            self.restarts.setdefault(name, 0)
        with (self._logs / f"{name.replace(':', '-')}.log").open("ab") as log:
            process = await asyncio.create_subprocess_exec(
                sys.executable,
                *command,
                stdin=asyncio.subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                process_group=0,  # Ctrl-C reaches the supervisor alone
                env={**os.environ, **(environment or {}), PARENT: str(os.getpid())},
            )
        self._processes[name] = process
        self._tell()

        async def watch() -> None:
            code = await process.wait()
            if self._processes.get(name) is process:
                del self._processes[name]
            if self._ending:
                return
            self._tell()
            if ended is not None:
                ended(code)
            if restart:
                self.restarts[name] += 1
                if self.restarts[name] > RESTARTS_MAX:
                    self._fail(f"{name} died {RESTARTS_MAX + 1} times{self._last_words(name)}")
                    return
                if code == UNUSABLE:
                    self._fail(f"{name} cannot run{self._last_words(name)}")
                    return
                await self.start(name, command, environment=environment, restart=True, ended=ended)

        task = asyncio.create_task(watch())
        self._watches.add(task)
        task.add_done_callback(self._watches.discard)

    def kill(self, name: str, sign: signal.Signals = signal.SIGKILL) -> bool:
        """Send a signal to a process; tell whether it was there."""
        process = self._processes.get(name)
        if process is None or process.returncode is not None:
            return False
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(sign)
        return True

    async def crash_loop(self) -> None:
        """Return never, or raise.

        Raises:
            RunError: If a process cannot be kept alive.
        """
        await asyncio.shield(self._crash_loop)

    async def wait_for(self, names: Sequence[str], timeout_s: float) -> bool:
        """Wait until none of ``names`` is left; tell whether that happened in time."""
        waits = [self._processes[name].wait() for name in names if name in self._processes]
        try:
            await asyncio.wait_for(asyncio.gather(*waits), timeout_s)
        except TimeoutError:
            return False
        return True

    async def end(self, names: Sequence[str] | None = None) -> None:
        """End processes, all of them by default: ask, then kill, and reap."""
        if names is None:
            self._ending = True
        chosen = list(self._processes) if names is None else list(names)
        alive = [self._processes[name] for name in chosen if name in self._processes]
        for process in alive:
            with contextlib.suppress(ProcessLookupError):
                process.send_signal(signal.SIGTERM)
                process.send_signal(signal.SIGCONT)  # a frozen process cannot hear the first
        if alive:
            _, late = await asyncio.wait(
                [asyncio.ensure_future(process.wait()) for process in alive], timeout=GRACE_S
            )
            for process in alive if late else ():
                with contextlib.suppress(ProcessLookupError):
                    process.kill()
            for process in alive:
                await process.wait()

    def end_now(self) -> None:
        """Kill everything that is left, without waiting."""
        self._ending = True
        for process in self._processes.values():
            with contextlib.suppress(ProcessLookupError):
                process.kill()

    def _tell(self) -> None:
        self._changed({name: process.pid for name, process in self._processes.items()})

    def _fail(self, reason: str) -> None:
        if not self._crash_loop.done():
            self._crash_loop.set_exception(RunError(reason))

    def log_of(self, name: str) -> str:
        """Return what a process wrote, stripped."""
        log = self._logs / f"{name.replace(':', '-')}.log"
        return log.read_text(encoding="utf-8", errors="replace").strip() if log.exists() else ""

    def _last_words(self, name: str) -> str:
        words = self.log_of(name).rpartition("\n")[2].strip()
        return f": {words}" if words else ""


UNUSABLE = 2
"""Exit code of a process that says that starting it again would not help."""
