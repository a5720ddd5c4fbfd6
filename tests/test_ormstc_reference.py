"""The reference of ORMSTC: the published values, and the paper's theorems on random little worlds."""

from collections import Counter
from collections.abc import Callable
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.grid import Cell
from tests.instances import Instance, read_instance
from tests.ormstc_reference import Kill, Outcome, coarse, play, reachable, scan, sub_cell

Shared = Callable[..., Path]

ONLINE = [
    "on_10x10",
    "on_1x3_cex",
    "on_5cell_cex",
    "on_6x6",
    "on_6x6_few",
    "on_W_1x2",
    "on_W_1x2_kill",
    "on_conflict",
    "on_done_dies",
    "on_mid",
    "on_shared",
    "on_shared_kill",
]
SCANS = ["scan_2x2", "scan_plus"]


def played(instance: Instance, rules: str) -> Outcome:
    """Play an instance; as its values were recorded, robots wait for the last kill."""
    return play(
        instance.free,
        instance.robots,
        instance.kills,
        rule=instance.conflict,
        lazy=rules.endswith("+lazy"),
        literal=rules == "literal",
        stand_by_until=max((tick for tick, _, _ in instance.kills), default=0),
    )


def cells_of(text: str) -> set[Cell]:
    rows = enumerate(text.split())
    return {(r, c) for r, row in rows for c, mark in enumerate(row) if mark == "."}


# Published values --------------------------------------------------------------------------------


def test_no_instance_is_left_out(shared: Shared) -> None:
    folder = shared("spec", "instances")
    named = {path.stem for pattern in ("on_*", "scan_*") for path in folder.glob(pattern)}
    assert named == {*ONLINE, *SCANS}


@pytest.mark.parametrize("name", ONLINE)
def test_an_instance_gives_its_values(shared: Shared, name: str) -> None:
    instance = read_instance(shared("spec", "instances", f"{name}.txt"))
    assert instance.kind == "online"
    assert {key.split(".")[0] for key in instance.expect} == set(instance.rules)
    for rules in instance.rules:
        outcome = asdict(played(instance, rules))
        expected = instance.expected(rules)
        assert {key: outcome[key] for key in expected} == expected, rules


@pytest.mark.parametrize("name", SCANS)
@pytest.mark.parametrize("direction", ["ccw", "cw"])
def test_a_scan_gives_its_values(shared: Shared, name: str, direction: str) -> None:
    instance = read_instance(shared("spec", "instances", f"{name}.txt"))
    assert instance.kind == "scan"
    (robot,) = instance.robots
    moves, revisits = scan(instance.free, robot, direction)
    assert instance.expected(direction) == {"moves": moves, "revisits": revisits}


def test_comments_are_no_part_of_an_instance(tmp_path: Path) -> None:
    text = """; a file
kind online ; its kind
map
..#
; between two rows
#..

robots 1 2  2 3
kills 2:1:pre 4:0:mid ; two
expect fixed.covered True ; yes
expect fixed.done_at [13, None]
expect fixed.owner 01#/#.1
"""
    path = tmp_path / "instance.txt"
    path.write_text(text, encoding="utf-8")
    instance = read_instance(path)
    assert (instance.kind, instance.rows, instance.conflict) == ("online", ["..#", "#.."], "id")
    assert instance.free == {(0, 0), (0, 1), (1, 1), (1, 2)}
    assert instance.robots == [(1, 2), (2, 3)]
    assert instance.kills == [(2, 1, "pre"), (4, 0, "mid")]
    expected = {"covered": True, "done_at": [13, None], "owner": "01#/#.1"}
    assert instance.expected("fixed") == expected


def test_under_r7_a_kill_after_the_end_never_strikes(shared: Shared) -> None:
    """Reference: the note on ``on_done_dies`` below the rules."""
    instance = read_instance(shared("spec", "instances", "on_done_dies.txt"))
    for lazy in (False, True):
        outcome = play(instance.free, instance.robots, instance.kills, lazy=lazy)
        assert (outcome.moves, outcome.extra, outcome.lost) == ([8, 4], 2, [])


def test_a_kill_in_the_tick_after_the_last_move_strikes() -> None:
    # Both are complete at 4. At that very moment, robot 1 dies; robot 0 takes its cell.
    free, robots = cells_of(".."), [(0, 1), (1, 3)]
    assert play(free, robots, [(5, 1, "pre")], lazy=False).moves == [10, 4]
    assert play(free, robots, [(5, 1, "pre")], lazy=True).moves == [4, 4]
    assert play(free, robots, [(5, 1, "mid")], lazy=False).lost == []


@pytest.mark.parametrize(("rule", "cells"), [("id", [1, 3]), ("few", [2, 2])])
def test_a_conflict_goes_to_the_highest_id_or_to_who_has_fewer_cells(
    rule: str, cells: list[int]
) -> None:
    # In tick 3 both claim the second cell; robot 1 has two by then.
    outcome = play(cells_of("...."), [(0, 0), (0, 6)], rule=rule, lazy=True)
    assert outcome.cells == cells


def test_lazily_cells_of_the_complete_stay_covered_unless_others_lie_behind_them() -> None:
    """Reference: R10. Robot 1 completes and dies between robot 0 and the cells of robot 2."""
    free, robots = cells_of("...."), [(1, 1), (1, 3), (1, 5)]
    alone = play(free, robots, [(5, 1, "pre")], lazy=True)
    assert (alone.cells, alone.extra, alone.done_at) == ([1, 1, 2], 3, [4, None, 8])
    before_another = play(free, robots, [(5, 1, "pre"), (6, 2, "pre")], lazy=True)
    assert (before_another.cells, before_another.covered) == ([4, 0, 0], True)


def test_completion_counts_from_the_arrival_at_the_start() -> None:
    """Reference: R5, R10. Killed on its last move it is incomplete, right after it complete."""
    free, robots = cells_of(".."), [(0, 1), (1, 3)]
    assert play(free, robots, [(4, 1, "mid")], lazy=True).cells == [2, 0]
    assert play(free, robots, [(5, 1, "pre")], lazy=True).cells == [1, 1]


# As printed --------------------------------------------------------------------------------------


def test_as_printed_a_withdrawn_completion_is_never_announced_again() -> None:
    """C3. Reference: Algorithm 3, lines 28 and 36."""
    free, robots, kills = cells_of("..."), [(1, 1), (0, 4)], [(6, 1, "pre")]
    printed = play(free, robots, kills, lazy=False, literal=True)
    assert (printed.covered, printed.ended, printed.done_at) == (True, False, [4, None])
    corrected = play(free, robots, kills, lazy=False)
    assert (corrected.covered, corrected.ended) == (True, True)


def test_as_printed_the_last_neighbour_of_the_start_is_entered_whoever_owns_it() -> None:
    """C4. Reference: Algorithm 3, lines 21 and 22; Theorem 5."""
    free, robots = cells_of(".."), [(0, 1), (1, 3)]
    assert play(free, robots, lazy=False, literal=True).moves == [8, 4]
    assert play(free, robots, lazy=False).moves == [4, 4]


# Random little worlds ----------------------------------------------------------------------------


PHASES = st.sampled_from(["pre", "mid"])
RULES = st.sampled_from(["id", "few"])


@st.composite
def worlds(draw: st.DrawFn) -> tuple[set[Cell], list[Cell]]:
    """Draw a map, more often than not connected, and sub-cells to start at."""
    rows, cols = draw(st.integers(1, 4)), draw(st.integers(1, 5))
    cells = [(row, col) for row in range(rows) for col in range(cols)]
    blocked = draw(st.sets(st.sampled_from(cells), max_size=len(cells) // 3))
    free = set(cells) - blocked
    places = st.sampled_from(sorted(sub_cells_of(free)))
    return free, draw(st.lists(places, min_size=1, max_size=4, unique=True))


@st.composite
def worlds_with_kills(draw: st.DrawFn) -> tuple[set[Cell], list[Cell], list[Kill]]:
    free, robots = draw(worlds())
    who = st.sets(st.integers(0, len(robots) - 1), max_size=len(robots) - 1)
    when = st.integers(1, 70)
    return free, robots, [(draw(when), n, draw(PHASES)) for n in sorted(draw(who))]


def sub_cells_of(cells: set[Cell]) -> set[Cell]:
    return {sub_cell(cell, which) for cell in cells for which in range(4)}


def check_walks(free: set[Cell], robots: list[Cell], outcome: Outcome) -> None:
    """Check that robots go step by step, at most one a tick, and count their moves right."""
    assert outcome.visits == sorted(outcome.visits)
    for number, start in enumerate(robots):
        walk = [(time, at) for time, robot, at in outcome.visits if robot == number]
        assert walk[0] == (0, start)
        for (earlier, (row, col)), (later, (to_row, to_col)) in pairwise(walk):
            assert later > earlier
            assert abs(row - to_row) + abs(col - to_col) == 1
            assert coarse((to_row, to_col)) in free
        assert len(walk) == outcome.moves[number] + 1


def check_trees(outcome: Outcome) -> None:
    """Check that each robot's cells are joined by a tree, and that nobody else has them."""
    for number, tree in enumerate(outcome.trees):
        own = {cell for cell, owner in outcome.owner.items() if owner == number}
        assert len(own) == outcome.cells[number]
        assert len(tree) == max(0, len(own) - 1)
        joined = set(sorted(own)[:1])
        for _ in tree:
            joined |= {cell for edge in tree if joined & set(edge) for cell in edge}
        assert joined == own
    assert sum(outcome.cells) == len(outcome.owner)


@settings(max_examples=150)
@given(worlds(), RULES, st.booleans())
def test_without_losses_each_sub_cell_is_visited_once_but_for_the_starts(
    world: tuple[set[Cell], list[Cell]], rule: str, lazy: bool
) -> None:
    """Reference: Theorem 5; the start is entered again when the lap closes."""
    free, robots = world
    outcome = play(free, robots, rule=rule, lazy=lazy)
    check_walks(free, robots, outcome)
    check_trees(outcome)
    expected = Counter(sub_cells_of(reachable(free, map(coarse, robots))))
    # A start once more: for the rooted by their return, for the spare by its owner.
    expected.update(robots)
    assert Counter(at for _, _, at in outcome.visits) == expected
    assert (outcome.ended, outcome.covered) == (True, True)
    # R5, and R4: of several robots in one coarse cell the last one has it.
    assert outcome.moves == [4 * cells for cells in outcome.cells]
    assert outcome.done_at == [moves or None for moves in outcome.moves]
    for number, start in enumerate(robots):
        is_spare = coarse(start) in map(coarse, robots[number + 1 :])
        assert is_spare == (outcome.cells[number] == 0)
        assert is_spare or outcome.owner[coarse(start)] == number


@settings(max_examples=400)
@given(worlds_with_kills(), RULES, st.booleans())
def test_what_a_survivor_can_reach_is_covered_in_bounded_time(
    world: tuple[set[Cell], list[Cell], list[Kill]], rule: str, lazy: bool
) -> None:
    """Reference: Theorem 6, with R11."""
    free, robots, kills = world
    outcome = play(free, robots, kills, rule=rule, lazy=lazy)
    check_walks(free, robots, outcome)
    check_trees(outcome)
    assert outcome.ended
    lost = {number: tick for tick, number, _ in kills if number in outcome.lost}
    within_reach = reachable(free, [coarse(at) for n, at in enumerate(robots) if n not in lost])
    visited = {at for _, _, at in outcome.visits}
    assert sub_cells_of(within_reach) <= visited
    assert outcome.covered
    for time, number, _ in outcome.visits:
        assert time < lost.get(number, time + 1)
    if lazy:
        assert within_reach <= set(outcome.owner)
    else:
        assert {outcome.owner[cell] for cell in within_reach}.isdisjoint(lost)
    for number, done_at in enumerate(outcome.done_at):
        assert (done_at is None) == (number in lost or not outcome.cells[number])
    # One more lap at most has been seen, and a quarter.
    assert outcome.visits[-1][0] <= max(lost.values(), default=0) + 2 * len(sub_cells_of(free))


@settings(max_examples=150)
@given(worlds_with_kills(), RULES)
def test_as_printed_a_run_ends_or_comes_to_rest(
    world: tuple[set[Cell], list[Cell], list[Kill]], rule: str
) -> None:
    free, robots, kills = world
    outcome = play(free, robots, kills, rule=rule, lazy=False, literal=True)
    check_walks(free, robots, outcome)
    assert len(outcome.visits) < 100 * len(free) * len(robots)


@settings(max_examples=60)
@given(worlds())
def test_a_lone_robot_plays_as_it_scans(world: tuple[set[Cell], list[Cell]]) -> None:
    free, robots = world
    outcome = play(free, robots[:1], lazy=True)
    assert scan(free, robots[0]) == (outcome.moves[0], outcome.extra)
    assert outcome.extra == 1
    # R1: in the other direction it covers the same, and never more cheaply.
    moves, revisits = scan(free, robots[0], "cw")
    assert moves + 1 - revisits == outcome.moves[0]
    assert revisits >= 1
