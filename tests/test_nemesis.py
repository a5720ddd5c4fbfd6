"""Runs by processes under faults: they give the trace of one thread, and leave nothing behind."""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path
from random import Random
from typing import Any

import pytest

from agents.node import NOT_JOINED
from deploy.judged import judge_journal
from deploy.setting import Setting, prepare
from deploy.verdict.result import Result
from protocol.errors import RunError
from protocol.scenario import from_tree
from protocol.zenoh_link import PASSWORD, free_port
from tests.play import graph_of
from tests.runs import (
    Run,
    Said,
    Started,
    Watch,
    free,
    lives,
    play,
    processes_that_mention,
    requests_of,
    run_cli,
    send,
    setting_of,
    started_cli,
    until,
)
from world_server.journal import Closing, Incarnation, Joined, scan
from world_server.replay import read_opening

SMALL = graph_of("01 12 23 34 40 13")
PATH = graph_of("01 12 23")
LONG = graph_of(" ".join(f"{v}-{v + 1}" for v in range(30)))
SEPARATE = {"router": "separate"}
RESTART = {"on_crash": "restart"}

SLOWLY = {"delay": "robot:0", "at": 0, "delay_s": 0.01, "for_s": 60.0}
"""Robot 0 takes 20 ms a request: enough of the run is left for what strikes later in real time."""


def check(setting: Setting, folder: Path) -> tuple[Result, Run]:
    """Play on both engines; whatever the faults, they must not be told apart."""
    alone = play(setting, folder, "inprocess")
    expected = judge_journal(alone.folder.journal).result
    run = play(setting, folder, "processes")
    result = result_of(run)
    assert run.trace_sha256 == alone.trace_sha256
    assert run.status == alone.status
    assert result.robots_lost == expected.robots_lost
    assert result.complete == expected.complete
    assert [claim for claim in result.guarantees if claim.holds is False] == []
    check_left(run)
    return result, run


def result_of(run: Run) -> Result:
    assert run.played is not None
    return judge_journal(run.folder.journal, **run.played.told(0.0)).result


def check_left(run: Run) -> None:
    """Check that of a run by processes nothing is left but what its folder is to keep."""
    name = run.folder.path.name
    until(lambda: not processes_that_mention(name), f"end of the processes of {name}")
    left = {path.name for path in run.folder.path.iterdir()}
    assert not left & {"processes.json", "processes.json.new", "users"}, left


def check_struck(result: Result, robots_lost: bool = False) -> None:
    """Check that the result tells of each fault when it struck, and how long the run stood."""
    assert result.faults_not_struck == []
    for fault in result.faults:
        assert fault.due is not None, fault
        assert fault.struck_s is not None, fault
        assert fault.struck_s > 0, fault
        if not robots_lost:
            assert fault.went_on_s is not None, fault
            assert 0 <= fault.went_on_s < 30, fault


# Each word, in a run.

WORDS: dict[str, tuple[list[dict[str, Any]], dict[str, Any]]] = {
    "kill world": ([{"kill": "world", "at": 2}], {}),
    "kill bookkeeping": ([{"kill": "bookkeeping", "at": 2}], {}),
    "kill world with a router": ([{"kill": "world", "at": 2}], {"network": SEPARATE}),
    "kill router": ([{"kill": "router", "at": 2}], {"network": SEPARATE}),
    "kill robot that comes back": ([{"kill": "robot:1", "at": 2}], {"team": RESTART}),
    "kill robot that is lost": ([{"kill": "robot:1", "at": 2}], {}),
    "pause world": ([{"pause": "world", "at": 2, "for_s": 0.3}], {}),
    "pause bookkeeping": ([{"pause": "bookkeeping", "at": 2, "for_s": 0.3}], {}),
    "pause router": ([{"pause": "router", "at": 2, "for_s": 0.3}], {"network": SEPARATE}),
    "pause robot": ([{"pause": "robot:1", "at": 2, "for_s": 0.3}], {}),
    "partition robot": ([{"partition": "robot:1", "at": 2, "for_s": 0.3}], {}),
    "partition halves": ([{"partition": "halves", "at": 2, "for_s": 0.3}], {}),
    "partition bookkeeping and a robot": (
        [{"partition": ["bookkeeping", "robot:1"], "at": 2, "for_s": 0.3}],
        {},
    ),
    "partition world": ([{"partition": "world", "at": 2, "for_s": 0.3}], {"network": SEPARATE}),
    "delay robot": (
        [{"delay": "robot:1", "at": 2, "delay_s": 0.03, "jitter_s": 0.03, "for_s": 0.3}],
        {},
    ),
    "delay bookkeeping": ([{"delay": "bookkeeping", "at": 2, "for_s": 0.3}], {}),
    "delay world": ([{"delay": "world", "at": 2, "for_s": 0.3}], {"network": SEPARATE}),
    "skew world": ([{"skew": "world", "at": 2}], {}),
    "skew bookkeeping back": ([{"skew": "bookkeeping", "at": 2, "by_s": -1e6}], {}),
    "skew router": ([{"skew": "router", "at": 2}], {"network": SEPARATE}),
    "skew robot back": ([{"skew": "robot:1", "at": 2, "by_s": -1e6}], {}),
    "tear journal": ([{"tear": "journal", "at": 2}], {}),
    "kill world at a request": ([{"kill": "world", "at_request": 6, "of": "robot:1"}], {}),
    "kill bookkeeping after a request": (
        [{"kill": "bookkeeping", "at_request": 6, "of": "robot:1", "after_s": 0.05}],
        {},
    ),
    "kill world at its opening": ([{"kill": "world", "at_request": 1, "of": "robot:1"}], {}),
    "kill robot at its opening": ([{"kill": "robot:1", "at_request": 1}], {"team": RESTART}),
    "kill world later": ([{"kill": "world", "at": 2, "after_s": 0.1}], {}),
    "kill robot later": ([{"kill": "robot:1", "at": 2, "after_s": 0.1}], {"team": RESTART}),
    "pause robot later": ([{"pause": "robot:2", "at": 2, "after_s": 0.1, "for_s": 0.3}], {}),
    "tear journal later": ([{"tear": "journal", "at": 2, "after_s": 0.1}], {}),
    "kill all there is at once": (
        [{"kill": name, "at": 2} for name in ("router", "bookkeeping", "world")],
        {"network": SEPARATE},
    ),
    "kill the world as it comes back": (
        [{"kill": "world", "at": 2, "after_s": after_s} for after_s in (0.0, 0.1, 0.2, 0.4)],
        {},
    ),
    "kill a robot that is lost while the world is down": (
        [{"kill": "world", "at": 2}, {"kill": "robot:1", "at": 2}],
        {},
    ),
}

QUICK = (
    "kill router",
    "kill robot that comes back",
    "pause world",
    "partition halves",
    "skew world",
    "tear journal",
    "kill world at a request",
)


@pytest.mark.parametrize(
    "name",
    [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in WORDS],
)
def test_a_fault_leaves_the_trace_as_it_is(name: str, tmp_path: Path) -> None:
    faults, fields = WORDS[name]
    setting = setting_of(SMALL, 3, faults=[SLOWLY, *faults], **fields)
    result, run = check(setting, tmp_path)
    plain = play(setting_of(SMALL, 3, **fields), tmp_path, "inprocess")
    lost = [fault for fault in faults if fault.get("kill") == "robot:1"] if not fields else []
    assert (run.trace_sha256 == plain.trace_sha256) == (not lost)
    check_struck(result)
    # Who was killed came back, and nobody else; of two kills at once the second may find it dead.
    deaths = Counter(
        fault.get("kill", "world") for fault in faults if {"kill", "tear"} & fault.keys()
    )
    if lost:
        del deaths["robot:1"]
    came_back = {name: count for name, count in run.restarts.items() if count}
    assert came_back.keys() == deaths.keys()
    assert all(count <= deaths[name] for name, count in came_back.items())


def test_several_faults_in_one_run(tmp_path: Path) -> None:
    faults = [
        SLOWLY,
        {"kill": "bookkeeping", "at": 1},
        {"pause": "robot:2", "at": 2, "for_s": 0.2},
        {"kill": "world", "at": 3, "round": 1},
        {"partition": "halves", "at": 4, "after_s": 0.02, "for_s": 0.2},
        {"kill": "robot:1", "at": 4},
    ]
    result, run = check(setting_of(SMALL, 3, faults=faults), tmp_path)
    check_struck(result)
    assert result.robots_lost == [1]
    assert run.restarts == {"world": 1, "bookkeeping": 1}


def test_a_cut_is_over_though_a_delay_goes_on(tmp_path: Path) -> None:
    faults = [
        {"delay": "robot:0", "at": 0, "delay_s": 0.01, "for_s": 60.0},
        {"partition": "robot:0", "at": 2, "for_s": 0.2},
    ]
    result, _ = check(setting_of(SMALL, 3, faults=faults, network={"patience_s": 1.0}), tmp_path)
    assert result.robots_lost == []


def test_the_result_tells_of_a_fault_that_came_too_late(tmp_path: Path) -> None:
    faults = [{"kill": "world", "at": 1, "after_s": 600.0}, {"kill": "world", "at": 9999}]
    result, run = check(setting_of(SMALL, 3, faults=faults), tmp_path)
    assert run.restarts == {"world": 0, "bookkeeping": 0}
    assert result.faults_not_struck == [
        "kill world at t=1, 600 s later",
        "kill world at t=9999",
    ]
    assert [(fault.due, fault.struck_s) for fault in result.faults] == [(1.0, None), (None, None)]


# Damage.


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_a_damaged_journal_ends_the_run_and_is_named(seed: int, tmp_path: Path) -> None:
    faults = [SLOWLY, {"flip": "journal", "at": 4}]
    setting = setting_of(SMALL, 3, faults=faults, seed=seed)
    with pytest.raises(RunError, match=r"world cannot run: .*/journal: offset \d+: damaged"):
        play(setting, tmp_path, "processes")
    (folder,) = tmp_path.iterdir()
    until(lambda: not processes_that_mention(folder.name), "end of the processes")
    assert not (folder / "processes.json").exists()
    assert not (folder / "users").exists()


@pytest.mark.slow
def test_runs_that_end_with_an_error_leave_no_descriptors(tmp_path: Path) -> None:
    found = []
    for seed in range(3):
        setting = setting_of(SMALL, 3, faults=[SLOWLY, {"flip": "journal", "at": 4}], seed=seed)
        with pytest.raises(RunError):
            play(setting, tmp_path, "processes")
        found.append(descriptors())
    assert found[2] <= found[1] <= found[0]


def test_a_damaged_journal_is_told_in_one_line(tmp_path: Path) -> None:
    scenario = tmp_path / "small.toml"
    (tmp_path / "small.edges").write_text("0 1\n1 2\n2 3\n3 4\n4 0\n1 3\n")
    scenario.write_text(
        'algorithm = "mr-dfs"\nteam = {robots = 2}\nworld = {map = "small.edges"}\n'
        'faults = [{delay = "robot:0", at = 0, for_s = 60}, {flip = "journal", at = 3}]\n'
    )
    watch = Watch(tmp_path)
    said = run_cli(
        *("run", scenario, "--json", "--no-picture", "--out", tmp_path / "run"),
        cwd=tmp_path,
        environment=watch.environment,
    )
    assert said.code == 1, said
    assert said.out == ""
    last = said.err.splitlines()[-1]
    assert re.match(r"canopy: RunError: world cannot run: .*run/journal: offset \d+: damaged", last)
    watch.nothing_left()
    assert not (tmp_path / "run" / "result.json").exists()


def flip_in_store(folder: Path, seed: int) -> str | None:
    """Damage a store with an earlier run's tags; return what was said, ``None`` if all went well."""
    database = folder / "tags.db"
    before = setting_of(LONG, 2, bookkeeping={"database": str(database)})
    play(before, folder, "inprocess")
    copy = folder / "copy.db"
    shutil.copy(database, copy)

    def goes_on(path: Path) -> Setting:
        store = {"database": str(path), "fresh": False}
        faults = [{"flip": "bookkeeping", "at": 20}]
        return setting_of(LONG, 2, faults=faults, bookkeeping=store, seed=seed)

    alone = play(goes_on(copy), folder, "inprocess")
    try:
        run = play(goes_on(database), folder, "processes")
    except RunError as error:
        return str(error)
    result = result_of(run)
    assert run.trace_sha256 == alone.trace_sha256
    assert [claim for claim in result.guarantees if claim.holds is False] == []
    return None


@pytest.mark.parametrize("seeds", [range(1), pytest.param(range(1, 8), marks=pytest.mark.slow)])
def test_a_damaged_store_ends_the_run_and_is_named(seeds: range, tmp_path: Path) -> None:
    """Unless the damage is where nothing is, or is written over: then nothing is wrong."""
    said = []
    for seed in seeds:
        folder = tmp_path / str(seed)
        folder.mkdir()
        said.append(flip_in_store(folder, seed))
    for words in said:
        assert words is None or re.search(r"cannot run: .*tags\.db: ", words), words


@pytest.mark.slow
def test_a_new_store_that_is_damaged_changes_no_result(tmp_path: Path) -> None:
    for seed in range(3):
        setting = setting_of(LONG, 2, faults=[{"flip": "bookkeeping", "at": 20}], seed=seed)
        check(setting, tmp_path)


# Every instant, every request.


@pytest.mark.slow
@pytest.mark.parametrize(
    ("victim", "round_", "network"),
    [
        ("world", 0, {}),
        ("world", 1, {}),
        ("bookkeeping", 0, {}),
        ("router", 0, SEPARATE),
        ("world", 0, SEPARATE),
    ],
)
def test_a_kill_at_every_instant(
    victim: str, round_: int, network: dict[str, Any], tmp_path: Path
) -> None:
    plain = play(setting_of(PATH, 2, network=network), tmp_path, "inprocess")
    makespan = judge_journal(plain.folder.journal).result.makespan
    assert makespan is not None
    came_back = 0
    for at in range(int(makespan) + 1):
        faults = [{"kill": victim, "at": at, "round": round_}]
        _, run = check(setting_of(PATH, 2, faults=faults, network=network), tmp_path)
        assert run.trace_sha256 == plain.trace_sha256
        came_back += run.restarts[victim]
    assert came_back >= makespan / 2  # at the end the run may be quicker


@pytest.mark.slow
@pytest.mark.parametrize("robot", range(2))
@pytest.mark.parametrize("victim", ["itself", "world"])
def test_a_kill_at_every_request(victim: str, robot: int, tmp_path: Path) -> None:
    plain = play(setting_of(PATH, 2), tmp_path, "inprocess")
    made, name = requests_of(plain)[robot], f"robot:{robot}" if victim == "itself" else victim
    came_back = 0
    for number in range(1, made + 1):
        fault = {"kill": name, "at_request": number, "of": f"robot:{robot}"}
        _, run = check(setting_of(PATH, 2, faults=[fault], team=RESTART), tmp_path)
        assert run.trace_sha256 == plain.trace_sha256
        struck = run.played is not None and run.played.stories[0].struck_s is not None
        assert run.restarts.get(name, 0) == struck
        came_back += run.restarts.get(name, 0)
    assert came_back >= made / 2


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, 4])
def test_a_robot_that_is_killed_comes_back_where_it_was(number: int, tmp_path: Path) -> None:
    plain = play(setting_of(PATH, 2), tmp_path, "inprocess")
    faults = [SLOWLY, {"kill": "robot:1", "at_request": number}]
    result, run = check(setting_of(PATH, 2, faults=faults, team=RESTART), tmp_path)
    assert run.trace_sha256 == plain.trace_sha256
    assert (run.restarts, result.robots_lost) == (
        {"world": 0, "bookkeeping": 0, "robot:1": 1},
        [],
    )


# Chaos.


def chaos_of(seed: int, *, robots_too: bool) -> dict[str, Any]:
    """Draw a run with 1 to 6 kills of infrastructure; on top of these also losses of robots."""
    rng = Random(seed)
    robots, on_graph = rng.randint(2, 4), rng.random() < 0.6
    place = rng.choice(
        [
            {"kind": "random-tree", "vertices": rng.randint(4, 12)},
            {"kind": "random-graph", "vertices": 8, "edges": 7 + rng.randrange(5)},
        ]
        if on_graph
        else [{"kind": "random-obstacles", "rows": 3, "cols": 3, "obstacles": rng.randrange(3)}]
    )
    tree: dict[str, Any] = {
        "algorithm": "mr-dfs" if on_graph else "ormstc",
        "seed": seed,
        "world": {"generate": place},
        "team": {"robots": robots, "on_crash": rng.choice(["lost", "restart"])},
        "clock": {"mode": rng.choice(["lockstep", "event"])},
        "network": {"router": rng.choice(["embedded", "separate"])},
        "chaos": {
            "infrastructure": rng.randint(1, 6),
            "robots": rng.randint(1, robots - 1) if robots_too else 0,
        },
    }
    # Without this a run is mostly over before what strikes later in real time.
    tree["faults"] = [SLOWLY] if rng.random() < 0.5 else []
    return tree


def check_chaos(seed: int, folder: Path, *, robots_too: bool = False) -> int:
    """Check one run of chaos; return how many processes came back."""
    tree = chaos_of(seed, robots_too=robots_too)
    setting = prepare(from_tree(tree, f"seed {seed}"))
    result, run = check(setting, folder)
    assert result.complete, seed
    if not robots_too:
        quiet = prepare(from_tree({**tree, "faults": [], "chaos": {}}, f"seed {seed}"))
        assert play(quiet, folder, "inprocess").trace_sha256 == run.trace_sha256, seed
        assert result.robots_lost == []
    shutil.rmtree(folder)
    folder.mkdir()
    return sum(run.restarts.values())


@pytest.mark.parametrize("robots_too", [False, True])
def test_chaos(robots_too: bool, tmp_path: Path) -> None:
    assert check_chaos(1, tmp_path, robots_too=robots_too) > 0


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("block", range(0, 200, 10))
def test_two_hundred_seeds_of_infrastructure(block: int, tmp_path: Path) -> None:
    assert sum(check_chaos(seed, tmp_path) for seed in range(block, block + 10)) > 0


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("block", range(1000, 1050, 10))
def test_losses_of_robots_on_top(block: int, tmp_path: Path) -> None:
    seeds = range(block, block + 10)
    assert sum(check_chaos(seed, tmp_path, robots_too=True) for seed in seeds) > 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_nobody_is_lost_by_the_network(seed: int, tmp_path: Path) -> None:
    """Even where patience is short and faults of the network are many."""
    chaos = {"network": 8, "until": 20.0}
    network = {"patience_s": 2.0, **(SEPARATE if seed % 2 else {})}
    scenario = {
        "algorithm": "mr-dfs",
        "seed": seed,
        "world": {"generate": {"kind": "random-graph", "vertices": 400, "edges": 440}},
        "team": {"robots": 4},
        "network": network,
        "chaos": chaos,
    }
    result, _ = check(prepare(from_tree(scenario, "test")), tmp_path)
    assert result.robots_lost == []
    assert len(result.faults) == 8
    assert len(result.faults_not_struck) < 4


# By hand.


def cave_of(folder: Path, *, vertices: int = 120, more: str = "") -> Path:
    """Write a scenario of three robots in a cave; ``more`` are further lines of its network."""
    path = folder / f"cave{vertices}.toml"
    path.write_text(
        'algorithm = "mr-dfs"\nteam = {robots = 3}\n'
        f'world = {{generate = {{kind = "cave", vertices = {vertices}, loops = 8}}}}\n'
        f"[network]\n{more}"
    )
    return path


def plain_trace(scenario: Path, folder: Path) -> str:
    said = run_cli(
        *("run", scenario, "--engine", "inprocess", "--json", "--no-picture"),
        *("--out", folder / "plain"),
        cwd=folder,
    )
    trace = said.result["trace_sha256"]
    assert isinstance(trace, str)
    return trace


def is_frozen(pid: int) -> bool:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"
    return False


def comes_back(run: Started, name: str, former: int) -> int:
    """Wait until a process has a new life, and return its pid."""
    until(lambda: run.living().get(name, former) != former, f"new life of {name}", run.process)
    return run.living()[name]


@pytest.mark.parametrize(
    "order", ["world first", pytest.param("robot first", marks=pytest.mark.slow)]
)
def test_a_robot_that_dies_while_the_world_is_down_stalls_nobody(
    order: str, tmp_path: Path
) -> None:
    """The supervisor knows; nobody has to wait until the patience of ten minutes is over."""
    scenario = cave_of(tmp_path, more="patience_s = 600\n")
    watch = Watch(tmp_path)
    with started_cli(
        *(scenario, "--json", "--no-picture"),
        cwd=tmp_path,
        folder=tmp_path / "run",
        environment=watch.environment,
    ) as run:
        pids = dict(run.all_there(3))
        run.plays(2_000)
        victims = [pids["world"], pids["robot:1"]]
        for pid in victims if order == "world first" else reversed(victims):
            send(pid, signal.SIGKILL)
        said = run.finish()
    assert said.code == 0, said
    assert (said.result["complete"], said.result["robots_lost"]) == (True, [1])
    assert said.result["restarts"] == {"world": 1, "bookkeeping": 0}
    watch.nothing_left()


@pytest.mark.slow
def test_a_robot_that_dies_while_the_world_is_frozen_stalls_nobody(tmp_path: Path) -> None:
    scenario = cave_of(tmp_path, more="patience_s = 600\n")
    watch = Watch(tmp_path)
    with started_cli(
        *(scenario, "--json", "--no-picture"),
        *("--set", 'faults=[{pause="world", at=5, for_s=1.5}]'),
        cwd=tmp_path,
        folder=tmp_path / "run",
        environment=watch.environment,
    ) as run:
        pids = dict(run.all_there(3))
        until(lambda: is_frozen(pids["world"]), "the world to freeze", run.process)
        send(pids["robot:2"], signal.SIGKILL)
        until(lambda: not lives(pids["robot:2"]), "end of the robot", run.process)
        assert is_frozen(pids["world"])
        said = run.finish()
    assert said.code == 0, said
    assert (said.result["complete"], said.result["robots_lost"]) == (True, [2])
    watch.nothing_left()


@pytest.mark.slow
def test_a_frozen_robot_whose_world_dies_is_lost_and_fenced(tmp_path: Path) -> None:
    scenario = cave_of(tmp_path, vertices=1500, more="patience_s = 1\n")
    watch = Watch(tmp_path)
    with started_cli(
        *(scenario, "--json", "--no-picture"),
        cwd=tmp_path,
        folder=tmp_path / "run",
        environment=watch.environment,
    ) as run:
        pids = dict(run.all_there(3))
        run.plays(2_000)
        frozen = pids["robot:1"]
        send(frozen, signal.SIGSTOP)
        send(pids["world"], signal.SIGKILL)
        comes_back(run, "world", pids["world"])
        # The others stand still until it is lost, then the journal grows again.
        run.grows(2_000)
        assert is_frozen(frozen)  # nobody has killed it
        send(frozen, signal.SIGCONT)
        until(lambda: not lives(frozen), "end of the fenced robot", run.process)
        assert "fenced" in (run.folder / "logs" / "robot-1.log").read_text()
        said = run.finish()
    assert said.code == 0, said
    assert (said.result["complete"], said.result["robots_lost"]) == (True, [1])
    assert said.result["restarts"]["world"] == 1
    watch.nothing_left()


@pytest.mark.slow
@pytest.mark.parametrize("victim", ["world", "bookkeeping", "router"])
def test_infrastructure_that_dies_before_anybody_has_joined(victim: str, tmp_path: Path) -> None:
    scenario = cave_of(tmp_path, more='router = "separate"\n')
    watch = Watch(tmp_path)
    with started_cli(
        *(scenario, "--json", "--no-picture"),
        cwd=tmp_path,
        folder=tmp_path / "run",
        environment=watch.environment,
    ) as run:
        until(lambda: victim in run.living(), f"start of {victim}", run.process)
        send(run.living()[victim], signal.SIGKILL)
        said = run.finish()
    assert said.code == 0, said
    assert said.result["restarts"][victim] == 1
    assert (said.result["complete"], said.result["robots_lost"]) == (True, [])
    assert said.result["trace_sha256"] == plain_trace(scenario, tmp_path)
    watch.nothing_left()


def is_closed(journal: Path) -> bool:
    return any(isinstance(record, Closing) for record, _ in scan(journal))


@pytest.mark.slow
@pytest.mark.parametrize("victim", ["world", "bookkeeping", "router"])
def test_infrastructure_that_dies_when_all_is_over(victim: str, tmp_path: Path) -> None:
    """The news of the end may be lost with it; the next life tells it again."""
    scenario = cave_of(tmp_path, more='router = "separate"\n')
    watch = Watch(tmp_path)
    with started_cli(
        *(scenario, "--json", "--no-picture"),
        cwd=tmp_path,
        folder=tmp_path / "run",
        environment=watch.environment,
    ) as run:
        pids = dict(run.all_there(3))
        pids |= run.living()
        run.plays()
        until(lambda: is_closed(run.journal), "end of the run")
        send(pids[victim], signal.SIGKILL)
        said = run.finish()
    assert said.code == 0, said
    assert (said.result["complete"], said.result["robots_lost"]) == (True, [])
    assert said.result["trace_sha256"] == plain_trace(scenario, tmp_path)
    watch.nothing_left()


@pytest.mark.parametrize("deaths", [2, pytest.param(5, marks=pytest.mark.slow)])
def test_a_router_that_dies_costs_nobody(deaths: int, tmp_path: Path) -> None:
    scenario = cave_of(tmp_path, vertices=300, more='router = "separate"\n')
    watch = Watch(tmp_path)
    with started_cli(
        *(scenario, "--json", "--no-picture"),
        cwd=tmp_path,
        folder=tmp_path / "run",
        environment=watch.environment,
    ) as run:
        run.all_there(3)
        run.plays(1_000)
        for _ in range(deaths):
            router = run.living()["router"]
            send(router, signal.SIGKILL)
            comes_back(run, "router", router)
            run.grows(1_000)
        said = run.finish()
    assert said.code == 0, said
    assert (said.result["complete"], said.result["robots_lost"]) == (True, [])
    assert said.result["restarts"] == {"router": deaths, "world": 0, "bookkeeping": 0}
    assert said.result["trace_sha256"] == plain_trace(scenario, tmp_path)
    watch.nothing_left()


class Intruder:
    """Starts processes by hand beside a run that stands still, and gets its own back in the end."""

    def __init__(self, run: Started, port: int) -> None:
        self.run = run
        self.name = read_opening(run.journal).run
        self.port = port
        lines = (run.folder / "users").read_text().splitlines()
        self.passwords = dict(line.split(":") for line in lines)

    def start(self, module: str, *arguments: object, password: str) -> Said:
        """Run a process to its end."""
        done = subprocess.run(
            [sys.executable, "-m", module, *map(str, arguments), "--run", self.name],
            env={**os.environ, PASSWORD: password},
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        return Said(done.returncode, done.stdout, done.stderr)


@pytest.mark.parametrize("router", [pytest.param("embedded", marks=pytest.mark.slow), "separate"])
def test_a_second_world_and_a_second_robot_are_refused(router: str, tmp_path: Path) -> None:
    port = free_port()
    more = f'port = {port}\nrouter = "{router}"\npatience_s = 600\n'
    scenario = cave_of(tmp_path, more=more)
    watch = Watch(tmp_path)
    with started_cli(
        *(scenario, "--json", "--no-picture"),
        cwd=tmp_path,
        folder=tmp_path / "run",
        environment=watch.environment,
    ) as run:
        pids = dict(run.all_there(3))
        run.plays(1_000)
        send(pids["robot:0"], signal.SIGSTOP)  # so that the run is not over meanwhile
        intruder = Intruder(run, port)
        passwords = intruder.passwords

        def world(at_port: int, at_router: str) -> str:
            said = intruder.start(
                *("world_server.node", run.folder, "--port", at_port, "--robots", 3),
                *("--router", at_router),
                password=passwords["world"],
            )
            assert said.code == 2, said
            assert len(said.err.splitlines()) == 1, said
            return said.err

        alive = rf"^world: {run.folder}/journal: another world server is alive on this run$"
        assert re.match(alive, world(free_port(), "embedded"))
        if router == "separate":
            assert re.match(alive, world(port, "separate"))
        else:
            assert f"cannot listen on 127.0.0.1:{port}" in world(port, "embedded")
        second = intruder.start(
            *("agents.node", "--port", port, "--robot", 1), password=passwords["robot-1"]
        )
        assert second.code == NOT_JOINED
        assert second.err == "JoinError: robot 1 has joined already\n"
        assert run.living() == pids | run.living()
        assert all(map(lives, pids.values()))
        send(pids["robot:0"], signal.SIGCONT)
        said = run.finish()
    assert said.code == 0, said
    assert said.result["robots_lost"] == []
    assert not any(said.result["restarts"].values())
    assert said.result["trace_sha256"] == plain_trace(scenario, tmp_path)
    records = [record for record, _ in scan(run.journal)]
    assert sum(isinstance(record, Incarnation) for record in records) == 1
    assert sum(isinstance(record, Joined) for record in records) == 3
    watch.nothing_left()


@pytest.mark.slow
def test_a_second_process_with_the_memory_of_a_living_robot_is_refused(tmp_path: Path) -> None:
    port = free_port()
    scenario = cave_of(tmp_path, more=f"port = {port}\npatience_s = 600\n")
    with started_cli(
        *(scenario, "--json", "--no-picture", "--set", "team.on_crash=restart"),
        cwd=tmp_path,
        folder=tmp_path / "run",
    ) as run:
        pids = dict(run.all_there(3))
        run.plays(1_000)
        send(pids["robot:0"], signal.SIGSTOP)
        intruder = Intruder(run, port)
        with subprocess.Popen(
            [
                *(sys.executable, "-m", "agents.node", "--run", intruder.name, "--robot", "1"),
                *("--port", str(port), "--memory", str(run.folder / "robot-1.memory")),
            ],
            env={**os.environ, PASSWORD: intruder.passwords["robot-1"]},
        ) as second:
            try:
                until(lambda: second.poll() is not None, "refusal", run.process, timeout_s=5)
            finally:
                second.kill()
        assert second.returncode == NOT_JOINED


@pytest.mark.slow
def test_a_client_of_another_run_is_refused(tmp_path: Path) -> None:
    """It has a password, but that of its own run."""
    port = free_port()
    more = f'port = {port}\nrouter = "separate"\npatience_s = 600\n'
    scenario = cave_of(tmp_path, more=more)
    with started_cli(
        *(scenario, "--json", "--no-picture"), cwd=tmp_path, folder=tmp_path / "run"
    ) as run:
        pids = dict(run.all_there(3))
        run.plays(1_000)
        send(pids["robot:0"], signal.SIGSTOP)
        intruder = Intruder(run, port)
        said = intruder.start("agents.node", "--port", port, "--robot", 1, password="0" * 32)
        assert said.code == 2, said
        assert said.err.startswith("robot 1: cannot reach the router on 127.0.0.1"), said
        assert len(said.err.splitlines()) == 1, said
        send(pids["robot:0"], signal.SIGCONT)
        ended = run.finish()
    assert ended.code == 0, ended
    assert ended.result["robots_lost"] == []


# What is left.


def descriptors() -> int:
    return sum(1 for _ in Path("/proc/self/fd").iterdir())


@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    "seeds",
    [
        range(2000, 2005),
        *(pytest.param(range(n, n + 20), marks=pytest.mark.slow) for n in (3000, 4000)),
    ],
)
def test_runs_under_chaos_leave_nothing(
    seeds: range, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also none of the supervisor's descriptors, which is this process here."""
    watch = Watch(tmp_path)
    for name, value in watch.environment.items():
        monkeypatch.setenv(name, value)
    port = free_port()

    def play_one(seed: int) -> None:
        tree = chaos_of(seed, robots_too=bool(seed % 2))
        tree["network"]["port"] = port
        tree["chaos"]["network"] = seed % 3
        folder = tmp_path / "runs"
        folder.mkdir()
        check_left(play(prepare(from_tree(tree, "test")), folder, "processes"))
        shutil.rmtree(folder)
        assert free(port)

    play_one(seeds[0])  # opens what is opened once for all
    before = descriptors()
    for seed in seeds[1:]:
        play_one(seed)
        assert descriptors() <= before, seed
    watch.nothing_left()
