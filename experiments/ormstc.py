"""The experiments on ORMSTC (Agmon, Hazon, Kaminka 2008), as scenarios to play and what came of them.

Four parts, each a function that returns a `Plan`: runs, told apart by labels. Runs that differ only in
their seed make up one `Row`.

    figure13  the paper's experiment (Sec. 4.3): two environments, teams of 2 to 10, random starts
    options   what each departure from the paper's assumptions costs (Sec. 4.2)
    losses    worlds of random obstacles, without and with losses, beside the specification's numbers
    helping   robots that are done take a share of what others have (not in the paper)

Time is counted in ticks of one move. *Coverage time* is that of the last first visit; where a run left
something uncovered it says little, so `Row.complete` stands beside it.

Departures from the paper's experiment: its two environments were not published. ``cave.png`` and
``autolab.png`` of the Stage simulator, which the authors used, stand for them; where they are absent,
maps of ours. What bumps, turns and control cost a real robot is not simulated.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from math import nan, sqrt
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from msgspec import Struct

import deploy
from deploy.ground import ground_of
from experiments.sweep import Measured, Tree, with_fields
from protocol.grid import STEPS, Cell, Grid
from protocol.scenario import from_tree
from protocol.seeds import spawn

MAPS = Path(deploy.__file__).parent / "maps"
"""Maps of ours."""

CELL_M = 0.2
"""Side of a sub-cell, which is the size of a robot: the cave has 40 x 40 coarse cells."""

Label = str | int | bool

# What is played.


class Size(Struct, frozen=True):
    """How much is played.

    Attributes:
        teams: numbers of robots.
        starts: random starts of each team.
        inputs: worlds of the losses.
    """

    teams: tuple[int, ...] = (2, 4, 6, 8, 10)
    starts: int = 10
    inputs: int = 100


QUICK = Size(teams=(2, 6, 10), starts=3, inputs=5)


class Run(Struct, frozen=True):
    """A run of a plan.

    Attributes:
        labels: what it has in common with those that differ only in their seed.
        tree: its scenario.
    """

    labels: dict[str, Label]
    tree: Tree


class Plan(Struct, frozen=True):
    """The runs of one part.

    Attributes:
        about: what is played, a line each.
        runs: all of them; those of one row stand together.
        samples: runs that are also played with a process for each robot, to compare the traces.
    """

    about: tuple[str, ...]
    runs: tuple[Run, ...]
    samples: tuple[Run, ...] = ()


class Row(Struct, frozen=True):
    """What the runs with the same labels came to.

    Attributes:
        labels: their labels.
        runs: how many they are.
        complete: how many of them ended and left nothing uncovered.
        coverage_time, coverage_time_sd: mean and standard deviation, ticks.
        even_share: what the mean would be if all robots shared the work evenly, ticks.
        extra_percent: visits that were no first ones, in percent of the first ones; mean.
        covered_percent: what was covered of what a survivor could reach; mean.
        killed: robots killed, mean.
        failed: robots that ended by a fault of their own, in all runs.
        impossible: runs with events that cannot be.
    """

    labels: dict[str, Label]
    runs: int
    complete: int
    coverage_time: float
    coverage_time_sd: float
    even_share: float
    extra_percent: float
    covered_percent: float
    killed: float
    failed: int
    impossible: int


def rows_of(plan: Plan, results: Sequence[Measured]) -> list[Row]:
    """Sum up the results of a plan, given in the order of its runs."""
    groups: dict[tuple[tuple[str, Label], ...], list[tuple[Run, Measured]]] = {}
    for run, result in zip(plan.runs, results, strict=True):
        groups.setdefault(tuple(run.labels.items()), []).append((run, result))
    return [_row(dict(labels), group) for labels, group in groups.items()]


def _row(labels: dict[str, Label], group: Sequence[tuple[Run, Measured]]) -> Row:
    results = [result for _, result in group]
    times = [result.coverage_time for result in results]
    return Row(
        labels=labels,
        runs=len(results),
        complete=sum(result.complete for result in results),
        coverage_time=fmean(times),
        coverage_time_sd=stdev(times) if len(times) > 1 else 0.0,
        even_share=fmean(result.to_cover / run.tree["team"]["robots"] - 1 for run, result in group),
        extra_percent=fmean(100 * result.visits_extra / result.covered for result in results),
        covered_percent=fmean(100 * result.covered / result.to_cover for result in results),
        killed=fmean(result.killed for result in results),
        failed=sum(result.failed for result in results),
        impossible=sum(result.violations > 0 for result in results),
    )


# Figure 13.


class Place(Struct, frozen=True):
    """A map of the paper's experiment.

    Attributes:
        name: as in the figure.
        file: the map.
        resolution_m: side of a pixel or character.
        about: where it comes from.
    """

    name: str
    file: Path
    resolution_m: float
    about: str


def shared_maps() -> Path:
    """Return the folder of maps beside the repository, which need not be there."""
    beside = Path(deploy.__file__).resolve().parents[2] / "shared"
    return Path(os.environ.get("CANOPY_SHARED") or beside) / "maps"


def places(maps: Path) -> tuple[Place, ...]:
    """Return the maps to play on: those of Stage in ``maps``, else ours."""
    office = "deploy/maps/office.txt, 12 m x 16 m"
    ours = Place("Office", MAPS / "office.txt", CELL_M, office)
    cave, room = maps / "stage" / "cave.png", maps / "stage" / "autolab.png"
    if cave.is_file() and room.is_file():
        return (
            Place("Cave", cave, 16 / 500, "Stage's cave.png, 16 m x 16 m"),
            Place("Room", room, 20 / 809, "Stage's autolab.png, 20 m x 17 m"),
            ours,
        )
    cavern = f"deploy/maps/cavern.txt, 12 m x 16 m, as Stage's maps are not in {maps}"
    return Place("Cave", MAPS / "cavern.txt", CELL_M, cavern), ours


def figure13(size: Size, maps: Path | None = None) -> Plan:
    """Plan the paper's experiment.

    Args:
        size: how much is played.
        maps: where Stage's maps are; default: beside the repository.

    Paper:
        Agmon et al. 2008, Sec. 4.3, Figure 13.
    """
    runs = []
    samples = []
    about = [f"sub-cells of {CELL_M:g} m; {size.starts} random starts a point"]
    for place in places(shared_maps() if maps is None else maps):
        world = {
            "map": str(place.file.resolve()),
            "cell_m": CELL_M,
            "resolution_m": place.resolution_m,
        }
        of_place = [
            Run({"map": place.name, "robots": robots}, _tree("figure13", seed, world, robots))
            for robots in size.teams
            for seed in range(1, size.starts + 1)
        ]
        runs += of_place
        samples.append(of_place[len(of_place) // 2])
        ground = ground_of(from_tree(of_place[0].tree, "figure13"))[0]
        assert isinstance(ground, Grid)
        rows, cols = ground.rows // 2, ground.cols // 2
        about.append(f"{place.name}: {place.about}, {rows} x {cols} coarse cells")
    return Plan(tuple(about), tuple(runs), tuple(samples))


# What each option costs.


class Option(Struct, frozen=True):
    """A departure from the paper's assumptions.

    Attributes:
        name: what it is.
        fields: what it sets in the scenario.
    """

    name: str
    fields: dict[str, Any]


BASELINE = "baseline"

OPTIONS: tuple[Option, ...] = (
    Option(BASELINE, {"sensing.mode": "ahead"}),
    Option("senses three cells", {"sensing.mode": "three"}),
    Option("senses a radius of 3", {"sensing.mode": "radius", "sensing.range_m": 3.0}),
    Option("line of sight up to 3", {"sensing.mode": "line-of-sight", "sensing.range_m": 3.0}),
    Option("event clock", {"clock.mode": "event"}),
    Option("jitter 0.2", {"clock.mode": "event", "clock.jitter": 0.2}),
    Option("jitter exponential", {"clock.mode": "event", "clock.jitter": "exponential"}),
    Option(
        "speeds 0.5 to 1.5",
        {"clock.mode": "event", "team.speed": [0.5, 0.7, 0.9, 1.1, 1.3, 1.5]},
    ),
    Option("latency 1", {"radio.latency": 1}),
    Option("latency 2", {"radio.latency": 2}),
    Option("latency 4", {"radio.latency": 4}),
    Option("drift 0.05", {"sensing.position": "odometry", "sensing.drift": 0.05}),
    Option("drift 0.1", {"sensing.position": "odometry", "sensing.drift": 0.1}),
    Option("drift 0.2", {"sensing.position": "odometry", "sensing.drift": 0.2}),
    Option(
        "drift 0.05, no reset",
        {"sensing.position": "odometry", "sensing.drift": 0.05, "sensing.reset": False},
    ),
    Option(
        "drift 0.1, no reset",
        {"sensing.position": "odometry", "sensing.drift": 0.1, "sensing.reset": False},
    ),
    Option(
        "drift 0.2, no reset",
        {"sensing.position": "odometry", "sensing.drift": 0.2, "sensing.reset": False},
    ),
    Option("loss 0.1", {"radio.loss": 0.1}),
    Option("loss 0.3", {"radio.loss": 0.3}),
    Option("reach 4", {"radio.reach": "radius", "radio.radius_m": 4.0}),
    Option("reach 16", {"radio.reach": "radius", "radio.radius_m": 16.0}),
    Option("bodies block", {"world.bodies": "block"}),
)
"""The baseline, and what is changed in it, one at a time. A line here is a line of the table."""

OBSTACLES = {"kind": "random-obstacles", "rows": 20, "cols": 20, "obstacles": 60}
"""The specification says 20 x 30, but its 1359 for one robot is 4 x 340 - 1: so 20 x 20."""


def options(size: Size) -> Plan:
    """Plan what each option costs: the same worlds and starts for all of them.

    Paper:
        Agmon et al. 2008, Sec. 4.2, which names these troubles but does not measure them.
    """
    robots = 6
    about = (
        f"20 x 20 coarse cells, 60 of them blocked at random; {robots} robots",
        f"{size.starts} worlds and starts, the same for each option",
        "lengths and standard deviations in sub-cells, latency in ticks; speeds: one each, mean 1",
    )
    world = {"generate": OBSTACLES}
    runs = tuple(
        Run({"option": each.name}, with_fields(_tree("options", seed, world, robots), each.fields))
        for each in OPTIONS
        for seed in range(1, size.starts + 1)
    )
    return Plan(about, runs)


def relative(rows: Sequence[Row]) -> dict[str, float | None]:
    """Return the coverage time of each option as a share of the baseline's.

    ``None`` where a run left something uncovered: it may well be short for that.
    """
    base = next(row for row in rows if row.labels["option"] == BASELINE)
    return {
        str(row.labels["option"]): row.coverage_time / base.coverage_time
        if row.complete == row.runs
        else None
        for row in rows
    }


# Losses.


class Published(Struct, frozen=True):
    """A number of the specification: a mean over 20 inputs."""

    coverage_time: float
    extra_percent: float | None = None


PUBLISHED_INPUTS = 20
PUBLISHED: dict[tuple[int, int], Published] = {
    (1, 0): Published(1359),
    (2, 0): Published(773),
    (4, 0): Published(476),
    (6, 0): Published(393),
    (8, 0): Published(283),
    (10, 0): Published(242),
    (10, 1): Published(278, 7),
    (10, 5): Published(450, 25),
    (10, 9): Published(1363, 44),
}
"""By number of robots, and how many of them are lost."""


def losses(size: Size) -> Plan:
    """Plan the specification's table."""
    about = (
        f"20 x 20 coarse cells, 60 of them blocked at random; {size.inputs} worlds and starts",
        f"losses at ticks uniform over 1 to {_even_share(10)}, before or after the robot claims",
        f"the specification's numbers are means over {PUBLISHED_INPUTS} inputs",
    )
    runs = tuple(
        Run(
            {"robots": robots, "losses": lost, "lazy": lazy},
            _with_losses(
                _tree("losses", seed, {"generate": OBSTACLES}, robots, {"lazy": lazy}), lost
            ),
        )
        for robots, lost in PUBLISHED
        for lazy in ((True, False) if lost else (True,))
        for seed in range(1, size.inputs + 1)
    )
    return Plan(about, runs)


def _even_share(robots: int) -> int:
    cells = OBSTACLES["rows"] * OBSTACLES["cols"] - OBSTACLES["obstacles"]  # type: ignore[operator]
    return int(4 * cells / robots)


def _with_losses(tree: Tree, lost: int) -> Tree:
    """Kill robots at random. Tick t decides at instant t - 1; round 1 comes after the claims."""
    robots = tree["team"]["robots"]
    rng = spawn(tree["seed"], "losses", lost)
    faults = []
    for victim in rng.sample(range(robots), lost):
        tick, phase = rng.randint(1, _even_share(robots)), rng.randrange(2)
        faults.append({"kill": f"robot:{victim}", "at": float(tick - 1), "round": phase})
    return with_fields(tree, {"faults": faults}) if faults else tree


def deviation(row: Row) -> float:
    """Return how far a row is from the specification's number, in standard errors of the difference.

    The specification gives no deviation; ours stands for its.
    """
    published = PUBLISHED[int(row.labels["robots"]), int(row.labels["losses"])]
    error = row.coverage_time_sd * sqrt(1 / row.runs + 1 / PUBLISHED_INPUTS)
    difference = row.coverage_time - published.coverage_time
    if not error:
        return 0.0 if not difference else nan
    return difference / error


# Helping.


def helping(size: Size) -> Plan:
    """Plan the comparison of ORMSTC with robots that help each other."""
    about = (
        f"20 x 20 coarse cells, 60 of them blocked at random; {size.starts} worlds and starts",
        "scattered: starts uniform over the sub-cells; clustered: in coarse cells next to each other",
    )
    runs = []
    for starts in ("scattered", "clustered"):
        for variant in ("corrected", "helping"):
            for robots in size.teams:
                for seed in range(1, size.starts + 1):
                    world = {"generate": OBSTACLES}
                    tree = _tree("helping", seed, world, robots, {"variant": variant})
                    if starts == "clustered":
                        tree = _clustered(tree)
                    labels: dict[str, Label] = {
                        "starts": starts,
                        "variant": variant,
                        "robots": robots,
                    }
                    runs.append(Run(labels, tree))
    return Plan(about, tuple(runs))


def _clustered(tree: Tree) -> Tree:
    """Let the robots start in the coarse cells around one that is drawn, each in its own."""
    ground = ground_of(from_tree(tree, "helping"))[0]
    assert isinstance(ground, Grid)
    rng = spawn(tree["seed"], "cluster")
    cells: dict[Cell, None] = {rng.choice(ground.complete_cells()): None}
    for row, col in (ahead := list(cells)):
        for down, right in STEPS:
            cell = (row + down, col + right)
            if cell not in cells and ground.is_complete(*cell):
                cells[cell] = None
                ahead.append(cell)
    starts = [
        [2 * row + rng.randrange(2), 2 * col + rng.randrange(2)]
        for row, col in list(cells)[: tree["team"]["robots"]]
    ]
    return with_fields(tree, {"world.starts": starts})


# All of them.

PARTS: Mapping[str, Callable[[Size], Plan]] = {
    "figure13": figure13,
    "options": options,
    "losses": losses,
    "helping": helping,
}


def _tree(
    name: str,
    seed: int,
    world: dict[str, Any],
    robots: int,
    algorithm_options: dict[str, Any] | None = None,
) -> Tree:
    return {
        "name": name,
        "algorithm": "ormstc",
        "algorithm_options": algorithm_options or {},
        "seed": seed,
        "world": dict(world),
        "team": {"robots": robots},
    }
