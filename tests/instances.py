"""Reader of the small instances with exact expected values, ``spec/instances/*.txt``."""

from ast import literal_eval
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from protocol.grid import Cell

Kill = tuple[int, int, str]
"""Tick, robot, and ``pre`` or ``mid``."""


@dataclass
class Instance:
    """One file.

    Attributes:
        kind: what it is about: ``online``, ``scan``, ``tour``, ``create``, ``trees``, ``los``.
        rows: the map, ``.`` for a free coarse cell and ``#`` for a blocked one.
        robots: their sub-cells, in the order of their ids.
        tree: edges between coarse cells.
        kills: who dies when.
        rules: the sets of rules that the expected values are given for.
        conflict: who gets a cell that several claim, ``id`` or ``few``.
        expect: the expected values, by their whole key (``fixed.covered``).
        others: the words behind any other keyword (``metrics``, ``radii``).
    """

    kind: str = ""
    rows: list[str] = field(default_factory=list)
    robots: list[Cell] = field(default_factory=list)
    tree: list[tuple[Cell, Cell]] = field(default_factory=list)
    kills: list[Kill] = field(default_factory=list)
    rules: list[str] = field(default_factory=list)
    conflict: str = "id"
    expect: dict[str, object] = field(default_factory=dict)
    others: dict[str, list[str]] = field(default_factory=dict)

    @property
    def free(self) -> set[Cell]:
        """The free coarse cells."""
        rows = enumerate(self.rows)
        return {(r, c) for r, row in rows for c, mark in enumerate(row) if mark == "."}

    def expected(self, of: str) -> dict[str, object]:
        """Return the values whose key begins with ``of.``, by the rest of their key."""
        return {
            key.removeprefix(of + "."): value
            for key, value in self.expect.items()
            if key.startswith(of + ".")
        }


def read_instance(path: Path) -> Instance:
    """Read a file; raises ValueError where a line is no part of the format."""
    instance = Instance()
    lines = _lines(path.read_text(encoding="utf-8"))
    for line in lines:
        keyword, *words = line.split()
        match keyword:
            case "kind":
                (instance.kind,) = words
            case "map":
                instance.rows = _map(lines)
            case "robots":
                numbers = [int(word) for word in words]
                instance.robots = list(zip(numbers[::2], numbers[1::2], strict=True))
            case "tree":
                instance.tree = [_edge(word) for word in words]
            case "kills":
                instance.kills = [_kill(word) for word in words]
            case "rules":
                instance.rules = words
            case "conflict":
                (instance.conflict,) = words
            case "expect":
                _, key, value = line.split(maxsplit=2)
                instance.expect[key] = _value(value)
            case _:
                instance.others[keyword] = words
    return instance


def _lines(text: str) -> Iterator[str]:
    """Yield the lines without their comments; of the empty ones, only that which ends the map."""
    in_map = False
    for whole in text.splitlines():
        line = whole.partition(";")[0].strip()
        # A line with nothing but a comment is no empty line, so it does not end the map.
        if line or (in_map and not whole.strip()):
            yield line
        in_map = line == "map" or (in_map and bool(whole.strip()))


def _map(lines: Iterator[str]) -> list[str]:
    rows: list[str] = []
    for line in lines:
        if not line:
            break
        if set(line) - set(".#") or (rows and len(line) != len(rows[0])):
            raise ValueError(f"no row of the map: {line!r}")
        rows.append(line)
    return rows


def _edge(word: str) -> tuple[Cell, Cell]:
    one, other = (tuple(int(number) for number in end.split(",")) for end in word.split("-"))
    return (one[0], one[1]), (other[0], other[1])


def _kill(word: str) -> Kill:
    tick, robot, phase = word.split(":")
    if phase not in {"pre", "mid"}:
        raise ValueError(f"no phase of a tick: {word!r}")
    return int(tick), int(robot), phase


def _value(text: str) -> object:
    """Return a Python value, or the text where it is none (a map in one line)."""
    try:
        return literal_eval(text)
    except (SyntaxError, ValueError):
        return text
