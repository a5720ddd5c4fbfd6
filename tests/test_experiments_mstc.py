"""The experiments on offline coverage: their statistics, and that they play."""

import json
from pathlib import Path

import pytest

from deploy.cli import main
from experiments import command, mstc
from experiments.mstc import Input, Times, coverage_times, plan_of, rows_of, t_test


@pytest.mark.parametrize(
    ("differences", "p"),
    [
        # By hand: t = 3.4641 with 4, t = 1.7321 with 2, t = 0 with 3 degrees of freedom; with 2 the
        # distribution is known in closed form: 1 - t / sqrt(2 + t * t).
        ([1.0, 2.0, 3.0], 1 - 12**0.5 / (2 + 12) ** 0.5),
        ([0.0, 1.0, 2.0], 1 - 3**0.5 / (2 + 3) ** 0.5),
        ([-1.0, 1.0, 2.0, -2.0], 1.0),
        ([0.0, 0.0], 1.0),
        ([2.0, 2.0], 0.0),
    ],
)
def test_p_of_a_paired_t_test(differences: list[float], p: float) -> None:
    assert t_test(differences) == pytest.approx(p, abs=1e-6)


def test_p_falls_as_the_difference_grows() -> None:
    noise = [-1.5, -0.5, 0.5, 1.5] * 10
    values = [t_test([shift + one for one in noise]) for shift in (0.0, 0.2, 0.5, 1.0, 3.0)]
    assert values == sorted(values, reverse=True)
    assert values[0] == pytest.approx(1.0)
    assert values[-1] < 1e-12


def test_rows_compare_pairs() -> None:
    inputs = [Input(0, 3, case, alpha) for alpha in (0.0, 2.0) for case in range(3)]
    times = [Times(100, 60), Times(110, 70), Times(120, 80)]
    times += [Times(50, 54), Times(55, 63), Times(60, 72)]
    (row,) = rows_of(inputs, times)
    assert (row.nb_random, row.nb, row.opt_random, row.opt) == (110, 55, 70, 63)
    assert (row.inputs, row.nb_improvement) == (3, 0.5)
    assert row.opt_improvement == pytest.approx(0.1)


def test_an_input_is_the_same_whoever_plans_it() -> None:
    one = Input(40, 5, 1, 2.0)
    assert coverage_times(one) == coverage_times(one)
    assert coverage_times(one).opt <= coverage_times(one).nb <= 2 * coverage_times(one).opt


def test_parts_cover_the_figures() -> None:
    assert {one.obstacles for one in plan_of("figure6", 1, [3])} == {80}
    assert {one.obstacles for one in plan_of("figure7", 1, [3])} == {0, 40, 80, 100, 160}
    assert plan_of("figure7", 2, [3, 4]) == plan_of("figure8", 2, [3, 4])


def test_the_command_writes_figures_and_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "WORKERS", 1)
    monkeypatch.setattr(mstc, "OBSTACLES", (0, 40))
    words = ["paper", "mstc", "--quick", "--inputs", "2", "--json", "--out", str(tmp_path)]
    assert main([*words, "--only", "figure7", "--only", "figure8"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert list(said["parts"]) == ["figure7", "figure8"]
    assert len(said["parts"]["figure7"]) == 6
    for part in said["parts"]:
        assert (tmp_path / f"{part}.png").stat().st_size > 10_000
        assert len((tmp_path / f"{part}.csv").read_text().splitlines()) == 1 + 2 * 3 * 2 * 2


def test_a_part_that_is_not_there_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["paper", "mstc", "--only", "figure9"]) == 2
    assert "--only figure9: no such part of the paper" in capsys.readouterr().err


def test_one_input_is_too_few(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["paper", "mstc", "--inputs", "1"]) == 2
    assert "--inputs: found 1" in capsys.readouterr().err
