"""What every algorithm of the registry that explores graphs owes: it covers, obeys, repeats itself,
survives. Those that play on grids: test_conformance_grid; on trees that are known: test_connected.
"""

from collections.abc import Callable
from random import Random
from typing import Any

import pytest

from agents.registry import ALGORITHMS, CONNECTED_ALGORITHMS, GRID_ALGORITHMS
from protocol.graph import PortGraph
from tests.play import Played, edges_crossed, graph_of, played, sha256
from world_server.maps.generators import complete, cycle, grid, nary_tree, path, random_graph, star

EXPLORERS = ALGORITHMS.keys() - GRID_ALGORITHMS - CONNECTED_ALGORITHMS

pytestmark = pytest.mark.parametrize("algorithm", sorted(EXPLORERS))

PLACES: dict[str, Callable[[], PortGraph]] = {
    "one vertex": lambda: star(0),
    "path": lambda: path(6),
    "star": lambda: star(7),
    "tree": lambda: nary_tree(3, 3),
    "cycle": lambda: cycle(7),
    "grid": lambda: grid(4, 5),
    "complete": lambda: complete(6),
    "loops and parallels": lambda: graph_of("00 01 01 12 12 22 20 23"),
    "random": lambda: random_graph(25, 40, Random("conformance")),
}

CLOCKS = [{"mode": "lockstep"}, {"mode": "event"}, {"mode": "event", "jitter": "exponential"}]

SMALL = graph_of("01 02 12 13 23 33")


def assert_obeys(run: Played) -> None:
    assert (run.failures, run.world.refusals) == ({}, {})
    assert run.end.status == "over"


@pytest.mark.parametrize("clock", CLOCKS)
@pytest.mark.parametrize("place", PLACES)
def test_covers_and_obeys_the_rules(algorithm: str, place: str, clock: dict[str, Any]) -> None:
    graph = PLACES[place]()
    for robots in (1, 2, 3, 7):
        run = played(graph, robots, algorithm=algorithm, clock=clock)
        assert_obeys(run)
        assert {event.place for event in run.events} == set(range(len(graph.names)))
        assert edges_crossed(graph, run.events) == set(range(len(graph.ends)))
        assert all(stop is not None for stop in run.stops())


@pytest.mark.parametrize("clock", CLOCKS)
def test_the_same_seed_gives_the_same_trace(algorithm: str, clock: dict[str, Any]) -> None:
    graph = PLACES["random"]()
    runs = [played(graph, 4, algorithm=algorithm, clock=clock, seed=5) for _ in range(2)]
    assert sha256(runs[0].events) == sha256(runs[1].events)


def test_another_seed_gives_another_trace_where_chance_plays(algorithm: str) -> None:
    graph = PLACES["random"]()
    hashes = {
        sha256(played(graph, 4, algorithm=algorithm, clock=CLOCKS[2], seed=seed).events)
        for seed in range(5)
    }
    assert len(hashes) == 5


def test_another_algorithm_run_between_changes_nothing(algorithm: str) -> None:
    """No state outlives a run."""
    graph = PLACES["grid"]()
    before = sha256(played(graph, 3, algorithm=algorithm).events)
    played(PLACES["complete"](), 5, algorithm=algorithm)
    assert sha256(played(graph, 3, algorithm=algorithm).events) == before


def test_more_robots_are_not_slower_on_trees(algorithm: str) -> None:
    tree = nary_tree(3, 4)
    times = [
        max(t or 0 for t in played(tree, k, algorithm=algorithm).stops()) for k in (1, 2, 4, 8)
    ]
    assert times == sorted(times, reverse=True)
    assert times[0] / times[1] > 1.9


@pytest.mark.parametrize("heartbeat", ["global", "reach"])
@pytest.mark.parametrize("victim", range(3))
def test_survives_the_loss_of_a_robot_at_any_request(
    algorithm: str, victim: int, heartbeat: str
) -> None:
    """Moments of death: each robot, each of its requests."""
    whole = played(SMALL, 3, algorithm=algorithm, radio={"heartbeat": heartbeat})
    requests = whole.fates()[victim].requests
    assert requests > 10
    for n in range(1, requests + 1):
        run = played(
            SMALL,
            3,
            algorithm=algorithm,
            radio={"heartbeat": heartbeat},
            faults=[{"kill": f"robot:{victim}", "at_request": n}],
        )
        assert_obeys(run)
        assert run.fates()[victim].cause == "killed"
        assert run.fates()[victim].requests == n - 1
        assert edges_crossed(SMALL, run.events) == set(range(len(SMALL.ends))), n
        for robot, fate in enumerate(run.fates()):
            assert robot == victim or (fate.place, fate.stopped_at is None) == (0, False), n


@pytest.mark.slow
@pytest.mark.parametrize("first", range(3))
def test_survives_the_loss_of_two_robots_at_any_requests(algorithm: str, first: int) -> None:
    second = (first + 1) % 3
    counts = [fate.requests for fate in played(SMALL, 3, algorithm=algorithm).fates()]
    for n in range(1, counts[first] + 1):
        for m in range(1, 2 * counts[second] + 1):
            faults = [
                {"kill": f"robot:{first}", "at_request": n},
                {"kill": f"robot:{second}", "at_request": m},
            ]
            run = played(SMALL, 3, algorithm=algorithm, faults=faults)
            assert_obeys(run)
            assert edges_crossed(SMALL, run.events) == set(range(len(SMALL.ends))), (n, m)
