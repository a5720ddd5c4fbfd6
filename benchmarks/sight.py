"""What the world senses on grids, and whom its radio reaches, beside looking cell by cell.

    python -m benchmarks.sight [--repeats 5]

Processor time of looks from places all over a map, each for the first time. The reference asks for
each sub-cell of the square whether the line to it is clear, vertex by vertex. Medians.
"""

import argparse
import time
from collections.abc import Callable, Iterable
from functools import cache
from itertools import product
from statistics import median

from benchmarks.table import print_table
from protocol.grid import Cell, Grid
from protocol.line_of_sight import gaps_to
from protocol.scenario import SensingSection
from protocol.seeds import spawn
from world_server.maps.generated_grids import rectangles
from world_server.radio import RadiusRadio
from world_server.sensing import See, seer

SIDE = 200
LOOKS = 200
"""From so many places; the reference from fewer."""

Gaps = tuple[tuple[Cell, ...], ...]


def is_clear(grid: Grid, row: int, col: int, gaps: Gaps) -> bool:
    """Tell whether a line from a sub-cell passes all of its gaps."""
    return all(any(grid.is_free(row + down, col + right) for down, right in gap) for gap in gaps)


def seer_by_hand(grid: Grid, range_cells: int) -> See:
    """Return what looks at one sub-cell after another; all lines are known beforehand."""
    reach = range(-range_cells, range_cells + 1)
    lines = [
        (down, right, gaps_to(down, right) if down**2 + right**2 <= range_cells**2 else None)
        for down, right in product(reach, repeat=2)
    ]

    def look(place: int, position: Cell, gaze: int | None) -> bytes:
        row, col = grid.position(place)
        seen = bytearray()
        for down, right, gaps in lines:
            if gaps is None or not is_clear(grid, row, col, gaps):
                seen += b"?"
            else:
                seen += b"." if grid.is_free(row + down, col + right) else b"#"
        return bytes(seen)

    return look


class _Robot:
    left_at = float("inf")

    def __init__(self, place: int) -> None:
        self.place = place


def _seconds(run: Callable[[], object]) -> float:
    before = time.process_time()
    run()
    return time.process_time() - before


def _look(see: See, grid: Grid, places: Iterable[int]) -> list[bytes]:
    return [see(place, grid.position(place), None) for place in places]


def _sensing(grid: Grid, range_cells: int, repeats: int) -> tuple[str, ...]:
    places = [grid.place(*cell) for cell in grid.free_cells()]
    places = places[:: len(places) // LOOKS]
    some = places[::range_cells]
    by_hand = seer_by_hand(grid, range_cells)
    section = SensingSection(mode="line-of-sight", range_m=range_cells * grid.cell_m)
    build_s = _seconds(lambda: seer(grid, section))
    pairs = []
    for _ in range(repeats):
        see, _ = seer(grid, section)  # which remembers nothing yet
        spent_s = _seconds(lambda see=see: _look(see, grid, places)) / len(places)  # type: ignore[misc]  # bound now
        reference_s = _seconds(lambda: _look(by_hand, grid, some)) / len(some)
        pairs.append((spent_s, reference_s))
    if _look(see, grid, some) != _look(by_hand, grid, some):
        raise RuntimeError(f"another sight at {range_cells} sub-cells")
    return _row(f"sensing, {range_cells} sub-cells", pairs, f"{build_s * 1e3:.0f}")


def _hears(grid: Grid, range_cells: int, repeats: int) -> tuple[str, ...]:
    """Let 60 robots ask for each other, five times before they are elsewhere."""
    rng = spawn(1, "robots")
    places = [grid.place(*cell) for cell in grid.free_cells()]
    teams = [[_Robot(place) for place in rng.sample(places, 60)] for _ in range(5)]

    known = cache(gaps_to)

    def by_hand(one: _Robot, other: _Robot, _: float) -> bool:
        (row, col), (row_to, col_to) = grid.position(one.place), grid.position(other.place)
        down, right = row_to - row, col_to - col
        return down**2 + right**2 <= range_cells**2 and is_clear(grid, row, col, known(down, right))

    def ask(hears: Callable[[_Robot, _Robot, float], bool]) -> int:
        asked = (product(team, repeat=2) for team in teams for _ in range(5))
        return sum(hears(one, other, 0.0) for pairs in asked for one, other in pairs)

    count = len(teams) * 5 * 60 * 60
    pairs = []
    for _ in range(repeats):
        radio = RadiusRadio(grid, range_cells * grid.cell_m, line_of_sight=True)
        spent_s = _seconds(lambda radio=radio: ask(radio.hears)) / count  # type: ignore[misc]  # bound now
        pairs.append((spent_s, _seconds(lambda: ask(by_hand)) / count))
    if ask(radio.hears) != ask(by_hand):
        raise RuntimeError(f"another radio at {range_cells} sub-cells")
    return _row(f"radio, {range_cells} sub-cells", pairs, "")


def _row(name: str, pairs: list[tuple[float, float]], build_ms: str) -> tuple[str, ...]:
    return (
        name,
        f"{median(spent for spent, _ in pairs) * 1e6:.2f}",
        f"{median(reference for _, reference in pairs) * 1e6:.2f}",
        f"{median(reference / spent for spent, reference in pairs):.1f}",
        build_ms,
    )


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    repeats = parser.parse_args().repeats

    grid = rectangles(SIDE, SIDE, 0.2, spawn(0, "world"))
    rows = [_sensing(grid, range_cells, repeats) for range_cells in (1, 5, 20, 64)]
    rows += [_hears(grid, range_cells, repeats) for range_cells in (20, 64)]
    print_table(
        f"line of sight, {SIDE} x {SIDE} sub-cells, 20 % obstacles",
        ("a look or a pair", "us", "cell by cell, us", "times as fast", "at the start, ms"),
        rows,
        "targets: looks at least 10 times as fast from 5 sub-cells on, 2 ms each at 64",
    )


if __name__ == "__main__":
    main()
