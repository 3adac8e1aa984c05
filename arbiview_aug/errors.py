"""Errors that this package raises on bad input, their base class, and warnings."""

import reprlib
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother, _SHORT.maxlong = 4, 100, 100, 100
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = 12


def shown(value: object) -> str:
    """A value for a message: its repr, cut where it is long or nested."""
    return _SHORT.repr(value)


def one_line(text: object, most: int = 300) -> str:
    """A text or an error for a message: on one line, cut where it is long."""
    return " ".join(str(text).split())[:most]


class ArbiviewError(Exception):
    """Base of this package's errors; messages name the camera or file, the expected and the given value."""


def described(error: BaseException) -> str:
    """One line about an error; errors of other packages with their type."""
    return str(error) if isinstance(error, ArbiviewError) else f"{type(error).__name__}: {error}"


def exit_status(program: str, command: Callable[[], int | None], *, resumable: bool = False) -> int:
    """Run a command; what the user can fix, Ctrl-C, SIGTERM or SIGHUP becomes one line on stderr after ``program``.

    Returns the command's exit status (None is 0), 2 after an error, 130 after Ctrl-C and the other signals; a
    ``resumable`` command may then be run again to continue.
    """
    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    in_main = threading.current_thread() is threading.main_thread()
    taken = [number for number in numbers if in_main and signal.getsignal(number) == signal.SIG_DFL]  # not by nohup
    for number in taken:
        signal.signal(number, signal.default_int_handler)
    try:
        return int(command() or 0)
    except KeyboardInterrupt:
        print(f"{program}: interrupted{'; run it again to go on' if resumable else ''}", file=sys.stderr)
        return 130  # 128 + SIGINT, as shells report Ctrl-C
    except (ArbiviewError, OSError) as error:
        print(f"{program}: {' '.join(str(error).splitlines())}", file=sys.stderr)
        return 2
    finally:
        for number in taken:
            signal.signal(number, signal.SIG_DFL)


class CalibrationError(ArbiviewError, ValueError):
    """A camera, rig or rig file that does not describe real cameras."""


@contextmanager
def calibration_of(where: str) -> Iterator[None]:
    """Name a file or frame in front of the errors of the calibrations in it."""
    try:
        yield
    except CalibrationError as error:
        raise CalibrationError(f"{where}: {error}") from None


class SampleError(ArbiviewError, ValueError):
    """A sample whose images, calibration and labels do not fit together."""


class UnreachableError(SampleError):
    """A target rig of which the sources show no pixel."""


class SampleTypeError(ArbiviewError, TypeError):
    """A sample value of a type that is not supported; the message gives the conversion to use."""


class DataError(ArbiviewError, ValueError):
    """A file of a data set that is missing, broken or inconsistent."""


class GeneratorError(ArbiviewError, ValueError):
    """A generator whose settings, weights and inputs do not fit together."""


class MissingPackageError(ArbiviewError, ImportError):
    """An optional package that is not installed; the message gives the command that installs it."""


class OutputError(ArbiviewError, RuntimeError):
    """A file that cannot be written: full disk or missing permission."""


class TrainingError(ArbiviewError, RuntimeError):
    """A training run with impossible settings or data, or one that cannot continue."""


class GeometryWarning(UserWarning):
    """Views that too little geometry or too few cameras support."""


class WarnOnce:
    """Warnings issued once per topic; ``topics`` are those issued."""

    def __init__(self) -> None:
        self.topics: set[str] = set()

    def __call__(self, topic: str, message: str, category: type[Warning] = UserWarning) -> None:
        """Warn, unless this topic was warned of before. Filters that make it an error do so for every sample."""
        if topic not in self.topics:
            warn(message, category)
            self.topics.add(topic)


_NOT_USERS = frozenset(("arbiview_aug", "torch", "torchvision")) | sys.stdlib_module_names


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn at the nearest line outside this package, torch and the standard library."""
    frame: FrameType | None = sys._getframe(1)
    level = 2
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] in _NOT_USERS:
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)
