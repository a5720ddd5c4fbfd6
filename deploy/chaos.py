"""Chaos: random faults of a scenario, drawn from its seed before the run, as scheduled ones.

What was drawn stands in the journal and in the result like any fault that a scenario schedules, so a
run that chaos made is repeated by its seed, and a single fault of it can be played by itself.
"""

from collections.abc import Sequence
from math import ceil

from msgspec.structs import replace

from deploy.ground import Ground
from protocol.faults import Fault
from protocol.grid import Grid
from protocol.scenario import ChaosSection, Scenario
from protocol.seeds import Stream, spawn

LATER_S = 0.3
"""A fault of a process strikes up to this long after its instant: about as long as a recovery."""

LASTS = 0.3
"""Faults of the network last at most this share of ``network.patience_s``: nobody is lost by them."""


def with_chaos(scenario: Scenario, ground: Ground, to_cover: int) -> Scenario:
    """Turn random faults into scheduled ones; those of tags name places by number.

    Args:
        scenario: with everything else filled in.
        ground: where it is played.
        to_cover: how many places the team is to visit.
    """
    chaos = scenario.chaos
    if chaos == ChaosSection():
        return scenario
    until = fair_share(scenario, ground, to_cover) if chaos.until is None else chaos.until
    faults = list(scenario.faults)
    rng = spawn(scenario.seed, "chaos")
    for victim in _victims(scenario, rng):
        at, round_ = _moment(scenario, until, rng)
        faults.append(Fault(kill=f"robot:{victim}", at=at, round=round_))
    # Streams of their own: that more of one kind is asked for changes nothing of the others.
    faults += _infrastructure(scenario, until, spawn(scenario.seed, "chaos", "infrastructure"))
    faults += _network(scenario, until, spawn(scenario.seed, "chaos", "network"))
    faults += _tags(scenario, until, ground, spawn(scenario.seed, "chaos", "tags"))
    return replace(scenario, faults=tuple(faults), chaos=ChaosSection())


def _victims(scenario: Scenario, rng: Stream) -> list[int]:
    """Draw the robots to kill: those that no scheduled fault kills, but for one that is to be left.

    Where these are too few, others are meant to be killed twice.
    """
    killed = {fault.robot for fault in scenario.faults if fault.robot is not None}
    others = [robot for robot in range(scenario.team.robots) if robot not in killed]
    count = min(scenario.chaos.robots, max(0, len(others) - 1))
    return rng.sample(others, count) + rng.sample(sorted(killed), scenario.chaos.robots - count)


def fair_share(scenario: Scenario, ground: Ground, to_cover: int) -> float:
    """Return the time in which the team could cover everything if it shared the work evenly."""
    robots, speed = scenario.team.robots, scenario.team.speed
    if isinstance(ground, Grid):
        moves, length = to_cover, ground.cell_m
    else:
        lengths = [known or 1.0 for known in ground.lengths]
        moves, length = 2 * len(lengths), sum(lengths) / max(1, len(lengths))
    if scenario.clock.mode == "lockstep":
        return max(1.0, moves / robots)
    together = sum(speed) if isinstance(speed, tuple) else speed * robots
    return max(1, moves) * length / together


def _moment(scenario: Scenario, until: float, rng: Stream) -> tuple[float, int]:
    """Draw an instant, and a round of it."""
    if scenario.clock.mode == "lockstep":
        return float(rng.randrange(ceil(until))), rng.randrange(2)
    return rng.uniform(0.0, until), 0


def infrastructure_of(scenario: Scenario) -> list[str]:
    """Return the processes of a run besides its robots."""
    names = ["world"]
    if scenario.device.capacity:
        names.append("bookkeeping")
    if scenario.network.router == "separate":
        names.append("router")
    return names


def _infrastructure(scenario: Scenario, until: float, rng: Stream) -> list[Fault]:
    """Draw kills; some strike at once with the one before, or while it comes back."""
    names = infrastructure_of(scenario)
    faults: list[Fault] = []
    at, round_, after_s = 0.0, 0, 0.0
    for _ in range(scenario.chaos.infrastructure):
        together = bool(faults) and rng.random() < 1 / 3
        if not together:
            at, round_ = _moment(scenario, until, rng)
            after_s = 0.0
        after_s += rng.choice((0.0, rng.uniform(0.0, LATER_S)))
        kill = rng.choice(names)
        faults.append(Fault(kill=kill, at=at, round=round_, after_s=round(after_s, 3)))
    return faults


def _network(scenario: Scenario, until: float, rng: Stream) -> list[Fault]:
    """Draw pauses, partitions and delays, too short for anybody to be lost."""
    robots = [f"robot:{robot}" for robot in range(scenario.team.robots)]
    processes = infrastructure_of(scenario)
    far = [*robots, *(name for name in processes if name == "bookkeeping")]
    longest_s = LASTS * scenario.network.patience_s
    faults = []
    for _ in range(scenario.chaos.network):
        at, round_ = _moment(scenario, until, rng)
        after_s = round(rng.uniform(0.0, LATER_S), 3)
        for_s = round(rng.uniform(0.05, longest_s), 3)
        match rng.choice(("pause", "partition", "halves", "delay")):
            case "pause":
                fault = Fault(pause=rng.choice([*robots, *processes]))
            case "partition":
                fault = Fault(partition=rng.choice(far))
            case "halves":
                fault = Fault(partition="halves")
            case _:
                delay_s = round(rng.uniform(0.0, 0.1), 3)
                fault = Fault(delay=rng.choice(far), delay_s=delay_s, jitter_s=delay_s / 2)
        faults.append(replace(fault, at=at, round=round_, after_s=after_s, for_s=for_s))
    return faults


def _tags(scenario: Scenario, until: float, ground: Ground, rng: Stream) -> list[Fault]:
    """Draw what becomes of tags; one device in five is destroyed for good."""
    places: Sequence[int] = range(0)
    if scenario.chaos.tags and isinstance(ground, Grid):
        places = [ground.place(*cell) for cell in ground.free_cells()]
    elif not isinstance(ground, Grid):
        places = range(len(ground.names))
    faults = []
    for _ in range(scenario.chaos.tags):
        at, round_ = _moment(scenario, until, rng)
        place = rng.choice(places)
        kinds = (
            Fault(erase_tag=place),
            Fault(erase_tag=place),
            Fault(corrupt_tag=place),
            Fault(corrupt_tag=place),
            Fault(destroy_tag=place),
        )
        faults.append(replace(rng.choice(kinds), at=at, round=round_))
    return faults
