"""ORMSTC on a radio that loses messages or does not reach everybody: what still holds.

The table of `agents.algorithms.ormstc_gossip`, line by line; then how notes travel.
"""

from collections import Counter
from collections.abc import Callable
from math import inf
from random import Random
from typing import Any, Literal

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from agents.algorithms.claims import Claim, Start
from agents.algorithms.gossip_body import (
    CELLS,
    NOTES,
    ROWS,
    Beside,
    Covered,
    Gossip,
    Packet,
    Row,
    read_note,
    read_packet,
)
from agents.algorithms.gossip_claims import GossipClaims
from agents.algorithms.ormstc import Explorer
from agents.algorithms.ormstc_gossip import GossipExplorer
from agents.algorithms.stc import located
from protocol.codec import encode
from protocol.errors import MessageError
from protocol.grid import Cell, sub_cells
from protocol.line_of_sight import in_sight
from protocol.messages import AnyRequest, Briefing, GridSight, RadioFacts, Stop
from tests.coverage_runs import Covered as Run
from tests.coverage_runs import (
    Little,
    any_kills,
    circumstances,
    coarse_grid,
    covered,
    explorers,
    little,
    littles,
)

randoms = st.randoms(use_true_random=False)


# Radios, and runs on them.


def lossy(rng: Random) -> dict[str, Any]:
    """Loses messages, doubles some, and may take time."""
    return {
        "reach": "global",
        "loss": rng.choice([0.1, 0.3, 0.6]),
        "duplicate": rng.choice([0.0, 0.2, 0.5]),
        "latency": rng.choice([0.0, 0.0, 0.3, 1.0, 2.0]),
    }


def limited(rng: Random) -> dict[str, Any]:
    """Does not reach everybody, and may lose messages, too."""
    reach = rng.choice(["radius"] * 6 + ["same-place", "none"])
    radio = {"reach": reach, "latency": rng.choice([0.0, 0.0, 0.3, 1.0, 3.5])}
    if reach == "radius":
        radio["radius_m"] = rng.choice([1.5, 2.5, 4.0, 100.0])
        radio["line_of_sight"] = rng.random() < 0.5
    return {
        **radio,
        "loss": rng.choice([0.0, 0.0, 0.3]),
        "heartbeat": rng.choice(["global", "reach"]),
    }


def run_on(
    world: Little, rng: Random, radio: dict[str, Any], /, *, kills: bool = True, **fields: Any
) -> Run:
    """Play a world in any circumstances, with losses at any time unless ``kills`` is false."""
    drawn = circumstances(rng, len(world.starts))
    drawn["faults"] = any_kills(rng, world) if kills else []
    drawn = {**drawn, **fields, "radio": radio}
    return covered(coarse_grid(world.rows), world.starts, **drawn)


def stops_of(run: Run) -> dict[int, float]:
    return {event.robot: event.time for event in run.events if isinstance(event.what, Stop)}


def stops_on_facts(run: Run) -> None:
    """Check that nobody stopped before all was covered that can be reached from its start."""
    for robot, time in stops_of(run).items():
        row, col = run.starts[robot]
        cells = run.grid.reachable_cells([(row // 2, col // 2)])
        assert all(run.first.get(at, inf) <= time for cell in cells for at in sub_cells(cell))


def packets_of(run: Run) -> list[tuple[float, int, Packet]]:
    return [
        (event.time, event.robot, read_packet(message))
        for event in run.events
        if not isinstance(event.what, str)
        for message in event.what.messages
    ]


def sends_little(run: Run) -> None:
    """Check that there is no storm: a packet a request, four an instant, and these are bounded."""
    sent: Counter[tuple[float, int]] = Counter()
    for event in run.events:
        if not isinstance(event.what, str):
            assert len(event.what.messages) <= 1
            sent[event.time, event.robot] += len(event.what.messages)
    assert max(sent.values(), default=0) <= 4
    for _, _, packet in packets_of(run):
        assert len(packet.notes) <= NOTES
        assert len(packet.rows) <= ROWS + 1


# Global, with loss and duplicates.


@settings(max_examples=150)
@given(littles(side=5, robots=4), randoms)
def test_lost_messages_cost_time_only(world: Little, rng: Random) -> None:
    """Theorems 4, 5 and 6: a cell is entered when all have acknowledged the claim."""
    run = run_on(world, rng, lossy(rng))
    run.keeps_the_theorems()
    stops_on_facts(run)
    sends_little(run)


@settings(max_examples=60)
@given(littles(side=5, robots=4), randoms)
def test_duplicates_alone_change_nothing(world: Little, rng: Random) -> None:
    run_on(world, rng, {"duplicate": 0.5, "latency": rng.choice([0.0, 1.0])}).keeps_the_theorems()


@pytest.mark.parametrize("loss", [0.1, 0.3, 0.6])
def test_a_team_covers_a_larger_place_once(loss: float) -> None:
    rows = ["........", "..#.....", ".##..#..", "........", "....#...", "...##..."]
    starts = [(0, 0), (0, 1), (11, 15), (6, 6), (11, 0)]
    covered(coarse_grid(rows), starts, radio={"loss": loss}).keeps_the_theorems()


def test_who_is_lost_in_the_midst_of_a_claim_is_not_waited_for() -> None:
    """Moments of death: each request of one robot while the others wait for it."""
    grid, starts = coarse_grid(["...", "..."]), [(0, 0), (0, 4), (3, 3)]
    for n in range(1, 60):
        faults = [{"kill": "robot:1", "at_request": n}]
        covered(grid, starts, radio={"loss": 0.3}, faults=faults).is_complete()


# Limited reach.


@settings(max_examples=150)
@given(littles(side=5, robots=4), randoms)
def test_out_of_reach_all_is_still_covered(world: Little, rng: Random) -> None:
    """Theorems 4 and 6, whoever hears of whom, and of which losses."""
    run = run_on(world, rng, limited(rng))
    run.is_complete()
    stops_on_facts(run)
    sends_little(run)


def in_touch(run: Run, radius: float, *, line_of_sight: bool = False) -> tuple[bool, bool]:
    """Tell whether the radio connects all robots in every tick until one stops, and if directly."""
    end = int(min(stops_of(run).values()))
    at = {(int(event.time), event.robot): event.place for event in run.events}
    now = [run.grid.place(*start) for start in run.starts]
    directly = True

    def hears(one: Cell, other: Cell) -> bool:
        near = (one[0] - other[0]) ** 2 + (one[1] - other[1]) ** 2 <= radius**2
        return near and (not line_of_sight or in_sight(run.grid, one, other))

    for tick in range(end):
        now = [at.get((tick, robot)) or place for robot, place in enumerate(now)]
        cells = [run.grid.position(place) for place in now]
        reached = {0}
        for _ in run.robots:
            reached |= {n for n in run.robots if any(hears(cells[n], cells[m]) for m in reached)}
        if len(reached) < len(cells):
            return False, False
        directly = directly and all(hears(one, other) for one in cells for other in cells)
    return True, directly


def test_robots_in_touch_cover_nothing_twice() -> None:
    """Theorem 5, also where news come by relays only."""
    relayed = 0
    for seed in range(200):
        rng = Random(f"in touch {seed}")
        world = little(rng, side=5, robots=6)
        radius, sight = rng.choice([3.0, 4.0, 5.0, 6.0]), rng.random() < 0.3
        latency = rng.choice([0.0, 0.0, 1.0])
        radio = {
            "reach": "radius",
            "radius_m": radius,
            "line_of_sight": sight,
            "latency": latency,
        }
        run = run_on(world, rng, radio, kills=False, clock={"mode": "lockstep"}, team={})
        run.is_complete()
        connected, directly = in_touch(run, radius, line_of_sight=sight)
        if connected:
            run.keeps_the_theorems()
            relayed += not directly
    assert relayed > 20


def test_robots_that_never_hear_of_each_other_cover_everything_each() -> None:
    grid, starts = coarse_grid(["....", "...."]), [(0, 0), (3, 7)]
    run = covered(grid, starts, radio={"reach": "none"})
    run.is_complete()
    assert [len(set(walk)) for walk in run.walks] == [32, 32]
    assert packets_of(run) == []


def test_a_spare_robot_that_is_left_alone_does_not_wait_for_ever() -> None:
    """Its cell has an owner, which is lost far away; nobody is told."""
    radio = {"reach": "radius", "radius_m": 2.0, "heartbeat": "reach"}
    faults = [{"kill": "robot:1", "at": 20.0}]
    grid = coarse_grid(["." * 12])
    run = covered(grid, [(0, 0), (0, 1)], radio=radio, faults=faults)
    run.is_complete()
    assert run.moves[0] > 0


def test_a_relay_carries_claims_between_two_that_do_not_hear_each_other() -> None:
    """The one in the middle stays there, as it is spare; the two at the ends meet at its place."""
    radio = {"reach": "radius", "radius_m": 7.0}
    starts = [(0, 0), (0, 13), (1, 6), (0, 6)]
    run = covered(coarse_grid(["......."]), starts, radio=radio)
    run.keeps_the_theorems()


def test_what_another_has_covered_need_not_be_covered_again_when_it_dies() -> None:
    """R10 without a reliable radio: that a cell is covered is passed on."""
    radio = {"reach": "radius", "radius_m": 100.0}
    grid, starts = coarse_grid(["........"]), [(0, 15), (0, 0)]
    once = covered(grid, starts, radio=radio)
    last = max(once.done_at, key=lambda time: time or 0) or 0
    faults = [{"kill": "robot:1", "at": last - 1}]
    run = covered(grid, starts, radio=radio, faults=faults)
    run.is_complete()
    assert run.lost == {1}
    assert run.extra <= once.extra


# Both.


@pytest.mark.slow
@pytest.mark.parametrize("radio", [lossy, limited])
def test_survivors_complete_many_times(radio: Callable[[Random], dict[str, Any]]) -> None:
    for seed in range(1000):
        rng = Random(f"gossip {seed}")
        world = little(rng, side=rng.choice([4, 6, 9]), robots=6)
        run = run_on(world, rng, radio(rng))
        assert (run.errors, run.status, run.missing) == ([], "over", set()), seed
        if radio is lossy and not run.lost:
            assert not run.twice, seed
        stops_on_facts(run)
        sends_little(run)


@settings(max_examples=40)
@given(littles(side=4, robots=4), randoms)
def test_runs_end_where_nothing_is_claimed(world: Little, rng: Random) -> None:
    """Bodies that block, robots that lose their way: no guarantee, but an end."""
    fields: dict[str, Any] = {"world": {"bodies": rng.choice(["block", "pass"])}}
    if rng.random() < 0.5:
        fields["sensing"] = {"position": "odometry", "drift": 0.2}
    run = run_on(world, rng, rng.choice([lossy, limited])(rng), **fields)
    assert (run.errors, run.status) == ([], "over")


@settings(max_examples=40)
@given(littles(side=4, robots=4), randoms, st.sampled_from([0.0, 1.0, 30.0, inf]))
def test_patience_is_a_matter_of_time_and_of_theorem_5_only(
    world: Little, rng: Random, patience: float
) -> None:
    options = {"patience": patience}
    run_on(world, rng, rng.choice([lossy, limited])(rng), algorithm_options=options).is_complete()


@pytest.mark.parametrize(
    ("radio", "kind"),
    [
        ({}, Explorer),
        ({"latency": 2.0}, Explorer),
        ({"duplicate": 0.5}, Explorer),
        ({"heartbeat": "reach"}, Explorer),
        ({"loss": 0.1}, GossipExplorer),
        ({"reach": "radius", "radius_m": 9.0}, GossipExplorer),
        ({"reach": "same-place"}, GossipExplorer),
        ({"reach": "none"}, GossipExplorer),
    ],
)
def test_a_reliable_radio_needs_no_gossip(radio: dict[str, Any], kind: type[Explorer]) -> None:
    with explorers() as robots:
        covered(coarse_grid(["..."]), [(0, 0), (1, 5)], radio=radio).is_complete()
    assert {type(robot) for robot in robots.values()} == {kind}


@pytest.mark.parametrize(
    "radio", [{"loss": 0.3}, {"reach": "radius", "radius_m": 3.0, "loss": 0.3}]
)
def test_the_same_seed_loses_the_same_messages(radio: dict[str, Any]) -> None:
    grid, starts = coarse_grid(["...", ".#.", "..."]), [(0, 0), (5, 5), (0, 5)]
    runs = [covered(grid, starts, radio=radio, seed=seed).events for seed in (1, 1, 2)]
    assert runs[0] == runs[1] != runs[2]


def test_a_robot_by_itself_talks_to_nobody() -> None:
    run = covered(coarse_grid(["..", ".."]), [(0, 0)], radio={"loss": 0.6})
    run.keeps_the_theorems()
    assert packets_of(run) == []


def test_the_radio_is_about_as_busy_as_the_robots() -> None:
    """A packet a robot and tick, and a few for claims."""
    rows = ["......"] * 6
    starts = [(0, 0), (0, 11), (11, 0), (11, 11)]
    run = covered(coarse_grid(rows), starts, radio={"loss": 0.3})
    ticks = max(stops_of(run).values())
    assert ticks <= len(packets_of(run)) / len(starts) <= 1.5 * ticks


# How notes travel.


def gossip_of(
    robot: int,
    *,
    team_size: int = 3,
    reach: str = "radius",
    heartbeat: Literal["global", "reach"] = "global",
    lossy: bool = False,
) -> Gossip:
    radio = RadioFacts(reach, 0.0, lossy)
    return Gossip(Briefing(robot, team_size, 0, "", {}, 0, heartbeat, True, radio), None)


def sight(time: float, *inbox: tuple[int, bytes], losses: tuple[int, ...] = ()) -> GridSight:
    return GridSight(time, 0, None, 4, b"", 0, alone=True, inbox=inbox, losses=losses)


def ask(body: Gossip, time: float, *inbox: tuple[int, bytes], **more: Any) -> Any:
    """Let a body wait; return what it sends, and what it hears."""
    steps = body.wait()
    request: AnyRequest = steps.send(None)
    try:
        steps.send(sight(time, *inbox, **more))
    except StopIteration as stop:
        return request.messages, stop.value
    raise AssertionError("asked twice")


NOTE = [encode(Claim(0.0, number, 1)) for number in range(100)]


def test_notes_come_in_order_and_once() -> None:
    sender, hearer = gossip_of(0), gossip_of(1)
    sender.say(*NOTE[:3])
    first = read_packet(ask(sender, 1.0)[0][0])
    assert [note[:2] for note in first.notes] == [(0, 0), (0, 1), (0, 2)]
    parts = [encode(Packet(first.rows, (note,))) for note in first.notes]
    _, here = ask(hearer, 1.0, (0, parts[2]), (0, parts[0]), (0, parts[0]))
    assert here.inbox == ((0, NOTE[0]),)
    _, here = ask(hearer, 2.0, (0, parts[1]))
    assert here.inbox == ((0, NOTE[1]), (0, NOTE[2]))
    _, here = ask(hearer, 3.0, *((0, part) for part in parts))
    assert here.inbox == ()


def test_a_note_is_repeated_until_it_was_heard() -> None:
    sender, hearer = gossip_of(0, team_size=2), gossip_of(1, team_size=2)
    (beacon,), _ = ask(hearer, 0.0)
    ask(sender, 0.0, (1, beacon))
    sender.say(NOTE[0])
    for time in (1.0, 2.0, 3.0):
        (packet,), _ = ask(sender, time)
        assert read_packet(packet).notes == ((0, 0, NOTE[0]),)
    ask(hearer, 3.0, (0, packet))
    (beacon,), _ = ask(hearer, 4.0)
    ask(sender, 4.0, (1, beacon))
    (packet,), _ = ask(sender, 5.0)
    assert read_packet(packet).notes == ()


def test_a_relay_passes_notes_and_rows_on() -> None:
    near, relay, far = gossip_of(0), gossip_of(1), gossip_of(2)
    (beacon,), _ = ask(far, 1.0)
    near.say(NOTE[0])
    (packet,), _ = ask(near, 1.0)
    ask(relay, 2.0, (0, packet), (2, beacon))
    (packet,), _ = ask(relay, 3.0)
    _, here = ask(far, 4.0, (1, packet))
    assert here.inbox == ((0, NOTE[0]),)
    assert far.rows[0].counts == (1, 0, 0)
    assert relay.waits_for(0)
    assert not far.is_silent(0)


def test_a_packet_is_bounded() -> None:
    body = gossip_of(0, team_size=40)
    rows = [Row(robot, 1.0, (0,) * 40) for robot in range(1, 40)]
    ask(body, 1.0, (1, encode(Packet(tuple(rows)))))
    body.say(*NOTE)
    numbers: list[int] = []
    heard: Counter[int] = Counter()
    for tick in range(2, 7):
        (packet,), _ = ask(body, float(tick))
        assert len(read_packet(packet).rows) == ROWS + 1
        assert len(read_packet(packet).notes) <= NOTES
        numbers += [number for _, number, _ in read_packet(packet).notes]
        heard.update(row.robot for row in read_packet(packet).rows)
    assert set(numbers) == set(range(100))
    assert len(heard) > 20  # each has its turn


def test_only_new_notes_are_answered_and_once_an_instant() -> None:
    one, other = gossip_of(0), gossip_of(1)
    one.say(NOTE[0])
    (packet,), _ = ask(one, 1.0)
    ask(other, 1.0, (0, packet))
    answer = other.exchange().send(None).messages
    assert len(answer) == 1
    ask(one, 1.0, (1, answer[0]))
    assert one.exchange().send(None).messages == ()
    assert other.exchange().send(None).messages == ()


def test_losses_are_passed_on_where_not_all_hear_of_them() -> None:
    witness, other = gossip_of(0, heartbeat="reach"), gossip_of(1)
    ask(witness, 1.0, losses=(2,))
    (packet,), _ = ask(witness, 2.0)
    _, here = ask(other, 2.0, (0, packet))
    assert here.losses == (2,)
    _, here = ask(other, 3.0, (0, packet), losses=(2,))
    assert here.losses == ()


def test_who_is_waited_for() -> None:
    body = gossip_of(0, team_size=3)
    for time, waits, silent in [(4.0, True, False), (5.0, False, False), (16.0, False, True)]:
        ask(body, time)
        assert (body.waits_for(1), body.is_silent(1)) == (waits, silent)
    ask(body, 17.0, (1, encode(Packet((Row(1, 16.0, (0, 0, 0)),)))))
    assert (body.waits_for(1), body.waits_for(2)) == (True, False)
    ask(body, 18.0, (1, encode(Packet((Row(1, 17.0, (0, 0, 0), done=True),)))))
    assert not body.waits_for(1)
    everywhere = gossip_of(0, reach="global", lossy=True)
    for time, waits in [(255.0, True), (256.0, False)]:
        ask(everywhere, time)
        assert everywhere.waits_for(1) == waits
    nowhere = gossip_of(0, reach="none")
    assert not nowhere.waits_for(1)


@given(st.binary(max_size=40))
@example(encode(Start(0)))
def test_what_is_no_packet_is_refused(data: bytes) -> None:
    try:
        packet = read_packet(data)
    except MessageError:
        return
    assert read_packet(encode(packet)) == packet


# What is covered.


def at(row: int, col: int) -> int:
    return located((2 * row, 2 * col))[0]


def claims_of(*notes: tuple[int, Any]) -> GossipClaims:
    claims = GossipClaims(3, fewest=False, lazy=True)
    for sender, note in notes:
        claims.hear(sender, read_note(encode(note)))
    return claims


HALF = (
    (0, Start(at(0, 0))),
    (1, Start(at(0, 3))),
    (0, Claim(1.0, at(0, 1), 1)),
    (1, Claim(1.0, at(0, 2), 1)),
    (0, Beside((at(0, 2),))),
    (0, Covered()),
)
"""Two robots in a row of four cells; one has covered its two."""


def test_what_lies_beside_covered_cells_is_left() -> None:
    claims = claims_of(*HALF)
    assert claims.around(at(0, 0), set()) == ({at(0, 0), at(0, 1)}, {at(0, 2)})
    assert claims.around(at(0, 0), {at(0, 2)}) == ({at(0, 0), at(0, 1)}, set())
    assert claims.awaited({at(0, 2)}) == {1}
    claims.hear(1, Covered())
    assert claims.around(at(0, 0), set()) == ({at(0, col) for col in range(4)}, set())


def test_what_the_dead_have_covered_stays_covered_until_it_is_in_the_way() -> None:
    claims = claims_of(*HALF)
    claims.replay(
        [[encode(note) for who, note in HALF if who == robot] for robot in range(3)], {0}, {1}
    )
    assert [claims.is_open(at(0, col)) for col in range(4)] == [False, False, True, True]
    assert claims.awaited({at(0, 2)}) == set()
    claims.freed = True
    assert claims.is_open(at(0, 0))


def test_facts_of_the_dead_count_also_when_they_come_late() -> None:
    claims = claims_of(*HALF)
    claims.bury(1)
    claims.hear(1, Claim(2.0, at(0, 4), 2))
    assert at(0, 4) in claims.known
    assert claims.is_open(at(0, 4))
    claims.hear(1, Covered())
    assert not claims.is_open(at(0, 4))


def test_a_long_border_is_told_in_parts() -> None:
    rows = ["".join(".#"[(row + col) % 2] for col in range(3)) for row in range(3)]
    assert CELLS == 64
    with explorers() as robots:
        covered(coarse_grid(rows), [(0, 0), (0, 1)], radio={"loss": 0.1})
    robot = robots[1]
    assert isinstance(robot, GossipExplorer)
    robot.border = {at(9, col): {(at(8, col), 2)} for col in range(150)}
    robot.claims.held[1].add(at(8, 0))
    notes = [read_note(note) for note in robot.announced()]
    assert [len(note.cells) for note in notes if isinstance(note, Beside)] == [64, 64, 22]
    assert isinstance(notes[-1], Covered)
    assert robot.announced() == ()
