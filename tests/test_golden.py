"""Golden traces: small runs, written down.

`pytest --rewrite-golden` writes them anew. Commit a difference only if you understand what caused
it.
"""

from pathlib import Path
from typing import Any

import pytest

from tests.play import graph_of, played, sha256

GOLDEN = Path(__file__).parent / "golden"

RUNS: dict[str, dict[str, Any]] = {
    # Two robots part, meet, bounce and come home.
    "lockstep": {"graph": graph_of("01 02 12 13 23"), "robots": 2},
    # Lengths, speeds and jitter: nothing happens at the same time.
    "event": {
        "graph": graph_of("01 02 12 13 23", lengths=[2.0, None, 0.0, 5.5, 1.0]),
        "robots": 3,
        "seed": 7,
        "team": {"speed": [1.0, 2.0, 0.5]},
        "clock": {"mode": "event", "jitter": 0.25},
    },
    # Two die, one in its turn and one on its way; the third begins new epochs.
    "kills": {
        "graph": graph_of("01 02 12 13 23"),
        "robots": 3,
        "faults": [{"kill": "robot:1", "at_request": 7}, {"kill": "robot:0", "at": 3.5}],
    },
    # Nobody hears of losses: one waits at the start until it takes the absent for lost.
    "waiting": {
        "graph": graph_of("01 12 20"),
        "robots": 2,
        "radio": {"heartbeat": "reach"},
        "faults": [{"kill": "robot:0", "at": 1, "round": 1}],
    },
}


@pytest.mark.parametrize("name", RUNS)
def test_the_trace_is_as_written_down(name: str, pytestconfig: pytest.Config) -> None:
    run = played(**RUNS[name])
    lines = [*map(str, run.events), f"end: {run.end.status}", f"sha256: {sha256(run.events)}"]
    path = GOLDEN / f"{name}.txt"
    if pytestconfig.getoption("--rewrite-golden"):
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    assert lines == path.read_text(encoding="utf-8").splitlines()
