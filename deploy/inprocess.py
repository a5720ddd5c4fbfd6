"""The in-process engine: one thread, no event loop, no sockets; the same algorithms and world."""

import traceback
from collections.abc import Callable, Iterator

from agents.body import REQUEST_TYPES, Algorithm, Body, Driver
from protocol.errors import RuleError
from protocol.messages import AnyRequest, Briefing
from protocol.scenario import Scenario
from protocol.trace import LossCause
from world_server.world import Answers, End, KillOrder, TagsWanted, Wave, World


def briefing_of(scenario: Scenario, robot: int, nonce: str = "") -> Briefing:
    """Return what ``robot`` may know beforehand."""
    return Briefing(
        robot,
        scenario.team.robots,
        scenario.seed,
        scenario.algorithm,
        scenario.algorithm_options,
        scenario.device.capacity_bytes,
        scenario.radio.heartbeat,
        scenario.bookkeeping.fresh,
        nonce,
    )


def play(
    scenario: Scenario,
    world: World,
    algorithm: Algorithm,
) -> tuple[End, dict[int, str]]:
    """Play a run to its end.

    Returns:
        How it ended, and for each robot whose algorithm failed the text of its exception.
    """
    drivers = [Driver(algorithm, Body(briefing_of(scenario, robot))) for robot in range(scenario.team.robots)]
    send = [driver.send for driver in drivers]
    failures: dict[int, str] = {}
    output = world.begin()
    while True:
        if type(output) is Wave:
            requests = []
            lost: tuple[tuple[int, LossCause], ...] = ()
            for robot, sight in zip(output.robots, output.sights, strict=True):
                # `Driver.next_request`, written out: a call a step is a tenth of the time.
                try:
                    try:
                        request = send[robot](sight)
                    except StopIteration as stop:
                        request = drivers[robot].last_request(stop)
                    if request.__class__ not in REQUEST_TYPES:
                        raise drivers[robot].foreign_await(request)
                    requests.append(request)
                except Exception:  # noqa: BLE001  whatever a user's algorithm raises
                    failures[robot] = traceback.format_exc()
                    requests.append(None)
                    lost = (*lost, (robot, "failed"))
            output = world.resume(Answers(requests, lost))
        elif type(output) is KillOrder:
            drivers[output.robot].close()
            output = world.resume(None)
        elif type(output) is TagsWanted:
            output = world.resume(())
        else:
            return output, failures
