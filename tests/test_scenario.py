"""The scenario: what is refused and how, overrides, defaults."""

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.errors import InputError, ScenarioError
from protocol.faults import Fault
from protocol.scenario import (
    ClockSection,
    DeviceSection,
    NaryTree,
    Scenario,
    from_tree,
    load,
    to_tree,
)

SMALL = """
algorithm = "mr-dfs"
[world]
map = "place.edges"
[team]
robots = 3
"""


def file_of(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(text, encoding="utf-8")
    return path


def tree_with(**fields: Any) -> dict[str, Any]:
    return {"algorithm": "mr-dfs", "world": {"map": "x"}, "team": {"robots": 3}, **fields}


def error_of(tree: Any) -> str:
    with pytest.raises(ScenarioError) as caught:
        from_tree(tree, "file.toml")
    message = str(caught.value)
    assert message.startswith("file.toml: ")
    assert "\n" not in message
    return message.removeprefix("file.toml: ")


def test_what_is_not_said_is_default(tmp_path: Path) -> None:
    scenario = load(file_of(tmp_path, SMALL))
    assert scenario.name == "small"
    assert scenario.seed == 0
    assert scenario.algorithm_options == {}
    assert scenario.durability == "process"
    assert scenario.team.speed == 1.0
    assert scenario.clock == ClockSection(mode="lockstep", jitter=0.0, rounds_max=10_000)
    assert (scenario.radio.reach, scenario.radio.heartbeat) == (None, None)
    assert scenario.device == DeviceSection(capacity_bytes=None)
    assert scenario.device.capacity == 888
    assert (scenario.bookkeeping.database, scenario.bookkeeping.fresh) == (None, True)
    assert scenario.network.patience_s == 5.0
    assert scenario.faults == ()


def test_a_scenario_may_have_a_name(tmp_path: Path) -> None:
    assert load(file_of(tmp_path, 'name = "mine"\n' + SMALL)).name == "mine"


def test_relative_paths_are_relative_to_the_file(tmp_path: Path) -> None:
    text = SMALL + '[bookkeeping]\ndatabase = "tags.db"\n'
    scenario = load(file_of(tmp_path, text))
    assert scenario.world.map == str(tmp_path / "place.edges")
    assert scenario.bookkeeping.database == str(tmp_path / "tags.db")
    absolute = SMALL.replace("place.edges", "/maps/place.edges")
    assert load(file_of(tmp_path, absolute)).world.map == "/maps/place.edges"


def test_an_empty_name_of_a_file_stays_empty() -> None:
    assert from_tree(tree_with(), "x").name == "scenario"


# Errors.


@pytest.mark.parametrize(
    ("change", "field", "found", "expected"),
    [
        ({"algorithm": 3}, "algorithm", "`int`", "`str`"),
        ({"team": {"robots": 0}}, "team.robots", "", ">= 1"),
        ({"team": {"robots": "many"}}, "team.robots", "`str`", "`int`"),
        ({"team": {"robots": 2.5}}, "team.robots", "`float`", "`int`"),
        ({"team": {"robots": True}}, "team.robots", "`bool`", "`int`"),
        ({"team": {}}, "team", "", "missing required field `robots`"),
        ({"team": {"robots": 3, "speed": 0}}, "team.speed", "", "> 0"),
        (
            {"team": {"robots": 3, "speed": [1.0]}},
            "team.speed",
            "[1.0]",
            "one for each of 3 robots",
        ),
        ({"team": {"robots": 3, "colour": 1}}, "team", "`colour`", "unknown field"),
        ({"teams": {"robots": 3}}, "", "`teams`", "unknown field"),
        ({"world": {}}, "world", "neither", "one of `map` and `generate`"),
        (
            {"world": {"map": "x", "generate": {"kind": "random-tree", "vertices": 3}}},
            "world",
            "both",
            "one of `map` and `generate`",
        ),
        ({"world": {"generate": {"kind": "moebius"}}}, "world.generate.kind", "'moebius'", ""),
        ({"world": {"generate": {"kind": "cave"}}}, "world.generate", "", "`vertices`"),
        (
            {"world": {"generate": {"kind": "cave", "vertices": 0}}},
            "world.generate.vertices",
            "",
            ">= 1",
        ),
        ({"world": {"map": "x", "start": "a", "starts": ["a"]}}, "world", "both", "one of `start`"),
        ({"world": {"map": "x", "starts": ["a"]}}, "world.starts", "['a']", "each of 3 robots"),
        ({"clock": {"mode": "wall"}}, "clock.mode", "'wall'", ""),
        ({"clock": {"jitter": 0.5}}, "clock.jitter", "0.5", "0 under the lockstep clock"),
        ({"clock": {"mode": "event", "jitter": 1.0}}, "clock.jitter", "", "< 1"),
        ({"clock": {"mode": "event", "jitter": -0.1}}, "clock.jitter", "", ">= 0"),
        ({"clock": {"rounds_max": 0}}, "clock.rounds_max", "", ">= 1"),
        ({"radio": {"reach": "far"}}, "radio.reach", "'far'", ""),
        ({"radio": {"heartbeat": "none"}}, "radio.heartbeat", "'none'", ""),
        ({"device": {"capacity_bytes": -1}}, "device.capacity_bytes", "", ">= 0"),
        ({"network": {"patience_s": 0.5}}, "network.patience_s", "", ">= 1"),
        ({"network": {"port": 70000}}, "network.port", "", "<= 65535"),
        ({"durability": "none"}, "durability", "'none'", ""),
        ({"seed": "x"}, "seed", "`str`", "`int`"),
        ({"faults": [{"kill": "robot:3", "at": 1}]}, "faults[0].kill", "'robot:3'", "robot:2"),
        ({"faults": [{"kill": "router", "at": 1}]}, "faults[0].kill", "'router'", "robot:2"),
        ({"faults": [{"kill": "robot:x", "at": 1}]}, "faults[0].kill", "'robot:x'", "robot:2"),
        ({"faults": [{"kill": "robot:-1", "at": 1}]}, "faults[0].kill", "'robot:-1'", "robot:2"),
        ({"faults": [{"kill": "robot:0"}]}, "faults[0]", "", "one of `at` and `at_request`"),
        (
            {
                "faults": [
                    {"kill": "robot:0", "at": 1},
                    {"kill": "robot:1", "at": 1, "at_request": 1},
                ]
            },
            "faults[1]",
            "",
            "one of `at` and `at_request`",
        ),
        ({"faults": [{"kill": "robot:0", "at": -1}]}, "faults[0].at", "", ">= 0"),
        ({"faults": [{"kill": "robot:0", "at": float("inf")}]}, "faults[0].at", "inf", "finite"),
        ({"faults": [{"kill": "robot:0", "at": float("nan")}]}, "faults[0].at", "", ">= 0"),
        ({"faults": [{"kill": "robot:0", "at": 1, "round": -1}]}, "faults[0].round", "", ">= 0"),
        ({"faults": [{"kill": "robot:0", "at_request": 0}]}, "faults[0].at_request", "", ">= 1"),
        (
            {"faults": [{"kill": "robot:0", "at_request": 1, "round": 1}]},
            "faults[0].round",
            "1",
            "no round with `at_request`",
        ),
        ({"team": {"robots": 3, "speed": float("nan")}}, "team.speed", "", "> 0"),
        ({"clock": {"mode": "event", "jitter": float("nan")}}, "clock.jitter", "", ""),
    ],
)
def test_an_error_names_field_found_and_expected(
    change: dict[str, Any], field: str, found: str, expected: str
) -> None:
    message = error_of(tree_with(**change))
    if field:
        assert f"field `{field}`" in message
    assert found.lower() in message.lower()
    assert expected.lower() in message.lower()


@pytest.mark.parametrize("speed", [float("inf"), [1.0, float("inf"), 1.0]])
def test_a_speed_is_finite(speed: Any) -> None:
    message = error_of(tree_with(team={"robots": 3, "speed": speed}, clock={"mode": "event"}))
    assert "field `team.speed`: found" in message


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"team": {"robots": 0}}, "0"),
        ({"team": {"robots": "many"}}, "'many'"),
        ({"faults": [{"kill": "robot:0", "at": -1.5}]}, "-1.5"),
    ],
)
def test_an_error_of_type_or_range_says_what_was_found(change: dict[str, Any], found: str) -> None:
    assert f"found {found}" in error_of(tree_with(**change))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"clock": {"mode": "wall"}}, "event"),
        ({"radio": {"reach": "far"}}, "same-place"),
        ({"world": {"generate": {"kind": "moebius"}}}, "nary-tree"),
    ],
)
def test_an_error_of_choice_says_what_is_allowed(change: dict[str, Any], expected: str) -> None:
    assert expected in error_of(tree_with(**change))


@pytest.mark.parametrize("missing", ["algorithm", "world", "team"])
def test_what_must_be_said(missing: str) -> None:
    tree = tree_with()
    del tree[missing]
    assert f"`{missing}`" in error_of(tree)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    path = tmp_path / "none.toml"
    with pytest.raises(ScenarioError, match=r"none.toml: no such file.*expected a scenario file"):
        load(path)
    with pytest.raises(ScenarioError, match="expected a scenario file"):
        load(tmp_path)


def test_a_file_that_is_no_toml(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"small.toml: not TOML: .*line 2"):
        load(file_of(tmp_path, "a = 1\nb = = 2\n"))


def test_a_file_that_is_no_text(tmp_path: Path) -> None:
    path = tmp_path / "small.toml"
    path.write_bytes(b"a = '\xff'\n")
    with pytest.raises(ScenarioError, match=r"small.toml: not UTF-8 at byte 5"):
        load(path)


@pytest.mark.parametrize(
    "text", ["world = 3", 'world = "x"', "team = []", "faults = 3", "[[world]]"]
)
def test_a_section_that_is_none(tmp_path: Path, text: str) -> None:
    with pytest.raises(ScenarioError, match=r"small.toml: "):
        load(file_of(tmp_path, f'algorithm = "mr-dfs"\n{text}\n'))


def test_every_error_is_one_of_input() -> None:
    assert issubclass(ScenarioError, InputError)


# Overrides.


def test_an_override_replaces_a_field(tmp_path: Path) -> None:
    overrides = [
        "team.robots=16",
        "seed = 9",
        "clock.mode=event",
        "clock.jitter=0.5",
        'name="other"',
        "algorithm_options.variant=paper",
        "world.start=A 7",
        'faults=[{kill = "robot:1", at = 2}]',
        "bookkeeping.fresh=false",
    ]
    scenario = load(file_of(tmp_path, SMALL), overrides)
    assert scenario.team.robots == 16
    assert scenario.seed == 9
    assert scenario.clock == ClockSection(mode="event", jitter=0.5)
    assert scenario.name == "other"
    assert scenario.algorithm_options == {"variant": "paper"}
    assert scenario.world.start == "A 7"
    assert scenario.faults == (Fault(kill="robot:1", at=2.0),)
    assert scenario.bookkeeping.fresh is False


def test_the_last_override_wins(tmp_path: Path) -> None:
    assert load(file_of(tmp_path, SMALL), ["seed=1", "seed=2"]).seed == 2


def test_a_path_of_an_override_is_relative_to_the_current_folder(tmp_path: Path) -> None:
    assert load(file_of(tmp_path, SMALL), ["world.map=here.edges"]).world.map == "here.edges"


def test_a_map_replaces_a_generator_and_the_other_way_round(tmp_path: Path) -> None:
    path = file_of(tmp_path, SMALL)
    tree = 'world.generate={kind = "nary-tree", branching = 2, radius = 3}'
    scenario = load(path, [tree])
    assert scenario.world.map is None
    assert scenario.world.generate == NaryTree(branching=2, radius=3)
    scenario = load(path, [tree, "world.map=b.edges"])
    assert (scenario.world.map, scenario.world.generate) == ("b.edges", None)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("team.robots", "--set team.robots: expected key.path=value"),
        ("=3", "--set =3: expected key.path=value"),
        ("team..robots=3", "expected key.path=value"),
        ("seed.x=3", "`seed` is no section"),
        ("algorithm.x=3", "`algorithm` is no section"),
        ("team.robots=many", "field `team.robots`"),
        ("team.robotss=3", "robotss"),
        ("tem.robots=3", "`tem`"),
        ("world=3", "field `world`"),
        ("world.map.x=3", "`map` is no section"),
    ],
)
def test_a_wrong_override_is_refused(tmp_path: Path, override: str, words: str) -> None:
    path = file_of(tmp_path, "seed = 1\n" + SMALL)
    with pytest.raises(ScenarioError) as caught:
        load(path, [override])
    assert words in str(caught.value)


# Round trips.


@given(
    robots=st.integers(1, 5),
    seed=st.integers(-5, 1 << 40),
    jitter=st.sampled_from([0.0, 0.25, "exponential"]),
    faults=st.lists(
        st.fixed_dictionaries({"at": st.floats(0, 1e9), "round": st.integers(0, 9)})
        | st.fixed_dictionaries({"at_request": st.integers(1, 99)}),
        max_size=3,
    ),
    start=st.none() | st.integers(0, 9) | st.text(max_size=3),
)
def test_a_scenario_survives_its_tree(
    robots: int, seed: int, jitter: Any, faults: list[dict[str, Any]], start: Any
) -> None:
    scenario = from_tree(
        tree_with(
            seed=seed,
            team={"robots": robots, "speed": [1.5] * robots},
            clock={"mode": "event", "jitter": jitter},
            world={"generate": {"kind": "cave", "vertices": 9, "loops": 1}, "start": start},
            faults=[{"kill": f"robot:{robots - 1}", **fault} for fault in faults],
            algorithm_options={"variant": "paper", "n": 3, "x": 0.5, "flag": True},
        ),
        "test",
    )
    assert from_tree(to_tree(scenario), "test") == scenario
    assert isinstance(scenario, Scenario)


def test_a_fault_knows_its_robot() -> None:
    assert Fault(kill="robot:12", at=0.0).robot == 12
