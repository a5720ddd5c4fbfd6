"""What every algorithm of the registry that plays on grids owes, in each of its variants."""

from collections.abc import Callable
from random import Random
from typing import Any

import pytest

from agents.registry import ALGORITHMS, GRID_ALGORITHMS, PARENT_ALGORITHMS, algorithm_of
from deploy.inprocess import play
from protocol.grid import Grid
from protocol.scenario import from_tree
from protocol.trace import Event
from tests.play import sha256
from world_server.maps.generated_grids import random_obstacles, rooms, warehouse
from world_server.terrain import terrain_of
from world_server.world import World

VARIANTS: dict[str, tuple[dict[str, Any], ...]] = {
    "mstc": ({}, {"split": "nb", "tree": "random"}, {"split": "b", "home": True}),
    "ormstc": ({}, {"variant": "helping"}, {"lazy": False, "conflict": "fewest-cells"}),
}

ALIKE = GRID_ALGORITHMS - PARENT_ALGORITHMS
"""Those of robots that are alike; `test_parent_child.py` has the same tests of the others."""

pytestmark = pytest.mark.parametrize(
    ("algorithm", "options"),
    [(name, options) for name in sorted(ALIKE) for options in VARIANTS[name]],
)

PLACES: dict[str, Callable[[], Grid]] = {
    "one cell": lambda: Grid.of_text("..\n.."),
    "corridor": lambda: Grid.of_text("\n".join(["." * 14] * 2)),
    "hall": lambda: Grid.of_text("\n".join(["." * 8] * 10)),
    "obstacles": lambda: random_obstacles(7, 8, 14, Random("conformance")),
    "rooms": lambda: rooms(14, 16, Random("conformance")),
    "warehouse": lambda: warehouse(10, 12),
}

CLOCKS = [{"mode": "lockstep"}, {"mode": "event"}, {"mode": "event", "jitter": "exponential"}]

SMALL = Grid.of_text("..##..\n..##..\n......\n......")


def played(
    grid: Grid, robots: int, algorithm: str, options: dict[str, Any], **fields: Any
) -> tuple[World, list[Event]]:
    tree = {
        "algorithm": algorithm,
        "algorithm_options": options,
        "world": {"map": "none"},
        "team": {"robots": robots},
        "radio": {"reach": "global"},
        "sensing": {"mode": "ahead", "map": algorithm == "mstc"},
        "device": {"capacity_bytes": 0},
        **fields,
    }
    scenario = from_tree(tree, "test")
    starts = Random(f"{robots} {len(grid)}").sample(grid.free_cells(), robots)
    events: list[Event] = []
    places = [grid.place(*start) for start in starts]
    world = World(scenario, terrain_of(grid, scenario), places, observe=events.append)
    end, failures = play(scenario, world, algorithm_of(algorithm, options))
    assert (end.status, failures, world.refusals) == ("over", {}, {})
    return world, events


def assert_covered(grid: Grid, events: list[Event]) -> None:
    assert {event.place for event in events} >= {grid.place(*cell) for cell in grid.free_cells()}


def test_every_algorithm_is_here(algorithm: str, options: dict[str, Any]) -> None:
    assert VARIANTS.keys() == ALIKE
    assert algorithm in ALGORITHMS


@pytest.mark.parametrize("clock", CLOCKS)
@pytest.mark.parametrize("place", PLACES)
def test_covers_and_obeys_the_rules(
    algorithm: str, options: dict[str, Any], place: str, clock: dict[str, Any]
) -> None:
    grid = PLACES[place]()
    for robots in (1, 2, 4):
        _, events = played(grid, robots, algorithm, options, clock=clock)
        assert_covered(grid, events)


@pytest.mark.parametrize("clock", CLOCKS)
def test_the_same_seed_gives_the_same_trace_whatever_ran_between(
    algorithm: str, options: dict[str, Any], clock: dict[str, Any]
) -> None:
    grid = PLACES["obstacles"]()
    first = sha256(played(grid, 4, algorithm, options, clock=clock, seed=5)[1])
    played(PLACES["hall"](), 3, algorithm, options)
    assert sha256(played(grid, 4, algorithm, options, clock=clock, seed=5)[1]) == first


@pytest.mark.parametrize("victim", range(3))
def test_survives_the_loss_of_a_robot_at_any_request(
    algorithm: str, options: dict[str, Any], victim: int
) -> None:
    """Moments of death: each robot, each of its requests."""
    whole, _ = played(SMALL, 3, algorithm, options)
    requests = whole.bodies[victim].requests
    for n in range(1, requests + 1):
        faults = [{"kill": f"robot:{victim}", "at_request": n}]
        world, events = played(SMALL, 3, algorithm, options, faults=faults)
        assert world.bodies[victim].requests == n - 1
        assert_covered(SMALL, events)
