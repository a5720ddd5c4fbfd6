"""What tests of coverage on grids share: little worlds, playing on them, and what came of it."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from random import Random
from typing import Any, NamedTuple
from unittest.mock import patch

from hypothesis import strategies as st

from agents.algorithms.ormstc import Explorer, Options
from agents.body import Body
from agents.registry import algorithm_of
from deploy.inprocess import play
from deploy.setting import Setting, prepare
from protocol.grid import Cell, Grid, sub_cells
from protocol.messages import Move
from protocol.scenario import Scenario, from_tree
from protocol.trace import Event
from tests.instances import Kill
from world_server.terrain import terrain_of
from world_server.world import End, Input, Output, Wave, World

# Little worlds.


class Little(NamedTuple):
    """A little world.

    Attributes:
        rows: of coarse cells, ``.`` for a free one.
        starts: sub-cells where robots start.
        kills: who dies in which tick; at most all but one.
    """

    rows: tuple[str, ...]
    starts: tuple[Cell, ...]
    kills: tuple[Kill, ...]

    @property
    def free(self) -> set[Cell]:
        """The free coarse cells."""
        return set(coarse_grid(self.rows).complete_cells())


def fine(rows: Iterable[str]) -> list[str]:
    """Return rows of sub-cells, two by two for each coarse cell."""
    return [line for row in rows for line in ["".join(mark * 2 for mark in row)] * 2]


def coarse_grid(rows: Iterable[str]) -> Grid:
    """Build a grid from rows of coarse cells."""
    return Grid.of_text("\n".join(fine(rows)))


def faults_of(kills: Iterable[Kill]) -> list[dict[str, Any]]:
    """Return kills as a scenario spells them: in tick t a robot decides at the instant t - 1."""
    return [
        {"kill": f"robot:{robot}", "at": tick - 1, "round": int(phase == "mid")}
        for tick, robot, phase in kills
    ]


def little(
    rng: Random, *, side: int = 6, robots: int = 5, ticks: int | None = None, spares: bool = True
) -> Little:
    """Draw a world.

    Args:
        rng: draws it.
        side: it has at most so many coarse cells each way.
        robots: at most so many.
        ticks: they die up to this tick; by default while there is much to do.
        spares: whether several may start in one coarse cell.
    """
    rows, cols = rng.randint(1, side), rng.randint(1, side)
    cells = [(row, col) for row in range(rows) for col in range(cols)]
    free = sorted(rng.sample(cells, rng.randint((len(cells) + 1) // 2, len(cells))))
    text = tuple("".join("#."[(row, col) in free] for col in range(cols)) for row in range(rows))
    places = [at for cell in free for at in sub_cells(cell)]
    if not spares:
        places = [rng.choice(list(sub_cells(cell))) for cell in free]
    starts = tuple(rng.sample(places, rng.randint(1, min(robots, len(places)))))
    ticks = ticks or 2 * len(free)
    victims = rng.sample(range(len(starts)), rng.randint(0, len(starts) - 1))
    kills = tuple((rng.randint(1, ticks), robot, rng.choice(["pre", "mid"])) for robot in victims)
    return Little(text, starts, kills)


def littles(**bounds: Any) -> st.SearchStrategy[Little]:
    """Little worlds; `little` says which ``bounds`` there are."""
    return st.randoms(use_true_random=False).map(lambda rng: little(rng, **bounds))


def any_kills(rng: Random, world: Little, *, instants: bool = False) -> list[dict[str, Any]]:
    """Draw faults that strike the victims of a world at any time, round or request.

    Args:
        rng: draws them.
        world: says who dies, and about when.
        instants: at whole instants only.
    """
    faults: list[dict[str, Any]] = []
    for tick, robot, _ in world.kills:
        fault: dict[str, Any] = {"kill": f"robot:{robot}"}
        if rng.random() < 0.4:
            fault["at_request"] = rng.randint(1, 3 * tick)
        else:
            fault["at"] = tick - 1 if instants or rng.random() < 0.5 else rng.uniform(0, 2 * tick)
            fault["round"] = rng.randint(0, 4)
        faults.append(fault)
    return faults


JITTERS = (0.0, 0.3, 0.9, "exponential")
SPEEDS = (0.5, 1.0, 2.0, 3.0)


def circumstances(
    rng: Random, robots: int, *, event: bool | None = None, latency: bool = True
) -> dict[str, Any]:
    """Draw what a theorem must not depend on: clock, speeds, latency, options.

    Args:
        rng: draws it.
        robots: so many.
        event: whether under the event clock; ``None``: that is drawn, too.
        latency: whether messages may take time.
    """
    options: dict[str, Any] = {"conflict": rng.choice(["id", "fewest-cells"])}
    fields: dict[str, Any] = {"seed": rng.randint(0, 999), "algorithm_options": options}
    if rng.random() < 0.5 if event is None else event:
        fields["clock"] = {"mode": "event", "jitter": rng.choice(JITTERS)}
        fields["team"] = {"speed": [rng.choice(SPEEDS) for _ in range(robots)]}
    if latency:
        options["lazy"] = rng.random() < 0.5
        fields["radio"] = {"latency": rng.choice([0.0, 0.0, 0.3, 1.0, 2.0, 3.5])}
    return fields


# Runs.


def ormstc_on(robots: int, **fields: Any) -> Scenario:
    """Build a scenario of ORMSTC; ``fields`` are its sections, completed by what the paper assumes."""
    tree: dict[str, Any] = {
        "algorithm": "ormstc",
        "world": {"map": "none"},
        "team": {"robots": robots},
        "radio": {"reach": "global"},
        "sensing": {"mode": "ahead"},
        "device": {"capacity_bytes": 0},
    }
    for name, value in fields.items():
        tree[name] = {**tree.get(name, {}), **value} if isinstance(value, dict) else value
    return from_tree(tree, "test")


class Covered(NamedTuple):
    """A run on a grid that was played to its end.

    Attributes:
        grid: the place.
        starts: where the robots started.
        status: how it ended.
        errors: how robots failed, or what rule they broke.
        visits: time, robot and sub-cell: all starts, and each arrival in another sub-cell.
        lost: robots that were lost.
        events: the trace.
    """

    grid: Grid
    starts: Sequence[Cell]
    status: str
    errors: list[str]
    visits: list[tuple[float, int, Cell]]
    lost: set[int]
    events: list[Event]

    @property
    def robots(self) -> range:
        """All robots."""
        return range(len(self.starts))

    @property
    def walks(self) -> list[list[Cell]]:
        """The sub-cells that each robot visited, in order."""
        return [[at for _, who, at in self.visits if who == robot] for robot in self.robots]

    @property
    def first(self) -> dict[Cell, float]:
        """When each sub-cell was visited first."""
        first: dict[Cell, float] = {}
        for time, _, at in self.visits:
            first.setdefault(at, time)
        return first

    @property
    def coverage_time(self) -> float:
        """The time of the last first visit."""
        return max(self.first.values())

    @property
    def extra(self) -> int:
        """Visits beyond the first of a sub-cell."""
        return len(self.visits) - len(self.first)

    @property
    def moves(self) -> list[int]:
        """How many moves each robot made."""
        return [len(walk) - 1 for walk in self.walks]

    @property
    def done_at(self) -> list[float | None]:
        """When each robot moved last; ``None`` for the lost, and for those that never did."""
        last = {robot: time for time, robot, _ in self.visits}
        return [None if robot in self.lost else last[robot] or None for robot in self.robots]

    @property
    def missing(self) -> set[Cell]:
        """What survivors could have reached and nobody visited (R11)."""
        starts = [self.starts[robot] for robot in self.robots if robot not in self.lost]
        within_reach = self.grid.reachable_cells((row // 2, col // 2) for row, col in starts)
        return {at for cell in within_reach for at in sub_cells(cell)} - self.first.keys()

    @property
    def twice(self) -> set[Cell]:
        """What was visited more often than Theorem 5 allows: starts are entered again."""
        counts = Counter(at for _, _, at in self.visits)
        return {at for at, count in counts.items() if count > 1 + (at in self.starts)}

    def is_complete(self) -> None:
        """Check that the run ended well, with nothing left uncovered (Theorems 4 and 6)."""
        assert (self.errors, self.status, self.missing) == ([], "over", set())

    def keeps_the_theorems(self) -> None:
        """Check Theorems 4 and 6, and 5 in its exact form where nobody was lost."""
        self.is_complete()
        assert self.lost or not self.twice


class WatchedWorld(World):
    """A world that tells when an instant has passed.

    Attributes:
        after_instant: called before any robot acts at another time, and at the end.
    """

    after_instant: Callable[["WatchedWorld"], None] = staticmethod(lambda _: None)
    _present = 0.0

    def alive_robots(self) -> set[int]:
        """Return the robots that are not lost."""
        return {body.robot for body in self.bodies if body.lost_at is None}

    def resume(self, given: Input) -> Output:
        """Go on to the next output."""
        output = super().resume(given)
        if isinstance(output, End) or (isinstance(output, Wave) and output.time > self._present):
            self._present = self.time
            self.after_instant(self)
        return output


def visits_of(
    grid: Grid, starts: Sequence[Cell], events: Iterable[Event]
) -> list[tuple[float, int, Cell]]:
    """Return time, robot and sub-cell of each visit, from the trace alone."""
    at = [grid.place(*start) for start in starts]
    visits: list[tuple[float, int, Cell]] = [(0, n, start) for n, start in enumerate(starts)]
    for event in events:
        if event.place is not None and event.place != at[event.robot]:
            at[event.robot] = event.place
            visits.append((event.time, event.robot, grid.position(event.place)))
    return visits


def covered(
    grid: Grid,
    starts: Sequence[Cell],
    *,
    after_instant: Callable[["WatchedWorld"], None] | None = None,
    **fields: Any,
) -> Covered:
    """Play ORMSTC, or what ``fields`` say, on the in-process engine.

    Args:
        grid: the place.
        starts: where the robots start.
        after_instant: called when an instant has passed.
        fields: sections of the scenario.
    """
    scenario = ormstc_on(len(starts), **fields)
    events: list[Event] = []
    places = [grid.place(*start) for start in starts]
    world = WatchedWorld(scenario, terrain_of(grid, scenario), places, observe=events.append)
    if after_instant is not None:
        world.after_instant = after_instant
    algorithm = algorithm_of(scenario.algorithm, scenario.algorithm_options)
    end, failures = play(scenario, world, algorithm)
    errors = [*failures.values(), *map(str, world.refusals.values())]
    lost = set(range(len(starts))) - world.alive_robots()
    visits = visits_of(grid, starts, events)
    return Covered(grid, starts, end.status, errors, visits, lost, events)


def moves_of(run: Covered) -> list[tuple[float, int, int | None, int]]:
    """Return when each robot set out, where, and by which exit."""
    return [
        (event.time, event.robot, event.place, event.what.exit)
        for event in run.events
        if isinstance(event.what, Move)
    ]


@contextmanager
def explorers() -> Iterator[dict[int, Explorer]]:
    """Collect the robots of a run that is played within, by id, to look into them."""
    found: dict[int, Explorer] = {}
    init = Explorer.__init__

    def collect(self: Explorer, body: Body, options: Options) -> None:
        init(self, body, options)
        found[body.robot] = self

    with patch.object(Explorer, "__init__", collect):
        yield found


# As the command line does it.


def setting_on(
    folder: Path, lines: Sequence[str], starts: Sequence[Cell], **fields: Any
) -> Setting:
    """Write a map, a character for each sub-cell, and prepare a run on it, of ORMSTC by default."""
    folder.mkdir(exist_ok=True)
    path = folder / "map.txt"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    world = {**fields.pop("world", {}), "map": str(path), "starts": [list(at) for at in starts]}
    team = {"robots": len(starts), **fields.pop("team", {})}
    tree = {"algorithm": fields.pop("algorithm", "ormstc"), "world": world, "team": team, **fields}
    return prepare(from_tree(tree, "test"))
