"""How long a world server takes to recover, after runs of 10,000 to 1,000,000 steps.

    python -m benchmarks.recovery_length [--steps N ...] [--robots 16] [--repeats 3]

Processor time of a fresh process that takes over a run which stands just before its end: start of
Python and imports, map, snapshot, rest of the journal. The floor is a process with the
same imports that does nothing. Two worlds: one of 1,000 vertices that robots wander about in, and a
tree that has half as many edges as the run has steps, explored by MR-DFS.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median
from time import process_time
from typing import NamedTuple

from agents.body import Algorithm, Body
from agents.registry import algorithm_of
from benchmarks.table import print_table
from deploy.inprocess import play
from protocol.graph import PortGraph
from protocol.messages import SCHEMA_VERSION
from protocol.scenario import from_tree, to_tree
from protocol.seeds import spawn
from protocol.trace import TraceDigest
from world_server.journal import Incarnation, Journal, WaveRecord, opening
from world_server.maps.generators import random_graph, wide_tree
from world_server.snapshot import EVERY_REQUESTS, Snapshot, SnapshotFile, snapshot_of
from world_server.state import WorldState
from world_server.terrain import terrain_of
from world_server.world import Answers, World
from world_server.write_behind import WriteBehind

RUN = "recovery-length"
BARE = "import world_server.node"
TAKE_OVER = """
import os, sys
from pathlib import Path
from world_server.node import take_over
recovered = take_over(Path(sys.argv[1]), sys.argv[2])
os._exit(0)  # a world server would go on now; to free everything takes its time too
"""


class Case(NamedTuple):
    """What is played, in about so many steps."""

    name: str
    graph: PortGraph
    algorithm: Algorithm


def cases(steps: int, robots: int) -> list[Case]:
    """Return a run in a fixed world, and one in a world that grows with it."""

    async def wander(body: Body) -> None:
        here = await body.look()
        for move in range(steps // robots):
            tag = move.to_bytes(4, "little")
            here = await body.move(body.rng.randrange(here.degree), tag=tag)

    graph = random_graph(1000, 3000, spawn(1, "graph"))
    tree = wide_tree(steps // 2, spawn(1, "tree"))
    return [
        Case("1,000 vertices", graph, wander),
        Case(f"tree of {steps // 2:,} edges", tree, algorithm_of("mr-dfs", {})),
    ]


class Kept(NamedTuple):
    """What was kept of a run.

    Attributes:
        moves: how many were made.
        play_s: processor time that it took in-process, snapshots included.
        snapshots_s: processor time of each of these: to take and to write.
        snapshot_bytes: size of the last.
    """

    moves: int
    play_s: float
    snapshots_s: list[float]
    snapshot_bytes: int


def keep(case: Case, robots: int, folder: Path) -> Kept:
    """Play a run with a journal and snapshots, as a world server does; it ends without an end."""
    tree = {"algorithm": "mr-dfs", "team": {"robots": robots}, "world": {"map": "none"}}
    scenario = from_tree(tree, "benchmark")
    terrain = terrain_of(case.graph, scenario)
    starts = (0,) * robots
    digest, store = TraceDigest(), WriteBehind(1)
    world = World(scenario, terrain, starts, observe=digest.later, on_write=store.written)
    journal = Journal(folder / "journal")
    journal.append(opening(RUN, "processes", to_tree(scenario), case.graph, starts))
    journal.append(Incarnation(1))
    snapshots = SnapshotFile(snapshot_of(folder), folder / "journal")
    taken_s: list[float] = []  # to copy the state, of the snapshot in hand
    spent_s: list[float] = []

    def take(state: WorldState) -> None:
        before = process_time()
        world.state()  # as was just done for us: this is what it costs
        end, trace, unacknowledged = journal.end, digest.state(), store.state()
        snapshots.take(Snapshot(SCHEMA_VERSION, RUN, end, 0, 1, (), state, trace, unacknowledged))
        taken_s.append(process_time() - before)

    def record(answers: Answers) -> None:
        digest.catch_up()
        batch = store.take(0.0)
        if batch is not None:
            store.acknowledged(batch.wave)
        if taken_s:
            before = process_time()
            snapshots.write()
            spent_s.append(process_time() - before + taken_s.pop())
        if snapshots.due(len(answers.requests)):
            world.when_quiet(take)
        journal.append(WaveRecord(answers.requests, answers.lost))
        store.next_wave()

    store.next_wave()
    store.resume(0)
    before = process_time()
    play(scenario, world, case.algorithm, record)
    play_s = process_time() - before
    journal.close()
    size = snapshot_of(folder).stat().st_size if spent_s else 0
    return Kept(world.progress().steps, play_s, spent_s, size)


def processor_s(program: str, *arguments: str) -> float:
    """Return the processor time of a fresh Python."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", program, *arguments], check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def measured(case: Case, robots: int, repeats: int) -> tuple[str, ...]:
    """Play a case and take it over; return a row of the table."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        kept = keep(case, robots, folder)
        bare, with_it, without = [], [], []
        snapshot = snapshot_of(folder)
        aside = folder / "aside"
        for _ in range(repeats):
            bare.append(processor_s(BARE))
            with_it.append(processor_s(TAKE_OVER, name, RUN))
            if snapshot.exists():
                snapshot.rename(aside)
            without.append(processor_s(TAKE_OVER, name, RUN))
            if aside.exists():
                aside.rename(snapshot)
        journal_mb = (folder / "journal").stat().st_size / 1e6
    each_ms = median(kept.snapshots_s) * 1e3 if kept.snapshots_s else 0.0
    share = sum(kept.snapshots_s) / kept.play_s
    ratio = median(a / b for a, b in zip(with_it, bare, strict=True))
    return (
        case.name,
        f"{kept.moves:,}",
        f"{journal_mb:.1f}",
        f"{kept.snapshot_bytes / 1e6:.2f}",
        f"{len(kept.snapshots_s)}",
        f"{each_ms:.1f}",
        f"{100 * share:.1f}",
        f"{median(bare):.2f}",
        f"{median(without):.2f}",
        f"{median(with_it):.2f}",
        f"{ratio:.1f}",
    )


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, nargs="+", default=[10_000, 100_000, 1_000_000])
    parser.add_argument("--robots", type=int, default=16)
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    robots, repeats = arguments.robots, arguments.repeats
    rows = [
        measured(case, robots, repeats)
        for steps in arguments.steps
        for case in cases(steps, robots)
    ]
    print_table(
        f"recovery: {robots} robots, a snapshot every {EVERY_REQUESTS:,} requests or more",
        (
            *("world", "moves", "journal MB", "snapshot MB", "snapshots", "each ms"),
            *("% of play", "bare s", "whole journal s", "snapshot s", "of bare"),
        ),
        rows,
        "target: at most 2 s after 1,000,000 steps; % of play is that of the in-process engine, which "
        "is faster than processes are",
    )


if __name__ == "__main__":
    main()
