"""Real SIGKILLs: ordered by the scenario, or sent by hand from outside; and what is left behind."""

import signal
from pathlib import Path
from random import Random

import pytest

from deploy.judged import judge_journal
from deploy.verdict.result import exit_code
from protocol.trace import Event
from protocol.zenoh_link import free_port
from tests.play import graph_of
from tests.runs import (
    Watch,
    ends,
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
    write_scenario,
)

SMALL = graph_of("01 12 23 34 40 13")
ROBOTS = 3


# A kill at every request of every robot.


def check_kill_at_request(robot: int, number: int, folder: Path) -> None:
    setting = setting_of(SMALL, ROBOTS, faults=[{"kill": f"robot:{robot}", "at_request": number}])
    alone = play(setting, folder, "inprocess")
    run = play(setting, folder, "processes")
    assert run.trace_sha256 == alone.trace_sha256
    result = judge_journal(run.folder.journal).result
    assert result.robots_lost == [robot]
    assert result.per_robot[robot].requests == number - 1  # the n-th definitely did not happen
    assert exit_code(result) == 0, result
    assert not processes_that_mention(run.folder.path.name)


@pytest.mark.parametrize(("robot", "number"), [(0, 1), (1, 2), (2, 7)])
def test_a_robot_killed_at_its_nth_request(robot: int, number: int, tmp_path: Path):
    check_kill_at_request(robot, number, tmp_path)


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("robot", range(ROBOTS))
def test_each_robot_killed_at_each_of_its_requests(robot: int, tmp_path: Path):
    made = requests_of(play(setting_of(SMALL, ROBOTS), tmp_path, "inprocess"))
    for number in range(1, made[robot] + 1):
        check_kill_at_request(robot, number, tmp_path)


def test_all_but_one_killed_by_order_at_one_instant(tmp_path: Path):
    kills = [{"kill": f"robot:{robot}", "at": 3} for robot in (0, 1, 3, 4)]
    run = play(setting_of(SMALL, 5, faults=kills), tmp_path, "processes")
    result = judge_journal(run.folder.journal).result
    assert (result.robots_lost, result.complete) == ([0, 1, 3, 4], True)
    assert exit_code(result) == 0


def test_a_team_of_which_nobody_is_left_ends_incomplete(tmp_path: Path):
    kills = [{"kill": f"robot:{robot}", "at_request": 3 + robot} for robot in range(3)]
    setting = setting_of(SMALL, 3, faults=kills)
    run = play(setting, tmp_path, "processes")
    assert run.trace_sha256 == play(setting, tmp_path, "inprocess").trace_sha256
    result = judge_journal(run.folder.journal).result
    assert (result.robots_lost, result.complete, result.status) == ([0, 1, 2], False, "over")
    assert exit_code(result) == 1


# Kills by hand.

RUN_BYTES = 8_000
"""The journal of such a run grows by more than this after the opening, whoever dies."""


def cave_of(folder: Path, *, robots: int, patience_s: float = 5.0, vertices: int = 120) -> Path:
    path = folder / f"cave{vertices}.toml"
    path.write_text(
        f'algorithm = "mr-dfs"\nteam = {{robots = {robots}}}\n'
        f"network = {{patience_s = {patience_s}}}\n"
        f'world = {{generate = {{kind = "cave", vertices = {vertices}, loops = 8}}}}\n'
    )
    return path


def check_kills_by_hand(seed: int, folder: Path) -> None:
    random = Random(seed)
    robots = random.randint(2, 4)
    victims = random.sample(range(robots), robots - 1)
    # A moment is so many bytes of the journal after the one before; the first may come before
    # anybody has joined.
    moments = [random.choice([None, random.randrange(RUN_BYTES // robots)])]
    moments += [random.randrange(RUN_BYTES // robots) for _ in victims[1:]]
    watch = Watch(folder)
    scenario = cave_of(folder, robots=robots)
    with started_cli(
        *(scenario, "--json", "--no-picture", "--set", f"seed={seed}"),
        cwd=folder,
        folder=folder / f"by-hand-{seed}",
        environment=watch.environment,
    ) as run:
        pids = run.all_there(robots)
        for victim, moment in zip(victims, moments, strict=True):
            if moment is not None:
                run.plays(moment)
            send(pids[f"robot:{victim}"], signal.SIGKILL)
        said = run.finish()
    assert said.code == 0, said
    assert said.result["complete"] is True
    assert said.result["robots_lost"] == sorted(victims)
    assert {robot["lost_by"] for robot in said.result["per_robot"]} == {None, "killed"}
    assert not any(said.result["restarts"].values())
    watch.nothing_left()
    assert not (run.folder / "processes.json").exists()
    assert not (run.folder / "users").exists()


@pytest.mark.parametrize("seed", range(2))
def test_all_but_one_killed_by_hand_at_random_moments(seed: int, tmp_path: Path):
    check_kills_by_hand(seed, tmp_path)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("block", range(2, 50, 8))
def test_fifty_runs_with_kills_by_hand(block: int, tmp_path: Path):
    for seed in range(block, min(block + 8, 50)):
        check_kills_by_hand(seed, tmp_path)


def test_a_run_with_kills_by_hand_replays(tmp_path: Path):
    scenario = cave_of(tmp_path, robots=3)
    with started_cli(
        scenario, "--json", "--no-picture", cwd=tmp_path, folder=tmp_path / "run"
    ) as run:
        pids = run.all_there(3)
        run.plays(2_000)
        send(pids["robot:1"], signal.SIGKILL)
        said = run.finish()
    replayed = run_cli("replay", run.folder, "--json", cwd=tmp_path)
    assert replayed.code == said.code == 0
    assert replayed.result["trace_sha256"] == said.result["trace_sha256"]
    assert replayed.result["robots_lost"] == [1]


# A robot that freezes.


def test_a_frozen_robot_is_lost_after_the_patience_and_fenced_when_it_wakes(tmp_path: Path):
    scenario = cave_of(tmp_path, robots=3, patience_s=1.0, vertices=1500)
    watch = Watch(tmp_path)
    folder = tmp_path / "run"
    with started_cli(
        *(scenario, "--json", "--no-picture"),
        cwd=tmp_path,
        folder=folder,
        environment=watch.environment,
    ) as run:
        pids = run.all_there(3)
        frozen = pids["robot:1"]
        run.plays(2_000)
        send(frozen, signal.SIGSTOP)
        # The others stand still until it is declared lost, then the journal grows again.
        until(lambda: 1 in losses(folder), "loss of the frozen robot", run.process)
        assert lives(frozen)  # nobody has killed it
        run.grows(2_000)
        assert lives(frozen)
        send(frozen, signal.SIGCONT)
        until(lambda: not lives(frozen), "end of the fenced robot", run.process)
        assert "fenced" in (folder / "logs" / "robot-1.log").read_text()
        said = run.finish()
    assert said.code == 0, said
    assert (said.result["complete"], said.result["robots_lost"]) == (True, [1])
    watch.nothing_left()


@pytest.mark.slow
def test_a_robot_that_stays_frozen_does_not_outlive_the_run(tmp_path: Path):
    scenario = cave_of(tmp_path, robots=3, patience_s=1.5)
    watch = Watch(tmp_path)
    with started_cli(
        *(scenario, "--json", "--no-picture"),
        cwd=tmp_path,
        folder=tmp_path / "run",
        environment=watch.environment,
    ) as run:
        pids = run.all_there(3)
        run.plays(2_000)
        send(pids["robot:0"], signal.SIGSTOP)
        said = run.finish()
    assert said.code == 0, said
    assert (said.result["complete"], said.result["robots_lost"]) == (True, [0])
    watch.nothing_left()


@pytest.mark.slow
def test_a_robot_that_freezes_before_it_joins_is_lost_in_the_end(tmp_path: Path):
    scenario = cave_of(tmp_path, robots=3)
    watch = Watch(tmp_path)
    with started_cli(
        *(scenario, "--json", "--no-picture", "--set", "network.join_patience_s=10"),
        cwd=tmp_path,
        folder=tmp_path / "run",
        environment=watch.environment,
    ) as run:
        until(lambda: "robot:2" in run.living(), "start of robot 2", run.process)
        send(run.living()["robot:2"], signal.SIGSTOP)
        said = run.finish()
    assert said.code == 0, said
    assert (said.result["complete"], said.result["robots_lost"]) == (True, [2])
    watch.nothing_left()


def losses(folder: Path) -> set[int]:
    """Return the robots that the journal takes for lost so far."""
    lost: set[int] = set()

    def note(event: Event) -> None:
        if isinstance(event.what, str):
            lost.add(event.robot)

    judge_journal(folder / "journal", also=note)
    return lost


# The supervisor dies.


@pytest.mark.parametrize("sign", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("router", ["embedded", pytest.param("separate", marks=pytest.mark.slow)])
def test_nothing_outlives_the_supervisor(sign: signal.Signals, router: str, tmp_path: Path):
    """Those whom nobody is left to reap may stay zombies, if our init is a lazy one."""
    port = free_port()
    watch = Watch(tmp_path)
    scenario = cave_of(tmp_path, robots=3, vertices=3000)
    with started_cli(
        *(scenario, "--json", "--no-picture", "--set", f"network.port={port}"),
        *("--set", f"network.router={router}"),
        cwd=tmp_path,
        folder=tmp_path / "run",
        environment=watch.environment,
    ) as run:
        pids = run.all_there(3)
        run.plays(2_000)
        assert not free(port)
        assert all(map(lives, pids.values()))
        run.process.send_signal(sign)
        said = run.finish()
    ends(pids)
    watch.nothing_left()
    # Of a process that is a zombie the kernel may still be closing what other threads held.
    until(lambda: free(port), "the port of the router", timeout_s=10)
    if sign == signal.SIGKILL:
        assert said.code == -signal.SIGKILL
    else:  # it has tidied up, and says so in one line
        assert said.code == 130
        assert said.err.splitlines()[-1] == "canopy: interrupted; everything that ran has ended"
        assert not (run.folder / "processes.json").exists()
        assert not (run.folder / "users").exists()
    # What was played until then can be looked at.
    replayed = run_cli("replay", run.folder, "--json", cwd=tmp_path)
    assert replayed.code == 1
    assert replayed.result["complete"] is False


def test_frozen_processes_do_not_outlive_a_killed_supervisor(tmp_path: Path):
    scenario = cave_of(tmp_path, robots=3, vertices=3000)
    watch = Watch(tmp_path)
    with started_cli(
        scenario,
        cwd=tmp_path,
        folder=tmp_path / "run",
        environment=watch.environment,
    ) as run:
        pids = run.all_there(3)
        run.plays(2_000)
        for pid in pids.values():
            send(pid, signal.SIGSTOP)
        run.process.kill()
        run.finish()
    ends(pids)
    watch.nothing_left()


# Infrastructure.


@pytest.mark.parametrize("victim", ["bookkeeping", "world"])
def test_infrastructure_that_dies_is_started_again(victim: str, tmp_path: Path):
    scenario = cave_of(tmp_path, robots=3)
    plain = run_cli(
        *("run", scenario, "--engine", "inprocess", "--json", "--no-picture"),
        *("--out", tmp_path / "plain"),
        cwd=tmp_path,
    )
    watch = Watch(tmp_path)
    with started_cli(
        *(scenario, "--json", "--no-picture"),
        cwd=tmp_path,
        folder=tmp_path / "run",
        environment=watch.environment,
    ) as run:
        pids = run.all_there(3)
        run.plays(2_000)
        send(pids[victim], signal.SIGKILL)
        said = run.finish()
    assert said.code == 0, said
    assert said.result["restarts"] == {"world": 0, "bookkeeping": 0, victim: 1}
    assert said.result["trace_sha256"] == plain.result["trace_sha256"]
    watch.nothing_left()


def test_a_small_run_leaves_nothing(tmp_path: Path):
    watch = Watch(tmp_path)
    said = run_cli(
        *("run", write_scenario(tmp_path), "--out", tmp_path / "run"),
        cwd=tmp_path,
        environment=watch.environment,
    )
    assert said.code == 0, said
    watch.nothing_left()
    kept = {path.name for path in (tmp_path / "run").iterdir()}
    assert kept == {"journal", "result.json", "run.png", "bookkeeping.db", "logs"}
