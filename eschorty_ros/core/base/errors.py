"""The package's errors: each message is one line that names the thing, the value and the remedy."""

MESSAGE_MAX = 280
"""Characters of a message; a longer one loses its middle, not the thing and the remedy."""


def one_line(message: str) -> str:
    """Return a message as one line of `MESSAGE_MAX` characters at most."""
    text = " ".join(message.splitlines())
    if len(text) <= MESSAGE_MAX:
        return text
    return f"{text[: MESSAGE_MAX - 104]} ... {text[-99:]}"


class EschortyError(Exception):
    """A failure a user can cause or cure; command line and nodes print it without a traceback."""

    def __init__(self, message: object = "") -> None:
        super().__init__(one_line(str(message)))


class ArgumentError(EschortyError, ValueError):
    """A value outside what a function accepts; the message names the argument and its value."""


class FormatError(EschortyError):
    """A file or stream that is not what its reader expects."""


class OtherFormatError(FormatError):
    """A file of the expected kind that another program wrote, in a form that is not read."""


class CalibrationError(EschortyError):
    """A calibration that is missing, malformed or does not fit the sensor."""


class FitError(CalibrationError):
    """Targets that do not determine the free parameters; names the condition number."""


class DeviceError(EschortyError):
    """A camera, laser or stage that refused or failed."""


class DeviceGoneError(DeviceError):
    """The device is no longer there: unplugged, switched off, its port closed."""


class DeviceNotReadyError(DeviceError):
    """The device is being started; wait for it."""


class DeviceTimeoutError(DeviceError):
    """The device did not answer in time."""


class DeviceStallError(DeviceError):
    """A USB endpoint refuses transfers until its halt is cleared."""
