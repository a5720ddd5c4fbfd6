"""Plans for parents and children on random maps, and robots that carry them out.

A map is what a scenario of the same seed would have, so that a plan and a run are about the same one.
"""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from msgspec import Struct

from deploy.inprocess import play
from deploy.picture_grid import draw_grid_run
from deploy.picture_parent_child import ParentTrail
from deploy.plan_parent_child import TeamPlan, WantedTeam, draw_team_plan, plan_parent_child
from deploy.setting import prepare
from deploy.verdict.grid_ledger import GridLedger
from deploy.verdict.parent_child import ParentChild
from deploy.verdict.result import Result, judge, ledger_of, monitors_of, observers
from experiments.command import Tally, write_csv, write_json
from protocol.grid import Cell, Grid
from protocol.scenario import from_tree
from protocol.seeds import spawn
from protocol.trace import Event, Observer, TraceDigest
from world_server.maps.generated_grids import rectangles
from world_server.terrain import terrain_of
from world_server.world import World

SIDE = 60
"""Vertices from end to end."""
SPACING_M = 0.5
R_LOS_M = 2.5
CHILDREN = 5

# Plans.


class Case(NamedTuple):
    """One plan.

    Attributes:
        ratio: share of the area that is obstructed.
        r_los_m: line-of-sight radius.
        children: how many, in all teams.
        seed: of the map.
        teams: how many, each of a parent and some of the children.
    """

    ratio: float
    r_los_m: float
    children: int
    seed: int
    teams: int = 1

    @property
    def grid(self) -> Grid:
        """The map, as a scenario of that seed would have it."""
        drawn = rectangles(SIDE, SIDE, self.ratio, spawn(self.seed, "world"))
        return Grid(drawn.rows, drawn.cols, drawn.cells(), SPACING_M)

    def plan(self) -> TeamPlan:
        """Plan for the team, or the teams."""
        wanted = WantedTeam(
            children=self.children, r_los_m=self.r_los_m, spacing_m=SPACING_M, teams=self.teams
        )
        return plan_parent_child(self.grid, wanted)


class Measured(NamedTuple):
    """What one plan comes to.

    Attributes:
        vertices: to cover, the paper's P.
        parents: vertices of the parent, the paper's Q.
        extra: further ones, for vertices that cannot be reached within sight of those.
        coverage, coordination: steps as the paper counts them.
        redundant: steps of all children that cover nothing.
        ticks: that robots need for all of it.
        cpu_s: processor time of planning.
    """

    vertices: int
    parents: int
    extra: int
    coverage: int
    coordination: int
    redundant: int
    ticks: int
    cpu_s: float


def measure(case: Case) -> Measured:
    """Make one plan."""
    began = time.process_time()
    facts = case.plan().facts
    return Measured(
        vertices=facts.vertices,
        parents=len(facts.parents),
        extra=len(facts.extra_stops),
        coverage=facts.coverage_steps,
        coordination=facts.coordination_steps,
        redundant=facts.redundant_steps,
        ticks=facts.schedule_steps,
        cpu_s=time.process_time() - began,
    )


# Runs.

EXAMPLE = Case(0.2, R_LOS_M, CHILDREN, 0)
"""What Figure 8 shows."""

CARRIED_OUT = (EXAMPLE, Case(0.0, 2.5, 3, 0), Case(0.35, 2.5, 7, 0), Case(0.2, 7.5, 9, 0))


class Played(Struct, frozen=True):
    """A plan that robots carried out.

    Attributes:
        ratio, r_los_m, children, seed: which.
        planned: ticks of the plan.
        makespan: when the robots were done.
        complete: whether all was covered.
        broken: guarantees that did not hold.
        trace_sha256: of the run.
    """

    ratio: float
    r_los_m: float
    children: int
    seed: int
    planned: int
    makespan: float | None
    complete: bool
    broken: list[str]
    trace_sha256: str

    @property
    def as_planned(self) -> bool:
        """Whether the run was what was planned."""
        return self.complete and self.makespan == self.planned and not self.broken


def scenario_tree(case: Case, start: Cell) -> dict[str, Any]:
    """Return the scenario of a plan, as a TOML file would hold it."""
    return {
        "algorithm": "parent-child",
        "seed": case.seed,
        "world": {
            "generate": {"kind": "rectangles", "rows": SIDE, "cols": SIDE, "ratio": case.ratio},
            "cell_m": SPACING_M,
            "start": list(start),
        },
        "team": {"robots": 1 + case.children, "parents": 1},
        "radio": {"reach": "radius", "radius_m": case.r_los_m, "line_of_sight": True},
    }


def carried_out(case: Case, team: TeamPlan) -> tuple[Result, GridLedger, ParentChild]:
    """Let robots carry out a plan on the in-process engine, and judge the run."""
    setting = prepare(from_tree(scenario_tree(case, team.plan.starts[0]), "experiment"))
    scenario = setting.scenario
    ledger = ledger_of(setting.ground, setting.starts, scenario)
    monitors = monitors_of(scenario, ledger)
    digest = TraceDigest()
    watching: list[Observer] = [*observers(ledger, monitors), digest]

    def observe(event: Event) -> None:
        for each in watching:
            each(event)

    world = World(scenario, terrain_of(setting.ground, scenario), setting.starts, observe=observe)
    end, _ = play(scenario, world, setting.algorithm)
    result = judge(
        scenario,
        ledger,
        monitors,
        status=end.status,
        engine="inprocess",
        trace_sha256=digest.hexdigest(),
    )
    (monitor,) = monitors
    assert isinstance(ledger, GridLedger)
    assert isinstance(monitor, ParentChild)
    return result, ledger, monitor


def compared(case: Case, team: TeamPlan, result: Result) -> Played:
    """Compare a run with its plan."""
    return Played(
        *case[:4],
        planned=team.facts.schedule_steps,
        makespan=result.makespan,
        complete=result.complete,
        broken=[one.name for one in result.guarantees if one.holds is False],
        trace_sha256=result.trace_sha256,
    )


def played(folder: Path, cases: Sequence[Case]) -> list[Played]:
    """Carry out plans one after another, and write what came of it."""
    runs = []
    with Tally("played") as tally:
        for case in cases:
            team = case.plan()
            runs.append(compared(case, team, carried_out(case, team)[0]))
            tally.show(len(runs), len(cases))
    write_json(folder / "played.json", runs)
    write_csv(folder / "played.csv", Played.__struct_fields__, map(msgspec.structs.astuple, runs))
    return runs


def figure8(folder: Path) -> list[Played]:
    """Draw the example, as planned and as carried out."""
    grid, team = EXAMPLE.grid, EXAMPLE.plan()
    name = f"{SIDE * SPACING_M:g} m x {SIDE * SPACING_M:g} m, {100 * EXAMPLE.ratio:g} % obstructed"
    draw_team_plan(grid, team, folder / "figure8.png", name)
    result, ledger, monitor = carried_out(EXAMPLE, team)
    run = compared(EXAMPLE, team, result)
    draw_grid_run(
        grid,
        folder / "figure8-run.png",
        title=name,
        subtitle=f"a parent and {EXAMPLE.children} children, r_los = {EXAMPLE.r_los_m:g} m; "
        f"{run.planned} ticks planned, {run.makespan:g} taken",
        starts=list(team.plan.starts),
        first_visits=ledger.first_visits,
        owners={},
        edges=[],
        lost={},
        stopped={},
        team_size=1 + EXAMPLE.children,
        parents=1,
        overlay=ParentTrail(*monitor.trail()),
    )
    write_json(folder / "figure8.json", {"plan": team.facts, "run": run})
    return [run]
