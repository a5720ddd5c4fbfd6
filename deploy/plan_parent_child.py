"""What `canopy plan --algorithm parent-child` does: a map becomes stops of a parent and moves of all.

A grid of characters gives a vertex for each of them; of other maps the vertices are squares of the
spacing d, free if all of the square is (the parent-child paper, Sec. 3.2). The team covers the
connected part of its start, or else the largest one. Several teams start at the same vertex.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from msgspec import UNSET, Struct, UnsetType, json

from agents.planning.parent_child import STAY, Plan
from agents.planning.parent_child_teams import TeamPart, TeamsPlanner, time_of
from agents.planning.vertices import Reach, choose
from deploy.grid_pixels import WALL, Pixels, paint_map, paint_run
from deploy.picture_parts import (
    COLOURS,
    GREY,
    INK,
    LEGEND_MOST,
    RED,
    SIZE_IN,
    colour,
    new_page,
    save,
)
from protocol.errors import InputError
from protocol.grid import STEPS, Cell, Grid
from world_server.maps import GridFile, read_map

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PARENT_CHILD = "parent-child"
CHILDREN = 5
"""The paper's best number at its default radius."""
R_LOS_M = 2.5
SPACING_M = 0.5
IN_CHARACTERS = ("text", "movingai")
"""Kinds of files whose characters are vertices, as no scale is given in them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WantedTeam:
    """What is to be planned.

    Attributes:
        children: how many, in all teams; ``None``: `CHILDREN`.
        teams: how many parents there are, each with some of the children; 0: as many as are fastest.
        start: where all robots are at first, as text, ``r,c``; ``None``: at the first stop chosen.
        r_los_m: how far the parent sees; ``None``: `R_LOS_M`.
        spacing_m: between vertices; ``None``: `SPACING_M`.
        los_cells_squared: how far instead: the largest squared distance in cells that is seen.
    """

    children: int | None = None
    teams: int = 1
    start: str | None = None
    r_los_m: float | None = None
    spacing_m: float | None = None
    los_cells_squared: int | None = None


class TeamFacts(Struct, frozen=True, kw_only=True):
    """One of several teams, in numbers of its own, which mean what they do in `TeamPlanFacts`."""

    robots: int
    vertices: int
    parents: list[Cell]
    extra_stops: list[Cell]
    coverage_steps: int
    coordination_steps: int
    redundant_steps: int
    schedule_steps: int


class TeamPlanFacts(Struct, frozen=True, kw_only=True):
    """A plan in numbers; `agents.planning.parent_child` tells how steps are counted.

    Attributes:
        algorithm: its name.
        robots: how many children, in all teams.
        vertices: how many there are to cover, the paper's P.
        out_of_reach: free vertices in other parts of the map, which nobody covers.
        parents: where the parent is to stand, in visiting order; as many as the paper's Q. Of several
            teams one after another, as are the extra stops.
        extra_stops: further ones, for vertices that are in sight of those but not to be reached there
            without leaving sight.
        los_max, los_sum: vertices in sight of a vertex, itself included: the most, and of all together.
        coverage_steps, coordination_steps: as the paper counts them; of several teams those of the
            one that takes the most of both together.
        redundant_steps: the same, of all teams together.
        schedule_steps: ticks that robots need for all of it, the slowest team of several.
        seconds: how long planning took.
        teams: each of several.
    """

    algorithm: str
    robots: int
    vertices: int
    out_of_reach: int
    parents: list[Cell]
    extra_stops: list[Cell]
    los_max: int
    los_sum: int
    coverage_steps: int
    coordination_steps: int
    redundant_steps: int
    schedule_steps: int
    seconds: float
    teams: list[TeamFacts] | UnsetType = UNSET


class TeamPlan(NamedTuple):
    """A plan, and what it was made for.

    Attributes:
        facts: it in numbers.
        teams: parts, stops and moves of each team.
        reach: how far the parent sees, in cells, at most across the map; that far is out of sight.
    """

    facts: TeamPlanFacts
    teams: tuple[TeamPart, ...]
    reach: float

    @property
    def plan(self) -> Plan:
        """Stops and moves of the first team, mostly the only one."""
        return self.teams[0].plan


def plan_parent_child(
    grid: Grid, wanted: WantedTeam, say: Callable[[str], object] = lambda _: None
) -> TeamPlan:
    """Plan a coverage.

    Args:
        grid: the map, a cell for each vertex.
        wanted: what is to be planned.
        say: is told now and then how far it is.

    Raises:
        InputError: If something wanted does not fit the map.
    """
    began = time.perf_counter()
    reach = _reach(wanted)
    start = None if wanted.start is None else _start(grid, wanted.start)
    chosen = choose(grid, reach, start)
    start = start or chosen.parents[0]
    children = wanted.children or CHILDREN
    say(f"planning moves around {len(chosen.parents)} stops")
    planner = TeamsPlanner(chosen, start, children=children, in_file=reach.in_file)
    if wanted.teams > planner.most_teams:
        raise InputError(
            f"--teams: found {wanted.teams}, expected at most {planner.most_teams}: each needs one of "
            f"{children} children, and one of {chosen.vertices} vertices"
        )
    teams = planner.plan(wanted.teams) if wanted.teams else planner.best()
    told = [_facts_of(team) for team in teams]
    slowest = max(told, key=lambda one: one.coverage_steps + one.coordination_steps)
    facts = TeamPlanFacts(
        algorithm=PARENT_CHILD,
        robots=children,
        vertices=chosen.vertices,
        out_of_reach=len(grid.free_cells()) - chosen.vertices,
        parents=[cell for one in told for cell in one.parents],
        extra_stops=[cell for one in told for cell in one.extra_stops],
        los_max=chosen.los_max,
        los_sum=chosen.los_sum,
        coverage_steps=slowest.coverage_steps,
        coordination_steps=slowest.coordination_steps,
        redundant_steps=sum(one.redundant_steps for one in told),
        schedule_steps=time_of(teams)[0],
        seconds=round(time.perf_counter() - began, 6),
        teams=told if len(told) > 1 else UNSET,
    )
    farthest = grid.rows**2 + grid.cols**2
    return TeamPlan(facts, teams, math.sqrt(min(reach.limit, farthest) + 1))


def _facts_of(team: TeamPart) -> TeamFacts:
    plan = team.plan
    return TeamFacts(
        robots=team.children,
        vertices=len(team.part),
        parents=list(plan.order),
        extra_stops=[stop.cell for stop in plan.stops if stop.is_extra],
        coverage_steps=plan.coverage_steps,
        coordination_steps=plan.coordination_steps,
        redundant_steps=plan.redundant_steps,
        schedule_steps=plan.schedule_steps,
    )


def _reach(wanted: WantedTeam) -> Reach:
    """Return how far the parent sees."""
    limit = wanted.los_cells_squared
    if limit is not None:
        if wanted.r_los_m is not None:
            raise InputError("--los-cells-squared: --r-los is given too; expected one of both")
        if limit < 1:
            raise InputError(f"--los-cells-squared: found {limit}, expected a whole number from 1")
        return Reach.of_limit(limit)
    r_los_m, spacing_m = _or(wanted.r_los_m, R_LOS_M), _or(wanted.spacing_m, SPACING_M)
    if not r_los_m < math.inf:
        raise InputError(f"--r-los: found {r_los_m:g}, expected a finite number of metres")
    if r_los_m <= spacing_m:
        raise InputError(
            f"--r-los: found {r_los_m:g}, expected more than the spacing, {spacing_m:g}, so that the "
            "parent sees the vertices beside its own"
        )
    return Reach.of_lengths(r_los_m, spacing_m)


def _or(found: float | None, default: float) -> float:
    return default if found is None else found


def _start(grid: Grid, text: str) -> Cell:
    """Read where the team starts."""
    parts = text.split(",")
    if len(parts) != 2 or not all(part.strip().isdecimal() for part in parts):
        raise InputError(f"--starts: found {text!r}, expected 'R,C', where the whole team starts")
    start = int(parts[0]), int(parts[1])
    if not grid.is_free(*start):
        raise InputError(
            f"--starts: found {text!r}, expected a free vertex of {grid.rows} x {grid.cols}"
        )
    return start


def read_vertices(
    path: Path, spacing_m: float | None, cell_m: float | None, resolution_m: float | None
) -> GridFile:
    """Read a map as a grid of vertices.

    Args:
        path: the map.
        spacing_m: between vertices.
        cell_m: the same; at most one of both is given.
        resolution_m: side of a pixel or character.

    Raises:
        InputError: If it is no grid, or the spacing is given twice.
        MapError: If it cannot be read.
    """
    if spacing_m is not None and cell_m is not None:
        raise InputError("--cell-m: is the spacing here; expected --spacing alone")
    if spacing_m is not None and not 0 < spacing_m < math.inf:
        raise InputError(f"--spacing: found {spacing_m:g}, expected a finite number of metres > 0")
    found = read_map(path, cell_m=cell_m, resolution_m=resolution_m)
    if not isinstance(found, GridFile):
        raise InputError(f"{path}: is a graph, expected a grid")
    if cell_m is not None or (found.kind in IN_CHARACTERS and resolution_m is None):
        return found
    again = read_map(path, cell_m=spacing_m or SPACING_M, resolution_m=resolution_m)
    assert isinstance(again, GridFile)
    return again


def describe_team(found: TeamPlan) -> Iterator[str]:
    """Say in lines what a plan comes to."""
    facts = found.facts
    robots = "child covers" if facts.robots == 1 else "children cover"
    teams = len(found.teams)
    parents = "a parent" if teams == 1 else f"{teams} parents"
    yield f"{facts.algorithm}: {parents} and {facts.robots} {robots} {_count(facts.vertices)}"
    extra = f", and {len(facts.extra_stops)} extra" if facts.extra_stops else ""
    yield f"  parent stands at  {_count(len(facts.parents))}{extra}"
    yield f"  in sight          at most {_count(facts.los_max)}, {facts.los_sum} in all"
    if facts.out_of_reach:
        yield f"  left out          {_count(facts.out_of_reach)} in other parts of the map"
    yield (
        f"  steps             {facts.coverage_steps} to cover, {facts.coordination_steps} to "
        f"coordinate; {facts.redundant_steps} of all children's are redundant"
    )
    yield f"  schedule          {facts.schedule_steps} ticks"
    if facts.teams is not UNSET:
        for at, team in enumerate(facts.teams):
            robots = "child " if team.robots == 1 else "children"
            yield (
                f"  team {at:<13}{team.robots} {robots}, {_count(team.vertices)}, "
                f"{team.coverage_steps} + {team.coordination_steps} steps, "
                f"{team.schedule_steps} ticks"
            )


def _count(vertices: int) -> str:
    return "1 vertex" if vertices == 1 else f"{vertices} vertices"


def write_places(path: Path, plans: Sequence[Plan]) -> None:
    """Write where each robot is, tick by tick, as JSON, ``[row, column]`` each.

    Team by team, the parent first; who is done earlier than others stays where it is.

    Raises:
        OSError: If the file cannot be written.
    """
    length = 1 + max(plan.schedule_steps for plan in plans)
    told = [places(plan, robot) for plan in plans for robot in range(len(plan.starts))]
    path.write_bytes(json.encode([one + one[-1:] * (length - len(one)) for one in told]) + b"\n")


def places(plan: Plan, robot: int) -> list[Cell]:
    """Return where a robot of a plan is before each tick, and at the end; robot 0 is the parent."""
    row, col = plan.starts[robot]
    told = [(row, col)]
    for move in plan.moves[robot]:
        if move != STAY:
            row, col = row + STEPS[move][0], col + STEPS[move][1]
        told.append((row, col))
    return told


# The picture.

MAP_BOX = (0.03, 0.06, 0.745, 0.9)
"""Where the map may lie on the page: west, south, east, north."""
KEY_X = 0.77


def draw_team_plan(grid: Grid, found: TeamPlan, picture: Path, name: str) -> None:
    """Draw obstacles, the stops of the parent with what it sees around them, and its way.

    Several teams have a colour each, and so have their parts.

    Args:
        grid: the map.
        found: the plan.
        picture: the file to write.
        name: of the map.

    Raises:
        ValueError: If the suffix is unknown.
        OSError: If the picture cannot be written.

    Paper:
        The parent-child paper, Fig. 8.
    """
    facts = found.facts
    teams = len(found.teams)
    if teams == 1:
        subtitle = (
            f"a parent and {facts.robots} children, {facts.vertices} vertices; "
            f"{facts.coverage_steps} steps to cover, {facts.coordination_steps} to coordinate"
        )
    else:
        subtitle = (
            f"{teams} parents and {facts.robots} children, {facts.vertices} vertices; "
            f"the slowest team takes {facts.schedule_steps} ticks"
        )
    figure = new_page(f"{name}: {facts.algorithm}", subtitle)
    west, south, east, north = MAP_BOX
    width, height = (east - west) * SIZE_IN[0], (north - south) * SIZE_IN[1]
    side_in = min(width / grid.cols, height / grid.rows)
    axes = figure.add_axes(
        (west, south, side_in * grid.cols / SIZE_IN[0], side_in * grid.rows / SIZE_IN[1])
    )
    px = max(1, math.ceil(side_in * 300))
    pixels = _paint(grid, found.teams, px, px / (72 * side_in))
    axes.imshow(pixels, extent=(0, grid.cols, grid.rows, 0), aspect="auto", zorder=0)
    axes.set_xlim(0, grid.cols)
    axes.set_ylim(grid.rows, 0)
    axes.set_xticks([])
    axes.set_yticks([])
    for team, look in zip(found.teams, _looks(found.teams), strict=True):
        _draw_team(axes, team.plan, found.reach, 72 * side_in, look)
    axes.plot([], [], "o", color=GREY, markerfacecolor="none", label="line-of-sight radius")
    axes.plot([], [], "s", color=WALL, markersize=9, label="obstacle")
    axes.legend(
        loc="upper left",
        bbox_to_anchor=(KEY_X, north),
        bbox_transform=figure.transFigure,
        frameon=False,
        fontsize=10 if teams == 1 else min(9.0, 250 / min(teams, LEGEND_MOST)),
    )
    save(figure, picture)


def _paint(grid: Grid, teams: Sequence[TeamPart], px: int, px_a_pt: float) -> Pixels:
    """Return the pixels of the map; of several teams each has its part in a pale colour."""
    blocked = np.frombuffer(grid.cells(), dtype=np.uint8).reshape(grid.rows, grid.cols) != 0
    nowhere = np.zeros_like(blocked)
    if len(teams) == 1:
        return paint_map(blocked, nowhere, px, px_a_pt)
    numbers = np.full(blocked.shape, -1, dtype=np.int64)
    for at, team in enumerate(teams):
        rows, cols = zip(*team.part, strict=True)
        numbers[list(rows), list(cols)] = at
    return paint_run(blocked, numbers, np.zeros(blocked.shape), nowhere, px, px_a_pt)


class _Look(NamedTuple):
    """Colours of a team, and what the legend says.

    Attributes:
        colours: of the way, of stops, and of extra ones.
        names: of the way, the start, stops, and extra ones; ``None`` says nothing.
    """

    colours: tuple[str, str, str]
    names: tuple[str | None, str | None, str | None, str | None]


def _looks(teams: Sequence[TeamPart]) -> Iterator[_Look]:
    if len(teams) == 1:
        names = "way of the parent", "start", "vertex of the parent", "extra stop"
        yield _Look((INK, COLOURS[1], COLOURS[2]), names)
        return
    for at, team in enumerate(teams):
        robots = "child" if team.children == 1 else "children"
        way = f"{at}: {team.children} {robots}, {team.plan.schedule_steps} ticks"
        said = way if at < LEGEND_MOST else None
        yield _Look((colour(at),) * 3, (said, None if at else "start", None, None))


def _draw_team(axes: "Axes", plan: Plan, reach: float, side_pt: float, look: _Look) -> None:
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Circle

    way = np.array(places(plan, 0), dtype=np.float64)[:, ::-1] + 0.5
    width = min(1.6, max(0.5, 0.15 * side_pt))
    axes.plot(*way.T, color=look.colours[0], linewidth=width, zorder=4, label=look.names[0])
    size = min(9.0, max(3.0, side_pt))
    axes.plot(*way[0], "o", color=RED, markersize=size, zorder=6, label=look.names[1])
    size = min(7.0, max(1.5, 0.8 * side_pt))
    extra = [stop.cell for stop in plan.stops if stop.is_extra]
    for cells, sign, paint, name in (
        (plan.order, "s", look.colours[1], look.names[2]),
        (extra, "D", look.colours[2], look.names[3]),
    ):
        if cells:
            middles = np.array(cells, dtype=np.float64)[:, ::-1] + 0.5
            axes.plot(*middles.T, sign, color=paint, markersize=size, zorder=5, label=name)
            circles = PatchCollection([Circle((x, y), reach) for x, y in middles])
            circles.set(facecolor="none", edgecolor=GREY, linewidth=0.5, alpha=0.8, zorder=3)
            axes.add_collection(circles)
