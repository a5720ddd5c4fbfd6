"""ORMSTC with helping: complete whoever dies, no cell with two owners, and faster than the peer."""

import json
from pathlib import Path
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.algorithms.ormstc_helping import Helper
from protocol.grid import Grid
from tests.coverage_runs import (
    Covered,
    Little,
    any_kills,
    circumstances,
    coarse_grid,
    covered,
    explorers,
    little,
    littles,
)

HELPING = {"variant": "helping"}


def helped(world: Little, rng: Random, *, kills: bool) -> Covered:
    fields = circumstances(rng, len(world.starts), latency=False)
    fields["algorithm_options"] |= HELPING
    faults = any_kills(rng, world) if kills else []
    return covered(coarse_grid(world.rows), world.starts, faults=faults, **fields)


@settings(max_examples=80)
@given(littles(), st.randoms(use_true_random=False))
def test_all_is_covered_without_losses(world: Little, rng: Random) -> None:
    helped(world, rng, kills=False).is_complete()


@settings(max_examples=120)
@given(littles(), st.randoms(use_true_random=False))
def test_survivors_complete(world: Little, rng: Random) -> None:
    helped(world, rng, kills=True).is_complete()


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_survivors_complete_three_thousand_times() -> None:
    for seed in range(3000):
        rng = Random(f"helping {seed}")
        run = helped(little(rng), rng, kills=True)
        assert (run.errors, run.status, run.missing) == ([], "over", set()), seed


@settings(max_examples=60)
@given(littles(), st.randoms(use_true_random=False))
def test_no_two_live_robots_own_one_cell(world: Little, rng: Random) -> None:
    """All copies of who owns what agree where the owner is alive, once the team stands still."""
    with explorers() as robots:
        run = helped(world, rng, kills=True)
        live = [robot for who, robot in robots.items() if who not in run.lost]
        owned = [
            {
                cell: stake[2]
                for cell, stake in robot.claims.owner.items()
                if stake[2] not in run.lost
            }
            for robot in live
        ]
    assert all(isinstance(robot, Helper) for robot in live)
    for cells in owned[1:]:
        both = cells.keys() & owned[0].keys()
        assert {cell: cells[cell] for cell in both} == {cell: owned[0][cell] for cell in both}


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
