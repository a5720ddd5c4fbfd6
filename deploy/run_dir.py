"""The folder of a run: what is in it, and where.

journal           every input of the world; `canopy replay` needs only this
snapshot          while the run lasts: the world as it was a while ago
result.json       the verdict
run.png           who visited what, and when
bookkeeping.db    the tags as they were left
processes.json    while the run lasts: each process and its pid
robot-3.memory    what robot 3 was told, if its process may be started again
logs/             what each process wrote
"""

import itertools
from collections.abc import Mapping
from pathlib import Path

import msgspec

from protocol.errors import ScenarioError


class RunDir:
    """The folder of one run.

    Attributes:
        path: the folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def create(cls, out: Path | None, name: str) -> "RunDir":
        """Make the folder: ``out``, or the next free ``runs/NAME-N``.

        Raises:
            ScenarioError: If it cannot be made, or holds a run already.
        """
        try:
            if out is not None:
                if (out / "journal").exists():
                    raise ScenarioError(f"--out {out}: holds a run already; choose another folder")
                out.mkdir(parents=True, exist_ok=True)
                made = cls(out)
            else:
                made = cls(_next_free(Path("runs"), name))
            made.logs.mkdir(exist_ok=True)
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            raise ScenarioError(f"cannot make the folder {error.filename}: {reason}") from None
        return made

    @property
    def journal(self) -> Path:
        """Every input of the world."""
        return self.path / "journal"

    @property
    def result(self) -> Path:
        """The verdict, as JSON."""
        return self.path / "result.json"

    @property
    def picture(self) -> Path:
        """Who visited what, and when."""
        return self.path / "run.png"

    @property
    def database(self) -> Path:
        """The store, unless the scenario names another."""
        return self.path / "bookkeeping.db"

    @property
    def users(self) -> Path:
        """While the run lasts: who may connect to its router."""
        return self.path / "users"

    def memory(self, robot: int) -> Path:
        """What a robot remembers beyond the death of its process."""
        return self.path / f"robot-{robot}.memory"

    def clock_shift(self, process: str) -> Path:
        """By how much the wall clock of a process is wrong, if a fault shifts it."""
        return self.path / f"{process.replace(':', '-')}.clock"

    @property
    def logs(self) -> Path:
        """What each process wrote."""
        return self.path / "logs"

    def write_processes(self, pids: Mapping[str, int]) -> None:
        """Say which process runs under which pid; a reader never sees half a file."""
        draft = self.path / "processes.json.new"
        draft.write_bytes(msgspec.json.format(msgspec.json.encode(dict(pids))))
        draft.replace(self.path / "processes.json")

    def remove_processes(self) -> None:
        """The run is over."""
        (self.path / "processes.json").unlink(missing_ok=True)
        self.users.unlink(missing_ok=True)


def _next_free(parent: Path, name: str) -> Path:
    safe = "".join(c if c.isalnum() or c in "-_." else "-" for c in name).strip(".") or "run"
    for number in itertools.count(1):
        path = parent / f"{safe}-{number}"
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            continue
        return path
    raise AssertionError
