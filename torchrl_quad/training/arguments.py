"""Command lines in the grammar of hydra, however they are written.

Sweeps of wandb hand over ``--env.wind={'mean': [1, 0, 0]}`` and ``env.randomize=None``, as Python prints them. hydra
reads ``env.wind={mean: [1, 0, 0]}`` and ``env.randomize=null``.
"""

from __future__ import annotations

import ast
import json
import re
from typing import Any

# hydra's own options that take a value are these, and some with a hyphen in their name.
_SETTING = re.compile(r"--(?!cfg=|package=|info=)([\w.@/]+=.*)", re.DOTALL)


def hydra_argument(argument: str) -> str:
    """One argument of a command line: without hyphens, if it is a setting, and with its value as hydra writes it."""
    if match := _SETTING.fullmatch(argument):
        argument = match[1]
    name, equals, value = argument.partition("=")
    return name + equals + _rewritten(value) if equals and not name.startswith("-") else argument


def _rewritten(value: str) -> str:
    """A value, or several with commas between them; those that Python and JSON cannot read stay as they are."""
    if not re.search(r"[\[{]|\bNone\b", value):
        return value
    for read in (ast.literal_eval, json.loads):
        try:
            content = read(value.strip())
            if isinstance(content, tuple):
                return ",".join(map(_written, content))
            if isinstance(content, dict | list | None):
                return _written(content)
        except (ValueError, SyntaxError, RecursionError, MemoryError):
            continue
    return value


def _written(content: Any) -> str:
    if isinstance(content, dict):
        pairs = {re.sub(r"([^\w./+-])", r"\\\1", str(key)): _written(x) for key, x in content.items()}
        return f"{{{', '.join(f'{key}: {x}' for key, x in pairs.items())}}}"
    if isinstance(content, list | tuple):
        return f"[{', '.join(map(_written, content))}]"
    if isinstance(content, str):  # hydra reads \' as a quotation mark, and backslashes before one in pairs
        return "'" + re.sub(r"(\\*)('|$)", lambda match: 2 * match[1] + match[2].replace("'", r"\'"), content) + "'"
    return json.dumps(content, default=str)
