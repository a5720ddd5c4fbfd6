"""What tests of runs share: playing a scenario, scripted robots, graphs, and judging a trace."""

from collections import Counter
from collections.abc import Callable, Coroutine, Iterable, Mapping, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

from hypothesis import strategies as st

from agents.body import Algorithm, Body, Driver
from agents.registry import algorithm_of
from deploy.inprocess import play
from protocol.graph import PortGraph
from protocol.grid import Cell, Grid
from protocol.messages import (
    AnyRequest,
    Exchange,
    Look,
    Move,
    Sight,
    Stop,
    TagWrite,
    Wait,
    WaitForNews,
    Write,
)
from protocol.scenario import Scenario, from_tree
from protocol.trace import NOBODY, Event, LossCause, TraceDigest
from world_server.terrain import GraphTerrain, terrain_of
from world_server.world import Answers, End, FaultOrder, KillOrder, TagsWanted, Wave, World

Script = Callable[[Body], Coroutine[AnyRequest, Sight, Stop | None]]


# Graphs.


def graph_of(edges: str, lengths: Iterable[float | None] | None = None) -> PortGraph:
    """Build a graph from edges such as ``"01 02 12"`` or ``"0-1 0-10"``; vertices are numbers."""
    ends = [tuple(map(int, edge.split("-") if "-" in edge else edge)) for edge in edges.split()]
    vertices = max((vertex for end in ends for vertex in end), default=0) + 1
    return PortGraph([str(v) for v in range(vertices)], [(u, v) for u, v in ends], lengths)


def tree_of(parents: Sequence[int]) -> PortGraph:
    """Build a tree from the parents of vertices 1, 2, ..."""
    names = [str(v) for v in range(len(parents) + 1)]
    return PortGraph(names, [(parent, child) for child, parent in enumerate(parents, start=1)])


@st.composite
def trees(draw: st.DrawFn, edges_max: int = 10) -> PortGraph:
    """Trees whose vertex 0 is the root, edges by child."""
    edges = draw(st.integers(0, edges_max))
    return tree_of([draw(st.integers(0, child)) for child in range(edges)])


@st.composite
def graphs(draw: st.DrawFn, vertices_max: int = 7, extra_max: int = 6) -> PortGraph:
    """Connected multigraphs with loops and parallel edges, in any order of the edges."""
    parents = [
        draw(st.integers(0, child)) for child in range(draw(st.integers(0, vertices_max - 1)))
    ]
    vertex = st.integers(0, len(parents))
    ends = [(parent, child) for child, parent in enumerate(parents, start=1)]
    ends += draw(st.lists(st.tuples(vertex, vertex), max_size=extra_max))
    ends = draw(st.permutations(ends))
    return PortGraph([str(v) for v in range(len(parents) + 1)], ends)


# Grids.


@st.composite
def grids(draw: st.DrawFn, rows_max: int = 9, cols_max: int = 9, marks: str = "...#") -> Grid:
    """Grids of any size and any shape, with one free sub-cell at least; ``marks``: how many more."""
    rows, cols = draw(st.integers(1, rows_max)), draw(st.integers(1, cols_max))
    cells = draw(st.binary(min_size=rows * cols, max_size=rows * cols))
    blocked = bytearray(marks[byte % len(marks)] == "#" for byte in cells)
    blocked[draw(st.integers(0, rows * cols - 1))] = 0
    return Grid(rows, cols, bytes(blocked), draw(st.sampled_from([1.0, 0.5, 0.1])))


def line_is_clear(grid: Grid, one: Cell, other: Cell) -> bool:
    """Tell whether one can look from the middle of one sub-cell to that of another.

    In exact numbers, by the words of the rule: the line crosses the inside of no obstacle, the ends
    left out, and does not squeeze between two obstacles that touch at a corner.
    """
    half = Fraction(1, 2)
    top, left = one[0] + half, one[1] + half
    down, right = other[0] - one[0], other[1] - one[1]
    rows = range(min(one[0], other[0]), max(one[0], other[0]) + 1)
    cols = range(min(one[1], other[1]), max(one[1], other[1]) + 1)
    obstacles = {(row, col) for row in rows for col in cols if not grid.is_free(row, col)}
    for row, col in obstacles - {one, other}:
        begin, end = Fraction(0), Fraction(1)  # the part of the line within the obstacle
        for near, start, length in ((row, top, down), (col, left, right)):
            if length:
                into, out_of = sorted(((near - start) / length, (near + 1 - start) / length))
                begin, end = max(begin, into), min(end, out_of)
            elif not near < start < near + 1:
                end = begin
        if begin < end:
            return False
    for row in rows[1:]:
        for col in cols[1:]:
            if (row - top) * right == (col - left) * down:  # the line passes this corner
                falls = down * right > 0
                above, below = (col, col - 1) if falls else (col - 1, col)
                if {(row - 1, above), (row, below)} <= obstacles:
                    return False
    return True


# Runs.


class Fate:
    """What became of one robot, by the trace alone.

    Attributes:
        place: where its body stands or stood last.
        moves: how many of its moves arrived.
        requests: how many requests were applied.
        stopped_at: when it stopped.
        lost_at: when it was lost.
        cause: why it was lost.
    """

    def __init__(self, place: int = 0) -> None:
        self.place = place
        self.moves = 0
        self.requests = 0
        self.stopped_at: float | None = None
        self.lost_at: float | None = None
        self.cause: str | None = None
        self.under_way = False

    def __call__(self, event: Event) -> None:
        """Take in the next event of this robot."""
        if event.place is not None:
            self.moves += self.under_way
            self.place = event.place
        self.under_way = isinstance(event.what, Move)
        if isinstance(event.what, str):
            self.lost_at, self.cause = event.time, event.what
        else:
            self.requests += 1
            if isinstance(event.what, Stop):
                self.stopped_at = event.time


class Played(NamedTuple):
    """A run that was played to its end.

    Attributes:
        world: the world in its last state.
        events: the trace.
        end: how it ended.
        failures: for each robot whose algorithm failed, the text of its exception.
        robots: how many there were.
    """

    world: World
    events: list[Event]
    end: End
    failures: dict[int, str]
    robots: int

    def fates(self) -> list[Fate]:
        """Return what became of each robot."""
        fates = [Fate() for _ in range(self.robots)]
        for event in self.events:
            if event.robot != NOBODY:
                fates[event.robot](event)
        return fates

    def stops(self) -> list[float | None]:
        """Return when each robot stopped."""
        return [fate.stopped_at for fate in self.fates()]


def scenario_of(robots: int, **fields: Any) -> Scenario:
    """Build a scenario of so many robots; ``fields`` are its sections as plain values."""
    team = {"robots": robots, **fields.pop("team", {})}
    tree = {"algorithm": "mr-dfs", "world": {"map": "none"}, "team": team, **fields}
    return from_tree(tree, "test")


def played(graph: PortGraph, robots: int, *, start: int = 0, **fields: Any) -> Played:
    """Play an algorithm of the registry on the in-process engine."""
    scenario = scenario_of(robots, **fields)
    events: list[Event] = []
    world = World(scenario, GraphTerrain(graph), [start] * robots, observe=events.append)
    algorithm = algorithm_of(scenario.algorithm, scenario.algorithm_options)
    end, failures = play(scenario, world, algorithm)
    return Played(world, events, end, failures, robots)


def makespan(graph: PortGraph, robots: int, *, start: int = 0, **fields: Any) -> float:
    """Play without keeping a trace; return when the last robot stopped."""
    stops: list[float] = []

    def observe(event: Event) -> None:
        if event.what.__class__ is Stop:
            stops.append(event.time)

    scenario = scenario_of(robots, **fields)
    world = World(scenario, GraphTerrain(graph), [start] * robots, observe=observe)
    end, failures = play(
        scenario, world, algorithm_of(scenario.algorithm, scenario.algorithm_options)
    )
    assert (end.status, failures, len(stops)) == ("over", {}, robots)
    return stops[-1]


def asking(*requests: AnyRequest, seen: list[Any] | None = None) -> Script:
    """Look, then make ``requests`` one after another, then stop; ``seen`` gets every sight."""

    async def script(body: Body) -> None:
        here = await body.look()
        for request in requests:
            if seen is not None:
                seen.append(here)
            match request:
                case Look(_, messages, gaze):
                    here = await body.look(gaze=gaze, messages=messages)
                case Write(tag, messages):
                    here = await body.write(tag or b"", messages)
                case Exchange(_, messages):
                    here = await body.exchange(*messages)
                case Move(tag, messages, exit_, gaze):
                    here = await body.move(exit_, gaze=gaze, tag=tag, messages=messages)
                case Wait(tag, messages, duration):
                    here = await body.wait(duration, tag=tag, messages=messages)
                case WaitForNews(tag, messages, at_most):
                    here = await body.wait_for_news(at_most=at_most, tag=tag, messages=messages)
                case Stop():
                    return
        if seen is not None:
            seen.append(here)

    return script


class Conducted(NamedTuple):
    """A run of scripted robots.

    Attributes:
        world: the world in its last state.
        events: the trace.
        end: how it ended.
        outputs: every output of the world, in order.
        writes: what `on_write` was told.
    """

    world: World
    events: list[Event]
    end: End
    outputs: list[Wave | KillOrder | FaultOrder | TagsWanted]
    writes: list[tuple[int, int, bytes]]

    def waves(self) -> list[tuple[float, int, int, list[int]]]:
        """Return time, round, index and robots of each wave."""
        waves = [output for output in self.outputs if isinstance(output, Wave)]
        return [(wave.time, wave.round, wave.index, wave.robots) for wave in waves]

    def lines(self) -> list[str]:
        """Return the trace as text without the digests of the sights."""
        return [str(event).rpartition(" sight=")[0] for event in self.events]


def conducted(
    ground: PortGraph | Grid,
    scripts: Sequence[Algorithm],
    *,
    starts: Sequence[int] | None = None,
    lost_in: Mapping[int, Sequence[tuple[int, LossCause]]] | None = None,
    old_tags: Mapping[int, TagWrite] | None = None,
    **fields: Any,
) -> Conducted:
    """Play one script for each robot, by a plain loop over the world's outputs.

    Args:
        ground: the place.
        scripts: what each robot does.
        starts: where each robot starts; by default all at 0.
        lost_in: robots that are lost during the n-th wave of the run, counted from 0.
        old_tags: what the store holds; asked for where ``fresh`` is false.
        fields: sections of the scenario.
    """
    scenario = scenario_of(len(scripts), **fields)
    events: list[Event] = []
    writes: list[tuple[int, int, bytes]] = []
    world = World(
        scenario,
        terrain_of(ground, scenario),
        starts or [0] * len(scripts),
        observe=events.append,
        on_write=lambda *write: writes.append(write),
    )
    drivers = [Driver(script, Body(world.briefing(robot))) for robot, script in enumerate(scripts)]
    outputs: list[Wave | KillOrder | FaultOrder | TagsWanted] = []
    waves = 0
    output = world.begin()
    while not isinstance(output, End):
        outputs.append(output)
        if isinstance(output, Wave):
            lost = tuple((lost_in or {}).get(waves, ()))
            waves += 1
            requests = [
                drivers[robot].next_request(sight)
                for robot, sight in zip(output.robots, output.sights, strict=True)
            ]
            output = world.resume(Answers(list(requests), lost))
        elif isinstance(output, KillOrder):
            drivers[output.robot].close()
            output = world.resume(None)
        elif isinstance(output, FaultOrder):
            output = world.resume(None)
        else:
            known = old_tags or {}
            output = world.resume(tuple(known[at] for at in output.places if at in known))
    return Conducted(world, events, output, outputs, writes)


# Judging a trace.


def crossings(events: Iterable[Event]) -> Counter[tuple[int, int, int]]:
    """Count the moves that arrived, by robot, place and exit: an edge is crossed on arrival."""
    counts: Counter[tuple[int, int, int]] = Counter()
    under_way: dict[int, tuple[int, int]] = {}
    for event in events:
        left = under_way.pop(event.robot, None)
        if left is not None and event.place is not None:
            counts[event.robot, *left] += 1
        if isinstance(event.what, Move):
            assert event.place is not None
            under_way[event.robot] = (event.place, event.what.exit)
    return counts


def edges_crossed(graph: PortGraph, events: Iterable[Event]) -> set[int]:
    """Return the edges that some robot crossed."""
    return {graph.edge_at[place][exit_] for _, place, exit_ in crossings(events)}


def sha256(events: Iterable[Event]) -> str:
    """Return the digest of a trace."""
    digest = TraceDigest()
    for event in events:
        digest(event)
    return digest.hexdigest()
