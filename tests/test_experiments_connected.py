"""The experiments on connected coverage: the paper's simulator, the specified numbers, the command."""

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.algorithms.connected_rule import Variant, checked_splits
from agents.planning.rooted_tree import NOWHERE, RootedTree, tree_of_parents, vertices_of_perfect
from deploy.cli import main
from experiments import command, connected
from experiments.connected import (
    SPECIFIED,
    SPECIFIED_HEIGHTS,
    Case,
    Measured,
    Point,
    general,
    graphs,
    heights,
    measure,
    office,
    robots,
    rows_of,
    table,
)
from experiments.connected_trees import Cut, Holes, Office, Perfect, Place
from experiments.inplace import inplace_ticks

LARGE = 10_000
"""Runs on trees with more vertices are slow."""

# The paper's simulator, against its definition.


def plain_ticks(tree: RootedTree, team: int, variant: Variant, splits: Sequence[int]) -> int | None:
    """Play the rule in place, with everything found out anew whenever it is asked for."""
    below = [{vertex} for vertex in range(len(tree))]
    lowest_first = sorted(range(len(tree)), key=lambda vertex: (tree.heights[vertex], vertex))
    for vertex in lowest_first[:-1]:
        below[tree.parents[vertex]] |= below[vertex]
    here = [0] * len(tree)
    here[tree.root] = team
    visited = {tree.root}
    top_split, drips = max(splits, default=0), variant == "cocta"

    def inside(vertex: int) -> int:
        return sum(here[w] for w in below[vertex])

    def explored(vertex: int) -> bool:
        return below[vertex] <= visited

    def finished(vertex: int) -> bool:
        return explored(vertex) and inside(vertex) == here[vertex]

    def room(vertex: int) -> int:
        if not drips:
            return team
        return max(0, sum(not finished(w) for w in below[vertex]) - inside(vertex))

    def decided(vertex: int) -> dict[int, int]:
        """Return how many go where."""
        parent, spare = tree.parents[vertex], here[vertex] - 1
        up = {} if parent == NOWHERE else {parent: spare}
        if finished(vertex):
            return dict.fromkeys(up, here[vertex])
        if explored(vertex):
            return up if drips or tree.heights[vertex] not in splits else {}
        children = [child for child in tree.children[vertex] if not explored(child)]
        shares = dict.fromkeys(children, 0)
        if tree.heights[vertex] in splits:
            rooms = {child: room(child) for child in children}
            # As many times around as could be needed.
            for child in children * spare:
                if sum(shares.values()) < spare and shares[child] < rooms[child]:
                    shares[child] += 1
            left = spare - sum(shares.values())
            return {**shares, **(dict.fromkeys(up, left) if drips else {})}
        if tree.heights[vertex] >= top_split:
            all_here = here[vertex] + inside(children[0]) == team
            if here[vertex] - (not all_here) <= room(children[0]):
                return {children[0]: here[vertex] - (not all_here)}
        for child in children:
            shares[child] = min(room(child), spare - sum(shares.values()))
        return shares

    for ticks in range(2 * len(tree) + 1):
        if finished(tree.root):
            return ticks
        moved = False
        for vertex in [v for v in lowest_first if here[v]]:
            for to, number in decided(vertex).items():
                here[vertex] -= number
                here[to] += number
                if number:
                    visited.add(to)
                    moved = True
        if not moved:
            return None
    raise AssertionError("does not end")


@st.composite
def runs(draw: st.DrawFn) -> tuple[RootedTree, int, tuple[int, ...]]:
    """Draw a tree, often deep, a team, and any split heights."""
    vertices = draw(st.integers(1, 12))
    reach = draw(st.sampled_from([2, 4, 12]))
    parents = [draw(st.integers(max(0, child - reach), child - 1)) for child in range(1, vertices)]
    tree = tree_of_parents([None, *parents])
    within = range(1, tree.height + 1)
    splits = draw(st.sets(st.sampled_from(within), max_size=3)) if within else set()
    return tree, draw(st.integers(1, 10)), checked_splits(tree, splits)


@given(runs(), st.sampled_from(["ncocta", "cocta"]))
def test_the_simulator_in_place_does_what_its_rules_say(
    run: tuple[RootedTree, int, tuple[int, ...]], variant: Variant
) -> None:
    tree, team, splits = run
    assert inplace_ticks(tree, team, variant, splits) == plain_ticks(tree, team, variant, splits)


# The specified numbers.


def cells() -> list[Any]:
    """List the runs of the table, the long ones marked as slow."""
    return [
        pytest.param(
            point,
            id=f"{point.panel}-{point.x}-{point.case.curve}",
            marks=[pytest.mark.slow] if vertices_of_perfect(*whole(point.case)) > LARGE else [],
        )
        for point in table(quick=False, cuts=0)
    ]


def whole(case: Case) -> Perfect:
    tree = case.tree.whole if isinstance(case.tree, Holes) else case.tree
    assert isinstance(tree, Perfect)
    return tree


@pytest.mark.parametrize("point", cells())
def test_a_cell_of_the_table(point: Point) -> None:
    assert measure(point.case).ticks == point.specified


@pytest.mark.parametrize("point", [p for p in heights(quick=True, cuts=0) if p.specified])
def test_a_height(point: Point) -> None:
    assert measure(point.case).ticks == point.specified


def test_the_numbers_are_those_of_the_specification(shared: Callable[..., Path]) -> None:
    text = shared("spec", "connected_coverage.md").read_text(encoding="utf-8")
    plain = re.compile(
        r"^\| (\d):(\d+) (\d+) \[([\d,]*)\] \| (\d+) \| (\d+) \| (\d+) (\d+) \|$", re.MULTILINE
    )
    holes = re.compile(
        r"^\| holes (\d):(\d+) c=(\d) i%(\d)==(\d), k=(\d+) \[([\d,]*)\], n=(\d+)"
        r" \| (\d+) \| (\d+) \| (\d+) (\d+) \|$",
        re.MULTILINE,
    )

    def tuple_of(words: str) -> tuple[int, ...]:
        return tuple(map(int, filter(None, words.split(","))))

    found: dict[Any, tuple[int, ...]] = {}
    for n, h, k, splits, *ticks in plain.findall(text):
        found[Perfect(int(n), int(h)), int(k), tuple_of(splits)] = tuple(map(int, ticks))
    for n, h, at, every, rest, k, splits, vertices, *ticks in holes.findall(text):
        tree = Holes(Perfect(int(n), int(h)), int(at), int(every), int(rest))
        found[tree, int(k), tuple_of(splits)] = tuple(map(int, ticks))
        assert len(tree.made()) == int(vertices)
    assert found == SPECIFIED
    line = next(line for line in text.splitlines() if line.startswith("2-ary, k = 60, H = 8..15"))
    numbers = [tuple(map(int, group.split())) for group in re.findall(r"\d+(?: \d+){7}", line)]
    assert numbers == list(SPECIFIED_HEIGHTS.values())


@pytest.mark.parametrize(
    ("team", "variant", "model", "speedup"),
    [
        (16, "ncocta", "pipe", 5.66),
        (58, "ncocta", "pipe", 17.63),
        (20, "cocta", "in place", 8.56),
    ],
)
def test_speedup_factors_of_the_paper(
    team: int, variant: Variant, model: connected.Model, speedup: float
) -> None:
    # The paper says over 5, over 17, and 8.6. Reference: Sec. 4.2 and 4.3.
    case = Case(Perfect(3, 7), team, variant, model)
    (row,) = rows_of([Point("", team, case)], [measure(case)])
    assert row.speedup == pytest.approx(speedup, abs=0.005)


# Trees.


def test_an_office_is_a_corridor_with_rooms() -> None:
    tree = Office(7).made()
    assert (len(tree), tree.height, tree.arity) == (22, 7, 3)


@pytest.mark.parametrize(("at", "cuts"), [(1, 0), (1, 6), (7, 6), (4, 3)])
def test_subtrees_are_cut_off_as_told(at: int, cuts: int) -> None:
    trees = [Cut(Perfect(2, 10), at, cuts, case).made() for case in (0, 0, 1)]
    assert {len(tree) for tree in trees} == {2047 - cuts * (2 ** (at + 1) - 1)}
    assert trees[0].children == trees[1].children
    if cuts == 6 and at == 1:
        assert trees[0].children != trees[2].children


def test_a_place_is_what_its_first_vertex_reaches(tmp_path: Path) -> None:
    file = tmp_path / "place.edges"
    file.write_text("a b\nb c\nc a\nc d\nx y\n")
    tree = Place(str(file)).made()
    assert sorted(tree.heights) == [0, 1, 1, 2]


# Parts and rows.


def test_rows_are_means_over_the_runs_at_a_point() -> None:
    case = Case(Perfect(2, 2), 2, "cocta")
    points = [Point("p", 1, case, 6), Point("p", 1, case, 6), Point("p", 2, case)]
    first, second = rows_of(points, [Measured(7, 2, 6), Measured(5, 2, 4), Measured(7, 2, None)])
    assert (first.runs, first.vertices, first.ticks, first.speedup) == (2, 6, 5, 2)
    assert first.lower_bound == (6 + 4) / 2
    assert first.differs
    assert (second.ticks, second.speedup, second.differs) == (None, None, False)


def test_parts_cover_the_figures() -> None:
    assert {(p.case.tree, p.x) for p in heights(quick=False, cuts=0)} == {
        (Perfect(2, height), height) for height in range(8, 16)
    }
    trees = {p.case.tree for p in robots(quick=False, cuts=0)}
    assert trees == {Perfect(2, 15), Perfect(3, 8), Perfect(4, 8)}
    each = [p for p in general(quick=False, cuts=10) if p.panel.endswith("12") and p.x == 3]
    assert len({p.case.tree for p in each}) == 70  # Sec. 4.4
    assert {p.case.robots for p in each} == {60}
    assert {3, 4} <= {p.x for p in office(quick=False, cuts=0)}


def test_real_places_can_be_covered(
    shared: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CANOPY_SHARED", str(shared("maps").parent))
    points = list(graphs(quick=True, cuts=0))
    assert {point.panel for point in points} >= {"office", "clinic", "Cogentco", "DowProv"}
    for row in rows_of(points, [measure(point.case) for point in points]):
        assert row.ticks is not None
        assert row.lower_bound <= row.ticks <= 2 * (row.vertices - 1)


# The command.


@pytest.mark.parametrize(("wrong", "code"), [(0, 0), (1, 1)])
def test_the_command_writes_figures_and_numbers(
    wrong: int,
    code: int,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (key, ticks) = next(iter(SPECIFIED.items()))
    monkeypatch.setattr(command, "WORKERS", 1)
    monkeypatch.setattr(connected, "SPECIFIED", {key: (ticks[0] + wrong, *ticks[1:])})
    words = ["paper", "connected", "--quick", "--inputs", "1", "--json", "--out", str(tmp_path)]
    assert main([*words, "--only", "table", "--only", "office"]) == code
    said = json.loads(capsys.readouterr().out)
    assert list(said["parts"]) == ["table", "office"]
    assert [row["ticks"] for row in said["parts"]["table"]] == list(ticks)
    for part, lines in (("table", 4), ("office", 16)):
        assert (tmp_path / f"{part}.png").stat().st_size > 10_000
        assert len((tmp_path / f"{part}.csv").read_text().splitlines()) == 1 + lines


def test_without_the_graphs_their_part_is_left_out_unless_it_is_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CANOPY_SHARED", str(tmp_path))
    assert list(graphs(quick=True, cuts=0)) == []
    assert main(["paper", "connected", "--only", "graphs"]) == 2
    assert "--only graphs: no folder" in capsys.readouterr().err


def test_a_part_that_is_not_there_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["paper", "connected", "--only", "figure4"]) == 2
    assert "--only figure4: no such part of the paper" in capsys.readouterr().err
