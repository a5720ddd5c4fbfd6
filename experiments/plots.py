"""Figures of the experiments on ORMSTC, as a paper could print them.

Figures are built without pyplot, which would keep every figure and share its state between callers.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from deploy.picture_parts import COLOURS, GREY, INK, PALE
from experiments.ormstc import BASELINE, PUBLISHED, Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 200
MARKS = ("o", "s", "^", "D")
FAINT = "#e6e6e6"


def figure13(rows: Sequence[Row], path: Path) -> None:
    """Draw the coverage time against the number of robots, a curve for each map."""
    figure = new(6.0, 4.2)
    axes = figure.subplots()
    names = dict.fromkeys(str(row.labels["map"]) for row in rows)
    for number, name in enumerate(names):
        of_map = [row for row in rows if row.labels["map"] == name]
        _curve(axes, of_map, name, number, shift=0.09 * (number - (len(names) - 1) / 2))
        _even_share(axes, of_map, COLOURS[number])
    dress(axes, "robots", "coverage time (ticks)", (int(row.labels["robots"]) for row in rows))
    _legend(axes)
    save(figure, path)


def options(rows: Sequence[Row], path: Path) -> None:
    """Draw what each option does to coverage time, extra visits and completeness."""
    figure = new(7.4, 0.5 + 0.235 * len(rows) + 0.45)
    panels = figure.subplots(1, 3, sharey=True, width_ratios=(2.2, 1, 1))
    heights = range(len(rows), 0, -1)
    base = next(row for row in rows if row.labels["option"] == BASELINE)
    titles = ("coverage time (ticks)", "extra visits (%)", "covered (%)")
    base_values = (base.coverage_time, base.extra_percent, base.covered_percent)
    for axes, title, base_value in zip(panels, titles, base_values, strict=True):
        axes.axvline(base_value, color=PALE, linewidth=0.8, linestyle=(0, (4, 3)), zorder=1)
        axes.set_xlabel(title, size=9, color=INK)
        axes.grid(axis="y", color=FAINT, linewidth=0.6)
        axes.tick_params(labelsize=8, colors=GREY, length=2.5)
        axes.tick_params(axis="y", length=0)
        _frame(axes)
        axes.spines["left"].set_visible(False)
    for row, height in zip(rows, heights, strict=True):
        whole = row.complete == row.runs
        colour = COLOURS[0] if whole else COLOURS[1]
        face = colour if whole else "white"
        marks = {"color": colour, "markerfacecolor": face, "markersize": 5, "marker": "o"}
        panels[0].errorbar(
            row.coverage_time,
            height,
            xerr=row.coverage_time_sd,
            capsize=2.5,
            elinewidth=1.0,
            linestyle="none",
            **marks,
        )
        panels[1].plot(row.extra_percent, height, **marks)
        panels[2].plot(row.covered_percent, height, clip_on=False, **marks)
        if not whole:
            panels[2].annotate(
                f"{row.complete} of {row.runs}",
                (row.covered_percent, height),
                textcoords="offset points",
                xytext=(6, 0) if row.covered_percent < 60 else (-6, 0),
                ha="left" if row.covered_percent < 60 else "right",
                va="center",
                fontsize=7.5,
                color=GREY,
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8},
            )
    panels[0].set_yticks(list(heights), [str(row.labels["option"]) for row in rows])
    for label in panels[0].get_yticklabels():
        label.set_color(INK)
        label.set_fontsize(8.5)
    panels[0].set_xlim(left=0)
    panels[1].set_xlim(left=-2)
    panels[2].set_xlim(min(40, *(row.covered_percent - 5 for row in rows)), 102)
    marks = {"marker": "o", "linestyle": "none", "markersize": 5}
    handles = [
        panels[0].plot([], [], color=COLOURS[0], label="all runs complete", **marks)[0],
        panels[0].plot(
            [],
            [],
            color=COLOURS[1],
            markerfacecolor="white",
            label="not all complete; how many",
            **marks,
        )[0],
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=2, frameon=False, fontsize=8.5)
    save(figure, path)


def losses(rows: Sequence[Row], path: Path) -> None:
    """Draw coverage time without and with losses, and extra visits, beside the specification's."""
    figure = new(7.8, 3.2)
    panels = figure.subplots(1, 3)
    unharmed = [row for row in rows if row.labels["losses"] == 0]
    _curve(panels[0], unharmed, "measured", 0)
    _published(
        panels[0],
        {robots: each.coverage_time for (robots, lost), each in PUBLISHED.items() if not lost},
    )
    dress(
        panels[0],
        "robots, none lost",
        "coverage time (ticks)",
        (int(row.labels["robots"]) for row in unharmed),
    )
    most = max(robots for robots, lost in PUBLISHED if lost)
    harmed = {lost: each for (robots, lost), each in PUBLISHED.items() if robots == most}
    for number, lazy in enumerate((True, False)):
        of_team = [
            row
            for row in rows
            if row.labels["robots"] == most
            and (row.labels["lazy"] == lazy or not row.labels["losses"])
        ]
        name = "lazy" if lazy else "not lazy"
        shift = 0.18 * (2 * number - 1)
        _curve(panels[1], of_team, name, number, x="losses", shift=shift)
        _curve(panels[2], of_team, name, number, x="losses", y="extra_percent", shift=shift)
    _published(panels[1], {lost: each.coverage_time for lost, each in harmed.items()})
    extra = {lost: each.extra_percent for lost, each in harmed.items()}
    _published(panels[2], {lost: share for lost, share in extra.items() if share is not None})
    for axes, name in zip(panels[1:], ("coverage time (ticks)", "extra visits (%)"), strict=True):
        dress(axes, f"lost, of {most} robots", name, harmed)
    for axes in panels[:2]:
        _legend(axes)
    save(figure, path)


def helping(rows: Sequence[Row], path: Path) -> None:
    """Draw the coverage time with and without helping, for scattered and for clustered starts."""
    figure = new(7.0, 3.4)
    kinds = list(dict.fromkeys(str(row.labels["starts"]) for row in rows))
    panels = figure.subplots(1, len(kinds), sharey=True, squeeze=False)[0]
    for axes, kind in zip(panels, kinds, strict=True):
        of_kind = [row for row in rows if row.labels["starts"] == kind]
        variants = dict.fromkeys(str(row.labels["variant"]) for row in of_kind)
        for number, variant in enumerate(variants):
            curve = [row for row in of_kind if row.labels["variant"] == variant]
            _curve(axes, curve, variant, number, shift=0.14 * (number - 0.5))
        _even_share(axes, [row for row in of_kind if row.labels["variant"] == "corrected"], PALE)
        axes.set_title(f"{kind} starts", size=10, color=INK, loc="left")
    for axes in panels:
        label = "coverage time (ticks)" if axes is panels[0] else ""
        dress(axes, "robots", label, (int(row.labels["robots"]) for row in rows))
    _legend(panels[0])
    save(figure, path)


FIGURES = {"figure13": figure13, "options": options, "losses": losses, "helping": helping}
"""By the name of the part."""


def new(width: float, height: float) -> "Figure":
    """Return an empty figure, inches."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    layout = ConstrainedLayoutEngine(wspace=0.06)
    return Figure(figsize=(width, height), dpi=DPI, layout=layout)


def save(figure: "Figure", path: Path) -> None:
    """Write a figure."""
    figure.savefig(path, facecolor="white", metadata={"Software": None})


def _curve(
    axes: "Axes",
    rows: Sequence[Row],
    name: str,
    number: int,
    *,
    x: str = "robots",
    y: str = "coverage_time",
    shift: float = 0.0,
) -> None:
    """Draw means, with a standard deviation to each side where there is one."""
    axes.errorbar(
        [int(row.labels[x]) + shift for row in rows],
        [getattr(row, y) for row in rows],
        yerr=[row.coverage_time_sd for row in rows] if y == "coverage_time" else None,
        label=name,
        color=COLOURS[number],
        marker=MARKS[number],
        markersize=4.5,
        linewidth=1.4,
        elinewidth=0.9,
        capsize=3,
        zorder=3,
    )


def _even_share(axes: "Axes", rows: Sequence[Row], colour: str) -> None:
    """Draw what the coverage time would be if the work were shared evenly."""
    axes.plot(
        [int(row.labels["robots"]) for row in rows],
        [row.even_share for row in rows],
        color=colour,
        linewidth=0.9,
        linestyle=(0, (4, 3)),
        zorder=2,
    )


def _legend(axes: "Axes") -> None:
    """List the curves in their order, then what there is besides."""
    from matplotlib.container import ErrorbarContainer
    from matplotlib.lines import Line2D

    handles, names = axes.get_legend_handles_labels()
    entries = sorted(
        zip(handles, names, strict=True),
        key=lambda each: not isinstance(each[0], ErrorbarContainer),
    )
    if any(line.get_linestyle() == "--" for line in axes.get_lines()):
        dashes = Line2D([], [], color=PALE, linewidth=0.9, linestyle=(0, (4, 3)))
        entries.append((dashes, "work shared evenly"))
    axes.legend(
        [handle for handle, _ in entries],
        [name for _, name in entries],
        frameon=False,
        fontsize=8.5,
    )


def _published(axes: "Axes", values: Mapping[int, float]) -> None:
    axes.plot(
        list(values),
        list(values.values()),
        color=INK,
        marker="x",
        markersize=6,
        markeredgewidth=1.3,
        linestyle="none",
        label="specification",
        zorder=4,
    )


def dress(axes: "Axes", x: str, y: str, ticks: Iterable[int]) -> None:
    """Name the axes, and give them ticks and a grid."""
    axes.set_xlabel(x, size=9.5, color=INK)
    axes.set_ylabel(y, size=9.5, color=INK)
    axes.set_xticks(sorted(set(ticks)))
    axes.set_ylim(bottom=0)
    axes.grid(axis="y", color=FAINT, linewidth=0.6)
    axes.tick_params(labelsize=8.5, colors=GREY, length=2.5)
    _frame(axes)


def _frame(axes: "Axes") -> None:
    axes.set_axisbelow(True)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color("#888888")
        spine.set_linewidth(0.7)
