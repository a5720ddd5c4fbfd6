"""Guarantees: claims that a run kept, broke, or to which it has nothing to say."""

from typing import Literal, Protocol

from msgspec import Struct

from deploy.verdict.ledger import Ledger, reachable
from protocol.trace import Observer

Status = Literal["over", "stalled", "unfinished"]
"""How far the run is: over, stalled, or cut off before its end (a replay up to some time)."""


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


class Monitor(Protocol):
    """Judges the claims of one paper."""

    @property
    def observe(self) -> Observer | None:
        """What to call with each event; ``None`` if what the ledger counts is enough."""
        ...

    def complete(self) -> bool:
        """Tell whether all was done that the paper asks for besides visiting every vertex."""
        ...

    def report(self, status: Status) -> list[Guarantee]:
        """Judge the run once it has ended."""
        ...


def common(ledger: Ledger, status: Status) -> list[Guarantee]:
    """Judge what every algorithm promises, and what the world promises to every algorithm."""
    return [covered(ledger, status), rules_kept(ledger), physics(ledger)]


def covered(ledger: Ledger, status: Status) -> Guarantee:
    """Judge whether every vertex was visited."""
    found = len(ledger.first_visits)
    expected, _ = reachable(ledger.graph, ledger.starts)
    holds: bool | None = found == expected
    detail = f"{found} of {expected} vertices visited"
    if not holds and not ledger.survivors:
        holds, detail = None, f"{detail}; no robot survived"
    elif not holds and status == "unfinished":
        holds, detail = None, f"{detail} so far"
    return Guarantee("every vertex visited", "Canopy: what a run is for", holds, detail)


def rules_kept(ledger: Ledger) -> Guarantee:
    """Judge whether every robot ended as robots end: by its stop, or killed from outside."""
    causes = {robot: loss.cause for robot, loss in ledger.losses.items() if loss.cause != "killed"}
    detail = "no robot failed or broke a rule"
    if causes:
        words = {"refused": "broke a rule", "failed": "failed"}
        detail = "; ".join(f"robot {robot} {words[cause]}" for robot, cause in causes.items())
    return Guarantee(
        "no robot ended by a fault of its own", "Canopy: errors are loud", not causes, detail
    )


def physics(ledger: Ledger) -> Guarantee:
    """Judge whether the trace is possible at all.

    Every robot is where its moves took it, after as long as they take; it takes one turn a round;
    events are in the order (time, round, wave, robot), and none follows a stop or a loss.
    """
    detail = f"{ledger.events} events, all possible"
    if ledger.first_violation is not None:
        detail = f"{ledger.events} events, violations: {ledger.violations}, the first: "
        detail += ledger.first_violation
    return Guarantee(
        "physics",
        "Canopy, architecture: a robot cannot cheat",
        ledger.violations == 0,
        detail,
    )
