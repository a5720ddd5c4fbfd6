"""What a team is to cover, and what of it is left.

On a graph every vertex, and on a grid every free sub-cell, that can be reached from a start. Algorithms
that cover complete coarse cells only are to cover those that can be reached from the starts of the
robots that survive, by way of such cells (if none survives: from all starts).

In a team of parents and children what counts is what the children visit.
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
        hindered: why nobody could go on, where that is nobody's fault; empty if somebody could.
    """

    covered: int
    to_cover: int
    missing: Sequence[int]
    hindered: str = ""


def coverage_of(scenario: Scenario, ledger: AnyLedger) -> Coverage:
    """Compare what was visited with what is to be visited."""
    if isinstance(ledger, GridLedger):
        wanted = _on_grid(ledger, cells=plain_name(scenario.algorithm) in CELL_ALGORITHMS)
    else:
        wanted = reached(ledger.graph, ledger.starts)
    visited = ledger.first_visits
    missing = sorted(place for place in wanted if place not in visited)
    return Coverage(len(visited), len(visited) + len(missing), missing, _hindered(scenario, ledger))


def _hindered(scenario: Scenario, ledger: AnyLedger) -> str:
    """Say what a team needs and has lost: a robot, and where there are parents one of each kind."""
    left, parents = ledger.survivors, scenario.team.parents
    if not left:
        return "no robot survived"
    if not parents:
        return ""
    if left[0] >= parents:
        return "no parent survived, without whom children cannot go on"
    return "no child survived" if left[-1] < parents else ""


def _on_grid(ledger: GridLedger, *, cells: bool) -> Iterable[int]:
    from deploy.ground import reach_of  # brings numpy, which graphs need not pay for

    grid, starts = ledger.grid, ledger.starts
    if cells and ledger.survivors:
        starts = tuple(starts[robot] for robot in ledger.survivors)
    found = reach_of(grid, [grid.position(start) for start in starts], cells=cells)
    return (grid.place(*sub_cell) for sub_cell in found)
