"""Errors that their message explains: what the user wrote cannot be used, why, and what to write instead.

The recipes end in one line for these; every other error is a mistake of a program and keeps its traceback.
"""

import reprlib
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


class UserError(Exception):
    """What the user wrote, or a file that the user named, cannot be used."""


class UserValueError(UserError, ValueError):
    """A value is out of its range, or unknown."""


class UserTypeError(UserError, TypeError):
    """A value has the wrong type, or an argument is unknown."""


class WrongState(UserValueError, RuntimeError):
    """Something is of the right kind, and cannot be used as it is: a rollout without its graph, an empty buffer."""


class Unsupported(UserValueError, NotImplementedError):
    """Something is valid elsewhere, and not offered here."""


class Diverged(UserError, FloatingPointError):
    """A run was given up, since too much of it was not finite."""


class MissingPackage(UserError, ImportError):
    """An optional package is not installed."""


@contextmanager
def needing(message: str, kind: type[Exception] = MissingPackage) -> Iterator[None]:
    """Say what to install where an import in this block fails."""
    try:
        yield
    except ImportError as error:
        raise kind(f"{message} ({one_line(error)})") from error


class DroneWarning(UserWarning):
    """A drone flies, but not as all its numbers promise."""


_SHORT = reprlib.Repr()  # which looks at no more of a value than it shows
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 100
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = 30


def shown(value: Any) -> str:
    """What somebody wrote, in one line of a hundred characters, whatever it is."""
    try:
        text = one_line(_SHORT.repr(value))
    except (ValueError, RecursionError):  # Python writes no integer of more than 4300 digits
        text = f"a whole number of {value.bit_length()} bits" if isinstance(value, int) else type(value).__name__
    return text if len(text) <= 100 else f"{text[:97]}..."


def one_line(text: object) -> str:
    """The message of a library in one line of at most 200 characters, without what would garble it."""
    return "".join(x if x.isprintable() else " " for x in " ".join(str(text).split()))[:200]


def run_program(main: Callable[[], None]) -> None:
    """Run a program without hydra: what the user got wrong ends it in one line and status 2, and Ctrl-C in 130."""
    sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]  # names of files may be anything
    try:
        main()
    except (UserError, OSError) as error:
        print("Error:", " ".join(str(error).split()), file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("Stopped. What is finished is kept.", file=sys.stderr)
        raise SystemExit(130) from None
