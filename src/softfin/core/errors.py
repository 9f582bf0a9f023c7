"""Errors that softfin raises. Every message says what was wrong, where, what is allowed, what to
do, in one line."""


class SoftfinError(Exception):
    """Root of all errors that softfin raises on purpose."""

    exit_code = 1


class InputError(SoftfinError):
    """Input from the user that cannot be used."""

    exit_code = 2


class ConfigurationError(InputError):
    """An option, a YAML file or a ``--set`` that does not fit the configuration."""


class LogError(InputError):
    """A recording that cannot be used for training."""


class ArtifactError(InputError):
    """A folder that is not a complete dataset, surrogate or controller."""


class PlantError(InputError):
    """Something that does not meet the Plant contract."""


class CommandError(InputError):
    """A command outside the limits of a plant."""


class CoverageError(InputError):
    """A reference force outside what a controller covers."""


class RigError(InputError):
    """A rig's file that cannot be used, or a device that does not match the file."""


class RunError(SoftfinError):
    """A run that started correctly and failed midway."""


class DeviceError(RunError):
    """A drive or a sensor that does not answer, or answers with an error."""


class SafetyStop(RunError):
    """Something was wrong or a stop was requested: the fin was stopped and the motor
    disabled."""

    exit_code = 3


def one_line(error: BaseException) -> str:
    """Return the message of any library's error in one line of at most 300 characters; the error's
    type if it has no message."""
    return " ".join(str(error).split())[:300] or type(error).__name__
