"""Play many scenarios and measure each: in-process, without journals, in one process or in several.

A scenario is given as a *tree* of plain values, as a TOML file would hold it. Order and number of
worker processes do not change a result.
"""

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from msgspec import Struct

from deploy.inprocess import play
from deploy.setting import prepare
from deploy.verdict.coverage import coverage_of
from deploy.verdict.grid_ledger import GridLedger
from experiments.command import Show, in_parallel
from protocol.errors import RunError
from protocol.grid import Grid
from protocol.scenario import from_tree
from protocol.trace import Event, Observer, TraceDigest
from world_server.terrain import terrain_of
from world_server.world import World

Tree = dict[str, Any]
"""A scenario as plain values."""

LAPS_MOST = 20
"""A run is cut off when a robot could have covered everything so many times."""

PATIENCE_S = 300.0
"""A run with a process for each robot that takes longer has failed."""


class Measured(Struct, frozen=True):
    """What one run came to.

    Attributes:
        complete: it ended, and everything that a survivor could reach was covered.
        status: how it ended: ``"over"``, ``"stalled"``, or ``"unfinished"`` if it was cut off.
        covered: sub-cells visited.
        to_cover: those and the ones that were left out.
        coverage_time: time of the last first visit.
        visits_extra: visits that were no first ones.
        killed: robots that were killed.
        failed: robots that ended by a fault of their own.
        violations: events that cannot be.
    """

    complete: bool
    status: str
    covered: int
    to_cover: int
    coverage_time: float
    visits_extra: int
    killed: int
    failed: int
    violations: int


class _CutOffError(Exception):
    """A run took too long."""


def with_fields(tree: Tree, fields: Mapping[str, Any]) -> Tree:
    """Return a copy of a tree with some fields set, each by its name such as ``"team.robots"``."""
    copy = deepcopy(tree)
    for name, value in fields.items():
        *sections, field = name.split(".")
        section = copy
        for each in sections:
            section = section.setdefault(each, {})
        section[field] = value
    return copy


def measure(tree: Tree) -> Measured:
    """Play a scenario on a grid, and measure it by its trace.

    Raises:
        InputError: If it cannot be played.
    """
    return _played(tree)


def trace_inprocess(tree: Tree) -> str:
    """Play a scenario on a grid in-process and return the SHA-256 of its trace."""
    digest = TraceDigest()
    _played(tree, digest)
    return digest.hexdigest()


def trace_of_processes(tree: Tree) -> str:
    """Play a scenario with a process for each robot, by the command line; see `trace_inprocess`.

    Raises:
        RunError: If there is no result.
    """
    with TemporaryDirectory(prefix="canopy-") as folder:
        scenario = Path(folder, "scenario.toml")
        scenario.write_text(to_toml(tree), encoding="utf-8")
        run = ["run", str(scenario), "--engine", "processes", "--json", "--no-picture"]
        out = ["--out", str(Path(folder, "run"))]
        said = subprocess.run(
            [sys.executable, "-m", "deploy.cli", *run, *out],
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
    try:
        return str(json.loads(said.stdout)["trace_sha256"])
    except ValueError:
        raise RunError(f"canopy run: {said.stderr.strip() or 'no result'}") from None


def sweep(
    trees: Sequence[Tree], *, workers: int | None = 1, show: Show = lambda _done, _total: None
) -> list[Measured]:
    """Measure scenarios, and return what they came to, in the same order.

    Args:
        trees: the scenarios.
        workers: in how many processes they are played; 1: in this one; ``None``: as for all papers.
        show: called after each run.

    Raises:
        InputError: If one cannot be played.
    """
    return in_parallel(measure, trees, show, workers=workers)


def to_toml(tree: Tree) -> str:
    """Write a tree as TOML; its lists hold plain values or tables, never nothing."""
    return "".join(f"{name} = {_value(value)}\n" for name, value in tree.items())


def _value(value: object) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{name} = {_value(each)}" for name, each in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_value, value)) + "]"
    return json.dumps(value)  # numbers, truth values and text are spelled alike


def _played(tree: Tree, also: Observer | None = None) -> Measured:
    setting = prepare(from_tree(tree, "experiment"))
    ground, scenario = setting.ground, setting.scenario
    assert isinstance(ground, Grid)
    ledger = GridLedger(ground, setting.starts, scenario)
    speed = scenario.team.speed
    slowest = min(speed) if isinstance(speed, tuple) else speed
    tick = 1.0 if scenario.clock.mode == "lockstep" else ground.cell_m / slowest
    latest = LAPS_MOST * tick * (setting.to_cover + 1)

    def observe(event: Event) -> None:
        if event.time > latest:
            raise _CutOffError
        ledger.observe(event)
        if also is not None:
            also(event)

    world = World(scenario, terrain_of(ground, scenario), setting.starts, observe=observe)
    try:
        end, _ = play(scenario, world, setting.algorithm)
        status: str = end.status
    except _CutOffError:
        status = "unfinished"
    coverage = coverage_of(scenario, ledger)
    causes = [loss.cause for loss in ledger.losses.values()]
    return Measured(
        complete=status == "over" and not coverage.missing,
        status=status,
        covered=coverage.covered,
        to_cover=coverage.to_cover,
        coverage_time=ledger.coverage_time,
        visits_extra=ledger.visits_extra,
        killed=causes.count("killed"),
        failed=len(causes) - causes.count("killed"),
        violations=ledger.violations,
    )
