"""What `canopy paper parent-child` does: the experiments on parent and child robots.

The parent-child paper, Sec. 5: maps of 30 m x 30 m with vertices 0.5 m apart, rectangles as obstacles.

table1   vertices and parent vertices, by obstacles
table2   parent vertices and redundant steps, by line-of-sight radius
table3   how long planning takes, by line-of-sight radius
figure5  time steps, by the number of children, a curve for each share of obstacles
figure6  the same, divided into coordination and coverage
figure7  so divided, by line-of-sight radius
figure8  an example: the map, the parent's vertices and way, and a run of it
teams    the paper's future work: time steps, by the number of teams that share the map and the children
played   not in the paper: some of these plans, carried out by robots on the in-process engine

A time step is one move of a robot, counted as the paper counts (`agents.planning.parent_child`). The
team starts at the first parent vertex chosen. Maps are drawn from seeds: those of the paper are not
known, nor is its definition of redundant steps; here they are the steps on walks of children that cover
nothing, as a share of all vertices. Numbers of the paper stand beside ours. Into the folder go for each
part ``PART.csv`` (a line for each plan), ``PART.json`` and, for figures, ``PART.png``.
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from pathlib import Path
from statistics import mean, pstdev

from msgspec import Struct

from experiments.command import (
    Tally,
    check_parts,
    files_of,
    in_parallel,
    print_json,
    write_csv,
    write_json,
)
from experiments.parent_child_figures import FIGURES
from experiments.parent_child_runs import (
    CARRIED_OUT,
    CHILDREN,
    R_LOS_M,
    Case,
    Measured,
    Played,
    figure8,
    measure,
    played,
)

RATIOS = (0.0, 0.2, 0.35)
RADII_M = (1.0, 2.5, 7.5)
SIZES, SIZES_QUICK = (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 13), (1, 2, 5, 9)
"""Numbers of children; the paper's laboratory has 13."""
SHARED, SHARED_QUICK = (6, 12), (6,)
"""Numbers of children that several teams share."""
TEAMS = (1, 2, 3, 4, 6)
"""Numbers of teams."""
SEEDS, SEEDS_QUICK = 8, 2


class Row(Struct, frozen=True, kw_only=True):
    """The means over the maps of one kind.

    Attributes:
        ratio: share of the area that is obstructed.
        r_los_m: line-of-sight radius.
        children: how many, in all teams.
        teams: how many parents, with children of their own.
        maps: how many; without obstacles there is only one.
        vertices, parents, extra: the paper's P and Q, and further vertices of the parent.
        coverage, coordination, steps: steps as the paper counts them, and their sum.
        steps_sd: standard deviation of the sum.
        ticks: that robots need.
        redundant_percent: steps of children that cover nothing, a hundred vertices.
        cpu_s: processor time of one plan.
        paper: what the paper has at this point, by the name of the number.
    """

    ratio: float
    r_los_m: float
    children: int
    teams: int
    maps: int
    vertices: float
    parents: float
    extra: float
    coverage: float
    coordination: float
    steps: float
    steps_sd: float
    ticks: float
    redundant_percent: float
    cpu_s: float
    paper: dict[str, float]


PAPER: dict[str, dict[tuple[float, float], dict[str, float]]] = {
    "table1": {
        (0.0, 2.5): {"vertices": 3600, "parents": 71},
        (0.2, 2.5): {"vertices": 2858, "parents": 78},
        (0.35, 2.5): {"vertices": 2317, "parents": 86},
    },
    "table2": {
        (0.2, 1.0): {"parents": 364, "redundant_percent": 20.11},
        (0.2, 2.5): {"parents": 78, "redundant_percent": 12.06},
        (0.2, 7.5): {"parents": 24, "redundant_percent": 10.68},
    },
    "table3": {
        (0.2, 1.0): {"minutes": 10.43},
        (0.2, 2.5): {"minutes": 10.76},
        (0.2, 7.5): {"minutes": 148.1},
    },
    "figure5": {(0.2, 2.5): {"fewest_with": 5}, (0.35, 2.5): {"fewest_with": 5}},
    "figure6": {(0.2, 2.5): {"fewest_with": 5}, (0.35, 2.5): {"fewest_with": 5}},
    "figure7": {
        (0.2, 1.0): {"fewest_with": 2},
        (0.2, 2.5): {"fewest_with": 5},
        (0.2, 7.5): {"fewest_with": 9},
    },
}
"""What the paper has, by part, and by share of obstacles and radius; it has one map of each kind.

``fewest_with``: the number of children with which fewest time steps are needed.
"""


def rows_of(part: str, results: dict[Case, Measured]) -> list[Row]:
    """Average the plans that differ by their seed only."""
    kinds: dict[tuple[float, float, int, int], list[Measured]] = {}
    for case, measured in results.items():
        kind = case.ratio, case.r_los_m, case.children, case.teams
        kinds.setdefault(kind, []).append(measured)
    return [
        Row(
            ratio=ratio,
            r_los_m=r_los_m,
            children=children,
            teams=teams,
            maps=len(found),
            vertices=mean(one.vertices for one in found),
            parents=mean(one.parents for one in found),
            extra=mean(one.extra for one in found),
            coverage=mean(one.coverage for one in found),
            coordination=mean(one.coordination for one in found),
            steps=mean(one.coverage + one.coordination for one in found),
            steps_sd=pstdev(one.coverage + one.coordination for one in found),
            ticks=mean(one.ticks for one in found),
            redundant_percent=mean(100 * one.redundant / one.vertices for one in found),
            cpu_s=mean(one.cpu_s for one in found),
            paper=PAPER.get(part, {}).get((ratio, r_los_m), {}),
        )
        for (ratio, r_los_m, children, teams), found in kinds.items()
    ]


# Parts.


def by_obstacles(sizes: Sequence[int], seeds: int) -> Iterator[Case]:
    """List the plans on maps with more and more obstacles; without any there is one map."""
    for ratio, children in product(RATIOS, sizes):
        for seed in range(seeds if ratio else 1):
            yield Case(ratio, R_LOS_M, children, seed)


def by_radius(sizes: Sequence[int], seeds: int) -> Iterator[Case]:
    """List the plans of parents that see farther and farther."""
    for r_los_m, children, seed in product(RADII_M, sizes, range(seeds)):
        yield Case(0.2, r_los_m, children, seed)


def by_teams(sizes: Sequence[int], seeds: int) -> Iterator[Case]:
    """List the plans of more and more teams that share their children."""
    for children, teams, seed in product(sizes, TEAMS, range(seeds)):
        yield Case(0.2, R_LOS_M, children, seed, teams)


Lister = Callable[[Sequence[int], int], Iterator[Case]]
Sizes = tuple[int, ...]

PLANNED: dict[str, tuple[Lister, Sizes, Sizes]] = {
    "table1": (by_obstacles, (CHILDREN,), (CHILDREN,)),
    "table2": (by_radius, (1, CHILDREN), (1, CHILDREN)),
    "table3": (by_radius, (CHILDREN,), (CHILDREN,)),
    "figure5": (by_obstacles, SIZES, SIZES_QUICK),
    "figure6": (by_obstacles, SIZES, SIZES_QUICK),
    "figure7": (by_radius, SIZES, SIZES_QUICK),
    "teams": (by_teams, SHARED, SHARED_QUICK),
}
"""What each part lists, its numbers of children, and those of a quick look."""

PARTS = (
    "table1",
    "table2",
    "table3",
    "figure5",
    "figure6",
    "figure7",
    "figure8",
    "teams",
    "played",
)


# The command.


def parent_child(
    *, out: Path | None, only: Sequence[str], quick: bool, inputs: int | None, as_json: bool
) -> int:
    """Compute the experiments on parent and child robots; return 1 if a run was not as planned.

    Args:
        out: folder for the files; default: ``runs/paper-parent-child``.
        only: parts; none: all.
        quick: few maps, few numbers of children, one run.
        inputs: maps with obstacles of each kind (8).
        as_json: print the numbers as one JSON object, and no tables.

    Raises:
        InputError: If there is no such part, or the files cannot be written.
    """
    check_parts(only, PARTS)
    seeds = inputs or (SEEDS_QUICK if quick else SEEDS)
    wanted = [part for part in PARTS if part in (only or PARTS)]
    numbers: dict[str, list[Row] | list[Played]] = {}
    with files_of("parent-child", out) as folder:
        cases = {part: cases_of(part, seeds, quick=quick) for part in wanted if part in PLANNED}
        results: dict[Case, Measured] = {}
        if cases:
            several = list(dict.fromkeys(case for listed in cases.values() for case in listed))
            with Tally("plans") as tally:
                found = in_parallel(measure, several, tally.show, chunk=2)
            results = dict(zip(several, found, strict=True))
        for part in wanted:
            if part == "figure8":
                numbers[part] = figure8(folder)
            elif part == "played":
                numbers[part] = played(folder, CARRIED_OUT[:1] if quick else CARRIED_OUT)
            else:
                chosen = {case: results[case] for case in cases[part]}
                numbers[part] = write(folder, part, chosen)
    if as_json:
        print_json("parent-child", folder, numbers)
    else:
        for part, rows in numbers.items():
            print_part(part, rows)
        print(f"\nfigures and numbers in {folder}")
    runs = (run for rows in numbers.values() for run in rows if isinstance(run, Played))
    return 0 if all(run.as_planned for run in runs) else 1


def cases_of(part: str, seeds: int, *, quick: bool) -> list[Case]:
    """List the plans of a part."""
    lister, sizes, sizes_quick = PLANNED[part]
    return list(lister(sizes_quick if quick else sizes, seeds))


def write(folder: Path, part: str, results: dict[Case, Measured]) -> list[Row]:
    """Write the numbers of a part, and its figure if it has one; return the means."""
    rows = rows_of(part, results)
    if part in FIGURES:
        FIGURES[part](rows, folder / f"{part}.png")
    write_json(folder / f"{part}.json", rows)
    lines = ((*case, *measured) for case, measured in results.items())
    write_csv(folder / f"{part}.csv", (*Case._fields, *Measured._fields), lines)
    return rows


# Tables.


def print_part(part: str, rows: Sequence[Row] | Sequence[Played]) -> None:
    """Print a table on stdout."""
    print(f"\n{part}: {TITLES[part]}")
    for row in rows:
        print(f"  {_line(part, row)}")
    if part in FIGURES and part != "teams":
        for line in fewest([row for row in rows if isinstance(row, Row)]):
            print(f"  {line}")
    sys.stdout.flush()


TITLES = {
    "table1": "vertices and parent vertices",
    "table2": "parent vertices and redundant steps",
    "table3": "processor time of planning (the paper: 1 GHz, up to 148 minutes)",
    "figure5": "time steps, by children",
    "figure6": "time steps, by children",
    "figure7": "time steps, by children",
    "figure8": "the example, carried out",
    "teams": "time steps, by teams that share the children",
    "played": "plans carried out on the in-process engine",
}


def _line(part: str, row: Row | Played) -> str:
    team = f"{row.children:2} {'child' if row.children == 1 else 'children'}"
    kind = f"{100 * row.ratio:3.0f} % obstructed, r_los = {row.r_los_m:g} m, {team}:"
    if isinstance(row, Played):
        verdict = "as planned" if row.as_planned else "NOT AS PLANNED"
        broken = f" ({', '.join(row.broken)})" if row.broken else ""
        taken = "-" if row.makespan is None else f"{row.makespan:g}"
        return f"{kind} planned {row.planned} ticks, taken {taken}: {verdict}{broken}"
    paper = {name: f" (paper {value:g})" for name, value in row.paper.items()}
    match part:
        case "table1":
            return (
                f"{kind} P = {row.vertices:.0f}{paper.get('vertices', '')}, "
                f"Q = {row.parents:.0f}{paper.get('parents', '')}, {row.extra:.1f} extra"
            )
        case "table2":
            return (
                f"{kind} Q = {row.parents:.0f}{paper.get('parents', '')}, redundant "
                f"{row.redundant_percent:.1f} %{paper.get('redundant_percent', '')}"
            )
        case "table3":
            minutes = row.paper.get("minutes")
            told = "" if minutes is None else f" (paper {minutes:g} min)"
            return f"{kind} {row.cpu_s:.2f} s{told}"
        case "teams":
            return (
                f"{kind[:-1]}, {row.teams} {'team' if row.teams == 1 else 'teams'}: "
                f"{row.steps:5.0f} ± {row.steps_sd:3.0f}; {row.ticks:5.0f} ticks of robots"
            )
        case _:
            return (
                f"{kind} {row.steps:5.0f} ± {row.steps_sd:3.0f} = {row.coordination:5.0f} to "
                f"coordinate + {row.coverage:5.0f} to cover; {row.ticks:5.0f} ticks of robots"
            )


def fewest(rows: Sequence[Row]) -> Iterator[str]:
    """Say with how many children the fewest steps are needed."""
    for ratio, r_los_m in dict.fromkeys((row.ratio, row.r_los_m) for row in rows):
        curve = [row for row in rows if (row.ratio, row.r_los_m) == (ratio, r_los_m)]
        best = min(curve, key=lambda row: row.steps)
        told = best.paper.get("fewest_with")
        paper = "" if told is None else f" (paper {told})"
        yield (
            f"{100 * ratio:.0f} % obstructed, r_los = {r_los_m:g} m: fewest steps with "
            f"{best.children} children{paper}"
        )
