"""Write docs/scenario.md, the scenario reference, from the Structs of protocol/scenario.py.

    python docs/generate_scenario.py            rewrite the reference
    python docs/generate_scenario.py --check    exit 1 if it is not up to date

Names, types, bounds and defaults come from the Structs, the meaning of a field from the `#:`
comment that stands behind it or on the lines below it.
"""

import argparse
import ast
import inspect
import sys
from collections.abc import Iterator
from pathlib import Path

import msgspec
import msgspec.inspect as types

from protocol import scenario

PAGE = Path(__file__).with_name("scenario.md")

HEAD = """\
<!-- Written by docs/generate_scenario.py from protocol/scenario.py; do not edit. -->

# The scenario reference

A scenario is one TOML file that says what is played. The smallest one:

```toml
algorithm = "mr-dfs"

[world]
map = "my_cave.edges"

[team]
robots = 4
```

Some algorithms play on graphs (`mr-dfs`, `ncocta`, `cocta`, `cocta-best`), others on grids (`mstc`,
`ormstc`, `parent-child`); those of users on both. On a grid a sub-cell has
the size of a robot, a coarse cell is two by two of them, and `[0, 0]` is the sub-cell at the top left.

Times are virtual: ticks under the lockstep clock, time units under the event clock. An unknown
field, a wrong type or a value out of range is refused in one line before anything starts.

`canopy run FILE --set KEY=VALUE` overrides any field, for example `--set team.robots=16`. The value
is read as TOML, and as plain text if it is none. Paths *in the file* are relative to the file; a
path given by `--set` is relative to the current folder.

`algorithm_options` of `mr-dfs`:

- `variant`: `"corrected"` (default) or `"paper"`, as printed there.
- `version`: `"graph"` (default) or `"tree"`, which is for trees only.

`algorithm_options` of `mstc`, whose robots have the map and execute a plan:

- `tree`: `"create-tree"` (default), `"random"`, `"depth-first"`, `"breadth-first"` or `"minimum"`.
- `split`: who covers what of the tour around it, `"opt"` (default), `"b"` or `"nb"`.
- `distance` (`"manhattan"`, `"euclid"`, `"shortest-path"`) and `alpha` (2): of Create_Tree.
- `home`: whether robots go back to where they started (default `false`).

`algorithm_options` of `ormstc`:

- `variant`: `"corrected"` (default), `"paper"`, or `"helping"`: robots that have nothing left to do
  take a share of what others have.
- `conflict`: who wins a cell that several claim at once, the highest `"id"` (default) or who has the
  `"fewest-cells"`.
- `lazy`: whether cells that a robot had covered completely before it died are left alone (default
  `true`).
- `scan`: `"counter-clockwise"` (default) or `"clockwise"`, which is for one robot only.
- `patience`: where the radio is not reliable and global, how old the last sign of life of a robot may
  be whose answer another one awaits before it enters a cell, time units.

`algorithm_options` of `ncocta`, `cocta` and `cocta-best`, whose robots have the map of a tree:

- `splits`: the heights at which the team splits, as a list; `"paper"` (default), by its formula; or
  `"best"`, the fastest of those that the team is large enough for, as far as they are tried. With
  `cocta-best` it is `"best"` (default) or a list. A team that is too small for any does not split.
  One that is too small for a list may come to where no rule moves it: it gathers, and does not
  split again.
- `tree`: `"given"` (default) refuses a graph with cycles, `"breadth-first"` and `"depth-first"` cover
  it along a spanning tree.
- `effort`: of `cocta-best`, how many ticks are played in search of a plan (20,000).
- `load` and `order`: of `cocta-best`, given with a list of `splits`: how many robots a subtree takes,
  in sixteenths of its unfinished vertices (0: as many as it has), and the siblings that are explored
  in another order than that of their ports.
- `heights`: what `splits` come to; filled in before the run.
"""

GENERATE = """\
### `generate`

A world without a file, drawn from the seed; `kind` names the generator:

```toml
[world]
generate = { kind = "cave", vertices = 200, loops = 12 }
```
"""

TABLE = "| field | type | default | meaning |\n|---|---|---|---|\n"


def meanings(kind: type) -> dict[str, str]:
    """Return the `#:` comment of each field of a Struct."""
    source = inspect.getsource(kind)
    lines = source.splitlines()
    body = ast.parse(source).body[0]
    assert isinstance(body, ast.ClassDef)
    found: dict[str, str] = {}
    for node in body.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            last = node.end_lineno or node.lineno
            words = [lines[last - 1].partition("#:")[2]]
            for line in lines[last:]:
                if not line.strip().startswith("#:"):
                    break
                words.append(line.partition("#:")[2])
            meaning = " ".join(word.strip() for word in words).strip()
            found[node.target.id] = meaning.replace("``", "`")
            if not found[node.target.id]:
                raise SystemExit(f"{kind.__name__}.{node.target.id} has no `#:` comment")
    return found


def in_words(kind: types.Type) -> str:
    """Say a type in words."""
    match kind:
        case types.StrType():
            return "text"
        case types.BoolType():
            return "true or false"
        case types.IntType() | types.FloatType():
            return _number(kind)
        case types.LiteralType(values=values):
            return " or ".join(f'`"{value}"`' for value in values)
        case types.VarTupleType(item_type=item):
            return "list of tables" if in_words(item) == "table" else f"list: {in_words(item)} each"
        case types.TupleType(item_types=(types.IntType(), types.IntType())):
            return "pair of whole numbers"
        case types.DictType(value_type=value):
            return f"table: {in_words(value)} each"
        case types.UnionType(types=options):
            # A list last: what its items are is then not taken for further options.
            options = sorted(options, key=lambda each: isinstance(each, types.VarTupleType))
            given = [in_words(each) for each in options if not isinstance(each, types.NoneType)]
            if "number" in given and "whole number" in given:
                given.remove("whole number")
            return " or ".join(dict.fromkeys(given))
        case types.StructType():
            return "table"
        case _:
            raise SystemExit(f"no words for the type {kind}")


def _number(kind: types.IntType | types.FloatType) -> str:
    name = "whole number" if isinstance(kind, types.IntType) else "number"
    bounds = []
    if kind.gt is not None:
        bounds.append(f"above {kind.gt:g}")
    if kind.ge is not None:
        bounds.append(f"from {kind.ge:g}")
    if kind.lt is not None:
        bounds.append(f"below {kind.lt:g}")
    if kind.le is not None:
        bounds.append(f"to {kind.le:g}")
    return " ".join([name, *bounds])


def _default(field: types.Field) -> str:
    if field.required:
        return "required"
    if field.default is msgspec.NODEFAULT or field.default in (None, "", ()):
        return ""
    if isinstance(field.default, msgspec.Struct):
        return "see below"
    return f"`{msgspec.json.encode(field.default).decode()}`"


def table(kind: type) -> str:
    """Return the table of one Struct."""
    info = types.type_info(kind)
    assert isinstance(info, types.StructType)
    meaning = meanings(kind)
    rows = [
        f"| `{field.name}` | {in_words(field.type)} | {_default(field)} | {meaning[field.name]} |\n"
        for field in info.fields
    ]
    return TABLE + "".join(rows)


def parts() -> Iterator[str]:
    """Yield the page, part by part."""
    yield HEAD
    yield f"## Top level\n\n{table(scenario.Scenario)}"
    info = types.type_info(scenario.Scenario)
    assert isinstance(info, types.StructType)
    for field in info.fields:
        if isinstance(field.type, types.StructType):
            kind = field.type.cls
            yield f"## `[{field.name}]`\n\n{_summary(kind)}\n\n{table(kind)}"
            if kind is scenario.WorldSection:
                yield from generators()
    yield f"## `[[faults]]`\n\n{_summary(scenario.Fault)}\n\n{table(scenario.Fault)}"


def generators() -> Iterator[str]:
    """Yield the section on generators."""
    yield GENERATE
    for kind in scenario.Generator.__args__:
        info = types.type_info(kind)
        assert isinstance(info, types.StructType)
        yield f'#### `kind = "{info.tag}"`\n\n{_summary(kind)}\n\n{table(kind)}'


def _summary(kind: type) -> str:
    return (inspect.getdoc(kind) or "").replace("``", "`")


def page() -> str:
    """Return the whole page."""
    return "\n".join(parts())


def main() -> int:
    """Write the page, or check it."""
    parser = argparse.ArgumentParser(description="Write the scenario reference.")
    parser.add_argument("--check", action="store_true", help="only say whether it is up to date")
    if not parser.parse_args().check:
        PAGE.write_text(page(), encoding="utf-8")
        return 0
    if PAGE.exists() and PAGE.read_text(encoding="utf-8") == page():
        return 0
    print(f"{PAGE}: not up to date; run `python docs/generate_scenario.py`", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
