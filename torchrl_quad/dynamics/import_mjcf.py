"""What MJCF says of a drone: MuJoCo reads its own format."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_quad.dynamics.import_formats import Array, Found, same, speed_at
from torchrl_quad.dynamics.import_models import DEPTH, Links, one_body, read_tree
from torchrl_quad.errors import UserValueError, needing, one_line, shown


def read_mjcf(root: ET.Element, path: Path, given: Found) -> tuple[str, str, Found, list[str]]:
    """What the bodies and actuators of MuJoCo's own format say, which MuJoCo itself reads.

    A rotor is an actuator that pushes at a site. Its gear says where to, and how much it turns the drone.
    """
    mujoco, model = _compiled(root, path)
    source, kind = str(path), "MJCF of MuJoCo"
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    some = [i for i in range(model.nu) if model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_SITE]
    gear, sites = model.actuator_gear[some], model.actuator_trnid[some, 0]
    forces = np.linalg.norm(gear[:, :3], axis=1)
    if not forces.all():  # some turn the whole body
        some, gear, sites, forces = [], gear[:0], sites[:0], forces[:0]
    bodies = [int(x) for x in model.site_bodyid[sites]] or [1 + int(model.body_mass[1:].argmax())]
    base, *others = {int(model.body_rootid[x]) for x in bodies}
    if others:
        names = shown([model.body(x).name for x in (base, *others)])
        raise UserValueError(f"{path}: rotors push several drones, {names}. Leave one in the file.")
    turn, links = data.xmat[base].reshape(3, 3), Links()

    def standing(place: Array, matrix: Array) -> Array:
        frame = np.eye(4)
        frame[:3, :3], frame[:3, 3] = turn.T @ matrix.reshape(3, 3), turn.T @ (place - data.xpos[base])
        return frame

    for x in np.flatnonzero(model.body_rootid == base):
        frame = standing(data.xipos[x], data.ximat[x])
        links[f"body {x}"] = float(model.body_mass[x]), frame, np.diag(model.body_inertia[x]), frame[:3, [2, 2]].T
    rotors = [f"the actuator {model.actuator(i).name or i}" for i in some]
    for name, x, push in zip(rotors, sites, gear[:, :3] / forces[:, None], strict=True):
        frame = standing(data.site_xpos[x], data.site_xmat[x])
        links[name] = 0.0, frame, np.zeros((3, 3)), np.tile(frame[:3, :3] @ push, (2, 1))
    carriers, held = set[int](), list[str]()
    for body in bodies if rotors else []:
        while body:
            carriers.add(body)
            body = int(model.body_parentid[body])
    for i in np.flatnonzero((model.body_rootid[model.jnt_bodyid] == base) & (model.jnt_type > 0)):
        name, rises = model.joint(i).name or f"joint {i}", abs((turn.T @ data.xaxis[i])[2]) > 0.7
        if int(model.jnt_bodyid[i]) not in carriers:
            held.append(name)
        elif not rises:
            why = f"the joint {shown(name)} turns rotors"
            raise UserValueError(f"{path}: {why}, and rotors here are fixed to the body. Take another drone.")
    found = one_body(links, rotors, True, held) | {"gravity": (np.linalg.norm(model.opt.gravity), "")}
    if not rotors:
        found["rotor_positions"] = None, "no actuators push at sites, one for each rotor"
        return source, kind, found | given, []
    torques = (gear[:, :3] * gear[:, 3:]).sum(1) / forces**2
    if torques.all():
        found["rotor_spin"], found["yaw_torque_coefficient"] = (np.sign(torques), "gear"), same(abs(torques), "gear")
    filters = (mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT)
    if np.isin(model.actuator_dyntype[some], filters).all():
        found["motor_time_constant"] = same(model.actuator_dynprm[some, 0], "their time constants")
    found |= given
    most, why = same(forces * model.actuator_gainprm[some, 0] * model.actuator_ctrlrange[some, 1], "ctrlrange")
    speed, curve = (found.get(x, (None,))[0] for x in ("rotor_speed_max", "thrust_map"))
    if most is None or most <= 0.0:
        found.setdefault("thrust_map", (None, why))
    elif curve is not None:
        found.setdefault("rotor_speed_max", (speed_at(most, curve), f"at {most:.4g} N, of ctrlrange"))
    elif speed is not None:
        found["thrust_map"] = [most / speed**2, 0.0, 0.0], f"{most:.4g} N of ctrlrange at rotor_speed_max"
    else:
        found["thrust_map"] = None, f"it follows from ctrlrange, {most:.4g} N, once rotor_speed_max is known"
    return source, kind, found, []


def _compiled(root: ET.Element, path: Path) -> tuple[Any, Any]:
    """MuJoCo, and the model that it makes of a file, without pictures."""
    with needing(f"{path}: MuJoCo reads its own format. Install it: pip install mujoco."):
        import mujoco
    _check_mjcf(root, path)
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        spec.memory = -1  # as much as it takes, whatever the file asks for
        for geom in [x for x in spec.geoms if x.mass == 0.0 or x.parent.explicitinertial]:
            spec.delete(geom)  # a picture, whose files need not be there
        for x in (*spec.geoms, *spec.sites):
            x.material = ""
        meshes = [x for x in spec.meshes if x.name not in {geom.meshname for geom in spec.geoms}]
        for x in (*meshes, *spec.materials, *spec.textures, *spec.hfields, *spec.skins, *spec.sensors, *spec.pairs):
            spec.delete(x)
        model = spec.compile()
    except ValueError as error:
        raise UserValueError(f"{path}: MuJoCo does not read it: {one_line(error)}.") from None
    if not model.body_mass.any():
        raise UserValueError(f"{path}: no body of it has a mass. Give the file of the drone.")
    return mujoco, model


def _check_mjcf(root: ET.Element, path: Path, depth: int = 0) -> None:
    """Refuse what makes much of little text, here and in the files that it includes."""
    if many := next((x.tag for x in root.iter() if x.tag in ("replicate", "composite", "flexcomp", "plugin")), None):
        raise UserValueError(f"{path}: a drone needs no <{many}>. Take it out, or write its parts out.")
    for include in root.iter("include"):
        file = path.parent / include.get("file", "")
        if depth == DEPTH or not file.is_file():
            raise UserValueError(f"{path} includes {shown(str(file))}, which is not there or includes itself.")
        _check_mjcf(read_tree(file), file, depth + 1)
