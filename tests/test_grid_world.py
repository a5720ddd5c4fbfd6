"""Motion on grids: exits and bumps, gazes, bodies in the way, odometry, and recovery of all that."""

from collections.abc import Sequence
from itertools import pairwise
from math import erfc, sqrt
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.body import Body
from deploy.inprocess import play
from protocol.errors import ExitError, GazeError, RuleError
from protocol.grid import EAST, NORTH, SOUTH, STEPS, WEST, Cell, Grid
from protocol.messages import (
    AnyRequest,
    GridSight,
    Look,
    Move,
    RadioFacts,
    SensingFacts,
    Stop,
    Wait,
    WaitForNews,
)
from protocol.scenario import to_tree
from protocol.seeds import spawn
from protocol.trace import Event, first_difference
from tests.play import Conducted, asking, conducted, graph_of, grids, scenario_of, sha256
from world_server.journal import (
    AnyRecord,
    Closing,
    Journal,
    OldTags,
    WaveRecord,
    opening,
    scan,
)
from world_server.replay import replay
from world_server.terrain import terrain_of
from world_server.world import (
    UNKNOWN_PLACE,
    Answers,
    End,
    KillOrder,
    Output,
    TagsWanted,
    Wave,
    World,
)

OPEN = Grid(5, 5, bytes(25))
BLOCK: dict[str, Any] = {"world": {"map": "none", "bodies": "block"}}
EVENT: dict[str, Any] = {"clock": {"mode": "event"}}
NO_DEVICES: dict[str, Any] = {"device": {"capacity_bytes": 0}}


def move(exit_: int, gaze: int | None = None) -> Move:
    return Move(None, (), exit_, gaze)


def look(gaze: int | None = None) -> Look:
    return Look(None, (), gaze)


def wait(duration: float = 1.0) -> Wait:
    return Wait(None, (), duration)


def walked(
    grid: Grid, start: Cell, requests: Sequence[AnyRequest], **fields: Any
) -> tuple[Conducted, list[GridSight]]:
    """Let one robot make requests; return the run and everything that it saw."""
    seen: list[GridSight] = []
    run = conducted(grid, [asking(*requests, seen=seen)], starts=[grid.place(*start)], **fields)
    return run, seen


def at(robot: int, time: float, round_: int = 0) -> dict[str, Any]:
    return {"kill": f"robot:{robot}", "at": time, "round": round_}


# Exits.


@pytest.mark.parametrize("exit_", [NORTH, EAST, SOUTH, WEST])
def test_exits_lead_north_east_south_and_west(exit_: int) -> None:
    _, seen = walked(OPEN, (2, 2), [move(exit_)])
    down, right = {0: (-1, 0), 1: (0, 1), 2: (1, 0), 3: (0, -1)}[exit_]
    assert [(sight.time, sight.position, sight.entry) for sight in seen] == [
        (0.0, (2, 2), None),
        (1.0, (2 + down, 2 + right), {0: 2, 1: 3, 2: 0, 3: 1}[exit_]),
    ]
    assert [sight.degree for sight in seen] == [4, 4]
    assert [OPEN.position(sight.place) for sight in seen] == [sight.position for sight in seen]


@pytest.mark.parametrize("exit_", [NORTH, EAST, SOUTH, WEST])
def test_who_bumps_comes_back_by_the_exit_it_took(exit_: int) -> None:
    _, seen = walked(Grid(1, 1, b"\0"), (0, 0), [move(exit_), move(exit_)])
    assert [(sight.time, sight.position, sight.entry) for sight in seen] == [
        (0.0, (0, 0), None),
        (1.0, (0, 0), exit_),
        (2.0, (0, 0), exit_),
    ]


@settings(max_examples=60)
@given(grids(), st.lists(st.integers(0, 3), max_size=40), st.data())
def test_a_walk_is_that_of_the_naive_model(
    grid: Grid, exits: list[int], data: st.DataObject
) -> None:
    start = data.draw(st.sampled_from(grid.free_cells()))
    _, seen = walked(grid, start, [move(exit_) for exit_ in exits])
    here, entry = start, None
    expected: list[tuple[float, Cell, int | None]] = [(0.0, here, None)]
    for tick, exit_ in enumerate(exits, start=1):
        to = (here[0] + STEPS[exit_][0], here[1] + STEPS[exit_][1])
        if to in grid.free_cells():
            here, entry = to, (exit_ + 2) % 4
        else:
            entry = exit_
        expected.append((float(tick), here, entry))
    assert [(sight.time, sight.position, sight.entry) for sight in seen] == expected


@pytest.mark.parametrize(("cell_m", "speed", "duration"), [(0.5, 2.0, 0.25), (3.0, 1.5, 2.0)])
def test_under_the_event_clock_a_step_and_a_bump_take_cell_by_speed(
    cell_m: float, speed: float, duration: float
) -> None:
    grid = Grid(1, 2, bytes(2), cell_m)
    _, seen = walked(
        grid, (0, 0), [move(EAST), move(EAST), move(NORTH)], team={"speed": speed}, **EVENT
    )
    assert [sight.time for sight in seen] == [0.0, duration, 2 * duration, 3 * duration]
    assert [sight.entry for sight in seen] == [None, WEST, EAST, NORTH]


def test_in_lockstep_a_step_takes_a_tick_whatever_its_length() -> None:
    grid = Grid(1, 2, bytes(2), 0.05)
    _, seen = walked(grid, (0, 0), [move(EAST), move(EAST)], team={"speed": 9.0})
    assert [sight.time for sight in seen] == [0.0, 1.0, 2.0]


def test_robots_meet_on_a_sub_cell_and_read_its_tag() -> None:
    seen: list[list[GridSight]] = [[], []]
    scripts = [
        asking(Move(b"left", (), EAST), wait(), seen=seen[0]),
        asking(move(NORTH), move(WEST), seen=seen[1]),
    ]
    conducted(OPEN, scripts, starts=[OPEN.place(1, 0), OPEN.place(2, 1)])
    assert [sight.here for sight in seen[0]] == [(), (1,), ()]
    assert seen[1][-1].tag == b"left"


# Refusals.


@pytest.mark.parametrize(
    ("request_", "error", "detail"),
    [
        (move(4), "ExitError", "exit 4 on a grid; expected 0 (north), 1, 2 or 3 (west)"),
        (move(-1), "ExitError", "exit -1 on a grid; expected 0 (north), 1, 2 or 3 (west)"),
        (move(10**9), "ExitError", None),
        (move(0, 4), "GazeError", "gaze 4; expected 0 (north), 1, 2 or 3 (west)"),
        (move(0, -1), "GazeError", None),
        (look(4), "GazeError", None),
        (look(-1), "GazeError", None),
    ],
)
def test_no_such_exit_or_direction_puts_a_robot_out(
    request_: AnyRequest, error: str, detail: str | None
) -> None:
    scripts = [asking(wait(), request_), asking(wait(3))]
    run = conducted(OPEN, scripts, starts=[OPEN.place(2, 2), 0])
    refusal = run.world.refusals[0]
    assert refusal.error == error
    assert detail in (None, refusal.detail)
    assert set(run.world.refusals) == {0}
    assert [(event.time, event.what) for event in run.events if event.robot == 0][-1] == (
        1.0,
        "refused",
    )
    assert run.world.bodies[0].place == OPEN.place(2, 2)
    assert run.events[-1].what == Stop()  # the other goes on


@pytest.mark.parametrize("request_", [look(0), move(0, 0), look(9)])
def test_on_a_graph_there_is_nothing_to_look_at(request_: AnyRequest) -> None:
    run = conducted(graph_of("01"), [asking(request_), asking(wait())])
    assert run.world.refusals[0].error == "GazeError"
    assert "on a graph" in run.world.refusals[0].detail
    assert run.events[-1].what == Stop()


def test_these_errors_are_definite_rules() -> None:
    for error in (ExitError, GazeError):
        assert issubclass(error, RuleError)
        assert error.definite


@pytest.mark.parametrize("gaze", ["north", 1.5])
def test_a_gaze_of_another_type_ends_its_robot_and_no_other(gaze: Any) -> None:
    async def script(body: Body) -> None:
        await body.look()
        await body.look(gaze=gaze if body.robot == 0 else NORTH)
        await body.wait(2.0)

    scenario = scenario_of(2, sensing={"mode": "ahead"})
    events: list[Event] = []
    world = World(scenario, terrain_of(OPEN, scenario), [0, 3], observe=events.append)
    end, failures = play(scenario, world, script)
    assert end == End("over")
    assert set(failures) | set(world.refusals) == {0}


# Gazes.

NICHES = Grid.of_text("""
    ##..##
    ##..##
    ......
    ......
    ##..##
    ##..##
""")
"""Seen from coarse cell 1, 1 all is free; from 0, 1 all but the south is blocked."""


def gazing(*requests: AnyRequest) -> list[str]:
    """Return what a robot sees of the coarse cell ahead of it, from sub-cell 2, 0 on."""
    _, seen = walked(NICHES, (2, 0), requests, sensing={"mode": "ahead"})
    return [sight.seen.decode() for sight in seen]


def test_a_robot_looks_nowhere_until_it_is_told_to() -> None:
    assert gazing(look(), move(SOUTH), wait()) == ["?"] * 4


def test_each_direction_is_looked_in() -> None:
    assert gazing(look(NORTH), look(EAST), look(SOUTH), look(WEST)) == ["?", "#", ".", "#", "#"]


def test_a_gaze_is_kept_until_another_one_is_named() -> None:
    """East of the first coarse cell is the second, and so on up to the border."""
    stay = (look(), wait(), WaitForNews(None, (), 1.0), move(WEST), move(SOUTH))
    assert gazing(look(EAST), *stay) == ["?"] + ["."] * 6
    # By way of the second and third coarse cell: the gaze goes along.
    assert gazing(look(EAST), *(move(EAST),) * 5) == ["?", ".", ".", ".", ".", "#", "#"]
    assert gazing(look(EAST), look(NORTH), look(), move(EAST)) == ["?", ".", "#", "#", "#"]


def test_the_gaze_of_a_move_is_that_on_arrival() -> None:
    assert gazing(look(NORTH), move(EAST, EAST), move(EAST, NORTH), look()) == [
        "?",
        "#",
        ".",
        ".",
        ".",
    ]
    assert gazing(look(EAST), move(SOUTH, WEST), move(NORTH)) == ["?", ".", "#", "#"]


def test_a_robot_that_bumps_looks_where_it_meant_to() -> None:
    assert gazing(look(EAST), move(WEST, SOUTH), look()) == ["?", ".", "#", "#"]


# Bodies in the way.


def follow(run: Conducted, grid: Grid, starts: Sequence[Cell], step: Sequence[float]) -> int:
    """Follow a trace by the rules alone; check that all stand where these put them.

    A robot takes up the sub-cell that it stands on, and while it goes also the one that it goes to.

    Args:
        run: a run with ``bodies = "block"``.
        grid: where.
        starts: sub-cell of each robot.
        step: how long a step takes each robot.

    Returns:
        How many moves ended at another body.
    """
    stands = list(starts)
    entries: list[int | None] = [None] * len(starts)
    heads: dict[int, tuple[float, Cell, int]] = {}
    bumps = 0
    for event in run.events:
        for robot, (due, to, entry) in list(heads.items()):
            if due <= event.time:
                stands[robot], entries[robot] = to, entry
                del heads[robot]
        robot, here = event.robot, stands[event.robot]
        if event.place is None:
            del heads[robot]  # lost on its way: it lies where it left from
            continue
        assert (grid.position(event.place), event.entry) == (here, entries[robot])
        assert robot not in heads
        if isinstance(event.what, Move):
            exit_ = event.what.exit
            to = (here[0] + STEPS[exit_][0], here[1] + STEPS[exit_][1])
            taken = to in stands or any(to == other for _, other, _ in heads.values())
            bumps += taken
            bumped = taken or not grid.is_free(*to)
            arrival = (here, exit_) if bumped else (to, (exit_ + 2) % 4)
            heads[robot] = (event.time + step[robot], *arrival)
        ahead = [to for robot, (_, to, _) in heads.items() if to != stands[robot]]
        assert len({*stands, *ahead}) == len(stands) + len(ahead), event
    return bumps


async def jostles(body: Body) -> None:
    """Walk about at random, wait now and then, and stop some time; now and then break a rule."""
    await body.look()
    for _ in range(body.rng.randint(5, 25)):
        chance = body.rng.random()
        if chance < 0.8:
            await body.move(body.rng.randrange(4))
        elif chance < 0.82:
            await body.move(7)
        elif chance < 0.95:
            await body.wait(float(body.rng.randint(1, 3)))
        else:
            await body.look()


@st.composite
def crowds(draw: st.DrawFn) -> tuple[Grid, list[Cell], dict[str, Any], dict[int, Any]]:
    """Small grids full of robots of which some are killed; a grid, starts, fields and losses."""
    grid = draw(grids(rows_max=4, cols_max=5))
    free = grid.free_cells()
    robots = draw(st.integers(1, min(7, len(free))))
    starts = draw(st.permutations(free))[:robots]
    number = st.integers(0, robots - 1)
    time = st.integers(0, 40).map(lambda half: half / 2)
    timed = st.builds(at, number, time, st.integers(0, 2))
    in_place = st.builds(
        lambda robot, n: {"kill": f"robot:{robot}", "at_request": n}, number, st.integers(1, 20)
    )
    fields: dict[str, Any] = {
        "seed": draw(st.integers(0, 1 << 20)),
        "faults": draw(st.lists(timed | in_place, max_size=4)),
        **(BLOCK if draw(st.booleans()) else {**BLOCK, **NO_DEVICES}),
    }
    if draw(st.booleans()):
        speeds = st.lists(st.sampled_from([0.3, 0.5, 1.0]), min_size=robots, max_size=robots)
        fields |= {**EVENT, "team": {"speed": draw(speeds)}}
    cause = st.sampled_from(["failed", "killed"])
    lost = draw(st.dictionaries(st.integers(0, 30), st.tuples(number, cause), max_size=2))
    return grid, list(starts), fields, {wave: [loss] for wave, loss in lost.items()}


@settings(max_examples=100)
@given(crowds())
def test_bodies_that_block_never_share_a_sub_cell(crowd: Any) -> None:
    """Also not with remains, and however they are killed."""
    grid, starts, fields, lost_in = crowd
    places = [grid.place(*start) for start in starts]
    run = conducted(grid, [jostles] * len(starts), starts=places, lost_in=lost_in, **fields)
    speeds = fields.get("team", {}).get("speed")
    step = [grid.cell_m / speed for speed in speeds] if speeds else [1.0] * len(starts)
    follow(run, grid, starts, step)
    final = [body.place for body in run.world.bodies]
    assert len(set(final)) == len(final)


@settings(max_examples=50)
@given(crowds(), st.sampled_from([0.2, 0.6, 2.0]), st.booleans())
def test_bodies_that_drift_never_share_a_sub_cell(crowd: Any, drift: float, reset: bool) -> None:
    grid, starts, fields, lost_in = crowd
    places = [grid.place(*start) for start in starts]
    fields["sensing"] = {
        "mode": "ahead",
        "position": "odometry",
        "drift": drift,
        "reset": reset,
    }
    run = conducted(grid, [jostles] * len(starts), starts=places, lost_in=lost_in, **fields)
    stands = list(places)
    for event in run.events:
        if event.place is not None:
            stands[event.robot] = event.place
        assert len(set(stands)) == len(stands), event
    assert [body.place for body in run.world.bodies] == stands


def test_crowds_do_bump() -> None:
    grid = Grid(3, 4, bytes(12))
    starts = grid.free_cells()[:9]
    places = [grid.place(*start) for start in starts]
    run = conducted(grid, [jostles] * 9, starts=places, **BLOCK)
    assert follow(run, grid, starts, [1.0] * 9) > 20


def ends_of(
    requests: Sequence[Sequence[AnyRequest]], starts: Sequence[int], **fields: Any
) -> list[list[tuple[float, int, int | None]]]:
    """Let robots act in a corridor; return time, column and entry of everything each one saw."""
    corridor = Grid(1, 6, bytes(6))
    seen: list[list[GridSight]] = [[] for _ in starts]
    scripts = [asking(*each, seen=sights) for each, sights in zip(requests, seen, strict=True)]
    conducted(corridor, scripts, starts=list(starts), **fields)
    return [[(sight.time, sight.position[1], sight.entry) for sight in sights] for sights in seen]


def test_robots_that_want_to_swap_both_bump() -> None:
    ends = ends_of([[move(EAST)], [move(WEST)]], [2, 3], **BLOCK)
    assert ends == [[(0.0, 2, None), (1.0, 2, EAST)], [(0.0, 3, None), (1.0, 3, WEST)]]


def test_where_bodies_pass_robots_swap_and_share() -> None:
    ends = ends_of([[move(EAST)], [move(WEST)], [wait(1)]], [2, 3, 3])
    assert ends[0][1] == (1.0, 3, WEST)
    assert ends[1][1] == (1.0, 2, EAST)


def test_a_sub_cell_is_taken_until_its_robot_has_arrived_elsewhere() -> None:
    follower, leader = ends_of([[move(EAST), move(EAST)], [move(EAST)]], [2, 3], **BLOCK)
    assert leader == [(0.0, 3, None), (1.0, 4, WEST)]
    assert follower == [(0.0, 2, None), (1.0, 2, EAST), (2.0, 3, WEST)]


def test_the_lower_id_gets_the_sub_cell_that_two_want() -> None:
    ends = ends_of([[move(EAST)], [move(WEST)]], [1, 3], **BLOCK)
    assert [sights[1] for sights in ends] == [(1.0, 2, WEST), (1.0, 3, WEST)]


def test_a_bump_takes_the_time_of_a_move() -> None:
    fields: dict[str, Any] = {**BLOCK, **EVENT, "team": {"speed": [0.5, 1.0]}}
    ends = ends_of([[move(EAST)], [wait(9)]], [2, 3], **fields)
    assert ends[0] == [(0.0, 2, None), (2.0, 2, EAST)]


def test_robots_that_wait_or_have_stopped_are_in_the_way() -> None:
    still: list[list[AnyRequest]] = [[wait(5)], [], [WaitForNews(None, (), 5.0)]]
    for requests in still:
        ends = ends_of([[wait(), move(EAST)], requests], [2, 3], **BLOCK)
        assert ends[0][-1] == (2.0, 2, EAST)


def test_remains_lie_where_a_robot_stood() -> None:
    requests: list[list[AnyRequest]] = [[wait(2), move(EAST)], [wait(9)]]
    ends = ends_of(requests, [2, 3], faults=[at(1, 1)], **BLOCK)
    assert ends[0][-1] == (3.0, 2, EAST)


def test_remains_of_a_robot_under_way_lie_where_it_left_from() -> None:
    requests: list[list[AnyRequest]] = [[wait(2), move(EAST)], [move(EAST)], [wait(2), move(WEST)]]
    ends = ends_of(requests, [1, 2, 4], faults=[at(1, 0.5)], **BLOCK)
    assert ends[0][-1] == (3.0, 1, EAST)  # there it lies
    assert ends[2][-1] == (3.0, 3, EAST)  # and not where it went


def test_remains_of_a_robot_that_was_about_to_bump_lie_where_it_stood() -> None:
    requests: list[list[AnyRequest]] = [[wait(2), move(EAST)], [move(EAST)], [wait(9)]]
    ends = ends_of(requests, [1, 2, 3], faults=[at(1, 0.5)], **BLOCK)
    assert ends[0][-1] == (3.0, 1, EAST)


def test_a_robot_that_broke_a_rule_is_in_the_way_and_nowhere_else() -> None:
    requests: list[list[AnyRequest]] = [[wait(2), move(EAST)], [move(9)], [wait(2), move(WEST)]]
    ends = ends_of(requests, [1, 2, 4], **BLOCK)
    assert ends[0][-1] == (3.0, 1, EAST)
    assert ends[2][-1] == (3.0, 3, EAST)


def test_a_move_that_was_refused_takes_up_no_sub_cell() -> None:
    too_long = Move(bytes(9), (), EAST)
    requests: list[list[AnyRequest]] = [[too_long], [wait(2), move(WEST)]]
    ends = ends_of(requests, [2, 4], device={"capacity_bytes": 8}, **BLOCK)
    assert ends[1][-1] == (3.0, 3, EAST)


# Odometry.


def walk_of(steps: int, seed: int, exits: Sequence[int] = (0, 1, 2, 3)) -> list[AnyRequest]:
    stream = spawn(seed, "walk")
    return [move(stream.choice(exits)) for _ in range(steps)]


@settings(max_examples=40)
@given(grids(), st.integers(0, 99), st.data())
def test_without_drift_odometry_is_the_known_position(
    grid: Grid, seed: int, data: st.DataObject
) -> None:
    start = data.draw(st.sampled_from(grid.free_cells()))
    walk = walk_of(30, seed)
    sights = [
        walked(grid, start, walk, sensing={"mode": "three", "position": position})[1]
        for position in ("known", "odometry")
    ]
    known, odometry = ([(s.time, s.position, s.entry, s.seen) for s in each] for each in sights)
    assert odometry == known


@settings(max_examples=40)
@given(grids(), st.integers(0, 99), st.data())
def test_without_drift_bodies_in_the_way_do_not_confuse_odometry(
    grid: Grid, seed: int, data: st.DataObject
) -> None:
    free = grid.free_cells()
    starts = data.draw(st.permutations(free))[:4]
    positions = []
    for position in ("known", "odometry"):
        seen: list[list[GridSight]] = [[] for _ in starts]
        scripts = [
            asking(*walk_of(20, seed + robot), seen=sights) for robot, sights in enumerate(seen)
        ]
        fields: dict[str, Any] = {**BLOCK, "sensing": {"mode": "ahead", "position": position}}
        conducted(grid, scripts, starts=[grid.place(*cell) for cell in starts], **fields)
        positions.append([[(s.position, s.entry) for s in sights] for sights in seen])
    assert positions[0] == positions[1]


def test_a_robot_that_adds_up_its_moves_is_not_told_its_place() -> None:
    told = {"odometry": {UNKNOWN_PLACE}, "known": {OPEN.place(2, 2), OPEN.place(1, 2)}}
    for position, places in told.items():
        sensing = {"mode": "ahead", "position": position}
        _, seen = walked(OPEN, (2, 2), [move(NORTH), move(SOUTH), wait(), look(1)], sensing=sensing)
        assert {sight.place for sight in seen} == places


WIDE = Grid(401, 401, bytes(401 * 401))


Journey = tuple[list[Cell], list[Cell], list[int | None]]


def drifted(
    grid: Grid,
    start: Cell,
    walk: Sequence[AnyRequest],
    sensing: dict[str, Any],
    **fields: Any,
) -> Journey:
    """Return where a robot was after each step, where it took itself to be, and its entries."""
    sensing = {"mode": "ahead", "position": "odometry", **sensing}
    run, seen = walked(grid, start, walk, sensing=sensing, **fields)
    assert all(event.place is not None for event in run.events)
    # The first event is the opening look, which answers no sight.
    true = [grid.position(event.place) for event in run.events[1:] if event.place is not None]
    entries = [sight.entry for sight in seen]
    assert entries == [event.entry for event in run.events[1:]]
    return true, [sight.position for sight in seen], entries


def expected_drift(
    grid: Grid, start: Cell, walk: Sequence[AnyRequest], seed: int, drift: float, *, reset: bool
) -> Journey:
    """Return the same by the words of the rule, for one robot of id 0."""
    stream = spawn(seed, "drift", 0)
    here, believes = start, start
    error = [0.0, 0.0]
    true, believed = [here], [believes]
    entries: list[int | None] = [None]
    for step in walk:
        assert isinstance(step, Move)
        down, right = STEPS[step.exit]
        meant = (here[0] + down, here[1] + right)
        entries.append(step.exit)
        if grid.is_free(*meant):
            entries[-1] = (step.exit + 2) % 4  # even if it slips back to where it was
            error = [off + stream.gauss(0.0, drift) for off in error]
            ends = (meant[0] + round(error[0]), meant[1] + round(error[1]))
            if not grid.is_free(*ends):
                ends = meant
                error = [max(-0.5, min(off, 0.5)) for off in error]
            believes = (believes[0] + down, believes[1] + right)
            error = [error[0] - (ends[0] - meant[0]), error[1] - (ends[1] - meant[1])]
            if reset:
                error = [0.0, 0.0]
            here = ends
        true.append(here)
        believed.append(believes)
    return true, believed, entries


@given(
    grids(),
    st.integers(0, 99),
    st.sampled_from([0.05, 0.3, 0.6, 2.0]),
    st.booleans(),
    st.sampled_from([BLOCK, {}]),
    st.data(),
)
def test_where_a_robot_is_and_believes_to_be_part_as_drawn(
    grid: Grid, seed: int, drift: float, reset: bool, fields: Any, data: st.DataObject
) -> None:
    start = data.draw(st.sampled_from(grid.free_cells()))
    walk = walk_of(40, seed)
    found = drifted(grid, start, walk, {"drift": drift, "reset": reset}, seed=seed, **fields)
    assert found == expected_drift(grid, start, walk, seed, drift, reset=reset)
    assert all(grid.is_free(*cell) for cell in found[0])  # walls keep it inside


def test_with_reset_each_move_slips_on_its_own() -> None:
    """An error of more than half a sub-cell, along or across, is as likely as that of a Gaussian."""
    drift, steps = 0.25, 3000
    walk = [move((EAST, WEST)[step % 2]) for step in range(steps)]
    true, believed, _ = drifted(WIDE, (200, 200), walk, {"drift": drift})
    assert set(believed) == {(200, 200), (200, 201)}
    slips = [
        ((b[0] - a[0]), (b[1] - a[1]) - (1 if step % 2 == 0 else -1))
        for step, (a, b) in enumerate(pairwise(true))
    ]
    for axis in (0, 1):
        rate = sum(slip[axis] != 0 for slip in slips) / steps
        assert abs(rate - erfc(0.5 / drift / sqrt(2))) < 0.01
        assert abs(sum(slip[axis] for slip in slips)) < 40  # to either side alike


def test_with_reset_errors_below_half_a_sub_cell_do_not_add_up() -> None:
    walk = walk_of(1000, 1)
    true, believed, _ = drifted(WIDE, (200, 200), walk, {"drift": 0.08})
    assert true == believed


def test_without_reset_errors_add_up() -> None:
    """After n moves the robot is off by the root of n times the drift, near enough."""
    drift, steps = 0.08, 1000
    offs = []
    for seed in range(8):
        sensing = {"drift": drift, "reset": False}
        true, believed, _ = drifted(WIDE, (200, 200), walk_of(steps, seed), sensing, seed=seed)
        offs += [true[-1][axis] - believed[-1][axis] for axis in (0, 1)]
    deviation = sqrt(sum(off * off for off in offs) / len(offs))
    assert 0.6 < deviation / (drift * sqrt(steps)) < 1.6


def test_an_error_does_not_grow_into_a_wall() -> None:
    """Behind the end of a long wall a robot is at most one sub-cell off, as it was beside it."""
    length = 300
    free = bytes([1] * length + [0] * 20)
    grid = Grid(3, 320, bytes([1] * 320) + bytes(320) + free)
    for seed in range(10):
        sensing = {"drift": 0.2, "reset": False}
        true, *_ = drifted(grid, (1, 0), [move(EAST)] * (length + 5), sensing, seed=seed)
        assert all(abs(b[0] - a[0]) <= 1 and abs(b[1] - a[1]) <= 2 for a, b in pairwise(true))
    one_row = Grid(1, 320, bytes(320))
    for seed in range(10):
        run = conducted(
            one_row,
            [asking(*[move(EAST)] * 200)],
            seed=seed,
            sensing={"mode": "ahead", "position": "odometry", "drift": 0.2, "reset": False},
        )
        steering = run.world._steering
        assert steering is not None
        assert all(abs(error) <= 0.5 for error in steering._errors[0])


def test_the_same_seed_drifts_alike_and_each_robot_on_its_own() -> None:
    def places(*walks: Sequence[AnyRequest], seed: int = 1) -> list[list[int | None]]:
        scripts = [asking(*walk) for walk in walks]
        sensing = {"mode": "ahead", "position": "odometry", "drift": 0.4}
        starts = [WIDE.place(200, 200)] * len(walks)
        run = conducted(WIDE, scripts, starts=starts, sensing=sensing, seed=seed)
        return [[e.place for e in run.events if e.robot == robot] for robot in range(len(walks))]

    walk = walk_of(60, 1)
    first, second = places(walk, walk)
    assert first != second
    assert places(walk, walk) == [first, second]
    assert places([wait()], walk)[1] == second  # whatever the others do
    assert places(walk, walk, seed=2)[0] != first


# Briefings.


def briefing_of(start: Cell, grid: Grid = OPEN, **fields: Any) -> Any:
    scenario = scenario_of(2, **fields)
    world = World(scenario, terrain_of(grid, scenario), [0, grid.place(*start)])
    return world.briefing(1)


def test_a_briefing_tells_position_senses_and_radio() -> None:
    briefing = briefing_of(
        (3, 1),
        sensing={"mode": "line-of-sight", "range_m": 2.5},
        radio={"reach": "radius", "radius_m": 4.0, "latency": 0.5, "loss": 0.1},
        **BLOCK,
    )
    assert briefing.position == (3, 1)
    assert briefing.sensing == SensingFacts(
        mode="line-of-sight", window=5, range_cells=2.5, bodies_block=True
    )
    assert briefing.radio == RadioFacts("radius", 0.5, True)


@pytest.mark.parametrize(
    ("sensing", "window", "range_cells"),
    [
        ({"mode": "ahead"}, 0, 0.0),
        ({"mode": "three"}, 0, 0.0),
        ({"mode": "three", "position": "odometry", "drift": 0.2}, 0, 0.0),
        ({"mode": "radius", "range_m": 0.2}, 1, 0.4),
        ({"mode": "radius", "range_m": 1.5}, 7, 3.0),
    ],
)
def test_a_briefing_tells_how_far_a_robot_sees(
    sensing: dict[str, Any], window: int, range_cells: float
) -> None:
    grid = Grid(5, 5, bytes(25), 0.5)
    briefing = briefing_of((0, 4), grid, sensing=sensing, radio={"reach": "global"})
    assert briefing.sensing == SensingFacts(
        mode=sensing["mode"], window=window, range_cells=range_cells
    )
    assert briefing.position == (0, 4)  # also for one that adds up its moves from there
    assert briefing.radio == RadioFacts("global", 0.0, False)


def test_on_a_graph_there_is_no_position() -> None:
    scenario = scenario_of(1)
    briefing = World(scenario, terrain_of(graph_of("01"), scenario), [0]).briefing(0)
    assert briefing.position is None
    assert (briefing.sensing, briefing.radio) == (SensingFacts(), RadioFacts())


# Recovery.

ROOM = Grid.of_text("""
    .......
    ..##...
    ..##.#.
    .......
""")
STARTS = tuple(ROOM.place(*cell) for cell in ((0, 0), (0, 1), (3, 0), (3, 5)))


def everything_on(**fields: Any) -> dict[str, Any]:
    """Return a scenario that leaves nothing out."""
    return {
        "seed": 5,
        "world": {"map": "none", "bodies": "block"},
        "clock": {"mode": "event", "jitter": 0.3},
        "radio": {
            "reach": "radius",
            "radius_m": 4.0,
            "line_of_sight": True,
            "latency": 0.7,
            "loss": 0.2,
            "duplicate": 0.2,
            "heartbeat": "reach",
        },
        "sensing": {
            "mode": "line-of-sight",
            "range_m": 2.5,
            "position": "odometry",
            "drift": 0.3,
            "reset": False,
        },
        "faults": [at(0, 6.5), {"kill": "robot:2", "at_request": 30}],
        "bookkeeping": {"fresh": False},
        **fields,
    }


LOCKSTEP = {"clock": {"mode": "lockstep"}}
RECOVERED = {
    "line-of-sight": everything_on(),
    "lockstep": everything_on(**LOCKSTEP),
    "radius": everything_on(sensing={"mode": "radius", "range_m": 1.0}),
    "ahead": everything_on(
        sensing={"mode": "ahead", "position": "odometry", "drift": 0.2}, **LOCKSTEP
    ),
    "three": everything_on(sensing={"mode": "three"}, world={"map": "none"}),
}


async def wanders(body: Body) -> None:
    """Do everything that one can do on a grid, at random."""
    here = await body.look(gaze=body.rng.randrange(4))
    rng = body.rng
    for _ in range(30):
        messages = tuple(rng.randbytes(1) for _ in range(rng.randrange(3)))
        gaze = rng.choice((None, 0, 1, 2, 3))
        match rng.randrange(10):
            case 0:
                here = await body.look(gaze=gaze, messages=messages)
            case 1:
                here = await body.write(bytes([len(here.inbox)]), messages)
            case 2:
                here = await body.exchange(*messages)
            case 3:
                here = await body.wait(float(rng.randint(1, 2)))
            case 4:
                here = await body.wait_for_news(at_most=3.0)
            case _:
                here = await body.move(rng.randrange(4), gaze=gaze, messages=messages)


def journalled(path: Path, fields: dict[str, Any]) -> tuple[World, list[Event]]:
    """Play with a journal, as an engine does."""
    scenario = scenario_of(len(STARTS), **fields)
    events: list[Event] = []
    world = World(scenario, terrain_of(ROOM, scenario), STARTS, observe=events.append)
    journal = Journal(path)
    journal.append(opening("run-1", "test", to_tree(scenario), ROOM, STARTS))

    def record(answers: Answers) -> None:
        journal.append(WaveRecord(answers.requests, answers.lost))

    def read_tags(places: tuple[int, ...]) -> tuple[()]:
        journal.append(OldTags(()))
        return ()

    end, failures = play(scenario, world, wanders, record, read_tags)
    assert (end, failures) == (End("over"), {})
    journal.append(Closing(end.status, sha256(events), 0.0))
    journal.close()
    return world, events


def state_of(world: World) -> list[Any]:
    """Return everything that a world remembers of bodies on a grid."""
    names = [name for name in world.bodies[0].__slots__ if name != "sight"]
    bodies = [{name: getattr(body, name) for name in names} for body in world.bodies]
    sights = [body.sight for body in world.bodies]
    steering = world._steering
    steered: list[Any] = []
    if steering is not None:
        streams = [stream.getstate() for stream in steering._streams]
        steered = [steering.believed, steering._errors, steering._bodies_at, streams]
    return [world.time, bodies, sights, steered, world.tags, world.revisions, world.struck]


@pytest.mark.parametrize("name", RECOVERED)
def test_a_replay_gives_the_same_world(tmp_path: Path, name: str) -> None:
    world, events = journalled(tmp_path / "journal", RECOVERED[name])
    found: list[Event] = []
    replayed = replay(tmp_path / "journal", observe=found.append)
    assert first_difference(events, found) is None
    assert replayed.output == End("over")
    assert replayed.closing is not None
    assert replayed.trace_sha256 == replayed.closing.trace_sha256 == sha256(events)
    assert state_of(replayed.world) == state_of(world)
    assert set(world.struck) == {0, 1}


def carry_on(world: World, output: Output, records: Sequence[AnyRecord]) -> Output:
    """Give a world the inputs that a journal holds."""
    for record in records:
        while isinstance(output, KillOrder):
            output = world.resume(None)
        if isinstance(record, WaveRecord):
            assert isinstance(output, Wave)
            output = world.resume(Answers(record.requests, record.lost))
        elif isinstance(record, OldTags):
            assert isinstance(output, TagsWanted)
            output = world.resume(record.tags)
    while isinstance(output, KillOrder):
        output = world.resume(None)
    return output


@pytest.mark.parametrize("name", RECOVERED)
def test_a_world_that_was_recovered_anywhere_goes_on_the_same(tmp_path: Path, name: str) -> None:
    world, events = journalled(tmp_path / "journal", RECOVERED[name])
    whole = (tmp_path / "journal").read_bytes()
    records = list(scan(tmp_path / "journal"))
    for cut in range(1, len(records) - 1, 9):
        path = tmp_path / f"cut{cut}"
        path.write_bytes(whole[: records[cut - 1][1]])
        found: list[Event] = []
        replayed = replay(path, observe=found.append, until_asked=True)
        rest = [record for record, _ in records[cut:]]
        assert carry_on(replayed.world, replayed.output, rest) == End("over")
        assert first_difference(events, found) is None
        assert state_of(replayed.world) == state_of(world)


def test_the_same_seed_gives_the_same_run_and_another_one_another(tmp_path: Path) -> None:
    digests = []
    for number, seed in enumerate((5, 5, 6)):
        _, events = journalled(tmp_path / str(number), everything_on(seed=seed))
        digests.append(sha256(events))
    assert digests[0] == digests[1] != digests[2]
