"""A grid that is played as a graph: its free sub-cells are the vertices."""

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given

from deploy.ground import graph_of
from deploy.judged import judge_journal
from deploy.setting import Setting, prepare
from protocol.errors import ScenarioError
from protocol.grid import STEPS, Cell, Grid
from protocol.scenario import from_tree
from tests.play import grids
from tests.runs import play

ROOM = """\
.#......
.#......
..##....
.###..#.
"""


@pytest.fixture
def room(tmp_path: Path) -> str:
    path = tmp_path / "room.txt"
    path.write_text(ROOM)
    return str(path)


def setting_of(room: str, algorithm: str = "mr-dfs", **fields: Any) -> Setting:
    world = {"map": room, **fields.pop("world", {})}
    tree = {"algorithm": algorithm, "world": world, "team": {"robots": 3}, **fields}
    return prepare(from_tree(tree, "test"))


@given(grids())
def test_vertices_are_free_sub_cells_and_edges_join_neighbours(grid: Grid) -> None:
    graph = graph_of(grid)
    cells = [tuple(map(int, name.split(","))) for name in graph.names]
    assert sorted(cells) == grid.free_cells()
    expected = {
        frozenset([cell, (cell[0] + down, cell[1] + right)])
        for cell in grid.free_cells()
        for down, right in STEPS
        if grid.is_free(cell[0] + down, cell[1] + right)
    }
    assert {frozenset([cells[u], cells[v]]) for u, v in graph.ends} == expected
    assert len(graph.ends) == len(expected)
    assert set(graph.lengths) <= {grid.cell_m}


@given(grids())
def test_the_largest_part_comes_first(grid: Grid) -> None:
    sizes, left = [], set(grid.free_cells())
    while left:
        part = grid.reachable([min(left)])
        sizes.append(len(part))
        left -= part
    first = graph_of(grid).component(0)
    assert len(first.names) == max(sizes)


def names_of(setting: Setting) -> list[str]:
    return [setting.graph.names[start] for start in setting.starts]


def test_an_algorithm_of_graphs_plays_on_the_largest_part(room: str) -> None:
    setting = setting_of(room)
    assert setting.scenario.world.ground == "graph"
    assert names_of(setting) == ["0,2"] * 3
    assert setting.to_cover == 6 + 6 + 4 + 3
    assert setting.notes == (
        "the map has several components; playing the one of '0,2': 19 of 24 vertices",
    )


@pytest.mark.parametrize("start", [[2, 1], "2,1"])
def test_robots_start_where_they_are_told(room: str, start: Any) -> None:
    setting = setting_of(room, world={"start": start})
    assert names_of(setting) == ["2,1"] * 3
    assert setting.to_cover == 5


@pytest.mark.parametrize("start", [(0, 1), (9, 9)])
def test_a_start_that_is_no_free_sub_cell_is_refused(room: str, start: Cell) -> None:
    with pytest.raises(ScenarioError) as error:
        setting_of(room, world={"start": list(start)})
    assert str(error.value) == (
        f"field `world.start`: found {start}, expected the name of a vertex, such as "
        "'0,2', '0,3', '0,4'"
    )


def test_edges_are_as_long_as_a_sub_cell_is_wide(room: str) -> None:
    setting = setting_of(room, world={"cell_m": 0.5, "resolution_m": 0.5})
    assert set(setting.graph.lengths) == {0.5}


def test_an_algorithm_of_a_user_plays_on_what_it_is_told(room: str) -> None:
    user = "tests.robots:wanderer"
    assert isinstance(setting_of(room, user).ground, Grid)
    assert setting_of(room, user).scenario.world.ground == "grid"
    assert setting_of(room, user, world={"ground": "graph"}).graph.names[0] == "0,2"


@pytest.mark.parametrize(
    ("algorithm", "options"),
    [
        ("mr-dfs", {}),
        ("ncocta", {"tree": "breadth-first"}),
        ("cocta", {"tree": "depth-first"}),
        ("cocta-best", {"tree": "breadth-first", "effort": 200}),
    ],
)
def test_a_building_is_covered_with_one_trace(
    algorithm: str, options: dict[str, Any], room: str, tmp_path: Path
) -> None:
    faults = [{"kill": "robot:1", "at": 6}]
    setting = setting_of(room, algorithm, algorithm_options=options, faults=faults)
    runs = [play(setting, tmp_path, engine) for engine in ("inprocess", "processes")]
    assert runs[0].trace_sha256 == runs[1].trace_sha256
    verdict = judge_journal(runs[1].folder.journal)
    assert verdict.result.complete
    assert verdict.result.robots_lost == [1]
    assert [each.name for each in verdict.result.guarantees if each.holds is False] == []
