"""Who owns which cell: every replica comes to the same owners, whatever the order of messages.

Rules: the specification of ORMSTC, R4 and R8 to R10.
"""

from collections import Counter
from collections.abc import Iterable
from random import Random
from typing import Any, get_args

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.algorithms.claims import (
    AT_START,
    OVER,
    WITHDRAWAL,
    AnyNote,
    Ask,
    Claim,
    Claims,
    Completion,
    Frontier,
    Grant,
    Offer,
    Over,
    Refusal,
    Removal,
    Retract,
    Start,
    Take,
    Withdrawal,
    read_note,
)
from protocol.codec import encode
from protocol.errors import MessageError

TEAM = 5


def replica(
    *, team: int = TEAM, fewest: bool = False, lazy: bool = False, delayed: bool = False
) -> Claims:
    return Claims(team, fewest=fewest, lazy=lazy, delayed=delayed)


def owners(claims: Claims) -> dict[int, int]:
    return {cell: stake[2] for cell, stake in claims.owner.items()}


def assert_counts_right(claims: Claims) -> None:
    counts = Counter(owners(claims).values())
    assert claims.cells == [counts[robot] for robot in range(claims.team_size)]


# Messages.

numbers = st.integers(-(2**63), 2**63 - 1)
several = st.lists(numbers, max_size=4).map(tuple)
times = st.floats(allow_nan=False)
NOTES: dict[type, st.SearchStrategy[Any]] = {
    Start: st.builds(Start, numbers),
    Claim: st.builds(Claim, times, numbers, numbers),
    Retract: st.builds(Retract, numbers),
    Completion: st.builds(Completion, numbers, numbers),
    Withdrawal: st.builds(Withdrawal),
    Over: st.builds(Over),
    Removal: st.builds(Removal, numbers),
    Frontier: st.builds(Frontier, several),
    Ask: st.builds(Ask),
    Offer: st.builds(Offer, numbers, numbers),
    Take: st.builds(Take, numbers, numbers),
    Grant: st.builds(
        Grant,
        numbers,
        times,
        several,
        several,
        st.lists(st.tuples(numbers, numbers), max_size=4).map(tuple),
        st.booleans(),
    ),
    Refusal: st.builds(Refusal, numbers),
}


def test_no_message_is_left_out() -> None:
    assert set(NOTES) == set(get_args(AnyNote))


@given(st.one_of(*NOTES.values()))
def test_a_message_comes_out_as_it_went_in(note: AnyNote) -> None:
    found = read_note(encode(note))
    assert (type(found), found) == (type(note), note)


def test_what_is_said_often_is_encoded_once() -> None:
    assert read_note(WITHDRAWAL) == Withdrawal()
    assert read_note(OVER) == Over()


@given(st.one_of(*NOTES.values()), st.data())
def test_a_message_that_is_cut_off_is_refused(note: AnyNote, data: st.DataObject) -> None:
    whole = encode(note)
    cut = data.draw(st.integers(0, len(whole) - 1))
    with pytest.raises(MessageError):
        read_note(whole[:cut])
    with pytest.raises(MessageError):
        read_note(whole + whole)


@pytest.mark.parametrize(
    "what",
    [
        None,
        7,
        "claim",
        [],
        ["claim"],
        ["claim", 0.0, 1],
        ["claim", 0.0, 1, 2, 3],
        ["claim", "0", 1, 2],
        ["claim", 0.0, 1.5, 2],
        ["start", None],
        ["grant", 0, 0.0, [1], [2], [3], False],
        ["treasure", 1],
        {"claim": 1},
    ],
)
def test_what_is_no_message_is_refused(what: object) -> None:
    with pytest.raises(MessageError):
        read_note(encode(what))


@given(st.binary(max_size=40))
def test_noise_is_refused(noise: bytes) -> None:
    try:
        found = read_note(noise)
    except MessageError:
        return
    assert isinstance(found, get_args(AnyNote))


# One instant.

RIVALS = st.dictionaries(st.integers(0, TEAM - 1), st.integers(0, 3), min_size=1)
"""Robots that claim one cell, and how many cells each has already."""


@given(RIVALS, st.booleans(), st.booleans(), st.booleans(), st.randoms(use_true_random=False))
def test_claims_of_one_instant_have_one_winner_in_any_order(
    cells: dict[int, int], fewest: bool, delayed: bool, was_owned: bool, rng: Random
) -> None:
    """The highest id, or who has fewest cells and of those the highest id.

    Reference: R2, R8, R9.
    """
    winner = max(cells, key=lambda robot: (-cells[robot] if fewest else 0, robot))
    notes = [(robot, Claim(8.0, 7, count)) for robot, count in cells.items()]
    for _ in range(4):
        rng.shuffle(notes)
        claims = replica(team=TEAM + 1, fewest=fewest, delayed=delayed)
        if was_owned:
            claims.hear(TEAM, Claim(3.0, 7, 1))
            claims.bury(TEAM)
        for robot, note in notes:
            claims.hear(robot, note)
        assert owners(claims) == {7: winner}
        assert all(claims.holds(robot, 7) == (robot == winner) for robot in range(TEAM + 1))
        assert not claims.is_open(7)
        assert_counts_right(claims)


@given(st.sets(st.integers(0, TEAM - 1), min_size=1), st.randoms(use_true_random=False))
def test_of_those_that_start_in_one_cell_the_highest_has_it(robots: set[int], rng: Random) -> None:
    """Reference: R4."""
    order = sorted(robots)
    rng.shuffle(order)
    claims = replica()
    # Its own it knows before it hears those of the others.
    claims.stake(3, (AT_START, -order[0], order[0]))
    for robot in order[1:]:
        claims.hear(robot, Start(3))
    assert owners(claims) == {3: max(robots)}
    assert_counts_right(claims)


@given(
    st.lists(
        st.tuples(st.integers(0, TEAM - 1), st.integers(0, 2), st.integers(0, 2)), max_size=12
    ),
    st.sets(st.integers(0, TEAM - 1)),
    st.booleans(),
)
def test_an_inbox_is_heard_as_its_messages_are(
    claimed: list[tuple[int, int, int]], dead: set[int], delayed: bool
) -> None:
    notes = [(robot, Claim(float(time), cell, 1)) for robot, cell, time in claimed]
    one_by_one, at_once = replica(delayed=delayed), replica(delayed=delayed)
    for claims in (one_by_one, at_once):
        for robot in dead:
            claims.bury(robot)
    for robot, note in notes:
        one_by_one.hear(robot, note)
    at_once.hear_all((robot, encode(note)) for robot, note in notes)
    for name in Claims.__slots__:
        assert getattr(at_once, name) == getattr(one_by_one, name), name


# The dead.


def test_the_cells_of_the_dead_are_open_by_whose_they_are_then() -> None:
    """Reference: R8."""
    claims = replica()
    for robot, cell in ((0, 1), (0, 2), (1, 3)):
        claims.hear(robot, Claim(1.0, cell, 1))
    claims.changed = False
    claims.bury(0)
    assert claims.changed
    assert [claims.is_open(cell) for cell in (1, 2, 3, 4)] == [True, True, False, True]
    claims.hear(2, Claim(5.0, 1, 1))
    assert [claims.is_open(cell) for cell in (1, 2, 3)] == [False, True, False]
    assert owners(claims) == {1: 2, 2: 0, 3: 1}
    assert_counts_right(claims)
    claims.bury(2)  # and so on, as often as it may be
    assert claims.is_open(1)
    claims.hear(1, Claim(9.0, 1, 2))
    assert claims.holds(1, 1)


def test_a_claim_of_a_robot_known_to_be_dead_is_void() -> None:
    """Also one that comes later. Reference: R8."""
    claims = replica(delayed=True)
    claims.bury(0)
    for note in (Claim(1.0, 1, 1), Start(2), Completion(0), Over()):
        claims.hear(0, note)
    claims.hear_all([(0, encode(Claim(1.0, 3, 1)))])
    assert (claims.owner, claims.complete, claims.over) == ({}, {}, False)
    claims.hear(1, Claim(2.0, 1, 1))
    claims.hear(0, Retract(1))
    assert owners(claims) == {1: 1}


def test_a_robot_dies_once() -> None:
    claims = replica(lazy=True)
    claims.bury(0)
    claims.changed = False
    claims.complete[0] = 0
    claims.bury(0)
    assert (claims.changed, claims.spared) == (False, set())


# Where messages take time.


def test_the_first_claim_wins_however_late_it_comes() -> None:
    """Reference: R9."""
    claims = replica(delayed=True)
    claims.hear(4, Claim(2.0, 7, 1))
    claims.hear(3, Claim(3.0, 7, 1))
    assert claims.holds(4, 7)
    claims.hear(0, Claim(1.0, 7, 1))
    assert claims.holds(0, 7)
    claims.hear(0, Retract(7))  # then the next best has it, as long as it stands
    assert claims.holds(4, 7)
    claims.bury(4)
    assert claims.holds(3, 7)
    claims.hear(3, Retract(7))
    assert claims.is_open(7)
    assert_counts_right(claims)


def test_a_loser_that_retracts_changes_nothing() -> None:
    claims = replica(delayed=True)
    claims.hear(1, Claim(1.0, 7, 1))
    claims.hear(2, Claim(2.0, 7, 1))
    claims.changed = False
    claims.hear(2, Retract(7))
    assert owners(claims) == {7: 1}
    assert not claims.changed
    claims.hear(1, Retract(7))
    assert owners(claims) == {}
    assert claims.changed
    assert_counts_right(claims)


def test_the_claim_of_one_that_died_as_a_loser_does_not_come_back() -> None:
    """As the winner gives up the cell, it goes to the next of those that live."""
    claims = replica(delayed=True)
    claims.hear(0, Claim(1.0, 7, 1))
    claims.hear(4, Claim(1.0, 7, 1))
    claims.hear(3, Claim(1.0, 7, 1))
    claims.bury(3)
    claims.hear(4, Retract(7))
    assert owners(claims) == {7: 0}


@st.composite
def hearsay(draw: st.DrawFn) -> list[tuple[int, AnyNote | None]]:
    """Draw what is heard of one cell: each robot's claims and retracts in its own order; a loss last.

    Of several messages of different robots any may come first. ``None``: the robot is dead.
    """
    heard: list[list[tuple[int, AnyNote | None]]] = []
    for robot in range(TEAM):
        said: list[tuple[int, AnyNote | None]] = []
        time = 0.0
        for _ in range(draw(st.integers(0, 2))):
            time += draw(st.integers(1, 3))
            said.append((robot, Claim(time, 7, 1)))
            if draw(st.booleans()):
                said.append((robot, Retract(7)))
        if draw(st.integers(0, 3)) == 0:
            said.insert(draw(st.integers(0, len(said))), (robot, None))
        heard.append(said)
    order = draw(st.permutations([robot for robot, said in enumerate(heard) for _ in said]))
    return [heard[robot].pop(0) for robot in order]


@settings(max_examples=300)
@given(hearsay())
def test_the_owner_is_the_first_claim_that_stands(heard: list[tuple[int, AnyNote | None]]) -> None:
    """Of robots that are not known to be dead. Reference: R9."""
    claims = replica(delayed=True)
    standing: set[tuple[float, int, int]] = set()
    dead = set()
    for robot, note in heard:
        if note is None:
            claims.bury(robot)
            dead.add(robot)
        else:
            claims.hear(robot, note)
        if not isinstance(note, Claim):
            standing = {stake for stake in standing if stake[2] != robot}
        elif robot not in dead:
            standing.add((note.time, -robot, robot))
        assert claims.is_open(7) == (not standing)
        assert not standing or claims.owner[7] == min(standing)
        assert_counts_right(claims)


# Completion.


def complete(
    claims: Claims, robots: Iterable[int], losses: int = 0, opened: int | None = None
) -> None:
    for robot in robots:
        claims.hear(robot, Completion(losses, losses if opened is None else opened))


def test_all_that_live_must_be_complete_in_view_of_the_same_losses() -> None:
    """Reference: R7."""
    claims = replica(team=3)
    complete(claims, [0, 1])
    assert not claims.agreed()
    complete(claims, [2])
    assert claims.agreed()
    claims.hear(1, Withdrawal())
    assert not claims.agreed()
    claims.bury(1)
    assert not claims.agreed()  # the others have not said that they know
    complete(claims, [0], losses=1)
    assert not claims.agreed()
    complete(claims, [2], losses=1)
    assert claims.agreed()
    claims.bury(2)
    complete(claims, [0], losses=2)
    assert claims.agreed()
    claims.hear(0, Withdrawal())
    claims.hear(0, Withdrawal())
    assert not claims.agreed()


def test_one_that_has_stopped_is_complete_for_good() -> None:
    claims = replica(team=3)
    complete(claims, [0, 1])
    complete(claims, [2], losses=3)
    assert claims.agreed()
    claims.bury(0)
    complete(claims, [1], losses=1)
    assert claims.agreed()


def test_it_is_settled_when_the_same_cells_were_open_to_all() -> None:
    """Reference: R7, R10."""
    claims = replica(team=3, lazy=True)
    complete(claims, [0, 1, 2])
    claims.bury(2)
    assert claims.view() == (1, 0)
    complete(claims, [0], losses=1, opened=0)
    assert not claims.settled()
    complete(claims, [1], losses=1, opened=1)  # 1 knows that 2 died incomplete, or is freed
    assert claims.agreed()
    assert not claims.settled()
    claims.free_the_spared()
    assert claims.view() == (1, 1)
    assert not claims.settled()  # 0 has yet to say that it has nothing to do in this view
    complete(claims, [0], losses=1, opened=1)
    assert claims.settled()


def test_one_that_knows_tells_all() -> None:
    claims = replica()
    claims.hear(3, Over())
    assert claims.over


@pytest.mark.parametrize("lazy", [True, False])
def test_cells_of_one_that_died_complete_stay_covered(lazy: bool) -> None:
    """Reference: R10."""
    claims = replica(team=3, lazy=lazy)
    for robot in (0, 1, 2):
        claims.hear(robot, Claim(1.0, robot, 1))
    complete(claims, [0, 1])
    claims.hear(1, Withdrawal())
    claims.bury(0)
    assert claims.is_open(0) != lazy
    assert claims.any_open() != lazy
    claims.bury(1)  # it was not complete any more
    assert claims.is_open(1)
    assert claims.any_open()
    assert claims.spared == ({0} if lazy else set())


def test_the_spared_are_freed_when_all_live_ones_are_complete_and_cells_are_left() -> None:
    """Reference: R10."""
    claims = replica(team=4, lazy=True)
    for robot in range(4):
        claims.hear(robot, Claim(1.0, robot, 1))
    complete(claims, [0, 1])
    claims.bury(0)
    claims.bury(1)
    complete(claims, [2, 3], losses=2, opened=0)
    claims.free_the_spared()  # nothing is left
    assert claims.spared == {0, 1}
    claims.hear(3, Withdrawal())
    claims.bury(3)
    claims.free_the_spared()  # 3 has left its cell, but 2 may yet get there
    assert claims.spared == {0, 1}
    complete(claims, [2], losses=3, opened=1)
    claims.changed = False
    claims.free_the_spared()
    assert (claims.spared, claims.changed) == (set(), True)
    assert all(claims.is_open(cell) for cell in (0, 1, 3))
    claims.changed = False
    claims.free_the_spared()  # once
    assert not claims.changed


def test_who_claims_a_cell_of_the_spared_has_freed_them() -> None:
    """Others hear of it by the claim, if they did not free them of themselves."""
    claims = replica(team=3, lazy=True)
    for cell in (5, 6):
        claims.hear(0, Claim(float(cell), cell, 1))
    complete(claims, [0])
    claims.bury(0)
    assert not claims.is_open(6)
    claims.hear(1, Claim(9.0, 5, 1))
    assert claims.holds(1, 5)
    assert claims.is_open(6)
    assert_counts_right(claims)
