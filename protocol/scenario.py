"""The scenario: one TOML file that says what is played.

`load` reads it into one frozen Struct. Every error is a `ScenarioError` of one line that names file,
field, what was found and what was expected. Times are virtual: ticks under the lockstep clock, time
units under the event clock. The comment behind a field is its entry in the scenario reference.
"""

import re
import tomllib
from collections.abc import Iterator, Sequence
from math import inf
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import msgspec.inspect
from msgspec import Meta

from protocol.errors import ScenarioError
from protocol.faults import Fault, misfits_of
from protocol.section import Count, Misfit, Natural, OptionValue, Positive, Section, Start

# Generators: a world without a file.


class NaryTree(Section, frozen=True, kw_only=True, tag="nary-tree", tag_field="kind"):
    """Every vertex but the leaves has ``branching`` children; leaves at depth ``radius``."""

    branching: Count  #: Children of each inner vertex.
    radius: Natural  #: Depth of the leaves, edges.


class RandomTree(Section, frozen=True, kw_only=True, tag="random-tree", tag_field="kind"):
    """A tree drawn uniformly among all labelled trees."""

    vertices: Count  #: Number of vertices.


class WideTree(Section, frozen=True, kw_only=True, tag="wide-tree", tag_field="kind"):
    """A random recursive tree: each vertex hangs from an earlier one (Brass et al., Sec. V)."""

    edges: Natural  #: Number of edges.


class LongTree(Section, frozen=True, kw_only=True, tag="long-tree", tag_field="kind"):
    """The tip gets one to four children, one of which is the next tip (Brass et al., Sec. V)."""

    edges: Natural  #: Number of edges.


class RandomGraph(Section, frozen=True, kw_only=True, tag="random-graph", tag_field="kind"):
    """A random recursive tree and further edges between distinct pairs."""

    vertices: Count  #: Number of vertices.
    edges: Natural  #: Number of edges, those of the tree included.


class RandomObstacles(Section, frozen=True, kw_only=True, tag="random-obstacles", tag_field="kind"):
    """A grid with coarse cells blocked at random, all others connected (Agmon et al., Sec. 3.4)."""

    rows: Count  #: Coarse cells from top to bottom.
    cols: Count  #: Coarse cells from left to right.
    obstacles: Natural = 0  #: How many of them are blocked.


class Rooms(Section, frozen=True, kw_only=True, tag="rooms", tag_field="kind"):
    """A grid like an office: rooms with doors and furniture."""

    rows: Count  #: Coarse cells from top to bottom.
    cols: Count  #: Coarse cells from left to right.


class Warehouse(Section, frozen=True, kw_only=True, tag="warehouse", tag_field="kind"):
    """A grid of racks with aisles between them."""

    rows: Count  #: Coarse cells from top to bottom.
    cols: Count  #: Coarse cells from left to right.


class Rectangles(Section, frozen=True, kw_only=True, tag="rectangles", tag_field="kind"):
    """A grid with rectangles of 1 to 8 sub-cells a side blocked at random, the rest connected."""

    rows: Count  #: Sub-cells from top to bottom.
    cols: Count  #: Sub-cells from left to right.
    ratio: Annotated[float, Meta(ge=0, le=0.75)] = 0.2
    #: Part of the area that is blocked; the last rectangle may exceed it.


class Cave(Section, frozen=True, kw_only=True, tag="cave", tag_field="kind"):
    """Winding passages, chambers, dead ends and a few loops; edges have lengths in metres."""

    vertices: Count  #: Number of vertices.
    loops: Natural = 0  #: Edges besides those of a spanning tree.


Generator = (
    NaryTree
    | RandomTree
    | WideTree
    | LongTree
    | RandomGraph
    | Cave
    | RandomObstacles
    | Rooms
    | Warehouse
    | Rectangles
)

# The parts of a scenario.


class WorldSection(Section, frozen=True, kw_only=True):
    """The place. Give either ``map`` or ``generate``."""

    map: str | None = None  #: Map file, absolute or relative to the scenario.
    generate: Generator | None = None  #: A generator (``kind``) and its parameters.
    ground: Literal["graph", "grid"] | None = None
    #: What the map is played as. A grid can be played as a graph: a vertex for each free sub-cell,
    #: called ``"row,column"``, an edge to each that it shares a side with. Default: a graph for the
    #: algorithms that play on graphs, else what the map is.
    start: Start | None = None
    #: Start of all robots: a vertex, on a grid a sub-cell ``[row, column]``. Default: on a graph the
    #: first vertex of the file (of a grid: of its largest part), on a grid as ``starts = "random"``.
    starts: tuple[Start, ...] | Literal["random"] | None = None
    #: Start of each robot instead; ``"random"``: drawn from the seed, no two alike, in the largest part
    #: of a grid (in several where none holds the team). Algorithm ``parent-child``, by default: all on
    #: one sub-cell of that part.
    cell_m: Positive | None = None
    #: Grids: side of a sub-cell, metres, which is the size of a robot. Default: one character or pixel
    #: of the file.
    resolution_m: Positive | None = None
    #: Grids: side of a character or pixel, metres, where the file does not say it.
    bodies: Literal["pass", "block"] = "pass"
    #: Grids: whether a robot can pass another, or its remains, or bumps against it.


class TeamSection(Section, frozen=True, kw_only=True):
    """The robots."""

    robots: Count  #: Number of robots (the papers' k).
    parents: Natural | None = None
    #: Grids: the first so many robots are parents, the others their children, which neither see
    #: anything nor know where they are. Default: as the algorithm's paper assumes, else all are alike.
    speed: Positive | tuple[Positive, ...] = 1.0
    #: Length per time unit (event clock), or one each.
    on_crash: Literal["lost", "restart"] = "lost"
    #: What the death of a robot's process means: the robot is lost, as in the papers; or it is started
    #: again and goes on where it was, and the trace is as if nothing had happened.


class ClockSection(Section, frozen=True, kw_only=True):
    """Virtual time."""

    mode: Literal["lockstep", "event"] = "lockstep"  #: One tick a move, or edge length / speed.
    jitter: Annotated[float, Meta(ge=0, lt=1)] | Literal["exponential"] = 0.0
    #: Event clock: each move takes U(1 - jitter, 1 + jitter) times as long, or Exp(1) times.
    rounds_max: Count = 10_000  #: Rounds of one instant after which a robot that still acts is out.


class RadioSection(Section, frozen=True, kw_only=True):
    """Who hears whom."""

    reach: Literal["none", "same-place", "adjacent", "radius", "global"] | None = None
    #: Who hears a message. ``"adjacent"``: robots at most ``hops`` edges (on a grid: moves) away; a
    #: robot under way is where it left from. Default: whom the algorithm's paper assumes; algorithms
    #: of users: nobody.
    hops: Count = 1  #: With ``reach = "adjacent"``: how far it carries.
    relay: bool | None = None
    #: With ``reach = "adjacent"``: robots pass on what they hear, so that a message reaches all that
    #: are connected to its sender by way of others. Default: as the algorithm's paper assumes, else no.
    radius_m: Positive | None = None  #: With ``reach = "radius"``: how far it carries, metres.
    line_of_sight: bool | None = None
    #: With ``reach = "radius"``: obstacles are in the way. Default: as the algorithm's paper assumes,
    #: else they are not.
    latency: Annotated[float, Meta(ge=0)] = 0.0  #: Time units from sending to hearing.
    loss: Annotated[float, Meta(ge=0, lt=1)] = 0.0
    #: Probability that a hearer misses a message; each misses it on its own.
    duplicate: Annotated[float, Meta(ge=0, lt=1)] = 0.0
    #: Probability that a hearer gets a message twice.
    heartbeat: Literal["global", "reach"] | None = None
    #: Who gets notice of a loss: everybody, or those who would have heard the lost robot's radio.
    #: Default: as the algorithm's paper assumes, else everybody.


class SensingSection(Section, frozen=True, kw_only=True):
    """What a robot perceives."""

    mode: Literal["ports", "ahead", "three", "radius", "line-of-sight"] | None = None
    #: Graphs: ``"ports"``, how many ports its vertex has; where one leads it learns only by going.
    #: Grids: ``"ahead"``, the coarse cell next to its own in the direction that it looks in;
    #: ``"three"``, those to the left, ahead and to the right of that direction; ``"radius"``, the
    #: sub-cells within ``range_m``; ``"line-of-sight"``, those of them that no obstacle hides.
    #: Default: the least that the algorithm can do with; algorithms of users on grids: ``"three"``.
    range_m: Positive | None = None  #: With ``"radius"`` and ``"line-of-sight"``: how far, metres.
    robots_m: Positive | None = None
    #: Grids: how far robots see other robots that no obstacle hides, metres; children see none.
    #: Default: as far as the radio carries if the algorithm's paper assumes so, else not at all.
    map: bool | None = None
    #: Whether robots have a map, and know where all of them start. Default: as the paper of the
    #: algorithm assumes; algorithms of users: no.
    position: Literal["known", "odometry"] = "known"
    #: Grids: whether a robot knows where it is, or adds up its own moves.
    drift: Annotated[float, Meta(ge=0)] = 0.0
    #: With ``"odometry"``: standard deviation of the error of one move, sub-cells, along and across.
    #: The robot ends in another sub-cell than it believes when the error exceeds half of one.
    reset: bool = True
    #: With ``"odometry"``: it lines up with the middle of its sub-cell after each move, so that errors
    #: below half a sub-cell do not add up.


class DeviceSection(Section, frozen=True, kw_only=True):
    """The bookkeeping device at each place."""

    capacity_bytes: Natural | None = None
    #: Size of its tag; 0: places carry no device. Default: 888, and 0 where the algorithm uses none.
    checksum: bool = True
    #: Whether a device notices that its tag was corrupted, and reads as blank then.

    @property
    def capacity(self) -> int:
        """The size of a tag, bytes."""
        return 888 if self.capacity_bytes is None else self.capacity_bytes


class BookkeepingSection(Section, frozen=True, kw_only=True):
    """The store that outlives a run."""

    database: str | None = None
    #: SQLite file, relative to the scenario; default: in the run folder.
    fresh: bool = True  #: Start on blank tags; false: on those that an earlier run left.


class NetworkSection(Section, frozen=True, kw_only=True):
    """How the processes talk."""

    router: Literal["embedded", "separate"] = "embedded"  #: In the world server, or a process.
    port: Annotated[int, Meta(ge=0, le=65535)] = 0  #: Port on loopback; 0: a free one is chosen.
    join_patience_s: Annotated[float, Meta(ge=1)] = 60.0
    #: A robot that has not joined this long after the last one that did is lost.
    patience_s: Annotated[float, Meta(ge=1)] = 5.0  #: A silent robot is lost after this time.


class ChaosSection(Section, frozen=True, kw_only=True):
    """Random faults, drawn from the seed before the run."""

    robots: Natural = 0  #: How many robots are killed, each once; fewer than there are.
    infrastructure: Natural = 0
    #: How many times the world, the store or a separate router is killed, also at once and while one
    #: comes back.
    network: Natural = 0
    #: How many times a process is frozen, cut off or slowed down, for less than ``network.patience_s``.
    tags: Natural = 0  #: How many times a tag is erased or corrupted, or a device destroyed.
    until: Positive | None = None
    #: They strike before this virtual time. Default: the time in which the team could have covered
    #: everything if it shared the work evenly.


class Scenario(Section, frozen=True, kw_only=True):
    """What is played."""

    name: str = ""  #: For people; default: the name of the file.
    algorithm: str  #: A name that ``canopy doctor`` lists, or ``package.module:function``.
    algorithm_options: dict[str, OptionValue] = msgspec.field(default_factory=dict)
    #: As the algorithm defines them.
    seed: int = 0  #: All randomness of the run comes from it.
    durability: Literal["process", "power"] = "process"
    #: What is acknowledged survives kill -9 of any process, or loss of power too (slower).
    world: WorldSection  #: The place.
    team: TeamSection  #: The robots.
    clock: ClockSection = ClockSection()  #: Virtual time.
    radio: RadioSection = RadioSection()  #: Who hears whom.
    sensing: SensingSection = SensingSection()  #: What a robot perceives.
    device: DeviceSection = DeviceSection()  #: The bookkeeping device at each place.
    bookkeeping: BookkeepingSection = BookkeepingSection()  #: The store that outlives a run.
    network: NetworkSection = NetworkSection()  #: How the processes talk.
    faults: tuple[Fault, ...] = ()  #: Scheduled faults.
    chaos: ChaosSection = ChaosSection()  #: Random faults.


def load(path: Path, overrides: Sequence[str] = ()) -> Scenario:
    """Read a scenario file.

    Args:
        path: the TOML file. Paths within it are relative to its folder.
        overrides: ``key.path=value`` each, as of ``--set``. The value is TOML; what is no TOML is
            taken as text. Relative paths are relative to the current folder.

    Raises:
        ScenarioError: If the file or an override cannot be used.
    """
    try:
        tree = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ScenarioError(f"{path}: {_reason(error)}; expected a scenario file (TOML)") from None
    except UnicodeDecodeError as error:
        raise ScenarioError(f"{path}: not UTF-8 at byte {error.start}; expected TOML") from None
    except tomllib.TOMLDecodeError as error:
        raise ScenarioError(f"{path}: not TOML: {error}") from None
    _anchor(tree, path.parent)
    for override in overrides:
        _override(tree, override)
    source = str(path) if not overrides else f"{path} with --set {' --set '.join(overrides)}"
    return from_tree(tree, source, default_name=path.stem)


def from_tree(tree: dict[str, Any], source: str, default_name: str = "scenario") -> Scenario:
    """Check a tree of plain values and turn it into a scenario.

    Raises:
        ScenarioError: If a field is missing, unknown, of the wrong type or out of range; the message
            begins with ``source``.
    """
    if not tree.get("name"):
        tree = {**tree, "name": default_name}
    try:
        scenario = msgspec.convert(tree, Scenario)
    except msgspec.ValidationError as error:
        raise ScenarioError(f"{source}: {in_words(error, tree, Scenario)}") from None
    _check(scenario, source)
    return scenario


def to_tree(scenario: Scenario) -> dict[str, Any]:
    """Turn a scenario into plain values; `from_tree` gives it back."""
    tree = msgspec.to_builtins(scenario)
    assert isinstance(tree, dict)
    return tree


def _reason(error: OSError) -> str:
    return (error.strerror or str(error)).lower()


def in_words(error: msgspec.ValidationError, tree: object, kind: type, section: str = "") -> str:
    """Say what is wrong so that it leads with the field and tells what was found there.

    Args:
        error: why the tree is none of the kind.
        tree: plain values.
        kind: the Struct that it should be.
        section: name of the section that it is, if it is not all of a scenario.
    """
    text, _, where = str(error).partition(" - at `$")
    field = where.rstrip("`").lstrip(".")
    found = tree
    for name in re.findall(r"[^.\[\]]+", field):
        if isinstance(found, dict):
            found = found.get(name)
        elif isinstance(found, list) and name.isdecimal():
            found = found[int(name)]
        else:
            break
    if text.startswith("Invalid"):
        text = f"expected one of {', '.join(_choices(field, kind))}"
    text = text.replace("Expected", "expected", 1)
    said = "" if isinstance(found, dict | list) or "..." in field else f"found {found!r}; "
    name = f"{section}.{field}".strip(".")
    return f"field `{name}`: {said}{text}" if name else text


def _choices(field: str, kind: type) -> list[str]:
    """Return what a field may be, where that is a choice among words."""
    known: list[Any] = [msgspec.inspect.type_info(kind)]
    for name in re.findall(r"[a-z_]+", field):
        # A tag field (`kind`) is no field of the generators themselves.
        tags = [type_.tag for type_ in known if getattr(type_, "tag_field", None) == name]
        if tags:
            return list(map(repr, tags))
        fields = [part for type_ in known for part in getattr(type_, "fields", ())]
        known = [part.type for part in fields if part.encode_name == name]
        known = [one for type_ in known for one in getattr(type_, "types", (type_,))]
        lists = ["a list"] * any(hasattr(type_, "item_type") for type_ in known)
        known = [getattr(type_, "item_type", type_) for type_ in known]
    words = [repr(value) for type_ in known for value in getattr(type_, "values", ())]
    return words + lists


def _anchor(tree: dict[str, Any], folder: Path) -> None:
    """Make the relative paths of a scenario relative to its own folder."""
    for section, field in (("world", "map"), ("bookkeeping", "database")):
        part = tree.get(section)
        if isinstance(part, dict) and isinstance(part.get(field), str):
            part[field] = str(folder / part[field])


def _override(tree: dict[str, Any], override: str) -> None:
    key, equals, text = override.partition("=")
    names = key.strip().split(".")
    if not equals or not all(names):
        raise ScenarioError(f"--set {override}: expected key.path=value, such as team.robots=16")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text.strip()
    node = tree
    for name in names[:-1]:
        node = node.setdefault(name, {})
        if not isinstance(node, dict):
            raise ScenarioError(f"--set {override}: `{name}` is no section")
    node[names[-1]] = value
    # A map given here replaces a generator of the file, and the other way round.
    if names[0] == "world" and len(names) > 1 and names[1] in ("map", "generate"):
        node = tree["world"]
        node.pop("generate" if names[1] == "map" else "map", None)


def _check(scenario: Scenario, source: str) -> None:
    """Check what types alone do not say.

    Raises:
        ScenarioError: If something does not fit.
    """
    for check in (_world_faults, _senses_faults, _schedule_faults):
        for field, found, expected in check(scenario):
            raise ScenarioError(f"{source}: field `{field}`: found {found!r}, expected {expected}")


def _world_faults(scenario: Scenario) -> Iterator[Misfit]:
    world, team = scenario.world, scenario.team
    if (world.map is None) == (world.generate is None):
        found = "neither" if world.map is None else "both"
        yield "world", found, "one of `map` and `generate`"
    if world.start is not None and world.starts is not None:
        yield "world", "both", "one of `start` and `starts`"
    if isinstance(world.starts, tuple) and len(world.starts) != team.robots:
        yield "world.starts", list(world.starts), f"one for each of {team.robots} robots"
    for name in ("cell_m", "resolution_m"):
        if getattr(world, name) == inf:
            yield f"world.{name}", inf, "a finite length"
    if isinstance(team.speed, tuple) and len(team.speed) != team.robots:
        yield "team.speed", list(team.speed), f"one for each of {team.robots} robots"
    if team.parents is not None and team.parents > team.robots:
        yield "team.parents", team.parents, f"at most {team.robots}, as many as there are robots"
    if inf in (team.speed if isinstance(team.speed, tuple) else (team.speed,)):
        yield "team.speed", team.speed, "a finite speed"
    if scenario.clock.mode == "lockstep" and scenario.clock.jitter != 0:
        yield "clock.jitter", scenario.clock.jitter, "0 under the lockstep clock"


def _senses_faults(scenario: Scenario) -> Iterator[Misfit]:
    radio, sensing = scenario.radio, scenario.sensing
    if radio.reach is not None and (radio.reach == "radius") != (radio.radius_m is not None):
        yield "radio.radius_m", radio.radius_m, 'a length if `reach = "radius"`, else nothing'
    if radio.line_of_sight and radio.reach != "radius":
        yield "radio.line_of_sight", True, 'false, or `reach = "radius"`'
    if radio.reach not in (None, "adjacent"):
        if radio.hops != 1:
            yield "radio.hops", radio.hops, '1, or `reach = "adjacent"`'
        if radio.relay:
            yield "radio.relay", True, 'false, or `reach = "adjacent"`'
    if inf in (radio.latency, radio.radius_m):
        yield "radio", inf, "finite lengths and times"
    squares = ("radius", "line-of-sight")
    if (sensing.mode in squares) != (sensing.range_m is not None):
        expected = 'a length if `mode` is "radius" or "line-of-sight", else nothing'
        yield "sensing.range_m", sensing.range_m, expected
    if inf in (sensing.range_m, sensing.robots_m, sensing.drift):
        yield "sensing", inf, "finite lengths"
    if sensing.drift and sensing.position == "known":
        yield "sensing.drift", sensing.drift, '0, or `position = "odometry"`'


def _schedule_faults(scenario: Scenario) -> Iterator[Misfit]:
    robots = scenario.team.robots
    if scenario.chaos.robots and scenario.chaos.robots >= robots:
        yield "chaos.robots", scenario.chaos.robots, f"at most {robots - 1}: one robot must be left"
    if scenario.chaos.until == inf:
        yield "chaos.until", inf, "a finite time"
    for index, fault in enumerate(scenario.faults):
        for name, found, expected in misfits_of(
            fault,
            scenario.team.robots,
            restart=scenario.team.on_crash == "restart",
            separate=scenario.network.router == "separate",
        ):
            yield f"faults[{index}]{name}", found, expected
