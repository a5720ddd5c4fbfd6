"""The bookkeeping stores: one conformance suite, a state machine, and files."""

import sqlite3
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from bookkeeping.sqlite_store import FILE_VERSION, Durability, SqliteStore
from bookkeeping.store import NUMBER_MAX, MemoryStore, Store
from protocol.errors import StoreError
from protocol.messages import Batch, TagWrite

ROOT = Path(__file__).resolve().parent.parent
CAPACITY = 16


def batch(wave: int, *writes: tuple[int, int, bytes], incarnation: int = 1) -> Batch:
    return Batch(incarnation, wave, tuple(TagWrite(*write) for write in writes))


# Conformance: every store keeps the rules of bookkeeping/store.py.

Opener = Callable[..., Store]
"""Opens the one store of a test, again and again: run, fresh, capacity_bytes."""


@pytest.fixture(params=["memory", "sqlite-process", "sqlite-power"])
def opener(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Opener]:
    opened: list[Store] = []

    def open_memory(run: str = "r", *, fresh: bool = False, capacity: int = CAPACITY) -> Store:
        earlier = opened[-1] if opened else None
        assert earlier is None or isinstance(earlier, MemoryStore)
        opened.append(MemoryStore(capacity, run=run, fresh=fresh, earlier=earlier))
        return opened[-1]

    durability: Durability = "power" if request.param == "sqlite-power" else "process"

    def open_sqlite(run: str = "r", *, fresh: bool = False, capacity: int = CAPACITY) -> Store:
        store = SqliteStore(
            tmp_path / "tags.sqlite",
            run=run,
            capacity_bytes=capacity,
            fresh=fresh,
            durability=durability,
        )
        opened.append(store)
        return store

    yield open_memory if request.param == "memory" else open_sqlite
    for store in opened:
        store.close()


def test_a_new_store_is_blank(opener: Opener) -> None:
    store = opener()
    assert store.hello(1) == 0
    assert store.tags() == {}
    assert store.read((0, 1)) == ()


def test_a_batch_is_applied(opener: Opener) -> None:
    store = opener()
    assert store.apply(batch(3, (7, 1, b"seven"), (2, 4, b""))) == 3
    assert store.hello(1) == 3
    assert store.tags() == {2: TagWrite(2, 4, b""), 7: TagWrite(7, 1, b"seven")}
    assert list(store.tags()) == [2, 7]


def test_read_answers_in_the_order_asked(opener: Opener) -> None:
    store = opener()
    store.apply(batch(1, (1, 1, b"a"), (2, 1, b"b"), (3, 1, b"c")))
    assert store.read((3, 9, 1)) == (TagWrite(3, 1, b"c"), TagWrite(1, 1, b"a"))
    assert store.read(()) == ()


def test_a_repeat_is_ignored_and_acknowledged(opener: Opener) -> None:
    store = opener()
    first, second = batch(1, (0, 1, b"a")), batch(4, (0, 2, b"b"))
    assert [store.apply(b) for b in (first, first, second, first, second)] == [1, 1, 4, 4, 4]
    assert store.tags() == {0: TagWrite(0, 2, b"b")}


def test_an_old_wave_is_ignored_whatever_it_holds(opener: Opener) -> None:
    store = opener()
    store.apply(batch(5, (0, 1, b"a")))
    assert store.apply(batch(4, (0, 9, b"x" * 99), (1, 1, b"new"))) == 5
    assert store.tags() == {0: TagWrite(0, 1, b"a")}


def test_a_batch_without_writes_counts(opener: Opener) -> None:
    store = opener()
    assert store.apply(batch(2)) == 2
    assert store.hello(1) == 2


def test_writes_of_one_batch_take_effect_in_order(opener: Opener) -> None:
    store = opener()
    store.apply(batch(1, (0, 1, b"a"), (1, 1, b"x"), (0, 2, b"b")))
    assert store.read((0,)) == (TagWrite(0, 2, b"b"),)


@pytest.mark.parametrize(
    ("writes", "match"),
    [
        ([(1, 1, b"ok"), (2, 1, b"x" * 17)], "place 2: tag of 17 bytes.*at most 16"),
        ([(1, 1, b"ok"), (0, 3, b"same")], "place 0: write of revision 3.*revision 3 already"),
        ([(1, 1, b"ok"), (0, 2, b"less")], "place 0: write of revision 2.*revision 3 already"),
        ([(1, 2, b"ok"), (1, 2, b"again")], "place 1: write of revision 2.*revision 2 already"),
        ([(1, 1, b"ok"), (2, 0, b"none")], "revision 0; expected"),
        ([(1, 1, b"ok"), (-1, 1, b"")], "place -1"),
        ([(1, 1, b"ok"), (NUMBER_MAX + 1, 1, b"")], "place 9223372036854775808"),
        ([(1, 1, b"ok"), (2, NUMBER_MAX + 1, b"")], "revision 9223372036854775808"),
    ],
)
def test_a_batch_with_a_bad_write_is_refused_whole(
    opener: Opener, writes: list[tuple[int, int, bytes]], match: str
) -> None:
    store = opener()
    store.apply(batch(1, (0, 3, b"kept")))
    with pytest.raises(StoreError, match=match):
        store.apply(batch(2, *writes))
    assert store.hello(1) == 1
    assert store.tags() == {0: TagWrite(0, 3, b"kept")}
    assert store.apply(batch(2, (0, 4, b"right"))) == 2


def test_numbers_are_bounded(opener: Opener) -> None:
    store = opener()
    with pytest.raises(StoreError, match="wave"):
        store.apply(batch(NUMBER_MAX + 1))
    with pytest.raises(StoreError, match="incarnation"):
        store.hello(NUMBER_MAX + 1)
    with pytest.raises(StoreError, match="place"):
        store.read((NUMBER_MAX + 1,))
    assert store.apply(batch(NUMBER_MAX, (NUMBER_MAX, NUMBER_MAX, b""))) == NUMBER_MAX


def test_the_older_of_two_worlds_is_shut_out(opener: Opener) -> None:
    store = opener()
    assert store.apply(batch(1, (0, 1, b"a"), incarnation=1)) == 1
    assert store.hello(2) == 1
    for old in (batch(2, (0, 2, b"b")), batch(1, (0, 1, b"a"))):
        with pytest.raises(StoreError, match="incarnation 1 refused: incarnation 2"):
            store.apply(old)
    with pytest.raises(StoreError, match="incarnation 1 refused"):
        store.hello(1)
    assert store.hello(2) == 1
    assert store.tags() == {0: TagWrite(0, 1, b"a")}


def test_a_batch_introduces_its_world_too(opener: Opener) -> None:
    store = opener()
    assert store.apply(batch(1, incarnation=3)) == 1
    assert store.apply(batch(1, incarnation=4)) == 1  # ignored, but heard
    with pytest.raises(StoreError, match="incarnation 3 refused"):
        store.hello(3)


def test_the_same_run_resumes(opener: Opener) -> None:
    with opener("r") as store:
        store.hello(5)
        store.apply(batch(9, (0, 2, b"a"), incarnation=5))
    store = opener("r", fresh=True)  # means nothing: the run has begun already
    with pytest.raises(StoreError, match="incarnation 4 refused"):
        store.hello(4)
    assert store.hello(6) == 9
    assert store.tags() == {0: TagWrite(0, 2, b"a")}


def test_the_incarnation_is_durable_by_hello_alone(opener: Opener) -> None:
    with opener() as store:
        store.hello(5)
    with pytest.raises(StoreError, match="incarnation 4 refused"):
        opener().hello(4)


def test_a_new_run_counts_anew_on_the_tags_that_were_left(opener: Opener) -> None:
    with opener("first") as store:
        store.apply(batch(9, (0, 2, b"a"), incarnation=5))
    store = opener("second")
    assert store.hello(1) == 0
    assert store.read((0,)) == (TagWrite(0, 2, b"a"),)
    with pytest.raises(StoreError, match="place 0: write of revision 1"):
        store.apply(batch(1, (0, 1, b"b")))
    assert store.apply(batch(1, (0, 3, b"b"))) == 1


def test_a_new_run_may_start_fresh(opener: Opener) -> None:
    with opener("first") as store:
        store.apply(batch(9, (0, 2, b"a"), incarnation=5))
    with opener("second", fresh=True) as store:
        assert store.hello(1) == 0
        assert store.tags() == {}
        assert store.apply(batch(1, (0, 1, b"b"))) == 1
    assert opener("second").tags() == {0: TagWrite(0, 1, b"b")}


def test_an_earlier_name_is_a_new_run(opener: Opener) -> None:
    opener("first").close()
    with opener("second") as store:
        store.apply(batch(9, incarnation=5))
    assert opener("first").hello(1) == 0


def test_tags_left_must_fit(opener: Opener) -> None:
    with opener("first") as store:
        store.apply(batch(1, (4, 1, b"x" * 10), (5, 1, b"y" * 3)))
    with pytest.raises(StoreError, match=r"place 4 holds a tag of 10 bytes.*at most 9"):
        opener("second", capacity=9)
    assert opener("second", capacity=9, fresh=True).tags() == {}


def test_a_refused_opening_changes_nothing(opener: Opener) -> None:
    with opener("first") as store:
        store.apply(batch(3, (4, 1, b"x" * 10)))
    with pytest.raises(StoreError, match="place 4"):
        opener("second", capacity=9)
    assert opener("first").hello(1) == 3


def test_an_open_store_is_nobody_elses(opener: Opener) -> None:
    store = opener()
    with pytest.raises(StoreError, match="open"):
        opener()
    assert store.apply(batch(1, (0, 1, b"a"))) == 1


def test_a_closed_store_refuses_everything(opener: Opener) -> None:
    store = opener()
    store.apply(batch(1, (0, 1, b"a")))
    store.close()
    store.close()
    for call in (
        lambda: store.hello(1),
        lambda: store.apply(batch(2, (0, 2, b"b"))),
        lambda: store.apply(batch(1, (0, 1, b"a"))),
        lambda: store.read((0,)),
        store.tags,
    ):
        with pytest.raises(StoreError, match="closed"):
            call()
    assert opener().tags() == {0: TagWrite(0, 1, b"a")}


def test_what_a_store_is_opened_with_is_checked(opener: Opener) -> None:
    with pytest.raises(StoreError, match="name"):
        opener("")
    with pytest.raises(StoreError, match="capacity"):
        opener(capacity=-1)


# The reference against SQLite, step by step.

write_st = st.tuples(st.integers(0, 4), st.integers(-1, 3), st.binary(max_size=CAPACITY + 1))


class StoreMachine(RuleBasedStateMachine):
    """Both stores get the same; both must answer the same and end the same."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = tempfile.TemporaryDirectory()
        self.path = Path(self.folder.name, "tags.sqlite")
        self.run = "0"
        self.sent: list[Batch] = []

    @initialize()
    def open_first(self) -> None:
        self.memory = MemoryStore(CAPACITY, run=self.run)
        self.sqlite = self._sqlite(fresh=False)

    def _sqlite(self, *, fresh: bool) -> SqliteStore:
        return SqliteStore(
            self.path, run=self.run, capacity_bytes=CAPACITY, fresh=fresh, durability="process"
        )

    def both(self, call: Callable[[Store], object]) -> None:
        answers = []
        for store in (self.memory, self.sqlite):
            try:
                answers.append(call(store))
            except StoreError as error:
                answers.append(str(error))
        assert answers[0] == answers[1]

    @rule(
        wave=st.integers(-1, 3),
        incarnation=st.sampled_from([0, 0, 0, 0, 1, -1]),
        writes=st.lists(write_st, max_size=6),
    )
    def send(self, wave: int, incarnation: int, writes: list[tuple[int, int, bytes]]) -> None:
        """Send a batch, described by how far it is from what the store has."""
        revisions = {place: tag.revision for place, tag in self.memory.tags().items()}
        built = []
        for place, step, tag in writes:
            revision = max(0, revisions.get(place, 0) + step)
            revisions[place] = max(revision, revisions.get(place, 0))
            built.append(TagWrite(place, revision, tag))
        message = Batch(
            max(0, self.memory._incarnation + incarnation),
            max(0, self.memory._wave + wave),
            tuple(built),
        )
        self.sent.append(message)
        self.both(lambda store: store.apply(message))

    @rule(incarnation=st.integers(0, 1), writes=st.lists(write_st, min_size=1, max_size=6))
    def send_right(self, incarnation: int, writes: list[tuple[int, int, bytes]]) -> None:
        """Send a batch that must be applied."""
        revisions = {place: tag.revision for place, tag in self.memory.tags().items()}
        built = []
        for place, step, tag in writes:
            revisions[place] = revisions.get(place, 0) + max(1, step)
            built.append(TagWrite(place, revisions[place], tag[:CAPACITY]))
        wave = self.memory._wave + 1
        message = Batch(self.memory._incarnation + incarnation, wave, tuple(built))
        self.sent.append(message)
        self.both(lambda store: store.apply(message))
        assert self.memory._wave == wave
        assert set(self.memory.read([write.place for write in built])) <= set(built)

    @rule(data=st.data())
    def repeat(self, data: st.DataObject) -> None:
        if self.sent:
            message = data.draw(st.sampled_from(self.sent))
            self.both(lambda store: store.apply(message))

    @rule(incarnation=st.integers(-1, 2))
    def hello(self, incarnation: int) -> None:
        number = self.memory._incarnation + incarnation
        self.both(lambda store: store.hello(number))

    @rule(places=st.lists(st.integers(0, 6), max_size=5))
    def read(self, places: list[int]) -> None:
        self.both(lambda store: store.read(places))

    @rule(another=st.booleans(), fresh=st.booleans())
    def reopen(self, another: bool, fresh: bool) -> None:
        self.memory.close()
        self.sqlite.close()
        if another:
            self.run = str(int(self.run) + 1)
        self.memory = MemoryStore(CAPACITY, run=self.run, fresh=fresh, earlier=self.memory)
        self.sqlite = self._sqlite(fresh=fresh)

    @invariant()
    def equal(self) -> None:
        assert self.memory.tags() == self.sqlite.tags()
        assert self.memory._wave == self.sqlite._wave
        assert self.memory._incarnation == self.sqlite._incarnation

    def teardown(self) -> None:
        if hasattr(self, "sqlite"):
            self.sqlite.close()
        self.folder.cleanup()


TestStores = StoreMachine.TestCase
TestStores.settings = settings(max_examples=40, stateful_step_count=30)


# Files.


def open_file(path: Path, run: str = "r") -> SqliteStore:
    return SqliteStore(path, run=run, capacity_bytes=CAPACITY, fresh=False, durability="process")


def test_nothing_lies_beside_the_file_after_closing(tmp_path: Path) -> None:
    path = tmp_path / "tags.sqlite"
    with open_file(path) as store:
        store.apply(batch(1, (0, 1, b"a")))
        assert {p.name for p in tmp_path.iterdir()} == {"tags.sqlite", "tags.sqlite-wal"}
    assert list(tmp_path.iterdir()) == [path]


def test_the_file_is_closed_after_an_error(tmp_path: Path) -> None:
    path = tmp_path / "tags.sqlite"
    with pytest.raises(StoreError), open_file(path) as store:
        store.apply(batch(1, (0, 1, b"x" * 99)))
    assert list(tmp_path.iterdir()) == [path]
    open_file(path).close()


def test_the_database_of_another_program_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "other.sqlite"
    database = sqlite3.connect(path)
    database.execute("CREATE TABLE tag (x)")
    database.commit()
    database.close()
    before = path.read_bytes()
    with pytest.raises(StoreError, match=r"other\.sqlite: a database of another program"):
        open_file(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("version", [1, FILE_VERSION + 1])
def test_a_file_of_another_version_is_refused(tmp_path: Path, version: int) -> None:
    path = tmp_path / "tags.sqlite"
    open_file(path).close()
    database = sqlite3.connect(path)
    database.execute(f"PRAGMA user_version = {version}")
    database.close()
    match = rf"tags\.sqlite: written in version {version}.*expected version {FILE_VERSION}"
    with pytest.raises(StoreError, match=match):
        open_file(path)


def test_what_is_no_database_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_bytes(b"no database at all. " * 100)
    with pytest.raises(StoreError, match=r"notes\.txt: it is no SQLite database: give another"):
        open_file(path)
    assert path.read_bytes() == b"no database at all. " * 100


@pytest.mark.parametrize("damage", ["truncated", "overwritten", "emptied"])
def test_a_damaged_file_is_refused(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "tags.sqlite"
    with open_file(path) as store:
        store.apply(batch(1, *[(place, 1, b"x" * CAPACITY) for place in range(2000)]))
    content = path.read_bytes()
    if damage == "truncated":
        path.write_bytes(content[: len(content) // 2])
    elif damage == "overwritten":
        half = len(content) // 2
        path.write_bytes(content[:half] + b"\xff" * 4096 + content[half + 4096 :])
    else:
        database = sqlite3.connect(path)
        database.execute("DELETE FROM run")
        database.commit()
        database.close()
    with pytest.raises(StoreError, match=r"tags\.sqlite: it is damaged: restore a copy"):
        open_file(path)


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"none/tags\.sqlite: it cannot be opened"):
        open_file(tmp_path / "none" / "tags.sqlite")
    with pytest.raises(StoreError, match="cannot be opened"):
        open_file(tmp_path)


def test_a_file_begun_but_not_made_is_new(tmp_path: Path) -> None:
    empty = tmp_path / "empty.sqlite"
    empty.touch()
    open_file(empty).close()
    begun = tmp_path / "begun.sqlite"
    database = sqlite3.connect(begun)
    database.execute("PRAGMA journal_mode = WAL")
    database.close()
    assert begun.stat().st_size > 0
    with open_file(begun) as store:
        assert store.hello(1) == 0


def test_a_disk_that_is_full_refuses_and_recovers(tmp_path: Path) -> None:
    with open_file(tmp_path / "tags.sqlite") as store:
        store.apply(batch(1, (0, 1, b"a")))
        (pages,) = store._database.execute("PRAGMA page_count").fetchone()
        store._database.execute(f"PRAGMA max_page_count = {pages}")
        many = batch(2, *[(place, 1, b"x" * CAPACITY) for place in range(1, 500)])
        with pytest.raises(StoreError, match=r"tags\.sqlite: the disk is full"):
            store.apply(many)
        assert store.hello(1) == 1
        assert store.tags() == {0: TagWrite(0, 1, b"a")}
        store._database.execute("PRAGMA max_page_count = 1000000")
        assert store.apply(many) == 2
        assert len(store.tags()) == 500


OTHER_PROCESS = """
import sys
from bookkeeping.sqlite_store import SqliteStore
from protocol.errors import StoreError
try:
    SqliteStore(sys.argv[1], run="r", capacity_bytes=16, fresh=False, durability="process")
except StoreError as error:
    print(error)
"""


def test_a_second_process_is_refused_at_once(tmp_path: Path) -> None:
    path = tmp_path / "tags.sqlite"
    with open_file(path) as store:
        other = subprocess.run(
            [sys.executable, "-c", OTHER_PROCESS, path],
            cwd=ROOT, capture_output=True, text=True, check=True, timeout=30,
        )  # fmt: skip
        assert "tags.sqlite: another process has it open" in other.stdout
        assert store.apply(batch(1, (0, 1, b"a"))) == 1
