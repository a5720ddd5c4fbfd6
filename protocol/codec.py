"""Bytes to messages and back: msgpack, typed, strict.

Everything that a process receives passes through `decoder_of(...)`: unknown fields, wrong types,
truncated or oversized payloads are refused with a reason, as `MessageError`.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import msgspec

from protocol.errors import MessageError
from protocol.messages import PAYLOAD_BYTES_MAX

T = TypeVar("T")

encode: Callable[[Any], bytes] = msgspec.msgpack.Encoder().encode
"""Encode a message, or any tree of plain values, as msgpack."""


def decoder_of(type_: type[T], bytes_max: int = PAYLOAD_BYTES_MAX) -> Callable[[bytes], T]:
    """Build the door for messages of ``type_`` (a Struct or a union of Structs).

    Returns:
        A function from bytes to a checked message. It raises MessageError if the bytes are no
        message of that type, or more than ``bytes_max`` of them.
    """
    decode = msgspec.msgpack.Decoder(type_).decode

    def checked(payload: bytes) -> T:
        if len(payload) > bytes_max:
            raise MessageError(f"message of {len(payload)} bytes; at most {bytes_max} are allowed")
        try:
            return decode(payload)
        except (msgspec.DecodeError, UnicodeDecodeError, OverflowError) as error:
            raise MessageError(f"not a message of this protocol: {error}") from None

    return checked
