"""The command line: what it prints and returns, and what it refuses without leaving a trace."""

import json
import re
import socket
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from deploy.verdict.audit_findings import SOURCE as AUDIT
from protocol.zenoh_link import free_port
from tests.conftest import ROOT, shared
from tests.runs import Said, Watch, free, run_cli, write_scenario
from world_server.journal import scan

ENGINES = ["inprocess", "processes"]


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    return write_scenario(tmp_path)


def run(scenario: Path, *arguments: object, **options: Any) -> Said:
    folder = scenario.parent
    return run_cli("run", scenario.name, "--no-picture", *arguments, cwd=folder, **options)


# The contract of a result.

CONTRACT: dict[str, type | tuple[type, ...]] = {
    "scenario": str,
    "algorithm": str,
    "engine": str,
    "seed": int,
    "robots": int,
    "robots_lost": list,
    "complete": bool,
    "covered": int,
    "to_cover": int,
    "coverage_time": float,
    "makespan": float,
    "steps": int,
    "guarantees": list,
    "trace_sha256": str,
    "restarts": dict,
    "device_bytes_max": int,
    "per_robot": list,
    "durability": str,
    "wall_s": float,
}


@pytest.mark.parametrize("engine", ENGINES)
def test_json_is_one_object_with_all_that_scripts_rely_on(engine: str, scenario: Path):
    said = run(scenario, "--json", "--engine", engine, "--set", "seed=9", "--out", "here")
    assert said.code == 0
    result = said.result
    for field, kind in CONTRACT.items():
        assert isinstance(result[field], kind), field
    expected = {
        "scenario": "small",
        "algorithm": "mr-dfs",
        "engine": engine,
        "seed": 9,
        "robots": 3,
        "robots_lost": [],
        "complete": True,
        "covered": 5,
        "to_cover": 5,
        "restarts": {"world": 0, "bookkeeping": 0} if engine == "processes" else {},
        "durability": "process",
    }
    assert {field: result[field] for field in expected} == expected
    assert re.fullmatch("[0-9a-f]{64}", result["trace_sha256"])
    assert result["wall_s"] > 0
    for claim in result["guarantees"]:
        assert {"name", "source", "holds", "detail"} <= claim.keys()
        assert claim["holds"] in (True, None)
        assert claim["detail"]
    assert [robot["id"] for robot in result["per_robot"]] == [0, 1, 2]
    assert sum(robot["moves"] for robot in result["per_robot"]) == result["steps"]
    assert {robot["lost_at"] for robot in result["per_robot"]} == {None}
    assert max(robot["stopped_at"] for robot in result["per_robot"]) == result["makespan"]
    assert json.loads((scenario.parent / "here" / "result.json").read_text()) == result
    assert "small: mr-dfs, 3 robots, 5 vertices, 6 edges" in said.err  # progress goes there


def test_both_engines_say_the_same(scenario: Path):
    fault = ("--set", 'faults=[{kill="robot:1", at=3}]')
    results = [run(scenario, "--json", "--engine", engine, *fault).result for engine in ENGINES]
    for result in results:
        for field in ("engine", "wall_s", "steps_per_s", "restarts"):
            del result[field]
        for fault in result["faults"]:
            del fault["struck_s"], fault["went_on_s"]
        # What a run by processes left in its folder is audited; in one thread that has no meaning.
        claims = result["guarantees"]
        result["guarantees"] = [claim for claim in claims if claim["source"] != AUDIT]
    assert results[0] == results[1]
    assert results[0]["robots_lost"] == [1]
    assert results[0]["per_robot"][1]["lost_at"] == 3


def test_the_verdict_in_words(scenario: Path):
    said = run_cli("run", scenario.name, "--engine", "inprocess", cwd=scenario.parent)
    assert said.code == 0
    assert said.out.startswith("covered: 5 of 5 places by 3 robots, none lost")
    for words in ("coverage time", "makespan", "✓ every vertex visited", "Brass et al. 2011"):
        assert words in said.out
    assert "result in runs/small-1/result.json, picture in runs/small-1/run.png" in said.out
    picture = scenario.parent / "runs" / "small-1" / "run.png"
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_runs_without_out_are_numbered(scenario: Path):
    for number in (1, 2):
        assert run(scenario, "--engine", "inprocess").code == 0
        assert (scenario.parent / "runs" / f"small-{number}" / "journal").exists()


def test_set_overrides_any_field(scenario: Path):
    (scenario.parent / "other.edges").write_text("a b\nb c\n")
    said = run(
        *(scenario, "--json", "--engine", "inprocess", "--set", "team.robots=5"),
        *("--set", "world.map=other.edges", "--set", "world.start=b", "--set", "name=mine"),
        *("--set", 'clock={mode="event", jitter=0.5}'),
    )
    result = said.result
    assert (result["robots"], result["to_cover"], result["scenario"]) == (5, 3, "mine")
    assert said.code == 0


@pytest.mark.parametrize("engine", ENGINES)
def test_an_incomplete_run_returns_1(engine: str, scenario: Path):
    kills = ", ".join(f'{{kill="robot:{robot}", at_request=4}}' for robot in range(3))
    said = run(scenario, "--json", "--engine", engine, "--set", f"faults=[{kills}]")
    assert said.code == 1
    assert said.result["complete"] is False
    assert said.result["robots_lost"] == [0, 1, 2]


# What is refused.

BAD_MAP = "0 1\n# a remark\n1 2 3 4\n"

Refused = tuple[list[str], list[str]]
REFUSED: dict[str, Refused] = {
    # arguments after `canopy run small.toml`; words that the one line must have
    "unknown field": (["--set", "wrld=1"], ["small.toml", "wrld"]),
    "unknown field of a section": (["--set", "team.robotss=1"], ["small.toml", "team", "robotss"]),
    "wrong type": (["--set", 'team.robots="many"'], ["small.toml", "team.robots", "int", "many"]),
    "zero robots": (["--set", "team.robots=0"], ["small.toml", "team.robots", ">= 1"]),
    "no map file": (["--set", "world.map=none.edges"], ["none.edges", "no such file"]),
    "bad line of a map": (["--set", "world.map=bad.edges"], ["bad.edges", "3"]),
    "unknown kind of map": (["--set", "world.map=small.toml"], ["small.toml", ".edges"]),
    "unknown start": (["--set", "world.start=nowhere"], ["world.start", "nowhere"]),
    "starts of others": (["--set", "world.starts=[0]"], ["small.toml", "world.starts", "3 robots"]),
    "device too small": (
        ["--set", "device.capacity_bytes=1"],
        ["small.toml", "device.capacity_bytes", "1", "at least 3", "degree 3"],
    ),
    "unknown algorithm": (
        ["--set", "algorithm=dfs"],
        ["small.toml", "algorithm", "'dfs'", "mr-dfs"],
    ),
    "unknown module": (["--set", "algorithm=nowhere:f"], ["algorithm", "nowhere"]),
    "unknown function": (["--set", "algorithm=mine:g"], ["algorithm", "mine", "'g'"]),
    "no coroutine": (["--set", "algorithm=mine:plain"], ["algorithm", "async def"]),
    "unknown option": (["--set", "algorithm_options.speed=1"], ["algorithm_options", "speed"]),
    "set without a value": (["--set", "seed"], ["--set seed", "key.path=value"]),
    "set into no section": (["--set", "seed.x=1"], ["--set seed.x=1", "seed"]),
    "fault on nobody": (
        ["--set", 'faults=[{kill="robot:3", at=1}]'],
        ["small.toml", "faults[0].kill", "robot:3", "robot:2"],
    ),
    "fault at no time": (
        ["--set", 'faults=[{kill="robot:1"}]'],
        ["small.toml", "faults[0]", "at_request"],
    ),
    "map and generator": (
        ["--set", 'world={map="small.edges", generate={kind="cave", vertices=9}}'],
        ["small.toml", "world", "both"],
    ),
    "neither map nor generator": (["--set", "world={}"], ["small.toml", "world", "neither"]),
    "unknown generator": (["--set", 'world.generate={kind="moon"}'], ["small.toml", "moon"]),
    "jitter in lockstep": (["--set", "clock.jitter=0.1"], ["small.toml", "clock.jitter"]),
    "little patience": (["--set", "network.patience_s=0.1"], ["network.patience_s", ">= 1"]),
    "port out of range": (["--set", "network.port=70000"], ["network.port", "65535"]),
    "no folder for the database": (
        ["--set", "bookkeeping.database=none/tags.db"],
        ["bookkeeping.database", "none/tags.db"],
    ),
    "database of another kind": (
        ["--set", "bookkeeping.database=small.edges"],
        ["bookkeeping.database", "small.edges"],
    ),
    "no earlier tags": (
        ["--set", "bookkeeping.database=new.db", "--set", "bookkeeping.fresh=false"],
        ["bookkeeping", "new.db"],
    ),
    "unwritable out": (["--out", "/dev/null/run"], ["/dev/null/run"]),
    "out is a file": (["--out", "small.edges"], ["small.edges"]),
    "unknown engine": (["--engine", "steam"], ["--engine", "steam", "inprocess"]),
    "unknown option of the command": (["--bogus"], ["--bogus"]),
}


@pytest.mark.parametrize("engine", [pytest.param("inprocess", marks=pytest.mark.slow), "processes"])
@pytest.mark.parametrize("name", REFUSED)
def test_bad_input_is_refused_in_one_line_and_leaves_nothing(
    name: str, engine: str, scenario: Path
):
    folder = scenario.parent
    (folder / "bad.edges").write_text(BAD_MAP)
    (folder / "mine.py").write_text("async def f(body): pass\ndef plain(body): pass\n")
    arguments, words = REFUSED[name]
    check_refused(lambda: run(scenario, "--engine", engine, *arguments), folder, words)


def check_refused(command: Callable[[], Said], folder: Path, words: list[str]) -> None:
    before = files(folder)
    said = command()
    assert said.code == 2, said
    assert said.out == ""
    assert len(said.err.splitlines()) == 1, said.err
    assert said.err.startswith("canopy: ")
    for word in words:
        assert word in said.err, said.err
    assert files(folder) == before


def files(folder: Path) -> dict[str, bytes | None]:
    """Return all files and folders, less what Python caches of a user's module."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
        if "__pycache__" not in path.parts
    }


def test_refusals_of_scenario_files(tmp_path: Path):
    write_scenario(tmp_path)
    (tmp_path / "latin.toml").write_bytes(b'name = "caf\xe9"\n')
    (tmp_path / "broken.toml").write_text('algorithm = "mr-dfs"\nworld = \n')
    (tmp_path / "empty.toml").write_text("")
    (tmp_path / "more.toml").write_text((tmp_path / "small.toml").read_text() + "\n[wings]\n")
    for name, words in {
        "none.toml": ["none.toml", "no such file"],
        ".": ["is a directory"],
        "latin.toml": ["latin.toml", "UTF-8"],
        "broken.toml": ["broken.toml", "line 2"],
        "empty.toml": ["empty.toml", "algorithm"],
        "more.toml": ["more.toml", "wings"],
    }.items():
        check_refused(partial(run_cli, "run", name, cwd=tmp_path), tmp_path, words)


def test_refusals_of_other_commands(tmp_path: Path):
    write_scenario(tmp_path)
    (tmp_path / "bad.edges").write_text(BAD_MAP)
    for arguments, words in (
        ([], ["COMMAND"]),
        (["fly"], ["fly"]),
        (["run"], ["SCENARIO.toml"]),
        (["map"], ["FILE"]),
        (["map", "none.edges"], ["none.edges", "no such file"]),
        (["map", "bad.edges"], ["bad.edges", "3"]),
        (["map", "small.edges", "--picture", "/dev/null/x.png"], ["--picture", "/dev/null/x.png"]),
        (["replay", "nowhere"], ["nowhere"]),
        (["replay", "."], ["journal"]),
    ):
        check_refused(partial(run_cli, *arguments, cwd=tmp_path), tmp_path, words)


def test_a_port_in_use_is_refused(scenario: Path):
    watch = Watch(scenario.parent)
    with socket.socket() as taken:
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        taken.bind(("127.0.0.1", free_port()))
        taken.listen()
        port = str(taken.getsockname()[1])
        check_refused(
            lambda: run(scenario, "--set", f"network.port={port}", environment=watch.environment),
            scenario.parent,
            ["network.port", port, "in use"],
        )
    watch.nothing_left()


def test_a_port_of_ones_own_is_free_again(scenario: Path):
    port = free_port()
    for number in (1, 2):
        said = run(scenario, "--set", f"network.port={port}", "--out", f"run-{number}")
        assert said.code == 0, said
        assert free(port)


def test_out_with_a_run_in_it_is_refused(scenario: Path):
    assert run(scenario, "--engine", "inprocess", "--out", "here").code == 0
    for engine in ENGINES:
        check_refused(
            partial(run, scenario, "--engine", engine, "--out", "here"),
            scenario.parent,
            ["--out here", "holds a run already"],
        )


def without(package: str, folder: Path) -> dict[str, str]:
    """Return an environment in which ``package`` is not installed."""
    hook = folder / f"without-{package}"
    hook.mkdir()
    (hook / "sitecustomize.py").write_text(
        "import sys\n"
        "class Missing:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name.partition('.')[0] == {package!r}:\n"
        f"            raise ModuleNotFoundError(f'No module named {{name!r}}', name={package!r})\n"
        "sys.meta_path.insert(0, Missing())\n"
    )
    return {"PYTHONPATH": str(hook)}


@pytest.mark.parametrize("package", ["zenoh", "matplotlib", "rich", "msgspec"])
def test_a_missing_package_is_told_in_one_line(package: str, scenario: Path):
    environment = without(package, scenario.parent)
    check_refused(
        lambda: run_cli("run", "small.toml", cwd=scenario.parent, environment=environment),
        scenario.parent,
        [package, "make setup"],
    )


def test_what_is_not_needed_may_be_missing(scenario: Path):
    for package in ("zenoh", "matplotlib"):
        environment = without(package, scenario.parent)
        said = run(scenario, "--engine", "inprocess", environment=environment)
        assert said.code == 0, said


@pytest.mark.parametrize("package", ["zenoh", "rich"])
def test_doctor_names_a_missing_package(package: str, tmp_path: Path):
    said = run_cli("doctor", cwd=tmp_path, environment=without(package, tmp_path))
    assert (said.code, said.err) == (1, ""), said
    assert re.search(
        rf"^✗ (eclipse-)?{package} +missing; run `make setup`$", said.out, re.MULTILINE
    )


# Replay.


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """A run by processes in which robot 1 is lost at 3, and its result."""
    folder = tmp_path_factory.mktemp("finished")
    scenario = write_scenario(folder)
    said = run(scenario, "--json", "--set", 'faults=[{kill="robot:1", at=3}]', "--out", "run")
    assert said.code == 0, said
    return folder / "run", said.result


def test_replay_gives_the_recorded_trace(finished: tuple[Path, dict[str, Any]], tmp_path: Path):
    folder, result = finished
    before = files(folder)
    said = run_cli("replay", folder, "--json", cwd=tmp_path)
    assert said.code == 0
    replayed = said.result
    assert replayed["trace_sha256"] == result["trace_sha256"]
    for field in CONTRACT:
        if field not in ("wall_s", "restarts"):
            assert replayed[field] == result[field], field
    assert files(folder) == before
    in_words = run_cli("replay", folder, cwd=tmp_path)
    assert in_words.code == 0
    assert "the replayed trace is the recorded one" in in_words.out


def test_replay_until_a_time(finished: tuple[Path, dict[str, Any]], tmp_path: Path):
    folder, result = finished
    steps = []
    for until in (0, 2, 3.5, 6, 1000):
        said = run_cli("replay", folder, "--until", until, "--json", cwd=tmp_path)
        assert said.code == 0
        steps.append(said.result["steps"])
        assert said.result["robots_lost"] == ([1] if until >= 3 else [])
        assert said.result["coverage_time"] <= until
    assert steps == sorted(steps)
    assert steps[0] == 0
    assert steps[-1] == result["steps"]


def test_replay_tells_the_events(finished: tuple[Path, dict[str, Any]], tmp_path: Path):
    folder, result = finished
    said = run_cli("replay", folder, "--events", "--json", cwd=tmp_path)
    assert said.result["trace_sha256"] == result["trace_sha256"]
    assert sum("lost (killed)" in line for line in said.err.splitlines()) == 1
    assert said.err.startswith("t=0 round=-1 wave=0 robot=0 at 0 entry=None look")


def test_a_damaged_journal_is_refused_with_its_offset(
    finished: tuple[Path, dict[str, Any]], tmp_path: Path
):
    whole = (finished[0] / "journal").read_bytes()
    offsets = [end for _, end in scan(finished[0] / "journal")]
    damaged = tmp_path / "damaged"
    damaged.mkdir()
    for offset in (0, 20, 40, offsets[0] + 5, offsets[3] + 1, offsets[5] + 14, len(whole) - 1):
        content = bytearray(whole)
        content[offset] ^= 0x40
        (damaged / "journal").write_bytes(content)
        said = run_cli("replay", damaged, cwd=tmp_path)
        assert said.code == 2, said
        assert len(said.err.splitlines()) == 1
        found = re.search(r"damaged/journal: offset (\d+): ", said.err)
        assert found, said.err
        starts = [0, 17, *offsets]
        assert int(found[1]) == max(start for start in starts if start <= offset)


def test_a_journal_cut_short_replays_as_far_as_it_goes(
    finished: tuple[Path, dict[str, Any]], tmp_path: Path
):
    whole = (finished[0] / "journal").read_bytes()
    cut = tmp_path / "cut"
    cut.mkdir()
    (cut / "journal").write_bytes(whole[: len(whole) * 2 // 3])
    said = run_cli("replay", cut, "--json", cwd=tmp_path)
    assert said.code == 1
    assert said.result["complete"] is False
    assert said.result["makespan"] is None
    assert "cut off before its end" in run_cli("replay", cut, cwd=tmp_path).out


# Maps and the machine.


@pytest.mark.parametrize(
    ("name", "vertices", "edges"),
    [
        ("rmf/office.edges", 29, 30),
        ("osm/planet_10.068,48.135_10.071,48.137.edges", 38, 36),
        ("zoo/Cogentco.graphml", 197, 245),
    ],
)
def test_map_says_what_a_file_is(name: str, vertices: int, edges: int, tmp_path: Path):
    path = shared("maps", "graphs", *name.split("/"))
    said = run_cli("map", path, "--json", "--picture", "map.png", cwd=tmp_path)
    assert said.code == 0, said
    facts = said.result
    assert (facts["kind"], facts["vertices"], facts["edges"]) == ("graph", vertices, edges)
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")
    in_words = run_cli("map", path, cwd=tmp_path)
    assert in_words.code == 0
    assert f"{vertices} vertices, {edges} edges" in in_words.out
    assert (tmp_path / f"{path.stem}.png").exists()


def test_map_reads_node_link_json(tmp_path: Path):
    said = run_cli("map", ROOT / "deploy" / "maps" / "cave.json", "--json", cwd=tmp_path)
    assert said.code == 0, said
    assert said.result["vertices"] >= 150


def test_doctor_finds_this_machine_fit(tmp_path: Path):
    said = run_cli("doctor", cwd=tmp_path)
    assert said.code == 0, said
    for name in ("python", "eclipse-zenoh", "zenoh on loopback", "mr-dfs"):
        assert name in said.out
    assert "✗" not in said.out
    assert list(tmp_path.iterdir()) == []


def test_help_names_all_commands(tmp_path: Path):
    said = run_cli("--help", cwd=tmp_path)
    assert said.code == 0
    for command in ("run", "replay", "map", "doctor"):
        assert re.search(rf"^ +{command} ", said.out, re.MULTILINE)
        assert run_cli(command, "--help", cwd=tmp_path).code == 0


# Algorithms of users.

MINE = """
from msgspec import Struct

class Options(Struct, forbid_unknown_fields=True):
    turns: int = 3

async def circle(body, options: Options):
    print("hello from an algorithm")
    here = await body.look()
    for _ in range(options.turns * 5):
        here = await body.move((here.entry or 0) ^ 1)
"""


def test_an_algorithm_in_the_current_folder_runs_in_both_engines(tmp_path: Path):
    scenario = write_scenario(tmp_path, "0 1\n1 2\n2 3\n3 4\n4 0\n")
    (tmp_path / "mine.py").write_text(MINE)
    results = [
        run(
            *(scenario, "--json", "--engine", engine, "--set", "algorithm=mine:circle"),
            *("--set", "algorithm_options.turns=2"),
        ).result
        for engine in ENGINES
    ]
    assert results[0]["trace_sha256"] == results[1]["trace_sha256"]
    for result in results:
        assert result["algorithm"] == "mine:circle"
        assert result["complete"] is True
        assert result["errors"] == []


FAULTY = {
    # algorithm: who is lost and how, and the error of the first of them
    "raises": ({1: "failed"}, "ValueError", "robot 1 has a bug"),
    "awaits_a_stranger": ({1: "failed"}, "AlgorithmError", "awaits something that is not"),
    "takes_no_exit": ({1: "refused"}, "ExitError", "exit 99"),
    "writes_too_much": ({1: "refused"}, "TagError", "1000 bytes"),
    "goes_in_rounds": ({0: "refused", 1: "refused"}, "RoundsError", "free requests"),
    "sleeps": ({1: "failed"}, "AlgorithmError", "(no running event loop)"),
    "moves_by_name": ({1: "failed"}, "AlgorithmError", "'north'"),
    "leaves_the_interpreter": ({1: "failed"}, "SystemExit", ""),
}


@pytest.mark.parametrize("name", FAULTY)
def test_a_robot_that_ends_loudly_is_named_and_the_others_go_on(name: str, scenario: Path):
    lost, error, detail = FAULTY[name]
    traces = set()
    for engine in ENGINES:
        said = run(
            *(scenario, "--json", "--engine", engine, "--set", "clock.rounds_max=20"),
            *("--set", f"algorithm=tests.robots:{name}"),
        )
        assert said.code == 1, said
        result = said.result
        assert {one["id"]: one["lost_by"] for one in result["per_robot"] if one["lost_by"]} == lost
        assert [one["robot"] for one in result["errors"]] == list(lost)
        assert result["errors"][0]["error"].rpartition(".")[2] == error
        assert detail in result["errors"][0]["detail"]
        assert result["status"] == "over"
        assert result["per_robot"][2]["stopped_at"] is not None
        traces.add(result["trace_sha256"])
    assert len(traces) == 1


def test_whole_durations_are_as_good_as_floats(scenario: Path):
    results = [
        run(
            scenario,
            "--json",
            "--engine",
            engine,
            "--set",
            "algorithm=tests.robots:waits_whole_numbers",
        ).result
        for engine in ENGINES
    ]
    assert results[0]["trace_sha256"] == results[1]["trace_sha256"]
    assert results[0]["makespan"] == 2


@pytest.mark.parametrize("engine", ENGINES)
def test_a_run_in_which_all_wait_is_stalled(engine: str, scenario: Path):
    watch = Watch(scenario.parent)
    said = run(
        *(scenario, "--json", "--engine", engine),
        *("--set", "algorithm=tests.robots:waits_for_ever"),
        environment=watch.environment,
    )
    assert said.code == 1
    result = said.result
    assert (result["status"], result["complete"], result["errors"]) == ("stalled", False, [])
    assert result["makespan"] is None
    assert [(one["robot"], one["place"]) for one in result["stalled"]] == [
        (0, "4"),
        (1, "0"),
        (2, "0"),
    ]
    watch.nothing_left()
