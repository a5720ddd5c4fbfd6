"""The verdict: each check bites on a trace that breaks it, none on what robots really do."""

import traceback
from collections.abc import Callable, Iterable, Sequence
from itertools import accumulate, pairwise
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.registry import algorithm_of
from deploy.inprocess import play
from deploy.verdict.guarantees import Guarantee, Status, rules_kept
from deploy.verdict.ledger import Ledger, reachable
from deploy.verdict.result import Result, RobotError, exit_code, judge, monitors_of, observers
from protocol.errors import AlgorithmError
from protocol.graph import PortGraph
from protocol.messages import (
    AnyRequest,
    Look,
    Message,
    Move,
    Refusal,
    Stop,
    Wait,
    WaitForNews,
    Write,
)
from protocol.scenario import Scenario, from_tree
from protocol.trace import Event
from world_server.maps import generators
from world_server.maps.readers import read_graph
from world_server.terrain import GraphTerrain
from world_server.world import World

# Worlds and scenarios.


def graph_of(edges: str, vertices: int = 0) -> PortGraph:
    """Build a graph from words such as ``0-1 1-2``; vertices are called ``v0``, ``v1``, ..."""
    ends = [(int(u), int(v)) for u, v in (word.split("-") for word in edges.split())]
    count = max([vertices - 1, *(max(end) for end in ends)]) + 1
    return PortGraph([f"v{vertex}" for vertex in range(count)], ends)


def scenario_of(robots: int, **fields: Any) -> Scenario:
    tree = {"algorithm": "mr-dfs", "world": {"map": "x"}, "team": {"robots": robots}, **fields}
    return from_tree(tree, "test")


STAR = graph_of("0-1 0-2 0-3")
PATH = graph_of("0-1 1-2")
TRIANGLE = graph_of("0-1 0-2 1-2")
HIDDEN = graph_of("0-1 0-2 0-7 7-8 8-9 9-10 1-3 2-3 3-4 3-5 3-6 4-2 5-1")
"""Where the paper's robots miss an edge if two of three are lost."""


# Judging.


def ledger_of(
    graph: PortGraph, trace: Iterable[Event], starts: Sequence[int], scenario: Scenario | None
) -> Ledger:
    ledger = Ledger(graph, starts, scenario)
    for event in trace:
        ledger.observe(event)
    return ledger


def verdict(
    graph: PortGraph,
    trace: Iterable[Event],
    starts: Sequence[int],
    scenario: Scenario | None = None,
    status: Status = "over",
) -> Result:
    scenario = scenario or scenario_of(len(starts))
    ledger = ledger_of(graph, trace, starts, scenario)
    monitors = monitors_of(scenario, ledger)
    return judge(scenario, ledger, monitors, status=status, engine="test", trace_sha256="")


def by_source(result: Result) -> dict[str, Guarantee]:
    """Find a guarantee by its name, or by its number in the paper."""
    found = {guarantee.name: guarantee for guarantee in result.guarantees}
    found |= {guarantee.source.rpartition(", ")[2]: guarantee for guarantee in result.guarantees}
    return found


def broken(result: Result) -> set[str]:
    return {guarantee.name for guarantee in result.guarantees if guarantee.holds is False}


# Hand-written traces.


def walks(graph: PortGraph, start: int, *paths: Sequence[int]) -> list[Event]:
    """Let each robot take the exits of its path, one a tick, and stop."""
    trace = [Event(0.0, -1, 0, robot, start, None, Look(), 0) for robot in range(len(paths))]
    places: list[tuple[int, int | None]] = [(start, None)] * len(paths)
    for tick in range(max(map(len, paths)) + 1):
        for robot, path in enumerate(paths):
            if tick > len(path):
                continue
            place, entry = places[robot]
            request: AnyRequest = Stop()
            if tick < len(path):
                request = Move(exit=path[tick])
                places[robot] = graph.far[place][path[tick]], graph.back[place][path[tick]]
            trace.append(Event(float(tick), 0, 0, robot, place, entry, request, 0))
    return trace


def changed(event: Event, **fields: Any) -> Event:
    return msgspec.structs.replace(event, **fields)


def test_a_good_walk_keeps_every_promise() -> None:
    result = verdict(STAR, walks(STAR, 0, (0, 0, 1, 0, 2, 0)), [0])
    assert broken(result) == set()
    assert result.complete
    assert exit_code(result) == 0
    assert result.makespan == 6
    assert result.coverage_time == 5
    assert result.steps == 6
    assert (result.covered, result.to_cover, result.traversed, result.to_traverse) == (4, 4, 3, 3)
    assert {guarantee.holds for guarantee in result.guarantees} == {True, None}


EDGES = "every edge traversed"
HOME = "survivors back at the start"
LEMMA_1 = "each robot uses each edge once each way"
LEMMA_2 = "all robots finish at the same step"
THEOREM_1 = "at most 2e steps"
EXCESS = "bounded excess multiplicity"
THEOREM_2 = "T <= min(2e, (2e + 2f)/k)"
THEOREM_3 = "two robots: T <= e + r"
LOWER = "T >= max(e/k, 2r), on trees max(2e/k, 2r)"
LOSSES = "succeeds while one robot is left"
COVERED = "every vertex visited"
PHYSICS = "physics"
RULES = "no robot ended by a fault of its own"
UNCOVERED = {COVERED, EDGES}


@pytest.mark.parametrize(
    ("graph", "paths", "expected"),
    [
        (TRIANGLE, [(0, 0, 1, 0)], {EDGES}),
        (TRIANGLE, [(0, 0)], UNCOVERED),
        (PATH, [(0, 1)], {HOME}),
        (STAR, [(0, 0, 0, 0, 1, 0, 2, 0)], {LEMMA_1, THEOREM_1, THEOREM_2}),
        (STAR, [(0, 0, 0, 0)], {*UNCOVERED, LEMMA_1}),
        (STAR, [(0, 0), (1, 0, 2, 0)], {LEMMA_2}),
        (STAR, [(0, 0, 1, 0, 2, 0)] * 2, {EXCESS, THEOREM_2, THEOREM_3}),
        (STAR, [(0, 0, 1, 0, 2, 0)] * 3, {EXCESS, THEOREM_2}),
        (STAR, [(0, 0, 1, 0, 2, 0), ()], {LEMMA_2, THEOREM_2, THEOREM_3}),
    ],
)
def test_each_claim_bites(
    graph: PortGraph, paths: list[tuple[int, ...]], expected: set[str]
) -> None:
    result = verdict(graph, walks(graph, 0, *paths), [0] * len(paths))
    assert broken(result) == expected
    assert exit_code(result) == 1
    assert result.complete == expected.isdisjoint(UNCOVERED)


def test_the_lower_bound_bites_on_a_run_that_was_too_fast() -> None:
    trace = [changed(event, time=event.time / 2) for event in walks(STAR, 0, (0, 0, 1, 0, 2, 0))]
    assert broken(verdict(STAR, trace, [0])) == {LOWER, PHYSICS}
    # Without a scenario nobody knows how long a move takes.
    assert ledger_of(STAR, trace, [0], None).violations == 0


def test_losses_are_no_excuse_while_one_robot_is_left() -> None:
    trace = walks(PATH, 0, (0, 0), (0,))[:-2]  # robot 1 is lost at vertex 1
    assert (trace[-1].robot, trace[-1].time) == (0, 1)
    trace.insert(-1, Event(1.0, 0, 0, 1, 1, 0, "killed", 0))
    trace.append(Event(2.0, 0, 0, 0, 0, 0, Stop(), 0))
    result = verdict(PATH, trace, [0, 0])
    assert broken(result) == {*UNCOVERED, LOSSES}
    claims = by_source(result)
    assert claims["Lemma 2"].holds is None
    assert "robots were lost" in claims["Lemma 2"].detail
    assert claims["Theorem 3"].holds is None
    assert claims["Sec. VI"].detail == "1 of 2 robots lost, 1 left; 1 of 2 edges traversed"


def test_who_is_lost_on_its_way_has_not_crossed() -> None:
    trace = [
        Event(0.0, -1, 0, 0, 0, None, Look(), 0),
        Event(0.0, 0, 0, 0, 0, None, Move(exit=0), 0),
        Event(0.5, 0, -1, 0, None, None, "killed", 0),
    ]
    ledger = ledger_of(PATH, trace, [0], scenario_of(1))
    assert ledger.violations == 0
    assert ledger.lost == {0: (0.5, None, 0)}
    assert ledger.place(0) is None
    assert ledger.steps == 0
    assert ledger.first_visits == {0: (0, 0.0)}
    assert ledger.makespan == 0.5  # the run ended with the last robot
    arrived = [*trace[:2], Event(1.0, 0, 0, 0, 1, 0, "killed", 0)]
    ledger = ledger_of(PATH, arrived, [0], scenario_of(1))
    assert ledger.violations == 0
    assert ledger.lost == {0: (1.0, 1, None)}
    assert ledger.steps == 1
    assert ledger.first_visits == {0: (0, 0.0), 1: (0, 1.0)}
    assert ledger.first_crossings == {0: (0, 1.0)}
    result = verdict(PATH, trace, [0])
    assert broken(result) == set()  # nobody promised anything without robots
    assert not result.complete
    assert exit_code(result) == 1


# Random worlds.


@st.composite
def graphs(draw: st.DrawFn, *, tree: bool = False) -> PortGraph:
    """Draw a connected graph: a tree, with further edges, loops and parallel edges if not."""
    vertices = draw(st.integers(1, 12))
    ends = [(draw(st.integers(0, child - 1)), child) for child in range(1, vertices)]
    if not tree:
        vertex = st.integers(0, vertices - 1)
        ends += draw(st.lists(st.tuples(vertex, vertex), max_size=6))
        ends = draw(st.permutations(ends))
    return PortGraph([f"v{number}" for number in range(vertices)], ends)


CLOCKS = st.sampled_from(
    [
        {"mode": "lockstep"},
        {"mode": "event"},
        {"mode": "event", "jitter": 0.5},
        {"mode": "event", "jitter": "exponential"},
    ]
)


@st.composite
def kills(draw: st.DrawFn, robots: int) -> list[dict[str, Any]]:
    """Draw the loss of some robots, but not of all."""
    victims = draw(st.lists(st.integers(0, robots - 1), max_size=robots - 1, unique=True))
    when = st.one_of(
        st.fixed_dictionaries({"at": st.integers(0, 60).map(lambda half: half / 2)}),
        st.fixed_dictionaries(
            {"at": st.integers(0, 30).map(float), "round": st.integers(0, 3)},
        ),
        st.fixed_dictionaries({"at_request": st.integers(1, 30)}),
    )
    return [{"kill": f"robot:{victim}", **draw(when)} for victim in victims]


def trace_of(graph: PortGraph, scenario: Scenario) -> list[Event]:
    """Play a run from vertex 0 and return its trace."""
    trace: list[Event] = []
    starts = [0] * scenario.team.robots
    world = World(scenario, GraphTerrain(graph), starts, observe=trace.append)
    play(scenario, world, algorithm_of(scenario.algorithm, scenario.algorithm_options))
    return trace


# What cannot be.

GOOD = walks(PATH, 0, (0, 1, 0, 0), (0, 1, 0, 0))


def at(time: float, robot: int) -> int:
    """Find the event of a robot at a time from 1 on in `GOOD`."""
    return next(i for i, e in enumerate(GOOD) if (e.time, e.robot) == (time, robot))


def replaced(index: int, **fields: Any) -> list[Event]:
    return [*GOOD[:index], changed(GOOD[index], **fields), *GOOD[index + 1 :]]


def inserted(index: int, *events: Event) -> list[Event]:
    return [*GOOD[:index], *events, *GOOD[index:]]


def of(time: float, robot: int, what: AnyRequest | str, **fields: Any) -> Event:
    """Build an event after the stops of `GOOD`, or with the fields given."""
    event = Event(time, 0, 0, robot, 0, 0, what, 0)
    return changed(event, **fields)


BIG = Look(tag=bytes(1000))


@pytest.mark.parametrize(
    ("trace", "words"),
    [
        (replaced(at(1.0, 0), place=2, entry=0), "expected at v1, entry 0"),
        (replaced(at(1.0, 0), place=0, entry=None), "expected at v1, entry 0"),
        (replaced(at(1.0, 0), entry=1), "expected at v1, entry 0"),
        (replaced(at(1.0, 0), place=None), "expected at v1, entry 0"),
        (replaced(at(1.0, 0), place=77), "expected at v1, entry 0"),
        (replaced(0, place=1), "expected at v0, entry None"),
        (replaced(at(1.0, 0), what=Move(exit=2)), "there are ports 0 to 1"),
        (replaced(at(1.0, 0), what=Move(exit=-1)), "there are ports 0 to 1"),
        (replaced(at(1.0, 0), time=0.5), "expected t=1"),
        (replaced(at(1.0, 0), robot=5), "there are robots 0 to 1"),
        (replaced(at(1.0, 0), robot=-1), "there are robots 0 to 1"),
        ([*GOOD[:-1], of(4.0, 1, Look()), of(5.0, 1, Stop())], "expected t=4"),
        ([*GOOD[:-1], of(4.0, 1, Wait(duration=2.0)), of(5.0, 1, Stop())], "expected t=6"),
        (
            [*GOOD[:-1], of(4.0, 1, WaitForNews(at_most=0.5)), of(5.0, 1, Stop())],
            "expected t=4 to 4.5",
        ),
        (replaced(at(1.0, 0), time=0.0), "expected t=1"),
        ([*GOOD[:-3], GOOD[0]], "comes after a later event"),
        (replaced(at(2.0, 0), time=float("nan")), "comes after a later event"),
        (replaced(at(2.0, 1), round=-1), "comes after a later event"),
        (inserted(at(2.0, 1), changed(GOOD[at(2.0, 0)], wave=1)), "expected at v1, entry 1"),
        (
            [*GOOD[:2], GOOD[3], GOOD[2], *GOOD[4:]],
            "it acts after robot 1 of the same wave",
        ),
        (inserted(2, of(0.0, 0, Look(), round=-1, wave=1, entry=None)), "it acts twice in a round"),
        ([*GOOD, of(4.0, 0, Look(), round=1)], "it is out of the run"),
        ([*GOOD, of(5.0, 0, "killed")], "it was out of the run already"),
        (inserted(at(1.0, 0), of(0.5, 0, "killed", place=0, entry=None)), "expected at v1"),
        (inserted(at(1.0, 0), of(0.5, 0, "killed", place=1)), "expected from t=1"),
        (inserted(at(1.0, 0), of(1.5, 0, "killed", place=None)), "expected by t=1"),
        (inserted(2, of(0.0, 0, "killed", place=None)), "it was not on its way"),
        (inserted(at(1.0, 1), of(1.0, 1, "killed", place=1)), "losses come before the requests"),
        (replaced(0, what=BIG), "a tag of 1000 bytes; the device holds 888"),
    ],
)
def test_physics_bites(trace: list[Event], words: str) -> None:
    result = verdict(PATH, trace, [0, 0])
    claim = by_source(result)[PHYSICS]
    assert claim.holds is False
    assert words in claim.detail
    assert exit_code(result) == 1


def test_physics_lets_pass_what_can_be() -> None:
    assert by_source(verdict(PATH, GOOD, [0, 0]))[PHYSICS].holds is True
    last = at(1.0, 1)
    told = [*GOOD[:last], changed(GOOD[last], what="refused")]
    ledger = ledger_of(PATH, told, [0, 0], scenario_of(2))
    assert ledger.violations == 0  # a refusal stands in the place of the request
    assert ledger.losses[1].cause == "refused"


@given(st.data(), st.integers(1, 4), CLOCKS)
@settings(max_examples=60)
def test_no_change_of_a_real_trace_goes_unnoticed(
    data: st.DataObject, robots: int, clock: dict[str, Any]
) -> None:
    graph = data.draw(graphs())
    scenario = scenario_of(robots, clock=clock, faults=data.draw(kills(robots)))
    trace = trace_of(graph, scenario)
    assert ledger_of(graph, trace, [0] * robots, scenario).violations == 0
    index = data.draw(st.integers(0, len(trace) - 1))
    event = trace[index]
    how = data.draw(st.sampled_from(["elsewhere", "other entry", "twice", "never", "other exit"]))
    if how == "elsewhere":
        place = data.draw(st.integers(0, len(graph.names)).filter(lambda v: v != event.place))
        trace[index] = changed(event, place=place)
    elif how == "other entry":
        if event.place is not None:  # one that was lost on its way came from where it came from
            trace[index] = changed(event, entry=0 if event.entry is None else event.entry + 1)
    elif how == "twice":
        trace.insert(index, event)
    elif type(event.what) is Move:
        if how == "never":
            del trace[index]
        elif any(
            later.robot == event.robot and later.place is not None for later in trace[index + 1 :]
        ):
            trace[index] = changed(event, what=Move(exit=event.what.exit + 1))
    violations = ledger_of(graph, trace, [0] * robots, scenario).violations
    untouched = index < len(trace) and trace[index] is event and how != "twice"
    assert (violations == 0) == untouched


@pytest.mark.parametrize(
    ("clock", "speed", "duration", "possible"),
    [
        ({"mode": "event"}, 2.0, 1.5, True),
        ({"mode": "event"}, 2.0, 1.4999, False),
        ({"mode": "event", "jitter": 0.5}, 2.0, 2.25, True),
        ({"mode": "event", "jitter": 0.5}, 2.0, 0.75, True),
        ({"mode": "event", "jitter": 0.5}, 2.0, 2.26, False),
        ({"mode": "event", "jitter": "exponential"}, 2.0, 1e-9, True),
        ({"mode": "event", "jitter": "exponential"}, 2.0, 1e9, True),
        ({"mode": "lockstep"}, 2.0, 1.0, True),
        ({"mode": "lockstep"}, 2.0, 1.5, False),
    ],
)
def test_moves_take_their_time(
    clock: dict[str, Any], speed: float, duration: float, *, possible: bool
) -> None:
    graph = PortGraph(["a", "b"], [(0, 1)], [3.0])
    scenario = scenario_of(1, clock=clock, team={"robots": 1, "speed": speed})
    trace = [
        Event(0.0, -1, 0, 0, 0, None, Look(), 0),
        Event(0.0, 0, 0, 0, 0, None, Move(exit=0), 0),
        Event(duration, 0, 0, 0, 1, 0, Stop(), 0),
    ]
    assert (ledger_of(graph, trace, [0], scenario).violations == 0) == possible


# Real runs.


def played(
    graph: PortGraph, robots: int, start: int = 0, **fields: Any
) -> tuple[Result, Ledger, World]:
    scenario = scenario_of(robots, **fields)
    starts = [start] * robots
    ledger = Ledger(graph, starts, scenario)
    monitors = monitors_of(scenario, ledger)
    (observe,) = observers(ledger, monitors)
    world = World(scenario, GraphTerrain(graph), starts, observe=observe)
    algorithm = algorithm_of(scenario.algorithm, scenario.algorithm_options)
    end, failures = play(scenario, world, algorithm)
    result = judge(
        scenario,
        ledger,
        monitors,
        status=end.status,
        engine="inprocess",
        trace_sha256="",
        failures=failures,
        refusals=world.refusals,
    )
    return result, ledger, world


@given(st.data(), st.integers(1, 5), CLOCKS)
@settings(max_examples=150)
def test_nothing_is_broken_without_losses(
    data: st.DataObject, robots: int, clock: dict[str, Any]
) -> None:
    graph = data.draw(graphs(tree=data.draw(st.booleans())))
    start = data.draw(st.integers(0, len(graph.names) - 1))
    variant = data.draw(st.sampled_from(["corrected", "paper"]))
    seed = data.draw(st.integers(0, 9))
    result, _, world = played(
        graph, robots, start, clock=clock, seed=seed, algorithm_options={"variant": variant}
    )
    assert broken(result) == set(), result.guarantees
    assert exit_code(result) == 0
    claims = by_source(result)
    judged = [COVERED, RULES, PHYSICS, EDGES, HOME, LEMMA_1, THEOREM_1]
    if graph.is_tree():
        judged.append(EXCESS)
    if clock["mode"] == "lockstep":
        judged.append(LOWER)
        if graph.is_tree():
            judged += [LEMMA_2, THEOREM_2] + [THEOREM_3] * (robots == 2)
    assert [name for name in claims if claims[name].holds] == [
        name for name in claims if name in judged or claims[name].name in judged
    ]
    assert result.makespan == world.time


@given(st.data(), st.integers(2, 5), CLOCKS, st.sampled_from(["global", "reach"]))
@settings(max_examples=200)
def test_nothing_is_broken_by_losses(
    data: st.DataObject, robots: int, clock: dict[str, Any], heartbeat: str
) -> None:
    graph = data.draw(graphs(tree=data.draw(st.booleans())))
    faults = data.draw(kills(robots))
    result, _, world = played(
        graph, robots, clock=clock, faults=faults, radio={"heartbeat": heartbeat}
    )
    assert broken(result) == set(), result.guarantees
    assert result.complete
    assert by_source(result)[LOSSES].holds is (True if result.robots_lost else None)
    assert len(result.robots_lost) == len(world.struck)
    assert len(result.faults_not_struck) == len(faults) - len(world.struck)


LENGTHS = (None, 1.5, None, 1.5, 3.0, None, None, 2.25, 2.25, None)


@pytest.mark.parametrize(
    ("edges", "lengths", "robots", "fields"),
    [
        # A loss heard once must not begin two epochs.
        ("0-1", None, 2, {"faults": [{"kill": "robot:0", "at_request": 8}]}),
        # A loss heard in the answer to the last record at the start must not be forgotten.
        (
            "0-1 0-2 2-3",
            None,
            2,
            {
                "faults": [{"kill": "robot:0", "at_request": 7}],
                "clock": {"mode": "event", "jitter": "exponential"},
                "seed": 2888,
            },
        ),
        # Who arrives as the others begin anew joins them, ...
        (
            "0-1 5-7 1-3 2-10 9-7 4-8 1-8 1-6 4-7 4-8 0-2 1-9 4-5 0-4",
            None,
            6,
            {
                "faults": [
                    {"kill": "robot:0", "at": 20.0, "round": 3},
                    {"kill": "robot:1", "at": 12.0},
                ]
            },
        ),
        # ... and begins no further epoch for a loss that they began with.
        (
            "0-1 1-7 2-5 1-3 7-0 4-5 0-2 0-6 3-4 3-7",
            LENGTHS,
            5,
            {
                "faults": [{"kill": "robot:4", "at": 12.0}],
                "clock": {"mode": "event"},
                "team": {"robots": 5, "speed": [1, 0.5, 1, 3, 1]},
            },
        ),
    ],
    ids=["heard once", "heard at last", "joins", "begins none"],
)
def test_one_loss_costs_one_epoch(
    edges: str, lengths: Sequence[float | None] | None, robots: int, fields: dict[str, Any]
) -> None:
    plain = graph_of(edges)
    graph = PortGraph(plain.names, plain.ends, lengths)
    result, _, _ = played(graph, robots, **fields)
    assert broken(result) == set(), result.guarantees


@given(st.data(), st.integers(1, 5), CLOCKS)
@settings(max_examples=60)
def test_one_pass_counts_what_many_passes_count(
    data: st.DataObject, robots: int, clock: dict[str, Any]
) -> None:
    graph = data.draw(graphs())
    scenario = scenario_of(robots, clock=clock, faults=data.draw(kills(robots)))
    trace = trace_of(graph, scenario)
    ledger = ledger_of(graph, trace, [0] * robots, scenario)
    visits = [(0.0, 0, 0)]
    crossings = []
    for robot in range(robots):
        own = [event for event in trace if event.robot == robot]
        crossed = [
            (after.time, before.place, before.what.exit, after.place)
            for before, after in pairwise(own)
            if isinstance(before.what, Move) and after.place is not None
        ]
        visits += [(time, robot, place) for time, _, _, place in crossed]
        crossings += [(time, robot, graph.edge_at[u or 0][port]) for time, u, port, _ in crossed]
        track, last = ledger.robots[robot], own[-1]
        assert track.moves == len(crossed)
        assert track.requests == sum(not isinstance(event.what, str) for event in own)
        assert track.stopped_at == (last.time if isinstance(last.what, Stop) else None)
        assert ledger.place(robot) == last.place
        loss = None
        if isinstance(last.what, str):
            edge = None
            if last.place is None:
                assert isinstance(own[-2].what, Move)
                edge = graph.edge_at[own[-2].place or 0][own[-2].what.exit]
            loss = (last.time, last.place, edge)
        assert ledger.lost.get(robot) == loss
        assert track.returned_at == max([t for t, *_, place in crossed if place == 0], default=0)
    for found, expected in ((ledger.first_visits, visits), (ledger.first_crossings, crossings)):
        first: dict[int, tuple[int, float]] = {}
        for time, robot, thing in sorted(expected, key=lambda visit: visit[0]):
            first.setdefault(thing, (robot, time))
        # Of several at one time the first in the trace counts, which depends on waves.
        assert {thing: time for thing, (_, time) in found.items()} == {
            thing: time for thing, (_, time) in first.items()
        }
    assert ledger.coverage_time == max(time for _, time in ledger.first_visits.values())


@given(st.data(), st.integers(2, 5))
@settings(max_examples=40)
def test_the_tree_version_needs_no_epochs(data: st.DataObject, robots: int) -> None:
    graph = data.draw(graphs(tree=True))
    options = {"version": "tree"}
    faults = data.draw(kills(robots))
    result, _, _ = played(graph, robots, algorithm_options=options, faults=faults)
    assert broken(result) == set(), result.guarantees
    claims = by_source(result)
    assert claims["Lemma 1"].holds is True
    assert "epochs" not in claims["Lemma 1"].detail


def test_the_tree_version_promises_nothing_elsewhere() -> None:
    trace = walks(TRIANGLE, 0, (0, 0))
    scenario = scenario_of(1, algorithm_options={"version": "tree"})
    claims = by_source(verdict(TRIANGLE, trace, [0], scenario))
    assert claims[EDGES].holds is None
    assert claims["Lemma 1"].detail == "Algorithm 2 is for trees, and this is none"


def test_old_tags_cost_an_epoch() -> None:
    result, _, _ = played(TRIANGLE, 1, bookkeeping={"fresh": False})
    assert exit_code(result) == 0
    claims = by_source(result)
    assert claims["Lemma 1"].holds is True
    assert claims["Lemma 1"].detail.startswith("most uses 2, allowed once in each of at most 2")
    assert result.makespan == 12
    # The paper does not speak of them.
    scenario = scenario_of(1, bookkeeping={"fresh": False}, algorithm_options={"variant": "paper"})
    trace = [of(0.0, 0, Look(), round=-1, entry=None), of(0.0, 0, Stop(), entry=None)]
    assert broken(verdict(TRIANGLE, trace, [0], scenario)) == {COVERED}


def test_starts_must_be_one() -> None:
    trace = [of(0.0, robot, Look(), round=-1, place=robot, entry=None) for robot in (0, 1)]
    claims = by_source(verdict(PATH, trace, [0, 1], status="stalled"))
    assert claims["Lemma 1"].holds is None
    assert claims["Lemma 1"].detail == "the robots start at different vertices"


def test_epochs_that_nobody_can_count_break_no_bound() -> None:
    trace = walks(STAR, 0, (0, 0, 0, 0, 1, 0, 2, 0))
    reach = scenario_of(1, radio={"heartbeat": "reach"})
    claims = by_source(verdict(STAR, trace, [0], reach))
    assert claims["Lemma 1"].holds is None
    assert 'heartbeat "reach"' in claims["Lemma 1"].detail
    assert claims["at most 2e steps"].holds is None
    paper = scenario_of(1, radio={"heartbeat": "reach"}, algorithm_options={"variant": "paper"})
    assert LEMMA_1 in broken(verdict(STAR, trace, [0], paper))


# The paper's claims where they fail, and the specification's numbers.


def test_lemma_2_is_not_judged_on_graphs() -> None:
    graph = graph_of("0-1 0-2 1-2 1-3 2-3")
    result, ledger, _ = played(graph, 4, algorithm_options={"variant": "paper"})
    assert [track.stopped_at for track in ledger.robots] == [6, 6, 4, 4]
    claim = by_source(result)["Lemma 2"]
    assert claim.holds is None
    assert "docs/findings.md" in claim.detail
    assert claim.detail.endswith("last arrivals at the start at 4 to 6")
    assert exit_code(result) == 0
    result, ledger, _ = played(graph, 4)  # early robots wait, and finish no later for it
    assert {track.stopped_at for track in ledger.robots} == {6}
    assert [track.returned_at for track in ledger.robots] == [6, 6, 4, 4]


@pytest.mark.parametrize("when", [{"at": 6.0, "round": 1}, {"at": 6.5}])
def test_two_losses_hide_an_edge_from_the_papers_robots(when: dict[str, Any]) -> None:
    faults = [{"kill": f"robot:{robot}", **when} for robot in (0, 1)]
    result, ledger, _ = played(HIDDEN, 3, faults=faults, algorithm_options={"variant": "paper"})
    assert not result.complete
    assert exit_code(result) == 1
    assert broken(result) == {COVERED, EDGES, LOSSES}
    (missing,) = set(range(len(HIDDEN.ends))) - set(ledger.first_crossings)
    assert HIDDEN.ends[missing] == (3, 6)
    assert result.makespan == 12
    result, ledger, _ = played(HIDDEN, 3, faults=faults)
    assert exit_code(result) == 0
    assert result.makespan == 38
    assert by_source(result)[LOSSES].holds is True
    if when["at"] == 6.5:
        assert all(place is None for _, place, _ in ledger.lost.values())


@pytest.mark.parametrize(
    ("graph", "makespans"),
    [
        (generators.nary_tree(7, 5), {15: 2628}),
        (generators.nary_tree(2, 12), {4: 4096, 6: 2752}),
        (generators.hash_tree(1000), {1: 2000, 2: 1002, 3: 672, 5: 414, 20: 138}),
        (generators.grid(10, 10), {1: 360, 2: 236, 3: 194, 4: 152, 8: 112}),
        (generators.complete(10), {1: 90, 2: 52, 3: 42, 4: 32, 8: 24}),
        (generators.cycle(9), {1: 18, 2: 10, 3: 10}),
    ],
    ids=["7-ary", "2-ary", "hash", "grid", "complete", "cycle"],
)
def test_the_numbers_of_the_specification(graph: PortGraph, makespans: dict[int, int]) -> None:
    for robots, makespan in makespans.items():
        result, ledger, _ = played(graph, robots)
        assert result.makespan == makespan
        assert exit_code(result) == 0
        if graph.is_tree():  # Lemma 4
            assert result.steps == robots * makespan
            assert result.steps == 2 * len(graph.ends) + 2 * ledger.excess


@pytest.mark.parametrize(
    ("file", "start", "ticks", "units"),
    [
        ("rmf/office", "L1:39", {1: 60, 2: 34, 8: 20}, {2: 117.742, 8: 54.796}),
        ("rmf/clinic", "L1:363", {2: 112, 4: 68}, {2: 602.254, 4: 389.748}),
        ("subt/niosh_sr_config_a", "0", {1: 34, 8: 14}, {}),
    ],
)
def test_the_numbers_on_real_maps(
    shared: Callable[..., Path],
    file: str,
    start: str,
    ticks: dict[int, int],
    units: dict[int, float],
) -> None:
    graph = read_graph(shared("maps", "graphs", *f"{file}.edges".split("/")))
    graph = graph.component(graph.vertex(start))
    for clock, expected in (("lockstep", ticks), ("event", units)):
        for robots, makespan in expected.items():
            result, _, _ = played(graph, robots, graph.vertex(start), clock={"mode": clock})
            assert result.makespan == pytest.approx(makespan, rel=1e-6)
            assert exit_code(result) == 0


# The result.


def test_the_result_is_json_as_promised() -> None:
    result, _, _ = played(HIDDEN, 3, name="hidden", faults=[{"kill": "robot:1", "at": 6.5}])
    tree = msgspec.json.decode(msgspec.json.encode(result))
    promised = (
        "scenario algorithm engine seed robots robots_lost complete covered to_cover coverage_time "
        "makespan steps guarantees trace_sha256 restarts device_bytes_max per_robot durability "
        "wall_s status stalled errors faults_not_struck"
    )
    assert set(promised.split()) <= set(tree)
    assert tree["scenario"] == "hidden"
    assert tree["robots_lost"] == [1]
    assert tree["device_bytes_max"] > 0
    assert set(tree["guarantees"][0]) == {"name", "source", "holds", "detail"}
    first, second, _ = tree["per_robot"]
    assert first["place"] == "v0"
    assert first["stopped_at"] == tree["makespan"]
    assert (first["lost_at"], first["lost_by"]) == (None, None)
    assert (second["place"], second["lost_at"], second["lost_by"]) == (None, 6.5, "killed")
    assert sum(robot["first_visits"] for robot in tree["per_robot"]) == 11
    assert sum(robot["moves"] for robot in tree["per_robot"]) == tree["steps"]
    assert msgspec.json.decode(msgspec.json.encode(result), type=Result) == result


def test_a_stalled_run_says_who_waits_where() -> None:
    trace = walks(PATH, 0, (0, 0), (0,))
    last = trace[-2]
    assert (last.robot, last.place) == (1, 1)
    trace[-2] = changed(last, what=WaitForNews())
    result = verdict(PATH, trace, [0, 0], status="stalled")
    assert [(waiting.robot, waiting.place) for waiting in result.stalled] == [(1, "v1")]
    assert result.makespan is None
    assert not result.complete
    assert exit_code(result) == 1
    claims = by_source(result)
    assert claims[HOME].holds is False
    assert claims[HOME].detail == "robot 1 has not stopped, at v1; the run is stalled"
    assert claims[THEOREM_1].detail == "robots have not finished"
    assert {LEMMA_2, THEOREM_1, THEOREM_2, THEOREM_3} <= broken(result)


def test_errors_are_told_apart() -> None:
    scenario = scenario_of(2)
    ledger = ledger_of(PATH, GOOD, [0, 0], scenario)
    printed = 'Traceback (most recent call last):\n  File "x"\nValueError: no: such thing\n'
    result = judge(
        scenario,
        ledger,
        (),
        status="over",
        engine="test",
        trace_sha256="ab",
        wall_s=0.9,
        play_s=0.5,
        failures={1: printed},
        refusals={0: Refusal("ExitError", "exit 7")},
        restarts={"world": 2},
    )
    refused, failed = result.errors
    assert (refused.robot, refused.error, refused.detail) == (0, "ExitError", "exit 7")
    assert (failed.robot, failed.error, failed.detail) == (1, "ValueError", "no: such thing")
    assert failed.traceback == printed
    assert result.restarts == {"world": 2}
    assert result.steps_per_s == result.steps / 0.5


def traceback_of(error: BaseException, cause: BaseException | None = None) -> str:
    try:
        raise error from cause
    except type(error):
        return traceback.format_exc()


@pytest.mark.parametrize(
    ("text", "error", "detail"),
    [
        (traceback_of(ValueError("no good\nsecond line")), "ValueError", "no good second line"),
        (
            traceback_of(ValueError("no: good\n  second: line\n")),
            "ValueError",
            "no: good second: line",
        ),
        (traceback_of(ValueError("\nlate")), "ValueError", "late"),
        (traceback_of(SystemExit(0)), "SystemExit", "0"),
        (traceback_of(SystemExit()), "SystemExit", ""),
        (traceback_of(KeyError("mine"), ValueError("a cause")), "KeyError", "'mine'"),
        (traceback_of(AlgorithmError("mine")), "protocol.errors.AlgorithmError", "mine"),
        ("printed: this\n" + traceback_of(ValueError("a\nb")), "ValueError", "a b"),
        (traceback_of(OSError("1")) + traceback_of(ValueError("2")), "ValueError", "2"),
        ("no traceback: at all", "no traceback", "at all"),
        ("Traceback (most recent call last):\n  cut off", "  cut off", ""),
        ("", "", ""),
    ],
)
def test_an_error_is_named_and_its_message_is_one_line(text: str, error: str, detail: str) -> None:
    scenario = scenario_of(1)
    ledger = ledger_of(PATH, GOOD, [0], scenario)
    failures = {0: text}
    result = judge(
        scenario, ledger, (), status="over", engine="test", trace_sha256="ab", failures=failures
    )
    assert result.errors == [RobotError(0, error, detail, text)]


def test_algorithms_of_users_have_the_common_guarantees() -> None:
    scenario = scenario_of(1, algorithm="their_package.module:function")
    result = verdict(PATH, walks(PATH, 0, (0, 1)), [0], scenario)
    assert [guarantee.name for guarantee in result.guarantees] == [COVERED, RULES, PHYSICS]
    assert exit_code(result) == 0


def test_faults_that_never_struck_are_listed() -> None:
    faults = [
        {"kill": "robot:0", "at": 1.5},
        {"kill": "robot:0", "at": 2.0, "round": 1},
        {"kill": "robot:1", "at_request": 500},
        {"kill": "robot:2", "at_request": 3},
    ]
    result, _, world = played(HIDDEN, 3, faults=faults)
    assert world.struck == [3, 0]
    assert result.faults_not_struck == [
        "kill robot:0 at t=2, round 1",
        "kill robot:1 at request 500",
    ]


def test_only_what_can_be_reached_is_asked_for() -> None:
    graph = graph_of("0-1 2-3 2-2", vertices=5)
    assert reachable(graph, [0, 0]) == (2, 1)
    assert reachable(graph, [0, 2]) == (4, 3)
    assert exit_code(verdict(graph, walks(graph, 0, (0, 0)), [0])) == 0


# Memory.


def objects_in(thing: object, seen: set[int] | None = None) -> int:
    """Count the objects that something holds, but for what it shares with the program."""
    seen = set() if seen is None else seen
    if id(thing) in seen or isinstance(thing, type | FunctionType | ModuleType | Message):
        return 0
    seen.add(id(thing))
    inside: list[object] = []
    if isinstance(thing, dict):
        inside = [*thing.keys(), *thing.values()]
    elif isinstance(thing, list | tuple | set | frozenset):
        inside = list(thing)
    else:
        slots = [slot for kind in type(thing).__mro__ for slot in getattr(kind, "__slots__", ())]
        inside = [getattr(thing, slot) for slot in slots if hasattr(thing, slot)]
        inside += list(getattr(thing, "__dict__", {}).values())
    return 1 + sum(objects_in(part, seen) for part in inside)


def test_memory_is_bounded_by_graph_and_team() -> None:
    def there_and_back(steps: int) -> list[Event]:
        path = [0] * steps  # between the ends of the first edge
        good = walks(PATH, 0, path, path)
        # Errors must not pile up either.
        return [*good, *(of(float(steps + n), 0, Write(tag=b"x")) for n in range(1, steps))]

    def count(steps: int) -> int:
        scenario = scenario_of(2)
        ledger = ledger_of(PATH, there_and_back(steps), [0, 0], scenario)
        assert ledger.most_used()[0] == steps // 2
        assert ledger.violations == steps - 1
        return objects_in([ledger, monitors_of(scenario, ledger)])

    # Equal objects may or may not be one object: counts above 256 are, floats are not.
    few, many = count(1000), count(20_000)
    assert abs(many - few) <= 8


def test_counts_are_sums() -> None:
    graph = generators.grid(5, 5)
    result, ledger, _ = played(graph, 3)
    offsets = (0, *accumulate(map(len, graph.far)))
    assert offsets[-1] == 2 * len(graph.ends)
    assert sum(sum(track.uses.values()) for track in ledger.robots) == result.steps
    assert max(time for _, time in ledger.first_visits.values()) == result.coverage_time
    assert all(0 <= dart < offsets[-1] for track in ledger.robots for dart in track.uses)


@pytest.mark.parametrize(
    ("cause", "holds"), [("killed", True), ("refused", False), ("failed", False)]
)
def test_a_robot_that_ends_by_its_own_fault_breaks_a_guarantee(cause: str, holds: bool) -> None:
    lost = Event(0.0, 0, 0, 1, 0, None, cause, 0)
    ledger = Ledger(PATH, [0, 0])
    ledger.observe(lost)
    assert rules_kept(ledger).holds is holds
