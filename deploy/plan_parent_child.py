"""What `canopy plan --algorithm parent-child` does: a map becomes stops of a parent and moves of all.

A grid of characters gives a vertex for each of them; of other maps the vertices are squares of the
spacing d, free if all of the square is (the parent-child paper, Sec. 3.2). The team covers the
connected part of its start, or else the largest one.
"""

import argparse
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from msgspec import Struct, json

from agents.planning.parent_child import STAY, Plan, Zones, plan_team
from agents.planning.vertices import Reach, choose
from deploy.grid_pixels import WALL, paint_map
from deploy.picture_parts import COLOURS, GREY, INK, RED, SIZE_IN, new_page, save
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
        children: how many; ``None``: `CHILDREN`.
        start: where all robots are at first, as text, ``r,c``; ``None``: at the first stop chosen.
        r_los_m: how far the parent sees; ``None``: `R_LOS_M`.
        spacing_m: between vertices; ``None``: `SPACING_M`.
        los_cells_squared: how far instead: the largest squared distance in cells that is seen.
    """

    children: int | None = None
    start: str | None = None
    r_los_m: float | None = None
    spacing_m: float | None = None
    los_cells_squared: int | None = None


class TeamPlanFacts(Struct, frozen=True, kw_only=True):
    """A plan in numbers; `agents.planning.parent_child` tells how steps are counted.

    Attributes:
        algorithm: its name.
        robots: how many children.
        vertices: how many there are to cover, the paper's P.
        parents: where the parent is to stand, in visiting order; as many as the paper's Q.
        extra_stops: further ones, for vertices that are in sight of those but not to be reached there
            without leaving sight.
        los_max, los_sum: vertices in sight of a vertex, itself included: the most, and of all together.
        coverage_steps, coordination_steps, redundant_steps: as the paper counts them.
        schedule_steps: ticks that robots need for all of it.
        seconds: how long planning took.
    """

    algorithm: str
    robots: int
    vertices: int
    parents: list[Cell]
    extra_stops: list[Cell]
    los_max: int
    los_sum: int
    coverage_steps: int
    coordination_steps: int
    redundant_steps: int
    schedule_steps: int
    seconds: float


class TeamPlan(NamedTuple):
    """A plan, and what it was made for.

    Attributes:
        facts: it in numbers.
        plan: stops and moves.
        reach: how far the parent sees, in cells; the distance itself is out of sight.
    """

    facts: TeamPlanFacts
    plan: Plan
    reach: float


def lines_of(arguments: argparse.Namespace) -> Iterator[str]:
    """Plan what the command line says, write the files it names, and yield what is to be printed.

    Raises:
        InputError: If something wanted does not fit the map, or a file cannot be written.
        MapError: If the map cannot be read.
    """
    for option in ("tree", "all_bridges", "open"):
        if getattr(arguments, option):
            name = option.replace("_", "-")
            raise InputError(f"--{name}: the algorithm parent-child has none; expected no --{name}")
    found = read_vertices(
        arguments.map, arguments.spacing, arguments.cell_m, arguments.resolution_m
    )
    wanted = WantedTeam(
        children=arguments.robots,
        start=arguments.starts,
        r_los_m=arguments.r_los,
        spacing_m=arguments.spacing if arguments.cell_m is None else arguments.cell_m,
        los_cells_squared=arguments.los_cells_squared,
    )
    planned = plan_parent_child(found.grid, wanted)
    try:
        if arguments.paths is not None:
            write_places(arguments.paths, planned.plan)
        if arguments.picture is not None:
            draw_team_plan(found.grid, planned, arguments.picture, arguments.map.stem)
    except (OSError, ValueError) as error:
        raise InputError(f"--paths or --picture: {error}; expected a file to write") from None
    if arguments.json:
        yield json.encode(planned.facts).decode()
    else:
        yield from describe_team(planned)


def plan_parent_child(grid: Grid, wanted: WantedTeam) -> TeamPlan:
    """Plan a coverage.

    Args:
        grid: the map, a cell for each vertex.
        wanted: what is to be planned.

    Raises:
        InputError: If something wanted does not fit the map.
    """
    began = time.perf_counter()
    reach = _reach(wanted)
    start = None if wanted.start is None else _start(grid, wanted.start)
    chosen = choose(grid, reach.limit, start)
    start = start or chosen.parents[0]
    children = wanted.children or CHILDREN
    plan = plan_team(
        Zones(grid, chosen.sights.seen),
        chosen.parents,
        parent=start,
        children=[start] * children,
        in_file=reach.in_file,
    )
    facts = TeamPlanFacts(
        algorithm=PARENT_CHILD,
        robots=children,
        vertices=chosen.vertices,
        parents=list(plan.order),
        extra_stops=[stop.cell for stop in plan.stops if stop.is_extra],
        los_max=chosen.los_max,
        los_sum=chosen.los_sum,
        coverage_steps=plan.coverage_steps,
        coordination_steps=plan.coordination_steps,
        redundant_steps=plan.redundant_steps,
        schedule_steps=plan.schedule_steps,
        seconds=round(time.perf_counter() - began, 6),
    )
    return TeamPlan(facts, plan, math.sqrt(reach.limit + 1))


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
    yield f"{facts.algorithm}: a parent and {facts.robots} {robots} {facts.vertices} vertices"
    extra = f", and {len(facts.extra_stops)} extra" if facts.extra_stops else ""
    yield f"  parent stands at  {len(facts.parents)} vertices{extra}"
    yield f"  in sight          at most {facts.los_max} vertices, {facts.los_sum} in all"
    yield (
        f"  steps             {facts.coverage_steps} to cover, {facts.coordination_steps} to "
        f"coordinate; {facts.redundant_steps} of all children's are redundant"
    )
    yield f"  schedule          {facts.schedule_steps} ticks"


def write_places(path: Path, plan: Plan) -> None:
    """Write where each robot is, tick by tick, as JSON: the parent first, ``[row, column]`` each.

    Raises:
        OSError: If the file cannot be written.
    """
    path.write_bytes(
        json.encode([places(plan, robot) for robot in range(len(plan.starts))]) + b"\n"
    )


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
    figure = new_page(
        f"{name}: {facts.algorithm}",
        f"a parent and {facts.robots} children, {facts.vertices} vertices; "
        f"{facts.coverage_steps} steps to cover, {facts.coordination_steps} to coordinate",
    )
    west, south, east, north = MAP_BOX
    width, height = (east - west) * SIZE_IN[0], (north - south) * SIZE_IN[1]
    side_in = min(width / grid.cols, height / grid.rows)
    axes = figure.add_axes(
        (west, south, side_in * grid.cols / SIZE_IN[0], side_in * grid.rows / SIZE_IN[1])
    )
    px = max(1, math.ceil(side_in * 300))
    blocked = np.frombuffer(grid.cells(), dtype=np.uint8).reshape(grid.rows, grid.cols) != 0
    pixels = paint_map(blocked, np.zeros_like(blocked), px, px / (72 * side_in))
    axes.imshow(pixels, extent=(0, grid.cols, grid.rows, 0), aspect="auto", zorder=0)
    axes.set_xlim(0, grid.cols)
    axes.set_ylim(grid.rows, 0)
    axes.set_xticks([])
    axes.set_yticks([])
    _draw_stops(axes, found, 72 * side_in)
    axes.legend(
        loc="upper left",
        bbox_to_anchor=(KEY_X, north),
        bbox_transform=figure.transFigure,
        frameon=False,
        fontsize=10,
    )
    save(figure, picture)


def _draw_stops(axes: "Axes", found: TeamPlan, side_pt: float) -> None:
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Circle

    way = np.array(places(found.plan, 0), dtype=np.float64)[:, ::-1] + 0.5
    width = min(1.6, max(0.5, 0.15 * side_pt))
    axes.plot(*way.T, color=INK, linewidth=width, zorder=4, label="way of the parent")
    size = min(9.0, max(3.0, side_pt))
    axes.plot(*way[0], "o", color=RED, markersize=size, zorder=6, label="start")
    size = min(7.0, max(1.5, 0.8 * side_pt))
    for cells, sign, colour, name in (
        (found.facts.parents, "s", COLOURS[1], "vertex of the parent"),
        (found.facts.extra_stops, "D", COLOURS[2], "extra stop"),
    ):
        if cells:
            middles = np.array(cells, dtype=np.float64)[:, ::-1] + 0.5
            axes.plot(*middles.T, sign, color=colour, markersize=size, zorder=5, label=name)
            circles = PatchCollection([Circle((x, y), found.reach) for x, y in middles])
            circles.set(facecolor="none", edgecolor=GREY, linewidth=0.5, alpha=0.8, zorder=3)
            axes.add_collection(circles)
    axes.plot([], [], "o", color=GREY, markerfacecolor="none", label="line-of-sight radius")
    axes.plot([], [], "s", color=WALL, markersize=9, label="obstacle")
