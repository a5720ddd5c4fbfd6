"""Pictures of grids and of runs on them, as a paper could print them.

A run is drawn on its grid: the colour of a sub-cell says which robot came first, its shade when. With
more robots than colours a texture tells two robots of one colour apart. What a team left undone is
hatched in red.

Sub-cells are painted pixel by pixel, each a square of whole pixels, so that a grid of a quarter of a
million costs little more than one of thirty-six, and every pixel can be tested.
"""

import itertools
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from deploy.grid_pixels import (
    ALARM,
    SHADED,
    WALL,
    Mask,
    Numbers,
    Pixels,
    enlarged,
    paint_map,
    paint_run,
    rgb,
)
from deploy.picture_parts import (
    GREY,
    INK,
    LABEL_PT,
    PALE,
    RED,
    SIZE_IN,
    Box,
    Entry,
    Mark,
    check,
    colour,
    legend,
    new_page,
    overlap,
    robot_entries,
    save,
    time_bar,
)
from protocol.grid import Cell, Grid

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_grid", "draw_grid_run"]

MAP_BOX = (0.06, 0.11, 0.975, 0.89)
RUN_BOX = (0.06, 0.11, 0.735, 0.89)
WIDEST_PT = 56.0
"""Side of a sub-cell on paper at most."""
COARSE_DPI, FINE_DPI, MOST_DPI = 150, 280, 420
"""Resolution with sub-cells of many pixels, of few, and of one."""
MANY_EDGES = 5000
"""From here on edges are pixels also in a drawing made of lines."""
MOST_RINGS = 200
"""Patches of missed sub-cells that are kept in view; more are seen anyway."""

Overlay = Callable[["Axes", float], "Sequence[Artist]"]
"""Draws on a map whose sub-cells have a side of so many points; returns what explains it."""


def draw_grid(grid: Grid, path: Path, title: str) -> None:
    """Draw a grid.

    Args:
        grid: The grid.
        path: The picture to write; its suffix (``.png``, ``.svg``, ``.pdf``) tells the format.
        title: Headline, plain text.

    Raises:
        ValueError: If the suffix is unknown.
        OSError: If the picture cannot be written.
    """
    blocked = _blocked(grid)
    whole = _whole(blocked)
    partly = ~blocked & ~whole
    unit = "" if grid.cell_m == 1 else f" of {grid.cell_m:g} m"
    subtitle = (
        f"{grid.rows} x {grid.cols} sub-cells{unit}, {int((~blocked).sum())} free; "
        f"{int(whole.sum()) // 4} complete coarse cells"
    )
    sheet = _Sheet(grid, title, subtitle, MAP_BOX)
    sheet.cells(paint_map(blocked, partly, sheet.px, sheet.px_a_pt))
    handles = [_patch("white", "free")]
    if partly.any():
        handles.append(_patch(SHADED, "free, in a partly blocked coarse cell"))
    sheet.key([*handles, _patch(WALL, "blocked")])
    save(sheet.figure, path, sheet.dpi)


def draw_grid_run(
    grid: Grid,
    path: Path,
    *,
    title: str,
    subtitle: str,
    starts: Sequence[Cell],
    first_visits: Mapping[int, tuple[int, float]],
    owners: Mapping[Cell, int],
    edges: Sequence[tuple[Cell, Cell, int]],
    lost: Mapping[int, tuple[float, int | None]],
    stopped: Mapping[int, int],
    team_size: int,
    parents: int = 0,
    overlay: Overlay | None = None,
) -> None:
    """Draw who covered what, and when.

    A free sub-cell that nobody visited is hatched in red if the team could be expected there, else in
    grey. It could if a robot can get there from a start, with owners or tree edges by way of complete
    coarse cells only; or if a robot owns the coarse cell.

    Args:
        grid: The grid.
        path: The picture to write; its suffix (``.png``, ``.svg``, ``.pdf``) tells the format.
        title: Headline, plain text.
        subtitle: Second line, plain text.
        starts: Sub-cell in which each robot starts.
        first_visits: Robot and virtual time of the first visit, by place.
        owners: Robot that owns a coarse cell at the end; borders are drawn between owners.
        edges: Tree edges: two coarse cells, and the robot whose tree it is.
        lost: Time of the loss, and place where the body lies, by robot; without a place there is
            only the legend.
        stopped: Place where a robot stopped, by robot.
        team_size: Number of robots, numbered from 0.
        parents: So many of the first ones cover nothing, and are not listed unless they were lost.
        overlay: Draws more upon what was covered.

    Raises:
        ValueError: If a place is not free, a coarse cell or robot is out of range, or the suffix is
            unknown.
        OSError: If the picture cannot be written.
    """
    bodies = {robot: place for robot, (_, place) in lost.items() if place is not None}
    for start in starts:
        if not grid.is_free(*start):
            raise ValueError(f"starts: found {start}, expected a free sub-cell")
    _check_free(grid, "first_visits", first_visits)
    _check_free(grid, "lost: place", bodies.values())
    _check_free(grid, "stopped: place", stopped.values())
    _check_coarse(grid, "owners", owners)
    _check_coarse(grid, "edges", (cell for one, other, _ in edges for cell in (one, other)))
    check("starts: robot", range(len(starts)), team_size)
    check("first_visits: robot", (robot for robot, _ in first_visits.values()), team_size)
    check("owners: robot", owners.values(), team_size)
    check("edges: robot", (robot for _, _, robot in edges), team_size)
    check("lost", lost, team_size)
    check("stopped", stopped, team_size)

    robots = np.full((grid.rows, grid.cols), -1, dtype=np.int64)
    shares = np.zeros(robots.shape)
    at = np.divmod(np.fromiter(first_visits, np.int64, len(first_visits)), grid.stride)
    robots[at] = [robot for robot, _ in first_visits.values()]
    last = max((time for _, time in first_visits.values()), default=0.0)
    shares[at] = [time / last if last > 0 else 1.0 for _, time in first_visits.values()]
    unvisited = ~_blocked(grid) & (robots < 0)
    missed = unvisited & _expected(grid, starts, owners, cells=bool(owners or edges))

    sheet = _Sheet(grid, title, subtitle, RUN_BOX)
    sheet.cells(paint_run(_blocked(grid), robots, shares, missed, sheet.px, sheet.px_a_pt))
    sheet.edges(edges)
    sheet.borders(owners)
    sheet.rings(missed)
    explained = [] if overlay is None else sheet.overlaid(overlay)
    lost_at = {robot: time for robot, (time, _) in lost.items()}
    sheet.marks(
        _together(enumerate(starts)),
        _together((robot, grid.position(place)) for robot, place in stopped.items()),
        _together((robot, grid.position(place)) for robot, place in bodies.items()),
        lost_at,
    )

    counts = Counter(robot for robot, _ in first_visits.values())
    listed = enumerate(robot_entries(team_size, counts, lost_at, sheet.robot_swatch))
    entries = [entry for robot, entry in listed if robot >= parents or robot in lost]
    for name, mask, is_missed in (
        ("not covered", missed, True),
        ("out of reach", unvisited & ~missed, False),
    ):
        if count := int(mask.sum()):
            entries.append(Entry(name, count, mark=sheet.unvisited_swatch(missed=is_missed)))
    time_bar(sheet.figure, legend(sheet.figure, "sub-cells", entries), last)
    signs = [
        (starts, _sign("start", GREY, "o")),
        (stopped, _sign("stop", GREY, "s", "white")),
        (bodies, _sign("lost", RED, "x")),
        (edges, _sign("tree edge", GREY, width=1.6)),
        (owners, _sign("border between owners", INK, width=0.8)),
    ]
    sheet.key([*(handle for present, handle in signs if present), *explained])
    save(sheet.figure, path, sheet.dpi)


# Paper --------------------------------------------------------------------------------------------


class _Sheet:
    """A figure with one grid on it.

    Positions are columns and rows on the map, to the right and down; sizes are points on paper.

    Attributes:
        figure: The matplotlib figure.
        dpi: Its resolution, at which the side of a sub-cell is a whole number of pixels.
        px: That number.
        px_a_pt: Pixels of the cells a point.
    """

    def __init__(self, grid: Grid, title: str, subtitle: str, box: Box) -> None:
        self.figure = new_page(title, subtitle)
        self._grid = grid
        page_width, page_height = SIZE_IN
        west, south = box[0] * page_width, box[1] * page_height
        room = (box[2] - box[0]) * page_width, (box[3] - box[1]) * page_height
        an_inch = max(grid.cols / room[0], grid.rows / room[1], 72 / WIDEST_PT)
        self.px = math.ceil((COARSE_DPI if an_inch < COARSE_DPI / 8 else FINE_DPI) / an_inch)
        self.dpi = min(MOST_DPI, math.ceil(self.px * an_inch))
        # A grid of more sub-cells than the paper has pixels is drawn coarser than it is painted.
        side_in = min(self.px / self.dpi, 1 / an_inch)
        self._side_pt = 72 * side_in
        self.px_a_pt = self.px / self._side_pt
        width, height = grid.cols * side_in, grid.rows * side_in
        # On whole pixels, or the cells would be sampled anew.
        left = round((west + (room[0] - width) / 2) * self.dpi) / self.dpi
        bottom = round((south + (room[1] - height) / 2) * self.dpi) / self.dpi
        self._map_in = (left, bottom, left + width, bottom + height)
        self._axes = self.figure.add_axes(
            (left / page_width, bottom / page_height, width / page_width, height / page_height)
        )
        self._axes.set_xlim(0, grid.cols)
        self._axes.set_ylim(grid.rows, 0)
        self._swatches: Axes | None = None
        self._taken: list[Box] = []
        self._ticks()
        if grid.cell_m != 1:
            self._scale_bar()

    # What lies on the map.

    def cells(self, pixels: Pixels) -> None:
        """Draw the sub-cells."""
        is_whole = self.dpi < MOST_DPI
        self._axes.imshow(
            pixels,
            extent=(0, self._grid.cols, self._grid.rows, 0),
            interpolation="none" if is_whole else "antialiased",
            aspect="auto",
            zorder=0,
        )

    def edges(self, edges: Sequence[tuple[Cell, Cell, int]]) -> None:
        """Draw tree edges from centre to centre of coarse cells."""
        ends = np.array([edge[:2] for edge in edges], dtype=np.float64).reshape(-1, 2, 2)
        inks = {robot: rgb(_ink(robot)) for robot in {robot for _, _, robot in edges}}
        colours = np.array([inks[robot] for _, _, robot in edges], dtype=np.float64) / 255
        width_pt = min(2.2, max(0.3, 0.16 * self._side_pt))
        self._lines(2 * ends[..., ::-1] + 1, colours.reshape(-1, 3), width_pt)

    def borders(self, owners: Mapping[Cell, int]) -> None:
        """Draw a line where coarse cells of two owners meet."""
        lines = []
        for (row, col), robot in owners.items():
            if owners.get((row, col + 1), robot) != robot:
                lines.append(((col + 1, row), (col + 1, row + 1)))
            if owners.get((row + 1, col), robot) != robot:
                lines.append(((col, row + 1), (col + 1, row + 1)))
        ends = 2.0 * np.array(lines, dtype=np.float64).reshape(-1, 2, 2)
        self._lines(ends, INK, min(1.4, max(0.5, 0.1 * self._side_pt)))

    def overlaid(self, overlay: Overlay) -> "Sequence[Artist]":
        """Draw what the caller has to show; return what explains it."""
        return overlay(self._axes, self._side_pt)

    def rings(self, missed: Mask) -> None:
        """Keep small patches of missed sub-cells in view, and put rings around the smallest."""
        small = (patch for patch in _patches(missed) if self._size_pt(patch) < 24)
        for west, north, east, south in itertools.islice(small, MOST_RINGS):
            at = ((west + east) / 2, (north + south) / 2)
            size_pt = self._size_pt((west, north, east, south))
            self._take(at, size_pt / 2 + 1)
            if size_pt < 8:
                self._dot(at, "o", size_pt + 9, face="none", rim=ALARM, zorder=5)
                self._take(at, size_pt / 2 + 5)

    def marks(
        self,
        starts: Mapping[Cell, Sequence[int]],
        stops: Mapping[Cell, Sequence[int]],
        bodies: Mapping[Cell, Sequence[int]],
        lost_at: Mapping[int, float],
    ) -> None:
        """Mark where robots started, stopped and were lost, with their numbers if there is room.

        Args:
            starts: Robots that started in a sub-cell.
            stops: Robots that stopped in a sub-cell.
            bodies: Robots that were lost in a sub-cell.
            lost_at: When robots were lost.
        """
        from matplotlib.patheffects import withStroke

        cross_pt = max(7.0, min(13.0, 0.5 * self._side_pt))
        for cell in bodies:
            at = _middle(cell)
            self._take(at, cross_pt / 2 + 1)
            self._axes.plot(
                *at,
                marker="x",
                markersize=cross_pt,
                markeredgewidth=2.2,
                color=RED,
                path_effects=[withStroke(linewidth=4.6, foreground="white")],
                zorder=8,
            )
        for cell in (*starts, *stops):
            self._take(_middle(cell), 2.0)
        for cell, robots in starts.items():
            self._tag(cell, robots, "o")
        for cell, robots in stops.items():
            self._tag(cell, robots, "s")
        for cell, robots in bodies.items():
            times = ", ".join(f"{robot} (t = {lost_at[robot]:g})" for robot in robots)
            noun = "robot" if len(robots) == 1 else "robots"
            self._cross_label(cell, cross_pt, (f"{noun} {times}", _numbers(robots)))

    # What lies beside it.

    def key(self, handles: "Sequence[Artist]") -> None:
        """Explain the signs in a line under the map."""
        if handles:
            self.figure.legend(
                handles=handles,
                loc="lower left",
                bbox_to_anchor=(0.015, 0.002),
                ncols=len(handles),
                frameon=False,
                fontsize=8.5,
                labelcolor=INK,
                handletextpad=0.5,
                columnspacing=1.6,
            )

    def robot_swatch(self, robot: int) -> Mark:
        """Return what draws the colour of a robot in the legend, from early to late."""

        def draw(_figure: "Figure", x: float, y: float, size: float) -> None:
            width, height = self._swatch_px(size)
            robots = np.full((height, width), robot, dtype=np.int64)
            shares = np.broadcast_to(np.linspace(0, 1, width), robots.shape)
            nowhere = np.zeros(robots.shape, dtype=np.bool_)
            pixels = paint_run(nowhere, robots, shares, nowhere, 1, self.px_a_pt)
            self._swatch(x, y, pixels, colour(robot))

        return draw

    def unvisited_swatch(self, *, missed: bool) -> Mark:
        """Return what draws an unvisited sub-cell in the legend."""

        def draw(_figure: "Figure", x: float, y: float, size: float) -> None:
            width, height = self._swatch_px(size)
            nobody = np.full((height, width), -1, dtype=np.int64)
            nowhere = np.zeros(nobody.shape, dtype=np.bool_)
            everywhere = np.full(nobody.shape, missed, dtype=np.bool_)
            shares = np.zeros(nobody.shape)
            pixels = paint_run(nowhere, nobody, shares, everywhere, 1, self.px_a_pt)
            self._swatch(x, y, pixels, ALARM if missed else PALE)

        return draw

    def _swatch_px(self, size: float) -> tuple[int, int]:
        return round(12.5 * self.px_a_pt), max(1, round(0.85 * size * self.px_a_pt))

    def _swatch(self, x: float, y: float, pixels: Pixels, rim: str) -> None:
        """Draw a swatch that begins a little left of ``x``, in a frame."""
        from matplotlib.patches import Rectangle

        if self._swatches is None:
            self._swatches = self.figure.add_axes((0, 0, 1, 1))
            self._swatches.set_axis_off()
            self._swatches.set_autoscale_on(False)
        width = pixels.shape[1] / self.px_a_pt / 72 / SIZE_IN[0]
        height = pixels.shape[0] / self.px_a_pt / 72 / SIZE_IN[1]
        left, bottom = x - 0.008, y - height / 2
        self._swatches.imshow(
            pixels,
            extent=(left, left + width, bottom, bottom + height),
            interpolation="none",
            aspect="auto",
        )
        self._swatches.add_patch(
            Rectangle((left, bottom), width, height, fill=False, edgecolor=rim, linewidth=0.7)
        )

    def _ticks(self) -> None:
        """Number rows and columns lightly."""
        axes, grid = self._axes, self._grid
        for axis, count, room_pt in ((axes.xaxis, grid.cols, 30.0), (axes.yaxis, grid.rows, 22.0)):
            step = _round_up(room_pt / self._side_pt)
            numbers = range(0, count, step)
            axis.set_ticks([number + 0.5 for number in numbers], [str(n) for n in numbers])
        axes.tick_params(labelsize=7.5, length=2.0, width=0.5, pad=2, colors="#888888")
        axes.set_xlabel("column", loc="left", size=8, color="#888888", labelpad=2)
        axes.set_ylabel("row", loc="top", size=8, color="#888888", labelpad=2)
        for spine in axes.spines.values():
            spine.set_linewidth(0.6)
            spine.set_color("#888888")

    def _scale_bar(self) -> None:
        """Draw a length in metres under the map."""
        from matplotlib.lines import Line2D

        left, bottom, right, _ = self._map_in
        m_an_inch = self._grid.cell_m * 72 / self._side_pt
        length_m = _round_down(max(0.6, 0.22 * (right - left)) * m_an_inch)
        east = max(right, left + 1.6) / SIZE_IN[0]
        west = east - length_m / m_an_inch / SIZE_IN[0]
        y = (bottom - 0.39) / SIZE_IN[1]
        bar = Line2D([west, east], [y, y], color=INK, linewidth=1.4, marker="|", markersize=5)
        self.figure.add_artist(bar)
        self.figure.text(
            (west + east) / 2, y + 0.007, f"{length_m:g} m", size=8, color=INK, ha="center"
        )

    # Helpers.

    def _lines(
        self,
        ends: npt.NDArray[np.float64],
        colours: str | npt.NDArray[np.float64],
        width_pt: float,
    ) -> None:
        from matplotlib.collections import LineCollection

        lines = LineCollection(
            list(ends), colors=colours, linewidths=width_pt, capstyle="round", zorder=2
        )
        lines.set_rasterized(len(ends) > MANY_EDGES)
        self._axes.add_collection(lines, autolim=False)

    def _dot(
        self, at: "_Point", shape: str, size_pt: float, *, face: str, rim: str, zorder: int
    ) -> None:
        self._axes.plot(
            *at,
            marker=shape,
            markersize=size_pt,
            markerfacecolor=face,
            markeredgecolor=rim,
            markeredgewidth=1.6 if face == "none" else 0.8,
            clip_on=False,
            zorder=zorder,
        )

    def _tag(self, cell: Cell, robots: Sequence[int], shape: str) -> None:
        """Mark a sub-cell with numbers, beside it if others are in the way, or with a dot only."""
        ink = _ink(robots[0]) if len(robots) == 1 else INK
        face, letters, rim = (ink, "white", "white") if shape == "o" else ("white", ink, ink)
        at = _middle(cell)
        text = _numbers(robots)
        size = max(6.5, min(9.5, 0.24 * self._side_pt))
        half_height = 0.75 * size + 1.5
        half_width = max(half_height, 0.31 * size * len(text) + 3.0)
        spot = self._spot(at, half_width, half_height, 2.0, (0, 6, 12, 20, 30, 42))
        if spot != at:
            self._dot(at, shape, 4.5, face=face, rim=rim, zorder=6)
        if spot is None:
            return
        if spot != at:
            self._leader(at, spot, ink)
        style = "circle,pad=0.26" if len(text) == 1 else "round,pad=0.32,rounding_size=0.9"
        self._axes.annotate(
            text,
            at,
            xytext=spot,
            ha="center",
            va="center",
            size=size,
            color=letters,
            weight="bold",
            bbox={
                "boxstyle": style if shape == "o" else "round,pad=0.3,rounding_size=0.1",
                "facecolor": face,
                "edgecolor": rim,
                "linewidth": 0.9,
            },
            annotation_clip=False,
            zorder=7,
        )

    def _leader(self, at: "_Point", to: "_Point", ink: str) -> None:
        """Draw a line from a mark to what is written of it."""
        self._axes.plot(
            *zip(at, to, strict=True), color=ink, linewidth=0.8, clip_on=False, zorder=5.5
        )

    def _cross_label(self, cell: Cell, cross_pt: float, texts: Iterable[str]) -> None:
        """Write the first of some texts for which there is room beside a cross."""
        from matplotlib.patheffects import withStroke

        at = _middle(cell)
        for text in texts:
            half = 0.3 * LABEL_PT * len(text) + 1, 0.62 * LABEL_PT
            spot = self._spot(at, *half, cross_pt / 2 + 1, (2, 10, 20, 34))
            if spot is None:
                continue
            if self._gap_pt(at, spot, half) > cross_pt / 2 + 6:
                self._leader(at, spot, RED)
            self._axes.annotate(
                text,
                at,
                xytext=spot,
                ha="center",
                va="center",
                size=LABEL_PT,
                color=RED,
                weight="bold",
                path_effects=[withStroke(linewidth=2.5, foreground="white")],
                annotation_clip=False,
                zorder=9,
            )
            return

    def _spot(
        self,
        at: "_Point",
        half_width: float,
        half_height: float,
        clear_pt: float,
        reaches: Iterable[float],
    ) -> "_Point | None":
        """Find the middle of a free box near a point, and take it.

        Args:
            at: The point.
            half_width: Of the box.
            half_height: Of the box.
            clear_pt: How far the point's own mark reaches.
            reaches: How far from it the box may begin; 0: around it.
        """
        x, y = at[0] * self._side_pt, at[1] * self._side_pt
        own = _around(x, y, clear_pt, clear_pt)
        taken = [box for box in self._taken if box != own]
        east, south = self._grid.cols * self._side_pt, self._grid.rows * self._side_pt
        for reach in reaches:
            for turn in np.arange(0, 2 * math.pi, math.pi / 8) if reach else (None,):
                cx, cy = x, y
                if turn is not None:
                    cx += math.cos(turn) * (clear_pt + reach + half_width)
                    cy -= math.sin(turn) * (clear_pt + reach + half_height)
                box = _around(cx, cy, half_width, half_height)
                inside = min(box[0], box[1]) > -1 and box[2] < east + 1 and box[3] < south + 1
                if (inside or turn is None) and not overlap(box, taken):
                    self._taken.append(box)
                    return at if turn is None else (cx / self._side_pt, cy / self._side_pt)
        return None

    def _gap_pt(self, at: "_Point", middle: "_Point", half: tuple[float, float]) -> float:
        """Return how far a point is from a box around ``middle``."""
        apart = (abs(middle[axis] - at[axis]) * self._side_pt - half[axis] for axis in (0, 1))
        return math.hypot(*(max(0.0, gap) for gap in apart))

    def _size_pt(self, box: Box) -> float:
        """Return the longer side of a box on the map."""
        west, north, east, south = box
        return max(east - west, south - north) * self._side_pt

    def _take(self, at: "_Point", half_pt: float) -> None:
        x, y = at[0] * self._side_pt, at[1] * self._side_pt
        self._taken.append(_around(x, y, half_pt, half_pt))


_Point = tuple[float, float]
"""Column and row, with fractions."""


def _around(x: float, y: float, half_width: float, half_height: float) -> Box:
    return (x - half_width, y - half_height, x + half_width, y + half_height)


def _middle(cell: Cell) -> _Point:
    """Return the middle of a sub-cell."""
    return (cell[1] + 0.5, cell[0] + 0.5)


def _ink(robot: int) -> str:
    """Return a darker colour of a robot, for lines on its cells and for paper under white letters."""
    return "#" + "".join(f"{round(0.6 * part):02x}" for part in rgb(colour(robot)))


def _numbers(robots: Sequence[int]) -> str:
    """Write the numbers of robots, those in a row by their first and last."""
    parts: list[list[int]] = []
    for robot in sorted(robots):
        if parts and parts[-1][-1] == robot - 1:
            parts[-1][1:] = [robot]
        else:
            parts.append([robot])
    text = ", ".join("–".join(map(str, part)) for part in parts)
    return text if len(text) <= 16 else f"{len(robots)} robots"


def _together(cells: Iterable[tuple[int, Cell]]) -> dict[Cell, list[int]]:
    """Return the robots in each sub-cell."""
    robots: dict[Cell, list[int]] = defaultdict(list)
    for robot, cell in cells:
        robots[cell].append(robot)
    return robots


def _round_up(number: float) -> int:
    """Return the least of 1, 2, 5, 10, 20, 50 ... that is not below a number."""
    ten = 1
    while True:
        for factor in (1, 2, 5):
            if factor * ten >= number:
                return factor * ten
        ten *= 10


def _round_down(number: float) -> float:
    """Return the greatest of ... 0.5, 1, 2, 5, 10 ... that is not above a number."""
    ten = 10.0 ** math.floor(math.log10(number))
    return max(factor * ten for factor in (1, 2, 5) if factor * ten <= number)


def _patch(face: str, label: str) -> "Artist":
    from matplotlib.patches import Patch

    return Patch(facecolor=face, edgecolor="#888888", linewidth=0.6, label=label)


def _sign(label: str, ink: str, marker: str = "", face: str = "", width: float = 0.0) -> "Artist":
    from matplotlib.lines import Line2D

    return Line2D(
        [],
        [],
        label=label,
        color=ink,
        linestyle="-" if width else "none",
        linewidth=width,
        marker=marker,
        markerfacecolor=face or ink,
        markeredgewidth=2.0 if marker == "x" else 1.0,
    )


# The grid -----------------------------------------------------------------------------------------


def _blocked(grid: Grid) -> Mask:
    cells = np.frombuffer(grid.cells(), dtype=np.uint8)
    blocked: Mask = cells.reshape(grid.rows, grid.cols) != 0
    return blocked


def _whole(blocked: Mask) -> Mask:
    """Return the sub-cells of complete coarse cells."""
    rows, cols = (side // 2 for side in blocked.shape)
    quarters = blocked[: 2 * rows, : 2 * cols].reshape(rows, 2, cols, 2)
    complete: Mask = np.logical_not(quarters.any(axis=(1, 3)))
    whole = np.zeros_like(blocked)
    whole[: 2 * rows, : 2 * cols] = enlarged(complete, 2)
    return whole


def _expected(grid: Grid, starts: Sequence[Cell], owners: Iterable[Cell], *, cells: bool) -> Mask:
    """Return the sub-cells that a team could be expected to cover.

    Args:
        grid: The grid.
        starts: Where robots start; nowhere: everything is expected.
        owners: Coarse cells that are owned.
        cells: Whether robots go by way of complete coarse cells only.
    """
    expected = np.full((grid.rows, grid.cols), not starts, dtype=np.bool_)
    coarse = set(owners)
    if cells:
        coarse |= grid.reachable_cells((row // 2, col // 2) for row, col in starts)
    else:
        expected[_index(grid.reachable(starts))] = True
    rows, cols = _index(coarse)
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
        inside = (2 * rows + down < grid.rows) & (2 * cols + right < grid.cols)
        expected[2 * rows[inside] + down, 2 * cols[inside] + right] = True
    return expected


def _index(cells: Collection[Cell]) -> tuple[Numbers, Numbers]:
    """Return rows and columns."""
    pairs = np.array(list(cells), dtype=np.int64).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def _patches(mask: Mask) -> Iterator[tuple[int, int, int, int]]:
    """Yield west, north, east and south of each connected patch of a mask."""
    left = set(zip(*(axis.tolist() for axis in np.nonzero(mask)), strict=True))
    while left:
        patch = [left.pop()]
        for row, col in patch:
            for cell in ((row - 1, col), (row, col + 1), (row + 1, col), (row, col - 1)):
                if cell in left:
                    left.remove(cell)
                    patch.append(cell)
        rows, cols = zip(*patch, strict=True)
        yield min(cols), min(rows), max(cols) + 1, max(rows) + 1


def _check_free(grid: Grid, parameter: str, places: Iterable[int]) -> None:
    """Refuse places that are not free."""
    for place in places:
        if not 0 <= place < len(grid) or grid.blocked[place]:
            raise ValueError(f"{parameter}: found {place}, expected a free place")


def _check_coarse(grid: Grid, parameter: str, cells: Iterable[Cell]) -> None:
    """Refuse coarse cells outside the grid."""
    rows, cols = (grid.rows + 1) // 2, (grid.cols + 1) // 2
    for row, col in cells:
        if not (0 <= row < rows and 0 <= col < cols):
            raise ValueError(
                f"{parameter}: found {(row, col)}, expected a coarse cell within {rows} x {cols}"
            )
