"""Tags that vanish or change: what the world does to them, what MR-DFS makes of it, what is judged.

Paper: Brass, Cabrera-Mora, Gasparri, Xiao 2011, "Multi-Robot Tree and Graph Exploration", Sec. VI.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.algorithms.mr_dfs import (
    BLANK,
    Layout,
    Options,
    Reading,
    Tag,
    last_call,
    legible,
    pack,
    record,
    reopen,
    unpack,
)
from agents.body import Body
from agents.registry import algorithm_of
from deploy.inprocess import play
from deploy.verdict.brass import Brass
from deploy.verdict.coverage import coverage_of
from deploy.verdict.guarantees import Guarantee, Status, common
from deploy.verdict.ledger import Ledger
from protocol.graph import PortGraph
from protocol.messages import Briefing, Look, Move, Sight, Stop, TagWrite, Wait, WaitForNews, Write
from protocol.scenario import Scenario
from protocol.trace import NOBODY, Event
from tests.play import (
    Played,
    asking,
    conducted,
    crossings,
    edges_crossed,
    graph_of,
    graphs,
    played,
    scenario_of,
    trees,
)
from world_server.terrain import GraphTerrain
from world_server.world import CORRUPT_BITS_MAX, World

PAPER: dict[str, Any] = {"algorithm_options": {"variant": "paper"}}
TREE: dict[str, Any] = {"algorithm_options": {"version": "tree"}}
UNNOTICED: dict[str, Any] = {"device": {"checksum": False}}

STAR = graph_of("01 02")


def of_robots(events: Iterable[Event]) -> list[Event]:
    """Leave out what happened to devices."""
    return [event for event in events if event.robot != NOBODY]


def moves(events: Iterable[Event]) -> Counter[int]:
    """Count the moves of each robot."""
    made: Counter[int] = Counter()
    for (robot, _, _), times in crossings(of_robots(events)).items():
        made[robot] += times
    return made


# The world.


def test_an_erased_tag_is_blank_and_counts_as_written() -> None:
    seen: list[Sight] = []
    script = asking(Write(b"a"), Wait(duration=1.0), Write(b"b"), Look(), seen=seen)
    run = conducted(STAR, [script], faults=[{"erase_tag": 0, "at": 0.5}])
    found = [(sight.time, sight.tag, sight.revision) for sight in seen]
    assert found == [(0, b"", 0), (0, b"a", 1), (1, b"", 2), (1, b"b", 3), (1, b"b", 3)]
    assert run.writes == [(0, 1, b"a"), (0, 2, b""), (0, 3, b"b")]
    line = "t=0.5 round=0 wave=-1 device at 0 erased"
    assert [str(event) for event in run.events if event.robot == NOBODY] == [line]


def test_a_destroyed_device_forgets_all_that_is_written() -> None:
    seen: list[Sight] = []
    script = asking(Write(b"a"), Wait(duration=1.0), Write(b"b"), Look(), seen=seen)
    faults = [{"destroy_tag": 0, "at": 0.5}, {"erase_tag": 0, "at": 0.75}]
    run = conducted(STAR, [script], faults=faults)
    found = [(sight.time, sight.tag, sight.revision) for sight in seen]
    assert found == [(0, b"", 0), (0, b"a", 1), (1, b"", 0), (1, b"", 0), (1, b"", 0)]
    assert run.writes == [(0, 1, b"a"), (0, 2, b"")]  # the store is told that the tag is gone
    assert run.world.struck == [0, 1]


def corrupted(tag: bytes, seed: int, *, checksum: bool) -> bytes:
    """Return what becomes of a tag."""
    seen: list[Sight] = []
    conducted(
        STAR,
        [asking(Write(tag), Look(), seen=seen)],
        faults=[{"corrupt_tag": 0, "at_request": 4, "of": "robot:0"}],
        device={"checksum": checksum},
        seed=seed,
    )
    assert [sight.revision for sight in seen] == [0, 1, 2]
    return seen[-1].tag


@settings(max_examples=50)
@given(st.binary(max_size=20), st.integers(0, 1000))
def test_a_corrupted_tag_is_blank_or_differs_in_a_few_bits(tag: bytes, seed: int) -> None:
    assert corrupted(tag, seed, checksum=True) == b""
    found = corrupted(tag, seed, checksum=False)
    assert len(found) == len(tag)
    flipped = sum((a ^ b).bit_count() for a, b in zip(found, tag, strict=True))
    assert flipped <= CORRUPT_BITS_MAX
    assert corrupted(tag, seed, checksum=False) == found


@pytest.mark.parametrize("word", ["erase_tag", "corrupt_tag", "destroy_tag"])
def test_whoever_waits_there_wakes(word: str) -> None:
    """And nobody else."""
    seen: list[Sight] = []
    elsewhere: list[Sight] = []
    scripts = [
        asking(WaitForNews(), seen=seen),
        asking(Move(exit=0), WaitForNews(at_most=5.0), seen=elsewhere),
    ]
    run = conducted(STAR, scripts, faults=[{word: 0, "at": 2.5}])
    assert [sight.time for sight in seen] == [0.0, 2.5]
    assert [sight.time for sight in elsewhere] == [0.0, 1.0, 6.0]
    assert run.end.status == "over"


def test_robots_know_beforehand_whether_devices_may_fail() -> None:
    def told(*faults: dict[str, Any]) -> bool:
        world = World(scenario_of(1, faults=list(faults)), GraphTerrain(STAR), [0])
        return world.briefing(0).devices_fail

    assert not told()
    assert not told({"kill": "robot:0", "at": 1.0})
    assert told({"erase_tag": 2, "at": 99.0})


class Device(NamedTuple):
    """A plain model: what a device holds, and how often that changed."""

    tag: bytes = b""
    revision: int = 0
    destroyed: bool = False

    def after(self, step: bytes | str) -> "Device":
        """Return the device after a write, or after a fault."""
        if self.destroyed:
            return self
        if step == "destroy_tag":
            return Device(destroyed=True)
        tag = step if isinstance(step, bytes) else b""
        return Device(tag, self.revision + 1)


steps = st.lists(
    st.binary(max_size=3) | st.sampled_from(["erase_tag", "corrupt_tag", "destroy_tag"]), max_size=8
)


@settings(max_examples=100)
@given(steps)
def test_a_device_is_what_its_writes_and_faults_make_of_it(given_steps: list[bytes | str]) -> None:
    device, expected = Device(), [Device()]
    requests: list[Write | Look] = []
    faults: list[dict[str, Any]] = []
    for step in given_steps:
        if isinstance(step, bytes):
            requests.append(Write(step))
            device = device.after(step)
        else:
            requests.append(Look())
            faults.append({step: 0, "at_request": len(requests) + 2, "of": "robot:0"})
            device = device.after(step)
        expected.append(device)
    seen: list[Sight] = []
    run = conducted(STAR, [asking(*requests, seen=seen)], faults=faults)
    assert [(sight.tag, sight.revision) for sight in seen] == [device[:2] for device in expected]
    revisions = [revision for _, revision, _ in run.writes]
    assert revisions == list(range(1, len(revisions) + 1))


# How MR-DFS reads.

THREE = Layout(3, 2, tree=False)  # three ports, a team of two: two bits a port


def sight(tag: bytes, entry: int | None = None, **fields: Any) -> Sight:
    return Sight(0.0, 7, entry, 3, tag, 1, alone=True, **fields)


def reading(**options: str) -> Reading:
    briefing = Briefing(0, 2, 0, "mr-dfs", {}, 99, "global", True, devices_fail=True)
    return Reading(Body(briefing), msgspec.convert(options, Options))


@pytest.mark.parametrize("data", [b"\x02\x00", b"\x03", b"\x03\xff", b"\xff\xff\xff"])
def test_what_cannot_be_a_tag_reads_as_blank(data: bytes) -> None:
    assert legible(data, THREE) is None
    assert reading(variant="paper").read(sight(data)).tag == b""
    assert unpack(reading().read(sight(data)).tag, THREE) == BLANK


def test_a_mark_of_more_departures_than_robots_is_none() -> None:
    layout = Layout(2, 1, tree=False)
    assert legible(pack(Tag(0b0010), layout), layout) is None
    assert legible(pack(Tag(0b0111), layout), layout) == Tag(0b0111)


def test_a_robot_sees_its_own_marks_besides_those_of_the_device() -> None:
    robot = reading()
    robot.arrive(sight(b"", entry=2), 0.0)
    others = pack(Tag(record(0b01, 1, THREE)), THREE)
    expected = Tag(record(record(0b01, 1, THREE), 2, THREE))
    assert unpack(robot.read(sight(others)).tag, THREE) == expected
    # In the next epoch there are none.
    robot.begin(1, sight(b"", losses=(1,)))
    assert unpack(robot.read(sight(others)).tag, THREE) == Tag(0, epoch=1)


def test_an_epoch_of_more_losses_than_there_were_is_no_tag() -> None:
    robot = reading()
    newer = pack(Tag(0b11, epoch=1), THREE)
    assert unpack(robot.read(sight(newer)).tag, THREE) == BLANK
    assert robot.read(sight(newer, losses=(1,))).tag == newer


def test_closed_ports_of_others_become_the_last_choice() -> None:
    marks = record(0b01, 1, THREE)
    assert reopen(marks, THREE) == 0b0101
    alone = Layout(2, 1, tree=False)
    assert reopen(0b1101, alone) == 0


# What the paper's conclusion says.


@pytest.mark.parametrize("erasures", [0, 1, 5, 40])
def test_erased_marks_have_the_printed_variant_explore_again(erasures: int) -> None:
    """As long as marks are erased it does not end. Theorem 1 allows 2e = 4 moves.

    Reference: Sec. VI.
    """
    faults = [{"erase_tag": 0, "at": 3 + 2 * number} for number in range(erasures)]
    assert moves(played(STAR, 1, faults=faults, **PAPER).events) == {0: 4 + 2 * erasures}
    assert moves(played(STAR, 1, faults=faults).events) == {0: 4}


class TooLongError(Exception):
    """A run has had more events than it should."""


def test_a_destroyed_device_keeps_the_printed_variant_from_its_end() -> None:
    """Reference: Sec. VI."""
    faults = [{"destroy_tag": 0, "at": 0.5}]
    assert moves(played(STAR, 1, faults=faults).events) == {0: 4}
    scenario = scenario_of(1, faults=faults, **PAPER)
    events: list[Event] = []

    def observe(event: Event) -> None:
        events.append(event)
        if len(events) > 1000:
            raise TooLongError

    world = World(scenario, GraphTerrain(STAR), [0], observe=observe)
    with pytest.raises(TooLongError):
        play(scenario, world, algorithm_of("mr-dfs", scenario.algorithm_options))
    assert moves(events)[0] > 900


def hides(graph: PortGraph, **fields: Any) -> bool:
    run = played(graph, 1, **fields)
    assert run.end.status == "over"
    return len(edges_crossed(graph, of_robots(run.events))) < len(graph.ends)


def test_wrong_marks_hide_places_and_a_checksum_tells_them() -> None:
    """Only an incorrect finished mark can keep a vertex from being visited.

    Reference: Sec. VI.
    """
    faults = [{"corrupt_tag": 0, "at": 0.5}]
    hidden = [
        seed for seed in range(400) if hides(STAR, faults=faults, seed=seed, **UNNOTICED, **PAPER)
    ]
    assert hidden
    for seed in hidden:
        assert hides(STAR, faults=faults, seed=seed, **UNNOTICED)
        assert not hides(STAR, faults=faults, seed=seed)
        assert not hides(STAR, faults=faults, seed=seed, **PAPER)


@pytest.mark.parametrize("options", [PAPER, TREE, {}])
def test_bytes_that_are_no_tag_crash_nobody(options: dict[str, Any]) -> None:
    """Each seed flips other bits, those of the head among them."""
    tree = graph_of("01 02 13 14")
    faults = [{"corrupt_tag": place, "at": at} for place in (0, 1) for at in (0.5, 1.5, 2.5)]
    for seed in range(100):
        run = played(tree, 2, faults=faults, seed=seed, **UNNOTICED, **options)
        assert (run.end.status, run.failures, run.world.refusals) == ("over", {}, {})


# What the corrected variant promises, on random runs.

jitters = st.sampled_from([0, 0.05, 0.5, "exponential"])


@st.composite
def moments(draw: st.DrawFn, until: int, robot: int | None, k: int) -> dict[str, Any]:
    """When a fault strikes; ``robot`` is whom it strikes."""
    if draw(st.booleans()):
        moment: dict[str, Any] = {"at_request": draw(st.integers(1, 3 * until))}
        if robot is None:
            moment["of"] = f"robot:{draw(st.integers(0, k - 1))}"
        return moment
    at = draw(st.integers(0, until)) + draw(st.sampled_from([0, 0, 0.5]))
    return {"at": at, "round": draw(st.integers(0, 3))}


class Case(NamedTuple):
    """A run to play."""

    graph: PortGraph
    robots: int
    fields: dict[str, Any]


@st.composite
def cases(draw: st.DrawFn, places: st.SearchStrategy[PortGraph]) -> Case:
    """Runs in which tags fail at random places and times, and up to all robots but one are lost."""
    graph, k = draw(places), draw(st.integers(1, 4))
    until = 2 * len(graph.ends) + 4
    words = st.sampled_from(["erase_tag", "corrupt_tag", "destroy_tag"])
    place = st.just(0) | st.integers(0, len(graph.names) - 1)
    faults: list[dict[str, Any]] = [
        {draw(words): draw(place), **draw(moments(until, None, k))}
        for _ in range(draw(st.integers(1, 12)))
    ]
    lost = st.lists(st.integers(0, k - 1), unique=True, max_size=k - 1)
    faults += [{"kill": f"robot:{robot}", **draw(moments(until, robot, k))} for robot in draw(lost)]
    fields: dict[str, Any] = {"faults": draw(st.permutations(faults))}
    fields["seed"] = draw(st.integers(0, 1000))
    if draw(st.booleans()):
        fields["clock"] = {"mode": "event", "jitter": draw(jitters)}
    return Case(graph, k, fields)


def assert_ends(case: Case, run: Played, *, epochs: int | None = None) -> None:
    """All come to their end at the start; in each epoch each edge is used once each way."""
    assert (run.end.status, run.failures, run.world.refusals) == ("over", {}, {})
    last = {event.robot: event for event in of_robots(run.events)}
    lost = {robot for robot, event in last.items() if event.what == "killed"}
    assert all(event.place == 0 for robot, event in last.items() if robot not in lost)
    used = crossings(of_robots(run.events))
    epochs = epochs or 1 + len(lost)
    assert max(used.values(), default=0) <= epochs
    assert max(moves(run.events).values(), default=0) <= 2 * len(case.graph.ends) * epochs


def assert_complete(case: Case, run: Played) -> None:
    found = edges_crossed(case.graph, of_robots(run.events))
    assert found == set(range(len(case.graph.ends)))


def judged(case: Case, run: Played, **fields: Any) -> dict[str, Guarantee]:
    """Judge a run; no guarantee may be broken."""
    scenario = scenario_of(case.robots, **{**case.fields, **fields})
    found = verdict(case.graph, run.events, scenario, status=run.end.status)
    assert [guarantee for guarantee in found.values() if guarantee.holds is False] == []
    return found


def verdict(
    graph: PortGraph, events: Iterable[Event], scenario: Scenario, status: Status = "over"
) -> dict[str, Guarantee]:
    ledger = Ledger(graph, [0] * scenario.team.robots, scenario)
    for event in events:
        ledger.observe(event)
    coverage = coverage_of(scenario, ledger)
    found = [*common(ledger, coverage, status), *Brass(scenario, ledger).report(status)]
    return {guarantee.name: guarantee for guarantee in found}


def check_sound(case: Case) -> None:
    """Erased, destroyed and noticed: complete, with losses, in at most so many epochs."""
    run = played(case.graph, case.robots, **case.fields)
    assert_ends(case, run)
    assert_complete(case, run)
    found = judged(case, run)
    assert found["each robot uses each edge once each way"].holds
    assert found["at most 2e steps"].holds
    assert found["every edge traversed"].holds


@settings(max_examples=200)
@given(cases(graphs()))
def test_survivors_complete_though_tags_fail(case: Case) -> None:
    check_sound(case)


@pytest.mark.slow
@settings(max_examples=3000)
@given(cases(graphs(vertices_max=9, extra_max=9)))
def test_survivors_complete_though_tags_fail_at_length(case: Case) -> None:
    check_sound(case)


@settings(max_examples=80)
@given(cases(trees()))
def test_the_tree_version_completes_though_tags_fail(case: Case) -> None:
    run = played(case.graph, case.robots, **case.fields, **TREE)
    assert_ends(case, run, epochs=1)
    assert_complete(case, run)
    judged(case, run, **TREE)


@settings(max_examples=80)
@given(cases(graphs()), st.booleans())
def test_where_losses_are_not_heard_each_robot_completes_by_itself(
    case: Case, checksum: bool
) -> None:
    """So not even wrong marks can hide a place."""
    fields: dict[str, Any] = {
        "radio": {"heartbeat": "reach"},
        "device": {"checksum": checksum},
    }
    run = played(case.graph, case.robots, **case.fields, **fields)
    assert_ends(case, run, epochs=1)
    assert_complete(case, run)
    judged(case, run, **fields)


@settings(max_examples=60)
@given(cases(graphs()), st.data())
def test_a_team_on_old_tags_completes_though_tags_fail(case: Case, data: st.DataObject) -> None:
    earlier = played(case.graph, case.robots, seed=case.fields["seed"], faults=kills_of(case)).world
    pairs = enumerate(zip(earlier.revisions, earlier.tags, strict=True))
    old = {place: TagWrite(place, revision, tag) for place, (revision, tag) in pairs if revision}
    algorithm = algorithm_of("mr-dfs", {})
    fields = {**case.fields, "bookkeeping": {"fresh": False}}
    again = conducted(case.graph, [algorithm] * case.robots, old_tags=old, **fields)
    run = Played(again.world, again.events, again.end, {}, case.robots)
    assert_ends(case, run, epochs=1)
    assert_complete(case, run)
    judged(case, run, bookkeeping={"fresh": False})
    # No device goes back to an older epoch, but for those that failed.
    failed = {event.place for event in run.events if event.robot == NOBODY}
    for place, tag in enumerate(run.world.tags):
        layout = Layout(case.graph.degree(place), case.robots, tree=False)
        if place in old and place not in failed:
            assert unpack(tag, layout).epoch >= unpack(old[place].tag, layout).epoch


def kills_of(case: Case) -> list[dict[str, Any]]:
    return [fault for fault in case.fields["faults"] if "kill" in fault]


def check_wrong(case: Case, **options: Any) -> None:
    """Marks that are wrong and not noticed: it ends; what is not visited is no broken promise."""
    run = played(case.graph, case.robots, **case.fields, **UNNOTICED, **options)
    assert_ends(case, run, epochs=1 if options else None)
    found = judged(case, run, **UNNOTICED, **options)
    visited = found["every vertex visited"]
    assert visited.holds or "device.checksum" in visited.detail


@settings(max_examples=120)
@given(cases(graphs()))
def test_wrong_marks_keep_nobody_from_its_end(case: Case) -> None:
    check_wrong(case)


@settings(max_examples=60)
@given(cases(trees()))
def test_wrong_marks_keep_nobody_from_its_end_on_trees(case: Case) -> None:
    check_wrong(case, **TREE)


@pytest.mark.slow
@settings(max_examples=3000)
@given(cases(graphs(vertices_max=9, extra_max=9)))
def test_wrong_marks_keep_nobody_from_its_end_at_length(case: Case) -> None:
    check_wrong(case)


@settings(max_examples=60)
@given(graphs(), st.integers(1, 4), st.none() | jitters, st.integers(0, 1000))
def test_faults_that_come_too_late_change_no_move(
    graph: PortGraph, k: int, jitter: float | str | None, seed: int
) -> None:
    """To remember costs nothing as long as devices are sound: the moves are those without it."""
    clock = {} if jitter is None else {"mode": "event", "jitter": jitter}
    plain = played(graph, k, clock=clock, seed=seed)
    wary = played(graph, k, clock=clock, seed=seed, faults=[{"erase_tag": 0, "at": 1e9}])
    assert moves_of(wary.events) == moves_of(plain.events)
    assert wary.stops() == plain.stops()


def moves_of(events: Iterable[Event]) -> list[tuple[float, int, int | None, int]]:
    return [
        (event.time, event.robot, event.place, event.what.exit)
        for event in events
        if isinstance(event.what, Move)
    ]


@pytest.mark.parametrize("robots", [2, 3, 4])
def test_nobody_waits_for_ever_at_a_start_without_a_device(robots: int) -> None:
    """Nobody is woken there, neither by those who come back nor by a new epoch."""
    graph = graph_of("01 02 12 13 23 33 04")
    for at in (0, 0.5, 3, 5.5):
        for loss in ([], [{"kill": "robot:1", "at": 4, "round": 1}]):
            faults = [{"destroy_tag": 0, "at": at}, *loss]
            case = Case(graph, robots, {"faults": faults})
            run = played(graph, robots, faults=faults)
            assert_ends(case, run)
            assert_complete(case, run)


HIDDEN = graph_of("0-1 0-2 0-7 7-8 8-9 9-10 1-3 2-3 3-4 3-5 3-6 4-2 5-1")
"""Where two robots of three that are lost leave marks that hide an edge (test_mr_dfs.py)."""


@pytest.mark.parametrize("moment", [{"at": 6.0, "round": 1}, {"at": 6.5}])
@pytest.mark.parametrize("word", ["erase_tag", "destroy_tag"])
@pytest.mark.parametrize("at", [0.5, 5.0, 8.5, 11.5, 13.0])
def test_an_epoch_begins_after_losses_though_the_start_forgets_its_number(
    moment: dict[str, float], word: str, at: float
) -> None:
    faults: list[dict[str, Any]] = [{"kill": f"robot:{robot}", **moment} for robot in (0, 1)]
    faults.append({word: 0, "at": at})
    check_sound(Case(HIDDEN, 3, {"faults": faults}))


def test_the_roll_must_be_full_three_times_running() -> None:
    """Whoever passes through the start, back to it or on, is gone by the third round."""
    robot = reading()
    body = Body(Briefing(0, 2, 0, "mr-dfs", {}, 99, "global", True, devices_fail=True))
    calling = last_call(body, sight(b"x", here=(1,)), frozenset({1}), robot)
    assert isinstance(calling.send(None), Look)
    assert isinstance(calling.send(sight(b"x", here=(1,))), Look)
    assert calling.send(sight(b"x")) == WaitForNews()
    assert isinstance(calling.send(sight(b"x", here=(1,))), Look)
    assert isinstance(calling.send(sight(b"x", here=(1,))), Look)
    with pytest.raises(StopIteration):
        calling.send(sight(b"x", here=(1,)))


def test_a_robot_that_is_called_home_uses_no_edge_a_third_time() -> None:
    """It came back to a vertex that it had left by its entry, and others had begun anew there."""
    graph = graph_of("44 24 03 34 24 30 23 01 12")
    faults = [
        {"destroy_tag": 0, "at": 8, "round": 2},
        {"kill": "robot:2", "at": 4, "round": 1},
        {"erase_tag": 1, "at": 6},
        {"erase_tag": 2, "at": 5, "round": 3},
        {"erase_tag": 3, "at": 4, "round": 1},
    ]
    case = Case(graph, 3, {"faults": faults})
    check_sound(case)


# The verdict.


def run_of_one(*faults: dict[str, Any]) -> tuple[list[Event], Scenario]:
    scenario = scenario_of(1, faults=list(faults))
    return played(STAR, 1, faults=list(faults)).events, scenario


def test_failures_of_devices_are_counted_and_no_violation() -> None:
    events, scenario = run_of_one(
        {"erase_tag": 2, "at": 1.0}, {"destroy_tag": 0, "at_request": 4, "of": "robot:0"}
    )
    ledger = Ledger(STAR, [0], scenario)
    for event in events:
        ledger.observe(event)
    assert ledger.tag_faults == [(1.0, 2, "erased"), (2.0, 0, "destroyed")]
    assert (ledger.violations, ledger.first_violation) == (0, None)
    assert ledger.events == len(events)
    assert not ledger.wrong_tags
    physics = verdict(STAR, events, scenario)["physics"]
    assert (
        physics.detail
        == f"{len(events)} events, all possible; failures of devices, as scheduled: 2"
    )


def fault_at(events: Sequence[Event]) -> int:
    return next(index for index, event in enumerate(events) if event.robot == NOBODY)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"time": 0.75}, "the scenario has no such fault"),
        ({"place": 1}, "the scenario has no such fault"),
        ({"what": "destroyed"}, "the scenario has no such fault"),
        ({"round": 1}, "the scenario has no such fault"),
        ({"place": 3}, "there is no such device"),
        ({"place": None}, "there is no such device"),
        ({"time": 0.0, "round": -1}, "comes after a later event"),
    ],
)
def test_failures_that_cannot_be_are_violations(fields: dict[str, Any], words: str) -> None:
    events, scenario = run_of_one({"erase_tag": 2, "at": 0.5})
    index = fault_at(events)
    events[index] = msgspec.structs.replace(events[index], **fields)
    physics = verdict(STAR, events, scenario)["physics"]
    assert physics.holds is False
    assert words in physics.detail


def test_one_fault_of_a_scenario_is_one_failure() -> None:
    events, scenario = run_of_one({"erase_tag": 2, "at": 0.5})
    index = fault_at(events)
    doubled = [*events[:index], events[index], *events[index:]]
    assert verdict(STAR, doubled, scenario)["physics"].holds is False
    without = [event for event in events if event.robot != NOBODY]
    assert verdict(STAR, without, scenario)["physics"].holds


def test_devices_fail_before_the_requests_of_their_wave() -> None:
    events, scenario = run_of_one({"erase_tag": 0, "at_request": 2, "of": "robot:0"})
    index = fault_at(events)
    events[index], events[index + 1] = events[index + 1], events[index]
    detail = verdict(STAR, events, scenario)["physics"].detail
    assert "devices fail before the requests of their wave" in detail


def test_a_fault_in_place_of_a_request_comes_right_before_it() -> None:
    events, scenario = run_of_one({"erase_tag": 0, "at_request": 3, "of": "robot:0"})
    index = fault_at(events)
    failure = events[index]
    assert (failure.time, failure.round, failure.wave) == (1.0, 0, 0)
    for early in (1, 2):
        first = events[index - early]
        moved = msgspec.structs.replace(failure, time=first.time, round=first.round)
        changed = [*events[: index - early], moved, *events[index - early : index]]
        changed += events[index + 1 :]
        physics = verdict(STAR, changed, scenario)["physics"]
        assert physics.holds is False
        assert "the scenario has no such fault" in physics.detail


def test_faults_of_one_moment_are_told_apart() -> None:
    """The first of them may be either; the second is of an earlier round, or of another robot."""
    faults: list[dict[str, Any]] = [
        {"erase_tag": 0, "at": 2, "round": round_} for round_ in (2, 1, 0)
    ]
    faults += [{"erase_tag": 0, "at_request": n, "of": "robot:0"} for n in (2, 3, 4)]
    faults += [{"erase_tag": 0, "at_request": n, "of": "robot:1"} for n in (2, 3, 4)]
    events = played(STAR, 2, faults=faults).events
    assert sum(event.robot == NOBODY for event in events) == len(faults)
    assert verdict(STAR, events, scenario_of(2, faults=faults))["physics"].holds


def test_bounds_that_assume_sound_devices_do_not_apply() -> None:
    faults = [{"erase_tag": 0, "at": 1.0}]
    events = played(STAR, 2, faults=faults).events
    found = verdict(STAR, events, scenario_of(2, faults=faults))
    reason = "failures of devices: 1"
    for name in (
        "all robots finish at the same step",
        "bounded excess multiplicity",
        "T <= min(2e, (2e + 2f)/k)",
        "two robots: T <= e + r",
    ):
        assert found[name].holds is None
        assert reason in found[name].detail
    for name in ("each robot uses each edge once each way", "at most 2e steps"):
        assert found[name].holds


def test_of_the_printed_variant_nothing_is_said_where_a_device_failed() -> None:
    faults = [{"erase_tag": 0, "at": 3}]
    events = played(STAR, 1, faults=faults, **PAPER).events
    found = verdict(STAR, events, scenario_of(1, faults=faults, **PAPER))
    for name in ("each robot uses each edge once each way", "at most 2e steps"):
        assert (found[name].holds, found[name].detail) == (None, "failures of devices: 1")
    assert found["every edge traversed"].holds
    assert found["physics"].holds


def test_what_a_wrong_mark_hides_is_judged_with_its_reason() -> None:
    faults = [{"corrupt_tag": 0, "at": 0.5}]
    seed = next(seed for seed in range(400) if hides(STAR, faults=faults, seed=seed, **UNNOTICED))
    fields = {"faults": faults, "seed": seed, **UNNOTICED}
    events = played(STAR, 1, **fields).events
    found = verdict(STAR, events, scenario_of(1, **fields))
    for name, detail in (
        ("every vertex visited", "2 of 3 vertices visited"),
        ("every edge traversed", "1 of 2 edges traversed"),
    ):
        assert found[name].holds is None
        assert found[name].detail.startswith(detail)
        assert "wrong marks can hide places" in found[name].detail
    assert [name for name, guarantee in found.items() if guarantee.holds is False] == []


def test_a_place_that_is_missed_though_all_was_noticed_is_a_broken_promise() -> None:
    faults = [{"erase_tag": 0, "at": 0.5}]
    scenario = scenario_of(1, faults=faults)
    events = [
        Event(0.0, -1, 0, 0, 0, None, Look(), 0),
        Event(0.5, 0, -1, NOBODY, 0, None, "erased", 0),
        Event(0.5, 0, 0, 0, 0, None, Stop(), 0),
    ]
    found = verdict(STAR, events, scenario)
    assert found["every vertex visited"].holds is False
    assert found["every edge traversed"].holds is False
