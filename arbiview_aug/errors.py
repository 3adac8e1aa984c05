"""Errors that this package raises on bad input, with one base class to catch them all."""

import sys
import warnings
from collections.abc import Callable

INTERRUPTED = 130
"""Exit status of a process that Ctrl-C ended: 128 + SIGINT, as shells report it."""


class ArbiviewError(Exception):
    """Base of every error raised on purpose; the message names the camera or file, what was expected, what came."""


def described(error: Exception) -> str:
    """An error in one line; errors of other packages with their type."""
    return str(error) if isinstance(error, ArbiviewError) else f"{type(error).__name__}: {error}"


def exit_status(
    program: str,
    command: Callable[[], int | None],
    errors: tuple[type[Exception], ...] = (ArbiviewError,),
    *,
    resumable: bool = False,
) -> int:
    """Run a command; an error or Ctrl-C becomes one line on stderr.

    Args:
        program: Comes first in that line.
        command: Returns its exit status; None is 0.
        errors: Exceptions that are the user's to mend.
        resumable: Whether the same command goes on where Ctrl-C stopped it.

    Returns:
        The command's exit status, 2 after an error, 130 after Ctrl-C.
    """
    try:
        return int(command() or 0)
    except KeyboardInterrupt:
        fix = "; run it again to go on" if resumable else ""
        print(f"{program}: interrupted{fix}", file=sys.stderr)
        return INTERRUPTED
    except errors as error:
        print(f"{program}: {error}", file=sys.stderr)
        return 2


class CalibrationError(ArbiviewError, ValueError):
    """A camera, rig or rig file that does not describe real cameras."""


class SampleError(ArbiviewError, ValueError):
    """A sample whose images, calibration and labels do not fit together."""


class SampleTypeError(ArbiviewError, TypeError):
    """A sample value of a type that is not supported; the message gives the conversion to use."""


class DataError(ArbiviewError, ValueError):
    """A file of a data set that is missing, broken or inconsistent."""


class GeneratorError(ArbiviewError, ValueError):
    """A generator whose settings, weights and inputs do not fit together."""


class OutputError(ArbiviewError, RuntimeError):
    """A file that cannot be written: full disk or missing permission."""


class TrainingError(ArbiviewError, RuntimeError):
    """A training run with impossible settings or data, or one that cannot go on."""


class WarnOnce:
    """Warnings issued once per topic; ``topics`` are those issued."""

    def __init__(self) -> None:
        self.topics: set[str] = set()

    def __call__(self, topic: str, message: str) -> None:
        """Warn, unless this topic was warned of before."""
        if topic not in self.topics:
            self.topics.add(topic)
            warnings.warn(message, stacklevel=_callers_level())


def _callers_level() -> int:
    """``stacklevel`` of the nearest line that is neither this package's nor torch's, as seen from our caller."""
    level, frame = 1, sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in _INSIDE:
        level, frame = level + 1, frame.f_back
    return level


_INSIDE = (__name__.partition(".")[0], "torch", "torchvision")
