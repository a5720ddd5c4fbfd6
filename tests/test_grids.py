"""Grids: what a grid is, what the readers of grid files take and refuse, and generated grids."""

import io
import json
import math
import re
import struct
import zlib
from collections.abc import Callable
from fractions import Fraction
from functools import cache
from pathlib import Path
from random import Random

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from PIL import Image

from deploy.cli import main
from deploy.map_facts import GridFacts, describe, facts_of
from protocol.errors import MapError
from protocol.graph import PortGraph
from protocol.grid import EAST, NORTH, SOUTH, STEPS, WEST, Grid, sub_cells
from world_server.maps import GridFile, read_grid, read_map
from world_server.maps import grids as grid_readers
from world_server.maps.generated_grids import random_obstacles, rectangles, rooms, warehouse
from world_server.maps.grids import CELLS_MOST, FREE_GREY, GRID_READERS
from world_server.maps.readers import READERS

ROOT = Path(__file__).resolve().parent.parent


@st.composite
def grids(draw: st.DrawFn, most: int = 7) -> Grid:
    rows, cols = draw(st.integers(1, most)), draw(st.integers(1, most))
    bits = draw(st.lists(st.booleans(), min_size=rows * cols, max_size=rows * cols))
    return Grid(rows, cols, bytes(bits), draw(st.sampled_from([1.0, 0.35])))


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str, str | bytes], Path]:
    def write(name: str, content: str | bytes) -> Path:
        path = tmp_path / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return write


Write = Callable[[str, str | bytes], Path]


def text_of(grid: Grid) -> str:
    rows = range(grid.rows)
    return "\n".join(
        "".join(".#"[not grid.is_free(row, col)] for col in range(grid.cols)) for row in rows
    )


def message_of(path: Path, **scale: float) -> str:
    """Read a file that must be refused; return the message without the folder."""
    with pytest.raises(MapError) as caught:
        read_grid(path, **scale)
    text = str(caught.value)
    assert len(text.splitlines()) == 1
    return text.replace(f"{path.parent}/", "")


def notes_of(path: Path) -> str:
    return "\n".join(read_grid(path).notes)


# The grid itself ---------------------------------------------------------------------------------


@given(grids())
def test_every_place_is_a_cell_and_a_step_off_the_grid_is_blocked(grid: Grid) -> None:
    assert len(grid) == (grid.rows + 1) * grid.stride
    for row in range(grid.rows):
        for col in range(grid.cols):
            place = grid.place(row, col)
            assert grid.position(place) == (row, col)
            assert grid.is_free(row, col) == (not grid.blocked[place])
            for down, right in STEPS:
                there = grid.blocked[place + down * grid.stride + right]
                assert grid.is_free(row + down, col + right) == (not there)
    for row in (-1, grid.rows):
        assert not grid.is_free(row, 0)


@given(grids())
def test_cells_give_the_grid_again(grid: Grid) -> None:
    again = Grid(grid.rows, grid.cols, grid.cells().replace(b"\1", b"\xff"), grid.cell_m)
    assert again == grid
    assert hash(again) == hash(grid)
    assert Grid.of_text(text_of(grid), grid.cell_m) == grid
    assert grid != Grid(grid.rows, grid.cols, grid.cells(), 2.0)
    assert grid != "a grid"
    assert len(grid.free_cells()) == grid.cells().count(0)


@given(grids())
def test_complete_cells_and_what_can_be_reached(grid: Grid) -> None:
    free = set(grid.free_cells())
    complete = set(grid.complete_cells())
    everything = [(row, col) for row in range(-1, grid.rows) for col in range(-1, grid.cols)]
    for cell in everything:
        assert grid.is_complete(*cell) == (cell in complete)
        assert grid.is_complete(*cell) == all(sub in free for sub in sub_cells(cell))
    for start in sorted(free)[:1]:
        reached = grid.reachable([start, (-1, 0)])
        assert start in reached <= free
        for row, col in reached:
            around = {(row + down, col + right) for down, right in STEPS}
            assert around & free <= reached
    starts = sorted(complete)[:1]
    assert grid.reachable_cells(starts) <= complete
    assert grid.reachable_cells(complete) == complete


def test_directions_and_malformed_grids() -> None:
    assert [STEPS[way] for way in (NORTH, EAST, SOUTH, WEST)] == [(-1, 0), (0, 1), (1, 0), (0, -1)]
    for rows, cols, cells in ((0, 1, b""), (1, 0, b""), (1, 2, b"\0"), (1, 1, b"\0\0")):
        with pytest.raises(ValueError, match="bytes for"):
            Grid(rows, cols, cells)


# MovingAI ----------------------------------------------------------------------------------------

HEADER = "type octile\nheight 2\nwidth 3\nmap\n"


@pytest.mark.parametrize(
    "text",
    [
        HEADER + ".G@\nTSO\n",
        HEADER + ".G@\nTSO",
        HEADER + ".G@\nTSO\n\n \n\n",
        "\ufeff" + HEADER + ".G@\nTSO\n",
        (HEADER + ".G@\nTSO\n").replace("\n", "\r\n"),
        (HEADER + ".G@\nTSO\n").replace("\n", "\r"),
        "width  3 \nheight\t2\ntype tile\n map\n.G@\nTSO\n",
    ],
)
def test_a_movingai_map_in_every_spelling(write: Write, text: str) -> None:
    found = read_grid(write("a.map", text))
    assert text_of(found.grid) == "..#\n#.#"
    assert (found.kind, found.resolution_m, found.grid.cell_m) == ("movingai", 1, 1)
    assert found.origin is None
    assert found.notes == (
        "1 swamp cells (S) count as free",
        "2 x 3 sub-cells: the last column belongs to no coarse cell",
    )


def test_water_is_blocked_and_noted(write: Write) -> None:
    found = read_grid(write("a.map", "type octile\nheight 2\nwidth 2\nmap\n.W\nW.\n"))
    assert text_of(found.grid) == ".#\n#."
    assert found.notes == ("2 water cells (W) count as blocked",)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("type octile\nheight 2\nwidth 3\n.G@\nTSO\n", "a.map:4: found '.G@', expected `type`"),
        ("type octile\nheight 2\n", "a.map: found no line `map`, expected `type`, `height`"),
        ("type octile\nheight 2\nmap\n..", "a.map:3: found `map` before `width`, expected"),
        ("height 1\nwidth 1\nmap\n.", "a.map:3: found `map` before `type`, expected"),
        ("height 1\nheight 1\n", "a.map:2: found `height` again, expected"),
        ("height 0\n", "a.map:1: `height`: found '0', expected a whole number > 0"),
        ("width -1\n", "a.map:1: `width`: found '-1', expected a whole number > 0"),
        ("width ٣\n", "a.map:1: `width`: found '٣', expected a whole number > 0"),
        ("width 9999999999\n", "a.map:1: `width`: found '9999999999', expected a whole"),
        ("height 2 3\n", "a.map:1: found 'height 2 3', expected `type`"),
        (
            "type octile\nheight 99999\nwidth 99999\nmap\n.",
            "a.map: found 99999 x 99999 characters, expected at most 64000000",
        ),
        (HEADER + "...\n", "a.map: found 1 rows below `map`, expected 2"),
        (HEADER + "...\n...\n...", "a.map: found 3 rows below `map`, expected 2"),
        (HEADER + "...\n..", "a.map:6:3: found 2 characters in the row, expected 3"),
        (HEADER + "....\n...", "a.map:5:4: found 4 characters in the row, expected 3"),
        (HEADER + "...\n\n", "a.map: found 1 rows below `map`, expected 2"),
        (HEADER + "\n...", "a.map:5:1: found 0 characters in the row, expected 3"),
        (HEADER + "...\n.x.", "a.map:6:2: found 'x', expected one of . G S @ O T W"),
        (HEADER + "... \n...", "a.map:5:4: found ' ', expected one of"),
        (HEADER + "@@@\n@@@", "a.map: found all 2 x 3 sub-cells of 1 m blocked, expected a free"),
        (b"type octile\nheight \xff", "a.map:2: found byte 0xff, expected text in UTF-8"),
        ("\n \n", "a.map: the file is empty, expected a grid with at least one free cell"),
    ],
)
def test_malformed_movingai_maps(write: Write, text: str | bytes, message: str) -> None:
    assert message_of(write("a.map", text)).startswith(message)


# Text --------------------------------------------------------------------------------------------


@given(
    grids(),
    st.sampled_from(["\n", "\r\n", "\r"]),
    st.sampled_from(["", "\n", "\r\n", "\n\n  \n\t\n"]),
    st.booleans(),
)
def test_text_grids_are_read_back(
    tmp_path_factory: pytest.TempPathFactory, grid: Grid, line_end: str, end: str, mark: bool
) -> None:
    path = tmp_path_factory.getbasetemp() / "written.txt"
    text = ("\ufeff" if mark else "") + text_of(grid).replace("\n", line_end) + end
    path.write_bytes(text.encode())
    if grid.free_cells():
        found = read_grid(path, cell_m=grid.cell_m, resolution_m=grid.cell_m)
        assert (found.grid, found.kind) == (grid, "text")
        assert any("coarse" in note for note in found.notes) == (
            grid.rows % 2 == 1 or grid.cols % 2 == 1
        )
    else:
        assert "sub-cells of 1 m blocked, expected a free one" in message_of(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("..\n.", "a.txt:2:2: found 1 characters in the row, expected 2"),
        ("..\n...", "a.txt:2:3: found 3 characters in the row, expected 2"),
        ("..\n\n..", "a.txt:2:1: found 0 characters in the row, expected 2"),
        ("\n..", "a.txt:2:1: found 2 characters in the row, expected 0"),
        ("..\n.@", "a.txt:2:2: found '@', expected one of . #"),
        (".é\n..", "a.txt:1:2: found 'é', expected one of . #"),
        (".\0\n..", "a.txt:1:2: found '\\x00', expected one of . #"),
        (b"..\n.\xe9", "a.txt:2: found byte 0xe9, expected text in UTF-8"),
        ("##", "a.txt: found all 1 x 2 sub-cells of 1 m blocked, expected a free one"),
        ("", "a.txt: the file is empty, expected a grid with at least one free cell"),
    ],
)
def test_malformed_text_grids(write: Write, text: str | bytes, message: str) -> None:
    assert message_of(write("a.txt", text)).startswith(message)


# Images ------------------------------------------------------------------------------------------

SHADES = np.array([[0, 128, 205, 206], [254, 255, 200, 30]], np.uint8)
WHITE = SHADES >= FREE_GREY


def encoded(image: Image.Image, kind: str, **options: object) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, kind, **options)
    return buffer.getvalue()


def free_of(found: GridFile) -> np.ndarray:
    cells = np.frombuffer(found.grid.cells(), np.uint8)
    free: np.ndarray = cells.reshape(found.grid.rows, found.grid.cols) == 0
    return free


@pytest.mark.parametrize(
    ("suffix", "kind"),
    [
        *((".png", "PNG"), (".pgm", "PPM"), (".bmp", "BMP"), (".gif", "GIF"), (".tif", "TIFF")),
        *((".TIFF", "TIFF"), (".ppm", "PPM"), (".webp", "WEBP"), (".png", "GIF")),
    ],
)
@pytest.mark.parametrize("mode", ["L", "RGB"])
def test_what_is_near_white_is_free(write: Write, suffix: str, kind: str, mode: str) -> None:
    options = {"lossless": True} if kind == "WEBP" else {}
    image = Image.fromarray(SHADES).convert(mode)
    found = read_grid(write(f"a{suffix}", encoded(image, kind, **options)))
    assert (free_of(found) == WHITE).all()
    assert (found.kind, found.resolution_m, found.origin) == ("image", 1, None)
    assert found.notes == (
        "4 grey pixels (1 to 205 of 255) count as blocked",
        "an image tells no scale: a pixel is taken as 1 m",
    )


def test_jpeg_is_near_enough(write: Write) -> None:
    image = np.zeros((32, 48), np.uint8)
    image[8:24, 8:40] = 255
    for mode in ("L", "RGB", "CMYK"):
        path = write("a.jpg", encoded(Image.fromarray(image).convert(mode), "JPEG", quality=95))
        assert (free_of(read_grid(path, resolution_m=0.1)) == (image == 255)).all()


def test_bits_palettes_and_colours(write: Write) -> None:
    black_and_white = Image.fromarray(WHITE)
    for kind, suffix in (("PNG", ".png"), ("PPM", ".pbm"), ("TIFF", ".tiff"), ("BMP", ".bmp")):
        assert (
            free_of(read_grid(write(f"a{suffix}", encoded(black_and_white, kind)))) == WHITE
        ).all()
    assert (free_of(read_grid(write("b.pbm", "P1\n# c\n3 1\n1 0 1\n"))) == [[0, 1, 0]]).all()
    palette = Image.new("P", (3, 1))
    palette.putpalette([0, 0, 0, 255, 255, 0, 255, 0, 255])
    palette.putdata([0, 1, 2])
    path = write("a.png", encoded(palette, "PNG"))
    assert free_of(read_grid(path)).tolist() == [[False, True, False]]  # yellow is bright
    assert "2 coloured pixels are taken by their brightness (Rec. 709)" in notes_of(path)


def test_what_is_not_opaque_counts_as_on_black(write: Write) -> None:
    pixels = np.full((1, 4, 4), 255, np.uint8)
    pixels[0, :, 3] = [255, 206, 205, 0]
    path = write("a.png", encoded(Image.fromarray(pixels, "RGBA"), "PNG"))
    assert free_of(read_grid(path)).tolist() == [[True, True, False, False]]
    assert "3 pixels that are not opaque count as on black" in notes_of(path)
    pixels[0, :, 3] = 255
    assert "opaque" not in notes_of(write("a.png", encoded(Image.fromarray(pixels, "RGBA"), "PNG")))
    grey = Image.fromarray(np.array([[255, 254]], np.uint8))
    path = write("b.png", encoded(grey, "PNG", transparency=255))
    assert free_of(read_grid(path)).tolist() == [[False, True]]


def test_sixteen_bits_a_pixel(write: Write) -> None:
    deep = SHADES.astype(np.uint16) * 257
    for kind, suffix in (("PNG", ".png"), ("TIFF", ".tif")):
        assert (
            free_of(read_grid(write(f"a{suffix}", encoded(Image.fromarray(deep), kind)))) == WHITE
        ).all()
    clear = encoded(Image.fromarray(deep), "PNG")
    length, name, body = 2, b"tRNS", b"\xff\xff"
    chunk = struct.pack(">I", length) + name + body + struct.pack(">I", zlib.crc32(name + body))
    at = clear.index(b"IDAT") - 4
    assert (
        free_of(read_grid(write("c.png", clear[:at] + chunk + clear[at:]))).sum() == WHITE.sum() - 1
    )
    floats = Image.fromarray(SHADES.astype(np.float32))
    assert message_of(write("f.tif", encoded(floats, "TIFF"))) == (
        "f.tif: found pixels in floating point, expected 8 or 16 bits"
    )
    long = Image.fromarray(SHADES.astype(np.int32) << 20)
    assert message_of(write("i.tif", encoded(long, "TIFF"))) == (
        "i.tif: found pixels of 32 bits, expected 8 or 16 bits"
    )


@given(
    st.sampled_from([2, 3, 5, 6]),
    st.sampled_from([1, 2, 100, 254, 255, 256, 1023, 65535]),
    st.tuples(st.integers(1, 4), st.integers(1, 4)),
    st.sampled_from(["\n", " ", "\r\n", "#\n", "\n# a b 1 2\r\n#\n  "]),
    st.randoms(use_true_random=False),
)
def test_pnm_of_any_depth(
    tmp_path_factory: pytest.TempPathFactory,
    kind: int,
    largest: int,
    size: tuple[int, int],
    gap: str,
    random: Random,
) -> None:
    rows, cols = size
    grey = [random.choice([0, largest, random.randint(0, largest)]) for _ in range(rows * cols)]
    grey[0] = largest
    values = [value for value in grey for _ in range(3 if kind in {3, 6} else 1)]
    header = gap.join(map(str, (f"P{kind}", cols, rows, largest))) + "\n"
    if kind in {2, 3}:
        body = gap.join(map(str, values)).encode()
    else:
        body = struct.pack(f">{len(values)}{'B' if largest < 256 else 'H'}", *values) + b"more"
    path = tmp_path_factory.getbasetemp() / "any.pgm"
    path.write_bytes(header.encode() + body)
    expected = [math.floor(Fraction(255 * value, largest) + Fraction(1, 2)) for value in grey]
    assert free_of(read_grid(path)).ravel().tolist() == [shade >= FREE_GREY for shade in expected]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("P5\n2 x", "a.pgm: found a damaged P5 header, expected width, height and largest"),
        ("P5\n0 2\n255\n..", "a.pgm: found width 0, height 2, largest value 255, expected all > 0"),
        ("P5 1 1 65536\n..", "a.pgm: found width 1, height 1, largest value 65536, expected all"),
        ("P5 9000 9000 255\n", "a.pgm: found 9000 x 9000 pixels, expected at most 64000000"),
        ("P5\n2 2\n255\n...", "a.pgm: found 3 bytes of pixels, expected 4"),
        ("P5\n1 1\n256\n.", "a.pgm: found 1 bytes of pixels, expected 2"),
        ("P5\n1 1\n10\n.", "a.pgm: found value 46, expected at most 10"),
        ("P2\n2 2\n255\n1 2 3", "a.pgm: found 3 values, expected 4"),
        ("P2\n2 2\n255\n ", "a.pgm: found 0 values, expected 4"),
        ("P2\n1 1\n255\n1.0", "a.pgm: found '.' among the pixels, expected digits"),
        ("P2\n1 1\n255\n256", "a.pgm: found value 256, expected at most 255"),
        ("P2\n1 1\n255\n" + "9" * 5000, "a.pgm: found '99999"),
        ("P1\n3 1\n1 0", "a.pgm: found a damaged image, expected a whole one: "),
        ("P7\n", "a.pgm: found no image, expected PNG, PPM, BMP, GIF, JPEG, TIFF, WEBP"),
        ("%!PS-Adobe-3.0 EPSF-3.0\n", "a.pgm: found no image, expected PNG"),
        (encoded(Image.fromarray(SHADES), "PNG")[:50], "a.pgm: found a damaged image, expected"),
        (encoded(Image.new("1", (8001, 8000), 1), "PNG"), "a.pgm: found 8000 x 8001 pixels, exp"),
        (b"BM" + b"\xff" * 60, "a.pgm: found a damaged image, expected a whole one: "),
        (" ", "a.pgm: the file is empty, expected a grid with at least one free cell"),
    ],
)
def test_malformed_images(write: Write, content: str | bytes, message: str) -> None:
    assert message_of(write("a.pgm", content)).startswith(message)


def test_a_bomb_is_not_unpacked(write: Write) -> None:
    def chunk(name: bytes, body: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(name + body))
        return struct.pack(">I", len(body)) + name + body + check

    head = struct.pack(">IIBBBBB", 1_000_000, 1_000_000, 1, 0, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", b"") + chunk(b"IEND", b"")
    assert message_of(write("a.png", data)) == (
        f"a.png: found a huge image, expected at most {CELLS_MOST} pixels"
    )


def test_the_first_of_several_images(write: Write) -> None:
    first = Image.fromarray(SHADES)
    data = encoded(first, "GIF", save_all=True, append_images=[first.rotate(180)])
    path = write("a.gif", data)
    assert (free_of(read_grid(path)) == WHITE).all()
    assert "the file holds several images; this is the first" in notes_of(path)


# ROS ---------------------------------------------------------------------------------------------

YAML = """\
image: map.pgm
resolution: 0.05
origin: [-10.0, 2, 1e-1]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""


def ros(write: Write, shades: list[int], text: str = YAML, **changes: str) -> Path:
    """Write a ROS map of one row; an empty change removes a field."""
    write("map.pgm", f"P5\n{len(shades)} 1\n255\n".encode() + bytes(shades))
    for name, value in changes.items():
        text = re.sub(f"(?m)^{name}:.*\n", "", text) + (f"{name}: {value}\n" if value else "")
    return write("map.yaml", text)


def occupancies(path: Path) -> tuple[list[int], int, int]:
    """Return which pixels are free, and how many are unknown and between."""
    found = read_grid(path)
    notes = "\n".join(found.notes)
    counts = [
        int(match[1]) if (match := re.search(rf"(\d+) {words} count", notes)) else 0
        for words in ("unknown pixels", "pixels of occupancy 1 to 99")
    ]
    free = np.flatnonzero(free_of(found)[0]).tolist()
    return free, counts[0], counts[1]


def test_a_ros_map(write: Write) -> None:
    found = read_grid(ros(write, [254, 205, 0, 206]))
    assert text_of(found.grid) == ".##."
    assert (found.kind, found.resolution_m, found.grid.cell_m) == ("ros", 0.05, 0.05)
    assert found.origin == (-10, 2, 0.1)
    assert "1 unknown pixels count as blocked" in found.notes


def test_thresholds_are_inclusive(write: Write) -> None:
    # In single precision 51 / 255 is 0.2 and 153 / 255 is 0.6; one shade on, it is neither.
    shades = [50, 51, 52, 152, 153, 154]
    limits = {"negate": "1", "free_thresh": "0.2", "occupied_thresh": "0.6"}
    assert occupancies(ros(write, shades, **limits)) == ([0, 1], 2, 0)
    assert occupancies(ros(write, shades, mode="scale", **limits)) == ([0, 1], 0, 2)
    limits["negate"] = "0"
    mirrored = [255 - shade for shade in shades]
    assert occupancies(ros(write, mirrored, **limits))[0] == [0, 1]
    same = {"free_thresh": "0.2", "occupied_thresh": "0.2", "negate": "1"}
    assert occupancies(ros(write, shades, **same)) == ([0, 1], 0, 0)  # free wins


def test_scale_rounds_to_whole_percents(write: Write) -> None:
    limits = {"negate": "true", "free_thresh": "0", "occupied_thresh": "1", "mode": "scale"}
    # 1 / 255 is 0.4 %, so free; 254 / 255 is 99.6 %, so occupied.
    assert occupancies(ros(write, [0, 1, 2, 128, 253, 254, 255], **limits)) == ([0, 1], 0, 3)


def test_raw_takes_the_grey_value(write: Write) -> None:
    shades = [0, 1, 99, 100, 101, 127, 128, 254, 255]
    assert occupancies(ros(write, shades, mode="Raw")) == ([0], 5, 2)


def test_what_is_not_opaque_is_unknown_but_not_in_raw(write: Write) -> None:
    pixels = np.zeros((1, 3, 4), np.uint8)
    pixels[0, :, :3] = 255
    pixels[0, :, 3] = [255, 254, 0]
    write("alpha.png", encoded(Image.fromarray(pixels, "RGBA"), "PNG"))
    for mode in ("trinary", "scale"):
        assert occupancies(ros(write, [0], image="alpha.png", mode=mode)) == ([0], 2, 0)
    pixels[0, :, :3] = 0
    write("alpha.png", encoded(Image.fromarray(pixels, "RGBA"), "PNG"))
    assert occupancies(ros(write, [0], image="alpha.png", mode="raw")) == ([0, 1, 2], 0, 0)


def test_colours_count_by_brightness(write: Write) -> None:
    colours = Image.new("RGB", (3, 1))
    colours.putdata([(255, 255, 0), (255, 0, 255), (0, 255, 255)])
    write("c.png", encoded(colours, "PNG"))
    # Luma 237, 73 and 201: an average would not tell them apart.
    path = ros(write, [0], image="c.png", free_thresh="0.1")
    assert occupancies(path) == ([0], 1, 0)
    assert "3 coloured pixels are taken by their brightness (Rec. 709)" in notes_of(path)


@pytest.mark.parametrize(
    ("changes", "free"),
    [
        ({"negate": "false"}, [0]),
        ({"negate": "No"}, [0]),
        ({"negate": "-0"}, [0]),
        ({"negate": "TRUE"}, [1]),
        ({"negate": "2"}, [1]),
        ({"mode": "Trinary"}, [0]),
        ({"resolution": "5e-2"}, [0]),
        ({"image": '"map.pgm"'}, [0]),
        ({"image": "./map.pgm # the image"}, [0]),
        ({"author": "[me, {you: 1}]"}, [0]),
        ({"origin": "\n  - 1\n  - 2\n  - 3"}, [0]),
    ],
)
def test_spellings_of_fields(write: Write, changes: dict[str, str], free: list[int]) -> None:
    path = ros(write, [254, 0], **changes)
    assert occupancies(path)[0] == free
    assert read_grid(path).resolution_m == 0.05


def test_an_image_by_its_whole_path_and_a_yml(write: Write, tmp_path: Path) -> None:
    ros(write, [254, 0])
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    path = elsewhere / "map.YML"
    path.write_text(YAML.replace("map.pgm", f"{tmp_path}/map.pgm"))
    assert text_of(read_grid(path).grid) == ".#"
    assert "map.YML:1: `image`: " in message_of(ros(write, [0]).rename(elsewhere / "b.map.YML"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"image": ""}, "map.yaml: found no field `image`, expected the metadata of a ROS map (im"),
        ({"free_thresh": ""}, "map.yaml: found no field `free_thresh`, expected the metadata"),
        ({"image": "none.pgm"}, "map.yaml:6: `image`: none.pgm: no such file, expected an image"),
        ({"image": "."}, "map.yaml:6: `image`: "),
        ({"image": "''"}, "map.yaml:6: `image`: found '', expected the name of a file"),
        ({"image": '"a\\nb"'}, "map.yaml:6: `image`: found 'a\\nb', expected the name of a file"),
        ({"image": "[a]"}, "map.yaml:6: `image`: found a list, expected a plain value"),
        ({"image": "map.yaml"}, "map.yaml:6: `image`: map.yaml: found no image, expected PNG"),
        ({"resolution": "0"}, "map.yaml:6: `resolution`: found 0, expected metres > 0"),
        ({"resolution": "-1"}, "map.yaml:6: `resolution`: found -1, expected metres > 0"),
        ({"resolution": "1:30"}, "map.yaml:6: `resolution`: found '1:30', expected a finite num"),
        ({"resolution": ".inf"}, "map.yaml:6: `resolution`: found '.inf', expected a finite"),
        ({"resolution": "inf"}, "map.yaml:6: `resolution`: found 'inf', expected a finite number"),
        ({"resolution": "{a: 1}"}, "map.yaml:6: `resolution`: found a mapping, expected a plain"),
        ({"origin": "[0, 0]"}, "map.yaml:6: `origin`: found no list of three numbers, expected"),
        ({"origin": "0 0 0"}, "map.yaml:6: `origin`: found no list of three numbers, expected"),
        ({"origin": "[0, 0, [0]]"}, "map.yaml:6: `origin`: found a list, expected a plain value"),
        ({"origin": "[0, 0, x]"}, "map.yaml:6: `origin`: found 'x', expected a finite number"),
        ({"negate": "0.0"}, "map.yaml:6: `negate`: found '0.0', expected 0 or 1"),
        ({"free_thresh": "25"}, "map.yaml:6: `free_thresh`: found 25, expected 0 to 1"),
        (
            {"free_thresh": "0.7"},
            "map.yaml:6: `free_thresh`: found 0.7, expected at most the occupied_thresh of 0.65",
        ),
        ({"mode": "binary"}, "map.yaml:7: `mode`: found 'binary', expected trinary, scale, raw"),
        ({"more": "[1"}, "map.yaml:8: expected well-formed YAML, found expected ',' or ']'"),
        ({"more": "a\nimage: b"}, "map.yaml:8: found `image` again, expected it once"),
        ({"more": "\0"}, "map.yaml:7: expected well-formed YAML, found a character 0x0"),
        ({"more": "x\n--- 1"}, "map.yaml:8: expected well-formed YAML, found but found another"),
        ({"more": '"\\UFFFFFFFF"'}, "map.yaml: expected well-formed YAML, found what gives a"),
        ({"more": "[" * 5000}, "map.yaml:7: expected well-formed YAML, found deep nesting"),
        ({"more": "x" * 70_000}, "map.yaml: found 70115 bytes, expected the metadata of a ROS map"),
    ],
)
def test_malformed_ros_maps(write: Write, changes: dict[str, str], message: str) -> None:
    text = message_of(ros(write, [254, 0], **changes))
    assert text.startswith(message)


@pytest.mark.parametrize("text", ["- a\n- b\n", "# only a comment\n", "word", "1"])
def test_yaml_without_fields(write: Write, text: str) -> None:
    assert message_of(write("a.yaml", text)).startswith(
        "a.yaml: found no fields, expected the metadata of a ROS map (image, resolution,"
    )


# Sub-cells over pixels ---------------------------------------------------------------------------


def laid_over(blocked: np.ndarray, ratio: Fraction) -> list[str]:
    """Lay sub-cells of ``ratio`` pixels over pixels, pixel by pixel and exactly."""
    rows, cols = (math.floor(side / ratio) for side in blocked.shape)

    def under(index: int, side: int) -> list[int]:
        near, far = index * ratio, (index + 1) * ratio
        return [pixel for pixel in range(side) if pixel < far and pixel + 1 > near]

    return [
        "".join(
            ".#"[
                any(
                    blocked[y, x]
                    for y in under(row, blocked.shape[0])
                    for x in under(col, blocked.shape[1])
                )
            ]
            for col in range(cols)
        )
        for row in range(rows)
    ]


@settings(max_examples=80)
@given(
    grids(most=8),
    st.fractions(min_value=Fraction(1, 4), max_value=5, max_denominator=12),
    st.sampled_from([1.0, 0.05, 0.1, 0.3, 1 / 3, 1e-9, 12345.678]),
)
def test_sub_cells_are_blocked_where_any_pixel_is(
    tmp_path_factory: pytest.TempPathFactory, grid: Grid, ratio: Fraction, resolution_m: float
) -> None:
    path = tmp_path_factory.getbasetemp() / "laid.txt"
    path.write_text(text_of(grid))
    blocked = np.frombuffer(grid.cells(), np.uint8).reshape(grid.rows, grid.cols)
    expected = laid_over(blocked, ratio)
    cell_m = resolution_m * float(ratio)
    try:
        found = read_grid(path, cell_m=cell_m, resolution_m=resolution_m)
    except MapError:
        assert not any("." in row for row in expected)
        return
    assert text_of(found.grid) == "\n".join(expected)
    assert (found.grid.cell_m, found.resolution_m) == (cell_m, resolution_m)
    left_out = any(side % ratio for side in (grid.rows, grid.cols))
    assert any("left out" in note for note in found.notes) == left_out


@pytest.mark.parametrize("resolution_m", [1.0, 0.1, 0.05, 0.03, 1 / 3, 0.7])
@pytest.mark.parametrize("pixels", [2, 3, 7, 10])
def test_rounding_never_reaches_a_further_pixel(
    write: Write, resolution_m: float, pixels: int
) -> None:
    blocked = np.random.default_rng(pixels).random(3000) < 0.2
    row = "".join(".#"[bit] for bit in blocked.astype(int))
    path = write("long.txt", "\n".join([row] * pixels))
    whole = 3000 // pixels * pixels
    expected = blocked[:whole].reshape(-1, pixels).any(axis=1)
    product = resolution_m * pixels
    for cell_m in (product, sum([resolution_m] * pixels), round(product, 12)):
        found = read_grid(path, cell_m=cell_m, resolution_m=resolution_m)
        assert (found.grid.rows, found.grid.cols) == (1, whole // pixels)
        assert (free_of(found)[0] == ~expected).all()


def test_half_a_character_gives_two_by_two(write: Write) -> None:
    path = write("a.txt", ".#\n..\n#.")
    found = read_grid(path, cell_m=0.5)
    assert text_of(found.grid) == "..##\n..##\n....\n....\n##..\n##.."
    assert (found.grid.cell_m, found.resolution_m, found.notes) == (0.5, 1, ())
    assert text_of(read_grid(path, cell_m=0.35, resolution_m=0.7).grid) == text_of(found.grid)


def test_what_does_not_fill_a_sub_cell_is_left_out_and_said(write: Write) -> None:
    path = write("a.txt", "..#\n..#\n###")
    found = read_grid(path, cell_m=2)
    assert text_of(found.grid) == "."
    assert found.notes == (
        "left out, too few for a sub-cell: the last row and the last column of characters",
        "1 x 1 sub-cells: the last row and the last column belong to no coarse cell",
    )
    notes = read_grid(write("b.txt", ".....\n.....\n....."), cell_m=1.5).notes
    assert notes[0].endswith("too few for a sub-cell: the last 0.5 columns of characters")


def test_a_resolution_that_is_given_wins_over_that_of_the_file(write: Write) -> None:
    path = ros(write, [254, 254, 0, 254])
    found = read_grid(path, resolution_m=0.1, cell_m=0.05)
    assert text_of(found.grid) == "....##..\n....##.."
    assert (found.grid.cell_m, found.resolution_m) == (0.05, 0.1)
    assert found.notes == ("resolution of 0.1 m as asked for, not 0.05 m as in the file",)
    assert "resolution" not in "".join(read_grid(path, resolution_m=0.05).notes)


@pytest.mark.parametrize(
    ("scale", "message"),
    [
        ({"cell_m": 0.0}, "a.txt: `cell_m`: found 0, expected a finite number of metres > 0"),
        ({"cell_m": -1.0}, "a.txt: `cell_m`: found -1, expected a finite number of metres > 0"),
        ({"cell_m": math.nan}, "a.txt: `cell_m`: found nan, expected a finite number"),
        ({"resolution_m": math.inf}, "a.txt: `resolution_m`: found inf, expected a finite"),
        ({"cell_m": 3.0}, "a.txt: found 2 x 3 m, expected at least one sub-cell of 3 m"),
        ({"cell_m": 1e300}, "a.txt: found 2 x 3 m, expected at least one sub-cell of 1e+300 m"),
        ({"cell_m": 1e308, "resolution_m": 1e-308}, "a.txt: found 2e-308 x 3e-308 m, expected"),
        ({"cell_m": 1e-4}, "a.txt: found 20000 x 30000 sub-cells of 0.0001 m, expected at most 64"),
        ({"cell_m": 5e-324}, "a.txt: found "),
        ({"cell_m": 5e-324, "resolution_m": 1e300}, "a.txt: found inf x inf sub-cells of 4.94"),
        ({"cell_m": 2.0}, "a.txt: found all 1 x 1 sub-cells of 2 m blocked, expected a free one"),
    ],
)
def test_scales_that_give_no_grid(write: Write, scale: dict[str, float], message: str) -> None:
    assert message_of(write("a.txt", "#..\n..."), **scale).startswith(message)


def test_as_many_sub_cells_as_allowed(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write("a.txt", "...\n...")
    monkeypatch.setattr(grid_readers, "CELLS_MOST", 6)
    assert len(read_grid(path).grid.free_cells()) == 6
    assert "found 4 x 6 sub-cells of 0.5 m, expected at most 6" in message_of(path, cell_m=0.5)
    monkeypatch.setattr(grid_readers, "CELLS_MOST", 5)
    assert message_of(path) == "a.txt: found 2 x 3 characters, expected at most 5"


# Any bytes ---------------------------------------------------------------------------------------


@cache
def valid_files() -> dict[str, tuple[bytes, ...]]:
    """Return small valid files for each suffix, to spoil."""
    grey = Image.fromarray(SHADES)
    colour = grey.convert("RGB")
    pixels = SHADES.tobytes()
    pnm = tuple(
        b"P%d\n# c\n4 2\n255\n" % kind
        + (pixels * 3 if kind > 4 else " ".join(map(str, [*pixels] * 3)).encode())
        for kind in (2, 3, 5, 6)
    )
    return {
        ".map": ((HEADER + ".G@\nTSO\n").encode(),),
        ".yaml": (YAML.encode(), YAML.encode() + b"mode: scale\n"),
        ".txt": (b"..#\n##.\n",),
        ".pgm": (*pnm, b"P1\n4 2\n0 1 0 1 0 0 0 0\n", encoded(grey.convert("1"), "PPM")),
        ".png": (
            encoded(grey, "PNG"),
            encoded(colour.convert("RGBA"), "PNG"),
            encoded(grey.convert("P"), "PNG", transparency=3),
            encoded(Image.fromarray(SHADES.astype(np.uint16) * 257), "PNG"),
        ),
        ".bmp": (encoded(grey, "BMP"), encoded(colour, "BMP")),
        ".gif": (encoded(grey, "GIF"), encoded(grey, "GIF", save_all=True, append_images=[grey])),
        ".jpg": (encoded(grey, "JPEG"), encoded(colour.convert("CMYK"), "JPEG")),
        # Not compressed: libtiff tells stderr of each damage that it meets.
        ".tif": (encoded(grey, "TIFF"), encoded(colour, "TIFF")),
        ".webp": (encoded(colour, "WEBP"), encoded(colour, "WEBP", lossless=True)),
    }


PIECES = [
    *(b"\n", b"\r", b"\0", b"\x80", b"\xff", b"\xef\xbb\xbf", b"0", b"9" * 12, b"-1", b"1e999"),
    *(b".nan", b"[", b"{", b"&a [*a]", b"? ", b": ", b"- ", b"|", b"%YAML 9.9\n", b"---\n"),
    *(b'"\\ud800', b'"\\UFFFFFFFF"', b"!!python/name:os.system ", b".", b"#", b"@", b"P5 1 1 1 "),
]


@st.composite
def spoilt_files(draw: st.DrawFn) -> tuple[str, bytes]:
    files = valid_files()
    suffix = draw(st.sampled_from(sorted(files)))
    data = bytearray(draw(st.sampled_from(files[suffix])))
    for _ in range(draw(st.integers(0, 5))):
        at = draw(st.integers(0, len(data)))
        match draw(st.sampled_from(["flip", "set", "drop", "insert", "double", "cut"])):
            case "flip":
                data[at : at + 1] = bytes(
                    byte ^ 1 << draw(st.integers(0, 7)) for byte in data[at : at + 1]
                )
            case "set":
                data[at : at + 1] = draw(st.sampled_from(PIECES))
            case "drop":
                del data[at : at + draw(st.integers(1, 9))]
            case "insert":
                data[at:at] = draw(st.sampled_from(PIECES) | st.binary(max_size=4))
            case "double":
                data[at:at] = data[at : at + draw(st.integers(1, 20))]
            case _:
                del data[at:]
    return suffix, bytes(data)


@settings(max_examples=150)
@given(
    spoilt_files() | st.tuples(st.sampled_from(sorted(GRID_READERS)), st.binary(max_size=40)),
    st.sampled_from([None, 0.02, 1.3]),
)
@example((".yaml", YAML.encode() + b"a: !!python/object/apply:os.system [ls]\n"), None)
@example((".txt", "‎.".encode()), None)
def test_any_bytes_give_a_grid_or_a_map_error_of_one_line(
    tmp_path_factory: pytest.TempPathFactory, case: tuple[str, bytes], cell_m: float | None
) -> None:
    suffix, data = case
    folder = tmp_path_factory.getbasetemp() / "spoilt"
    folder.mkdir(exist_ok=True)
    (folder / "map.pgm").write_bytes(b"P5 4 2 255\n" + SHADES.tobytes())
    path = folder / f"spoilt{suffix}"
    path.write_bytes(data)
    try:
        found = read_grid(path, cell_m=cell_m)
    except MapError as error:
        text = str(error)
        assert text.startswith(str(path))
        assert len(text.splitlines()) == 1
        assert len(text) - text.count(str(folder)) * len(str(folder)) < 300
    else:
        assert found.grid.free_cells()
        assert all(len(note.splitlines()) == 1 for note in found.notes)


# Files -------------------------------------------------------------------------------------------


def test_maps_of_every_suffix_go_to_their_reader(write: Write, tmp_path: Path) -> None:
    assert isinstance(read_map(write("a.edges", "a b\n")), PortGraph)
    assert isinstance(read_map(write("a.TXT", "..\n")), GridFile)
    grid = read_map(write("b.txt", "..\n"), cell_m=0.5, resolution_m=0.5)
    assert isinstance(grid, GridFile)
    assert grid.grid.cell_m == 0.5

    def message(name: str, **scale: float) -> str:
        with pytest.raises(MapError) as caught:
            read_map(tmp_path / name, **scale)
        return str(caught.value).replace(f"{tmp_path}/", "")

    assert message("a.edges", cell_m=1) == "a.edges: `cell_m`: found 1, expected none for a graph"
    assert message("a.edges", resolution_m=2).startswith("a.edges: `resolution_m`: found 2, exp")
    assert message("none.map") == "none.map: no such file, expected a grid file"
    assert message("none.edges") == "none.edges: no such file, expected a graph file"
    assert message("none.doc") == "none.doc: no such file, expected a map file"
    assert message("").endswith("is a directory, expected a map file")
    write("a.doc", "..")
    known = ", ".join([*READERS, *GRID_READERS])
    assert message("a.doc") == f"a.doc: unknown suffix '.doc', expected one of {known}"
    (tmp_path / "folder.map").mkdir()
    assert message("folder.map") == "folder.map: is a directory, expected a grid file"
    with pytest.raises(MapError, match=r"unknown suffix '\.edges', expected one of \.map, "):
        read_grid(tmp_path / "a.edges")


# What SOURCES.md says of the real maps: columns, rows, free, components and the largest of them,
# complete and partial coarse cells, components of the complete ones.
REAL = {
    "lsmcpp/gridmaps/AR0205SR.map": (220, 220, 13088, 1, 13088, 3272, 0, 1),
    "lsmcpp/gridmaps/floor_large.map": (60, 60, 3040, 1, 3040, 760, 0, 1),
    "lsmcpp/gridmaps/floor_medium.map": (40, 40, 1296, 1, 1296, 324, 0, 1),
    "lsmcpp/gridmaps/floor_small.map": (10, 20, 184, 1, 184, 46, 0, 1),
    "lsmcpp/gridmaps/ht_chantry.map": (150, 150, 8136, 1, 8136, 2034, 0, 1),
    "lsmcpp/gridmaps/ht_chantry/0.091-0.map": (150, 150, 7397, 1, 7397, 1391, 643, 69),
    "lsmcpp/gridmaps/terrain_small.map": (20, 20, 320, 1, 320, 80, 0, 1),
    "movingai/Berlin_1_256.map": (256, 256, 47540, 10, 46880, 10971, 1794, 12),
    "movingai/arena.map": (49, 49, 2054, 1, 2054, 463, 94, 1),
    "movingai/den312d.map": (65, 81, 2445, 1, 2445, 483, 250, 3),
    "movingai/maze-32-32-2.map": (32, 32, 666, 1, 666, 72, 184, 20),
    "movingai/random-32-32-20.map": (32, 32, 819, 1, 819, 106, 146, 30),
    "movingai/room-32-32-4.map": (32, 32, 682, 1, 682, 64, 192, 64),
    "movingai/warehouse-10-20-10-2-1.map": (161, 63, 5699, 1, 5699, 720, 1310, 2),
    "ros/fetch_3_1_16_keepout/3_1_16_keepout.yaml": (
        *(958, 982, 155634, 239, 155009),
        *(37507, 2876, 15),
    ),
    "ros/nav2_depot/depot.yaml": (604, 307, 179481, 115, 174677, 43500, 2347, 68),
    "ros/turtlebot3_world/map.yaml": (384, 384, 7939, 4, 7936, 1902, 158, 1),
    "ros/willow_garage/willow-2010-02-18-0.10.yaml": (
        *(566, 608, 109207, 187, 108671),
        *(24161, 6072, 221),
    ),
    "stage/SRI-AIC-kwing.png": (856, 293, 59425, 904, 56503, 12688, 4511, 124),
    "stage/autolab.png": (809, 689, 533216, 4, 334090, 131722, 2416, 5),
    "stage/cave.png": (500, 500, 244730, 8, 190933, 60628, 1109, 8),
}


@pytest.mark.parametrize("name", REAL)
def test_real_maps(shared: Callable[..., Path], name: str) -> None:
    path = shared("maps", *name.split("/"))
    found = read_grid(path)
    facts = facts_of(path, found)
    assert isinstance(facts, GridFacts)
    assert (
        *(facts.cols, facts.rows, facts.free, facts.components, facts.largest),
        *(facts.complete, facts.partial, facts.coarse_components),
    ) == REAL[name]
    assert facts.blocked == facts.rows * facts.cols - facts.free


def test_real_ros_maps_carry_scale_origin_and_notes(shared: Callable[..., Path]) -> None:
    found = read_grid(shared("maps", "ros", "turtlebot3_world", "map.yaml"))
    assert (found.resolution_m, found.grid.cell_m, found.origin) == (0.05, 0.05, (-10, -10, 0))
    assert found.notes == ("138722 unknown pixels count as blocked",)
    assert read_grid(shared("maps", "ros", "nav2_depot", "depot.yaml")).notes == (
        "307 x 604 sub-cells: the last row belongs to no coarse cell",
    )
    # Row 0 is the top of the image, so that of the largest y.
    willow = shared("maps", "ros", "willow_garage", "willow-2010-02-18-0.10.yaml")
    top = read_grid(willow).grid.free_cells()[0]
    image = np.asarray(Image.open(willow.with_suffix(".pgm")))
    assert top == tuple(np.argwhere(image >= FREE_GREY)[0])


def test_every_shared_file_is_read_or_refused_in_one_line(shared: Callable[..., Path]) -> None:
    read, refused = 0, {}
    for path in sorted(shared("maps").rglob("*")):
        try:
            read_map(path)
            read += 1
        except MapError as error:
            refused[path] = str(error)
    assert read >= 30
    for path, text in refused.items():
        assert text.startswith(str(path))
        assert len(text.splitlines()) == 1
    for name in ("office", "clinic"):
        path = shared("maps", "graphs", "rmf", f"{name}.building.yaml")
        with pytest.raises(MapError, match="expected the metadata of a ROS map"):
            read_map(path)


# Generated grids ---------------------------------------------------------------------------------


def assert_coarse_and_connected(grid: Grid, rows: int, cols: int) -> int:
    """Check what holds for all generated grids; return the number of free coarse cells."""
    assert (grid.rows, grid.cols, grid.cell_m) == (2 * rows, 2 * cols, 1)
    complete = grid.complete_cells()
    assert len(grid.free_cells()) == 4 * len(complete)
    assert len(grid.reachable_cells(complete[:1])) == len(complete) > 0
    return len(complete)


@given(st.integers(1, 7), st.integers(1, 7), st.data())
def test_random_obstacles_are_as_many_as_asked_and_cut_nothing_off(
    rows: int, cols: int, data: st.DataObject
) -> None:
    obstacles = data.draw(st.integers(0, rows * cols - 1))
    seed = data.draw(st.integers(0, 99))
    grid = random_obstacles(rows, cols, obstacles, Random(seed))
    assert assert_coarse_and_connected(grid, rows, cols) == rows * cols - obstacles
    assert random_obstacles(rows, cols, obstacles, Random(seed)) == grid


def test_random_obstacles_fall_everywhere() -> None:
    blocked = [0] * 9
    for seed in range(300):
        grid = random_obstacles(3, 3, 1, Random(seed))
        blocked[[not grid.is_complete(*divmod(cell, 3)) for cell in range(9)].index(True)] += 1
    assert min(blocked) > 15
    assert random_obstacles(1, 4, 3, Random(1)).complete_cells()
    assert_coarse_and_connected(random_obstacles(20, 30, 160, Random(1)), 20, 30)


@given(st.integers(1, 30), st.integers(1, 30), st.integers(0, 999))
def test_rooms_are_connected(rows: int, cols: int, seed: int) -> None:
    grid = rooms(rows, cols, Random(seed))
    assert_coarse_and_connected(grid, rows, cols)
    assert rooms(rows, cols, Random(seed)) == grid


def test_rooms_have_walls() -> None:
    free = assert_coarse_and_connected(rooms(30, 40, Random(1)), 30, 40)
    assert 600 < free < 1080


@given(st.integers(1, 24), st.integers(1, 24))
def test_warehouses_are_connected(rows: int, cols: int) -> None:
    assert_coarse_and_connected(warehouse(rows, cols), rows, cols)


def test_a_warehouse() -> None:
    coarse = text_of(warehouse(6, 12)).splitlines()[::2]
    assert [row[::2] for row in coarse] == [
        "............",
        ".########.#.",
        "............",
        ".########.#.",
        "............",
        "............",
    ]


@given(st.integers(1, 20), st.integers(1, 20), st.sampled_from((0, 0.2, 0.35, 0.75)), st.data())
def test_rectangles_fill_as_much_as_asked_and_cut_nothing_off(
    rows: int, cols: int, ratio: float, data: st.DataObject
) -> None:
    seed = data.draw(st.integers(0, 99))
    grid = rectangles(rows, cols, ratio, Random(seed))
    free = grid.free_cells()
    assert (grid.rows, grid.cols) == (rows, cols)
    assert grid.reachable(free[:1]) == set(free)
    blocked = rows * cols - len(free)
    assert min(ratio * rows * cols, rows * cols - 1) <= blocked
    assert blocked < max(1, ratio * rows * cols) + 64
    assert rectangles(rows, cols, ratio, Random(seed)) == grid


def test_a_rectangle_has_sides_up_to_eight() -> None:
    sides = set()
    for seed in range(400):
        grid = rectangles(30, 30, 1 / 900, Random(seed))
        free = set(grid.free_cells())
        cells = [(row, col) for row in range(30) for col in range(30) if (row, col) not in free]
        rows, cols = ({cell[axis] for cell in cells} for axis in (0, 1))
        assert len(cells) == len(rows) * len(cols)
        sides.add((len(rows), len(cols)))
    assert {side for pair in sides for side in pair} == set(range(1, 9))
    # Reference: Sec. 5 of the parent-child paper; sides uniform from 1 to 8.


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: random_obstacles(2, 2, 4, Random(1)), "obstacles: found 4, expected 0 to 3"),
        (lambda: random_obstacles(2, 2, -1, Random(1)), "obstacles: found -1, expected 0 to 3"),
        (lambda: random_obstacles(0, 2, 0, Random(1)), "rows: found 0, expected at least 1"),
        (lambda: rooms(1, 0, Random(1)), "cols: found 0, expected at least 1"),
        (lambda: warehouse(-1, 1), "rows: found -1, expected at least 1"),
        (lambda: rectangles(1, 0, 0, Random(1)), "cols: found 0, expected at least 1"),
        (lambda: rectangles(2, 2, 0.8, Random(1)), "ratio: found 0.8, expected 0 to 0.75"),
    ],
)
def test_generators_refuse_what_cannot_be(call: Callable[[], Grid], message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}$"):
        call()


# Facts -------------------------------------------------------------------------------------------


def components(
    cells: set[tuple[int, int]], reach: Callable[..., set[tuple[int, int]]]
) -> list[int]:
    sizes = []
    while cells:
        part = reach([min(cells)])
        sizes.append(len(part))
        cells = cells - part
    return sizes


@settings(max_examples=60)
@given(grids())
def test_facts_agree_with_floods(grid: Grid) -> None:
    if not grid.free_cells():
        return
    facts = facts_of(Path("a.txt"), GridFile(grid, "text", 2.0, None, ("so", "be it")))
    assert isinstance(facts, GridFacts)
    parts = components(set(grid.free_cells()), grid.reachable)
    coarse = components(set(grid.complete_cells()), grid.reachable_cells)
    assert (facts.components, facts.largest, facts.free) == (len(parts), max(parts), sum(parts))
    assert (facts.coarse_components, facts.coarse_largest) == (len(coarse), max(coarse, default=0))
    assert facts.complete == sum(coarse)
    assert facts.partial == sum(
        0 < sum(grid.is_free(*sub) for sub in sub_cells((row, col))) < 4
        for row in range(grid.rows // 2)
        for col in range(grid.cols // 2)
    )
    assert (facts.width_m, facts.height_m) == (grid.cols * grid.cell_m, grid.rows * grid.cell_m)
    text = list(describe(facts))
    assert text[0].startswith(f"a.txt: grid (text), {grid.rows} rows x {grid.cols} columns")
    assert text[-2:] == ["  note: so", "  note: be it"]


def test_the_command_says_what_a_grid_is_and_draws_it(
    write: Write,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    write("a.txt", "..#\n...\n#..")
    assert main(["map", "a.txt", "--cell-m", "0.5", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["kind"], facts["format"], facts["rows"], facts["free"]) == ("grid", "text", 6, 28)
    assert (facts["cell_m"], facts["resolution_m"], facts["width_m"]) == (0.5, 1, 3)
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    image = encoded(Image.fromarray(SHADES), "PNG")
    write("b.png", image)
    assert main(["map", "b.png", "--resolution-m", "0.25"]) == 0
    said = capsys.readouterr().out
    assert "b.png: grid (image), 2 rows x 4 columns of sub-cells, 1 m wide, 0.5 m high" in said
    assert "note: 4 grey pixels (1 to 205 of 255) count as blocked" in said
    assert (tmp_path / "b.png").read_bytes() == image
    assert (tmp_path / "b-map.png").exists()
    assert main(["map", "b.png", "--picture", "b.png"]) == 2
    assert "--picture b.png: is the map itself" in capsys.readouterr().err
    assert main(["map", "a.txt", "--cell-m", "-1"]) == 2
    assert capsys.readouterr().err == (
        "canopy: a.txt: `cell_m`: found -1, expected a finite number of metres > 0\n"
    )
