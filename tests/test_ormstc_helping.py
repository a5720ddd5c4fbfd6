"""ORMSTC with helping: complete whoever dies, no cell with two owners, and faster than the peer."""

import json
from pathlib import Path
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.algorithms.ormstc import Explorer
from agents.algorithms.ormstc_helping import Helper
from protocol.grid import Grid
from tests.coverage_runs import (
    Covered,
    Little,
    WatchedWorld,
    any_kills,
    circumstances,
    coarse_grid,
    covered,
    explorers,
    little,
    littles,
)

HELPING = {"variant": "helping"}

randoms = st.randoms(use_true_random=False)


def helped(world: Little, rng: Random, *, kills: bool, **more: Any) -> Covered:
    fields = circumstances(rng, len(world.starts), latency=False)
    fields["algorithm_options"] |= HELPING
    faults = any_kills(rng, world) if kills else []
    return covered(coarse_grid(world.rows), world.starts, faults=faults, **fields, **more)


@settings(max_examples=80)
@given(littles(), randoms)
def test_all_is_covered_without_losses(world: Little, rng: Random) -> None:
    helped(world, rng, kills=False).is_complete()


@settings(max_examples=120)
@given(littles(), randoms)
def test_survivors_complete(world: Little, rng: Random) -> None:
    helped(world, rng, kills=True).is_complete()


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_survivors_complete_three_thousand_times() -> None:
    for seed in range(3000):
        rng = Random(f"helping {seed}")
        run = helped(little(rng), rng, kills=True)
        assert (run.errors, run.status, run.missing) == ([], "over", set()), seed


def owned(robot: Explorer, alive: set[int]) -> dict[int, int]:
    """Return whose cells are, as far as a robot knows, if their owners are alive."""
    owners = robot.claims.owner.items()
    return {cell: owner for cell, (_, _, owner) in owners if owner in alive}


@settings(max_examples=80)
@given(littles(), randoms)
def test_who_stays_to_the_end_agrees_on_every_owner(world: Little, rng: Random) -> None:
    """Who cannot reach what is left stops earlier, and hears no more."""
    last: list[int] = []
    alive: set[int] = set()

    def look(present: WatchedWorld) -> None:
        stops = {body.robot: body.stopped_at for body in present.bodies}
        last[:] = [robot for robot, time in stops.items() if time == present.time]
        alive.clear()
        alive.update(present.alive_robots())

    with explorers() as robots:
        helped(world, rng, kills=True, after_instant=look).is_complete()
    assert all(isinstance(robot, Helper) for robot in robots.values())
    assert last
    for robot in last:
        assert owned(robots[robot], alive) == owned(robots[last[0]], alive)


@settings(max_examples=60)
@given(littles(side=8, robots=8), randoms)
def test_no_two_robots_own_one_cell_at_any_instant(world: Little, rng: Random) -> None:
    """Each by what it knows itself; shares change hands. Where somebody dies, his share is open."""
    with explorers() as robots:

        def check(_: WatchedWorld) -> None:
            held = [
                cell
                for me, robot in robots.items()
                for cell, (_, _, owner) in robot.claims.owner.items()
                if owner == me
            ]
            assert len(held) == len(set(held))

        helped(world, rng, kills=False, after_instant=check).is_complete()


def test_who_stops_early_is_not_waited_for() -> None:
    """Robot 0 cannot reach what robot 3 left, and stops; then another dies, and all agree anew."""
    run = covered(
        coarse_grid([".#.."]),
        [(1, 1), (1, 5), (0, 4), (1, 7)],
        algorithm_options=HELPING,
        clock={"mode": "event"},
        team={"speed": [1.0, 1.0, 1.0, 0.25]},
        faults=[{"kill": "robot:3", "at": 6.0}, {"kill": "robot:1", "at": 16.0}],
    )
    run.is_complete()
    assert run.lost == {1, 3}
    assert run.coverage_time > 16


def test_who_has_lost_a_claim_waits_before_it_claims_anew() -> None:
    """Else, if the winner dies meanwhile, a robot on its way cannot tell which claim stands."""
    starts = [(1, 1), (0, 1), (3, 3), (2, 2), (3, 2), (2, 3), (1, 0), (0, 0)]
    faults = [
        {"kill": "robot:1", "at_request": 9},
        {"kill": "robot:6", "at": 2, "round": 2},
        {"kill": "robot:3", "at_request": 5},
        {"kill": "robot:7", "at": 2, "round": 4},
    ]
    with explorers() as robots:
        run = covered(coarse_grid([".#", "#."]), starts, algorithm_options=HELPING, faults=faults)
    run.is_complete()
    alive = {0, 2, 4, 5}
    assert run.lost == {1, 3, 6, 7}
    assert all(owned(robots[robot], alive) == owned(robots[0], alive) for robot in alive)


@pytest.mark.parametrize("radio", [{"latency": 1.0}, {"loss": 0.1}, {"reach": "none"}])
def test_a_radio_that_it_cannot_work_with_is_refused(radio: dict[str, Any]) -> None:
    run = covered(coarse_grid([".."]), [(0, 0), (1, 3)], algorithm_options=HELPING, radio=radio)
    assert all("needs radio.reach" in error for error in run.errors)
    assert len(run.errors) == 2


# Against the online planner of others, on its instances.

PEER = {
    "ls_floor_small_k4": 52,
    "mstc_grid5x10_k4": 53,
    "mip_maze_small_10x10_k6": 63,
    "ls_terrain_small_k8": 69,
    "mip_maze_medium_20x20_k6": 286,
    "ls_floor_medium_k8": 198,
    "ls_floor_large_k12": 339,
}
"""Coverage times of OnDemCPP."""

OURS = {
    "ls_floor_small_k4": (66, 36),
    "mstc_grid5x10_k4": (63, 30),
    "mip_maze_small_10x10_k6": (55, 6),
    "ls_terrain_small_k8": (62, 118),
    "mip_maze_medium_20x20_k6": (213, 116),
    "ls_floor_medium_k8": (197, 198),
    "ls_floor_large_k12": (307, 473),
}
"""Coverage times, and visits in vain."""


def on_peer(folder: Path, name: str, **fields: Any) -> Covered:
    instance = json.loads((folder / f"{name}.json").read_text())
    grid = Grid.of_text("\n".join(row.replace("@", "#") for row in instance["grid"]))
    starts = [(row, col) for row, col in instance["robots"]]
    return covered(grid, starts, algorithm_options=HELPING, **fields)


@pytest.mark.parametrize("name", PEER)
def test_coverage_times_on_the_grids_of_the_peer(name: str, shared: Any) -> None:
    run = on_peer(shared("peers/grids"), name)
    run.is_complete()
    assert (run.coverage_time, run.extra) == OURS[name]


def test_five_of_seven_are_no_worse_than_the_peer() -> None:
    assert sum(OURS[name][0] <= time for name, time in PEER.items()) >= 5


@pytest.mark.parametrize("victim", range(4))
def test_where_the_peer_stalls_after_a_kill_this_finishes(victim: int, shared: Any) -> None:
    faults = [{"kill": f"robot:{victim}", "at": 20.0}]
    run = on_peer(shared("peers/grids"), "ls_floor_small_k4", faults=faults)
    run.is_complete()
    assert run.lost == {victim}
