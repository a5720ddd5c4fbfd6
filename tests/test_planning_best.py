"""The best planner: its walks are legal and complete, and at least as short as the best known."""

import json
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.planning.best import plan_best
from agents.planning.best_regions import Blocks, Regions, anneal, around, balance, grow, mend, prune
from agents.planning.best_split import split
from agents.planning.best_walks import Search, Team
from protocol.grid import STEPS, Cell
from protocol.seeds import spawn

Free = list[list[bool]]
Walks = Sequence[Sequence[Cell]]


# An independent judge: it shares no code with the planner.


def grid_of(text: str) -> Free:
    return [[mark == "." for mark in line] for line in text.split()]


def is_free(free: Free, cell: Cell) -> bool:
    row, col = cell
    return 0 <= row < len(free) and 0 <= col < len(free[0]) and free[row][col]


def reached_from(free: Free, starts: Iterable[Cell]) -> set[Cell]:
    reached = set(starts)
    ahead = list(reached)
    while ahead:
        row, col = ahead.pop()
        for down, right in STEPS:
            cell = (row + down, col + right)
            if cell not in reached and is_free(free, cell):
                reached.add(cell)
                ahead.append(cell)
    return reached


def judged(
    free: Free, starts: Sequence[Cell], walks: Walks, *, closed: bool = True
) -> tuple[int, int]:
    """Check walks by replaying them; return the longest one's moves and the coverage time."""
    assert len(walks) == len(starts)
    seen: dict[Cell, int] = {}
    for start, walk in zip(starts, walks, strict=True):
        assert walk[0] == start
        assert not closed or walk[-1] == start
        for (row, col), (next_row, next_col) in pairwise(walk):
            assert abs(row - next_row) + abs(col - next_col) == 1
        for moves, cell in enumerate(walk):
            assert is_free(free, cell)
            seen[cell] = min(moves, seen.get(cell, moves))
    assert set(seen) == reached_from(free, starts)
    return max(len(walk) - 1 for walk in walks), max(seen.values())


def share(free: Free, starts: Sequence[Cell]) -> int:
    """Return how many cells some robot has to visit at least, over all connected parts."""
    parts = {frozenset(reached_from(free, [start])) for start in starts}
    return max(-(-len(part) // sum(start in part for start in starts)) for part in parts)


# What holds for every grid.


@st.composite
def problems(draw: st.DrawFn) -> tuple[Free, list[Cell]]:
    """Small grids with any blocked sub-cells, and robots on any free ones."""
    rows, cols = draw(st.integers(1, 9)), draw(st.integers(1, 9))
    marks = draw(st.lists(st.sampled_from("...#"), min_size=rows * cols, max_size=rows * cols))
    free = [[mark == "." for mark in marks[row * cols : (row + 1) * cols]] for row in range(rows)]
    places = [(row, col) for row in range(rows) for col in range(cols) if free[row][col]]
    if not places:
        free[0][0] = True
        places = [(0, 0)]
    return free, draw(st.lists(st.sampled_from(places), min_size=1, max_size=6))


@given(problems(), st.booleans(), st.integers(0, 3))
@settings(max_examples=150)
def test_walks_are_legal_and_complete(
    problem: tuple[Free, list[Cell]],
    closed: bool,
    seed: int,
) -> None:
    free, starts = problem
    walks = plan_best(free, starts, budget_s=0.01, seed=seed, closed=closed)
    tour, covered = judged(free, starts, walks, closed=closed)
    assert covered >= share(free, starts) - 1
    assert tour >= covered
    if closed:
        assert tour % 2 == 0
        assert tour >= share(free, starts) or tour == 0
    else:
        assert tour == covered


def test_same_seed_gives_same_walks() -> None:
    free = grid_of("......... ..#.#.... .....#... .#....... .....####")
    starts = [(0, 0), (2, 8), (0, 0)]
    one, other = (plan_best(free, starts, budget_s=0.05, seed=5) for _ in range(2))
    assert one == other
    assert one != plan_best(free, starts, budget_s=0.05, seed=6)


def test_clock_ends_the_search() -> None:
    ticks = iter(range(10**6))
    free = [[True] * 13 for _ in range(7)]
    walks = plan_best(free, [(0, 0)] * 3, budget_s=60, seed=0, clock=lambda: next(ticks))
    judged(free, [(0, 0)] * 3, walks)
    assert next(ticks) < 200


# Odd cases.

ROOM_BEHIND_DOOR = "\n".join(["." * 12] * 10 + ["." + "#" * 11] + ["." * 5 + "#" * 7] * 3)

ODD: dict[str, tuple[str, list[Cell]]] = {
    "one sub-cell": (".", [(0, 0)]),
    "one sub-cell, many robots": (".", [(0, 0)] * 5),
    "two sub-cells": (".. ##", [(0, 1)]),
    "a corridor": ("." * 40, [(0, 7), (0, 7), (0, 30)]),
    "a crooked corridor": (".#... .#.#. ...#.", [(0, 0), (2, 4)]),
    "diagonal sub-cells": (".#. #.# .#.", [(0, 0), (1, 1), (2, 2)]),
    "a part without robot": ("...#... ...#... ...#...", [(0, 0), (1, 1)]),
    "parts with one robot each": ("...#.... ...#.... ...#....", [(0, 0), (1, 6)]),
    "more robots than sub-cells": ("..# ...", [(0, 0), (1, 2), (0, 1), (1, 1), (1, 0), (0, 0)]),
    "a narrow door": (ROOM_BEHIND_DOOR, [(13, 0), (13, 1), (12, 1), (13, 4)]),
    "all in one corner": ("\n".join(["." * 11] * 9), [(0, 0), (0, 0), (0, 1), (1, 0), (1, 1)]),
    "a comb": ("\n".join([".#.#.#.#.#."] * 6 + ["." * 11]), [(6, 0), (0, 10)]),
}


@pytest.mark.parametrize("closed", [True, False], ids=["closed", "open"])
@pytest.mark.parametrize("name", ODD)
def test_odd_case(name: str, closed: bool) -> None:
    text, starts = ODD[name]
    free = grid_of(text)
    walks = plan_best(free, starts, budget_s=0.2, seed=1, closed=closed)
    judged(free, starts, walks, closed=closed)


@pytest.mark.parametrize(
    ("text", "starts", "tour"),
    [
        ("....\n....", [(0, 0)], 8),
        ("....\n....", [(0, 0), (0, 3)], 4),
        ("....\n....", [(0, 0), (1, 3), (0, 1), (1, 2)], 2),
        (".....", [(0, 0)], 8),
        (".....", [(0, 2)], 8),
        (".....", [(0, 2), (0, 2)], 4),
        ("...\n...\n...", [(1, 1)], 10),
        ("...\n.#.\n...", [(0, 1)], 8),
        ("..\n..", [(0, 0), (0, 1), (1, 0), (1, 1)], 0),
    ],
)
def test_least_tour(text: str, starts: list[Cell], tour: int) -> None:
    free = grid_of(text)
    walks = plan_best(free, starts, budget_s=0.1, seed=0)
    assert judged(free, starts, walks)[0] == tour


@pytest.mark.parametrize(
    ("text", "starts", "covered"),
    [
        ("....\n....", [(0, 0)], 7),
        (".....", [(0, 2)], 6),
        (".....", [(0, 2), (0, 3)], 2),
        ("...\n...\n...", [(1, 1)], 8),
        ("..\n..", [(0, 0), (0, 1), (1, 0), (1, 1)], 0),
    ],
)
def test_least_coverage_time_without_return(text: str, starts: list[Cell], covered: int) -> None:
    free = grid_of(text)
    walks = plan_best(free, starts, budget_s=0.1, seed=0, closed=False)
    assert judged(free, starts, walks, closed=False) == (covered, covered)


def test_return_does_not_delay_coverage() -> None:
    """With a tour of 2 x 9 moves to the far end, the corridor is covered on the way there."""
    free = grid_of("." * 10)
    assert judged(free, [(0, 0)], plan_best(free, [(0, 0)], budget_s=0.05, seed=0)) == (18, 9)


@pytest.mark.parametrize(
    ("free", "starts", "word"),
    [
        ([], [(0, 0)], "row"),
        ([[True], [True, True]], [(0, 0)], "length"),
        ([[True, False]], [(0, 1)], "free"),
        ([[True, False]], [(0, 2)], "free"),
        ([[True, False]], [(-1, 0)], "free"),
    ],
)
def test_refuses(free: Free, starts: list[Cell], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        plan_best(free, starts, budget_s=1, seed=0)


def test_no_robots_no_walks() -> None:
    assert plan_best([[True]], [], budget_s=1, seed=0) == []


# Against the best known.

Shared = Callable[..., Path]

PEERS = {
    "ls_floor_small_k4": (70, 63),
    "mstc_grid5x10_k4": (64, 67),
    "mip_maze_small_10x10_k6": (42, 43),
    "ls_terrain_small_k8": (52, 51),
    "mip_maze_medium_20x20_k6": (184, 183),
    "ls_floor_medium_k8": (164, 163),
    "ls_floor_large_k12": (256, 255),
    "ls_ht_chantry_k32": (490, 437),
}
"""Longest tour of the best peer, and coverage time of the best peer, of each instance."""


def peer(shared: Shared, name: str) -> tuple[Free, list[Cell]]:
    data = json.loads(shared("peers", "grids", f"{name}.json").read_text(encoding="utf-8"))
    free = [[mark == "." for mark in row] for row in data["grid"]]
    return free, [(row, col) for row, col in data["robots"]]


def assert_beats(shared: Shared, name: str, budget_s: float) -> None:
    free, starts = peer(shared, name)
    tour, covered = judged(free, starts, plan_best(free, starts, budget_s=budget_s, seed=0))
    assert tour <= PEERS[name][0]
    assert covered <= PEERS[name][1]


QUICK = sorted(PEERS.keys() - {"mip_maze_medium_20x20_k6", "ls_ht_chantry_k32"})


@pytest.mark.parametrize("name", QUICK)
def test_no_worse_than_best_peer(shared: Shared, name: str) -> None:
    """Reference: spec/mstc.md, table of peers."""
    assert_beats(shared, name, 0.6)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mip_maze_medium_20x20_k6", "ls_ht_chantry_k32"])
def test_no_worse_than_best_peer_on_larger_grids(shared: Shared, name: str) -> None:
    """Reference: spec/mstc.md, table of peers."""
    assert_beats(shared, name, 4)


@pytest.mark.parametrize(
    ("rows", "cols", "starts"),
    [
        (20, 20, [(0, 0), (7, 12), (19, 19), (10, 3)]),
        (31, 17, [(5, 5), (30, 0), (12, 9), (16, 16), (0, 16)]),
    ],
)
def test_open_floor_is_shared_evenly(rows: int, cols: int, starts: list[Cell]) -> None:
    free = [[True] * cols for _ in range(rows)]
    tour, _ = judged(free, starts, plan_best(free, starts, budget_s=0.5, seed=0))
    assert tour <= 1.05 * share(free, starts)


def test_crowded_starts_share_what_lies_behind_the_door() -> None:
    """One robot alone would take 120 moves and more for the room."""
    text, starts = ODD["a narrow door"]
    free = grid_of(text)
    tour, _ = judged(free, starts, plan_best(free, starts, budget_s=0.5, seed=0))
    assert tour <= 56


def hall(size: int) -> tuple[Free, list[Cell]]:
    """A square hall with some blocked rectangles, and robots along one wall."""
    rng = spawn(4, "hall")
    free = [[True] * size for _ in range(size)]
    for _ in range(size * size // 400):
        row, col = rng.randrange(2, size), rng.randrange(2, size)
        for r in range(row, min(size, row + rng.randrange(1, 9))):
            for c in range(col, min(size, col + rng.randrange(1, 9))):
                free[r][c] = False
    return free, [(0, col) for col in range(0, size, size // 12)]


@pytest.mark.slow
def test_large_hall() -> None:
    free, starts = hall(150)
    tour, _ = judged(free, starts, plan_best(free, starts, budget_s=5, seed=0))
    assert tour <= 1.1 * share(free, starts)


# The parts.


def regions_of(free: Free, starts: Sequence[Cell]) -> tuple[Regions, list[int]]:
    """Return regions that hold their roots alone, and the numbers of the starts."""
    reached = reached_from(free, starts)
    rows, cols = range(len(free)), range(len(free[0]))
    blocks = Blocks(np.array([[(row, col) in reached for col in cols] for row in rows]))
    cells = [(row + 1) * blocks.stride + col + 1 for row, col in starts]
    return Regions(blocks, [blocks.of[cell] for cell in cells]), cells


def assert_whole(regions: Regions) -> None:
    """Each region holds together and its root; the books are right."""
    for robot, held in enumerate(regions.held):
        ahead = [regions.roots[robot]]
        seen = set(ahead)
        assert seen <= held
        while ahead:
            for other in regions.blocks.near[ahead.pop()]:
                if other in held and other not in seen:
                    seen.add(other)
                    ahead.append(other)
        assert seen == held
        assert all(robot in regions.holders[block] for block in held)
    assert sum(map(len, regions.held)) == sum(map(len, regions.holders))


@given(problems(), st.booleans(), st.integers(0, 60))
@settings(max_examples=100)
def test_regions_hold_together(problem: tuple[Free, list[Cell]], dig: bool, spare: int) -> None:
    regions, cells = regions_of(*problem)
    rng = spawn(1, "test")
    grow(regions, rng, dig=dig)
    assert_whole(regions)
    assert all(regions.holders)
    prune(regions)
    balance(regions, rng, lambda: True)
    assert_whole(regions)
    assert all(regions.holders)
    if anneal(regions, spare, rng, 2000, 0.2) or mend(regions, spare):
        assert all(regions.holders)
    assert_whole(regions)
    for held, cell, cost in zip(regions.held, cells, regions.cost, strict=True):
        walk = around(regions.blocks, held, cell)
        assert walk[0] == walk[-1] == cell
        assert set(walk) == {cell for block in held for cell in regions.blocks.cells[block]}
        assert len(walk) - 1 <= cost


def test_costs_are_what_walks_take() -> None:
    """Where all blocks are complete, each costs 4."""
    free = [[True] * 8 for _ in range(6)]
    regions, cells = regions_of(free, [(0, 0), (5, 7)])
    grow(regions, spawn(0, "test"), dig=False)
    assert regions.cost == [24, 24]
    for held, cell in zip(regions.held, cells, strict=True):
        assert len(around(regions.blocks, held, cell)) == 25


def test_squares_are_aligned_with_most_of_the_grid() -> None:
    free = grid_of("####### #....## #....## #######")
    regions, _ = regions_of(free, [(1, 1)])
    assert sorted(map(len, regions.blocks.cells)) == [4, 4]


def test_walk_goes_around_a_loop_once() -> None:
    free = grid_of(".......... .########. .########. ..........")
    regions, cells = regions_of(free, [(0, 0)])
    grow(regions, spawn(0, "test"), dig=False)
    assert len(around(regions.blocks, regions.held[0], cells[0])) - 1 == 24


@given(problems())
def test_split_covers_all(problem: tuple[Free, list[Cell]]) -> None:
    free, starts = problem
    regions, cells = regions_of(free, starts)
    stride = regions.blocks.stride
    walks = split(regions.blocks, cells)
    places = [[(cell // stride - 1, cell % stride - 1) for cell in walk] for walk in walks]
    judged(free, starts, places)


def test_split_shares_a_hall_between_crowded_robots() -> None:
    free = [[True] * 60 for _ in range(60)]
    starts = [(0, col) for col in range(12)]
    regions, cells = regions_of(free, starts)
    walks = split(regions.blocks, cells)
    assert max(map(len, walks)) <= share(free, starts) + 2 * 130


@given(problems(), st.booleans(), st.integers(0, 20))
@settings(max_examples=100)
def test_annealing_keeps_walks_walks(
    problem: tuple[Free, list[Cell]], closed: bool, limit: int
) -> None:
    free, starts = problem
    regions, cells = regions_of(free, starts)
    grow(regions, spawn(0, "test"), dig=True)
    stride = regions.blocks.stride
    open_ = [block >= 0 for block in regions.blocks.of]
    walks = [
        around(regions.blocks, held, cell) for held, cell in zip(regions.held, cells, strict=True)
    ]
    team = Team(open_, walks)
    assert team.walks() == walks
    search = Search(team, open_, stride, spawn(0, "search"), price=0.15, closed=closed)
    search.aim(limit)
    search.run(2000, 0.3)
    search.mend()
    seen = set()
    for walk, start, length in zip(team.walks(), cells, team.length, strict=True):
        assert walk[0] == start
        assert not closed or walk[-1] == start
        assert len(walk) - 1 == length
        for one, other in pairwise(walk):
            assert open_[other]
            assert abs(other - one) in {1, stride}
        seen |= set(walk)
    assert team.missed == sum(open_) - len(seen)
    if search.is_solved():
        assert max(team.length) <= limit
        assert team.missed == 0
