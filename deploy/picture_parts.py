"""What pictures have in common: palette, page, legend, scale of time, where a label goes.

Figures are built without pyplot, which would keep every figure and share its state between callers.
"""

import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = (
    "#0072b2",
    "#d55e00",
    "#009e73",
    "#cc79a7",
    "#e69f00",
    "#56b4e9",
    "#882255",
    "#999933",
)
"""Told apart with any common colour blindness (mostly those of Okabe and Ito)."""
INK = "#222222"
GREY = "#555555"
PALE = "#9a9a9a"
RED = "#c00000"
EARLY = 0.12
"""Share of its colour that the earliest visit has; the rest is white. The latest has all."""
SIZE_IN = (10.0, 7.0)
DPI = 150
LEGEND_X = 0.765
LEGEND_MOST = 34
"""Robots that the legend has room for."""
LABEL_PT = 8.5

Box = tuple[float, float, float, float]
"""West, south, east, north."""
Mark = Callable[["Figure", float, float, float], None]
"""Draws around a point of the figure, as high as text of a size in points."""


@dataclass(frozen=True, slots=True)
class Entry:
    """A row of the legend.

    Attributes:
        name: What the mark stands for.
        count: How many of them there are.
        note: What else is to be said, in red.
        mark: Draws the mark.
    """

    name: str
    count: int
    note: str = ""
    mark: "Mark | None" = None


def new_page(title: str, subtitle: str) -> "Figure":
    """Return a figure with its two head lines, plain text."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE_IN, dpi=DPI)
    for text, height, size, weight, colour in (
        (title, 0.955, 14, "bold", INK),
        (subtitle, 0.922, 10, "normal", GREY),
    ):
        figure.text(0.025, height, text, size=size, weight=weight, color=colour, parse_math=False)
    return figure


def save(figure: "Figure", path: Path, dpi: int = DPI) -> None:
    """Write the picture."""
    with warnings.catch_warnings():
        # A name in a script that the font lacks is drawn as boxes; that is no reason to fail.
        warnings.filterwarnings("ignore", message="Glyph .* missing", category=UserWarning)
        figure.savefig(path, dpi=dpi, facecolor="white")


def robot_entries(
    team_size: int,
    counts: Mapping[int, int],
    lost_at: Mapping[int, float],
    mark: Callable[[int], Mark],
) -> Iterator[Entry]:
    """Yield a row for each robot, and one for all that the legend has no room for."""
    for robot in range(min(team_size, LEGEND_MOST)):
        note = f"lost at {lost_at[robot]:g}" if robot in lost_at else ""
        yield Entry(f"robot {robot}", counts.get(robot, 0), note, mark(robot))
    if team_size > LEGEND_MOST:
        rest = sum(counts.get(robot, 0) for robot in range(LEGEND_MOST, team_size))
        yield Entry(f"{team_size - LEGEND_MOST} more", rest)


def legend(figure: "Figure", unit: str, entries: Collection[Entry]) -> float:
    """List who came first, and where, beside the map; return the height at which the list ends."""
    height_in = SIZE_IN[1]
    row = min(0.3, 5.0 / max(1, len(entries))) / height_in
    size = min(9.5, row * height_in * 72 * 0.62)
    y = 0.87
    figure.text(LEGEND_X, y, "First visitor", size=10, weight="bold", color=INK)
    figure.text(0.975, y, unit, size=9, color=GREY, ha="right")
    for entry in entries:
        y -= row
        if entry.mark is not None:
            entry.mark(figure, LEGEND_X + 0.008, y + 0.36 * size / 72 / height_in, size)
        figure.text(LEGEND_X + 0.024, y, entry.name, size=size, color=INK)
        if entry.note:
            room = (0.975 - LEGEND_X - 0.1) * 72 * SIZE_IN[0] - 0.65 * size * len(str(entry.count))
            note_size = min(0.88 * size, room / (0.56 * len(entry.note)))
            figure.text(LEGEND_X + 0.094, y, entry.note, size=note_size, color=RED)
        figure.text(0.975, y, str(entry.count), size=size, color=INK, ha="right")
    return y


def time_bar(figure: "Figure", top: float, last: float) -> None:
    """Draw the scale of shades under the legend, in grey as it holds for every colour."""
    from matplotlib.colors import LinearSegmentedColormap

    shades = [mix("#404040", EARLY), "#404040"]
    axes = figure.add_axes((LEGEND_X, max(0.07, top - 0.1), 0.21, 0.022))
    axes.imshow(
        np.linspace(0, 1, 256)[None, :],
        aspect="auto",
        extent=(0.0, last or 1.0, 0.0, 1.0),
        cmap=LinearSegmentedColormap.from_list("time", shades),
    )
    axes.set_yticks([])
    axes.set_title("time of first visit", size=9, color=INK, loc="left", pad=4)
    axes.tick_params(labelsize=8, length=2.5, colors=GREY)
    axes.locator_params(axis="x", nbins=5)
    for spine in axes.spines.values():
        spine.set_linewidth(0.6)
        spine.set_color("#888888")


def overlap(box: Box, others: Iterable[Box]) -> int:
    """Count the boxes that a box overlaps."""
    left, bottom, right, top = box
    return sum(
        left < east and west < right and bottom < north and south < top
        for west, south, east, north in others
    )


def colour(robot: int) -> str:
    """Return the colour of a robot."""
    return COLOURS[robot % len(COLOURS)]


def mix(colour: str, share: float) -> str:
    """Mix ``share`` of a colour with white."""
    parts = (int(colour[at : at + 2], 16) for at in (1, 3, 5))
    return "#" + "".join(f"{round(255 + (part - 255) * share):02x}" for part in parts)


def check(parameter: str, found: Iterable[int], below: int) -> None:
    """Refuse numbers that are not of a vertex, edge or robot."""
    for number in found:
        if not 0 <= number < below:
            raise ValueError(f"{parameter}: found {number}, expected 0 to {below - 1}")
