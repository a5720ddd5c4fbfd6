"""A robot's process: one algorithm, one line to the world.

    python -m agents.node --run RUN --port PORT --robot 3 [--host HOST] [--memory FILE]

With a memory the process may be killed and started again; it goes on where it was.

Exit codes: 0 the robot stopped; 1 its algorithm failed; 2 it could not join; 3 the world had declared
it lost; 4 the world refused a request; 5 it was told to end.
"""

import argparse
import asyncio
import sys
import traceback
from pathlib import Path

from agents.body import Body, Driver
from agents.memory import Memory
from agents.registry import algorithm_of
from protocol.errors import (
    FencedError,
    JoinError,
    OutcomeUnknownError,
    RunError,
    rule_errors,
)
from protocol.lifeline import tie_to_supervisor
from protocol.messages import Refusal, Sight, Stopped
from protocol.zenoh_link import (
    Link,
    LinkConfig,
    RobotLine,
    credentials_of,
    run_beside_loop,
    run_process,
)

STOPPED, FAILED, NOT_JOINED, FENCED, REFUSED, TOLD_TO_END = range(6)


def live(line: RobotLine, memory: Memory | None = None) -> int:
    """Play one robot from its first look, or from where its memory ends, to its stop.

    Returns:
        The exit code of the process.
    """
    try:
        try:
            return _play(line, memory)
        except (FencedError, RunError):
            raise
        except BaseException:  # noqa: BLE001  whatever a user's algorithm raises, SystemExit too
            traceback.print_exc()
            line.fail()
            return FAILED
    except FencedError as error:
        print(f"robot {line.briefing.robot}: fenced: {error}", file=sys.stderr)
        return FENCED


def _play(line: RobotLine, memory: Memory | None) -> int:
    briefing = line.briefing
    driver = Driver(algorithm_of(briefing.algorithm, briefing.options), Body(briefing))
    sight: Sight | None = None
    for remembered in () if memory is None else memory.sights:
        driver.next_request(sight)
        sight = remembered
    while True:
        reply = line.request(driver.next_request(sight))
        if isinstance(reply, Stopped):
            return STOPPED
        if isinstance(reply, Refusal):
            driver.close()
            print(f"{reply.error}: {reply.detail}", file=sys.stderr)
            return REFUSED if reply.error in rule_errors() else FAILED
        sight = reply
        if memory is not None:
            memory.keep(sight)


async def _main(arguments: argparse.Namespace) -> int:
    config = LinkConfig(
        arguments.run,
        arguments.port,
        credentials=credentials_of(f"robot-{arguments.robot}"),
        patience_s=arguments.patience,
        host=arguments.host,
    )
    memory = None if arguments.memory is None else Memory(arguments.memory)
    process, answered = ("", 0) if memory is None else (memory.process, len(memory.sights))
    with Link(config) as link:
        try:
            line = await asyncio.to_thread(RobotLine, link, arguments.robot, process, answered)
        except (JoinError, OutcomeUnknownError) as error:
            print(f"JoinError: {error}", file=sys.stderr)
            return NOT_JOINED
        code = await run_beside_loop(link, lambda: live(line, memory), tick=line.repeat_if_due)
    return TOLD_TO_END if code is None else code


def main() -> None:
    """Run a robot's process."""
    tie_to_supervisor()
    parser = argparse.ArgumentParser(prog="agents.node", description=__doc__)
    parser.add_argument("--run", required=True, help="name of the run")
    parser.add_argument("--host", default="127.0.0.1", help="where the router is")
    parser.add_argument("--port", type=int, required=True, help="port of the router")
    parser.add_argument("--robot", type=int, required=True, help="the identity to join under")
    parser.add_argument("--patience", type=float, default=5.0, help="seconds of silence allowed")
    parser.add_argument("--memory", type=Path, help="file to remember in, so that it can come back")
    arguments = parser.parse_args()
    run_process(f"robot {arguments.robot}", _main(arguments))


if __name__ == "__main__":
    main()
