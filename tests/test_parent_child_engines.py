"""Parent and children with a process for each: the trace of the in-process engine, with real kills."""

from pathlib import Path
from random import Random
from typing import Any

import pytest

from deploy.judged import judge_journal
from tests.runs import play
from tests.test_parent_child import HALL, Family, clocks, family, kills_among

COVERED = "every sub-cell visited"
EVENT = {"mode": "event", "jitter": "exponential"}


def both(folder: Path, drawn: Family, **fields: Any) -> None:
    """Play on both engines; the traces are equal, and all is covered if a parent and a child live."""
    folder.mkdir(exist_ok=True)
    setting = drawn.setting(folder, **fields)
    runs = [play(setting, folder, engine) for engine in ("inprocess", "processes")]
    assert runs[0].trace_sha256 == runs[1].trace_sha256
    assert (runs[1].status, runs[1].failures) == ("over", {})
    result = judge_journal(runs[1].folder.journal).result
    alive = [robot for robot, told in enumerate(result.per_robot) if told.lost_at is None]
    if alive and min(alive) < drawn.parents <= max(alive):
        assert result.complete
    assert [one.name for one in result.guarantees if one.holds is False] in ([], [COVERED])


@pytest.mark.parametrize(
    ("parents", "fields"),
    [
        (
            1,
            {
                "faults": [
                    {"kill": "robot:2", "at": 4.0, "round": 1},
                    {"kill": "world", "at": 9.0},
                ]
            },
        ),
        (1, {"team": {"on_crash": "restart"}, "faults": [{"kill": "robot:0", "at": 5.0}]}),
        (
            2,
            {
                "clock": EVENT,
                "faults": [{"kill": "robot:0", "at": 6.5}, {"kill": "robot:3", "at_request": 9}],
            },
        ),
    ],
    ids=["lockstep", "restart", "event"],
)
def test_traces_are_equal(parents: int, fields: dict[str, Any], tmp_path: Path) -> None:
    both(tmp_path, HALL._replace(parents=parents), **fields)


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_twenty_families_have_one_trace(tmp_path: Path) -> None:
    for seed in range(20):
        rng = Random(f"families {seed}")
        drawn = family(rng, side=5, parents=2, children=3)
        robots = len(drawn.starts)
        fields = clocks(rng, robots)
        fields["faults"] = kills_among(
            rng, rng.sample(range(robots), rng.randint(0, robots - 1)), 12
        )
        both(tmp_path / str(seed), drawn, **fields)
