"""The setting of a run on a grid: starts, what is filled in, what is refused, and chaos."""

from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from deploy.ground import reach_of
from deploy.setting import Setting, prepare
from protocol.errors import ScenarioError
from protocol.grid import Cell, Grid, sub_cells
from protocol.scenario import Scenario, from_tree, load, to_tree
from tests.play import grids

USER = "tests.robots:wanderer"

ROOM = """\
..........
..........
..##....#.
..##......
"""
"""Two coarse cells are not whole: that of sub-cell 2, 2 and that of 2, 8."""

GRAPH = {"generate": {"kind": "cave", "vertices": 20}}


@pytest.fixture
def room(tmp_path: Path) -> str:
    path = tmp_path / "room.txt"
    path.write_text(ROOM)
    return str(path)


def scenario_of(
    world: dict[str, Any], robots: int = 2, algorithm: str = "ormstc", **fields: Any
) -> Scenario:
    tree = {"algorithm": algorithm, "world": world, "team": {"robots": robots}, **fields}
    return from_tree(tree, "test")


def cells_of(setting: Setting) -> list[Cell]:
    assert isinstance(setting.ground, Grid)
    return [setting.ground.position(start) for start in setting.starts]


def refusal(scenario: Scenario) -> str:
    """Return why a scenario is refused: one line that begins with the field."""
    with pytest.raises(ScenarioError) as caught:
        prepare(scenario)
    said = str(caught.value)
    assert "\n" not in said
    assert said.startswith("field `")
    return said


# Starts.


@pytest.mark.parametrize("algorithm", ["ormstc", USER])
def test_each_robot_starts_where_it_is_told(algorithm: str, room: str) -> None:
    starts = [[0, 0], "1, 9", "[3,5]"]
    setting = prepare(scenario_of({"map": room, "starts": starts}, 3, algorithm))
    assert cells_of(setting) == [(0, 0), (1, 9), (3, 5)]


def test_robots_of_a_user_may_share_their_start(room: str) -> None:
    setting = prepare(scenario_of({"map": room, "start": [2, 9]}, 3, USER))
    assert cells_of(setting) == [(2, 9)] * 3
    setting = prepare(scenario_of({"map": room, "starts": ["0,0", "0,0"]}, 2, USER))
    assert cells_of(setting) == [(0, 0)] * 2


def test_starts_come_from_a_file_as_they_are_written(tmp_path: Path, room: str) -> None:
    path = tmp_path / "scenario.toml"
    path.write_text(
        'algorithm = "ormstc"\n[team]\nrobots = 2\n'
        '[world]\nmap = "room.txt"\nstarts = [[0, 4], "1, 4"]\n'
    )
    assert cells_of(prepare(load(path))) == [(0, 4), (1, 4)]
    setting = prepare(load(path, ["world.starts=[[0, 0], [1, 1]]"]))
    assert cells_of(setting) == [(0, 0), (1, 1)]
    setting = prepare(load(path, ["world.starts=random", "team.robots=5"]))
    assert len(set(cells_of(setting))) == 5


@pytest.mark.parametrize("world", [{}, {"starts": "random"}])
@pytest.mark.parametrize("algorithm", ["ormstc", USER])
def test_random_starts_come_from_the_seed(world: dict[str, Any], algorithm: str, room: str) -> None:
    drawn = [
        cells_of(prepare(scenario_of({"map": room, **world}, 5, algorithm, seed=seed)))
        for seed in (1, 1, 2)
    ]
    assert drawn[0] == drawn[1] != drawn[2]
    assert all(len(set(starts)) == 5 for starts in drawn)


def largest_part(grid: Grid, *, cells: bool) -> list[set[Cell]]:
    """Return the largest connected parts, of sub-cells; cells: of complete coarse cells only."""
    whole = grid.complete_cells() if cells else grid.free_cells()
    todo, parts = set(whole), []
    while todo:
        part, ahead = set(), [todo.pop()]
        while ahead:
            row, col = ahead.pop()
            part.add((row, col))
            around = {(row - 1, col), (row + 1, col), (row, col - 1), (row, col + 1)} & todo
            todo -= around
            ahead += around
        parts.append({one for cell in part for one in sub_cells(cell)} if cells else part)
    most = max(map(len, parts), default=0)
    return [part for part in parts if len(part) == most]


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    grids(marks=".....#"), st.sampled_from(["ormstc", USER]), st.integers(1, 6), st.integers(0, 9)
)
def test_random_starts_are_distinct_and_in_the_largest_part(
    tmp_path: Path, grid: Grid, algorithm: str, robots: int, seed: int
) -> None:
    path = tmp_path / "grid.txt"
    marks = ["#" if bit else "." for bit in grid.cells()]
    rows = ["".join(marks[at : at + grid.cols]) for at in range(0, len(marks), grid.cols)]
    path.write_text("\n".join(rows) + "\n")
    cells = algorithm == "ormstc"
    parts = largest_part(grid, cells=cells)
    scenario = scenario_of({"map": str(path)}, robots, algorithm, seed=seed)
    room = len(parts[0]) if parts else 0
    everywhere = 4 * len(grid.complete_cells()) if cells else len(grid.free_cells())
    if everywhere < robots:
        kind = "sub-cells of complete coarse cells" if cells else "free sub-cells"
        expected = f"field `team.robots`: found {robots}; there are {everywhere} {kind}"
        assert refusal(scenario) == expected
        return
    setting = prepare(scenario)
    starts = cells_of(setting)
    assert len(set(starts)) == robots
    if room < robots:  # no part holds the team, so it starts in several
        assert setting.to_cover >= room
        return
    assert any(part.issuperset(starts) for part in parts)
    assert setting.to_cover == room


PARTS = """\
..#...
..#...
.#....
#.....
"""
"""Free are the sub-cells of three coarse cells and more; two parts, each of them connected."""


@pytest.mark.parametrize(
    ("algorithm", "starts", "to_cover", "notes"),
    [
        (USER, [[0, 0], [0, 1]], 5, ("5 of 20 free sub-cells can be reached from the starts",)),
        (USER, [[3, 1], [3, 1]], 15, ("15 of 20 free sub-cells can be reached from the starts",)),
        (USER, [[0, 0], [3, 1]], 20, ()),
        (
            "ormstc",
            [[0, 0], [0, 1]],
            4,
            ("4 of 16 sub-cells of complete coarse cells can be reached from the starts",),
        ),
        (
            "ormstc",
            [[2, 2], [0, 5]],
            12,
            ("12 of 16 sub-cells of complete coarse cells can be reached from the starts",),
        ),
        ("ormstc", [[0, 0], [0, 5]], 16, ()),
    ],
)
def test_what_cannot_be_reached_is_no_task_and_is_told(
    algorithm: str, starts: Any, to_cover: int, notes: tuple[str, ...], tmp_path: Path
) -> None:
    path = tmp_path / "parts.txt"
    path.write_text(PARTS)
    setting = prepare(scenario_of({"map": str(path), "starts": starts}, 2, algorithm))
    assert (setting.to_cover, setting.notes) == (to_cover, notes)
    assert isinstance(setting.ground, Grid)
    reached = reach_of(setting.ground, cells_of(setting), cells=algorithm == "ormstc")
    assert len(reached) == to_cover


PARTLY_BLOCKED = (
    "sub-cell [3, 9] lies in a coarse cell that is partly blocked; expected one in a free coarse cell "
    "(2 x 2, aligned to even rows and columns)"
)


@pytest.mark.parametrize(
    ("world", "expected"),
    [
        (
            {"start": [2, 2]},
            "field `world.start`: sub-cell [2, 2] is blocked",
        ),
        ({"starts": [[0, 0], [3, 9]]}, f"field `world.starts[1]`: {PARTLY_BLOCKED}"),
        ({"start": "3, 9"}, f"field `world.start`: {PARTLY_BLOCKED}"),
        (
            {"starts": [[0, 0], [0, 0]]},
            "field `world.starts`: several robots start on sub-cell [0, 0]; expected one each",
        ),
        (
            {"start": "0, 1"},
            "field `world.start`: several robots start on sub-cell [0, 1]; expected one each",
        ),
        (
            {"starts": [[0, 0], [4, 0]]},
            "field `world.starts[1]`: found [4, 0], expected [row, column] within 4 x 10 sub-cells",
        ),
        (
            {"start": [0, 10]},
            "field `world.start`: found [0, 10], expected [row, column] within 4 x 10 sub-cells",
        ),
        (
            {"start": [0, -1]},
            "field `world.start`: found [0, -1], expected [row, column] within 4 x 10 sub-cells",
        ),
        (
            {"start": "7"},
            "field `world.start`: found '7', expected [row, column] within 4 x 10 sub-cells",
        ),
        (
            {"start": 7},
            "field `world.start`: found 7, expected [row, column] within 4 x 10 sub-cells",
        ),
        (
            {"starts": ["0, 0", "a, b"]},
            "field `world.starts[1]`: found 'a, b', expected [row, column] within 4 x 10 sub-cells",
        ),
    ],
)
def test_a_start_that_is_none_is_refused(world: dict[str, Any], expected: str, room: str) -> None:
    assert refusal(scenario_of({"map": room, **world})) == expected


def test_robots_of_a_user_start_wherever_it_is_free(room: str) -> None:
    assert cells_of(prepare(scenario_of({"map": room, "start": [3, 9]}, 1, USER))) == [(3, 9)]
    expected = "field `world.start`: sub-cell [3, 3] is blocked"
    assert refusal(scenario_of({"map": room, "start": [3, 3]}, 1, USER)) == expected


@pytest.mark.parametrize("world", [{"start": [0, 1]}, {"starts": [[0, 1], [0, 1]]}])
def test_where_bodies_block_each_robot_starts_on_a_sub_cell_of_its_own(
    world: dict[str, Any], room: str
) -> None:
    (field,) = world
    expected = f"field `world.{field}`: several robots start on sub-cell [0, 1]; expected one each"
    assert refusal(scenario_of({"map": room, "bodies": "block", **world}, 2, USER)) == expected
    one_each = {"map": room, "bodies": "block", "starts": [[0, 1], [0, 2]]}
    assert prepare(scenario_of(one_each, 2, USER)).scenario.world.bodies == "block"


@pytest.mark.parametrize("algorithm", ["ormstc", USER])
def test_more_robots_than_sub_cells_are_refused(algorithm: str, room: str) -> None:
    room_for = {"ormstc": 32, USER: 35}[algorithm]
    assert len(set(cells_of(prepare(scenario_of({"map": room}, room_for, algorithm))))) == room_for
    said = refusal(scenario_of({"map": room}, room_for + 1, algorithm))
    assert said.startswith(f"field `team.robots`: found {room_for + 1}; there are {room_for} ")


@pytest.mark.parametrize(
    ("world", "expected"),
    [
        ({"starts": [[0, 0]]}, r"field `world\.starts`: found .*expected one for each of 2 robots"),
        ({"starts": []}, r"field `world\.starts`: found \[\], expected one for each of 2 robots"),
        ({"start": [0, 0], "starts": "random"}, r"field `world`: found 'both'"),
        ({"starts": "anywhere"}, r"field `world\.starts`: "),
        ({"start": [1, 2, 3]}, r"field `world\.start`: "),
        ({"start": [0.5, 1]}, r"field `world\.start"),
    ],
)
def test_starts_that_make_no_sense_anywhere_are_refused_on_reading(
    world: dict[str, Any], expected: str, room: str
) -> None:
    with pytest.raises(ScenarioError, match=f"^test: {expected}"):
        scenario_of({"map": room, **world})


# Grids and graphs.


def test_an_algorithm_of_ours_plays_where_it_can(room: str) -> None:
    assert refusal(scenario_of(GRAPH)) == (
        "field `algorithm`: ormstc plays on a grid, found a graph"
    )
    for name in ("mr-dfs", "MR_DFS"):
        assert refusal(scenario_of({"map": room, "ground": "grid"}, algorithm=name)) == (
            "field `algorithm`: mr-dfs plays on a graph, found a grid"
        )
    assert refusal(scenario_of({"map": room, "ground": "graph"})) == (
        "field `algorithm`: ormstc plays on a grid, found a graph"
    )
    assert refusal(scenario_of({**GRAPH, "ground": "grid"})) == (
        "field `world.ground`: found 'grid'; the map is a graph"
    )


def test_an_algorithm_of_a_user_plays_on_both(room: str) -> None:
    assert isinstance(prepare(scenario_of({"map": room}, algorithm=USER)).ground, Grid)
    assert prepare(scenario_of(GRAPH, algorithm=USER)).graph.names


@pytest.mark.parametrize(
    ("world", "fields", "field", "found"),
    [
        ({"cell_m": 0.5}, {}, "world.cell_m", "0.5"),
        ({"resolution_m": 0.5}, {}, "world.resolution_m", "0.5"),
        ({"bodies": "block"}, {}, "world.bodies", "'block'"),
        ({"starts": "random"}, {}, "world.starts", "'random'"),
        ({}, {"sensing": {"position": "odometry"}}, "sensing.position", "'odometry'"),
        (
            {},
            {"sensing": {"position": "odometry", "drift": 0.2}},
            "sensing.position",
            "'odometry'",
        ),
        ({}, {"radio": {"reach": "radius", "radius_m": 3.0}}, "radio.reach", "'radius'"),
    ],
)
@pytest.mark.parametrize("algorithm", ["mr-dfs", USER])
def test_what_is_for_grids_is_refused_on_a_graph(
    world: dict[str, Any], fields: dict[str, Any], field: str, found: str, algorithm: str
) -> None:
    said = refusal(scenario_of({**GRAPH, **world}, 2, algorithm, **fields))
    assert said == f"field `{field}`: found {found}, which is for grids only"


@pytest.mark.parametrize(
    "sensing",
    [
        {"mode": "ahead"},
        {"mode": "three"},
        {"mode": "radius", "range_m": 2.0},
        {"mode": "line-of-sight", "range_m": 2.0},
    ],
)
def test_senses_for_grids_are_refused_on_a_graph(sensing: dict[str, Any]) -> None:
    said = refusal(scenario_of(GRAPH, algorithm="mr-dfs", sensing=sensing))
    assert said == (
        f"field `sensing.mode`: found {sensing['mode']!r}, which is for a grid; the map is a graph"
    )


def test_senses_for_graphs_are_refused_on_a_grid(room: str) -> None:
    said = refusal(scenario_of({"map": room}, sensing={"mode": "ports"}))
    assert said == "field `sensing.mode`: found 'ports', which is for a graph; the map is a grid"


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"radio": {"reach": "radius"}}, r"`radio\.radius_m`: found None"),
        ({"radio": {"reach": "global", "radius_m": 2.0}}, r"`radio\.radius_m`: found 2\.0"),
        ({"radio": {"line_of_sight": True}}, r"`radio\.line_of_sight`: found True"),
        ({"radio": {"latency": float("inf")}}, r"`radio`: found inf"),
        ({"radio": {"latency": -1.0}}, r"`radio\.latency`: found -1\.0"),
        ({"radio": {"loss": 1.0}}, r"`radio\.loss`: found 1\.0"),
        ({"radio": {"duplicate": 1.0}}, r"`radio\.duplicate`: found 1\.0"),
        ({"sensing": {"mode": "radius"}}, r"`sensing\.range_m`: found None"),
        ({"sensing": {"mode": "ahead", "range_m": 2.0}}, r"`sensing\.range_m`: found 2\.0"),
        ({"sensing": {"mode": "radius", "range_m": 0.0}}, r"`sensing\.range_m`: found 0\.0"),
        ({"sensing": {"drift": 0.1}}, r"`sensing\.drift`: found 0\.1"),
        ({"sensing": {"mode": "sonar"}}, r"`sensing\.mode`: found 'sonar'; expected one of "),
        ({"chaos": {"robots": 2}}, r"`chaos\.robots`: found 2, expected at most 1"),
        ({"chaos": {"robots": 3}}, r"`chaos\.robots`: found 3, expected at most 1"),
        ({"chaos": {"robots": -1}}, r"`chaos\.robots`: found -1"),
        ({"chaos": {"robots": 1, "until": 0.0}}, r"`chaos\.until`: found 0\.0"),
        ({"chaos": {"until": float("inf")}}, r"`chaos\.until`: found inf"),
    ],
)
def test_options_that_do_not_go_together_are_refused_on_reading(
    fields: dict[str, Any], expected: str, room: str
) -> None:
    with pytest.raises(ScenarioError, match=f"^test: field {expected}") as caught:
        scenario_of({"map": room}, **fields)
    assert "\n" not in str(caught.value)


# Sizes.


@pytest.mark.parametrize("kind", ["random-obstacles", "rooms", "warehouse", "rectangles"])
def test_the_size_of_a_sub_cell_counts_for_generated_grids_too(kind: str) -> None:
    grids = []
    for world in ({}, {"cell_m": 0.25}):
        generate = {"kind": kind, "rows": 6, "cols": 12}
        setting = prepare(scenario_of({"generate": generate, **world}))
        assert isinstance(setting.ground, Grid)
        grids.append(setting.ground)
    assert [grid.cell_m for grid in grids] == [1.0, 0.25]
    assert grids[0].cells() == grids[1].cells()


def test_a_generated_grid_has_no_characters_to_be_of_a_size() -> None:
    generate = {"kind": "warehouse", "rows": 6, "cols": 12}
    assert refusal(scenario_of({"generate": generate, "resolution_m": 0.25})) == (
        "field `world.resolution_m`: found 0.25, which is for map files only; "
        "expected `world.cell_m`"
    )


def test_the_size_of_a_sub_cell_of_a_file(room: str) -> None:
    ground = prepare(scenario_of({"map": room, "cell_m": 2.0, "resolution_m": 1.0})).ground
    assert isinstance(ground, Grid)
    assert (ground.rows, ground.cols, ground.cell_m) == (2, 5, 2.0)


def test_parameters_that_give_no_grid_are_refused() -> None:
    generate = {"kind": "random-obstacles", "rows": 3, "cols": 3, "obstacles": 9}
    said = refusal(scenario_of({"generate": generate}))
    assert said == "field `world.generate`: obstacles: found 9, expected 0 to 8"


# What is filled in.


def test_what_the_paper_of_an_algorithm_assumes_is_filled_in(room: str) -> None:
    scenario = prepare(scenario_of({"map": room})).scenario
    assert (scenario.radio.reach, scenario.sensing.mode) == ("global", "ahead")
    assert scenario.device.capacity_bytes == 0
    assert scenario.device.capacity == 0


def test_for_an_algorithm_of_a_user_less_is_assumed(room: str) -> None:
    scenario = prepare(scenario_of({"map": room}, algorithm=USER)).scenario
    assert (scenario.radio.reach, scenario.sensing.mode) == ("none", "three")
    assert scenario.device.capacity == 888
    scenario = prepare(scenario_of(GRAPH, algorithm=USER)).scenario
    assert (scenario.radio.reach, scenario.sensing.mode) == ("none", "ports")


def test_on_a_graph_nothing_has_changed() -> None:
    scenario = prepare(scenario_of(GRAPH, algorithm="mr-dfs")).scenario
    assert (scenario.radio.reach, scenario.sensing.mode) == ("none", "ports")
    assert scenario.device.capacity == 888


def test_what_a_scenario_says_is_kept(room: str) -> None:
    fields: dict[str, Any] = {
        "radio": {
            "reach": "radius",
            "radius_m": 3.0,
            "line_of_sight": True,
            "latency": 0.5,
            "relay": False,
            "heartbeat": "reach",
        },
        "sensing": {
            "mode": "three",
            "map": True,
            "position": "odometry",
            "drift": 0.1,
            "reset": False,
        },
        "device": {"capacity_bytes": 17},
    }
    scenario = scenario_of({"map": room}, **fields)
    found = prepare(scenario).scenario
    assert (found.radio, found.sensing, found.device) == (
        scenario.radio,
        scenario.sensing,
        scenario.device,
    )


def test_a_setting_can_be_written_down_and_read_again(room: str) -> None:
    world = {"map": room, "starts": [[0, 0], "0, 1"], "bodies": "block"}
    scenario = prepare(scenario_of(world, chaos={"robots": 1})).scenario
    assert from_tree(to_tree(scenario), "again") == scenario


# Chaos.

SCHEDULED = [{"kill": "robot:1", "at": 3.0, "round": 1}, {"kill": "robot:0", "at_request": 4}]


def struck(mode: str, until: float | None, seed: int = 1, robots: int = 8) -> Scenario:
    chaos: dict[str, Any] = {"robots": robots - 1}
    if until is not None:
        chaos["until"] = until
    world = {"generate": {"kind": "rooms", "rows": 8, "cols": 8}}
    fields: dict[str, Any] = {"clock": {"mode": mode}, "chaos": chaos, "faults": SCHEDULED}
    return prepare(scenario_of(world, robots, seed=seed, **fields)).scenario


@pytest.mark.parametrize("mode", ["lockstep", "event"])
@pytest.mark.parametrize("until", [0.5, 1.0, 2.5, 30.0])
def test_chaos_strikes_each_victim_once_and_in_time(mode: str, until: float) -> None:
    for seed in range(20):
        scenario = struck(mode, until, seed)
        planned = from_tree({**to_tree(scenario), "faults": SCHEDULED}, "again").faults
        assert scenario.faults[:2] == planned  # the scheduled ones are kept
        drawn = scenario.faults[2:]
        assert len({fault.robot for fault in drawn}) == len(drawn) == 7
        for fault in drawn:
            assert fault.at is not None
            assert 0 <= fault.at < until
            assert mode == "event" or fault.at == int(fault.at)
            assert mode == "lockstep" or fault.round == 0
        assert not scenario.chaos.robots


@pytest.mark.parametrize("mode", ["lockstep", "event"])
def test_chaos_comes_from_the_seed(mode: str) -> None:
    assert struck(mode, 20.0) == struck(mode, 20.0)
    assert struck(mode, 20.0).faults != struck(mode, 20.0, seed=2).faults


def test_chaos_reaches_every_robot_and_both_rounds() -> None:
    world = {"generate": {"kind": "warehouse", "rows": 8, "cols": 8}}
    faults = [
        prepare(scenario_of(world, 4, seed=seed, chaos={"robots": 1})).scenario.faults[0]
        for seed in range(60)
    ]
    assert {fault.robot for fault in faults} == {0, 1, 2, 3}
    assert {fault.round for fault in faults} == {0, 1}


@pytest.mark.parametrize(
    ("fields", "cell_m", "share"),
    [
        ({}, 1.0, 100 / 4),
        ({}, 0.5, 100 / 4),  # a tick a move, whatever its length
        ({"clock": {"mode": "event"}}, 0.5, 100 * 0.5 / 4),
        ({"clock": {"mode": "event"}, "team": {"robots": 4, "speed": 2.0}}, 1.0, 100 / 8),
        (
            {"clock": {"mode": "event"}, "team": {"robots": 4, "speed": [1.0, 1.0, 2.0, 6.0]}},
            1.0,
            100 / 10,
        ),
    ],
)
def test_by_default_chaos_lasts_while_there_is_work(
    fields: dict[str, Any], cell_m: float, share: float
) -> None:
    world = {"generate": {"kind": "random-obstacles", "rows": 5, "cols": 5}, "cell_m": cell_m}
    times = []
    for seed in range(60):
        scenario = scenario_of(world, 4, **{"seed": seed, "chaos": {"robots": 3}, **fields})
        times += [fault.at for fault in prepare(scenario).scenario.faults if fault.at is not None]
    assert 0.9 * share < max(times) < share
    assert min(times) < 0.1 * share


def test_without_chaos_nothing_is_added(room: str) -> None:
    scenario = prepare(scenario_of({"map": room}, faults=SCHEDULED)).scenario
    assert len(scenario.faults) == 2
