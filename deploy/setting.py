"""The setting of a run: the scenario, checked against the place that it is played at."""

from pathlib import Path

from msgspec import Struct

from agents.body import Algorithm
from agents.registry import algorithm_of, tag_bytes_max, tag_format
from bookkeeping.sqlite_store import tag_format_left
from protocol.errors import MapError, ScenarioError
from protocol.graph import PortGraph
from protocol.scenario import (
    Cave,
    LongTree,
    NaryTree,
    RandomGraph,
    RandomTree,
    Scenario,
    WideTree,
)
from protocol.seeds import spawn
from world_server.maps import generators, read_graph

SQLITE = b"SQLite format 3\0"
"""What a store's file begins with."""


class Setting(Struct, frozen=True):
    """Everything a run needs, checked.

    Attributes:
        scenario: what is played.
        graph: the place, reduced to the component of the start.
        starts: start vertex of each robot.
        algorithm: what each robot runs.
        notes: what the user should know, a line each.
    """

    scenario: Scenario
    graph: PortGraph
    starts: tuple[int, ...]
    algorithm: Algorithm
    notes: tuple[str, ...] = ()


def prepare(scenario: Scenario) -> Setting:
    """Read or generate the place and check the scenario against it.

    Raises:
        ScenarioError: If a field does not fit the place or the algorithm.
        MapError: If the map cannot be read.
    """
    algorithm = algorithm_of(scenario.algorithm, scenario.algorithm_options)
    whole = _place(scenario)
    starts = _starts(scenario, whole)
    graph = whole.component(starts[0])
    notes: list[str] = []
    if graph is not whole:
        distance = whole.distances(starts[0])
        for robot, start in enumerate(starts):
            if distance[start] < 0:
                raise ScenarioError(
                    f"field `world.starts[{robot}]`: vertex {whole.names[start]!r} cannot be reached "
                    f"from {whole.names[starts[0]]!r}; expected one component"
                )
        starts = tuple(graph.vertex(whole.names[start]) for start in starts)
        notes.append(
            f"the map has several components; playing the one of {graph.names[starts[0]]!r}: "
            f"{len(graph.names)} of {len(whole.names)} vertices"
        )
    _check_devices(scenario, graph)
    _check_database(scenario)
    return Setting(scenario, graph, starts, algorithm, tuple(notes))


def tag_format_of(scenario: Scenario) -> str:
    """Name the format of the tags that a run of ``scenario`` leaves."""
    return tag_format(scenario.algorithm, scenario.algorithm_options, scenario.team.robots)


def _place(scenario: Scenario) -> PortGraph:
    world = scenario.world
    if world.map is not None:
        graph = read_graph(Path(world.map))
        if not graph.names:
            raise MapError(f"{world.map}: no vertices; expected at least one")
        return graph
    assert world.generate is not None
    rng = spawn(scenario.seed, "world")
    try:
        match world.generate:
            case NaryTree(branching=branching, radius=radius):
                return generators.nary_tree(branching, radius)
            case RandomTree(vertices=vertices):
                return generators.random_tree(vertices, rng)
            case WideTree(edges=edges):
                return generators.wide_tree(edges, rng)
            case LongTree(edges=edges):
                return generators.long_tree(edges, rng)
            case RandomGraph(vertices=vertices, edges=edges):
                return generators.random_graph(vertices, edges, rng)
            case Cave(vertices=vertices, loops=loops):
                return generators.cave(vertices, loops, rng)
    except ValueError as error:
        raise ScenarioError(f"field `world.generate`: {error}") from None


def _starts(scenario: Scenario, graph: PortGraph) -> tuple[int, ...]:
    world = scenario.world
    if world.starts is not None:
        return tuple(
            _vertex(graph, name, f"world.starts[{robot}]")
            for robot, name in enumerate(world.starts)
        )
    start = 0 if world.start is None else _vertex(graph, world.start, "world.start")
    return (start,) * scenario.team.robots


def _vertex(graph: PortGraph, name: str | int, field: str) -> int:
    try:
        return graph.vertex(str(name))
    except KeyError:
        some = ", ".join(map(repr, graph.names[:3]))
        raise ScenarioError(
            f"field `{field}`: found {name!r}, expected the name of a vertex, such as {some}"
        ) from None


def _check_devices(scenario: Scenario, graph: PortGraph) -> None:
    """Refuse devices that are too small for the largest vertex before anything starts."""
    widest = max(range(len(graph.names)), key=graph.degree)
    needed = tag_bytes_max(
        scenario.algorithm,
        scenario.algorithm_options,
        graph.degree(widest),
        scenario.team.robots,
    )
    if needed > scenario.device.capacity_bytes:
        raise ScenarioError(
            f"field `device.capacity_bytes`: found {scenario.device.capacity_bytes}, expected at "
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
