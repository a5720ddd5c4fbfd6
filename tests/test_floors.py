"""The floors: who may import whom, and what an algorithm may not do.

    protocol                           floor 0
    bookkeeping  world_server  agents  floor 1: never import each other
    deploy                             floor 2
    experiments  benchmarks  tests     floor 3

Each rule is a function of a file's path and source, so that it can be proven to bite on small
offenders.
"""

import ast
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("protocol", "bookkeeping", "world_server", "agents", "deploy")

FLOORS = {
    "protocol": 0,
    "bookkeeping": 1,
    "world_server": 1,
    "agents": 1,
    "deploy": 2,
    "experiments": 3,
    "benchmarks": 3,
    "tests": 3,
}
LINK = "protocol/zenoh_link.py"
SHELLS = ("bookkeeping/node.py", "world_server/node.py", "agents/node.py")
HEAVY = ("matplotlib", "rich", "networkx", "numpy")
"""What no robot process loads: a team is many processes, and each would pay for it."""


class Import(NamedTuple):
    """One imported module, by its full dotted name."""

    line: int
    module: str
    relative: bool = False

    @property
    def top(self) -> str:
        return self.module.partition(".")[0]


def imports_of(source: str) -> Iterator[Import]:
    """Yield every import, wherever it stands, also those by a literal name at run time."""
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Import(names=names):
                for alias in names:
                    yield Import(node.lineno, alias.name)
            case ast.ImportFrom(module=module, level=level):
                yield Import(node.lineno, module or "", relative=level > 0)
            case ast.Call(
                func=ast.Name(id="__import__" | "import_module")
                | ast.Attribute(attr="__import__" | "import_module"),
                args=[ast.Constant(value=str(module)), *_],
            ):
                yield Import(node.lineno, module.lstrip("."), relative=module.startswith("."))
            case _:
                pass


def floor_faults(path: str, source: str) -> list[str]:
    """Find imports that go up, or sideways on floor 1."""
    home = path.partition("/")[0]
    return [
        f"{path}:{found.line}: {home} must not import {found.module}"
        for found in imports_of(source)
        if found.top in FLOORS
        and not found.relative
        and found.top != home
        and FLOORS[found.top] >= FLOORS[home]
    ]


def zenoh_faults(path: str, source: str) -> list[str]:
    """Find imports of zenoh outside the one door to it."""
    return [
        f"{path}:{found.line}: only {LINK} imports zenoh"
        for found in imports_of(source)
        if found.top == "zenoh" and path != LINK
    ]


def asyncio_faults(path: str, source: str) -> list[str]:
    """Find imports of asyncio outside the shells, the link and deploy."""
    if path in SHELLS or path == LINK or path.startswith("deploy/"):
        return []
    return [
        f"{path}:{found.line}: only shells (node.py), {LINK} and deploy/ import asyncio"
        for found in imports_of(source)
        if found.top == "asyncio"
    ]


def relative_faults(path: str, source: str) -> list[str]:
    """Find relative imports."""
    return [
        f"{path}:{found.line}: relative import" for found in imports_of(source) if found.relative
    ]


def finally_faults(path: str, source: str) -> list[str]:
    """Find awaits on the way out of an algorithm: a robot that was killed never resumes."""
    if not path.startswith("agents/algorithms/"):
        return []
    faults = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Try | ast.TryStar):
            faults += [
                f"{path}:{line}: await in finally"
                for statement in node.finalbody
                for line in await_lines(statement)
            ]
        elif isinstance(node, ast.AsyncWith):
            faults.append(f"{path}:{node.lineno}: async with awaits on its way out, as in finally")
    return faults


def await_lines(node: ast.AST) -> Iterator[int]:
    """Yield the lines that await, leaving out functions that are only defined here."""
    match node:
        case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.Lambda():
            return
        case ast.Await() | ast.AsyncFor():
            yield node.lineno
        case ast.comprehension(is_async=1, iter=iterated):
            yield iterated.lineno
        case _:
            pass
    for child in ast.iter_child_nodes(node):
        yield from await_lines(child)


def heavy_imports(modules: list[str], search: Path) -> set[str]:
    """Import ``modules`` in a fresh process and tell which heavy packages came with them."""
    program = (
        "import importlib, sys\n"
        f"for module in {modules!r}: importlib.import_module(module)\n"
        "print(*{name.partition('.')[0] for name in sys.modules})\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ | {"PYTHONPATH": str(search)},
        cwd=search,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    return set(HEAVY) & set(result.stdout.split())


# The repository obeys.

RULES = (floor_faults, zenoh_faults, asyncio_faults, relative_faults, finally_faults)
Rule = Callable[[str, str], list[str]]


def files() -> list[Path]:
    return sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))


def test_there_are_files_to_look_at():
    assert ROOT / "protocol" / "__init__.py" in files()


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_every_file_obeys(rule: Rule):
    faults = [
        fault
        for path in files()
        for fault in rule(path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8"))
    ]
    assert not faults, "\n".join(faults)


def test_robot_process_stays_light():
    if not (ROOT / "agents" / "node.py").exists():
        pytest.skip("no agents/node.py yet")
    assert heavy_imports(["agents.node"], ROOT) == set()


def test_algorithms_stay_light():
    modules = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for path in sorted((ROOT / "agents" / "algorithms").rglob("*.py"))
    ]
    if not modules:
        pytest.skip("no algorithms yet")
    assert heavy_imports(modules, ROOT) == set()


# Each rule bites, and lets pass what it should.


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("protocol/keys.py", "import agents"),
        ("protocol/keys.py", "from world_server.world import World"),
        ("protocol/keys.py", "def late():\n    import deploy.cli"),
        ("bookkeeping/device.py", "from agents import body"),
        ("world_server/world.py", "import bookkeeping.device as device"),
        ("agents/body.py", "import json, world_server"),
        ("agents/body.py", "from deploy import supervisor"),
        ("agents/body.py", "import importlib\nimportlib.import_module('bookkeeping.store')"),
        ("agents/body.py", "if TYPE_CHECKING:\n    from world_server import clock"),
        ("deploy/cli.py", "from tests.conftest import shared"),
        ("deploy/cli.py", "__import__('experiments')"),
    ],
)
def test_floor_rule_bites(path, source):
    assert len(floor_faults(path, source)) == 1


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("protocol/keys.py", "from protocol import ids"),
        ("agents/body.py", "import protocol.messages, agents.registry"),
        ("deploy/cli.py", "from world_server import world\nfrom agents import body"),
        ("protocol/keys.py", "import deployment, agentsmith"),
        ("protocol/keys.py", "'import agents'  # import agents"),
    ],
)
def test_floor_rule_lets_pass(path, source):
    assert floor_faults(path, source) == []


@pytest.mark.parametrize("path", ["protocol/keys.py", "agents/node.py", "deploy/processes.py"])
@pytest.mark.parametrize(
    "source", ["import zenoh", "from zenoh import Session", "def f():\n    import zenoh.ext"]
)
def test_zenoh_rule_bites(path, source):
    assert len(zenoh_faults(path, source)) == 1


def test_zenoh_rule_lets_the_link_pass():
    assert zenoh_faults("protocol/zenoh_link.py", "import zenoh") == []
    assert zenoh_faults("deploy/cli.py", "from protocol import zenoh_link") == []


@pytest.mark.parametrize(
    "path",
    ["protocol/codec.py", "agents/body.py", "agents/algorithms/node.py", "world_server/world.py"],
)
@pytest.mark.parametrize(
    "source", ["import asyncio", "from asyncio import sleep", "import asyncio.queues"]
)
def test_asyncio_rule_bites(path, source):
    assert len(asyncio_faults(path, source)) == 1


@pytest.mark.parametrize("path", [*SHELLS, LINK, "deploy/supervisor.py", "deploy/view/server.py"])
def test_asyncio_rule_lets_shells_pass(path):
    assert asyncio_faults(path, "import asyncio") == []


@pytest.mark.parametrize(
    "source",
    ["from . import ids", "from .ids import RobotId", "from ..protocol import ids"],
)
def test_relative_rule_bites(source):
    assert len(relative_faults("protocol/keys.py", source)) == 1


def test_relative_rule_lets_pass():
    assert relative_faults("protocol/keys.py", "from protocol.ids import RobotId") == []


@pytest.mark.parametrize(
    "ending",
    [
        "try: pass\n    finally: await body.stop()",
        "try: pass\n    finally:\n        if body: x = [await body.look()]",
        "try: pass\n    finally:\n        async for _ in body: pass",
        "try: pass\n    finally: x = [_ async for _ in body]",
        "try: pass\n    finally:\n        for _ in (): await body.look()",
        "try: pass\n    except* ValueError: pass\n    finally: await body.stop()",
        "async with body: pass",
    ],
)
def test_finally_rule_bites(ending):
    source = f"async def walk(body):\n    {ending}\n"
    assert len(finally_faults("agents/algorithms/mine.py", source)) == 1
    assert len(finally_faults("agents/algorithms/deep/mine.py", source)) == 1
    assert finally_faults("deploy/supervisor.py", source) == []


@pytest.mark.parametrize(
    "ending",
    [
        "try: await body.look()\n    finally: print()",
        "try: await body.look()\n    except ValueError: await body.look()",
        "try: pass\n    finally:\n        async def later(): await body.look()",
        "await body.look()",
    ],
)
def test_finally_rule_lets_pass(ending):
    source = f"async def walk(body):\n    {ending}\n"
    assert finally_faults("agents/algorithms/mine.py", source) == []


def test_light_rule_bites(tmp_path: Path):
    (tmp_path / "numpy.py").write_text("")
    (tmp_path / "direct.py").write_text("import numpy")
    (tmp_path / "indirect.py").write_text("import json, direct")
    (tmp_path / "light.py").write_text("import json")
    assert heavy_imports(["indirect"], tmp_path) == {"numpy"}
    assert heavy_imports(["light", "direct"], tmp_path) == {"numpy"}
    assert heavy_imports(["light"], tmp_path) == set()
