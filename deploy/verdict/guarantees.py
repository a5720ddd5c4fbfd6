"""Guarantees: claims that a run kept, broke, or to which it has nothing to say."""

from collections.abc import Sequence
from typing import Literal, Protocol

from msgspec import Struct

from deploy.verdict.base_ledger import BaseLedger
from deploy.verdict.coverage import Coverage
from protocol.trace import Observer

Status = Literal["over", "stalled", "unfinished"]
"""How far the run is: over, stalled, or cut off before its end (a replay up to some time)."""


WRONG_TAGS = "a corrupted tag was not noticed (device.checksum), and wrong marks can hide places"
"""Why nobody can promise that all is visited."""


class Guarantee(Struct, frozen=True):
    """One claim, and whether this run kept it.

    Attributes:
        name: what is claimed, in a few words.
        source: who claims it: paper and number.
        holds: whether it held; ``None`` where the claim does not apply to this run.
        detail: what was found and what is allowed, or why the claim does not apply.
    """

    name: str
    source: str
    holds: bool | None
    detail: str


class Share(Struct, frozen=True):
    """One robot's part in a run, as a paper counts it.

    Attributes:
        cells: how many coarse cells it owns at the end.
        stopped_at: when it was done; ``None`` if it was lost or did nothing.
    """

    cells: int
    stopped_at: float | None


class Monitor(Protocol):
    """Judges the claims of one paper."""

    @property
    def observe(self) -> Observer | None:
        """What to call with each event; ``None`` if what the ledger counts is enough."""
        ...

    def complete(self) -> bool:
        """Tell whether all was done that the paper asks for besides visiting every place."""
        ...

    def shares(self) -> Sequence[Share] | None:
        """Return each robot's part; ``None`` where the paper counts as everybody does."""
        ...

    def report(self, status: Status) -> list[Guarantee]:
        """Judge the run once it has ended."""
        ...


def common(ledger: BaseLedger, coverage: Coverage, status: Status) -> list[Guarantee]:
    """Judge what every algorithm promises, and what the world promises to every algorithm."""
    return [covered(ledger, coverage, status), rules_kept(ledger), physics(ledger)]


def covered(ledger: BaseLedger, coverage: Coverage, status: Status) -> Guarantee:
    """Judge whether every place was visited."""
    holds: bool | None = not coverage.missing
    detail = f"{coverage.covered} of {coverage.to_cover} {ledger.units} visited"
    if not holds and coverage.hindered:
        holds, detail = None, f"{detail}; {coverage.hindered}"
    elif not holds and status == "unfinished":
        holds, detail = None, f"{detail} so far"
    elif not holds and ledger.wrong_tags:
        holds, detail = None, f"{detail}; {WRONG_TAGS}"
    return Guarantee(f"every {ledger.unit} visited", "Canopy: what a run is for", holds, detail)


def rules_kept(ledger: BaseLedger) -> Guarantee:
    """Judge whether every robot ended as robots end: by its stop, or killed from outside."""
    causes = {robot: loss.cause for robot, loss in ledger.losses.items() if loss.cause != "killed"}
    detail = "no robot failed or broke a rule"
    if causes:
        words = {"refused": "broke a rule", "failed": "failed"}
        detail = "; ".join(f"robot {robot} {words[cause]}" for robot, cause in causes.items())
    return Guarantee(
        "no robot ended by a fault of its own", "Canopy: errors are loud", not causes, detail
    )


def physics(ledger: BaseLedger) -> Guarantee:
    """Judge whether the trace is possible at all.

    Every robot is where its moves took it, after as long as they take; it takes one turn a round;
    events are in the order (time, round, wave, robot), and none follows a stop or a loss. Devices fail
    when the scenario has them fail.
    """
    detail = f"{ledger.events} events, all possible"
    if ledger.tag_faults:
        detail += f"; failures of devices, as scheduled: {len(ledger.tag_faults)}"
    if ledger.first_violation is not None:
        detail = f"{ledger.events} events, violations: {ledger.violations}, the first: "
        detail += ledger.first_violation
    return Guarantee(
        "physics",
        "Canopy, architecture: a robot cannot cheat",
        ledger.violations == 0,
        detail,
    )
