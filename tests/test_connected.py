"""Connected coverage as robots run it: its numbers, its claims, and what becomes of it after losses.

Paper: Sinay, Agmon, Maksimov, Kraus, Peleg 2017, "Maintaining Communication in Multi-Robot Tree
Coverage". What a team does is read off the trace alone, by an `Eye`.
"""

import re
from random import Random
from typing import Any, NamedTuple
from weakref import WeakSet

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.algorithms import connected, connected_course
from agents.algorithms.connected_course import Step, first_step
from agents.algorithms.connected_options import Options, planned
from agents.algorithms.connected_regroup import status_of
from agents.algorithms.connected_rule import Team, Variant, checked_splits, ticks_taken
from agents.algorithms.connected_splits import choose_splits
from agents.planning.rooted_tree import (
    RootedTree,
    perfect_tree,
    spanning_tree,
    vertices_of_perfect,
    without,
)
from agents.registry import algorithm_of
from deploy.inprocess import play
from protocol.errors import AlgorithmError
from protocol.graph import PortGraph
from protocol.messages import Move
from protocol.trace import NOBODY, Event
from tests.play import graph_of, graphs, scenario_of, tree_of, trees
from world_server.terrain import GraphTerrain
from world_server.world import End, World

BOTH: tuple[Variant, ...] = ("ncocta", "cocta")
EVENT: dict[str, Any] = {"mode": "event"}


# What the trace says.


class Eye:
    """Follows a team by its trace, and looks at it at the end of each instant.

    Attributes:
        at: where each robot is; one under way is where it left from.
        living: who is not lost.
        visited: the vertices where somebody has been.
        apart: the instants at whose end the living were not connected.
        alone: the instants at whose end a robot was under way without contact, and who.
        late: the instants at whose end a team was apart for longer than it may be after a loss.
        losses: when robots were lost.
    """

    def __init__(self, graph: PortGraph, robots: int) -> None:
        self.at = [0] * robots
        self.living = set(range(robots))
        self.visited = {0}
        self.apart: list[float] = []
        self.alone: list[tuple[float, int]] = []
        self.late: list[float] = []
        self.losses: list[float] = []
        self._far = graph.far
        self._depths = graph.distances(0)
        self._to: dict[int, int] = {}
        self._now = 0.0
        self._highest: int | None = None  # of all who were there when losses began
        self._due = 0.0

    def __call__(self, event: Event) -> None:
        """Take in the next event."""
        if event.time != self._now:
            self.look()
            self._now = event.time
        robot = event.robot
        assert robot != NOBODY
        assert robot in self.living
        if event.place is not None:
            self._to.pop(robot, None)
            self.at[robot] = event.place
            self.visited.add(event.place)
        if isinstance(event.what, str):
            self._lose(robot)
        elif isinstance(event.what, Move):
            self._to[robot] = self._far[self.at[robot]][event.what.exit]

    def _lose(self, robot: int) -> None:
        """Note until when the team must be connected again: see `test_losses_in_lockstep`."""
        self.losses.append(self._now)
        depths = [self._depths[self._to.get(one, self.at[one])] for one in self.living]
        depths += [self._depths[self.at[one]] for one in self.living]
        if self._highest is None:
            self._highest = min(depths)
        self._due = self._now + max(depths) - self._highest + 1
        self.living.discard(robot)
        self._to.pop(robot, None)

    def look(self) -> None:
        """Judge the instant that ends."""
        whole = self.is_connected()
        if not whole:
            self.apart.append(self._now)
            if self._now > self._due:
                self.late.append(self._now)
        elif self._now > self._due:
            self._highest = None
        for robot, to in self._to.items():
            if not self._has_contact(self.at[robot], to):
                self.alone.append((self._now, robot))

    def is_connected(self) -> bool:
        """Tell whether one gets from any living robot to any other by way of places with robots."""
        places = {self.at[robot] for robot in self.living}
        ahead = [places.pop()] if places else []
        while ahead:
            near = places.intersection(self._far[ahead.pop()])
            places -= near
            ahead += near
        return not places

    def _has_contact(self, one: int, other: int) -> bool:
        ends = {one, other}
        if any(self.at[robot] in ends for robot in self.living - self._to.keys()):
            return True
        # Nobody stands there; then all must be on this edge.
        return self.living == self._to.keys() and all(
            {self.at[robot], self._to[robot]} == ends for robot in self._to
        )


class Run(NamedTuple):
    """A run of a connected team that was played to its end.

    Attributes:
        eye: what the trace says.
        world: the world in its last state.
        end: how it ended.
        failures: what went wrong with which robot.
    """

    eye: Eye
    world: World
    end: End
    failures: dict[int, str]

    def assert_complete(self) -> None:
        """All is covered, all who live are back, and no robot went wrong."""
        eye = self.eye
        assert (self.failures, self.world.refusals, self.end.status) == ({}, {}, "over")
        if eye.living:
            assert len(eye.visited) == len(self.world.tags)
            assert {eye.at[robot] for robot in eye.living} == {0}


def fields_of(algorithm: str, clock: dict[str, Any] | None = None, **more: Any) -> dict[str, Any]:
    """Return the sections of a scenario of connected coverage, with what a `Setting` fills in."""
    heartbeat = more.pop("heartbeat", "global" if clock else "reach")
    return {
        "algorithm": algorithm,
        "algorithm_options": more.pop("options", {}),
        "clock": clock or {},
        "radio": {"reach": "adjacent", "relay": True, "heartbeat": heartbeat},
        "sensing": {"mode": "ports", "map": True},
        "device": {"capacity_bytes": 0},
        **more,
    }


def run_of(graph: PortGraph, robots: int, algorithm: str, **more: Any) -> Run:
    """Play a connected team on the in-process engine; robots start at 0."""
    scenario = scenario_of(robots, **fields_of(algorithm, **more))
    eye = Eye(graph, robots)
    world = World(scenario, GraphTerrain(graph), [0] * robots, observe=eye)
    end, failures = play(
        scenario, world, algorithm_of(scenario.algorithm, scenario.algorithm_options)
    )
    eye.look()
    return Run(eye, world, end, failures)


def graph_from(tree: RootedTree) -> PortGraph:
    """Return a tree as a graph whose ports lead to the parent first, then to the children in order."""
    edges = [(parent, child) for parent, below in enumerate(tree.children) for child in below]
    return PortGraph([str(vertex) for vertex in range(len(tree))], edges)


# Numbers.

TABLE: list[tuple[int, int, int, list[int], int, int]] = [
    # arity, height, robots, split heights, NCOCTA, COCTA
    (2, 3, 7, [3], 10, 10),
    (2, 3, 11, [3, 2], 7, 7),
    (3, 7, 3, [], 6558, 3643),
    (3, 7, 16, [5], 1158, 1124),
    (3, 7, 20, [5], 1158, 999),
    (3, 7, 30, [5], 1158, 686),
    (3, 7, 57, [5], 1158, 433),
    (3, 7, 58, [7, 6], 372, 372),
    (3, 8, 16, [5], 3480, 3368),
    (3, 8, 60, [7, 6], 1122, 1101),
    (2, 8, 60, [8, 7], 136, 83),
    (2, 9, 60, [8, 7], 276, 167),
    (2, 10, 60, [8, 7], 556, 332),
    (2, 11, 60, [8, 7], 1116, 662),
    (2, 15, 30, [5], 40956, 20479),
    (2, 15, 60, [8, 7], 17916, 10562),
    (2, 15, 120, [10, 9, 8], 8668, 5571),
    (4, 8, 60, [5], 22312, 8971),
    (4, 8, 101, [7, 6], 5500, 5485),
]


def holes(arity: int, height: int, depth: int, every: int, rest: int) -> RootedTree:
    """Return a perfect tree less every so many vertices of one depth, and what is below them."""
    first, end = (vertices_of_perfect(arity, last) for last in (depth - 1, depth))
    return without(perfect_tree(arity, height), range(first + rest, end, every))


HOLES = [
    # tree, vertices, robots, NCOCTA, COCTA; split heights by the formula
    (holes(2, 10, 6, 4, 1), 1551, 60, 432, 260),
    (holes(3, 7, 5, 3, 2), 2227, 20, 807, 693),
]


def assert_takes(tree: RootedTree, robots: int, variant: str, splits: Any, ticks: int) -> None:
    """Play a run without losses: complete, connected at the end of every tick, and so long."""
    run = run_of(graph_from(tree), robots, variant, options={"splits": splits})
    run.assert_complete()
    assert run.eye.apart == []
    assert run.world.time == ticks


@pytest.mark.parametrize(
    ("arity", "height", "robots", "splits", "ncocta", "cocta"),
    [
        pytest.param(
            *row,
            marks=[pytest.mark.slow, pytest.mark.timeout(300)] if row[2] * row[4] > 15_000 else [],
            id=f"{row[0]}-ary, H = {row[1]}, k = {row[2]}",
        )
        for row in TABLE
    ],
)
def test_takes_the_ticks_of_the_table(
    arity: int, height: int, robots: int, splits: list[int], ncocta: int, cocta: int
) -> None:
    tree = perfect_tree(arity, height)
    assert_takes(tree, robots, "ncocta", splits, ncocta)
    assert_takes(tree, robots, "cocta", splits, cocta)


@pytest.mark.parametrize("row", [row for row in TABLE if 3 < row[1] < 12], ids=str)
def test_the_formula_gives_the_heights_of_the_table(row: tuple[Any, ...]) -> None:
    arity, height, robots, splits = row[:4]
    graph = graph_from(perfect_tree(arity, height))
    for variant in BOTH:
        options = planned(graph, 0, robots, Options(), variant)
        assert options.heights == tuple(splits)


def test_robots_that_are_given_no_heights_use_the_formula() -> None:
    for variant, ticks in (("ncocta", 136), ("cocta", 83)):
        assert_takes(perfect_tree(2, 8), 60, variant, "paper", ticks)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tree", "vertices", "robots", "ncocta", "cocta"), HOLES, ids=["2-ary", "3-ary"]
)
def test_takes_the_ticks_of_the_table_on_trees_with_holes(
    tree: RootedTree, vertices: int, robots: int, ncocta: int, cocta: int
) -> None:
    assert len(tree) == vertices
    assert_takes(tree, robots, "ncocta", "paper", ncocta)
    assert_takes(tree, robots, "cocta", "paper", cocta)


def test_a_robot_that_has_not_heard_of_a_loss_is_named() -> None:
    with pytest.raises(AlgorithmError, match="robot 2 has heard of a loss that robot 1 has not"):
        status_of(b"1234", 1, 2)


# Any tree, any team.


@st.composite
def some_trees(draw: st.DrawFn) -> PortGraph:
    """Draw trees: any, deep ones, wide ones, perfect ones."""
    most = draw(st.integers(0, 24))
    shape = draw(st.sampled_from(["any", "deep", "wide", "perfect"]))
    if shape == "any":
        return draw(trees(most))
    if shape == "perfect":
        arity = draw(st.integers(1, 4))
        return tree_of([child // arity for child in range(most)])
    reach = 2 if shape == "deep" else most + 1
    nearest = st.integers(0, reach)
    if shape == "deep":
        return tree_of([max(0, child - draw(nearest)) for child in range(most)])
    return tree_of([min(child, draw(st.integers(0, 2))) for child in range(most)])


def some_splits(data: st.DataObject, graph: PortGraph) -> Any:
    height = max(graph.distances(0))
    heights = st.lists(st.integers(1, height), unique=True, max_size=3) if height else st.just([])
    return data.draw(st.sampled_from(["paper", "best"]) | heights)


@settings(max_examples=150)
@given(some_trees(), st.integers(1, 14), st.sampled_from(BOTH), st.data())
def test_is_complete_connected_and_as_fast_as_the_rule(
    graph: PortGraph, robots: int, variant: Variant, data: st.DataObject
) -> None:
    """Reference: Lemmas 4.1 and 4.2."""
    splits = some_splits(data, graph)
    run = run_of(graph, robots, variant, options={"splits": splits})
    run.assert_complete()
    assert run.eye.apart == []
    tree = spanning_tree(graph, 0).tree
    heights = choose_splits(tree, robots, variant, splits)
    ticks = ticks_taken(Team(tree, robots, variant, heights), 10 * len(tree))
    assert ticks in (None, run.world.time)  # a team that is too small for its splits gathers


@settings(max_examples=100)
@given(some_trees(), st.integers(1, 10), st.sampled_from(BOTH), st.data())
def test_on_the_event_clock_nobody_leaves_without_contact(
    graph: PortGraph, robots: int, variant: Variant, data: st.DataObject
) -> None:
    splits = some_splits(data, graph)
    lengths = st.sampled_from([None, 0.5, 1.0, 3.0])
    graph = PortGraph(graph.names, graph.ends, [data.draw(lengths) for _ in graph.ends])
    jitter = data.draw(st.sampled_from([0.0, 0.5, "exponential"]))
    speed = [data.draw(st.sampled_from([0.5, 1.0, 2.0])) for _ in range(robots)]
    run = run_of(
        graph,
        robots,
        variant,
        options={"splits": splits},
        clock={**EVENT, "jitter": jitter},
        team={"speed": speed},
        seed=data.draw(st.integers(0, 1000)),
    )
    run.assert_complete()
    assert (run.eye.apart, run.eye.alone) == ([], [])


@pytest.mark.parametrize("clock", [None, EVENT], ids=["lockstep", "event"])
@pytest.mark.parametrize("variant", BOTH)
def test_small_worlds(variant: str, clock: dict[str, Any] | None) -> None:
    for robots in (1, 2, 9):
        run = run_of(PortGraph(["0"], []), robots, variant, clock=clock)
        run.assert_complete()
        assert run.world.time == 0
        run_of(graph_of("01"), robots, variant, clock=clock).assert_complete()  # more than vertices
    alone = run_of(graph_of("01 02 13 14"), 1, variant, clock=clock)
    alone.assert_complete()
    assert alone.world.time == 8  # there and back on each edge


# Graphs with cycles.


def test_a_graph_with_cycles_is_refused_by_each_robot() -> None:
    run = run_of(graph_of("01 12 20"), 3, "cocta")
    assert [*run.failures] == [0, 1, 2]
    for said in run.failures.values():
        assert 'expected `algorithm_options.tree = "breadth-first"`, or a tree' in said


@settings(max_examples=80)
@given(
    graphs(vertices_max=12, extra_max=8),
    st.integers(1, 8),
    st.sampled_from(BOTH),
    st.sampled_from(["breadth-first", "depth-first"]),
    st.booleans(),
)
def test_a_spanning_tree_of_a_graph_will_do(
    graph: PortGraph, robots: int, variant: str, tree: str, later: bool
) -> None:
    clock = EVENT if later else None
    run = run_of(graph, robots, variant, options={"tree": tree}, clock=clock)
    run.assert_complete()
    assert (run.eye.apart, run.eye.alone if later else []) == ([], [])


# Losses.


class Lost(NamedTuple):
    """A run with losses, as drawn from a seed.

    Attributes:
        graph: a tree.
        robots: how many there are.
        algorithm: what they run.
        more: the other fields.
    """

    graph: PortGraph
    robots: int
    algorithm: str
    more: dict[str, Any]


def with_losses(seed: int, most: int = 40, robots_most: int = 15) -> Lost:
    """Draw a tree, a team, and the deaths of some of it, though not of all."""
    rng = Random(f"losses {seed}")
    vertices = rng.randrange(1, most)
    shape = rng.randrange(4)
    parents = [
        (rng.randrange(child), max(0, child - 1 - rng.randrange(3)), (child - 1) // 3, child - 1)[
            shape
        ]
        for child in range(1, vertices)
    ]
    graph = tree_of(parents)
    robots = rng.randrange(1, robots_most)
    heights = range(1, max(graph.distances(0)) + 1)
    some = rng.sample(heights, min(len(heights), rng.randrange(3)))
    more: dict[str, Any] = {
        "options": {"splits": rng.choice(["paper", "paper", "best", some])},
        "faults": any_losses(rng, robots, vertices),
        "seed": seed,
    }
    if rng.random() < 0.5:
        more["clock"] = {**EVENT, "jitter": rng.choice([0.0, 0.5, "exponential"])}
        more["team"] = {"speed": [rng.choice([0.5, 1.0, 2.0]) for _ in range(robots)]}
    else:
        more["heartbeat"] = rng.choice(["reach", "reach", "global"])
    return Lost(graph, robots, rng.choice(BOTH), more)


def any_losses(rng: Random, robots: int, vertices: int) -> list[dict[str, Any]]:
    """Draw up to k - 1 deaths: at instants and rounds, on the way, at requests, several at once."""
    span = rng.choice([5, vertices, 3 * vertices])
    moment = float(rng.randrange(span + 1))
    faults: list[dict[str, Any]] = []
    for victim in rng.sample(range(robots), rng.randrange(robots)):
        when: dict[str, Any] = rng.choice(
            [
                {"at_request": rng.randrange(1, span + 2)},
                {"at": float(rng.randrange(span + 1)), "round": rng.choice([0, 0, 1, 2])},
                {"at": rng.random() * span},
                {"at": rng.randrange(span + 1) + 0.5},
                {"at": moment},
                {"at": moment},
            ]
        )
        faults.append({"kill": f"robot:{victim}", **when})
    return faults


def check_losses(seed: int) -> None:
    """Play a run with losses: whoever is left covers all and comes back, and they find together.

    In lockstep, after a loss at time t: be D how many edges lower the lowest robot was, or was going to
    be, than the highest one, of all who were alive when the losses began. Then the team is connected
    at the end of every instant after t + D + 1, unless there is another loss: one tick for moves that
    are under way, and D to go up. Losses begin anew once the team has been connected so long.
    """
    lost = with_losses(seed)
    run = run_of(lost.graph, lost.robots, lost.algorithm, **lost.more)
    run.assert_complete()
    if "clock" not in lost.more:
        assert run.eye.late == []


@pytest.fixture(name="own_copies")
def own_copies_fixture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no robot share its copy of the team's state with others, as in processes of their own."""

    def own_step(*arguments: Any) -> Step:
        connected_course._first_steps.clear()
        return first_step(*arguments)

    monkeypatch.setattr(connected, "first_step", own_step)


def blocks(seeds: int, block: int) -> list[range]:
    """Return the seeds by blocks."""
    return [range(first, min(seeds, first + block)) for first in range(0, seeds, block)]


def test_losses_one_copy_for_all() -> None:
    for seed in range(100):
        check_losses(seed)


@pytest.mark.usefixtures("own_copies")
def test_losses_a_copy_each() -> None:
    for seed in range(100, 200):
        check_losses(seed)


@pytest.mark.slow
@pytest.mark.parametrize("seeds", blocks(2000, 250), ids=str)
def test_losses_two_thousand_times(seeds: range) -> None:
    for seed in seeds:
        check_losses(10_000 + seed)


@pytest.mark.slow
@pytest.mark.usefixtures("own_copies")
@pytest.mark.parametrize("seeds", blocks(1000, 250), ids=str)
def test_losses_a_thousand_times_with_a_copy_each(seeds: range) -> None:
    for seed in seeds:
        check_losses(20_000 + seed)


@pytest.mark.parametrize("variant", BOTH)
def test_after_one_loss_at_the_beginning_of_a_tick_a_single_tick_is_enough(variant: str) -> None:
    """One robot holds one place: that is all that can be missing."""
    graph, robots = tree_of([(child - 1) // 3 for child in range(1, 22)]), 7
    options = {"splits": [2]}
    apart = 0
    for time in range(int(run_of(graph, robots, variant, options=options).world.time)):
        for robot in range(robots):
            faults = [{"kill": f"robot:{robot}", "at": float(time)}]
            run = run_of(graph, robots, variant, options=options, faults=faults)
            run.assert_complete()
            assert set(run.eye.apart) <= {float(time)}
            apart += bool(run.eye.apart)
    assert apart  # there were some that mattered


TRAIL = tree_of([*range(8), 0])
"""A long way down, and a leaf at the root: the team splits there, and leaves a trail."""


def test_who_lacks_the_word_of_a_robot_that_was_lost_hears_that_all_is_covered() -> None:
    """Robot 2 is lost as the others hear the last of them, and stop; some never had its word."""
    faults = [{"kill": "robot:7", "at_request": 10}, {"kill": "robot:2", "at_request": 18}]
    run = run_of(
        graph_of("01 02 03 14 15 16 27 04 06 37"),
        8,
        "cocta",
        clock={"mode": "event", "jitter": "exponential"},
        options={"splits": [3, 1], "tree": "depth-first"},
        faults=faults,
        seed=17,
    )
    assert (run.end.status, run.failures) == ("over", {})
    stopped = {body.stopped_at for body in run.world.bodies if body.lost_at is None}
    assert stopped == {run.world.bodies[2].lost_at}


def along_the_trail(faults: list[dict[str, Any]]) -> Run:
    run = run_of(TRAIL, 8, "ncocta", options={"splits": [8]}, faults=faults)
    run.assert_complete()
    return run


def test_a_part_below_follows_one_that_goes_up_to_the_meeting_vertex() -> None:
    """At 6 there are robots at depths 0, 1, ..., 6; those at 0, 1, 2 and 5 are lost.

    Those who are left at 3 and 4 need three ticks to the meeting vertex, depth 0, where they wait.
    Those at 6 are then at 3, and need one more.
    """
    kills = [{"kill": f"robot:{robot}", "at": 6.0} for robot in (2, 1, 3, 5)]
    assert along_the_trail(kills).eye.apart == [6.0, 7.0, 8.0, 9.0]


def test_a_trail_that_breaks_is_mended_in_time() -> None:
    longest = 0
    for seed in range(100):
        rng = Random(f"trail {seed}")
        at, round_ = rng.randrange(1, 16) + rng.choice([0.0, 0.0, 0.5]), rng.choice([0, 0, 1])
        victims = rng.sample(range(8), rng.randrange(1, 8))
        kills = [{"kill": f"robot:{robot}", "at": at, "round": round_} for robot in victims]
        kills[-1]["at"] = at + rng.choice([0.0, 0.0, 1.0, 2.0])
        eye = along_the_trail(kills).eye
        assert eye.late == []
        longest = max(longest, len(eye.apart))
    assert longest > 3  # there were some that took their time


# Copies that differ.


@pytest.mark.parametrize("clock", [None, EVENT], ids=["lockstep", "event"])
def test_a_robot_whose_moves_differ_is_found_out(
    clock: dict[str, Any] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Robot 1 takes robot 2 for one that stays where it is, in the third tick."""
    copies: list[Step] = []

    def own_step(*arguments: Any) -> Step:
        connected_course._first_steps.clear()
        step = first_step(*arguments)
        copies.append(step)
        if len(copies) == 2:
            third = step.next().next()
            del third.moves[2]
            copies.append(third)  # steps that nobody holds are forgotten
        return step

    monkeypatch.setattr(connected, "first_step", own_step)
    run = run_of(tree_of([(child - 1) // 2 for child in range(1, 31)]), 3, "ncocta", clock=clock)
    said = "\n".join(run.failures.values())
    assert said.count("errors.AlgorithmError: ") == len(run.failures) > 0
    assert re.search(r"robots? (1\b|\d+ and 1\b)|digest of robot 1\b", said), said


@pytest.mark.parametrize("clock", [None, EVENT], ids=["lockstep", "event"])
def test_a_robot_with_a_plan_of_its_own_is_found_out(
    clock: dict[str, Any] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    copies: list[Step] = []

    def own_step(tree: RootedTree, size: int, variant: Variant, splits: Any, load: Any) -> Step:
        connected_course._first_steps.clear()
        own = checked_splits(tree, [tree.height]) if len(copies) == 1 else splits
        copies.append(first_step(tree, size, variant, own, load))
        return copies[-1]

    monkeypatch.setattr(connected, "first_step", own_step)
    graph = tree_of([(child - 1) // 2 for child in range(1, 31)])
    run = run_of(graph, 5, "cocta", options={"splits": []}, clock=clock)
    if clock:  # it leaves for where nobody hears it: all wait for it, as for one that is slow
        assert (run.end.status, run.failures) == ("stalled", {})
        return
    said = "\n".join(run.failures.values())
    assert said.count("errors.AlgorithmError: ") == len(run.failures) > 0
    assert re.search(r"robots? (1\b|\d+ and 1\b)|digest of robot 1\b", said), said


# Memory.


@pytest.mark.parametrize("clock", [None, EVENT], ids=["lockstep", "event"])
def test_steps_are_forgotten(clock: dict[str, Any] | None, monkeypatch: pytest.MonkeyPatch) -> None:
    kept: WeakSet[Step] = WeakSet()
    counts: list[int] = []

    class Counted(Step):
        __slots__ = ()

        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            kept.add(self)
            counts.append(len(kept))

    monkeypatch.setattr(connected_course, "Step", Counted)
    run = run_of(tree_of([(child - 1) // 3 for child in range(1, 121)]), 3, "cocta", clock=clock)
    run.assert_complete()
    assert len(counts) > 100
    assert max(counts) <= 4
