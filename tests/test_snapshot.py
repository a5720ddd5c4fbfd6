"""Snapshots: a world that goes on from one, the file, and recovery that begins at it."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from agents.body import Body, Driver
from deploy.supervisor import Supervisor
from protocol.codec import decoder_of, encode
from protocol.errors import JournalError, StoreError
from protocol.graph import PortGraph
from protocol.grid import Grid
from protocol.messages import (
    SCHEMA_VERSION,
    AnyRequest,
    Batch,
    GridSight,
    Look,
    TagWrite,
    Wait,
    Write,
)
from protocol.scenario import Scenario, to_tree
from protocol.seeds import spawn
from protocol.trace import CHUNK_BYTES, DigestState, Event, TraceDigest
from tests.play import graph_of, graphs, grids, scenario_of, sha256, tree_of
from tests.runs import play as play_run
from tests.runs import setting_of
from world_server.journal import (
    CarriedOut,
    Closing,
    Incarnation,
    Joined,
    Journal,
    OldTags,
    WaveRecord,
    checksum,
    hold,
    opening,
    scan,
)
from world_server.replay import Recovered, all_writes, recover, replay
from world_server.snapshot import (
    BYTES_PER_REQUEST,
    Snapshot,
    SnapshotFile,
    read_snapshot,
    snapshot_of,
)
from world_server.state import TagsState, WorldState, put_back, put_tags_back, states_of, tags_state
from world_server.terrain import terrain_of
from world_server.world import Answers, End, FaultOrder, Input, KillOrder, Output, Wave, World
from world_server.write_behind import WriteBehind

RUN = "run-1"
decode_state: Callable[[bytes], WorldState] = decoder_of(WorldState, 1 << 24)

# The digest.

EVENTS = [
    Event(float(n), 0, 0, n % 7, n, None, Write(bytes(n * 37 % 4000), ()), n) for n in range(120)
]


def test_the_events_here_make_several_links() -> None:
    assert sum(len(encode(event)) for event in EVENTS) > 3 * CHUNK_BYTES


@given(st.lists(st.integers(0, len(EVENTS)), max_size=4), st.sets(st.integers(0, len(EVENTS))))
def test_a_digest_goes_on_from_where_it_was_saved(saved_at: list[int], later: set[int]) -> None:
    digest = TraceDigest()
    for number, event in enumerate(EVENTS):
        for _ in range(saved_at.count(number)):
            saved = decoder_of(DigestState)(encode(digest.state()))
            assert len(saved.rest) <= CHUNK_BYTES
            digest = TraceDigest(saved)
        (digest.later if number in later else digest)(event)
    assert digest.hexdigest() == sha256(EVENTS) == digest.hexdigest()


# Random streams.


@given(st.integers(0, 5), st.integers(0, 1300))
def test_a_stream_goes_on_from_where_it_was_saved(gausses: int, draws: int) -> None:
    one, other = spawn(1, "one"), spawn(1, "other")
    for _ in range(draws):
        one.random()
    for _ in range(gausses):
        one.gauss()
    put_back([other], states_of([one]))
    for draw in ("random", "gauss", "gauss", "gauss"):
        assert getattr(one, draw)() == getattr(other, draw)()


# Tags.


@given(
    st.lists(st.tuples(st.integers(0, 3), st.binary(max_size=2)), max_size=40), st.integers(0, 90)
)
def test_tags_come_back_whether_few_or_many(written: list[tuple[int, bytes]], blank: int) -> None:
    revisions = [revision for revision, _ in written] + [0] * blank
    tags = [tag if revision else b"" for revision, tag in written] + [b""] * blank
    state = decoder_of(TagsState)(encode(tags_state(revisions, tags)))
    assert len(state.tags) <= 4 * sum(map(bool, revisions))
    found: tuple[list[int], list[bytes]] = ([0] * len(tags), [b""] * len(tags))
    put_tags_back(state, *found)
    assert found == (revisions, tags)


# Worlds.


async def wanders(body: Body) -> None:
    """Do whatever a robot can do, drawn from its own stream; now and then break a rule."""
    draw = body.rng
    here = await body.look()
    for _ in range(draw.randint(1, 40)):
        chance = draw.random()
        tag = bytes([draw.randrange(256)]) if draw.random() < 0.2 else None
        messages = (bytes([draw.randrange(256)]),) if draw.random() < 0.2 else ()
        if chance < 0.6 and here.degree:
            exit_ = draw.randrange(here.degree)
            on_grid = isinstance(here, GridSight)
            gaze = draw.randrange(4) if on_grid and draw.random() < 0.3 else None
            here = await body.move(exit_, gaze=gaze, tag=tag, messages=messages)
        elif chance < 0.7:
            here = await body.exchange(*messages)
        elif chance < 0.8:
            here = await body.wait(float(draw.randint(1, 4)), tag=tag, messages=messages)
        elif chance < 0.97:
            bound = float(draw.randint(1, 9)) if draw.random() < 0.9 else None
            here = await body.wait_for_news(at_most=bound, tag=tag)
        else:
            here = await body.move(99)
    if draw.random() < 0.5:
        await body.wait_for_news(at_most=50.0)


class Case(NamedTuple):
    """What is played: a scenario and where."""

    scenario: Scenario
    ground: PortGraph | Grid
    starts: list[int]
    old_tags: dict[int, TagWrite]
    lost_in: dict[int, tuple[int, Any]]

    def world(self, **observers: Any) -> World:
        return World(
            self.scenario, terrain_of(self.ground, self.scenario), self.starts, **observers
        )


class Quiet(NamedTuple):
    """A state between two instants, and how much had come before it."""

    inputs: int
    events: int
    writes: int
    state: bytes


class Tape(NamedTuple):
    """A run: ``outputs[i]`` is what input ``i`` answers."""

    case: Case
    world: World
    outputs: list[Output]
    inputs: list[Input]
    events: list[Event]
    writes: list[tuple[int, int, bytes]]
    quiet: list[Quiet]


def noting(writes: list[tuple[int, int, bytes]]) -> Callable[[int, int, bytes], None]:
    return lambda *write: writes.append(write)


def taped(case: Case) -> Tape:
    """Play a case by robots that wander, and keep everything."""
    events: list[Event] = []
    writes: list[tuple[int, int, bytes]] = []
    inputs: list[Input] = []
    quiet: list[Quiet] = []
    world = case.world(observe=events.append, on_write=noting(writes))
    drivers = [Driver(wanders, Body(world.briefing(robot))) for robot in range(len(case.starts))]

    def take(state: WorldState) -> None:
        quiet.append(Quiet(len(inputs), len(events), len(writes), encode(state)))

    world.when_quiet(take)
    outputs = [world.begin()]
    waves = count()
    while not isinstance(output := outputs[-1], End):
        given: Input = None
        if isinstance(output, Wave):
            requests: list[AnyRequest | None] = [
                drivers[robot].next_request(sight)
                for robot, sight in zip(output.robots, output.sights, strict=True)
            ]
            lost = case.lost_in.get(next(waves))
            given = Answers(requests, () if lost is None else (lost,))
        elif not isinstance(output, KillOrder | FaultOrder):
            given = tuple(case.old_tags[at] for at in output.places if at in case.old_tags)
        inputs.append(given)
        world.when_quiet(take)
        outputs.append(world.resume(given))
    for driver in drivers:
        driver.close()
    return Tape(case, world, outputs, inputs, events, writes, quiet)


@st.composite
def cases(draw: st.DrawFn) -> Case:
    """Scenarios with a little of everything, on graphs and on grids."""
    ground: PortGraph | Grid
    if draw(st.booleans()):
        ground = draw(graphs(vertices_max=6, extra_max=4))
        free = list(range(len(ground.names)))
        sensing: dict[str, Any] = {}
        world: dict[str, Any] = {}
        reaches = ["none", "same-place", "global"]
    else:
        ground = draw(grids(rows_max=4, cols_max=4, marks="....#"))
        free = [ground.place(*cell) for cell in ground.free_cells()]
        sensing = {"mode": draw(st.sampled_from(["ahead", "three"]))}
        if draw(st.booleans()):
            sensing |= {"position": "odometry", "drift": draw(st.sampled_from([0.0, 0.4]))}
            sensing["reset"] = draw(st.booleans())
        world = {"bodies": draw(st.sampled_from(["pass", "block"]))}
        reaches = ["none", "same-place", "global", "radius"]
    robots = draw(st.integers(1, 5 if world.get("bodies") != "block" else min(5, len(free))))
    if world.get("bodies") == "block":
        starts = draw(st.permutations(free))[:robots]
    else:
        starts = draw(st.lists(st.sampled_from(free), min_size=robots, max_size=robots))
    radio: dict[str, Any] = {
        "reach": draw(st.sampled_from(reaches)),
        "latency": draw(st.sampled_from([0.0, 1.0, 2.5])),
        "loss": draw(st.sampled_from([0.0, 0.3])),
        "duplicate": draw(st.sampled_from([0.0, 0.3])),
        "heartbeat": draw(st.sampled_from(["global", "reach"])),
    }
    if radio["reach"] == "radius":
        radio["radius_m"] = 2.0
    fields: dict[str, Any] = {
        "seed": draw(st.integers(0, 999)),
        "world": {"map": "none", **world},
        "sensing": sensing,
        "radio": radio,
        "device": {"capacity_bytes": draw(st.sampled_from([0, 9])), "checksum": False},
        "bookkeeping": {"fresh": draw(st.booleans())},
        "faults": draw(st.lists(faults(robots, free), max_size=5)),
    }
    if draw(st.booleans()):
        jitter = draw(st.sampled_from([0.0, 0.5, "exponential"]))
        fields["clock"] = {"mode": "event", "jitter": jitter}
    fields.setdefault("clock", {})["rounds_max"] = draw(st.sampled_from([3, 10_000]))
    number = st.integers(0, robots - 1)
    loss = st.tuples(number, st.sampled_from(["failed", "killed"]))
    old = draw(st.dictionaries(st.sampled_from(free), st.integers(1, 9), max_size=3))
    return Case(
        scenario_of(robots, **fields),
        ground,
        list(starts),
        {place: TagWrite(place, revision, b"old") for place, revision in old.items()},
        draw(st.dictionaries(st.integers(0, 40), loss, max_size=2)),
    )


def faults(robots: int, places: list[int]) -> st.SearchStrategy[dict[str, Any]]:
    number = st.integers(0, robots - 1)
    place = st.sampled_from(places)
    words = st.sampled_from(["erase_tag", "corrupt_tag", "destroy_tag"])
    what = st.one_of(
        number.map(lambda robot: {"kill": f"robot:{robot}"}),
        st.just({"kill": "world"}),
        st.builds(lambda word, at: {word: at}, words, place),
    )
    timed = st.builds(
        lambda at, round_: {"at": at / 2, "round": round_}, st.integers(0, 60), st.integers(0, 2)
    )
    at_request = st.builds(
        lambda whose, n: {"of": f"robot:{whose}", "at_request": n}, number, st.integers(1, 25)
    )

    def joined(fault: dict[str, Any], when: dict[str, Any]) -> dict[str, Any]:
        if "of" in when and fault.get("kill", "").startswith("robot"):
            return {**fault, "at_request": when["at_request"]}  # its own: it is lost then
        return {**fault, **when}

    return st.builds(joined, what, timed | at_request)


@settings(max_examples=150, suppress_health_check=[HealthCheck.too_slow])
@given(cases(), st.data())
def test_a_restored_world_goes_on_as_the_original(case: Case, data: st.DataObject) -> None:
    tape = taped(case)
    if not tape.quiet:
        return  # it was over in its first instant
    for quiet in data.draw(st.lists(st.sampled_from(tape.quiet), min_size=1, max_size=3)):
        events: list[Event] = []
        writes: list[tuple[int, int, bytes]] = []
        world = case.world(observe=events.append, on_write=noting(writes))
        world.restore(decode_state(quiet.state))
        assert world.state() == decode_state(quiet.state)
        assert world.begin() == tape.outputs[quiet.inputs]
        for given_, expected in zip(
            tape.inputs[quiet.inputs :], tape.outputs[quiet.inputs + 1 :], strict=True
        ):
            assert world.resume(given_) == expected
        assert events == tape.events[quiet.events :]
        assert writes == tape.writes[quiet.writes :]
        assert world.state() == tape.world.state()
        assert world.progress() == tape.world.progress()
        assert world.waiting() == tape.world.waiting()
        assert world.alive() == tape.world.alive()


def test_nothing_of_a_world_is_forgotten() -> None:
    """Whoever gives a world one more attribute decides here what becomes of it in a snapshot."""
    of_the_scenario = """_believed _blind _capacity _eyes _latency _leave _move_duration
        _notices_reach _observe _radio _rounds_max _scenario _see _sense _starts _terrain _tick
        _wait_duration on_write"""
    of_one_instant = "_in_turn _next _play _round _wave _when_quiet"
    saved = """_agenda _alive _at_request _clock _destroyed _ether _faults _in_air _moves _resting
        _steering _unseen _visited bodies refusals revisions struck struck_at tags time"""
    world = Case(scenario_of(1), graph_of("01"), [0], {}, {}).world()
    assert set(vars(world)) == {*of_the_scenario.split(), *of_one_instant.split(), *saved.split()}
    body = {"robot", "has_news"}
    fields = set(type(decode_state(encode(world.state())).bodies[0]).__struct_fields__)
    assert set(type(world.bodies[0]).__slots__) - body == fields


def test_a_snapshot_is_taken_only_where_it_was_asked_for_and_nobody_is_in_turn() -> None:
    case = Case(scenario_of(2), graph_of("01 12 20"), [0, 0], {}, {})
    taken: list[WorldState] = []
    world = case.world()
    output = world.begin()
    assert isinstance(output, Wave)
    output = world.resume(Answers([Look(), Look()]))
    world.when_quiet(taken.append)
    assert isinstance(output, Wave)  # of the first round: one robot after another
    output = world.resume(Answers([Write(b"a", ())]))
    assert isinstance(output, Wave)
    assert not taken
    while isinstance(output, Wave) and world.time == 0:
        output = world.resume(Answers([wait_of(robot) for robot in output.robots]))
    assert [state.time for state in taken] == [0.0]
    assert isinstance(output, Wave)
    world.resume(Answers([wait_of(robot) for robot in output.robots]))
    assert len(taken) == 1


def wait_of(robot: int) -> AnyRequest:
    return Wait(None, (), robot + 1.0)


# Runs that are taken over, by several lives.


class Store:
    """A store that never forgets: number of the last batch that it applied, and the tags."""

    def __init__(self) -> None:
        self.wave = 0
        self.tags: dict[int, tuple[int, bytes]] = {}

    def apply(self, batch: Batch) -> int:
        """Apply a batch unless it is late; return what is acknowledged."""
        if batch.wave > self.wave:
            self.wave = batch.wave
            self.tags |= {write.place: (write.revision, write.tag) for write in batch.writes}
        return self.wave


def drained(writes: WriteBehind, store: Store) -> dict[int, tuple[int, bytes]]:
    """Let a store have all writes; return its tags."""
    writes.flush()
    while not writes.idle:
        batch = writes.take(1e9) or writes.repeat(1e9)
        assert batch is not None
        assert batch.incarnation == writes.incarnation
        writes.acknowledged(store.apply(batch))
    return store.tags


def record_of(given_: Input, output: Output) -> WaveRecord | OldTags | CarriedOut:
    """Return what a world server journals before it gives its world an input."""
    if isinstance(given_, Answers):
        return WaveRecord(given_.requests, given_.lost)
    if isinstance(output, KillOrder | FaultOrder):
        return CarriedOut(output.fault)
    assert isinstance(given_, tuple)
    return OldTags(given_)


def born(folder: Path, tape: Tape) -> Path:
    """Write the opening of a run into a new folder; return its journal."""
    folder.mkdir()
    case = tape.case
    journal = Journal(folder / "journal")
    tree = to_tree(case.scenario)
    journal.append(opening(RUN, "processes", tree, case.ground, tuple(case.starts)))
    journal.close()
    return folder / "journal"


def live(
    folder: Path, tape: Tape, store: Store, *, inputs: int, every: int, ticks: Iterator[int]
) -> Recovered:
    """Take a run over, as a world server does, and die after so many inputs (or at its end).

    Args:
        folder: of the run.
        tape: what is played.
        store: talks to us through a window that opens now and then.
        inputs: how many inputs this life commits.
        every: requests between two snapshots.
        ticks: drawn: what happens between two inputs; 0: nothing, 1: a batch arrives, 2: it arrives
            and its acknowledgement too.
    """
    found = recover(folder, RUN)
    assert found.misfit == ""
    world, writes, digest = found.replayed.world, found.store, found.replayed.digest
    incarnation = writes.incarnation
    found.journal.append(Incarnation(incarnation))
    found.journal.append(Joined(0, f"process-{incarnation}", f"nonce-{incarnation}"))
    snapshots = SnapshotFile(
        snapshot_of(folder), folder / "journal", every_requests=every, last=found.snapshot
    )

    def take(state: WorldState) -> None:
        snapshots.take(
            Snapshot(
                SCHEMA_VERSION,
                RUN,
                found.journal.end,
                0,
                incarnation,
                (Joined(0, f"process-{incarnation}", f"nonce-{incarnation}"),),
                state,
                digest.state(),
                writes.state(),
            )
        )

    writes.resume(store.wave)
    position = writes.last_wave - 1  # to begin is the first that a world is given
    output = found.replayed.output
    assert output == tape.outputs[position]
    for given_ in tape.inputs[position : position + inputs]:
        tick = next(ticks)
        now_s = position * 0.03
        batch = writes.take(now_s) or writes.repeat(now_s)
        if batch is not None and tick:
            acknowledged = store.apply(batch)
            if tick > 1:
                writes.acknowledged(acknowledged)
        snapshots.write()
        found.journal.append(record_of(given_, output))
        if snapshots.due(1):
            world.when_quiet(take)
        writes.next_wave()
        output = world.resume(given_)
        position += 1
        assert output == tape.outputs[position]
    if position == len(tape.inputs):
        drained(writes, store)
        found.journal.append(Closing("over", digest.hexdigest(), 0.0))
    found.journal.close()
    return found


@settings(
    max_examples=60,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
@given(case=cases(), data=st.data())
def test_many_lives_are_one_run(
    case: Case, data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Whoever takes over goes on exactly where the last one died; store and trace show nothing."""
    tape = taped(case)
    folder = tmp_path_factory.mktemp("lives") / "run"
    journal = born(folder, tape)
    store = Store()
    every = data.draw(st.sampled_from([1, 5, 20, 1000]))
    ticks = iter(data.draw(st.lists(st.integers(0, 2), min_size=500, max_size=500)) * 100)
    for inputs in data.draw(st.lists(st.integers(0, 40), max_size=4)):
        live(folder, tape, store, inputs=inputs, every=every, ticks=ticks)
        torn = data.draw(st.binary(max_size=11))
        journal.write_bytes(journal.read_bytes() + torn)
    last = live(folder, tape, store, inputs=1 << 30, every=every, ticks=ticks)
    replayed = replay(journal)
    assert replayed.trace_sha256 == sha256(tape.events) == last.replayed.digest.hexdigest()
    assert replayed.incarnations == last.store.incarnation
    assert replayed.joined[0].nonce == f"nonce-{replayed.incarnations}"
    assert last.replayed.world.state() == tape.world.state() == replayed.world.state()
    written = {place: (revision, tag) for place, revision, tag in tape.writes}
    assert store.tags == written
    again = recover(folder, RUN)
    again.journal.close()
    assert again.replayed.closing is not None
    assert again.replayed.trace_sha256 == sha256(tape.events)
    again.store.resume(store.wave)
    assert again.store.idle


# One run in detail.

TREE = tree_of([child // 3 for child in range(60)])
LONG = Case(
    scenario_of(
        12,
        seed=17,
        clock={"mode": "event", "jitter": 0.5},
        radio={"reach": "global", "latency": 1.5, "loss": 0.2},
        faults=[{"kill": "robot:1", "at": 9.5}, {"erase_tag": 0, "at": 9.5}],
    ),
    TREE,
    [0, 0, *range(5, 15)],
    {},
    {},
)
"""A run with something of everything."""


@pytest.fixture(scope="module", name="long")
def long_fixture() -> Tape:
    tape = taped(LONG)
    assert len(tape.inputs) > 150
    return tape


def snapshots_of(folder: Path, tape: Tape) -> list[tuple[bytes, int]]:
    """Play a run in one life; return each of its snapshots and how much of the journal it covers."""
    born(folder, tape)
    found: list[tuple[bytes, int]] = []
    store, ticks = Store(), iter(lambda: 0, 1)
    for _ in range(len(tape.inputs)):
        live(folder, tape, store, inputs=4, every=3, ticks=ticks)
        path = snapshot_of(folder)
        if path.exists():
            snapshot = read_snapshot(path, RUN, folder / "journal")
            assert snapshot is not None
            if not found or found[-1][1] < snapshot.journal_bytes:
                found.append((path.read_bytes(), snapshot.journal_bytes))
        *_, (record, _) = scan(folder / "journal")
        if isinstance(record, Closing):
            return found
    raise AssertionError("no end")


def same(one: Recovered, other: Recovered) -> None:
    """Check that two recoveries found the same."""
    a, b = one.replayed, other.replayed
    assert a.output == b.output
    assert a.world.state() == b.world.state()
    assert a.digest.state() == b.digest.state()
    assert a.joined == b.joined
    assert a.end == b.end
    assert (a.closing, a.incarnations) == (b.closing, b.incarnations)
    assert one.store.last_wave == other.store.last_wave
    for found in (one, other):
        found.journal.close()
        found.store.resume(0)
    assert drained(one.store, Store()) == drained(other.store, Store())


def test_a_journal_cut_behind_a_snapshot_is_recovered_as_without(
    long: Tape, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    taken = snapshots_of(folder, long)
    assert len(taken) > 10
    journal = (folder / "journal").read_bytes()
    ends = [end for _, end in scan(folder / "journal")]
    for snapshot, covered in taken[:: len(taken) // 5]:
        behind = [end for end in ends if end >= covered]
        for end in [*behind[:3], *behind[3::9], behind[-1]]:
            recovered = []
            for name, with_snapshot in (("with", True), ("without", False)):
                copy = tmp_path / name
                copy.mkdir(exist_ok=True)
                (copy / "journal").write_bytes(journal[:end])
                snapshot_of(copy).unlink(missing_ok=True)
                if with_snapshot:
                    snapshot_of(copy).write_bytes(snapshot)
                recovered.append(recover(copy, RUN))
                assert (recovered[-1].snapshot is not None) == with_snapshot
            same(*recovered)


@pytest.fixture(scope="module", name="halfway")
def halfway_fixture(long: Tape, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that was left after 60 inputs, with a snapshot of about the fiftieth."""
    folder = tmp_path_factory.mktemp("halfway") / "run"
    born(folder, long)
    live(folder, long, Store(), inputs=60, every=25, ticks=iter(lambda: 0, 1))
    assert read_snapshot(snapshot_of(folder), RUN, folder / "journal") is not None
    return folder


def copy_of(folder: Path, to: Path) -> Path:
    to.mkdir()
    for path in folder.iterdir():
        (to / path.name).write_bytes(path.read_bytes())
    return to


def check_falls_back(halfway: Path, changed: Path, why: str) -> None:
    """Check that the snapshot of a changed copy is not used, and that nothing else changes."""
    with pytest.raises(JournalError, match=why):
        read_snapshot(snapshot_of(changed), RUN, changed / "journal")
    found = recover(changed, RUN)
    assert found.snapshot is None
    assert "snapshot" in found.misfit
    plain = changed.parent / "plain"
    copy_of(halfway, plain)
    snapshot_of(plain).unlink()
    same(found, recover(plain, RUN))


@pytest.mark.parametrize("where", [0, 10, 17, 18, 25, 33, 1000, -1])
def test_a_damaged_snapshot_is_not_used(halfway: Path, tmp_path: Path, where: int) -> None:
    changed = copy_of(halfway, tmp_path / "changed")
    content = bytearray(snapshot_of(changed).read_bytes())
    content[where] ^= 4
    snapshot_of(changed).write_bytes(content)
    check_falls_back(halfway, changed, "snapshot")


@pytest.mark.parametrize("size", [0, 5, 18, 20, 29, 30, 1000, -1])
def test_a_snapshot_that_was_cut_is_not_used(halfway: Path, tmp_path: Path, size: int) -> None:
    changed = copy_of(halfway, tmp_path / "changed")
    snapshot_of(changed).write_bytes(snapshot_of(changed).read_bytes()[:size])
    check_falls_back(halfway, changed, "snapshot")


@settings(max_examples=150)
@given(data=st.data())
def test_a_flipped_bit_of_a_snapshot_is_noticed(halfway: Path, data: st.DataObject) -> None:
    content = bytearray(snapshot_of(halfway).read_bytes())
    position = data.draw(st.integers(0, len(content) * 8 - 1))
    content[position // 8] ^= 1 << position % 8
    changed = halfway.parent / "flipped"
    changed.write_bytes(content)
    with pytest.raises(JournalError):
        read_snapshot(changed, RUN, halfway / "journal")


def rewritten(folder: Path, **fields: Any) -> None:
    """Write a snapshot anew with other fields, whole and with the right checksums."""
    found = read_snapshot(snapshot_of(folder), RUN, folder / "journal")
    assert found is not None
    other = SnapshotFile(snapshot_of(folder), folder / "journal")
    other.take(replace(found, **fields))
    other.write()


@pytest.mark.parametrize(
    ("fields", "why"),
    [({"run": "run-2"}, "of run run-2"), ({"schema": SCHEMA_VERSION + 1}, "by schema")],
)
def test_a_snapshot_of_another_run_is_not_used(
    halfway: Path, tmp_path: Path, fields: dict[str, Any], why: str
) -> None:
    changed = copy_of(halfway, tmp_path / "changed")
    rewritten(changed, **fields)
    check_falls_back(halfway, changed, why)


def test_a_snapshot_of_another_state_is_found_out_by_what_follows(
    halfway: Path, tmp_path: Path
) -> None:
    """Whole, of this run, and wrong: the journal does not fit it, and has the last word."""
    changed = copy_of(halfway, tmp_path / "changed")
    found = read_snapshot(snapshot_of(changed), RUN, changed / "journal")
    assert found is not None
    rewritten(changed, world=replace(found.world, agenda=[]))
    assert read_snapshot(snapshot_of(changed), RUN, changed / "journal") is not None
    recovered = recover(changed, RUN)
    assert recovered.snapshot is None
    assert "fits" in recovered.misfit
    plain = copy_of(halfway, tmp_path / "plain")
    snapshot_of(plain).unlink()
    same(recovered, recover(plain, RUN))


def test_a_snapshot_of_more_than_there_is_of_the_journal_is_not_used(
    halfway: Path, tmp_path: Path
) -> None:
    """The machine lost power: the snapshot reached the disk, the end of the journal did not."""
    changed = copy_of(halfway, tmp_path / "changed")
    found = read_snapshot(snapshot_of(changed), RUN, changed / "journal")
    assert found is not None
    whole = (changed / "journal").read_bytes()
    (changed / "journal").write_bytes(whole[: found.journal_bytes - 1])
    recovered = recover(changed, RUN)
    recovered.journal.close()
    assert recovered.snapshot is None
    assert f"first {found.journal_bytes} bytes" in recovered.misfit
    assert recovered.replayed.end < found.journal_bytes


def test_damage_of_the_journal_before_the_snapshot_is_noticed(
    halfway: Path, tmp_path: Path
) -> None:
    changed = copy_of(halfway, tmp_path / "changed")
    found = read_snapshot(snapshot_of(changed), RUN, changed / "journal")
    assert found is not None
    whole = bytearray((changed / "journal").read_bytes())
    _, behind_opening = next(scan(changed / "journal"))
    whole[(behind_opening + found.journal_bytes) // 2] ^= 16
    (changed / "journal").write_bytes(whole)
    with pytest.raises(JournalError, match="journal: offset"):
        recover(changed, RUN)
    os.close(hold(changed / "journal"))  # nobody holds it any longer


def test_without_a_snapshot_there_is_nothing_to_say(halfway: Path, tmp_path: Path) -> None:
    changed = copy_of(halfway, tmp_path / "changed")
    snapshot_of(changed).unlink()
    recovered = recover(changed, RUN)
    recovered.journal.close()
    assert (recovered.snapshot, recovered.misfit) == (None, "")


# The file.


def test_a_snapshot_that_was_being_written_leaves_the_last_one(
    halfway: Path, tmp_path: Path
) -> None:
    changed = copy_of(halfway, tmp_path / "changed")
    (changed / "snapshot.new").write_bytes(b"half of it")
    recovered = recover(changed, RUN)
    recovered.journal.close()
    assert recovered.snapshot is not None
    file = SnapshotFile(snapshot_of(changed), changed / "journal", last=recovered.snapshot)
    file.take(recovered.snapshot)
    file.write()
    assert {path.name for path in changed.iterdir()} == {"journal", "snapshot"}
    assert read_snapshot(snapshot_of(changed), RUN, changed / "journal") == recovered.snapshot
    file.remove()
    file.remove()
    assert {path.name for path in changed.iterdir()} == {"journal"}


@pytest.mark.parametrize("durability", ["process", "power"])
def test_a_snapshot_is_due_by_requests_and_by_its_size(
    halfway: Path, tmp_path: Path, durability: Any
) -> None:
    found = read_snapshot(snapshot_of(halfway), RUN, halfway / "journal")
    assert found is not None
    path = tmp_path / "snapshot"
    file = SnapshotFile(path, halfway / "journal", every_requests=10, durability=durability)
    assert [file.due(4), file.due(4), file.due(4), file.due(1)] == [False, False, True, True]
    file.write()  # nothing was taken
    assert not path.exists()
    file.take(found)
    file.write()
    assert read_snapshot(path, RUN, halfway / "journal") == found
    left = (path.stat().st_size - 30) // BYTES_PER_REQUEST
    assert left > 20
    assert not file.due(left - 1)
    assert file.due(1)


def test_a_checksum_goes_on_and_knows_the_end(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(bytes(range(256)) * 10_000)
    whole = checksum(path, 0, 2_560_000)
    half = checksum(path, 0, 1_100_001)
    assert half is not None
    assert checksum(path, 1_100_001, 2_560_000, half) == whole
    assert checksum(path, 0, 2_560_001) is None
    assert checksum(path, 5, 5, 77) == 77


# The store.


def test_a_store_that_lost_its_end_gets_all_writes_again(long: Tape, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    journal = born(folder, long)
    live(folder, long, Store(), inputs=80, every=20, ticks=iter(lambda: 2, 0))
    recovered = recover(folder, RUN)
    recovered.journal.close()
    assert recovered.snapshot is not None
    assert recovered.store.known_wave > 0
    empty = Store()
    with pytest.raises(StoreError, match="lost its end"):
        recovered.store.resume(empty.wave)
    writes = all_writes(journal, 7)
    writes.resume(empty.wave)
    drained(writes, empty)
    world = recovered.replayed.world
    assert empty.tags == {
        place: (world.revisions[place], world.tags[place]) for place in empty.tags
    }
    assert set(empty.tags) == {place for place, revision in enumerate(world.revisions) if revision}
    assert len(empty.tags) > 5


# The lock.


def test_a_journal_has_one_writer(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    journal = Journal(path)
    for another in (lambda: Journal(path), lambda: hold(path)):
        with pytest.raises(JournalError, match="another world server is alive on this run"):
            another()
    journal.append(Incarnation(1))
    assert [record for record, _ in scan(path)] == [Incarnation(1)]  # readers are welcome
    journal.close()
    Journal(path).close()


def test_a_world_that_is_alive_keeps_others_from_its_run(halfway: Path, tmp_path: Path) -> None:
    folder = copy_of(halfway, tmp_path / "run")
    first = recover(folder, RUN)
    with pytest.raises(JournalError, match="another world server is alive on this run"):
        recover(folder, RUN)
    first.journal.append(Incarnation(2))
    first.journal.close()
    second = recover(folder, RUN)
    second.journal.close()
    assert second.store.incarnation == first.store.incarnation + 1


def test_there_is_nothing_to_take_over_in_an_empty_folder(tmp_path: Path) -> None:
    with pytest.raises(JournalError, match="expected a journal"):
        recover(tmp_path, RUN)
    assert list(tmp_path.iterdir()) == []


HOLDER = """
import sys
from pathlib import Path
from world_server.journal import Journal
journal = Journal(Path(sys.argv[1]))
print("held", flush=True)
sys.stdin.readline()
"""


def test_a_world_that_was_killed_holds_nothing(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"held\n"
        with pytest.raises(JournalError, match="another world server is alive"):
            Journal(path)
        holder.send_signal(signal.SIGKILL)
        holder.wait()
    Journal(path).close()


# Runs of processes.


def snapshots_every(requests: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the world servers of this test take snapshots more often."""
    start = Supervisor.start

    async def start_so(self: Supervisor, name: str, command: list[str], **more: Any) -> None:
        option = ["--snapshot-every", str(requests)] if name == "world" else []
        await start(self, name, [*command, *option], **more)

    monkeypatch.setattr(Supervisor, "start", start_so)


def check_world_kills(at: list[float], folder: Path, **fields: Any) -> str:
    """Play a run whose world dies at these times; return what its lives said."""
    kills = [{"kill": "world", "at": time} for time in at]
    setting = setting_of(TREE, 3, faults=kills, **fields)
    run = play_run(setting, folder, "processes")
    alone = play_run(setting_of(TREE, 3, **fields), folder, "inprocess")
    assert run.trace_sha256 == alone.trace_sha256
    assert run.restarts["world"] == len(at)
    assert not list(run.folder.path.glob("snapshot*"))  # the run is over
    return (run.folder.logs / "world.log").read_text()


def test_a_world_that_dies_goes_on_from_its_snapshot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    snapshots_every(20, monkeypatch)
    said = check_world_kills([20, 40], tmp_path)
    lines = [line for line in said.splitlines() if line.startswith("life ")]
    assert [line.partition(":")[0] for line in lines] == ["life 2", "life 3"]
    begins = [int(line.partition("from byte ")[2].split()[0]) for line in lines]
    assert 0 < begins[0] < begins[1]


@pytest.mark.slow
@pytest.mark.parametrize("durability", ["process", "power"])
@pytest.mark.parametrize("clock", [{}, {"mode": "event", "jitter": 0.5}], ids=["lockstep", "event"])
def test_a_world_that_dies_again_and_again_leaves_the_trace_as_it_is(
    clock: dict[str, Any], durability: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    snapshots_every(10, monkeypatch)
    times = [float(time) for time in range(3, 40, 6)]
    said = check_world_kills(times, tmp_path, clock=clock, durability=durability)
    assert said.count("from byte ") == len(times)
    assert "snapshot was not used" not in said
