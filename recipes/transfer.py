"""Fly an exported policy in a third-party simulator, through its contract and without torch.

python recipes/transfer.py bundle=outputs/.../policy simulator=mujoco

It flies one episode from each of the bundle's fresh starts with each rate loop of the simulator, judges them by the
task's own rules, adds a row to ``transfer.csv`` beside the bundle, and prints them. What is there is not flown again.
Settings:

    simulator=mujoco     or rotorpy, crazyflow, betaflight (the firmware, on Linux), torchrl_quad (ours; needs torch)
    loop=pid             only one rate loop: contract, pid, pd, or own, that of RotorPy and Betaflight; or stock,
                         Betaflight's without the gains of betaflight.txt
    mutants=true         also fly mistakes of a port, most of which must fail
    scale={mass: 1.2}    fly another drone than the policy was told of
    late=1               control steps by which commands are later than the contract says
    episodes=64          fewer of the starts
    folder=PATH          where transfer.csv and pictures go
    pictures=true        film the first drones beside our own simulator, and write a replay; needs torch and an extra
"""

import re
import sys
from pathlib import Path
from typing import Any

from torchrl_quad.deploy import load_bundle
from torchrl_quad.deploy.contract import naming
from torchrl_quad.deploy.simulators import simulator_class
from torchrl_quad.deploy.transfer import measure, mistakes, table
from torchrl_quad.errors import MissingPackage, UserValueError, run_program, shown
from torchrl_quad.files import make_folder


def main() -> None:
    if {"-h", "--help"} & set(sys.argv):
        print(__doc__)
        return
    cfg = settings(sys.argv[1:])
    loops = [cfg["loop"]] if cfg["loop"] else simulator_class(cfg["simulator"]).loops
    if cfg["pictures"]:
        try:
            from torchrl_quad.training.drawing import draw_transfer
        except ImportError as error:
            what = 'pictures=true needs torch and the extra recipes: pip install ".[recipes]"'
            raise MissingPackage(f"{what} ({error})") from error
    bundle = load_bundle(cfg["bundle"], on_fault="hover")
    bundle.check()
    folder = make_folder(cfg["folder"] or Path(cfg["bundle"]).resolve().parent)
    for loop in loops:
        for mutant in ("none", *(mistakes(bundle) if cfg["mutants"] else ())):
            options = {name: cfg[name] for name in ("scale", "late", "episodes")}
            measure(bundle, folder / "transfer.csv", cfg["simulator"], loop, mutant, **options)
    print(table(folder / "transfer.csv", bundle))
    if cfg["pictures"]:
        with naming(bundle.folder):
            path, changes = folder / f"transfer_{cfg['simulator']}", {name: cfg[name] for name in ("scale", "late")}
            draw_transfer(bundle, cfg["simulator"], loops[0], path, min(4, cfg["episodes"] or 4), **changes)


def settings(arguments: list[str]) -> dict[str, Any]:
    """The settings of a command line, ``name=value``; null is the default."""
    cfg: dict[str, Any] = {}
    for argument in arguments:
        name, equals, value = argument.partition("=")
        if name not in SETTINGS or not equals:
            choices = ", ".join(f"{x}=..." for x in SETTINGS)
            raise UserValueError(f"unknown setting {shown(argument)}. Choose from: {choices}.")
        if name in cfg:
            raise UserValueError(f"{name} is given twice. Give it once.")
        read, default = SETTINGS[name]
        cfg[name] = default if value in ("", "null") else read(name, value) if read else value
    cfg = {name: default for name, (_, default) in SETTINGS.items()} | cfg
    if cfg["bundle"] is None:
        raise UserValueError("bundle is missing: write bundle=FOLDER, of a policy that recipes/export.py has written.")
    return cfg


def flag(name: str, value: str) -> bool:
    if value.lower() not in ("true", "false"):
        raise UserValueError(f"{name} must be true or false, got {shown(value)}.")
    return value.lower() == "true"


def whole(name: str, value: str) -> int:
    least = {"late": 0, "episodes": 1}[name]
    if not re.fullmatch("[+-]?[0-9]{1,18}", value) or int(value) < least:
        raise UserValueError(f"{name} must be a whole number, at least {least}, got {shown(value)}.")
    return int(value)


def factors(name: str, value: str) -> dict[str, float]:
    """A mapping such as {mass: 1.2, inertia: 1.5}, of words to numbers."""
    inside = re.fullmatch(r"\s*{(.*)}\s*", value)
    pairs = [x.strip().partition(":") for x in inside[1].split(",") if x.strip()] if inside else []
    try:
        found = {field.strip(" '\""): float(factor) for field, _, factor in pairs}
    except ValueError:
        found = {}
    if not inside or len(found) < len(pairs):
        raise UserValueError(f"{name} must look like {{mass: 1.2, inertia: 1.5}}, got {shown(value)}.")
    return found


SETTINGS: dict[str, tuple[Any, Any]] = {  # how each is read, if it is not text, and its default
    "bundle": (None, None),
    "simulator": (None, "mujoco"),
    "loop": (None, None),
    "mutants": (flag, False),
    "scale": (factors, {}),
    "late": (whole, 0),
    "episodes": (whole, None),
    "folder": (None, None),
    "pictures": (flag, False),
}


if __name__ == "__main__":
    run_program(main)
