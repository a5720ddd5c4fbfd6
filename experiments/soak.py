"""The soak: random scenarios under random faults, for as long as one likes.

    python -m experiments.soak --minutes 10
    python -m experiments.soak --seed 123 --runs 1      one run again, which says what it does

Each run is drawn from its own seed: a place, a team, an algorithm, clock, radio and router, and faults
of all kinds. It is played in one thread and by processes. It fails if the traces differ, a guarantee is
broken, the run hangs, or anything is left behind. Exit code 0: no run failed.
"""

import argparse
import asyncio
import multiprocessing
import os
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from pathlib import Path
from typing import Any

from msgspec import Struct

from deploy import inprocess, processes
from deploy.judged import judge_journal
from deploy.run_dir import RunDir
from deploy.setting import prepare
from deploy.verdict.result import Result
from protocol.scenario import Scenario, from_tree
from protocol.seeds import Stream, spawn

PATIENCE_S = 120.0
"""A run that takes longer hangs."""

ON_GRAPHS = ("mr-dfs", "mr-dfs", "mr-dfs", "ncocta", "cocta", "cocta-best")
ON_GRIDS = ("ormstc", "ormstc", "parent-child")
"""What is played, the oftener named the oftener."""

LEAVE_S = 3.0
"""What a run started is gone this long after it."""


class Outcome(Struct):
    """What became of one run.

    Attributes:
        seed: what it was drawn from.
        words: what it was, in a line.
        wrong: what went wrong, a line each.
        faults: how many faults of each kind struck.
        restarts: how many processes came back.
        moves: moves that the robots made.
        wall_s: how long it took by processes.
    """

    seed: int
    words: str
    wrong: list[str]
    faults: dict[str, int]
    restarts: int
    moves: int
    wall_s: float


def draw(seed: int) -> dict[str, Any]:
    """Draw a scenario, as the tree of a file."""
    rng = spawn(seed, "soak")
    robots = rng.choice((1, 2, 2, 3, 3, 4, 5, 6))
    algorithm = rng.choice(ON_GRAPHS + ON_GRIDS)
    on_graph = algorithm in ON_GRAPHS
    has_devices = algorithm == "mr-dfs"
    event = algorithm != "ormstc" and rng.random() < 0.4
    scenario: dict[str, Any] = {
        "name": f"soak-{seed}",
        "algorithm": algorithm,
        "seed": seed,
        "durability": rng.choice(("process", "process", "process", "power")),
        "world": {"generate": _graph(rng) if on_graph else _grid(rng)},
        "team": {"robots": robots, "on_crash": rng.choice(("lost", "lost", "restart"))},
        "network": {"router": rng.choice(("embedded", "separate"))},
        "chaos": {
            "robots": rng.randrange(robots),
            "infrastructure": rng.randrange(7),
            "network": rng.choice((0, 0, 0, 1, 2)),
            "tags": rng.choice((0, 0, 0, 1, 2, 4)) if has_devices else 0,
        },
    }
    if rng.random() < 0.2:
        names = ["world", *(["bookkeeping"] if has_devices else []), "robot:0"]
        skew = {"skew": rng.choice(names), "at": rng.randrange(4), "by_s": rng.uniform(-1e6, 1e6)}
        scenario["faults"] = [skew]
    if on_graph and not has_devices:
        scenario["algorithm_options"] = {"tree": "breadth-first"}
    if algorithm == "parent-child":
        scenario["radio"] = {"radius_m": rng.choice((1.5, 2.0, 3.0))}
        # Of two parents and two children one of each is left.
        scenario["team"] |= {"robots": robots + 3, "parents": 2}
        scenario["chaos"]["robots"] = rng.randrange(2)
    if algorithm == "cocta-best":
        scenario["algorithm_options"]["effort"] = 200
    if event:
        scenario["clock"] = {"mode": "event", "jitter": rng.choice((0.0, 0.3, "exponential"))}
    return scenario


def _graph(rng: Stream) -> dict[str, Any]:
    vertices = rng.randint(2, 40)
    match rng.randrange(4):
        case 0:
            return {"kind": "random-tree", "vertices": vertices}
        case 1:
            most = vertices * (vertices - 1) // 2
            edges = min(most, vertices - 1 + rng.randrange(10))
            return {"kind": "random-graph", "vertices": vertices, "edges": edges}
        case 2:
            return {
                "kind": "nary-tree",
                "branching": rng.randint(1, 3),
                "radius": rng.randint(1, 3),
            }
        case _:
            return {"kind": "cave", "vertices": vertices + 8, "loops": rng.randrange(2)}


def _grid(rng: Stream) -> dict[str, Any]:
    rows, cols = rng.randint(2, 6), rng.randint(3, 7)
    obstacles = rng.randrange(rows * cols // 4)
    return {"kind": "random-obstacles", "rows": rows, "cols": cols, "obstacles": obstacles}


def play(seed: int) -> Outcome:
    """Play one run in both engines and compare."""
    scenario = from_tree(draw(seed), f"soak {seed}")
    folder = Path(tempfile.mkdtemp(prefix="canopy-soak-"))
    started = time.monotonic()
    outcome = Outcome(seed, _in_words(scenario), [], {}, 0, 0, 0.0)
    try:
        _play(scenario, folder, outcome)
    except Exception:  # noqa: BLE001  whatever happens is a finding
        outcome.wrong += traceback.format_exc().strip().splitlines()[-12:]
    finally:
        outcome.wall_s = time.monotonic() - started
        for log in sorted(folder.glob("processes/logs/*.log")) if outcome.wrong else ():
            outcome.wrong += (f"{log.stem}: {line}" for line in log.read_text().splitlines()[-5:])
        shutil.rmtree(folder)
    return outcome


def _play(scenario: Scenario, folder: Path, outcome: Outcome) -> None:
    setting = prepare(scenario)
    name = f"soak-{scenario.seed}-{os.getpid()}"
    alone = RunDir.create(folder / "inprocess", scenario.name)
    inprocess.run(setting, alone, name, lambda _: None)
    expected = judge_journal(alone.journal).result
    together = RunDir.create(folder / "processes", scenario.name)

    async def bounded() -> processes.Played:
        async with asyncio.timeout(PATIENCE_S):
            return await processes.play(
                setting,
                together,
                name,
                lambda _: None,
                snapshot_every=spawn(scenario.seed, "snapshots").choice((None, 1, 7, 50)),
            )

    try:
        played = asyncio.run(bounded())
    except TimeoutError:
        outcome.wrong.append(f"hung: no end after {PATIENCE_S:g} s")
        return
    finally:
        outcome.wrong += _left_behind(name)
    judged = judge_journal(together.journal, **played.told(0.0))
    found = judged.result
    outcome.restarts, outcome.moves = sum(found.restarts.values()), found.steps
    words = (setting.scenario.faults[number].word for number in judged.replayed.world.struck)
    outcome.faults = dict(Counter(words))
    outcome.wrong += compare(expected, found)


def compare(expected: Result, found: Result) -> list[str]:
    """Say where a run by processes differs from the one in a thread, or broke a promise."""
    wrong = []
    if found.trace_sha256 != expected.trace_sha256:
        wrong.append(
            f"another trace: {found.steps} moves against {expected.steps}, "
            f"lost {found.robots_lost} against {expected.robots_lost}"
        )
    if found.status != "over" or not found.complete:
        wrong.append(f"{found.status}, {found.covered} of {found.to_cover} covered")
    wrong += (
        f"broken: {claim.name}: {claim.detail}"
        for claim in found.guarantees
        if claim.holds is False
    )
    return wrong


def _left_behind(name: str) -> list[str]:
    """Say what of a run is still there a while after it."""
    until = time.monotonic() + LEAVE_S
    while left := list(_processes_of(name)):
        if time.monotonic() > until:
            return [f"left behind: process {pid}: {command}" for pid, command in left]
        time.sleep(0.01)
    return []


def _processes_of(name: str) -> Iterator[tuple[int, str]]:
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal() and int(entry.name) != os.getpid():
            try:
                command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            except OSError:
                continue
            if name in command.split():
                yield int(entry.name), command


def _in_words(scenario: Scenario) -> str:
    chaos, kind = scenario.chaos, type(scenario.world.generate).__name__
    return (
        f"{scenario.algorithm} on {kind}, {scenario.team.robots} robots ({scenario.team.on_crash}), "
        f"{scenario.clock.mode}, router {scenario.network.router}, faults: {chaos.robots} robots, "
        f"{chaos.infrastructure} infrastructure, {chaos.network} network, {chaos.tags} tags"
    )


def soak(minutes: float, first: int, runs: int | None, jobs: int) -> int:
    """Play runs until the time is over, print how it goes, and return the exit code."""
    shared_before = _shared_memory()
    end = time.monotonic() + 60 * minutes
    outcomes: list[Outcome] = []
    seeds = iter(range(first, first + runs) if runs is not None else range(first, sys.maxsize))
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=context) as pool:
        pending: set[Future[Outcome]] = set()
        while True:
            while len(pending) < jobs and (runs is not None or time.monotonic() < end):
                seed = next(seeds, None)
                if seed is None:
                    break
                pending.add(pool.submit(play, seed))
            if not pending:
                break
            done, pending = wait(pending, return_when=FIRST_COMPLETED)
            for future in done:
                outcomes.append(future.result())
                _tell(outcomes[-1], every=runs is not None or len(outcomes) % 25 == 0, of=outcomes)
    left = _shared_memory() - shared_before
    failed = [outcome for outcome in outcomes if outcome.wrong]
    print(_summary(outcomes))
    if left:
        print(f"left behind in /dev/shm: {', '.join(sorted(left))}")
    return 1 if failed or left else 0


def _shared_memory() -> set[str]:
    """Return what lies in shared memory, but for semaphores of Python's pools, ours or others'."""
    folder = Path("/dev/shm")  # noqa: S108  looked at, not used
    names = {entry.name for entry in folder.iterdir()} if folder.is_dir() else set()
    return {name for name in names if not name.startswith("sem.mp-")}


def _tell(outcome: Outcome, *, every: bool, of: list[Outcome]) -> None:
    if outcome.wrong:
        print(f"FAILED seed {outcome.seed}: {outcome.words}")
        for line in outcome.wrong:
            print(f"    {line}")
        print(f"    again: python -m experiments.soak --seed {outcome.seed} --runs 1")
    elif every:
        print(f"run {len(of)}: seed {outcome.seed}: {outcome.words}: {outcome.wall_s:.1f} s")
    sys.stdout.flush()


def _summary(outcomes: list[Outcome]) -> str:
    faults: Counter[str] = Counter()
    for outcome in outcomes:
        faults.update(outcome.faults)
    kinds = ", ".join(f"{count} {word}" for word, count in sorted(faults.items())) or "none"
    failed = [outcome.seed for outcome in outcomes if outcome.wrong]
    return (
        f"soak: {len(outcomes)} runs, {sum(outcome.moves for outcome in outcomes)} moves, "
        f"{sum(outcome.restarts for outcome in outcomes)} processes came back\n"
        f"  faults that struck: {kinds}\n"
        f"  failures: {len(failed)}" + (f", seeds {failed}" if failed else "")
    )


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.soak",
        description="Play random scenarios under random faults, and check that nothing changes.",
    )
    parser.add_argument("--minutes", type=float, default=10.0, help="how long (10)")
    parser.add_argument("--runs", type=int, help="how many runs, instead of a time")
    parser.add_argument("--seed", type=int, help="the first seed (drawn from the clock)")
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time (2)")
    arguments = parser.parse_args()
    seed = arguments.seed
    if seed is None:
        seed = int.from_bytes(os.urandom(4), "little")
    return soak(arguments.minutes, seed, arguments.runs, arguments.jobs)


if __name__ == "__main__":
    sys.exit(main())
