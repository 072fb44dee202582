"""Errors that their message explains: what the user wrote cannot be used, why, and what to write instead.

The recipes end in one line for these; every other error is a mistake of a program and keeps its traceback.
"""


class UserError(Exception):
    """What the user wrote, or a file that the user named, cannot be used."""


class UserValueError(UserError, ValueError):
    """A value is out of its range, or unknown."""


class UserTypeError(UserError, TypeError):
    """A value has the wrong type, or an argument is unknown."""


class MissingPackage(UserError, ImportError):
    """An optional package is not installed."""
