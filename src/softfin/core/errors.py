"""Errors that softfin raises. Every message is one line with the object, the problem, the allowed
values and the fix."""


class SoftfinError(Exception):
    """Base class of all errors that softfin raises on purpose."""

    exit_code = 1


class InputError(SoftfinError):
    """Unusable input from the user."""

    exit_code = 2


class ConfigurationError(InputError):
    """An option or a YAML file that is invalid for the configuration."""


class LogError(InputError):
    """A recording that cannot be used for training."""


class NotALogError(LogError):
    """A file that does not contain a log."""


class ArtifactError(InputError):
    """A folder that is not a complete dataset, surrogate or controller."""


class PlantError(InputError):
    """An object that does not implement the Plant interface."""


class CommandError(InputError):
    """A command outside the limits of a plant."""


class CoverageError(InputError):
    """A reference force outside a controller's range."""


class RigError(InputError):
    """An unusable rig file, or a device that does not match it."""


class RunError(SoftfinError):
    """A failure at run time."""


class DeviceError(RunError):
    """A drive or sensor that does not respond, or responds with an error."""


class SafetyStop(RunError):
    """A fault or a requested stop, after which the fin was stopped and the motor disabled."""

    exit_code = 3

    def __init__(self, message: str, cause: str = "", is_confirmed: bool = False) -> None:
        super().__init__(message)
        self.cause = cause
        """Short name of the reason as in recordings, e.g. ``force_peak``; empty if unknown."""
        self.is_confirmed = is_confirmed
        """Whether the stop is confirmed; also True if the machine cannot confirm any stop."""


def one_line(error: BaseException) -> str:
    """Return the message of an error as one line of at most 300 characters, or its type if it has
    no message."""
    return " ".join(str(error).split())[:300] or type(error).__name__
