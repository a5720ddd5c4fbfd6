"""The claims of ORMSTC.

Agmon, Hazon, Kaminka 2008, "The giving tree", Sec. 4.1: Theorems 4, 5 and 6.

They are judged by where the robots went. What the robots said to each other only tells who covered
which coarse cell: a cell belongs to the robot that entered it last, after claiming it. A cell where
robots start belongs to the highest of them; another of them, a spare, has it from its first move after
it has claimed it. An edge of a robot's tree leads from where it entered a cell first.

The paper assumes that robots know where they are, that bodies are not in each other's way, and that
every message is heard by all. Where one of these does not hold, Theorems 4 and 6 may be kept but not
broken, and nothing is said of Theorem 5.

Departures:

- Theorem 5 is judged in its exact form: each sub-cell is visited once, except the one where a robot
  starts, which it enters again with its last move, when its lap closes. Where a spare robot stands at
  the start counts as visited when it is entered.
- Theorem 6 speaks of what can be reached from the starts of the robots that survive.
- ``variant = "helping"`` pays with repeated visits, so Theorem 5 says nothing of it. The others are
  judged, also where they are known to fail: ``variant = "paper"`` and ``scan = "clockwise"``.
- A robot is done at the end of its last move, not when it hears that all others are done, too.
"""

from agents.algorithms.claims import Claim, Grant, Retract, read_note
from agents.algorithms.stc import located, number, row_and_column
from deploy.verdict.base_ledger import in_words
from deploy.verdict.coverage import Coverage, coverage_of
from deploy.verdict.grid_ledger import GridLedger
from deploy.verdict.guarantees import Guarantee, Share, Status
from protocol.errors import MessageError
from protocol.grid import Cell
from protocol.scenario import Scenario
from protocol.trace import Event

Finding = tuple[bool | None, str]
"""Whether a claim holds, and the detail."""


class Agmon:
    """Judges a run of ``ormstc``.

    Attributes:
        repeats: how many visits Theorem 5 does not allow.
    """

    def __init__(self, scenario: Scenario, ledger: GridLedger) -> None:
        """Take note of what is played."""
        self._scenario = scenario
        self._ledger = ledger
        self._team = len(ledger.starts)
        self._stride = ledger.grid.stride
        self._starts = ledger.starts
        self._at = list(ledger.starts)
        self._cell = [located(ledger.name(start))[0] for start in ledger.starts]
        self._owner = {cell: robot for robot, cell in enumerate(self._cell)}
        self._claimed: list[set[int]] = [set() for _ in range(self._team)]
        # For each robot the cells that it entered, and from where; its root from itself.
        self._entered: list[dict[int, int]] = [{} for _ in range(self._team)]
        self._spares = set(range(self._team)).difference(self._owner.values())
        for cell, robot in self._owner.items():
            self._claimed[robot].add(cell)
            self._entered[robot][cell] = cell
        self._moved_at: list[float | None] = [None] * self._team
        self._visited = {ledger.starts[robot] for robot in self._owner.values()}
        self._returned: dict[int, float] = {}
        self.repeats = 0
        self._first_repeat = ""

    # One pass.

    def observe(self, event: Event) -> None:
        """Take in the next event of the trace, after the ledger."""
        robot, place, what = event.robot, event.place, event.what
        if not 0 <= robot < self._team:
            return
        if place is not None and place != self._at[robot]:
            self._arrive(robot, place, event.time)
        if not isinstance(what, str) and what.messages:
            for message in what.messages:
                self._hear(robot, message)

    def _hear(self, robot: int, message: bytes) -> None:
        try:
            note = read_note(message)
        except MessageError:
            return
        if isinstance(note, Claim):
            self._claimed[robot].add(note.cell)
        elif isinstance(note, Retract):
            self._claimed[robot].discard(note.cell)
        elif isinstance(note, Grant) and 0 <= note.to < self._team:
            for cell in note.cells:
                if self._owner.get(cell) == robot:
                    self._enter(note.to, cell, cell)

    def _arrive(self, robot: int, place: int, time: float) -> None:
        self._at[robot] = place
        self._moved_at[robot] = time
        before = self._cell[robot]
        if robot in self._spares and before in self._claimed[robot]:
            self._spares.discard(robot)
            self._enter(robot, before, before)
        row, col = divmod(place, self._stride)
        cell = number((row >> 1, col >> 1))
        if cell != before:
            self._cell[robot] = cell
            if cell in self._claimed[robot]:
                self._enter(robot, cell, before)
        if robot in self._returned:
            # Its lap had not closed then.
            self._repeat(robot, self._starts[robot], self._returned.pop(robot))
        if place not in self._visited:
            self._visited.add(place)
        elif place == self._starts[robot]:
            self._returned[robot] = time
        else:
            self._repeat(robot, place, time)

    def _enter(self, robot: int, cell: int, before: int) -> None:
        self._owner[cell] = robot
        self._entered[robot].setdefault(cell, before)

    def _repeat(self, robot: int, place: int, time: float) -> None:
        self.repeats += 1
        if self.repeats == 1:
            where = in_words(self._ledger.name(place))
            self._first_repeat = f"robot {robot} entered {where} at t={time:g}"

    # Who did what.

    def complete(self) -> bool:
        """Ask for nothing but that every cell is covered."""
        return True

    def shares(self) -> list[Share]:
        """Return how many cells each robot owns, and when it was done."""
        owners = list(self._owner.values())
        losses = self._ledger.losses
        return [
            Share(owners.count(robot), None if robot in losses else moved_at)
            for robot, moved_at in enumerate(self._moved_at)
        ]

    def owners(self) -> dict[Cell, int]:
        """Return which robot each coarse cell belongs to."""
        return {row_and_column(cell): robot for cell, robot in self._owner.items()}

    def edges(self) -> list[tuple[Cell, Cell, int]]:
        """Return what is left of the trees: edges between cells that belong to one robot still."""
        return [
            (row_and_column(before), row_and_column(cell), robot)
            for robot, entered in enumerate(self._entered)
            for cell, before in entered.items()
            if cell != before and self._owner[cell] == self._owner.get(before) == robot
        ]

    # The claims.

    def report(self, status: Status) -> list[Guarantee]:
        """Judge every claim."""
        coverage = coverage_of(self._scenario, self._ledger)
        claims = (
            ("every cell covered", 4, self._complete(coverage, status)),
            ("no sub-cell visited twice", 5, self._not_redundant()),
            ("covered with up to k - 1 losses", 6, self._robust(coverage, status)),
        )
        return [
            Guarantee(name, f"Agmon et al. 2008, Theorem {number}", *finding)
            for name, number, finding in claims
        ]

    def _outside(self) -> str | None:
        """Return which assumption of the paper does not hold, if one does not."""
        scenario = self._scenario
        if scenario.sensing.drift:
            return "robots lose their way (sensing.drift)"
        if scenario.world.bodies == "block":
            return "bodies are in the way (world.bodies)"
        if scenario.radio.reach != "global":
            return "not all hear all messages (radio.reach)"
        if scenario.radio.loss:
            return "messages are lost (radio.loss)"
        return None

    def _covered(self, coverage: Coverage, status: Status, detail: str) -> Finding:
        detail += f"{coverage.covered} of {coverage.to_cover} sub-cells covered"
        if not coverage.missing:
            return True, detail
        if status == "unfinished":
            return None, f"{detail} so far"
        reason = self._outside()
        return (False, detail) if reason is None else (None, f"{detail}; {reason}")

    def _complete(self, coverage: Coverage, status: Status) -> Finding:
        if self._ledger.losses:
            return None, "robots were lost, see Theorem 6"
        return self._covered(coverage, status, "")

    def _not_redundant(self) -> Finding:
        if self._ledger.losses:
            return None, "robots were lost, see Theorem 6"
        detail = f"visits beyond the first, but for the end of a lap: {self.repeats or 'none'}"
        if self.repeats:
            detail += f"; the first: {self._first_repeat}"
        reason = self._outside()
        if self._scenario.algorithm_options.get("variant") == "helping":
            reason = 'variant "helping" pays with visits'
        return (self.repeats == 0, detail) if reason is None else (None, f"{reason}; {detail}")

    def _robust(self, coverage: Coverage, status: Status) -> Finding:
        ledger = self._ledger
        lost, left = len(ledger.losses), len(ledger.survivors)
        if not lost:
            return None, "no robot was lost"
        if not left:
            return None, "no robot survived"
        holds, detail = self._covered(
            coverage, status, f"{lost} of {self._team} robots lost, {left} left; "
        )
        extra = ledger.visits_extra
        share = 100 * extra / len(ledger.first_visits)
        return holds, f"{detail}; {extra} extra visits ({share:.0f} %)"
