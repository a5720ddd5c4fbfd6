"""The spine of the design: one scenario gives one trace, on whichever engine it is played."""

import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from deploy.judged import judge_journal
from deploy.setting import Setting, prepare
from protocol.graph import PortGraph
from protocol.scenario import from_tree
from tests.conftest import shared
from tests.play import graph_of, graphs
from tests.runs import Run, play, setting_of
from world_server.maps import read_graph

SMALL = graph_of("01 12 23 34 40 13")


def same_on_both(setting: Setting, folder: Path) -> Run:
    """Play on both engines, compare, and return the run by processes."""
    alone = play(setting, folder, "inprocess")
    by_processes = play(setting, folder, "processes")
    assert by_processes.trace_sha256 == alone.trace_sha256
    assert by_processes.status == alone.status
    assert by_processes.failures.keys() == alone.failures.keys()
    assert not any(by_processes.restarts.values())
    judged = [judge_journal(run.folder.journal).result for run in (alone, by_processes)]
    assert judged[0].per_robot == judged[1].per_robot
    assert judged[0].faults_not_struck == judged[1].faults_not_struck
    return by_processes


# Random scenarios.


def with_lengths(graph: PortGraph, lengths: list[float | None]) -> PortGraph:
    return PortGraph(graph.names, graph.ends, lengths)


@st.composite
def faults(draw: st.DrawFn, robots: int) -> list[dict[str, Any]]:
    """Kills of every kind; the same robot may be meant twice, and a fault may never strike."""
    found: list[dict[str, Any]] = []
    for _ in range(draw(st.integers(0, robots))):
        fault: dict[str, Any] = {"kill": f"robot:{draw(st.integers(0, robots - 1))}"}
        if draw(st.booleans()):
            fault["at_request"] = draw(st.integers(1, 20))
        else:
            fault["at"] = draw(st.integers(0, 24)) / 2
            fault["round"] = draw(st.integers(0, 3))
        found.append(fault)
    return found


@st.composite
def random_settings(draw: st.DrawFn) -> Setting:
    """MR-DFS by teams of 1 to 6 on multigraphs with loops, both clocks, and some of them killed."""
    graph = draw(graphs(vertices_max=6, extra_max=4))
    robots = draw(st.integers(1, 6))
    fields: dict[str, Any] = {"seed": draw(st.integers(0, 99)), "faults": draw(faults(robots))}
    if draw(st.booleans()):
        jitter = draw(st.sampled_from([0.0, 0.05, 0.5, "exponential"]))
        fields["clock"] = {"mode": "event", "jitter": jitter}
        length = st.sampled_from([None, 0.0, 0.5, 1.0, 1.1, 7.3])
        edges = len(graph.ends)
        graph = with_lengths(graph, draw(st.lists(length, min_size=edges, max_size=edges)))
    fields["radio"] = {"heartbeat": draw(st.sampled_from(["global", "reach"]))}
    fields["algorithm_options"] = {"variant": draw(st.sampled_from(["corrected", "paper"]))}
    return setting_of(graph, robots, **fields)


# A failing example is a scenario that one can read; to shrink it costs minutes of processes.
PLAIN = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
PHASES = [Phase.explicit, Phase.reuse, Phase.generate]


@given(setting=random_settings())
@settings(max_examples=6, suppress_health_check=PLAIN, phases=PHASES)
def test_some_random_scenarios_have_one_trace(setting: Setting, tmp_path: Path):
    same_on_both(setting, tmp_path)


@pytest.mark.slow
@pytest.mark.timeout(600)
@given(setting=random_settings())
@settings(max_examples=40, suppress_health_check=PLAIN, phases=PHASES)
def test_random_scenarios_have_one_trace(setting: Setting, tmp_path: Path):
    same_on_both(setting, tmp_path)


@pytest.mark.parametrize("clock", [{}, {"mode": "event", "jitter": 0.5}], ids=["lockstep", "event"])
def test_kills_of_all_kinds_have_one_trace(clock: dict[str, Any], tmp_path: Path):
    kills = [
        {"kill": "robot:0", "at": 2, "round": 1},
        {"kill": "robot:1", "at": 4.5},
        {"kill": "robot:2", "at_request": 6},
        {"kill": "robot:2", "at": 500},  # never strikes
    ]
    run = same_on_both(setting_of(SMALL, 5, clock=clock, faults=kills), tmp_path)
    result = judge_journal(run.folder.journal).result
    assert set(result.robots_lost) >= {1, 2}
    assert result.faults_not_struck == ["kill robot:2 at t=500"]
    assert result.complete


def test_a_separate_router_and_flushing_change_no_trace(tmp_path: Path):
    plain = play(setting_of(SMALL, 3), tmp_path, "inprocess")
    for fields in ({"network": {"router": "separate"}}, {"durability": "power"}):
        run = play(setting_of(SMALL, 3, **fields), tmp_path, "processes")
        assert run.trace_sha256 == plain.trace_sha256
        assert not any(run.restarts.values())


def test_places_without_devices_have_one_trace(tmp_path: Path):
    fields: dict[str, Any] = {
        "algorithm": "tests.robots:wanderer",
        "device": {"capacity_bytes": 0},
        "seed": 5,
    }
    run = same_on_both(setting_of(SMALL, 4, **fields), tmp_path)
    assert not run.folder.database.exists()


def test_radio_waiting_and_starts_of_their_own_have_one_trace(tmp_path: Path):
    for reach in ("none", "same-place", "global"):
        fields: dict[str, Any] = {
            "algorithm": "tests.robots:talker",
            "radio": {"reach": reach},
            "faults": [{"kill": "robot:1", "at": 3}],
        }
        same_on_both(setting_of(SMALL, 4, starts=[0, 2, 2, 4], **fields), tmp_path)


# Real maps.

MAPS = [
    "cave/DowProv.edges",
    "nav2_route/turtlebot4_graph.edges",
    "osm/planet_10.068,48.135_10.071,48.137.edges",
    "rmf/clinic.edges",
    "rmf/office.edges",
    "subt/cave_circuit_01.edges",
    "subt/niosh_sr_config_a.edges",
    "subt/tunnel_circuit_practice_01.edges",
    "zoo/Cogentco.edges",
    "zoo/Cogentco.graphml",
]
QUICK = {"rmf/office.edges", "subt/niosh_sr_config_a.edges"}
CLOCKS = {"lockstep": {}, "event": {"mode": "event"}, "jitter": {"mode": "event", "jitter": 0.5}}


def real_maps(*, quick: bool = True):
    return [
        pytest.param(name, marks=() if quick and name in QUICK else pytest.mark.slow, id=name)
        for name in MAPS
    ]


def real_setting(name: str, robots: int, **fields: Any) -> Setting:
    path = shared("maps", "graphs", *name.split("/"))
    tree = {
        "algorithm": "mr-dfs",
        "world": {"map": str(path)},
        "team": {"robots": robots},
        **fields,
    }
    return prepare(from_tree(tree, name))


def test_every_real_graph_is_in_the_list():
    folder = shared("maps", "graphs")
    found = {str(path.relative_to(folder)) for path in folder.rglob("*.edges")}
    found |= {str(path.relative_to(folder)) for path in folder.rglob("*.graphml")}
    assert found == set(MAPS)


@pytest.mark.parametrize("clock", CLOCKS)
@pytest.mark.parametrize("name", real_maps())
def test_every_real_graph_has_one_trace_with_kills(name: str, clock: str, tmp_path: Path):
    alone = play(real_setting(name, 3, clock=CLOCKS[clock]), tmp_path, "inprocess")
    makespan = judge_journal(alone.folder.journal).result.makespan
    assert makespan is not None
    kills = [
        {"kill": "robot:1", "at": makespan // 4, "round": 1},
        {"kill": "robot:2", "at": makespan // 3 + 0.5},
    ]
    run = same_on_both(real_setting(name, 3, clock=CLOCKS[clock], faults=kills), tmp_path)
    result = judge_journal(run.folder.journal).result
    assert result.robots_lost == [1, 2]
    assert result.complete


# Exploration time in ticks with 8 robots: ../shared/spec/mr_dfs.md, "Real maps". The rows of the
# table name the start as the file does; where the file does not begin with it, it is given here.
TICKS_OF_EIGHT = [
    ("nav2_route/turtlebot4_graph.edges", "1", 38),
    ("osm/planet_10.068,48.135_10.071,48.137.edges", "7119017425", 36),
    ("rmf/clinic.edges", "L1:363", 42),
    ("rmf/office.edges", "L1:39", 20),
    ("subt/cave_circuit_01.edges", "0", 126),
    ("subt/niosh_sr_config_a.edges", "0", 14),
    ("subt/tunnel_circuit_practice_01.edges", "0", 166),
    ("zoo/Cogentco.edges", "0", 140),
]


@pytest.mark.parametrize(
    ("name", "start", "ticks"),
    [
        pytest.param(*row, marks=() if row[0] in QUICK else pytest.mark.slow, id=row[0])
        for row in TICKS_OF_EIGHT
    ],
)
def test_eight_processes_take_the_time_of_the_specification(
    name: str, start: str, ticks: float, tmp_path: Path
):
    world = {"map": str(shared("maps", "graphs", *name.split("/"))), "start": start}
    run = same_on_both(real_setting(name, 8, world=world), tmp_path)
    result = judge_journal(run.folder.journal).result
    assert (result.makespan, result.complete) == (ticks, True)
    assert all(guarantee.holds is not False for guarantee in result.guarantees)


def test_the_numbers_here_are_those_of_the_specification():
    text = shared("spec", "mr_dfs.md").read_text()
    table = dict(re.findall(r"^\| (\S+\.edges) \| .* \| [\d ]+ (\d+) \|$", text, re.MULTILINE))
    for name, start, ticks in TICKS_OF_EIGHT:
        key = "osm/planet_...edges" if name.startswith("osm") else name
        assert int(table[key]) == ticks
        assert f"| {key} | {start} |" in text
        assert read_graph(shared("maps", "graphs", *name.split("/"))).names[0] == start
