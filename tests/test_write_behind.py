"""The world's side of the store: batches, their times, and an unreliable link to a real store."""

from unittest.mock import ANY

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from bookkeeping.store import MemoryStore
from protocol.errors import StoreError
from protocol.messages import Batch, TagWrite
from world_server.write_behind import REPEAT_MAX_S, REPEAT_S, WriteBehind


def ready(incarnation: int = 1, writes_max: int = 4, delay_s: float = 0.05) -> WriteBehind:
    """One whose store has said that it is blank."""
    behind = WriteBehind(incarnation, writes_max, delay_s)
    behind.resume(0)
    return behind


def batch(wave: int, *writes: tuple[int, int, bytes], incarnation: int = 1) -> Batch:
    return Batch(incarnation, wave, tuple(TagWrite(*write) for write in writes), after=ANY)


def test_a_batch_says_what_it_follows() -> None:
    behind = ready(writes_max=1)
    behind.note(1, 0, 1, b"a")
    first = behind.take(0.0)
    assert first is not None
    assert first.after == 0
    behind.acknowledged(1)
    behind.note(3, 0, 2, b"b")
    second = behind.take(0.0)
    assert second is not None
    assert second.after == 1
    with pytest.raises(StoreError, match=r"wave 3 follows wave 1, .* the store is at wave 0"):
        MemoryStore(run="run", capacity_bytes=8, fresh=True).apply(second)


# When a batch leaves.


def test_nothing_noted_nothing_to_do() -> None:
    behind = ready()
    assert behind.idle
    assert behind.due_s() is None
    assert behind.take(0.0) is None
    assert behind.repeat(0.0) is None
    behind.flush()
    assert behind.take(9.0) is None


def test_a_write_waits_for_others_and_then_leaves() -> None:
    behind = ready()
    behind.note(1, 7, 1, b"a")
    assert behind.due_s() == 0.0  # nobody has told the time yet
    assert behind.take(10.0) is None
    assert not behind.idle
    assert behind.due_s() == 10.05
    behind.note(2, 8, 1, b"b")
    assert behind.take(10.04) is None
    assert behind.due_s() == 10.05
    assert behind.take(10.05) == batch(2, (7, 1, b"a"), (8, 1, b"b"))
    assert not behind.idle
    behind.acknowledged(2)
    assert behind.idle
    assert behind.due_s() is None


def test_enough_writes_leave_at_once() -> None:
    behind = ready(writes_max=3)
    behind.note(1, 0, 1, b"a")
    behind.note(1, 1, 1, b"b")
    assert behind.take(0.0) is None
    behind.note(2, 2, 1, b"c")
    assert behind.take(0.0) == batch(2, (0, 1, b"a"), (1, 1, b"b"), (2, 1, b"c"))


def test_a_flush_leaves_at_once() -> None:
    behind = ready()
    behind.note(1, 0, 1, b"a")
    behind.flush()
    assert behind.due_s() == 0.0
    assert behind.take(0.0) == batch(1, (0, 1, b"a"))
    behind.acknowledged(1)
    behind.note(2, 0, 2, b"b")
    assert behind.take(0.0) is None  # the flush was for what had been noted


def test_a_flush_carries_on_until_all_is_gone() -> None:
    behind = ready(writes_max=1)
    for wave in (1, 2, 3):
        behind.note(wave, wave, 1, b"")
    behind.flush()
    for wave in (1, 2, 3):
        assert behind.take(0.0) == batch(wave, (wave, 1, b""))
        assert behind.take(0.0) is None
        behind.acknowledged(wave)
    assert behind.idle


def test_nothing_leaves_before_the_store_has_answered_hello() -> None:
    behind = WriteBehind(1, writes_max=1)
    behind.note(1, 0, 1, b"a")
    behind.flush()
    assert behind.take(9.0) is None
    assert behind.due_s() is None
    assert not behind.idle
    behind.resume(0)
    assert behind.take(9.0) == batch(1, (0, 1, b"a"))


def test_one_batch_in_flight() -> None:
    behind = ready(writes_max=1)
    behind.note(1, 0, 1, b"a")
    assert behind.take(0.0) is not None
    behind.note(2, 0, 2, b"b")
    assert behind.take(9.0) is None
    behind.acknowledged(1)
    assert behind.take(9.0) == batch(2, (0, 2, b"b"))


def test_the_delay_runs_while_another_batch_is_in_flight() -> None:
    behind = ready()
    behind.note(1, 0, 1, b"a")
    behind.flush()
    assert behind.take(0.0) is not None
    behind.note(2, 0, 2, b"b")
    assert behind.take(0.01) is None
    behind.acknowledged(1)
    assert behind.due_s() == pytest.approx(0.06)
    assert behind.take(0.07) is not None


def test_repeats_are_the_same_and_back_off() -> None:
    behind = ready(writes_max=1)
    behind.note(1, 0, 1, b"a")
    sent = behind.take(0.0)
    now_s, interval_s = 0.0, REPEAT_S
    for _ in range(8):
        due_s = behind.due_s()
        assert due_s is not None
        assert due_s == pytest.approx(now_s + interval_s)
        now_s = due_s
        assert behind.repeat(now_s) is sent
        interval_s = min(2 * interval_s, REPEAT_MAX_S)
    behind.acknowledged(1)
    assert behind.repeat(now_s) is None
    behind.note(2, 0, 2, b"b")
    assert behind.take(now_s) is not None
    assert behind.due_s() == pytest.approx(now_s + REPEAT_S)


# What is in a batch.


def test_a_later_write_replaces_an_earlier_one_of_the_same_batch() -> None:
    behind = ready()
    behind.note(1, 0, 1, b"a")
    behind.note(1, 0, 2, b"b")
    behind.note(2, 1, 1, b"c")
    behind.note(3, 0, 3, b"d")
    behind.flush()
    assert behind.take(0.0) == batch(3, (0, 3, b"d"), (1, 1, b"c"))


def test_a_wave_is_not_split() -> None:
    behind = ready(writes_max=4)
    for wave, size in ((1, 3), (2, 2), (3, 2), (4, 7), (5, 1)):
        for place in range(size):
            behind.note(wave, 10 * wave + place, 1, b"")
    behind.flush()
    sizes = []
    while (sent := behind.take(0.0)) is not None:
        sizes.append((sent.wave, len(sent.writes)))
        behind.acknowledged(sent.wave)
    assert sizes == [(1, 3), (3, 4), (4, 7), (5, 1)]


def test_replaced_writes_make_room() -> None:
    behind = ready(writes_max=2)
    for wave in (1, 2, 3):
        for place in (0, 1):
            behind.note(wave, place, wave, b"")
    behind.flush()
    assert behind.take(0.0) == batch(3, (0, 3, b""), (1, 3, b""))
    behind.acknowledged(3)
    assert behind.idle


@pytest.mark.parametrize("close", ["take", "flush", "resume", "later"])
def test_a_closed_wave_stays_closed(close: str) -> None:
    behind = ready()
    behind.note(3, 0, 1, b"")
    if close == "take":
        behind.take(0.0)
    elif close == "flush":
        behind.flush()
    elif close == "resume":
        behind.resume(0)
    else:
        behind.note(4, 1, 1, b"")
    with pytest.raises(ValueError, match=r"wave 3 noted after wave \d was closed"):
        behind.note(3, 0, 2, b"")


def test_waves_count_from_one() -> None:
    with pytest.raises(ValueError, match="wave 0"):
        ready().note(0, 0, 1, b"")


@pytest.mark.parametrize(("writes_max", "delay_s"), [(0, 0.05), (1, -0.1)])
def test_the_limits_are_checked(writes_max: int, delay_s: float) -> None:
    with pytest.raises(ValueError, match="expected at least"):
        WriteBehind(1, writes_max, delay_s)


# What the store says.


def test_late_acknowledgements_are_ignored() -> None:
    behind = ready(writes_max=1)
    for wave in (1, 2):
        behind.note(wave, 0, wave, b"")
        behind.take(0.0)
        behind.acknowledged(wave - 1)
        assert not behind.idle
        behind.acknowledged(wave)
        behind.acknowledged(wave)
        behind.acknowledged(wave - 1)
        assert behind.idle


def test_an_acknowledgement_of_what_was_never_sent_is_an_error() -> None:
    behind = ready(writes_max=1)
    with pytest.raises(StoreError, match="another world"):
        behind.acknowledged(1)
    behind.note(1, 0, 1, b"")
    behind.take(0.0)
    with pytest.raises(StoreError, match="wave 2, but only wave 1 was sent"):
        behind.acknowledged(2)


def test_resume_drops_what_the_store_has() -> None:
    behind = WriteBehind(2, writes_max=3)
    behind.note(1, 0, 1, b"a")
    behind.note(2, 1, 1, b"b")
    behind.note(3, 0, 2, b"c")
    behind.note(4, 2, 1, b"d")
    behind.note(5, 3, 1, b"e")
    behind.resume(2)
    behind.flush()
    assert behind.take(0.0) == batch(4, (0, 2, b"c"), (2, 1, b"d"), incarnation=2)
    behind.acknowledged(4)
    assert behind.take(0.0) == batch(5, (3, 1, b"e"), incarnation=2)


def test_resume_with_a_store_that_has_everything() -> None:
    behind = WriteBehind(2, writes_max=1)
    behind.note(1, 0, 1, b"a")
    behind.note(2, 1, 1, b"b")
    behind.flush()
    behind.resume(2)
    assert behind.idle
    assert behind.due_s() is None


def test_a_store_ahead_of_the_journal_is_an_error() -> None:
    behind = WriteBehind(2)
    behind.note(4, 0, 1, b"a")
    with pytest.raises(
        StoreError, match="store is at wave 5, the journal writes only up to wave 4"
    ):
        behind.resume(5)


def test_a_store_behind_what_it_acknowledged_is_an_error() -> None:
    behind = ready(writes_max=1)
    behind.note(4, 0, 1, b"a")
    behind.take(0.0)
    behind.acknowledged(4)
    with pytest.raises(StoreError, match="acknowledged wave 4"):
        behind.resume(3)


@pytest.mark.parametrize("applied", [True, False])
def test_a_restart_of_the_store_settles_the_batch_in_flight(applied: bool) -> None:
    behind = ready(writes_max=1)
    behind.note(1, 0, 1, b"a")
    sent = behind.take(0.0)
    behind.resume(1 if applied else 0)
    assert behind.idle is applied
    assert behind.repeat(0.0) == (None if applied else sent)


# An unreliable link: batches and acknowledgements are lost, doubled and overtake one another, while
# the world and the store die and come back.

CAPACITY = 4


class LinkMachine(RuleBasedStateMachine):
    """After every step the store holds the tags as of its wave; in the end, the last writes."""

    def __init__(self) -> None:
        super().__init__()
        self.store = MemoryStore(CAPACITY)
        self.now_s = 0.0
        self.incarnation = 0
        self.journal: list[tuple[int, list[TagWrite]]] = []
        self.revisions: dict[int, int] = {}
        self.tags_at: dict[int, dict[int, TagWrite]] = {0: {}}
        self.wave = 0
        self.batches: list[Batch] = []
        self.acknowledgements: list[int] = []
        self.restart_world(writes_max=3)

    def send(self, message: Batch | None) -> None:
        if message is not None:
            self.batches.append(message)

    @rule(
        places=st.lists(st.integers(0, 5), max_size=6),
        skip=st.integers(1, 3),
        tag=st.binary(max_size=4),
    )
    def wave_passes(self, places: list[int], skip: int, tag: bytes) -> None:
        """The world commits a wave, with the same place twice perhaps; then it calls take."""
        self.wave += skip
        writes = []
        for place in places:
            self.revisions[place] = self.revisions.get(place, 0) + 1
            writes.append(TagWrite(place, self.revisions[place], tag))
        self.journal.append((self.wave, writes))
        latest = dict(max(self.tags_at.items())[1])
        latest.update({write.place: write for write in writes})
        self.tags_at[self.wave] = latest
        self.note(self.wave, writes)
        self.send(self.behind.take(self.now_s))

    def note(self, wave: int, writes: list[TagWrite]) -> None:
        for write in writes:
            self.behind.note(wave, write.place, write.revision, write.tag)

    @rule(step_s=st.sampled_from([0.01, 0.03, 0.05, 1.0]))
    def time_passes(self, step_s: float) -> None:
        self.now_s += step_s
        due_s = self.behind.due_s()
        if due_s is not None and due_s <= self.now_s:
            self.send(self.behind.repeat(self.now_s) or self.behind.take(self.now_s))

    @rule()
    def flush(self) -> None:
        self.behind.flush()
        self.send(self.behind.take(self.now_s))

    @precondition(lambda self: self.batches)
    @rule(data=st.data(), copies=st.integers(0, 2), stays=st.booleans())
    def batch_arrives(self, data: st.DataObject, copies: int, stays: bool) -> None:
        """Any batch on its way, of any life of the world; lost, or once, or twice."""
        index = data.draw(st.integers(0, len(self.batches) - 1))
        message = self.batches[index] if stays else self.batches.pop(index)
        for _ in range(copies):
            if message.incarnation < self.incarnation:
                with pytest.raises(StoreError, match="refused"):
                    self.store.apply(message)
            else:
                self.acknowledgements.append(self.store.apply(message))

    @precondition(lambda self: self.acknowledgements)
    @rule(data=st.data(), copies=st.integers(0, 2), stays=st.booleans())
    def acknowledgement_arrives(self, data: st.DataObject, copies: int, stays: bool) -> None:
        """Any acknowledgement on its way, even one that was meant for an earlier life."""
        index = data.draw(st.integers(0, len(self.acknowledgements) - 1))
        wave = self.acknowledgements[index] if stays else self.acknowledgements.pop(index)
        for _ in range(copies):
            self.behind.acknowledged(wave)

    @rule(writes_max=st.integers(1, 6))
    def restart_world(self, writes_max: int) -> None:
        self.incarnation += 1
        self.behind = WriteBehind(self.incarnation, writes_max)
        for wave, writes in self.journal:
            self.note(wave, writes)
        self.behind.resume(self.store.hello(self.incarnation))

    @rule()
    def restart_store(self) -> None:
        self.store.close()
        self.store = MemoryStore(CAPACITY, earlier=self.store)
        self.behind.resume(self.store.hello(self.incarnation))

    @invariant()
    def the_store_is_exactly_at_its_wave(self) -> None:
        assert self.store.tags() == self.tags_at[self.store.hello(self.incarnation)]

    def teardown(self) -> None:
        """The link is good from now on."""
        self.behind.flush()
        for _ in range(len(self.journal) + 1):
            message = self.behind.repeat(self.now_s) or self.behind.take(self.now_s)
            if message is None:
                break
            self.behind.acknowledged(self.store.apply(message))
        assert self.behind.idle
        assert self.store.tags() == self.tags_at[self.wave]


TestUnreliableLink = LinkMachine.TestCase
TestUnreliableLink.settings = settings(max_examples=150, stateful_step_count=40)
