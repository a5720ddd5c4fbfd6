"""The command `canopy plan`: what it is given, and what it prints and writes."""

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from protocol.errors import InputError

PARENT_CHILD = "parent-child"
FOR_WALKS = ("seed", "tree", "distance", "tries", "alpha", "all_bridges", "budget", "open")
FOR_PARENTS = ("r_los", "spacing", "los_cells_squared", "teams")
"""Options that only some algorithms take."""

PLAN = """\
Plan who covers what of a known map: a walk for each robot, all computed before any moves.

Algorithms are named TREE+SPLIT (Agmon et al. 2008, Sec. 3). TREE is a spanning tree of the coarse
cells (2 x 2 free sub-cells): random, depth-first, breadth-first, minimum (random weights), or
create-tree, which grows a subtree for each robot, away from the others, and keeps the best of many
sets of bridges between them. SPLIT divides the tour around the tree: nb-mstc, where each robot
follows it to the cell before the next robot's start; b-mstc, where the largest gap and the two after
it may be shared; opt-mstc, where each robot covers some of the tour behind it and some before it,
the fewer first, so that the last is covered as early as can be. The algorithm best searches without
a tree, and covers all free sub-cells that can be reached.

When its part is covered a robot goes home by a short way over sub-cells that are covered by then, so
that the way home covers nothing: coverage time is the same with and without --open. Times and lengths
are moves. Robots share one connected part of the map.

The algorithm parent-child plans for --robots children (5) that move in sight of a parent robot only:
where that stands, and every move of all of them. A character is a vertex; of maps with a scale a
square of --spacing is one. With --teams there are several parents, and the children are shared
among them: each team covers a part of the map.
"""

PLAN_EXAMPLES = """\
examples:
  canopy plan office.txt --robots 8 --picture plan.png
  canopy plan office.txt --starts "0,0 0,9 17,4" --algorithm create-tree+nb-mstc --json
  canopy plan office.txt --starts "0,0 0,9" --tree my_tree.txt --algorithm opt-mstc
  canopy plan office.txt --robots 3 --all-bridges --paths walks.json
  canopy plan office.txt --algorithm parent-child --r-los 2.5 --spacing 0.5 --picture plan.png
"""


def add_plan(commands: "argparse._SubParsersAction[Any]") -> None:
    """Add the command to those of the command line."""
    plan = commands.add_parser(
        "plan",
        help="plan who covers what of a known map",
        description=PLAN,
        epilog=PLAN_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    plan.add_argument("map", type=Path, metavar="MAP", help="a grid, as `canopy map` reads it")
    plan.add_argument(
        "--robots", type=whole_number, metavar="K", help="how many; they start where the seed says"
    )
    plan.add_argument(
        "--starts", metavar="'R,C R,C ...'", help="row and column of each robot's sub-cell"
    )
    plan.add_argument(
        "--algorithm",
        default="create-tree+opt-mstc",
        metavar="NAME",
        help="TREE+SPLIT, best, or parent-child (create-tree+opt-mstc)",
    )
    plan.add_argument("--seed", type=int, metavar="N", help="of all that is drawn (0)")
    plan.add_argument(
        "--tree",
        type=Path,
        metavar="FILE",
        help="take this tree instead: edges R,C-R,C between coarse cells; # begins a comment",
    )
    plan.add_argument(
        "--distance",
        choices=("manhattan", "euclid", "shortest-path"),
        help="between the tips of growing subtrees (manhattan)",
    )
    plan.add_argument(
        "--tries",
        metavar="N",
        help="sets of bridges to draw: a number; alpha, K to the power of --alpha (default); "
        "or max, that but at least as many as there are sub-cells",
    )
    plan.add_argument("--alpha", type=float, metavar="A", help="see --tries (2)")
    plan.add_argument(
        "--all-bridges",
        action="store_const",
        const=True,
        help="evaluate all sets of bridges, keep the best, and say what they come to",
    )
    plan.add_argument(
        "--budget",
        type=float,
        metavar="S",
        help="for best: so many seconds of processor time, about (10); how fast the machine is "
        "does not change the plan",
    )
    plan.add_argument(
        "--open",
        action="store_const",
        const=True,
        help="let walks end where the last cell is covered",
    )
    for option, kind, name, text in (
        ("--r-los", float, "M", "how far the parent sees, metres (2.5)"),
        ("--spacing", float, "M", "from vertex to vertex, metres (0.5)"),
        ("--los-cells-squared", int, "N", "how far instead: largest squared distance in vertices"),
        ("--teams", str, "T", "parents that share the children (1); 0 or best: what is fastest"),
    ):
        plan.add_argument(option, type=kind, metavar=name, help=f"for parent-child: {text}")
    plan.add_argument(
        "--paths",
        type=Path,
        metavar="FILE",
        help="write the walks: JSON, a list of [row, column] for each robot, from its start",
    )
    plan.add_argument("--picture", type=Path, metavar="PNG", help="draw tree, parts and starts")
    plan.add_argument("--json", action="store_true", help="print the plan as one JSON object")
    plan.add_argument("--cell-m", type=float, metavar="M", help="side of a sub-cell")
    plan.add_argument("--resolution-m", type=float, metavar="M", help="side of a pixel")
    plan.set_defaults(command=_plan)


def whole_number(text: str) -> int:
    """Read a whole number from 1."""
    if not text.isdecimal() or not int(text):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a whole number from 1")
    return int(text)


def _plan(arguments: argparse.Namespace) -> int:
    for_parents = arguments.algorithm == PARENT_CHILD
    _check_options(arguments, for_parents=for_parents)
    _check_files(arguments)
    lines = _plan_for_parents(arguments) if for_parents else _plan_walks(arguments)
    for line in lines:
        print(line)
    return 0


def _check_options(arguments: argparse.Namespace, *, for_parents: bool) -> None:
    """Refuse options that the algorithm does not take."""
    for option in FOR_WALKS if for_parents else FOR_PARENTS:
        if getattr(arguments, option) is not None:
            name = "--" + option.replace("_", "-")
            fix = f"no {name}" if for_parents else f"--algorithm {PARENT_CHILD}, or no {name}"
            raise InputError(f"{name}: not for the algorithm {arguments.algorithm}; expected {fix}")


def _check_files(arguments: argparse.Namespace) -> None:
    """Refuse files that a plan cannot be written to, before anything is planned."""
    for option in ("paths", "picture"):
        path = getattr(arguments, option)
        if path is not None and (path.is_dir() or not path.absolute().parent.is_dir()):
            raise InputError(f"--{option} {path}: expected a file in a folder that exists")
        is_there = path is not None and path.exists() and arguments.map.exists()
        if is_there and path.samefile(arguments.map):
            raise InputError(f"--{option} {path}: is the map itself, expected another file")


def _plan_walks(arguments: argparse.Namespace) -> Iterator[str]:
    """Plan a walk for each robot, write the files, and yield what is to be printed."""
    from deploy.plan import Wanted, describe, draw_plan, plan, write_paths
    from world_server.maps import GridFile, read_map

    found = read_map(arguments.map, cell_m=arguments.cell_m, resolution_m=arguments.resolution_m)
    if not isinstance(found, GridFile):
        raise InputError(f"{arguments.map}: is a graph, expected a grid")
    given = {
        "seed": arguments.seed,
        "tree": arguments.tree,
        "distance": arguments.distance,
        "tries": arguments.tries,
        "alpha": arguments.alpha,
        "all_bridges": arguments.all_bridges,
        "is_open": arguments.open,
        "budget_s": arguments.budget,
    }
    wanted = Wanted(
        algorithm=arguments.algorithm,
        robots=arguments.robots,
        starts=arguments.starts,
        **{name: value for name, value in given.items() if value is not None},
    )
    planned = plan(found.grid, wanted, _progress())
    _write(arguments, "paths", lambda path: write_paths(path, planned.walks))
    name = arguments.map.stem
    _write(arguments, "picture", lambda path: draw_plan(found.grid, planned, path, name))
    yield from _told(arguments, planned.facts, found.notes, describe(planned))


def _plan_for_parents(arguments: argparse.Namespace) -> Iterator[str]:
    """Plan for parents and children, write the files, and yield what is to be printed."""
    from deploy.plan_parent_child import (
        WantedTeam,
        describe_team,
        draw_team_plan,
        plan_parent_child,
        read_vertices,
        write_places,
    )

    found = read_vertices(
        arguments.map, arguments.spacing, arguments.cell_m, arguments.resolution_m
    )
    wanted = WantedTeam(
        children=arguments.robots,
        teams=_teams(arguments.teams),
        start=arguments.starts,
        r_los_m=arguments.r_los,
        spacing_m=arguments.spacing if arguments.cell_m is None else arguments.cell_m,
        los_cells_squared=arguments.los_cells_squared,
    )
    planned = plan_parent_child(found.grid, wanted, _progress())
    plans = [team.plan for team in planned.teams]
    _write(arguments, "paths", lambda path: write_places(path, plans))
    name = arguments.map.stem
    _write(arguments, "picture", lambda path: draw_team_plan(found.grid, planned, path, name))
    yield from _told(arguments, planned.facts, found.notes, describe_team(planned))


def _teams(text: str | None) -> int:
    """Read how many teams there are to be; 0 for as many as are fastest."""
    if text is None:
        return 1
    if text == "best":
        return 0
    if not text.isdecimal():
        raise InputError(f"--teams: found {text!r}, expected a whole number, or 'best'")
    return int(text)


def _progress() -> Callable[[str], None]:
    """Return what says on stderr now and then how far it is."""
    said = time.monotonic()

    def say(line: str) -> None:
        nonlocal said
        if time.monotonic() - said >= 1:  # what is done at once needs no progress
            said = time.monotonic()
            print(f"  {line}", file=sys.stderr, flush=True)

    return say


def _write(arguments: argparse.Namespace, option: str, write: Callable[[Path], object]) -> None:
    """Write a file that the command line names."""
    path: Path | None = getattr(arguments, option)
    if path is None:
        return
    try:
        write(path)
    except (OSError, ValueError) as error:
        raise InputError(f"--{option} {path}: {error}; expected a file to write") from None


def _told(
    arguments: argparse.Namespace, facts: object, notes: Sequence[str], lines: Iterator[str]
) -> Iterator[str]:
    """Yield what is to be printed of a plan; notes on how the map was taken only to people."""
    import msgspec

    if arguments.json:
        yield msgspec.json.encode(facts).decode()
        return
    yield from lines
    for note in notes:
        yield f"  note: {note}"
