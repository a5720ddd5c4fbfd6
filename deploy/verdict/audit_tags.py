"""The audit of tags: the store holds what the trace wrote last."""

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

from deploy.run_dir import RunDir
from deploy.verdict.audit_findings import Findings, skipped
from deploy.verdict.audit_journal import JournalAudit
from deploy.verdict.guarantees import Guarantee
from protocol.scenario import Scenario
from protocol.trace import Event

CORRUPT_BITS_MAX = 4
"""In so many bits at most a corrupted tag differs from the one that was written."""

Tag = tuple[int, bytes, int]
"""What a device holds: revision, tag, and in how many bits the tag may differ."""


class TagAudit:
    """The tag of each place that was written, as the trace tells."""

    def __init__(self, scenario: Scenario, folder: RunDir) -> None:
        named = scenario.bookkeeping.database
        self._path = folder.database if named is None else Path(named)
        self._elsewhere = named is not None
        self._fresh = scenario.bookkeeping.fresh
        self._checked = scenario.device.checksum
        self._tags: dict[int, Tag] = {}
        self._destroyed: set[int] = set()
        self._writes = 0
        self._last = (0, 0)  # number of the input that brought the last write: at least, at most

    def written(self, event: Event, tag: bytes, journal: JournalAudit) -> None:
        """Let a request write a tag."""
        place = event.place
        if place is None or place in self._destroyed:
            return
        self._write(place, (self._at(place, journal)[0] + 1, tag, 0))
        self._last = (journal.inputs_before, journal.inputs_before)

    def failed(self, event: Event, what: str, journal: JournalAudit) -> None:
        """Let a device fail."""
        place = event.place
        if place is None or place in self._destroyed:
            return
        self._last = journal.span()  # has read the old tag, too
        revision, tag, bits = self._at(place, journal)
        if what == "corrupted" and not self._checked:
            self._write(place, (revision + 1, tag, bits + CORRUPT_BITS_MAX))
        else:
            self._write(place, (revision + 1, b"", 0))
        if what == "destroyed":
            self._destroyed.add(place)

    def _write(self, place: int, tag: Tag) -> None:
        self._tags[place] = tag
        self._writes += 1

    def _at(self, place: int, journal: JournalAudit) -> Tag:
        found = self._tags.get(place)
        return (*journal.old_tags.get(place, (0, b"")), 0) if found is None else found

    def report(self, name: str, journal: JournalAudit, *, whole: bool) -> Guarantee:
        """Judge, once the trace has been seen whole."""
        if journal.closed is None:
            return skipped(name, "the run is not over, and the store may be behind")
        wrong = Findings()
        if not self._path.exists():
            if self._elsewhere or not whole:
                return skipped(name, f"{self._path} is not here any more")
            wrong.add(f"{self._path.name} is gone from the run's folder")
            return wrong.guarantee(name, f"{len(self._tags)} tags expected")
        assert journal.opening is not None
        try:
            with closing(self._open()) as database:
                (row,) = database.execute("SELECT name, wave FROM run").fetchall()
                found = database.execute("SELECT place, revision, tag FROM tag").fetchall()
        except (sqlite3.Error, ValueError) as error:
            if getattr(error, "sqlite_errorname", "").startswith("SQLITE_BUSY"):
                return skipped(name, f"{self._path} is in use")
            wrong.add(f"{self._path.name} cannot be read: {error}")
            return wrong.guarantee(name, f"{len(self._tags)} tags expected")
        run, wave = row
        if run != journal.opening.run:
            if self._elsewhere:
                return skipped(name, f"{self._path} holds the tags of another run by now: {run}")
            wrong.add(f"it is of run {run}")
        at_least, at_most = self._last
        if not at_least <= wave <= at_most:
            numbers = f"{at_least}" if at_least == at_most else f"{at_least} to {at_most}"
            wrong.add(f"it is at wave {wave}, and the last write was in wave {numbers}")
        self._compare({place: (revision, tag) for place, revision, tag in found}, journal, wrong)
        return wrong.guarantee(
            name,
            f"{len(self._tags)} places written, {self._writes} writes, the last in wave {wave}",
        )

    def _open(self) -> sqlite3.Connection:
        """Open the store, to be read only.

        Without a log the file is all there is, and SQLite is told to put nothing beside it.
        """
        log = Path(f"{self._path}-wal")
        mode = "mode=ro" if log.exists() and log.stat().st_size else "mode=ro&immutable=1"
        return sqlite3.connect(f"{self._path.absolute().as_uri()}?{mode}", uri=True, timeout=0)

    def _compare(
        self, found: dict[int, tuple[Any, Any]], journal: JournalAudit, wrong: Findings
    ) -> None:
        """Compare the tags in the store with those of the trace, and of an earlier run."""
        expected = {place: (*old, 0) for place, old in journal.old_tags.items()} | self._tags
        for place, (revision, tag, bits) in sorted(expected.items()):
            if place not in found:
                wrong.add(f"place {place}: no tag, expected revision {revision}")
                continue
            stored_revision, stored = found[place]
            if stored_revision != revision:
                wrong.add(f"place {place}: revision {stored_revision}, expected {revision}")
            elif not isinstance(stored, bytes) or not _alike(stored, tag, bits):
                wrong.add(f"place {place}: tag {stored!r}, expected {tag!r}")
        if self._fresh:
            for place in sorted(found.keys() - expected.keys()):
                wrong.add(f"place {place}: a tag that nobody wrote")


def _alike(tag: bytes, other: bytes, bits: int) -> bool:
    """Tell whether two tags differ in so many bits at most."""
    if len(tag) != len(other):
        return False
    differing = int.from_bytes(tag, "little") ^ int.from_bytes(other, "little")
    return differing.bit_count() <= bits
