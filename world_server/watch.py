"""What the world server keeps of those around it: who is away, and which faults are under way.

No clock and no transport; the shell tells the time and sends what it is given.
"""

from array import array
from bisect import bisect_right


class Absences:
    """Robots whose sign of life has ended, and until when each may come back.

    A token ends with its robot, but also with a router between, or with the link: so a robot is taken
    for lost only when it has not come back in time. Any word of it counts as a sign of life.
    """

    def __init__(self, grace_s: float) -> None:
        self._grace_s = grace_s
        self._until: dict[int, float] = {}

    def __bool__(self) -> bool:
        """Tell whether anybody is away."""
        return bool(self._until)

    def gone(self, robot: int, now_s: float, grace_s: float | None = None) -> None:
        """Take down that a sign of life has ended, or was never there."""
        self._until[robot] = now_s + (self._grace_s if grace_s is None else grace_s)

    def back(self, robot: int) -> bool:
        """Take down a sign of life; tell whether the robot had been away."""
        return self._until.pop(robot, None) is not None

    def overdue(self, now_s: float) -> list[int]:
        """Remove and return the robots that have not come back in time."""
        late = [robot for robot, until in self._until.items() if now_s >= until]
        for robot in late:
            del self._until[robot]
        return late


class FaultsUnderWay:
    """Faults that the nemesis carries out: which it took down, and when the run went on after each.

    Word that a fault has struck may come late, over a router that was itself struck. So where there
    are faults the time of every commit is kept.

    Attributes:
        taken: faults that the nemesis has taken down.
        waiting: whether the next commit is to be told.
        young: whether no wave was committed in this life of the world.
    """

    def __init__(self, *, expected: bool = True) -> None:
        """Begin a life; ``expected``: whether there may be faults."""
        self.taken: set[int] = set()
        self.young = True
        self._expected = expected
        self._commits_s = array("d")
        self._struck_s: dict[int, float] = {}

    @property
    def waiting(self) -> bool:
        """Whether the next commit is to be told."""
        return self._expected or self.young

    def committed(self, now_s: float) -> dict[int, float]:
        """Take down that a wave was committed; return the faults after which the run went on now."""
        self.young = False
        self._commits_s.append(now_s)
        if not self._struck_s:
            return {}
        went_on = {fault: now_s for fault, at_s in self._struck_s.items() if at_s < now_s}
        for fault in went_on:
            del self._struck_s[fault]
        return went_on

    def struck(self, fault: int, at_s: float) -> float | None:
        """Hear that a fault has struck at ``at_s``; return when the run went on, if it has."""
        later = bisect_right(self._commits_s, at_s)
        if later < len(self._commits_s):
            return self._commits_s[later]
        self._struck_s[fault] = at_s
        return None
