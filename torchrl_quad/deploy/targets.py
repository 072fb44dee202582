"""The code that lets an exported policy fly inside an autopilot's firmware."""

from __future__ import annotations

import math
from pathlib import Path

from torchrl_quad.deploy import autopilots
from torchrl_quad.deploy.bundle import load_bundle
from torchrl_quad.deploy.network import as_float, as_floats, fill_in
from torchrl_quad.deploy.simulators.vehicle import Drone
from torchrl_quad.errors import UserValueError, shown
from torchrl_quad.files import replacing_folder

#: By target the files of its folder, beside the network and ``pilot.h``, as their templates are called.
TARGETS = {
    "crazyflie": ("policy_crazyflie.c", "Kbuild", "app-config", "Makefile"),
    "px4": ("policy_px4.cpp",),
    "betaflight": ("policy_betaflight.c",),
}
# What each takes of what policies command.
MODES = dict.fromkeys(("crazyflie", "px4"), ("rates", "attitude", "velocity")) | {"betaflight": ("rates",)}
AIMED = ("hovering", "landing")  # tasks that observe a target and the body
STACK = 2000  # of an app, in words, which holds the layers of networks up to 500 wide


def write_target(folder: str | Path, target: str) -> Path:
    """Write the folder ``policy_TARGET`` beside a bundle: the network in C, and the code that calls it in a firmware.

    Args:
        folder: a bundle whose policy reads no image, and commands what the target takes (``MODES``).
        target: crazyflie, px4 or betaflight.

    Raises:
        ValueError: the target is unknown, or has no code for such a policy.
    """
    folder = Path(folder)
    bundle = load_bundle(folder)
    contract, output = bundle.contract, bundle.contract["output"]
    if not isinstance(target, str) or target not in TARGETS:
        raise UserValueError(f"target must be one of {', '.join(TARGETS)}, got {shown(target)}.")
    control, modes = output["control"], MODES[target]
    wrong = {"env.control=rates": control not in modes, "env.camera=null": contract["camera"]}
    wrong["env.observe_last_action=false"] = "action_queue" in contract["graphs"]["observe"]["reads"]
    if wrong := [setting for setting, has in wrong.items() if has]:
        raise UserValueError(
            f"target={target}: the code commands {' or '.join(modes)} from what a drone measures; this policy commands "
            f"{control}. Train it with {' '.join(wrong)}, or call policy.c from code of your own."
        )
    drone = Drone(contract["drone"])
    idle = autopilots.idle(drone)
    curve = autopilots.throttle(drone, idle)
    aims = contract["task"]["name"] in AIMED and contract["observation"]["size"] == 13
    values = {
        "task": contract["task"]["name"],
        "control": control,
        "message": {"velocity": "trajectory"}.get(control, f"vehicle_{control}") + "_setpoint",
        "target": as_floats(bundle.starts()["target"][0]) if aims else "",
        "memory": " pilot->memory," if contract["memory"] else "",
        "full_thrust": as_float(len(drone.rotor_spin) * drone.thrust_limits[1]),
        "full_curve": as_float(curve.full_thrust),
        "curve": as_float(curve.model_factor),
        "idle": as_float(idle),
        "min_check": as_float(autopilots.MIN_CHECK),
        "weight": as_float(output["thrust"]["weight"]),
        "period": round(1000 * contract["control_dt"]),
        "stick": as_float(math.radians(autopilots.stick_rate(contract))),
        "stack": STACK,
    }
    features = ["aims" if aims else "yours", control, *["thrust"] * (control != "velocity")]
    features += ["memory"] * bool(contract["memory"])
    place = folder.parent / f"{folder.name}_{target}"
    written = {name: fill_in(name, values, features) for name in ("pilot.h", *TARGETS[target])}
    written |= {name: (folder / name).read_text() for name in ("policy.c", "policy.h")}

    def check(place: Path) -> None:
        if others := sorted({x.name for x in place.iterdir()} - set(written)) if place.is_dir() else []:
            raise FileExistsError(f"{place} also holds {', '.join(others)}. Move it away: the folder is replaced.")

    with replacing_folder(place, check) as temporary:
        for name, text in written.items():
            (temporary / name).write_text(text)
    return place
