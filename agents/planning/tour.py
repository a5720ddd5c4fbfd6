"""The way around a tree of coarse cells, and how far apart robots stand on it.

Paper:
    Agmon et al. 2008, Sec. 3.1: the spanning tree path, and D. N is the length of the tour, four
    sub-cells for each cell of the tree.
"""

from collections.abc import Sequence

from agents.algorithms.stc import AWAY, BEFORE, BEHIND, Tree, located, sub_cell
from protocol.grid import Cell


def circumnavigate(tree: Tree, start: Cell) -> list[Cell]:
    """Go once around a tree, counter-clockwise, the tree on the left.

    Args:
        tree: the tree; only the part that is connected to the start counts.
        start: sub-cell of a cell of the tree.

    Returns:
        Each sub-cell of the tree once, ``start`` first; the last one lies beside the first.

    Raises:
        KeyError: If ``start`` is not on the tree.
    """
    edges = tree.edges
    first = cell, corner = located(start)
    tour: list[Cell] = []
    while True:
        tour.append(sub_cell(cell, corner))
        if edges[cell] >> corner & 1:
            cell += AWAY[corner]
            corner = BEHIND[corner]
        else:
            corner = BEFORE[corner]
        if (cell, corner) == first:
            return tour


class Places:
    """Where robots stand on a tour.

    Attributes:
        order: robots as the tour meets them, robot 0 first.
        at: position on the tour of each robot of ``order``.
        gaps: moves from each robot of ``order`` to the next one; the paper's D. They sum up to N.
    """

    __slots__ = ("at", "gaps", "order")

    def __init__(self, tour: Sequence[Cell], starts: Sequence[Cell]) -> None:
        """Find the robots.

        Args:
            tour: the sub-cells of a tour that begins where robot 0 starts.
            starts: sub-cell of each robot, no two alike.

        Raises:
            ValueError: If a start is not on the tour, or robot 0 does not stand at its beginning.
        """
        robots = {start: robot for robot, start in enumerate(starts)}
        self.at = [at for at, cell in enumerate(tour) if cell in robots]
        self.order = [robots[tour[at]] for at in self.at]
        if len(self.at) < len(starts) or tour[0] != starts[0]:
            raise ValueError("each robot needs a place of its own on the tour, robot 0 the first")
        ends = [*self.at[1:], len(tour)]
        self.gaps = [end - at for at, end in zip(self.at, ends, strict=True)]
