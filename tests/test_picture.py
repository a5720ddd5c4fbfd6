"""Pictures: layouts put every vertex somewhere sensible, drawings are complete files."""

import math
import re
import sys
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure
from matplotlib.text import Text

from deploy.picture import LEGEND_MOST, draw_map, draw_run, layout
from protocol.graph import PortGraph
from world_server.maps import generators, read_graph

PNG = b"\x89PNG\r\n\x1a\n"


def without_positions(graph: PortGraph) -> PortGraph:
    return PortGraph(graph.names, graph.ends)


def spans(graph: PortGraph) -> list[float]:
    """The drawn length of each edge that is no loop."""
    points = layout(graph)
    return [math.dist(points[u], points[v]) for u, v in graph.ends if u != v]


# Layout ------------------------------------------------------------------------------------------


def test_a_map_with_positions_keeps_them() -> None:
    graph = generators.grid(3, 4)
    assert graph.positions is not None
    assert layout(graph) == list(graph.positions)


@settings(max_examples=60)
@given(st.integers(1, 12), st.data())
def test_every_vertex_of_any_graph_has_a_place_of_its_own(
    vertices: int, data: st.DataObject
) -> None:
    vertex = st.integers(0, vertices - 1)
    ends = data.draw(st.lists(st.tuples(vertex, vertex), max_size=20))
    graph = PortGraph([str(v) for v in range(vertices)], ends)
    points = layout(graph)
    assert len(points) == vertices
    assert all(math.isfinite(x) and math.isfinite(y) for x, y in points)
    apart = [math.dist(points[u], points[v]) for u in range(vertices) for v in range(u)]
    assert min(apart, default=1.0) > 0.01
    assert layout(graph) == points


@pytest.mark.parametrize(
    "graph",
    [
        generators.nary_tree(7, 3),
        generators.wide_tree(200, Random(1)),
        generators.long_tree(200, Random(1)),
        generators.cycle(40),
        generators.path(60),
        without_positions(generators.grid(10, 14)),
        without_positions(generators.cave(180, 12, Random(26))),
    ],
    ids=["nary", "wide", "long", "cycle", "path", "grid", "cave"],
)
def test_edges_are_short_and_vertices_apart(graph: PortGraph) -> None:
    points = layout(graph)
    width = max(x for x, _ in points) - min(x for x, _ in points)
    height = max(y for _, y in points) - min(y for _, y in points)
    drawn = spans(graph)
    assert max(drawn) < 0.5 * math.hypot(width, height)
    order = sorted(points)
    nearest = [
        min(math.dist(point, other) for other in points if other is not point) for point in order
    ]
    assert sorted(nearest)[len(nearest) // 20] > 0.05
    assert sum(drawn) / len(drawn) < 2.0


def test_a_grid_is_drawn_as_a_grid() -> None:
    drawn = spans(without_positions(generators.grid(8, 11)))
    assert min(drawn) > 0.75
    assert max(drawn) < 1.3


def test_large_graphs_are_laid_out() -> None:
    for graph in (without_positions(generators.grid(45, 70)), generators.nary_tree(4, 6)):
        drawn = spans(graph)
        assert min(drawn) > 0
        assert sum(drawn) / len(drawn) < 2.0


def test_components_do_not_overlap() -> None:
    ends = [(0, 1), (1, 2), (2, 0), (3, 4), (4, 5)]
    points = layout(PortGraph("abcdefg", ends))
    for one, other in (((0, 1, 2), (3, 4, 5)), ((0, 1, 2), (6,)), ((3, 4, 5), (6,))):
        assert min(math.dist(points[u], points[v]) for u in one for v in other) > 0.5


# Drawings ----------------------------------------------------------------------------------------

MULTI = PortGraph(
    "abcdef", [(0, 1), (0, 1), (1, 1), (2, 1), (2, 3), (2, 3), (2, 3), (4, 0), (4, 4), (4, 4)]
)


@pytest.mark.parametrize(
    "graph", [MULTI, PortGraph("a", []), PortGraph("ab", []), generators.path(2)]
)
def test_maps_of_all_shapes_are_drawn(tmp_path: Path, graph: PortGraph) -> None:
    path = tmp_path / "map.png"
    draw_map(graph, path, "$x_ a name in no font: 洞窟", 0)
    assert path.read_bytes().startswith(PNG)
    draw_map(graph, path, "", None)


def test_vertices_in_one_place_can_be_drawn(tmp_path: Path) -> None:
    graph = PortGraph("abc", [(0, 1), (1, 2)], positions=[(5, 5)] * 3)
    draw_map(graph, tmp_path / "map.png", "one place", 2)


@pytest.mark.parametrize("team_size", [1, 16, 64])
def test_a_run_is_drawn(tmp_path: Path, team_size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Figure] = []
    save = Figure.savefig

    def keep(figure: Figure, *args: Any, **options: Any) -> None:
        drawn.append(figure)
        save(figure, *args, **options)

    monkeypatch.setattr(Figure, "savefig", keep)
    graph = generators.cave(60, 5, Random(3))
    depth = graph.distances(0)
    robots = [vertex % team_size for vertex in range(60)]
    visits = {v: (robots[v], float(depth[v])) for v in range(60) if depth[v] < 12}
    crossings = {
        edge: (robots[u], float(depth[u]))
        for edge, (u, v) in enumerate(graph.ends)
        if u in visits and v in visits
    }
    lost: dict[int, tuple[float, int | None, int | None]] = {0: (3.0, 2, None)}
    if team_size > 4:
        lost |= {1: (3.0, 2, None), 2: (6.5, 4, 5), 3: (9.0, None, None)}
    path = tmp_path / "run.svg"
    draw_run(
        graph,
        path,
        title="A run",
        subtitle="as the test has it",
        start=0,
        first_visits=visits,
        crossings=crossings,
        lost=lost,
        team_size=team_size,
    )
    assert path.read_text().rstrip().endswith("</svg>")
    texts = {text.get_text() for text in drawn[0].findobj(Text)}
    said = ["A run", "as the test has it", "start", "never visited", "time of first visit"]
    said += ["lost at 3", "robots 0 (t = 3), 1 (t = 3)" if team_size > 4 else "robot 0 (t = 3)"]
    said += ["robot 2 (t = 6.5)", "lost at 9"] if team_size > 4 else []
    said += ["30 more"] if team_size == 64 else []
    assert set(said) <= texts
    rows = [words for words in texts if re.fullmatch(r"robot \d+", words)]
    assert len(rows) == min(team_size, LEGEND_MOST)


def test_a_run_in_which_nothing_happened_is_drawn(tmp_path: Path) -> None:
    draw_run(
        MULTI,
        tmp_path / "run.png",
        title="",
        subtitle="",
        start=0,
        first_visits={0: (0, 0.0)},
        crossings={},
        lost={0: (0.0, None, 2)},
        team_size=1,
    )
    assert (tmp_path / "run.png").read_bytes().startswith(PNG)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"start": 6}, "start: found 6, expected 0 to 5"),
        ({"first_visits": {9: (0, 0.0)}}, "first_visits: found 9, expected 0 to 5"),
        ({"first_visits": {0: (2, 0.0)}}, "first_visits: robot: found 2, expected 0 to 1"),
        ({"crossings": {10: (0, 0.0)}}, "crossings: found 10, expected 0 to 9"),
        ({"crossings": {1: (-1, 0.0)}}, "crossings: robot: found -1, expected 0 to 1"),
        ({"lost": {2: (0.0, None, None)}}, "lost: found 2, expected 0 to 1"),
        ({"lost": {1: (0.0, 6, None)}}, "lost: vertex: found 6, expected 0 to 5"),
        ({"lost": {1: (0.0, None, 10)}}, "lost: edge: found 10, expected 0 to 9"),
    ],
)
def test_numbers_out_of_range(tmp_path: Path, wrong: dict[str, object], message: str) -> None:
    right: dict[str, object] = {"start": 0, "first_visits": {}, "crossings": {}, "lost": {}}
    texts = {"title": "", "subtitle": ""}
    with pytest.raises(ValueError, match=f"^{message}$"):
        draw_run(MULTI, tmp_path / "run.png", team_size=2, **texts, **right | wrong)  # type: ignore[arg-type]


def test_drawing_does_not_load_pyplot(tmp_path: Path) -> None:
    draw_map(MULTI, tmp_path / "map.png", "", 0)
    assert "matplotlib.pyplot" not in sys.modules


def test_a_real_cave_is_legible(shared: Callable[..., Path]) -> None:
    graph = read_graph(shared("maps", "graphs", "cave", "DowProv.edges"))
    points = layout(graph)
    width = max(x for x, _ in points) - min(x for x, _ in points)
    # Drawn straight it is 400 hops wide, and its stations run together on a page.
    assert width < 200
    assert min(spans(graph)) > 0.2
