"""The setting of a run: what fits the place and the devices, and which old tags a team can read."""

from pathlib import Path
from typing import Any, get_args

import pytest

from deploy.inprocess import run
from deploy.run_dir import RunDir
from deploy.setting import Setting, prepare
from protocol.errors import MapError, ScenarioError
from protocol.grid import Grid
from protocol.scenario import Generator, Scenario, from_tree

EDGES = "0 1\n1 2\n2 0\n1 3\n"
TWO_PARTS = "0 1\n1 2\n7 8\n8 9\n9 7\n"
TREE = {"version": "tree"}


@pytest.fixture
def place(tmp_path: Path) -> Path:
    path = tmp_path / "place.edges"
    path.write_text(EDGES)
    return path


@pytest.fixture
def two_parts(tmp_path: Path) -> Path:
    path = tmp_path / "parts.edges"
    path.write_text(TWO_PARTS)
    return path


def scenario_of(world: dict[str, Any], robots: int = 3, **fields: Any) -> Scenario:
    tree = {"algorithm": "mr-dfs", "world": world, "team": {"robots": robots}, **fields}
    return from_tree(tree, "test")


def names_of(setting: Setting) -> list[str]:
    return [setting.graph.names[start] for start in setting.starts]


# Old tags.


@pytest.fixture
def left(tmp_path: Path, place: Path) -> Path:
    """The file that a run of three robots left."""
    database = tmp_path / "left.db"
    setting = prepare(
        scenario_of({"map": str(place)}, bookkeeping={"database": str(database)}),
    )
    folder = RunDir.create(tmp_path / "earlier", "earlier")
    assert run(setting, folder, "earlier", lambda _: None) == {}
    return database


def again(place: Path, database: Path, robots: int = 3, **fields: Any) -> Scenario:
    bookkeeping = {"database": str(database), "fresh": False}
    return scenario_of({"map": str(place)}, robots, bookkeeping=bookkeeping, **fields)


@pytest.mark.parametrize("name", ["mr-dfs", "MR_DFS"])
def test_a_team_of_the_same_size_reads_old_tags(
    name: str, place: Path, left: Path, tmp_path: Path
) -> None:
    before = left.read_bytes()
    setting = prepare(again(place, left, algorithm=name))
    assert left.read_bytes() == before
    folder = RunDir.create(tmp_path / "later", "later")
    assert run(setting, folder, "later", lambda _: None) == {}


def test_the_variants_of_one_version_share_their_tags(place: Path, left: Path) -> None:
    prepare(again(place, left, algorithm_options={"variant": "paper"}))


@pytest.mark.parametrize(
    ("robots", "fields", "expected"),
    [
        (2, {}, "mr-dfs, graph version, 2 robots"),
        (4, {}, "mr-dfs, graph version, 4 robots"),
        (3, {"algorithm_options": TREE}, "mr-dfs, tree version, 3 robots"),
        (3, {"algorithm": "tests.robots:wanderer"}, "tests.robots:wanderer"),
    ],
)
def test_old_tags_of_another_format_are_refused(
    robots: int, fields: dict[str, Any], expected: str, place: Path, left: Path
) -> None:
    before = left.read_bytes()
    with pytest.raises(ScenarioError, match=r"^field `bookkeeping\.fresh`: ") as caught:
        prepare(again(place, left, robots, **fields))
    found = "holds tags of 'mr-dfs, graph version, 3 robots'"
    assert f"{found}, expected {expected!r}" in str(caught.value)
    assert left.read_bytes() == before


def test_a_team_that_starts_afresh_need_not_read_old_tags(
    place: Path, left: Path, tmp_path: Path
) -> None:
    bookkeeping = {"database": str(left), "fresh": True}
    setting = prepare(scenario_of({"map": str(place)}, 2, bookkeeping=bookkeeping))
    folder = RunDir.create(tmp_path / "later", "later")
    assert run(setting, folder, "later", lambda _: None) == {}
    prepare(again(place, left, 2))
    with pytest.raises(ScenarioError, match=r"`bookkeeping\.fresh`.*2 robots.*3 robots"):
        prepare(again(place, left, 3))


def test_what_is_no_store_is_refused(place: Path, tmp_path: Path) -> None:
    for fresh in (True, False):
        text = {"database": str(place), "fresh": fresh}
        with pytest.raises(ScenarioError, match=r"`bookkeeping\.database`.*another kind of file"):
            prepare(scenario_of({"map": str(place)}, bookkeeping=text))
    with pytest.raises(ScenarioError, match=r"`bookkeeping\.database`.*no such file"):
        prepare(again(place, tmp_path / "none.db"))
    with pytest.raises(ScenarioError, match=r"`bookkeeping\.database`.*found a folder,"):
        prepare(again(place, tmp_path))
    with pytest.raises(ScenarioError, match=r"`bookkeeping\.database`.*folder that does not exist"):
        prepare(again(place, tmp_path / "none" / "left.db"))


# Starts and components.


def test_one_component_is_played_as_it_is(place: Path) -> None:
    setting = prepare(scenario_of({"map": str(place)}))
    assert (len(setting.graph.names), len(setting.graph.ends)) == (4, 4)
    assert setting.starts == (0, 0, 0)
    assert setting.notes == ()


@pytest.mark.parametrize(
    ("start", "names", "edges"),
    [({}, ["0", "1", "2"], 2), ({"start": "8"}, ["7", "8", "9"], 3), ({"start": 9}, None, 3)],
)
def test_of_several_components_that_of_the_start_is_played(
    start: dict[str, Any], names: list[str] | None, edges: int, two_parts: Path
) -> None:
    setting = prepare(scenario_of({"map": str(two_parts), **start}))
    wanted = str(start.get("start", "0"))
    assert names_of(setting) == [wanted] * 3
    assert list(setting.graph.names) == (names or ["7", "8", "9"])
    assert len(setting.graph.ends) == edges
    note = f"the map has several components; playing the one of {wanted!r}: 3 of 6 vertices"
    assert setting.notes == (note,)


def test_each_robot_starts_where_it_is_told(two_parts: Path) -> None:
    setting = prepare(scenario_of({"map": str(two_parts), "starts": ["9", 7, "8"]}))
    assert names_of(setting) == ["9", "7", "8"]


def test_starts_in_different_components_are_refused(two_parts: Path) -> None:
    with pytest.raises(ScenarioError, match=r"^field `world\.starts\[2\]`: ") as caught:
        prepare(scenario_of({"map": str(two_parts), "starts": ["9", "7", "1"]}))
    assert "vertex '1' cannot be reached from '9'" in str(caught.value)


@pytest.mark.parametrize(
    ("world", "field"),
    [({"start": "x"}, r"world\.start"), ({"starts": ["0", "1", "x"]}, r"world\.starts\[2\]")],
)
def test_an_unknown_start_is_refused(world: dict[str, Any], field: str, place: Path) -> None:
    with pytest.raises(ScenarioError, match=rf"^field `{field}`: found 'x', .* such as '0', '1'"):
        prepare(scenario_of({"map": str(place), **world}))


def test_a_map_without_vertices_is_refused(place: Path) -> None:
    place.write_text("# nothing\n")
    with pytest.raises(MapError, match="expected at least one vertex"):
        prepare(scenario_of({"map": str(place)}))


# Devices.


@pytest.mark.parametrize(
    ("robots", "options", "needed"),
    # 1 byte for the degree 9, and 9 marks of ceil(log2(k + 2)) bits; 4 bits for an entry
    [(2, {}, 4), (3, {}, 5), (14, {}, 6), (15, {}, 7), (2, TREE, 4), (3, TREE, 5)],
)
def test_a_device_must_hold_the_tag_of_the_widest_vertex(
    robots: int, options: dict[str, Any], needed: int
) -> None:
    star = {"generate": {"kind": "nary-tree", "branching": 9, "radius": 1}}

    def prepared(capacity: int) -> Setting:
        device = {"capacity_bytes": capacity}
        return prepare(scenario_of(star, robots, device=device, algorithm_options=options))

    assert prepared(needed).graph.degree(0) == 9
    for capacity in (0, needed - 1):
        with pytest.raises(ScenarioError, match=r"^field `device\.capacity_bytes`: ") as caught:
            prepared(capacity)
        assert f"found {capacity}, expected at least {needed} for the degree 9" in str(caught.value)


def test_the_widest_vertex_counts_only_where_it_can_be_reached(tmp_path: Path) -> None:
    place = tmp_path / "far.edges"
    place.write_text("0 1\n" + "".join(f"hub leaf{leaf}\n" for leaf in range(50)))
    device = {"capacity_bytes": 2}
    assert prepare(scenario_of({"map": str(place)}, device=device)).graph.names == ("0", "1")
    with pytest.raises(ScenarioError, match="degree 50 of vertex 'hub'"):
        prepare(scenario_of({"map": str(place), "start": "hub"}, device=device))


def test_users_algorithms_need_no_device(place: Path) -> None:
    device = {"capacity_bytes": 0}
    scenario = scenario_of({"map": str(place)}, algorithm="tests.robots:wanderer", device=device)
    assert prepare(scenario).starts == (0, 0, 0)


# Generated places.

GENERATED = {
    # kind: its parameters, and how many vertices and edges they give
    "nary-tree": ({"branching": 3, "radius": 2}, 13, 12),
    "random-tree": ({"vertices": 30}, 30, 29),
    "wide-tree": ({"edges": 30}, 31, 30),
    "long-tree": ({"edges": 30}, 31, 30),
    "random-graph": ({"vertices": 20, "edges": 40}, 20, 40),
    "cave": ({"vertices": 40, "loops": 3}, 40, 42),
}


@pytest.mark.parametrize("kind", GENERATED)
def test_generated_places_come_from_the_seed(kind: str) -> None:
    parameters, vertices, edges = GENERATED[kind]
    world = {"generate": {"kind": kind, **parameters}}
    settings = [prepare(scenario_of(world, seed=seed)) for seed in (1, 1, 2)]
    first, same, other = (setting.graph for setting in settings)
    assert (len(first.names), len(first.ends)) == (vertices, edges)
    assert (first.ends, first.lengths) == (same.ends, same.lengths)
    assert kind == "nary-tree" or (first.ends, first.lengths) != (other.ends, other.lengths)
    assert settings[0].starts == (0, 0, 0)
    assert settings[0].notes == ()


GENERATED_GRIDS = {
    # kind: its parameters, and how many sub-cells there are to cover; None: what the seed gives
    "random-obstacles": ({"rows": 8, "cols": 9, "obstacles": 20}, 4 * (72 - 20)),
    "rooms": ({"rows": 12, "cols": 15}, None),
    "warehouse": ({"rows": 7, "cols": 11}, 4 * (77 - 3 * 8)),
}


@pytest.mark.parametrize("kind", GENERATED_GRIDS)
def test_generated_grids_come_from_the_seed(kind: str) -> None:
    parameters, to_cover = GENERATED_GRIDS[kind]
    world = {"generate": {"kind": kind, **parameters}}
    settings = [prepare(scenario_of(world, algorithm="ormstc", seed=seed)) for seed in (1, 1, 2)]
    first, same, other = (setting.ground for setting in settings)
    assert isinstance(first, Grid)
    assert (first.rows, first.cols) == (2 * parameters["rows"], 2 * parameters["cols"])
    assert first == same
    assert kind == "warehouse" or first != other
    assert len(first.free_cells()) == settings[0].to_cover == (to_cover or settings[0].to_cover)
    assert settings[0].starts == settings[1].starts != settings[2].starts
    assert settings[0].notes == ()


def test_rectangles_come_from_the_seed() -> None:
    world = {"generate": {"kind": "rectangles", "rows": 15, "cols": 12, "ratio": 0.25}}
    family: dict[str, Any] = {"algorithm": "parent-child", "radio": {"radius_m": 2.5}}
    settings = [prepare(scenario_of(world, **family, seed=seed)) for seed in (1, 1, 2)]
    first, same, other = (setting.ground for setting in settings)
    assert isinstance(first, Grid)
    assert (first.rows, first.cols) == (15, 12)
    assert first == same
    assert first != other
    assert len(first.free_cells()) == settings[0].to_cover <= 0.75 * 15 * 12
    assert len(set(settings[0].starts)) == 1


def test_every_kind_of_generator_is_prepared_here() -> None:
    kinds = {kind.__struct_config__.tag for kind in get_args(Generator)}
    assert kinds == {"rectangles"} | GENERATED.keys() | GENERATED_GRIDS.keys()


def test_parameters_that_give_no_graph_are_refused() -> None:
    world = {"generate": {"kind": "random-graph", "vertices": 5, "edges": 3}}
    with pytest.raises(ScenarioError, match=r"^field `world\.generate`: "):
        prepare(scenario_of(world))
