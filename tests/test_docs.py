"""The documents: links resolve, commands and scenarios parse, the example runs as it is shown.

A fenced block says what it is: ``console`` (commands behind ``$``), ``toml`` (a scenario, or a part
of one), ``python``, ``text``.
"""

import ast
import importlib.util
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from deploy import inprocess
from deploy.cli import _parser
from deploy.judged import judge_journal
from deploy.run_dir import RunDir
from deploy.setting import prepare
from deploy.verdict.result import exit_code
from protocol.scenario import from_tree, load
from tests.conftest import ROOT

PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
EXAMPLE = ROOT / "docs" / "examples" / "own_algorithm.toml"

LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
TEST = re.compile(r"`(tests/\w+\.py)(?:::(\w+))?`")


class Block(NamedTuple):
    """A fenced block of a page."""

    page: str
    kind: str
    text: str


def blocks(kind: str) -> list[Block]:
    found = []
    for page in PAGES:
        for each, text in FENCE.findall(page.read_text(encoding="utf-8")):
            if each == kind:
                found.append(Block(page.name, kind, text))
    return found


def commands() -> Iterator[tuple[str, str]]:
    for block in blocks("console"):
        for line in block.text.splitlines():
            if line.startswith("$ "):
                yield block.page, line.removeprefix("$ ")


def anchors(page: Path) -> set[str]:
    """Return the anchors of the headings of a page, as GitHub makes them."""
    prose = FENCE.sub("", page.read_text(encoding="utf-8"))
    headings = re.findall(r"^#+ (.+)$", prose, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_every_fence_says_what_it_is() -> None:
    known = {"console", "toml", "python", "text"}
    kinds = {
        (page.name, kind)
        for page in PAGES
        for kind, _ in FENCE.findall(page.read_text(encoding="utf-8"))
    }
    assert {kind for _, kind in kinds} <= known, kinds


@pytest.mark.parametrize("name", NAMES)
def test_links_resolve(name: str) -> None:
    page = ROOT / name
    broken = []
    for link in LINK.findall(FENCE.sub("", page.read_text(encoding="utf-8"))):
        if "://" in link:
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            broken.append(link)
    assert broken == []


@pytest.mark.parametrize("name", NAMES)
def test_named_tests_exist(name: str) -> None:
    missing = []
    for path, function in TEST.findall((ROOT / name).read_text(encoding="utf-8")):
        file = ROOT / path
        source = file.read_text(encoding="utf-8") if file.exists() else ""
        if not source or (function and f"def {function}(" not in source):
            missing.append(f"{path}::{function}")
    assert missing == []


@pytest.mark.parametrize(("page", "command"), list(commands()))
def test_commands_parse(page: str, command: str) -> None:
    words = shlex.split(command)
    if words[0] == "make":
        makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
        targets = [word for word in words[1:] if "=" not in word]
        assert all(re.search(rf"^{target}:", makefile, re.MULTILINE) for target in targets)
    elif words[0] == "canopy":
        parsed = _parser().parse_args(words[1:])
        scenario = getattr(parsed, "scenario", None)
        if scenario is not None:
            load(ROOT / scenario, parsed.overrides)
    else:
        assert words[0] == "python"
        assert (ROOT / words[1]).is_file()


@pytest.mark.parametrize("block", blocks("toml"), ids=lambda block: block.page)
def test_scenarios_are_scenarios(block: Block) -> None:
    """A block without ``algorithm`` is a part of a scenario."""
    tree: dict[str, Any] = tomllib.loads(block.text)
    if "algorithm" not in tree:
        rest = {"algorithm": "mr-dfs", "world": {"map": "any.edges"}, "team": {"robots": 4}}
        tree = {**rest, **tree}
    from_tree(tree, block.page)


@pytest.mark.parametrize("block", blocks("python"), ids=lambda block: block.page)
def test_python_parses(block: Block) -> None:
    ast.parse(block.text)


# The example.


def test_the_example_is_shown_as_it_is() -> None:
    page = (ROOT / "docs" / "own_algorithm.md").read_text(encoding="utf-8")
    source = EXAMPLE.with_suffix(".py").read_text(encoding="utf-8")
    code = source.partition('"""\n\n')[2]  # behind the docstring of the module
    assert f"```python\n{code}```" in page
    scenario = EXAMPLE.read_text(encoding="utf-8").partition("\n")[2]  # behind its comment
    assert f"```toml\n{scenario}```" in page


def test_the_example_covers_although_a_robot_is_lost(tmp_path: Path) -> None:
    run_dir = RunDir.create(tmp_path / "run", "example")
    failures = inprocess.run(prepare(load(EXAMPLE)), run_dir, "example", lambda _: None)
    result = judge_journal(run_dir.journal, failures=failures).result
    assert result.errors == []
    assert result.robots_lost == [2]
    assert (result.covered, result.complete) == (60, True)
    assert exit_code(result) == 0


@pytest.mark.slow
def test_the_example_runs_in_both_engines_alike(tmp_path: Path) -> None:
    digests = []
    for engine in ("inprocess", "processes"):
        out = tmp_path / engine
        command = ["-m", "deploy.cli", "run", str(EXAMPLE), "--engine", engine, "--no-picture"]
        done = subprocess.run(
            [sys.executable, *command, "--out", str(out)],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        digests.append(judge_journal(RunDir(out).journal).result.trace_sha256)
    assert digests[0] == digests[1]


# The scenario reference.


def generator() -> Any:
    path = ROOT / "docs" / "generate_scenario.py"
    spec = importlib.util.spec_from_file_location("generate_scenario", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_reference_is_up_to_date() -> None:
    made = generator()
    assert made.PAGE.read_text(encoding="utf-8") == made.page(), "python docs/generate_scenario.py"


def test_a_stale_reference_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made = generator()
    monkeypatch.setattr(made, "PAGE", tmp_path / "scenario.md")
    monkeypatch.setattr(sys, "argv", ["generate_scenario.py", "--check"])
    assert made.main() == 1
    assert "python docs/generate_scenario.py" in capsys.readouterr().err
    monkeypatch.setattr(sys, "argv", ["generate_scenario.py"])
    assert made.main() == 0
    monkeypatch.setattr(sys, "argv", ["generate_scenario.py", "--check"])
    assert made.main() == 0


def test_the_picture_is_small() -> None:
    assert (ROOT / "docs" / "demo.png").stat().st_size < 400_000
