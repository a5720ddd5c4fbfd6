"""The plan of a parent and its children: the schedule played by hand, and its counts."""

import json
from collections.abc import Callable, Sequence
from functools import cache
from itertools import pairwise, permutations
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.planning.order import NEAREST, near_distances, visiting_order
from agents.planning.parent_child import STAY, Plan, Zones, plan_team
from agents.planning.vertices import Reach, Views, choose
from deploy.cli import main
from protocol.grid import STEPS, Cell, Grid
from protocol.seeds import spawn
from tests.conftest import shared
from tests.instances import read_instance
from world_server.maps.generated_grids import rectangles

MOVES = (*STEPS, (0, 0))


class Sight:
    """Who sees whom, by sampling no line: in fractions of twice the cells, square by square."""

    def __init__(self, grid: Grid, limit: int) -> None:
        self.grid = grid
        self.limit = limit
        reach = range(-limit, limit + 1)
        self.near = [
            (down, right) for down in reach for right in reach if down**2 + right**2 <= limit
        ]
        self.of = cache(self._of)

    def _of(self, cell: Cell) -> list[Cell]:
        cells = [(cell[0] + down, cell[1] + right) for down, right in self.near]
        return [one for one in cells if self.grid.is_free(*one) and self._clear(cell, one)]

    def _clear(self, one: Cell, other: Cell) -> bool:
        rows = range(min(one[0], other[0]), max(one[0], other[0]) + 1)
        cols = range(min(one[1], other[1]), max(one[1], other[1]) + 1)
        down, right = other[0] - one[0], other[1] - one[1]

        def side(row: int, col: int) -> int:
            """Tell on which side of the line a corner lies, in half cells from the first centre."""
            return (2 * (row - one[0]) - 1) * right - (2 * (col - one[1]) - 1) * down

        for row in rows:
            for col in cols:
                corners = [side(row + south, col + east) for south in (0, 1) for east in (0, 1)]
                if min(corners) < 0 < max(corners) and not self.grid.is_free(row, col):
                    return False
        # A corner that the line meets lies between two cells that it does not cross.
        for row in rows[1:]:
            for col in cols[1:]:
                if side(row, col) == 0:
                    across = ((row - 1, col), (row, col - 1))
                    if (down > 0) != (right > 0):
                        across = ((row - 1, col - 1), (row, col))
                    if not any(self.grid.is_free(*cell) for cell in across):
                        return False
        return True


class Case(NamedTuple):
    """A map, who sees how far, and where the team is."""

    grid: Grid
    sight: Sight
    stops: list[Cell]
    parent: Cell
    children: list[Cell]
    covered: set[Cell]

    def plan(self) -> Plan:
        return plan_team(
            Zones(self.grid, self.sight.of),
            self.stops,
            parent=self.parent,
            children=self.children,
            covered=self.covered,
            in_file=2,
        )


@st.composite
def cases(draw: st.DrawFn, *, anywhere: bool = False) -> Case:
    rows, cols = draw(st.integers(1, 12)), draw(st.integers(1, 12))
    rng = Random(draw(st.integers(0, 2**32)))
    density = draw(st.sampled_from((0, 0.1, 0.3, 0.4)))
    grid = Grid(rows, cols, bytes([0, *(rng.random() < density for _ in range(rows * cols - 1))]))
    reach = sorted(grid.reachable([(0, 0)]))
    stops = rng.sample(reach, rng.randint(0, min(12, len(reach))))
    parent = rng.choice(reach)
    children = draw(st.integers(1, 6))
    where = [rng.choice(reach) if anywhere else parent for _ in range(children)]
    covered = {cell for cell in reach if anywhere and rng.random() < 0.5}
    limit = draw(st.sampled_from((1, 2, 3, 8, 24)))
    return Case(grid, Sight(grid, limit), stops, parent, where, covered)


def played(case: Case, plan: Plan) -> list[list[Cell]]:
    """Play a schedule; return where the robots are before each tick, and at the end.

    Asserts that moves lead to free cells, and that children move in sight of the parent only.
    """
    places = [case.parent, *case.children]
    assert list(plan.starts) == places
    assert len({len(moves) for moves in plan.moves}) == 1
    told = [places]
    for moves in zip(*plan.moves, strict=True):
        seen = case.sight.of(places[0])
        for place, move in zip(places[1:], moves[1:], strict=True):
            assert move == STAY or place in seen
        places = [
            (row + MOVES[move][0], col + MOVES[move][1])
            for (row, col), move in zip(places, moves, strict=True)
        ]
        assert all(case.grid.is_free(*place) for place in places)
        told.append(places)
    return told


@given(cases())
def test_children_visit_every_vertex_and_move_in_sight_of_the_parent_only(case: Case) -> None:
    plan = case.plan()
    told = played(case, plan)
    visited = {place for places in told for place in places[1:]}
    assert visited == case.grid.reachable([case.parent])
    # Eq. 3: each vertex is covered from one stop.
    covers = [cell for stop in plan.stops for cell in stop.covers]
    assert len(covers) == len(set(covers))
    assert set(covers) == visited
    assert all(place in case.sight.of(told[-1][0]) for place in told[-1])


@given(cases(anywhere=True))
def test_the_rest_is_planned_from_anywhere(case: Case) -> None:
    plan = case.plan()
    visited = {place for places in played(case, plan) for place in places[1:]}
    rest = case.grid.reachable([case.parent]) - case.covered
    assert rest <= visited
    assert {cell for stop in plan.stops for cell in stop.covers} == rest
    assert {stop.cell for stop in plan.stops if not stop.is_extra} <= set(plan.order)
    assert set(plan.order) <= set(case.stops)


@given(cases())
def test_walks_are_what_the_schedule_does_around_a_stop(case: Case) -> None:
    plan = case.plan()
    told = played(case, plan)
    for stop in plan.stops:
        assert told[stop.arrived][0] == stop.cell
        assert {cell for walk in stop.walks for cell in walk} >= set(stop.covers)
        assert set(stop.covers) <= set(case.sight.of(stop.cell))
        for child, walk in enumerate(stop.walks, start=1):
            been = [places[child] for places in told[stop.arrived : stop.covered + 1]]
            # In this order, with waits for a parent that is off its vertex.
            rest = iter([one for one, other in pairwise([*been, None]) if one != other])
            assert all(cell in rest for cell in walk)


@given(cases())
def test_the_parent_steps_off_its_vertex_for_a_child_and_comes_back(case: Case) -> None:
    plan = case.plan()
    told = played(case, plan)
    for stop in plan.stops:
        during = told[stop.arrived : stop.covered + 1]
        off = [places for places in during if places[0] != stop.cell]
        if stop.cell not in stop.covers:
            assert not off
        elif off:
            assert len(off) == 1
            assert stop.cell in off[0][1:]
        else:
            # A child whose walk begins there stood there already when the parent came.
            starts = [walk[0] if walk else None for walk in stop.walks]
            assert (stop.cell, stop.cell) in zip(starts, during[0][1:], strict=True)


@given(cases())
def test_steps_are_counted_as_the_paper_counts_them(case: Case) -> None:
    plan = case.plan()
    assert plan.coverage_steps == sum(
        max(len(walk) - 1 for walk in stop.walks if walk) for stop in plan.stops
    )
    assert plan.redundant_steps == sum(
        len(walk) for stop in plan.stops for walk in stop.walks
    ) - sum(len(stop.covers) for stop in plan.stops)
    ways = [case.parent, *(stop.cell for stop in plan.stops)]
    for stop, (one, other) in zip(plan.stops, pairwise(ways), strict=True):
        steps = stop.steps
        assert steps.leg == _moves(case.grid, one, other)
        assert steps.queue == (max(0, len(case.children) - 2) if steps.leg else 0)
        assert steps.coordination == steps.gather + steps.leg + steps.queue + steps.spread
    assert plan.schedule_steps == len(plan.moves[0])
    # Each stop may make a child wait for a tick, as the parent is off its vertex, or one behind it.
    least = plan.coverage_steps + plan.coordination_steps
    assert plan.schedule_steps <= least + 2 * len(plan.stops)


# The order of stops.


@st.composite
def stops_on_a_grid(draw: st.DrawFn, most: int) -> tuple[Grid, int, list[int]]:
    rng = Random(draw(st.integers(0, 2**32)))
    grid = Grid(9, 9, bytes([0, *(rng.random() < 0.25 for _ in range(80))]))
    reach = sorted(grid.place(*cell) for cell in grid.reachable([(0, 0)]))
    return grid, rng.choice(reach), rng.sample(reach, min(len(reach), rng.randint(1, most)))


def length(grid: Grid, places: list[int]) -> int:
    cells = map(grid.position, places)
    return sum(_moves(grid, one, other) for one, other in pairwise(cells))


@given(stops_on_a_grid(5))
def test_few_stops_are_visited_in_an_order_that_is_close_to_the_best(
    drawn: tuple[Grid, int, list[int]],
) -> None:
    grid, start, stops = drawn
    order = visiting_order(grid, start, stops)
    assert sorted(order) == sorted(stops)
    assert start not in stops or order[0] == start
    best = min(length(grid, [start, *way]) for way in permutations(stops))
    assert best <= length(grid, [start, *order]) <= 1.5 * best


@given(stops_on_a_grid(40))
def test_each_stop_knows_the_moves_to_the_nearest_others(
    drawn: tuple[Grid, int, list[int]],
) -> None:
    grid, _, stops = drawn
    known = near_distances(grid, stops)
    for one, found in zip(stops, known, strict=True):
        for other, moves in found.items():
            assert moves == _moves(grid, grid.position(one), grid.position(stops[other]))
        assert list(found.values()) == sorted(found.values())
        assert len(found) >= min(NEAREST, len(stops) - 1)


def test_an_order_of_many_stops_is_close_to_the_shortest() -> None:
    # On a lattice of 14 x 14 stops, five moves apart, 195 legs of five moves are the least.
    grid = Grid(70, 70, bytes(4900))
    stops = [grid.place(row, col) for row in range(2, 70, 5) for col in range(2, 70, 5)]
    Random(1).shuffle(stops)
    order = visiting_order(grid, grid.place(2, 2), stops)
    assert sorted(order) == sorted(stops)
    assert length(grid, order) < 1.1 * 195 * 5


# Parent vertices.


@pytest.mark.parametrize("name", ["los_10x10", "los_60x60", "los_60x60_20pct_seed0"])
def test_parent_vertices_are_those_of_the_reference(name: str) -> None:
    told = read_instance(shared("spec", "instances", f"{name}.txt"))
    grid = Grid.of_text("\n".join(told.rows))
    for radius in told.others["radii"]:
        chosen = choose(grid, Reach.of_limit(int(radius)))
        found = {
            "maxLOS": chosen.los_max,
            "sumLOS": chosen.los_sum,
            "Q": len(chosen.parents),
            "first": chosen.parents[:5],
        }
        assert found == told.expected(radius)
        assert chosen.vertices == told.expect["P"]


@given(cases())
def test_views_are_by_the_rule(case: Case) -> None:
    views = Views(case.grid, case.sight.limit)
    for cell in case.grid.free_cells():
        assert views.seen(cell) == sorted(case.sight.of(cell))


@given(cases())
def test_each_parent_vertex_has_the_largest_weight(case: Case) -> None:
    """Sec. 3.3, recomputed from scratch for each choice."""
    limit = case.sight.limit
    reach = Reach(limit, near=4 * limit + 1, in_file=1)
    chosen = choose(case.grid, reach, case.parent)
    left = case.grid.reachable([case.parent])
    assert chosen.vertices == len(left)
    parents: list[Cell] = []
    for parent in chosen.parents:
        worth = {cell: (9 - _around(cell, left)) ** 2 for cell in left}
        near = [cell for cell in left if any(_squared(cell, one) <= reach.near for one in parents)]
        weights = {
            cell: sum(worth.get(seen, 0) for seen in case.sight.of(cell)) for cell in near or left
        }
        assert parent == min(weights, key=lambda cell: (-weights[cell], cell))
        parents.append(parent)
        left -= set(case.sight.of(parent))
    assert not left


def _around(cell: Cell, cells: set[Cell]) -> int:
    row, col = cell
    near = {(row + down, col + right) for down in (-1, 0, 1) for right in (-1, 0, 1)} - {cell}
    return len(near & cells)


def _squared(one: Cell, other: Cell) -> int:
    return (one[0] - other[0]) ** 2 + (one[1] - other[1]) ** 2


@pytest.mark.parametrize(
    ("r_los_m", "spacing_m", "expected"),
    [
        (2.5, 0.5, (24, 100, 5)),
        (1.0, 0.5, (3, 16, 2)),
        (7.5, 0.5, (224, 900, 15)),
        (0.3, 0.1, (8, 36, 3)),
        (1.1, 0.5, (4, 19, 2)),
    ],
)
def test_a_radius_is_out_of_sight_itself(
    r_los_m: float, spacing_m: float, expected: tuple[int, int, int]
) -> None:
    assert Reach.of_lengths(r_los_m, spacing_m) == expected


# The paper's numbers.


def trend(
    r_los_m: float, ratio: float, teams: Sequence[int], seeds: int
) -> tuple[float, list[int]]:
    """Plan on maps of the paper's experiments.

    Returns:
        Parent vertices on average, and for each team size the steps of all maps together.
    """
    reach = Reach.of_lengths(r_los_m, 0.5)
    parents, steps = 0, [0] * len(teams)
    for seed in range(seeds):
        chosen = choose(rectangles(60, 60, ratio, spawn(seed, "world")), reach)
        parents += len(chosen.parents)
        zones = Zones(chosen.sights.grid, chosen.sights.seen)
        start = chosen.parents[0]
        for at, team in enumerate(teams):
            plan = plan_team(
                zones, chosen.parents, parent=start, children=[start] * team, in_file=reach.in_file
            )
            assert plan.schedule_steps <= plan.coverage_steps + plan.coordination_steps
            steps[at] += plan.coverage_steps + plan.coordination_steps
    return parents / seeds, steps


@pytest.mark.slow
@pytest.mark.parametrize(
    ("r_los_m", "ratio", "least", "most", "best"),
    [(1.0, 0.2, 350, 385, (2,)), (2.5, 0.2, 73, 82, (5, 6, 7)), (2.5, 0.35, 77, 89, (5, 6, 7))],
)
def test_trends_of_the_paper(
    r_los_m: float, ratio: float, least: float, most: float, best: tuple[int, ...]
) -> None:
    teams = range(1, 10)
    parents, steps = trend(r_los_m, ratio, teams, seeds=4)
    assert least <= parents <= most
    assert teams[steps.index(min(steps))] in best
    # Reference: Sec. 5, Fig. 5 and 7, Tables 1 and 2.


def test_more_sight_means_fewer_stops_and_steps() -> None:
    near, (steps_near,) = trend(2.5, 0.2, (5,), seeds=1)
    far, (steps_far,) = trend(7.5, 0.2, (5,), seeds=1)
    assert far < near / 2
    assert steps_far < steps_near


# The command.


@pytest.fixture
def facts(capsys: pytest.CaptureFixture[str]) -> Callable[..., dict[str, Any]]:
    def call(*arguments: object) -> dict[str, Any]:
        words = ["plan", *map(str, arguments), "--algorithm", "parent-child", "--json"]
        assert main(words) == 0
        told = json.loads(capsys.readouterr().out)
        assert isinstance(told, dict)
        return told

    return call


ROOM = """\
..........
.####.....
.####..##.
.......##.
..........
"""


def test_the_command_prints_the_plan(facts: Callable[..., dict[str, Any]], tmp_path: Path) -> None:
    (tmp_path / "room.txt").write_text(ROOM)
    told = facts(tmp_path / "room.txt", "--r-los", 2.5, "--spacing", 0.5, "--robots", 3)
    same = facts(tmp_path / "room.txt", "--los-cells-squared", 24, "--robots", 3)
    assert {**told, "seconds": 0} == {**same, "seconds": 0}
    chosen = choose(Grid.of_text(ROOM), Reach.of_limit(24))
    assert (told["vertices"], told["los_max"], told["los_sum"]) == (
        38,
        chosen.los_max,
        chosen.los_sum,
    )
    assert sorted(map(tuple, told["parents"])) == sorted(chosen.parents)
    assert told["robots"] == 3
    assert 0 < told["schedule_steps"] <= told["coverage_steps"] + told["coordination_steps"]


def test_the_command_writes_where_robots_are_and_a_picture(
    facts: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    (tmp_path / "room.txt").write_text(ROOM)
    paths, picture = tmp_path / "paths.json", tmp_path / "plan.png"
    told = facts(
        tmp_path / "room.txt",
        "--starts",
        "4,0",
        "--paths",
        paths,
        "--picture",
        picture,
        "--r-los",
        1,
    )
    walks = json.loads(paths.read_text())
    assert [walk[0] for walk in walks] == [[4, 0]] * 6
    assert {len(walk) for walk in walks} == {told["schedule_steps"] + 1}
    assert len({tuple(cell) for walk in walks[1:] for cell in walk}) == 38
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_map_with_a_scale_has_vertices_at_the_spacing(
    facts: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    (tmp_path / "room.txt").write_text(ROOM)
    told = facts(
        tmp_path / "room.txt", "--resolution-m", 0.5, "--spacing", 1, "--los-cells-squared", 2
    )
    # Squares of two by two characters, all free, of the first two rows; the last row has no whole one.
    assert told["vertices"] == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--r-los", "0.5"), "--r-los: found 0.5, expected more than the spacing"),
        (("--r-los", "nan"), "--r-los: found nan"),
        (("--spacing", "0"), "--spacing: found 0"),
        (("--los-cells-squared", "0"), "--los-cells-squared: found 0"),
        (("--los-cells-squared", "3", "--r-los", "1"), "--los-cells-squared: --r-los is given too"),
        (("--starts", "1,1"), "--starts: found '1,1', expected a free vertex"),
        (("--starts", "0,0 0,1"), "--starts: found '0,0 0,1', expected 'R,C'"),
        (("--r-los", "inf"), "--r-los: found inf"),
        (("--open",), "--open: not for the algorithm parent-child; expected no --open"),
        (("--seed", "0"), "--seed: not for the algorithm parent-child; expected no --seed"),
        (("--teams", "6"), "--teams: found 6, expected at most 5"),
    ],
)
def test_the_command_refuses(
    arguments: Sequence[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "room.txt").write_text(ROOM)
    words = ["plan", str(tmp_path / "room.txt"), "--algorithm", "parent-child", *arguments]
    assert main(words) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1


@pytest.mark.parametrize(
    "far",
    [
        ("--r-los", 1e9),
        ("--r-los", 1e300),
        ("--spacing", 1e-9),
        ("--los-cells-squared", 10**22),
    ],
)
def test_who_sees_farther_than_the_map_sees_all_of_it(
    far: tuple[str, float], facts: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    (tmp_path / "two.txt").write_text("....#...\n....#...\n")
    told = facts(tmp_path / "two.txt", *far, "--picture", tmp_path / "plan.png")
    assert (told["vertices"], told["out_of_reach"]) == (8, 6)
    assert (told["los_max"], told["los_sum"]) == (8, 64)
    assert len(told["parents"]) == 1


def test_the_command_tells_what_it_leaves_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, text, said in (
        ("whole", ROOM, False),
        ("two", "...#..\n", True),
    ):
        (tmp_path / f"{name}.txt").write_text(text)
        assert main(["plan", str(tmp_path / f"{name}.txt"), "--algorithm", "parent-child"]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert ("  left out          2 vertices in other parts of the map" in lines) == said


def _moves(grid: Grid, one: Cell, other: Cell) -> int:
    reached, moves = {one}, 0
    while other not in reached:
        moves += 1
        reached |= {
            (row + down, col + right)
            for row, col in reached
            for down, right in STEPS
            if grid.is_free(row + down, col + right)
        }
    return moves
