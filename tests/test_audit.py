"""The audit: it finds nothing in a sound run, and each kind of damage where it should."""

import ast
import shutil
import sqlite3
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import structs
from msgspec.msgpack import decode

from agents.body import Algorithm, Body, Driver
from bookkeeping.sqlite_store import SqliteStore
from deploy.judged import judge_journal
from deploy.run_dir import RunDir
from deploy.verdict import audit
from deploy.verdict.audit import Audit
from deploy.verdict.audit_findings import SOURCE
from deploy.verdict.guarantees import Guarantee
from protocol.codec import encode
from protocol.graph import PortGraph
from protocol.grid import Grid
from protocol.messages import Batch, Move, Stop, TagWrite, Wait, Write
from protocol.records import framed, read_records
from protocol.scenario import Scenario, to_tree
from protocol.trace import NOBODY, Event, LossCause
from tests.play import asking, graph_of, graphs, grids, scenario_of
from tests.runs import play, setting_of
from world_server.journal import (
    CarriedOut,
    Closing,
    Incarnation,
    Joined,
    Journal,
    OldTags,
    WaveRecord,
    opening,
)
from world_server.terrain import terrain_of
from world_server.world import Answers, End, FaultOrder, KillOrder, TagsWanted, Wave, World

WHOLE = "the journal is whole"
KEPT = "nothing acknowledged is missing"
ONCE = "no request applied twice, no robot in two places"
STORE = "the store holds the last tags"

SMALL = graph_of("01 12 23 34 40 13")


class Case(NamedTuple):
    """A run that is over: its folder, and its trace."""

    folder: Path
    events: list[Event]

    def copied(self, to: Path) -> "Case":
        """Return a copy, to be damaged."""
        return Case(shutil.copytree(self.folder, to), list(self.events))


def audited(case: Case) -> dict[str, Guarantee]:
    """Audit a run; return the guarantees by name."""
    auditor = Audit(case.folder)
    for event in case.events:
        auditor.observe(event)
    report = auditor.report()
    assert [claim.name for claim in report] == [WHOLE, KEPT, ONCE, STORE]
    assert {claim.source for claim in report} == {SOURCE}
    assert all(claim.detail for claim in report)
    return {claim.name: claim for claim in report}


def verdicts(case: Case) -> dict[str, bool | None]:
    """Audit a run; return which guarantees held."""
    return {name: claim.holds for name, claim in audited(case).items()}


def broken(case: Case) -> set[str]:
    """Audit a run; return the guarantees that were broken."""
    return {name for name, holds in verdicts(case).items() if holds is False}


# Runs with real processes and real kills.


def played(folder: Path, **fields: Any) -> Case:
    """Play three robots by processes; the verdict has the audit in it, and nothing is broken."""
    run = play(setting_of(SMALL, 3, **fields), folder, "processes")
    events: list[Event] = []
    result = judge_journal(run.folder.journal, also=events.append).result
    assert (run.status, run.restarts["world"]) == ("over", 1)
    assert [claim for claim in result.guarantees if claim.holds is False] == []
    assert [claim.name for claim in result.guarantees[-4:]] == [WHOLE, KEPT, ONCE, STORE]
    # A store that is killed at the very end leaves its log; reading it must leave nothing more.
    assert not list(run.folder.path.glob("*-shm"))
    return Case(run.folder.path, events)


@pytest.fixture(scope="module", name="lossy")
def lossy_fixture(tmp_path_factory: pytest.TempPathFactory) -> Case:
    """A run that lost a robot by order, and in which world and store were killed and devices failed."""
    faults = [
        {"kill": "world", "at": 3},
        {"kill": "bookkeeping", "at": 4},
        {"kill": "robot:1", "at": 4},
        {"erase_tag": 1, "at": 4},
        {"destroy_tag": 2, "at": 5},
    ]
    return played(tmp_path_factory.mktemp("lossy"), faults=faults)


@pytest.fixture(scope="module", name="restarting")
def restarting_fixture(tmp_path_factory: pytest.TempPathFactory) -> Case:
    """A run in which world and store were killed, and two robots came back."""
    faults = [
        {"kill": "world", "at": 3},
        {"kill": "bookkeeping", "at": 3},
        {"kill": "robot:1", "at": 2},
        {"kill": "robot:2", "at_request": 5},
    ]
    folder = tmp_path_factory.mktemp("restarting")
    return played(folder, team={"on_crash": "restart"}, faults=faults)


def test_a_run_with_kills_and_losses_passes(lossy: Case):
    found = audited(lossy)
    assert {name: claim.holds for name, claim in found.items()} == {
        WHOLE: True,
        KEPT: None,
        ONCE: True,
        STORE: True,
    }
    requests = sum(not isinstance(event.what, str) for event in lossy.events)
    assert f"2 lives, 3 joins, {waves_in(lossy)} waves with {requests} requests" in (
        found[WHOLE].detail
    )
    assert "1 kills by order" in found[WHOLE].detail
    assert f"{requests} requests of 3 robots" in found[ONCE].detail
    assert "5 places written" in found[STORE].detail


def test_a_run_in_which_robots_come_back_passes(restarting: Case):
    found = audited(restarting)
    assert {claim.holds for claim in found.values()} == {True}
    # All but the last request of each robot, its stop, were answered by a sight.
    assert found[KEPT].detail.startswith(f"{len(restarting.events) - 3} replies kept by 3 robots")


@pytest.mark.slow
def test_runs_of_other_kinds_pass(tmp_path: Path):
    played(tmp_path, clock={"mode": "event", "jitter": 0.3}, faults=[{"kill": "world", "at": 3}])
    tags = [{"corrupt_tag": place, "at": 5} for place in range(5)]
    faults = [*tags, {"kill": "world", "at": 5}, {"kill": "robot:0", "at_request": 4}]
    played(tmp_path, device={"checksum": False}, faults=faults)
    database = str(tmp_path / "tags.db")
    once = {"bookkeeping": {"database": database}, "faults": [{"kill": "world", "at": 2}]}
    first = played(tmp_path, **once)
    assert verdicts(first)[STORE] is True
    again = {"bookkeeping": {"database": database, "fresh": False}}
    second = played(tmp_path, **again, faults=[{"kill": "world", "at": 2}])
    assert verdicts(second)[STORE] is True
    assert verdicts(first)[STORE] is None  # its tags are not there any more


# Damage to a journal, a memory, a store.


def records_of(path: Path, magic: int = 0) -> list[bytes]:
    """Return the body of each record behind so many bytes."""
    with path.open("rb") as file:
        file.seek(magic)
        return [body for body, _ in read_records(file, path, magic)]


def rewrite(path: Path, bodies: Iterable[bytes], magic: bytes = b"") -> None:
    """Write records anew, with checksums that are right."""
    path.write_bytes(magic + b"".join(map(framed, bodies)))


MAGIC = b"canopy journal 1\n"


def journal_of(case: Case) -> list[bytes]:
    return records_of(case.folder / "journal", len(MAGIC))


def kinds_of(case: Case) -> list[str]:
    return [decode(body)[0] for body in journal_of(case)]


def waves_in(case: Case) -> int:
    return kinds_of(case).count("wave")


def rewrite_journal(case: Case, bodies: Iterable[bytes]) -> None:
    rewrite(case.folder / "journal", bodies, MAGIC)


def nth(bodies: Sequence[bytes], kind: str, number: int = 0) -> int:
    """Return where the n-th record of a kind is; below 0 counts from the end."""
    return [at for at, body in enumerate(bodies) if decode(body)[0] == kind][number]


def dropped(kind: str, number: int = 0) -> Callable[[Case], None]:
    def damage(case: Case) -> None:
        bodies = journal_of(case)
        del bodies[nth(bodies, kind, number)]
        rewrite_journal(case, bodies)

    return damage


def repeated(kind: str, number: int = 0) -> Callable[[Case], None]:
    def damage(case: Case) -> None:
        bodies = journal_of(case)
        at = nth(bodies, kind, number)
        rewrite_journal(case, [*bodies[: at + 1], *bodies[at:]])

    return damage


def replaced(
    kind: str, number: int, change: Callable[[list[Any]], object]
) -> Callable[[Case], None]:
    """Change a record of the journal as plain values."""

    def damage(case: Case) -> None:
        bodies = journal_of(case)
        at = nth(bodies, kind, number)
        record = decode(bodies[at])
        change(record)
        rewrite_journal(case, [*bodies[:at], encode(record), *bodies[at + 1 :]])

    return damage


def swapped_waves(case: Case) -> None:
    bodies = journal_of(case)
    waves = [at for at, body in enumerate(bodies) if decode(body)[0] == "wave"]
    one, other = next((a, b) for a, b in pairwise(waves[3:]) if bodies[a] != bodies[b])
    bodies[one], bodies[other] = bodies[other], bodies[one]
    rewrite_journal(case, bodies)


def added(*record: Any) -> Callable[[Case], None]:
    def damage(case: Case) -> None:
        rewrite_journal(case, [*journal_of(case), encode(record)])

    return damage


def lost_wave_written(case: Case) -> None:
    """Make a request blank, as if its robot had been lost."""
    replaced("wave", -1, lambda record: record[1].__setitem__(0, None))(case)


def in_store(statement: str, *values: Any) -> Callable[[Case], None]:
    def damage(case: Case) -> None:
        with closing(sqlite3.connect(case.folder / "bookkeeping.db")) as database:
            database.execute(statement, values)
            database.commit()

    return damage


def garbage(name: str) -> Callable[[Case], None]:
    def damage(case: Case) -> None:
        (case.folder / name).write_bytes(b"garbage" * 1000)

    return damage


def gone(name: str) -> Callable[[Case], None]:
    def damage(case: Case) -> None:
        (case.folder / name).unlink()

    return damage


def in_memory(change: Callable[[list[bytes]], object], robot: int = 1) -> Callable[[Case], None]:
    def damage(case: Case) -> None:
        path = case.folder / f"robot-{robot}.memory"
        bodies = records_of(path)
        change(bodies)
        rewrite(path, bodies)

    return damage


def other_reply(bodies: list[bytes]) -> None:
    sight = decode(bodies[3])
    sight[5] += b"!"  # its tag
    bodies[3] = encode(sight)


def swap(items: list[Any], one: int, other: int) -> None:
    assert items[one] != items[other]
    items[one], items[other] = items[other], items[one]


def bit_flipped(name: str, share: float) -> Callable[[Case], None]:
    def damage(case: Case) -> None:
        path = case.folder / name
        content = bytearray(path.read_bytes())
        content[int(len(content) * share)] ^= 4
        path.write_bytes(content)

    return damage


def cut_short(name: str) -> Callable[[Case], None]:
    def damage(case: Case) -> None:
        path = case.folder / name
        path.write_bytes(path.read_bytes()[:-3])

    return damage


def event_at(
    case: Case, which: Callable[[Event], bool], number: int = 1, **fields: Any
) -> tuple[int, Event]:
    """Return where the n-th event of a kind is, and the event with other fields."""
    at = [index for index, event in enumerate(case.events) if which(event)][number]
    return at, structs.replace(case.events[at], **fields)


def is_move(event: Event) -> bool:
    return isinstance(event.what, Move)


def changed(**fields: Any) -> Callable[[Case], None]:
    """Change an event that follows a move of its robot."""

    def damage(case: Case) -> None:
        at, move = event_at(case, is_move)
        follows = (i for i, e in enumerate(case.events) if i > at and e.robot == move.robot)
        after = next(follows)
        found = {name: value(getattr(case.events[after], name)) for name, value in fields.items()}
        case.events[after] = structs.replace(case.events[after], **found)

    return damage


def event_twice(case: Case) -> None:
    at, event = event_at(case, is_move)
    case.events.insert(at, event)


def event_gone(case: Case) -> None:
    del case.events[event_at(case, is_move, 2)[0]]


def other_request(case: Case) -> None:
    at, event = event_at(case, is_move)
    assert isinstance(event.what, Move)
    other = structs.replace(event.what, tag=b"another")
    case.events[at] = structs.replace(event, what=other)


def last_tag(case: Case) -> None:
    event = case.events[-1]
    assert isinstance(event.what, Stop)
    case.events[-1] = structs.replace(event, what=Stop(b"last"))


def other_exit(case: Case) -> None:
    at, event = event_at(case, is_move)
    assert isinstance(event.what, Move)
    case.events[at] = structs.replace(event, what=structs.replace(event.what, exit=9))


def longer_wait(case: Case) -> None:
    at, event = event_at(case, is_move)
    case.events[at] = structs.replace(event, what=Wait(None, (), 7.0))


def acts_after_its_stop(case: Case) -> None:
    _, event = event_at(case, lambda event: isinstance(event.what, Stop), 0)
    case.events.append(structs.replace(event, time=99.0, what=Wait()))


def lost_after_its_stop(case: Case) -> None:
    _, event = event_at(case, lambda event: isinstance(event.what, Stop), 0)
    case.events.append(structs.replace(event, time=99.0, what="killed", digest=0))


def lost_before_it_acted(case: Case) -> None:
    at, event = event_at(case, lambda event: isinstance(event.what, Stop), 0)
    case.events.insert(at + 1, structs.replace(event, time=event.time - 1, what="killed", digest=0))
    del case.events[at]
    before = max(i for i in range(at) if case.events[i].robot == event.robot)
    case.events[before] = structs.replace(case.events[before], time=event.time)


def refused_without_a_wave(case: Case) -> None:
    case.events.append(structs.replace(case.events[-1], time=99.0, what="refused", digest=0))


def refused_once_more(case: Case) -> None:
    case.events.append(structs.replace(case.events[-1], robot=0, what="refused", digest=0))


def lost_nowhere(case: Case) -> None:
    at, _ = event_at(case, lambda event: isinstance(event.what, Stop), 0)
    event = case.events[at]
    case.events[at] = structs.replace(event, place=None, what="killed", digest=0)


def events_swapped(case: Case) -> None:
    one, _ = event_at(case, is_move)
    other = next(
        index
        for index in range(one + 1, len(case.events))
        if case.events[index].time > case.events[one].time
    )
    swap(case.events, one, other)


def a_stranger(case: Case) -> None:
    case.events.append(structs.replace(case.events[-1], robot=3, time=99.0))


def device_fails(case: Case) -> None:
    last = case.events[-1]
    case.events.append(structs.replace(last, robot=NOBODY, place=0, what="erased", digest=0))


def device_did_not_fail(case: Case) -> None:
    del case.events[event_at(case, lambda event: event.what == "destroyed", 0)[0]]


def loss_gone(case: Case) -> None:
    del case.events[event_at(case, lambda event: event.what == "killed", 0)[0]]


def failed_instead(case: Case) -> None:
    at, event = event_at(case, lambda event: event.what == "killed", 0, what="failed")
    case.events[at] = event


def one_nonce(case: Case) -> None:
    nonce = decode(journal_of(case)[nth(journal_of(case), "joined", 0)])[3]
    replaced("joined", 1, lambda record: record.__setitem__(3, nonce))(case)


def kill_dropped(case: Case) -> None:
    bodies = journal_of(case)
    bodies.remove(encode(["carried_out", 2]))
    rewrite_journal(case, bodies)


def memories_swapped(case: Case) -> None:
    paths = [case.folder / f"robot-{robot}.memory" for robot in (0, 1)]
    contents = [path.read_bytes() for path in paths]
    for path, content in zip(paths, reversed(contents), strict=True):
        path.write_bytes(content)


def joined_as_another(case: Case) -> None:
    """Let one process join in the place of another, under a nonce of its own."""
    robot = decode(journal_of(case)[nth(journal_of(case), "joined", 0)])[1]
    replaced("joined", 1, lambda record: record.__setitem__(1, robot))(case)


LOSSY_DAMAGE: Mapping[str, tuple[str, Callable[[Case], None]]] = {
    # The journal against the trace.
    "dropped wave": (WHOLE, dropped("wave", 9)),
    "dropped first wave": (WHOLE, dropped("wave")),
    "dropped last wave": (WHOLE, dropped("wave", -1)),
    "repeated wave": (WHOLE, repeated("wave", 9)),
    "repeated last wave": (WHOLE, repeated("wave", -1)),
    "swapped waves": (WHOLE, swapped_waves),
    "a request more in a wave": (
        WHOLE,
        replaced("wave", 9, lambda r: r[1].append(["stop", None, []])),
    ),
    "another request in a wave": (
        WHOLE,
        replaced("wave", 9, lambda r: r[1][0].__setitem__(1, b"!")),
    ),
    "a request less in a wave": (WHOLE, replaced("wave", 9, lambda r: r[1].pop())),
    "a blank request of nobody": (WHOLE, lost_wave_written),
    "a loss that is not in the trace": (
        WHOLE,
        replaced("wave", 9, lambda r: r[2].append([0, "failed"])),
    ),
    "second join": (WHOLE, repeated("joined", 1)),
    "join by another": (WHOLE, joined_as_another),
    "join of nobody": (WHOLE, replaced("joined", 1, lambda r: r.__setitem__(1, 7))),
    "one nonce for two": (WHOLE, one_nonce),
    "nobody joined": (WHOLE, dropped("joined", 2)),
    "dropped life": (WHOLE, dropped("incarnation")),
    "repeated life": (WHOLE, repeated("incarnation")),
    "a life skipped": (WHOLE, replaced("incarnation", -1, lambda r: r.__setitem__(1, 3))),
    "a kill dropped": (WHOLE, kill_dropped),
    "an order carried out twice": (WHOLE, repeated("carried_out")),
    "second closing": (WHOLE, repeated("closing")),
    "wave behind the closing": (WHOLE, added("wave", [], [])),
    "join behind the closing": (WHOLE, added("joined", 1, "x", "y")),
    "closed too early": (WHOLE, replaced("closing", 0, lambda r: r.__setitem__(1, "stalled"))),
    "second opening": (WHOLE, repeated("opening")),
    "no opening": (WHOLE, dropped("opening")),
    "an unknown record": (WHOLE, replaced("joined", 1, lambda r: r.__setitem__(0, "parted"))),
    "an empty record": (WHOLE, replaced("joined", 1, lambda r: r.clear())),
    "a flipped bit at the beginning": (WHOLE, bit_flipped("journal", 0.0)),
    "a flipped bit in the midst": (WHOLE, bit_flipped("journal", 0.5)),
    "a flipped bit near the end": (WHOLE, bit_flipped("journal", 0.95)),
    "garbage for a journal": (WHOLE, garbage("journal")),
    "no journal": (WHOLE, gone("journal")),
    # The trace against the journal.
    "another request in the trace": (WHOLE, other_request),
    "an event missing": (WHOLE, event_gone),
    "an event twice, in the journal": (WHOLE, event_twice),
    "events out of order, in the journal": (WHOLE, events_swapped),
    "an event more": (WHOLE, acts_after_its_stop),
    "a loss missing": (WHOLE, loss_gone),
    "a refusal more": (WHOLE, refused_without_a_wave),
    "a refusal more in a wave": (WHOLE, refused_once_more),
    "a loss for another reason": (WHOLE, failed_instead),
    # Places and moves.
    "another place": (ONCE, changed(place=lambda place: (place + 1) % 5)),
    "no place": (ONCE, changed(place=lambda _: None)),
    "a place that is none": (ONCE, changed(place=lambda _: 77)),
    "another entry": (ONCE, changed(entry=lambda entry: (entry or 0) + 1)),
    "an event too early": (ONCE, changed(time=lambda time: time - 0.5)),
    "an event too late": (ONCE, changed(time=lambda time: time + 0.5)),
    "an event twice": (ONCE, event_twice),
    "events out of order": (ONCE, events_swapped),
    "an exit that is none": (ONCE, other_exit),
    "a wait cut short": (ONCE, longer_wait),
    "a move missing": (ONCE, event_gone),
    "an event after a stop": (ONCE, acts_after_its_stop),
    "a loss after a stop": (ONCE, lost_after_its_stop),
    "a loss before its last request": (ONCE, lost_before_it_acted),
    "a loss on no way": (ONCE, lost_nowhere),
    "a robot that is none": (ONCE, a_stranger),
    # The store.
    "a changed tag": (
        STORE,
        in_store("UPDATE tag SET tag = zeroblob(length(tag)) WHERE place = 1"),
    ),
    "a tag that is text": (STORE, in_store("UPDATE tag SET tag = 'text' WHERE place = 1")),
    "a longer tag": (STORE, in_store("UPDATE tag SET tag = zeroblob(888) WHERE place = 1")),
    "a missing tag": (STORE, in_store("DELETE FROM tag WHERE place = 3")),
    "a higher revision": (
        STORE,
        in_store("UPDATE tag SET revision = revision + 1 WHERE place = 4"),
    ),
    "a lower revision": (STORE, in_store("UPDATE tag SET revision = revision - 1 WHERE place = 4")),
    "a tag more": (STORE, in_store("INSERT INTO tag VALUES (9, 1, X'00', 0)")),
    "an earlier wave": (STORE, in_store("UPDATE run SET wave = wave - 1")),
    "a later wave": (STORE, in_store("UPDATE run SET wave = wave + 1")),
    "another run": (STORE, in_store("UPDATE run SET name = 'another'")),
    "no run": (STORE, in_store("DELETE FROM run")),
    "no tags": (STORE, in_store("DROP TABLE tag")),
    "garbage for a store": (STORE, garbage("bookkeeping.db")),
    "no store": (STORE, gone("bookkeeping.db")),
    "a write that the store lacks": (STORE, last_tag),
    "a failure that the store lacks": (STORE, device_fails),
    "a failure that only the store has": (STORE, device_did_not_fail),
}

RESTARTING_DAMAGE: Mapping[str, tuple[str, Callable[[Case], None]]] = {
    "a reply too many": (KEPT, in_memory(lambda bodies: bodies.append(bodies[-1]))),
    "a reply too few": (KEPT, in_memory(lambda bodies: bodies.pop())),
    "a changed reply": (KEPT, in_memory(other_reply)),
    "a reply missing in the midst": (KEPT, in_memory(lambda bodies: bodies.pop(4))),
    "swapped replies": (KEPT, in_memory(lambda bodies: swap(bodies, 3, 4))),
    "the memory of another": (KEPT, memories_swapped),
    "another name": (KEPT, in_memory(lambda bodies: bodies.__setitem__(0, b"another"))),
    "nothing remembered": (KEPT, in_memory(lambda bodies: bodies.clear())),
    "a memory missing": (KEPT, gone("robot-1.memory")),
    "a flipped bit in a memory": (KEPT, bit_flipped("robot-2.memory", 0.6)),
    "a memory cut short": (KEPT, cut_short("robot-0.memory")),
    "another name in the journal": (KEPT, replaced("joined", 1, lambda r: r.__setitem__(2, "x"))),
    "another sight in the trace": (KEPT, changed(digest=lambda digest: digest ^ 1)),
    "a robot's life dropped": (STORE, dropped("carried_out")),
}


@pytest.mark.parametrize("damage", LOSSY_DAMAGE)
def test_damage_is_found(damage: str, lossy: Case, tmp_path: Path):
    guarantee, inflict = LOSSY_DAMAGE[damage]
    case = lossy.copied(tmp_path / "copy")
    assert broken(case) == set()
    inflict(case)
    found = audited(case)
    assert found[guarantee].holds is False, found
    # Where the trace is what it was, nobody is accused of having moved wrongly.
    assert case.events != lossy.events or found[ONCE].holds is not False


@pytest.mark.parametrize("damage", RESTARTING_DAMAGE)
def test_damage_to_a_run_in_which_robots_come_back_is_found(
    damage: str, restarting: Case, tmp_path: Path
):
    guarantee, inflict = RESTARTING_DAMAGE[damage]
    case = restarting.copied(tmp_path / "copy")
    assert broken(case) == set()
    inflict(case)
    assert broken(case) == {guarantee}


def test_each_wave_counts(lossy: Case, tmp_path: Path):
    """Whichever wave is missing, or is there twice, is missed."""
    case = lossy.copied(tmp_path / "copy")
    bodies = journal_of(case)
    for at in [at for at, kind in enumerate(kinds_of(case)) if kind == "wave"]:
        for others in ([], [bodies[at]] * 2):
            rewrite_journal(case, [*bodies[:at], *others, *bodies[at + 1 :]])
            assert WHOLE in broken(case), (at, others)


def test_each_event_counts(restarting: Case):
    """Whichever event is missing, or is there twice, is missed."""
    events = restarting.events
    for at in range(len(events)):
        for others in ([], [events[at]] * 2):
            case = Case(restarting.folder, [*events[:at], *others, *events[at + 1 :]])
            assert {WHOLE, ONCE if others else WHOLE} <= broken(case), (at, others)


def test_what_a_crash_explains_is_not_wrong(lossy: Case, tmp_path: Path):
    """A record that was cut short at the end; a world that was killed behind the closing."""
    case = lossy.copied(tmp_path / "copy")
    journal = case.folder / "journal"
    added("incarnation", 3)(case)
    journal.write_bytes(journal.read_bytes() + framed(encode(["incarnation", 4]))[:-1])
    assert broken(case) == set()


def test_a_run_that_is_not_over_is_judged_as_far_as_it_went(restarting: Case, tmp_path: Path):
    case = restarting.copied(tmp_path / "copy")
    bodies = journal_of(case)
    rewrite_journal(case, bodies[: nth(bodies, "wave", 20) + 1])
    found = verdicts(case)  # of a run that went on since: the trace is further
    assert (found[WHOLE], found[ONCE], found[STORE]) == (True, True, None)
    case.events[:] = []
    judge_journal(case.folder / "journal", also=case.events.append)
    shorter = audited(case)
    assert shorter[KEPT].holds is False  # the robots know of more than the journal
    assert (shorter[WHOLE].holds, shorter[STORE].holds) == (True, None)
    assert "not closed" in shorter[WHOLE].detail


def test_a_journal_alone_is_enough(restarting: Case, tmp_path: Path):
    """Whoever has only that is told what could not be audited; nothing is broken."""
    shutil.copy(restarting.folder / "journal", tmp_path / "journal")
    found = verdicts(Case(tmp_path, restarting.events))
    assert found == {WHOLE: True, KEPT: None, ONCE: True, STORE: None}


def test_a_store_that_was_killed_is_read_with_its_log(lossy: Case, tmp_path: Path):
    case = lossy.copied(tmp_path / "copy")
    store = case.folder / "bookkeeping.db"
    content = store.read_bytes()
    with closing(sqlite3.connect(store)) as database:
        database.execute("UPDATE tag SET revision = revision + 1 WHERE place = 4")
        database.commit()
        log = Path(f"{store}-wal").read_bytes()  # as kill -9 leaves it
    store.write_bytes(content)
    assert broken(case) == set()
    Path(f"{store}-wal").write_bytes(log)
    assert broken(case) == {STORE}


def test_a_store_that_another_run_uses_is_left_alone(lossy: Case, tmp_path: Path):
    case = lossy.copied(tmp_path / "copy")
    with SqliteStore(
        case.folder / "bookkeeping.db",
        run="another",
        capacity_bytes=888,
        fresh=True,
        durability="process",
    ) as store:
        store.apply(Batch(1, 3, (TagWrite(0, 1, b"x"),)))
        assert audited(case)[STORE].holds is None


def test_it_shares_no_code_with_what_it_checks():
    """It imports nothing that reads or writes these files, plays a run, or judges one."""
    rooms = sorted(Path(audit.__file__).parent.glob("audit*.py"))
    assert len(rooms) > 1
    trees = [ast.parse(room.read_text(encoding="utf-8")) for room in rooms]
    nodes = [node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    own = {f"deploy.verdict.{room.stem}" for room in rooms}
    imported = {node.module or "" for node in nodes} - own
    packages = ("protocol", "deploy", "world_server", "bookkeeping", "agents")
    ours = {name for name in imported if name.partition(".")[0] in packages}
    assert ours == {
        "deploy.run_dir",
        "deploy.verdict.guarantees",
        "protocol.errors",
        "protocol.messages",
        "protocol.scenario",
        "protocol.trace",
    }


def test_the_folder_is_left_as_it_is(restarting: Case, tmp_path: Path):
    case = restarting.copied(tmp_path / "copy")

    def contents() -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in case.folder.rglob("*") if path.is_file()}

    before = contents()
    audited(case)
    assert contents() == before


# Runs in one thread, written down as those of processes are.


class Script(NamedTuple):
    """What may happen to a run that nobody planned.

    Attributes:
        lost: robots lost in the n-th wave, and why.
        lives: waves before which the world begins a new life.
    """

    lost: Mapping[int, Sequence[tuple[int, LossCause]]] = {}
    lives: frozenset[int] = frozenset()


def restless(seed: int, requests: int, *, tags: bool) -> Algorithm:
    """Return robots that do anything, now and then also what is not allowed."""

    async def wander(body: Body) -> None:
        rng = body.rng
        for _ in range(seed):
            rng.random()
        here = await body.look()
        for _ in range(requests):
            tag = bytes([rng.randrange(256)]) if tags and rng.random() < 0.5 else None
            match rng.randrange(12):
                case 0:
                    here = await body.wait(float(rng.randint(1, 3)), tag=tag)
                case 1:
                    here = await body.wait_for_news(at_most=2.0, tag=tag)
                case 2:
                    here = await body.exchange(b"news")
                case 3 if tags:
                    here = await body.write(bytes(rng.randrange(4)))
                case 4:
                    here = await body.look()
                case 5 if rng.random() < 0.2:
                    here = await body.move(here.degree)
                case _:
                    if here.degree:
                        here = await body.move(rng.randrange(here.degree), tag=tag)

    return wander


def written(
    folder: Path,
    ground: PortGraph | Grid,
    algorithm: Algorithm,
    robots: int,
    *,
    starts: Sequence[int] | None = None,
    script: Script | None = None,
    store: Path | None = None,
    **fields: Any,
) -> Case:
    """Play robots in one thread, and leave behind what a run by processes does."""
    scenario, script = scenario_of(robots, **fields), script or Script()
    starts = tuple(starts or [0] * robots)
    run = RunDir.create(folder, "written")
    restart = scenario.team.on_crash == "restart"
    memories = [[b"process %d" % robot] for robot in range(robots)]
    events: list[Event] = []
    inputs, last = 1, 0
    tags: dict[int, TagWrite] = {}

    def on_write(place: int, revision: int, tag: bytes) -> None:
        nonlocal last
        last, tags[place] = inputs, TagWrite(place, revision, tag)

    world = World(
        scenario, terrain_of(ground, scenario), starts, observe=events.append, on_write=on_write
    )
    drivers = [Driver(algorithm, Body(world.briefing(robot))) for robot in range(robots)]
    with closing(Journal(run.journal)) as journal, _store(scenario, run, store) as database:
        name = str(folder)
        journal.append(opening(name, "processes", to_tree(scenario), ground, starts))
        journal.append(Incarnation(1))
        for robot in range(robots):
            journal.append(Joined(robot, f"process {robot}", f"nonce {robot}"))
        waves, life = 0, 1
        output = world.begin()
        while not isinstance(output, End):
            inputs += 1
            match output:
                case Wave():
                    if waves in script.lives:
                        life += 1
                        journal.append(Incarnation(life))
                    lost = script.lost.get(waves, ())
                    lost = tuple(one for one in lost if world.bodies[one[0]].state < 4)
                    waves += 1
                    for robot, sight in zip(output.robots, output.sights, strict=True):
                        if sight is not None:
                            memories[robot].append(encode(sight))
                    gone = dict(lost)
                    requests = [
                        None if robot in gone else drivers[robot].next_request(sight)
                        for robot, sight in zip(output.robots, output.sights, strict=True)
                    ]
                    journal.append(WaveRecord(requests, lost))
                    output = world.resume(Answers(requests, lost))
                case KillOrder(fault=fault) | FaultOrder(fault=fault):
                    journal.append(CarriedOut(fault))
                    output = world.resume(None)
                case TagsWanted(places=places):
                    old = database.read(places)
                    journal.append(OldTags(old))
                    output = world.resume(old)
        if tags:
            database.apply(Batch(life, last, tuple(tags.values())))
        journal.append(Closing(output.status, "", 1.0))
    for robot, driver in enumerate(drivers):
        driver.close()
        if restart:
            rewrite(run.memory(robot), memories[robot])
    return Case(folder, events)


def _store(scenario: Scenario, run: RunDir, path: Path | None) -> SqliteStore:
    return SqliteStore(
        path or run.database,
        run=str(run.path),
        capacity_bytes=scenario.device.capacity,
        fresh=scenario.bookkeeping.fresh,
        durability="process",
    )


async def one_tag_more(body: Body) -> None:
    """Write what stands here and one byte more, at the first three places of a line."""
    here = await body.look()
    for _ in range(3):
        here = await body.write(here.tag + bytes([255]))
        here = await body.move(here.degree - 1)


LINE = graph_of("01 12 23 34 45")


def test_a_run_on_the_tags_of_an_earlier_one(tmp_path: Path):
    store = tmp_path / "tags.db"
    book = {"database": str(store), "fresh": False}
    first = written(tmp_path / "1", LINE, one_tag_more, 1, store=store, bookkeeping=book)
    assert audited(first)[STORE].detail.startswith("3 places written, 3 writes")
    erased = [{"erase_tag": 2, "at": 2}, {"erase_tag": 5, "at": 1}]
    again: dict[str, Any] = {"starts": [1], "store": store, "bookkeeping": book, "faults": erased}
    second = written(tmp_path / "2", LINE, one_tag_more, 1, **again)
    assert verdicts(second)[STORE] is True
    assert "by now" in audited(first)[STORE].detail  # the second has been there
    assert verdicts(first)[STORE] is None
    with closing(sqlite3.connect(store)) as database:
        rows = dict(database.execute("SELECT place, revision FROM tag"))
        assert rows == {0: 1, 1: 2, 2: 3, 3: 1, 5: 1}
        for place, revision in rows.items():
            found = "UPDATE tag SET revision = ? WHERE place = ?"
            database.execute(found, (revision + 1, place))
            database.commit()
            # At place 0 the second run never was; nobody can tell.
            assert verdicts(second)[STORE] is (place == 0)
            database.execute(found, (revision, place))
            database.commit()
    store.unlink()
    assert verdicts(second)[STORE] is None


def test_a_corrupted_tag_differs_in_a_few_bits(tmp_path: Path):
    corrupted = [{"corrupt_tag": 1, "at": 9}]
    device = {"capacity_bytes": 8, "checksum": False}
    rest = asking(Move(b"a", (), 0), Write(b"abcdefgh"), Wait(None, (), 20.0))
    case = written(tmp_path / "1", LINE, rest, 1, device=device, faults=corrupted)
    assert verdicts(case)[STORE] is True
    tag = int.from_bytes(b"abcdefgh", "little")
    for bits in range(10):
        found = (tag ^ ((1 << bits) - 1)).to_bytes(8, "little")
        in_store("UPDATE tag SET tag = ? WHERE place = 1", found)(case)
        assert verdicts(case)[STORE] is (bits <= 4)


@st.composite
def faults(draw: st.DrawFn, robots: int, places: int) -> list[dict[str, Any]]:
    """Kills of robots and of the world, and devices that fail."""
    found: list[dict[str, Any]] = []
    for _ in range(draw(st.integers(0, 5))):
        word = draw(st.sampled_from(["kill", "kill", "erase_tag", "corrupt_tag", "destroy_tag"]))
        robot = draw(st.integers(0, robots - 1))
        victim: Any = draw(st.integers(0, places - 1))
        if word == "kill":
            victim = draw(st.sampled_from(["world", f"robot:{robot}"]))
        if draw(st.booleans()):
            when: dict[str, Any] = {
                "at": draw(st.integers(0, 12)) / 2,
                "round": draw(st.integers(0, 2)),
            }
        else:
            of = {} if victim == f"robot:{robot}" else {"of": f"robot:{robot}"}
            when = {"at_request": draw(st.integers(1, 12)), **of}
        found.append({word: victim, **when})
    return found


@st.composite
def scripts(draw: st.DrawFn, robots: int) -> Script:
    """Losses that nobody planned, and lives of the world."""
    waves = st.integers(0, 12)
    causes: st.SearchStrategy[LossCause] = st.sampled_from(["killed", "failed"])
    losses = st.dictionaries(st.integers(0, robots - 1), causes, min_size=1, max_size=2)
    lost = draw(st.dictionaries(waves, losses, max_size=2))
    return Script(
        {wave: sorted(of.items()) for wave, of in lost.items()}, frozenset(draw(st.sets(waves)))
    )


CLOCKS: tuple[dict[str, Any], ...] = (
    {},
    {"mode": "event", "jitter": 0.3},
    {"mode": "event", "jitter": "exponential"},
)


def check_any_run(data: st.DataObject, folder: Path, ground: PortGraph | Grid, **fields: Any):
    """Check that the audit finds nothing in a run, and whatever is missing from it then."""
    robots = data.draw(st.integers(1, 4))
    places = len(ground.names) if isinstance(ground, PortGraph) else len(ground)
    free = list(range(places))
    if isinstance(ground, Grid):
        free = [place for place in free if not ground.blocked[place]]
    starts = [data.draw(st.sampled_from(free)) for _ in range(robots)]
    if fields.get("world", {}).get("bodies") == "block":
        starts = list(dict.fromkeys(starts))
        robots = len(starts)
    tags = data.draw(st.booleans())
    case = written(
        folder,
        ground,
        restless(data.draw(st.integers(0, 1000)), 12, tags=tags),
        robots,
        starts=starts,
        script=data.draw(scripts(robots)),
        faults=data.draw(faults(robots, places)) if tags else [],
        team={"on_crash": data.draw(st.sampled_from(["lost", "restart"]))},
        clock=data.draw(st.sampled_from(CLOCKS)),
        radio={"reach": "global"},
        device={
            "capacity_bytes": 8 if tags else 0,
            "checksum": data.draw(st.booleans()),
        },
        **fields,
    )
    found = audited(case)
    assert {name for name, claim in found.items() if claim.holds is False} == set(), found
    assert (found[STORE].holds is None) == (not tags)
    bodies = journal_of(case)
    waves = [at for at, kind in enumerate(kinds_of(case)) if kind == "wave"]
    at = data.draw(st.sampled_from(waves)) if waves else 0  # it may be that nobody ever acted
    for others in ([], [bodies[at]] * 2) if waves else ():
        rewrite_journal(case, [*bodies[:at], *others, *bodies[at + 1 :]])
        assert WHOLE in broken(case)
    rewrite_journal(case, bodies)
    in_store("UPDATE tag SET tag = CAST(tag || X'FF' AS BLOB)")(case)
    assert broken(case) == ({STORE} if store_has_tags(case) else set())


def store_has_tags(case: Case) -> bool:
    with closing(sqlite3.connect(case.folder / "bookkeeping.db")) as database:
        (count,) = database.execute("SELECT count(*) FROM tag").fetchone()
    return bool(count)


@settings(max_examples=40)
@given(data=st.data(), graph=graphs())
def test_any_run_on_a_graph_passes(data: st.DataObject, graph: PortGraph):
    with TemporaryDirectory() as folder:
        check_any_run(data, Path(folder) / "run", graph)


GRID_RULES: tuple[dict[str, Any], ...] = (
    {},
    {"world": {"map": "none", "bodies": "block"}},
    {"sensing": {"mode": "three", "position": "odometry", "drift": 0.4}},
    {
        "world": {"map": "none", "bodies": "block"},
        "sensing": {"mode": "three", "position": "odometry", "drift": 0.4, "reset": False},
    },
)


@settings(max_examples=40)
@given(data=st.data(), grid=grids(5, 5))
def test_any_run_on_a_grid_passes(data: st.DataObject, grid: Grid):
    rules = data.draw(st.sampled_from(GRID_RULES))
    with TemporaryDirectory() as folder:
        fields = {"sensing": {"mode": "three"}, **rules}
        check_any_run(data, Path(folder) / "run", grid, **fields)
