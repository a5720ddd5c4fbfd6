"""Where a team splits: the split heights of NCOCTA and COCTA, by formula or the fastest tried.

Paper: Sinay et al. 2017, as `agents.algorithms.connected_rule`.
"""

from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Literal

from agents.algorithms.connected_rule import Team, Variant, checked_splits, ticks_taken
from agents.planning.rooted_tree import RootedTree, vertices_of_perfect

Splits = Literal["paper", "best"] | Sequence[int]
"""Split heights: by the paper's formula, the fastest of those that were tried, or as given."""


MOST_SPLITS = 4096
"""How many sets of split heights are looked at, at most, before they are tried."""


def choose_splits(
    tree: RootedTree, team_size: int, variant: Variant, splits: Splits, effort: int = 100_000
) -> tuple[int, ...]:
    """Return the split heights for a team, descending.

    Args:
        tree: what they are to cover.
        team_size: number of robots.
        variant: ``"ncocta"`` or ``"cocta"``.
        splits: ``"paper"``, ``"best"``, or the heights themselves.
        effort: how many ticks may be played, in all, to find the best.

    Raises:
        ValueError: If a given height is not in 1..H, or given twice.
    """
    if splits == "paper":
        return paper_splits(tree.arity, tree.height, team_size)
    if splits == "best":
        return fastest_splits(tree, team_size, variant, effort)
    assert not isinstance(splits, str), splits
    return checked_splits(tree, splits)


def paper_splits(arity: int, height: int, team_size: int) -> tuple[int, ...]:
    """Return the split heights by the paper's formula, for as many splits as the team allows.

    Where the highest would be above the root, the lowest is lowered, and if that is not enough there
    are fewer of them. On a tree that is not perfect ``arity`` is the largest number of children; on a
    path nothing is to be split.

    Paper:
        Sinay et al. 2017, Sec. 4.2, Eq. (1), with the lowest height of Lemma 4.5 as in Sec. 4.3.
    """
    if arity < 2:
        return ()
    number = 0
    while robots_needed(arity, _printed_splits(arity, number + 1)) <= team_size:
        number += 1
    number = min(number, height)
    if not number:
        return ()
    lowest = min(_printed_splits(arity, number)[-1], height - number + 1)
    return tuple(range(lowest + number - 1, lowest - 1, -1))


def _printed_splits(arity: int, number: int) -> tuple[int, ...]:
    """Return h_1, ..., h_m for m splits: h_m = floor(log_N m) + m + 4, and h_i = h_m + m - i."""
    logarithm = 0
    while arity ** (logarithm + 1) <= number:
        logarithm += 1
    lowest = logarithm + number + 4
    return tuple(range(lowest + number - 1, lowest - 1, -1))


def robots_needed(arity: int, splits: Sequence[int]) -> int:
    """Return how many robots make up a trail from each split to the leaves: then the run ends.

    Paper:
        Sinay et al. 2017, Sec. 4.1: 1 + N h_1 + the sum over i > 1 of (N^i - N^(i-1)) h_i.
    """
    if not splits:
        return 1
    needed = 1 + arity * splits[0]
    for i, height in enumerate(splits[1:], 2):
        needed += (arity**i - arity ** (i - 1)) * height
    return needed


def perfect_tree_ticks(arity: int, height: int, splits: Sequence[int]) -> int:
    """Return the ticks that NCOCTA takes on a perfect tree, with at least `robots_needed`.

    Paper:
        Sinay et al. 2017, Lemma 4.3 and the recursion for Lemma 4.4 (E_H), for any split heights.
    """
    if not splits:
        return _there_and_back(arity, height)
    lower = splits[-1]
    ticks: int = vertices_of_perfect(arity, lower - 1) + lower
    for upper in splits[-2::-1]:
        # Into one child; from there, all together, to each vertex of the lower split height.
        between = upper - 1 - lower
        ticks = 2 + _there_and_back(arity, between) + arity**between * ticks
        lower = upper
    subtrees: int = arity ** (height - lower)
    return _there_and_back(arity, height - lower) + subtrees * ticks


def _there_and_back(arity: int, height: int) -> int:
    return 2 * (vertices_of_perfect(arity, height) - 1)


def fastest_splits(
    tree: RootedTree, team_size: int, variant: Variant, effort: int
) -> tuple[int, ...]:
    """Return the fastest of the split heights that were tried on a tree.

    Those of the paper come first, then others in the order in which they are promising: by the time
    of NCOCTA on the perfect tree. Each is played to its end, or until it is no faster.
    """
    best = paper_splits(tree.arity, tree.height, team_size)
    limit = effort
    sets = sorted(
        islice(allowed_splits(tree, team_size), MOST_SPLITS),
        key=lambda splits: (perfect_tree_ticks(tree.arity, tree.height, splits), splits),
    )
    for splits in dict.fromkeys((best, *sets)):
        if effort <= 0:
            break
        ticks = ticks_taken(Team(tree, team_size, variant, splits), min(limit, effort))
        if ticks is not None:
            best, limit = splits, ticks - 1
        effort -= limit
    return best


def allowed_splits(
    tree: RootedTree, team_size: int, above: tuple[int, ...] = ()
) -> Iterator[tuple[int, ...]]:
    """Yield the sets of split heights for which a team is large enough, and that there be none."""
    yield above
    if tree.arity < 2:
        return
    for height in range(above[-1] - 1 if above else tree.height, 0, -1):
        splits = (*above, height)
        if robots_needed(tree.arity, splits) <= team_size:
            yield from allowed_splits(tree, team_size, splits)
