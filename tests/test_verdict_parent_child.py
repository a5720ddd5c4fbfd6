"""The verdict on parents and children: each claim bites on a trace that breaks it, and on no other."""

from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from agents.algorithms.parent_child import first_plan
from agents.planning.parent_child import STAY, Plan
from deploy.cli import main
from deploy.picture_grid import draw_grid_run
from deploy.picture_parent_child import ParentTrail
from deploy.report import print_verdict
from deploy.verdict.guarantees import Guarantee, Status
from deploy.verdict.parent_child import ParentChild, PlannedSteps
from deploy.verdict.result import Result, exit_code, judge, ledger_of, monitors_of, observers
from deploy.verdict.sight import Looks
from protocol.grid import EAST, NORTH, SOUTH, Cell, Grid
from protocol.messages import Look, Move, Request, Stop, Wait, WaitForNews
from protocol.scenario import Scenario, from_tree
from protocol.trace import Event
from tests.play import grids, line_is_clear

COVERED = "every sub-cell visited"
SEEN = "every vertex seen by a parent"
IN_SIGHT = "no child moves out of sight"
OBEDIENT = "children do as they are told"
PLANNED = "covered in the planned time"
ROBUST = "covered with losses"
END = 5

R_LOS_M, CELL_M = 1.5, 0.5
"""Three sub-cells: eight in a square around one are in sight, two in a row, and no third."""

CORRIDOR = Grid.of_text(".......", CELL_M)
ROOMS = Grid.of_text(
    """
    ......#.....
    ......#.....
    ............
    ......#.....
    ###.###..#..
    ......#.....
    ......#.....
    """,
    CELL_M,
)


# Traces.


def trace_of(
    grid: Grid,
    starts: Sequence[Cell],
    ticks: Iterable[Sequence[int]],
    *,
    parents: int = 1,
    told: Iterable[Sequence[int]] | None = None,
) -> list[Event]:
    """Let robots move tick by tick, as robots of the algorithm do.

    Args:
        grid: the map.
        starts: of all robots, the parents first.
        ticks: what each robot does in each tick: an exit, or `STAY`.
        parents: how many robots are parents; the first commands.
        told: the commands, if they are not what robots do.
    """
    moves = [list(tick) for tick in ticks]
    commands = moves if told is None else [list(tick) for tick in told]
    places = [grid.place(*start) for start in starts]
    entries: list[int | None] = [None] * len(places)
    trace: list[Event] = []

    def note(time: int, round_: int, robot: int, what: Request) -> None:
        at = places[robot], entries[robot]
        trace.append(Event(float(time), round_, 0, robot, *at, what, 0))  # type: ignore[arg-type]

    for robot in range(len(places)):
        note(0, -1, robot, Look())
    arrived = set(range(parents, len(places)))
    for time, (tick, command) in enumerate(zip(moves, commands, strict=True)):
        message = (bytes([command[0], *command[parents:]]),)
        for robot in range(parents):
            said = message if robot == 0 else ()
            note(
                time,
                0,
                robot,
                Wait(messages=said)
                if tick[robot] == STAY
                else Move(messages=said, exit=tick[robot]),
            )
        for child in sorted(arrived):
            note(time, 0, child, WaitForNews(messages=(bytes(4),)))
        arrived = set()
        for child in range(parents, len(places)):
            if tick[child] == STAY:
                note(time, 1, child, WaitForNews())
            else:
                note(time, 1, child, Move(exit=tick[child]))
                arrived.add(child)
        for robot, exit_ in enumerate(tick):
            if exit_ != STAY:
                step = (-grid.stride, 1, grid.stride, -1)[exit_]
                blocked = grid.blocked[places[robot] + step]
                places[robot] += 0 if blocked else step
                entries[robot] = exit_ if blocked else (exit_ + 2) % 4
    end = len(moves)
    for robot in range(parents):
        stop = (bytes([END] * (1 + len(places) - parents)),) if robot == 0 else ()
        note(end, 0, robot, Stop(messages=stop))
    for child in sorted(arrived):
        note(end, 0, child, WaitForNews(messages=(bytes(4),)))
    for child in range(parents, len(places)):
        note(end, 1, child, Stop())
    return trace


def losing(trace: Iterable[Event], robot: int, time: float) -> list[Event]:
    """Kill a robot at the beginning of an instant, where it stands then."""
    events = list(trace)
    at = next(event for event in events if event.robot == robot and event.time >= time)
    lost = Event(time, 0, -1, robot, at.place, at.entry, "killed", 0)
    before = [event for event in events if event.time < time or event.round < 0]
    after = [event for event in events[len(before) :] if event.robot != robot]
    return [*before, lost, *after]


def scenario_of(robots: int, **team: Any) -> Scenario:
    return from_tree(
        {
            "algorithm": "parent-child",
            "world": {"map": "x"},
            "team": {"robots": robots, "parents": 1, **team},
            "radio": {"reach": "radius", "radius_m": R_LOS_M, "line_of_sight": True},
            "sensing": {"robots_m": R_LOS_M, "map": True, "mode": "ahead"},
            "device": {"capacity_bytes": 0},
        },
        "test",
    )


def verdict(
    grid: Grid,
    trace: Iterable[Event],
    starts: Sequence[Cell],
    *,
    parents: int = 1,
    status: Status = "over",
) -> tuple[Result, ParentChild]:
    scenario = scenario_of(len(starts), parents=parents)
    ledger = ledger_of(grid, [grid.place(*start) for start in starts], scenario)
    monitors = monitors_of(scenario, ledger)
    for event in trace:
        for observe in observers(ledger, monitors):
            observe(event)
    result = judge(scenario, ledger, monitors, status=status, engine="test", trace_sha256="")
    (monitor,) = monitors
    assert isinstance(monitor, ParentChild)
    return result, monitor


def broken(result: Result) -> set[str]:
    return {guarantee.name for guarantee in result.guarantees if guarantee.holds is False}


def claim(result: Result, name: str) -> Guarantee:
    (found,) = (guarantee for guarantee in result.guarantees if guarantee.name == name)
    return found


def plan_of(grid: Grid, starts: Sequence[Cell], parents: int = 1) -> Plan:
    cells = R_LOS_M / CELL_M
    return first_plan(grid.rows, grid.cols, grid.cells(), tuple(starts), parents, cells)


def ticks_of(plan: Plan) -> list[tuple[int, ...]]:
    return list(zip(*plan.moves, strict=True))


AT = (0, 0)
THREE = [AT, AT, AT]
"""A parent and two children."""

# Runs as they should be.


@pytest.mark.parametrize("grid", [CORRIDOR, ROOMS])
@pytest.mark.parametrize("children", [1, 2, 5])
def test_a_plan_that_is_carried_out_keeps_every_promise(grid: Grid, children: int) -> None:
    starts = [AT] * (1 + children)
    plan = plan_of(grid, starts)
    result, monitor = verdict(grid, trace_of(grid, starts, ticks_of(plan)), starts)
    assert broken(result) == set()
    assert result.complete
    assert exit_code(result) == 0
    assert result.makespan == plan.schedule_steps
    assert claim(result, PLANNED).holds
    assert claim(result, ROBUST).holds is None
    assert result.parent_child == PlannedSteps(
        stops=len(plan.stops),
        coverage_steps=plan.coverage_steps,
        coordination_steps=plan.coordination_steps,
        redundant_steps=plan.redundant_steps,
        schedule_steps=plan.schedule_steps,
    )
    assert msgspec.json.decode(msgspec.json.encode(result), type=Result) == result
    # The trail is the parent's way, step by step, with the stops of the plan.
    trail = monitor.trail()
    steps = [abs(a - c) + abs(b - d) for (a, b), (c, d) in pairwise(trail.way)]
    assert steps == [1] * sum(move != STAY for move in plan.moves[0])
    assert trail.stops == [stop.cell for stop in plan.stops]
    assert set(trail.stops) <= set(trail.way)
    assert trail.reach == 3


def test_the_report_tells_the_steps_of_the_plan(capsys: pytest.CaptureFixture[str]) -> None:
    plan = plan_of(ROOMS, THREE)
    result, _ = verdict(ROOMS, trace_of(ROOMS, THREE, ticks_of(plan)), THREE)
    print_verdict(result)
    said = capsys.readouterr().out
    assert f"{len(plan.stops)} stops, {plan.coverage_steps} steps to cover" in said


def test_parents_that_stand_by_make_the_same_moves() -> None:
    starts = [AT] * 4
    plan = plan_of(ROOMS, starts, 2)
    ticks = [(parent, parent, *children) for parent, *children in ticks_of(plan)]
    result, _ = verdict(ROOMS, trace_of(ROOMS, starts, ticks, parents=2), starts, parents=2)
    assert broken(result) == set()
    # One of them that stays behind is not as planned.
    ticks = [(parent, STAY, *children) for parent, _, *children in ticks]
    result, _ = verdict(ROOMS, trace_of(ROOMS, starts, ticks, parents=2), starts, parents=2)
    assert broken(result) == {PLANNED}
    assert "robot 1 made 0 moves" in claim(result, PLANNED).detail


# Each claim bites.


def test_a_child_that_walks_off_is_out_of_sight() -> None:
    starts = [AT, AT]
    result, _ = verdict(CORRIDOR, trace_of(CORRIDOR, starts, [(STAY, EAST)] * 6), starts)
    assert broken(result) == {SEEN, IN_SIGHT, OBEDIENT, PLANNED}
    assert claim(result, SEEN).detail == "3 of 7 in sight of where a parent stood"
    assert claim(result, IN_SIGHT).detail == (
        "3 of 6 moves of children out of sight, the first: robot 1 at [0, 3], t=3"
    )
    assert claim(result, OBEDIENT).detail == (
        "3 of 6 moves of children without a command in sight, the first: robot 1 at [0, 3], t=3"
    )


def test_a_wall_and_a_squeeze_hide_a_child() -> None:
    for text in ("... .#. ...", "..# .#. #.."):
        grid = Grid.of_text(text, CELL_M)
        around = [(STAY, EAST), (STAY, EAST), (STAY, SOUTH), (STAY, NORTH)]
        result, _ = verdict(grid, trace_of(grid, [(0, 0)] * 2, around), [(0, 0)] * 2)
        assert claim(result, IN_SIGHT).holds is (text != "... .#. ...")
    # From (1, 0) to (0, 1) between two obstacles: the child is one column away, yet hidden.
    grid = Grid.of_text("#... .#.. ....", CELL_M)
    starts = [(1, 0), (0, 1)]
    result, _ = verdict(grid, trace_of(grid, starts, [(STAY, EAST)]), starts)
    assert claim(result, IN_SIGHT).holds is False


def test_a_child_moves_on_command_only() -> None:
    plan = plan_of(ROOMS, THREE)
    ticks = ticks_of(plan)
    at = next(time for time, tick in enumerate(ticks) if tick[1] != STAY)
    for wrong in (STAY, (ticks[at][1] + 1) % 4):
        told = [
            (tick[0], wrong, *tick[2:]) if time == at else tick for time, tick in enumerate(ticks)
        ]
        result, _ = verdict(ROOMS, trace_of(ROOMS, THREE, ticks, told=told), THREE)
        assert broken(result) == {OBEDIENT}
        assert "the first: robot 1" in claim(result, OBEDIENT).detail


def test_a_command_is_good_for_one_move() -> None:
    starts = [AT, AT]
    trace = trace_of(CORRIDOR, starts, [(STAY, EAST), (STAY, EAST)])
    silent = [
        msgspec.structs.replace(event, what=Wait())
        if event.robot == 0 and event.time == 1
        else event
        for event in trace
    ]
    result, _ = verdict(CORRIDOR, silent, starts)
    assert claim(result, OBEDIENT).holds is False
    assert claim(result, IN_SIGHT).holds is True


def test_what_only_a_parent_visits_is_not_covered() -> None:
    starts = [AT, AT]
    ticks = [(EAST, STAY), (EAST, EAST), (EAST, EAST), (EAST, EAST), (EAST, EAST), (EAST, EAST)]
    result, _ = verdict(CORRIDOR, trace_of(CORRIDOR, starts, ticks), starts)
    assert broken(result) == {COVERED, PLANNED}
    assert result.uncovered == [(0, 6)]
    assert (result.covered, result.to_cover, result.visits_extra) == (6, 7, 0)
    assert (result.coverage_time, result.complete) == (6, False)
    assert [robot.first_visits for robot in result.per_robot] == [0, 6]


def test_a_tick_more_is_not_as_planned() -> None:
    plan = plan_of(CORRIDOR, THREE)
    ticks = [(STAY, STAY, STAY), *ticks_of(plan)]
    result, _ = verdict(CORRIDOR, trace_of(CORRIDOR, THREE, ticks), THREE)
    assert broken(result) == {PLANNED}
    assert claim(result, PLANNED).detail == (
        f"makespan {len(ticks)}, planned {len(ticks) - 1} ticks"
    )


def test_a_run_that_was_cut_off_has_not_failed_yet() -> None:
    trace = trace_of(ROOMS, THREE, ticks_of(plan_of(ROOMS, THREE)))
    result, _ = verdict(ROOMS, trace[:40], THREE, status="unfinished")
    assert broken(result) == set()
    assert claim(result, SEEN).detail.endswith("so far")
    assert claim(result, PLANNED).detail.endswith("the run is not over")


# Losses.


def test_without_a_parent_nobody_is_blamed_and_it_is_said() -> None:
    starts = [AT, AT]
    trace = losing(trace_of(CORRIDOR, starts, [(STAY, EAST), (STAY, STAY)]), 0, 1)
    result, _ = verdict(CORRIDOR, trace, starts)
    assert broken(result) == set()
    assert not result.complete
    assert exit_code(result) == 1
    assert result.parent_child is None
    for name in (COVERED, SEEN, ROBUST):
        assert claim(result, name).holds is None
        assert (
            "no parent survived, without whom children cannot go on" in claim(result, name).detail
        )
    # A child that goes on all the same is seen by nobody.
    trace = losing(trace_of(CORRIDOR, starts, [(STAY, EAST), (STAY, EAST)]), 0, 1)
    result, _ = verdict(CORRIDOR, trace, starts)
    assert broken(result) == {IN_SIGHT, OBEDIENT}


def test_without_a_child_nobody_is_blamed() -> None:
    starts = [AT, AT]
    trace = losing(trace_of(CORRIDOR, starts, [(STAY, EAST), (STAY, STAY)]), 1, 1)
    result, _ = verdict(CORRIDOR, trace, starts)
    assert broken(result) == set()
    assert claim(result, COVERED).detail == "2 of 7 sub-cells visited; no child survived"


def test_a_parent_that_stands_by_sees_for_the_lost_one() -> None:
    starts = [AT, AT, AT]
    ticks = [(STAY, STAY, EAST), (STAY, STAY, EAST)]
    trace = losing(trace_of(CORRIDOR, starts, ticks, parents=2), 0, 1)
    told = [
        msgspec.structs.replace(event, what=Wait(messages=(bytes([STAY, EAST]),)))
        if event.robot == 1 and event.time == 1
        else event
        for event in trace
    ]
    result, _ = verdict(CORRIDOR, told, starts, parents=2)
    # It does not go on: the survivors could have covered all.
    assert broken(result) == {COVERED, SEEN, ROBUST}
    # While both live only the lowest commands.
    result, _ = verdict(CORRIDOR, trace, starts, parents=2)
    assert OBEDIENT in broken(result)


def test_survivors_cover_the_rest() -> None:
    plan = plan_of(CORRIDOR, [AT, AT])
    # One child does it all, the other is lost at once.
    ticks = [(*tick, STAY) for tick in ticks_of(plan)]
    result, monitor = verdict(CORRIDOR, losing(trace_of(CORRIDOR, THREE, ticks), 2, 1), THREE)
    assert broken(result) == set()
    # The plan is another one than at first; its stops are where the parent stayed.
    assert set(monitor.trail().stops) <= {stop.cell for stop in plan.stops}
    assert monitor.trail().stops
    assert claim(result, ROBUST).holds
    assert claim(result, ROBUST).detail == "1 of 3 robots lost; 7 of 7 sub-cells covered"
    assert claim(result, PLANNED).holds is None
    short = losing(trace_of(CORRIDOR, THREE, ticks[:3]), 2, 1)
    result, _ = verdict(CORRIDOR, short, THREE)
    assert {COVERED, ROBUST} <= broken(result)


# Sight.


@given(grids(), st.sampled_from([0.5, 1.0, 1.5, 2.5]), st.data())
def test_sight_is_that_of_the_rule(grid: Grid, radius_m: float, data: st.DataObject) -> None:
    looks = Looks(grid, radius_m)
    cells = grid.free_cells()
    one = data.draw(st.sampled_from(cells))
    for other in cells:
        distance = ((one[0] - other[0]) ** 2 + (one[1] - other[1]) ** 2) ** 0.5 * grid.cell_m
        near = distance < radius_m - 1e-9
        expected = near and line_is_clear(grid, one, other)
        assert looks.sees(grid.place(*one), grid.place(*other)) == expected


# Pictures.


def test_a_picture_shows_where_the_parent_went(tmp_path: Path) -> None:
    plan = plan_of(ROOMS, THREE)
    result, monitor = verdict(ROOMS, trace_of(ROOMS, THREE, ticks_of(plan)), THREE)
    drawn = []
    for overlay in (None, ParentTrail(*monitor.trail())):
        drawn.append(tmp_path / f"{overlay is None}.png")
        draw_grid_run(
            ROOMS,
            drawn[-1],
            title="A run",
            subtitle="as the test has it",
            starts=THREE,
            first_visits=monitor._ledger.first_visits,
            owners={},
            edges=[],
            lost={},
            stopped={},
            team_size=result.robots,
            parents=1,
            overlay=overlay,
        )
    without, shown = (Image.open(path).convert("L") for path in drawn)
    assert without.size == shown.size
    dark = [sum(image.histogram()[:60]) for image in (without, shown)]
    assert dark[1] > dark[0] + 1000


def test_a_run_has_its_plan_in_the_result_and_its_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scenario = Path(__file__).parents[1] / "deploy" / "scenarios" / "parent_child.toml"
    words = [
        "run",
        str(scenario),
        "--engine",
        "inprocess",
        "--json",
        "--out",
        str(tmp_path / "run"),
    ]
    assert main(words) == 0
    result = msgspec.json.decode(capsys.readouterr().out, type=Result)
    assert result.parent_child is not None
    assert result.makespan == result.parent_child.schedule_steps
    assert broken(result) == set()
    assert (tmp_path / "run" / "run.png").stat().st_size > 10_000
