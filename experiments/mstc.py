"""What `canopy paper mstc` does: the experiments on offline coverage, with figures and tables.

Agmon, Hazon, Kaminka 2008, Sec. 3.3: 20 x 30 coarse cells, 0 to 160 of them obstacles, robots at random
sub-cells; NB and Opt MSTC on a random tree against the same on the tree of Create_Tree.

figure6    Create_Tree with alpha 1, 2 and 3, 80 obstacles
figure7    coverage times, by obstacles
figure8    by how much Create_Tree improves them

Times are moves. Means go with a paired, two-tailed t-test. Into the folder go for each part
``PART.png``, ``PART.csv`` (a line for each input) and ``PART.json``.
"""

import sys
from collections.abc import Iterable, Sequence
from math import atan, cos, exp, lgamma, pi, sqrt
from pathlib import Path
from statistics import mean, stdev
from typing import TYPE_CHECKING, NamedTuple

from msgspec import Struct

from agents.algorithms.stc import number
from agents.planning.splits import nb_mstc, opt_mstc
from agents.planning.team import Kind, tree_of
from agents.planning.tour import Places, circumnavigate
from deploy.picture_parts import COLOURS
from experiments import plots
from experiments.command import (
    Tally,
    check_parts,
    files_of,
    in_parallel,
    print_json,
    write_csv,
    write_json,
)
from protocol.errors import InputError
from protocol.seeds import spawn
from world_server.maps.generated_grids import random_obstacles

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ROWS, COLS = 20, 30
OBSTACLES = (0, 40, 80, 100, 160)
ROBOTS = (3, 5, 10, 15, 20, 25, 30)
INPUTS, INPUTS_QUICK = 300, 20
PARTS = ("figure6", "figure7", "figure8")

RANDOM = "random"


class Input(NamedTuple):
    """One map with one team on it, and how its tree is made.

    Attributes:
        obstacles: blocked coarse cells.
        robots: number of robots.
        case: which of the inputs of that kind.
        alpha: of Create_Tree; 0 for a random tree.
    """

    obstacles: int
    robots: int
    case: int
    alpha: float


class Times(NamedTuple):
    """Coverage times of NB and Opt MSTC, moves."""

    nb: int
    opt: int


def coverage_times(one: Input) -> Times:
    """Plan for one input. The map and the starts depend on all but alpha."""
    obstacles, robots, case, alpha = one
    rng = spawn(0, "paper-mstc", obstacles, robots, case)
    grid = random_obstacles(ROWS, COLS, obstacles, rng)
    starts = rng.sample(grid.free_cells(), robots)
    cells = sorted(map(number, grid.complete_cells()))
    kind = Kind("create-tree" if alpha else RANDOM, "", "manhattan", alpha)
    tour = circumnavigate(tree_of(kind, cells, starts, case), starts[0])
    gaps = Places(tour, starts).gaps
    return Times(nb_mstc(gaps).moves, opt_mstc(gaps).moves)


class Row(Struct, frozen=True):
    """The means over the inputs of one kind, moves.

    Attributes:
        obstacles: blocked coarse cells.
        robots: number of robots.
        inputs: how many.
        alpha: of Create_Tree.
        nb_random, opt_random: on a random tree.
        nb, opt: on the tree of Create_Tree.
        nb_improvement, opt_improvement: by which share these are shorter.
        nb_p, opt_p: chance of such a difference if there were none (paired t-test, two-tailed).
    """

    obstacles: int
    robots: int
    inputs: int
    alpha: float
    nb_random: float
    opt_random: float
    nb: float
    opt: float
    nb_improvement: float
    opt_improvement: float
    nb_p: float
    opt_p: float


def rows_of(inputs: Sequence[Input], times: Sequence[Times]) -> list[Row]:
    """Compare Create_Tree with random trees, kind by kind."""
    found = dict(zip(inputs, times, strict=True))
    kinds = dict.fromkeys((one.obstacles, one.robots, one.alpha) for one in inputs if one.alpha)
    rows = []
    for obstacles, robots, alpha in kinds:
        count = sum(one[:2] == (obstacles, robots) and one.alpha == alpha for one in inputs)
        ours = [found[Input(obstacles, robots, case, alpha)] for case in range(count)]
        others = [found[Input(obstacles, robots, case, 0.0)] for case in range(count)]
        nb_random, nb = (mean(one.nb for one in group) for group in (others, ours))
        opt_random, opt = (mean(one.opt for one in group) for group in (others, ours))
        pairs = list(zip(others, ours, strict=True))
        rows.append(
            Row(
                obstacles=obstacles,
                robots=robots,
                inputs=count,
                alpha=alpha,
                nb_random=nb_random,
                opt_random=opt_random,
                nb=nb,
                opt=opt,
                nb_improvement=1 - nb / nb_random,
                opt_improvement=1 - opt / opt_random,
                nb_p=t_test([before.nb - after.nb for before, after in pairs]),
                opt_p=t_test([before.opt - after.opt for before, after in pairs]),
            )
        )
    return rows


def t_test(differences: Sequence[float]) -> float:
    """Return the two-tailed p of a paired t-test: Student's distribution, integrated.

    Args:
        differences: of the pairs, at least two.
    """
    count, spread = len(differences), stdev(differences)
    if not spread:
        return 1.0 if not mean(differences) else 0.0
    t, freedom = abs(mean(differences)) / (spread / sqrt(count)), count - 1
    scale = exp(lgamma((freedom + 1) / 2) - lgamma(freedom / 2)) / sqrt(pi)
    # With x = sqrt(freedom) tan a the density is scale cos(a) ** (freedom - 1); by Simpson's rule.
    start, steps = atan(t / sqrt(freedom)), 2000
    width = (pi / 2 - start) / steps
    weights = (1 if step in (0, steps) else 4 if step % 2 else 2 for step in range(steps + 1))
    tail = sum(
        weight * max(0.0, cos(start + step * width)) ** (freedom - 1)
        for step, weight in enumerate(weights)
    )
    return min(1.0, 2 * scale * tail * width / 3)


def plan_of(part: str, inputs: int, robots: Sequence[int]) -> list[Input]:
    """Return what a part is computed from."""
    alphas = (1.0, 2.0, 3.0) if part == "figure6" else (2.0,)
    obstacles = (80,) if part == "figure6" else OBSTACLES
    return [
        Input(blocked, team, case, alpha)
        for blocked in obstacles
        for team in robots
        for alpha in (0.0, *alphas)
        for case in range(inputs)
    ]


def mstc(
    *, out: Path | None, only: Sequence[str], quick: bool, inputs: int | None, as_json: bool
) -> int:
    """Compute the experiments on offline coverage, and return the exit code.

    Args:
        out: folder for the files; default: ``runs/paper-mstc``.
        only: parts; none: all.
        quick: few inputs.
        inputs: maps and starts for each number of robots and of obstacles (300).
        as_json: print the numbers as one JSON object, and no tables.

    Raises:
        InputError: If there is no such part, or the files cannot be written.
    """
    check_parts(only, PARTS)
    count = inputs or (INPUTS_QUICK if quick else INPUTS)
    if count < 2:
        raise InputError("--inputs: found 1, expected at least 2 for a t-test")
    robots = (3, 10, 30) if quick else ROBOTS
    numbers: dict[str, list[Row]] = {}
    same: tuple[list[Input], list[Times]] | None = None  # figures 7 and 8 show the same runs
    with files_of("mstc", out) as folder:
        for part in PARTS:
            if part not in (only or PARTS):
                continue
            if part == "figure6" or same is None:
                plan = plan_of(part, count, robots)
                with Tally(part) as tally:
                    times = in_parallel(coverage_times, plan, tally.show, chunk=16)
                if part != "figure6":
                    same = (plan, times)
            else:
                plan, times = same
            numbers[part] = rows_of(plan, times)
            write(folder, part, plan, times, numbers[part])
    if as_json:
        print_json("mstc", folder, numbers)
    else:
        for part, rows in numbers.items():
            print_rows(part, rows)
        print(f"\nfigures and numbers in {folder}")
    return 0


def write(
    folder: Path, part: str, plan: Sequence[Input], times: Sequence[Times], rows: Sequence[Row]
) -> None:
    """Write the figure of a part and its numbers."""
    FIGURES[part](rows, folder / f"{part}.png")
    write_json(folder / f"{part}.json", rows)
    lines = ((*one, *time) for one, time in zip(plan, times, strict=True))
    write_csv(folder / f"{part}.csv", (*Input._fields, *Times._fields), lines)


def print_rows(part: str, rows: Iterable[Row]) -> None:
    """Print a table on stdout."""
    print(f"\n{part}: coverage time in moves, random tree against Create_Tree")
    print(
        f"  {'obstacles':>9} {'robots':>6} {'alpha':>5} {'NB':>13} {'Opt':>13}"
        f" {'improved by':>13} {'p at most':>9}"
    )
    for row in rows:
        p = max(row.nb_p, row.opt_p)
        print(
            f"  {row.obstacles:9} {row.robots:6} {row.alpha:5g}"
            f" {row.nb_random:6.0f} {row.nb:6.0f} {row.opt_random:6.0f} {row.opt:6.0f}"
            f" {100 * row.nb_improvement:5.0f} % {100 * row.opt_improvement:3.0f} %"
            f" {'<1e-12' if p < 1e-12 else f'{p:.1g}':>9}"
        )
    sys.stdout.flush()


# Figures.


def figure6(rows: Sequence[Row], path: Path) -> None:
    """Draw coverage times by alpha."""
    figure = plots.new(6.0, 4.2)
    axes = figure.subplots()
    for at, alpha in enumerate(sorted({row.alpha for row in rows})):
        chosen = [row for row in rows if row.alpha == alpha]
        _line(axes, chosen, [row.nb for row in chosen], f"NB, alpha = {alpha:g}", at)
        name = f"Opt, alpha = {alpha:g}"
        _line(axes, chosen, [row.opt for row in chosen], name, at, dashed=True)
    _finish(axes, rows, "coverage time (moves)")
    plots.save(figure, path)


def figure7(rows: Sequence[Row], path: Path) -> None:
    """Draw coverage times on both kinds of tree, a panel for each number of obstacles."""
    obstacles = sorted({row.obstacles for row in rows})
    figure = plots.new(3.0 * len(obstacles), 3.4)
    panels = figure.subplots(1, len(obstacles), squeeze=False)[0]
    for axes, blocked in zip(panels, obstacles, strict=True):
        chosen = [row for row in rows if row.obstacles == blocked]
        _line(axes, chosen, [row.nb_random for row in chosen], "NB, random tree", 0)
        _line(axes, chosen, [row.opt_random for row in chosen], "Opt, random tree", 0, dashed=True)
        _line(axes, chosen, [row.nb for row in chosen], "NB, Create_Tree", 1)
        _line(axes, chosen, [row.opt for row in chosen], "Opt, Create_Tree", 1, dashed=True)
        axes.set_title(f"{blocked} obstacles", fontsize=9.5)
        _finish(axes, chosen, "coverage time (moves)")
    plots.save(figure, path)


def figure8(rows: Sequence[Row], path: Path) -> None:
    """Draw by how much Create_Tree improves, NB left and Opt right, a curve for each density."""
    figure = plots.new(8.0, 3.8)
    left, right = figure.subplots(1, 2, sharey=True)
    for at, blocked in enumerate(sorted({row.obstacles for row in rows})):
        chosen = [row for row in rows if row.obstacles == blocked]
        name = f"{blocked} obstacles"
        _line(left, chosen, [100 * row.nb_improvement for row in chosen], name, at)
        _line(right, chosen, [100 * row.opt_improvement for row in chosen], name, at)
    for axes, name in ((left, "NB"), (right, "Opt")):
        axes.set_title(name, fontsize=9.5)
        _finish(axes, rows, "shorter by (%)")
    plots.save(figure, path)


FIGURES = {"figure6": figure6, "figure7": figure7, "figure8": figure8}
"""By the name of the part."""


def _line(
    axes: "Axes",
    rows: Sequence[Row],
    values: Sequence[float],
    name: str,
    at: int,
    *,
    dashed: bool = False,
) -> None:
    axes.plot(
        [row.robots for row in rows],
        values,
        label=name,
        color=COLOURS[at],
        marker=plots.MARKS[at % len(plots.MARKS)],
        markersize=4,
        linewidth=1.3,
        linestyle=(0, (4, 2)) if dashed else "-",
    )


def _finish(axes: "Axes", rows: Sequence[Row], y: str) -> None:
    plots.dress(axes, "robots", y, (row.robots for row in rows))
    axes.legend(frameon=False, fontsize=7.5)
