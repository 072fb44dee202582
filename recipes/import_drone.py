"""Make a drone of ours from a file of another project: URDF, SDF, MJCF, or parameters in YAML, TOML or JSON.

python recipes/import_drone.py cf2x.urdf motor_time_constant=0.07

It writes a YAML file, with its source and every assumption in comments, and says which fields the file lacks. Settings:

    output=PATH          the file to write, never over another one; without it, outputs/drones/NAME.yaml, by the entry,
                         the file, or its folder
    entry=NAME           which drone, of a file that has several
    FIELD=NUMBERS        what the file does not say, in SI units, such as linear_drag=[0.1,0.1,0.1]
"""

import sys
from pathlib import Path
from typing import Any

from torchrl_quad.dynamics import import_drone, presets
from torchrl_quad.errors import UserValueError, run_program, shown
from torchrl_quad.files import make_folder, replacing


def main() -> None:
    if len(sys.argv) < 2 or {"-h", "--help"} & set(sys.argv):
        print(__doc__)
        return
    path, cfg = settings(sys.argv[1:])
    name = path.stem.removesuffix(".sdf")  # of .sdf.jinja
    name = cfg.get("entry") or (path.absolute().parent.name if name == "model" else name)  # many SDF are model.sdf
    output = Path(cfg.pop("output", None) or f"outputs/drones/{name}.yaml")
    if output.exists() and path.exists() and output.samefile(path):
        raise UserValueError(f"output={output} is the file that is read. Choose another.")
    if output.suffix not in (".yaml", ".yml"):
        raise UserValueError(f"output={output}: it is written in YAML, so its name must end in .yaml.")
    text = import_drone(path, **cfg)
    if output.is_file() and output.read_bytes() != text.encode():
        raise UserValueError(f"{output} exists, and says something else. Remove it, or write output=ANOTHER.yaml.")
    make_folder(output.parent)
    with replacing(output) as temporary:
        temporary.write_text(text)
    print(f"{text}\nThis is {output}. Fly it by env.drone={output}, or load_drone({str(output)!r}).")


def settings(arguments: list[str]) -> tuple[Path, dict[str, Any]]:
    """The file and the settings of a command line, ``name=value``."""
    path, *rest = arguments
    cfg: dict[str, Any] = {}
    for argument in rest:
        name, equals, value = argument.partition("=")
        if not equals or name in cfg:
            raise UserValueError(f"{shown(argument)}: write each setting once, as name=value; the file comes first.")
        if not value:
            raise UserValueError(f"{name}= has no value. Write {name}=..., or leave it out.")
        cfg[name] = value if name in ("output", "entry") else presets.parse(value.encode(), name)
    return Path(path), cfg


if __name__ == "__main__":
    run_program(main)
