"""NCOCTA and COCTA: the rule against its definition, its numbers, and the claims of the paper.

Paper: Sinay, Agmon, Maksimov, Kraus, Peleg 2017, "Maintaining Communication in Multi-Robot Tree
Coverage". Numbers are ticks: each robot crosses at most one edge a tick.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from itertools import combinations_with_replacement, pairwise, product
from math import ceil, inf
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.algorithms.connected_rule import (
    Moves,
    Team,
    Tick,
    Variant,
    checked_splits,
    next_moves,
    ticks_taken,
)
from agents.algorithms.connected_splits import (
    allowed_splits,
    choose_splits,
    fastest_splits,
    paper_splits,
    perfect_tree_ticks,
    robots_needed,
)
from agents.planning.rooted_tree import (
    NOWHERE,
    RootedTree,
    perfect_tree,
    spanning_tree,
    tree_of_parents,
    vertices_of_perfect,
    without,
)
from protocol.graph import PortGraph
from protocol.seeds import spawn

BOTH: tuple[Variant, ...] = ("ncocta", "cocta")

Case = tuple[RootedTree, int, tuple[int, ...]]
"""A tree, how many robots there are, and where they split."""


@st.composite
def trees(draw: st.DrawFn, most: int = 14) -> RootedTree:
    """Draw a tree, often deep; a vertex has a smaller number than its children."""
    vertices = draw(st.integers(1, most))
    reach = draw(st.sampled_from([2, 4, most]))
    parents = [draw(st.integers(max(0, child - reach), child - 1)) for child in range(1, vertices)]
    return tree_of_parents([None, *parents])


@st.composite
def cases(draw: st.DrawFn, most: int = 14, robots: int = 12) -> Case:
    """Draw a tree, a team, and any split heights, for which the team may be too small."""
    tree = draw(trees(most))
    heights = range(1, tree.height + 1)
    splits = draw(st.sets(st.sampled_from(heights), max_size=3)) if heights else set()
    return tree, draw(st.integers(1, robots)), checked_splits(tree, splits)


@st.composite
def large_enough(draw: st.DrawFn, most: int = 20) -> Case:
    """Draw a case in which the run must end."""
    tree, extra, splits = draw(cases(most))
    return tree, robots_needed(tree.arity, splits) + extra - 1, splits


def play(team: Team, each: Callable[[Team], object] = lambda _: None) -> int | None:
    """Move a team until its run is over, and look at each tick; None if it comes to a stand."""
    ticks = 0
    each(team)
    while not team.over:
        moves = next_moves(team)
        if not moves:
            return None
        team.apply(moves)
        each(team)
        ticks += 1
        assert ticks <= 2 * len(team.tree), "does not end"
    return ticks


def ticks_of(tree: RootedTree, robots: int, variant: Variant, splits: Iterable[int] = ()) -> int:
    ticks = ticks_taken(Team(tree, robots, variant, tuple(splits)), 2 * len(tree))
    assert ticks is not None
    return ticks


def is_connected(tree: RootedTree, at: Iterable[int]) -> bool:
    """Tell whether the vertices with robots form one subtree: only one of them has no parent there."""
    places = set(at)
    return sum(tree.parents[vertex] not in places for vertex in places) == 1


def assert_connected(team: Team) -> None:
    assert is_connected(team.tree, team.at.values()), team.at


# The rule, against its definition.


class Plain:
    """The rule as it is written down: everything is found out anew whenever it is asked for.

    A set of vertices is an integer with a bit for each.
    """

    def __init__(
        self,
        tree: RootedTree,
        robots: int,
        variant: Variant,
        splits: Iterable[int],
        *,
        printed: bool = False,
    ) -> None:
        self.tree, self.drips, self.splits, self.printed = tree, variant == "cocta", splits, printed
        self.top_split = max(splits, default=-1)
        self.at = [tree.root] * robots
        self.visited = 1 << tree.root
        self.subtree = [1 << vertex for vertex in range(len(tree))]
        for vertex in self.lowest_first()[:-1]:
            self.subtree[tree.parents[vertex]] |= self.subtree[vertex]

    def lowest_first(self) -> list[int]:
        heights = self.tree.heights
        return sorted(range(len(self.tree)), key=lambda vertex: (heights[vertex], vertex))

    def robots_in(self, vertex: int) -> int:
        return sum(self.subtree[vertex] >> place & 1 for place in self.at)

    def explored(self, vertex: int) -> bool:
        return not self.subtree[vertex] & ~self.visited

    def finished(self, vertex: int) -> bool:
        return self.explored(vertex) and self.robots_in(vertex) == self.at.count(vertex)

    def unfinished(self, vertex: int) -> int:
        inside = range(len(self.tree))
        return sum(self.subtree[vertex] >> w & 1 and not self.finished(w) for w in inside)

    def over(self) -> bool:
        return self.finished(self.tree.root)

    def decide(
        self, vertex: int, av: int, arr: int, finished: bool
    ) -> tuple[int, list[tuple[int, int]]]:
        """Return how many of ``av`` go to the parent, and how many to which children."""
        is_root = vertex == self.tree.root
        is_split = self.tree.heights[vertex] in self.splits
        guard = max(0, 1 - arr)
        if finished:
            return (0 if is_root else av), []
        children = [u for u in self.tree.children[vertex] if not self.explored(u)]
        if not children:
            stay = is_root or (is_split and not self.drips)
            return (0 if stay else max(0, av - guard)), []
        cap = {
            u: max(0, self.unfinished(u) - self.robots_in(u)) if self.drips else inf
            for u in children
        }
        given = dict.fromkeys(children, 0)
        number = max(0, av - guard)
        if is_split:
            for left in range(number, 0, -1):
                room = [u for u in children if given[u] < cap[u]]
                if not room:
                    return (0 if is_root else left), list(given.items())
                given[min(room, key=lambda u: self.robots_in(u) + given[u])] += 1
            return 0, list(given.items())
        first = children[0]
        if self.tree.heights[vertex] > self.top_split:
            outside = any(
                place != vertex and not self.subtree[first] >> place & 1 for place in self.at
            )
            together = max(0, av - max(0, (outside and not self.printed) - arr))
            number = together if together <= cap[first] else number
        for u in children:
            given[u] = int(min(number, cap[u]))
            number -= given[u]
        return 0, list(given.items())

    def tick(self) -> Moves:
        before = list(self.at)
        finished_before = [self.finished(vertex) for vertex in range(len(self.tree))]
        moves: Moves = {}

        def here(vertex: int) -> tuple[list[int], int]:
            there = [robot for robot, place in enumerate(self.at) if place == vertex]
            left = [robot for robot in there if robot not in moves]
            return left, len(there) - len(left)

        def send(robots: list[int], to: int, number: int) -> None:
            for robot in robots[len(robots) - number :]:
                robots.remove(robot)
                moves[robot] = self.at[robot] = to

        for vertex in self.lowest_first():
            robots, arr = here(vertex)
            waits = not self.drips and self.tree.heights[vertex] in self.splits
            finished = finished_before[vertex] if waits else self.finished(vertex)
            up, _ = self.decide(vertex, len(robots), arr, finished)
            send(robots, self.tree.parents[vertex], up)
        for vertex in reversed(self.lowest_first()):
            robots, arr = here(vertex)
            _, down = self.decide(vertex, len(robots), arr, self.finished(vertex))
            for u, number in down:
                send(robots, u, number)
                self.visited |= number and 1 << u
        assert all(before[robot] != to for robot, to in moves.items())
        return moves


def assert_knows(team: Team, at: list[int], visited: Iterable[int]) -> None:
    """Compare all that a team keeps with what its places and the visited vertices tell."""
    plain = Plain(team.tree, team.team_size, "cocta", ())
    plain.at, plain.visited = list(at), sum(1 << vertex for vertex in set(visited))
    vertices = range(len(team.tree))
    assert list(team.at.values()) == at
    assert team.robots_at == {
        vertex: [robot for robot, place in enumerate(at) if place == vertex] for vertex in set(at)
    }
    assert team.inside == [plain.robots_in(vertex) for vertex in vertices]
    assert [not left for left in team.pending] == [plain.explored(vertex) for vertex in vertices]
    assert [*map(bool, team.finished)] == [plain.finished(vertex) for vertex in vertices]
    assert team.unfinished == [plain.unfinished(vertex) for vertex in vertices]
    assert team.over == plain.over()
    for vertex in vertices:
        unexplored = [u for u in team.tree.children[vertex] if not plain.explored(u)]
        assert list(team.open_children(vertex)) == unexplored


def compare(case: Case, variant: Variant) -> None:
    """Play a case by the rule and by its definition, and compare them tick by tick."""
    tree, robots, splits = case
    team, plain = Team(tree, robots, variant, splits), Plain(tree, robots, variant, splits)
    while not team.over:
        before = list(team.at.values())
        moves = next_moves(team)
        assert list(team.at.values()) == before
        assert next_moves(team) == moves
        assert moves == plain.tick()
        if not moves:
            return
        team.apply(moves)
        vertices = range(len(tree))
        assert_knows(team, plain.at, [v for v in vertices if plain.visited >> v & 1])
    assert plain.over()


@pytest.mark.parametrize("variant", BOTH)
@given(cases())
@settings(max_examples=60)
def test_moves_as_defined(variant: Variant, case: Case) -> None:
    compare(case, variant)


@pytest.mark.slow
@pytest.mark.parametrize("variant", BOTH)
@given(cases(40, 30))
@settings(max_examples=400)
def test_moves_as_defined_on_larger_trees(variant: Variant, case: Case) -> None:
    compare(case, variant)


@pytest.mark.parametrize("variant", BOTH)
@pytest.mark.parametrize(
    ("arity", "height", "robots", "splits"),
    [(2, 3, 7, [3]), (2, 3, 11, [3, 2]), (3, 3, 9, [2]), (4, 3, 9, [2]), (2, 5, 31, [5, 3, 1])],
)
def test_moves_as_defined_on_perfect_trees(
    variant: Variant, arity: int, height: int, robots: int, splits: list[int]
) -> None:
    compare((perfect_tree(arity, height), robots, tuple(splits)), variant)


def test_the_highest_go_and_the_first_child_gets_the_highest() -> None:
    team = Team(perfect_tree(2, 2), 6, "ncocta", [2])
    moves = next_moves(team)
    assert moves == {5: 1, 4: 1, 3: 1, 2: 2, 1: 2}  # of five, the first child gets three
    team.apply(moves)
    assert team.robots_at == {0: [0], 1: [3, 4, 5], 2: [1, 2]}
    assert next_moves(team) == {5: 3, 4: 3, 2: 5}


@given(trees(), st.integers(1, 5), st.integers())
@settings(max_examples=60)
def test_knows_where_any_moves_lead(tree: RootedTree, robots: int, seed: int) -> None:
    """Also after moves that the rule never makes, for instance into what is explored."""
    rng = spawn(seed, "moves")
    team = Team(tree, robots, "cocta")
    at, visited = [tree.root] * robots, {tree.root}
    for _ in range(12):
        ways = [[at[r], tree.parents[at[r]], *tree.children[at[r]]] for r in range(robots)]
        goals = [rng.choice([way for way in ways[r] if way != NOWHERE]) for r in range(robots)]
        team.apply({robot: to for robot, to in enumerate(goals) if to != at[robot]})
        at, visited = goals, visited.union(goals)
        assert_knows(team, at, visited)


@pytest.mark.parametrize("to", [NOWHERE, 0, 3, 5])
def test_refuses_moves_along_no_edge(to: int) -> None:
    team = Team(perfect_tree(2, 2), 2, "cocta")
    with pytest.raises(ValueError, match=f"robot 1 cannot go from 0 to {to}"):
        team.apply({0: 1, 1: to})
    assert_knows(team, [0, 0], [0])


# The tree.


def test_perfect_trees_are_numbered_by_level() -> None:
    tree = perfect_tree(3, 2)
    assert len(tree) == vertices_of_perfect(3, 2) == 13
    assert tree.children[0] == (1, 2, 3)
    assert tree.children[3] == (10, 11, 12)
    assert tree.parents[12] == 3
    assert tree.heights == (2, 1, 1, 1, *[0] * 9)
    assert (tree.height, tree.arity) == (2, 3)


def test_heights_are_counted_from_the_root() -> None:
    tree = tree_of_parents([None, 0, 0, 1, 3])
    assert tree.heights == (3, 2, 2, 1, 0)  # vertex 2 is a leaf, yet of height 2


def test_children_by_number_or_by_port() -> None:
    graph = PortGraph("abcd", [(1, 3), (2, 1), (1, 0)])
    assert spanning_tree(graph, 1).tree.children == ((), (3, 2, 0), (), ())
    assert spanning_tree(graph, 3).tree.children == ((), (2, 0), (), (1,))
    assert tree_of_parents([1, None, 1, 1]).children == ((), (0, 2, 3), (), ())


@given(trees())
def test_a_graph_gives_its_tree(tree: RootedTree) -> None:
    edges = [(tree.parents[vertex], vertex) for vertex in range(1, len(tree))]
    again = spanning_tree(PortGraph([""] * len(tree), edges), 0).tree
    assert (again.children, again.heights) == (tree.children, tree.heights)


@pytest.mark.parametrize("deep", [False, True])
@pytest.mark.parametrize(
    "edges", [[(0, 1), (1, 2), (2, 0)], [(0, 1), (0, 1), (1, 2)], [(0, 0), (0, 1), (1, 2)]]
)
def test_a_graph_with_cycles_has_spanning_trees(edges: list[tuple[int, int]], deep: bool) -> None:
    graph = PortGraph("abc", edges)
    paths = spanning_tree(graph, 0, deep=deep)
    assert paths.tree.height == (2 if deep or (2, 0) not in edges else 1)
    for vertex in (1, 2):
        parent = paths.tree.parents[vertex]
        assert graph.ways[vertex][paths.up[vertex]] == (parent, paths.down[vertex])


def test_refuses_what_is_no_tree() -> None:
    for parents in ([], [None, None], [1, 0], [None, 2, 1], [None, 7]):
        with pytest.raises(ValueError, match=r"root|no vertex"):
            tree_of_parents(parents)
    with pytest.raises(ValueError, match="vertex 2 is not below the root 0"):
        spanning_tree(PortGraph("abc", [(0, 1)]), 0)
    with pytest.raises(ValueError, match="vertex 1 below 1"):
        RootedTree([[1], [1]])
    with pytest.raises(ValueError, match="without its root"):
        without(perfect_tree(2, 1), [0])


def with_holes(arity: int, height: int, cut: int, every: int, rest: int) -> RootedTree:
    """Return a perfect tree less every so many vertices of one height, and what is below them."""
    level = range(vertices_of_perfect(arity, height - cut))[-(arity ** (height - cut)) :]
    return without(perfect_tree(arity, height), level[rest::every])


def test_without_keeps_the_order_of_the_others() -> None:
    tree = without(perfect_tree(2, 2), [1, 6])
    assert tree.children == ((1,), (2,), ())
    assert without(perfect_tree(2, 2), [3]).children == ((1, 2), (3,), (4, 5), (), (), ())


# Where the team splits.


@pytest.mark.parametrize(
    ("arity", "thresholds"), [(2, (11, 31, 71)), (3, (16, 58, 229)), (4, (21, 101, 469))]
)
def test_number_of_splits(arity: int, thresholds: tuple[int, ...]) -> None:
    """Reference: Sec. 4.2, Eq. (1), and the example of the 3-ary tree below Lemma 4.7."""
    for number, team_size in enumerate(thresholds, 1):
        assert len(paper_splits(arity, 20, team_size - 1)) == number - 1
        assert len(paper_splits(arity, 20, team_size)) == number
        assert robots_needed(arity, paper_splits(arity, 20, team_size)) == team_size


@pytest.mark.parametrize(
    ("arity", "height", "team_size", "splits"),
    [
        (3, 7, 15, ()),
        (3, 7, 16, (5,)),
        (3, 7, 58, (7, 6)),
        (2, 15, 120, (10, 9, 8)),
        (3, 6, 58, (6, 5)),  # the highest would be above the root: the lowest is lowered
        (3, 3, 16, (3,)),
        (2, 2, 1000, (2, 1)),  # and then there are fewer
        (2, 0, 1000, ()),
        (1, 9, 1000, ()),
        (0, 0, 3, ()),
    ],
)
def test_splits_of_the_paper(
    arity: int, height: int, team_size: int, splits: tuple[int, ...]
) -> None:
    assert paper_splits(arity, height, team_size) == splits


def test_splits_as_given() -> None:
    tree = perfect_tree(2, 3)
    assert choose_splits(tree, 3, "cocta", [1, 3]) == (3, 1)
    assert Team(tree, 3, "cocta", [1, 3]).splits == (3, 1)
    for wrong in ([0], [4], [2, -1]):
        with pytest.raises(ValueError, match=r"split heights are in 1\.\.3"):
            choose_splits(tree, 3, "cocta", wrong)
    with pytest.raises(ValueError, match="given twice"):
        Team(tree, 3, "cocta", [2, 2])
    with pytest.raises(ValueError, match="at least one robot"):
        Team(tree, 0, "cocta")


def test_splits_that_a_team_allows() -> None:
    assert list(allowed_splits(perfect_tree(2, 3), 7)) == [(), (3,), (2,), (2, 1), (1,)]
    assert list(allowed_splits(perfect_tree(1, 3), 7)) == [()]


@pytest.mark.parametrize(
    ("arity", "height", "team_size", "splits", "ticks", "of_the_paper"),
    [(2, 8, 20, (5, 4), 168, 204), (3, 5, 57, (5, 3, 1), 38, 49), (3, 6, 30, (5, 2), 196, 230)],
)
def test_best_splits(
    arity: int,
    height: int,
    team_size: int,
    splits: tuple[int, ...],
    ticks: int,
    of_the_paper: int,
) -> None:
    tree = perfect_tree(arity, height)
    printed = choose_splits(tree, team_size, "cocta", "paper")
    assert choose_splits(tree, team_size, "cocta", "best") == splits
    assert ticks_of(tree, team_size, "cocta", splits) == ticks
    assert ticks_of(tree, team_size, "cocta", printed) == of_the_paper
    every = [ticks_of(tree, team_size, "cocta", s) for s in allowed_splits(tree, team_size)]
    assert min(every) == ticks


@given(trees(), st.integers(1, 20), st.sampled_from(BOTH), st.integers(0, 200))
@settings(max_examples=60)
def test_best_is_no_slower_than_the_paper(
    tree: RootedTree, team_size: int, variant: Variant, effort: int
) -> None:
    printed = paper_splits(tree.arity, tree.height, team_size)
    best = fastest_splits(tree, team_size, variant, effort)
    fast, slow = (ticks_of(tree, team_size, variant, s) for s in (best, printed))
    assert fast <= slow
    if effort < slow:
        assert best == printed
    assert fastest_splits(tree, team_size, variant, effort) == best


# The numbers.

TABLE = [
    # N  H   k   heights   NCOCTA  COCTA  and where robots may cross several edges a tick
    (2, 3, 7, [3], 10, 10, 8, 8),
    (2, 3, 11, [3, 2], 7, 7, 5, 5),
    (3, 7, 3, [], 6558, 3643, 6558, 3642),
    (3, 7, 16, [5], 1158, 1124, 1113, 1113),
    (3, 7, 20, [5], 1158, 999, 1113, 766),
    (3, 7, 30, [5], 1158, 686, 1113, 456),
    (3, 7, 57, [5], 1158, 433, 1113, 280),
    (3, 7, 58, [7, 6], 372, 372, 366, 366),
    (3, 8, 16, [5], 3480, 3368, 3345, 3345),
    (3, 8, 60, [7, 6], 1122, 1101, 1101, 1066),
    (2, 15, 30, [5], 40956, 20479, 35836, 15356),
    (2, 15, 60, [8, 7], 17916, 10562, 16892, 7996),
    (2, 15, 120, [10, 9, 8], 8668, 5571, 8348, 4156),
    (4, 8, 60, [5], 22312, 8971, 21992, 5448),
    (4, 8, 101, [7, 6], 5500, 5485, 5472, 5472),
    # H = 8..14, the latter for COCTA only
    (2, 8, 60, [8, 7], 136, 83, None, 59),
    (2, 9, 60, [8, 7], 276, 167, None, 123),
    (2, 10, 60, [8, 7], 556, 332, None, 247),
    (2, 11, 60, [8, 7], 1116, 662, None, 496),
    (2, 12, 60, [8, 7], 2236, 1322, None, 996),
    (2, 13, 60, [8, 7], 4476, 2642, None, 1996),
    (2, 14, 60, [8, 7], 8956, 5282, None, 3996),
]
HOLES = [
    (with_holes(2, 10, 4, 4, 1), 60, [8, 7], 1551, 432, 260, 400, 195),
    (with_holes(3, 7, 2, 3, 2), 20, [5], 2227, 807, 693, 762, 529),
]


def rows(first: int) -> list[Any]:
    """Return rows of the table with two of its columns, and the long ones marked."""
    return [
        pytest.param(
            *row[:4],
            *row[first : first + 2],
            marks=[pytest.mark.slow] if row[5] > 2000 else [],
            id=f"{row[0]}-ary, H = {row[1]}, k = {row[2]}",
        )
        for row in TABLE
    ]


BY_FORMULA = [row[:5] for row in TABLE if row[1] > 3]


@pytest.mark.parametrize(("arity", "height", "team_size", "splits", "ncocta", "cocta"), rows(4))
def test_ticks_on_perfect_trees(
    arity: int, height: int, team_size: int, splits: list[int], ncocta: int, cocta: int
) -> None:
    tree = perfect_tree(arity, height)
    assert ticks_of(tree, team_size, "ncocta", splits) == ncocta
    assert ticks_of(tree, team_size, "cocta", splits) == cocta


@pytest.mark.parametrize(("arity", "height", "team_size", "splits", "ncocta"), BY_FORMULA)
def test_splits_and_ticks_by_formula(
    arity: int, height: int, team_size: int, splits: list[int], ncocta: int
) -> None:
    assert [*paper_splits(arity, height, team_size)] == splits
    assert perfect_tree_ticks(arity, height, splits) == ncocta


@pytest.mark.parametrize(
    ("tree", "team_size", "splits", "vertices", "ncocta", "cocta"),
    [row[:6] for row in HOLES],
    ids=["2-ary", "3-ary"],
)
def test_ticks_on_trees_with_holes(
    tree: RootedTree, team_size: int, splits: list[int], vertices: int, ncocta: int, cocta: int
) -> None:
    assert len(tree) == vertices
    assert [*paper_splits(tree.arity, tree.height, team_size)] == splits
    assert ticks_of(tree, team_size, "ncocta", splits) == ncocta
    assert ticks_of(tree, team_size, "cocta", splits) == cocta


# The numbers of the paper: robots that may cross several edges a tick.


class RoundRobin(Tick):
    """At a split the robots go to the children in turn, whoever is there already."""

    def spread(self, vertex: int, number: int) -> None:
        children = list(self.team.open_children(vertex))
        room = {child: self.room(child) for child in children}
        while number > 0 and any(room.values()):
            for child in children:
                if number > 0 and room[child] > 0:
                    room[child] -= 1
                    number -= 1
                    self.move(vertex, child, 1)


def ticks_in_place(tree: RootedTree, robots: int, variant: Variant, splits: Iterable[int]) -> int:
    """Play Alg. 1 or 2 as its loop is printed: each vertex finds the robots where the last left them.

    A robot that goes up is moved on with those of its new vertex, in the same iteration.
    """
    team, ticks = Team(tree, robots, variant, tuple(splits)), 0
    while not team.over:
        for vertex in sorted(team.robots_at, key=tree.upwards.__getitem__):
            tick = RoundRobin(team)
            if vertex != tree.root:
                tick.go_up(vertex)
            tick.go_down(vertex)
            team.apply(tick.moves)
        ticks += 1
    return ticks


@pytest.mark.parametrize(("arity", "height", "team_size", "splits", "ncocta", "cocta"), rows(6))
def test_ticks_in_place(
    arity: int, height: int, team_size: int, splits: list[int], ncocta: int | None, cocta: int
) -> None:
    """Reference: Sec. 4.3: speedup 8.6 on the 3-ary tree of height 7 with 20 robots: 766 ticks."""
    tree = perfect_tree(arity, height)
    if ncocta is not None:
        assert ticks_in_place(tree, team_size, "ncocta", splits) == ncocta
    assert ticks_in_place(tree, team_size, "cocta", splits) == cocta


@pytest.mark.parametrize(
    ("tree", "team_size", "splits", "ncocta", "cocta"),
    [(*row[:3], *row[6:]) for row in HOLES],
    ids=["2-ary", "3-ary"],
)
def test_ticks_in_place_on_trees_with_holes(
    tree: RootedTree, team_size: int, splits: list[int], ncocta: int, cocta: int
) -> None:
    assert ticks_in_place(tree, team_size, "ncocta", splits) == ncocta
    assert ticks_in_place(tree, team_size, "cocta", splits) == cocta


# The claims.


@pytest.mark.parametrize("variant", BOTH)
@given(cases(20, 20))
def test_is_always_connected(variant: Variant, case: Case) -> None:
    """With any splits, also where the team is too small for them. Reference: Lemma 4.1."""
    tree, robots, splits = case
    play(Team(tree, robots, variant, splits), assert_connected)


@pytest.mark.parametrize("variant", BOTH)
@given(large_enough())
def test_visits_every_vertex_and_comes_back(variant: Variant, case: Case) -> None:
    """Reference: Lemma 4.2."""
    tree, robots, splits = case
    team = Team(tree, robots, variant, splits)
    seen = {tree.root}
    ticks = play(team, lambda team: seen.update(team.at.values()))
    assert ticks is not None
    assert ticks <= 2 * (len(tree) - 1)  # what one robot takes
    assert ticks >= max(ceil(2 * (len(tree) - 1) / robots), 2 * tree.height)
    assert len(seen) == len(tree)
    assert set(team.at.values()) == {tree.root}


@given(cases(20, 20))
def test_cocta_is_never_slower(case: Case) -> None:
    """And it ends wherever NCOCTA does, even where the team is too small. Reference: Sec. 4.3."""
    tree, robots, splits = case
    plain, dripping = (play(Team(tree, robots, variant, splits)) for variant in BOTH)
    assert (plain is None) == (dripping is None)
    assert plain is None or dripping is None or dripping <= plain


def test_an_equal_level_keeps_cocta_from_being_slower() -> None:
    """With remainders given round robin it takes 37 ticks here, one more than NCOCTA."""
    tree = perfect_tree(4, 3)
    assert ticks_of(tree, 9, "ncocta", [2]) == 36
    assert ticks_of(tree, 9, "cocta", [2]) <= 36


def test_more_robots_may_be_slower() -> None:
    """They allow one more split, which hurts; the best splits do not get worse here."""
    tree = perfect_tree(3, 4)
    printed = [ticks_of(tree, k, "cocta", paper_splits(3, 4, k)) for k in range(1, 30)]
    assert any(few < more for few, more in pairwise(printed))
    best = [ticks_of(tree, k, "cocta", choose_splits(tree, k, "cocta", "best")) for k in (15, 16)]
    assert best[1] <= best[0]


shapes = st.sampled_from([(1, 6), (2, 1), (2, 4), (2, 6), (3, 2), (3, 4), (4, 3), (5, 2)])


@given(shapes, st.data(), st.integers(0, 9))
@settings(max_examples=60)
def test_ncocta_takes_the_time_of_the_formula(
    shape: tuple[int, int], data: st.DataObject, extra: int
) -> None:
    """More robots than needed change nothing. Reference: Lemmas 4.3 and 4.4."""
    arity, height = shape
    lowest = data.draw(st.integers(1, height))
    highest = data.draw(st.integers(lowest - 1, height))  # below the lowest: no split
    splits = tuple(range(highest, lowest - 1, -1))
    team_size = robots_needed(arity, splits) + extra
    expected = perfect_tree_ticks(arity, height, splits)
    assert ticks_of(perfect_tree(arity, height), team_size, "ncocta", splits) == expected


@given(shapes, st.data(), st.integers(0, 9))
@settings(max_examples=60)
def test_ncocta_takes_no_longer_where_heights_are_left_out(
    shape: tuple[int, int], data: st.DataObject, extra: int
) -> None:
    """Between two splits that are apart a guard goes on as soon as it is relieved."""
    arity, height = shape
    tree = perfect_tree(arity, height)
    splits = checked_splits(tree, data.draw(st.sets(st.integers(1, height), max_size=4)))
    team_size = robots_needed(arity, splits) + extra
    expected = perfect_tree_ticks(arity, height, splits)
    assert ticks_of(tree, team_size, "ncocta", splits) <= expected


def test_the_formula_is_no_equation_where_heights_are_left_out() -> None:
    assert perfect_tree_ticks(2, 4, [4, 1]) == 22
    assert ticks_of(perfect_tree(2, 4), 11, "ncocta", [4, 1]) == 21


@pytest.mark.parametrize(("team_size", "at_least"), [(16, 5), (57, 5), (58, 17)])
def test_speedup_factors_of_the_paper(team_size: int, at_least: int) -> None:
    """Reference: Sec. 4.2, the example below Lemma 4.7."""
    tree = perfect_tree(3, 7)
    ticks = ticks_of(tree, team_size, "ncocta", paper_splits(3, 7, team_size))
    assert 2 * (len(tree) - 1) / ticks > at_least


FIVE_VERTICES = tree_of_parents([None, 0, 0, 1, 2])


def loses_connection(plain: Plain) -> bool:
    while not plain.over():
        assert plain.tick()
        if not is_connected(plain.tree, plain.at):
            return True
    return False


@pytest.mark.parametrize(("tree", "team_size"), [(perfect_tree(3, 2), 5), (FIVE_VERTICES, 4)])
def test_the_printed_rule_loses_the_connection(tree: RootedTree, team_size: int) -> None:
    """COCTA as printed above the top split; the correction leaves a robot behind.

    No tree of fewer vertices shows it. Reference: Alg. 2, the last branch for an unfinished vertex.
    """
    assert loses_connection(Plain(tree, team_size, "cocta", (), printed=True))
    assert not loses_connection(Plain(tree, team_size, "cocta", ()))
    assert play(Team(tree, team_size, "cocta"), assert_connected) is not None


class AtOnce(Plain):
    """All robots decide at the start of the tick: nobody takes the place of a guard in the same one."""

    def tick(self) -> Moves:
        moves: Moves = {}
        for vertex in self.lowest_first():
            left = [robot for robot, place in enumerate(self.at) if place == vertex]
            up, down = self.decide(vertex, len(left), 0, self.finished(vertex))
            for to, number in [(self.tree.parents[vertex], up), *down]:
                moves |= {left.pop(): to for _ in range(number)}
        for robot, to in moves.items():
            self.at[robot] = to
            self.visited |= 1 << to
        return moves


@pytest.mark.parametrize("team_size", [3, 4])
def test_it_does_so_where_all_move_at_once(team_size: int) -> None:
    """Here three robots suffice, which stay connected where a guard can be relieved within a tick."""
    assert loses_connection(AtOnce(FIVE_VERTICES, team_size, "cocta", (), printed=True))
    assert not loses_connection(AtOnce(FIVE_VERTICES, team_size, "cocta", ()))
    assert not loses_connection(Plain(FIVE_VERTICES, 3, "cocta", (), printed=True))


def test_the_printed_rule_stays_connected_on_smaller_trees() -> None:
    for tree in sorted_trees(4):
        for robots in range(1, 7):
            assert not loses_connection(Plain(tree, robots, "cocta", (), printed=True))


@pytest.mark.parametrize("variant", BOTH)
def test_too_few_robots_come_to_a_stand(variant: Variant) -> None:
    """A trail to the leaves takes one robot a vertex; without splits any team is large enough."""
    tree = perfect_tree(2, 4)
    assert robots_needed(2, [4]) == 9
    assert play(Team(tree, 9, variant, [4]), assert_connected) is not None
    assert play(Team(tree, 4, variant, [4]), assert_connected) is None
    assert ticks_taken(Team(tree, 4, variant, [4]), 1000) is None
    assert play(Team(tree, 4, variant), assert_connected) is not None


def test_a_run_may_be_cut_short() -> None:
    assert ticks_taken(Team(perfect_tree(2, 3), 7, "cocta", [3]), 9) is None
    assert ticks_taken(Team(perfect_tree(2, 3), 7, "cocta", [3]), 10) == 10


@pytest.mark.parametrize("variant", BOTH)
@given(trees())
def test_one_robot_goes_around_the_tree(variant: Variant, tree: RootedTree) -> None:
    order: list[int] = []
    ticks = play(Team(tree, 1, variant), lambda team: order.extend(team.at.values()))
    assert ticks == 2 * (len(tree) - 1)
    assert set(order) == set(range(len(tree)))


@pytest.mark.parametrize("variant", BOTH)
def test_a_single_vertex_needs_no_tick(variant: Variant) -> None:
    team = Team(tree_of_parents([None]), 3, variant)
    assert team.over
    assert next_moves(team) == {}
    assert ticks_taken(team, 0) == 0


@pytest.mark.parametrize("variant", BOTH)
@pytest.mark.parametrize("robots", [1, 2, 6])
def test_a_path_is_walked_to_its_end_and_back(variant: Variant, robots: int) -> None:
    assert ticks_of(perfect_tree(1, 5), robots, variant) == 10


def test_a_star_is_covered_from_its_centre() -> None:
    star = perfect_tree(12, 1)
    for variant in BOTH:
        assert (
            ticks_of(star, 4, variant, [1]) == 7
        )  # three leaves, then one by him who was relieved


# The optimum.


def optimal_ticks(tree: RootedTree, robots: int) -> int:
    """Return the fewest ticks by search over all places of all robots, which are alike."""
    near = [
        [v, *tree.children[v], *([] if v == tree.root else [tree.parents[v]])]
        for v in range(len(tree))
    ]
    places = combinations_with_replacement(range(len(tree)), robots)
    following: dict[tuple[int, ...], list[tuple[tuple[int, ...], int]]] = {}
    for at in (at for at in places if is_connected(tree, at)):
        goals = {tuple(sorted(goal)) for goal in product(*(near[v] for v in at))}
        following[at] = [
            (goal, sum(1 << v for v in set(goal))) for goal in goals if is_connected(tree, goal)
        ]
    start = ((tree.root,) * robots, 1 << tree.root)
    end = ((tree.root,) * robots, (1 << len(tree)) - 1)
    level, found, ticks = {start}, {start}, 0
    while end not in found:
        level = {
            (goal, visited | there) for at, visited in level for goal, there in following[at]
        } - found
        found |= level
        ticks += 1
    return ticks


def gaps_of(tree: RootedTree) -> list[tuple[int, int]]:
    return [gap_to_optimum(tree, robots) for robots in range(1, 5)]


def gap_to_optimum(tree: RootedTree, robots: int) -> tuple[int, int]:
    """Return the fewest ticks, and those of COCTA with the best splits."""
    splits = choose_splits(tree, robots, "cocta", "best")
    return optimal_ticks(tree, robots), ticks_of(tree, robots, "cocta", splits)


def sorted_trees(most: int) -> Iterator[RootedTree]:
    """Yield trees of up to so many vertices, each shape at least once."""
    for vertices in range(2, most + 1):
        for parents in product(*(range(child) for child in range(1, vertices))):
            if list(parents) == sorted(parents):
                yield tree_of_parents([None, *parents])


def test_is_optimal_or_one_tick_off_up_to_six_vertices() -> None:
    gaps = Counter(slow - fast for t in sorted_trees(6) for fast, slow in gaps_of(t))
    assert gaps == {0: 240, 1: 16}


def test_the_smallest_tree_where_it_is_two_ticks_off() -> None:
    tree = tree_of_parents([None, 0, 0, 0, 0, 1, 4])
    assert gap_to_optimum(tree, 3) == (6, 8)


@pytest.mark.slow
def test_is_optimal_up_to_two_ticks_for_seven_vertices() -> None:
    """And the optimum is at most twice the lower bound: edges shared out, or the deepest vertex."""
    gaps: Counter[int] = Counter()
    for tree in (tree for tree in sorted_trees(7) if len(tree) == 7):
        for robots in (2, 3):
            fast, slow = gap_to_optimum(tree, robots)
            gaps[slow - fast] += 1
            assert fast <= 2 * max(ceil(12 / robots), 2 * tree.height)
    assert gaps == {0: 223, 1: 40, 2: 1}


# What a tick costs.


class Counted(list[int]):
    """A list that counts how often it is read."""

    reads = 0

    def __getitem__(self, place: Any) -> Any:
        self.reads += 1
        return super().__getitem__(place)


@pytest.mark.parametrize("variant", BOTH)
def test_a_tick_costs_no_more_on_a_larger_tree(variant: Variant) -> None:
    """Robots read of the places where they are, and upwards: linear in robots and in height."""
    most = {}
    for height in (6, 12):
        team = Team(perfect_tree(2, height), 11, variant, [5])
        team.pending, team.inside = Counted(team.pending), Counted(team.inside)
        team.unfinished = Counted(team.unfinished)
        reads = [0]
        while not team.over:
            team.apply(next_moves(team))
            reads.append(team.pending.reads + team.inside.reads + team.unfinished.reads)
        most[height] = max(after - before for before, after in pairwise(reads))
    assert most[12] <= 2 * most[6]
    assert most[12] <= 11 * 2 * 12
