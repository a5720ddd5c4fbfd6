"""Record files: append-only, each record with its length and checksums.

A record is 12 bytes of header (length of the body, CRC-32 of the body, CRC-32 of these two) and the
body. The header has a checksum of its own, so that a damaged length is told from a record that a crash
cut short: the latter can only be the last and is dropped, anything else is refused with file and
offset.
"""

from collections.abc import Iterator
from pathlib import Path
from struct import Struct as Layout
from typing import BinaryIO
from zlib import crc32

from protocol.errors import JournalError

_HEADER = Layout("<III")
_SUMS = Layout("<II")


def framed(body: bytes) -> bytes:
    """Return a record: the body behind its header."""
    sums = _SUMS.pack(len(body), crc32(body))
    return sums + crc32(sums).to_bytes(4, "little") + body


def read_records(file: BinaryIO, path: Path, offset: int) -> Iterator[tuple[bytes, int]]:
    """Read records up to the end of a file.

    Args:
        file: stands before a record.
        path: what to call it.
        offset: where it stands.

    Yields:
        The body of each record, and the offset behind it. A record that a crash cut short at the very
        end is left out.

    Raises:
        JournalError: If a record is damaged.
    """
    while len(header := file.read(_HEADER.size)) == _HEADER.size:
        length, body_sum, header_sum = _HEADER.unpack(header)
        if crc32(header[:8]) != header_sum:
            raise JournalError(f"{path}: offset {offset}: damaged header of a record")
        body = file.read(length)
        if len(body) < length:
            return
        if crc32(body) != body_sum:
            raise JournalError(f"{path}: offset {offset}: damaged record of {length} bytes")
        offset += _HEADER.size + length
        yield body, offset
