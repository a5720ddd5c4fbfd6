"""Claims that are told by notes, which come late, or not at all.

What for, and why that is enough: `agents.algorithms.ormstc_gossip`.
"""

from collections.abc import Iterable

from agents.algorithms.claims import AnyNote, Claim, Claims, Retract, Start
from agents.algorithms.gossip_body import Beside, Covered, read_note
from agents.algorithms.stc import AWAY


class GossipClaims(Claims):
    """One robot's copy of who owns what, and of what is covered for good.

    Attributes:
        missing: robots taken for lost; they are among the dead.
        held: the cells that each robot has claimed and not given up, whoever owns them.
        covered: cells that are covered, whatever becomes of those who did it.
        known: cells known to be free.
        starts: the cell where each robot started, as far as it was heard.
        freed: whether also what the dead had covered is open: it is in the way.
    """

    __slots__ = ("covered", "freed", "held", "known", "missing", "starts")

    def __init__(self, team_size: int, *, fewest: bool, lazy: bool) -> None:
        super().__init__(team_size, fewest=fewest, lazy=lazy, delayed=True)
        self.missing: set[int] = set()
        self.held: list[set[int]] = [set() for _ in range(team_size)]
        self.covered: set[int] = set()
        self.known: set[int] = set()
        self.starts: dict[int, int] = {}
        self.freed = False

    # What one can ask.

    def has_no_owner(self, cell: int) -> bool:
        """Tell whether nobody owns a cell, or only the dead do."""
        stake = self.owner.get(cell)
        return stake is None or stake[2] in self.dead

    def is_open(self, cell: int) -> bool:
        """Tell whether a cell is to be covered by whoever comes first."""
        if not self.has_no_owner(cell):
            return False
        if cell not in self.covered or self.freed:
            return True
        stake = self.owner.get(cell)
        return not self.lazy and stake is not None and stake[2] not in self.missing

    def around(self, start: int, walls: set[int]) -> tuple[set[int], set[int]]:
        """Return the covered cells that hang together with ``start``, and what is left beside them."""
        if start not in self.covered:
            return set(), {start}
        covered, left, ahead = {start}, set(), [start]
        while ahead:
            cell = ahead.pop()
            for away in AWAY:
                beside = cell + away
                if beside in self.covered and beside not in covered:
                    covered.add(beside)
                    ahead.append(beside)
                elif beside in self.known and beside not in covered and beside not in walls:
                    left.add(beside)
        return covered, left

    def awaited(self, left: set[int]) -> set[int]:
        """Return who is to cover these cells: their owners, or else those who own what is beside."""
        robots: set[int] = set()
        for cell in left:
            near = [cell + away for away in AWAY] if self.has_no_owner(cell) else [cell]
            robots.update(self.owner[at][2] for at in near if not self.has_no_owner(at))
        return robots

    # What one hears.

    def hear_all(self, inbox: Iterable[tuple[int, bytes]]) -> None:
        """Take in notes."""
        for sender, note in inbox:
            self.hear(sender, read_note(note))

    def hear(self, sender: int, note: AnyNote | Beside | Covered) -> None:
        """Take in a note; the dead own nothing, but what they have covered is covered."""
        if isinstance(note, Covered):
            self.covered |= self.held[sender]
            self.changed = True
        elif isinstance(note, Beside):
            self.known.update(note.cells)
        else:
            if isinstance(note, Claim | Start):
                self.known.add(note.cell)
                self.held[sender].add(note.cell)
            if isinstance(note, Start):
                self.starts[sender] = note.cell
            elif isinstance(note, Retract):
                self.held[sender].discard(note.cell)  # also of a robot that is dead
            super().hear(sender, note)

    def retract(self, cell: int, robot: int) -> None:
        """Let a robot give a cell up."""
        self.held[robot].discard(cell)
        super().retract(cell, robot)

    def free_the_spared(self) -> None:
        """Nobody is spared here: see `freed`."""

    def replay(self, logs: list[list[bytes]], dead: set[int], missing: set[int]) -> None:
        """Begin anew: hear all that was said, then who is dead or taken for lost."""
        self.owner.clear()
        self.rivals.clear()
        self.taken.clear()
        self.dead.clear()
        self.cells = [0] * self.team_size
        for held in self.held:
            held.clear()
        for origin, log in enumerate(logs):
            self.hear_all((origin, note) for note in log)
        for robot in sorted(dead | missing):
            self.bury(robot)
        self.missing = missing
        self.freed = False
        self.changed = True
