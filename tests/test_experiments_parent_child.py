"""The experiments on parent and child robots: their trends, and that they play."""

import csv
import json
from itertools import product
from pathlib import Path
from statistics import mean

import pytest

from agents.planning.vertices import Reach, choose
from deploy.cli import main
from experiments import command, parent_child_runs
from experiments.parent_child import (
    PAPER,
    PARTS,
    RADII_M,
    RATIOS,
    SIZES,
    TEAMS,
    cases_of,
    fewest,
    rows_of,
)
from experiments.parent_child_runs import Case, Measured, Played, carried_out, compared, measure
from protocol.grid import Grid

SMALL = 14


@pytest.fixture
def on_small_maps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Play on maps of 7 m x 7 m, in this process alone."""
    monkeypatch.setattr(parent_child_runs, "SIDE", SMALL)
    monkeypatch.setattr(command, "WORKERS", 1)


def measured(coverage: int, coordination: int, vertices: int = 100) -> Measured:
    return Measured(
        vertices=vertices,
        parents=10,
        extra=1,
        coverage=coverage,
        coordination=coordination,
        redundant=20,
        ticks=coverage,
        cpu_s=0.5,
    )


def test_rows_are_means_over_maps() -> None:
    (one, other) = rows_of(
        "figure7",
        {
            Case(0.2, 1.0, 2, 0): measured(50, 10, vertices=100),
            Case(0.2, 1.0, 2, 1): measured(60, 20, vertices=200),
            Case(0.2, 1.0, 3, 0): measured(40, 30),
        },
    )
    assert (one.maps, one.vertices, one.coverage, one.coordination) == (2, 150, 55, 15)
    assert (one.steps, one.steps_sd, one.redundant_percent) == (70, 10, 15)
    assert (other.maps, other.steps_sd, other.paper) == (1, 0, {"fewest_with": 2})
    # Of equals the smaller team.
    assert list(fewest([one, other])) == [
        "20 % obstructed, r_los = 1 m: fewest steps with 2 children (paper 2)"
    ]


def test_parts_list_what_the_paper_shows() -> None:
    for part in ("figure5", "figure6"):
        cases = cases_of(part, 8, quick=False)
        assert {case.ratio for case in cases} == set(RATIOS)
        assert {case.children for case in cases} == set(SIZES)
        # Without obstacles there is one map.
        assert len(cases) == len(SIZES) * (1 + 8 + 8)
    cases = cases_of("figure7", 8, quick=False)
    assert {case.r_los_m for case in cases} == set(RADII_M)
    assert len(cases) == len(SIZES) * 3 * 8
    cases = cases_of("teams", 8, quick=False)
    assert {case.teams for case in cases} == set(TEAMS)
    assert len(cases) == 2 * len(TEAMS) * 8
    for part in ("table1", "table2", "table3"):
        kinds = {(case.ratio, case.r_los_m) for case in cases_of(part, 1, quick=True)}
        assert set(PAPER[part]) == kinds


@pytest.mark.usefixtures("on_small_maps")
def test_the_command_writes_figures_and_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["paper", "parent-child", "--quick", "--inputs", "2", "--out", str(tmp_path)]
    assert main([*words, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)["parts"]
    assert tuple(said) == PARTS
    for part in ("figure5", "figure6", "figure7", "figure8", "figure8-run", "teams"):
        assert (tmp_path / f"{part}.png").stat().st_size > 10_000
    lines = list(csv.DictReader((tmp_path / "figure7.csv").read_text().splitlines()))
    assert len(lines) == 3 * 4 * 2
    for line in lines:
        case = Case(0.2, float(line["r_los_m"]), int(line["children"]), int(line["seed"]))
        assert int(line["ticks"]) == measure(case).ticks
    several = said["teams"]
    assert [row["teams"] for row in several] == list(TEAMS)
    assert several[-1]["ticks"] < several[0]["ticks"]
    (run,) = said["played"]
    assert run["complete"]
    assert run["planned"] == run["makespan"]
    assert run["broken"] == []
    assert main([*words, "--only", "table1", "--only", "table3", "--only", "figure7"]) == 0
    said = capsys.readouterr().out
    assert "P = 196 (paper 3600)" in said
    assert "s (paper 148.1 min)" in said
    assert "fewest steps with" in said


@pytest.mark.usefixtures("on_small_maps")
@pytest.mark.parametrize("case", [Case(0.3, 1.0, 4, 3), Case(0.2, 2.5, 2, 5)])
def test_robots_carry_out_what_was_planned(case: Case) -> None:
    team = case.plan()
    result, ledger, _ = carried_out(case, team)
    run = compared(case, team, result)
    assert run.as_planned
    # The plan was made for the map that the robots had.
    assert isinstance(ledger.grid, Grid)
    assert ledger.grid == case.grid
    assert result.parent_child is not None
    assert result.parent_child.coverage_steps == team.facts.coverage_steps
    assert result.parent_child.coordination_steps == team.facts.coordination_steps


def test_a_run_that_was_not_as_planned_is_told() -> None:
    run = Played(0.2, 2.5, 5, 0, 100, 100.0, complete=True, broken=[], trace_sha256="")
    assert run.as_planned
    for wrong in (
        Played(0.2, 2.5, 5, 0, 100, 101.0, complete=True, broken=[], trace_sha256=""),
        Played(0.2, 2.5, 5, 0, 100, 100.0, complete=False, broken=[], trace_sha256=""),
        Played(0.2, 2.5, 5, 0, 100, 100.0, complete=True, broken=["physics"], trace_sha256=""),
    ):
        assert not wrong.as_planned


def test_a_part_that_is_not_there_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["paper", "parent-child", "--only", "figure9"]) == 2
    assert "--only figure9: no such part of the paper" in capsys.readouterr().err


def test_without_obstacles_the_table_is_the_papers() -> None:
    found = measure(Case(0.0, 2.5, 5, 0))
    assert (found.vertices, found.parents) == (3600, 71)


@pytest.mark.parametrize(("r_los_m", "parents"), [(1.0, 368), (2.5, 77), (7.5, 27)])
def test_parents_are_as_many_as_specified(r_los_m: float, parents: int) -> None:
    reach = Reach.of_lengths(r_los_m, 0.5)
    found = [len(choose(Case(0.2, r_los_m, 1, seed).grid, reach).parents) for seed in range(8)]
    assert mean(found) == pytest.approx(parents, rel=0.02, abs=4)


@pytest.mark.slow
def test_the_best_number_of_children_is_that_of_the_paper() -> None:
    teams = (1, 2, 3, 5, 7, 9, 11)
    for r_los_m, best in ((1.0, {2}), (2.5, {5, 7}), (7.5, {9, 11})):
        steps = dict.fromkeys(teams, 0)
        for children, seed in product(teams, range(4)):
            found = measure(Case(0.2, r_los_m, children, seed))
            steps[children] += found.coverage + found.coordination
        assert min(teams, key=lambda team: steps[team]) in best
