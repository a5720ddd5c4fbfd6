"""Planning for a parent and its children: processor time, beside searching the map from each stop.

    python -m benchmarks.parent_child [--repeats 5]

The whole plan: who sees whom, parent vertices, their order, roadmaps, every move. The floor is one
breadth-first search over the whole map from every parent vertex, in plain Python; on the large map
from some of them only, scaled up.
"""

import argparse
import resource
import time
from collections.abc import Callable, Sequence
from statistics import median

from agents.planning.child_roadmaps import distances
from agents.planning.parent_child import Plan, Zones, plan_team
from agents.planning.vertices import Choice, Reach, choose
from benchmarks.table import print_table
from protocol.grid import Grid
from protocol.seeds import spawn
from world_server.maps.generated_grids import rectangles

CHILDREN = 5
SEARCHES = 20
"""From so many parent vertices at most the floor is measured."""


def planned(grid: Grid, reach: Reach) -> tuple[Choice, Plan]:
    """Plan for a team that starts at the first parent vertex chosen."""
    chosen = choose(grid, reach)
    start = chosen.parents[0]
    return chosen, plan_team(
        Zones(grid, chosen.sights.seen),
        chosen.parents,
        parent=start,
        children=[start] * CHILDREN,
        in_file=reach.in_file,
    )


def search(grid: Grid, stops: Sequence[tuple[int, int]]) -> None:
    """Search the map from some stops."""
    free = {grid.place(*cell) for cell in grid.free_cells()}
    for stop in stops:
        distances(free, grid.place(*stop), grid.stride)


def _seconds(run: Callable[[], object]) -> float:
    before = time.process_time()
    run()
    return time.process_time() - before


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    repeats = parser.parse_args().repeats

    rows = []
    for side, reach, times in (
        (60, Reach.of_lengths(1.0, 0.5), repeats),
        (60, Reach.of_lengths(2.5, 0.5), repeats),
        (60, Reach.of_lengths(7.5, 0.5), repeats),
        (512, Reach.of_limit(99), 1),
    ):
        grid = rectangles(side, side, 0.2, spawn(0, "world"))
        stops = choose(grid, reach).parents
        some = stops[:: -(-len(stops) // SEARCHES)]
        pairs = []
        for _ in range(times):
            spent_s = _seconds(lambda grid=grid, reach=reach: planned(grid, reach))  # type: ignore[misc]  # bound now
            floor_s = _seconds(lambda grid=grid, some=some: search(grid, some))  # type: ignore[misc]  # bound now
            pairs.append((spent_s, floor_s * len(stops) / len(some)))
        rows.append(
            (
                f"{side} x {side}, {reach.in_file} cells",
                len(stops),
                f"{median(spent for spent, _ in pairs):.2f}",
                f"{median(floor for _, floor in pairs):.2f}",
                f"{median(spent / floor for spent, floor in pairs):.2f}",
                f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f}",
            )
        )
    print_table(
        f"parent-child, {CHILDREN} children, 20 % obstacles",
        ("map and radius", "stops", "s", "floor, s", "times the floor", "MB"),
        rows,
        "targets: at most 1.0 s at 5 cells, 3 s at 15; 60 s and 1024 MB on the large map",
    )


if __name__ == "__main__":
    main()
