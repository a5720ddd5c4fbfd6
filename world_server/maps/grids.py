"""Readers of grid files: MovingAI ``.map``, ROS map_server ``.yaml``, images and text.

Every format comes down to pixels (or characters) that are free or blocked, row 0 at the top, with a
resolution in metres. The grid is made of sub-cells of the size of a robot: by default one a pixel,
or, with ``cell_m``, squares laid over the pixels from the top left corner; a sub-cell is blocked if
any pixel under it is. Whatever the bytes are, a reader gives a grid or raises
`protocol.errors.MapError` with one line: file, place, found, expected.

What counts as free:

- MovingAI: ``.``, ``G`` and ``S`` (swamp); blocked: ``@``, ``O``, ``T`` and ``W`` (water).
- ROS: what nav2's map_server (``nav2_map_server/src/map_io.cpp`` at a3a97043) calls free, which is
  occupancy 0; everything else, unknown too, is blocked. Its rules, in single precision as there:
  grey is the Rec. 709 luma of eight bits; ``trinary`` and ``scale`` take ``1 - grey / 255`` (without
  the ``1 -`` if ``negate``) and compare it inclusively with both thresholds, and a pixel that is not
  fully opaque is unknown; ``scale`` maps what lies between to 0 to 100; ``raw`` takes the grey value
  itself and knows neither thresholds nor transparency. Departure: thresholds that exclude each other
  (outside 0 to 1, or free above occupied) are refused.
- Images: near white, grey 206 or more after compositing on black; this is what a ROS map with the
  usual ``free_thresh: 0.196`` calls free, and leaves out the grey (128, 205) that means unknown.
- Text: ``.``; blocked: ``#``.
"""

import io
import math
import re
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
import yaml
from msgspec import Struct
from PIL import Image, UnidentifiedImageError

from protocol.errors import MapError
from protocol.graph import PortGraph
from protocol.grid import Grid
from world_server.maps.readers import (
    READERS,
    decode,
    finite,
    lines_of,
    load,
    one_line,
    read_graph,
    show,
)

Kind = Literal["movingai", "ros", "image", "text"]
Pixels = npt.NDArray[np.uint8]
"""Rows of grey values, or of bits that are 1 where a pixel is blocked."""

CELLS_MOST = 64_000_000
"""Pixels of an image and sub-cells of a grid that are still read."""
FREE_GREY = 206
"""Least grey value of a free pixel of a plain image: the least that ROS's 0.196 leaves free."""
ROUNDING = 1e-6
"""How much of a pixel or of a sub-cell, whichever is smaller, is put down to rounding."""
YAML_MOST = 65_536
"""Bytes of a ROS map's metadata; real ones have 150."""
YAML_DEEPEST = 20
"""Nodes within nodes; real metadata has 3, and PyYAML's time grows with the square of this."""

IMAGE_FORMATS = ("PNG", "PPM", "BMP", "GIF", "JPEG", "TIFF", "WEBP")
"""Pillow's names of the formats that are tried; by content, whatever the suffix."""
LUMA = (0.212656, 0.715158, 0.072186)
"""Weights of red, green and blue in Rec. 709 luma, as ImageMagick has them."""
ROS_FIELDS = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")
ROS_MODES = ("trinary", "scale", "raw")
TRUE_WORDS = frozenset({"y", "yes", "true", "on"})
FALSE_WORDS = frozenset({"n", "no", "false", "off"})

_PNM_START = re.compile(rb"P[2356][\s#]")
_PNM_GAP = rb"(?:\s|#[^\r\n]*[\r\n])+"
_PNM_HEADER = re.compile(
    rb"P([2356])" + _PNM_GAP + rb"(\d{1,9})" + _PNM_GAP + rb"(\d{1,9})" + _PNM_GAP + rb"(\d{1,9})\s"
)


class GridFile(Struct, frozen=True):
    """A grid, and the file it comes from.

    Attributes:
        grid: the sub-cells, with their side in metres.
        kind: format of the file.
        resolution_m: side of a pixel or character, metres.
        origin: pose of the lower left pixel: x and y in metres, yaw in radians; ROS maps only.
        notes: what the reader should know of how the file was taken, a line each.
    """

    grid: Grid
    kind: Kind
    resolution_m: float
    origin: tuple[float, float, float] | None
    notes: tuple[str, ...]


class _Raster(Struct):
    """What a file holds, before sub-cells are laid over it.

    Attributes:
        kind: format of the file.
        blocked: 1 where a pixel is blocked.
        notes: lines for `GridFile.notes`.
        resolution_m: side of a pixel if the file tells it.
        origin: as in `GridFile`.
    """

    kind: Kind
    blocked: Pixels
    notes: list[str]
    resolution_m: float | None = None
    origin: tuple[float, float, float] | None = None


class _Picture(Struct):
    """A decoded image.

    Attributes:
        grey: brightness of each pixel.
        alpha: 255 where a pixel is opaque; ``None`` if all are.
        notes: lines for `GridFile.notes`.
    """

    grey: Pixels
    alpha: Pixels | None
    notes: list[str]


def read_map(
    path: Path, *, cell_m: float | None = None, resolution_m: float | None = None
) -> PortGraph | GridFile:
    """Read a map, a graph or a grid, from a file whose suffix tells its format.

    Args:
        path: A file with a suffix of `READERS` or of `GRID_READERS` (any case).
        cell_m: As for `read_grid`; grids only.
        resolution_m: As for `read_grid`; grids only.

    Returns:
        The graph or the grid.

    Raises:
        MapError: If the file cannot be read, or a graph is asked for cells.
    """
    suffix = path.suffix.lower()
    if suffix in GRID_READERS:
        return read_grid(path, cell_m=cell_m, resolution_m=resolution_m)
    if suffix not in READERS:
        load(path, "a map file", "a map", [*READERS, *GRID_READERS])
    graph = read_graph(path)
    for name, given in (("cell_m", cell_m), ("resolution_m", resolution_m)):
        if given is not None:
            raise MapError(f"{path}: `{name}`: found {given:g}, expected none for a graph")
    return graph


def read_grid(
    path: Path, *, cell_m: float | None = None, resolution_m: float | None = None
) -> GridFile:
    """Read a grid from a file whose suffix tells its format.

    Args:
        path: A file with a suffix of `GRID_READERS` (any case); a ROS map is its ``.yaml``, with
            the image beside it.
        cell_m: Side of a sub-cell, the size of a robot, metres; by default the resolution.
            Sub-cell ``(i, j)`` spans the metres from ``i * cell_m`` to ``(i + 1) * cell_m`` below
            the top of the image, and so on for ``j`` from the left.
        resolution_m: Side of a pixel or character, metres; by default what the file says, or 1.

    Returns:
        The grid, all components of it.

    Raises:
        MapError: If the file cannot be read, or gives no free sub-cell or more than `CELLS_MOST`.
    """
    data = load(path, "a grid file", "a grid with at least one free cell", GRID_READERS)
    for name, given in (("cell_m", cell_m), ("resolution_m", resolution_m)):
        if given is not None and not 0 < given < math.inf:
            raise MapError(
                f"{path}: `{name}`: found {given:g}, expected a finite number of metres > 0"
            )
    raster = GRID_READERS[path.suffix.lower()](path, data)
    notes = raster.notes
    if raster.resolution_m is not None and resolution_m not in {None, raster.resolution_m}:
        notes.append(
            f"resolution of {resolution_m:g} m as asked for, not {raster.resolution_m:g} m as in "
            "the file"
        )
    if raster.kind == "image" and resolution_m is None:
        notes.append("an image tells no scale: a pixel is taken as 1 m")
    resolution_m = resolution_m or raster.resolution_m or 1.0
    cell_m = cell_m or resolution_m
    blocked = _resample(path, raster, resolution_m, cell_m)
    rows, cols = blocked.shape
    if blocked.all():
        raise MapError(
            f"{path}: found all {rows} x {cols} sub-cells of {cell_m:g} m blocked, expected a free "
            "one"
        )
    odd = [name for name, side in (("row", rows), ("column", cols)) if side % 2]
    if odd:
        belong = "belongs" if len(odd) == 1 else "belong"
        notes.append(
            f"{rows} x {cols} sub-cells: the last {' and the last '.join(odd)} {belong} to no "
            "coarse cell"
        )
    grid = Grid(rows, cols, blocked.tobytes(), cell_m)
    return GridFile(grid, raster.kind, resolution_m, raster.origin, tuple(notes))


# Sub-cells over pixels ---------------------------------------------------------------------------


def _resample(path: Path, raster: _Raster, resolution_m: float, cell_m: float) -> Pixels:
    """Lay sub-cells over pixels from the top left corner; those that stick out are left out."""
    ratio = cell_m / resolution_m
    rounding = ROUNDING * min(1.0, ratio)
    sides = [(side + rounding) / ratio if ratio else math.inf for side in raster.blocked.shape]
    if min(sides) < 1:
        height_m, width_m = (side * resolution_m for side in raster.blocked.shape)
        raise MapError(
            f"{path}: found {height_m:g} x {width_m:g} m, expected at least one sub-cell of "
            f"{cell_m:g} m"
        )
    rows, cols = sides
    if max(sides) > CELLS_MOST or int(rows) * int(cols) > CELLS_MOST:
        raise MapError(
            f"{path}: found {np.floor(rows):.9g} x {np.floor(cols):.9g} sub-cells of {cell_m:g} m, "
            f"expected at most {CELLS_MOST}"
        )
    blocked = raster.blocked
    rests = []
    for side, name in zip(sides, ("row", "column"), strict=True):
        pixels = len(blocked)
        count = int(side)
        steps = np.arange(count)
        first = np.floor(steps * ratio + rounding).astype(np.int64)
        end = np.ceil((steps + 1) * ratio - rounding).astype(np.int64).clip(max=pixels)
        blocked = _any_between(blocked, first, end).T
        rest = pixels - count * ratio
        if rest > ROUNDING:
            rests.append(f"the last {name}" if rest == 1 else f"the last {rest:g} {name}s")
    if rests:
        unit = "pixels" if raster.kind in {"ros", "image"} else "characters"
        left_out = " and ".join(rests)
        raster.notes.append(f"left out, too few for a sub-cell: {left_out} of {unit}")
    return blocked


def _any_between(
    blocked: Pixels, first: npt.NDArray[np.int64], end: npt.NDArray[np.int64]
) -> Pixels:
    """Tell for each range of rows, column by column, whether any pixel of it is blocked."""
    if (end - first).max() <= 2:
        return blocked[first] | blocked[end - 1]
    # A rectangle holds a blocked pixel if one of its columns does: so the table of sums, which
    # would otherwise need both axes at once, is one of sums over rows, built once for each axis.
    sums = np.zeros((len(blocked) + 1, blocked.shape[1]), np.int32)
    np.cumsum(blocked, axis=0, dtype=np.int32, out=sums[1:])
    some: Pixels = (sums[end] != sums[first]).astype(np.uint8)
    return some


# Characters --------------------------------------------------------------------------------------


def _read_movingai(path: Path, data: bytes) -> _Raster:
    """Read a MovingAI benchmark map."""
    lines = _without_blank_end(lines_of(path, data))
    expected = "`type`, `height`, `width`, then `map`"
    header: dict[str, str] = {}
    for index, line in enumerate(lines, start=1):
        where = f"{path}:{index}"
        match line.split():
            case ["type" | "height" | "width" as name, value]:
                if name in header:
                    raise MapError(f"{where}: found `{name}` again, expected {expected}")
                header[name] = value
                if name != "type":
                    _side(where, name, value)
            case ["map"]:
                top = index
                break
            case _:
                raise MapError(f"{where}: found {show(line)}, expected {expected}")
    else:
        raise MapError(f"{path}: found no line `map`, expected {expected}")
    for name in ("type", "height", "width"):
        if name not in header:
            raise MapError(f"{path}:{top}: found `map` before `{name}`, expected {expected}")
    height, width = int(header["height"]), int(header["width"])
    _limit(path, height, width, "characters")
    rows = lines[top:]
    if len(rows) != height:
        raise MapError(f"{path}: found {len(rows)} rows below `map`, expected {height}")
    notes = []
    blocked = _characters(path, rows, top, width, ".GS", "@OTW")
    if swamp := sum(row.count("S") for row in rows):
        notes.append(f"{swamp} swamp cells (S) count as free")
    if water := sum(row.count("W") for row in rows):
        notes.append(f"{water} water cells (W) count as blocked")
    return _Raster("movingai", blocked, notes)


def _side(where: str, name: str, value: str) -> None:
    """Check a size in a header."""
    if not re.fullmatch("[0-9]{1,9}", value) or int(value) == 0:
        raise MapError(f"{where}: `{name}`: found {show(value)}, expected a whole number > 0")


def _read_text(path: Path, data: bytes) -> _Raster:
    """Read rows of ``.`` and ``#``, a character a sub-cell."""
    lines = _without_blank_end(lines_of(path, data))
    return _Raster("text", _characters(path, lines, 0, len(lines[0]), ".", "#"), [])


def _without_blank_end(lines: list[str]) -> list[str]:
    """Drop blank lines from the end of a file that holds something else too."""
    while not lines[-1].strip(" \t"):
        lines.pop()
    return lines


def _characters(
    path: Path, rows: Sequence[str], before: int, width: int, free: str, blocked: str
) -> Pixels:
    """Turn rows of characters into pixels; ``before`` lines stand above them in the file."""
    known = free + blocked
    for line, row in enumerate(rows, start=before + 1):
        foreign = row.lstrip(known)
        if foreign:
            where = f"{path}:{line}:{len(row) - len(foreign) + 1}"
            raise MapError(f"{where}: found {show(foreign[0])}, expected one of {' '.join(known)}")
        if len(row) != width:
            where = f"{path}:{line}:{min(len(row), width) + 1}"
            raise MapError(f"{where}: found {len(row)} characters in the row, expected {width}")
    _limit(path, len(rows), width, "characters")
    bits = "".join(rows).encode().translate(bytes.maketrans(known.encode(), _bits(free, blocked)))
    return np.frombuffer(bits, np.uint8).reshape(len(rows), width)


def _bits(free: str, blocked: str) -> bytes:
    return bytes(len(free)) + b"\1" * len(blocked)


def _limit(path: Path, rows: int, cols: int, unit: str) -> None:
    """Refuse a file that would take too much memory."""
    if rows * cols > CELLS_MOST:
        raise MapError(f"{path}: found {rows} x {cols} {unit}, expected at most {CELLS_MOST}")


# Images ------------------------------------------------------------------------------------------


def _read_image(path: Path, data: bytes) -> _Raster:
    """Read a plain image: what is near white is free."""
    picture = _decode_image(path, data)
    notes = picture.notes
    grey = picture.grey
    if picture.alpha is not None:
        grey = ((grey.astype(np.uint16) * picture.alpha + 127) // 255).astype(np.uint8)
        clear = np.count_nonzero(picture.alpha < 255)
        notes.append(f"{clear} pixels that are not opaque count as on black")
    if between := np.count_nonzero((grey > 0) & (grey < FREE_GREY)):
        notes.append(f"{between} grey pixels (1 to {FREE_GREY - 1} of 255) count as blocked")
    return _Raster("image", (grey < FREE_GREY).astype(np.uint8), notes)


def _decode_image(path: Path, data: bytes) -> _Picture:
    """Decode an image into shades of grey.

    Args:
        path: Where the bytes come from, for messages.
        data: Content of the file, in one of `IMAGE_FORMATS` whatever the suffix is.

    Raises:
        MapError: If the bytes are no image, a damaged one, or one that is too large.
    """
    if _PNM_START.match(data):
        return _decode_pnm(path, data)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of odd metadata and of sizes, which we check
            with Image.open(io.BytesIO(data), formats=IMAGE_FORMATS) as image:
                cols, rows = image.size
                _limit(path, rows, cols, "pixels")
                return _decode_opened(path, image)
    except MapError:
        raise
    except UnidentifiedImageError:
        raise MapError(f"{path}: found no image, expected {', '.join(IMAGE_FORMATS)}") from None
    except Image.DecompressionBombError:
        raise MapError(
            f"{path}: found a huge image, expected at most {CELLS_MOST} pixels"
        ) from None
    except Exception as error:  # noqa: BLE001 - Pillow raises anything when an image is damaged
        problem = one_line(str(error)) or type(error).__name__
        raise MapError(f"{path}: found a damaged image, expected a whole one: {problem}") from None


def _decode_opened(path: Path, image: Image.Image) -> _Picture:
    """Decode what Pillow has recognised."""
    notes: list[str] = []
    alpha = None
    if image.mode == "F":
        raise MapError(f"{path}: found pixels in floating point, expected 8 or 16 bits")
    if image.mode.startswith("I"):
        values = np.asarray(image)
        if values.min() < 0 or values.max() > 65_535:
            raise MapError(f"{path}: found pixels of 32 bits, expected 8 or 16 bits")
        grey = _to_bytes(values, 65_535)
        clear = image.info.get("transparency")
        if isinstance(clear, int):
            alpha = np.where(values == clear, 0, 255).astype(np.uint8)
    elif image.has_transparency_data:
        pixels = np.asarray(image.convert("RGBA"))
        grey, alpha = _luma(pixels, notes), pixels[:, :, 3]
    elif image.mode in {"1", "L"}:
        grey = np.asarray(image.convert("L"))
    else:
        grey = _luma(np.asarray(image.convert("RGB")), notes)
    if alpha is not None and alpha.min(initial=255) == 255:
        alpha = None
    if getattr(image, "is_animated", False):
        notes.append("the file holds several images; this is the first")
    return _Picture(grey, alpha, notes)


def _luma(pixels: Pixels, notes: list[str]) -> Pixels:
    """Return the brightness of each pixel."""
    red, green, blue = (pixels[:, :, channel] for channel in range(3))
    coloured = np.count_nonzero((red != green) | (green != blue))
    if not coloured:
        return green
    notes.append(f"{coloured} coloured pixels are taken by their brightness (Rec. 709)")
    luma = red * np.float32(LUMA[0])
    luma += green * np.float32(LUMA[1])
    luma += blue * np.float32(LUMA[2])
    return (luma + np.float32(0.5)).astype(np.uint8)


def _decode_pnm(path: Path, data: bytes) -> _Picture:
    """Decode PGM and PPM, plain or raw, of any depth; Pillow takes a second and more for some."""
    header = _PNM_HEADER.match(data)
    if header is None:
        found = data[:2].decode()
        raise MapError(
            f"{path}: found a damaged {found} header, expected width, height and largest value"
        )
    kind, cols, rows, largest = map(int, header.groups())
    if not (rows and cols and 0 < largest <= 65_535):
        raise MapError(
            f"{path}: found width {cols}, height {rows}, largest value {largest}, "
            "expected all > 0 and the last <= 65535"
        )
    _limit(path, rows, cols, "pixels")
    channels = 3 if kind in {3, 6} else 1
    count = rows * cols * channels
    values = (_plain_values if kind in {2, 3} else _raw_values)(
        path, data[header.end() :], count, largest
    )
    if values.max() > largest:
        raise MapError(f"{path}: found value {values.max():g}, expected at most {largest}")
    pixels = _to_bytes(values, largest)
    notes: list[str] = []
    if channels == 1:
        return _Picture(pixels.reshape(rows, cols), None, notes)
    return _Picture(_luma(pixels.reshape(rows, cols, 3), notes), None, notes)


def _plain_values(path: Path, body: bytes, count: int, _largest: int) -> npt.NDArray[np.int64]:
    """Read values written out in digits."""
    body = re.sub(rb"#[^\r\n]*", b"", body)
    foreign = body.translate(None, b"0123456789 \t\r\n\v\f")
    if foreign:
        raise MapError(f"{path}: found {show(chr(foreign[0]))} among the pixels, expected digits")
    if long := re.search(rb"\d{10,}", body):
        raise MapError(f"{path}: found {show(long[0].decode())}, expected at most 65535")
    values = np.fromstring(body, np.int64, sep=" ") if body.strip() else np.zeros(0, np.int64)
    if len(values) < count:
        raise MapError(f"{path}: found {len(values)} values, expected {count}")
    return values[:count]


def _raw_values(
    path: Path, body: bytes, count: int, largest: int
) -> npt.NDArray[np.uint8 | np.uint16]:
    """Read values of one byte, or of two with the higher one first."""
    kind = np.dtype(np.uint8 if largest < 256 else ">u2")
    if len(body) < count * kind.itemsize:
        needed = count * kind.itemsize
        raise MapError(f"{path}: found {len(body)} bytes of pixels, expected {needed}")
    return np.frombuffer(body, kind, count)


def _to_bytes(values: npt.NDArray[np.integer], largest: int) -> Pixels:
    """Scale values of 0 to ``largest`` to 0 to 255, rounding to the nearest."""
    scaled = (np.arange(largest + 1) * 255 + largest // 2) // largest
    shades: Pixels = scaled.astype(np.uint8)[values]
    return shades


# ROS ---------------------------------------------------------------------------------------------


def _read_ros(path: Path, data: bytes) -> _Raster:
    """Read the metadata of a ROS map and the image that it names."""
    fields = _Fields(path, data)
    resolution_m = fields.number("resolution")
    if resolution_m <= 0:
        raise fields.error("resolution", f"found {resolution_m:g}, expected metres > 0")
    origin = fields.origin()
    table = _occupancies(fields)
    opaque_only = fields.mode() != "raw"
    name = fields.text("image")
    if not name or not name.isprintable():
        raise fields.error("image", f"found {show(name)}, expected the name of a file")
    image = path.parent / name
    try:
        picture = _decode_image(image, load(image, "an image", "an image"))
    except MapError as error:
        raise fields.error("image", str(error)) from None
    occupancy = table[picture.grey]
    notes = picture.notes
    if opaque_only and picture.alpha is not None:
        clear = picture.alpha < 255
        occupancy = np.where(clear, np.int8(-1), occupancy)
        notes.append(f"{np.count_nonzero(clear)} pixels that are not opaque count as unknown")
    if unknown := np.count_nonzero(occupancy < 0):
        notes.append(f"{unknown} unknown pixels count as blocked")
    if between := np.count_nonzero((occupancy > 0) & (occupancy < 100)):
        notes.append(f"{between} pixels of occupancy 1 to 99 count as blocked")
    blocked = (occupancy != 0).astype(np.uint8)
    return _Raster("ros", blocked, notes, resolution_m, origin)


def _occupancies(fields: "_Fields") -> npt.NDArray[np.int8]:
    """Return the occupancy of each grey value: -1 unknown, 0 free, up to 100 occupied.

    Line by line what nav2's ``loadMapFromFile`` does for a matrix of them.
    """
    free_thresh = fields.threshold("free_thresh")
    occupied_thresh = fields.threshold("occupied_thresh")
    if free_thresh > occupied_thresh:
        raise fields.error(
            "free_thresh",
            f"found {free_thresh:g}, expected at most the occupied_thresh of {occupied_thresh:g}",
        )
    negate = fields.negate()
    mode = fields.mode()
    grey = np.arange(256)
    if mode == "raw":
        return np.where(grey <= 100, grey, -1).astype(np.int8)
    shade = grey.astype(np.float32) / np.float32(255)
    if not negate:
        shade = np.float32(1) - shade
    free, occupied = np.float32(free_thresh), np.float32(occupied_thresh)
    result = np.full(256, -1, np.int8)
    result[shade >= occupied] = 100
    result[shade <= free] = 0
    if mode == "scale":
        between = (shade > free) & (shade < occupied)
        span = np.float32(occupied_thresh - free_thresh)
        scaled = (shade[between] - free) / span * np.float32(100)
        result[between] = np.floor(scaled.astype(np.float64) + 0.5).astype(np.int8)
    return result


class _ShallowLoader(yaml.SafeLoader):
    """Refuses what is nested too deeply."""

    depth = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """Compose a node and all below it."""
        self.depth += 1
        if self.depth > YAML_DEEPEST:
            mark = parent.start_mark if parent else None
            raise yaml.MarkedYAMLError(problem="deep nesting", problem_mark=mark)
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


class _Fields:
    """The fields of a ROS map's metadata, with their lines.

    The YAML is composed only: nothing in it is turned into objects, and a number is read as
    map_server reads it and not as YAML 1.1 would have it (``5e-2`` is one, ``1:30`` is none).
    """

    def __init__(self, path: Path, data: bytes) -> None:
        self._path = path
        self._nodes: dict[str, yaml.Node] = {}
        wanted = f"the metadata of a ROS map ({', '.join(ROS_FIELDS)})"
        if len(data) > YAML_MOST:
            raise MapError(
                f"{path}: found {len(data)} bytes, expected {wanted} of at most {YAML_MOST}"
            )
        root = self._compose(decode(path, data))
        if not isinstance(root, yaml.MappingNode):
            raise MapError(f"{path}: found no fields, expected {wanted}")
        for key, value in root.value:
            name = key.value if isinstance(key, yaml.ScalarNode) else ""
            if name in {*ROS_FIELDS, "mode"} and name in self._nodes:
                line = key.start_mark.line + 1
                raise MapError(f"{path}:{line}: found `{name}` again, expected it once")
            self._nodes[name] = value
        for name in ROS_FIELDS:
            if name not in self._nodes:
                raise MapError(f"{path}: found no field `{name}`, expected {wanted}")

    def error(self, name: str, text: str) -> MapError:
        """Build the refusal of a field."""
        line = self._nodes[name].start_mark.line + 1
        return MapError(f"{self._path}:{line}: `{name}`: {text}")

    def text(self, name: str) -> str:
        """Return a field as it is written."""
        return self._scalar(name, self._nodes[name])

    def number(self, name: str) -> float:
        """Return a field that is a finite number."""
        return self._finite(name, self.text(name))

    def threshold(self, name: str) -> float:
        """Return a field that is a number from 0 to 1."""
        found = self.number(name)
        if not 0 <= found <= 1:
            raise self.error(name, f"found {found:g}, expected 0 to 1")
        return found

    def origin(self) -> tuple[float, float, float]:
        """Return the pose of the lower left pixel."""
        node = self._nodes["origin"]
        if not isinstance(node, yaml.SequenceNode) or len(node.value) != 3:
            raise self.error("origin", "found no list of three numbers, expected [x, y, yaw]")
        x, y, yaw = (self._finite("origin", self._scalar("origin", item)) for item in node.value)
        return (x, y, yaw)

    def negate(self) -> bool:
        """Return whether black is free; map_server takes a whole number or a truth value."""
        text = self.text("negate")
        if re.fullmatch("[+-]?[0-9]+", text):
            return text.strip("+-0") != ""
        if text.lower() in TRUE_WORDS | FALSE_WORDS:
            return text.lower() in TRUE_WORDS
        raise self.error("negate", f"found {show(text)}, expected 0 or 1")

    def mode(self) -> str:
        """Return the way in which grey values become occupancies."""
        if "mode" not in self._nodes:
            return ROS_MODES[0]
        text = self.text("mode")
        if text.lower() not in ROS_MODES:
            raise self.error("mode", f"found {show(text)}, expected {', '.join(ROS_MODES)}")
        return text.lower()

    def _finite(self, name: str, text: str) -> float:
        line = self._nodes[name].start_mark.line + 1
        return finite(f"{self._path}:{line}: `{name}`", text, "a finite number")

    def _scalar(self, name: str, node: yaml.Node) -> str:
        if not isinstance(node, yaml.ScalarNode):
            found = "list" if isinstance(node, yaml.SequenceNode) else "mapping"
            raise self.error(name, f"found a {found}, expected a plain value")
        return str(node.value)

    def _compose(self, text: str) -> yaml.Node | None:
        expected = "expected well-formed YAML"
        try:
            return yaml.compose(text, Loader=_ShallowLoader)
        except yaml.reader.ReaderError as error:
            line = 1 + text.count("\n", 0, error.position)
            found = f"a character {error.character:#x}"
            raise MapError(f"{self._path}:{line}: {expected}, found {found}") from None
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            where = f"{self._path}:{mark.line + 1}" if mark else f"{self._path}"
            problem = one_line(error.problem or error.context or "an error")
            raise MapError(f"{where}: {expected}, found {problem}") from None
        except (yaml.YAMLError, ValueError, OverflowError) as error:
            # Escapes such as "\UFFFFFFFF", which PyYAML does not check.
            problem = type(error).__name__
            raise MapError(f"{self._path}: {expected}, found what gives a {problem}") from None


GRID_READERS: dict[str, Callable[[Path, bytes], _Raster]] = {
    ".map": _read_movingai,
    ".yaml": _read_ros,
    ".yml": _read_ros,
    ".txt": _read_text,
    **dict.fromkeys(
        (
            *(".png", ".pgm", ".ppm", ".pbm", ".bmp", ".gif", ".jpg", ".jpeg"),
            *(".tif", ".tiff", ".webp"),
        ),
        _read_image,
    ),
}
"""The reader of each suffix."""
