"""Damage to what is kept: it is found, or it does no harm; it is never read as something else.

Bytes that change, ends that are lost and pages that are out of date: in the file of a store, in the log
that a killed store leaves beside it, and in a journal.
"""

import functools
import inspect
import random
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bookkeeping.sqlite_store import SqliteStore, _tag_checksum, tag_format_left
from protocol.codec import encode
from protocol.errors import CanopyError, JournalError, StoreError
from protocol.messages import Batch, Look, Move, TagWrite, Write
from protocol.scenario import to_tree
from tests.play import graph_of, scenario_of
from world_server.journal import (
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

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("damage")


def changed(content: bytes, position: int, damage: bytes) -> bytes:
    """Return the content with other bytes at a position, as long as before."""
    return (content[:position] + damage + content[position + len(damage) :])[: len(content)]


def put(path: Path, content: bytes) -> None:
    """Write a file anew; over an old one, some file systems would wait for the disk."""
    path.unlink(missing_ok=True)
    path.write_bytes(content)


def flipped(content: bytes, position: int, mask: int) -> bytes:
    """Return the content with the bits of the mask flipped in one byte."""
    return changed(content, position, bytes([content[position] ^ mask]))


def some_mask(position: int) -> int:
    """Return bits to flip in one byte; over some positions, any."""
    return 1 + position * 97 % 255


def check_named(error: CanopyError, path: Path, then: str = "") -> None:
    """Check that an error begins with the name of the file."""
    assert str(error).startswith(f"{path}: {then}")


# Stores. What a wave writes follows from its number, so each wave's tags are known.

CAPACITY_BYTES = 90
PLACES = 40
WAVES = 24
PAGE_BYTES = 512  # the least: many pages in a small file, and inner ones among them
HEADER_BYTES = 100  # of an SQLite file
LOG_HEADER_BYTES = 32
FRAME_BYTES = 24 + PAGE_BYTES  # of the log: a header and a page

Tags = dict[int, TagWrite]


def writes_of(wave: int) -> list[tuple[int, bytes]]:
    """Places and tags of a wave: many at first, then so few that most pages stay as they are."""
    rng = random.Random(wave)
    places = rng.sample(range(PLACES), PLACES - 3 if wave == 1 else rng.choice((1, 1, 2, 4)))
    return [(place * place, rng.randbytes(rng.randint(0, CAPACITY_BYTES))) for place in places]


def play(store: SqliteStore, waves: int) -> None:
    """Let a store, at whatever wave it is, go on to this one."""
    tags = store.tags()
    for wave in range(store.hello(1) + 1, waves + 1):
        writes = []
        for place, tag in writes_of(wave):
            revision = tags[place].revision + 1 if place in tags else 1
            writes.append(TagWrite(place, revision, tag))
        store.apply(Batch(1, wave, tuple(writes)))
        tags.update({write.place: write for write in writes})


@functools.cache
def tags_at(wave: int) -> Tags:
    """All tags after a wave, by place; the batches of a run and nothing else."""
    if wave == 0:
        return {}
    tags = dict(tags_at(wave - 1))
    for place, tag in writes_of(wave):
        tags[place] = TagWrite(place, tags[place].revision + 1 if place in tags else 1, tag)
    return tags


def opened(path: Path) -> SqliteStore:
    return SqliteStore(
        path, run="voyage", capacity_bytes=CAPACITY_BYTES, fresh=False, durability="process"
    )


def begin_small(path: Path) -> None:
    """Begin a file with small pages; to a store it is new."""
    database = sqlite3.connect(path)
    database.execute(f"PRAGMA page_size = {PAGE_BYTES}")
    database.execute("VACUUM")
    database.close()


def log_of(path: Path) -> Path:
    return path.with_name(path.name + "-wal")


def look(path: Path, content: bytes, log: bytes = b"") -> tuple[int, Tags] | None:
    """Open a store on these bytes.

    Returns:
        Its wave and its tags; ``None`` if it is refused.
    """
    put(path, content)
    put(log_of(path), log)
    refused = False
    for _ in range(2):  # a refusal must not make it look whole
        try:
            with opened(path) as store:
                found = store._wave, store.tags()  # hello says the same, but it writes: slower
        except StoreError as error:
            check_named(error, path)
            refused = True
        else:
            assert not refused
            return found
    return None


@functools.cache
def closed_store(folder: Path, waves: int = WAVES) -> bytes:
    """The file of a store that was closed after these waves."""
    path = folder / f"closed{waves}"
    begin_small(path)
    with opened(path) as store:
        play(store, waves)
    return path.read_bytes()


def check_flips(path: Path, content: bytes, mask_of: Callable[[int], int]) -> None:
    """Flip bits of each byte, one byte at a time; the mask tells which, by position."""
    whole = (WAVES, tags_at(WAVES))
    harmless = set()
    for position in range(len(content)):
        found = look(path, flipped(content, position, mask_of(position)))
        assert found in (None, whole), position
        if found is not None:
            harmless.add(position)
            if position < HEADER_BYTES:
                check_going_on(path)
    for write in tags_at(WAVES).values():
        start = content.rindex(write.tag) if len(write.tag) > 4 else len(content)
        assert harmless.isdisjoint(range(start, start + len(write.tag)))


def check_going_on(path: Path) -> None:
    """What has done no harm so far must not do any later, or be found then."""
    try:
        with opened(path) as store:
            play(store, WAVES + 3)
        with opened(path) as store:
            assert (store.hello(1), store.tags()) == (WAVES + 3, tags_at(WAVES + 3))
    except StoreError as error:
        check_named(error, path)


def test_a_flipped_byte_of_a_store_is_found_or_carries_nothing(folder: Path) -> None:
    content = closed_store(folder)
    assert len(content) > 8 * PAGE_BYTES
    check_flips(folder / "flips", content, some_mask)


@pytest.mark.slow
@pytest.mark.parametrize("bit", range(8))
def test_each_flipped_bit_of_a_store_is_found_or_carries_nothing(bit: int, folder: Path) -> None:
    check_flips(folder / "bits", closed_store(folder), lambda _: 1 << bit)


def test_a_name_that_is_no_text_any_more_is_told_as_damage(folder: Path) -> None:
    path, content = folder / "name", closed_store(folder)
    put(path, flipped(content, content.index(b"voyage"), 0x80))
    with pytest.raises(StoreError, match=r"name: it is damaged: restore .*checksum of the run"):
        opened(path)


damages = st.one_of(
    st.binary(min_size=1, max_size=3),
    st.builds(bytes, st.integers(1, 600)),  # zeros, as of a sector that was never written
    st.randoms(use_true_random=False).map(lambda rng: rng.randbytes(rng.randint(4, 600))),
)


@functools.cache
def large_store(folder: Path) -> tuple[bytes, Tags]:
    """The file of a store of 600 tags in pages of the usual size, and the tags."""
    rng = random.Random(0)
    writes = tuple(TagWrite(place, 7, rng.randbytes(rng.randint(0, 60))) for place in range(600))
    path = folder / "large"
    with opened(path) as store:
        store.apply(Batch(1, 5, writes))
    return path.read_bytes(), {write.place: write for write in writes}


@settings(max_examples=60)
@given(st.floats(0, 1, exclude_max=True), damages)
def test_other_bytes_anywhere_in_a_store_are_found_or_carry_nothing(
    folder: Path, where: float, damage: bytes
) -> None:
    content, tags = large_store(folder)
    position = int(where * len(content))
    found = look(folder / "others", changed(content, position, damage))
    assert found in (None, (5, tags))


def test_a_store_that_lost_its_end_is_found(folder: Path) -> None:
    content = closed_store(folder)
    # Not 0: an empty file is a new one, and its wave 0 lets the world server write all of it again.
    sizes = {1, HEADER_BYTES, PAGE_BYTES - 1, *range(PAGE_BYTES, len(content), PAGE_BYTES)}
    for size in sizes | {size + 1 for size in sizes}:
        if size < len(content):
            assert look(folder / "cut", content[:size]) is None, size


def test_a_page_that_is_out_of_date_is_found(folder: Path) -> None:
    """A disk that lost one write leaves a page whose rows are whole, but old."""
    new = closed_store(folder)
    for waves in range(WAVES - 6, WAVES):
        old = closed_store(folder, waves)
        refused = 0
        for start in range(0, min(len(old), len(new)), PAGE_BYTES):
            page = old[start : start + PAGE_BYTES]
            found = look(folder / "page", changed(new, start, page))
            assert found in (None, (WAVES, tags_at(WAVES))), (waves, start)
            refused += found is None
        assert refused > 0


def test_tags_that_are_whole_but_not_of_this_wave_are_found(folder: Path) -> None:
    """Rows that are right by themselves: a tag gone, the run's from before, the tags from before."""
    path = folder / "rows"
    changes = [
        "DELETE FROM tag WHERE place = (SELECT min(place) FROM tag)",
        "UPDATE run SET (wave, digest, checksum) = (SELECT wave, digest, checksum FROM old.run)",
        "REPLACE INTO tag SELECT * FROM old.tag",
    ]
    (folder / "old").write_bytes(closed_store(folder, WAVES - 3))
    for change in changes:
        path.write_bytes(closed_store(folder))
        database = sqlite3.connect(path, isolation_level=None)
        database.execute("ATTACH ? AS old", (str(folder / "old"),))
        assert database.execute(change).rowcount > 0
        database.close()
        with pytest.raises(
            StoreError, match=r"rows: it is damaged: .*its tags are not those of wave"
        ):
            opened(path)


def test_changes_of_two_tags_do_not_cancel_out(folder: Path) -> None:
    """A CRC is linear: the same change of two tags changes both alike, some up, some down."""
    path, other = folder / "alike", folder / "before"
    rises: dict[int, int] = {}
    for place in range(10_000):
        rise = _tag_checksum(place, 2, b"behind") - _tag_checksum(place, 1, b"before")
        if -rise in rises:
            break
        rises[rise] = place
    places = (rises[-rise], place)
    with opened(path) as store:
        store.apply(Batch(1, 1, tuple(TagWrite(place, 1, b"before") for place in places)))
        database = sqlite3.connect(other)
        store._database.backup(database)
        database.close()
        store.apply(Batch(1, 2, tuple(TagWrite(place, 2, b"behind") for place in places)))
    database = sqlite3.connect(path, isolation_level=None)
    database.execute("ATTACH ? AS old", (str(other),))
    database.execute("REPLACE INTO tag SELECT * FROM old.tag")
    database.close()
    with pytest.raises(StoreError, match="its tags are not those of wave 2"):
        opened(path)


def test_damage_under_an_open_store_is_found_when_it_is_read(folder: Path) -> None:
    path = folder / "open"
    path.write_bytes(closed_store(folder))
    tags = tags_at(WAVES)
    place, other, gone = (place for place in list(tags)[:3])
    with opened(path) as store:
        store._database.execute("UPDATE tag SET revision = revision + 1 WHERE place = ?", (place,))
        store._database.execute("DELETE FROM tag WHERE place = ?", (gone,))
        for bad in (place, gone):
            with pytest.raises(StoreError, match=f"open: it is damaged: restore .*place {bad}: "):
                store.read((other, bad))
        with pytest.raises(StoreError, match="open: it is damaged: restore"):
            store.tags()
        assert store.read((other,)) == (tags[other],)
    with pytest.raises(StoreError, match=f"open: it is damaged: restore .*place {place}: "):
        opened(path)


def test_the_format_of_a_damaged_file_is_told_or_not_at_all(folder: Path) -> None:
    """The opening that follows refuses the file; this must only not fail otherwise."""
    path = folder / "format"
    content = closed_store(folder)
    for position in range(PAGE_BYTES):
        put(path, flipped(content, position, some_mask(position)))
        assert tag_format_left(path) in (None, "")


# Stores that were killed. What was not yet moved into the file is in the log beside it.

CHILD = f"""
import os, random, signal, sqlite3, sys
from pathlib import Path
from bookkeeping.sqlite_store import SqliteStore
from protocol.messages import Batch, TagWrite
CAPACITY_BYTES, PLACES, PAGE_BYTES = {CAPACITY_BYTES}, {PLACES}, {PAGE_BYTES}
{inspect.getsource(writes_of)}
{inspect.getsource(play)}
{inspect.getsource(opened)}
{inspect.getsource(begin_small)}
path = Path(sys.argv[1])
begin_small(path)
store = opened(path)
for step in sys.argv[2:]:
    if step == "close":
        store.close()
        store = opened(path)
    elif step == "move":
        store._database.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchall()
    else:
        play(store, int(step))
os.kill(os.getpid(), signal.SIGKILL)
"""

DEATHS = {
    "young": f"{WAVES}",
    "aged": f"8 close {WAVES}",
    "moved": f"8 close {WAVES} move",  # the file has all of the log, which is still there
    "begun anew": f"8 close 20 move {WAVES}",  # behind the log's new frames lie old ones
}
"""What a process does that kills itself: waves to write, the file closed, the log moved into it."""


class Left(NamedTuple):
    """What a store that was killed has left."""

    content: bytes
    log: bytes

    @property
    def frames(self) -> range:
        """Where the pages in the log begin, and the end."""
        return range(LOG_HEADER_BYTES, len(self.log) + 1, FRAME_BYTES)


@functools.cache
def killed_store(folder: Path, death: str) -> Left:
    """Let a process write all waves and kill itself; the steps between tell what lies where."""
    path = folder / f"killed {death}"
    steps = DEATHS[death].split()
    child = subprocess.run(
        [sys.executable, "-c", CHILD, path, *steps], cwd=ROOT, check=False, timeout=60
    )
    assert child.returncode == -signal.SIGKILL
    return Left(path.read_bytes(), log_of(path).read_bytes())


def check_left(path: Path, content: bytes, log: bytes) -> bool:
    """Check that a store is at a wave, or refused; return whether it is refused."""
    found = look(path, content, log)
    if found is not None:
        wave, tags = found
        assert tags == tags_at(wave)
    return found is None


@pytest.mark.parametrize("death", DEATHS)
def test_a_killed_store_is_at_its_last_wave(death: str, folder: Path) -> None:
    left = killed_store(folder, death)
    assert look(folder / "last", left.content, left.log) == (WAVES, tags_at(WAVES))
    (folder / "format").write_bytes(left.content)
    log_of(folder / "format").write_bytes(left.log)
    assert tag_format_left(folder / "format") == ""


@pytest.mark.parametrize("death", DEATHS)
def test_a_log_that_lost_its_end_leaves_an_earlier_wave_or_a_refusal(
    death: str, folder: Path
) -> None:
    left = killed_store(folder, death)
    refused = 0
    for end in left.frames:
        for size in (end - 1, end, end + 1, end + FRAME_BYTES // 2):
            refused += check_left(folder / "ends", left.content, left.log[:size])
    # A log that was moved into the file and then lost its end would take pages back.
    assert (refused > 0) == (death == "moved")


@settings(max_examples=60)
@given(st.sampled_from(sorted(DEATHS)), st.floats(0, 1, exclude_max=True), damages)
def test_other_bytes_in_a_log_leave_an_earlier_wave_or_a_refusal(
    folder: Path, death: str, where: float, damage: bytes
) -> None:
    left = killed_store(folder, death)
    position = int(where * len(left.log))
    check_left(folder / "log", left.content, changed(left.log, position, damage))


@pytest.mark.parametrize("death", DEATHS)
def test_a_flipped_byte_of_what_guards_a_log(death: str, folder: Path) -> None:
    left = killed_store(folder, death)
    for start in (0, left.frames[0], left.frames[len(left.frames) // 2]):
        for position in range(start, start + LOG_HEADER_BYTES):
            mask = some_mask(position)
            check_left(folder / "guard", left.content, flipped(left.log, position, mask))


@pytest.mark.slow
@pytest.mark.parametrize("death", DEATHS)
def test_many_flipped_bytes_of_a_log_leave_an_earlier_wave_or_a_refusal(
    death: str, folder: Path
) -> None:
    left = killed_store(folder, death)
    for position in range(0, len(left.log), 19):
        mask = some_mask(position)
        check_left(folder / "each", left.content, flipped(left.log, position, mask))


def test_a_store_killed_while_the_log_is_moved(folder: Path) -> None:
    """Pages are moved one by one: whole log, all waves; damaged log, an earlier one or refusal."""
    before, after = killed_store(folder, "aged"), killed_store(folder, "moved")
    refused = 0
    for end in range(0, len(after.content) + 1, PAGE_BYTES):
        content = after.content[:end] + before.content[end:]
        assert look(folder / "moving", content, before.log) == (WAVES, tags_at(WAVES))
        for start in before.frames[:: len(before.frames) // 5]:
            refused += check_left(folder / "moving", content, before.log[:start])
    assert refused > 0


def test_a_store_that_lost_its_head_does_not_look_new(folder: Path) -> None:
    left = killed_store(folder, "young")
    for size in (0, 1, PAGE_BYTES - 1):
        assert look(folder / "head", left.content[:size], left.log) is None, size


# Journals.

RECORDS: list[AnyRecord] = [
    opening("run", "test", to_tree(scenario_of(2)), graph_of("01 02 12"), (0, 0)),
    Incarnation(1),
    Joined(0, "process", "00ff"),
    Joined(1, "other", "ff00"),
    WaveRecord([Look(), Look()]),
    OldTags((TagWrite(2, 4, b"old"), TagWrite(0, 1, b""))),
    WaveRecord([Move(b"\x00\x01", (b"m",), 2), None], ((1, "failed"),)),
    WaveRecord([Write(b"\x02\x0f", ())]),
    Closing("over", "00" * 32, 0.5),
]
BODIES = [encode(record) for record in RECORDS]


@functools.cache
def journal_bytes(folder: Path) -> bytes:
    path = folder / "journal"
    append(path, RECORDS)
    return path.read_bytes()


def append(path: Path, records: list[AnyRecord]) -> None:
    journal = Journal(path)
    for record in records:
        journal.append(record)
    journal.close()


def bodies_in(path: Path) -> list[bytes]:
    return [encode(record) for record, _ in scan(path)]


def check_refused(path: Path, content: bytes) -> None:
    """Check that a damaged journal is neither read to its end nor continued, and stays as it is."""
    put(path, content)
    for use in (bodies_in, Journal):
        with pytest.raises(JournalError) as told:
            use(path)
        check_named(told.value, path, "offset ")
    assert path.read_bytes() == content


def test_each_flipped_byte_of_a_journal_is_found(folder: Path) -> None:
    whole = journal_bytes(folder)
    for position in range(len(whole)):
        check_refused(folder / "flipped", flipped(whole, position, some_mask(position)))


@given(st.floats(0, 1, exclude_max=True), damages)
def test_other_bytes_anywhere_in_a_journal_are_found(
    folder: Path, where: float, damage: bytes
) -> None:
    whole = journal_bytes(folder)
    content = changed(whole, int(where * len(whole)), damage)
    if content != whole:
        check_refused(folder / "flipped", content)


def test_a_journal_cut_anywhere_goes_on_behind_what_is_whole(folder: Path) -> None:
    whole, path = journal_bytes(folder), folder / "cut"
    ends = [end for _, end in scan(folder / "journal")]
    for size in range(len(whole) + 1):
        put(path, whole[:size])
        kept = BODIES[: sum(end <= size for end in ends)]
        assert bodies_in(path) == kept
        append(path, [Incarnation(7)])
        append(path, [Joined(1, "again", "00")])
        assert bodies_in(path) == [*kept, encode(Incarnation(7)), encode(Joined(1, "again", "00"))]


@given(st.floats(0, 1), st.floats(0, 1, exclude_max=True), st.integers(1, 255))
def test_a_journal_cut_and_damaged_is_a_beginning_or_refused(
    folder: Path, cut: float, where: float, mask: int
) -> None:
    content = journal_bytes(folder)
    content = content[: 1 + int(cut * (len(content) - 1))]
    path = folder / "both"
    put(path, flipped(content, int(where * len(content)), mask))
    found = []
    try:
        for record, _ in scan(path):
            found.append(encode(record))
    except JournalError as error:
        check_named(error, path, "offset ")
    # What was read before the damage was met is right as well.
    assert found == BODIES[: len(found)]
