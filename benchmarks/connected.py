"""The rule of connected coverage against one that looks at every vertex in every tick.

    python -m benchmarks.connected [--repeats 5]

Perfect binary trees, 60 robots, COCTA. Processor time; the variants one after another in each repeat,
over the same ticks from the middle of the run, with the same moves; medians.
"""

import argparse
import time
from collections.abc import Callable
from math import inf
from statistics import median

from agents.algorithms.connected_rule import (
    Moves,
    Team,
    next_moves,
    ticks_taken,
)
from agents.algorithms.connected_splits import (
    paper_splits,
)
from agents.planning.rooted_tree import (
    RootedTree,
    perfect_tree,
)
from benchmarks.table import print_table

ROBOTS = 60
HEIGHTS = (9, 12, 15)


class EveryVertex:
    """COCTA, straight from its rules: in each tick all is counted anew, for each vertex of the tree."""

    def __init__(self, team: Team) -> None:
        """Go on from where a team is."""
        self.tree = team.tree
        self.splits = team.splits
        self.top_split = team.top_split
        self.at = list(team.at.values())
        self.visited = [bool(visited) for visited in team.visited]
        self.lowest_first = sorted(range(len(self.tree)), key=self.tree.upwards.__getitem__)
        self.inside = [0] * len(self.tree)
        self.unfinished = [0] * len(self.tree)
        self.explored = [False] * len(self.tree)

    def measure(self, vertex: int) -> None:
        """Count what is in a subtree from what was counted for the children."""
        here = below = len(self.robots_at[vertex]) + self.arrived[vertex]
        explored, unfinished = self.visited[vertex], 0
        for child in self.tree.children[vertex]:
            below += self.inside[child]
            unfinished += self.unfinished[child]
            explored = explored and self.explored[child]
        self.inside[vertex] = below
        self.explored[vertex] = explored
        self.unfinished[vertex] = unfinished + (not explored or below > here)

    def cap(self, vertex: int) -> int:
        """Return how many more robots a subtree has work for."""
        return max(0, self.unfinished[vertex] - self.inside[vertex])

    def tick(self) -> Moves:
        """Move all, and return the moves."""
        self.robots_at: list[list[int]] = [[] for _ in self.visited]
        for robot, vertex in enumerate(self.at):
            self.robots_at[vertex].append(robot)
        self.arrived = [0] * len(self.visited)
        moves: Moves = {}
        for vertex in self.lowest_first:
            self.measure(vertex)
            if vertex != self.tree.root:
                self.send(moves, vertex, self.tree.parents[vertex], self.up(vertex))
        for vertex in self.lowest_first:
            self.measure(vertex)
        for vertex in reversed(self.lowest_first):
            for child, number in self.down(vertex).items():
                self.send(moves, vertex, child, number)
        for robot, to in moves.items():
            self.at[robot] = to
            self.visited[to] = True
        return moves

    def send(self, moves: Moves, vertex: int, to: int, number: int) -> None:
        """Move those with the highest ids."""
        for _ in range(number):
            moves[self.robots_at[vertex].pop()] = to
        self.arrived[to] += number

    def spare(self, vertex: int) -> int:
        """Return how many may go if a guard stays."""
        return max(0, len(self.robots_at[vertex]) - (not self.arrived[vertex]))

    def up(self, vertex: int) -> int:
        """Return how many go to the parent."""
        if not self.explored[vertex]:
            if self.tree.heights[vertex] not in self.splits:
                return 0
            children = self.tree.children[vertex]
            room = sum(self.cap(child) for child in children if not self.explored[child])
            return max(0, self.spare(vertex) - room)
        if self.inside[vertex] == len(self.robots_at[vertex]) + self.arrived[vertex]:
            return len(self.robots_at[vertex])
        return self.spare(vertex)

    def down(self, vertex: int) -> dict[int, int]:
        """Return how many go to which children."""
        children = [child for child in self.tree.children[vertex] if not self.explored[child]]
        if not children:
            return {}
        shares = dict.fromkeys(children, 0)
        number = self.spare(vertex)
        if self.tree.heights[vertex] in self.splits:
            for _ in range(number):
                children = [child for child in children if shares[child] < self.cap(child)]
                fewest, least = -1, inf
                for child in children:
                    if self.inside[child] + shares[child] < least:
                        fewest, least = child, self.inside[child] + shares[child]
                if fewest >= 0:
                    shares[fewest] += 1
            return shares
        if self.tree.heights[vertex] > self.top_split:
            here = len(self.robots_at[vertex]) + self.arrived[vertex]
            all_here = here + self.inside[children[0]] == len(self.at)
            together = len(self.robots_at[vertex]) if all_here else number
            number = together if together <= self.cap(children[0]) else number
        for child in children:
            shares[child] = min(number, self.cap(child))
            number -= shares[child]
        return shares


def team_of(tree: RootedTree, ticks: int = 0) -> Team:
    """Return the team after some ticks."""
    team = Team(tree, ROBOTS, "cocta", paper_splits(tree.arity, tree.height, ROBOTS))
    for _ in range(ticks):
        team.apply(next_moves(team))
    return team


def _seconds(run: Callable[[], object]) -> float:
    before = time.process_time()
    run()
    return time.process_time() - before


def _same_ticks(tree: RootedTree, start: int, ticks: int) -> tuple[float, float]:
    """Return the seconds that the rule and the other one take; both make the same moves."""
    team = team_of(tree, start)
    every = EveryVertex(team)
    ours: list[Moves] = []
    theirs: list[Moves] = []

    def play() -> None:
        for _ in range(ticks):
            ours.append(next_moves(team))
            team.apply(ours[-1])

    seconds = _seconds(play), _seconds(lambda: theirs.extend(every.tick() for _ in range(ticks)))
    assert ours == theirs
    return seconds


def main() -> None:
    """Measure and print tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    repeats = parser.parse_args().repeats
    rows = []
    for height in HEIGHTS:
        tree = perfect_tree(2, height)
        whole_s = []
        for _ in range(repeats):
            team = team_of(tree)
            whole_s.append(_seconds(lambda team=team: ticks_taken(team, 2 * len(team.tree))))  # type: ignore[misc]  # bound now
        length = ticks_taken(team_of(tree), 2 * len(tree))
        assert length is not None
        ticks = min(length // 4, 1_000_000 // len(tree))
        pairs = [_same_ticks(tree, length // 2, ticks) for _ in range(repeats)]
        rows.append(
            (
                f"H = {height}",
                len(tree),
                length,
                f"{length / median(whole_s):,.0f}",
                f"{ticks / median(pair[0] for pair in pairs):,.0f}",
                f"{ticks / median(pair[1] for pair in pairs):,.0f}",
                f"{median(other / one for one, other in pairs):.1f}",
            )
        )
    print_table(
        f"ticks a second: perfect binary trees, {ROBOTS} robots, COCTA",
        ("", "vertices", "ticks", "whole run", "middle", "every vertex", "times Canopy"),
        rows,
        "target: every vertex at least 2 times Canopy",
    )


if __name__ == "__main__":
    main()
