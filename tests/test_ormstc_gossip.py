"""ORMSTC on a radio that loses messages or does not reach everybody: what still holds."""

from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.algorithms.ormstc import Explorer
from agents.algorithms.ormstc_gossip import GossipExplorer
from tests.coverage_runs import (
    Covered,
    Little,
    any_kills,
    coarse_grid,
    covered,
    explorers,
    little,
    littles,
)

CLOCKS = [{"mode": "lockstep"}, {"mode": "event", "jitter": 0.5}]


def run_on(world: Little, rng: Random, radio: dict[str, Any], *, kills: bool = True) -> Covered:
    faults = any_kills(rng, world, instants=True) if kills else []
    fields: dict[str, Any] = {
        "seed": rng.randint(0, 999),
        "clock": rng.choice(CLOCKS),
        "faults": faults,
    }
    return covered(coarse_grid(world.rows), world.starts, radio=radio, **fields)


def lossy(rng: Random) -> dict[str, Any]:
    return {
        "loss": rng.choice([0.1, 0.3, 0.6]),
        "duplicate": rng.choice([0.0, 0.2]),
        "latency": rng.choice([0.0, 0.0, 1.0]),
    }


def short(rng: Random) -> dict[str, Any]:
    sight = rng.random() < 0.5
    return {"reach": "radius", "radius_m": rng.choice([1.5, 4.0, 100.0]), "line_of_sight": sight}


@settings(max_examples=60)
@given(littles(side=5, robots=4), st.randoms(use_true_random=False))
def test_lost_messages_cost_time_only(world: Little, rng: Random) -> None:
    """Theorems 4, 5 and 6 hold: claims are acknowledged by all before a cell is entered."""
    run_on(world, rng, lossy(rng)).keeps_the_theorems()


@settings(max_examples=60)
@given(littles(side=5, robots=4), st.randoms(use_true_random=False))
def test_out_of_reach_all_is_still_covered(world: Little, rng: Random) -> None:
    """Theorems 4 and 6 hold; cells may be covered twice."""
    run_on(world, rng, short(rng)).is_complete()


@settings(max_examples=40)
@given(littles(side=4, robots=3), st.randoms(use_true_random=False))
def test_without_any_radio_each_covers_what_it_can(world: Little, rng: Random) -> None:
    run_on(world, rng, {"reach": "none"}).is_complete()


@pytest.mark.slow
@pytest.mark.parametrize("radio", [lossy, short])
def test_survivors_complete_many_times(radio: Any) -> None:
    for seed in range(200):
        rng = Random(f"gossip {seed}")
        run = run_on(little(rng), rng, radio(rng))
        assert (run.errors, run.status, run.missing) == ([], "over", set()), seed


@pytest.mark.parametrize(
    ("radio", "kind"),
    [
        ({}, Explorer),
        ({"latency": 2.0}, Explorer),
        ({"loss": 0.1}, GossipExplorer),
        ({"reach": "radius", "radius_m": 9.0}, GossipExplorer),
        ({"reach": "none"}, GossipExplorer),
    ],
)
def test_a_reliable_radio_needs_no_gossip(radio: dict[str, Any], kind: type[Explorer]) -> None:
    with explorers() as robots:
        covered(coarse_grid(["..."]), [(0, 0), (1, 5)], radio=radio).is_complete()
    assert {type(robot) for robot in robots.values()} == {kind}


def test_the_same_seed_loses_the_same_messages() -> None:
    grid, starts = coarse_grid(["...", ".#.", "..."]), [(0, 0), (5, 5), (0, 5)]
    runs = [covered(grid, starts, radio={"loss": 0.3}, seed=seed).events for seed in (1, 1, 2)]
    assert runs[0] == runs[1] != runs[2]
