"""ORMSTC with a process for each robot: the trace of the in-process engine, with real kills."""

from pathlib import Path
from random import Random
from typing import Any

import pytest

from deploy.inprocess import play as play_inprocess
from deploy.judged import judge_journal
from deploy.setting import prepare
from deploy.verdict.coverage import coverage_of
from deploy.verdict.grid_ledger import GridLedger
from deploy.verdict.result import ledger_of
from protocol.scenario import from_tree
from tests.conftest import shared
from tests.coverage_runs import any_kills, fine, little, setting_on
from tests.runs import play
from world_server.terrain import terrain_of
from world_server.world import World


def both(folder: Path, lines: list[str], starts: Any, **fields: Any) -> None:
    """Play on both engines; the traces are equal, and all that can be reached is covered."""
    setting = setting_on(folder, lines, starts, **fields)
    runs = [play(setting, folder, engine) for engine in ("inprocess", "processes")]
    assert runs[0].trace_sha256 == runs[1].trace_sha256
    assert (runs[1].status, runs[1].failures) == ("over", {})
    assert judge_journal(runs[1].folder.journal).result.complete


PLACE = fine(["....#.", ".##...", ".....#", "..#..."])
STARTS = [(0, 1), (3, 7), (5, 4), (7, 10)]
KILLS = [
    {"kill": "robot:1", "at": 3.0, "round": 1},
    {"kill": "robot:3", "at": 12.0},
    {"kill": "robot:0", "at_request": 20},
]
EVENT = {"mode": "event", "jitter": "exponential"}


@pytest.mark.parametrize(
    "fields",
    [
        {"faults": KILLS},
        {"clock": EVENT, "faults": [KILLS[2], {"kill": "robot:1", "at": 7.5}]},
        {"radio": {"latency": 1.0}, "faults": KILLS[:2]},
        {"radio": {"loss": 0.2, "duplicate": 0.1}, "faults": KILLS[:1]},
        {"algorithm_options": {"variant": "helping"}, "faults": KILLS},
        {"world": {"bodies": "block"}, "sensing": {"mode": "line-of-sight", "range_m": 4.0}},
        {"sensing": {"position": "odometry", "drift": 0.01}},
    ],
    ids=["losses", "event", "latency", "loss of messages", "helping", "sight", "odometry"],
)
def test_traces_are_equal(fields: dict[str, Any], tmp_path: Path) -> None:
    both(tmp_path, PLACE, STARTS, **fields)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_hundred_little_worlds_have_one_trace(tmp_path: Path) -> None:
    for seed in range(100):
        rng = Random(f"engines {seed}")
        world = little(rng, side=4, robots=3)
        options = {"variant": rng.choice(["corrected", "helping"])}
        fields: dict[str, Any] = {"algorithm_options": options, "faults": any_kills(rng, world)}
        if rng.random() < 0.5:
            fields["clock"] = EVENT
        both(tmp_path / str(seed), fine(world.rows), world.starts, **fields)


# Real maps.

MOVINGAI = (
    "Berlin_1_256",
    "arena",
    "den312d",
    "maze-32-32-2",
    "random-32-32-20",
    "room-32-32-4",
    "warehouse-10-20-10-2-1",
)
ROS = (
    "fetch_3_1_16_keepout/3_1_16_keepout",
    "nav2_depot/depot",
    "turtlebot3_world/map",
    "willow_garage/willow-2010-02-18-0.10",
)


def cover(path: Path, **world: Any) -> None:
    """Cover a map with eight robots, three of which are lost."""
    tree = {
        "algorithm": "ormstc",
        "world": {"map": str(path), **world},
        "team": {"robots": 8},
        "chaos": {"robots": 3},
        "seed": 5,
    }
    setting = prepare(from_tree(tree, "test"))
    ledger = ledger_of(setting.ground, setting.starts, setting.scenario)
    terrain = terrain_of(setting.ground, setting.scenario)
    run = World(setting.scenario, terrain, setting.starts, observe=ledger.observe)
    end, failures = play_inprocess(setting.scenario, run, setting.algorithm)
    assert (end.status, failures, ledger.violations) == ("over", {}, 0)
    assert len(ledger.losses) == 3
    assert isinstance(ledger, GridLedger)
    assert coverage_of(setting.scenario, ledger).missing == []


def test_all_real_maps_are_listed() -> None:
    files = {file.stem for file in shared("maps", "movingai").iterdir() if file.suffix == ".map"}
    assert files == set(MOVINGAI)
    files = {file.stem for file in shared("maps", "ros").glob("*/*.yaml")}
    assert files == {name.rpartition("/")[2] for name in ROS}


@pytest.mark.slow
@pytest.mark.parametrize("name", MOVINGAI)
def test_game_maps_are_covered_with_three_losses(name: str) -> None:
    cover(shared("maps", "movingai", f"{name}.map"))


@pytest.mark.slow
@pytest.mark.parametrize("name", ROS)
def test_robot_maps_are_covered_with_three_losses(name: str) -> None:
    cover(shared("maps", "ros", f"{name}.yaml"))
