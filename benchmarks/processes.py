"""Steps per second of the processes engine against the bare Zenoh exchange of equal messages.

    python -m benchmarks.processes [--robots 1 4 16 64] [--repeats 3] [--algorithm ormstc]

Each repeat plays the run and both floors one after another, so that all meet the same machine; the
medians of the ratios are what counts. Steps are moves.
"""

import argparse
import asyncio
import tempfile
import uuid
from pathlib import Path
from statistics import median

from agents.body import Body, Driver
from benchmarks import floor
from benchmarks.ormstc import setting as grid_setting
from benchmarks.table import print_table
from deploy import processes
from deploy.run_dir import RunDir
from deploy.setting import Setting, prepare
from protocol.codec import encode
from protocol.messages import AnyRequest, Batch, NumberedReply, NumberedRequest, TagWrite
from protocol.scenario import from_tree
from world_server.replay import replay
from world_server.terrain import terrain_of
from world_server.world import Answers, Wave, World

RADIUS = {1: 4, 4: 4, 16: 5, 64: 5}
"""Radius of the 7-ary tree for each team, so that each run takes seconds."""


def setting_for(robots: int, algorithm: str) -> Setting:
    """Return a run that is worth measuring."""
    if algorithm == "ormstc":
        return grid_setting(40, 60, 240, robots)
    world = {"generate": {"kind": "nary-tree", "branching": 7, "radius": RADIUS.get(robots, 4)}}
    team = {"robots": robots}
    return prepare(from_tree({"algorithm": "mr-dfs", "world": world, "team": team}, "benchmark"))


def recorded(setting: Setting) -> tuple[list[floor.Exchange], list[list[int]], int]:
    """Play a run in-process and keep what would have gone over the wire.

    Returns:
        The waves, the sizes of each robot's requests, and the moves made.
    """
    robots = setting.scenario.team.robots
    writes: list[TagWrite] = []
    world = World(
        setting.scenario,
        terrain_of(setting.ground, setting.scenario),
        setting.starts,
        on_write=lambda place, revision, tag: writes.append(TagWrite(place, revision, tag)),
    )
    drivers = [Driver(setting.algorithm, Body(world.briefing(robot))) for robot in range(robots)]
    seq = [0] * robots
    sizes: list[list[int]] = [[] for _ in range(robots)]
    exchanges: list[floor.Exchange] = []
    output = world.begin()
    number = 0
    while isinstance(output, Wave):
        requests: list[AnyRequest | None] = []
        replies: list[bytes] = []
        for robot, sight in zip(output.robots, output.sights, strict=True):
            if sight is not None:
                replies.append(encode(NumberedReply(seq[robot], sight)))
            request = drivers[robot].next_request(sight)
            seq[robot] += 1
            sizes[robot].append(len(encode(NumberedRequest(seq[robot], request))))
            requests.append(request)
        wave, number = output, number + 1
        output = world.resume(Answers(requests))
        if wave.round < 0:
            continue  # the opening looks come by themselves
        batch = None
        if not isinstance(output, Wave) or (output.time, output.round) != (wave.time, wave.round):
            batch = encode(Batch(1, number, tuple(writes)))
            writes.clear()
        exchanges.append(floor.Exchange(tuple(wave.robots), tuple(replies), batch))
    return exchanges, sizes, world.progress().steps


def played_s(setting: Setting, folder: Path) -> float:
    """Play the run with processes and return the seconds from its first instant to its end."""
    run_dir = RunDir.create(folder / uuid.uuid4().hex, "benchmark")
    name = f"benchmark-{uuid.uuid4().hex[:8]}"
    asyncio.run(processes.play(setting, run_dir, name, lambda _: None))
    closing = replay(run_dir.journal).closing
    assert closing is not None
    return closing.play_s


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, nargs="+", default=[1, 4, 16, 64])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--algorithm", choices=("mr-dfs", "ormstc"), default="mr-dfs")
    arguments = parser.parse_args()
    rows = []
    for robots in arguments.robots:
        setting = setting_for(robots, arguments.algorithm)
        exchanges, sizes, steps = recorded(setting)
        times: list[tuple[float, float, float]] = []
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            for _ in range(arguments.repeats):
                played = played_s(setting, folder)
                one = floor.measure(exchanges, sizes, folder, with_store=False)
                two = floor.measure(exchanges, sizes, folder, with_store=True)
                times.append((played, one, two))
        rows.append(
            (
                robots,
                steps,
                len(exchanges),
                *(f"{steps / median(column):.0f}" for column in zip(*times, strict=True)),
                f"{median(one / played for played, one, _ in times):.2f}",
                f"{median(two / played for played, _, two in times):.2f}",
            )
        )
    print_table(
        "processes: moves a second, "
        + (
            "40 x 60 coarse cells with 240 obstacles (no store, so only floor 1 counts)"
            if arguments.algorithm == "ormstc"
            else "7-ary tree of radius 4 (16 and 64 robots: 5)"
        ),
        ("robots", "moves", "waves", "Canopy", "floor 1", "floor 2", "of floor 1", "of floor 2"),
        rows,
        "targets: at 16 and 64 robots at least 0.75 of floor 1 and 0.90 of floor 2; at 1 robot at "
        "least 0.80 of floor 1 (1.25 times its round trip)",
    )


if __name__ == "__main__":
    main()
