"""The result of a run: what `canopy run --json` prints, and the exit code that follows from it."""

from collections.abc import Callable, Mapping, Sequence
from itertools import dropwhile
from typing import Literal

from msgspec import Struct

from deploy.verdict.brass import Brass
from deploy.verdict.guarantees import Guarantee, Monitor, Status, common
from deploy.verdict.ledger import Ledger, reachable
from protocol.messages import Refusal
from protocol.scenario import Fault, Scenario
from protocol.trace import Observer

MONITORS: dict[str, tuple[Callable[[Scenario, Ledger], Monitor], ...]] = {"mr-dfs": (Brass,)}
"""The monitors of each algorithm of Canopy; those of users have the common guarantees."""

TRACEBACK = "Traceback (most recent call last):"
"""What a traceback begins with; all its lines are indented, and the error follows."""


class RobotResult(Struct, frozen=True, kw_only=True):
    """What became of one robot.

    Attributes:
        id: its number.
        moves: edges that it crossed.
        stopped_at: when it stopped, or ``None``.
        lost_at: when it was lost, or ``None``.
        lost_by: ``"killed"``, ``"refused"`` (it broke a rule), ``"failed"``, or ``None``.
        requests: requests that were applied.
        first_visits: vertices where it came first, its start included.
        place: name of the vertex where it stands at the end; ``None`` if it was lost on its way.
        returned_at: when it last arrived at its start; 0 if it never did.
    """

    id: int
    moves: int
    stopped_at: float | None
    lost_at: float | None
    lost_by: str | None
    requests: int
    first_visits: int
    place: str | None
    returned_at: float


class Waiting(Struct, frozen=True):
    """A robot that still waited when the run stalled, and the name of the vertex where it is."""

    robot: int
    place: str | None


class RobotError(Struct, frozen=True):
    """A robot that ended loudly: a bug of its algorithm.

    Attributes:
        robot: its number.
        error: name of the error.
        detail: one line.
        traceback: where it came from, if it is known.
    """

    robot: int
    error: str
    detail: str
    traceback: str | None = None


class Result(Struct, frozen=True, kw_only=True):
    """The result of a run.

    Attributes:
        scenario: name of the scenario.
        algorithm: name of the algorithm.
        engine: what played it.
        seed: the scenario's seed.
        robots: number of robots.
        robots_lost: those that were lost.
        status: ``"over"``; ``"stalled"``: all that were alive waited for news; ``"unfinished"``: cut
            off before its end.
        complete: the run is over, every vertex was visited, and all else that the algorithm's paper
            asks for (MR-DFS: every edge traversed) was done.
        covered: vertices visited.
        to_cover: vertices that can be reached.
        traversed: edges traversed.
        to_traverse: edges that can be reached.
        coverage_time: time of the last first visit.
        makespan: when the last live robot stopped; ``None`` if one did not.
        steps: moves made, all robots.
        guarantees: the claims, and whether they held.
        trace_sha256: SHA-256 of the trace.
        restarts: of each infrastructure process.
        device_bytes_max: size of the largest tag.
        per_robot: what became of each robot.
        stalled: who waited where, if the run stalled.
        errors: robots that ended loudly.
        faults_not_struck: scheduled faults that never struck.
        durability: what survives.
        wall_s: real time that it took.
        steps_per_s: moves per second of real time between the first instant and the end; ``None``
            if that is not known.
    """

    scenario: str
    algorithm: str
    engine: str
    seed: int
    robots: int
    robots_lost: list[int]
    status: Status
    complete: bool
    covered: int
    to_cover: int
    traversed: int
    to_traverse: int
    coverage_time: float
    makespan: float | None
    steps: int
    guarantees: list[Guarantee]
    trace_sha256: str
    restarts: dict[str, int]
    device_bytes_max: int
    per_robot: list[RobotResult]
    stalled: list[Waiting]
    errors: list[RobotError]
    faults_not_struck: list[str]
    durability: Literal["process", "power"]
    wall_s: float
    steps_per_s: float | None


def monitors_of(scenario: Scenario, ledger: Ledger) -> list[Monitor]:
    """Return the monitors of the scenario's algorithm."""
    name = scenario.algorithm.lower().replace("_", "-")
    return [monitor(scenario, ledger) for monitor in MONITORS.get(name, ())]


def observers(ledger: Ledger, monitors: Sequence[Monitor]) -> list[Observer]:
    """Return all that must be called with every event of the trace, in this order."""
    return [ledger.observe, *(monitor.observe for monitor in monitors if monitor.observe)]


def judge(
    scenario: Scenario,
    ledger: Ledger,
    monitors: Sequence[Monitor],
    *,
    status: Status,
    engine: str,
    trace_sha256: str,
    wall_s: float = 0.0,
    play_s: float = 0.0,
    refusals: Mapping[int, Refusal] | None = None,
    failures: Mapping[int, str] | None = None,
    restarts: Mapping[str, int] | None = None,
) -> Result:
    """Judge a run that has ended.

    Args:
        scenario: what was played.
        ledger: has seen the whole trace.
        monitors: have seen the whole trace.
        status: how the run ended.
        engine: what played it.
        trace_sha256: SHA-256 of the trace.
        wall_s: real time that it took, start and end included.
        play_s: real time from the first instant to the end.
        refusals: what each robot that broke a rule was told.
        failures: for each robot whose algorithm failed the text of its traceback.
        restarts: of each infrastructure process.
    """
    to_cover, to_traverse = reachable(ledger.graph, ledger.starts)
    covered, steps = len(ledger.first_visits), ledger.steps
    asked_for = all(monitor.complete() for monitor in monitors)
    claims = [claim for monitor in monitors for claim in monitor.report(status)]
    waiting = ledger.alive if status == "stalled" else []
    return Result(
        scenario=scenario.name,
        algorithm=scenario.algorithm,
        engine=engine,
        seed=scenario.seed,
        robots=len(ledger.starts),
        robots_lost=sorted(ledger.losses),
        status=status,
        complete=status == "over" and covered == to_cover and asked_for,
        covered=covered,
        to_cover=to_cover,
        traversed=len(ledger.first_crossings),
        to_traverse=to_traverse,
        coverage_time=ledger.coverage_time,
        makespan=ledger.makespan,
        steps=steps,
        guarantees=[*common(ledger, status), *claims],
        trace_sha256=trace_sha256,
        restarts=dict(restarts or {}),
        device_bytes_max=ledger.device_bytes_max,
        per_robot=_robots(ledger),
        stalled=[Waiting(robot, _name(ledger, robot)) for robot in waiting],
        errors=_errors(refusals or {}, failures or {}),
        faults_not_struck=[] if status == "unfinished" else _not_struck(scenario.faults, ledger),
        durability=scenario.durability,
        wall_s=wall_s,
        steps_per_s=steps / play_s if play_s > 0 else None,
    )


def exit_code(result: Result) -> int:
    """Return 0 if the run is complete and no guarantee is broken, else 1."""
    broken = any(guarantee.holds is False for guarantee in result.guarantees)
    return 0 if result.complete and not broken else 1


def _name(ledger: Ledger, robot: int) -> str | None:
    place = ledger.place(robot)
    return None if place is None else ledger.graph.names[place]


def _robots(ledger: Ledger) -> list[RobotResult]:
    firsts = [0] * len(ledger.starts)
    for robot, _ in ledger.first_visits.values():
        firsts[robot] += 1
    return [
        RobotResult(
            id=robot,
            moves=track.moves,
            stopped_at=track.stopped_at,
            lost_at=None if track.loss is None else track.loss.time,
            lost_by=None if track.loss is None else track.loss.cause,
            requests=track.requests,
            first_visits=firsts[robot],
            place=_name(ledger, robot),
            returned_at=track.returned_at,
        )
        for robot, track in enumerate(ledger.robots)
    ]


def _errors(refusals: Mapping[int, Refusal], failures: Mapping[int, str]) -> list[RobotError]:
    errors = [RobotError(robot, told.error, told.detail) for robot, told in refusals.items()]
    for robot, traceback in failures.items():
        errors.append(RobotError(robot, *_last_words(traceback), traceback))
    return sorted(errors, key=lambda error: error.robot)


def _last_words(text: str) -> tuple[str, str]:
    """Return the name of the error that a text ends with, and its message as one line.

    What a robot printed may stand before its traceback.
    """
    lines = text.strip().splitlines() or [""]
    said = lines[-1:]
    for index, line in enumerate(lines):
        if line == TRACEBACK:
            said = list(dropwhile(lambda line: line.startswith("  "), lines[index + 1 :])) or said
    error, _, message = said[0].partition(": ")
    return error, " ".join(filter(None, map(str.strip, [message, *said[1:]])))


def _not_struck(faults: Sequence[Fault], ledger: Ledger) -> list[str]:
    """Name the scheduled faults that no loss in the trace goes back to.

    A robot is lost once: of several faults at the moment of its loss the first of the file struck.
    """
    accounted: set[int] = set()
    missing = []
    for fault in faults:
        robot = fault.robot
        track = ledger.robots[robot]
        loss = track.loss
        struck = (
            loss is not None
            and loss.cause == "killed"
            and robot not in accounted
            and (fault.at == loss.time or fault.at_request == track.requests + 1)
        )
        if struck:
            accounted.add(robot)
            continue
        when = f"at request {fault.at_request}" if fault.at is None else f"at t={fault.at:g}"
        when += f", round {fault.round}" if fault.round else ""
        missing.append(f"kill {fault.kill} {when}")
    return missing
