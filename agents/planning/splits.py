"""Who covers what of a tour: NB, B and Opt MSTC.

Robot i of k stands on a tour of N sub-cells, ``gaps[i]`` moves (the paper's D) before robot i + 1,
indices modulo k. Where it stands is covered from the start. It covers ``back[i]`` sub-cells behind it
and ``ahead[i]`` before it, first the fewer, then, over its start again, the more; that takes

    back + ahead + min(back, ahead)

moves. A gap is covered if ``ahead[i] + back[i + 1]`` is at least ``gaps[i] - 1``. Coverage time is the
largest of those costs, in moves. Nobody overtakes anybody.

    NB     nobody goes back: the largest gap less one
    B      where one gap is more than half the tour, it and the next two are shared
    Opt    all gaps are shared

It always holds that Opt <= B <= NB <= 2 Opt.

Paper:
    Agmon et al. 2008, Sec. 3.1 (Theorem 1). B_MSTC is used there but not defined: ours is the rule
    above.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple


class Split(NamedTuple):
    """Parts of a tour, robots in tour order.

    Attributes:
        moves: coverage time.
        back: sub-cells that each robot covers behind its start.
        ahead: sub-cells that each robot covers before it.
    """

    moves: int
    back: tuple[int, ...]
    ahead: tuple[int, ...]


def nb_mstc(gaps: Sequence[int]) -> Split:
    """Let each robot follow the tour up to the next robot's start.

    Args:
        gaps: distance of each robot to the next one, at least 1 each.
    """
    return Split(max(gaps) - 1, (0,) * len(gaps), tuple(gap - 1 for gap in gaps))


def b_mstc(gaps: Sequence[int]) -> Split:
    """Share the largest gap and the two after it if it is more than half the tour, else as NB.

    Args:
        gaps: distance of each robot to the next one, at least 1 each.
    """
    largest = max(gaps)
    if 2 * largest <= sum(gaps):
        return nb_mstc(gaps)
    first = gaps.index(largest)
    shared = {(first + step) % len(gaps) for step in range(3)}
    return _least(gaps, [robot in shared for robot in range(len(gaps))])


def opt_mstc(gaps: Sequence[int]) -> Split:
    """Share all gaps so that the coverage time is least, exactly.

    Args:
        gaps: distance of each robot to the next one, at least 1 each.
    """
    return _least(gaps, [True] * len(gaps))


SPLITS: dict[str, Callable[[Sequence[int]], Split]] = {
    "nb-mstc": nb_mstc,
    "b-mstc": b_mstc,
    "opt-mstc": opt_mstc,
}


def cost(back: int, ahead: int) -> int:
    """Return the moves of a robot that covers so many sub-cells on both sides."""
    return back + ahead + min(back, ahead)


def _least(gaps: Sequence[int], shared: Sequence[bool]) -> Split:
    """Find the least coverage time by bisection, and parts that keep to it."""
    robots = len(gaps)
    # Behind a gap that nobody shares nothing is covered backwards; behind the smallest one, little.
    before = shared.index(False) if False in shared else gaps.index(min(gaps))
    turn = [(before + 1 + step) % robots for step in range(robots)]
    turned = [(gaps[robot], shared[robot]) for robot in turn]
    low, high = -(-(sum(gaps) - robots) // robots), max(gaps) - 1
    while low < high:
        middle = (low + high) // 2
        if _backs(turned, middle) is None:
            low = middle + 1
        else:
            high = middle
    backs = _backs(turned, high)
    assert backs is not None, "NB is a split too"
    back = [0] * robots
    for robot, covered in zip(turn, backs, strict=True):
        back[robot] = covered
    ahead = [gaps[robot] - 1 - back[(robot + 1) % robots] for robot in range(robots)]
    return Split(high, tuple(back), tuple(ahead))


def _backs(gaps: Sequence[tuple[int, bool]], limit: int) -> list[int] | None:
    """Find how much robots cover behind them if each makes at most ``limit`` moves.

    Each robot goes ahead as far as its moves allow; the rest of the gap is left to the next one. The
    more the first robot covers behind it, the more is left to it after a round, so that beginning
    with nothing and repeating finds the least it can do with, if there is any. What it covers is
    less than the last gap and grows with each round, which bounds their number.

    Args:
        gaps: each gap, and whether it may be shared.
        limit: moves of each robot at most.

    Returns:
        The sub-cells that each robot covers behind it, as few as can be; ``None`` if there is no way.
    """
    back = 0
    while True:
        backs = []
        left = back
        for gap, shared in gaps:
            backs.append(left)
            # The most ahead for so much back: the fewer of both count twice.
            reach = limit - 2 * left if 3 * left <= limit else (limit - left) // 2
            left = max(0, gap - 1 - reach)
            if left > limit or (left and not shared):
                return None
        if left <= back:
            return backs
        back = left
