"""The trace: its encoding, its digest, and what is said where two of them part."""

import hashlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.codec import encode
from protocol.messages import Exchange, Look, Move, Stop, Wait, WaitForNews, Write
from protocol.trace import Event, TraceDigest, first_difference
from tests.play import sha256

EVENTS = [
    Event(0.0, -1, 0, 0, 4, None, Look(), 0),
    Event(0.0, 0, 1, 2, 4, None, Write(b"\x01", ()), 0xDEADBEEF),
    Event(1.5, 0, 0, 0, 5, 3, Move(None, (b"hi",), 2), 1),
    Event(2.5, 1, -1, 0, None, 3, "killed", 0),
]


def test_the_encoding_is_golden() -> None:
    """Traces of earlier versions stay comparable: a change here is a change of the wire format."""
    assert [encode(event).hex() for event in EVENTS] == [
        "98cb0000000000000000ff000004c094a46c6f6f6bc090c000",
        "98cb000000000000000000010204c093a57772697465c4010190cedeadbeef",
        "98cb3ff8000000000000000000050395a46d6f7665c091c402686902c001",
        "98cb400400000000000001ff00c003a66b696c6c656400",
    ]


def test_the_digest_of_the_golden_events() -> None:
    assert sha256(EVENTS) == hashlib.sha256(b"".join(map(encode, EVENTS))).hexdigest()
    assert sha256([]) == hashlib.sha256(b"").hexdigest()


@given(st.lists(st.sampled_from(EVENTS), max_size=30), st.sets(st.integers(0, 30)))
def test_looking_at_the_digest_does_not_change_it(events: list[Event], looks: set[int]) -> None:
    digest = TraceDigest()
    for number, event in enumerate(events):
        if number in looks:
            digest.hexdigest()
        digest(event)
    assert digest.hexdigest() == hashlib.sha256(b"".join(map(encode, events))).hexdigest()
    assert digest.hexdigest() == digest.hexdigest()


def test_a_long_trace_is_hashed_link_by_link() -> None:
    events = [
        Event(float(n), 0, 0, n % 7, n, None, Write(bytes(n % 97), ()), n) for n in range(9000)
    ]
    link, rest, links = b"", b"", 0
    for event in events:
        rest += encode(event)
        if len(rest) > 65536:
            link, rest, links = hashlib.sha256(link + rest).digest(), b"", links + 1
    assert links > 5
    assert sha256(events) == hashlib.sha256(link + rest).hexdigest()


def test_equal_traces_have_no_difference() -> None:
    assert first_difference([], []) is None
    assert first_difference(EVENTS, list(EVENTS)) is None


def test_the_first_difference_shows_both_events() -> None:
    other = [*EVENTS[:2], Event(1.5, 0, 0, 0, 5, 3, Move(None, (), 2), 1), EVENTS[3]]
    assert first_difference(EVENTS, other) == (
        "event 2:\n"
        "  left:  t=1.5 round=0 wave=0 robot=0 at 5 entry=3 move exit=2 messages=['6869']"
        " sight=00000001\n"
        "  right: t=1.5 round=0 wave=0 robot=0 at 5 entry=3 move exit=2 sight=00000001"
    )


def test_the_first_difference_of_a_trace_that_ends_early() -> None:
    assert first_difference(EVENTS, EVENTS[:3]) == (
        "event 3:\n"
        "  left:  t=2.5 round=1 wave=-1 robot=0 on its way entry=3 lost (killed) sight=00000000\n"
        "  right: (ends)"
    )


@pytest.mark.parametrize(
    ("what", "words"),
    [
        (Look(), "look"),
        (Write(b"\x00\xff", ()), "write tag=00ff"),
        (Write(b"", ()), "write tag=blank"),
        (Exchange(None, (b"a", b"b")), "exchange messages=['61', '62']"),
        (Wait(None, (), 2.5), "wait duration=2.5"),
        (WaitForNews(None, (), None), "waitfornews"),
        (Stop(), "stop"),
        ("failed", "lost (failed)"),
    ],
)
def test_an_event_in_words(what: object, words: str) -> None:
    event = Event(0.0, 0, 0, 1, 2, None, what, 0xAB)  # type: ignore[arg-type]
    assert str(event) == f"t=0 round=0 wave=0 robot=1 at 2 entry=None {words} sight=000000ab"


def test_a_bounded_wait_for_news_tells_its_bound() -> None:
    shown = [str(Event(0.0, 0, 0, 1, 2, None, WaitForNews(None, (), n), 0)) for n in (3.0, 4.0)]
    assert shown[0] != shown[1]
