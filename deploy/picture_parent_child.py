"""What a picture of parent and child robots shows of the parent: its way, its stops, what it sees.

Paper:
    The parent-child paper, Fig. 8.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from deploy.picture_parts import INK
from protocol.grid import Cell

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

LINE_PT, CIRCLE_PT, STOP_PT = 1.6, 0.6, 6.0
"""Widths of the way and of circles, and size of a stop, on large sub-cells."""


class ParentTrail:
    """Draws the trail of a parent on a map.

    Attributes:
        way: the sub-cells where it was, one after another.
        stops: those where it stayed while children covered.
        reach: how far it sees, sub-cells.
    """

    def __init__(self, way: Sequence[Cell], stops: Sequence[Cell], reach: float) -> None:
        self.way = way
        self.stops = stops
        self.reach = reach

    def __call__(self, axes: "Axes", side_pt: float) -> "Sequence[Artist]":
        """Draw on the axes; return what explains it.

        Args:
            axes: one unit is a sub-cell.
            side_pt: side of a sub-cell on paper.
        """
        from matplotlib.collections import PatchCollection
        from matplotlib.lines import Line2D
        from matplotlib.patches import Circle
        from matplotlib.patheffects import withStroke

        halo = withStroke(linewidth=self._line(side_pt) + 1.2, foreground="white")
        circles = [Circle((x, y), self.reach) for x, y in _middles(self.stops)]
        axes.add_collection(
            PatchCollection(
                circles, facecolors="none", edgecolors=INK, linewidths=CIRCLE_PT, alpha=0.55
            )
        ).set_zorder(3.5)
        way = Line2D([], [], color=INK, linewidth=self._line(side_pt), solid_joinstyle="round")
        way.set_data(*_middles(self.way).T)
        way.set_path_effects([halo])
        way.set_zorder(4)
        axes.add_line(way)
        stops = _square(min(STOP_PT, max(1.5, 0.55 * side_pt)))
        stops.set_data(*_middles(self.stops).T)
        stops.set_zorder(5)
        axes.add_line(stops)
        key = [Line2D([], [], color=INK, linewidth=LINE_PT, label="way of the parent")]
        if self.stops:
            stop, circle = _square(STOP_PT), Line2D([], [], color=INK, linestyle="none")
            stop.set_label("its stops")
            circle.set(marker="o", markersize=9, markerfacecolor="none", label="how far it sees")
            key += [stop, circle]
        return key

    @staticmethod
    def _line(side_pt: float) -> float:
        return min(LINE_PT, max(0.5, 0.16 * side_pt))


def _middles(cells: Sequence[Cell]) -> "np.ndarray[tuple[int, int], np.dtype[np.float64]]":
    """Return the middles of sub-cells, x and y each."""
    return np.array(cells, dtype=np.float64).reshape(-1, 2)[:, ::-1] + 0.5


def _square(size_pt: float) -> "Line2D":
    from matplotlib.lines import Line2D

    return Line2D(
        [],
        [],
        linestyle="none",
        marker="s",
        markersize=size_pt,
        color=INK,
        markeredgecolor="white",
        markeredgewidth=min(0.8, 0.15 * size_pt),
    )
