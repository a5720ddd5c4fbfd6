"""The options of connected coverage, and the plan that they ask for.

A plan takes long to find. It is found once, before the run, and stands in the options beside what was
asked for: robots only carry it out, and a replay does not search again.
"""

from typing import Annotated, Literal

from msgspec import Meta, Struct
from msgspec.structs import replace

from agents.algorithms.connected_rule import Variant, checked_splits
from agents.algorithms.connected_splits import choose_splits
from agents.planning.connected_best import plan_connected
from agents.planning.rooted_tree import order_of, reordered, spanning_tree
from protocol.graph import PortGraph


class Options(Struct, frozen=True, forbid_unknown_fields=True):
    """Options of NCOCTA and COCTA.

    Attributes:
        splits: the split heights: by the paper's formula, the best of those tried, or as given.
        tree: what to do about a graph that is no tree: refuse it, or use a spanning tree of it.
        heights: the plan: what the split heights come to; ``None``: it is not made yet.
    """

    splits: Literal["paper", "best"] | tuple[int, ...] = "paper"
    tree: Literal["given", "breadth-first", "depth-first"] = "given"
    heights: tuple[int, ...] | None = None


class BestOptions(Options, frozen=True, forbid_unknown_fields=True):
    """Options of COCTA by a better plan, of which load and order are parts too.

    Attributes:
        splits: ``"best"``: the whole plan is searched for; or split heights, with load and order as
            given.
        effort: how many ticks are played in search of a plan.
        load: as of `connected_rule.SparingTick`; 0: none.
        order: siblings in the order in which they are explored, where that is not the order of ports.
    """

    splits: Literal["best"] | tuple[int, ...] = "best"
    effort: Annotated[int, Meta(ge=1)] = 20_000
    load: Annotated[int, Meta(ge=0)] = 0
    order: tuple[int, ...] = ()


AnyOptions = Options | BestOptions


def planned(
    graph: PortGraph, root: int, team_size: int, options: AnyOptions, variant: Variant
) -> AnyOptions:
    """Return options with the plan filled in; one that is there already is kept.

    Raises:
        ValueError: If the split heights, the load or the order that are given do not do.
    """
    tree = spanning_tree(graph, root, deep=options.tree == "depth-first").tree
    if isinstance(options, BestOptions):
        reordered(tree, options.order)
    if options.heights is not None:
        return replace(options, heights=checked_splits(tree, options.heights))
    if isinstance(options, BestOptions) and options.splits == "best":
        if options.load or options.order:
            raise ValueError("a load or an order is given without split heights; expected both")
        plan = plan_connected(tree, team_size, options.effort)
        order = order_of(plan.tree, tree)
        return replace(options, heights=plan.splits, load=plan.load or 0, order=order)
    return replace(options, heights=choose_splits(tree, team_size, variant, options.splits))
