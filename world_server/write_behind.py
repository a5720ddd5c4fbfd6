"""The world's side of the bookkeeping store: writes gather here and follow in batches.

No clock and no transport: the shell tells the time, sends what `WriteBehind.take` and
`WriteBehind.repeat` give, and reports what the store answers. During a run the journal is the
authority; the store may lag behind, be down, be restarted, and always ends with the last writes.

How it works. The store applies each batch in one transaction together with its number, which is
the wave of its last write, and ignores numbers that it has passed. Hence:

- *Cuts fall between waves.* Were a wave split over two batches of the same number, the store would
  ignore the second. A batch holds at most ``writes_max`` writes unless one wave alone has more;
  such a wave goes whole.
- *A later write of a place replaces an earlier one only within the batch that both belong to.* The
  batch is one transaction, so nobody can see that the first was left out; the revision grows by
  more than one, which the store allows. Across batches nothing is replaced: so after each batch
  the store holds exactly the tags as of the wave in its number, and revisions reach it in rising
  order.
- *One batch in flight.* It is repeated, the same for ever, until it is acknowledged, and only then
  does the next leave. Repeats, lost and late acknowledgements do no harm, as a batch below the
  store's number is ignored, and an acknowledgement below the batch in flight is too.
- *Restart of the world.* It replays its journal and notes all writes again, or takes back from a
  snapshot those that were not acknowledged then and notes the later ones; the store's number on
  hello tells which it has. The batches are cut differently then, which does not matter: each
  buffered write remembers the wave of the last write of its place, and those that the store has
  are dropped.
- *A wave* is here whatever the world was given at once: the beginning, which is number 1, the answers
  to a wave, old tags, or word that an order was carried out. `next_wave` counts them.

The shell must have a wave in its journal before it calls `take`: a batch whose wave a restarted
world does not know would make the store ignore the waves that come in its place (`resume`,
called before the world goes on, finds that out).

A batch is one message, so ``writes_max`` tags of full capacity, and those of one wave, must fit
`protocol.messages.PAYLOAD_BYTES_MAX`.
"""

from collections import deque

from protocol.errors import StoreError
from protocol.messages import Batch, TagWrite
from world_server.state import State

_Writes = dict[int, tuple[int, int, bytes]]
"""By place: wave, revision and tag of the last write."""

REPEAT_S = 0.1
"""A batch that is not acknowledged is repeated after this time at first, ..."""

REPEAT_MAX_S = 1.6
"""... then after twice the time before, up to this."""

_NO_WAVE = -1
_AT_ONCE_S = 0.0


class UnacknowledgedState(State, frozen=True):
    """What the store has not acknowledged; the writes of a batch by place, as they are kept.

    Attributes:
        store_wave: how far the store was.
        full: batches with their numbers, oldest first; that in flight is the first of them.
        gathered: what makes the next one.
        closed_wave: the last wave of those.
        current: the writes of the wave that is being noted, ...
        wave: ... and its number.
        last_wave: number of what the world was given last.
    """

    store_wave: int
    full: list[tuple[int, _Writes]]
    gathered: _Writes
    closed_wave: int
    current: _Writes
    wave: int
    last_wave: int


class WriteBehind:
    """Gathers the writes of the world and hands them out in batches, each until acknowledged.

    Give it every write, wave by wave, with `note`; call `take` once after each wave and whenever
    `due_s` has come. Nothing leaves before `resume` has told how far the store is.

    Attributes:
        incarnation: number of this life of the world server, which all batches carry.
        known_wave: up to here the store has everything, and nothing of it is here.
        last_wave: number of what the world was given last, as `next_wave` counts.
    """

    def __init__(self, incarnation: int = 0, writes_max: int = 256, delay_s: float = 0.05) -> None:
        """Begin with nothing noted.

        Args:
            incarnation: larger than that of any life before; it may be set until a batch is taken.
            writes_max: writes in a batch, and how many gathered writes make one due.
            delay_s: how long a write waits at most for others while nothing is in flight.

        Raises:
            ValueError: If ``writes_max`` is less than 1 or ``delay_s`` is negative.
        """
        if writes_max < 1 or delay_s < 0:
            raise ValueError(
                f"writes_max {writes_max}, delay_s {delay_s}; expected at least 1 and at least 0"
            )
        self.incarnation = incarnation
        self.known_wave = 0
        self.last_wave = 0
        self._writes_max = writes_max
        self._delay_s = delay_s
        # The buffer, oldest first: batches that are full, with their numbers; the writes of closed
        # waves that make the next one; the writes of the wave that is being noted.
        self._full: deque[tuple[int, _Writes]] = deque()
        self._gathered: _Writes = {}
        self._current: _Writes = {}
        self._wave = _NO_WAVE  # the wave being noted
        self._closed_wave = 0  # the last one that was
        self._since_s: float | None = None  # when take first saw the oldest of the last two
        self._flushing = False
        self._store_wave: int | None = None  # how far the store is, as far as is known
        self._in_flight: Batch | None = None
        self._repeat_s = REPEAT_S
        self._repeat_due_s = 0.0

    def note(self, wave: int, place: int, revision: int, tag: bytes) -> None:
        """Buffer a write.

        Args:
            wave: number of the wave it belongs to, from 1; never smaller than the one before.
            place: where.
            revision: how often the place was written, this write included.
            tag: what it holds now.

        Raises:
            ValueError: If ``wave`` is closed: a later one was noted, or `take`, `flush` or
                `resume` called since.
        """
        if wave != self._wave:
            self._begin(wave)
        self._current[place] = (wave, revision, tag)

    def next_wave(self) -> None:
        """Count one more thing that the world is given."""
        self.last_wave += 1

    def written(self, place: int, revision: int, tag: bytes) -> None:
        """Note a write of the wave that was counted last."""
        self.note(self.last_wave, place, revision, tag)

    def take(self, now_s: float) -> Batch | None:
        """Close the wave, and give the next batch if it is due.

        It is due when nothing is in flight, the store's hello was heard, and ``writes_max`` writes
        have gathered, or the oldest has waited ``delay_s``, or a flush was asked for.

        Args:
            now_s: the time, in seconds; not negative, and never goes back.

        Returns:
            The batch to send, which is in flight from now on; or ``None``.
        """
        if self._current:
            self._close()
        if self._since_s is None and self._gathered:
            self._since_s = now_s
        if self._in_flight is not None or self._store_wave is None:
            return None
        if self._full:
            wave, writes = self._full.popleft()
        elif self._since_s is not None and (
            self._flushing
            or now_s >= self._since_s + self._delay_s
            or len(self._gathered) >= self._writes_max
        ):
            wave, writes = self._closed_wave, self._gathered
            self._gathered = {}
            self._since_s = None
        else:
            return None
        if not self._full and not self._gathered:
            self._flushing = False
        self._in_flight = Batch(
            self.incarnation,
            wave,
            tuple([TagWrite(place, revision, tag) for place, (_, revision, tag) in writes.items()]),
            self.known_wave,
        )
        self._repeat_s = REPEAT_S
        self._repeat_due_s = now_s + REPEAT_S
        return self._in_flight

    def repeat(self, now_s: float) -> Batch | None:
        """Give the batch in flight once more, whether its repeat is due or not.

        Args:
            now_s: the time; the repeat after this one is due later by a longer interval.

        Returns:
            The same batch as before, or ``None`` if nothing is in flight.
        """
        if self._in_flight is not None:
            self._repeat_s = min(2 * self._repeat_s, REPEAT_MAX_S)
            self._repeat_due_s = now_s + self._repeat_s
        return self._in_flight

    def due_s(self) -> float | None:
        """Tell when something is to be done next, if nothing happens until then.

        Returns:
            When to call `repeat` if a batch is in flight, else when to call `take` (0: at once);
            ``None`` if there is nothing to wait for, or the store's hello is still to come.
        """
        if self._in_flight is not None:
            return self._repeat_due_s
        if self._store_wave is None or self._is_empty():
            return None
        if self._full or self._flushing or self._since_s is None:
            return _AT_ONCE_S
        return self._since_s + self._delay_s

    def flush(self) -> None:
        """Ask that what is noted leaves without waiting for more; also closes the wave."""
        if self._current:
            self._close()
        self._flushing = not self._is_empty()

    def acknowledged(self, wave: int) -> None:
        """Hear that the store has applied everything up to a wave.

        Args:
            wave: what the store answered; late and repeated answers are ignored.

        Raises:
            StoreError: If nothing of that wave was ever sent: another world writes to the store.
        """
        batch = self._in_flight
        if batch is None or wave != batch.wave:
            sent = self._store_wave or 0 if batch is None else batch.wave
            if wave > sent:
                raise StoreError(
                    f"the store acknowledges wave {wave}, but only wave {sent} was sent: is "
                    "another world server alive on this run?"
                )
            return
        self._in_flight = None
        self._store_wave = self.known_wave = wave

    @property
    def idle(self) -> bool:
        """Whether nothing is buffered and nothing in flight: the store has everything noted."""
        return self._in_flight is None and self._is_empty()

    def resume(self, store_wave: int) -> None:
        """Hear how far the store is: its answer to hello.

        After a restart of the world, note all writes of the journal first; those that the store has
        are dropped here, the others follow. After a restart of the store the batch in flight counts
        as acknowledged if the store has it, and is to be repeated if not.

        Args:
            store_wave: wave number of the last batch that the store has applied. Only the answer
                to the last hello counts; the shell ignores any that come late.

        Raises:
            StoreError: If the store is ahead of everything noted here, or behind ``known_wave``:
                journal and store do not belong together, or one lost its end.
        """
        if self._current:
            self._close()
        if store_wave > self._closed_wave:
            raise StoreError(
                f"the store is at wave {store_wave}, the journal writes only up to wave "
                f"{self._closed_wave}: the journal has lost its end, or belongs to another run"
            )
        if store_wave < self.known_wave:
            raise StoreError(
                f"the store is at wave {store_wave}, but acknowledged wave {self.known_wave}: it "
                "has lost its end, or is another"
            )
        self._store_wave = self.known_wave = store_wave
        if self._in_flight is not None and self._in_flight.wave <= store_wave:
            self._in_flight = None
        kept = ((wave, _after(store_wave, writes)) for wave, writes in self._full)
        self._full = deque((wave, writes) for wave, writes in kept if writes)
        self._gathered = _after(store_wave, self._gathered)
        if not self._gathered:
            self._since_s = None
        if self._is_empty():
            self._flushing = False

    def state(self) -> UnacknowledgedState:
        """Return what the store has not acknowledged."""
        full = [(wave, writes.copy()) for wave, writes in self._full]
        batch = self._in_flight
        if batch is not None:
            # It is applied as a whole or not at all, so the number of its last wave does for all.
            writes = {one.place: (batch.wave, one.revision, one.tag) for one in batch.writes}
            full.insert(0, (batch.wave, writes))
        return UnacknowledgedState(
            self.known_wave,
            full,
            self._gathered.copy(),
            self._closed_wave,
            self._current.copy(),
            self._wave,
            self.last_wave,
        )

    def restore(self, state: UnacknowledgedState) -> None:
        """Begin with what the store had not acknowledged in an earlier life; `resume` follows."""
        self.known_wave, self.last_wave = state.store_wave, state.last_wave
        self._full = deque((wave, writes.copy()) for wave, writes in state.full)
        self._gathered, self._current = state.gathered.copy(), state.current.copy()
        self._closed_wave, self._wave = state.closed_wave, state.wave

    def _begin(self, wave: int) -> None:
        """Close the wave being noted and begin a later one."""
        if self._current:
            self._close()
        if wave <= self._closed_wave:
            raise ValueError(
                f"write of wave {wave} noted after wave {self._closed_wave} was closed"
            )
        self._wave = wave

    def _close(self) -> None:
        """Add the wave to the gathered ones; if they become too many, begin a batch with it."""
        current, gathered = self._current, self._gathered
        if gathered:
            size = len(gathered) + len(current)
            if size > self._writes_max:
                size -= len(gathered.keys() & current.keys())
            if size > self._writes_max:
                self._full.append((self._closed_wave, gathered))
                self._gathered = current
                self._since_s = None
            else:
                gathered.update(current)
        else:
            self._gathered = current
        self._current = {}
        self._closed_wave = self._wave
        self._wave = _NO_WAVE

    def _is_empty(self) -> bool:
        return not (self._full or self._gathered or self._current)


def _after(store_wave: int, writes: _Writes) -> _Writes:
    """Give those of the writes that are of later waves."""
    return {place: write for place, write in writes.items() if write[0] > store_wave}
