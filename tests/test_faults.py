"""Faults in the words of a scenario: what is refused and how, and what chaos draws."""

from collections.abc import Callable
from itertools import groupby, pairwise
from typing import Any

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from deploy.chaos import LASTS, LATER_S, infrastructure_of
from deploy.setting import Setting, prepare
from protocol.errors import ScenarioError
from protocol.faults import FAULT_WORDS, LASTING_WORDS, TAG_WORDS, Fault, robot_of
from protocol.scenario import from_tree, to_tree

KINDS = ("robots", "infrastructure", "network", "tags")


def tree_with(*faults: dict[str, Any], **fields: Any) -> dict[str, Any]:
    """A scenario of three robots on a small tree, with these faults."""
    team = {"robots": 3, **fields.pop("team", {})}
    world = {"generate": {"kind": "nary-tree", "branching": 2, "radius": 2}}
    return {
        "algorithm": "mr-dfs",
        "world": world,
        "team": team,
        "faults": list(faults),
        **fields,
    }


def error_of(*faults: dict[str, Any], **fields: Any) -> str:
    """Return what is said of a scenario that is refused: one line, and which field."""
    with pytest.raises(ScenarioError) as caught:
        prepare(from_tree(tree_with(*faults, **fields), "file"))
    message = str(caught.value).removeprefix("file: ")
    assert message.startswith("field `"), message
    assert "\n" not in message
    return message


SEPARATE = {"network": {"router": "separate"}}
RESTART = {"team": {"on_crash": "restart"}}
ORMSTC = {
    "algorithm": "ormstc",
    "world": {"generate": {"kind": "random-obstacles", "rows": 3, "cols": 3}},
}


# Words.


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (Fault(kill="robot:1", at=3.0), "kill robot:1 at t=3"),
        (Fault(kill="robot:1", at=0.5, round=2), "kill robot:1 at t=0.5, round 2"),
        (Fault(kill="robot:1", at_request=7), "kill robot:1 at request 7"),
        (
            Fault(kill="world", at_request=7, of="robot:2"),
            "kill world at request 7 of robot:2",
        ),
        (
            Fault(pause="router", at=1.0, for_s=2.0, after_s=0.25),
            "pause router for 2 s at t=1, 0.25 s later",
        ),
        (
            Fault(partition=("robot:0", "bookkeeping"), at=1.0),
            "partition robot:0, bookkeeping for 0.5 s at t=1",
        ),
        (
            Fault(delay="robot:0", at=1.0, delay_s=0.1),
            "delay robot:0 by 0.1 s for 0.5 s at t=1",
        ),
        (Fault(skew="world", at=1.0, by_s=-60.0), "skew world by -60 s at t=1"),
        (Fault(erase_tag="A 7", at=1.0), "erase tag of A 7 at t=1"),
        (Fault(destroy_tag=(1, 2), at=1.0), "destroy tag of (1, 2) at t=1"),
        (Fault(tear="journal", at=1.0), "tear journal at t=1"),
        (Fault(flip="bookkeeping", at=1.0), "flip bookkeeping at t=1"),
    ],
)
def test_a_fault_in_words(fault: Fault, words: str) -> None:
    assert str(fault) == words
    assert words.startswith(fault.what)


def test_a_fault_says_what_it_is_and_whom_it_strikes() -> None:
    assert [Fault(**{word: "x"}).word for word in FAULT_WORDS] == list(FAULT_WORDS)  # type: ignore[arg-type]
    assert Fault(kill="robot:2").robot == 2
    assert Fault(kill="world").robot is None
    assert Fault(pause="robot:2").robot is None  # nobody is lost by it
    assert Fault(partition=("robot:1", "world")).targets == ("robot:1", "world")
    assert Fault(erase_tag=4).targets == ("4",)
    assert Fault(erase_tag=4).place == 4
    assert Fault(kill="world").place is None


def test_what_a_fault_is_triggered_by() -> None:
    assert Fault(kill="robot:2", at=1.0).trigger is None
    assert Fault(kill="robot:2", at_request=3).trigger == (2, 3)
    assert Fault(kill="world", at_request=3, of="robot:0").trigger == (0, 3)
    assert Fault(pause="robot:2", at_request=3, of="robot:0").trigger == (0, 3)


@pytest.mark.parametrize(
    ("process", "robot"),
    [
        ("robot:0", 0),
        ("robot:12", 12),
        ("robot", None),
        ("robot:", None),
        ("robot:-1", None),
        ("robot:1.0", None),
        ("world", None),
        (None, None),
    ],
)
def test_which_processes_are_robots(process: str | None, robot: int | None) -> None:
    assert robot_of(process) == robot


# What is refused.

REFUSED: list[tuple[dict[str, Any], dict[str, Any], str, str, str]] = [
    # a fault, other fields; the field that is named, what was found, what was expected
    ({"at": 1}, {}, "faults[0]", "'none'", "exactly one of kill, pause"),
    (
        {"kill": "world", "pause": "world", "at": 1},
        {},
        "faults[0]",
        "['kill', 'pause']",
        "exactly one of kill, pause",
    ),
    ({"kill": "robot:3", "at": 1}, {}, "faults[0].kill", "'robot:3'", '"robot:2", "world"'),
    ({"kill": "store", "at": 1}, {}, "faults[0].kill", "'store'", '"bookkeeping"'),
    ({"kill": "router", "at": 1}, {}, "faults[0].kill", "'router'", 'network.router = "separate"'),
    ({"pause": "router", "at": 1}, {}, "faults[0].pause", "'router'", "separate"),
    ({"skew": "robot:7", "at": 1}, {}, "faults[0].skew", "'robot:7'", '"robot:0" to "robot:2"'),
    (
        {"partition": ["robot:0", "robot:9"], "at": 1},
        {},
        "faults[0].partition",
        "'robot:9'",
        '"robot:0" to "robot:2"',
    ),
    # With an embedded router the world is what others are cut off from; else the router is.
    ({"partition": "world", "at": 1}, {}, "faults[0].partition", "'world'", '"bookkeeping"'),
    ({"delay": "router", "at": 1}, SEPARATE, "faults[0].delay", "'router'", '"world"'),
    ({"delay": "halves", "at": 1}, {}, "faults[0].delay", "'halves'", '"robot:0"'),
    ({"pause": "halves", "at": 1}, {}, "faults[0].pause", "'halves'", '"robot:0"'),
    ({"tear": "bookkeeping", "at": 1}, {}, "faults[0].tear", "'bookkeeping'", "journal"),
    ({"flip": "world", "at": 1}, {}, "faults[0].flip", "'world'", "bookkeeping"),
    ({"kill": "world"}, {}, "faults[0]", "kill world", "one of `at` and `at_request`"),
    (
        {"kill": "robot:1", "at": 1, "at_request": 1},
        {},
        "faults[0]",
        "kill robot:1",
        "one of `at` and `at_request`",
    ),
    ({"kill": "world", "at": float("inf")}, {}, "faults[0].at", "inf", "a finite time"),
    (
        {"pause": "world", "at": 1, "for_s": float("inf")},
        {},
        "faults[0].for_s",
        "inf",
        "a finite time",
    ),
    (
        {"kill": "world", "at": 1, "after_s": float("inf")},
        {},
        "faults[0].after_s",
        "inf",
        "a finite time",
    ),
    (
        {"skew": "world", "at": 1, "by_s": float("-inf")},
        {},
        "faults[0].by_s",
        "-inf",
        "a finite time",
    ),
    ({"pause": "world", "at": 1, "for_s": 0}, {}, "faults[0].for_s", "0", "> 0"),
    ({"kill": "world", "at": 1, "after_s": -1}, {}, "faults[0].after_s", "-1", ">= 0"),
    (
        {"kill": "robot:1", "at_request": 1, "round": 1},
        {},
        "faults[0].round",
        "1",
        "no round with `at_request`",
    ),
    ({"kill": "world", "at_request": 1}, {}, "faults[0].of", "'none'", '"robot:0" to "robot:2"'),
    (
        {"kill": "world", "at_request": 1, "of": "robot:3"},
        {},
        "faults[0].of",
        "'robot:3'",
        '"robot:0" to "robot:2"',
    ),
    (
        {"kill": "world", "at_request": 1, "of": "bookkeeping"},
        {},
        "faults[0].of",
        "'bookkeeping'",
        '"robot:0" to "robot:2"',
    ),
    (
        {"kill": "robot:1", "at_request": 1, "of": "robot:0"},
        {},
        "faults[0].of",
        "'robot:0'",
        "'robot:1': the loss takes the place of its request",
    ),
    (
        {"kill": "world", "at": 1, "of": "robot:0"},
        {},
        "faults[0].of",
        "'robot:0'",
        "nothing without `at_request`",
    ),
    (
        {"kill": "robot:1", "at": 1, "after_s": 0.5},
        {},
        "faults[0].after_s",
        "0.5",
        "0: this fault is part of the trace",
    ),
    (
        {"erase_tag": "0", "at": 1, "after_s": 0.5},
        {},
        "faults[0].after_s",
        "0.5",
        "0: this fault is part of the trace",
    ),
    (
        {"delay": "robot:0", "at": 1, "delay_s": 0.1, "jitter_s": 0.2},
        {},
        "faults[0].jitter_s",
        "0.2",
        "at most `delay_s`",
    ),
    # What shows only where the place is known.
    ({"erase_tag": "nowhere", "at": 1}, {}, "faults[0].erase_tag", "'nowhere'", ""),
    ({"kill": "bookkeeping", "at": 1}, ORMSTC, "faults[0].kill", "no bookkeeping", "no devices"),
    ({"flip": "bookkeeping", "at": 1}, ORMSTC, "faults[0].flip", "no bookkeeping", "no devices"),
    (
        {"partition": ["robot:0", "bookkeeping"], "at": 1},
        ORMSTC,
        "faults[0].partition",
        "no bookkeeping",
        "no devices",
    ),
    ({"corrupt_tag": [0, 0], "at": 1}, ORMSTC, "faults[0].corrupt_tag", "", "no devices"),
]


@pytest.mark.parametrize(("fault", "fields", "field", "found", "expected"), REFUSED)
def test_a_refusal_names_field_found_and_expected(
    fault: dict[str, Any], fields: dict[str, Any], field: str, found: str, expected: str
) -> None:
    message = error_of(fault, **fields)
    assert message.startswith(f"field `{field}`: ")
    assert found in message
    assert expected in message


def test_the_field_names_the_fault_that_is_wrong() -> None:
    good = {"kill": "world", "at": 1}
    assert error_of(good, good, {"kill": "world"}).startswith("field `faults[2]`: ")


def test_chaos_of_tags_needs_devices() -> None:
    assert "no devices" in error_of(chaos={"tags": 1}, **ORMSTC)


@pytest.mark.parametrize("robots", [3, 4])
def test_chaos_leaves_a_robot(robots: int) -> None:
    assert error_of(chaos={"robots": robots}).startswith("field `chaos.robots`: ")


@pytest.mark.parametrize(
    ("fault", "fields"),
    [
        ({"kill": "router", "at": 1}, SEPARATE),
        ({"pause": "router", "at_request": 3, "of": "robot:0"}, SEPARATE),
        ({"partition": ["world", "robot:0"], "at": 1}, SEPARATE),
        ({"partition": "halves", "at": 0, "after_s": 0.2}, {}),
        ({"delay": ["bookkeeping", "robot:2"], "at": 1, "delay_s": 0.0}, {}),
        ({"kill": "robot:1", "at": 1, "after_s": 0.5}, RESTART),
        ({"kill": "robot:1", "at_request": 1, "of": "robot:0"}, RESTART),
        ({"erase_tag": "0", "at_request": 2, "of": "robot:1"}, {}),
        ({"skew": "world", "at": 1, "by_s": -1e9}, {}),
        ({"tear": "journal", "at": 1, "after_s": 0.5}, {}),
    ],
)
def test_what_is_allowed_survives_its_tree(fault: dict[str, Any], fields: dict[str, Any]) -> None:
    scenario = prepare(from_tree(tree_with(fault, **fields), "file")).scenario
    assert from_tree(to_tree(scenario), "journal") == scenario


@pytest.mark.parametrize("when", [{"at": 1}, {"at_request": 1}])
@pytest.mark.parametrize("word", ["partition", "delay"])
def test_a_fault_that_strikes_nobody_is_refused(word: str, when: dict[str, Any]) -> None:
    assert f"faults[0].{word}" in error_of({word: [], **when})


def test_a_clock_is_set_to_a_number() -> None:
    assert "faults[0].by_s" in error_of({"skew": "world", "at": 1, "by_s": float("nan")})


@pytest.mark.parametrize("name", ["robot:01", "robot:\N{ARABIC-INDIC DIGIT ONE}"])
def test_a_process_has_one_name(name: str) -> None:
    assert "faults[0].pause" in error_of({"pause": name, "at": 1})


# Chaos.


@st.composite
def chaotic(draw: st.DrawFn) -> dict[str, Any]:
    """A scenario with chaos, as the tree of a file."""
    robots = draw(st.integers(1, 5))
    tree = tree_with(team={"robots": robots}, seed=draw(st.integers(0, 1 << 32)))
    tree["network"] = {
        "router": draw(st.sampled_from(["embedded", "separate"])),
        "patience_s": draw(st.sampled_from([1.0, 5.0, 60.0])),
    }
    tree["chaos"] = {kind: draw(st.integers(0, 4)) for kind in KINDS}
    tree["chaos"]["robots"] = draw(st.integers(0, robots - 1))
    if draw(st.booleans()):
        tree["chaos"]["until"] = draw(st.floats(0.5, 50.0))
    if draw(st.booleans()):
        tree["clock"] = {"mode": "event"}
    if draw(st.booleans()):
        tree |= ORMSTC
        tree["chaos"]["tags"] = 0
    return tree


def drawn(tree: dict[str, Any]) -> Setting:
    return prepare(from_tree(tree, "file"))


def kind_of(fault: Fault) -> str:
    if fault.word in TAG_WORDS:
        return "tags"
    if fault.word == "kill":
        return "infrastructure" if fault.robot is None else "robots"
    return "network"


def by_kind(setting: Setting) -> dict[str, list[Fault]]:
    return {
        kind: [fault for fault in setting.scenario.faults if kind_of(fault) == kind]
        for kind in KINDS
    }


@given(chaotic())
def test_chaos_is_as_much_as_was_asked_for_and_comes_from_the_seed(tree: dict[str, Any]) -> None:
    setting = drawn(tree)
    found = by_kind(setting)
    assert {kind: len(found[kind]) for kind in KINDS} == {
        kind: tree["chaos"][kind] for kind in KINDS
    }
    assert drawn(tree).scenario == setting.scenario
    # It is written to the journal, and read from there.
    assert from_tree(to_tree(setting.scenario), "journal") == setting.scenario
    assert not any(getattr(setting.scenario.chaos, kind) for kind in KINDS)


@given(chaotic(), st.sampled_from(KINDS))
def test_more_of_one_kind_does_not_change_the_others(tree: dict[str, Any], more: str) -> None:
    assume(more != "tags" or tree["algorithm"] == "mr-dfs")  # there must be devices
    assume(more != "robots" or tree["chaos"]["robots"] + 1 < tree["team"]["robots"])
    tree["chaos"]["until"] = 10.0
    before = by_kind(drawn(tree))
    tree["chaos"][more] += 1
    after = by_kind(drawn(tree))
    assert {kind: before[kind] for kind in KINDS if kind != more} == {
        kind: after[kind] for kind in KINDS if kind != more
    }
    if more != "robots":  # and those that there were are still the first
        assert after[more][:-1] == before[more]


@given(chaotic())
def test_faults_that_a_scenario_schedules_stand_before_those_of_chaos(tree: dict[str, Any]) -> None:
    alone = drawn(tree).scenario.faults
    tree["faults"] = [{"kill": "world", "at": 3, "after_s": 0.125}]
    assert drawn(tree).scenario.faults == (Fault(kill="world", at=3.0, after_s=0.125), *alone)


@given(chaotic(), st.integers(0, 4))
def test_chaos_kills_none_that_is_killed_already(tree: dict[str, Any], victim: int) -> None:
    robots = tree["team"]["robots"]
    assume(victim < robots and tree["chaos"]["robots"] + 1 < robots)
    tree["faults"] = [{"kill": f"robot:{victim}", "at": 3}]
    killed = [fault.robot for fault in by_kind(drawn(tree))["robots"]]
    assert killed[0] == victim
    assert len(set(killed)) == len(killed) == tree["chaos"]["robots"] + 1


@given(chaotic())
def test_chaos_keeps_its_bounds(tree: dict[str, Any]) -> None:
    setting = drawn(tree)
    scenario, found = setting.scenario, by_kind(setting)
    until = tree["chaos"].get("until", float("inf"))
    for fault in scenario.faults:
        assert fault.at is not None
        assert 0 <= fault.at <= until
        if scenario.clock.mode == "lockstep":
            assert fault.at == int(fault.at)
    assert len({fault.robot for fault in found["robots"]}) == tree["chaos"]["robots"]
    assert {fault.kill for fault in found["infrastructure"]} <= set(infrastructure_of(scenario))
    # Those of one instant come one soon after the other: at once, or while one comes back.
    for _, together in groupby(found["infrastructure"], key=lambda fault: (fault.at, fault.round)):
        later_s = [0.0, *(fault.after_s for fault in together)]
        assert all(b - a <= LATER_S + 0.001 for a, b in pairwise(later_s))
    for fault in found["network"]:
        assert fault.word in LASTING_WORDS
        # Nobody is lost by it: it passes before the patience is over.
        assert 0 < fault.for_s <= max(0.05, LASTS * scenario.network.patience_s) + 0.001
        assert 0 <= fault.after_s <= LATER_S + 0.001
        assert fault.delay_s <= 0.1
        assert fault.jitter_s <= fault.delay_s
    for fault in found["tags"]:
        assert fault.place is not None
        assert 0 <= fault.place < len(setting.graph.names)


def seeds_that(holds: Callable[[list[Fault]], bool], **chaos: int) -> int:
    """Count the seeds, of a hundred, whose faults are such."""
    trees = (tree_with(seed=seed, chaos=chaos, **SEPARATE) for seed in range(100))
    return sum(holds(list(drawn(tree).scenario.faults)) for tree in trees)


def test_chaos_strikes_everybody_in_every_way() -> None:
    """What tests of recovery rely on: all of this is drawn, and often enough."""
    words = {
        (fault.word, target.partition(":")[0])
        for seed in range(100)
        for fault in drawn(
            tree_with(seed=seed, chaos={"infrastructure": 6, "network": 6, "tags": 6}, **SEPARATE)
        ).scenario.faults
        for target in (fault.targets if fault.word not in TAG_WORDS else ("",))
    }
    assert {("kill", name) for name in ("world", "bookkeeping", "router")} <= words
    assert {("pause", name) for name in ("robot", "world", "bookkeeping", "router")} <= words
    assert {("partition", name) for name in ("robot", "bookkeeping", "halves")} <= words
    assert {("delay", name) for name in ("robot", "bookkeeping")} <= words
    assert {(word, "") for word in TAG_WORDS} <= words

    def at_once(faults: list[Fault]) -> bool:
        one, other = faults
        return (one.at, one.round, one.after_s) == (other.at, other.round, other.after_s)

    def close(faults: list[Fault]) -> bool:
        one, other = faults
        return (one.at, one.round) == (other.at, other.round) and one.after_s < other.after_s

    assert seeds_that(at_once, infrastructure=2) >= 5
    assert seeds_that(close, infrastructure=2) >= 5
