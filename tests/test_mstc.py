"""MSTC executed: what was planned happens, and the living take over from the dead."""

from pathlib import Path
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.algorithms.mstc import Options, Parts, note, read, shortest_way
from agents.planning.team import team_plan
from deploy.inprocess import play as play_inprocess
from deploy.judged import judge_journal
from deploy.setting import Setting
from deploy.verdict.result import Result, judge, ledger_of, monitors_of, observers
from protocol.errors import ScenarioError
from protocol.grid import Cell
from protocol.trace import Event
from tests.coverage_runs import Little, any_kills, coarse_grid, fine, little, littles, setting_on
from tests.runs import play
from world_server.terrain import terrain_of
from world_server.world import World

TREES = ("create-tree", "random", "depth-first", "breadth-first", "minimum")
SPLITS = ("nb", "b", "opt")


def setting_of(folder: Path, world: Little, **fields: Any) -> Setting:
    return setting_on(folder, fine(world.rows), world.starts, algorithm="mstc", **fields)


def judged(setting: Setting) -> Result:
    """Play in one thread and judge."""
    ledger = ledger_of(setting.ground, setting.starts, setting.scenario)
    monitors = monitors_of(setting.scenario, ledger)
    watchers = observers(ledger, monitors)

    def observe(event: Event) -> None:
        for watcher in watchers:
            watcher(event)

    terrain = terrain_of(setting.ground, setting.scenario)
    world = World(setting.scenario, terrain, setting.starts, observe=observe)
    end, failures = play_inprocess(setting.scenario, world, setting.algorithm)
    assert (failures, world.refusals) == ({}, {})
    return judge(
        setting.scenario,
        ledger,
        monitors,
        status=end.status,
        engine="inprocess",
        trace_sha256="",
        due=dict(zip(world.struck, world.struck_at, strict=True)),
    )


def broken(result: Result) -> list[str]:
    return [f"{one.name}: {one.detail}" for one in result.guarantees if one.holds is False]


def holds(result: Result, name: str) -> bool | None:
    (found,) = (one.holds for one in result.guarantees if one.name == name)
    return found


def options_from(rng: Random) -> dict[str, Any]:
    return {
        "tree": rng.choice(TREES),
        "split": rng.choice(SPLITS),
        "distance": rng.choice(("manhattan", "euclid", "shortest-path")),
        "home": rng.random() < 0.3,
    }


# Without losses.


@given(littles(side=5, robots=5), st.sampled_from(TREES), st.sampled_from(SPLITS))
def test_what_is_planned_happens(
    tmp_path_factory: pytest.TempPathFactory, world: Little, tree: str, split: str
) -> None:
    """Reference: Sec. 3.1, complete and, with NB, not redundant."""
    folder = tmp_path_factory.mktemp("plan")
    result = judged(setting_of(folder, world, algorithm_options={"tree": tree, "split": split}))
    assert result.complete
    assert broken(result) == []
    assert holds(result, "covered in the planned time") is True
    if split == "nb":
        assert holds(result, "no sub-cell visited twice") is True
        assert result.visits_extra == 0


@given(littles(side=5, robots=4))
def test_robots_go_home_if_asked_to(
    tmp_path_factory: pytest.TempPathFactory, world: Little
) -> None:
    setting = setting_of(tmp_path_factory.mktemp("home"), world, algorithm_options={"home": True})
    result = judged(setting)
    assert result.complete
    assert [robot.place for robot in result.per_robot] == list(world.starts)


def test_each_robot_makes_the_same_plan() -> None:
    grid = coarse_grid(["....#.", ".##...", ".....#"])
    starts: tuple[Cell, ...] = ((0, 1), (3, 7), (5, 4))
    plans = [
        team_plan(grid.rows, grid.cols, grid.cells(), starts, Options().kind, 7, robot)
        for robot in range(3)
    ]
    assert plans[0][1:] == plans[1][1:] == plans[2][1:]
    assert plans[0].tree.edges == plans[1].tree.edges == plans[2].tree.edges
    tour = [cell for robot in plans[0].order for cell in plans[0].parts[robot]]
    assert len(set(tour)) == 4 * len(grid.complete_cells())


# Losses.


@settings(max_examples=60)
@given(st.integers(0, 1 << 32))
def test_the_living_take_over(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    """Reference: Sec. 3.1, robust; the same of B and Opt."""
    check_takeover(seed, tmp_path_factory.mktemp("loss"))


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("part", range(4))
def test_the_living_take_over_in_many_worlds(part: int, tmp_path: Path) -> None:
    for seed in range(500 * part, 500 * (part + 1)):
        check_takeover(seed, tmp_path)


def check_takeover(seed: int, folder: Path) -> None:
    rng = Random(f"mstc {seed}")
    world = little(rng, side=5, robots=5)
    fields: dict[str, Any] = {"seed": seed, "algorithm_options": options_from(rng)}
    if rng.random() < 0.5:
        fields["clock"] = {"mode": "event", "jitter": rng.choice((0.0, 0.5, "exponential"))}
        fields["team"] = {"speed": [rng.choice((0.5, 1.0, 2.0)) for _ in world.starts]}
    if rng.random() < 0.3:
        fields["radio"] = {"latency": rng.choice((0.5, 1.0, 3.5))}
    result = judged(setting_of(folder, world, faults=any_kills(rng, world), **fields))
    assert result.status == "over"
    assert result.complete
    assert broken(result) == []


def test_a_part_belongs_to_the_nearest_behind() -> None:
    parts = Parts([0, 3, 1, 2])
    assert [parts.heir(robot) for robot in range(4)] == [0, 1, 2, 3]
    parts.lost.update({1, 3})
    assert [parts.heir(robot) for robot in range(4)] == [0, 0, 2, 0]
    assert parts.left_to(0) == [0, 3, 1]
    parts.done.add(3)
    assert parts.left_to(0) == [0, 1]
    parts.lost.add(0)
    assert (parts.heir(0), parts.left_to(2)) == (2, [2, 0, 1])
    assert not parts.complete()
    parts.done.update({0, 1, 2})
    assert parts.complete()
    parts.lost.add(2)
    assert parts.heir(2) is None


@given(st.integers(0, 1 << 31))
def test_a_note_comes_back(part: int) -> None:
    assert read(note(part)) == part


def test_a_shortest_way_keeps_to_the_cells() -> None:
    cells = {(0, 0), (0, 1), (0, 2), (1, 2), (2, 2), (2, 1), (2, 0)}
    assert shortest_way(cells, (0, 0), {(2, 0), (2, 2)}) == [(0, 1), (0, 2), (1, 2), (2, 2)]
    assert shortest_way(cells, (0, 0), {(0, 0)}) == []


# Refusals.


@pytest.mark.parametrize(
    ("fields", "field"),
    [
        ({"sensing": {"map": False}}, "sensing.map"),
        ({"sensing": {"position": "odometry"}}, "sensing.position"),
        ({"radio": {"reach": "none"}}, "radio.reach"),
        ({"radio": {"loss": 0.1}}, "radio.loss"),
        ({"world": {"bodies": "block"}}, "world.bodies"),
        ({"algorithm_options": {"split": "thirds"}}, "algorithm_options.split"),
    ],
)
def test_what_it_cannot_do_without_is_asked_for(
    fields: dict[str, Any], field: str, tmp_path: Path
) -> None:
    with pytest.raises(ScenarioError, match=f"field `{field}`"):
        setting_on(tmp_path, fine(["..", ".."]), [(0, 0)], algorithm="mstc", **fields)


# Processes.

PLACE = fine(["....#.", ".##...", ".....#", "..#..."])
STARTS = [(0, 1), (3, 7), (5, 4), (7, 10)]
EVENT = {"mode": "event", "jitter": "exponential"}


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"faults": [{"kill": "robot:1", "at": 3.0, "round": 1}, {"kill": "robot:3", "at": 9.0}]},
        {"clock": EVENT, "faults": [{"kill": "robot:0", "at_request": 12}]},
        {"faults": [{"kill": "world", "at": 5.0}, {"kill": "robot:2", "at": 5.0}]},
    ],
    ids=["whole", "losses", "event", "world"],
)
def test_traces_are_equal(fields: dict[str, Any], tmp_path: Path) -> None:
    setting = setting_on(tmp_path, PLACE, STARTS, algorithm="mstc", **fields)
    runs = [play(setting, tmp_path, engine) for engine in ("inprocess", "processes")]
    assert runs[0].trace_sha256 == runs[1].trace_sha256
    result = judge_journal(runs[1].folder.journal).result
    assert result.complete
    assert broken(result) == []
