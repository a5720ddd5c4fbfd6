"""The instant, sentence by sentence, with scripted robots; and the world against a naive one."""

from itertools import pairwise
from math import inf, nan
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.body import Body
from deploy.inprocess import play
from protocol.errors import (
    DurationError,
    ExitError,
    OpeningError,
    RoundsError,
    RuleError,
    TagError,
)
from protocol.graph import PortGraph
from protocol.messages import (
    AnyRequest,
    Exchange,
    Look,
    Move,
    Sight,
    Stop,
    TagWrite,
    Wait,
    WaitForNews,
    Write,
)
from protocol.trace import first_difference
from tests.naive_world import NaiveWorld
from tests.play import Conducted, Script, asking, conducted, graph_of, graphs, scenario_of
from world_server.terrain import GraphTerrain
from world_server.world import Answers, End, KillOrder, TagsWanted, Wave, World

PATH = graph_of("01 12 23")
NO_DEVICES: dict[str, Any] = {"device": {"capacity_bytes": 0}}
EVENT: dict[str, Any] = {"clock": {"mode": "event"}}

# Requests.


def move(exit_: int = 0, tag: bytes | None = None, *messages: bytes) -> Move:
    return Move(tag, messages, exit_)


def write(tag: bytes, *messages: bytes) -> Write:
    return Write(tag, messages)


def say(*messages: bytes) -> Exchange:
    return Exchange(None, messages)


def wait(duration: float = 1.0) -> Wait:
    return Wait(None, (), duration)


def listen(at_most: float | None = None) -> WaitForNews:
    return WaitForNews(None, (), at_most)


def causes(run: Conducted) -> dict[int, tuple[float, int, int, str]]:
    """Return time, round, wave and cause of each loss."""
    return {
        event.robot: (event.time, event.round, event.wave, event.what)
        for event in run.events
        if isinstance(event.what, str)
    }


def instants(run: Conducted, robot: int) -> list[tuple[float, int, int]]:
    """Return time, round and wave of each request of a robot."""
    return [(event.time, event.round, event.wave) for event in run.events if event.robot == robot]


def at(robot: int, time: float, round_: int = 0) -> dict[str, Any]:
    return {"kill": f"robot:{robot}", "at": time, "round": round_}


def in_place_of(robot: int, request: int) -> dict[str, Any]:
    return {"kill": f"robot:{robot}", "at_request": request}


# The opening.


def test_the_run_opens_with_a_look_of_each_robot() -> None:
    run = conducted(PATH, [asking(), asking()])
    opening = run.outputs[0]
    assert opening == Wave(0.0, -1, 0, [0, 1], [None, None])
    assert run.lines()[:2] == [
        "t=0 round=-1 wave=0 robot=0 at 0 entry=None look",
        "t=0 round=-1 wave=0 robot=1 at 0 entry=None look",
    ]


def test_the_first_sight_is_in_round_0_of_time_0() -> None:
    seen: list[Sight] = []
    conducted(PATH, [asking(Look(), seen=seen)], starts=[1])
    assert seen == [
        Sight(0.0, 1, None, 2, b"", 0, True),
        Sight(0.0, 1, None, 2, b"", 0, False),  # alone is a matter of the first round
    ]


# Waves.


def test_at_a_device_turns_go_lowest_id_first_each_seeing_the_tag_as_left() -> None:
    seen: list[list[Sight]] = [[], [], []]
    scripts = [asking(write(bytes([65 + robot])), seen=seen[robot]) for robot in range(3)]
    run = conducted(PATH, scripts)
    assert run.waves()[1:4] == [(0.0, 0, 0, [0]), (0.0, 0, 1, [1]), (0.0, 0, 2, [2])]
    assert [sights[0].tag for sights in seen] == [b"", b"A", b"B"]
    assert [sights[1].tag for sights in seen] == [b"C", b"C", b"C"]
    assert [sights[1].revision for sights in seen] == [3, 3, 3]
    assert run.writes == [(0, 1, b"A"), (0, 2, b"B"), (0, 3, b"C")]


def test_without_devices_all_take_their_turn_in_one_wave() -> None:
    run = conducted(PATH, [asking(Look())] * 3, starts=[0, 0, 1], **NO_DEVICES)
    assert run.waves()[1:] == [(0.0, 0, 0, [0, 1, 2]), (0.0, 1, 0, [0, 1, 2])]


def test_the_jth_turns_at_all_places_are_a_wave() -> None:
    run = conducted(PATH, [asking()] * 6, starts=[1, 0, 1, 0, 2, 1])
    assert run.waves()[1:] == [(0.0, 0, 0, [0, 1, 4]), (0.0, 0, 1, [2, 3]), (0.0, 0, 2, [5])]


def test_requests_of_a_wave_take_place_lowest_id_first() -> None:
    run = conducted(PATH, [asking(move())] * 3, starts=[2, 1, 3])
    first_moves = [event.robot for event in run.events if isinstance(event.what, Move)]
    assert first_moves == [0, 1, 2]


def test_turns_of_one_wave_do_not_see_each_other_act() -> None:
    seen: list[Sight] = []
    scripts = [asking(say(b"x"), say()), asking(Look(), Look(), seen=seen)]
    conducted(PATH, scripts, radio={"reach": "global"}, **NO_DEVICES)
    assert [sight.inbox for sight in seen] == [(), ((0, b"x"),), ()]


# Rounds.


def test_all_record_then_all_choose_is_two_rounds() -> None:
    seen: list[Sight] = []
    scripts = [asking(write(b"a"), move(), seen=seen), asking(write(b"b"), move())]
    run = conducted(PATH, scripts)
    assert seen[1].tag == b"b"
    assert instants(run, 0)[1:3] == [(0.0, 0, 0), (0.0, 1, 0)]
    assert instants(run, 1)[1:3] == [(0.0, 0, 1), (0.0, 1, 1)]


@pytest.mark.parametrize("request_", [Look(), write(b"x"), say(b"x")])
def test_a_free_request_ends_the_turn_in_this_round(request_: AnyRequest) -> None:
    run = conducted(PATH, [asking(request_, request_)])
    assert instants(run, 0) == [(0.0, -1, 0), (0.0, 0, 0), (0.0, 1, 0), (0.0, 2, 0)]


def test_rounds_are_common_to_all_places() -> None:
    run = conducted(PATH, [asking(Look()), asking(Look(), Look())], starts=[0, 3])
    assert [wave[1:] for wave in run.waves()] == [
        (-1, 0, [0, 1]),
        (0, 0, [0, 1]),
        (1, 0, [0, 1]),
        (2, 0, [1]),
    ]


def test_alone_is_the_only_one_in_turn_in_round_0() -> None:
    seen: list[list[Sight]] = [[], [], [], []]
    scripts = [
        asking(wait(2.0), seen=seen[0]),  # a waiting body does not count
        asking(seen=seen[1]),  # nor one that stopped
        asking(wait(9.0), seen=seen[2]),  # nor a lost one
        asking(move(), Look(), seen=seen[3]),
    ]
    conducted(PATH, scripts, starts=[0, 0, 0, 1], faults=[at(2, 0.5)])
    assert [sight.alone for sight in seen[3]] == [True, True, False]
    assert [sights[0].alone for sights in seen[:3]] == [False, False, False]
    assert seen[3][1].here == (0, 1)


def test_two_that_arrive_together_are_not_alone() -> None:
    seen: list[list[Sight]] = [[], []]
    conducted(PATH, [asking(move(), seen=sights) for sights in seen], starts=[2, 0])
    assert [[(sight.place, sight.alone) for sight in sights] for sights in seen] == [
        [(2, True), (1, False)],
        [(0, True), (1, False)],
    ]


def test_here_lists_those_in_turn_waiting_and_stopped() -> None:
    seen: list[Sight] = []
    scripts = [asking(), asking(wait(5.0)), asking(listen(5.0)), asking(move(), wait(5.0))]
    scripts.append(asking(wait(1.0), seen=seen))
    conducted(PATH, scripts, starts=[0, 0, 0, 1, 0])
    assert [sight.here for sight in seen] == [(0, 1, 2), (0, 1, 2, 3)]


def test_a_robot_woken_in_this_round_still_stands_here() -> None:
    seen: list[Sight] = []
    scripts = [asking(wait(), write(b"x")), asking(wait(), seen=seen), asking(listen())]
    conducted(PATH, scripts)
    assert seen[1].tag == b"x"
    assert seen[1].here == (0, 2)


# Time.


def test_arrivals_and_ends_of_waits_of_an_instant_share_its_round_0() -> None:
    run = conducted(PATH, [asking(move()), asking(wait()), asking(move())], starts=[0, 1, 2])
    assert (1.0, 0, 0, [0]) in run.waves()
    assert [wave for wave in run.waves() if wave[0] == 1.0] == [
        (1.0, 0, 0, [0]),
        (1.0, 0, 1, [1]),
        (1.0, 0, 2, [2]),
    ]


def test_in_lockstep_every_move_takes_one_tick() -> None:
    graph = graph_of("01 12", lengths=[7.0, None])
    run = conducted(graph, [asking(move(), move(1))], team={"speed": 3.0})
    assert [event.time for event in run.events] == [0.0, 0.0, 1.0, 2.0]


def test_under_the_event_clock_a_move_takes_length_by_speed() -> None:
    graph = graph_of("01 01 01", lengths=[6.0, None, 0.0])
    scripts = [asking(move(0), move(1), move(2))] * 2
    run = conducted(graph, scripts, team={"speed": [1.0, 4.0]}, **EVENT)
    assert [time for time, *_ in instants(run, 0)] == [0.0, 0.0, 6.0, 7.0, 8.0]
    assert [time for time, *_ in instants(run, 1)] == [0.0, 0.0, 1.5, 1.75, 2.0]


@pytest.mark.parametrize("jitter", [0.25, "exponential"])
def test_jitter_is_repeatable_and_each_robots_own(jitter: float | str) -> None:
    def times(*scripts: Script, seed: int = 1) -> list[list[float]]:
        clock = {"mode": "event", "jitter": jitter}
        run = conducted(PATH, scripts, clock=clock, seed=seed)
        return [[time for time, *_ in instants(run, robot)] for robot in range(len(scripts))]

    walk = asking(move(), move(), move())
    first, second = times(walk, walk)
    assert first != second
    assert times(walk, walk) == [first, second]
    assert times(asking(wait(0.3)), walk)[1] == second  # whatever the others do
    assert times(walk, walk, seed=2)[0] != first
    if jitter == 0.25:
        durations = [b - a for a, b in pairwise(first[1:])]
        assert all(0.75 <= duration <= 1.25 for duration in durations)
        assert len(set(durations)) == len(durations)


def test_events_of_one_instant_are_those_of_exactly_equal_times() -> None:
    graph = graph_of("01 02", lengths=[0.1, 0.3])
    # 0.1 + 0.1 + 0.1 is not 0.3
    scripts = [asking(wait(0.1), wait(0.1), wait(0.1)), asking(wait(0.3))]
    run = conducted(graph, scripts, **EVENT)
    assert run.waves()[-1][0] == 0.1 + 0.1 + 0.1
    assert run.waves()[-2] == (0.3, 0, 0, [1])


def test_times_are_floats() -> None:
    run = conducted(PATH, [asking(wait(2), move())], faults=[at(0, 9)])
    assert all(type(event.time) is float for event in run.events)


@pytest.mark.parametrize("clock", ["lockstep", "event"])
@pytest.mark.parametrize("request_", [wait(2), listen(2)])
def test_the_trace_does_not_depend_on_how_a_robot_spells_a_duration(
    request_: AnyRequest, clock: str
) -> None:
    """A process sends floats; an integer of the same value must leave the same trace."""
    spelt = [
        conducted(PATH, [asking(r)], clock={"mode": clock})
        for r in (
            request_,
            wait(2.0) if isinstance(request_, Wait) else listen(2.0),
        )
    ]
    texts = [[repr(event) for event in run.events] for run in spelt]
    assert texts[0] == texts[1]


# Faults.


def test_a_fault_of_round_0_strikes_after_arrivals_and_before_turns() -> None:
    run = conducted(PATH, [asking(move(), move())], faults=[at(0, 1)])
    assert run.lines()[-1] == "t=1 round=0 wave=-1 robot=0 at 1 entry=0 lost (killed)"


@pytest.mark.parametrize("n", [1, 2, 3])
def test_a_fault_of_round_n_strikes_once_n_rounds_are_done(n: int) -> None:
    scripts = [asking(wait(), *[write(b"x")] * 5)]
    run = conducted(PATH, scripts, faults=[at(0, 1, n)])
    assert len(run.writes) == n
    assert causes(run) == {0: (1.0, n, -1, "killed")}


def test_a_fault_of_a_larger_round_than_there_are_strikes_at_the_end() -> None:
    run = conducted(PATH, [asking(move(), Look(), wait(), wait())], faults=[at(0, 1, 99)])
    assert run.lines()[-2:] == [
        "t=1 round=1 wave=0 robot=0 at 1 entry=0 wait duration=1",
        "t=1 round=2 wave=-1 robot=0 at 1 entry=0 lost (killed)",
    ]


def test_at_the_end_of_the_instant_of_leaving_the_victim_is_on_its_way() -> None:
    run = conducted(PATH, [asking(move(), move())], faults=[at(0, 0, 1)])
    assert run.lines()[-1] == "t=0 round=1 wave=-1 robot=0 on its way entry=None lost (killed)"


def test_the_time_of_a_fault_is_an_instant_of_its_own() -> None:
    run = conducted(PATH, [asking(move(), move())], faults=[at(0, 0.5)])
    assert run.lines()[-1] == "t=0.5 round=0 wave=-1 robot=0 on its way entry=None lost (killed)"
    assert run.end == End("over")


def test_faults_of_an_instant_strike_in_the_order_of_round_and_file() -> None:
    faults = [at(2, 1, 1), at(0, 1), at(1, 1), at(3, 1)]
    run = conducted(PATH, [asking(wait(9))] * 3 + [asking(wait(), wait())], faults=faults)
    orders = [output for output in run.outputs if isinstance(output, KillOrder)]
    assert orders == [KillOrder(1, 0), KillOrder(2, 1), KillOrder(3, 3), KillOrder(0, 2)]
    assert run.world.struck == [1, 2, 3, 0]


def test_a_fault_of_round_1_waits_for_those_whom_a_fault_of_round_0_woke() -> None:
    """There is a round after all, so round 1 is not larger than there are."""
    faults = [at(0, 0.5), at(1, 0.5, 1)]
    run = conducted(PATH, [asking(wait(9)), asking(wait(9)), asking(listen())], faults=faults)
    assert instants(run, 2)[2] == (0.5, 0, 0)
    assert causes(run)[1] == (0.5, 1, -1, "killed")


def test_a_robot_killed_before_its_turn_makes_no_round() -> None:
    run = conducted(PATH, [asking(wait()), asking(wait(9))], faults=[at(0, 1), at(1, 1, 1)])
    assert causes(run) == {0: (1.0, 0, -1, "killed"), 1: (1.0, 0, -1, "killed")}


def test_a_kill_of_one_that_stopped_or_was_lost_is_no_kill() -> None:
    faults = [at(0, 5), at(1, 2), at(1, 3), at(2, 99)]
    run = conducted(PATH, [asking(), asking(wait(9)), asking(wait(7))], faults=faults)
    assert [output for output in run.outputs if isinstance(output, KillOrder)] == [KillOrder(1, 1)]
    assert run.world.struck == [1]


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_at_request_strikes_in_place_of_the_nth_request(n: int) -> None:
    scripts = [asking(write(b"a"), move(0, b"b"), write(b"c"))]
    run = conducted(PATH, scripts, faults=[in_place_of(0, n)])
    assert len(run.events) == n
    assert [tag for *_, tag in run.writes] == [b"a", b"b", b"c"][: max(0, n - 2)]
    place = 1 if n == 4 else 0
    round_, wave = (-1, 0) if n == 1 else (n - 2 if n < 4 else 0, 0)
    time = 1.0 if n == 4 else 0.0
    assert causes(run) == {0: (time, round_, wave, "killed")}
    assert run.world.tags[0] == [b"", b"", b"a", b"b"][n - 1]
    assert run.events[-1].place == place


def test_a_victim_at_its_first_request_was_never_seen() -> None:
    seen: list[Sight] = []
    run = conducted(PATH, [asking(), asking(seen=seen)], faults=[in_place_of(0, 1)])
    assert run.outputs[:2] == [KillOrder(0, 0), Wave(0.0, -1, 0, [1], [None])]
    assert seen[0].here == ()
    assert seen[0].losses == (0,)
    assert seen[0].alone


def test_a_victim_in_its_wave_is_heard_by_the_later_waves_of_the_round() -> None:
    seen: list[Sight] = []
    scripts = [asking(Look(), Look()), asking(Look(), Look(), seen=seen)]
    conducted(PATH, scripts, faults=[in_place_of(0, 3)])
    assert [(sight.losses, sight.here) for sight in seen] == [((), (0,)), ((0,), ()), ((), ())]


# Losses that nobody scheduled.


def test_an_unscheduled_loss_drops_the_request_that_came_with_it() -> None:
    scripts = [asking(write(b"a")), asking(write(b"b"))]
    run = conducted(PATH, scripts, starts=[0, 1], lost_in={1: [(0, "killed")]})
    assert run.writes == [(1, 1, b"b")]
    assert causes(run) == {0: (0.0, 0, 0, "killed")}


def test_an_unscheduled_loss_comes_before_the_requests_of_its_wave() -> None:
    seen: list[Sight] = []
    scripts = [asking(wait(5)), asking(listen(), seen=seen)]
    run = conducted(PATH, scripts, starts=[0, 3], lost_in={1: [(0, "failed")]})
    assert [str(event.what) for event in run.events if event.robot == 0][-1] == "failed"
    kinds = [event.what for event in run.events[2:4]]
    assert kinds == ["failed", listen()]
    assert [(s.time, s.losses) for s in seen] == [(0.0, ()), (0.0, (0,))]  # woken at once


def test_a_loss_may_strike_a_robot_of_another_wave() -> None:
    scripts = [asking(Look()), asking(write(b"b")), asking(wait(9))]
    run = conducted(PATH, scripts, starts=[0, 0, 3], lost_in={1: [(1, "killed"), (2, "killed")]})
    assert run.writes == []
    assert set(causes(run)) == {1, 2}
    assert (0.0, 0, 1, [1]) not in run.waves()


def test_a_second_loss_of_one_robot_is_none() -> None:
    lost_in: dict[int, Any] = {1: [(0, "killed"), (0, "failed")], 2: [(0, "killed")]}
    run = conducted(PATH, [asking(wait()), asking(wait(), wait())], starts=[0, 2], lost_in=lost_in)
    assert [event.what for event in run.events if event.robot == 0][-1] == "killed"
    assert sum(isinstance(event.what, str) for event in run.events) == 1


# Notices of losses.


def notices(reach: str, heartbeat: str, **fields: Any) -> list[tuple[int, ...]]:
    """Robot 0 dies at place 1 at time 2; return what those at 1 and 3 hear, and one under way."""
    seen: list[list[Sight]] = [[], [], []]
    scripts = [asking(wait(9))]
    scripts += [asking(listen(5), seen=sights) for sights in seen[:2]]
    scripts += [asking(wait(), move(), wait(9), seen=seen[2])]
    radio = {"reach": reach, "heartbeat": heartbeat}
    conducted(PATH, scripts, starts=[1, 1, 3, 1], radio=radio, faults=[at(0, 1.5)], **fields)
    return [tuple(robot for sight in sights for robot in sight.losses) for sights in seen]


@pytest.mark.parametrize(
    ("reach", "heartbeat", "heard"),
    [
        ("none", "global", [(0,), (0,), (0,)]),
        ("none", "reach", [(), (), ()]),
        ("same-place", "reach", [(0,), (), ()]),
        ("global", "reach", [(0,), (0,), (0,)]),
    ],
)
def test_who_hears_of_a_loss(reach: str, heartbeat: str, heard: list[tuple[int, ...]]) -> None:
    assert notices(reach, heartbeat) == heard


def test_a_victim_on_its_way_is_out_of_the_reach_of_places() -> None:
    seen: list[Sight] = []
    scripts = [asking(move()), asking(listen(5), seen=seen)]
    radio = {"reach": "same-place", "heartbeat": "reach"}
    conducted(PATH, scripts, radio=radio, faults=[at(0, 0.5)])
    assert [sight.losses for sight in seen] == [(), ()]


def test_a_victim_that_left_in_this_instant_has_not_gone_anywhere_yet() -> None:
    seen: list[Sight] = []
    scripts = [asking(move()), asking(listen(5), seen=seen)]
    radio = {"reach": "same-place", "heartbeat": "reach"}
    conducted(PATH, scripts, radio=radio, faults=[at(0, 0, 9)])
    assert [(sight.time, sight.losses) for sight in seen] == [(0.0, ()), (0.0, (0,))]


def test_a_loss_notice_wakes_those_who_wait_into_the_next_round() -> None:
    scripts = [asking(wait(), Look(), wait(9)), asking(listen(), wait()), asking(wait(9))]
    run = conducted(PATH, scripts, starts=[0, 1, 2], faults=[at(2, 1, 1)])
    assert instants(run, 1)[2] == (1.0, 1, 0)


def test_a_mere_wait_is_not_woken() -> None:
    seen: list[Sight] = []
    scripts = [asking(write(b"x", b"m"), wait(9)), asking(wait(3), seen=seen)]
    conducted(PATH, scripts, radio={"reach": "global"}, faults=[at(0, 1)])
    assert [(s.time, s.inbox, s.losses) for s in seen] == [
        (0.0, ((0, b"m"),), ()),
        (3.0, (), (0,)),
    ]


# Radio.


def hearing(reach: str) -> list[tuple[int, ...]]:
    """Robot 0 speaks at place 1 at time 1; return whom each of the others heard by time 3."""
    seen: list[list[Sight]] = [[] for _ in range(5)]
    scripts = [asking(wait(), say(b"hello"), wait(9))]
    scripts += [asking(wait(3), seen=seen[0])]  # at the same place
    scripts += [asking(wait(3), seen=seen[1])]  # elsewhere
    scripts += [asking(wait(), move(), wait(9), seen=seen[2])]  # leaves in the same instant
    scripts += [asking(move(1), wait(9), seen=seen[3])]  # left before
    scripts += [asking(move(0), wait(2), seen=seen[4])]  # arrives in the same instant
    conducted(PATH, scripts, starts=[1, 1, 3, 1, 1, 0], radio={"reach": reach})
    return [tuple(sender for s in sights for sender, _ in s.inbox) for sights in seen]


@pytest.mark.parametrize(
    ("reach", "heard"),
    [
        ("none", [(), (), (), (), ()]),
        ("same-place", [(0,), (), (0,), (), (0,)]),
        ("global", [(0,), (0,), (0,), (0,), (0,)]),
    ],
)
def test_who_hears_a_message(reach: str, heard: list[tuple[int, ...]]) -> None:
    assert hearing(reach) == heard


def test_a_message_sent_while_leaving_is_heard_where_it_was_sent() -> None:
    seen: list[list[Sight]] = [[], []]
    scripts = [asking(move(0, None, b"bye")), *(asking(wait(), seen=s) for s in seen)]
    conducted(PATH, scripts, starts=[0, 0, 1], radio={"reach": "same-place"}, **NO_DEVICES)
    assert [sights[-1].inbox for sights in seen] == [((0, b"bye"),), ()]


def test_messages_come_in_the_order_in_which_they_were_sent() -> None:
    seen: list[Sight] = []
    scripts = [asking(say(b"1", b"2"), say(b"4")), asking(say(b"3")), asking(wait(), seen=seen)]
    conducted(PATH, scripts, starts=[0, 1, 2], radio={"reach": "global"})
    assert seen[-1].inbox == ((0, b"1"), (0, b"2"), (1, b"3"), (0, b"4"))


def test_nobody_hears_itself_and_an_inbox_is_emptied_by_a_sight() -> None:
    seen: list[list[Sight]] = [[], []]
    scripts = [asking(say(b"a"), Look(), Look(), seen=s) for s in seen]
    conducted(PATH, scripts, radio={"reach": "global"}, **NO_DEVICES)
    for other, sights in zip((1, 0), seen, strict=True):
        assert [sight.inbox for sight in sights] == [(), ((other, b"a"),), (), ()]


# Waiting.


def test_a_wait_lasts_as_long_as_it_says() -> None:
    run = conducted(PATH, [asking(wait(4), wait(1))])
    assert [time for time, *_ in instants(run, 0)] == [0.0, 0.0, 4.0, 5.0]


@pytest.mark.parametrize(
    ("news", "fields"),
    [
        (say(b"x"), {"radio": {"reach": "same-place"}}),
        (write(b"x"), {}),
        (move(0, b"x"), {}),
        (write(b""), {}),  # a write is a change, whatever it writes
    ],
)
def test_news_wake_into_the_next_round(news: AnyRequest, fields: dict[str, Any]) -> None:
    run = conducted(PATH, [asking(wait(2), news, wait()), asking(listen(), wait())], **fields)
    assert instants(run, 1)[2] == (2.0, 1, 0 if isinstance(news, Move) else 1)


def test_a_tag_changed_elsewhere_is_no_news() -> None:
    run = conducted(PATH, [asking(write(b"x")), asking(listen(3))], starts=[1, 0])
    assert instants(run, 1)[2] == (3.0, 0, 0)


def test_ones_own_write_is_no_news() -> None:
    run = conducted(PATH, [asking(write(b"x"), WaitForNews(b"y", (), 3.0))])
    assert [time for time, *_ in instants(run, 0)] == [0.0, 0.0, 0.0, 3.0]


def test_a_message_that_comes_with_the_request_to_wait_wakes_at_once() -> None:
    scripts = [asking(say(b"x"), wait()), asking(listen(), wait())]
    run = conducted(PATH, scripts, radio={"reach": "global"}, **NO_DEVICES)
    assert instants(run, 1)[1:3] == [(0.0, 0, 0), (0.0, 1, 0)]


def test_at_most_bounds_the_wait_for_news() -> None:
    run = conducted(PATH, [asking(listen(3), listen(2))])
    assert [time for time, *_ in instants(run, 0)] == [0.0, 0.0, 3.0, 5.0]


def test_a_bound_of_an_earlier_wait_does_not_end_a_later_one() -> None:
    scripts = [asking(listen(4), listen(9)), asking(wait(1), write(b"x"))]
    run = conducted(PATH, scripts)
    assert [time for time, *_ in instants(run, 0)] == [0.0, 0.0, 1.0, 10.0]


def test_a_bound_of_an_earlier_wait_may_fall_on_that_of_a_later_one() -> None:
    scripts = [asking(listen(4), listen(3), wait()), asking(wait(1), write(b"x"))]
    run = conducted(PATH, scripts)
    assert [time for time, *_ in instants(run, 0)] == [0.0, 0.0, 1.0, 4.0, 5.0]


def test_all_waiting_for_news_is_a_stall_and_says_who_waits_where() -> None:
    run = conducted(PATH, [asking(listen()), asking(move(), listen()), asking()])
    assert run.end == End("stalled")
    assert run.world.waiting() == [(0, 0), (1, 1)]


def test_a_fault_to_come_is_news_to_come() -> None:
    run = conducted(PATH, [asking(listen()), asking(listen())], faults=[at(1, 7)])
    assert run.end == End("over")
    assert instants(run, 0)[-1] == (7.0, 0, 0)


def test_faults_without_news_end_in_a_stall() -> None:
    radio = {"heartbeat": "reach"}
    run = conducted(PATH, [asking(listen()), asking(listen())], faults=[at(1, 7)], radio=radio)
    assert run.end == End("stalled")
    assert run.world.waiting() == [(0, 0)]


def test_a_run_without_survivors_is_over() -> None:
    run = conducted(PATH, [asking(wait(9))] * 2, faults=[at(0, 1), at(1, 2)])
    assert (run.end, run.world.alive()) == (End("over"), 0)


# Rules.


def refused(request: AnyRequest, **fields: Any) -> tuple[Conducted, str, str]:
    """Let robot 0 write a tag and make a request that is refused; tell the error."""
    capacity = fields.get("device", {}).get("capacity_bytes", 888)
    before = [write(b"t")] if capacity else []
    run = conducted(PATH, [asking(*before, request), asking(wait(2))], starts=[0, 3], **fields)
    refusal = run.world.refusals[0]
    assert {robot: cause for robot, (*_, cause) in causes(run).items()} == {0: "refused"}
    # Nothing of it happened.
    assert run.world.tags[0] == (b"t" if capacity else b"")
    assert len(run.writes) == len(before)
    assert len(instants(run, 0)) == 1 + len(before) + 1
    assert [wave[3] for wave in run.waves()][-1] == [1]  # the others go on
    return run, refusal.error, refusal.detail


@pytest.mark.parametrize("exit_", [1, 2, -1, 10**9])
def test_there_must_be_such_an_exit(exit_: int) -> None:
    _, error, detail = refused(move(exit_, b"new"))
    assert error == "ExitError"
    assert detail == f"exit {exit_} at a place with 1 ports; expected 0 to 0"


@pytest.mark.parametrize(
    "kind", [write(b"12345"), move(0, b"12345"), Wait(b"12345"), Stop(b"12345")]
)
def test_a_tag_must_fit_its_device(kind: AnyRequest) -> None:
    if isinstance(kind, Stop):

        async def script(body: Body) -> Stop:
            await body.look()
            return body.last_words(tag=b"12345")

        run = conducted(PATH, [script], device={"capacity_bytes": 4})
        assert (run.world.refusals[0].error, run.writes) == ("TagError", [])
        return
    _, error, detail = refused(kind, device={"capacity_bytes": 4})
    assert error == "TagError"
    assert "5 bytes" in detail
    assert "holds 4" in detail


@pytest.mark.parametrize("tag", [b"x", b""])
def test_without_devices_nothing_is_written(tag: bytes) -> None:
    _, error, detail = refused(write(tag), **NO_DEVICES)
    assert error == "TagError"
    assert "no device" in detail


@pytest.mark.parametrize("duration", [0.0, -1.0, 1.5, 0.5, nan, inf, -inf])
@pytest.mark.parametrize("kind", [wait, listen])
def test_in_lockstep_waits_are_whole_ticks(kind: Any, duration: float) -> None:
    _, error, detail = refused(kind(duration))
    assert error == "DurationError"
    assert str(duration) in detail


@pytest.mark.parametrize("duration", [0.0, -1.0, nan, inf, -inf])
@pytest.mark.parametrize("kind", [wait, listen])
def test_under_the_event_clock_waits_are_positive_and_finite(kind: Any, duration: float) -> None:
    _, error, _ = refused(kind(duration), **EVENT)
    assert error == "DurationError"


def test_under_the_event_clock_a_wait_may_be_a_fraction() -> None:
    run = conducted(PATH, [asking(wait(1.5), listen(0.25))], **EVENT)
    assert [time for time, *_ in instants(run, 0)] == [0.0, 0.0, 1.5, 1.75]


@pytest.mark.parametrize("first", [Move(), Write(b"x"), Wait(), WaitForNews(), Exchange()])
def test_the_first_request_is_a_look(first: AnyRequest) -> None:
    scenario = scenario_of(1)
    events: list[Any] = []
    world = World(scenario, GraphTerrain(PATH), [0], observe=events.append)
    world.begin()
    assert world.resume(Answers([first])) == End("over")
    assert world.refusals[0].error == "OpeningError"
    assert [(event.round, event.what) for event in events] == [(-1, "refused")]
    assert world.tags[0] == b""


def test_the_first_request_of_an_algorithm_that_returns_at_once() -> None:
    async def nothing(body: Body) -> None:
        pass

    run = conducted(PATH, [nothing])
    assert run.world.refusals[0].error == "OpeningError"


def test_free_requests_without_end_are_refused() -> None:
    scripts = [asking(*[Look()] * 50), asking(wait(), wait())]
    run = conducted(PATH, scripts, starts=[0, 3], clock={"rounds_max": 7})
    assert run.world.refusals[0].error == "RoundsError"
    assert len(instants(run, 0)) == 1 + 7 + 1
    assert causes(run) == {0: (0.0, 7, -1, "refused")}
    assert run.waves()[-1] == (2.0, 0, 0, [1])


def test_one_that_hears_of_a_robot_without_end_goes_on() -> None:
    """Only robots that made too many free requests are out, not those whom their loss wakes."""
    scripts = [asking(*[Look()] * 50), asking(listen(), wait())]
    run = conducted(PATH, scripts, starts=[0, 3], clock={"rounds_max": 7})
    assert set(run.world.refusals) == {0}


def test_rule_errors_are_definite() -> None:
    for error in (ExitError, TagError, DurationError, OpeningError, RoundsError):
        assert issubclass(error, RuleError)
        assert error.definite


@pytest.mark.parametrize(
    "wrong",
    [
        lambda body: body.move(None),
        lambda body: body.move("0"),
        lambda body: body.move(0.0),
        lambda body: body.write("text"),
        lambda body: body.exchange("text"),
        lambda body: body.wait("1"),
        lambda body: body.wait(None),
        lambda body: body.wait(10**400),
    ],
)
def test_a_request_of_wrong_types_ends_its_robot_and_no_other(wrong: Any) -> None:
    async def script(body: Body) -> None:
        await body.look()
        if body.robot == 0:
            await wrong(body)
        else:
            await body.wait(2.0)

    scenario = scenario_of(2)
    events: list[Any] = []
    world = World(scenario, GraphTerrain(PATH), [0, 3], observe=events.append)
    end, failures = play(scenario, world, script)
    assert end == End("over")
    assert set(failures) | set(world.refusals) == {0}
    assert events[-1].what == Stop()


def test_no_two_instants_have_one_time() -> None:
    run = conducted(PATH, [asking(wait(1.0), wait(1e-300), wait(1e-300))], **EVENT)
    opened = [wave[0] for wave in run.waves() if wave[1:3] == (0, 0)]
    assert len(opened) == len(set(opened))


# Old tags.


def test_old_tags_are_asked_for_once_a_place_and_before_the_wave() -> None:
    old = {0: TagWrite(0, 4, b"old"), 2: TagWrite(2, 1, b"far")}
    seen: list[Sight] = []
    scripts = [asking(move(), move(1), move(), seen=seen), asking(move(), seen=[])]
    run = conducted(PATH, scripts, starts=[0, 1], old_tags=old, bookkeeping={"fresh": False})
    wanted = [output for output in run.outputs if isinstance(output, TagsWanted)]
    assert wanted == [TagsWanted((0, 1)), TagsWanted((2,))]
    assert [(sight.tag, sight.revision) for sight in seen] == [
        (b"old", 4),
        (b"", 0),
        (b"far", 1),
        (b"", 0),
    ]


def test_without_devices_no_old_tags_are_asked_for() -> None:
    run = conducted(PATH, [asking(move())], bookkeeping={"fresh": False}, **NO_DEVICES)
    assert not any(isinstance(output, TagsWanted) for output in run.outputs)


def test_writes_go_on_counting_from_the_old_revision() -> None:
    old = {0: TagWrite(0, 4, b"old")}
    run = conducted(PATH, [asking(write(b"x"))], old_tags=old, bookkeeping={"fresh": False})
    assert run.writes == [(0, 5, b"x")]


# The world against a naive one.

DURATIONS = (1.0, 1.0, 2.0, 3.0, 0.5, 2.5)
RADIOS: tuple[dict[str, Any], ...] = (
    *({"reach": reach} for reach in ("none", "same-place", "global")),
    *(
        {"reach": "adjacent", "hops": hops, "relay": relay}
        for hops in (1, 2)
        for relay in (False, True)
    ),
)


class RandomRobots:
    """Robots that ask at random, each from a stream of its own, now and then against the rules."""

    def __init__(self, seed: int, robots: int, requests_max: int, fractions: bool) -> None:
        self._streams = [Random(f"{seed}/{robot}") for robot in range(robots)]
        self._left = [stream.randint(1, requests_max) for stream in self._streams]
        self._durations = DURATIONS if fractions else DURATIONS[:4]

    def answer(self, robot: int, sight: Sight | None) -> AnyRequest:
        stream = self._streams[robot]
        self._left[robot] -= 1
        if sight is None:
            return Look() if stream.random() < 0.98 else Wait()
        messages = tuple(stream.randbytes(1) for _ in range(stream.choice((0, 0, 0, 1, 2))))
        tag = stream.choice((None, None, b"", stream.randbytes(2), sight.tag))
        if stream.random() < 0.01:
            tag = bytes(9)
        if self._left[robot] < 0:
            return Stop(None, messages)
        exit_ = stream.randrange(sight.degree) if sight.degree else 0
        if stream.random() < 0.01:
            exit_ = stream.choice((-1, sight.degree))
        duration = stream.choice(self._durations)
        if stream.random() < 0.01:
            duration = stream.choice((0.0, nan, inf, -2.0, 0.25))
        at_most = stream.choice((None, duration))
        requests: tuple[AnyRequest, ...] = (
            Look(),
            Write(tag or b"", messages),
            Exchange(tag, messages),
            Move(tag, messages, exit_),
            Move(tag, messages, exit_),
            Wait(tag, messages, duration),
            WaitForNews(tag, messages, at_most),
            WaitForNews(tag, (), at_most),
        )
        return stream.choice(requests)


def play_both(
    graph: PortGraph,
    starts: list[int],
    seed: int,
    lost_in: dict[int, list[tuple[int, str]]],
    old_tags: dict[int, TagWrite],
    **fields: Any,
) -> tuple[World, End, list[Any], NaiveWorld, str]:
    """Play the same random robots in the world and in the naive one."""
    robots = len(starts)
    scenario = scenario_of(robots, seed=seed, **fields)
    fractions = scenario.clock.mode == "event"
    script = RandomRobots(seed, robots, 12, fractions)
    naive = NaiveWorld(scenario, graph, starts, script.answer, lost_in=lost_in, old_tags=old_tags)
    status = naive.run()
    script = RandomRobots(seed, robots, 12, fractions)
    events: list[Any] = []
    world = World(scenario, GraphTerrain(graph), starts, observe=events.append)
    output, waves = world.begin(), 0
    while not isinstance(output, End):
        if isinstance(output, Wave):
            turns = zip(output.robots, output.sights, strict=True)
            requests: list[AnyRequest | None] = [script.answer(*turn) for turn in turns]
            lost: Any = tuple(lost_in.get(waves, ()))
            waves += 1
            output = world.resume(Answers(requests, lost))
        elif isinstance(output, TagsWanted):
            known = tuple(old_tags[p] for p in output.places if p in old_tags)
            output = world.resume(known)
        else:
            output = world.resume(None)
    return world, output, events, naive, status


@st.composite
def random_runs(draw: st.DrawFn) -> dict[str, Any]:
    graph = draw(graphs(vertices_max=4, extra_max=3))
    robots = draw(st.integers(1, 5))
    number = st.integers(0, robots - 1)
    faults: list[dict[str, Any]] = draw(
        st.lists(
            st.builds(in_place_of, number, st.integers(1, 9))
            | st.builds(
                at,
                number,
                st.sampled_from([0, 0.5, 1, 1, 2, 3, 3.5]),
                st.sampled_from([0, 0, 1, 2, 5]),
            ),
            max_size=4,
        )
    )
    run: dict[str, Any] = {
        "graph": graph,
        "starts": draw(
            st.lists(st.integers(0, len(graph.names) - 1), min_size=robots, max_size=robots)
        ),
        "seed": draw(st.integers(0, 1 << 30)),
        "lost_in": {
            wave: [(robot, "failed")]
            for wave, robot in draw(st.dictionaries(st.integers(0, 20), number, max_size=2)).items()
        },
        "old_tags": {},
        "faults": faults,
        "radio": {
            **draw(st.sampled_from(RADIOS)),
            "heartbeat": draw(st.sampled_from(["global", "reach"])),
        },
        "device": {"capacity_bytes": draw(st.sampled_from([8, 8, 8, 0]))},
        "clock": {"rounds_max": 40},
    }
    if draw(st.booleans()):
        lengths = st.sampled_from([None, 0.0, 0.5, 1.0, 3.0])
        run["graph"] = PortGraph(graph.names, graph.ends, [draw(lengths) for _ in graph.ends])
        jitter = draw(st.sampled_from([0, 0, 0.25, "exponential"]))
        run["clock"] = {"mode": "event", "jitter": jitter, "rounds_max": 40}
        run["team"] = {"speed": [draw(st.sampled_from([0.5, 1.0, 2.0])) for _ in range(robots)]}
    if run["device"]["capacity_bytes"] and draw(st.booleans()):
        run["bookkeeping"] = {"fresh": False}
        places = draw(st.sets(st.integers(0, len(graph.names) - 1)))
        run["old_tags"] = {place: TagWrite(place, place + 1, b"old") for place in places}
    return run


@settings(max_examples=700)
@given(random_runs())
def test_the_world_is_the_naive_world(run: dict[str, Any]) -> None:
    world, end, events, naive, status = play_both(**run)
    assert first_difference(events, naive.events) is None, first_difference(events, naive.events)
    assert end.status == status
    assert world.struck == naive.struck
    assert {robot: refusal.error for robot, refusal in world.refusals.items()} == naive.refused
    seen = range(len(naive.tags)) if not run["old_tags"] else ()
    assert [world.tags[place] for place in seen] == [naive.tags[place] for place in seen]
    assert [world.revisions[place] for place in seen] == [naive.revisions[place] for place in seen]
