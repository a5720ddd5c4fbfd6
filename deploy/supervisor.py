"""The supervisor: starts processes, watches them, restarts infrastructure, ends everything.

Nothing outlives it: each process ties itself to the supervisor's life by the kernel (see
`protocol.lifeline`), and on every way out the supervisor kills what is left and reaps it.
Infrastructure that dies is started again. Of robots the scenario says it: a dead robot is a lost robot,
or its process is started again, if it did not end by itself.
"""

import asyncio
import contextlib
import os
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal

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
        self._handles: dict[int, int] = {}  # by pid: a descriptor that means this process alone
        self._ordered: dict[str, int] = {}  # deaths that we brought about ourselves
        self._before_restart: dict[str, Callable[[], None]] = {}
        self._watches: set[asyncio.Task[None]] = set()
        self._ending = False
        self._crash_loop: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    async def start(
        self,
        name: str,
        command: Sequence[str],
        *,
        environment: Mapping[str, str] | None = None,
        restart: Literal["never", "killed", "always"] = "never",
        ended: Callable[[int], None] | None = None,
        reaped: Callable[[int], None] | None = None,
    ) -> None:
        """Start a Python process and watch it.

        Args:
            name: as in ``processes.json``.
            command: what follows the Python interpreter.
            environment: variables besides our own.
            restart: whether to start it again when it dies: if a signal killed it, or always.
            ended: called with the exit code when it ends and is not started again.
            reaped: called with the pid of each of its lives when that is over.
        """
        if self._ending:
            return
        if restart == "always":
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
        self._handles[process.pid] = os.pidfd_open(process.pid)
        self._tell()

        async def watch() -> None:
            code = await process.wait()
            os.close(self._handles.pop(process.pid))
            if reaped is not None:
                reaped(process.pid)
            if self._processes.get(name) is process:
                del self._processes[name]
            if self._ending:
                return
            self._tell()
            if restart == "never" or (restart == "killed" and code >= 0):
                if ended is not None:
                    ended(code)
                return
            self.restarts[name] = 1 + self.restarts.get(name, 0)
            if self.restarts[name] - self._ordered.get(name, 0) > RESTARTS_MAX:
                self._fail(f"{name} died {RESTARTS_MAX + 1} times{self._last_words(name)}")
                return
            if code == UNUSABLE:
                self._fail(f"{name} cannot run{self._last_words(name)}")
                return
            self._before_restart.pop(name, lambda: None)()
            await self.start(
                name,
                command,
                environment=environment,
                restart=restart,
                ended=ended,
                reaped=reaped,
            )

        task = asyncio.create_task(watch())
        self._watches.add(task)
        task.add_done_callback(self._watches.discard)

    def kill(self, name: str, sign: signal.Signals = signal.SIGKILL) -> bool:
        """Send a signal to a process; tell whether it was there."""
        process = self._processes.get(name)
        if process is None or process.returncode is not None:
            return False
        self._send(process, sign)
        if sign == signal.SIGKILL:
            self._ordered[name] = 1 + self._ordered.get(name, 0)
        return True

    def before_restart(self, name: str, act: Callable[[], None]) -> None:
        """Call ``act`` once, between the next death of a process and its next life."""
        self._before_restart[name] = act

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
            self._send(process, signal.SIGTERM)
            self._send(process, signal.SIGCONT)  # a frozen process cannot hear the first
        if alive:
            _, late = await asyncio.wait(
                [asyncio.ensure_future(process.wait()) for process in alive], timeout=GRACE_S
            )
            for process in alive if late else ():
                self._send(process, signal.SIGKILL)
            for process in alive:
                await process.wait()
        if names is None:
            await asyncio.gather(*self._watches, return_exceptions=True)

    def end_now(self) -> None:
        """Kill everything that is left, without waiting."""
        self._ending = True
        for process in self._processes.values():
            self._send(process, signal.SIGKILL)

    def _send(self, process: asyncio.subprocess.Process, sign: signal.Signals) -> None:
        """Send a signal to a process unless it is gone.

        `Process.send_signal` would poll, and so take the exit code away from who waits for it.
        """
        handle = self._handles.get(process.pid)
        if handle is not None:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(handle, sign)

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
