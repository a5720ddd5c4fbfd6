"""Vertices that see each other, and the weights by which parent vertices are chosen."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.planning.vertices import Views, _Choice, counts_in_sight
from deploy.cli import main
from protocol.grid import Cell, Grid
from protocol.line_of_sight import in_sight
from tests.conftest import shared
from tests.instances import read_instance
from tests.play import grids

LIMITS = (1, 2, 3, 8, 24, 60, 200)


def _squared(one: Cell, other: Cell) -> int:
    return (one[0] - other[0]) ** 2 + (one[1] - other[1]) ** 2


@given(grids(), st.sampled_from(LIMITS))
def test_all_views_at_once_are_those_of_pairs(grid: Grid, limit: int) -> None:
    views = Views(grid, limit)
    free = grid.free_cells()
    counts = counts_in_sight(grid, limit)
    for one in free:
        near = [other for other in free if _squared(one, other) <= limit]
        seen = [other for other in near if in_sight(grid, one, other)]
        assert views.seen(one) == seen
        assert counts[one] == len(seen)
    blocked = np.frombuffer(grid.cells(), np.uint8).reshape(counts.shape) != 0
    assert not counts[blocked].any()


@given(grids(rows_max=12, cols_max=12, marks=".....#"), st.sampled_from(LIMITS), st.data())
def test_weights_follow_what_is_covered(grid: Grid, limit: int, data: st.DataObject) -> None:
    """Whatever is chosen: kept up to date they are those counted anew."""
    views = Views(grid, limit)
    part = np.zeros_like(views.free)
    left = grid.reachable(grid.free_cells()[:1])
    for cell in left:
        part[cell] = True
    choice = _Choice(views, limit, part)
    while left:
        around = {
            (row, col): sum(
                (row + down, col + right) in left for down in (-1, 0, 1) for right in (-1, 0, 1)
            )
            - 1
            for row, col in left
        }
        for cell in grid.free_cells():
            seen = [other for other in views.seen(cell) if other in left]
            assert choice.weights[cell] == sum((around[other] - 9) ** 2 for other in seen)
        chosen = data.draw(st.sampled_from(sorted(left)))
        choice.choose(chosen)
        left -= set(views.seen(chosen))


# The command.


@pytest.fixture
def floor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "floor.txt").write_text("...\n.#.\n..#\n")
    return Path("floor.txt")


@pytest.mark.parametrize(
    ("name", "los_m", "squared"),
    [
        ("los_10x10", 1.0, 3),
        ("los_10x10", 1.5, 8),
        ("los_10x10", 2.5, 24),
        ("los_60x60", 2.5, 24),
        ("los_60x60", 2.51, 25),
        ("los_60x60_20pct_seed0", 1.0, 3),
        ("los_60x60_20pct_seed0", 2.5, 24),
    ],
)
def test_the_command_counts_who_sees_whom(
    floor: Path, capsys: pytest.CaptureFixture[str], name: str, los_m: float, squared: int
) -> None:
    told = read_instance(shared("spec", "instances", f"{name}.txt"))
    floor.write_text("\n".join(told.rows))
    assert main(["map", str(floor), "--resolution-m", "0.5", "--los", str(los_m), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    expected = told.expected(str(squared))
    assert facts["vertices"] == told.expect["P"]
    assert (facts["los_max"], facts["los_sum"]) == (expected["maxLOS"], expected["sumLOS"])
    assert facts["los_m"] == los_m


def test_the_command_says_who_sees_whom(floor: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["map", str(floor), "--los", "1.5"]) == 0
    # (0, 1) sees its row and, past the obstacle, (1, 0) and (1, 2); (2, 1) sees (2, 0) and (1, 0).
    assert (
        "  line of sight below 1.5 m: 7 vertices, one sees 5 at most, all together 25, "
        "each itself among them\n" in capsys.readouterr().out
    )
    assert main(["map", str(floor), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert {facts[name] for name in ("los_m", "vertices", "los_max", "los_sum")} == {None}


@pytest.mark.parametrize("los_m", ["0.5", "0.2", "-1", "inf", "nan"])
def test_the_command_refuses_what_is_no_sight(
    floor: Path, capsys: pytest.CaptureFixture[str], los_m: str
) -> None:
    assert main(["map", str(floor), "--cell-m", "0.5", f"--los={los_m}"]) == 2
    error = capsys.readouterr().err
    assert f"--los {float(los_m):g}: expected a length above 0.5, the side of a sub-cell" in error


def test_the_command_refuses_a_graph(floor: Path, capsys: pytest.CaptureFixture[str]) -> None:
    graph = floor.with_suffix(".edges")
    graph.write_text("a b\n")
    assert main(["map", str(graph), "--los", "2"]) == 2
    assert f"--los 2: {graph} is a graph, expected a grid" in capsys.readouterr().err
