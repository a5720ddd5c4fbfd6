"""The pixels of a grid: a square of whole pixels for each sub-cell, in the colour of who came first.

Textures tell robots of one colour apart; stripes mean that nobody came.
"""

import math
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from deploy.picture_parts import COLOURS, EARLY, PALE

Numbers = npt.NDArray[np.int64]
Shares = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Pixels = npt.NDArray[np.uint8]
Scalar = TypeVar("Scalar", bound=np.generic)

WALL = "#3a4048"
SHADED = "#d9e0e8"
"""Free, but in a coarse cell that is partly blocked."""
ALARM = "#e4002b"
"""Not covered, and should be."""
TEXTURES = 4
"""Robots of one colour that can be told apart."""
TEXTURE_DEPTH = 0.3
"""How much more of its colour a texture has than the sub-cell under it."""


def paint_map(blocked: Mask, partly: Mask, px: int, px_a_pt: float) -> Pixels:
    """Return the pixels of a map.

    Args:
        blocked: Sub-cells that are blocked.
        partly: Free sub-cells of coarse cells that are partly blocked.
        px: Side of a sub-cell.
        px_a_pt: Pixels a point.
    """
    cells = np.full((*blocked.shape, 3), 255, dtype=np.uint8)
    cells[blocked] = rgb(WALL)
    cells[partly] = rgb(SHADED)
    return _ruled(enlarged(cells, px), enlarged(blocked, px), px, px_a_pt)


def paint_run(
    blocked: Mask, robots: Numbers, shares: Shares, missed: Mask, px: int, px_a_pt: float
) -> Pixels:
    """Return the pixels of a run.

    Args:
        blocked: Sub-cells that are blocked.
        robots: Robot that came first, or -1.
        shares: Share of the whole time at which it came.
        missed: Free sub-cells that nobody covered but should have.
        px: Side of a sub-cell.
        px_a_pt: Pixels a point.
    """
    tones = EARLY + (1 - EARLY) * shares
    visited = robots >= 0
    cells = np.full((*blocked.shape, 3), 255, dtype=np.uint8)
    cells[blocked] = rgb(WALL)
    cells[visited] = shade(robots[visited], tones[visited])
    pixels = enlarged(cells, px)

    textures = np.where(visited, robots // len(COLOURS) % TEXTURES, 0)
    if textures.any():
        cells[visited] = shade(robots[visited], tones[visited] + TEXTURE_DEPTH)
        inked = _texture(enlarged(textures, px), px_a_pt)
        pixels[inked] = enlarged(cells, px)[inked]
    pixels = _ruled(pixels, enlarged(blocked, px), px, px_a_pt)

    unvisited = enlarged(~blocked & ~visited, px)
    pixels[unvisited & _stripes(unvisited.shape, 4.0, 0.5, px_a_pt)] = rgb(PALE)
    if missed.any():
        alarmed = enlarged(missed, px)
        pixels[alarmed] = 255
        pixels[alarmed & _stripes(alarmed.shape, 4.0, 1.3, px_a_pt)] = rgb(ALARM)
        pixels[_grown(alarmed, max(2, round(1.3 * px_a_pt))) & ~alarmed] = rgb(ALARM)
    return pixels


def shade(robots: Numbers, tones: Shares) -> Pixels:
    """Return the colours of robots in tones from 0, white, over 1, their own, to 2, black."""
    own = np.array([rgb(name) for name in COLOURS], dtype=np.float64)[robots % len(COLOURS)]
    tones = tones[..., None]
    mixed = np.where(tones <= 1, 255 + (own - 255) * tones, own * (2 - tones))
    pixels: Pixels = np.rint(mixed).astype(np.uint8)
    return pixels


def _texture(textures: Numbers, px_a_pt: float) -> Mask:
    """Return the pixels that lie on the lines or dots of a texture: 1, 2 or 3; 0 has none."""
    y, x = np.ogrid[: textures.shape[0], : textures.shape[1]]
    pitch, dot = max(3, round(3.2 * px_a_pt)), max(1, round(1.3 * px_a_pt))
    dots = (x % pitch < dot) & (y % pitch < dot)
    lines = _stripes(textures.shape, 4.5, 1.2, px_a_pt)
    crossed = lines | _stripes(textures.shape, 4.5, 1.2, px_a_pt)[:, ::-1]
    mask: Mask = ((textures == 1) & lines) | ((textures == 2) & dots) | ((textures == 3) & crossed)
    return mask


def _stripes(shape: tuple[int, ...], pitch_pt: float, width_pt: float, px_a_pt: float) -> Mask:
    """Return the pixels that lie on slanted stripes."""
    y, x = np.ogrid[: shape[0], : shape[1]]
    pitch, width = max(3, round(pitch_pt * px_a_pt * math.sqrt(2))), width_pt * px_a_pt
    mask: Mask = (x + y) % pitch < max(1, round(width * math.sqrt(2)))
    return mask


def _ruled(pixels: Pixels, blocked: Mask, px: int, px_a_pt: float) -> Pixels:
    """Rule lines between coarse cells and, if there is room, finer ones between sub-cells."""
    height, width, _ = pixels.shape
    y, x = np.arange(height), np.arange(width)
    line = max(1, round(0.5 * px_a_pt))
    for pitch, darker in ((px, 0.93), (2 * px, 0.86)):
        if pitch < 5 * px_a_pt:
            continue
        ruled = ((y % pitch < line) & (y >= pitch))[:, None] | ((x % pitch < line) & (x >= pitch))
        ruled &= ~blocked
        pixels[ruled] = (pixels[ruled] * darker).astype(np.uint8)
    return pixels


def _grown(mask: Mask, by: int) -> Mask:
    """Return a mask grown by some pixels to all sides."""
    grown = mask
    for _ in range(2):
        seed, grown = grown, grown.copy()
        for step in range(1, by + 1):
            grown[step:] |= seed[:-step]
            grown[:-step] |= seed[step:]
        grown = grown.T
    return grown


def enlarged(cells: npt.NDArray[Scalar], px: int) -> npt.NDArray[Scalar]:
    """Return an array with ``px`` by ``px`` elements for each of another."""
    return cells.repeat(px, axis=0).repeat(px, axis=1)


def rgb(name: str) -> tuple[int, int, int]:
    """Return red, green and blue."""
    red, green, blue = bytes.fromhex(name.removeprefix("#"))
    return red, green, blue
