"""A run judged from its folder: replayed from the journal, measured, checked and drawn."""

from collections.abc import Callable, Mapping
from math import inf
from pathlib import Path

from msgspec import Struct

from deploy.run_dir import RunDir
from deploy.verdict.agmon import Agmon
from deploy.verdict.audit import Audit
from deploy.verdict.coverage import AnyLedger
from deploy.verdict.grid_ledger import GridLedger
from deploy.verdict.guarantees import Monitor
from deploy.verdict.parent_child import ParentChild
from deploy.verdict.result import Result, judge, ledger_of, monitors_of, observers
from protocol.trace import Event
from world_server.replay import Replayed, read_opening, replay
from world_server.world import End


class Judged(Struct):
    """A run and the verdict on it.

    Attributes:
        result: the verdict.
        ledger: what was counted.
        monitors: what judged the claims of the algorithm's paper.
        replayed: the run.
    """

    result: Result
    ledger: AnyLedger
    monitors: list[Monitor]
    replayed: Replayed


def judge_journal(
    journal: Path,
    *,
    wall_s: float | None = None,
    failures: Mapping[int, str] | None = None,
    restarts: Mapping[str, int] | None = None,
    struck: Mapping[int, tuple[float, float | None]] | None = None,
    until: float = inf,
    also: Callable[[Event], None] | None = None,
) -> Judged:
    """Replay a journal and judge the run by its trace alone.

    Of a whole run by processes the folder is audited as well.

    Args:
        journal: of a run that ended, or was cut off.
        wall_s: real time that the run took; default: that of its instants, as the journal says.
        failures: for each robot whose algorithm failed the text of its exception.
        restarts: of each infrastructure process.
        struck: for each fault that the nemesis carried out when it struck, and how long it took until
            the run went on, real seconds; ``None``: there was no nemesis.
        until: judge only what happened up to this virtual time.
        also: called with each event, besides.

    Raises:
        JournalError: If the journal is damaged.
        ReplayError: If it does not give the trace that was recorded.
    """
    first = read_opening(journal)
    scenario = first.checked_scenario()
    ledger = ledger_of(first.ground.restored(), first.starts, scenario)
    monitors = monitors_of(scenario, ledger)
    observe = observers(ledger, monitors)
    audit: Audit | None = None
    if first.engine == "processes" and until == inf and journal == RunDir(journal.parent).journal:
        audit = Audit(journal.parent)
        observe.append(audit.observe)
    if also is not None:
        observe.append(also)

    def observe_all(event: Event) -> None:
        for each in observe:
            each(event)

    replayed = replay(journal, observe=observe_all, until=until)
    output = replayed.output
    play_s = 0.0 if replayed.closing is None else replayed.closing.play_s
    result = judge(
        scenario,
        ledger,
        monitors,
        status=output.status if isinstance(output, End) else "unfinished",
        engine=first.engine,
        trace_sha256=replayed.trace_sha256,
        wall_s=play_s if wall_s is None else wall_s,
        play_s=play_s,
        refusals=replayed.world.refusals,
        failures=failures,
        restarts=restarts,
        due=dict(zip(replayed.world.struck, replayed.world.struck_at, strict=True)),
        struck=struck,
    )
    if audit is not None:
        result.guarantees.extend(audit.report())
    return Judged(result, ledger, monitors, replayed)


def draw(judged: Judged, path: Path) -> None:
    """Draw who visited what, and when."""
    result, ledger = judged.result, judged.ledger
    title = f"{result.scenario}: {result.algorithm} with {result.robots} robots"
    end = "not over" if result.makespan is None else f"makespan {result.makespan:g}"
    subtitle = (
        f"{result.covered} of {result.to_cover} {ledger.units}, "
        f"coverage time {result.coverage_time:g}, {end}"
    )
    if isinstance(ledger, GridLedger):
        _draw_grid(judged, ledger, path, title, subtitle)
        return
    from deploy.picture import draw_run  # matplotlib is slow to import

    draw_run(
        ledger.graph,
        path,
        title=title,
        subtitle=subtitle,
        start=ledger.starts[0],
        first_visits=ledger.first_visits,
        crossings=ledger.first_crossings,
        lost=ledger.lost,
        team_size=result.robots,
    )


def _draw_grid(judged: Judged, ledger: GridLedger, path: Path, title: str, subtitle: str) -> None:
    from deploy.picture_grid import draw_grid_run
    from deploy.picture_parent_child import ParentTrail

    owners, edges = {}, []
    trail, parents = None, 0
    for monitor in judged.monitors:
        if isinstance(monitor, Agmon):
            owners, edges = monitor.owners(), monitor.edges()
        elif isinstance(monitor, ParentChild):
            trail, parents = ParentTrail(*monitor.trail()), monitor.parents
    stopped = {}
    for robot in judged.result.per_robot:
        place = ledger.place(robot.id)
        if robot.stopped_at is not None and place is not None:
            stopped[robot.id] = place
    draw_grid_run(
        ledger.grid,
        path,
        title=title,
        subtitle=subtitle,
        starts=[ledger.name(start) for start in ledger.starts],
        first_visits=ledger.first_visits,
        owners=owners,
        edges=edges,
        lost=ledger.lost,
        stopped=stopped,
        team_size=judged.result.robots,
        parents=parents,
        overlay=trail,
    )
