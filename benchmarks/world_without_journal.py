"""The world server's process, but its waves are not written to the journal: `benchmarks.journaling`.

A run of it can be neither recovered nor replayed.
"""

from world_server import journal, node

append = journal.Journal.append


def append_all_but_waves(self: journal.Journal, record: journal.AnyRecord) -> None:
    """Write the record unless it is a wave's."""
    if not isinstance(record, journal.WaveRecord):
        append(self, record)


if __name__ == "__main__":
    journal.Journal.append = append_all_but_waves  # type: ignore[method-assign]
    node.main()
