"""The algorithms that a scenario can name, and those of users.

A scenario says ``algorithm = "mr-dfs"`` or ``algorithm = "package.module:function"``. A function of a
user takes a `Body`, or a Body and its options: the Struct that annotates its second parameter, which
the scenario's ``[algorithm_options]`` fill.
"""

import inspect
from collections.abc import Coroutine
from importlib import import_module
from typing import Any, get_type_hints

import msgspec
from msgspec import Struct

from agents.algorithms import connected, mr_dfs, mstc, ormstc, parent_child
from agents.body import Algorithm, Body
from protocol.errors import ScenarioError
from protocol.messages import AnyRequest, Sight, Stop
from protocol.scenario import in_words
from protocol.section import OptionValue

ALGORITHMS: dict[str, Any] = {
    "cocta": connected.cocta,
    "cocta-best": connected.cocta_best,
    "mr-dfs": mr_dfs.mr_dfs,
    "mstc": mstc.mstc,
    "ncocta": connected.ncocta,
    "ormstc": ormstc.ormstc,
    "parent-child": parent_child.parent_child,
}
"""The algorithms of Canopy by name."""

TAG_BYTES = {"mr-dfs": mr_dfs.tag_bytes}
"""The size of a tag, for those that use devices: of degree, team size and tree version."""

GRID_ALGORITHMS = frozenset({"mstc", "ormstc", "parent-child"})
"""Those that play on grids; the others of Canopy play on graphs, those of users on both."""

_CONNECTED = {
    "radio.reach": "adjacent",
    "radio.relay": True,
    "radio.heartbeat": "reach",
    "sensing.map": True,
}

ASSUMED: dict[str, dict[str, Any]] = {
    "cocta": _CONNECTED,
    "cocta-best": _CONNECTED,
    "mstc": {"radio.reach": "global", "sensing.mode": "ahead", "sensing.map": True},
    "ncocta": _CONNECTED,
    "ormstc": {"radio.reach": "global", "sensing.mode": "ahead"},
    "parent-child": {
        "team.parents": 1,
        "radio.reach": "radius",
        "radio.line_of_sight": True,
        "sensing.mode": "ahead",
        "sensing.map": True,
    },
}
"""What an algorithm's paper assumes, for fields that a scenario leaves out."""

CONNECTED_ALGORITHMS = frozenset({"cocta", "cocta-best", "ncocta"})
"""Those whose team stays connected by radio on a known tree."""

CELL_ALGORITHMS = frozenset({"mstc", "ormstc"})
"""Those that cover complete coarse cells only."""

PARENT_ALGORITHMS = frozenset({"parent-child"})
"""Those of parents that lead children in line of sight; all start together unless told otherwise."""


def plain_name(name: str) -> str:
    """Return the name of an algorithm as the tables here spell it."""
    return name.lower().replace("_", "-")


def algorithm_of(name: str, options: dict[str, OptionValue]) -> Algorithm:
    """Return the algorithm called ``name`` with its options filled in.

    Raises:
        ScenarioError: If there is no such algorithm, or the options are not its own.
    """
    function: Any = ALGORITHMS.get(plain_name(name)) or _of_user(name)
    if not inspect.iscoroutinefunction(function):
        raise ScenarioError(f"field `algorithm`: {name!r} is no `async def` function")
    parameters = list(inspect.signature(function).parameters.values())
    if len(parameters) not in (1, 2):
        raise ScenarioError(
            f"field `algorithm`: {name!r} takes {len(parameters)} parameters; "
            "expected a body, or a body and its options"
        )
    if len(parameters) == 1:
        if options:
            raise ScenarioError(f"field `algorithm_options`: {name!r} takes none, found {options}")
        plain: Algorithm = function
        return plain
    kind: Any = get_type_hints(function).get(parameters[1].name, dict)
    try:
        filled = msgspec.convert(options, kind)
    except msgspec.ValidationError as error:
        raise ScenarioError(in_words(error, options, kind, "algorithm_options")) from None

    def bound(body: Body) -> Coroutine[AnyRequest, Sight, Stop | None]:
        coroutine: Coroutine[AnyRequest, Sight, Stop | None] = function(body, filled)
        return coroutine

    bound.__qualname__ = function.__qualname__
    return bound


def _of_user(name: str) -> Any:  # noqa: ANN401  whatever a user's module holds
    module_name, colon, function_name = name.partition(":")
    if not (module_name and colon and function_name):
        known = ", ".join(sorted(ALGORITHMS))
        raise ScenarioError(
            f"field `algorithm`: found {name!r}, expected {known}, or package.module:function"
        )
    try:
        return getattr(import_module(module_name), function_name)
    except ImportError as error:
        raise ScenarioError(f"field `algorithm`: cannot import {module_name!r}: {error}") from None
    except AttributeError:
        raise ScenarioError(
            f"field `algorithm`: module {module_name!r} has no {function_name!r}"
        ) from None


def default_options(name: str) -> Struct | None:
    """Return the options of an algorithm of Canopy as they are by default; ``None``: it has none."""
    hints = get_type_hints(ALGORITHMS[name])
    kind = hints.get("options")
    return None if kind is None else kind()


def tag_bytes_max(name: str, options: dict[str, OptionValue], degree: int, team_size: int) -> int:
    """Return the size of the largest tag that an algorithm writes at a vertex of ``degree``.

    0 for an algorithm of a user, whose tags we cannot know.
    """
    sizes = TAG_BYTES.get(plain_name(name))
    return 0 if sizes is None else sizes(degree, team_size, tree=options.get("version") == "tree")


def tag_format(name: str, options: dict[str, OptionValue], team_size: int) -> str:
    """Name the format of an algorithm's tags: only a run of the same format can read them."""
    known = plain_name(name)
    if known not in TAG_BYTES:
        return name
    return f"{known}, {options.get('version', 'graph')} version, {team_size} robots"
