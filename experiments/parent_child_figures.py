"""Figures of the experiments on parent and child robots."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deploy.picture_parts import COLOURS, GREY, INK, mix
from experiments import plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from experiments.parent_child import Row

BAR = 0.72
"""Width of a bar; children are one apart."""
RING: dict[str, Any] = {"marker": "o", "markersize": 11, "markerfacecolor": "none"}
"""Goes around the least point of a curve."""
TICKS: dict[str, Any] = {"marker": ".", "markersize": 4, "linewidth": 0.9, "linestyle": (0, (4, 2))}
"""How the ticks that robots need are drawn, beside the steps as the paper counts them."""


def figure5(rows: Sequence["Row"], path: Path) -> None:
    """Draw time steps by the number of children, a curve for each share of obstacles."""
    from matplotlib.lines import Line2D

    figure = plots.new(6.0, 4.2)
    axes = figure.subplots()
    for at, ratio in enumerate(dict.fromkeys(row.ratio for row in rows)):
        curve = [row for row in rows if row.ratio == ratio]
        shift = 0.06 * (at - 1)
        name = f"{100 * ratio:g} % obstructed"
        _curve(axes, at, [row.children + shift for row in curve], curve, name)
        least = min(curve, key=lambda row: row.steps)
        axes.plot(least.children + shift, least.steps, color=COLOURS[at], linestyle="none", **RING)
    plots.dress(axes, "child robots", "time steps", (row.children for row in rows))
    handles, names = axes.get_legend_handles_labels()
    ring = Line2D([], [], color=GREY, linestyle="none", **RING)
    axes.legend([*handles, ring], [*names, "fewest"], frameon=False, fontsize=8.5)
    plots.save(figure, path)


def teams(rows: Sequence["Row"], path: Path) -> None:
    """Draw time steps by the number of teams, a curve for each number of children."""
    figure = plots.new(6.0, 4.2)
    axes = figure.subplots()
    for at, children in enumerate(dict.fromkeys(row.children for row in rows)):
        curve = [row for row in rows if row.children == children]
        _curve(axes, at, [row.teams for row in curve], curve, f"time steps, {children} children")
        axes.plot(
            [row.teams for row in curve],
            [row.ticks for row in curve],
            color=COLOURS[at],
            label=f"ticks of robots, {children} children",
            **TICKS,
        )
    plots.dress(axes, "teams", "time steps", (row.teams for row in rows))
    axes.legend(frameon=False, fontsize=8.5)
    plots.save(figure, path)


def figure6(rows: Sequence["Row"], path: Path) -> None:
    """Draw what time steps are spent on, a panel for each share of obstacles."""
    _divided(rows, path, lambda row: f"{100 * row.ratio:g} % obstructed")


def figure7(rows: Sequence["Row"], path: Path) -> None:
    """Draw what time steps are spent on, a panel for each line-of-sight radius."""
    _divided(rows, path, lambda row: f"line of sight {row.r_los_m:g} m")


FIGURES = {"figure5": figure5, "figure6": figure6, "figure7": figure7, "teams": teams}
"""By the name of the part."""


def _curve(axes: "Axes", at: int, where: Sequence[float], rows: Sequence["Row"], name: str) -> None:
    """Draw the steps of some plans, and how far they spread over the maps."""
    axes.errorbar(
        where,
        [row.steps for row in rows],
        yerr=[row.steps_sd for row in rows],
        label=name,
        color=COLOURS[at],
        marker=plots.MARKS[at],
        markersize=4.5,
        linewidth=1.4,
        elinewidth=0.9,
        capsize=2.5,
        zorder=3,
    )


def _divided(rows: Sequence["Row"], path: Path, name_of: Callable[["Row"], str]) -> None:
    names = list(dict.fromkeys(map(name_of, rows)))
    figure = plots.new(3.3 * len(names), 3.6)
    panels = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    for axes, name in zip(panels, names, strict=True):
        _bars(axes, [row for row in rows if name_of(row) == name])
        axes.set_title(name, size=10, color=INK, loc="left")
        label = "time steps" if axes is panels[0] else ""
        plots.dress(axes, "child robots", label, (row.children for row in rows))
    panels[-1].legend(frameon=False, fontsize=8)
    plots.save(figure, path)


def _bars(axes: "Axes", rows: Sequence["Row"]) -> None:
    """Draw bars: coordination below, coverage upon it; the least one is outlined."""
    children = [row.children for row in rows]
    coordination = [row.coordination for row in rows]
    axes.bar(
        children,
        [row.coverage for row in rows],
        BAR,
        bottom=coordination,
        color=mix(COLOURS[0], 0.35),
        label="coverage",
    )
    axes.bar(children, coordination, BAR, color=COLOURS[0], label="coordination")
    least = min(rows, key=lambda row: row.steps)
    axes.bar(
        least.children,
        least.steps,
        BAR,
        facecolor="none",
        edgecolor=INK,
        linewidth=1.2,
        label="fewest steps",
    )
    of_paper = [row for row in rows if row.children == row.paper.get("fewest_with")]
    axes.plot(
        [row.children for row in of_paper],
        [row.steps + 250 for row in of_paper],
        color=INK,
        marker="v",
        markersize=5,
        linestyle="none",
        label="fewest in the paper",
    )
    axes.plot(
        children,
        [row.ticks for row in rows],
        color=COLOURS[1],
        label="ticks of robots",
        **TICKS,
    )
