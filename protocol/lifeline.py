"""The lifeline: a process that a supervisor started does not outlive it, not even a kill -9."""

import ctypes
import os
import signal
import sys

PARENT = "CANOPY_SUPERVISOR_PID"
"""Environment variable in which a supervisor gives its pid to the processes that it starts."""

_PR_SET_PDEATHSIG = 1


def tie_to_supervisor() -> None:
    """Let the kernel kill this process when the supervisor that started it dies.

    Does nothing where no supervisor is named. Call it first of all, in the main thread.
    """
    supervisor = os.environ.get(PARENT)
    if supervisor is None:
        return
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG)")
    if os.getppid() != int(supervisor):  # it died before the kernel knew of the tie
        sys.exit(1)
