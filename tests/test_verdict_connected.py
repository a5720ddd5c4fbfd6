"""The verdict on connected coverage: each claim bites on a trace that breaks it, and only there."""

from collections.abc import Iterable, Sequence
from itertools import combinations
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.algorithms.connected_rule import Team, Variant, next_moves
from agents.algorithms.connected_splits import paper_splits
from agents.planning.rooted_tree import perfect_tree, spanning_tree
from deploy.report import print_verdict
from deploy.verdict.connection import Occupied
from deploy.verdict.guarantees import Guarantee, Status
from deploy.verdict.ledger import Ledger
from deploy.verdict.result import Result, exit_code, judge, monitors_of, observers
from deploy.verdict.sinay import ConnectedPlan
from protocol.graph import PortGraph
from protocol.messages import AnyRequest, Look, Move, Stop, Wait, WaitForNews
from protocol.scenario import from_tree
from protocol.trace import Event
from tests.play import graph_of, graphs, tree_of

CONNECTED = "the team is connected"
CONTACT = "nobody leaves without contact"
HOME = "survivors back at the start"
EXACT = "NCOCTA takes E_H ticks"
NOT_SLOWER = "never slower than NCOCTA"
COVERED = "every vertex visited"
PHYSICS = "physics"
OURS = (CONNECTED, CONTACT, HOME, EXACT, NOT_SLOWER)

PATH = graph_of("01 12 23")
FORK = graph_of("01 02")


def verdict(
    graph: PortGraph,
    trace: Iterable[Event],
    robots: int,
    algorithm: str = "cocta",
    status: Status = "over",
    **fields: Any,
) -> Result:
    tree = {"algorithm": algorithm, "world": {"map": "x"}, "team": {"robots": robots}, **fields}
    scenario = from_tree(tree, "test")
    ledger = Ledger(graph, [0] * robots, scenario)
    monitors = monitors_of(scenario, ledger)
    observe = observers(ledger, monitors)
    for event in trace:
        for each in observe:
            each(event)
    return judge(scenario, ledger, monitors, status=status, engine="test", trace_sha256="")


def claim(result: Result, name: str) -> Guarantee:
    (found,) = [guarantee for guarantee in result.guarantees if guarantee.name == name]
    return found


def broken(result: Result) -> set[str]:
    return {guarantee.name for guarantee in result.guarantees if guarantee.holds is False}


def walks(
    graph: PortGraph,
    *paths: Sequence[int],
    lost: dict[int, float] | None = None,
    ends: bool = True,
) -> list[Event]:
    """Let each robot be where its path says at ticks 0, 1, ...; at its end it stops.

    Args:
        graph: where they walk.
        paths: for each robot its vertices; one that stays is there twice.
        lost: when robots are lost, before they choose or on their way.
        ends: whether they stop; else they wait for news.
    """
    lost = lost or {}
    trace = [Event(0.0, -1, 0, robot, 0, None, Look(), 0) for robot in range(len(paths))]
    entry: list[int | None] = [None] * len(paths)
    for tick in range(max(map(len, paths))):
        requests = []
        for robot, path in enumerate(paths):
            here, gone = path[min(tick, len(path) - 1)], lost.get(robot, tick + 1)
            came_by = entry[robot]
            if gone < tick or tick >= len(path):
                continue
            if gone == tick:
                trace.append(Event(float(tick), 0, -1, robot, here, came_by, "killed", 0))
                continue
            request: AnyRequest = Wait(duration=1.0)
            if tick + 1 == len(path):
                request = Stop() if ends else WaitForNews()
            elif path[tick + 1] != here:
                exit_ = graph.far[here].index(path[tick + 1])
                request = Move(exit=exit_)
                entry[robot] = graph.back[here][exit_]
            requests.append(Event(float(tick), 0, 0, robot, here, came_by, request, 0))
        trace += requests
        for robot, gone in sorted(lost.items()):
            if tick < gone < tick + 1:
                trace.append(Event(gone, 0, -1, robot, None, None, "killed", 0))
    return trace


# Connected.


def test_a_good_walk_keeps_every_claim() -> None:
    trace = walks(FORK, (0, 1, 0, 2, 0), (0, 0, 0, 0, 0))
    result = verdict(FORK, trace, 2, algorithm_options={"heights": ()})
    assert broken(result) == set()
    assert claim(result, CONNECTED).detail == "at every instant"
    assert claim(result, HOME).holds
    assert claim(result, NOT_SLOWER).holds
    assert claim(result, EXACT).holds is None
    assert claim(result, CONTACT).holds is None
    assert exit_code(result) == 0


def test_a_team_that_falls_apart_is_found_out() -> None:
    trace = walks(PATH, (0, 1, 2, 1, 0), (0, 0, 0, 0, 0), (0, 1, 2, 1, 0))
    result = verdict(PATH, trace, 3, status="unfinished")
    assert claim(result, CONNECTED).holds is False
    assert claim(result, CONNECTED).detail == (
        "not connected at t=2: robots 0, 2 apart from those further up"
    )
    assert PHYSICS not in broken(result)
    # With somebody in between it does not.
    trace = walks(PATH, (0, 1, 2, 1, 0), (0, 0, 0, 0, 0), (0, 1, 1, 1, 0))
    assert claim(verdict(PATH, trace, 3), CONNECTED).holds


def test_a_robot_under_way_is_where_it_left_from() -> None:
    # Between ticks 1 and 2 all leave vertex 1 at once, and meet again beside each other.
    trace = walks(PATH, (0, 1, 2, 1, 0), (0, 1, 1, 0, 0))
    assert claim(verdict(PATH, trace, 2), CONNECTED).holds


def test_an_edge_that_closes_a_cycle_connects() -> None:
    ring = graph_of("01 12 23 30")
    # 2 is below 1 in the breadth-first tree, yet adjacent to 3.
    trace = walks(ring, (0, 3, 3, 3, 0), (0, 1, 2, 3, 0), (0, 0, 0, 0, 0))
    assert claim(verdict(ring, trace, 3), CONNECTED).holds
    trace = walks(ring, (0, 0, 0, 0), (0, 1, 2, 1))
    assert claim(verdict(ring, trace, 2), CONNECTED).holds is False


@given(graphs(vertices_max=9), st.booleans())
def test_depths_are_those_of_the_tree_that_the_robots_use(graph: PortGraph, deep: bool) -> None:
    tree = spanning_tree(graph, 0, deep=deep).tree
    assert Occupied(graph, 0, deep=deep).depths == [tree.height - h for h in tree.heights]


LONG = graph_of("01 12 23 34")
DOWN = (0, 1, 2, 3)


def stays_then_up(ticks: int, *, top: int = 3) -> tuple[int, ...]:
    """Go down to ``top``, wait there from tick 4 for so long, and go up."""
    return (*DOWN[: top + 1], *[top] * (4 - top + ticks), *range(top - 1, -1, -1))


@pytest.mark.parametrize(("ticks", "kept"), [(0, True), (1, True), (3, True), (4, False)])
def test_after_a_loss_there_is_one_move_more_than_the_lowest_is_below_the_highest(
    ticks: int, *, kept: bool
) -> None:
    # Robots stand at 0, 1, 2 and 3; the ones at 1 and 2 are lost at tick 4.
    still = (*[0] * 14,)
    trace = walks(
        LONG,
        still,
        stays_then_up(0, top=1),
        stays_then_up(0, top=2),
        stays_then_up(ticks - 1),
        lost={1: 4, 2: 4},
    )
    # 3 is three below 0. It is adjacent to 0 two moves after it has set out.
    result = verdict(LONG, trace, 4, status="unfinished")
    assert claim(result, CONNECTED).holds is kept
    if kept:
        apart = 1 + ticks
        assert claim(result, CONNECTED).detail == f"broken by 1 of 2 losses, for at most {apart}"
    else:
        assert "by t=8, after a loss: robot 3 apart" in claim(result, CONNECTED).detail


def test_a_loss_on_the_way_counts_from_when_the_others_have_arrived() -> None:
    # Robot 1 is lost on its way from 1; robot 2 arrives at 3 at the same time, two below 0 ... and
    # needs three moves then, of which the last is not needed to be adjacent.
    paths = ((*[0] * 9,), (0, 1, 1, 2), (0, 1, 2, 3, 3, 2, 1, 0))
    result = verdict(LONG, walks(LONG, *paths, lost={1: 2.5}), 3, status="unfinished")
    assert claim(result, CONNECTED).holds
    late = ((*[0] * 10,), (0, 1, 1, 2), (0, 1, 2, 3, 3, 3, 3, 3, 2, 1))
    result = verdict(LONG, walks(LONG, *late, lost={1: 2.5}), 3, status="unfinished")
    assert claim(result, CONNECTED).holds is False
    assert "by t=7, after a loss: robot 2" in claim(result, CONNECTED).detail


def test_once_connected_again_a_team_has_no_excuse() -> None:
    # Robot 1 is lost three moves above robot 3; the others are connected after one, and then no more.
    paths = (
        (*[0] * 9,),
        (0, 1, 1, 1, 1),
        (0, 1, 2, 2, 2, 1, 2, 1, 0),
        (0, 1, 2, 3, 3, 2, 2, 1, 0),
    )
    result = verdict(LONG, walks(LONG, *paths, lost={1: 4}), 4, status="unfinished")
    assert claim(result, CONNECTED).detail == (
        "not connected at t=6: robots 2, 3 apart from those further up"
    )


def test_a_team_that_stays_apart_for_ever_is_found_out_though_nothing_happens() -> None:
    paths = ((0, 0, 0, 0), (0, 1, 1), (0, 1, 2, 2))
    trace = walks(LONG, *paths, lost={1: 2}, ends=False)
    assert claim(verdict(LONG, trace, 3, status="stalled"), CONNECTED).holds is False
    so_far = claim(verdict(LONG, trace, 3, status="unfinished"), CONNECTED)
    assert so_far.holds is None
    assert "apart since t=2" in so_far.detail


def test_a_robot_that_has_stopped_connects_nobody() -> None:
    paths = ((*[0] * 4,), (0, 1), (0, 1, 2, 2))
    assert claim(verdict(PATH, walks(PATH, *paths), 3), CONNECTED).holds is False


@given(graphs(vertices_max=9), st.booleans(), st.data())
def test_counting_finds_what_searching_finds(
    graph: PortGraph, deep: bool, data: st.DataObject
) -> None:
    occupied = Occupied(graph, 0, deep=deep)
    at: list[int] = []
    vertex = st.integers(0, len(graph.names) - 1)
    for _ in range(data.draw(st.integers(1, 12))):
        leaves: bool = data.draw(st.booleans())
        if at and leaves:
            occupied.remove(at.pop(data.draw(st.integers(0, len(at) - 1))))
        else:
            at.append(data.draw(vertex))
            occupied.add(at[-1])
        assert occupied.connected() == connected(graph, set(at))


def connected(graph: PortGraph, places: set[int]) -> bool:
    parts = [{place} for place in places]
    while True:
        for one, other in combinations(parts, 2):
            if any(far in other for place in one for far in graph.far[place]):
                one.update(other)
                parts.remove(other)
                break
        else:
            return len(parts) <= 1


# Contact on the event clock.

EVENT: dict[str, Any] = {"clock": {"mode": "event"}}
Line = tuple[float, int, int, int | None, AnyRequest | str]
"""Time, robot, place, entry, request."""


def trace_of(lines: Iterable[Line], robots: int) -> list[Event]:
    looks = [Event(0.0, -1, 0, robot, 0, None, Look(), 0) for robot in range(robots)]
    return [*looks, *(Event(t, 0, 0, r, v, e, what, 0) for t, r, v, e, what in lines)]


SHORT_LONG = graph_of("01 12", [1.0, 3.0])


def test_who_leaves_last_leaves_somebody_behind() -> None:
    good: list[Line] = [
        (0.0, 0, 0, None, Move(exit=0)),
        (0.0, 1, 0, None, WaitForNews()),
        (1.0, 0, 1, 0, WaitForNews()),
        (1.0, 1, 0, None, Move(exit=0)),
        (2.0, 0, 1, 0, WaitForNews()),
        (2.0, 1, 1, 0, Move(exit=1)),
        (5.0, 1, 2, 0, WaitForNews()),
    ]
    result = verdict(SHORT_LONG, trace_of(good, 2), 2, status="unfinished", **EVENT)
    assert claim(result, CONTACT).holds
    assert claim(result, CONNECTED).holds
    assert PHYSICS not in broken(result)
    # The other one sets out as well, to the other side.
    bad: list[Line] = [*good[:4], (1.5, 0, 1, 0, Move(exit=1)), (2.0, 1, 1, 0, WaitForNews())]
    result = verdict(SHORT_LONG, trace_of(bad, 2), 2, status="unfinished", **EVENT)
    assert claim(result, CONTACT).holds is False
    assert claim(result, CONTACT).detail == "t=1.5: robot 1 between 0 and 1, with nobody there"


def test_all_may_be_on_one_edge() -> None:
    lines: list[Line] = [(0.0, robot, 0, None, Move(exit=0)) for robot in range(2)]
    lines += [(1.0, robot, 1, 0, Move(exit=1)) for robot in range(2)]
    result = verdict(SHORT_LONG, trace_of(lines, 2), 2, status="unfinished", **EVENT)
    assert claim(result, CONTACT).holds
    # But not if somebody is elsewhere.
    lines = [(0.0, 0, 0, None, Move(exit=0)), (1.0, 0, 1, 0, Move(exit=1))]
    lines.insert(1, (0.0, 1, 0, None, WaitForNews()))
    result = verdict(SHORT_LONG, trace_of(lines, 2), 2, status="unfinished", **EVENT)
    assert claim(result, CONTACT).holds is False


def test_contact_is_not_asked_for_after_a_loss_until_the_team_must_be_connected() -> None:
    lines: list[Line] = [
        (0.0, 0, 0, None, Move(exit=0)),
        (0.0, 1, 0, None, Move(exit=0)),
        (0.0, 2, 0, None, WaitForNews()),
        (1.0, 0, 1, 0, Move(exit=1)),
        (1.0, 1, 1, 0, WaitForNews()),
    ]
    trace = trace_of(lines, 3)
    trace.append(Event(1.5, 0, -1, 1, 1, 0, "killed", 0))
    trace.append(Event(2.0, 0, 0, 2, 0, None, Move(exit=0), 0))
    trace.append(Event(3.0, 0, 0, 2, 1, 0, WaitForNews(), 0))
    trace.append(Event(4.0, 0, 0, 0, 2, 0, WaitForNews(), 0))
    result = verdict(SHORT_LONG, trace, 3, status="unfinished", **EVENT)
    assert claim(result, CONTACT).holds
    assert claim(result, CONNECTED).holds
    # Robot 2 leaves at once, and again when the time for three moves is over: 4 + 3 * 3 + 1.
    for there, holds in ((5.0, True), (15.0, False)):
        rest = [
            Event(there, 0, 0, 2, 1, 0, Move(exit=0), 0),
            Event(there + 0.5, 0, 0, 0, 2, 0, Move(exit=0), 0),
        ]
        result = verdict(SHORT_LONG, [*trace, *rest], 3, status="unfinished", **EVENT)
        assert claim(result, CONTACT).holds is holds


def test_who_was_left_behind_after_a_loss_is_not_forgotten() -> None:
    graph = graph_of("01 12", [1.0, 30.0])
    lines: list[Line] = [
        (0.0, 0, 0, None, Move(exit=0)),
        (0.0, 1, 0, None, Move(exit=0)),
        (0.0, 2, 0, None, WaitForNews()),
        (1.0, 0, 1, 0, WaitForNews()),
        (1.0, 1, 1, 0, WaitForNews()),
    ]
    trace = trace_of(lines, 3)
    # One below, and moves took 1: the excuse is over at 1.5 + 2 + 1, the move of robot 0 much later.
    trace.append(Event(1.5, 0, -1, 2, 0, None, "killed", 0))
    trace.append(Event(3.6, 0, 0, 0, 1, 0, Move(exit=1), 0))
    trace.append(Event(4.0, 0, 0, 1, 1, 0, Move(exit=0), 0))
    result = verdict(graph, trace, 3, status="unfinished", **EVENT)
    assert claim(result, CONTACT).holds
    trace.append(Event(4.6, 0, 0, 1, 0, 0, WaitForNews(), 0))
    result = verdict(graph, trace, 3, status="unfinished", **EVENT)
    assert claim(result, CONTACT).detail == "t=4.6: robot 0 between 1 and 2, with nobody there"


def test_a_move_under_way_counts_for_as_long_as_it_takes() -> None:
    lines: list[Line] = [(0.0, 0, 0, None, Move(exit=0)), (0.0, 1, 0, None, Move(exit=0))]
    lines += [(0.0, 2, 0, None, WaitForNews()), (1.0, 0, 1, 0, Move(exit=1))]
    lines += [(1.0, 1, 1, 0, WaitForNews()), (2.0, 0, 2, 0, WaitForNews())]
    before = [*trace_of(lines, 3), Event(3.0, 0, -1, 1, 1, 0, "killed", 0)]
    # Two below, and moves took 1: connected by 3 + 3 * 1 + 1, if none takes longer.
    for what, back, holds in (
        (Move(exit=0), Event(9.0, 0, 0, 0, 1, 1, WaitForNews(), 0), True),
        (WaitForNews(), Event(9.0, 0, 0, 0, 2, 0, Move(exit=0), 0), False),
    ):
        trace = [*before, Event(3.0, 0, 0, 0, 2, 0, what, 0), back]
        found = claim(verdict(PATH, trace, 3, status="unfinished", **EVENT), CONNECTED)
        assert (found.holds is not False) == holds, found


def test_on_the_event_clock_the_longest_move_counts() -> None:
    still: list[Line] = [(0.0, 1, 0, None, WaitForNews()), (0.0, 2, 0, None, WaitForNews())]
    lines: list[Line] = [(0.0, 0, 0, None, Move(exit=0)), *still, (1.0, 0, 1, 0, Move(exit=1))]
    lines += [(1.0, 1, 0, None, Move(exit=0)), (2.0, 1, 1, 0, WaitForNews())]
    lines += [(4.0, 0, 2, 0, WaitForNews())]
    trace = trace_of(lines, 3)
    trace.append(Event(5.0, 0, -1, 1, 1, 0, "killed", 0))
    # Two below, and the longest move took 3: by 5 + 3 * 3 + 1 they must be connected.
    for when, holds in ((12.0, True), (12.5, False)):
        rest = [
            Event(when, 0, 0, 0, 2, 0, Move(exit=0), 0),
            Event(when + 3.0, 0, 0, 0, 1, 1, WaitForNews(), 0),
        ]
        result = verdict(SHORT_LONG, [*trace, *rest], 3, status="unfinished", **EVENT)
        assert claim(result, CONNECTED).holds is holds


# Back home, and times.


def test_survivors_stop_at_the_start() -> None:
    result = verdict(FORK, walks(FORK, (0, 1, 0, 2), (0, 0, 0, 0)), 2)
    assert broken(result) == {HOME}
    assert claim(result, HOME).detail == "robot 0 not stopped there"
    assert claim(result, NOT_SLOWER).holds is None
    lost = verdict(FORK, walks(FORK, (0, 1, 0, 2), (0, 0), lost={0: 3, 1: 1}), 2)
    assert claim(lost, HOME).detail == "no robot survived"


def rule_trace(graph: PortGraph, team: Team) -> list[Event]:
    """Play the rule itself."""
    paths = [[0] for _ in team.at]
    while not team.over:
        team.apply(next_moves(team))
        for robot, path in enumerate(paths):
            path.append(team.at[robot])
    return walks(graph, *paths)


def perfect(arity: int, height: int) -> PortGraph:
    vertices = sum(arity**depth for depth in range(height + 1))
    return tree_of([(child - 1) // arity for child in range(1, vertices)])


@pytest.mark.parametrize(
    ("arity", "height", "k", "splits", "ticks"),
    [
        (2, 3, 7, (3,), 10),
        (2, 3, 11, (3, 2), 7),
        (3, 4, 16, "paper", 44),
        (2, 5, 11, "paper", 36),
        (3, 3, 2, (), 78),
        (2, 4, 9, (3,), 24),
    ],
)
def test_ncocta_takes_as_long_as_the_paper_says(
    arity: int, height: int, k: int, splits: tuple[int, ...] | str, ticks: int
) -> None:
    graph = perfect(arity, height)
    heights = paper_splits(arity, height, k) if isinstance(splits, str) else splits
    trace = rule_trace(graph, Team(perfect_tree(arity, height), k, "ncocta", heights))
    options = {"splits": splits, "heights": heights}
    result = verdict(graph, trace, k, "ncocta", algorithm_options=options)
    assert broken(result) == set()
    assert claim(result, EXACT).holds
    assert result.connected is not None
    assert result.connected.split_heights == [*heights]
    assert f"{ticks} ticks, E_H = {ticks}" in claim(result, EXACT).detail
    # One that dawdles.
    slow = [[0, *(event.place or 0 for event in trace if event.robot == r)] for r in range(k)]
    result = verdict(graph, walks(graph, *slow), k, "ncocta", algorithm_options=options)
    assert claim(result, EXACT).holds is False


def test_split_heights_by_the_formula_are_judged() -> None:
    graph = perfect(2, 5)
    trace = rule_trace(graph, Team(perfect_tree(2, 5), 11, "ncocta", (3,)))
    options = {"splits": "paper", "heights": (3,)}
    found = claim(verdict(graph, trace, 11, "ncocta", algorithm_options=options), EXACT)
    assert found.holds is False
    assert found.detail == "split heights [3], by the formula [5]"


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"algorithm_options": {"splits": (3, 1), "heights": (3, 1)}}, "not one below the other"),
        (
            {"algorithm_options": {"splits": "best", "heights": (3, 2)}},
            "2 robots; split heights [3, 2] need 11",
        ),
        ({"algorithm_options": {"splits": "best"}}, "the plan is not known"),
        ({"algorithm": "cocta"}, "only NCOCTA"),
        ({"clock": {"mode": "event"}}, "only under the lockstep clock"),
        ({"graph": tree_of([0, 0, 1])}, "only on perfect trees"),
        ({"graph": graph_of("01 12 20")}, "only on trees"),
    ],
)
def test_e_h_is_not_claimed_elsewhere(change: dict[str, Any], why: str) -> None:
    graph = change.pop("graph", perfect(2, 3))
    tour = around(graph)
    fields = {"algorithm": "ncocta", **change}
    found = claim(verdict(graph, walks(graph, tour, tour), 2, **fields), EXACT)
    assert found.holds is None
    assert why in found.detail


def around(graph: PortGraph) -> list[int]:
    """Go depth first from vertex 0 and back."""
    seen: set[int] = set()

    def visit(vertex: int) -> list[int]:
        seen.add(vertex)
        found = [vertex]
        for far in graph.far[vertex]:
            if far not in seen:
                found += [*visit(far), vertex]
        return found

    return visit(0)


@pytest.mark.parametrize("variant", ["cocta", "cocta-best"])
def test_cocta_is_measured_against_ncocta(variant: str) -> None:
    graph, tree, k = perfect(2, 4), perfect_tree(2, 4), 9
    drips: Variant = "cocta"
    trace = rule_trace(graph, Team(tree, k, drips, (3,)))
    options = {"splits": "best", "heights": (3,)}
    result = verdict(graph, trace, k, variant, algorithm_options=options)
    assert broken(result) == set()
    assert claim(result, NOT_SLOWER).holds
    # NCOCTA needs 24 ticks with these split heights; all together around the tree take 60.
    slow = walks(graph, *[around(graph)] * k)
    result = verdict(graph, slow, k, variant, algorithm_options=options)
    assert broken(result) == {NOT_SLOWER}
    assert claim(result, NOT_SLOWER).detail == "60 ticks; NCOCTA with split heights [3]: 24"


def test_a_plan_that_was_given_is_not_measured() -> None:
    graph = perfect(2, 4)
    slow = walks(graph, *[around(graph)] * 9)
    options = {"splits": (3,), "heights": (3,), "load": 1, "order": (2, 1)}
    result = verdict(graph, slow, 9, "cocta-best", algorithm_options=options)
    assert claim(result, NOT_SLOWER).holds is None
    assert claim(result, NOT_SLOWER).detail == "the plan was given"
    assert result.connected == ConnectedPlan(split_heights=[3], load=1, reordered=2, tree="given")


def test_the_time_is_not_judged_after_losses() -> None:
    tour = around(FORK)
    for algorithm in ("ncocta", "cocta"):
        trace = walks(FORK, tour, tour, tour, lost={1: 1})
        result = verdict(FORK, trace, 3, algorithm)
        assert broken(result) == set()
        assert {claim(result, name).holds for name in (EXACT, NOT_SLOWER)} == {None}


# What messages cost.


def test_messages_are_counted_with_their_bytes() -> None:
    trace = [
        Event(0.0, -1, 0, 0, 0, None, Look(messages=(b"abc",)), 0),
        Event(0.0, 0, 0, 0, 0, None, Wait(messages=(b"", b"de")), 0),
        Event(1.0, 0, 0, 0, 0, None, Stop(), 0),
    ]
    result = verdict(FORK, trace, 1)
    assert (result.messages, result.message_bytes) == (3, 5)


@pytest.mark.parametrize(("words", "line"), [((b"ab", b"c"), "2, 3 bytes"), ((), None)])
def test_the_verdict_says_what_was_said(
    words: tuple[bytes, ...], line: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    looks = Event(0.0, -1, 0, 0, 0, None, Look(messages=words), 0)
    print_verdict(verdict(FORK, [looks, Event(0.0, 0, 0, 0, 0, None, Stop(), 0)], 1))
    said = [each.split(maxsplit=1) for each in capsys.readouterr().out.splitlines()]
    lines = {each[0]: each[1] for each in said if len(each) == 2}
    assert lines.get("messages") == line
