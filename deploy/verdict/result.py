"""The result of a run: what `canopy run --json` prints, and the exit code that follows from it."""

from collections.abc import Mapping, Sequence
from itertools import dropwhile
from typing import Literal

from msgspec import Struct

from agents.registry import plain_name
from deploy.verdict.agmon import Agmon
from deploy.verdict.base_ledger import PlaceName
from deploy.verdict.brass import Brass
from deploy.verdict.coverage import AnyLedger, coverage_of
from deploy.verdict.grid_ledger import GridLedger
from deploy.verdict.guarantees import Guarantee, Monitor, Share, Status, common
from deploy.verdict.ledger import Ledger, reachable
from deploy.verdict.mstc import Mstc
from deploy.verdict.parent_child import ParentChild, PlannedSteps
from deploy.verdict.sinay import ConnectedPlan, Sinay
from protocol.faults import TAG_WORDS
from protocol.graph import PortGraph
from protocol.grid import Grid
from protocol.messages import Refusal
from protocol.scenario import Scenario
from protocol.trace import Observer

TRACEBACK = "Traceback (most recent call last):"
"""What a traceback begins with; all its lines are indented, and the error follows."""


class RobotResult(Struct, frozen=True, kw_only=True):
    """What became of one robot.

    Attributes:
        id: its number.
        moves: edges that it crossed; on a grid, moves to another sub-cell.
        stopped_at: when it stopped, or ``None``. For ``ormstc`` the end of its last move; ``None`` if
            it was lost, or never moved because it was not needed.
        lost_at: when it was lost, or ``None``.
        lost_by: ``"killed"``, ``"refused"`` (it broke a rule), ``"failed"``, or ``None``.
        requests: requests that were applied.
        first_visits: places where it came first, its start included.
        place: where it stands at the end, the name of the vertex, or row and column of the sub-cell;
            ``None`` if it was lost on its way.
        returned_at: when it last arrived at its start; 0 if it never did.
        cells: for ``ormstc``, how many coarse cells it owns at the end.
    """

    id: int
    moves: int
    stopped_at: float | None
    lost_at: float | None
    lost_by: str | None
    requests: int
    first_visits: int
    place: PlaceName | None
    returned_at: float
    cells: int | None = None


class Waiting(Struct, frozen=True):
    """A robot that still waited when the run stalled, and the vertex or sub-cell where it is."""

    robot: int
    place: PlaceName | None


class FaultResult(Struct, frozen=True, kw_only=True):
    """What became of one scheduled fault.

    Attributes:
        fault: what happens, to whom, and when, in words.
        due: virtual time at which it was due; ``None`` if that never came.
        struck_s: real seconds from the beginning of the run to the stroke; ``None`` if it did not
            strike, or has no real time, being part of the trace or read from a journal.
        went_on_s: real seconds from there to the next wave that was committed.
    """

    fault: str
    due: float | None
    struck_s: float | None = None
    went_on_s: float | None = None


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
        complete: the run is over, every place was visited, and all else that the algorithm's paper
            asks for (MR-DFS: every edge traversed) was done.
        covered: vertices or sub-cells visited.
        to_cover: those that can be reached (see `coverage`), and what was visited besides.
        uncovered: what was not visited: names of vertices, or rows and columns of sub-cells.
        traversed: edges traversed; ``None`` on a grid.
        to_traverse: edges that can be reached; ``None`` on a grid.
        visits_extra: on a grid, visits that were no first ones, each start and each arrival in another
            sub-cell being a visit; ``None`` on a graph.
        coverage_time: time of the last first visit.
        makespan: when the last live robot stopped; ``None`` if one did not.
        steps: moves made, all robots.
        guarantees: the claims, and whether they held.
        trace_sha256: SHA-256 of the trace.
        restarts: of each infrastructure process.
        device_bytes_max: size of the largest tag.
        messages: radio messages sent, all robots; each counts once, however many hear it.
        message_bytes: their sizes, added up.
        per_robot: what became of each robot.
        stalled: who waited where, if the run stalled.
        errors: robots that ended loudly.
        faults: what became of each scheduled fault, in the order of the scenario.
        faults_not_struck: scheduled faults that never struck.
        durability: what survives.
        wall_s: real time that it took.
        steps_per_s: moves per second of real time between the first instant and the end; ``None``
            if that is not known.
        connected: for ``ncocta``, ``cocta`` and ``cocta-best``, the plan, if made beforehand.
        parent_child: for ``parent-child``, what the plan comes to; ``None`` after losses, too.
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
    uncovered: list[PlaceName]
    traversed: int | None
    to_traverse: int | None
    visits_extra: int | None
    coverage_time: float
    makespan: float | None
    steps: int
    guarantees: list[Guarantee]
    trace_sha256: str
    restarts: dict[str, int]
    device_bytes_max: int
    messages: int
    message_bytes: int
    per_robot: list[RobotResult]
    stalled: list[Waiting]
    errors: list[RobotError]
    faults: list[FaultResult]
    faults_not_struck: list[str]
    durability: Literal["process", "power"]
    wall_s: float
    steps_per_s: float | None
    connected: ConnectedPlan | None = None
    parent_child: PlannedSteps | None = None


def ledger_of(ground: PortGraph | Grid, starts: Sequence[int], scenario: Scenario) -> AnyLedger:
    """Open the ledger of a run."""
    if isinstance(ground, Grid):
        return GridLedger(ground, starts, scenario)
    return Ledger(ground, starts, scenario)


def monitors_of(scenario: Scenario, ledger: AnyLedger) -> list[Monitor]:
    """Return the monitors of the scenario's algorithm; those of users have none."""
    match plain_name(scenario.algorithm), ledger:
        case "mr-dfs", Ledger():
            return [Brass(scenario, ledger)]
        case "ncocta" | "cocta" | "cocta-best", Ledger():
            return [Sinay(scenario, ledger)]
        case "ormstc", GridLedger():
            return [Agmon(scenario, ledger)]
        case "mstc", GridLedger():
            return [Mstc(scenario, ledger)]
        case "parent-child", GridLedger():
            return [ParentChild(scenario, ledger)]
        case _:
            return []


def observers(ledger: AnyLedger, monitors: Sequence[Monitor]) -> list[Observer]:
    """Return all that must be called with every event of the trace, in this order."""
    return [ledger.observe, *(monitor.observe for monitor in monitors if monitor.observe)]


def judge(
    scenario: Scenario,
    ledger: AnyLedger,
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
    due: Mapping[int, float] | None = None,
    struck: Mapping[int, tuple[float, float | None]] | None = None,
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
        due: when each fault that was due came, by its number; virtual time.
        struck: for faults of processes and the network that struck, when, and how long it took until
            the run went on; real seconds. ``None``: the engine has no such things, or this is a replay.
    """
    coverage, steps = coverage_of(scenario, ledger), ledger.steps
    traversed, to_traverse, visits_extra = None, None, None
    if isinstance(ledger, GridLedger):
        visits_extra = ledger.visits_extra
    else:
        traversed = len(ledger.first_crossings)
        _, to_traverse = reachable(ledger.graph, ledger.starts)
    shares = next((found for monitor in monitors if (found := monitor.shares())), None)
    planned = next((one.steps() for one in monitors if isinstance(one, ParentChild)), None)
    connected = next((one.plan() for one in monitors if isinstance(one, Sinay)), None)
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
        complete=status == "over" and not coverage.missing and asked_for,
        covered=coverage.covered,
        to_cover=coverage.to_cover,
        uncovered=[ledger.name(place) for place in coverage.missing],
        traversed=traversed,
        to_traverse=to_traverse,
        visits_extra=visits_extra,
        coverage_time=ledger.coverage_time,
        makespan=_makespan(ledger, shares),
        steps=steps,
        guarantees=[*common(ledger, coverage, status), *claims],
        trace_sha256=trace_sha256,
        restarts=dict(restarts or {}),
        device_bytes_max=ledger.device_bytes_max,
        messages=ledger.messages,
        message_bytes=ledger.message_bytes,
        per_robot=_robots(ledger, shares, status),
        stalled=[Waiting(robot, _name(ledger, robot)) for robot in waiting],
        errors=_errors(refusals or {}, failures or {}),
        faults=_faults(scenario, due or {}, struck or {}),
        faults_not_struck=(
            [] if status == "unfinished" else _not_struck(scenario, ledger, due or {}, struck)
        ),
        durability=scenario.durability,
        wall_s=wall_s,
        steps_per_s=steps / play_s if play_s > 0 else None,
        connected=connected,
        parent_child=planned,
    )


def exit_code(result: Result) -> int:
    """Return 0 if the run is complete and no guarantee is broken, else 1."""
    broken = any(guarantee.holds is False for guarantee in result.guarantees)
    return 0 if result.complete and not broken else 1


def _name(ledger: AnyLedger, robot: int) -> PlaceName | None:
    place = ledger.place(robot)
    return None if place is None else ledger.name(place)


def _robots(ledger: AnyLedger, shares: Sequence[Share] | None, status: Status) -> list[RobotResult]:
    firsts = [0] * len(ledger.starts)
    for robot, _ in ledger.first_visits.values():
        firsts[robot] += 1
    found = []
    for robot, track in enumerate(ledger.robots):
        cells, stopped_at = None, track.stopped_at
        if shares is not None:
            cells = shares[robot].cells
            if status != "unfinished" or not track.alive:
                stopped_at = shares[robot].stopped_at
        found.append(
            RobotResult(
                id=robot,
                moves=track.moves,
                stopped_at=stopped_at,
                lost_at=None if track.loss is None else track.loss.time,
                lost_by=None if track.loss is None else track.loss.cause,
                requests=track.requests,
                first_visits=firsts[robot],
                place=_name(ledger, robot),
                returned_at=track.returned_at,
                cells=cells,
            )
        )
    return found


def _makespan(ledger: AnyLedger, shares: Sequence[Share] | None) -> float | None:
    """Return when the last live robot stopped; ``None`` while a robot is alive."""
    stops = [share.stopped_at for share in shares or () if share.stopped_at is not None]
    return ledger.makespan if ledger.alive else max(stops, default=ledger.makespan)


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


def _faults(
    scenario: Scenario,
    due: Mapping[int, float],
    struck: Mapping[int, tuple[float, float | None]],
) -> list[FaultResult]:
    found = []
    for number, fault in enumerate(scenario.faults):
        at_s, went_on_s = struck.get(number, (None, None))
        found.append(
            FaultResult(fault=str(fault), due=due.get(number), struck_s=at_s, went_on_s=went_on_s)
        )
    return found


def _not_struck(
    scenario: Scenario,
    ledger: AnyLedger,
    due: Mapping[int, float],
    struck: Mapping[int, tuple[float, float | None]] | None,
) -> list[str]:
    """Name the scheduled faults that never struck: no loss in the trace goes back to them.

    A robot is lost once: of several faults at the moment of its loss the first of the file struck.
    Faults that are not in the trace struck if they were due, and if the nemesis, where there was one,
    says so.
    """
    accounted: set[int] = set()
    missing = []
    for number, fault in enumerate(scenario.faults):
        robot = fault.robot
        if robot is None or scenario.team.on_crash == "restart":
            nemesis = struck is not None and fault.word not in TAG_WORDS
            if number not in due or (nemesis and struck is not None and number not in struck):
                missing.append(str(fault))
            continue
        track = ledger.robots[robot]
        loss = track.loss
        if (
            loss is not None
            and loss.cause == "killed"
            and robot not in accounted
            and (fault.at == loss.time or fault.at_request == track.requests + 1)
        ):
            accounted.add(robot)
        else:
            missing.append(str(fault))
    return missing
