"""Offline planning: trees, tours, splits, Create_Tree, walks; Agmon et al. 2008, Sec. 3."""

from collections.abc import Collection, Sequence
from itertools import combinations, pairwise, product
from pathlib import Path

import networkx as nx
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import agents.planning.walks as walks_module
from agents.algorithms.stc import AWAY, Tree, located, number, row_and_column
from agents.planning.bridges import (
    Bridges,
    best_of_all,
    best_of_tries,
    count_spanning_sets,
    spanning_sets,
)
from agents.planning.create_tree import DISTANCES, ORDER, Forest, grow_forest
from agents.planning.splits import SPLITS, Split, b_mstc, cost, nb_mstc, opt_mstc
from agents.planning.tour import Places, circumnavigate
from agents.planning.trees import TREES, component, edges_of
from agents.planning.walks import closed_walks, first_visits, open_walks
from protocol.grid import Cell, sub_cells
from protocol.seeds import spawn
from tests.conftest import shared
from tests.instances import Instance, read_instance
from world_server.maps.generated_grids import random_obstacles

METRICS = {"manhattan": "manhattan", "euclid": "euclid", "sp": "shortest-path"}


# What tests start from.


@st.composite
def floors(draw: st.DrawFn, most: int = 30) -> list[int]:
    """Connected coarse cells, row by row."""
    cells = {number((10, 10))}
    for _ in range(draw(st.integers(0, most - 1))):
        cell = draw(st.sampled_from(sorted(cells)))
        cells.add(cell + draw(st.sampled_from(AWAY)))
    return sorted(cells)


@st.composite
def teams(draw: st.DrawFn, most: int = 30) -> tuple[list[int], list[Cell]]:
    """Connected coarse cells, and starts on them."""
    cells = draw(floors(most))
    among = places_on(cells)
    count = draw(st.integers(1, min(6, len(among))))
    return cells, draw(st.permutations(among))[:count]


def places_on(cells: Sequence[int]) -> list[Cell]:
    return [at for cell in cells for at in sub_cells(row_and_column(cell))]


def tree_of(edges: Sequence[tuple[int, int]], cells: Sequence[int]) -> Tree:
    tree = Tree()
    for cell in cells:
        tree.root(cell)
    for one, other in edges:
        tree.join(one, AWAY.index(other - one))
    return tree


def graph_of(tree: Tree) -> "nx.Graph[int]":
    graph: nx.Graph[int] = nx.Graph()
    graph.add_nodes_from(tree.edges)
    for cell, bits in tree.edges.items():
        for way, away in enumerate(AWAY):
            if bits >> way & 1:
                assert tree.edges[cell + away] >> (way + 2) % 4 & 1
                graph.add_edge(cell, cell + away)
    return graph


def instances(*names: str) -> list[Path]:
    folder = shared("spec", "instances")
    found = [path for name in names for path in sorted(folder.glob(f"{name}*.txt"))]
    assert found
    return found


def gaps_on(tree: Tree, starts: Sequence[Cell]) -> list[int]:
    return Places(circumnavigate(tree, starts[0]), starts).gaps


# Exact instances.


def test_tours() -> None:
    for path in instances("tour", "fig2"):
        told = read_instance(path)
        cells = sorted(number(cell) for cell in told.free)
        tree = tree_of([(number(one), number(other)) for one, other in told.tree], cells)
        tour = circumnavigate(tree, told.robots[0])
        places = Places(tour, told.robots)
        found = {
            "N": len(tour),
            "order": places.order,
            "D": places.gaps,
            "NB": nb_mstc(places.gaps).moves,
            "B": b_mstc(places.gaps).moves,
            "Opt": opt_mstc(places.gaps).moves,
        }
        assert found == told.expect, path.name


def test_all_trees_of_small_maps() -> None:
    for path in instances("fig3"):
        told = read_instance(path)
        cells = sorted(number(cell) for cell in told.free)
        edges = [(cell, cell + AWAY[way]) for cell, way in edges_of(cells)]
        ends = [(cells.index(one), cells.index(other)) for one, other in edges]
        sets = list(spanning_sets(len(cells), ends))
        gaps = [
            gaps_on(tree_of([edges[edge] for edge in chosen], cells), told.robots)
            for chosen in sets
        ]
        worst, best = max(map(max, gaps)), min(map(max, gaps))
        found = {
            "count": count_spanning_sets(len(cells), ends),
            "multiset": sorted(tuple(sorted(gap, reverse=True)) for gap in gaps),
            "bestDmax": best,
            "bestNB": min(nb_mstc(gap).moves for gap in gaps),
            "worstNB": worst - 1,
        }
        assert len(sets) == found["count"]
        assert found == {**told.expect, "multiset": sorted(told.expect["multiset"])}, path.name  # type: ignore[call-overload]  # a list of pairs


def grown(told: Instance, distance: str) -> tuple[Forest, Bridges]:
    cells = sorted(number(cell) for cell in told.free)
    forest = grow_forest(cells, [located(robot)[0] for robot in told.robots], distance)
    return forest, Bridges(forest, told.robots)


def owner_of(told: Instance, forest: Forest) -> str:
    return "/".join(
        "".join(str(forest.owner.get(number((row, col)), "#")) for col in range(len(line)))
        for row, line in enumerate(told.rows)
    )


def owner_in(path: Path, metric: str) -> str:
    """Read the expected owners as they stand there; they may look like numbers or comments."""
    lines = path.read_text(encoding="utf-8").splitlines()
    (line,) = [line for line in lines if line.startswith(f"expect {metric}.owner ")]
    return line.split()[2]


def test_create_tree() -> None:
    for path in instances("create"):
        told = read_instance(path)
        for metric in told.others["metrics"]:
            forest, bridges = grown(told, METRICS[metric])
            whole = best_of_all(bridges, 10_000)
            assert whole is not None
            expected = told.expected(metric)
            found = {
                "sizes": forest.sizes,
                "bridges": len(bridges),
                "owner": expected["owner"],
                "ops": list(forest.growths),
                "sets": whole.best.sets,
                "bestDmax": whole.best.d_max,
                "worstDmax": whole.d_max_worst,
                "bestOpt": whole.opt_best,
            }
            assert found == expected, (path.name, metric)
            assert owner_of(told, forest) == owner_in(path, metric)


def test_tries_fall_in_the_range_and_reach_the_best() -> None:
    for path in instances("create"):
        told = read_instance(path)
        for metric in told.others["metrics"]:
            _, bridges = grown(told, METRICS[metric])
            expected = told.expected(metric)
            for seed in range(20):
                best = best_of_tries(bridges, 1, spawn(seed, "tries"))
                assert expected["bestDmax"] <= best.d_max <= expected["worstDmax"]  # type: ignore[operator]  # numbers both
            best = best_of_tries(bridges, 500, spawn(0, "tries"))
            assert best.d_max == expected["bestDmax"]
            assert max(gaps_on(bridges.join(best.bridge_set), told.robots)) == best.d_max


# Trees and tours.


@pytest.mark.parametrize("kind", TREES)
@given(cells=floors(), seed=st.integers(0, 9))
@settings(max_examples=40)
def test_every_kind_of_tree_spans(kind: str, cells: list[int], seed: int) -> None:
    tree = TREES[kind](cells, spawn(seed, "tree"))
    graph = graph_of(tree)
    assert set(graph) == set(cells)
    assert nx.is_tree(graph)
    assert TREES[kind](cells, spawn(seed, "tree")).edges == tree.edges


def test_random_trees_are_equally_likely() -> None:
    cells = [number((row, col)) for row in range(2) for col in range(3)]
    rng = spawn(0, "trees")
    counts: dict[tuple[int, ...], int] = {}
    for _ in range(3000):
        edges = TREES["random"](cells, rng).edges
        key = tuple(edges[cell] for cell in cells)
        counts[key] = counts.get(key, 0) + 1
    assert len(counts) == 15
    chi_squared = sum((count - 200) ** 2 / 200 for count in counts.values())
    assert chi_squared < 36.1  # 14 degrees of freedom, one in a thousand


@given(floors(), st.integers(0, 9), st.data())
@settings(max_examples=60)
def test_a_tour_passes_each_sub_cell_once(cells: list[int], seed: int, data: st.DataObject) -> None:
    tree = TREES["random"](cells, spawn(seed, "tree"))
    start = data.draw(st.sampled_from(places_on(cells)))
    tour = circumnavigate(tree, start)
    assert tour[0] == start
    assert sorted(tour) == sorted(places_on(cells))
    for one, other in zip(tour, [*tour[1:], start], strict=True):
        assert abs(one[0] - other[0]) + abs(one[1] - other[1]) == 1


def test_a_component_is_what_is_connected() -> None:
    one, other = number((3, 3)), number((5, 5))
    assert component([other, one, one + 1], one) == [one, one + 1]


def test_places_refuse_what_is_not_on_the_tour() -> None:
    tour = circumnavigate(tree_of([], [0]), (0, 0))
    with pytest.raises(ValueError, match="a place of its own"):
        Places(tour, [(0, 0), (5, 5)])
    with pytest.raises(ValueError, match="robot 0 the first"):
        Places(tour, [(1, 1)])


# Splits.

GAPS = st.lists(st.integers(1, 8), min_size=1, max_size=5)


def costs(split: Split) -> list[int]:
    return [cost(*sides) for sides in zip(split.back, split.ahead, strict=True)]


def least(gaps: Sequence[int], shared: Collection[int]) -> int:
    """Try every way to divide every gap that is shared."""
    robots = range(len(gaps))
    ways = [range(gap) if robot in shared else [gap - 1] for robot, gap in enumerate(gaps)]
    return min(
        max(cost(gaps[robot - 1] - 1 - ahead[robot - 1], ahead[robot]) for robot in robots)
        for ahead in product(*ways)
    )


@given(GAPS)
def test_opt_is_the_least(gaps: list[int]) -> None:
    assert opt_mstc(gaps).moves == least(gaps, range(len(gaps)))


@given(st.lists(st.integers(1, 6), min_size=1, max_size=6), st.integers(0, 20), st.data())
def test_b_is_the_least_with_three_gaps_shared(
    others: list[int], more: int, data: st.DataObject
) -> None:
    at = data.draw(st.integers(0, len(others)))
    gaps = [*others[:at], sum(others) + 1 + more, *others[at:]]
    shared = {(at + step) % len(gaps) for step in range(3)}
    assert b_mstc(gaps).moves == least(gaps, shared)


@given(st.lists(st.integers(1, 200), min_size=1, max_size=20))
def test_parts_cover_every_gap_at_the_cost_that_is_told(gaps: list[int]) -> None:
    for split in (nb_mstc(gaps), b_mstc(gaps), opt_mstc(gaps)):
        robots = range(len(gaps))
        assert max(costs(split)) == split.moves
        assert all(min(sides) >= 0 for sides in zip(split.back, split.ahead, strict=True))
        assert [
            split.ahead[robot] + split.back[(robot + 1) % len(gaps)] + 1 for robot in robots
        ] == gaps


@given(st.lists(st.integers(1, 200), min_size=1, max_size=20))
def test_sharing_more_is_never_worse(gaps: list[int]) -> None:
    assert opt_mstc(gaps).moves <= b_mstc(gaps).moves <= nb_mstc(gaps).moves


@pytest.mark.parametrize("length", [12, 24])
@pytest.mark.parametrize("robots", [2, 3, 4])
def test_theorem_1(length: int, robots: int) -> None:
    """Reference: Sec. 3.1, Theorem 1."""
    ratios = []
    for cuts in combinations(range(1, length), robots - 1):
        ends = (0, *cuts, length)
        gaps = [far - near for near, far in pairwise(ends)]
        nb, b, opt = (split(gaps).moves for split in SPLITS.values())
        assert opt <= b <= nb <= 2 * opt
        ratios.append(nb / opt)
    assert length == 12 or max(ratios) > 1.8


def test_b_shares_three_gaps_and_no_more() -> None:
    assert b_mstc([5, 5, 5, 5, 10]) == nb_mstc([5, 5, 5, 5, 10])
    split = b_mstc([1, 40, 1, 1, 5])
    assert split.back[:2] == (0, 0)
    assert split.back[2] > 0
    assert split.ahead[4] == 4
    assert opt_mstc([40, 1, 1, 1, 1, 35]).moves < 34 == b_mstc([40, 1, 1, 1, 1, 35]).moves


def test_one_robot_goes_around() -> None:
    assert nb_mstc([12]) == opt_mstc([12]) == b_mstc([12]) == Split(11, (0,), (11,))


# Create_Tree.


def naive_choice(
    cells: Sequence[int], tip: int, others: Sequence[int], vacant: Sequence[int], name: str
) -> int:
    """Choose as the rule is written, with one search for each pair."""
    graph: nx.Graph[int] = nx.Graph()
    graph.add_nodes_from(cells)
    graph.add_edges_from((cell, cell + AWAY[way]) for cell, way in edges_of(list(cells)))

    def distance(one: int, other: int) -> float:
        (row, col), (to_row, to_col) = row_and_column(one), row_and_column(other)
        match name:
            case "manhattan":
                return abs(row - to_row) + abs(col - to_col)
            case "euclid":
                return float((row - to_row) ** 2 + (col - to_col) ** 2)
            case _:
                length: int = nx.shortest_path_length(graph, one, other)
                return length

    values = [
        (min(distance(tip + AWAY[way], other) for other in others), -place, way)
        for place, way in enumerate(ORDER)
        if tip + AWAY[way] in vacant
    ]
    return max(values)[2]


@pytest.mark.parametrize("name", DISTANCES)
@given(cells=floors(), data=st.data())
@settings(max_examples=60)
def test_the_tip_goes_where_others_are_far(
    name: str, cells: list[int], data: st.DataObject
) -> None:
    tip = data.draw(st.sampled_from(cells))
    vacant = [cell + away for cell, away in product([tip], AWAY) if cell + away in cells]
    rest = [cell for cell in cells if cell not in (tip, *vacant)]
    assume(len(vacant) > 1 and rest)
    others = data.draw(st.lists(st.sampled_from(rest), min_size=1, max_size=4, unique=True))
    ways = [way for way in ORDER if tip + AWAY[way] in vacant]
    found = DISTANCES[name](frozenset(cells))(tip, ways, others)
    assert found == naive_choice(cells, tip, others, vacant, name)


@pytest.mark.parametrize("name", DISTANCES)
@given(team=teams())
@settings(max_examples=40)
def test_subtrees_partition_the_cells(name: str, team: tuple[list[int], list[Cell]]) -> None:
    cells, starts = team
    forest = grow_forest(cells, [located(start)[0] for start in starts], name)
    assert set(forest.owner) == set(cells) == set(forest.tree.edges)
    parts = [set(part) for part in nx.connected_components(graph_of(forest.tree))]
    assert sorted(map(len, parts)) == sorted(forest.sizes)
    for part in parts:
        (subtree,) = {forest.owner[cell] for cell in part}
        assert forest.roots[subtree] in part
    assert nx.is_forest(graph_of(forest.tree))
    walked, hilled, branched = forest.growths
    assert len(forest.roots) + walked + 2 * hilled + branched == len(cells)


Edge = tuple[int, int]


def edge_of(one: int, other: int) -> Edge:
    return min(one, other), max(one, other)


def naive_forest(cells: Sequence[int], starts: Sequence[int]) -> tuple[dict[int, int], set[Edge]]:
    """Grow as the rules are written: scan the whole path and the whole subtree each time."""
    roots = list(dict.fromkeys(starts))
    owner = {root: index for index, root in enumerate(roots)}
    paths = [[root] for root in roots]
    branches: list[set[Edge]] = [set() for _ in roots]

    def edges_in(index: int) -> set[Edge]:
        return {edge_of(*edge) for edge in pairwise(paths[index])} | branches[index]

    def vacant(cell: int) -> bool:
        return cell in cells and cell not in owner

    def grow(index: int) -> None:
        path = paths[index]
        tips = [path[-1] for other, path in enumerate(paths) if other != index]
        ways = [path[-1] + AWAY[way] for way in ORDER if vacant(path[-1] + AWAY[way])]
        if ways:
            to = ways[0]
            if len(ways) > 1 and tips:
                left = [cell for cell in cells if cell not in owner]
                to = path[-1] + AWAY[naive_choice(cells, path[-1], tips, left, "manhattan")]
            owner[to] = index
            path.append(to)
            return
        for at in range(len(path) - 1, 0, -1):
            near, far = path[at - 1], path[at]
            sides = (1, 3) if abs(far - near) > 1 else (0, 2)
            for away in (AWAY[side] for side in sides):
                if vacant(near + away) and vacant(far + away):
                    owner[near + away] = owner[far + away] = index
                    path[at:at] = [near + away, far + away]
                    return
        seen = [roots[index]]
        for cell in seen:
            for to in (cell + AWAY[way] for way in ORDER):
                if vacant(to):
                    owner[to] = index
                    branches[index].add(edge_of(cell, to))
                    return
                if edge_of(cell, to) in edges_in(index) and to not in seen:
                    seen.append(to)

    while len(owner) < len(cells):
        for index in range(len(roots)):
            grow(index)
    return owner, set().union(*map(edges_in, range(len(roots))))


@given(teams(most=60))
@settings(max_examples=100)
def test_growing_keeps_to_the_rules(team: tuple[list[int], list[Cell]]) -> None:
    cells, starts = team
    roots = [located(start)[0] for start in starts]
    forest = grow_forest(cells, roots, "manhattan")
    owner, edges = naive_forest(cells, roots)
    assert forest.owner == owner
    assert {edge_of(*edge) for edge in graph_of(forest.tree).edges} == edges


@pytest.mark.parametrize("seed", range(12))
def test_growing_keeps_to_the_rules_on_a_floor(seed: int) -> None:
    grid = random_obstacles(8, 10, 3 * seed, spawn(seed, "world"))
    cells = sorted(map(number, grid.complete_cells()))
    roots = spawn(seed, "roots").sample(cells, 1 + seed % 5)
    forest = grow_forest(cells, roots, "manhattan")
    owner, edges = naive_forest(cells, roots)
    assert forest.owner == owner
    assert {edge_of(*edge) for edge in graph_of(forest.tree).edges} == edges


def test_cells_that_are_not_connected_are_refused() -> None:
    with pytest.raises(ValueError, match="1 cells are not connected"):
        grow_forest([0, 1, 5], [0], "manhattan")


@given(teams(), st.integers(0, 9))
@settings(max_examples=80)
def test_splicing_gives_what_going_around_gives(
    team: tuple[list[int], list[Cell]], seed: int
) -> None:
    cells, starts = team
    forest = grow_forest(cells, [located(start)[0] for start in starts], "manhattan")
    bridges = Bridges(forest, starts)
    sets = []
    rng = spawn(seed, "sets")
    for _ in range(5):
        order = rng.sample(range(len(bridges)), len(bridges))
        labels = list(range(bridges.subtrees))
        chosen = []
        for bridge in order:
            one, other = (labels[int(end)] for end in bridges.ends[bridge])
            if one != other:
                chosen.append(bridge)
                labels = [other if label == one else label for label in labels]
        sets.append(chosen)
    found = bridges.gaps(np.array(sets, dtype=np.int64).reshape(5, -1)).tolist()
    for gaps, chosen in zip(found, sets, strict=True):
        tree = bridges.join(chosen)
        assert nx.is_tree(graph_of(tree))
        assert gaps == gaps_on(tree, starts)
    best = best_of_tries(bridges, 7, rng)
    assert max(gaps_on(bridges.join(best.bridge_set), starts)) == best.d_max


@given(st.integers(2, 5), st.data())
@settings(max_examples=40)
def test_spanning_sets_are_as_many_as_kirchhoff_says(nodes: int, data: st.DataObject) -> None:
    pairs = st.sampled_from(list(combinations(range(nodes), 2)))
    edges = data.draw(st.lists(pairs, max_size=8))
    sets = list(spanning_sets(nodes, edges))
    expected = []
    for chosen in combinations(range(len(edges)), nodes - 1):
        graph = nx.MultiGraph([edges[edge] for edge in chosen])
        graph.add_nodes_from(range(nodes))
        if nx.is_tree(graph):
            expected.append(chosen)
    assert sets == expected
    assert count_spanning_sets(nodes, edges) == len(expected)


def test_all_sets_of_one_subtree_are_one() -> None:
    forest = grow_forest([0, 1], [0, 0], "manhattan")
    bridges = Bridges(forest, [(0, 0), (1, 1)])
    whole = best_of_all(bridges, 1)
    assert whole is not None
    assert (whole.best.bridge_set, whole.best.sets) == ((), 1)
    assert best_of_tries(bridges, 3, spawn(0, "tries")).bridge_set == ()
    assert (
        gaps_on(forest.tree, [(0, 0), (1, 1)])
        == bridges.gaps(np.zeros((1, 0), dtype=np.int64)).tolist()[0]
    )


def test_too_many_sets_are_not_looked_at() -> None:
    cells = [number((row, col)) for row in range(4) for col in range(4)]
    forest = grow_forest(cells, [cells[0], cells[-1]], "manhattan")
    bridges = Bridges(forest, [(0, 0), (7, 7)])
    assert best_of_all(bridges, len(bridges) - 1) is None
    assert best_of_all(bridges, len(bridges)) is not None


# Walks.


@pytest.mark.parametrize("name", SPLITS)
@given(team=teams(), seed=st.integers(0, 9))
@settings(max_examples=40)
def test_walks_cover_in_time_and_lead_home(
    name: str, team: tuple[list[int], list[Cell]], seed: int
) -> None:
    cells, starts = team
    tour = circumnavigate(TREES["random"](cells, spawn(seed, "tree")), starts[0])
    places = Places(tour, starts)
    split = SPLITS[name](places.gaps)
    one_way = open_walks(tour, places, split)
    closed = closed_walks(one_way)
    for start, walk, longer in zip(starts, one_way, closed, strict=True):
        assert walk[0] == longer[0] == longer[-1] == start
        assert longer[: len(walk)] == walk
        assert len(longer) <= 2 * len(walk)
        for here, there in pairwise(longer):
            assert abs(here[0] - there[0]) + abs(here[1] - there[1]) == 1
            assert there in set(tour)
    for walks in (one_way, closed):
        first: dict[Cell, int] = {}
        for time in range(max(map(len, walks))):
            for walk in walks:
                if time < len(walk):
                    first.setdefault(walk[time], time)
        assert first == first_visits(walks)
        assert set(first) == set(tour)
        assert max(first.values()) == split.moves


def test_the_way_home_is_the_shortest_over_what_is_covered() -> None:
    """Robot 0 goes down and up; across the middle it is back at once, if robot 1 was there."""
    down = [(row, 0) for row in range(5)]
    walk = [*down, (4, 1), (4, 2), *((row, 2) for row in range(3, -1, -1))]
    (alone,) = closed_walks([walk])
    assert alone[len(walk) :] == walk[-2::-1]
    other = [(-3, 1), (-2, 1), (-1, 1), (0, 1)]
    first, _ = closed_walks([walk, other])
    assert first[len(walk) :] == [(0, 1), (0, 0)]
    late = [*[(-3, 1), (-2, 1)] * 10, (-1, 1), (0, 1)]
    first, _ = closed_walks([walk, late])
    assert first[len(walk) :] == walk[-2::-1]


def test_without_effort_a_robot_comes_home_by_its_own_part(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(walks_module, "EFFORT", 2)
    walk = [(0, 0), (1, 0), (2, 0), (2, 1), (1, 1)]
    first, _ = closed_walks([walk, [(5, 5)]])
    assert first == [*walk, (1, 0), (0, 0)]


# Statistics.

TABLE = [
    (0, 3, 37, 6),
    (0, 10, 52, 27),
    (0, 30, 54.5, 34.4),
    (160, 10, 41, 23),
    (160, 30, 43.1, 23.5),
]
"""Obstacles and robots, and by how many percent Create_Tree shortens NB and Opt of random trees."""


@pytest.mark.slow
@pytest.mark.parametrize(("obstacles", "robots", "nb", "opt"), TABLE)
def test_create_tree_shortens_coverage(obstacles: int, robots: int, nb: float, opt: float) -> None:
    """The mean of 50 inputs alone strays by 2 points, so this takes more.

    Reference: Sec. 3.3.2, Figs. 7 and 8.
    """
    sums = np.zeros((2, 2))
    for seed in range(400):
        grid = random_obstacles(20, 30, obstacles, spawn(seed, "world"))
        cells = sorted(map(number, grid.complete_cells()))
        starts = spawn(seed, "starts").sample(places_on(cells), robots)
        forest = grow_forest(cells, [located(start)[0] for start in starts], "manhattan")
        bridges = Bridges(forest, starts)
        best = best_of_tries(bridges, robots**2, spawn(seed, "bridges"))
        for row, tree in enumerate(
            (TREES["random"](cells, spawn(seed, "tree")), bridges.join(best.bridge_set))
        ):
            gaps = gaps_on(tree, starts)
            sums[row] += nb_mstc(gaps).moves, opt_mstc(gaps).moves
    improvements = 100 * (1 - sums[1] / sums[0])
    assert improvements == pytest.approx([nb, opt], abs=5), sums / 400
