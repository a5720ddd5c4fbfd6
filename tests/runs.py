"""What tests of whole runs share: both engines, the command line, and what a run leaves behind."""

import asyncio
import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from agents.registry import algorithm_of
from deploy import inprocess, processes
from deploy.run_dir import RunDir
from deploy.setting import Setting
from protocol.graph import PortGraph
from protocol.scenario import from_tree
from world_server.journal import Closing, WaveRecord, scan
from world_server.replay import replay

CANOPY = Path(sys.executable).with_name("canopy")


RUN_S = 90.0
"""A run by processes that takes longer hangs."""

# Both engines, without the command line.


class Run(NamedTuple):
    """A run that has ended.

    Attributes:
        folder: of the run.
        trace_sha256: as its journal says.
        status: how it ended.
        failures: for each robot whose algorithm failed what it said.
        restarts: of the infrastructure, and of robots that came back.
        played: what the journal does not tell of a run by processes; ``None`` in one thread.
    """

    folder: RunDir
    trace_sha256: str
    status: str
    failures: dict[int, str]
    restarts: dict[str, int]
    played: processes.Played | None = None


def setting_of(
    graph: PortGraph, robots: int, *, starts: Sequence[int] | None = None, **fields: Any
) -> Setting:
    """Build a setting of so many robots at 0; ``fields`` are the scenario's sections."""
    team = {"robots": robots, **fields.pop("team", {})}
    tree = {"algorithm": "mr-dfs", "world": {"map": "none"}, "team": team, **fields}
    scenario = from_tree(tree, "test")
    algorithm = algorithm_of(scenario.algorithm, scenario.algorithm_options)
    return Setting(scenario, graph, tuple(starts or [0] * robots), algorithm, len(graph.names))


def play(setting: Setting, folder: Path, engine: str, limit_s: float = RUN_S) -> Run:
    """Play a setting on an engine, in a new folder under ``folder``, to its end."""
    name = f"test-{uuid.uuid4().hex[:12]}"
    run_dir = RunDir.create(folder / name, name)
    restarts: dict[str, int] = {}
    played = None
    if engine == "processes":
        played = asyncio.run(_bounded(setting, run_dir, name, limit_s))
        restarts, failures = played.restarts, played.failures
    else:
        failures = inprocess.run(setting, run_dir, name, lambda _: None)
    # Behind it there may be lives of a world that was started again to tell of the end.
    (closing,) = (record for record, _ in scan(run_dir.journal) if isinstance(record, Closing))
    return Run(run_dir, closing.trace_sha256, closing.status, failures, restarts, played)


async def _bounded(
    setting: Setting, run_dir: RunDir, name: str, limit_s: float
) -> processes.Played:
    """Play a run by processes; one that hangs is ended, and says what it was about."""
    try:
        async with asyncio.timeout(limit_s):
            return await processes.play(setting, run_dir, name, lambda _: None)
    except TimeoutError:
        logs = [f"{log.name}: {log.read_text()[-500:]}" for log in sorted(run_dir.logs.iterdir())]
        words = [
            f"{name} hangs: no end after {limit_s:g} s",
            *map(str, setting.scenario.faults),
            *logs,
        ]
        raise AssertionError("\n".join(words)) from None


def requests_of(run: Run) -> list[int]:
    """Return how many requests each robot made."""
    return [body.requests for body in replay(run.folder.journal).world.bodies]


# The command line.


class Said(NamedTuple):
    """What a command said, and how it ended."""

    code: int
    out: str
    err: str

    @property
    def result(self) -> dict[str, Any]:
        """The JSON object on stdout; there must be exactly one, and nothing else."""
        lines = self.out.splitlines()
        assert len(lines) == 1, self
        result = json.loads(lines[0])
        assert isinstance(result, dict)
        return result


def _environment(more: Mapping[str, str] | None) -> dict[str, str]:
    """Return our environment, less what would change what a command prints."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")}
    return {**kept, "COLUMNS": "200", **(more or {})}


def run_cli(
    *arguments: object,
    cwd: Path,
    environment: Mapping[str, str] | None = None,
    timeout_s: float = 100.0,
) -> Said:
    """Run ``canopy`` with these arguments to its end."""
    done = subprocess.run(
        [CANOPY, *map(str, arguments)],
        cwd=cwd,
        env=_environment(environment),
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )
    return Said(done.returncode, done.stdout, done.stderr)


class Started:
    """A ``canopy run`` that goes on, and its folder.

    Attributes:
        process: the supervisor.
        folder: of the run.
    """

    def __init__(self, process: subprocess.Popen[str], folder: Path) -> None:
        self.process = process
        self.folder = folder
        self.pids: dict[str, int] = {}

    def all_there(self, robots: int) -> dict[str, int]:
        """Wait until every process is there, and return the pid of each."""
        wanted = {"world", "bookkeeping", *(f"robot:{robot}" for robot in range(robots))}

        def there() -> bool:
            self.pids.update(self.living())
            return wanted <= self.pids.keys()

        until(there, "all processes of the run", self.process)
        return self.pids

    def living(self) -> dict[str, int]:
        """Return what ``processes.json`` says now; empty where there is none."""
        try:
            found: dict[str, int] = json.loads((self.folder / "processes.json").read_text())
        except FileNotFoundError:
            return {}
        return found

    @property
    def journal(self) -> Path:
        """The journal."""
        return self.folder / "journal"

    def plays(self, size: int = 0) -> None:
        """Wait until all robots have joined, and the journal has so many bytes besides."""
        until(lambda: self.journal.exists() and waves_of(self.journal) > 0, "wave", self.process)
        self.grows(size)

    def grows(self, size: int) -> None:
        """Wait until the journal has so many bytes more."""
        enough = self.journal.stat().st_size + size
        until(lambda: self.journal.stat().st_size >= enough, f"{size} bytes more", self.process)

    def finish(self, timeout_s: float = 60.0) -> Said:
        """Wait for the end."""
        out, err = self.process.communicate(timeout=timeout_s)
        return Said(self.process.returncode, out, err)


@contextlib.contextmanager
def started_cli(
    *arguments: object, cwd: Path, folder: Path, environment: Mapping[str, str] | None = None
) -> Iterator[Started]:
    """Start ``canopy run`` into ``folder``; what still runs at the end is killed."""
    with subprocess.Popen(
        [CANOPY, "run", *map(str, arguments), "--out", str(folder)],
        cwd=cwd,
        env=_environment(environment),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            yield Started(process, folder)
        finally:
            if process.poll() is None:
                process.kill()


def until(
    condition: Callable[[], bool],
    what: str,
    process: "subprocess.Popen[str] | None" = None,
    timeout_s: float = 30.0,
) -> None:
    """Look until ``condition`` holds; fail when time is up, or when ``process`` ends before."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        if process is not None and process.poll() is not None and not condition():
            raise AssertionError(f"the run ended before: {what}: {process.communicate()}")
        assert time.monotonic() < deadline, f"in vain: {what}"
        time.sleep(0.002)  # between two looks; nothing depends on how long


# What a run may leave behind.


def lives(pid: int) -> bool:
    """Tell whether a process runs or is frozen; a zombie has ended, and waits for its parent."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False
    return stat.rpartition(")")[2].split()[0] not in "ZX"


def processes_that_mention(text: str) -> dict[int, str]:
    """Return the living processes whose command line or environment mention ``text``."""
    found = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdecimal() or int(entry.name) == os.getpid():
            continue
        with contextlib.suppress(OSError):
            command = (entry / "cmdline").read_bytes()
            mentions = text.encode() in command + (entry / "environ").read_bytes()
            if mentions and lives(int(entry.name)):
                found[int(entry.name)] = command.replace(b"\0", b" ").decode()
    return found


def ends(pids: Mapping[str, int]) -> None:
    """Wait until none of these processes is left; nobody need have reaped them."""
    until(lambda: not any(map(lives, pids.values())), f"end of {dict(pids)}", timeout_s=15)


class Watch:
    """Looks at what a run leaves behind, in a folder for temporary files of its own and elsewhere.

    The folders of the machine are shared with whatever else runs there: of what is new in them only
    that counts which bears a name of ours or of the libraries that we use.
    """

    OURS = ("zenoh", "canopy", "matplotlib", "test-")
    OTHERS = "canopy-soak-"  # a soak beside us makes and removes its folders meanwhile
    SHARED = (Path("/dev/shm"), Path("/tmp"))  # looked at, never written

    def __init__(self, folder: Path) -> None:
        self.mark = f"watched-{uuid.uuid4().hex}"
        self._temporary = folder / f"tmp-{self.mark}"
        self._temporary.mkdir()
        self.environment = {"TMPDIR": str(self._temporary), "CANOPY_TEST_MARK": self.mark}
        self._before = self._found()

    def _found(self) -> set[str]:
        names = {
            str(path) for folder in self.SHARED if folder.is_dir() for path in folder.iterdir()
        }
        names = {name for name in names if self.OTHERS not in name}
        return {name for name in names if any(ours in name.lower() for ours in self.OURS)}

    def nothing_left(self) -> None:
        """Check that no process, no shared memory and no temporary file is left of our commands."""
        until(
            lambda: not processes_that_mention(self.mark),
            f"the end of {processes_that_mention(self.mark)}",
            timeout_s=15,
        )
        assert list(self._temporary.iterdir()) == []
        assert self._found() - self._before == set()


def free(port: int) -> bool:
    """Tell whether a router could listen on a port of loopback."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


def send(pid: int, sign: signal.Signals) -> None:
    """Send a signal to a process that may have ended meanwhile."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, sign)


# Files.


def write_scenario(
    folder: Path, edges: str = "0 1\n1 2\n2 3\n3 4\n4 0\n1 3\n", more: str = ""
) -> Path:
    """Write a small map and a scenario of three robots on it; ``more`` is further TOML."""
    (folder / "small.edges").write_text(edges)
    path = folder / "small.toml"
    path.write_text(
        f'algorithm = "mr-dfs"\n[world]\nmap = "small.edges"\n[team]\nrobots = 3\n{more}'
    )
    return path


def waves_of(journal: Path) -> int:
    """Return how many waves a journal holds."""
    return sum(isinstance(record, WaveRecord) for record, _ in scan(journal))
