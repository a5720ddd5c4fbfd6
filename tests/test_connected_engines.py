"""Connected coverage with a process for each robot: the in-process trace, with real kills."""

import signal
from collections.abc import Iterator
from pathlib import Path
from random import Random
from typing import Any

import pytest

from agents.algorithms import connected
from agents.planning.rooted_tree import RootedTree, perfect_tree
from deploy.judged import judge_journal
from deploy.setting import prepare
from protocol.graph import PortGraph
from protocol.scenario import from_tree
from tests.play import tree_of
from tests.runs import Started, play, requests_of, run_cli, send, setting_of, started_cli, until
from tests.test_connected import HOLES, TABLE, fields_of, graph_from, with_losses

SMALL = tree_of([(child - 1) // 3 for child in range(1, 14)])
TRAIL = tree_of([*range(5), 0, 0])
MOST_QUICK, MOST_SLOW = 200, 36_000
"""Requests of all robots up to which a row of the table is quick, and slow; others are long."""


def both(folder: Path, graph: PortGraph, robots: int, algorithm: str, **more: Any) -> list[int]:
    """Play on both engines: one trace, all covered, nobody fails; return who was lost."""
    setting = setting_of(graph, robots, **fields_of(algorithm, **more))
    runs = [play(setting, folder, engine) for engine in ("inprocess", "processes")]
    assert runs[0].trace_sha256 == runs[1].trace_sha256
    assert [run.status for run in runs] == ["over", "over"]
    result = judge_journal(runs[1].folder.journal).result
    assert result.complete
    assert [run.failures for run in runs] == [{}, {}]
    left = [each for each in result.per_robot if each.lost_by is None]
    assert {each.place for each in left} <= {"0"}
    return result.robots_lost


def test_one_trace_without_losses(tmp_path: Path) -> None:
    assert both(tmp_path, SMALL, 4, "cocta", options={"splits": [2]}) == []


@pytest.mark.parametrize(
    ("clock", "kills"),
    [
        (None, [{"at": 6.0}, {"at": 6.0}, {"at_request": 9}]),
        ({"mode": "event", "jitter": 0.5}, [{"at": 2.5}, {"at_request": 7}, {"at": 9.0}]),
    ],
    ids=["lockstep", "event"],
)
def test_one_trace_with_kills(
    clock: dict[str, Any] | None, kills: list[dict[str, Any]], tmp_path: Path
) -> None:
    faults = [
        {"kill": f"robot:{robot}", **kill} for robot, kill in zip((1, 2, 4), kills, strict=True)
    ]
    options = {"splits": [5]}
    lost = both(tmp_path, TRAIL, 6, "ncocta", options=options, clock=clock, faults=faults)
    assert lost == [1, 2, 4]


@pytest.mark.parametrize("algorithm", ["cocta", "cocta-best"])
def test_a_plan_is_made_once_for_all(
    algorithm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    generate = {"kind": "cave", "vertices": 30}
    tree = {"algorithm": algorithm, "world": {"generate": generate}, "team": {"robots": 4}}
    options = {"splits": "best"}
    setting = prepare(from_tree({**tree, "algorithm_options": options}, "test"))
    monkeypatch.setattr(connected, "planned", None)
    assert play(setting, tmp_path, "inprocess").failures == {}


def rows() -> Iterator[Any]:
    """Yield the rows of the table, for both algorithms; marked by how many requests the robots make."""
    table: list[tuple[Any, ...]] = [(perfect_tree(*row[:2]), *row[2:]) for row in TABLE]
    table += [(tree, robots, "paper", *ticks) for tree, _, robots, *ticks in HOLES]
    for tree, robots, splits, *both_ticks in table:
        for algorithm, ticks in zip(("ncocta", "cocta"), both_ticks, strict=True):
            marks = []
            if robots * ticks > MOST_SLOW:
                marks = [pytest.mark.long, pytest.mark.timeout(7200)]
            elif robots * ticks > MOST_QUICK:
                marks = [pytest.mark.slow, pytest.mark.timeout(600)]
            name = f"{algorithm}, {len(tree)} vertices, k = {robots}"
            yield pytest.param(tree, robots, algorithm, splits, ticks, id=name, marks=marks)


@pytest.mark.parametrize(("tree", "robots", "algorithm", "splits", "ticks"), list(rows()))
def test_robots_take_the_ticks_of_the_table(
    tree: RootedTree, robots: int, algorithm: str, splits: Any, ticks: int, tmp_path: Path
) -> None:
    fields = fields_of(algorithm, options={"splits": splits})
    setting = setting_of(graph_from(tree), robots, **fields)
    run = play(setting, tmp_path, "processes", limit_s=7200)
    result = judge_journal(run.folder.journal).result
    assert result.complete
    assert result.makespan == ticks
    assert [each.name for each in result.guarantees if each.holds is False] == []


def check_many(seed: int, folder: Path) -> None:
    """Kill robots at random instants and requests, in some runs the world too."""
    rng = Random(f"connected engines {seed}")
    lost = with_losses(40_000 + seed, most=16, robots_most=7)
    more = dict(lost.more)
    if seed % 4 == 0:
        at: Any = rng.choice([{"at": float(rng.randrange(1, 9))}, {"at": rng.random() * 9}])
        more["faults"] = [*more["faults"], {"kill": "world", **at}]
    both(folder, lost.graph, lost.robots, lost.algorithm, **more)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("block", range(0, 100, 20))
def test_a_hundred_runs_with_kills_have_one_trace(block: int, tmp_path: Path) -> None:
    for seed in range(block, block + 20):
        check_many(seed, tmp_path / str(seed))


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_each_robot_killed_at_each_of_its_first_requests(tmp_path: Path) -> None:
    fields = fields_of("cocta", options={"splits": [2]})
    made = requests_of(play(setting_of(SMALL, 4, **fields), tmp_path, "inprocess"))
    for robot in range(4):
        for number in range(1, made[robot] + 1, 3):
            faults = [{"kill": f"robot:{robot}", "at_request": number}]
            lost = both(tmp_path, SMALL, 4, "cocta", options={"splits": [2]}, faults=faults)
            assert lost == [robot]


# Kills by hand, from outside.


def all_there(run: Started, robots: int) -> dict[str, int]:
    """Wait until every robot's process is there, without devices to keep; return the pid of each."""
    pids: dict[str, int] = {}

    def there() -> bool:
        pids.update(run.living())
        return pids.keys() >= {f"robot:{robot}" for robot in range(robots)}

    until(there, "all robots", run.process)
    return pids


@pytest.mark.slow
@pytest.mark.parametrize("clock", ["lockstep", "event"])
def test_robots_killed_by_hand_at_any_moment(clock: str, tmp_path: Path) -> None:
    path = tmp_path / "by-hand.toml"
    path.write_text(
        'algorithm = "cocta"\nteam = {robots = 5}\n'
        f'clock = {{mode = "{clock}"}}\n'
        'world = {generate = {kind = "nary-tree", branching = 3, radius = 5}}\n'
    )
    for seed in range(5):
        rng = Random(f"by hand {clock} {seed}")
        victims = rng.sample(range(5), 3)
        with started_cli(
            path, "--json", "--no-picture", cwd=tmp_path, folder=tmp_path / str(seed)
        ) as run:
            pids = all_there(run, 5)
            run.plays(rng.randrange(2_000))
            for victim in victims:
                send(pids[f"robot:{victim}"], signal.SIGKILL)
            said = run.finish()
        assert said.code == 0, said
        assert (said.result["complete"], said.result["robots_lost"]) == (True, sorted(victims))
        replayed = run_cli("replay", run.folder, "--json", cwd=tmp_path)
        assert replayed.result["trace_sha256"] == said.result["trace_sha256"]
