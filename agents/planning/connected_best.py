"""Better plans than COCTA's for a connected team on a known tree: child order, splits and a load.

The team plays such a plan by the rule that it has anyway, `connected_rule.next_moves`, from the root to
the end. What may differ from COCTA: the order in which children are explored, the split heights, and
the load, which limits how many robots go into a subtree (`connected_rule.SparingTick`).

COCTA loses time in three ways: more robots stand guard than need be; they wait, deep in the tree, for
others to finish; and a deep branch may be entered early, so that the team comes back from it and then
goes down again. The load is meant against the first two; against the third, children are explored from
the shallowest to the deepest. From there on the planner climbs: it changes the plan at random places
and keeps what is no slower.

Claims: the plan is connected at every tick and complete, as the rule is connected from any
configuration and each plan that is kept was played to its end. It is never slower than COCTA with the
paper's splits, nor with those that `choose_splits` finds best with the same effort. The same tree, team
and effort give the same plan.

After losses a team goes on without the load, by plain COCTA: only the run from the root was played.
"""

from collections.abc import Iterator
from typing import NamedTuple

from agents.algorithms.connected_rule import Team, ticks_taken, trails
from agents.algorithms.connected_splits import choose_splits, paper_splits
from agents.planning.optimal_connected import lower_bound
from agents.planning.rooted_tree import RootedTree
from protocol.seeds import Stream, spawn

FIRST_LOADS = (9, 12, 6)
"""Loads to begin with, the most promising first."""

FULL_LOAD = 16
"""One robot for each unfinished vertex, as with COCTA."""

VERTICES_A_TICK = 32
"""To set up so many vertices for a run costs about as much as to play one tick."""


class ConnectedPlan(NamedTuple):
    """How a connected team covers a tree.

    Attributes:
        tree: with the children in the order in which they are explored.
        team_size: number of robots.
        splits: the split heights, descending.
        load: see `connected_rule.SparingTick`; None: plain COCTA.
        ticks: how long it takes.
    """

    tree: RootedTree
    team_size: int
    splits: tuple[int, ...]
    load: int | None
    ticks: int

    def team(self) -> Team:
        """Return the team at the root, ready to go."""
        return Team(self.tree, self.team_size, "cocta", self.splits, load=self.load)


def plan_connected(tree: RootedTree, team_size: int, effort: int = 100_000) -> ConnectedPlan:
    """Return a fast plan for a team whose robots all start at the root.

    Args:
        tree: what they are to cover; its order of children is where the search starts.
        team_size: number of robots.
        effort: how many ticks may be played to find COCTA's best splits, and as many again to
            find something better.
    """
    return improved(cocta_plan(tree, team_size, effort), effort)


def cocta_plan(tree: RootedTree, team_size: int, effort: int) -> ConnectedPlan:
    """Return plain COCTA with the best splits."""
    splits = choose_splits(tree, team_size, "cocta", "best", effort)
    ticks = ticks_taken(Team(tree, team_size, "cocta", splits), 2 * len(tree))
    assert ticks is not None, "a team that is large enough for its splits comes to an end"
    return ConnectedPlan(tree, team_size, splits, None, ticks)


def improved(plan: ConnectedPlan, effort: int) -> ConnectedPlan:
    """Return a plan that is no slower, by playing others for so many ticks."""
    bound = lower_bound(plan.tree, plan.team_size)
    others = first_tries(plan)
    rng = spawn(len(plan.tree), "connected plans")
    while effort > 0 and plan.ticks > bound:
        other = next(others, None) or changed(plan, rng)
        limit = min(plan.ticks, effort)
        ticks = ticks_taken(other.team(), limit)
        if ticks is not None:
            plan = other._replace(ticks=ticks)
        effort -= limit + len(plan.tree) // VERTICES_A_TICK
    return plan


def first_tries(plan: ConnectedPlan) -> Iterator[ConnectedPlan]:
    """Yield some plans that are often good, with the shallowest children first."""
    tree = shallow_first(plan.tree)
    printed = paper_splits(tree.arity, tree.height, plan.team_size)
    lower = tuple(split - 1 for split in printed if split > 1)
    for load in FIRST_LOADS:
        for splits in dict.fromkeys((plan.splits, lower, printed, ())):
            yield plan._replace(tree=tree, splits=splits, load=load)


def shallow_first(tree: RootedTree) -> RootedTree:
    """Return a tree with the children of each vertex from the shallowest to the deepest."""
    below = trails(tree)
    return RootedTree(
        [sorted(children, key=below.__getitem__) for children in tree.children], tree.root
    )


def changed(plan: ConnectedPlan, rng: Stream) -> ConnectedPlan:
    """Return a plan with another load, split height or order of children."""
    tree = plan.tree
    draw = rng.random()
    if draw < 0.2:
        return plan._replace(load=rng.randrange(2, FULL_LOAD + 1))
    if draw < 0.6 and tree.height:
        load = plan.load or FULL_LOAD
        return plan._replace(splits=changed_splits(plan.splits, tree.height, rng), load=load)
    return plan._replace(tree=with_child_moved(tree, rng))


def changed_splits(splits: tuple[int, ...], height: int, rng: Stream) -> tuple[int, ...]:
    """Return splits with all of them one up or down, or with one more or one less."""
    by = rng.choice((-1, 0, 0, 1))
    if by:
        return tuple(split + by for split in splits if 1 <= split + by <= height)
    other = set(splits) ^ {rng.randrange(1, height + 1)}
    return tuple(sorted(other, reverse=True))


def with_child_moved(tree: RootedTree, rng: Stream) -> RootedTree:
    """Return a tree in which one child of one vertex is at another place among its siblings."""
    branching = [vertex for vertex, children in enumerate(tree.children) if len(children) > 1]
    if not branching:
        return tree
    vertex = rng.choice(branching)
    children = [list(siblings) for siblings in tree.children]
    siblings = children[vertex]
    child = siblings.pop(rng.randrange(len(siblings)))
    siblings.insert(rng.randrange(len(siblings) + 1), child)
    return RootedTree(children, tree.root)
