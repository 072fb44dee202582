"""Options by type and range, declared once, in the signature of what takes them; recipes read the same annotations.

``@checked`` holds arguments against annotations in plain types (numbers, bool, str, None, Literal, lists and mappings
of them), such as ``seconds: Positive = 1.0``: -1 is refused with "seconds must be greater than 0, got -1.", and what
the docstring says of the argument under "Args:". Nothing is converted but numpy's scalars. What has another type, such
as a tensor or a network, the function checks itself.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import importlib
import inspect
import pkgutil
import re
import sys
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, cast

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field, TypeAdapter, ValidationError

from torchrl_quad.errors import UserTypeError, UserValueError, shown

Real = Annotated[float, Field(allow_inf_nan=False, ge=-1e30, le=1e30)]
Positive = Annotated[float, Field(allow_inf_nan=False, gt=0, le=1e30)]
NonNegative = Annotated[float, Field(allow_inf_nan=False, ge=0, le=1e30)]
Fraction = Annotated[float, Field(allow_inf_nan=False, ge=0, le=1)]
Share = Annotated[float, Field(allow_inf_nan=False, gt=0, le=1)]
Count = Annotated[int, Field(ge=0, le=10**9)]
Size = Annotated[int, Field(ge=1, le=10_000_000)]
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Below1 = Annotated[float, Field(allow_inf_nan=False, ge=0, lt=1)]
Scale = Annotated[float, Field(allow_inf_nan=False, gt=0, le=1e6)]
Coefficient = Annotated[float, Field(allow_inf_nan=False, ge=0, le=1e6)]
Horizon = Annotated[int, Field(ge=1, le=100_000)]
Width = Annotated[int, Field(ge=1, le=65_536)]
Copies = Annotated[int, Field(ge=1, le=64)]
Delay = Annotated[int, Field(ge=0, le=1_000)]  # in control steps


class Explained(UserValueError):
    """Raised by a validator of an annotation; its message needs no further explanation."""


def between(least: float, most: float) -> Any:
    """The range of a number: ``Annotated[float, between(0.0, 1.0)]``, or ``Annotated[int, between(0, 10)]``."""
    return Field(ge=least, le=most, allow_inf_nan=False if isinstance(least, float) else None)


def entries(least: int, most: int) -> Any:
    """How many entries a list has: ``Annotated[Sequence[Real], entries(3, 3)]``."""
    return Field(min_length=least, max_length=most)


def accepted(accepts: Callable[[Any], bool], wanted: str) -> AfterValidator:
    """What a function accepts, ``Annotated[Any, accepted(...)]``; ``wanted`` ends the sentence "It must be ..."."""

    def validate(value: Any) -> Any:
        if not accepts(value):
            raise UserValueError(f"be {wanted}")
        return value

    return AfterValidator(validate)


def _is_entry(key: Any) -> bool:
    return isinstance(key, str) or (isinstance(key, tuple) and bool(key) and all(isinstance(x, str) for x in key))


def _is_device(device: Any) -> bool:
    import torch  # which not all that checks options needs

    try:
        torch.Generator(torch.device(device))
    except Exception:  # torch has another one for each thing that may be wrong
        return False
    return isinstance(device, str | torch.device)


Entry = Annotated[Any, accepted(_is_entry, 'the name of an entry, such as "observation" or ("state", "velocity")')]
Entries = Annotated[Sequence[Entry], Field(min_length=1)]
Device = Annotated[Any, accepted(_is_device, "a device of this machine that torch knows, such as 'cpu' or 'cuda'")]

_CONFIG = ConfigDict(strict=True, allow_inf_nan=False)
_PLAIN = (bool, int, float, str, type(None), Path, list, tuple, dict, Mapping, Sequence)
_MUST = {  # pydantic's kinds of error in plain words
    "int_type": "be a whole number",
    "float_type": "be a number",
    "bool_type": "be true or false",
    "string_type": "be a string",
    "list_type": "be a list",
    "sequence_str": "be a list",
    "dict_type": "be a mapping",
    "mapping_type": "be a mapping",
    "model_type": "be a section with settings of its own",
}
_F = TypeVar("_F", bound=Callable[..., Any])
_T = TypeVar("_T")


def checked(target: _F, described_by: type | None = None) -> _F:
    """Make a function, or a class when it is built, refuse arguments that do not fit its annotations.

    Of a method, ``described_by`` is the class whose docstring describes the arguments.

    Raises:
        UserValueError: (in use) the first argument that has the wrong type or is out of its range.
        UserTypeError: (in use) an argument is unknown, missing, or given twice.
    """
    if isinstance(target, type):
        target.__init__ = checked(target.__init__, target)  # type: ignore[misc]
        return target
    signature = inspect.signature(target)

    @functools.wraps(target)
    def function(*args: Any, **kwargs: Any) -> Any:
        try:
            bound = signature.bind(*args, **kwargs)
        except TypeError as error:
            called = type(args[0]) if target.__name__ == "__init__" and args else target
            check_known(called, kwargs)
            raise UserTypeError(f"{called.__name__}: {error}.") from None
        adapters = _adapters(described_by or target)
        for name in [name for name in bound.arguments if name in adapters]:
            bound.arguments[name] = _checked(name, bound.arguments[name], *adapters[name])
        return target(*bound.args, **bound.kwargs)

    return cast("_F", function)


def check_value(name: str, value: Any, kind: Any, description: str = "") -> Any:
    """A value that fits an annotation, for what no signature can hold; a UserValueError if it does not."""
    return _checked(name, value, TypeAdapter(kind, config=_CONFIG), description)


def build(cls: type[_T], name: str, spec: Any, **more: Any) -> _T:
    """An object from a mapping of its arguments, or the object itself, with the arguments ``more`` that are not zero.

    Raises:
        UserValueError: it is neither, has an unknown key, lacks one, or has a value that does not fit.
    """
    if isinstance(spec, cls):
        changes = {key: value for key, value in more.items() if value}
        return dataclasses.replace(cast("Any", spec), **changes) if changes else spec
    allowed = {key: x for key, x in inspect.signature(cls).parameters.items() if key not in more}
    listed = ", ".join(allowed)
    if not isinstance(spec, Mapping):
        such = next((f", such as {shown({k: x.default})}" for k, x in allowed.items() if x.default is not x.empty), "")
        wanted = f"it must be a mapping with any of {listed}{such}, or a {cls.__name__}"
        raise UserValueError(f"{name}: {wanted}; got {shown(spec)}.")
    for key in spec:
        if key not in allowed:
            raise UserValueError(f"{name}: unknown key {shown(key)}. Allowed: {listed}.")
    for key, argument in allowed.items():
        if key not in spec and argument.default is argument.empty:
            raise UserValueError(f"{name}: missing key {key!r}. Allowed: {listed}.")
    try:
        return cls(**spec, **more)
    except UserValueError as error:
        raise UserValueError(f"{name}: {error}") from None


def buildable(cls: type, name: str) -> AfterValidator:
    """What :func:`build` makes such an object of, or None: ``Annotated[Any, buildable(...)]``."""
    return explained(functools.partial(build, cls, name), name)


def explained(make: Callable[[Any], Any], name: str) -> AfterValidator:
    """None, or what a function takes that says what is wrong of ``name``: ``Annotated[Any, explained(...)]``."""

    def validate(value: Any) -> Any:
        try:
            return value if value is None else make(value)
        except UserValueError as error:
            raise Explained(str(error).removeprefix(f"{name}: ")) from None

    return AfterValidator(validate)


def imported(path: Any, what: str = "task") -> Any:
    """What a path leads to, such as "mypackage.WindowEnv"; its module is imported.

    Raises:
        ValueError: it is no path, or that of a module; or there is no such module, or that has nothing of this name.
    """
    if not (isinstance(path, str) and re.fullmatch(r"\w+(\.\w+)+", path)):
        raise UserValueError(f"{what}={shown(path)}: it must be the path of a class, such as mypackage.Mine.")
    module, _, name = path.rpartition(".")
    try:
        found = importlib.import_module(module)
        end = getattr(found, name) if hasattr(found, name) else importlib.import_module(path)
    except ModuleNotFoundError as error:
        above, _, missing = (error.name or "").rpartition(".")
        own = missing and f"{path}.".startswith(f"{error.name}.")
        if not own or (above and above not in sys.modules):
            raise  # the module is there, and needs one that is not
        said = f"Python finds no module {missing!r}. Put its folder on PYTHONPATH, or install its package."
        if found := sys.modules.get(above):
            at = getattr(found, "__file__", None)
            said = f"the module {above!r}{f' ({at})' if at else ''} has no {missing!r}. {_classes_in(found)}"
        raise UserValueError(f"{what} {path!r}: {said}") from None
    if isinstance(end, types.ModuleType):
        raise UserValueError(f"{what} {path!r}: this is a module. {_classes_in(end)}")
    return end


def _classes_in(module: types.ModuleType) -> str:
    """Which paths of classes in a module, or else in those below it, may be written."""
    name = module.__name__
    if own := [f"{name}.{x}" for x, y in vars(module).items() if isinstance(y, type) and y.__module__ == name]:
        return f"Write one of: {', '.join(own)}."
    below = [x.name for x in pkgutil.iter_modules(getattr(module, "__path__", []))]
    return f"Write the path of a class{' in one of its modules: ' * bool(below)}{', '.join(below)}."


def declared(target: Callable[..., Any]) -> dict[str, tuple[Any, str]]:
    """The plain annotation and the description of each argument of a function or class, with those of its bases."""
    found: dict[str, tuple[Any, str]] = {}
    for owner, function in reversed(_takers(target)):
        described = _descriptions(owner) or _descriptions(function)
        for name, kind in _annotations(function).items():  # what a subclass does not describe, its base does
            found[name] = kind, described.get(name) or found.get(name, (kind, ""))[1]
    return found


def must(error: Mapping[str, Any]) -> str:
    """What pydantic's error asks for, as the end of a sentence that begins with "it must"."""
    said = error["msg"].removeprefix("Value error, ").replace(" after validation", "")
    said = re.sub("^[A-Z][a-z]+ should ", "", said)
    for long, short in (("greater than or equal to", "at least"), ("less than or equal to", "at most")):
        said = said.replace(long, short)
    if isinstance(error.get("ctx", {}).get("error"), Explained):
        return f"have other entries: {said.rstrip('.')}"
    if error["type"] == "is_instance_of" and error["ctx"]["class"] == "Sequence":
        return "be a list"
    asked, value = _MUST.get(error["type"], said), error["input"]
    if error["type"] == "float_type" and isinstance(value, int) and not isinstance(value, bool):
        asked += " that a float holds"
    if error["type"] == "int_type" and isinstance(value, float) and value.is_integer():
        asked += f", written {int(value)}"
    return asked


def _checked(name: str, value: Any, adapter: TypeAdapter[Any], description: str) -> Any:
    try:
        plain = _without_numpy(value)
    except RecursionError:
        raise UserValueError(f"{name} holds too many nested lists. Write it flatter.") from None
    try:
        valid = adapter.validate_python(plain)
    except ValidationError as refused:
        first, *others = refused.errors()
        if isinstance(error := first.get("ctx", {}).get("error"), Explained):
            raise UserValueError(f"{name}: {error}") from None
        if isinstance(error, UserValueError) and str(error).startswith(name):  # which is a sentence of its own
            raise error from None
        place = "".join(f"[{key}]" for key in first["loc"] if isinstance(key, int))
        choices = [must(error) for error in (first, *others) if error["input"] is first["input"]]
        said = f"{name}{place} must {' or '.join(dict.fromkeys(choices))}, got {shown(first['input'])}."
        raise UserValueError(" ".join(filter(None, (said, description)))) from None
    # A tensor of one element or a Decimal passes as a number, but would not compute with others: it becomes a float.
    return valid if type(valid) is float and not isinstance(plain, int | float) else plain


def _without_numpy(value: Any) -> Any:
    if isinstance(value, np.generic) or (isinstance(value, np.ndarray) and value.ndim == 0):
        return value.item()
    if str(getattr(value, "dtype", "")) == "torch.bool":  # which is a float to Python
        return value.tolist()
    if type(value) in (list, tuple):
        return type(value)(map(_without_numpy, value))
    if type(value) is dict:
        return {key: _without_numpy(x) for key, x in value.items()}
    return value


def check_known(called: Callable[..., Any], given: Iterable[str]) -> None:
    """Raise UserTypeError for the first name that is no argument, with the closest one that is."""
    known = argument_names(called)
    for unknown in (name for name in given if name not in known):
        close = difflib.get_close_matches(unknown, known, 1)
        hint = f"Did you mean {close[0]!r}? " if close else ""
        what = f"{called.__name__} got an unexpected keyword argument {shown(unknown)}"
        raise UserTypeError(f"{what}. {hint}Choose from: {', '.join(known)}.")


def argument_names(called: Callable[..., Any]) -> list[str]:
    """The names of all arguments; those of a class include what it hands on to its bases."""
    whole = [called] if hasattr(called, "__signature__") else [function for _, function in _takers(called)]
    given = [x for function in whole for x in inspect.signature(function).parameters.values()]
    return sorted({x.name for x in given if x.kind not in (x.VAR_KEYWORD, x.VAR_POSITIONAL)} - {"self"})


def _takers(called: Callable[..., Any]) -> list[tuple[Any, Callable[..., Any]]]:
    """A function; or those of a class and its bases that take arguments of it, up to the one that hands on nothing."""
    if not isinstance(called, type):
        return [(called, called)]
    found = []
    for owner in called.__mro__:
        function = vars(owner).get("__init__")
        if isinstance(function, types.FunctionType):
            found.append((owner, function))
            if not any(x.kind is x.VAR_KEYWORD for x in inspect.signature(function).parameters.values()):
                break
    return found


@functools.cache
def _adapters(target: Callable[..., Any]) -> dict[str, tuple[TypeAdapter[Any], str]]:
    return {name: (TypeAdapter(kind, config=_CONFIG), said) for name, (kind, said) in declared(target).items()}


def _annotations(function: Callable[..., Any]) -> dict[str, Any]:
    """The annotations in plain types, by argument."""
    found, known = {}, getattr(inspect.unwrap(function), "__globals__", {})
    for name, parameter in inspect.signature(function).parameters.items():
        kind = parameter.annotation
        try:
            kind = eval(kind, known) if isinstance(kind, str) else kind
        except NameError:  # of a type that only type checkers import
            continue
        is_one = parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
        if is_one and kind is not parameter.empty and _is_plain(kind):
            found[name] = kind
    return found


def _is_plain(kind: Any) -> bool:
    origin = typing.get_origin(kind)
    if origin is Annotated:
        return typing.get_args(kind)[0] is Any or _is_plain(typing.get_args(kind)[0])
    if origin in (typing.Union, types.UnionType):
        return all(map(_is_plain, typing.get_args(kind)))
    if origin is Literal or (kind in (..., Any) and origin is None):
        return kind is not Any
    return (origin or kind) in _PLAIN and all(x is Any or _is_plain(x) for x in typing.get_args(kind))


def _descriptions(owner: Any) -> dict[str, str]:
    """The first sentence of each argument's entry under "Args:" in a docstring."""
    found: dict[str, str] = {}
    is_constructor = not isinstance(owner, type) and owner.__name__ == "__init__"  # its class describes its arguments
    text = "" if is_constructor else inspect.getdoc(owner) or ""
    section = re.search(r"^Args:\n((?:[ \n].*\n?)+)", text, re.MULTILINE)
    for names, said in re.findall(r"^ {4}([\w, ]+): (.*(?:\n {6,}.*)*)", section[1] if section else "", re.MULTILINE):
        plain = re.sub(r":\w+:`~?([^`]+)`", r"\1", said).replace("``", "")
        sentence = " ".join(plain.split()).split(". ")[0].rstrip(".:") + "."
        found |= dict.fromkeys(names.split(", "), sentence[0].upper() + sentence[1:])
    return found
