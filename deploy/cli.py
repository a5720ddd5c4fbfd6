"""The command line: `canopy run | replay | map | plan | paper | doctor`.

Exit codes: 0, the run is complete and all guarantees hold; 1, it is not; 2, a scenario, a map or the
command line cannot be used: one line on stderr names file, field and fix.
"""

import argparse
import asyncio
import math
import os
import signal
import sys
import time
import uuid
from collections.abc import Sequence
from contextlib import redirect_stdout
from importlib.util import find_spec
from pathlib import Path
from typing import NoReturn

from deploy.cli_plan import add_plan, whole_number
from protocol.errors import CanopyError, InputError, JournalError, MachineError, ScenarioError

EXAMPLES = """\
examples:
  canopy run deploy/scenarios/demo.toml
  canopy run demo.toml --set team.robots=16 --set world.map=my_cave.edges
  canopy run demo.toml --set 'faults=[{kill="robot:3", at=40}]' --engine inprocess
  canopy replay runs/demo-1 --until 30
  canopy map my_cave.edges
  canopy paper ormstc --quick
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    parsed = _parser().parse_args(arguments)
    if (
        arguments is None
    ):  # a command of its own: told to end, it ends what it started, as by Ctrl-C
        signal.signal(signal.SIGTERM, lambda *_: signal.raise_signal(signal.SIGINT))
    try:
        code: int = parsed.command(parsed)
    except (InputError, JournalError) as error:
        return _refuse(error)
    except ModuleNotFoundError as error:
        return _refuse(MachineError(f"the package {error.name!r} is missing; run `make setup`"))
    except CanopyError as error:
        print(f"canopy: {type(error).__name__}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("canopy: interrupted; everything that ran has ended", file=sys.stderr)
        return 128 + signal.SIGINT
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return code


def _refuse(error: CanopyError) -> int:
    print(f"canopy: {error}", file=sys.stderr)
    return 2


class _Parser(argparse.ArgumentParser):
    """Says what is wrong with a command line in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"canopy: {message}; see `{self.prog} --help`\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="canopy",
        description="Teams of robots that explore and cover an area together, each a process.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    run = commands.add_parser(
        "run",
        help="play a scenario and judge it",
        description="Play a scenario, show how it goes, and end with a verdict.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    run.add_argument("scenario", type=Path, metavar="SCENARIO.toml", help="what to play")
    run.add_argument(
        "--engine",
        choices=("inprocess", "processes"),
        default="processes",
        help="one thread, or one process per robot (default); both give the same trace",
    )
    run.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="override a field, such as team.robots=16; may be given often",
    )
    run.add_argument("--out", type=Path, metavar="DIR", help="folder of the run (runs/NAME-N)")
    run.add_argument("--json", action="store_true", help="print the result as one JSON object")
    run.add_argument("--no-picture", action="store_true", help="do not draw run.png")
    run.set_defaults(command=_run)

    replay = commands.add_parser(
        "replay",
        help="simulate a run again from its journal, and check its trace",
        description="Simulate a finished or crashed run again, check its trace, and judge it.",
    )
    replay.add_argument("run_dir", type=Path, metavar="RUN_DIR", help="folder of the run")
    replay.add_argument("--until", type=float, metavar="T", help="stop at this virtual time")
    replay.add_argument("--events", action="store_true", help="print each event of the trace")
    replay.add_argument("--json", action="store_true", help="print the result as one JSON object")
    replay.set_defaults(command=_replay)

    map_ = commands.add_parser(
        "map",
        help="say what a map file is, and draw it",
        description=(
            "Read a map, describe it and draw it. Graphs: .edges, GraphML, node-link JSON. "
            "Grids: MovingAI .map, ROS map_server .yaml, images, .txt of . and #."
        ),
    )
    map_.add_argument("file", type=Path, metavar="FILE", help="the map")
    map_.add_argument(
        "--cell-m", type=float, metavar="M", help="side of a sub-cell of a grid (its resolution)"
    )
    map_.add_argument(
        "--resolution-m", type=float, metavar="M", help="side of a pixel or character of a grid"
    )
    map_.add_argument(
        "--los",
        type=float,
        metavar="R_M",
        help="also say how many cells of a grid see each other, less than so many metres away",
    )
    map_.add_argument("--json", action="store_true", help="print the facts as one JSON object")
    map_.add_argument(
        "--picture",
        type=Path,
        metavar="PNG",
        help="where to draw (NAME.png here; NAME-map.png if the map is an image)",
    )
    map_.set_defaults(command=_map)

    add_plan(commands)

    paper = commands.add_parser(
        "paper",
        help="play a paper's experiments, with figures and tables",
        description="Play the experiments of a paper, print tables, and write figures and numbers.",
    )
    paper.add_argument(
        "name", metavar="NAME", help="the paper: connected, mstc, ormstc or parent-child"
    )
    paper.add_argument(
        "--only",
        action="append",
        default=[],
        metavar="PART",
        help="play one part, such as figure13 of ormstc, figure6 of mstc, table of connected; may be "
        "given often",
    )
    paper.add_argument("--quick", action="store_true", help="play a few runs of each part")
    paper.add_argument(
        "--inputs",
        type=whole_number,
        metavar="N",
        help="how many are drawn: losses of ormstc (100), mstc (300), general trees of connected, "
        "maps of parent-child (8)",
    )
    paper.add_argument("--out", type=Path, metavar="DIR", help="folder for files (runs/paper-NAME)")
    paper.add_argument("--json", action="store_true", help="print the numbers as one JSON object")
    paper.set_defaults(command=_paper)

    doctor = commands.add_parser("doctor", help="check this machine, and list the algorithms")
    doctor.set_defaults(command=_doctor)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    import msgspec  # here as everywhere below, so that `main` can name a package that is missing

    from deploy.judged import draw, judge_journal
    from deploy.report import Display, print_verdict, size_of
    from deploy.run_dir import RunDir
    from deploy.setting import prepare
    from deploy.verdict.result import exit_code
    from protocol.scenario import load

    # Refuse what is missing at the end before anything is made.
    wanted = [
        *([] if arguments.no_picture else ["matplotlib"]),
        *([] if arguments.json else ["rich"]),
    ]
    for package in wanted:
        if find_spec(package) is None:
            raise ModuleNotFoundError(name=package)
    sys.path.insert(0, str(Path.cwd()))  # for algorithms of users
    scenario = load(arguments.scenario, arguments.overrides)
    try:
        setting = prepare(scenario)
    except ScenarioError as error:
        raise ScenarioError(f"{arguments.scenario}: {error}") from None
    if arguments.engine == "processes":
        from deploy import processes
        from protocol.zenoh_link import free_port

        free_port(scenario.network.port)  # refuse before anything is made
    run_dir = RunDir.create(arguments.out, scenario.name)
    name = f"{run_dir.path.name}-{uuid.uuid4().hex[:12]}".replace(" ", "-")
    robots = scenario.team.robots
    started = time.monotonic()
    with Display(setting.to_cover, robots) as display:
        display.say(
            f"{scenario.name}: {scenario.algorithm}, {robots} robots, {size_of(setting)}, "
            f"engine {arguments.engine}"
        )
        for note in setting.notes:
            display.say(f"  {note}")
        if arguments.engine == "processes":
            play = processes.play(setting, run_dir, name, display.show, display.say)
            told = asyncio.run(play).told(started)
        else:
            from deploy import inprocess

            with redirect_stdout(sys.stderr):  # what an algorithm prints is no result
                told = {"failures": inprocess.run(setting, run_dir, name, display.show)}
        judged = judge_journal(run_dir.journal, wall_s=time.monotonic() - started, **told)
        run_dir.result.write_bytes(msgspec.json.format(msgspec.json.encode(judged.result)) + b"\n")
        if not arguments.no_picture:
            display.say("  drawing ...")
            draw(judged, run_dir.picture)
    if arguments.json:
        print(msgspec.json.encode(judged.result).decode())
    else:
        print_verdict(judged.result)
        picture = "" if arguments.no_picture else f", picture in {run_dir.picture}"
        print(f"result in {run_dir.result}{picture}")
    return exit_code(judged.result)


def _replay(arguments: argparse.Namespace) -> int:
    import msgspec

    from deploy.judged import judge_journal
    from deploy.report import print_verdict
    from deploy.run_dir import RunDir
    from deploy.verdict.result import exit_code
    from protocol.trace import Event

    def show(event: Event) -> None:
        print(event, file=sys.stderr if arguments.json else sys.stdout)

    if not arguments.run_dir.is_dir():
        raise InputError(f"{arguments.run_dir}: no such folder; expected the folder of a run")
    judged = judge_journal(
        RunDir(arguments.run_dir).journal,
        until=math.inf if arguments.until is None else arguments.until,
        also=show if arguments.events else None,
    )
    if arguments.json:
        print(msgspec.json.encode(judged.result).decode())
    else:
        print_verdict(judged.result)
        if judged.result.status != "unfinished":
            print("the replayed trace is the recorded one")
        elif arguments.until is None:
            print("the run was cut off before its end; this is how far its journal goes")
    if arguments.until is not None:
        return 0
    return exit_code(judged.result)


def _map(arguments: argparse.Namespace) -> int:
    import msgspec

    from deploy.map_facts import describe, facts_of
    from world_server.maps import GridFile, read_map

    found = read_map(arguments.file, cell_m=arguments.cell_m, resolution_m=arguments.resolution_m)
    facts = facts_of(arguments.file, found, arguments.los)
    # A map that is an image, or has one beside it, must not be drawn over.
    is_image = isinstance(found, GridFile) and found.kind in {"image", "ros"}
    picture = arguments.picture or Path(f"{arguments.file.stem}{'-map' * is_image}.png")
    try:
        if picture.exists() and picture.samefile(arguments.file):
            raise InputError(f"--picture {picture}: is the map itself, expected another file")
        if isinstance(found, GridFile):
            from deploy.picture_grid import draw_grid

            draw_grid(found.grid, picture, arguments.file.stem)
        else:
            from deploy.picture import draw_map

            draw_map(found, picture, arguments.file.stem, 0)
    except (OSError, ValueError) as error:
        raise InputError(f"--picture {picture}: {error}") from None
    if arguments.json:
        print(msgspec.json.encode(facts).decode())
    else:
        for line in describe(facts):
            print(line)
        print(f"picture in {picture}")
    return 0


def _paper(arguments: argparse.Namespace) -> int:
    from importlib.metadata import entry_points

    # Experiments stand on this floor and may be left out of an installation: found by name.
    papers = {entry.name: entry for entry in entry_points(group="canopy.papers")}
    if not papers:
        raise MachineError("the package 'experiments' is not installed; run `make setup`")
    if arguments.name not in papers:
        known = ", ".join(sorted(papers))
        raise InputError(f"paper {arguments.name}: no such paper; expected {known}")
    play = papers[arguments.name].load()
    code: int = play(
        out=arguments.out,
        only=arguments.only,
        quick=arguments.quick,
        inputs=arguments.inputs,
        as_json=arguments.json,
    )
    return code


def _doctor(_: argparse.Namespace) -> int:
    from deploy.doctor import report

    return report(print)


if __name__ == "__main__":
    sys.exit(main())
