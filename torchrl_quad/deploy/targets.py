"""The code that lets an exported policy fly inside an autopilot's firmware."""

from __future__ import annotations

import math
from pathlib import Path
from string import Template

from torchrl_quad.deploy.bundle import load_bundle
from torchrl_quad.deploy.network import as_float, as_floats, fill_in
from torchrl_quad.deploy.simulators.vehicle import Drone
from torchrl_quad.errors import UserValueError, shown
from torchrl_quad.files import replacing_folder

#: By target the files of its folder, beside the network and ``pilot.h``, with their text where it is no template.
TARGETS: dict[str, dict[str, str | None]] = {
    "crazyflie": {
        "policy_crazyflie.c": None,
        "Kbuild": "obj-y += policy_crazyflie.o policy.o\n",
        "app-config": "CONFIG_APP_ENABLE=y\nCONFIG_APP_PRIORITY=1\nCONFIG_APP_STACKSIZE=$stack\n",
        "Makefile": "OOT_CONFIG := $$(PWD)/app-config\ninclude $$(CRAZYFLIE_BASE)/tools/make/oot.mk\n",
    },
    "px4": {"policy_px4.cpp": None},
    "betaflight": {"policy_betaflight.c": None},
}
AIMED = ("hovering", "landing")  # tasks that observe a target and the body
STACK = 2000  # of an app, in words, which holds the layers of networks up to 500 wide


def write_target(folder: str | Path, target: str) -> Path:
    """Write the folder ``policy_TARGET`` beside a bundle: the network in C, and the code that calls it in a firmware.

    Args:
        folder: a bundle whose policy commands rates and reads no image.
        target: crazyflie, px4 or betaflight.

    Raises:
        ValueError: the target is unknown, or has no code for such a policy.
    """
    folder = Path(folder)
    bundle = load_bundle(folder)
    contract, output = bundle.contract, bundle.contract["output"]
    if not isinstance(target, str) or target not in TARGETS:
        raise UserValueError(f"target must be one of {', '.join(TARGETS)}, got {shown(target)}.")
    queue = "action_queue" in contract["graphs"]["observe"]["reads"]
    wrong = {"an image": contract["camera"], "commands on their way": queue}
    wrong = [what for what, has in wrong.items() if has]
    if output["control"] != "rates" or wrong:
        raise UserValueError(
            f'target={target}: the code is for control="rates" from what a drone measures; this policy commands '
            f"{output['control']}{' and reads ' + wrong[0] if wrong else ''}. Call policy.c from code of your own."
        )
    full = len(contract["drone"]["rotor_spin"]) * float(Drone(contract["drone"]).thrust_limits[1])
    most = [high for _, high in output["body_rate"]["range"]]
    aims = contract["task"]["name"] in AIMED and contract["observation"]["size"] == 13
    values = {
        "task": contract["task"]["name"],
        "target": as_floats(bundle.starts()["target"][0]) if aims else "",
        "memory": " pilot->memory," if contract["memory"] else "",
        "full_thrust": as_float(full),
        "weight": as_float(output["thrust"]["weight"]),
        "period": round(1000 * contract["control_dt"]),
        "max_rates": as_floats(most),
        "stick": ", ".join(f"{math.degrees(x):g}" for x in most),
        "stack": STACK,
    }
    features = ["aims" if aims else "yours", *(["memory"] if contract["memory"] else [])]
    place = folder.parent / f"{folder.name}_{target}"
    files = {"pilot.h": None, **TARGETS[target]}
    written = {
        name: Template(x).substitute(values) if x else fill_in(name, values, features) for name, x in files.items()
    }
    written |= {name: (folder / name).read_text() for name in ("policy.c", "policy.h")}

    def check(place: Path) -> None:
        if others := sorted({x.name for x in place.iterdir()} - set(written)) if place.is_dir() else []:
            raise FileExistsError(f"{place} also holds {', '.join(others)}. Move it away: the folder is replaced.")

    with replacing_folder(place, check) as temporary:
        for name, text in written.items():
            (temporary / name).write_text(text)
    return place
