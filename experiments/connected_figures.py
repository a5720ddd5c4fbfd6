"""Figures of the experiments on connected coverage."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from deploy.picture_parts import COLOURS, GREY, INK
from experiments import plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from experiments.connected import Row

IN_PLACE = "in place"
PAPER_OFFICE = {3: 2.05}
"""Speedup factor by robots that the paper gives for its office as a tree (Sec. 5)."""

STYLES: dict[str, tuple[str, str]] = {
    "NCOCTA": (COLOURS[0], "o"),
    "COCTA": (COLOURS[1], "s"),
    "COCTA, best splits": (COLOURS[2], "^"),
}
"""Colour and mark of each curve; what is in place is dashed."""


def by_robots(rows: Sequence["Row"], path: Path) -> None:
    """Draw speedup factors above coverage times, by the number of robots."""
    _two_lines(rows, path, "robots")


def by_height(rows: Sequence["Row"], path: Path) -> None:
    """Draw speedup factors above coverage times, by the height of the tree."""
    _two_lines(rows, path, "height of the tree")


def by_cuts(rows: Sequence["Row"], path: Path) -> None:
    """Draw speedup factors above coverage times, by the number of vertices removed."""
    _two_lines(rows, path, "vertices removed, with all below")


def office(rows: Sequence["Row"], path: Path) -> None:
    """Draw speedup factors beside coverage times, with what the paper measured."""
    figure = plots.new(7.6, 3.4)
    left, right = figure.subplots(1, 2)
    _curves(left, rows, lambda row: row.speedup)
    left.plot(
        list(PAPER_OFFICE),
        list(PAPER_OFFICE.values()),
        color=INK,
        marker="x",
        linestyle="none",
        label="the paper's office",
    )
    _curves(right, rows, lambda row: row.ticks)
    for axes, name in ((left, "speedup factor"), (right, "coverage time (ticks)")):
        plots.dress(axes, "robots", name, (row.x for row in rows))
        axes.legend(frameon=False, fontsize=7.5)
    plots.save(figure, path)


def graphs(rows: Sequence["Row"], path: Path) -> None:
    """Draw speedup factors, a panel for each graph."""
    names = list(dict.fromkeys(row.panel for row in rows))
    across = min(3, len(names))
    down = -(-len(names) // across)
    figure = plots.new(3.0 * across, 2.6 * down)
    panels = figure.subplots(down, across, squeeze=False).flat
    for axes in panels:
        axes.set_visible(False)
    for axes, name in zip(figure.axes, names, strict=False):
        chosen = [row for row in rows if row.panel == name]
        axes.set_visible(True)
        _curves(axes, chosen, lambda row: row.speedup)
        axes.set_title(f"{name[:28]}, n = {chosen[0].vertices:g}", fontsize=8.5)
        plots.dress(axes, "robots", "speedup factor", {row.x for row in chosen if row.x >= 10})
    figure.axes[0].legend(frameon=False, fontsize=7.5)
    plots.save(figure, path)


def table(rows: Sequence["Row"], path: Path) -> None:
    """Draw measured ticks against those of the specification."""
    figure = plots.new(4.6, 4.2)
    axes = figure.subplots()
    for curve in dict.fromkeys(row.curve for row in rows):
        chosen = [(row.specified or 1, row.ticks or 1) for row in rows if row.curve == curve]
        colour, mark = STYLES[curve.removesuffix(f", {IN_PLACE}")]
        axes.plot(
            [specified for specified, _ in chosen],
            [ticks for _, ticks in chosen],
            label=curve,
            color=colour,
            marker=mark,
            markerfacecolor="white" if curve.endswith(IN_PLACE) else colour,
            linestyle="none",
        )
    largest = max(row.specified or 1 for row in rows)
    axes.plot([1, largest], [1, largest], color=GREY, linewidth=0.8)
    plots.dress(axes, "specified (ticks)", "measured (ticks)", ())
    for scale, limit in ((axes.set_xscale, axes.set_xlim), (axes.set_yscale, axes.set_ylim)):
        scale("log")
        limit(2, 2 * largest)
    axes.legend(frameon=False, fontsize=7.5)
    plots.save(figure, path)


FIGURES: dict[str, Callable[[Sequence["Row"], Path], None]] = {
    "table": table,
    "robots": by_robots,
    "heights": by_height,
    "general": by_cuts,
    "office": office,
    "graphs": graphs,
}
"""By the name of the part."""


def _two_lines(rows: Sequence["Row"], path: Path, x: str) -> None:
    names = list(dict.fromkeys(row.panel for row in rows))
    figure = plots.new(max(4.6, 3.6 * len(names)), 6.0)
    panels = figure.subplots(2, len(names), squeeze=False)
    for at, name in enumerate(names):
        chosen = [row for row in rows if row.panel == name]
        above, below = panels[0][at], panels[1][at]
        _curves(above, chosen, lambda row: row.speedup)
        _curves(below, chosen, lambda row: row.ticks)
        below.plot(
            [row.x for row in chosen],
            [row.lower_bound for row in chosen],
            color=GREY,
            linewidth=0.9,
            linestyle=":",
            label="lower bound",
        )
        above.set_title(name, fontsize=9.5)
        # Where there are many, not every number has room below the axis.
        ticks = sorted({row.x for row in chosen})
        ticks = ticks if len(ticks) <= 8 else [each for each in ticks if each % 20 == 0]
        plots.dress(above, x, "speedup factor", ticks)
        plots.dress(below, x, "coverage time (ticks)", ticks)
    panels[1][0].legend(frameon=False, fontsize=7.5)
    plots.save(figure, path)


def _curves(axes: "Axes", rows: Sequence["Row"], y: Callable[["Row"], float | None]) -> None:
    for curve in dict.fromkeys(row.curve for row in rows):
        chosen = [row for row in rows if row.curve == curve and y(row) is not None]
        colour, mark = STYLES[curve.removesuffix(f", {IN_PLACE}")]
        axes.plot(
            [row.x for row in chosen],
            [y(row) or 0.0 for row in chosen],
            label=curve,
            color=colour,
            marker=mark,
            markersize=3.5,
            linewidth=1.3,
            linestyle=(0, (4, 2)) if curve.endswith(IN_PLACE) else "-",
        )
