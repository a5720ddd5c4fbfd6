"""Messages on the wire, keys, and the tree of errors."""

import re
from typing import Any, get_args

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol import errors
from protocol import keys as key_module
from protocol.codec import decoder_of, encode
from protocol.errors import CanopyError, MessageError, OutcomeUnknownError, RuleError, rule_errors
from protocol.keys import Keys
from protocol.messages import (
    Again,
    AnyReply,
    AnyReport,
    AnyRequest,
    AnyStoreReply,
    AnyStoreRequest,
    AnyWord,
    Batch,
    BatchReply,
    Briefing,
    Ended,
    Exchange,
    FaultOrder,
    GridSight,
    Hello,
    HelloReply,
    Join,
    KillOrder,
    Look,
    Move,
    NumberedReply,
    NumberedRequest,
    Progress,
    ReadTags,
    ReadTagsReply,
    Reaped,
    Refusal,
    Sight,
    Stop,
    Stopped,
    StoreRefusal,
    Struck,
    TagWrite,
    Taken,
    TeamSight,
    Up,
    Wait,
    WaitForNews,
    WentOn,
    Write,
)

REQUESTS: list[Any] = [
    Look(),
    Write(b"t", (b"m",)),
    Exchange(None, (b"m", b"")),
    Move(None, (), 2),
    Wait(b"", (), 1.5),
    WaitForNews(None, (), None),
    WaitForNews(None, (), 2.0),
    Stop(b"t", (b"m",)),
]
SIGHT = Sight(1.5, 3, None, 2, b"t", 4, True, (1, 2), ((1, b"m"),), (2,))
GRID_SIGHT = GridSight(1.0, 9, 1, 4, b"", 0, False, (), (), (), (3, 4), b".#?")
TEAM_SIGHT = TeamSight(2.0, 9, 1, 4, b"", 0, False, (), (), (), (3, 4), b".", ((2, (3, 5)),))
EXAMPLES: list[tuple[Any, list[Any]]] = [
    (AnyRequest, REQUESTS),
    (AnyReply, [SIGHT, GRID_SIGHT, TEAM_SIGHT, Stopped(), Refusal("TagError", "too long")]),
    (NumberedRequest, [NumberedRequest(7, request) for request in REQUESTS]),
    (
        NumberedReply,
        [NumberedReply(7, SIGHT), NumberedReply(8, Stopped()), NumberedReply(9, Again())],
    ),
    (Join, [Join(1, 2, "abc")]),
    (
        Briefing,
        [Briefing(0, 2, 9, "mr-dfs", {"a": True, "b": 0.5}, 888, "global", True, nonce="0f")],
    ),
    (
        AnyReport,
        [
            Up(2, {"start": 0.5}),
            KillOrder(1, 2),
            FaultOrder(3),
            WentOn(3, 12.5),
            Progress(1.0, 2, 3, 4, ((1, 0.5),)),
            Ended("stalled"),
        ],
    ),
    (AnyWord, [Reaped(3), Taken(4), Struck(4, 12.5)]),
    (AnyStoreRequest, [Hello(1, 2), Batch(1, 7, (TagWrite(1, 2, b"t"),)), ReadTags(1, (2, 3), 1)]),
    (
        AnyStoreReply,
        [
            HelloReply(7, 1),
            BatchReply(7, 1),
            ReadTagsReply(1, (TagWrite(1, 2, b"t"),), 1),
            StoreRefusal("reason", 1),
        ],
    ),
]

# The codec.


@pytest.mark.parametrize(("type_", "messages"), EXAMPLES)
def test_every_message_comes_back(type_: Any, messages: list[Any]) -> None:
    decode = decoder_of(type_)
    assert [decode(encode(message)) for message in messages] == messages
    kinds = {kind for kind in get_args(type_) if isinstance(kind, type)}
    assert kinds <= {type(message) for message in messages}


@pytest.mark.parametrize(("type_", "messages"), EXAMPLES)
def test_a_truncated_message_is_refused(type_: Any, messages: list[Any]) -> None:
    decode = decoder_of(type_)
    for message in messages:
        whole = encode(message)
        for size in range(len(whole)):
            with pytest.raises(MessageError):
                decode(whole[:size])


@pytest.mark.parametrize(("type_", "messages"), EXAMPLES)
def test_a_further_field_is_refused(type_: Any, messages: list[Any]) -> None:
    for message in messages:
        fields = msgspec.msgpack.decode(encode(message))
        with pytest.raises(MessageError, match="not a message of this protocol"):
            decoder_of(type_)(encode([*fields, None]))


@pytest.mark.parametrize(("type_", "messages"), EXAMPLES)
def test_trailing_bytes_are_refused(type_: Any, messages: list[Any]) -> None:
    for message in messages:
        with pytest.raises(MessageError):
            decoder_of(type_)(encode(message) + b"\x00")


@pytest.mark.parametrize(
    "payload",
    [
        ["jump", None, []],
        ["move", None, [], "2"],
        ["move", None, [], 1.5],
        ["move", "text", [], 1],
        ["move", None, ["text"], 1],
        ["move", None, [], None],
        ["wait", None, [], "long"],
        ["wait", None, [], True],
        ["move", None, {}, 1],
        {"exit": 1},
        "move",
        None,
        [],
        [3],
    ],
)
def test_wrong_types_are_refused(payload: Any) -> None:
    with pytest.raises(MessageError, match="not a message of this protocol"):
        decoder_of(AnyRequest)(encode(payload))  # type: ignore[arg-type]


@given(st.binary(max_size=60))
def test_any_bytes_are_a_message_or_refused(payload: bytes) -> None:
    for type_, _ in EXAMPLES:
        try:
            message = decoder_of(type_)(payload)
        except MessageError:
            continue
        assert decoder_of(type_)(encode(message)) == message


def test_an_oversized_message_is_refused() -> None:
    decode = decoder_of(Write, 100)
    fitting = encode(Write(bytes(90), ()))
    assert len(fitting) <= 100
    assert decode(fitting) == Write(bytes(90), ())
    with pytest.raises(MessageError, match=r"message of 1\d\d bytes; at most 100 are allowed"):
        decode(encode(Write(bytes(100), ())))


def test_a_message_is_never_changed() -> None:
    with pytest.raises(AttributeError):
        SIGHT.time = 2.0  # type: ignore[misc]


# Keys.

names = st.from_regex(r"[A-Za-z0-9_.-]{1,12}", fullmatch=True)
nonces = st.from_regex(r"[0-9a-f]{1,16}", fullmatch=True)


@given(names, st.integers(0, 10**6), nonces)
def test_a_key_tells_its_sender(run: str, robot: int, nonce: str) -> None:
    keys = Keys(run)
    assert keys.sender(keys.requests(robot, nonce)) == ("robot", robot, nonce)
    assert keys.sender(keys.alive(robot, nonce)) == ("robot", robot, nonce)
    assert keys.sender(keys.supervisor_reports) == ("supervisor", -1, "")
    assert keys.sender(keys.store_replies) == ("bookkeeping", -1, "")
    assert keys.joining(keys.join(robot)) == robot


def test_keys_are_as_documented() -> None:
    keys = Keys("RUN")
    documented = {
        keys.requests(3, "NONCE"),
        keys.supervisor_reports,
        keys.store_replies,
        keys.join(3),
        keys.replies(3, "NONCE"),
        keys.store_requests,
        keys.world_reports,
        keys.alive(3, "NONCE"),
    }
    listed = set(re.findall(r"^    (canopy/\S+)", key_module.__doc__ or "", re.MULTILINE))
    assert documented <= listed


@pytest.mark.parametrize(
    "key",
    [
        "",
        "canopy/OTHER/world/in/robot/3/00",
        "canopy/RUN/world/in/robot/3",
        "canopy/RUN/world/in/robot/x/00",
        "canopy/RUN/world/in/robot/3/00/more",
        "canopy/RUN/world/in/robot/3/XYZ",
        "canopy/RUN/world/in/robot/-3/00",
        "canopy/RUN/world/in/supervisor/3",
        "canopy/RUN/world/in/stranger",
        "canopy/RUN/robot/3/00/reply",
        "canopy/RUN",
        "canopy/RUN2/world/in/robot/3/00",
    ],
)
def test_a_foreign_key_is_refused(key: str) -> None:
    with pytest.raises(MessageError):
        Keys("RUN").sender(key)
    with pytest.raises(MessageError):
        Keys("RUN").joining(key)


@pytest.mark.parametrize("number", ["", "x", "-1", "3/4", "*", "\u00b2"])
def test_a_join_of_no_robot_is_refused(number: str) -> None:
    with pytest.raises(MessageError):
        Keys("RUN").joining(f"canopy/RUN/world/join/{number}")


# Errors.


def all_errors() -> list[type[CanopyError]]:
    found: list[type[CanopyError]] = []
    ahead = [CanopyError]
    while ahead:
        error = ahead.pop()
        found.append(error)
        ahead += error.__subclasses__()
    return [error for error in found if error.__module__ == "protocol.errors"]


def test_the_tree_in_the_docstring_is_the_tree() -> None:
    lines = re.findall(r"^    ([| `-]*)([A-Z]\w+Error)\b", errors.__doc__ or "", re.MULTILINE)
    assert sorted(name for _, name in lines) == sorted(error.__name__ for error in all_errors())
    under = {error.__name__: error.__mro__[1].__name__ for error in all_errors()}
    stack: list[str] = []
    for branches, name in lines:
        stack = [*stack[: len(branches) // 4], name]
        assert name == "CanopyError" or under[name] == stack[-2], name


def test_every_error_says_whether_it_is_definite() -> None:
    indefinite = {error for error in all_errors() if not error.definite}
    assert indefinite == {OutcomeUnknownError}


def test_every_error_has_a_line_of_documentation() -> None:
    assert all(error.__doc__ for error in all_errors())


def test_rule_errors_are_found_by_the_name_in_a_refusal() -> None:
    found = rule_errors()
    assert set(found.values()) == {e for e in all_errors() if issubclass(e, RuleError)}
    assert all(name == error.__name__ for name, error in found.items())
