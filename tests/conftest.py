"""What all tests share: hypothesis profiles, and the way to data beside the repository."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings

ROOT = Path(__file__).resolve().parent.parent

settings.register_profile("ci", derandomize=True, deadline=None)
settings.register_profile("dev", deadline=None, print_blob=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the flag that rewrites golden traces."""
    parser.addoption(
        "--rewrite-golden",
        action="store_true",
        help="write the golden traces anew; commit them only if you understand what changed them",
    )


def shared(*parts: str) -> Path:
    """Find a file or folder of the shared data, or skip the test that asks for it.

    Args:
        parts: path inside ``CANOPY_SHARED`` (by default ``shared`` beside the repository).
    """
    path = Path(os.environ.get("CANOPY_SHARED") or ROOT.parent / "shared").joinpath(*parts)
    if not path.exists():
        # Inside a test this skips the test; at the top of a test module, the module.
        pytest.skip(f"no {path}: point CANOPY_SHARED at the shared data", allow_module_level=True)
    return path


@pytest.fixture(name="shared")
def shared_fixture() -> Callable[..., Path]:
    """`shared`, for tests that would rather not import it."""
    return shared
