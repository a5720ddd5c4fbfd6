"""The audit: what a run left in its folder, held against its trace by code that is none of the run's.

Three witnesses tell of a run by processes: the journal of the world server, the memories of robots
that come back, and the store. The trace is replayed from the journal, so a reader that errs, or a
world that forgets, could take its own mistake for the truth. Hence the audit parses each file by
itself (frames by hand, msgpack into plain values, the store with plain SQL) and follows the trace with
a model of its own of places, moves and tags. What it takes to be right:

- *Journal and trace.* The entries of a wave record belong to its robots, in order. Each that is not
  blank is in the trace once: as a request that was applied, or as the loss of a robot whose request was
  refused. A blank belongs to one of the record's losses; each loss is in the trace, unless that robot
  was out of the run before. A kill by order has a record of its own. A loss by too many free requests
  (wave -1) has none: it follows from the waves before.
- *Journal and memory.* A robot keeps each sight before it asks for more. So it has as many as it made
  requests, or one less; one less if it stopped, which no sight answers.
- *Trace and store.* Each tag that a request brings counts one revision; a device that was destroyed
  takes none. A device that fails counts one, too, and is blank then; a corrupted tag that nothing
  checks differs in a few bits. What an earlier run left is what the journal says was read.

Two things are not wrong: a record cut short at the end of a file, which a crash explains; and lives of
the world that began behind the closing.
"""

from pathlib import Path

from deploy.run_dir import RunDir
from deploy.verdict.audit_findings import skipped
from deploy.verdict.audit_journal import JournalAudit, MemoryAudit
from deploy.verdict.audit_motion import MotionAudit
from deploy.verdict.audit_tags import TagAudit
from deploy.verdict.guarantees import Guarantee
from protocol.trace import NOBODY, Event


class Audit:
    """An audit of one run by processes.

    Everything is looked at as far as it went when the audit began: a run that is not over goes on.
    """

    def __init__(self, run_dir: Path) -> None:
        """Open the folder of a run."""
        folder = RunDir(run_dir)
        self._whole = folder.logs.is_dir()  # else only the journal was copied here
        self._journal = JournalAudit(folder.journal)
        self._motion: MotionAudit | None = None
        self._memories: MemoryAudit | None = None
        self._tags: TagAudit | None = None
        opening = self._journal.opening
        if opening is not None:
            scenario = opening.scenario
            self._motion = MotionAudit(opening)
            if scenario.team.on_crash == "restart":
                self._memories = MemoryAudit(folder, len(opening.starts))
            if scenario.device.capacity:
                self._tags = TagAudit(scenario, folder)

    def observe(self, event: Event) -> None:
        """Take in the next event of the trace."""
        motion, tags, journal = self._motion, self._tags, self._journal
        if motion is None:
            return  # without an opening there is nothing to hold it against
        what = event.what
        if isinstance(what, str):
            if event.robot != NOBODY:
                journal.lost(event, what)
                motion.lost(event)
            elif tags is not None:
                tags.failed(event, what, journal)
            return
        journal.applied(event, what)
        motion.applied(event, what)
        if self._memories is not None:
            self._memories.applied(event, what)
        if what.tag is not None and tags is not None:
            tags.written(event, what.tag, journal)

    def report(self) -> list[Guarantee]:
        """Judge, once the trace has been seen whole."""
        journal = self._journal
        whole = journal.report()
        none_missing, store = "nothing acknowledged is missing", "the store holds the last tags"
        once = "no request applied twice, no robot in two places"
        if self._motion is None:
            why = "the journal has no opening that can be read"
            return [whole, *(skipped(name, why) for name in (none_missing, once, store))]
        reports = [whole]
        if self._memories is None:
            reports.append(skipped(none_missing, "robots that die do not come back in this run"))
        else:
            reports.append(self._memories.report(none_missing, journal, whole=self._whole))
        reports.append(self._motion.report(once))
        if self._tags is None:
            reports.append(skipped(store, "there are no devices"))
        else:
            reports.append(self._tags.report(store, journal, whole=self._whole))
        return reports
