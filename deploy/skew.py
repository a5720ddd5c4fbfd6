"""Faults of clocks: a process whose wall clock can be shifted while it runs.

libfaketime stands between the process and its clock and reads the shift from a file. The monotonic
clock, by which everything of Canopy waits and repeats, is left alone, as it is by a person or a time
server that sets the clock of a machine.
"""

from importlib.util import find_spec
from pathlib import Path

from protocol.errors import MachineError


def environment_of(shift: Path) -> dict[str, str]:
    """Return the variables under which a process takes its wall clock from a file.

    Args:
        shift: that file; it is made, and says that the clock is right.

    Raises:
        MachineError: If libfaketime is not installed.
    """
    found = find_spec("libfaketime")
    if found is None or found.origin is None:
        raise MachineError(
            "a fault `skew` needs the package 'libfaketime'; run `make setup`, or leave the fault out"
        )
    library = Path(found.origin).parent / "vendor/libfaketime/src/libfaketime.so.1"
    set_clock(shift, 0.0)
    return {
        "LD_PRELOAD": str(library),
        "FAKETIME_TIMESTAMP_FILE": str(shift.absolute()),
        "FAKETIME_NO_CACHE": "1",
        "FAKETIME_DONT_FAKE_MONOTONIC": "1",
    }


def clear(pid: int) -> None:
    """Remove the shared memory that libfaketime leaves behind for a process that was killed."""
    for name in (f"faketime_shm_{pid}", f"sem.faketime_sem_{pid}"):
        (Path("/dev/shm") / name).unlink(missing_ok=True)  # noqa: S108  a fixed place of the kernel's


def set_clock(shift: Path, by_s: float) -> None:
    """Shift the wall clock of the process that reads ``shift``; a reader never sees half a number."""
    draft = shift.with_name(f"{shift.name}.new")
    draft.write_text(f"{by_s:+f}", encoding="ascii")
    draft.replace(shift)
