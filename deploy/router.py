"""A router as a process of its own: the death of the world server then leaves all links up.

python -m deploy.router RUN_DIR --run RUN --port PORT --robots N
"""

import argparse
import asyncio
import signal
from pathlib import Path

from protocol.lifeline import tie_to_supervisor
from protocol.zenoh_link import Link, LinkConfig, run_process


async def _main(arguments: argparse.Namespace) -> None:
    users = arguments.run_dir / "users"
    config = LinkConfig(
        arguments.run,
        arguments.port,
        "router",
        users=str(users) if users.exists() else None,
        robots=arguments.robots,
    )
    told = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, told.set)
    with Link(config):
        await told.wait()


def main() -> None:
    """Run the router's process."""
    tie_to_supervisor()
    parser = argparse.ArgumentParser(prog="deploy.router", description=__doc__)
    parser.add_argument("run_dir", type=Path, help="folder of the run, with its users")
    parser.add_argument("--run", required=True, help="name of the run")
    parser.add_argument("--port", type=int, required=True, help="port to listen on")
    parser.add_argument("--robots", type=int, required=True, help="number of robots")
    run_process("router", _main(parser.parse_args()))


if __name__ == "__main__":
    main()
