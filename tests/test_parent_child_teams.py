"""Several teams of a parent and its children: parts, schedules played by hand, and the command."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.planning.parent_child import STAY, Plan, Zones, plan_team
from agents.planning.parent_child_teams import TeamPart, TeamsPlanner, time_of
from agents.planning.vertices import Choice, Reach, choose
from deploy.cli import main
from protocol.grid import STEPS, Cell, Grid
from protocol.line_of_sight import in_sight
from protocol.seeds import spawn
from world_server.maps.generated_grids import rectangles

MOVES = (*STEPS, (0, 0))
IN_FILE = 2


class Case(NamedTuple):
    """A map, how far is seen, and the robots."""

    grid: Grid
    limit: int
    start: Cell
    children: int

    @property
    def chosen(self) -> Choice:
        return choose(self.grid, Reach.of_limit(self.limit), self.start)

    @property
    def planner(self) -> TeamsPlanner:
        return TeamsPlanner(self.chosen, self.start, children=self.children, in_file=IN_FILE)

    def sees(self, one: Cell, other: Cell) -> bool:
        down, right = other[0] - one[0], other[1] - one[1]
        return down**2 + right**2 <= self.limit and in_sight(self.grid, one, other)


@st.composite
def cases(draw: st.DrawFn, most_children: int = 6) -> Case:
    rows, cols = draw(st.integers(1, 9)), draw(st.integers(1, 9))
    rng = Random(draw(st.integers(0, 2**32)))
    density = draw(st.sampled_from((0, 0.15, 0.35)))
    grid = Grid(rows, cols, bytes([0, *(rng.random() < density for _ in range(rows * cols - 1))]))
    start = rng.choice(sorted(grid.reachable([(0, 0)])))
    limit = draw(st.sampled_from((1, 3, 8, 24)))
    return Case(grid, limit, start, draw(st.integers(1, most_children)))


@st.composite
def divided(draw: st.DrawFn) -> tuple[Case, tuple[TeamPart, ...]]:
    case = draw(cases())
    planner = case.planner
    return case, planner.plan(draw(st.integers(1, planner.most_teams)))


def visited(case: Case, plan: Plan) -> set[Cell]:
    """Play a schedule; return where children were. Asserts that they move in sight of the parent."""
    places = list(plan.starts)
    been = set(places[1:])
    for moves in zip(*plan.moves, strict=True):
        for place, move in zip(places[1:], moves[1:], strict=True):
            assert move == STAY or case.sees(places[0], place)
        places = [
            (row + MOVES[move][0], col + MOVES[move][1])
            for (row, col), move in zip(places, moves, strict=True)
        ]
        assert all(case.grid.is_free(*place) for place in places)
        been.update(places[1:])
    return been


def is_connected(cells: Sequence[Cell]) -> bool:
    left = set(cells)
    ahead = [left.pop()]
    while ahead:
        row, col = ahead.pop()
        beside = {(row + down, col + right) for down, right in STEPS} & left
        left -= beside
        ahead += beside
    return not left


@settings(max_examples=40)
@given(divided())
def test_parts_are_connected_and_share_what_is_to_be_covered(
    drawn: tuple[Case, tuple[TeamPart, ...]],
) -> None:
    case, teams = drawn
    cells = [cell for team in teams for cell in team.part]
    assert len(cells) == len(set(cells))
    assert set(cells) == case.grid.reachable([case.start])
    assert all(is_connected(team.part) for team in teams)


@settings(max_examples=40)
@given(divided())
def test_children_of_each_team_visit_its_part_in_sight_of_their_parent(
    drawn: tuple[Case, tuple[TeamPart, ...]],
) -> None:
    case, teams = drawn
    assert sum(team.children for team in teams) == case.children
    for team in teams:
        assert team.plan.starts == (case.start,) * (1 + team.children)
        assert visited(case, team.plan) >= set(team.part)
        covers = [cell for stop in team.plan.stops for cell in stop.covers]
        assert sorted(covers) == list(team.part)


@settings(max_examples=40)
@given(divided())
def test_the_time_is_that_of_the_slowest_team(drawn: tuple[Case, tuple[TeamPart, ...]]) -> None:
    _, teams = drawn
    plans = [team.plan for team in teams]
    assert time_of(teams) == (
        max(plan.schedule_steps for plan in plans),
        max(plan.coverage_steps + plan.coordination_steps for plan in plans),
    )


@settings(max_examples=40)
@given(cases())
def test_one_team_does_what_a_team_alone_does(case: Case) -> None:
    chosen = case.chosen
    alone = plan_team(
        Zones(case.grid, chosen.sights.seen),
        chosen.parents,
        parent=case.start,
        children=[case.start] * case.children,
        in_file=IN_FILE,
    )
    (team,) = case.planner.plan(1)
    assert team.plan == alone


@settings(max_examples=25)
@given(cases(most_children=9))
def test_as_many_teams_as_are_fastest_are_never_slower_than_one_or_all(case: Case) -> None:
    planner = case.planner
    best = planner.best()
    assert sum(team.children for team in best) == case.children
    assert time_of(best) <= time_of(planner.plan(1))
    assert time_of(best) <= time_of(planner.plan(planner.most_teams))


@settings(max_examples=15)
@given(cases())
def test_a_plan_does_not_depend_on_what_was_planned_before(case: Case) -> None:
    used = case.planner
    most = used.most_teams
    used.best()
    assert used.plan(most) == case.planner.plan(most)


def test_two_teams_in_a_corridor_go_to_both_ends() -> None:
    case = Case(Grid(1, 41, bytes(41)), 8, (0, 20), 2)
    teams = case.planner.plan(2)
    assert {len(team.part) for team in teams} <= {19, 20, 21, 22}
    # No slower than one child that has half of the corridor, and begins at an end of it.
    (half,) = Case(Grid(1, 21, bytes(21)), 8, (0, 0), 1).planner.plan(1)
    assert time_of(teams) <= half.time


@pytest.mark.slow
def test_teams_on_the_maps_of_the_paper_share_the_time_about_evenly() -> None:
    reach = Reach.of_lengths(2.5, 0.5)
    chosen = choose(rectangles(60, 60, 0.2, spawn(0, "world")), reach)
    start = chosen.parents[0]
    planner = TeamsPlanner(chosen, start, children=6, in_file=reach.in_file)
    times = []
    for number in (1, 2, 3, 6):
        teams = planner.plan(number)
        ticks = [team.time[0] for team in teams]
        assert max(ticks) <= 1.15 * min(ticks)
        times.append(time_of(teams))
    assert times == sorted(times, reverse=True)
    # Twice as many parents with as many children: much is gained by less coordination.
    assert times[-1][0] < times[0][0] / 2


# The command.

ROOM = """\
..........
.####.....
.####..##.
.......##.
..........
"""


@pytest.fixture
def room(tmp_path: Path) -> Path:
    (tmp_path / "room.txt").write_text(ROOM)
    return tmp_path / "room.txt"


@pytest.fixture
def facts(capsys: pytest.CaptureFixture[str]) -> Callable[..., dict[str, Any]]:
    def call(*arguments: object) -> dict[str, Any]:
        words = ["plan", *map(str, arguments), "--algorithm", "parent-child", "--json"]
        assert main(words) == 0
        told = json.loads(capsys.readouterr().out)
        assert isinstance(told, dict)
        return told

    return call


def test_the_command_tells_of_each_team(facts: Callable[..., dict[str, Any]], room: Path) -> None:
    told = facts(room, "--r-los", 1, "--robots", 5, "--teams", 3)
    teams = told["teams"]
    assert len(teams) == 3
    for key in ("robots", "vertices", "redundant_steps"):
        assert told[key] == sum(team[key] for team in teams)
    assert told["parents"] == [cell for team in teams for cell in team["parents"]]
    assert told["schedule_steps"] == max(team["schedule_steps"] for team in teams)
    assert told["coverage_steps"] + told["coordination_steps"] == max(
        team["coverage_steps"] + team["coordination_steps"] for team in teams
    )


def test_one_team_is_told_of_as_ever(facts: Callable[..., dict[str, Any]], room: Path) -> None:
    told, one = facts(room, "--robots", 3), facts(room, "--robots", 3, "--teams", 1)
    assert {**told, "seconds": 0} == {**one, "seconds": 0}
    assert "teams" not in told


def test_the_command_finds_how_many_teams_are_fastest(
    facts: Callable[..., dict[str, Any]], room: Path
) -> None:
    best, same = (facts(room, "--robots", 4, "--teams", word) for word in ("best", 0))
    assert {**best, "seconds": 0} == {**same, "seconds": 0}
    alone = facts(room, "--robots", 4)
    assert len(best["teams"]) > 1
    assert best["schedule_steps"] < alone["schedule_steps"]


def test_the_command_writes_all_robots_of_all_teams_and_draws_them(
    facts: Callable[..., dict[str, Any]],
    room: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    paths, picture = tmp_path / "paths.json", tmp_path / "plan.png"
    asked = ("--starts", "4,0", "--robots", "3", "--teams", "2", "--r-los", "1")
    told = facts(room, *asked, "--paths", paths, "--picture", picture)
    walks = json.loads(paths.read_text())
    assert [walk[0] for walk in walks] == [[4, 0]] * 5
    assert {len(walk) for walk in walks} == {told["schedule_steps"] + 1}
    first = 1 + told["teams"][0]["robots"]
    children = walks[1:first] + walks[first + 1 :]
    assert len({tuple(cell) for walk in children for cell in walk}) == told["vertices"]
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert main(["plan", str(room), "--algorithm", "parent-child", *asked]) == 0
    said = capsys.readouterr().out
    assert "2 parents and 3 children" in said
    assert "  team 1 " in said


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--teams", "few"), "--teams: found 'few', expected a whole number"),
        (("--teams", "-1"), "--teams: found '-1', expected a whole number"),
        (("--teams", "4", "--robots", "3"), "--teams: found 4, expected at most 3"),
        (("--teams", "39", "--robots", "50"), "--teams: found 39, expected at most 38"),
    ],
)
def test_the_command_refuses(
    arguments: Sequence[str], message: str, room: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["plan", str(room), "--algorithm", "parent-child", *arguments]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
