"""Tables of cases, and calls that must be refused."""

import inspect

import pytest


def cases(*rows, ids=None):
    """Parametrises a test by rows: of the values of its first arguments, as many as a row has."""

    def parametrised(test):
        names = list(inspect.signature(test).parameters)[: len(getattr(rows[0], "values", rows[0]))]
        return pytest.mark.parametrize(names, rows, ids=ids)(test)

    return parametrised


def refuses(message, call, /, *arguments, error=ValueError, **options):
    """A call raises an error that says this; what it is given was made before. Returns all that it says."""
    with pytest.raises(error, match=message) as refused:
        call(*arguments, **options)
    return str(refused.value)
