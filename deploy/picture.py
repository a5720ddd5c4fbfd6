"""Pictures of maps and of runs, as a paper could print them.

A run is drawn on its map: the colour of a vertex says which robot came first, its shade when. With
more robots than colours the shape of a vertex tells two robots of one colour apart.
"""

import itertools
import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from deploy.layout import Array, layout
from deploy.picture_parts import (
    COLOURS,
    EARLY,
    INK,
    LABEL_PT,
    LEGEND_MOST,
    PALE,
    RED,
    SIZE_IN,
    Box,
    Entry,
    Mark,
    check,
    colour,
    legend,
    mix,
    new_page,
    overlap,
    robot_entries,
    save,
    time_bar,
)
from protocol.graph import PortGraph

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["LEGEND_MOST", "draw_map", "draw_run", "layout"]

SHAPES = ("o", "s", "D", "^")
MAP_BOX = (0.02, 0.03, 0.96, 0.86)
RUN_BOX = (0.02, 0.03, 0.72, 0.86)
WIDEST_PT = 130.0
"""Distance on paper that neighbours are drawn apart at most."""


def draw_map(graph: PortGraph, path: Path, title: str, start: int | None) -> None:
    """Draw a map.

    Args:
        graph: The map.
        path: The picture to write; its suffix (``.png``, ``.svg``, ``.pdf``) tells the format.
        title: Headline, plain text.
        start: A vertex to mark, or ``None``.

    Raises:
        ValueError: If ``start`` is no vertex, or the suffix is unknown.
        OSError: If the picture cannot be written.
    """
    if start is not None:
        check("start", [start], len(graph.names))
    subtitle = f"{len(graph.names)} vertices, {len(graph.ends)} edges"
    sheet = _Sheet(graph, title, subtitle, MAP_BOX)
    everything = range(len(graph.ends))
    sheet.edges(everything, ["#7d8894"] * len(everything), 1.0)
    fills = dict.fromkeys(range(len(graph.names)), "#24476b")
    sheet.vertices(fills, dict.fromkeys(fills, "#24476b"), SHAPES[0])
    if start is not None:
        sheet.start(start)
    save(sheet.figure, path)


def draw_run(
    graph: PortGraph,
    path: Path,
    *,
    title: str,
    subtitle: str,
    start: int,
    first_visits: Mapping[int, tuple[int, float]],
    crossings: Mapping[int, tuple[int, float]],
    lost: Mapping[int, tuple[float, int | None, int | None]],
    team_size: int,
) -> None:
    """Draw who explored what, and when.

    Args:
        graph: The map.
        path: The picture to write; its suffix (``.png``, ``.svg``, ``.pdf``) tells the format.
        title: Headline, plain text.
        subtitle: Second line, plain text.
        start: The vertex to mark as the start.
        first_visits: Robot and virtual time of the first visit, by vertex; the rest is hollow.
        crossings: Robot and virtual time of the first crossing, by edge; the rest is pale.
        lost: Time of the loss, vertex where the robot stood and edge on which it was, by robot;
            with an edge the mark is in its middle, with neither there is only the legend.
        team_size: Number of robots, numbered from 0.

    Raises:
        ValueError: If a vertex, edge or robot is out of range, or the suffix is unknown.
        OSError: If the picture cannot be written.
    """
    vertices, edges = len(graph.names), len(graph.ends)
    check("start", [start], vertices)
    check("first_visits", first_visits, vertices)
    check("first_visits: robot", [robot for robot, _ in first_visits.values()], team_size)
    check("crossings", crossings, edges)
    check("crossings: robot", [robot for robot, _ in crossings.values()], team_size)
    check("lost", lost, team_size)
    check("lost: vertex", [v for _, v, _ in lost.values() if v is not None], vertices)
    check("lost: edge", [e for _, _, e in lost.values() if e is not None], edges)

    sheet = _Sheet(graph, title, subtitle, RUN_BOX)
    sheet.edges([edge for edge in range(edges) if edge not in crossings], "#c4c4c4", 0.8)
    crossed = sorted(crossings)
    sheet.edges(crossed, [colour(crossings[edge][0]) for edge in crossed], 1.6)
    unvisited = dict.fromkeys((v for v in range(vertices) if v not in first_visits), "white")
    sheet.vertices(unvisited, dict.fromkeys(unvisited, PALE), SHAPES[0])
    last = max((time for _, time in first_visits.values()), default=0.0)
    groups: dict[str, dict[int, str]] = defaultdict(dict)
    for vertex, (robot, time) in first_visits.items():
        share = time / last if last > 0 else 1.0
        groups[_shape(robot)][vertex] = mix(colour(robot), EARLY + (1 - EARLY) * share)
    for shape, fills in groups.items():
        sheet.vertices(fills, {v: colour(first_visits[v][0]) for v in fills}, shape)
    sheet.start(start)
    sheet.losses(lost)
    counts = Counter(robot for robot, _ in first_visits.values())
    lost_at = {robot: time for robot, (time, _, _) in lost.items()}
    entries = [
        *robot_entries(
            team_size,
            counts,
            lost_at,
            lambda robot: _mark(_shape(robot), colour(robot), colour(robot)),
        )
    ]
    if unvisited:
        entries.append(Entry("never visited", len(unvisited), mark=_mark(SHAPES[0], "white", PALE)))
    time_bar(sheet.figure, legend(sheet.figure, "vertices", entries), last)
    save(sheet.figure, path)


class _Sheet:
    """A figure with one map on it.

    Attributes:
        figure: The matplotlib figure.
    """

    def __init__(
        self, graph: PortGraph, title: str, subtitle: str, box: tuple[float, float, float, float]
    ) -> None:
        self.figure = new_page(title, subtitle)
        self._graph = graph
        self._points = np.array(layout(graph), dtype=np.float64)
        self._axes: Axes = self.figure.add_axes(box)
        self._axes.set_axis_off()
        self._axes.set_aspect("equal", adjustable="box", anchor="C")
        self._scale_pt = self._frame(box)
        self._diameter_pt = self._vertex_diameter()
        self._lines = _lines(graph, self._points, self._diameter_pt / self._scale_pt)
        self._marks = np.concatenate([self._points, *map(_beads, self._lines)])
        self._taken: list[Box] = []

    def edges(self, edges: Sequence[int], colours: str | Sequence[str], width: float) -> None:
        """Draw edges in colours of their own, ``width`` times as wide as usual."""
        from matplotlib.collections import LineCollection

        usual_pt = min(1.5, max(0.25, 0.22 * self._diameter_pt))
        self._axes.add_collection(
            LineCollection(
                [self._lines[edge] for edge in edges],
                colors=colours,
                linewidths=width * usual_pt,
                capstyle="round",
                zorder=1,
            ),
            autolim=False,
        )

    def vertices(self, fills: Mapping[int, str], rims: Mapping[int, str], shape: str) -> None:
        """Draw vertices of one shape."""
        if not fills:
            return
        chosen = list(fills)
        # Squares and diamonds of the same width look larger than circles.
        diameter_pt = self._diameter_pt * {"o": 1.0, "s": 0.9, "D": 0.85, "^": 1.1}[shape]
        self._axes.scatter(
            self._points[chosen, 0],
            self._points[chosen, 1],
            s=diameter_pt**2,
            c=[fills[vertex] for vertex in chosen],
            edgecolors=[rims[vertex] for vertex in chosen],
            linewidths=min(1.1, max(0.4, 0.16 * self._diameter_pt)),
            marker=shape,
            zorder=2,
        )

    def start(self, vertex: int) -> None:
        """Mark the start with a ring and its name."""
        x, y = self._points[vertex]
        ring_pt = self._diameter_pt + 7
        self._axes.scatter(
            [x], [y], s=ring_pt**2, facecolors="none", edgecolors=INK, linewidths=1.6, zorder=4
        )
        self._label(float(x), float(y), ring_pt / 2, "start", INK)

    def losses(self, lost: Mapping[int, tuple[float, int | None, int | None]]) -> None:
        """Mark each place where robots were lost with a cross that names them."""
        from matplotlib.patheffects import withStroke

        places: dict[tuple[float, float], list[int]] = defaultdict(list)
        for robot, (_, vertex, edge) in sorted(lost.items()):
            if edge is not None:
                line = self._lines[edge]
                x, y = line[len(line) // 2] if len(line) % 2 else line.mean(axis=0)
            elif vertex is not None:
                x, y = self._points[vertex]
            else:
                continue
            places[float(x), float(y)].append(robot)
        size_pt = max(8.0, min(11.0, 1.4 * self._diameter_pt))
        halo = [withStroke(linewidth=5, foreground="white")]
        for x, y in places:
            cx, cy = x * self._scale_pt, y * self._scale_pt
            half_pt = size_pt / 2 + 1
            self._taken.append((cx - half_pt, cy - half_pt, cx + half_pt, cy + half_pt))
            self._axes.plot(
                [x],
                [y],
                marker="x",
                markersize=size_pt,
                markeredgewidth=2.4,
                color=RED,
                path_effects=halo,
                zorder=6,
            )
        for (x, y), robots in places.items():
            names = ", ".join(f"{robot} (t = {lost[robot][0]:g})" for robot in robots)
            noun = "robot" if len(robots) == 1 else "robots"
            self._label(x, y, size_pt / 2, f"{noun} {names}", RED)

    def _frame(self, box: tuple[float, float, float, float]) -> float:
        """Choose the limits of the axes; return points per unit of length."""
        low, high = self._points.min(axis=0), self._points.max(axis=0)
        extent = np.maximum(high - low, 1e-9)
        room_pt = 72 * np.array([SIZE_IN[0] * box[2], SIZE_IN[1] * box[3]]) - 44
        scale_pt = float((room_pt / extent).min())
        nearest = _nearest(self._points)
        if len(nearest):
            # A handful of vertices would look lost at the far corners of the page.
            scale_pt = min(scale_pt, WIDEST_PT / max(float(np.median(nearest)), 1e-9))
        else:
            scale_pt = 1.0
        middle, half = (low + high) / 2, (room_pt + 44) / scale_pt / 2
        self._axes.set_xlim(middle[0] - half[0], middle[0] + half[0])
        self._axes.set_ylim(middle[1] - half[1], middle[1] + half[1])
        return scale_pt

    def _vertex_diameter(self) -> float:
        """Return a diameter in points at which few vertices touch their neighbours."""
        nearest = _nearest(self._points) * self._scale_pt
        spacing_pt = float(np.quantile(nearest, 0.2)) if len(nearest) else 20.0
        return max(2.0, min(11.0, 0.62 * spacing_pt))

    def _label(self, x: float, y: float, clear_pt: float, text: str, colour: str) -> None:
        """Write ``text`` beside a point where it covers least."""
        from matplotlib.patheffects import withStroke

        width, height = 0.56 * LABEL_PT * len(text), 1.15 * LABEL_PT
        anchor = np.array([x, y]) * self._scale_pt
        marks = self._marks * self._scale_pt
        (left, right), (bottom, top) = self._axes.get_xlim(), self._axes.get_ylim()
        frame = np.array([left, bottom, right, top]) * self._scale_pt
        best: tuple[float, tuple[float, float]] | None = None
        for reach in (3.0, 14.0, 28.0):
            for angle in np.arange(0, 2 * math.pi, math.pi / 8):
                out = clear_pt + reach
                dx, dy = float(math.cos(angle)), float(math.sin(angle))
                cx = anchor[0] + dx * (out + width / 2)
                cy = anchor[1] + dy * (out + height / 2)
                low = np.array([cx - width / 2, cy - height / 2])
                high = np.array([cx + width / 2, cy + height / 2])
                inside = ((marks > low - 2) & (marks < high + 2)).all(axis=1).sum()
                outside = (low < frame[:2]).any() or (high > frame[2:]).any()
                over = overlap((low[0], low[1], high[0], high[1]), self._taken)
                cost = float(inside) + 30.0 * over + 100.0 * bool(outside) + 0.1 * reach
                if best is None or cost < best[0]:
                    best = cost, (float(cx), float(cy))
        assert best is not None
        cx, cy = best[1]
        self._taken.append((cx - width / 2, cy - height / 2, cx + width / 2, cy + height / 2))
        gap_pt = math.hypot(
            max(abs(cx - anchor[0]) - width / 2, 0), max(abs(cy - anchor[1]) - height / 2, 0)
        )
        self._axes.annotate(
            text,
            (x, y),
            xytext=(cx / self._scale_pt, cy / self._scale_pt),
            ha="center",
            va="center",
            size=LABEL_PT,
            color=colour,
            weight="bold",
            parse_math=False,
            path_effects=[withStroke(linewidth=2.5, foreground="white")],
            arrowprops={"arrowstyle": "-", "color": colour, "lw": 0.7}
            if gap_pt > clear_pt + 7
            else None,
            zorder=7,
        )


def _lines(graph: PortGraph, points: Array, diameter: float) -> list[Array]:
    """Return the line of each edge: straight, bent where edges are parallel, round for loops.

    Args:
        graph: The map.
        points: Position of each vertex.
        diameter: Diameter of a vertex, in units of the positions.
    """
    alike: dict[tuple[int, int], list[int]] = defaultdict(list)
    for edge, (u, v) in enumerate(graph.ends):
        alike[min(u, v), max(u, v)].append(edge)
    lines: list[Array] = [np.zeros((0, 2))] * len(graph.ends)
    for (u, v), edges in alike.items():
        for rank, edge in enumerate(edges):
            if u == v:
                radius = diameter * (1.0 + 0.5 * rank)
                turn = np.linspace(-math.pi / 2, 1.5 * math.pi, 33)
                circle = np.column_stack([np.cos(turn), 1 + np.sin(turn)])
                lines[edge] = points[u] + radius * circle
            elif len(edges) == 1:
                lines[edge] = points[[u, v]]
            else:
                along = points[v] - points[u]
                aside = np.array([-along[1], along[0]]) * 0.3 * (rank - (len(edges) - 1) / 2)
                share = np.linspace(0, 1, 17)[:, None]
                lines[edge] = points[u] + share * along + 2 * share * (1 - share) * aside
    return lines


def _beads(line: Array) -> Array:
    """Return points along a line, close enough that no label fits between them."""
    share = np.linspace(0, 1, 9)[1:-1, None]
    return np.concatenate([a + share * (b - a) for a, b in itertools.pairwise(line)])


def _nearest(points: Array) -> Array:
    """Return the distance of each point from the nearest other, if there are several points."""
    order = np.argsort(points[:, 0], kind="stable")
    ordered = points[order]
    nearest = np.full(len(points), np.inf)
    # Points beside each other in one coordinate are compared; a window of them is enough to choose
    # a size by, and keeps the time linear.
    for step in range(1, min(len(points), 64)):
        apart = np.hypot(*(ordered[step:] - ordered[:-step]).T)
        nearest[step:] = np.minimum(nearest[step:], apart)
        nearest[:-step] = np.minimum(nearest[:-step], apart)
    known: Array = nearest[np.isfinite(nearest)]
    return known


def _shape(robot: int) -> str:
    """Return the shape of the vertices of a robot."""
    return SHAPES[robot // len(COLOURS) % len(SHAPES)]


def _mark(shape: str, fill: str, rim: str) -> Mark:
    """Return what draws a vertex in the legend."""

    def draw(figure: "Figure", x: float, y: float, size: float) -> None:
        from matplotlib.lines import Line2D

        figure.add_artist(
            Line2D(
                [x],
                [y],
                marker=shape,
                markersize=0.85 * size,
                markerfacecolor=fill,
                markeredgecolor=rim,
                linestyle="none",
            )
        )

    return draw
