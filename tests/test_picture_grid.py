"""Pictures of grids: every sub-cell has the colour it should have, drawings are complete files."""

import itertools
import re
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.text import Text

from deploy.grid_pixels import ALARM, SHADED, TEXTURES, WALL, paint_map, paint_run, shade
from deploy.picture_grid import draw_grid, draw_grid_run
from deploy.picture_parts import COLOURS, EARLY, LEGEND_MOST, colour, mix
from protocol.grid import Cell, Grid, sub_cells

PNG = b"\x89PNG\r\n\x1a\n"
SMALL = Grid.of_text(
    """
    ......
    ......
    ..##..
    ..##..
    .....#
    ......
    """
)
"""Seven complete coarse cells, one blocked, one partly blocked."""
OPEN = Grid(16, 16, bytes(256), 0.25)
DISTINCT = len(COLOURS) * TEXTURES


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that would have been saved; saving takes most of the time."""
    figures: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))
    return figures


@pytest.fixture
def saved(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that were saved."""
    figures: list[Figure] = []
    save = Figure.savefig

    def keep(figure: Figure, *args: Any, **options: Any) -> None:
        figures.append(figure)
        save(figure, *args, **options)

    monkeypatch.setattr(Figure, "savefig", keep)
    return figures


def texts(figure: Figure) -> Counter[str]:
    return Counter(text.get_text() for text in figure.findobj(Text))


def legend_row(figure: Figure, name: str) -> str | None:
    """The count beside a name in the legend."""
    found = [text for text in figure.texts if text.get_text() == name]
    beside = [
        text.get_text()
        for text in figure.texts
        if found
        and text.get_position()[1] == found[0].get_position()[1]
        and text.get_horizontalalignment() == "right"
    ]
    return beside[0] if beside else None


def rgb(name: str) -> tuple[int, ...]:
    return tuple(bytes.fromhex(name[1:]))


def a_run(grid: Grid, team_size: int) -> dict[str, Any]:
    """A run in which robots share the complete coarse cells in rows, each one long branch."""
    cells = grid.complete_cells()
    share = -(-len(cells) // team_size)
    owners = {cell: at // share for at, cell in enumerate(cells)}
    beside = [
        (one, other, owners[one])
        for one, other in itertools.pairwise(cells)
        if owners[one] == owners[other] and one[0] == other[0] and one[1] + 1 == other[1]
    ]
    visits: dict[int, tuple[int, float]] = {}
    starts: dict[int, Cell] = {}
    stopped: dict[int, int] = {}
    for at, (cell, robot) in enumerate(owners.items()):
        for number, sub_cell in enumerate(sub_cells(cell)):
            visits[grid.place(*sub_cell)] = robot, 4.0 * (at % share) + number
            starts.setdefault(robot, sub_cell)
            stopped[robot] = grid.place(*sub_cell)
    return {
        "starts": list(starts.values()),
        "first_visits": visits,
        "owners": owners,
        "edges": beside,
        "lost": {},
        "stopped": stopped,
        "team_size": team_size,
    }


def draw(grid: Grid, path: Path, run: Mapping[str, Any], **changes: Any) -> None:
    draw_grid_run(
        grid, path, **{"title": "A run", "subtitle": "as the test has it", **run, **changes}
    )


# Pixels ------------------------------------------------------------------------------------------


@given(st.integers(0, 100), st.floats(0, 1))
def test_shades_are_those_of_other_pictures(robot: int, tone: float) -> None:
    found = shade(np.array([robot]), np.array([tone]))
    wanted = rgb(mix(colour(robot), tone))
    assert np.abs(found[0].astype(int) - wanted).max() <= 1


@given(st.integers(0, 100), st.floats(EARLY, 1.3), st.floats(0.05, 0.5))
def test_what_is_later_is_darker(robot: int, tone: float, step: float) -> None:
    early, late = shade(np.array([robot] * 2), np.array([tone, tone + step]))
    assert (late <= early).all()
    assert late.sum() < early.sum()


def painted(robots: Sequence[int], time_share: float, px: int) -> Any:
    """The pixels of a row of sub-cells that one robot each came to."""
    row = np.array([robots])
    nowhere = np.zeros(row.shape, dtype=np.bool_)
    return paint_run(nowhere, row, np.full(row.shape, time_share), nowhere, px, 2.0)


@pytest.mark.parametrize("time_share", [0.0, 0.5, 1.0])
def test_robots_can_be_told_apart(time_share: float) -> None:
    looks = {
        painted([robot], time_share, 40).tobytes(): robot for robot in reversed(range(DISTINCT + 8))
    }
    assert sorted(looks.values()) == list(range(DISTINCT))


def test_most_of_a_cell_has_the_tone_of_its_time() -> None:
    for robot in range(DISTINCT):
        pixels = painted([robot], 0.5, 60).reshape(-1, 3)
        tone = shade(np.array([robot]), np.array([EARLY + (1 - EARLY) * 0.5]))[0]
        assert (pixels == tone).all(axis=1).mean() > 0.4


@settings(max_examples=60)
@given(st.data(), st.integers(1, 12))
def test_every_cell_is_painted_as_it_is(data: st.DataObject, px: int) -> None:
    rows, cols = data.draw(st.integers(1, 6)), data.draw(st.integers(1, 6))
    kinds = data.draw(
        st.lists(st.integers(-3, len(COLOURS) - 1), min_size=rows * cols, max_size=rows * cols)
    )
    kind = np.array(kinds).reshape(rows, cols)
    blocked, missed = kind == -3, kind == -2
    # At 100 pixels a point no line is ruled, and the only stripe is in the corner.
    pixels = paint_run(
        blocked, np.maximum(kind, -1), np.full(kind.shape, 0.5), missed & False, px, 100.0
    )
    assert pixels.shape == (rows * px, cols * px, 3)
    for row, col in np.ndindex(rows, cols):
        found = {tuple(pixel) for pixel in pixels[row * px :, col * px :][:px, :px].reshape(-1, 3)}
        match kind[row, col]:
            case -3:
                assert found == {rgb(WALL)}
            case -2 | -1:
                assert rgb(WALL) not in found
            case robot:
                wanted = shade(np.array([robot]), np.array([EARLY + (1 - EARLY) / 2]))[0]
                assert found == {tuple(wanted)}


@pytest.mark.parametrize("px", [1, 3, 20])
def test_missed_cells_are_red_beyond_their_rims(px: int) -> None:
    robots = np.zeros((5, 5), dtype=np.int64)
    missed = np.zeros((5, 5), dtype=np.bool_)
    robots[2, 2], missed[2, 2] = -1, True
    nowhere = np.zeros_like(missed)
    pixels = paint_run(nowhere, robots, np.ones(robots.shape), missed, px, 1.0)
    red = (pixels == rgb(ALARM)).all(axis=2)
    rim = slice(2 * px - min(2, 2 * px), 3 * px + 2)
    assert red[rim, rim].mean() > 0.3
    assert red.sum() == red[rim, rim].sum()
    inside = pixels[2 * px : 3 * px, 2 * px : 3 * px].reshape(-1, 3)
    assert {tuple(pixel) for pixel in inside} <= {rgb(ALARM), (255, 255, 255)}


def test_partly_blocked_coarse_cells_are_shaded() -> None:
    blocked = np.array([[False, True, False]])
    partly = np.array([[True, False, False]])
    cells = paint_map(blocked, partly, 1, 1.0)
    assert [tuple(cell) for cell in cells[0]] == [rgb(SHADED), rgb(WALL), (255, 255, 255)]


# Maps --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_a_map_is_drawn(tmp_path: Path, saved: list[Figure], suffix: str) -> None:
    path = tmp_path / f"map.{suffix}"
    draw_grid(SMALL, path, "$x_ a name in no font: 洞窟")
    assert path.read_bytes().startswith({"png": PNG, "svg": b"<?xml", "pdf": b"%PDF"}[suffix])
    said = ["6 x 6 sub-cells, 31 free; 7 complete coarse cells", "free", "blocked", "row", "column"]
    said += ["free, in a partly blocked coarse cell", "$x_ a name in no font: 洞窟"]
    assert set(said) <= set(texts(saved[0]))
    assert not [text for text in texts(saved[0]) if re.fullmatch(r"[\d.e-]+ m", text)]


@pytest.mark.parametrize(
    ("rows", "cols", "cell_m"), [(1, 1, 1.0), (1, 40, 0.05), (40, 1, 2.5), (7, 9, 1e-3)]
)
def test_maps_of_all_shapes_are_drawn(
    tmp_path: Path, drawn: list[Figure], rows: int, cols: int, cell_m: float
) -> None:
    draw_grid(Grid(rows, cols, bytes(rows * cols), cell_m), tmp_path / "map.png", "")
    bars = [text for text in texts(drawn[0]) if re.fullmatch(r"[\d.e-]+ m", text)]
    assert len(bars) == (cell_m != 1)


def test_a_map_of_more_cells_than_pixels_is_drawn(tmp_path: Path) -> None:
    draw_grid(Grid(3, 6000, bytes(18000)), tmp_path / "map.png", "")
    assert (tmp_path / "map.png").read_bytes().startswith(PNG)


# Runs --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("team_size", [1, 16, 64])
def test_a_run_is_drawn(tmp_path: Path, saved: list[Figure], team_size: int) -> None:
    run = a_run(OPEN, team_size)
    run["lost"] = {0: (3.5, run["stopped"].pop(0))}
    if team_size > 1:
        run["lost"][1] = (7.0, None)
    draw(OPEN, tmp_path / "run.png", run)
    assert (tmp_path / "run.png").read_bytes().startswith(PNG)
    said = texts(saved[0])
    wanted = {"A run", "as the test has it", "time of first visit", "sub-cells", "start", "lost"}
    wanted |= {"tree edge"} if team_size < 64 else set()
    wanted |= {"lost at 3.5", "lost at 7", "stop"} if team_size > 1 else {"lost at 3.5"}
    wanted |= {"30 more"} if team_size == 64 else set()
    assert wanted <= set(said)
    assert said["robot 0 (t = 3.5)"] == 1
    rows = [text for text in said if re.fullmatch(r"robot \d+", text)]
    assert len(rows) == min(team_size, LEGEND_MOST)
    assert {legend_row(saved[0], name) for name in rows} == {str(256 // team_size)}
    assert legend_row(saved[0], "not covered") is None
    # At its start or beside it stands the number of each robot, if there is room.
    if team_size < 64:
        numbers = Counter(text.get_text() for text in saved[0].axes[0].texts)
        assert all(numbers[str(robot)] >= 1 for robot in range(team_size))


def test_tree_edges_go_from_centre_to_centre(tmp_path: Path, drawn: list[Figure]) -> None:
    draw(SMALL, tmp_path / "run.svg", a_run(SMALL, 1) | {"edges": [((0, 2), (1, 2), 0)]})
    edges = drawn[0].axes[0].findobj(LineCollection)[0]
    assert isinstance(edges, LineCollection)
    assert [line.tolist() for line in edges.get_segments()] == [[[5, 1], [5, 3]]]


def test_borders_run_between_owners(tmp_path: Path, drawn: list[Figure]) -> None:
    owners = {(0, 0): 0, (0, 1): 1, (1, 0): 0}
    draw(SMALL, tmp_path / "run.png", a_run(SMALL, 2) | {"owners": owners})
    borders = drawn[0].axes[0].findobj(LineCollection)[1]
    assert isinstance(borders, LineCollection)
    assert [line.tolist() for line in borders.get_segments()] == [[[2, 0], [2, 2]]]


def test_cells_are_where_the_ticks_say(tmp_path: Path, saved: list[Figure]) -> None:
    run = a_run(SMALL, 2) | {"starts": [], "stopped": {}, "owners": {}, "edges": []}
    missed = SMALL.place(5, 1)
    del run["first_visits"][missed]
    path = tmp_path / "run.png"
    draw(SMALL, path, run)
    pixels = np.rint(imread(path)[..., :3] * 255).astype(int)
    west, south, east, north = saved[0].axes[0].get_position().extents
    height, width, _ = pixels.shape
    last = max(time for _, time in run["first_visits"].values())
    for row, col in itertools.product(range(6), range(6)):
        x = width * (west + (east - west) * (col + 0.5) / 6)
        y = height * (1 - north + (north - south) * (row + 0.5) / 6)
        found = pixels[round(y) - 5 : round(y) + 5, round(x) - 5 : round(x) + 5].reshape(-1, 3)
        place = SMALL.place(row, col)
        if place in run["first_visits"]:
            robot, time = run["first_visits"][place]
            wanted = mix(colour(robot), EARLY + (1 - EARLY) * time / last)
            assert np.abs(found - rgb(wanted)).max() <= 1
        elif SMALL.is_free(row, col):
            assert {tuple(pixel) for pixel in found} == {rgb(ALARM), (255, 255, 255)}
        else:
            assert {tuple(pixel) for pixel in found} == {rgb(WALL)}


def test_cells_that_nobody_covered_are_counted(tmp_path: Path, drawn: list[Figure]) -> None:
    run = a_run(SMALL, 2)
    for cell in ((0, 0), (5, 1)):
        del run["first_visits"][SMALL.place(*cell)]
    draw(SMALL, tmp_path / "run.png", run)
    assert legend_row(drawn[0], "not covered") == "2"
    # The three free sub-cells of the coarse cell that is partly blocked.
    assert legend_row(drawn[0], "out of reach") == "3"


def test_owning_a_partly_blocked_coarse_cell_is_a_duty(tmp_path: Path, drawn: list[Figure]) -> None:
    run = a_run(SMALL, 1)
    draw(SMALL, tmp_path / "run.png", run | {"owners": run["owners"] | {(2, 2): 0}})
    assert legend_row(drawn[0], "not covered") == "3"
    assert legend_row(drawn[0], "out of reach") is None


def test_cells_that_nobody_came_to_own_count(tmp_path: Path, drawn: list[Figure]) -> None:
    run = a_run(SMALL, 1) | {"owners": {(0, 0): 0}, "edges": []}
    for cell in sub_cells((2, 0)):
        del run["first_visits"][SMALL.place(*cell)]
    draw(SMALL, tmp_path / "run.png", run)
    assert legend_row(drawn[0], "not covered") == "4"
    assert legend_row(drawn[0], "out of reach") == "3"


def test_where_no_coarse_cell_is_owned_all_sub_cells_count(
    tmp_path: Path, drawn: list[Figure]
) -> None:
    run = a_run(SMALL, 1) | {"owners": {}, "edges": []}
    draw(SMALL, tmp_path / "run.png", run)
    assert legend_row(drawn[0], "not covered") == "3"


def test_cells_behind_walls_are_out_of_reach(tmp_path: Path, drawn: list[Figure]) -> None:
    grid = Grid.of_text("..##..\n..##..")
    run = {"owners": {}, "edges": [], "lost": {}, "stopped": {}, "team_size": 1}
    visits = {grid.place(*cell): (0, 0.0) for cell in sub_cells((0, 0))}
    draw(grid, tmp_path / "run.png", run, starts=[(0, 0)], first_visits=visits)
    assert legend_row(drawn[0], "out of reach") == "4"
    assert legend_row(drawn[0], "not covered") is None


def test_a_lone_missed_cell_of_a_large_grid_has_a_ring(tmp_path: Path, drawn: list[Figure]) -> None:
    grid = Grid(70, 70, bytes(4900))
    visits = {grid.place(*cell): (0, 1.0) for cell in grid.free_cells() if cell != (27, 51)}
    run = {"owners": {}, "edges": [], "lost": {}, "stopped": {}, "team_size": 1}
    draw(grid, tmp_path / "run.png", run, starts=[(0, 0)], first_visits=visits)
    rings = [line for line in drawn[0].axes[0].lines if line.get_markeredgecolor() == ALARM]
    assert [np.asarray(line.get_xydata()).tolist() for line in rings] == [[[51.5, 27.5]]]


@pytest.mark.parametrize("grid", [SMALL, OPEN, Grid(1, 1, b"\0"), Grid(3, 5, b"\1" * 15)])
def test_a_run_in_which_nothing_happened_is_drawn(
    tmp_path: Path, drawn: list[Figure], grid: Grid
) -> None:
    nothing: dict[str, Any] = {"starts": [], "first_visits": {}, "owners": {}, "edges": []}
    draw(grid, tmp_path / "run.png", nothing, lost={}, stopped={}, team_size=1)
    free = len(grid.free_cells())
    assert legend_row(drawn[0], "not covered") == (str(free) if free else None)


def test_robots_that_start_in_one_place_share_a_mark(tmp_path: Path, drawn: list[Figure]) -> None:
    run = a_run(OPEN, 8) | {"starts": [(4, 4)] * 6 + [(9, 9)] * 2, "stopped": {}}
    run["lost"] = {3: (1.0, OPEN.place(2, 12)), 5: (2.5, OPEN.place(2, 12))}
    draw(OPEN, tmp_path / "run.png", run)
    said = texts(drawn[0])
    assert said["0–5"] == said["6–7"] == 1
    assert said["robots 3 (t = 1), 5 (t = 2.5)"] == 1


def test_numbers_do_not_overlap(tmp_path: Path, drawn: list[Figure]) -> None:
    grid = Grid(128, 128, bytes(16384))
    run: dict[str, Any] = {"first_visits": {}, "owners": {}, "edges": []}
    starts = [(50 + robot // 4, 50 + robot % 4) for robot in range(16)]
    draw(grid, tmp_path / "run.png", run, starts=starts, lost={}, stopped={}, team_size=16)
    marks = drawn[0].axes[0].texts
    assert sorted(int(mark.get_text()) for mark in marks) == list(range(16))
    renderer = FigureCanvasAgg(drawn[0]).get_renderer()
    boxes = [mark.get_window_extent(renderer) for mark in marks]
    assert not any(one.overlaps(other) for one, other in itertools.combinations(boxes, 2))


def test_the_same_run_gives_the_same_picture(tmp_path: Path) -> None:
    for name in ("one.png", "two.png"):
        draw(SMALL, tmp_path / name, a_run(SMALL, 2))
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"starts": [(0, 6)]}, "starts: found (0, 6), expected a free sub-cell"),
        ({"starts": [(2, 2)]}, "starts: found (2, 2), expected a free sub-cell"),
        ({"starts": [(0, 0)] * 3}, "starts: robot: found 2, expected 0 to 1"),
        ({"first_visits": {6: (0, 0.0)}}, "first_visits: found 6, expected a free place"),
        ({"first_visits": {49: (0, 0.0)}}, "first_visits: found 49, expected a free place"),
        ({"first_visits": {-1: (0, 0.0)}}, "first_visits: found -1, expected a free place"),
        ({"first_visits": {0: (2, 0.0)}}, "first_visits: robot: found 2, expected 0 to 1"),
        ({"owners": {(3, 0): 0}}, "owners: found (3, 0), expected a coarse cell within 3 x 3"),
        ({"owners": {(0, 0): 2}}, "owners: robot: found 2, expected 0 to 1"),
        (
            {"edges": [((0, 0), (0, -1), 0)]},
            "edges: found (0, -1), expected a coarse cell within 3 x 3",
        ),
        ({"edges": [((0, 0), (0, 1), -1)]}, "edges: robot: found -1, expected 0 to 1"),
        ({"lost": {2: (0.0, None)}}, "lost: found 2, expected 0 to 1"),
        ({"lost": {1: (0.0, 16)}}, "lost: place: found 16, expected a free place"),
        ({"stopped": {2: 0}}, "stopped: found 2, expected 0 to 1"),
        ({"stopped": {0: 48}}, "stopped: place: found 48, expected a free place"),
    ],
)
def test_numbers_out_of_range(tmp_path: Path, wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        draw(SMALL, tmp_path / "run.png", a_run(SMALL, 2) | wrong)
    assert not (tmp_path / "run.png").exists()


def test_an_unknown_suffix_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="xyz"):
        draw_grid(SMALL, tmp_path / "map.xyz", "")


def test_drawing_does_not_load_pyplot(tmp_path: Path) -> None:
    draw_grid(SMALL, tmp_path / "map.png", "")
    assert "matplotlib.pyplot" not in sys.modules
