"""What a bookkeeping store promises, and the reference implementation in memory.

The store is the durable copy of all tags; during a run the journal of the world server is the
authority and the store follows it. Its rules:

1. *Batches.* The world sends its writes in batches, each numbered with the wave of its last write.
   A batch is one transaction: its writes and its number are applied together or not at all.
2. *Once.* A batch whose number is not above that of the last one applied was applied before; it is
   ignored and acknowledged again, so the world may repeat a batch for ever.
3. *Incarnations.* Each life of the world server has a larger incarnation number than the one
   before, and says `hello` under it. The store remembers the largest it has heard, durably, and
   refuses all smaller ones: of two worlds that are alive on one run the older is shut out, in
   `hello` and in `apply`, and even where its batch would have been ignored.
4. *Revisions.* They only grow, by one or more (the world leaves out a write that a later one in
   the same batch replaced). A write that would not raise the revision of its place is an error of
   the world, and so is a tag over capacity: the whole batch is refused and nothing of it applied.

A place that was written holds a tag, even if the tag is empty (an erased one still has a
revision); a place that never was is simply absent.

Runs. What is stored may outlive a run, as physical tags stay where they were dropped. A store is
opened for a ``run``, and remembers the name of the last one:

- the *same* run again: the bookkeeping process was restarted. Everything is kept, tags, wave and
  incarnation. ``fresh`` means nothing then, or a crash would erase what was acknowledged.
- *another* run: wave and incarnation start anew at 0, since both count within one run. The tags
  are erased if ``fresh``; else they stay, with their revisions, from which the new run counts on.

This happens in one transaction, before the store answers anything. Only the last run is
remembered: going back to an earlier name is a new run, so a run's name must never be used for
another run. Tags left by an earlier run that exceed the capacity now asked for are refused on
opening.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, Self

from bookkeeping.device import Device
from protocol.errors import StoreError
from protocol.messages import Batch, TagWrite

NUMBER_MAX = (1 << 63) - 1
"""Places, revisions, waves and incarnations are at most this (what SQLite can hold)."""


class Store(ABC):
    """All devices of a world, as the rules above say. For one thread at a time.

    A store is a context manager that closes itself.
    """

    @abstractmethod
    def hello(self, incarnation: int) -> int:
        """Let a world server introduce itself.

        Args:
            incarnation: its number; the largest is remembered, durably.

        Returns:
            The wave number of the last batch applied in this run (0: none).

        Raises:
            StoreError: If a larger incarnation was heard before, or the store fails or is closed.
        """

    @abstractmethod
    def apply(self, batch: Batch) -> int:
        """Apply a batch once; when this returns it is as durable as was asked for.

        Args:
            batch: the writes of the waves up to ``batch.wave``.

        Returns:
            The wave number of the last batch applied: ``batch.wave``, or more if this one is old.

        Raises:
            StoreError: If the batch is of an older incarnation, follows one that is missing, a tag
                exceeds the capacity, a revision does not grow, or the store fails or is closed.
                Nothing was applied.
        """

    @abstractmethod
    def read(self, places: Sequence[int]) -> tuple[TagWrite, ...]:
        """Read tags as they are now.

        Args:
            places: where; answered in this order.

        Returns:
            The tags, places without one left out.

        Raises:
            StoreError: If the store fails or is closed.
        """

    @abstractmethod
    def tags(self) -> dict[int, TagWrite]:
        """Read all tags, by place, in the order of the places.

        Raises:
            StoreError: If the store fails or is closed.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the store; closing it again does nothing.

        Raises:
            StoreError: If what was acknowledged could not be brought to its final form.
        """

    def __enter__(self) -> Self:
        """Return the store itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the store."""
        self.close()


class MemoryStore(Store):
    """The store in memory: for one process, for tests, and as the reference of what is right.

    As a file outlives the process that wrote it, the devices of a closed store can be taken over by
    a new one (``earlier``); so the rules about runs hold here too.
    """

    def __init__(
        self,
        capacity_bytes: int,
        *,
        run: str = "run",
        fresh: bool = False,
        earlier: "MemoryStore | None" = None,
    ) -> None:
        """Open a store for a run.

        Args:
            capacity_bytes: capacity of each device.
            run: name of the run.
            fresh: whether a new run starts on blank devices.
            earlier: a closed store whose devices these are; ``None``: nothing was ever written.

        Raises:
            StoreError: If ``earlier`` is still open, a tag in it exceeds the capacity, or the
                capacity is negative or the run has no name.
        """
        check_opening(run, capacity_bytes)
        self._capacity_bytes = capacity_bytes
        self._run = run
        self._devices: dict[int, Device] = {}
        self._incarnation = 0
        self._wave = 0
        self._closed = False
        if earlier is not None:
            self._take_over(**earlier._left(), fresh=fresh)  # noqa: SLF001 - of the same class

    def hello(self, incarnation: int) -> int:
        """Let a world server introduce itself; see `Store.hello`."""
        self._check_open()
        check_incarnation(incarnation, self._incarnation)
        self._incarnation = incarnation
        return self._wave

    def apply(self, batch: Batch) -> int:
        """Apply a batch once; see `Store.apply`."""
        if batch.wave <= self.hello(batch.incarnation):
            return self._wave
        check_writes(batch, self._capacity_bytes, self._wave)
        check_revisions(batch.writes, self._revision)
        for write in batch.writes:
            self._devices[write.place] = Device(self._capacity_bytes, write.tag, write.revision)
        self._wave = batch.wave
        return self._wave

    def read(self, places: Sequence[int]) -> tuple[TagWrite, ...]:
        """Read tags as they are now; see `Store.read`."""
        self._check_open()
        check_places(places)
        return tuple(
            TagWrite(place, device.revision, device.tag)
            for place in places
            if (device := self._devices.get(place)) is not None
        )

    def tags(self) -> dict[int, TagWrite]:
        """Read all tags; see `Store.tags`."""
        return {tag.place: tag for tag in self.read(sorted(self._devices))}

    def close(self) -> None:
        """Close the store; see `Store.close`."""
        self._closed = True

    def _left(self) -> dict[str, Any]:
        """Give what outlives this store."""
        if not self._closed:
            raise StoreError("the earlier store is still open: close it first")
        return {
            "run": self._run,
            "incarnation": self._incarnation,
            "wave": self._wave,
            "devices": self._devices,
        }

    def _take_over(
        self, run: str, incarnation: int, wave: int, devices: dict[int, Device], *, fresh: bool
    ) -> None:
        resumed = run == self._run
        if resumed:
            self._incarnation = incarnation
            self._wave = wave
        if resumed or not fresh:
            for place, device in devices.items():
                check_left(place, len(device.tag), self._capacity_bytes)
                self._devices[place] = Device(self._capacity_bytes, device.tag, device.revision)

    def _revision(self, place: int) -> int:
        device = self._devices.get(place)
        return 0 if device is None else device.revision

    def _check_open(self) -> None:
        if self._closed:
            raise StoreError("the store in memory is closed")


# The rules as functions, common to all stores.


def check_opening(run: str, capacity_bytes: int) -> None:
    """Check what a store is opened with.

    Raises:
        StoreError: If the run has no name, or the capacity is negative.
    """
    if not run:
        raise StoreError("a store is opened for a run; the run's name is empty")
    if capacity_bytes < 0:
        raise StoreError(f"capacity of {capacity_bytes} bytes; expected 0 or more")


def check_left(place: int, tag_bytes: int, capacity_bytes: int) -> None:
    """Check that a tag left by an earlier run fits the devices of this one.

    Raises:
        StoreError: If it does not.
    """
    if tag_bytes > capacity_bytes:
        raise StoreError(
            f"place {place} holds a tag of {tag_bytes} bytes from before; the devices now hold at "
            f"most {capacity_bytes}: raise capacity_bytes, or start fresh"
        )


def check_incarnation(incarnation: int, largest: int) -> None:
    """Tell two live worlds apart.

    Args:
        incarnation: that of the world that speaks.
        largest: the largest heard so far in this run.

    Raises:
        StoreError: If the world is not the newest, or the number is out of range.
    """
    if incarnation < largest:
        raise StoreError(
            f"world of incarnation {incarnation} refused: incarnation {largest} has taken over"
        )
    if not 0 <= incarnation <= NUMBER_MAX:
        raise StoreError(f"incarnation {incarnation}; expected 0 to {NUMBER_MAX}")


def check_writes(batch: Batch, capacity_bytes: int, stored_wave: int) -> None:
    """Check that a batch follows what is stored, and each write of it by itself.

    Raises:
        StoreError: If batches before it are missing, a tag exceeds the capacity or a number is out of
            range; names the write.
    """
    if batch.after > stored_wave:
        raise StoreError(
            f"wave {batch.wave} follows wave {batch.after}, which was acknowledged, but the store is "
            f"at wave {stored_wave}: its file has lost its end"
        )
    if batch.wave > NUMBER_MAX:
        raise StoreError(f"wave {batch.wave}; expected at most {NUMBER_MAX}")
    for write in batch.writes:
        if len(write.tag) > capacity_bytes:
            raise StoreError(
                f"wave {batch.wave}, place {write.place}: tag of {len(write.tag)} bytes; the "
                f"device holds at most {capacity_bytes}"
            )
        if not (0 <= write.place <= NUMBER_MAX and 0 < write.revision <= NUMBER_MAX):
            raise StoreError(
                f"wave {batch.wave}: place {write.place}, revision {write.revision}; expected a "
                f"place from 0 and a revision from 1, both up to {NUMBER_MAX}"
            )


def check_revisions(writes: Sequence[TagWrite], stored: Callable[[int], int]) -> None:
    """Check that each write of a batch raises the revision of its place.

    Args:
        writes: in order.
        stored: gives the revision of a place before the batch (0: never written).

    Raises:
        StoreError: If a revision does not grow; names the write.
    """
    revisions: dict[int, int] = {}
    for write in writes:
        place = write.place
        before = revisions[place] if place in revisions else stored(place)
        if write.revision <= before:
            raise StoreError(
                f"place {place}: write of revision {write.revision}, but the tag is at revision "
                f"{before} already"
            )
        revisions[place] = write.revision


def check_places(places: Sequence[int]) -> None:
    """Check the places of a question.

    Raises:
        StoreError: If one is out of range.
    """
    for place in places:
        if not 0 <= place <= NUMBER_MAX:
            raise StoreError(f"place {place}; expected 0 to {NUMBER_MAX}")
