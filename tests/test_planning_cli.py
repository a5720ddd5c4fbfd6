"""`canopy plan`: what it prints and writes, and what it refuses."""

import json
from collections.abc import Callable
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from deploy.cli import main
from protocol.grid import Cell
from tests.conftest import ROOT, shared
from tests.instances import Instance, read_instance
from tests.runs import run_cli

METRICS = {"manhattan": "manhattan", "euclid": "euclid", "sp": "shortest-path"}
SPLITS = {"NB": "nb-mstc", "B": "b-mstc", "Opt": "opt-mstc"}
OFFICE = ROOT / "deploy" / "maps" / "office.txt"


class Said(NamedTuple):
    code: int
    out: str
    err: str


Plan = Callable[..., Said]


@pytest.fixture
def plan(capsys: pytest.CaptureFixture[str]) -> Plan:
    """`canopy plan` in this process."""

    def call(*arguments: object) -> Said:
        try:
            code = main(["plan", *map(str, arguments)])
        except SystemExit as ended:
            code = int(str(ended.code))
        return Said(code, *capsys.readouterr())

    return call


def facts_of(said: Said) -> dict[str, Any]:
    assert said.code == 0, said.err
    (line,) = said.out.splitlines()
    facts = json.loads(line)
    assert isinstance(facts, dict)
    return facts


def write_map(path: Path, rows: list[str]) -> Path:
    """Write a map of coarse cells, two by two characters each."""
    doubled = ("".join(2 * mark for mark in row) for row in rows)
    path.write_text("".join(f"{row}\n{row}\n" for row in doubled))
    return path


def starts_of(told: Instance) -> str:
    return " ".join(f"{row},{col}" for row, col in told.robots)


def replayed(path: Path, rows: list[str], starts: list[Cell], *, closed: bool) -> tuple[int, int]:
    """Walk the walks on a map of sub-cells; return sub-cells covered and the time of the last."""
    walks = [[(row, col) for row, col in walk] for walk in json.loads(path.read_text())]
    assert [walk[0] for walk in walks] == starts
    first: dict[Cell, int] = {}
    for walk in walks:
        if closed:
            assert walk[-1] == walk[0]
        for time, (row, col) in enumerate(walk):
            assert min(row, col) >= 0
            assert rows[row][col] == "."
            first[row, col] = min(time, first.get((row, col), time))
        for (row, col), (to_row, to_col) in pairwise(walk):
            assert abs(row - to_row) + abs(col - to_col) == 1
    return len(first), max(first.values())


# Exact instances.


@pytest.mark.parametrize("name", ["tour0", "tour1", "fig2_bundled", "fig2_spread"])
@pytest.mark.parametrize("key", SPLITS)
@pytest.mark.parametrize("open_", [False, True])
def test_tours(name: str, key: str, open_: bool, plan: Plan, tmp_path: Path) -> None:
    told = read_instance(shared("spec", "instances", f"{name}.txt"))
    grid = write_map(tmp_path / "map.txt", told.rows)
    tree = tmp_path / "tree.txt"
    tree.write_text(
        "# the tree\n" + "".join(f"{r},{c}-{to_r},{to_c}\n" for (r, c), (to_r, to_c) in told.tree)
    )
    paths = tmp_path / "walks.json"
    facts = facts_of(
        plan(
            *(grid, "--starts", starts_of(told), "--tree", tree, "--algorithm", SPLITS[key]),
            *("--json", "--paths", paths, *(["--open"] if open_ else [])),
        )
    )
    found = {
        "N": facts["cells"],
        "order": facts["order"],
        "D": facts["distances"],
        key: facts["coverage_time"],
    }
    assert found == {name: told.expect[name] for name in ("N", "order", "D", key)}
    fine = grid.read_text().split()
    assert replayed(paths, fine, told.robots, closed=not open_) == (
        told.expect["N"],
        told.expect[key],
    )
    assert facts["lower_bound"] == -(-facts["cells"] // facts["robots"])
    assert facts["tour"] >= max(facts["walks"])
    assert open_ or facts["tour"] == max(facts["walks"])
    assert facts["walks"] == [len(walk) - 1 for walk in json.loads(paths.read_text())]


@pytest.mark.parametrize("name", ["fig3", "fig3_alt88"])
def test_trees(name: str, plan: Plan, tmp_path: Path) -> None:
    told = read_instance(shared("spec", "instances", f"{name}.txt"))
    grid = write_map(tmp_path / "map.txt", told.rows)
    edges = ["0,0-0,1", "0,0-1,0", "0,1-1,1", "1,0-1,1"]
    found = []
    tree = tmp_path / "tree.txt"
    for chosen in combinations(edges, 3):
        tree.write_text("tree " + " ".join(chosen))
        arguments = (grid, "--starts", starts_of(told), "--tree", tree, "--json")
        facts = facts_of(plan(*arguments, "--algorithm", "random+nb-mstc"))
        found.append((facts["distances"], facts["coverage_time"]))
    gaps = sorted(tuple(sorted(gaps, reverse=True)) for gaps, _ in found)
    assert len(gaps) == told.expect["count"]
    assert gaps == sorted(told.expect["multiset"])  # type: ignore[call-overload]  # a list of pairs
    assert min(time for _, time in found) == told.expect["bestNB"]
    assert max(time for _, time in found) == told.expect["worstNB"]


@pytest.mark.parametrize("name", ["create0", "create1", "create_wall"])
@pytest.mark.parametrize("metric", METRICS)
def test_create_tree(name: str, metric: str, plan: Plan, tmp_path: Path) -> None:
    path = shared("spec", "instances", f"{name}.txt")
    told = read_instance(path)
    expected = told.expected(metric)
    lines = path.read_text(encoding="utf-8").splitlines()
    (owner,) = [line.split()[2] for line in lines if line.startswith(f"expect {metric}.owner ")]
    grid = write_map(tmp_path / "map.txt", told.rows)
    arguments = (grid, "--starts", starts_of(told), "--json", "--distance", METRICS[metric])
    facts = facts_of(plan(*arguments, "--all-bridges", "--algorithm", "create-tree+nb-mstc"))
    found = {
        "sizes": facts["subtree_sizes"],
        "bridges": facts["bridges"],
        "owner": expected["owner"],
        "ops": facts["growths"],
        "sets": facts["bridge_sets"],
        "bestDmax": facts["d_max_best"],
        "worstDmax": facts["d_max_worst"],
        "bestOpt": facts["opt_best"],
    }
    assert found == expected
    assert facts["owner"] == owner.split("/")
    assert facts["coverage_time"] == expected["bestDmax"] - 1  # type: ignore[operator]  # a number
    drawn = facts_of(plan(*arguments, "--tries", 200, "--algorithm", "create-tree+nb-mstc"))
    assert drawn["coverage_time"] == facts["coverage_time"]
    assert drawn["tries"] == 200
    assert "bridge_sets" not in drawn


# Real maps.


@pytest.mark.parametrize(
    "tree", ["random", "depth-first", "breadth-first", "minimum", "create-tree"]
)
@pytest.mark.parametrize("split", SPLITS.values())
def test_every_algorithm_covers_the_office(
    tree: str, split: str, plan: Plan, tmp_path: Path
) -> None:
    paths = tmp_path / "walks.json"
    arguments = (OFFICE, "--robots", 7, "--seed", 2, "--algorithm", f"{tree}+{split}", "--json")
    facts = facts_of(plan(*arguments, "--paths", paths))
    starts = [(row, col) for row, col in facts["starts"]]
    found = replayed(paths, OFFICE.read_text().split(), starts, closed=True)
    assert found == (facts["cells"], facts["coverage_time"]) == (2832, facts["coverage_time"])
    again = facts_of(plan(*arguments))
    assert {**again, "seconds": 0} == {**facts, "seconds": 0}
    assert facts_of(plan(*arguments, "--seed", 3))["starts"] != facts["starts"]


@pytest.mark.parametrize("name", ["ls_floor_small_k4", "mip_maze_small_10x10_k6"])
def test_peers_instances(name: str, plan: Plan, tmp_path: Path) -> None:
    peer = json.loads(shared("peers", "grids", f"{name}.json").read_text())
    grid, paths = tmp_path / "map.txt", tmp_path / "walks.json"
    grid.write_text("\n".join(peer["grid"]))
    starts = [(row, col) for row, col in peer["robots"]]
    words = " ".join(f"{row},{col}" for row, col in starts)
    facts = facts_of(plan(grid, "--starts", words, "--paths", paths, "--json"))
    assert replayed(paths, peer["grid"], starts, closed=True)[0] == peer["N"] == facts["cells"]


@pytest.mark.parametrize("open_", [False, True])
def test_best_covers_all_that_can_be_reached(open_: bool, plan: Plan, tmp_path: Path) -> None:
    pytest.importorskip("agents.planning.best")
    grid, paths = tmp_path / "map.txt", tmp_path / "walks.json"
    rows = [".........", "..#......", ".....#.#.", "......#.#", ".......##"]
    grid.write_text("\n".join(rows))
    arguments = (grid, "--starts", "0,8 4,0", "--algorithm", "best", "--budget", 0.3, "--json")
    facts = facts_of(plan(*arguments, "--paths", paths, *(["--open"] if open_ else [])))
    found = replayed(paths, rows, [(0, 8), (4, 0)], closed=not open_)
    assert found == (facts["cells"], facts["coverage_time"]) == (37, facts["coverage_time"])
    assert facts["tour"] >= facts["lower_bound"] == 19
    assert (facts["order"], facts["distances"], facts["subtree_sizes"]) == ([], [], [])
    for words, *more in (
        ("--budget: found 0", "--budget", 0),
        ("--tree: the algorithm best has no tree", "--tree", paths),
        ("3,7 is not connected", "--starts", "0,0 3,7"),
    ):
        said = plan(*arguments, *more)
        assert said.code == 2
        assert words in said.err


def test_one_cell(plan: Plan, tmp_path: Path) -> None:
    grid = write_map(tmp_path / "map.txt", ["."])
    facts = facts_of(plan(grid, "--starts", "1,0", "--json"))
    assert (facts["cells"], facts["coverage_time"], facts["tour"]) == (4, 3, 4)
    facts = facts_of(plan(grid, "--robots", 4, "--json", "--all-bridges"))
    assert (facts["distances"], facts["coverage_time"], facts["tour"]) == ([1] * 4, 0, 0)
    assert (facts["subtree_sizes"], facts["bridges"], facts["bridge_sets"]) == ([1], 0, 1)


def test_starts_outside_the_largest_part_choose_theirs(plan: Plan, tmp_path: Path) -> None:
    grid = write_map(tmp_path / "map.txt", ["..#...."])
    assert facts_of(plan(grid, "--starts", "0,0 1,3", "--json"))["cells"] == 8
    assert facts_of(plan(grid, "--robots", 2, "--json"))["cells"] == 16


@pytest.mark.parametrize(
    ("options", "tries"),
    [
        ((), 9),
        (("--alpha", "3"), 27),
        (("--tries", "max"), 400),
        (("--tries", "5"), 5),
        (("--tries", "max", "--alpha", "6"), None),
    ],
)
def test_tries(options: tuple[str, ...], tries: int | None, plan: Plan, tmp_path: Path) -> None:
    grid = write_map(tmp_path / "map.txt", ["." * 10] * 10)
    said = plan(grid, "--starts", "0,0 19,0 0,19", "--json", *options)
    if tries is None:
        assert "--alpha: found 6, expected 0 to 4" in said.err
    else:
        assert facts_of(said)["tries"] == tries


def test_in_words_and_with_a_picture(tmp_path: Path) -> None:
    picture = tmp_path / "plan.png"
    said = run_cli("plan", OFFICE, "--robots", 3, "--picture", picture, cwd=tmp_path)
    assert said.code == 0, said.err
    lines = said.out.splitlines()
    assert lines[0] == "create-tree+opt-mstc: 3 robots cover 2832 sub-cells"
    for words in ("coverage time", "at least 944", "to the next"):
        assert words in said.out
    assert len(lines) == 7
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_help_teaches(plan: Plan) -> None:
    said = plan("--help")
    assert said.code == 0
    for words in ("TREE+SPLIT", "opt-mstc", "create-tree", "goes home", "examples:"):
        assert words in said.out


# What is refused: map, arguments, tree, and what the line says.

SQUARE = ["..", ".."]
ACROSS = "0,0-0,1 0,0-1,0 "
REFUSED: dict[str, tuple[list[str], list[str], str, str]] = {
    "blocked start": (["..", ".#"], ["--starts", "0,0 2,2"], "", "robot 1: 2,2 is blocked"),
    "start outside": (SQUARE, ["--starts", "0,4"], "", "robot 0: 0,4 lies outside"),
    "negative start": (SQUARE, ["--starts=-1,0"], "", "robot 0: -1,0 lies outside"),
    "no start": (SQUARE, ["--starts", "0;4"], "", "found '0;4', expected ROW,COLUMN"),
    "empty starts": (SQUARE, ["--starts", " "], "", "--starts: found none"),
    "same sub-cell": (SQUARE, ["--starts", "0,1 1,1 0,1"], "", "robots 0 and 2 both start on 0,1"),
    "another part": ([".#."], ["--starts", "0,0 0,4"], "", "robot 1: 0,4 is not connected"),
    "more robots": (SQUARE, ["--robots", "17"], "", "--robots: found 17, expected at most 16"),
    "no robots": (SQUARE, ["--robots", "0"], "", "found '0', expected a whole number from 1"),
    "nobody": (SQUARE, [], "", "--robots: how many?"),
    "both": (SQUARE, ["--robots", "2", "--starts", "0,0"], "", "found 2 with 1 --starts"),
    "algorithm": (SQUARE, ["--robots", "1", "--algorithm", "x"], "", "--algorithm: found 'x'"),
    "tries": (SQUARE, ["--robots", "2", "--tries", "0"], "", "--tries: found '0', expected"),
    "for parents": (
        SQUARE,
        ["--robots", "2", "--r-los", "2"],
        "",
        "--r-los: not for the algorithm create-tree+opt-mstc; expected --algorithm parent-child",
    ),
    "bridges": (
        SQUARE,
        ["--robots", "1", "--all-bridges", "--algorithm", "random+nb-mstc"],
        "",
        "--all-bridges: only create-tree",
    ),
    "bridges of a tree": (
        ["."],
        ["--all-bridges", "--algorithm", "nb-mstc"],
        "# none",
        "--all-bridges: only create-tree",
    ),
    "cycle": (SQUARE, [], ACROSS + "0,1-1,1 1,0-1,1", "line 1: edge 1,0-1,1: closes a cycle"),
    "twice": (SQUARE, [], ACROSS + "\n0,1-0,0", "line 2: edge 0,1-0,0: closes a cycle"),
    "two trees": (SQUARE, [], ACROSS, "2 edges leave coarse cells apart; expected a tree of all 4"),
    "far edge": (SQUARE, [], "0,0-1,1", "edge 0,0-1,1: these are no neighbours"),
    "blocked edge": (["..", ".#"], [], ACROSS + "0,1-1,1", "1,1 is no free coarse cell"),
    "outside edge": (SQUARE, [], "0,0-0,-1", "edge 0,0-0,-1: expected ROW,COLUMN-ROW,COLUMN"),
    "other part": ([".#.."], [], "0,2-0,3", "0,2 is not connected with the robots"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused_in_one_line(name: str, plan: Plan, tmp_path: Path) -> None:
    rows, arguments, tree, words = REFUSED[name]
    grid = write_map(tmp_path / "map.txt", rows)
    if tree:
        (tmp_path / "tree.txt").write_text(tree)
        arguments = ["--starts", "0,0", "--tree", str(tmp_path / "tree.txt"), *arguments]
    said = plan(grid, "--json", *arguments)
    assert (said.code, said.out) == (2, "")
    (line,) = said.err.splitlines()
    assert line.startswith("canopy: ")
    assert words in line


@pytest.mark.parametrize("text", [".", "..\n.#", ".\n.\n."])
def test_maps_without_coarse_cells_are_refused(text: str, plan: Plan, tmp_path: Path) -> None:
    grid = tmp_path / "map.txt"
    grid.write_text(text)
    for arguments in (["--robots", 1], ["--starts", "0,0"]):
        said = plan(grid, *arguments)
        assert said.code == 2
        assert "MAP: no complete coarse cell" in said.err


def test_a_start_in_half_a_coarse_cell_is_refused(plan: Plan, tmp_path: Path) -> None:
    grid = tmp_path / "map.txt"
    grid.write_text("...\n...\n")
    assert "0,2 lies in a coarse cell that is partly blocked" in plan(grid, "--starts", "0,2").err


def test_too_many_bridge_sets_are_refused(plan: Plan, tmp_path: Path) -> None:
    grid = write_map(tmp_path / "map.txt", ["." * 20] * 20)
    said = plan(grid, "--robots", 12, "--all-bridges")
    assert said.code == 2
    assert "expected at most 1000000" in said.err


def test_files_that_cannot_be_written_are_refused_at_once(plan: Plan, tmp_path: Path) -> None:
    grid = write_map(tmp_path / "map.txt", SQUARE)
    before = grid.read_bytes()
    for option in ("--paths", "--picture"):
        for path in (tmp_path, tmp_path / "none" / "out.png", grid):
            said = plan(grid, "--robots", 1, option, path)
            assert said.code == 2
            assert f"{option} {path}" in said.err
    assert "--tree" in plan(grid, "--robots", 1, "--tree", tmp_path / "none").err
    assert plan(grid, "--robots", 1, "--picture", tmp_path / "a.xyz").code == 2
    assert grid.read_bytes() == before


def test_graphs_are_refused(plan: Plan, tmp_path: Path) -> None:
    graph = tmp_path / "map.edges"
    graph.write_text("a b\n")
    assert "is a graph, expected a grid" in plan(graph, "--robots", 1).err
