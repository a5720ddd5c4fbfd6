"""One bookkeeping device against a list of writes."""

import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from bookkeeping.device import Device
from protocol.errors import TagError

CAPACITY = 8

fitting = st.binary(max_size=CAPACITY)
too_long = st.binary(min_size=CAPACITY + 1, max_size=CAPACITY + 8)


class DeviceMachine(RuleBasedStateMachine):
    """A device is its list of writes: the last one, and how many there were."""

    def __init__(self) -> None:
        super().__init__()
        self.device = Device(CAPACITY)
        self.writes = [b""]

    @rule(tag=fitting)
    def write(self, tag: bytes) -> None:
        self.writes.append(tag)
        assert self.device.write(tag) == len(self.writes) - 1

    @rule(tag=fitting)
    def set_what_was_seen(self, tag: bytes) -> None:
        assert self.device.compare_and_set(len(self.writes) - 1, tag)
        self.writes.append(tag)

    @precondition(lambda self: len(self.writes) > 1)
    @rule(tag=fitting, data=st.data())
    def set_what_has_changed(self, tag: bytes, data: st.DataObject) -> None:
        stale = data.draw(st.integers(0, len(self.writes) - 2))
        assert not self.device.compare_and_set(stale, tag)

    @rule(tag=fitting, ahead=st.integers(1, 3))
    def set_what_never_was(self, tag: bytes, ahead: int) -> None:
        assert not self.device.compare_and_set(len(self.writes) - 1 + ahead, tag)

    @rule(tag=too_long)
    def write_too_much(self, tag: bytes) -> None:
        with pytest.raises(TagError):
            self.device.write(tag)

    @rule(tag=too_long, revision=st.integers(0, 5))
    def set_too_much(self, tag: bytes, revision: int) -> None:
        with pytest.raises(TagError):
            self.device.compare_and_set(revision, tag)

    @invariant()
    def holds_the_last_write(self) -> None:
        assert self.device.tag == self.writes[-1]
        assert self.device.revision == len(self.writes) - 1


TestDevice = DeviceMachine.TestCase


def test_overflow_says_what_was_found_and_expected() -> None:
    with pytest.raises(TagError, match="tag of 5 bytes; the device holds at most 4"):
        Device(4).write(b"12345")


def test_a_device_may_hold_a_tag_from_before() -> None:
    device = Device(4, b"old", 7)
    assert device.write(b"new") == 8
    with pytest.raises(TagError):
        Device(2, b"old", 7)


@pytest.mark.parametrize(("capacity_bytes", "revision"), [(-1, 0), (0, -1)])
def test_nothing_is_negative(capacity_bytes: int, revision: int) -> None:
    with pytest.raises(ValueError, match="negative"):
        Device(capacity_bytes, b"", revision)


def test_no_capacity_holds_only_the_empty_tag() -> None:
    device = Device(0)
    assert device.write(b"") == 1
    with pytest.raises(TagError):
        device.write(b"1")
