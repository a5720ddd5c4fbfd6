"""The exact optimum of connected coverage on small trees, and the lower bound.

Paper: Sinay, Agmon, Maksimov, Kraus, Peleg 2017; neither is in it.
"""

from collections.abc import Iterator
from itertools import product
from math import ceil

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.algorithms.connected_rule import Team, ticks_taken
from agents.algorithms.connected_splits import choose_splits
from agents.planning.optimal_connected import MOST_VERTICES, add, lower_bound, optimum
from agents.planning.rooted_tree import NOWHERE, RootedTree, perfect_tree, tree_of_parents


@st.composite
def trees(draw: st.DrawFn, most: int) -> RootedTree:
    """Draw a tree, often deep."""
    vertices = draw(st.integers(1, most))
    reach = draw(st.sampled_from([2, 4, most]))
    parents = [draw(st.integers(max(0, child - reach), child - 1)) for child in range(1, vertices)]
    return tree_of_parents([None, *parents])


def ticks_by_search(tree: RootedTree, robots: int) -> int:
    """Search over all that robots with names can do; the connection is tested edge by edge."""
    near = [
        {vertex, *tree.children[vertex], tree.parents[vertex]} - {NOWHERE}
        for vertex in range(len(tree))
    ]

    def connected(places: tuple[int, ...]) -> bool:
        reached = {places[0]}
        for _ in places:
            reached |= {place for place in places if near[place] & reached}
        return reached == {*places}

    start = (tree.root,) * robots
    level, known, ticks = {(start, frozenset([tree.root]))}, set(), 0
    while (start, frozenset(range(len(tree)))) not in level:
        known |= level
        level = {
            (after, visited.union(after))
            for places, visited in level
            for after in product(*(near[place] for place in places))
            if connected(after)
        } - known
        ticks += 1
    return ticks


@given(trees(5), st.integers(1, 3))
@settings(max_examples=40)
def test_the_optimum_is_what_a_plain_search_finds(tree: RootedTree, robots: int) -> None:
    assert optimum(tree, robots) == ticks_by_search(tree, robots)


@given(trees(9), st.integers(1, 4))
@settings(max_examples=100)
def test_the_optimum_is_between_the_bound_and_cocta(tree: RootedTree, robots: int) -> None:
    best = optimum(tree, robots)
    splits = choose_splits(tree, robots, "cocta", "best", 1000)
    cocta = ticks_taken(Team(tree, robots, "cocta", splits), 2 * len(tree))
    assert cocta is not None
    assert lower_bound(tree, robots) <= best <= cocta
    assert robots == 1 or optimum(tree, robots - 1) >= best


@pytest.mark.slow
@given(trees(11), st.integers(1, 4))
@settings(max_examples=400)
def test_no_plan_beats_the_bound_on_larger_trees(tree: RootedTree, robots: int) -> None:
    assert lower_bound(tree, robots) <= optimum(tree, robots)


@given(trees(30), st.integers(1, 12))
def test_the_bound_is_at_least_the_plain_one(tree: RootedTree, robots: int) -> None:
    """Edges shared out, or there and back."""
    plain = max(ceil(2 * (len(tree) - 1) / robots), 2 * tree.height)
    assert lower_bound(tree, robots) >= plain


@pytest.mark.parametrize(
    ("tree", "robots", "plain", "bound", "best"),
    [
        (tree_of_parents([None, 0, 0, 0, 0, 1, 4]), 3, 4, 6, 6),  # COCTA: 8
        (tree_of_parents([None, 0, 1, 2, 3]), 2, 8, 8, 8),
        (tree_of_parents([None, 0, 0, 0, 0, 0, 0]), 3, 4, 5, 5),
        (tree_of_parents([None, 0, 0, 0, 0, 0, 0]), 4, 3, 4, 4),
        (perfect_tree(2, 2), 2, 6, 9, 9),
        (perfect_tree(2, 2), 3, 4, 6, 8),
    ],
)
def test_on_some_trees(tree: RootedTree, robots: int, plain: int, bound: int, best: int) -> None:
    """On a star robots take turns at the root: who comes up relieves who goes down."""
    assert max(ceil(2 * (len(tree) - 1) / robots), 2 * tree.height) == plain
    assert lower_bound(tree, robots) == bound
    assert optimum(tree, robots) == best


def test_a_branch_as_long_as_the_team_takes_all_robots() -> None:
    """Two branches of six vertices: edges shared out, or there and back, would be 12 ticks."""
    two_branches = tree_of_parents([None, 0, 1, 2, 3, 4, 5, 0, 7, 8, 9, 10, 11])
    team = Team(two_branches, 3, "cocta")
    assert lower_bound(two_branches, 3) == 21
    assert ticks_taken(team, 100) == 22


def test_one_robot_goes_around_the_tree() -> None:
    for tree in (perfect_tree(2, 2), perfect_tree(1, 6), perfect_tree(5, 1), perfect_tree(3, 0)):
        assert optimum(tree, 1) == lower_bound(tree, 1) == 2 * (len(tree) - 1)


def test_only_small_trees_and_teams_with_robots() -> None:
    with pytest.raises(ValueError, match=f"expected at most {MOST_VERTICES}"):
        optimum(perfect_tree(2, 3), 2)
    with pytest.raises(ValueError, match="at least one robot"):
        optimum(perfect_tree(2, 1), 0)


@given(st.lists(st.integers(0, 31), max_size=12))
def test_keeps_the_sets_that_are_part_of_no_other(sets: list[int]) -> None:
    kept: list[int] = []
    for number, visited in enumerate(sets):
        before = sets[:number]
        assert add(kept, visited) == all(visited & ~other for other in before)
    assert sorted(kept) == sorted(largest(sets))


def largest(sets: list[int]) -> Iterator[int]:
    for visited in {*sets}:
        if not any(visited & ~other == 0 for other in {*sets} - {visited}):
            yield visited
