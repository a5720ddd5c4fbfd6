"""What the parts of an audit have in common: findings, and the frames of records, read by hand."""

from collections.abc import Iterator
from pathlib import Path
from struct import Struct as Layout
from zlib import crc32

import msgspec

from deploy.verdict.guarantees import Guarantee
from protocol.errors import InputError, JournalError

SOURCE = "Canopy: an audit of the run's folder"

_HEADER = Layout("<III")

UNREADABLE = (
    OSError,
    InputError,
    JournalError,
    LookupError,
    TypeError,
    ValueError,
    StopIteration,
    msgspec.DecodeError,
)
"""What a record that is not as it should be may raise."""

encode = msgspec.msgpack.Encoder().encode
decode = msgspec.msgpack.decode


class Findings:
    """What is wrong with one guarantee: how much, and the first of it in words."""

    def __init__(self) -> None:
        self.count = 0
        self.first = ""

    def add(self, words: str) -> None:
        """Take down one thing that is wrong."""
        self.count += 1
        self.first = self.first or words

    def guarantee(self, name: str, detail: str) -> Guarantee:
        """Return the verdict; ``detail`` says what was looked at."""
        if self.count:
            others = f" (and {self.count - 1} more, which may follow from it)"
            detail = f"{self.first}{others if self.count > 1 else ''}; {detail}"
        return Guarantee(name, SOURCE, not self.count, detail)


def skipped(name: str, why: str) -> Guarantee:
    """Return the verdict on what could not be looked at, and why."""
    return Guarantee(name, SOURCE, None, why)


def bodies(path: Path, magic: bytes, end: int) -> Iterator[bytes]:
    """Yield the body of each whole record in the first ``end`` bytes of a file.

    Raises:
        JournalError: If a checksum is wrong.
    """
    with path.open("rb") as file:
        if file.read(len(magic)) != magic:
            raise JournalError(f"{path.name} does not begin as it should")
        offset = len(magic)
        while offset + _HEADER.size <= end:
            header = file.read(_HEADER.size)
            length, body_sum, header_sum = _HEADER.unpack(header)
            if crc32(header[:8]) != header_sum:
                raise JournalError(f"{path.name}, byte {offset}: a wrong sum of a record's header")
            if offset + _HEADER.size + length > end:
                return
            body = file.read(length)
            if crc32(body) != body_sum:
                raise JournalError(f"{path.name}, byte {offset}: a wrong sum of a record")
            offset += _HEADER.size + length
            yield body
