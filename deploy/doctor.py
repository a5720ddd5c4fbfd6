"""`canopy doctor`: what this machine has, and what Canopy would miss."""

import os
import platform
import shutil
import sys
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec

from msgspec import Struct

from agents.registry import ALGORITHMS
from protocol.errors import CanopyError

PACKAGES = {
    "eclipse-zenoh": "zenoh",
    "msgspec": "msgspec",
    "numpy": "numpy",
    "pillow": "PIL",
    "pyyaml": "yaml",
    "networkx": "networkx",
    "matplotlib": "matplotlib",
    "rich": "rich",
}
"""Each package, and what it is imported as."""


class Check(Struct, frozen=True):
    """One thing that was looked at.

    Attributes:
        name: what.
        fine: whether Canopy can work with it.
        detail: what was found, and what to do.
    """

    name: str
    fine: bool
    detail: str


def examine() -> list[Check]:
    """Look at everything a run needs."""
    return [_python(), *map(_package, PACKAGES), _router(), _kernel(), _docker(), _algorithms()]


def _python() -> Check:
    fine = sys.version_info >= (3, 11)
    return Check("python", fine, platform.python_version() + ("" if fine else "; needs 3.11"))


def _package(name: str) -> Check:
    try:
        if find_spec(PACKAGES[name]) is not None:
            return Check(name, True, version(name))
    except (PackageNotFoundError, ModuleNotFoundError):
        pass
    return Check(name, False, "missing; run `make setup`")


def _router() -> Check:
    """Open a router on loopback and have a client ask it something."""
    try:
        from protocol.zenoh_link import Link, LinkConfig, free_port

        port = free_port()
        with Link(LinkConfig("doctor", port, "router")) as router:
            router.answer(router.keys.join("*"), lambda _, payload: payload)
            with Link(LinkConfig("doctor", port)) as client:
                client.ask(client.keys.join(0), b"hello", timeout_s=5)
    except (CanopyError, ModuleNotFoundError) as error:
        return Check("zenoh on loopback", False, str(error))
    return Check("zenoh on loopback", True, "a router and a client talk")


def _kernel() -> Check:
    fine = sys.platform == "linux"
    found = f"{platform.system()} {platform.release()}, {os.cpu_count()} cores"
    return Check("kernel", fine, found if fine else f"{found}; needs Linux (process ties)")


def _docker() -> Check:
    found = shutil.which("docker")
    detail = "found" if found else "not found; only the containers engine needs it"
    return Check("docker", True, detail)


def _algorithms() -> Check:
    return Check("algorithms", True, ", ".join(sorted(ALGORITHMS)))


def report(show: Callable[[str], None]) -> int:
    """Print all checks; return the exit code."""
    checks = examine()
    width = max(len(check.name) for check in checks)
    for check in checks:
        show(f"{'✓' if check.fine else '✗'} {check.name:<{width}}  {check.detail}")
    return 0 if all(check.fine for check in checks) else 1
