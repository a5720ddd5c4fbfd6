"""Who is away and which faults are under way, each against a model that looks through a log."""

from math import inf
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from world_server.watch import Absences, FaultsUnderWay

ROBOTS = range(4)
robots = st.sampled_from(ROBOTS)
steps_s = st.sampled_from([0.0, 0.5, 1.0, 2.0, 5.0])


# Absences.


def until_of(log: list[tuple[str, int, float]], robot: int) -> float | None:
    """Return until when a robot may come back, by all that was taken down; ``None``: it is here."""
    words = [(word, until) for word, whose, until in log if whose == robot]
    return words[-1][1] if words and words[-1][0] == "gone" else None


@given(
    st.floats(0.5, 5.0),
    st.lists(
        st.tuples(steps_s, st.just("gone"), robots, st.none() | steps_s)
        | st.tuples(steps_s, st.just("back"), robots, st.none())
        | st.tuples(steps_s, st.just("overdue"), st.just(0), st.none()),
        max_size=40,
    ),
)
def test_absences_are_those_of_a_log(grace_s: float, acts: list[Any]) -> None:
    absences, now = Absences(grace_s), 0.0
    log: list[tuple[str, int, float]] = []
    for step_s, act, robot, own_s in acts:
        now += step_s
        away = [one for one in ROBOTS if until_of(log, one) is not None]
        match act:
            case "gone":
                absences.gone(robot, now, own_s)
                log.append(("gone", robot, now + (grace_s if own_s is None else own_s)))
            case "back":
                assert absences.back(robot) == (robot in away)
                log.append(("back", robot, now))
            case _:
                late = [one for one in away if (until_of(log, one) or 0.0) <= now]
                assert sorted(absences.overdue(now)) == late
                log += (("lost", one, now) for one in late)
        assert bool(absences) == any(until_of(log, one) is not None for one in ROBOTS)


def test_a_robot_is_overdue_once() -> None:
    absences = Absences(2.0)
    absences.gone(1, 10.0)
    assert absences.overdue(11.999) == []
    assert absences.overdue(12.0) == [1]
    assert absences.overdue(99.0) == []
    assert not absences


def test_who_comes_back_in_time_is_never_overdue() -> None:
    absences = Absences(2.0)
    absences.gone(1, 10.0)
    assert absences.back(1) is True
    assert absences.back(1) is False
    assert absences.overdue(inf) == []


def test_who_goes_again_has_all_the_time_again() -> None:
    absences = Absences(2.0)
    absences.gone(1, 10.0)
    absences.gone(1, 11.5)
    assert absences.overdue(12.0) == []
    assert absences.overdue(13.5) == [1]


# Faults under way.


@given(
    st.lists(
        st.tuples(steps_s, st.just("committed"), st.just(0), st.just(0.0))
        | st.tuples(steps_s, st.just("struck"), robots, steps_s),
        max_size=40,
    )
)
def test_a_run_goes_on_with_the_first_commit_behind_a_fault(acts: list[Any]) -> None:
    """A fault may be heard of late, and often; at two that are at once none is behind the other."""
    faults, now = FaultsUnderWay(), 20.0
    commits: list[float] = []
    struck: dict[int, float] = {}

    def went_on(fault: int) -> float | None:
        return min((at_s for at_s in commits if at_s > struck[fault]), default=None)

    for step_s, act, fault, ago_s in acts:
        now += step_s
        if act == "committed":
            open_before = [one for one in struck if went_on(one) is None]
            commits.append(now)
            over = {one: now for one in open_before if went_on(one) is not None}
            assert faults.committed(now) == over
        else:
            struck.setdefault(fault, now - ago_s)
            assert faults.struck(fault, struck[fault]) == went_on(fault)
        assert faults.young == (not commits)
        # Who is not told of a commit could not say later that it came behind a fault.
        assert faults.waiting


def test_a_fault_that_struck_before_this_life_is_over_with_its_first_commit() -> None:
    faults = FaultsUnderWay()
    assert faults.struck(3, 10.0) is None
    assert faults.committed(12.0) == {3: 12.0}
    # The news was lost, and is asked for again; also by one that this life hears of only now.
    assert faults.struck(3, 10.0) == 12.0
    assert faults.struck(4, 11.0) == 12.0


def test_a_fault_that_strikes_later_is_over_with_the_next_commit() -> None:
    faults = FaultsUnderWay()
    assert faults.committed(12.0) == {}
    assert faults.struck(3, 13.0) is None
    assert faults.committed(14.0) == {3: 14.0}
    assert faults.committed(15.0) == {}
    assert faults.struck(3, 13.0) == 14.0


def test_where_no_faults_are_expected_only_the_first_commit_of_a_life_is_told() -> None:
    faults = FaultsUnderWay(expected=False)
    assert faults.waiting
    assert faults.committed(12.0) == {}
    assert not faults.waiting
