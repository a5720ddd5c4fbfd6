"""What a person sees of a run: live progress, and the verdict."""

import sys
import time
from collections.abc import Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Self

from deploy.verdict.base_ledger import PlaceName, in_words
from deploy.verdict.result import Result
from deploy.verdict.sinay import ConnectedPlan
from protocol.graph import PortGraph
from protocol.messages import Progress

if TYPE_CHECKING:
    from rich.live import Live
    from rich.table import Table
    from rich.text import Text

    from deploy.setting import Setting

PLAIN_S = 1.0
"""Without a terminal, progress is a line now and then."""

BAR = 20

SHOWN = 6
"""So many places that were not covered are named."""


class Display:
    """Live progress on stderr: redrawn in a terminal, a line a second elsewhere."""

    def __init__(self, to_cover: int, robots: int, *, quiet: bool = False) -> None:
        self._to_cover = to_cover
        self._robots = robots
        self._quiet = quiet
        self._live: Live | None = None
        self._lost: set[int] = set()
        self._next_line = 0.0
        self._started = time.monotonic()
        self._shown = ""

    def __enter__(self) -> Self:
        """Begin to show."""
        if not self._quiet and sys.stderr.isatty():
            from rich.console import Console
            from rich.live import Live

            self._live = Live(console=Console(stderr=True), refresh_per_second=12, transient=True)
            self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Leave the terminal as it was."""
        if self._live is not None:
            self._live.stop()

    def say(self, line: str) -> None:
        """Show a line that stays."""
        if self._live is not None:
            self._live.console.print(line, highlight=False)
        elif not self._quiet:
            print(line, file=sys.stderr, flush=True)

    def show(self, progress: Progress) -> None:
        """Show how far the run is."""
        for robot, at in progress.lost:
            if robot not in self._lost:
                self._lost.add(robot)
                self.say(f"  t = {at:g}: robot {robot} is lost")
        if self._live is not None:
            self._live.update(self._drawn(progress))
        elif not self._quiet and time.monotonic() >= self._next_line:
            words = self._words(progress)
            if words != self._shown and progress.steps:
                self._next_line = time.monotonic() + PLAIN_S
                self._shown = words
                self.say("  " + words)

    def _words(self, progress: Progress) -> str:
        return (
            f"t = {progress.time:g}  {progress.covered}/{self._to_cover} places  "
            f"{progress.steps} moves  {progress.alive}/{self._robots} robots"
        )

    def _drawn(self, progress: Progress) -> "Text":
        from rich.text import Text

        full = BAR * progress.covered // max(1, self._to_cover)
        text = Text("  ")
        text.append("━" * full, style="green")
        text.append("━" * (BAR - full), style="bright_black")
        text.append(f"  {self._words(progress)}")
        text.append(f"  {time.monotonic() - self._started:.1f} s", style="bright_black")
        return text


def size_of(setting: "Setting") -> str:
    """Say how large the ground of a run is."""
    if isinstance(setting.ground, PortGraph):
        return f"{setting.to_cover} vertices, {len(setting.ground.ends)} edges"
    return f"{setting.to_cover} sub-cells"


def print_verdict(result: Result) -> None:
    """Print the verdict on stdout."""
    from rich.console import Console

    marks = {True: "[green]✓[/]", False: "[red]✗[/]", None: "[bright_black]–[/]"}
    console = Console(highlight=False, soft_wrap=False)
    lost = len(result.robots_lost)
    headline, colour = ("covered", "green") if result.complete else ("NOT covered", "red")
    if result.status == "unfinished":
        headline, colour = "so far", "yellow"
    elif result.status == "stalled":
        headline += ", stalled"
    places = "places" if result.visits_extra is None else "sub-cells"
    console.print(
        f"[bold {colour}]{headline}[/]: {result.covered} of {result.to_cover} {places} by "
        f"{result.robots} robots, {lost or 'none'} lost"
    )
    for name, value in (
        ("coverage time", _number(result.coverage_time)),
        ("makespan", _number(result.makespan)),
        ("moves", str(result.steps)),
        ("planned", _planned(result)),
        ("extra visits", _extra(result)),
        ("largest tag", f"{result.device_bytes_max} bytes" if result.device_bytes_max else None),
        ("messages", _messages(result)),
        ("real time", _real_time(result)),
        ("trace", result.trace_sha256[:16]),
    ):
        if value is not None:
            console.print(f"  {name:<14} {value}", soft_wrap=True)
    if result.uncovered and result.status != "unfinished":
        console.print(f"  [red]not covered[/]    {_some(result.uncovered)}", soft_wrap=True)
    for guarantee in result.guarantees:
        mark, source = marks[guarantee.holds], f"[bright_black]{guarantee.source}[/]"
        console.print(f"  {mark} {guarantee.name}  {source}", soft_wrap=True)
        console.print(f"      [bright_black]{guarantee.detail}[/]", soft_wrap=True)
    for robot in result.per_robot:
        if robot.lost_at is not None:
            console.print(f"  robot {robot.id} lost at t = {robot.lost_at:g}")
    for waiting in result.stalled:
        where = "on its way" if waiting.place is None else f"at {in_words(waiting.place)}"
        console.print(f"  robot {waiting.robot} still waits {where}")
    for error in result.errors:
        console.print(f"  [red]robot {error.robot}: {error.error}: {error.detail}[/]")
        where = _last_place(error.traceback)
        if where:
            console.print(f"    {where}", soft_wrap=True)
    if any(fault.due is not None for fault in result.faults):
        console.print(_fault_table(result))
    for fault in result.faults_not_struck:
        console.print(f"  never struck: {fault}")


def _fault_table(result: Result) -> "Table":
    """Return a table of the faults that were due: when, what, how long until the run went on."""
    from rich.table import Table

    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bright_black")
    table.add_column("t", justify="right")
    table.add_column("fault")
    table.add_column("struck", justify="right")
    table.add_column("went on after", justify="right")
    for fault in sorted(result.faults, key=lambda one: (one.due or 0.0, one.struck_s or 0.0)):
        if fault.due is not None:
            real = "–" if fault.struck_s is None else f"{fault.struck_s:.2f} s"
            went_on = "–" if fault.went_on_s is None else f"{1000 * fault.went_on_s:.0f} ms"
            table.add_row(f"{fault.due:g}", fault.fault, real, went_on)
    return table


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:g}"


def _extra(result: Result) -> str | None:
    """Return the visits that were no first ones, and their share of the first ones."""
    if result.visits_extra is None:
        return None
    return f"{result.visits_extra}, {100 * result.visits_extra / max(1, result.covered):.0f} %"


def _planned(result: Result) -> str | None:
    """Return what the plan comes to that a team carried out."""
    if result.connected is not None:
        return _connected(result.connected)
    plan = result.parent_child
    if plan is None:
        return None
    return (
        f"{plan.stops} stops, {plan.coverage_steps} steps to cover, {plan.coordination_steps} to "
        f"coordinate; {plan.redundant_steps} of all children's are redundant"
    )


def _connected(plan: ConnectedPlan) -> str:
    heights = ", ".join(map(str, plan.split_heights))
    parts = [f"split heights {heights}" if heights else "no splits"]
    if plan.load:
        parts.append(f"load {plan.load}/16")
    if plan.reordered:
        parts.append(f"{plan.reordered} siblings in another order")
    if plan.tree != "given":
        parts.append(f"{plan.tree} tree")
    return "; ".join(parts)


def _messages(result: Result) -> str | None:
    """Return how much was said by radio, if anything."""
    if not result.messages:
        return None
    return f"{result.messages}, {result.message_bytes} bytes"


def _some(places: Sequence[PlaceName]) -> str:
    """Return the first few of some places, as text for the console."""
    from rich.markup import escape

    text = ", ".join(map(in_words, places[:SHOWN]))
    more = f" and {len(places) - SHOWN} more" if len(places) > SHOWN else ""
    return escape(text) + more


def _real_time(result: Result) -> str:
    rate = "" if result.steps_per_s is None else f", {result.steps_per_s:.0f} moves a second"
    return f"{result.wall_s:.2f} s{rate}, engine {result.engine}"


def _last_place(traceback: str | None) -> str:
    """Return the line of a traceback that says where the error was raised."""
    places = [line.strip() for line in (traceback or "").splitlines() if line.startswith("  File")]
    return places[-1] if places else ""
