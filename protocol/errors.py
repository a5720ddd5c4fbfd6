"""Every error of Canopy, in one tree.

    CanopyError
    |-- InputError             a file or a command line that cannot be used (exit code 2)
    |   |-- ScenarioError        a scenario field: missing, unknown, of the wrong type, out of range
    |   |-- MapError             a map file that cannot be read
    |   `-- MachineError         this machine lacks something: a package, a free port
    |-- RuleError              a robot asked for what the world does not allow
    |   |-- ExitError            no such exit here
    |   |-- GazeError            no such direction to look in, or nothing to look with
    |   |-- TagError             the tag does not fit the device, or there is no device
    |   |-- DurationError        a wait that is no positive, finite (lockstep: whole) time
    |   |-- OpeningError         the first request must be a look
    |   `-- RoundsError          too many requests of zero duration in one instant
    |-- AlgorithmError         a robot algorithm that broke the contract of its Body
    |-- MessageError           bytes or a sequence number that the protocol does not allow
    |-- JoinError              the world refused this process under this identity
    |-- FencedError            the world has declared this robot lost
    |-- JournalError           a journal that cannot be trusted, with file and offset
    |-- ReplayError            a replay that did not give what was recorded
    |-- StoreError             the bookkeeping store refused a batch
    |-- RunError               a run that could not be carried to its end
    `-- OutcomeUnknownError    no answer: the request may or may not have taken place

``definite`` tells, for each class, whether the thing asked for certainly did not happen. Only
`OutcomeUnknownError` is indefinite: repeat the request under the same number, never report failure.
"""

from typing import ClassVar


class CanopyError(Exception):
    """Root of all errors that Canopy raises on purpose."""

    definite: ClassVar[bool] = True


class InputError(CanopyError):
    """A file or command line that cannot be used; the message names file, field and fix."""


class ScenarioError(InputError):
    """A scenario field is missing, unknown, of the wrong type or out of range."""


class MapError(InputError):
    """A map file cannot be read; the message names file and line."""


class MachineError(InputError):
    """This machine lacks something that the run needs."""


class RuleError(CanopyError):
    """A robot asked for what the world does not allow; the request did not happen."""


class ExitError(RuleError):
    """There is no such exit at this place."""


class GazeError(RuleError):
    """There is no such direction, or the robot has no senses that look in one."""


class TagError(RuleError):
    """The tag does not fit the device, or this place carries none."""


class DurationError(RuleError):
    """A wait must last a positive, finite time, in lockstep a whole number of ticks."""


class OpeningError(RuleError):
    """A robot must look before it asks for anything else."""


class RoundsError(RuleError):
    """A robot made too many requests of zero duration in one instant."""


class AlgorithmError(CanopyError):
    """A robot algorithm broke the contract of its Body, for instance by a foreign await."""


class MessageError(CanopyError):
    """A message that the protocol does not allow: type, field, size, version or number."""


class JoinError(CanopyError):
    """The world refused this process under this identity."""


class FencedError(CanopyError):
    """The world has declared this robot lost; its process must end."""


class JournalError(CanopyError):
    """A journal record is damaged; the message names file and offset."""


class ReplayError(CanopyError):
    """A replay did not give what was recorded."""


class StoreError(CanopyError):
    """The bookkeeping store refused a batch."""


class RunError(CanopyError):
    """A run could not be carried to its end."""


class OutcomeUnknownError(CanopyError):
    """No answer came: the request may or may not have taken place."""

    definite = False


def rule_errors() -> dict[str, type[RuleError]]:
    """Map the name of each kind of refusal to its class, as it travels in a `Refusal`."""
    kinds: list[type[RuleError]] = [RuleError, *RuleError.__subclasses__()]
    return {kind.__name__: kind for kind in kinds}
