"""What `canopy paper ormstc` does: play the parts of the experiment, print tables, write files.

Into its folder go, for each part, ``PART.png`` (the figure), ``PART.csv`` (a line for each run) and
``PART.json`` (the numbers of the table).
"""

from collections.abc import Callable, Sequence
from math import isnan
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from experiments import plots
from experiments.command import Tally, check_parts, files_of, print_json, write_csv, write_json
from experiments.ormstc import (
    BASELINE,
    PARTS,
    PUBLISHED,
    QUICK,
    Plan,
    Row,
    Size,
    deviation,
    relative,
    rows_of,
)
from experiments.sweep import Measured, sweep, trace_inprocess, trace_of_processes

WIDTH = 96
"""Columns that the widest table takes."""


class Check(Struct, frozen=True):
    """A run that was also played with a process for each robot.

    Attributes:
        labels: which.
        seed: its seed.
        same: whether both traces are the same.
        trace_sha256: of the run in-process.
    """

    labels: dict[str, Any]
    seed: int
    same: bool
    trace_sha256: str


class Part(Struct, frozen=True):
    """What came of a part.

    Attributes:
        part: its name.
        about: what was played.
        rows: the numbers.
        checks: runs that were played on both engines.
    """

    part: str
    about: tuple[str, ...]
    rows: list[Row]
    checks: list[Check]


def ormstc(
    *, out: Path | None, only: Sequence[str], quick: bool, inputs: int | None, as_json: bool
) -> int:
    """Play the experiments on ORMSTC, and return the exit code.

    Args:
        out: folder for the files; default: ``runs/paper-ormstc``.
        only: parts to play; none: all.
        quick: play a few runs of each part.
        inputs: worlds of the part ``losses``.
        as_json: print the numbers as one JSON object, and no tables.

    Raises:
        InputError: If there is no such part, or the files cannot be written.
    """
    check_parts(only, PARTS)
    size = QUICK if quick else Size()
    if inputs is not None:
        size = msgspec.structs.replace(size, inputs=inputs)
    with files_of("ormstc", out) as folder:
        parts = [play_part(name, size, folder) for name in PARTS if name in (only or PARTS)]
    if as_json:
        print_json("ormstc", folder, {part.part: part for part in parts})
    else:
        for part in parts:
            print_part(part)
        print(f"\nfigures and numbers in {folder}")
    sound = all(check.same for part in parts for check in part.checks) and not any(
        row.impossible for part in parts for row in part.rows
    )
    return 0 if sound else 1


def play_part(
    name: str, size: Size, folder: Path, workers: int | None = None, *, check: bool = True
) -> Part:
    """Play one part and write its files.

    Args:
        name: of the part.
        size: how much is played.
        folder: where the files go.
        workers: number of processes that play; default: as for all papers.
        check: play some runs with a process for each robot, too.
    """
    plan = PARTS[name](size)
    with Tally(name) as tally:
        results = sweep([run.tree for run in plan.runs], workers=workers, show=tally.show)
    checks = []
    for run in plan.samples if check else ():
        trace = trace_inprocess(run.tree)
        same = trace == trace_of_processes(run.tree)
        checks.append(Check(run.labels, run.tree["seed"], same, trace))
    part = Part(name, plan.about, rows_of(plan, results), checks)
    plots.FIGURES[name](part.rows, folder / f"{name}.png")
    _write_runs(folder / f"{name}.csv", plan, results)
    write_json(folder / f"{name}.json", part)
    return part


def _write_runs(path: Path, plan: Plan, results: Sequence[Measured]) -> None:
    lines = (
        [*run.labels.values(), run.tree["seed"], *msgspec.structs.astuple(result)]
        for run, result in zip(plan.runs, results, strict=True)
    )
    write_csv(path, [*plan.runs[0].labels, "seed", *Measured.__struct_fields__], lines)


# Tables.

Cells = Callable[[Row], list[str]]


def print_part(part: Part) -> None:
    """Print the table of a part on stdout."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    head, cells = _TABLES[part.part](part.rows)
    # The parts' own words; nothing in them is markup.
    console = Console(highlight=False, markup=False)
    console.width = max(console.width, WIDTH)
    table = Table(box=box.SIMPLE_HEAD, title=part.part, title_justify="left", title_style="bold")
    for number, name in enumerate(head):
        table.add_column(name, justify="left" if number == 0 else "right")
    for row in part.rows:
        table.add_row(*cells(row))
    console.print(table)
    for line in part.about:
        console.print(f"  {line}", style="bright_black", soft_wrap=True)
    for check in part.checks:
        of = ", ".join(f"{name} {value}" for name, value in check.labels.items())
        same = "the same trace" if check.same else "ANOTHER TRACE"
        line = f"  {of}, seed {check.seed}: {same} with a process for each robot"
        console.print(line, style="green" if check.same else "bold red", soft_wrap=True)
    wrong = sum(row.impossible for row in part.rows)
    if wrong:
        console.print(f"  {wrong} runs with events that cannot be", style="bold red")


def _figure13(_: Sequence[Row]) -> tuple[list[str], Cells]:
    head = ["map", "robots", "coverage time", "even share", "ratio", "complete"]

    def cells(row: Row) -> list[str]:
        ratio = f"{row.coverage_time / row.even_share:.2f}"
        labels = [str(row.labels["map"]), str(row.labels["robots"])]
        return [*labels, _time(row), f"{row.even_share:.0f}", ratio, _complete(row)]

    return head, cells


def _options(rows: Sequence[Row]) -> tuple[list[str], Cells]:
    head = ["option", "coverage time", f"of {BASELINE}", "extra", "covered", "complete", "failed"]
    shares = relative(rows)

    def cells(row: Row) -> list[str]:
        name = str(row.labels["option"])
        share = shares[name]
        return [
            name,
            _time(row),
            "–" if share is None else f"{share:.2f}",
            _percent(row.extra_percent),
            _percent(row.covered_percent),
            _complete(row),
            str(row.failed),
        ]

    return head, cells


def _losses(_: Sequence[Row]) -> tuple[list[str], Cells]:
    head = ["robots", "lost", "lazy", "coverage time", "spec", "apart", "extra", "spec", "complete"]

    def cells(row: Row) -> list[str]:
        published = PUBLISHED[int(row.labels["robots"]), int(row.labels["losses"])]
        apart = deviation(row)
        extra = published.extra_percent
        return [
            str(row.labels["robots"]),
            f"{row.killed:g} of {row.labels['losses']}" if row.labels["losses"] else "0",
            ("yes" if row.labels["lazy"] else "no") if row.labels["losses"] else "",
            _time(row),
            f"{published.coverage_time:g}",
            "–" if isnan(apart) else f"{apart:+.1f} se",
            _percent(row.extra_percent),
            "" if extra is None else f"{extra:g} %",
            _complete(row),
        ]

    return head, cells


def _helping(_: Sequence[Row]) -> tuple[list[str], Cells]:
    head = ["starts", "variant", "robots", "coverage time", "even share", "extra", "complete"]

    def cells(row: Row) -> list[str]:
        labels = [str(row.labels[name]) for name in ("starts", "variant", "robots")]
        share = f"{row.even_share:.0f}"
        return [*labels, _time(row), share, _percent(row.extra_percent), _complete(row)]

    return head, cells


_TABLES = {"figure13": _figure13, "options": _options, "losses": _losses, "helping": _helping}


def _time(row: Row) -> str:
    return f"{row.coverage_time:.0f} ± {row.coverage_time_sd:.0f}"


def _percent(share: float) -> str:
    return f"{share:.1f} %"


def _complete(row: Row) -> str:
    return f"{row.complete}/{row.runs}"
