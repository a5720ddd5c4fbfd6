"""Cost of a step and memory as an in-process run grows from 10,000 to 1,000,000 steps.

    python -m benchmarks.flat

Each length in a process of its own: four robots walk round a cycle of 100 vertices, with the trace
digest and the ledger of the verdict on. The floor is the shortest run.
"""

import resource
import subprocess
import sys
import time

from agents.body import Body
from benchmarks.table import print_table
from deploy.inprocess import play
from deploy.setting import prepare
from deploy.verdict.ledger import Ledger
from protocol.scenario import from_tree
from protocol.trace import Event, TraceDigest
from world_server.maps import generators
from world_server.terrain import GraphTerrain
from world_server.world import World

LENGTHS = (10_000, 100_000, 1_000_000)
ROBOTS = 4


async def walk(body: Body, options: dict[str, int]) -> None:
    """Walk on and on, writing the tag of each place."""
    here = await body.look()
    for step in range(options["moves"]):
        here = await body.move(step % here.degree, tag=step.to_bytes(4, "little"))


def measure(steps: int) -> None:
    """Play one run and print seconds and the peak of resident memory in kB."""
    tree = {
        "algorithm": "benchmarks.flat:walk",
        "algorithm_options": {"moves": steps // ROBOTS},
        "world": {"generate": {"kind": "nary-tree", "branching": 1, "radius": 1}},
        "team": {"robots": ROBOTS},
    }
    setting = prepare(from_tree(tree, "benchmark"))
    graph = generators.cycle(100)
    digest, ledger = TraceDigest(), Ledger(graph, [0] * ROBOTS)

    def observe(event: Event) -> None:
        digest(event)
        ledger.observe(event)

    world = World(setting.scenario, GraphTerrain(graph), [0] * ROBOTS, observe=observe)
    started = time.process_time()
    play(setting.scenario, world, setting.algorithm)
    assert ledger.steps == steps // ROBOTS * ROBOTS
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(time.process_time() - started, peak)


def main() -> None:
    """Measure and print a table, or measure one length."""
    if len(sys.argv) > 1:
        measure(int(sys.argv[1]))
        return
    rows = []
    base = 0.0
    for steps in LENGTHS:
        command = [sys.executable, "-m", "benchmarks.flat", str(steps)]
        seconds, peak = subprocess.check_output(command, text=True).split()
        cost = float(seconds) / steps
        base = base or cost
        rows.append((steps, f"{cost * 1e6:.2f}", f"{cost / base:.2f}", f"{int(peak) / 1024:.0f}"))
    print_table(
        "in-process as the run grows",
        ("steps", "us a step", "of the shortest", "peak MB"),
        rows,
        "target: both columns flat",
    )


if __name__ == "__main__":
    main()
