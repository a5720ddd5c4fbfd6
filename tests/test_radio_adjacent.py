"""The radio of connected teams: who hears whom, directly and by way of others.

Paper: Sinay et al. 2017, Sec. 3: robots reach each other at the same vertex and at adjacent ones. More
hops, grids, and that it can be had without relays, go beyond it. The world as a whole is compared with
a naive one, this radio included, in `test_world`.
"""

from collections.abc import Callable, Sequence
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deploy.setting import Setting, prepare
from protocol.errors import ScenarioError
from protocol.graph import PortGraph
from protocol.grid import Grid
from protocol.messages import AnyRequest, Exchange, Look, Move, Sight, Wait, WaitForNews
from protocol.scenario import from_tree
from tests.play import asking, conducted, graph_of, graphs, grids

PATH = graph_of("01 12 23 34 45 56 67")
NO_DEVICES: dict[str, Any] = {"device": {"capacity_bytes": 0}}
EVENT: dict[str, Any] = {"clock": {"mode": "event"}}

Near = Callable[[int, int], bool]


def adjacent(hops: int = 1, *, relay: bool = False, **more: Any) -> dict[str, Any]:
    return {"radio": {"reach": "adjacent", "hops": hops, "relay": relay, **more}}


def say(message: bytes) -> Exchange:
    return Exchange(None, (message,))


def wait(duration: float = 1.0) -> Wait:
    return Wait(None, (), duration)


def move(exit_: int) -> Move:
    return Move(None, (), exit_)


def at(robot: int, time: float) -> dict[str, Any]:
    return {"kill": f"robot:{robot}", "at": time}


def acted(
    ground: PortGraph | Grid, requests: Sequence[list[AnyRequest]], starts: list[int], **fields: Any
) -> list[list[Sight]]:
    """Let robots act; return what each saw, one sight after another."""
    seen: list[list[Sight]] = [[] for _ in requests]
    scripts = [asking(*each, seen=sights) for each, sights in zip(requests, seen, strict=True)]
    conducted(ground, scripts, starts=starts, **NO_DEVICES, **fields)
    return seen


def news(sights: list[Sight]) -> list[tuple[float, bytes]]:
    """Return when a robot heard what."""
    return [(sight.time, message) for sight in sights for _, message in sight.inbox]


def notices(sights: list[Sight]) -> list[tuple[float, int]]:
    """Return when a robot heard of whose loss."""
    return [(sight.time, lost) for sight in sights for lost in sight.losses]


# Reach.


def expected_hearers(sender: int, places: list[int], near: Near, relay: bool) -> set[int]:
    """Return who hears a robot, by going from robot to robot until nobody is added."""
    others = set(range(len(places))) - {sender}
    reached = {sender}
    while True:
        more = {
            other
            for other in others - reached
            if any(near(places[by], places[other]) for by in reached)
        }
        if not more:
            return reached - {sender}
        reached |= more
        if not relay:
            return reached - {sender}


def assert_hears(
    ground: PortGraph | Grid, places: list[int], hops: int, relay: bool, near: Near
) -> None:
    """Let every robot speak; all hear whom they should, once, and nobody else."""
    requests: list[list[AnyRequest]] = [
        [say(bytes([robot])), Look()] for robot, _ in enumerate(places)
    ]
    seen = acted(ground, requests, places, **adjacent(hops, relay=relay))
    robots = range(len(places))
    heard_by = {robot: expected_hearers(robot, places, near, relay) for robot in robots}
    for robot in robots:
        expected = [other for other in robots if robot in heard_by[other]]
        assert seen[robot][1].inbox == tuple((other, bytes([other])) for other in expected)


@settings(max_examples=150)
@given(graphs(vertices_max=9, extra_max=4), st.integers(1, 4), st.booleans(), st.data())
def test_who_is_so_many_edges_away_hears(
    graph: PortGraph, hops: int, relay: bool, data: st.DataObject
) -> None:
    place = st.integers(0, len(graph.names) - 1)
    places = data.draw(st.lists(place, min_size=1, max_size=7))
    distances = [graph.distances(vertex) for vertex in range(len(graph.names))]
    assert_hears(graph, places, hops, relay, lambda one, other: distances[one][other] <= hops)


def moves_between(grid: Grid, one: int, other: int, most: int) -> bool:
    """Tell whether so many moves lead from one sub-cell to another, around what is blocked."""
    reached = {grid.position(one)}
    for _ in range(most):
        steps = ((row + down, col + right) for row, col in reached for down, right in SIDES)
        reached |= {cell for cell in steps if grid.is_free(*cell)}
    return grid.position(other) in reached


SIDES = ((-1, 0), (0, 1), (1, 0), (0, -1))


@settings(max_examples=80)
@given(grids(rows_max=5, cols_max=5), st.integers(1, 4), st.booleans(), st.data())
def test_who_is_so_many_moves_away_hears(
    grid: Grid, hops: int, relay: bool, data: st.DataObject
) -> None:
    cells = st.sampled_from(grid.free_cells())
    places = [grid.place(*cell) for cell in data.draw(st.lists(cells, min_size=1, max_size=7))]
    assert_hears(
        grid, places, hops, relay, lambda one, other: moves_between(grid, one, other, hops)
    )


def test_a_message_goes_from_robot_to_robot_and_not_over_a_gap() -> None:
    listeners: list[list[AnyRequest]] = [[Look()]] * 4
    starts = [0, 1, 2, 4, 5]
    seen = acted(PATH, [[say(b"x")], *listeners], starts, **adjacent(relay=True))
    assert [bool(news(each)) for each in seen] == [False, True, True, False, False]
    seen = acted(PATH, [[say(b"x")], *listeners], starts, **adjacent(2, relay=True))
    assert [bool(news(each)) for each in seen] == [False, True, True, True, True]


def test_a_wall_is_in_the_way() -> None:
    grid = Grid.of_text(".#.\n.#.\n...")
    starts = [grid.place(0, 0), grid.place(0, 2)]
    for hops, hears in ((2, False), (5, False), (6, True)):
        seen = acted(grid, [[say(b"x")], [Look()]], starts, **adjacent(hops))
        assert bool(news(seen[1])) is hears


def test_who_has_stopped_passes_nothing_on() -> None:
    requests: list[list[AnyRequest]] = [[wait(), say(b"x")], [], [wait(2)]]
    seen = acted(PATH, requests, [0, 1, 2], **adjacent(relay=True))
    assert news(seen[2]) == []
    requests[1] = [wait(2)]
    seen = acted(PATH, requests, [0, 1, 2], **adjacent(relay=True))
    assert news(seen[2]) == [(2.0, b"x")]


# Under way.


@pytest.mark.parametrize("relay", [False, True])
def test_a_robot_under_way_is_where_it_left_from(relay: bool) -> None:
    """Robots 1 and 2 go from 1 to 2 and from 2 to 1, for longer than robot 0 waits."""
    requests: list[list[AnyRequest]] = [
        [wait(), say(b"x"), wait(2), say(b"y")],
        [move(1)],
        [move(0)],
    ]
    fields: dict[str, Any] = {"team": {"speed": [1.0, 0.5, 0.5]}, **adjacent(relay=False), **EVENT}
    seen = acted(PATH, requests, [0, 1, 2], **fields)
    assert news(seen[1]) == [(2.0, b"x")]  # it left from where it could hear
    assert news(seen[2]) == []  # it left from where it could not
    fields = {**fields, **adjacent(relay=relay)}
    heard = acted(PATH, [requests[0], [move(1), wait(2)], [move(0), wait(2)]], [0, 1, 2], **fields)
    assert [message for _, message in news(heard[2])] == ([b"x", b"y"] if relay else [b"y"])
    assert [message for _, message in news(heard[1])] == ([b"x", b"y"] if relay else [b"x"])


def test_who_is_under_way_passes_on_what_it_hears() -> None:
    requests: list[list[AnyRequest]] = [[wait(), say(b"x")], [move(1)], [wait(2)]]
    fields: dict[str, Any] = {"team": {"speed": [1.0, 0.25, 1.0]}, **EVENT}
    seen = acted(PATH, requests, [0, 1, 2], **fields, **adjacent(relay=True))
    assert news(seen[2]) == [(2.0, b"x")]


# Losses.


@pytest.mark.parametrize(
    ("heartbeat", "relay", "told"),
    [
        ("reach", False, [1]),
        ("reach", True, [1, 2]),
        ("global", False, [1, 2, 3]),
        ("global", True, [1, 2, 3]),
    ],
)
def test_who_would_have_heard_the_lost_robot_gets_notice(
    heartbeat: str, relay: bool, told: list[int]
) -> None:
    requests: list[list[AnyRequest]] = [[wait(3)]] * 4
    fields = adjacent(relay=relay, heartbeat=heartbeat)
    seen = acted(PATH, requests, [0, 1, 2, 4], faults=[at(0, 2.0)], **fields)
    assert [robot for robot, each in enumerate(seen) if notices(each)] == told


def test_a_lost_robot_passes_nothing_on() -> None:
    """Of two that are lost at one instant the first is heard by way of the second, not after it."""
    requests: list[list[AnyRequest]] = [[wait(3)]] * 3
    fields = adjacent(relay=True, heartbeat="reach")
    seen = acted(PATH, requests, [0, 1, 2], faults=[at(0, 2.0), at(1, 2.0)], **fields)
    assert notices(seen[2]) == [(3.0, 0), (3.0, 1)]
    seen = acted(PATH, requests, [0, 1, 2], faults=[at(1, 2.0), at(0, 2.0)], **fields)
    assert notices(seen[2]) == [(3.0, 1)]


def test_a_notice_wakes_who_waits_for_news() -> None:
    requests: list[list[AnyRequest]] = [[wait(3)], [WaitForNews(None, (), 9.0)]]
    fields = adjacent(heartbeat="reach")
    seen = acted(PATH, requests, [0, 1], faults=[at(0, 2.0)], **fields)
    assert notices(seen[1]) == [(2.0, 0)]


def test_a_robot_that_is_lost_under_way_falls_silent_where_it_left_from() -> None:
    requests: list[list[AnyRequest]] = [[move(1)], [wait(3)], [wait(3)]]
    fields = adjacent(heartbeat="reach")
    seen = acted(PATH, requests, [2, 1, 4], faults=[at(0, 0.5)], **EVENT, **fields)
    assert [bool(notices(each)) for each in seen] == [False, True, False]


def test_who_is_killed_before_it_asks_has_told_nothing() -> None:
    requests: list[list[AnyRequest]] = [[say(b"x")], [Look(), wait()]]
    fields = adjacent(heartbeat="reach")
    seen = acted(PATH, requests, [0, 1], faults=[{"kill": "robot:0", "at_request": 2}], **fields)
    assert (news(seen[1]), [lost for _, lost in notices(seen[1])]) == ([], [0])


# What a scenario may say.

TREE: dict[str, Any] = {"generate": {"kind": "nary-tree", "branching": 2, "radius": 3}}
CYCLE: dict[str, Any] = {"generate": {"kind": "random-graph", "vertices": 6, "edges": 9}}
ROOM: dict[str, Any] = {"generate": {"kind": "rooms", "rows": 8, "cols": 8}}


def prepared(algorithm: str = "cocta", **fields: Any) -> Setting:
    tree = {"algorithm": algorithm, "world": TREE, "team": {"robots": 3}, **fields}
    return prepare(from_tree(tree, "test"))


@pytest.mark.parametrize(
    ("radio", "said"),
    [
        ({"hops": 2}, None),  # the algorithm's reach
        ({"reach": "adjacent", "hops": 0}, "field `radio.hops`: found 0; expected `int` >= 1"),
        (
            {"reach": "global", "hops": 2},
            'field `radio.hops`: found 2, expected 1, or `reach = "adjacent"`',
        ),
        (
            {"reach": "same-place", "relay": True},
            'field `radio.relay`: found True, expected false, or `reach = "adjacent"`',
        ),
        ({"reach": "none", "relay": False}, None),
        ({"reach": "near"}, "field `radio.reach`: found 'near'; expected one of "),
        ({"reach": "adjacent", "relay": "yes"}, "field `radio.relay`: found 'yes'; expected `bool"),
        ({"heartbeat": "relay"}, "field `radio.heartbeat`: found 'relay'; expected one of"),
        (
            {"reach": "adjacent", "radius_m": 2.0},
            "field `radio.radius_m`: found 2.0, expected a length if",
        ),
    ],
)
def test_the_radio_section_is_checked(radio: dict[str, Any], said: str | None) -> None:
    tree = {"algorithm": "cocta", "world": TREE, "team": {"robots": 3}, "radio": radio}
    if said is None:
        from_tree(tree, "test")
        return
    with pytest.raises(ScenarioError) as error:
        from_tree(tree, "test")
    assert str(error.value).startswith(f"test: {said}")


@pytest.mark.parametrize("algorithm", ["ncocta", "cocta", "cocta-best"])
@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"sensing": {"map": False}}, "field `sensing.map`: found False; {} needs True"),
        (
            {"radio": {"reach": "global"}},
            "field `radio.reach`: found 'global'; {} needs 'adjacent'",
        ),
        ({"radio": {"relay": False}}, "field `radio.relay`: found False; {} needs True"),
        ({"radio": {"latency": 1.0}}, "field `radio.latency`: found 1.0; {} needs 0.0"),
        ({"radio": {"loss": 0.1}}, "field `radio.loss`: found 0.1; {} needs 0.0"),
        ({"radio": {"duplicate": 0.1}}, "field `radio.duplicate`: found 0.1; {} needs 0.0"),
        (
            {"world": {**TREE, "starts": ["0", "0", "1"]}},
            "field `world.starts`: found ('0', '0', '1'); {} needs one start: `world.start`",
        ),
        (
            {"radio": {"heartbeat": "reach"}, **EVENT},
            "field `radio.heartbeat`: found 'reach'; {} needs 'global'",
        ),
        (
            {"device": {"capacity_bytes": 10}},
            "field `device.capacity_bytes`: found 10; {} needs 0",
        ),
        (
            {"world": {**ROOM, "ground": "grid"}},
            "field `algorithm`: {} plays on a graph, found a grid",
        ),
    ],
    ids=[
        "map",
        "reach",
        "relay",
        "latency",
        "loss",
        "duplicate",
        "starts",
        "heartbeat",
        "device",
        "grid",
    ],
)
def test_what_connected_coverage_cannot_do_without(
    algorithm: str, fields: dict[str, Any], said: str
) -> None:
    with pytest.raises(ScenarioError) as error:
        prepared(algorithm, **fields)
    assert str(error.value) == said.format(algorithm)


@pytest.mark.parametrize("algorithm", ["ncocta", "cocta", "cocta-best"])
@pytest.mark.parametrize(("mode", "heartbeat"), [("lockstep", "reach"), ("event", "global")])
def test_what_connected_coverage_assumes_is_filled_in(
    algorithm: str, mode: str, heartbeat: str
) -> None:
    scenario = prepared(algorithm, clock={"mode": mode}).scenario
    radio = scenario.radio
    assert (radio.reach, radio.relay, radio.hops) == ("adjacent", True, 1)
    assert (radio.heartbeat, scenario.sensing.map) == (heartbeat, True)
    assert scenario.device.capacity == 0


def test_other_algorithms_get_no_relay_and_hear_of_losses_everywhere() -> None:
    for reach in ("adjacent", "none"):
        radio = prepared("tests.robots:wanderer", radio={"reach": reach}).scenario.radio
        assert (radio.reach, radio.relay, radio.heartbeat) == (reach, False, "global")


def test_a_beacon_that_is_heard_everywhere_will_do_in_lockstep() -> None:
    assert prepared(radio={"heartbeat": "global"}).scenario.radio.heartbeat == "global"


def test_a_graph_with_cycles_is_refused_unless_a_tree_of_it_is_asked_for() -> None:
    with pytest.raises(ScenarioError) as error:
        prepared(world=CYCLE)
    assert str(error.value) == (
        "field `world`: a graph of 6 vertices and 9 edges is no tree, which cocta covers; expected "
        '`algorithm_options.tree = "breadth-first"` for a spanning tree of it, or a tree'
    )
    for tree in ("breadth-first", "depth-first"):
        setting = prepared(world=CYCLE, algorithm_options={"tree": tree})
        assert setting.scenario.algorithm_options["tree"] == tree


@pytest.mark.parametrize(
    ("splits", "said"),
    [
        ([4], "field `algorithm_options.splits`: split heights are in 1..3, not [4]"),
        ([2, 0], "field `algorithm_options.splits`: split heights are in 1..3, not [2, 0]"),
        ([2, 3, 2], "field `algorithm_options.splits`: a split height is given twice: [3, 2, 2]"),
    ],
)
def test_split_heights_that_the_tree_does_not_have_are_refused(
    splits: list[int], said: str
) -> None:
    with pytest.raises(ScenarioError) as error:
        prepared(algorithm_options={"splits": splits})
    assert str(error.value) == said


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"splits": "most"}, "splits`: found 'most'; expected one of 'best', 'paper', a list"),
        ({"splits": 3}, "splits`: found 3; expected"),
        ({"splits": [1.5]}, "field `algorithm_options[...][0]`: expected `int`"),
        ({"splits": ["2"]}, "field `algorithm_options[...][0]`: expected `int`"),
        ({"tree": "random"}, "tree`: found 'random'; expected one of 'breadth-first', "),
        ({"split": [2]}, "Object contains unknown field `split`"),
    ],
)
def test_options_that_are_none_are_refused(options: dict[str, Any], said: str) -> None:
    with pytest.raises(ScenarioError) as error:
        prepared(algorithm_options=options)
    assert said in str(error.value)


def test_split_heights_are_planned_once_and_told_to_all() -> None:
    for splits, told in (("paper", (3,)), ((1, 3), (3, 1))):
        setting = prepared(team={"robots": 11}, algorithm_options={"splits": splits})
        options = setting.scenario.algorithm_options
        assert options == {"splits": splits, "tree": "given", "heights": told}


def test_a_plan_of_an_earlier_run_is_kept() -> None:
    best = prepared("cocta-best", team={"robots": 11}).scenario.algorithm_options
    assert best["splits"] == "best"
    again = prepared("cocta-best", team={"robots": 11}, algorithm_options=best)
    assert again.scenario.algorithm_options == best


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"load": 3}, "a load or an order is given without split heights; expected both"),
        ({"order": [2, 1]}, "a load or an order is given without split heights; expected both"),
        ({"splits": [2], "order": [5, 5]}, "the order of siblings has an unknown vertex, the root"),
        ({"splits": [2], "order": [0, 1]}, "the order of siblings has an unknown vertex, the root"),
        ({"splits": [2], "order": [9999]}, "the order of siblings has an unknown vertex, the root"),
        ({"heights": [9]}, "split heights are in 1..3, not [9]"),
    ],
)
def test_a_plan_that_is_none_is_refused(options: dict[str, Any], said: str) -> None:
    with pytest.raises(ScenarioError) as error:
        prepared("cocta-best", algorithm_options=options)
    assert str(error.value).startswith(f"field `algorithm_options.splits`: {said}")


def test_a_team_that_is_too_small_for_its_splits_is_told() -> None:
    setting = prepared(team={"robots": 2}, algorithm_options={"splits": [3, 2]})
    (note,) = setting.notes
    assert note.startswith("split heights [3, 2] are for 11 robots; with 2 the team may come to")
    assert prepared(team={"robots": 11}, algorithm_options={"splits": [3, 2]}).notes == ()
