"""The journal: what a crash or a flipped bit does to it, and replay."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from agents.body import Body as RobotBody
from agents.body import Driver
from agents.registry import algorithm_of
from protocol.codec import encode
from protocol.errors import JournalError, ReplayError
from protocol.graph import PortGraph
from protocol.messages import Look, Move, TagWrite, Write
from protocol.scenario import to_tree
from protocol.trace import Event, first_difference
from tests.play import graph_of, scenario_of, sha256
from world_server.journal import (
    MAGIC,
    AnyRecord,
    Closing,
    Incarnation,
    Joined,
    Journal,
    OldTags,
    WaveRecord,
    opening,
    scan,
)
from world_server.replay import read_opening, replay
from world_server.terrain import GraphTerrain
from world_server.world import Answers, End, KillOrder, TagsWanted, Wave, World

GRAPH = graph_of("01 02 12 13 23", lengths=[1.0, None, 0.0, 2.5, 1.0])


def opening_of(graph: PortGraph = GRAPH) -> AnyRecord:
    return opening("run-1", "test", to_tree(scenario_of(2)), graph, (0, 0))


RECORDS: list[AnyRecord] = [
    opening_of(),
    Incarnation(1),
    Joined(0, "abc", "00ff"),
    WaveRecord([Look(), None], ((1, "failed"),)),
    WaveRecord([Move(b"\x00\x01", (b"m",), 2)]),
    OldTags((TagWrite(3, 4, b"old"),)),
    Closing("over", "00" * 32, 0.5),
]


def written(path: Path, records: list[AnyRecord], durability: Any = "process") -> Path:
    journal = Journal(path, durability)
    for record in records:
        journal.append(record)
    journal.close()
    return path


def read(path: Path) -> list[AnyRecord]:
    return [record for record, _ in scan(path)]


def bodies(records: Iterable[AnyRecord]) -> list[bytes]:
    """Return the records as they stand in a file."""
    return [encode(record) for record in records]


def ends(path: Path) -> list[int]:
    return [end for _, end in scan(path)]


@pytest.mark.parametrize("durability", ["process", "power"])
def test_what_was_written_is_read(tmp_path: Path, durability: str) -> None:
    path = written(tmp_path / "journal", RECORDS, durability)
    assert bodies(read(path)) == bodies(RECORDS)
    assert ends(path)[-1] == path.stat().st_size
    assert path.read_bytes().startswith(MAGIC)


def test_the_opening_keeps_the_graph(tmp_path: Path) -> None:
    positions = [(0.5, 1.0), (2.0, 3.0), (4.0, 5.0), (6.0, 7.0)]
    graph = PortGraph(["a", "b", "ä", "d"], GRAPH.ends, GRAPH.lengths, positions)
    found = read_opening(written(tmp_path / "journal", [opening_of(graph)])).ground.restored()
    for field in PortGraph.__slots__:
        assert getattr(found, field) == getattr(graph, field)


def test_a_torn_tail_is_dropped_at_every_byte(tmp_path: Path) -> None:
    path = written(tmp_path / "journal", RECORDS)
    whole, last = path.read_bytes(), ends(path)[-2]
    for size in range(last, len(whole)):
        path.write_bytes(whole[:size])
        assert bodies(read(path)) == bodies(RECORDS[:-1])


def test_a_journal_cut_anywhere_is_a_beginning_of_it(tmp_path: Path) -> None:
    path = written(tmp_path / "journal", RECORDS)
    whole, offsets = path.read_bytes(), ends(path)
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        assert bodies(read(path)) == bodies(RECORDS)[: sum(offset <= size for offset in offsets)]


def test_a_journal_is_continued_behind_its_last_whole_record(tmp_path: Path) -> None:
    path = written(tmp_path / "journal", RECORDS)
    whole, offsets = path.read_bytes(), ends(path)
    for size in {0, 5, len(MAGIC), len(MAGIC) + 3, offsets[2] + 7, len(whole) - 1, len(whole)}:
        path.write_bytes(whole[:size])
        kept = RECORDS[: sum(offset <= size for offset in offsets)]
        found = read(written(path, [Incarnation(7)]))
        assert bodies(found) == bodies([*kept, Incarnation(7)])


def test_a_flipped_bit_is_refused_wherever_it_is(tmp_path: Path) -> None:
    path = written(tmp_path / "journal", RECORDS)
    whole = bytearray(path.read_bytes())
    starts = [len(MAGIC), *ends(path)]
    for position in range(len(whole)):
        bit = 1 << position % 8
        whole[position] ^= bit
        path.write_bytes(whole)
        whole[position] ^= bit
        start = max((start for start in starts if start <= position), default=0)
        with pytest.raises(JournalError) as caught:
            read(path)
        assert f"{path}: offset {start}: " in str(caught.value)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_any_flipped_bit_is_refused(tmp_path: Path, data: st.DataObject) -> None:
    path = tmp_path / "journal"
    path.unlink(missing_ok=True)
    whole = bytearray(written(path, RECORDS).read_bytes())
    position = data.draw(st.integers(0, len(whole) * 8 - 1))
    whole[position // 8] ^= 1 << position % 8
    path.write_bytes(whole)
    with pytest.raises(JournalError, match="offset"):
        read(path)


def test_a_damaged_journal_is_not_continued(tmp_path: Path) -> None:
    path = written(tmp_path / "journal", RECORDS)
    whole = bytearray(path.read_bytes())
    whole[ends(path)[1] + 14] ^= 1
    path.write_bytes(whole)
    with pytest.raises(JournalError):
        Journal(path)
    assert path.read_bytes() == bytes(whole)


@pytest.mark.parametrize(
    "content", [b"something else entirely", b"canopy journal 2\n", b"\x00" * 40]
)
def test_another_file_is_no_journal(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "journal").write_bytes(content)
    with pytest.raises(JournalError, match="offset 0: no Canopy journal"):
        read(tmp_path / "journal")


def test_no_file_is_no_journal(tmp_path: Path) -> None:
    with pytest.raises(JournalError, match=r"journal: .*expected a journal"):
        read(tmp_path / "journal")
    with pytest.raises(JournalError):
        read(tmp_path)


def test_a_run_that_never_began(tmp_path: Path) -> None:
    for records in ([], [Incarnation(1)]):
        path = written(tmp_path / f"journal{len(records)}", list(records))
        with pytest.raises(JournalError, match="the run never began"):
            read_opening(path)


# Replay.

FIELDS: list[dict[str, Any]] = [
    {},
    {"clock": {"mode": "event", "jitter": 0.5}, "seed": 3},
    {
        "faults": [
            {"kill": "robot:0", "at": 2.5},
            {"kill": "robot:1", "at_request": 6},
        ]
    },
    {"bookkeeping": {"fresh": False}, "faults": [{"kill": "robot:2", "at": 1, "round": 1}]},
]


def journalled(
    path: Path, fields: dict[str, Any], stop_after: int | None = None
) -> tuple[World, list[Event]]:
    """Play MR-DFS with three robots and a journal; perhaps only so many waves of it."""
    scenario = scenario_of(3, **fields)
    events: list[Event] = []
    world = World(scenario, GraphTerrain(GRAPH), [0] * 3, observe=events.append)
    algorithm = algorithm_of("mr-dfs", {})
    drivers = [Driver(algorithm, RobotBody(world.briefing(robot))) for robot in range(3)]
    journal = Journal(path)
    journal.append(opening("run-1", "test", to_tree(scenario), GRAPH, (0, 0, 0)))
    output, waves = world.begin(), 0
    while not isinstance(output, End) and waves != stop_after:
        if isinstance(output, Wave):
            waves += 1
            turns = zip(output.robots, output.sights, strict=True)
            requests: Any = [drivers[robot].next_request(sight) for robot, sight in turns]
            journal.append(WaveRecord(requests))
            output = world.resume(Answers(requests))
        elif isinstance(output, TagsWanted):
            old = tuple(TagWrite(place, 5, b"\x02\x00") for place in output.places if place == 3)
            journal.append(OldTags(old))
            output = world.resume(old)
        else:
            output = world.resume(None)
    if isinstance(output, End):
        journal.append(Closing(output.status, sha256(events), 0.0))
    journal.close()
    for driver in drivers:
        driver.close()
    return world, events


@pytest.mark.parametrize("fields", FIELDS)
def test_a_replay_gives_the_trace_of_the_run(tmp_path: Path, fields: dict[str, Any]) -> None:
    world, events = journalled(tmp_path / "journal", fields)
    replayed_events: list[Event] = []
    replayed = replay(tmp_path / "journal", observe=replayed_events.append)
    assert first_difference(events, replayed_events) is None
    assert replayed.trace_sha256 == sha256(events)
    assert replayed.closing is not None
    assert replayed.closing.trace_sha256 == sha256(events)
    assert replayed.output == End("over")
    assert replayed.world.tags == world.tags
    assert replayed.world.struck == world.struck
    assert len(world.struck) == len(fields.get("faults", ()))


@pytest.mark.parametrize("fields", FIELDS)
def test_a_replay_until_t_is_the_trace_until_t(tmp_path: Path, fields: dict[str, Any]) -> None:
    _, events = journalled(tmp_path / "journal", fields)
    for until in (0.0, 1.0, 2.4, 2.5, 4.0, 99.0):
        found: list[Event] = []
        replay(tmp_path / "journal", observe=found.append, until=until)
        expected = [event for event in events if event.time <= until]
        assert first_difference(expected, found) is None, until


@pytest.mark.parametrize("fields", FIELDS)
def test_a_replay_of_a_run_cut_off_is_a_beginning_of_it(
    tmp_path: Path, fields: dict[str, Any]
) -> None:
    _, events = journalled(tmp_path / "whole", fields)
    for waves in range(0, 25, 4):
        path = tmp_path / f"cut{waves}"
        _, before = journalled(path, fields, stop_after=waves)
        found: list[Event] = []
        replayed = replay(path, observe=found.append)
        assert replayed.closing is None
        assert found[: len(before)] == before
        assert events[: len(found)] == found
        # A kill that was ordered was done; nothing else may follow what was recorded.
        assert all(event.what == "killed" for event in found[len(before) :])


def test_a_replay_asks_for_what_comes_next(tmp_path: Path) -> None:
    world, events = journalled(tmp_path / "journal", FIELDS[2], stop_after=6)
    replayed = replay(tmp_path / "journal", until_asked=True)
    assert isinstance(replayed.output, Wave | KillOrder)
    assert replayed.trace_sha256 == sha256(events)
    assert replayed.world.time == world.time


@pytest.mark.parametrize(
    "change",
    [
        lambda records: [*records[:3], *records[4:]],
        lambda records: [*records[:2], WaveRecord([*records[2].requests, Look()]), *records[3:]],
        lambda records: [*records[:2], OldTags(()), *records[2:]],
        lambda records: [*records[:-1], Closing("over", "00" * 32, 0.0)],
        lambda records: [*records[:2], WaveRecord([Write(b"\x02\x0f", ())]), *records[3:]],
    ],
)
def test_a_journal_that_does_not_fit_is_refused(
    tmp_path: Path, change: Callable[[list[Any]], list[AnyRecord]]
) -> None:
    journalled(tmp_path / "journal", {})
    changed = written(tmp_path / "changed", change(read(tmp_path / "journal")))
    with pytest.raises(ReplayError, match="changed"):
        replay(changed)
