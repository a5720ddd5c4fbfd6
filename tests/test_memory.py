"""Record files, and the memory of a robot: what survives a crash, and what is refused."""

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.memory import Memory
from protocol.codec import encode
from protocol.errors import JournalError, MessageError
from protocol.messages import AnySight, GridSight, Move, Sight
from protocol.records import framed, read_records

SIGHTS: list[AnySight] = [
    Sight(0.0, 0, None, 2, b"", 0, True, (), (), ()),
    Sight(1.5, 3, 1, 2, b"tag", 4, False, (1, 2), ((1, b"message"),), (2,)),
    GridSight(2.0, 9, 1, 4, b"", 0, False, (), (), (), (3, 4), b".#?"),
]

sights = st.builds(
    Sight,
    st.floats(0, 1e6),
    st.integers(0, 9),
    st.none() | st.integers(0, 3),
    st.integers(0, 9),
    st.binary(max_size=20),
    st.integers(0, 99),
    st.booleans(),
    st.lists(st.integers(0, 9), max_size=3).map(tuple),
    st.lists(st.tuples(st.integers(0, 9), st.binary(max_size=9)), max_size=2).map(tuple),
    st.lists(st.integers(0, 9), max_size=2).map(tuple),
)


@contextmanager
def life(path: Path) -> Iterator[Memory]:
    """Open a memory as a process does that dies at the end of the block."""
    memory = Memory(path)
    try:
        yield memory
    finally:
        memory.close()


def written(path: Path, seen: Sequence[AnySight]) -> str:
    """Let a first life see all this; return the text by which it joined."""
    with life(path) as memory:
        assert memory.sights == []
        for sight in seen:
            memory.keep(sight)
        return memory.process


def ends_of(content: bytes) -> list[int]:
    """Return the offset behind each record."""
    return [end for _, end in read_records(io.BytesIO(content), Path("memory"), 0)]


# Records.

bodies = st.lists(st.binary(max_size=40), max_size=6)


@given(bodies, st.integers(0, 1 << 40))
def test_records_come_back_with_the_offsets_behind_them(found: list[bytes], start: int) -> None:
    records = [framed(body) for body in found]
    ends = [start + sum(map(len, records[: n + 1])) for n in range(len(records))]
    file = io.BytesIO(b"".join(records))
    assert list(read_records(file, Path("f"), start)) == list(zip(found, ends, strict=True))


@given(bodies, st.data())
def test_of_a_file_cut_short_all_whole_records_are_read(found: list[bytes], data: st.DataObject):
    content = b"".join(map(framed, found))
    cut = data.draw(st.integers(0, len(content)))
    whole = [body for body, end in zip(found, ends_of(content), strict=True) if end <= cut]
    read = read_records(io.BytesIO(content[:cut]), Path("f"), 0)
    assert [body for body, _ in read] == whole


@given(bodies.filter(bool), st.data())
def test_a_flipped_bit_is_refused_with_file_and_offset(found: list[bytes], data: st.DataObject):
    content = bytearray(b"".join(map(framed, found)))
    ends = [0, *ends_of(bytes(content))]
    position = data.draw(st.integers(0, len(content) - 1))
    content[position] ^= 1 << data.draw(st.integers(0, 7))
    begin = max(end for end in ends if end <= position)
    read: list[bytes] = []
    with pytest.raises(JournalError, match=rf"^name: offset {begin}: damaged"):
        read.extend(body for body, _ in read_records(io.BytesIO(content), Path("name"), 0))
    # What comes before it is told before.
    good = io.BytesIO(content[:begin])
    assert [body for body, _ in read_records(good, Path("name"), 0)] == found[: ends.index(begin)]


# The memory of a robot.


@given(st.lists(st.lists(sights, max_size=4), min_size=1, max_size=4))
def test_each_life_knows_what_all_before_it_were_told(lives: list[list[Sight]]) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "memory"
        processes: set[str] = set()
        told: list[Sight] = []
        for seen in lives:
            with life(path) as memory:
                assert memory.sights == told
                processes.add(memory.process)
                for sight in seen:
                    memory.keep(sight)
            told += seen
        (process,) = processes
        assert re.fullmatch("[0-9a-f]{16}", process)


def test_two_robots_have_different_texts(tmp_path: Path) -> None:
    assert written(tmp_path / "one", []) != written(tmp_path / "other", [])


def test_what_is_kept_is_in_the_file_before_the_next_step(tmp_path: Path) -> None:
    path = tmp_path / "memory"
    with life(path) as memory:
        for number, sight in enumerate(SIGHTS, 1):
            memory.keep(sight)
            with life(tmp_path / "copy") as copy:
                assert copy.sights == []
            (tmp_path / "copy").write_bytes(path.read_bytes())
            with life(tmp_path / "copy") as copy:
                assert copy.sights == SIGHTS[:number]
                assert copy.process == memory.process
            (tmp_path / "copy").unlink()


def test_a_torn_tail_is_dropped_wherever_it_ends(tmp_path: Path) -> None:
    path = tmp_path / "memory"
    process = written(path, SIGHTS)
    content = path.read_bytes()
    ends = ends_of(content)
    for cut in range(len(content)):
        path.write_bytes(content[:cut])
        whole = sum(end <= cut for end in ends)
        with life(path) as memory:
            assert memory.sights == SIGHTS[: max(0, whole - 1)]
            # A crash before the first record was whole: this process has never joined.
            assert (memory.process == process) == (whole > 0)
            memory.keep(SIGHTS[0])
        # What is kept from now on follows the last whole record, not the torn one.
        with life(path) as memory:
            assert memory.sights == [*SIGHTS[: max(0, whole - 1)], SIGHTS[0]]


@pytest.mark.parametrize("mask", [0x01, 0x80])
def test_each_damaged_byte_is_refused_with_file_and_offset(mask: int, tmp_path: Path) -> None:
    path = tmp_path / "memory"
    written(path, SIGHTS)
    content = path.read_bytes()
    starts = [0, *ends_of(content)]
    for position in range(len(content)):
        damaged = bytearray(content)
        damaged[position] ^= mask
        path.write_bytes(damaged)
        begin = max(start for start in starts if start <= position)
        with pytest.raises(
            JournalError, match=rf"^{re.escape(str(path))}: offset {begin}: damaged"
        ):
            Memory(path)
        assert path.read_bytes() == damaged  # it may be looked at later


def test_one_process_holds_a_memory(tmp_path: Path) -> None:
    path = tmp_path / "memory"
    with life(path) as memory:
        memory.keep(SIGHTS[0])
        with pytest.raises(JournalError, match="another process of this robot is alive"):
            Memory(path)
        memory.keep(SIGHTS[1])  # which it did not disturb
    with life(path) as memory:
        assert memory.sights == SIGHTS[:2]


def test_what_is_no_sight_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "memory"
    written(path, SIGHTS[:1])
    with path.open("ab") as file:
        file.write(framed(encode(Move(None, (), 1))))
    with pytest.raises(MessageError):
        Memory(path)
