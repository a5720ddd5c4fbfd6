"""The radio on grids: how far it reaches, what is in its way, and what becomes of messages."""

from itertools import combinations
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.body import Body
from protocol.grid import EAST, Cell, Grid
from protocol.messages import AnyRequest, Exchange, GridSight, Look, Move, Stop, Wait, WaitForNews
from protocol.trace import first_difference
from tests.play import asking, conducted, graph_of, grids, line_is_clear
from world_server.world import End

CORRIDOR = Grid(1, 12, bytes(12))
NO_DEVICES: dict[str, Any] = {"device": {"capacity_bytes": 0}}
EVENT: dict[str, Any] = {"clock": {"mode": "event"}}


def say(*messages: bytes) -> Exchange:
    return Exchange(None, messages)


def wait(duration: float = 1.0) -> Wait:
    return Wait(None, (), duration)


def listen(at_most: float | None = None) -> WaitForNews:
    return WaitForNews(None, (), at_most)


def move(exit_: int, *messages: bytes) -> Move:
    return Move(None, messages, exit_)


def heard(
    requests: list[list[AnyRequest]], cols: list[int], grid: Grid = CORRIDOR, **fields: Any
) -> list[list[tuple[float, list[bytes]]]]:
    """Let robots act in the first row; return when each saw something, and what it then heard."""
    seen: list[list[GridSight]] = [[] for _ in requests]
    scripts = [asking(*each, seen=sights) for each, sights in zip(requests, seen, strict=True)]
    conducted(grid, scripts, starts=[grid.place(0, col) for col in cols], **fields)
    return [
        [(sight.time, [message for _, message in sight.inbox]) for sight in sights]
        for sights in seen
    ]


def news(of: list[tuple[float, list[bytes]]]) -> list[tuple[float, list[bytes]]]:
    """Return the instants at which a robot heard something."""
    return [(time, messages) for time, messages in of if messages]


# Reach.


@settings(max_examples=60)
@given(grids(), st.sampled_from([1.0, 2.0, 4.0, 5.0, 8.0, 25.0]), st.booleans(), st.data())
def test_who_is_within_a_radius_hears(
    grid: Grid, squared: float, line_of_sight: bool, data: st.DataObject
) -> None:
    radius_m = (squared + 1e-6) ** 0.5 * grid.cell_m
    cell = st.sampled_from(grid.free_cells())
    cells: list[Cell] = data.draw(st.lists(cell, min_size=2, max_size=6))
    radio = {"reach": "radius", "radius_m": radius_m, "line_of_sight": line_of_sight}
    seen: list[list[GridSight]] = [[] for _ in cells]
    scripts = [asking(say(bytes([robot])), Look(), seen=seen[robot]) for robot in range(len(cells))]
    conducted(
        grid, scripts, starts=[grid.place(*cell) for cell in cells], radio=radio, **NO_DEVICES
    )

    def hears(one: Cell, other: Cell) -> bool:
        near = (one[0] - other[0]) ** 2 + (one[1] - other[1]) ** 2 <= squared
        return near and (not line_of_sight or line_is_clear(grid, one, other))

    for robot, sights in enumerate(seen):
        others = [other for other in range(len(cells)) if other != robot]
        expected = [other for other in others if hears(cells[other], cells[robot])]
        assert sights[1].inbox == tuple((other, bytes([other])) for other in expected)


@pytest.mark.parametrize(
    ("cell_m", "radius_m", "farthest"),
    # 0.3 / 0.1 is a little less than 3 in floats
    [(1.0, 3.0, 3), (1.0, 2.99, 2), (0.5, 2.0, 4), (0.1, 0.3, 3), (2.0, 3.9, 1), (0.2, 0.1, 0)],
)
def test_a_radius_is_in_metres(cell_m: float, radius_m: float, farthest: int) -> None:
    grid = Grid(1, 12, bytes(12), cell_m)
    radio = {"reach": "radius", "radius_m": radius_m}
    listeners: list[list[AnyRequest]] = [[Look()] for _ in range(12)]
    ends = heard([[say(b"x")], *listeners], [0, *range(12)], grid, radio=radio, **NO_DEVICES)
    assert [bool(news(each)) for each in ends[1:]] == [col <= farthest for col in range(12)]


def test_a_wall_is_in_the_way_of_a_line_of_sight_only() -> None:
    grid = Grid.of_text("..#..\n.....")
    for line_of_sight, reached in ((False, [True, True]), (True, [True, False])):
        radio = {"reach": "radius", "radius_m": 9.0, "line_of_sight": line_of_sight}
        requests: list[list[AnyRequest]] = [[say(b"x")], [Look()], [Look()]]
        ends = heard(requests, [0, 1, 4], grid, radio=radio, **NO_DEVICES)
        assert [bool(news(each)) for each in ends[1:]] == reached


def test_a_robot_under_way_is_where_it_left_from() -> None:
    radio = {"reach": "radius", "radius_m": 2.0}
    requests: list[list[AnyRequest]] = [
        [wait(), say(b"x")],
        [wait(), move(EAST)],  # within reach when it leaves, in this very instant
        [move(EAST), wait()],  # out of reach by the time of sending
        [wait(2)],
    ]
    fields: dict[str, Any] = {"radio": radio, "team": {"speed": [1.0, 1.0, 0.4, 1.0]}}
    ends = heard(requests, [0, 2, 2, 3], **fields, **EVENT)
    assert news(ends[1]) == [(2.0, [b"x"])]
    assert news(ends[2]) == [(2.5, [b"x"])]  # it left at 0 and arrives at 2.5
    assert news(ends[3]) == []


def test_a_robot_that_drifted_is_heard_where_it_is() -> None:
    """Not where it believes to be, beside the other."""
    seen: list[list[GridSight]] = [[], []]
    grid = Grid(9, 9, bytes(81))
    walk = [move(EAST), move(3)] * 20
    scripts = [
        asking(*walk, say(b"x"), seen=seen[0]),
        asking(wait(40), Look(), Look(), seen=seen[1]),
    ]
    run = conducted(
        grid,
        scripts,
        starts=[grid.place(4, 4)] * 2,
        radio={"reach": "radius", "radius_m": 1.0},
        sensing={"mode": "ahead", "position": "odometry", "drift": 1.0},
        **NO_DEVICES,
    )
    speaks = next(event for event in run.events if isinstance(event.what, Exchange))
    assert speaks.place is not None
    row, col = grid.position(speaks.place)
    assert (row - 4) ** 2 + (col - 4) ** 2 > 1
    assert seen[0][-1].position == (4, 4)
    assert not any(sight.inbox for sight in seen[1])


# Notices of losses.


@pytest.mark.parametrize("line_of_sight", [False, True])
def test_a_heartbeat_within_reach_is_heard_within_the_radius(line_of_sight: bool) -> None:
    grid = Grid.of_text(".....#..")
    radio = {
        "reach": "radius",
        "radius_m": 3.0,
        "line_of_sight": line_of_sight,
        "heartbeat": "reach",
    }
    seen: list[list[GridSight]] = [[] for _ in range(5)]
    scripts = [asking(wait(9)), *(asking(listen(5), seen=sights) for sights in seen[:4])]
    scripts.append(asking(move(EAST), wait(9), seen=seen[4]))  # leaves from within reach
    faults = [{"kill": "robot:0", "at": 0.5}]
    starts = [4, 3, 1, 0, 7, 2]
    conducted(grid, scripts, starts=starts, radio=radio, faults=faults)
    found = [[(sight.time, sight.losses) for sight in sights if sight.losses] for sights in seen]
    behind = [] if line_of_sight else [(0.5, (0,))]
    assert found == [[(0.5, (0,))], [(0.5, (0,))], [], behind, [(1.0, (0,))]]


def test_a_victim_under_way_is_heard_of_where_it_left_from() -> None:
    radio = {"reach": "radius", "radius_m": 1.0, "heartbeat": "reach"}
    seen: list[list[GridSight]] = [[], []]
    scripts = [asking(move(EAST)), *(asking(listen(5), seen=sights) for sights in seen)]
    faults = [{"kill": "robot:0", "at": 0.5}]
    conducted(CORRIDOR, scripts, starts=[3, 2, 5], radio=radio, faults=faults)
    found = [[sight.losses for sight in sights if sight.losses] for sights in seen]
    assert found == [[(0,)], []]


# Latency.


def late(latency: float, **more: Any) -> dict[str, Any]:
    return {"radio": {"reach": "global", "latency": latency, **more}}


@pytest.mark.parametrize("latency", [0.25, 1.0, 2.5])
def test_a_message_arrives_exactly_then_and_wakes_those_who_wait_for_news(latency: float) -> None:
    requests: list[list[AnyRequest]] = [[wait(), say(b"x"), wait(9)], [listen(), listen(9)]]
    ends = heard(requests, [0, 5], **late(latency), **EVENT)
    assert news(ends[1]) == [(1.0 + latency, [b"x"])]
    assert [time for time, _ in ends[1]] == [0.0, 1.0 + latency, 10.0 + latency]


def test_a_message_is_seen_by_who_is_under_way_when_it_arrives_there() -> None:
    requests: list[list[AnyRequest]] = [
        [say(b"x"), wait(9)],
        [move(EAST), wait()],  # under way when the message comes: at 0.5
        [wait(3), wait()],  # a mere wait is not woken
        [listen(0.5), wait()],
    ]
    ends = heard(requests, [0, 3, 5, 7], **late(0.5), **EVENT)
    assert news(ends[1]) == [(1.0, [b"x"])]
    assert news(ends[2]) == [(3.0, [b"x"])]
    assert news(ends[3]) == [(0.5, [b"x"])]
    assert [time for time, _ in ends[3]] == [0.0, 0.5, 1.5]  # it was woken once


def test_a_message_that_comes_with_an_arrival_is_in_its_sight() -> None:
    requests: list[list[AnyRequest]] = [[say(b"x"), wait(9)], [move(EAST), Look()]]
    ends = heard(requests, [0, 3], **late(1.0), **NO_DEVICES)
    assert ends[1] == [(0.0, []), (1.0, [b"x"]), (1.0, [])]


def test_in_lockstep_too_a_message_comes_between_two_ticks() -> None:
    requests: list[list[AnyRequest]] = [[say(b"x"), wait(9)], [listen(), wait()]]
    ends = heard(requests, [0, 3], **late(0.75))
    assert [time for time, _ in ends[1]] == [0.0, 0.75, 1.75]


def test_messages_come_in_the_order_in_which_they_were_sent() -> None:
    requests: list[list[AnyRequest]] = [
        [say(b"1", b"2"), wait(), say(b"4"), wait(9)],
        [say(b"3"), wait(9)],
        [listen(), listen(), wait()],
    ]
    ends = heard(requests, [0, 3, 5], **late(3.0))
    assert news(ends[2]) == [(3.0, [b"1", b"2", b"3"]), (4.0, [b"4"])]


def test_who_was_in_reach_at_the_sending_hears_wherever_it_is_later() -> None:
    radio = {"reach": "radius", "radius_m": 1.0, "latency": 2.0}
    requests: list[list[AnyRequest]] = [
        [wait(), say(b"x"), wait(9)],
        [wait(), *[move(EAST)] * 4],  # beside it at 1, and gone by 3
        [*[move(3)] * 3, wait(9)],  # far away at 1, and beside it at 3
    ]
    ends = heard(requests, [0, 1, 4], radio=radio, **NO_DEVICES)
    assert news(ends[1]) == [(3.0, [b"x"])]
    assert news(ends[2]) == []


def test_a_message_outlives_its_sender() -> None:
    requests: list[list[AnyRequest]] = [
        [say(b"x"), wait(9)],
        [say(b"y")],
        [listen(), listen(), wait()],
    ]
    fields = {**late(2.0), "faults": [{"kill": "robot:0", "at": 1.0}]}
    ends = heard(requests, [0, 3, 5], **fields)
    assert news(ends[2]) == [(2.0, [b"x", b"y"])]  # one was killed and the other has stopped


def test_those_who_stopped_or_were_lost_meanwhile_hear_nothing() -> None:
    scripts = [asking(say(b"x"), wait(9)), asking(wait()), asking(wait(9)), asking(wait(9))]
    run = conducted(CORRIDOR, scripts, faults=[{"kill": "robot:2", "at": 1.0}], **late(2.0))
    assert run.end == End("over")
    assert [body.inbox for body in run.world.bodies] == [[], [], [], []]
    robots = [event.robot for event in run.events if event.time > 1.0]
    assert robots == [0, 3]  # and nobody else acts any more


def test_a_message_in_the_air_is_news_to_come() -> None:
    scripts = [asking(say(b"x"), listen()), asking(listen(), say(b"y"), listen(9.0))]
    run = conducted(CORRIDOR, scripts, **late(4.0))
    assert run.end == End("over")
    times = [(event.robot, event.time) for event in run.events if isinstance(event.what, Stop)]
    assert times == [(0, 8.0), (1, 13.0)]


def test_when_the_last_message_has_come_a_run_may_stall() -> None:
    scripts = [asking(say(b"x"), listen()), asking(listen(), listen())]
    run = conducted(CORRIDOR, scripts, starts=[0, 5], **late(4.0))
    assert run.end == End("stalled")
    assert run.world.time == 4.0
    assert run.world.waiting() == [(0, 0), (1, 5)]


def test_a_message_that_is_nobodys_any_more_does_not_keep_a_run_from_stalling() -> None:
    scripts = [asking(say(b"x"), listen()), asking()]
    run = conducted(CORRIDOR, scripts, **late(4.0))
    assert run.end == End("stalled")


def test_a_fault_before_a_message_comes_strikes_before_it() -> None:
    scripts = [asking(say(b"x"), listen(9)), asking(listen(), wait())]
    run = conducted(
        CORRIDOR,
        scripts,
        **late(2.0, heartbeat="reach"),
        faults=[{"kill": "robot:1", "at": 2.0}, {"kill": "robot:0", "at": 1.5}],
    )
    lost = [(event.robot, event.time) for event in run.events if event.what == "killed"]
    assert lost == [(0, 1.5), (1, 2.0)]


def test_latency_is_on_graphs_too() -> None:
    run = conducted(graph_of("01"), [asking(say(b"x")), asking(listen())], **late(3.0))
    assert [(event.robot, event.time) for event in run.events if isinstance(event.what, Stop)] == [
        (0, 0.0),
        (1, 3.0),
    ]


# Losses and duplicates.

MESSAGES = 600


def copies_of(seed: int = 1, hearers: int = 3, **radio: Any) -> list[list[int]]:
    """Let one robot say many things, three at once; return how many copies each hearer got."""
    seen: list[list[GridSight]] = [[] for _ in range(hearers)]
    numbered = [number.to_bytes(2, "big") for number in range(MESSAGES)]
    scripts = [asking(*[say(*numbered[at : at + 3]) for at in range(0, MESSAGES, 3)], wait(3))]
    scripts += [asking(wait(3), seen=sights) for sights in seen]
    conducted(CORRIDOR, scripts, seed=seed, radio={"reach": "global", **radio}, **NO_DEVICES)
    counts = []
    for sights in seen:
        inbox = [int.from_bytes(message, "big") for sight in sights for _, message in sight.inbox]
        assert inbox == sorted(inbox)  # those that come at all come in order
        counts.append([inbox.count(number) for number in range(MESSAGES)])
    return counts


@pytest.mark.parametrize("latency", [0.0, 1.0])
@pytest.mark.parametrize(("loss", "duplicate"), [(0.3, 0.0), (0.0, 0.2), (0.4, 0.25)])
def test_messages_are_lost_and_doubled_as_often_as_it_says(
    loss: float, duplicate: float, latency: float
) -> None:
    for counts in copies_of(loss=loss, duplicate=duplicate, latency=latency):
        rates = [counts.count(copies) / MESSAGES for copies in range(4)]
        assert abs(rates[0] - loss) < 0.06
        assert abs(rates[2] - (1 - loss) * duplicate) < 0.06
        assert rates[3] == 0.0
        assert loss or not rates[0]
        assert duplicate or not rates[2]


def test_each_hearer_misses_messages_on_its_own() -> None:
    lost = [[count == 0 for count in counts] for counts in copies_of(loss=0.5)]
    for one, other in combinations(lost, 2):
        both = sum(a and b for a, b in zip(one, other, strict=True)) / MESSAGES
        assert abs(both - 0.25) < 0.06


def test_each_message_is_lost_on_its_own() -> None:
    """Also of those that were sent at once."""
    for counts in copies_of(loss=0.5):
        first, second = ([count == 0 for count in counts[at::3]] for at in (0, 1))
        both = sum(a and b for a, b in zip(first, second, strict=True)) / len(first)
        assert abs(both - 0.25) < 0.1


def test_the_same_seed_loses_the_same() -> None:
    radio: dict[str, Any] = {"loss": 0.3, "duplicate": 0.3}
    assert copies_of(seed=4, **radio) == copies_of(seed=4, **radio)
    assert copies_of(seed=4, **radio) != copies_of(seed=5, **radio)


def test_a_lost_message_wakes_nobody() -> None:
    scripts = [asking(*[say(b"x")] * 20), asking(*[listen(50)] * 3)]
    run = conducted(CORRIDOR, scripts, radio={"reach": "global", "loss": 0.999999}, **NO_DEVICES)
    assert run.events[-1].time == 150.0


def test_copies_of_a_message_come_together() -> None:
    requests: list[list[AnyRequest]] = [[say(b"x"), wait(9)], [listen(), wait()]]
    ends = heard(requests, [0, 3], **late(2.0, duplicate=0.999999))
    assert news(ends[1]) == [(2.0, [b"x", b"x"])]


async def chatters(body: Body) -> None:
    """Do everything that has to do with messages, at random."""
    await body.look()
    rng = body.rng
    for _ in range(15):
        messages = tuple(rng.randbytes(1) for _ in range(rng.randrange(3)))
        match rng.randrange(4):
            case 0:
                await body.exchange(*messages)
            case 1:
                await body.wait(float(rng.randint(1, 2)), messages=messages)
            case 2:
                await body.wait_for_news(at_most=2.0, messages=messages)
            case _:
                await body.move(rng.randrange(4), messages=messages)


@settings(max_examples=40)
@given(
    grids(rows_max=3, cols_max=4),
    st.sampled_from(["same-place", "radius", "global"]),
    st.integers(0, 1 << 20),
    st.integers(1, 5),
    st.booleans(),
)
def test_messages_that_meet_no_mishap_arrive_as_without_any(
    grid: Grid, reach: str, seed: int, robots: int, devices: bool
) -> None:
    """The way for messages that may be lost, and that for those that cannot, lead to one trace."""
    start = grid.place(*grid.free_cells()[0])
    traces = []
    for loss in (0.0, 1e-300):
        radio = {"reach": reach, "loss": loss, "heartbeat": "reach"}
        if reach == "radius":
            radio["radius_m"] = grid.cell_m
        run = conducted(
            grid,
            [chatters] * robots,
            starts=[start] * robots,
            seed=seed,
            radio=radio,
            faults=[{"kill": "robot:0", "at": 3.0, "round": 1}],
            device={"capacity_bytes": 8 if devices else 0},
        )
        traces.append(run.events)
    assert first_difference(*traces) is None
