"""What a team is to cover, and what of it is left.

On a graph every vertex, and on a grid every free sub-cell, that can be reached from a start. Algorithms
that cover complete coarse cells only are to cover those that can be reached from the starts of the
robots that survive, by way of such cells (if none survives: from all starts).
"""

from collections.abc import Iterable, Sequence

from msgspec import Struct

from agents.registry import CELL_ALGORITHMS, plain_name
from deploy.verdict.grid_ledger import GridLedger
from deploy.verdict.ledger import Ledger, reached
from protocol.scenario import Scenario

AnyLedger = Ledger | GridLedger


class Coverage(Struct, frozen=True):
    """How much is covered.

    Attributes:
        covered: how many places were visited.
        to_cover: how many places were to be visited, or were visited all the same.
        missing: those that were not visited, in ascending order.
    """

    covered: int
    to_cover: int
    missing: Sequence[int]


def coverage_of(scenario: Scenario, ledger: AnyLedger) -> Coverage:
    """Compare what was visited with what is to be visited."""
    if isinstance(ledger, GridLedger):
        wanted = _on_grid(ledger, cells=plain_name(scenario.algorithm) in CELL_ALGORITHMS)
    else:
        wanted = reached(ledger.graph, ledger.starts)
    visited = ledger.first_visits
    missing = sorted(place for place in wanted if place not in visited)
    return Coverage(len(visited), len(visited) + len(missing), missing)


def _on_grid(ledger: GridLedger, *, cells: bool) -> Iterable[int]:
    from deploy.ground import reach_of  # brings numpy, which graphs need not pay for

    grid, starts = ledger.grid, ledger.starts
    if cells and ledger.survivors:
        starts = tuple(starts[robot] for robot in ledger.survivors)
    found = reach_of(grid, [grid.position(start) for start in starts], cells=cells)
    return (grid.place(*sub_cell) for sub_cell in found)
