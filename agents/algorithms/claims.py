"""Who owns which coarse cell: what each robot knows of it, from messages alone.

Every robot keeps its own copy. A robot that wants a cell *claims* it; the owner is the least claim, by
time and then by rank, of a robot that is not known to be dead (spec rule R9; without delay all claims
on a cell are of one instant, and rank decides). What a robot that died had claimed is open to all
(R8), except that under ``lazy`` the cells of a robot that died after it had announced completion are
not (R10): until they are freed.
"""

from collections.abc import Iterable
from functools import lru_cache
from typing import Any

from msgspec import Struct

from protocol.codec import decoder_of, encode


class Note(Struct, frozen=True, array_like=True, forbid_unknown_fields=True, gc=False):
    """Root of all messages between the robots."""


class Start(Note, frozen=True, tag="start"):
    """The sender starts in this coarse cell (Alg. 2 l. 10)."""

    cell: int


class Claim(Note, frozen=True, tag="claim"):
    """The sender wants to construct a tree edge to ``cell`` (Alg. 3 l. 15 and 34).

    Attributes:
        time: when it claims.
        cell: what it claims.
        cells: how many cells it owns.
    """

    time: float
    cell: int
    cells: int


class Retract(Note, frozen=True, tag="retract"):
    """The sender gives ``cell`` up: another was first, or it cannot be entered."""

    cell: int


class Completion(Note, frozen=True, tag="completion"):
    """The sender has nothing left to do (Alg. 3 l. 24), as far as it knows.

    Attributes:
        dead: how many losses it knows of; ``team_size`` from one that stops: so it is for good.
        opened: whose cells are open of them: so many, that is, less the spared.
    """

    dead: int
    opened: int = 0


class Withdrawal(Note, frozen=True, tag="withdrawal"):
    """The sender has something to do after all (Alg. 3 l. 28)."""


class Over(Note, frozen=True, tag="over"):
    """The sender knew that all were complete in the same view: everything is covered."""


class Removal(Note, frozen=True, tag="removal"):
    """The paper's own: all forget their connections to ``robot`` (Alg. 3 l. 13 and 33)."""

    robot: int


class Frontier(Note, frozen=True, tag="frontier"):
    """Helping: the sender left these open cells behind; it would come back to them last."""

    cells: tuple[int, ...]


class Ask(Note, frozen=True, tag="ask"):
    """Helping: the sender has nothing to do; who has how much before it?"""


class Offer(Note, frozen=True, tag="offer"):
    """Helping: the sender has ``left`` sub-cells before it, as far as it knows; to robot ``to``."""

    to: int
    left: int


class Take(Note, frozen=True, tag="take"):
    """Helping: the sender, who is in that cell, wants a share of what robot ``of`` has."""

    of: int
    cell: int


class Grant(Note, frozen=True, tag="grant"):
    """Helping: the sender's share for a helper.

    Attributes:
        to: the helper.
        time: when it is granted.
        cells: the cells of the share; they are the helper's now.
        shared: those of them in which the sender still covers some sub-cells.
        way: the sub-cells of the share (cell and corner) in the order in which to cover them.
        backwards: whether that is against the way around the sender's tree.
    """

    to: int
    time: float
    cells: tuple[int, ...]
    shared: tuple[int, ...]
    way: tuple[tuple[int, int], ...]
    backwards: bool


class Refusal(Note, frozen=True, tag="refusal"):
    """Helping: no share for robot ``to`` is worth the journey."""

    to: int


AnyNote = (
    Start
    | Claim
    | Retract
    | Completion
    | Withdrawal
    | Over
    | Removal
    | Frontier
    | Ask
    | Offer
    | Take
    | Grant
    | Refusal
)

WITHDRAWAL = encode(Withdrawal())
OVER = encode(Over())

_decode: Any = decoder_of(AnyNote)  # type: ignore[arg-type]


@lru_cache(maxsize=4096)
def read_note(data: bytes) -> AnyNote:
    """Decode a message.

    Raises:
        MessageError: If it is none.
    """
    note: AnyNote = _decode(data)
    return note


Stake = tuple[float, int, int]
"""A claim on a cell: time, rank (less is better), robot."""

AT_START = -1.0
"""The time of the claim that a robot has on the cell where it starts; before all others."""


class Claims:
    """One robot's copy of who owns what.

    Attributes:
        owner: the stake that holds each known cell.
        cells: how many cells each robot owns.
        dead: robots known to be dead.
        spared: those of them whose cells are not open (R10).
        complete: robots that have announced completion and not withdrawn it, and how many losses
            each knew of.
        opened: of how many of these the cells were open to it.
        over: whether a robot has found that everything is covered.
        changed: whether cells may have become open since it was last reset.
        taken: cells that have found an owner since it was last cleared.
    """

    __slots__ = (
        "cells",
        "changed",
        "complete",
        "dead",
        "delayed",
        "fewest",
        "lazy",
        "opened",
        "over",
        "owner",
        "rivals",
        "spared",
        "taken",
        "team_size",
    )

    def __init__(self, team_size: int, *, fewest: bool, lazy: bool, delayed: bool) -> None:
        """Know nothing yet.

        Args:
            team_size: number of robots.
            fewest: whether the robot with the fewest cells comes first, not the one of highest id.
            lazy: whether R10 applies.
            delayed: whether messages take time, so that a losing claim stands until it is retracted.
        """
        self.team_size = team_size
        self.fewest = fewest
        self.lazy = lazy
        self.delayed = delayed
        self.owner: dict[int, Stake] = {}
        self.rivals: dict[int, list[Stake]] = {}
        self.cells = [0] * team_size
        self.dead: set[int] = set()
        self.spared: set[int] = set()
        self.complete: dict[int, int] = {}
        self.opened: dict[int, int] = {}
        self.over = False
        self.changed = False
        self.taken: list[int] = []

    # What one can ask.

    def is_open(self, cell: int) -> bool:
        """Tell whether nobody owns a cell, or only the dead do."""
        stake = self.owner.get(cell)
        return stake is None or (stake[2] in self.dead and stake[2] not in self.spared)

    def holds(self, robot: int, cell: int) -> bool:
        """Tell whether ``robot`` owns a cell."""
        stake = self.owner.get(cell)
        return stake is not None and stake[2] == robot

    def agreed(self) -> bool:
        """Tell whether all that are alive are complete, in view of the same losses."""
        same = (len(self.dead), self.team_size)
        return all(self.complete.get(robot) in same for robot in self.alive())

    def settled(self) -> bool:
        """Tell whether all that are alive are complete, and the same cells were open to them.

        Who was on its way may only then hear that the spared are freed, and find work.
        """
        _, opened = self.view()
        return self.agreed() and all(self.opened.get(robot) == opened for robot in self.alive())

    def alive(self) -> list[int]:
        """Return the robots that are not known to be dead."""
        return [robot for robot in range(self.team_size) if robot not in self.dead]

    def view(self) -> tuple[int, int]:
        """Return how many losses are known, and of how many of them the cells are open."""
        return len(self.dead), len(self.dead) - len(self.spared)

    def any_open(self) -> bool:
        """Tell whether some known cell may be open."""
        return self.delayed or any(self.cells[robot] for robot in self.dead - self.spared)

    # What one hears.

    def hear_all(self, inbox: Iterable[tuple[int, bytes]]) -> None:
        """Take in messages as they come by radio.

        Most of them are claims on cells that nobody owns, so these are dealt with here: everybody
        hears of every cell of the grid.
        """
        owner, dead = self.owner, self.dead
        for sender, message in inbox:
            note = read_note(message)
            if note.__class__ is Claim and note.cell not in owner and sender not in dead:
                self._give(note.cell, (note.time, self.rank(sender, note), sender))
            else:
                self.hear(sender, note)

    def rank(self, sender: int, claim: Claim) -> int:
        """Return the rank of a claim among those of one instant; less is better."""
        return claim.cells * self.team_size - sender if self.fewest else -sender

    def hear(self, sender: int, note: AnyNote) -> None:
        """Take in a message; claims of a robot known to be dead are void (R8)."""
        if sender in self.dead:
            return
        kind = note.__class__
        if kind is Claim:
            self.stake(note.cell, (note.time, self.rank(sender, note), sender))  # type: ignore[union-attr, arg-type]
        elif kind is Completion:
            self.complete[sender] = note.dead  # type: ignore[union-attr]
            self.opened[sender] = note.opened  # type: ignore[union-attr]
        elif kind is Withdrawal:
            self.complete.pop(sender, None)
        elif kind is Start:
            self.stake(note.cell, (AT_START, -sender, sender))  # type: ignore[union-attr]
        elif kind is Retract:
            self.retract(note.cell, sender)  # type: ignore[union-attr]
        elif kind is Over:
            self.over = True

    def stake(self, cell: int, stake: Stake) -> None:
        """Let a robot claim a cell."""
        held = self.owner.get(cell)
        if held is None:
            self._give(cell, stake)
        elif held[2] in self.dead:
            self.spared.discard(held[2])  # whoever claims from the dead has freed all that they had
            self._give(cell, stake)
        elif self.delayed:
            if stake < held:
                self.rivals.setdefault(cell, []).append(held)
                self._give(cell, stake)
            elif stake != held:
                self.rivals.setdefault(cell, []).append(stake)
        elif stake < held or stake[0] > held[0]:
            # Without delay a robot claims open cells only: who claims later knew the owner to be dead.
            self._give(cell, stake)

    def retract(self, cell: int, robot: int) -> None:
        """Let a robot give a cell up."""
        gone = {robot, *self.dead}
        left = [stake for stake in self.rivals.pop(cell, ()) if stake[2] not in gone]
        if self.holds(robot, cell):
            self.cells[robot] -= 1
            del self.owner[cell]
            self.changed = True
            for stake in left:
                self.stake(cell, stake)
        elif left:
            self.rivals[cell] = left

    def bury(self, robot: int) -> None:
        """Hear that a robot is dead."""
        if robot in self.dead:
            return
        self.dead.add(robot)
        if self.lazy and robot in self.complete:
            self.spared.add(robot)
        self.changed = True
        for cell in [cell for cell in self.rivals if self.holds(robot, cell)]:
            for stake in self.rivals.pop(cell):
                if stake[2] not in self.dead:
                    self.stake(cell, stake)

    def free_the_spared(self) -> None:
        """Open the cells of those that died after completing, if nothing else is left (R10)."""
        if not (self.spared and self.agreed()):
            return
        _, opened = self.view()
        if self.any_open() or any(self.opened[robot] > opened for robot in self.alive()):
            self.spared.clear()
            self.changed = True

    def _give(self, cell: int, stake: Stake) -> None:
        held = self.owner.get(cell)
        if held is not None:
            self.cells[held[2]] -= 1
        self.owner[cell] = stake
        self.cells[stake[2]] += 1
        self.taken.append(cell)
