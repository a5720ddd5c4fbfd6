"""The setting of a run: the scenario, checked against the place that it is played at."""

from collections.abc import Sequence
from pathlib import Path

from msgspec import Struct, convert, to_builtins
from msgspec.structs import replace

from agents.algorithms.connected_options import BestOptions, Options, planned
from agents.algorithms.connected_rule import Variant
from agents.algorithms.connected_splits import robots_needed
from agents.body import Algorithm
from agents.planning.rooted_tree import spanning_tree
from agents.registry import (
    ALGORITHMS,
    ASSUMED,
    CELL_ALGORITHMS,
    CONNECTED_ALGORITHMS,
    GRID_ALGORITHMS,
    PARENT_ALGORITHMS,
    TAG_BYTES,
    algorithm_of,
    plain_name,
    tag_bytes_max,
    tag_format,
)
from bookkeeping.sqlite_store import tag_format_left
from deploy.chaos import with_chaos
from deploy.ground import Ground, Started, ground_of, place_of, starts_on
from protocol.errors import ScenarioError
from protocol.faults import TAG_WORDS
from protocol.graph import PortGraph
from protocol.grid import Grid
from protocol.messages import PAYLOAD_BYTES_MAX, KnownGraph
from protocol.scenario import Scenario

SQLITE = b"SQLite format 3\0"
"""What a store's file begins with."""


SENSING_MOST = 64
"""No robot sees farther, sub-cells: a sight of more is too much for a message, and for us."""


MAP_BYTES_MOST = PAYLOAD_BYTES_MAX // 2
"""A map of a graph that takes more does not fit into a briefing with all the rest."""


class Setting(Struct, frozen=True):
    """Everything a run needs, checked.

    Attributes:
        scenario: what is played, with everything filled in that the file left out.
        ground: the graph, reduced to the component of the start, or the grid.
        starts: start place of each robot.
        algorithm: what each robot runs.
        to_cover: how many places the team is to visit.
        notes: what the user should know, a line each.
    """

    scenario: Scenario
    ground: Ground
    starts: tuple[int, ...]
    algorithm: Algorithm
    to_cover: int
    notes: tuple[str, ...] = ()

    @property
    def graph(self) -> PortGraph:
        """The ground of a run that is played on a graph."""
        assert isinstance(self.ground, PortGraph)
        return self.ground


def prepare(scenario: Scenario) -> Setting:
    """Read or generate the place and check the scenario against it.

    Raises:
        ScenarioError: If a field does not fit the place or the algorithm.
        MapError: If the map cannot be read.
    """
    algorithm_of(scenario.algorithm, scenario.algorithm_options)  # refuses what is none
    scenario = _with_ground(scenario)
    whole, notes = ground_of(scenario)
    scenario = _filled_in(scenario, whole)
    _check_kind(scenario, whole)
    _check_assumed(scenario)
    name = plain_name(scenario.algorithm)
    leads = name in PARENT_ALGORITHMS
    found = starts_on(whole, scenario, cells=name in CELL_ALGORITHMS, together=leads)
    if leads:
        _check_family(scenario, found)
    if isinstance(found.ground, PortGraph):
        _check_devices(scenario, found.ground)
        _check_size(scenario, found.ground)
        scenario, more = _with_plan(scenario, found.ground, found.starts)
        notes = (*notes, *more)
    _check_database(scenario)
    scenario = with_chaos(_with_places(scenario, found.ground), found.ground, found.to_cover)
    notes = (*notes, *found.notes)
    algorithm = algorithm_of(scenario.algorithm, scenario.algorithm_options)
    return Setting(scenario, found.ground, found.starts, algorithm, found.to_cover, notes)


def tag_format_of(scenario: Scenario) -> str:
    """Name the format of the tags that a run of ``scenario`` leaves."""
    return tag_format(scenario.algorithm, scenario.algorithm_options, scenario.team.robots)


def _with_ground(scenario: Scenario) -> Scenario:
    """Play a grid as a graph for an algorithm that plays on graphs."""
    name = plain_name(scenario.algorithm)
    if scenario.world.ground is not None or name not in ALGORITHMS or name in GRID_ALGORITHMS:
        return scenario
    return replace(scenario, world=replace(scenario.world, ground="graph"))


def _filled_in(scenario: Scenario, ground: Ground) -> Scenario:
    """Fill in what the scenario leaves to the algorithm and the place."""
    name = plain_name(scenario.algorithm)
    assumed = ASSUMED.get(name, {})
    radio, sensing, device = scenario.radio, scenario.sensing, scenario.device
    team, world = scenario.team, scenario.world
    on_grid = isinstance(ground, Grid)
    if world.ground is None:
        world = replace(world, ground="grid" if on_grid else "graph")
    if team.parents is None:
        team = replace(team, parents=assumed.get("team.parents"))
    if name in PARENT_ALGORITHMS:
        sensing = replace(sensing, robots_m=sensing.robots_m or radio.radius_m)
    if radio.reach is None:
        radio = replace(radio, reach=assumed.get("radio.reach", "none"))
    if (radio.radius_m is None) == (radio.reach == "radius"):
        raise ScenarioError(
            f"field `radio.radius_m`: found {radio.radius_m}, expected a length if "
            f'`reach = "radius"`, else nothing; the reach is {radio.reach!r}'
        )
    if radio.line_of_sight is None:
        hidden = assumed.get("radio.line_of_sight", False) and radio.reach == "radius"
        radio = replace(radio, line_of_sight=hidden)
    if radio.relay is None:
        relay = assumed.get("radio.relay", False) and radio.reach == "adjacent"
        radio = replace(radio, relay=relay)
    if radio.heartbeat is None:
        # On the event clock silence tells nothing: only a beacon that is heard everywhere does.
        heard = "global" if scenario.clock.mode == "event" else assumed.get("radio.heartbeat")
        radio = replace(radio, heartbeat=heard or "global")
    if sensing.mode is None:
        usual = "three" if on_grid else "ports"
        sensing = replace(sensing, mode=assumed.get("sensing.mode", usual))
    if sensing.map is None:
        sensing = replace(sensing, map=assumed.get("sensing.map", False))
    if device.capacity_bytes is None and name in ALGORITHMS and name not in TAG_BYTES:
        device = replace(device, capacity_bytes=0)
    return replace(scenario, world=world, team=team, radio=radio, sensing=sensing, device=device)


def _check_kind(scenario: Scenario, ground: Ground) -> None:
    """Refuse what does not go with a graph, or with a grid."""
    name = plain_name(scenario.algorithm)
    on_grid = isinstance(ground, Grid)
    where, other = ("a grid", "a graph") if on_grid else ("a graph", "a grid")
    if name in ALGORITHMS and (name in GRID_ALGORITHMS) != on_grid:
        raise ScenarioError(f"field `algorithm`: {name} plays on {other}, found {where}")
    if (scenario.sensing.mode == "ports") == on_grid:
        raise ScenarioError(
            f"field `sensing.mode`: found {scenario.sensing.mode!r}, which is for {other}; "
            f"the map is {where}"
        )
    if isinstance(ground, Grid):
        for field in ("range_m", "robots_m"):
            length_m = getattr(scenario.sensing, field) or 0.0
            if length_m > SENSING_MOST * ground.cell_m:
                raise ScenarioError(
                    f"field `sensing.{field}`: found {length_m:g}, expected at most "
                    f"{SENSING_MOST * ground.cell_m:g}, {SENSING_MOST} sub-cells"
                )
        return
    world = scenario.world
    for field, value, usual in (
        ("world.bodies", world.bodies, "pass"),
        ("world.starts", "random" if world.starts == "random" else None, None),
        ("sensing.position", scenario.sensing.position, "known"),
        ("sensing.robots_m", scenario.sensing.robots_m, None),
        ("team.parents", scenario.team.parents, None),
        ("radio.reach", "radius" if scenario.radio.reach == "radius" else None, None),
    ):
        if value != usual:
            raise ScenarioError(f"field `{field}`: found {value!r}, which is for grids only")


def _with_places(scenario: Scenario, ground: Ground) -> Scenario:
    """Name the places of faulty tags by number.

    Raises:
        ScenarioError: If there is no such place, or no device.
    """
    faults = []
    if scenario.chaos.tags and not scenario.device.capacity:
        raise ScenarioError("field `chaos.tags`: there are no devices in this scenario")
    for index, fault in enumerate(scenario.faults):
        if "bookkeeping" in fault.targets and not scenario.device.capacity:
            raise ScenarioError(
                f"field `faults[{index}].{fault.word}`: there is no bookkeeping, as there are no "
                "devices in this scenario"
            )
        if fault.word in TAG_WORDS:
            field = f"faults[{index}].{fault.word}"
            if not scenario.device.capacity:
                raise ScenarioError(f"field `{field}`: there are no devices in this scenario")
            place = place_of(ground, getattr(fault, fault.word), field)
            fault = replace(fault, **{fault.word: place})  # noqa: PLW2901  the same fault, resolved
        faults.append(fault)
    return replace(scenario, faults=tuple(faults))


def _check_assumed(scenario: Scenario) -> None:
    """Refuse what an algorithm that executes a plan cannot do without."""
    name = plain_name(scenario.algorithm)
    radio, sensing = scenario.radio, scenario.sensing
    needs: list[tuple[str, object, object]] = []
    if name in CONNECTED_ALGORITHMS:
        needs = [
            ("sensing.map", sensing.map, True),
            ("radio.reach", radio.reach, "adjacent"),
            ("radio.relay", radio.relay, True),
            ("radio.latency", radio.latency, 0.0),
            ("radio.loss", radio.loss, 0.0),
            ("radio.duplicate", radio.duplicate, 0.0),
            ("device.capacity_bytes", scenario.device.capacity, 0),
        ]
        if scenario.world.starts is not None:
            raise ScenarioError(
                f"field `world.starts`: found {scenario.world.starts!r}; {name} needs one start: "
                "`world.start`"
            )
        if scenario.clock.mode == "event":
            needs.append(("radio.heartbeat", radio.heartbeat, "global"))
    elif name == "mstc":
        needs = [
            ("sensing.map", sensing.map, True),
            ("sensing.position", sensing.position, "known"),
            ("world.bodies", scenario.world.bodies, "pass"),
            ("radio.reach", radio.reach, "global"),
            ("radio.loss", radio.loss, 0.0),
        ]
    elif name in PARENT_ALGORITHMS:
        needs = [
            ("sensing.map", sensing.map, True),
            ("sensing.position", sensing.position, "known"),
            ("world.bodies", scenario.world.bodies, "pass"),
            ("radio.reach", radio.reach, "radius"),
            ("radio.line_of_sight", radio.line_of_sight, True),
            ("radio.latency", radio.latency, 0.0),
            ("radio.loss", radio.loss, 0.0),
            ("radio.duplicate", radio.duplicate, 0.0),
            ("radio.heartbeat", radio.heartbeat, "global"),
        ]
    for field, found, expected in needs:
        if found != expected:
            raise ScenarioError(f"field `{field}`: found {found!r}; {name} needs {expected!r}")


def _check_family(scenario: Scenario, found: Started) -> None:
    """Refuse parents and children that could not work together."""
    name, grid, starts = plain_name(scenario.algorithm), found.ground, found.starts
    parents, robots = scenario.team.parents or 0, scenario.team.robots
    radius_m, robots_m = scenario.radio.radius_m, scenario.sensing.robots_m
    assert isinstance(grid, Grid)
    assert radius_m is not None
    assert robots_m is not None
    if not 0 < parents < robots:
        expected = f"at least 1, and fewer than {robots} robots: the others are children"
        raise ScenarioError(f"field `team.parents`: found {parents}; {name} needs {expected}")
    if radius_m <= grid.cell_m:
        raise ScenarioError(
            f"field `radio.radius_m`: found {radius_m:g}; {name} needs a length above "
            f"{grid.cell_m:g}, the side of a sub-cell"
        )
    if not grid.cell_m < robots_m <= radius_m:
        raise ScenarioError(
            f"field `sensing.robots_m`: found {robots_m:g}; {name} needs a length above "
            f"{grid.cell_m:g}, the side of a sub-cell, up to {radius_m:g}, `radio.radius_m`"
        )
    cells = [grid.position(start) for start in starts]
    apart = [robot for robot in range(parents) if starts[robot] != starts[0]]
    if apart:
        raise ScenarioError(
            f"field `world.starts[{apart[0]}]`: parent {apart[0]} starts on sub-cell "
            f"{list(cells[apart[0]])}, parent 0 on {list(cells[0])}; {name} needs all parents on one"
        )
    reached = grid.reachable(cells[:1])
    for robot, cell in enumerate(cells):
        if cell not in reached:
            raise ScenarioError(
                f"field `world.starts[{robot}]`: sub-cell {list(cell)} cannot be reached from "
                f"{list(cells[0])}, where the parent starts"
            )


def _check_size(scenario: Scenario, graph: PortGraph) -> None:
    """Refuse a map that is too large to be told."""
    if not scenario.sensing.map or 8 * len(graph.ends) <= MAP_BYTES_MOST:
        return
    size = len(KnownGraph.of(len(graph.names), graph.ends, ()).packed)
    if size > MAP_BYTES_MOST:
        raise ScenarioError(
            f"field `world`: a map of {len(graph.ends)} edges takes {size} bytes in the briefing, "
            f"expected at most {MAP_BYTES_MOST}; take a smaller graph, or `sensing.map = false`"
        )


def _with_plan(
    scenario: Scenario, graph: PortGraph, starts: Sequence[int]
) -> tuple[Scenario, tuple[str, ...]]:
    """Plan for a connected team, once for all robots; say what the user should know of the plan.

    Raises:
        ScenarioError: If the graph or the split heights do not do.
    """
    name = plain_name(scenario.algorithm)
    if name not in CONNECTED_ALGORITHMS:
        return scenario, ()
    best = name == "cocta-best"
    options = convert(scenario.algorithm_options, BestOptions if best else Options)
    if options.tree == "given" and not graph.is_tree():
        raise ScenarioError(
            f"field `world`: a graph of {len(graph.names)} vertices and {len(graph.ends)} edges is no "
            f'tree, which {name} covers; expected `algorithm_options.tree = "breadth-first"` for a '
            "spanning tree of it, or a tree"
        )
    variant: Variant = "ncocta" if name == "ncocta" else "cocta"
    robots = scenario.team.robots
    try:
        options = planned(graph, starts[0], robots, options, variant)
    except ValueError as error:
        raise ScenarioError(f"field `algorithm_options.splits`: {error}") from None
    heights = options.heights or ()
    arity = spanning_tree(graph, starts[0], deep=options.tree == "depth-first").tree.arity
    needed = robots_needed(arity, heights)
    notes = (
        f"split heights {[*heights]} are for {needed} robots; with {robots} the team may come to where "
        "it can only gather, and goes on without splits from there"
    )
    told = (notes,) if needed > robots else ()
    return replace(scenario, algorithm_options=to_builtins(options)), told


def _check_devices(scenario: Scenario, graph: PortGraph) -> None:
    """Refuse devices that are too small for the largest vertex before anything starts."""
    widest = max(range(len(graph.names)), key=graph.degree)
    needed = tag_bytes_max(
        scenario.algorithm,
        scenario.algorithm_options,
        graph.degree(widest),
        scenario.team.robots,
    )
    if needed > scenario.device.capacity:
        raise ScenarioError(
            f"field `device.capacity_bytes`: found {scenario.device.capacity}, expected at "
            f"least {needed} for the degree {graph.degree(widest)} of vertex "
            f"{graph.names[widest]!r} and {scenario.team.robots} robots"
        )


def _check_database(scenario: Scenario) -> None:
    """Refuse a file that cannot be a store before anything starts."""
    name, fresh = scenario.bookkeeping.database, scenario.bookkeeping.fresh
    if name is None:
        return
    path = Path(name)
    found = None
    if not path.parent.is_dir():
        found = "a folder that does not exist"
    elif path.is_dir():
        found = "a folder"
    elif not path.exists():
        found = None if fresh else "no such file, and `bookkeeping.fresh` is false"
    elif path.stat().st_size:
        with path.open("rb") as file:
            if file.read(len(SQLITE)) != SQLITE:
                found = "another kind of file"
    if found is None and not fresh:
        left, needed = tag_format_left(path), tag_format_of(scenario)
        if left != needed:
            raise ScenarioError(
                f"field `bookkeeping.fresh`: {name} holds tags of {left!r}, expected {needed!r}; "
                "set it to true, or play with the team that left them"
            )
    if found is not None:
        raise ScenarioError(
            f"field `bookkeeping.database`: {name}: found {found}, expected a SQLite file"
            + (" or a new one" if fresh else " that an earlier run left")
        )
