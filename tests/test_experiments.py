"""The experiments: each part in miniature, the same numbers every time, and the maps they play on."""

import csv
import importlib.metadata
import json
import tomllib
from math import isnan
from pathlib import Path
from typing import Any

import msgspec
import pytest

from deploy.cli import main
from experiments import command, ormstc, paper, plots, sweep
from experiments.ormstc import PARTS, PUBLISHED, Plan, Row, Run, Size
from experiments.sweep import Measured
from protocol.errors import ScenarioError
from protocol.grid import Grid
from protocol.scenario import from_tree, load, to_tree
from tests.conftest import ROOT

TINY = Size(teams=(2, 4), starts=1, inputs=1)
SMALL = {"kind": "random-obstacles", "rows": 8, "cols": 8, "obstacles": 10}
PNG = b"\x89PNG\r\n\x1a\n"


def tiny(robots: int = 2, seed: int = 1, **fields: Any) -> sweep.Tree:
    """A world of 6 x 6 coarse cells, 6 of them blocked."""
    generate = {"kind": "random-obstacles", "rows": 6, "cols": 6, "obstacles": 6}
    tree = {
        "algorithm": "ormstc",
        "seed": seed,
        "world": {"generate": generate},
        "team": {"robots": robots},
    }
    return sweep.with_fields(tree, fields)


def measured(time: float = 8.0, **fields: Any) -> Measured:
    base = Measured(
        complete=True,
        status="over",
        covered=10,
        to_cover=10,
        coverage_time=time,
        visits_extra=1,
        killed=0,
        failed=0,
        violations=0,
    )
    return msgspec.structs.replace(base, **fields)


# Every part.


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Play on small worlds and on our own maps, and draw small."""
    monkeypatch.setattr(ormstc, "OBSTACLES", SMALL)
    monkeypatch.setattr(ormstc, "shared_maps", lambda: tmp_path)
    monkeypatch.setattr(plots, "DPI", 50)


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("name", PARTS)
def test_a_part_is_played_drawn_and_written(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    part = paper.play_part(name, TINY, tmp_path, 1, check=False)
    assert (tmp_path / f"{name}.png").read_bytes().startswith(PNG)

    numbers = json.loads((tmp_path / f"{name}.json").read_text(encoding="utf-8"))
    assert numbers == json.loads(msgspec.json.encode(part))

    plan = PARTS[name](TINY)
    with (tmp_path / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == len(plan.runs) == sum(row.runs for row in part.rows)

    paper.print_part(part)
    printed = capsys.readouterr().out
    assert printed.splitlines()[0].strip() == name
    for row in part.rows:
        assert f"{row.coverage_time:.0f} ± {row.coverage_time_sd:.0f}" in printed

    drifting = [row for row in part.rows if "drift" in str(row.labels.get("option"))]
    assert all(row.complete == row.runs for row in part.rows if row not in drifting)


def test_the_same_plan_gives_the_same_numbers_however_it_is_played() -> None:
    trees = [tiny(robots, seed) for robots in (1, 3) for seed in (1, 2)]
    shown: list[tuple[int, int]] = []
    alone = sweep.sweep(trees, show=lambda done, total: shown.append((done, total)))
    assert shown == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert sweep.sweep(trees, workers=2) == alone == [sweep.measure(tree) for tree in trees]
    assert alone[0] != alone[2]


def test_seeds_change_a_plan_and_nothing_else_does() -> None:
    for name, part in PARTS.items():
        plan = part(TINY)
        assert plan == part(TINY), name
        for labels in {tuple(run.labels.items()) for run in plan.runs}:
            seeds = [run.tree["seed"] for run in plan.runs if run.labels == dict(labels)]
            assert len(set(seeds)) == len(seeds)


def test_all_runs_of_all_parts_are_scenarios() -> None:
    for plan in PARTS.values():
        for run in plan(TINY).runs:
            from_tree(run.tree, "test")


# Rows.


def test_a_row_sums_up_runs_that_differ_in_their_seed() -> None:
    runs = [Run({"robots": robots}, tiny(robots, seed)) for robots in (2, 5) for seed in (1, 2)]
    results = [
        measured(6.0),
        measured(10.0, complete=False, covered=5, visits_extra=2, failed=1, violations=3),
        measured(1.0),
        measured(1.0),
    ]
    first, second = ormstc.rows_of(Plan((), tuple(runs)), results)
    assert first.coverage_time_sd == pytest.approx(8**0.5)
    assert first == Row(
        labels={"robots": 2},
        runs=2,
        complete=1,
        coverage_time=8.0,
        coverage_time_sd=first.coverage_time_sd,
        even_share=4.0,
        extra_percent=25.0,
        covered_percent=75.0,
        killed=0.0,
        failed=1,
        impossible=1,
    )
    assert (second.runs, second.coverage_time_sd, second.even_share) == (2, 0.0, 1.0)


def test_an_option_that_leaves_something_uncovered_is_not_compared() -> None:
    runs = [Run({"option": name}, tiny()) for name in (ormstc.BASELINE, "a", "b")]
    results = [measured(10.0), measured(15.0), measured(2.0, complete=False)]
    rows = ormstc.rows_of(Plan((), tuple(runs)), results)
    assert ormstc.relative(rows) == {ormstc.BASELINE: 1.0, "a": 1.5, "b": None}


def test_deviations_are_in_standard_errors() -> None:
    def row(*times: float) -> Row:
        runs = tuple(
            Run({"robots": 1, "losses": 0}, tiny(1, seed)) for seed in range(1, len(times) + 1)
        )
        return ormstc.rows_of(Plan((), runs), list(map(measured, times)))[0]

    assert ormstc.deviation(row(1359.0, 1359.0)) == 0.0
    assert isnan(ormstc.deviation(row(1360.0, 1360.0)))
    expected = 10 / (200**0.5 * (1 / 2 + 1 / 20) ** 0.5)
    assert ormstc.deviation(row(1359.0, 1379.0)) == pytest.approx(expected)


# What is played.


def test_one_robot_covers_the_obstacle_world_in_the_published_time() -> None:
    """Reference: 1359 = 4 x 340 - 1, for 20 x 20 coarse cells of which 60 are blocked."""
    run = ormstc.losses(TINY).runs[0]
    assert (run.labels["robots"], run.labels["losses"]) == (1, 0)
    assert sweep.measure(run.tree).coverage_time == PUBLISHED[1, 0].coverage_time == 1359


def test_losses_strike_different_robots_in_both_phases_within_an_even_share() -> None:
    rounds = set()
    plan = ormstc.losses(Size(inputs=20))
    for run in plan.runs:
        faults = run.tree.get("faults", [])
        assert len({fault["kill"] for fault in faults}) == run.labels["losses"]
        assert all(0 <= fault["at"] < 136 for fault in faults)
        rounds |= {fault["round"] for fault in faults}
    assert rounds == {0, 1}
    # The same losses, lazily and not.
    lazy, eager = (
        [
            run.tree["faults"]
            for run in plan.runs
            if run.labels["losses"] and run.labels["lazy"] == wish
        ]
        for wish in (True, False)
    )
    assert lazy == eager


def test_clustered_robots_start_in_cells_of_their_own_next_to_each_other() -> None:
    for run in ormstc.helping(Size(teams=(10,), starts=5)).runs:
        if run.labels["starts"] == "clustered":
            cells = {(row // 2, col // 2) for row, col in run.tree["world"]["starts"]}
            assert len(cells) == 10
            rows = ["".join(".#"[(r, c) not in cells] * 2 for c in range(20)) for r in range(20)]
            grid = Grid.of_text("\n".join(row for row in rows for _ in (0, 1)))
            assert grid.reachable_cells([min(cells)]) == cells


def test_maps_of_ours_stand_in_for_those_that_are_absent(tmp_path: Path) -> None:
    assert [(place.name, place.file.name) for place in ormstc.places(tmp_path)] == [
        ("Cave", "cavern.txt"),
        ("Office", "office.txt"),
    ]
    about = "\n".join(ormstc.figure13(TINY, tmp_path).about)
    assert f"as Stage's maps are not in {tmp_path}" in about
    stage = tmp_path / "stage"
    stage.mkdir()
    for name in ("cave.png", "autolab.png"):
        (stage / name).touch()
    assert [place.name for place in ormstc.places(tmp_path)] == ["Cave", "Room", "Office"]


@pytest.mark.parametrize("name", ["cavern", "office"])
def test_a_map_of_ours_is_nearly_all_one_part(name: str) -> None:
    grid = Grid.of_text((ROOT / "deploy" / "maps" / f"{name}.txt").read_text(encoding="utf-8"))
    assert (grid.rows, grid.cols) == (60, 80)
    cells = grid.complete_cells()
    assert grid.reachable_cells(cells[:1]) == set(cells)
    assert 4 * len(cells) >= 0.85 * len(grid.free_cells())


@pytest.mark.parametrize(("name", "lost"), [("cave", 3), ("room", 2), ("warehouse", 2)])
def test_a_scenario_of_ours_is_covered_although_robots_are_lost(name: str, lost: int) -> None:
    result = sweep.measure(to_tree(load(ROOT / "deploy" / "scenarios" / f"{name}.toml")))
    assert (result.complete, result.killed, result.failed, result.violations) == (True, lost, 0, 0)
    assert result.visits_extra > 20


# Playing.


def test_fields_are_set_in_a_copy() -> None:
    tree = tiny()
    changed = sweep.with_fields(tree, {"sensing.mode": "three", "team.robots": 5})
    assert (changed["sensing"], changed["team"]) == ({"mode": "three"}, {"robots": 5})
    assert tree == tiny()


def test_a_tree_as_toml_is_the_same_tree() -> None:
    faults = [{"kill": "robot:1", "at": 3.0, "round": 1}]
    fields = {"name": 'a "b" \\ é', "faults": faults, "team.speed": [0.5, 2.0], "world.x": True}
    tree = sweep.with_fields(tiny(), fields)
    assert tomllib.loads(sweep.to_toml(tree)) == tree


def test_a_run_without_end_is_cut_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep, "LAPS_MOST", 0.1)
    result = sweep.measure(tiny())
    assert (result.status, result.complete) == ("unfinished", False)
    assert result.covered < result.to_cover == 120


def test_losses_and_faults_are_told_apart() -> None:
    faults = [{"kill": "robot:0", "at": 3.0}]
    result = sweep.measure(tiny(3, faults=faults))
    assert (result.complete, result.killed, result.failed) == (True, 1, 0)
    near = {"sensing.mode": "radius", "sensing.range_m": 1.0}
    result = sweep.measure(sweep.with_fields(tiny(), near))
    assert (result.complete, result.killed, result.failed) == (False, 0, 2)


def test_a_scenario_that_cannot_be_played_is_refused_by_any_process() -> None:
    wrong = tiny(robots=1000)
    for workers in (1, 2):
        with pytest.raises(ScenarioError, match=r"team\.robots"):
            sweep.sweep([wrong], workers=workers)


@pytest.mark.slow
def test_processes_give_the_trace_of_a_sweep() -> None:
    faults = [{"kill": "robot:1", "at": 20.0, "round": 1}]
    for tree in (tiny(3), tiny(3, faults=faults)):
        assert sweep.trace_of_processes(tree) == sweep.trace_inprocess(tree)


# The command.


@pytest.mark.usefixtures("small")
def test_the_command_prints_one_object(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(paper, "QUICK", TINY)
    monkeypatch.setattr(command, "WORKERS", 1)
    words = ["paper", "ormstc", "--quick", "--only", "losses", "--inputs", "2", "--json"]
    assert main([*words, "--out", str(tmp_path / "new")]) == 0
    said = capsys.readouterr()
    assert "losses: 24 runs" in said.err
    (line,) = said.out.splitlines()
    parts = json.loads(line)["parts"]
    assert list(parts) == ["losses"]
    assert all(row["runs"] == row["complete"] == 2 for row in parts["losses"]["rows"])


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (
            ["nonesuch"],
            "paper nonesuch: no such paper; expected connected, mstc, ormstc, parent-child",
        ),
        (
            ["ormstc", "--only", "x"],
            "--only x: no such part of the paper; expected one of figure13",
        ),
        (["ormstc", "--out", "file"], "--out file: file: file exists"),
    ],
)
def test_what_cannot_be_played_is_refused_in_one_line(
    words: list[str],
    complaint: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    assert main(["paper", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"canopy: {complaint}")


@pytest.mark.parametrize("inputs", ["0", "-1", "many"])
def test_a_number_of_inputs_is_at_least_one(
    inputs: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["paper", "ormstc", f"--inputs={inputs}"])
    assert ended.value.code == 2
    assert f"found '{inputs}', expected a whole number from 1" in capsys.readouterr().err


def test_without_experiments_the_command_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda **_: [])
    assert main(["paper", "ormstc"]) == 2
    said = capsys.readouterr().err
    assert said == "canopy: the package 'experiments' is not installed; run `make setup`\n"
