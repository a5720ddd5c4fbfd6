"""The in-process engine: one thread, no event loop, no sockets; the same algorithms and world."""

import time
import traceback
from collections.abc import Callable
from contextlib import ExitStack, closing

from agents.body import REQUEST_TYPES, Algorithm, Body, Driver
from bookkeeping.sqlite_store import SqliteStore
from deploy.run_dir import RunDir
from deploy.setting import Setting, tag_format_of
from protocol.messages import AnyRequest, Batch, Progress, TagWrite
from protocol.scenario import Scenario, to_tree
from protocol.trace import LossCause, TraceDigest
from world_server.journal import Closing, Journal, OldTags, WaveRecord, opening
from world_server.terrain import terrain_of
from world_server.world import (
    Answers,
    End,
    FaultOrder,
    KillOrder,
    Output,
    TagsWanted,
    Wave,
    World,
)

SHOW_S = 0.1
"""Progress is shown this often, looked at once in so many waves."""

SHOW_WAVES = 512

Recorder = Callable[[Answers], None]
"""Called with the input to each wave before it is applied."""


ReadTags = Callable[[tuple[int, ...]], tuple[TagWrite, ...]]
"""Gives the tags that an earlier run left at some places."""


def play(
    scenario: Scenario,
    world: World,
    algorithm: Algorithm,
    record: Recorder | None = None,
    read_tags: ReadTags | None = None,
) -> tuple[End, dict[int, str]]:
    """Play a run to its end.

    Args:
        scenario: what is played.
        world: a world that has not begun.
        algorithm: what each robot runs.
        record: called with the input to each wave.
        read_tags: what an earlier run left; ``None``: nothing.

    Returns:
        How it ended, and for each robot whose algorithm failed the text of its exception.
    """
    robots = range(scenario.team.robots)
    drivers = [Driver(algorithm, Body(world.briefing(robot))) for robot in robots]
    send = [driver.send for driver in drivers]
    resume = world.resume
    failures: dict[int, str] = {}
    output: Output = world.begin()
    while True:
        if output.__class__ is Wave:
            requests: list[AnyRequest | None] = []
            lost: tuple[tuple[int, LossCause], ...] = ()
            for robot, sight in zip(output.robots, output.sights):  # noqa: B905  equal by design
                # `Driver.next_request`, written out: a call a step is a tenth of the time.
                try:
                    try:
                        request = send[robot](sight)
                    except StopIteration as stop:
                        request = drivers[robot].last_request(stop)
                    except RuntimeError as error:
                        foreign = drivers[robot].foreign_loop(error)
                        if foreign is None:
                            raise
                        raise foreign from error
                    if request.__class__ not in REQUEST_TYPES:
                        raise drivers[robot].foreign_await(request)
                    requests.append(request)
                except (Exception, SystemExit):  # noqa: BLE001  whatever a user's algorithm raises
                    failures[robot] = traceback.format_exc()
                    requests.append(None)
                    lost = (*lost, (robot, "failed"))
            answers = Answers(requests, lost)
            if record is not None:
                record(answers)
            output = resume(answers)
        elif isinstance(output, KillOrder):
            drivers[output.robot].close()
            output = resume(None)
        elif isinstance(output, FaultOrder):
            output = resume(None)  # there are no processes here, nor a network
        elif isinstance(output, End):
            return output, failures
        elif isinstance(output, TagsWanted):
            output = resume(() if read_tags is None else read_tags(output.places))


def run(
    setting: Setting, run_dir: RunDir, name: str, show: Callable[[Progress], None]
) -> dict[int, str]:
    """Play a run with a journal, as the processes engine does.

    Args:
        setting: what is played.
        run_dir: where; the journal is written there.
        name: name of the run.
        show: called now and then with how far the run is.

    Returns:
        For each robot whose algorithm failed the text of its exception.
    """
    scenario = setting.scenario
    started = time.monotonic()
    digest = TraceDigest()
    written: dict[int, TagWrite] = {}

    def note(place: int, revision: int, tag: bytes) -> None:
        written[place] = TagWrite(place, revision, tag)

    next_look, next_show, waves = SHOW_WAVES, started + SHOW_S, 0

    def record(answers: Answers) -> None:
        nonlocal next_look, next_show, waves
        journal.append(WaveRecord(answers.requests, answers.lost))
        waves += 1
        if waves >= next_look:
            next_look = waves + SHOW_WAVES
            if time.monotonic() >= next_show:
                next_show = time.monotonic() + SHOW_S
                show(world.progress())

    def read(places: tuple[int, ...]) -> tuple[TagWrite, ...]:
        assert store is not None
        tags = store.read(places)
        journal.append(OldTags(tags))
        return tags

    with ExitStack() as stack:
        store = (
            stack.enter_context(_store(setting, run_dir, name)) if _has_store(scenario) else None
        )
        journal = stack.enter_context(closing(Journal(run_dir.journal, scenario.durability)))
        journal.append(
            opening(name, "inprocess", to_tree(scenario), setting.ground, setting.starts)
        )
        terrain = terrain_of(setting.ground, scenario)
        world = World(scenario, terrain, setting.starts, observe=digest, on_write=note)
        end, failures = play(scenario, world, setting.algorithm, record, read)
        if store is not None and written:
            store.apply(Batch(1, waves, tuple(written.values())))
        play_s = time.monotonic() - started
        journal.append(Closing(end.status, digest.hexdigest(), play_s))
        show(world.progress())
    return failures


def _has_store(scenario: Scenario) -> bool:
    return scenario.device.capacity > 0


def _store(setting: Setting, run_dir: RunDir, name: str) -> SqliteStore:
    """Open the file that the tags are left in; one thread needs no service."""
    scenario = setting.scenario
    return SqliteStore(
        scenario.bookkeeping.database or run_dir.database,
        run=name,
        capacity_bytes=scenario.device.capacity,
        fresh=scenario.bookkeeping.fresh,
        durability=scenario.durability,
        tag_format=tag_format_of(scenario),
    )
