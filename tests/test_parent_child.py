"""Parent and children executed: what was planned happens, in sight only, and the living go on."""

from collections.abc import Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.algorithms.parent_child import Team, acknowledged, acknowledgement, first_plan
from agents.planning.parent_child import STAY
from deploy.inprocess import play
from deploy.setting import Setting, prepare
from protocol.errors import ScenarioError
from protocol.grid import STEPS, Cell, Grid
from protocol.messages import Look, Move, Sight, Stop, TeamSight, WaitForNews
from protocol.scenario import from_tree, load
from protocol.trace import Event
from tests.coverage_runs import setting_on
from tests.play import asking, conducted, grids, line_is_clear
from world_server.terrain import terrain_of
from world_server.world import World

ROOT = Path(__file__).parents[1]

# Families.


class Family(NamedTuple):
    """A world, and who is in it.

    Attributes:
        lines: the map, a character for each sub-cell.
        starts: of all robots.
        parents: how many of them are parents.
        r_los: how far robots see each other, sub-cells.
    """

    lines: tuple[str, ...]
    starts: tuple[Cell, ...]
    parents: int
    r_los: float

    def setting(self, folder: Path, **fields: Any) -> Setting:
        fields["team"] = {"parents": self.parents, **fields.get("team", {})}
        fields["radio"] = {"radius_m": self.r_los, **fields.get("radio", {})}
        return setting_on(folder, self.lines, self.starts, algorithm="parent-child", **fields)


def family(rng: Random, *, side: int = 8, parents: int = 3, children: int = 5) -> Family:
    """Draw one; ``parents`` and ``children``: at most so many."""
    rows, cols = rng.randint(1, side), rng.randint(1, side)
    density = rng.choice((0.0, 0.15, 0.35))
    lines = ["".join(".#"[rng.random() < density] for _ in range(cols)) for _ in range(rows)]
    lines[0] = "." + lines[0][1:]
    reach = sorted(Grid.of_text("\n".join(lines)).reachable([(0, 0)]))
    start = rng.choice(reach)
    leaders, led = rng.randint(1, parents), rng.randint(1, children)
    apart = rng.random() < 0.3
    starts = [start] * leaders + [rng.choice(reach) if apart else start for _ in range(led)]
    return Family(tuple(lines), tuple(starts), leaders, rng.choice((1.1, 1.5, 2.0, 2.5, 3.7)))


def families(**bounds: Any) -> st.SearchStrategy[Family]:
    return st.randoms(use_true_random=False).map(lambda rng: family(rng, **bounds))


EVENT = {"mode": "event", "jitter": "exponential"}


def clocks(rng: Random, robots: int) -> dict[str, Any]:
    """Draw a clock."""
    if rng.random() < 0.5:
        return {}
    speeds = [rng.choice((0.5, 1.0, 2.0)) for _ in range(robots)]
    jitter = rng.choice((0.0, 0.5, "exponential"))
    return {"clock": {"mode": "event", "jitter": jitter}, "team": {"speed": speeds}}


def kills_among(rng: Random, robots: Sequence[int], ticks: int) -> list[dict[str, Any]]:
    """Draw deaths at any time, round or request."""
    faults: list[dict[str, Any]] = []
    for robot in robots:
        fault: dict[str, Any] = {"kill": f"robot:{robot}"}
        if rng.random() < 0.4:
            fault["at_request"] = rng.randint(1, 2 * ticks + 2)
        else:
            at = rng.uniform(0, 1.2 * ticks)
            fault["at"] = at if rng.random() < 0.5 else float(round(at))
            fault["round"] = rng.randint(0, 4)
        faults.append(fault)
    return faults


# Runs.


class Told(NamedTuple):
    """What a trace tells.

    Attributes:
        status: how the run ended.
        tracks: where each robot was from its start on, one entry an arrival.
        stopped: when those that stopped did.
        lost: who was lost.
        covered: where children were.
        reached: what was to be covered.
    """

    status: str
    tracks: list[list[Cell]]
    stopped: dict[int, float]
    lost: set[int]
    covered: set[Cell]
    reached: set[Cell]


def told(setting: Setting) -> Told:
    """Play in one thread; no child may move unless a parent that lives sees it."""
    grid, scenario = setting.ground, setting.scenario
    assert isinstance(grid, Grid)
    events: list[Event] = []
    world = World(scenario, terrain_of(grid, scenario), setting.starts, observe=events.append)
    end, failures = play(scenario, world, setting.algorithm)
    assert (failures, world.refusals) == ({}, {})
    parents, robots = scenario.team.parents or 0, scenario.team.robots
    radius = (scenario.radio.radius_m or 0.0) / grid.cell_m
    tracks = [[grid.position(start)] for start in setting.starts]
    lost: set[int] = set()
    stopped: dict[int, float] = {}
    clear = cache(lambda one, other: line_is_clear(grid, one, other))

    def sees(parent: int, child: int) -> bool:
        (row, col), (other_row, other_col) = tracks[parent][-1], tracks[child][-1]
        near = (row - other_row) ** 2 + (col - other_col) ** 2 <= radius**2
        return near and clear(tracks[parent][-1], tracks[child][-1])

    for event in events:
        track = tracks[event.robot]
        if event.place is not None and grid.position(event.place) != track[-1]:
            track.append(grid.position(event.place))
        if isinstance(event.what, str):
            lost.add(event.robot)
        elif isinstance(event.what, Stop):
            stopped[event.robot] = event.time
        elif isinstance(event.what, Move) and event.robot >= parents:
            assert any(sees(one, event.robot) for one in range(parents) if one not in lost), event
    assert lost | stopped.keys() == set(range(robots))
    covered = {cell for track in tracks[parents:] for cell in track}
    return Told(end.status, tracks, stopped, lost, covered, grid.reachable([tracks[0][0]]))


# Without losses.


@given(families())
def test_what_is_planned_happens(tmp_path_factory: pytest.TempPathFactory, drawn: Family) -> None:
    setting = drawn.setting(tmp_path_factory.mktemp("whole"))
    grid = setting.ground
    assert isinstance(grid, Grid)
    run = told(setting)
    plan = first_plan(grid.rows, grid.cols, grid.cells(), drawn.starts, drawn.parents, drawn.r_los)
    ways = [plan.moves[0]] * drawn.parents + list(plan.moves[1:])
    for track, moves in zip(run.tracks, ways, strict=True):
        steps = [STEPS[exit_] for exit_ in moves if exit_ != STAY]
        assert [(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(track)] == steps
    assert run.covered == run.reached
    assert set(run.stopped.values()) == {plan.schedule_steps}
    assert run.status == "over"


@given(families(), st.sampled_from([0.0, 0.5, "exponential"]), st.integers(0, 99))
def test_the_plan_is_kept_to_when_no_robot_takes_as_long_as_another(
    tmp_path_factory: pytest.TempPathFactory, drawn: Family, jitter: Any, seed: int
) -> None:
    rng = Random(seed)
    speeds = [rng.choice((0.5, 1.0, 3.0)) for _ in drawn.starts]
    folder = tmp_path_factory.mktemp("event")
    tracks = [
        told(drawn.setting(folder, seed=seed, **fields)).tracks
        for fields in (
            {},
            {"clock": {"mode": "event", "jitter": jitter}, "team": {"speed": speeds}},
        )
    ]
    assert tracks[0] == tracks[1]


def test_children_start_where_the_parent_does(tmp_path: Path) -> None:
    (tmp_path / "map.txt").write_text("..#.\n....\n#...\n", encoding="utf-8")
    tree = {
        "algorithm": "parent-child",
        "world": {"map": str(tmp_path / "map.txt")},
        "team": {"robots": 4},
        "radio": {"radius_m": 2.5},
    }
    setting = prepare(from_tree(tree, "test"))
    assert len(set(setting.starts)) == 1
    assert setting.scenario.team.parents == 1
    assert setting.scenario.sensing.robots_m == 2.5
    run = told(setting)
    assert run.covered == run.reached


def test_the_scenario_that_comes_along_is_played_as_planned() -> None:
    setting = prepare(load(ROOT / "deploy" / "scenarios" / "parent_child.toml"))
    grid = setting.ground
    assert isinstance(grid, Grid)
    starts = tuple(map(grid.position, setting.starts))
    plan = first_plan(grid.rows, grid.cols, grid.cells(), starts, 1, 5.0)
    run = told(setting)
    assert run.covered == run.reached
    assert set(run.stopped.values()) == {plan.schedule_steps}


# Losses.


def check_losses(seed: int, folder: Path) -> None:
    """Kill up to all but one child, and up to all parents; the rest do what can be done."""
    rng = Random(f"parent-child {seed}")
    drawn = family(rng, side=6)
    robots = len(drawn.starts)
    children = range(drawn.parents, robots)
    victims = rng.sample(children, rng.randint(0, len(children) - 1))
    victims += rng.sample(range(drawn.parents), rng.randint(0, drawn.parents))
    fields = clocks(rng, robots)
    ticks = (
        4 * len(Grid.of_text("\n".join(drawn.lines)).reachable(drawn.starts[:1])) // len(children)
    )
    run = told(drawn.setting(folder, seed=seed, faults=kills_among(rng, victims, ticks), **fields))
    assert run.status == "over"
    if run.lost.issuperset(range(drawn.parents)):
        return
    assert run.covered == run.reached


def test_the_living_cover_what_is_left(tmp_path: Path) -> None:
    for seed in range(300):
        check_losses(seed, tmp_path)


@pytest.mark.slow
def test_the_living_cover_what_is_left_in_many_worlds(tmp_path: Path) -> None:
    for seed in range(1000, 2500):
        check_losses(seed, tmp_path)


HALL = Family((".......", "..#....", "..#..#.", ".....#."), ((1, 0),) * 5, 1, 2.5)


@pytest.mark.parametrize("clock", [{}, EVENT], ids=["lockstep", "event"])
@pytest.mark.parametrize("victim", range(5))
def test_survives_the_loss_of_a_robot_at_any_request(
    clock: dict[str, Any], victim: int, tmp_path: Path
) -> None:
    """Moments of death: each robot, each of its requests; two parents, the second takes over."""
    drawn = HALL._replace(parents=2)
    fields: dict[str, Any] = {"clock": clock} if clock else {}
    whole = drawn.setting(tmp_path, **fields)
    events: list[Event] = []
    world = World(
        whole.scenario,
        terrain_of(whole.ground, whole.scenario),
        whole.starts,
        observe=events.append,
    )
    play(whole.scenario, world, whole.algorithm)
    for n in range(1, world.bodies[victim].requests + 1):
        faults = [{"kill": f"robot:{victim}", "at_request": n}]
        run = told(drawn.setting(tmp_path, faults=faults, **fields))
        assert run.lost == {victim}
        assert (run.status, run.covered) == ("over", run.reached)


@pytest.mark.parametrize("clock", [{}, EVENT], ids=["lockstep", "event"])
def test_one_child_that_is_left_covers_all(clock: dict[str, Any], tmp_path: Path) -> None:
    faults = [{"kill": f"robot:{robot}", "at": 2.0 * robot, "round": 1} for robot in (1, 2, 4)]
    fields: dict[str, Any] = {"clock": clock} if clock else {}
    run = told(HALL.setting(tmp_path, faults=faults, **fields))
    assert run.lost == {1, 2, 4}
    assert (run.status, run.covered) == ("over", run.reached)


def test_children_stop_where_they_are_when_no_parent_is_left(tmp_path: Path) -> None:
    run = told(HALL.setting(tmp_path, faults=[{"kill": "robot:0", "at": 4.0, "round": 1}]))
    # The command of that instant came from a robot that is no more.
    assert run.stopped == dict.fromkeys(range(1, 5), 4.0)
    assert run.status == "over"
    assert run.covered < run.reached


def test_a_parent_without_children_stops(tmp_path: Path) -> None:
    faults = [{"kill": f"robot:{robot}", "at": 3.0} for robot in range(1, 5)]
    run = told(HALL.setting(tmp_path, faults=faults))
    assert run.stopped == {0: 3.0}
    assert (run.status, run.covered < run.reached) == ("over", True)


# What a parent knows.


def sight(*robots: tuple[int, Cell], inbox: Sequence[tuple[int, bytes]] = ()) -> TeamSight:
    return TeamSight(
        0.0, 0, None, 4, b"", 0, alone=True, inbox=tuple(inbox), position=(0, 0), robots=robots
    )


def test_only_what_was_seen_or_acknowledged_is_covered() -> None:
    team = Team([(0, 0), (0, 0), (0, 0)], parents=1)
    team.told(bytes([STAY, 1, 2]))
    assert team.at == {0: (0, 0), 1: (0, 1), 2: (1, 0)}
    team.hear(sight((1, (0, 0)), (2, (1, 0))))
    assert team.covered == {(1, 0)}
    # Acknowledged, out of sight; the other one is a move late.
    team.told(bytes([STAY, STAY, 2]))
    team.hear(sight(inbox=[(1, acknowledgement(1)), (2, acknowledgement(1))]))
    assert team.covered == {(1, 0), (0, 1)}


def test_the_lowest_parent_that_lives_leads() -> None:
    team = Team([(0, 0)] * 4, parents=2)
    leaders = [team.leader]
    for robot in (2, 0, 1):
        team.lost.add(robot)
        leaders.append(team.leader)
    assert leaders == [0, 0, 1, None]
    assert team.children == [3]


@given(st.integers(0, 1 << 31))
def test_an_acknowledgement_comes_back(moves: int) -> None:
    assert acknowledged(acknowledgement(moves)) == moves


# What robots perceive.


@given(grids(marks="..#"), st.data())
def test_parents_see_robots_in_sight_and_children_nothing(grid: Grid, data: st.DataObject) -> None:
    cells = [data.draw(st.sampled_from(grid.free_cells())) for _ in range(5)]
    squared = data.draw(st.integers(0, 30))
    seen: list[list[Sight]] = [[] for _ in cells]
    run = conducted(
        grid,
        [asking(Look(), seen=sights) for sights in seen],
        starts=[grid.place(*cell) for cell in cells],
        team={"parents": 3},
        sensing={
            "mode": "three",
            "map": True,
            "robots_m": (squared + 1e-6) ** 0.5 * grid.cell_m,
        },
        faults=[{"kill": "robot:4", "at_request": 2}],
        device={"capacity_bytes": 0},
    )
    for robot, (last, cell) in enumerate(zip(seen, cells, strict=True)):
        if robot == 4:
            continue  # was lost before it saw anything; nobody sees it
        if robot == 3:
            assert type(last[-1]) is Sight
            assert (last[-1].place, last[-1].here, last[-1].alone) == (-1, (), False)
            continue
        expected = [
            (other, there)
            for other, there in enumerate(cells[:4])
            if other != robot
            and (cell[0] - there[0]) ** 2 + (cell[1] - there[1]) ** 2 <= squared
            and line_is_clear(grid, cell, there)
        ]
        assert isinstance(last[-1], TeamSight)
        assert list(last[-1].robots) == expected
    briefings = [run.world.briefing(robot) for robot in range(5)]
    assert [briefing.map is None for briefing in briefings] == [False] * 3 + [True] * 2
    assert [briefing.position for briefing in briefings] == [*cells[:3], None, None]
    assert {briefing.parents for briefing in briefings} == {3}
    assert briefings[3].sensing.mode == "none"


def test_a_robot_under_way_is_seen_where_it_left_from() -> None:
    seen: list[TeamSight] = []
    conducted(
        Grid.of_text("..."),
        [asking(WaitForNews(None, (), 1.0), Look(), seen=seen), asking(Move(None, (), 1))],
        starts=[0, 1],
        clock={"mode": "event"},
        team={"parents": 1, "speed": [1.0, 0.5]},
        sensing={"mode": "three", "robots_m": 5.0},
        device={"capacity_bytes": 0},
    )
    assert [(one.time, one.robots) for one in seen] == [
        (0.0, ((1, (0, 1)),)),
        (1.0, ((1, (0, 1)),)),
        (1.0, ((1, (0, 1)),)),
    ]


def test_who_adds_up_its_moves_sees_others_from_where_it_takes_itself_to_be() -> None:
    seen: list[TeamSight] = []
    conducted(
        Grid.of_text("....."),
        [asking(Move(None, (), 1), Move(None, (), 1), seen=seen), asking()],
        starts=[0, 4],
        sensing={"mode": "three", "robots_m": 9.0, "position": "odometry", "drift": 0.6},
        device={"capacity_bytes": 0},
        seed=1,
    )
    run_of = [(one.position, one.robots) for one in seen]
    mistaken = [robots != ((1, (0, 4)),) for _, robots in run_of]
    assert mistaken[0] is False
    assert any(mistaken)


# Refusals.


@pytest.mark.parametrize(
    ("fields", "field"),
    [
        ({"sensing": {"map": False}}, "sensing.map"),
        ({"sensing": {"position": "odometry"}}, "sensing.position"),
        ({"sensing": {"robots_m": 1.0}}, "sensing.robots_m"),
        ({"sensing": {"robots_m": 3.0}}, "sensing.robots_m"),
        ({"sensing": {"robots_m": 64.5}, "radio": {"radius_m": 70.0}}, "sensing.robots_m"),
        ({"radio": {"radius_m": 1.0}}, "radio.radius_m"),
        ({"radio": {"reach": "radius", "line_of_sight": False}}, "radio.line_of_sight"),
        ({"radio": {"loss": 0.1}}, "radio.loss"),
        ({"radio": {"latency": 0.1}}, "radio.latency"),
        ({"radio": {"duplicate": 0.1}}, "radio.duplicate"),
        ({"radio": {"heartbeat": "reach"}}, "radio.heartbeat"),
        ({"world": {"bodies": "block"}}, "world.bodies"),
        ({"team": {"parents": 0}}, "team.parents"),
        ({"team": {"parents": 5}}, "team.parents"),
        ({"team": {"parents": 6}}, "team.parents"),
        ({"algorithm_options": {"anything": 1}}, "algorithm_options"),
    ],
)
def test_what_it_cannot_do_without_is_asked_for(
    fields: dict[str, Any], field: str, tmp_path: Path
) -> None:
    with pytest.raises(ScenarioError, match=f"field `{field}`"):
        HALL.setting(tmp_path, **fields)


def test_a_radius_is_asked_for(tmp_path: Path) -> None:
    with pytest.raises(
        ScenarioError, match=r"field `radio\.radius_m`: found None, expected a length"
    ):
        setting_on(tmp_path, HALL.lines, HALL.starts, algorithm="parent-child")


def test_a_radius_without_a_reach_is_refused_for_others(tmp_path: Path) -> None:
    radio = {"radius_m": 2.0}
    with pytest.raises(ScenarioError, match=r"field `radio\.radius_m`: found 2\.0, expected"):
        setting_on(tmp_path, ["..", ".."], [(0, 0)], radio=radio)


@pytest.mark.parametrize(
    ("starts", "parents", "robot"),
    [(((0, 0), (1, 0), (0, 0)), 2, 1), (((0, 0), (0, 0), (0, 2)), 1, 2)],
    ids=["parents apart", "child out of reach"],
)
def test_starts_that_do_not_do_are_refused(
    starts: tuple[Cell, ...], parents: int, robot: int, tmp_path: Path
) -> None:
    drawn = Family((".#.", ".#."), starts, parents, 2.5)
    with pytest.raises(ScenarioError, match=rf"field `world\.starts\[{robot}\]`"):
        drawn.setting(tmp_path)


@pytest.mark.parametrize(
    ("fields", "field"),
    [
        ({"team": {"parents": 1}}, "team.parents"),
        ({"sensing": {"robots_m": 2.0}}, "sensing.robots_m"),
    ],
)
def test_parents_and_eyes_are_for_grids(fields: dict[str, Any], field: str) -> None:
    team = {"robots": 2, **fields.pop("team", {})}
    tree = {"generate": {"kind": "nary-tree", "branching": 2, "radius": 1}}
    with pytest.raises(ScenarioError, match=f"field `{field}`: .* is for grids only"):
        prepare(from_tree({"algorithm": "mr-dfs", "world": tree, "team": team, **fields}, "test"))
