"""What a robot's process remembers beyond its death: who it was, and all that it was told.

An algorithm is a pure function of its replies. So a process that was killed and started again takes
its algorithm through the replies that it had, and goes on with the request that stood open; the world
knows that by its number.

The file holds records (`protocol.records`): the text by which the process joined, then each reply,
written before the algorithm sees it.
"""

import fcntl
import os
from pathlib import Path
from typing import Any

from protocol.codec import decoder_of, encode
from protocol.errors import JournalError
from protocol.messages import AnySight
from protocol.records import framed, read_records


class Memory:
    """The memory of one robot.

    Attributes:
        process: the text by which it joins.
        sights: what it was told in its earlier lives, in order.
    """

    def __init__(self, path: Path) -> None:
        """Open the file, new or of an earlier life, behind its last whole record.

        Raises:
            JournalError: If it is damaged, or another process holds it.
            MessageError: If a record is no reply.
        """
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(self._descriptor)
            raise JournalError(f"{path}: another process of this robot is alive") from None
        try:
            self.process, self.sights, end = _read(path)
            os.ftruncate(self._descriptor, end)
            os.lseek(self._descriptor, end, os.SEEK_SET)
            if not end:
                self.process = os.urandom(8).hex()
                os.write(self._descriptor, framed(self.process.encode("ascii")))
        except BaseException:
            self.close()
            raise

    def keep(self, sight: AnySight) -> None:
        """Remember one more reply; when this returns it survives kill -9."""
        record = framed(encode(sight))
        if os.write(self._descriptor, record) != len(record):
            raise JournalError("half a reply was remembered; is the disk full?")

    def close(self) -> None:
        """Let go of the file."""
        os.close(self._descriptor)


def _read(path: Path) -> tuple[str, list[AnySight], int]:
    """Return the text of joining, all replies, and the offset behind the last whole record."""
    decode: Any = decoder_of(AnySight)  # type: ignore[arg-type]  # a union is a type here
    process, end = "", 0
    sights: list[AnySight] = []
    with path.open("rb") as file:
        for body, offset in read_records(file, path, 0):
            if end:
                sights.append(decode(body))
            else:
                process = body.decode("ascii")
            end = offset
    return process, sights, end
