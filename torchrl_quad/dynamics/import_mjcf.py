"""What MJCF says of a drone: MuJoCo reads its own format."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_quad.dynamics.import_formats import Array, Found, same, speed_at
from torchrl_quad.dynamics.import_models import Links, one_body, read_tree
from torchrl_quad.errors import UserValueError, needing, one_line, shown

MANY = ("composite", "flexcomp", "plugin")  # elements that make much of little text
MOST = 2000  # what a file may ask memory for
ACROSS = 0.02  # the share of a torque that may be across the thrust; and how far from a rotor its joint may be [m]


def read_mjcf(path: Path, given: Found) -> tuple[str, str, Found, list[str]]:
    """What the bodies and actuators of MuJoCo's own format say, which MuJoCo itself reads.

    A rotor is an actuator that pushes at a site. Its gear says where to, and how much it turns the drone; or another
    actuator at its site turns the drone.
    """
    _check_files(path)
    mujoco, model = _compiled(path)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    at_sites = [i for i in range(model.nu) if model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_SITE]
    some = [i for i in at_sites if model.actuator_gear[i, :3].any()]
    some = some if len(some) > 3 else []  # fewer push the whole drone
    gear, sites = model.actuator_gear[some], model.actuator_trnid[some, 0]
    ends = np.array([_ends(mujoco, model, i) for i in some]).reshape(-1, 2)
    forces, turners = np.where(ends[:, 1] >= -ends[:, 0], ends[:, 1], ends[:, 0]), list[int]()
    for i in (i for i in at_sites if i not in some):
        low, high = _ends(mujoco, model, i)
        mine = [k for k in np.flatnonzero(sites == model.actuator_trnid[i, 0]) if forces[k]]
        if len(mine) == 1 and low * high == 0.0 != low + high:  # else it may turn either way
            share = (low + high) / forces[mine[0]] * np.linalg.norm(gear[mine[0], :3])
            gear[mine[0], 3:] += share * model.actuator_gear[i, 3:]
            turners.append(i)
    bodies = [*model.site_bodyid[sites]] or [1 + model.body_mass[1:].argmax()]
    chains = [_chain(model, x) for x in bodies]
    if len({chain[-1] for chain in chains}) > 1:
        names = shown(sorted({model.body(chain[-1]).name for chain in chains}))
        raise UserValueError(f"{path}: rotors push several drones, {names}. Leave the actuators of one in the file.")
    shared = [x for x in chains[0] if all(x in chain for chain in chains)]  # these carry all rotors
    free = [x for x in shared if model.body_jntnum[x] and model.jnt_type[model.body_jntadr[x]] == 0]
    base = next((x for x in (*free, *shared) if model.body_jntnum[x]), shared[-1])  # below a stand, if it is on one
    turn, links = data.xmat[base].reshape(3, 3), Links()

    def standing(place: Array, matrix: Array) -> Array:
        frame = np.eye(4)
        frame[:3, :3], frame[:3, 3] = turn.T @ matrix.reshape(3, 3), turn.T @ (place - data.xpos[base])
        return frame

    own = [x for x in range(1, model.nbody) if base in _chain(model, x)]
    for x in own:
        frame = standing(data.xipos[x], data.ximat[x])
        links[f"body {x}"] = float(model.body_mass[x]), frame, np.diag(model.body_inertia[x]), frame[:3, [2, 2]].T
    rotors = [f"the actuator {model.actuator(i).name or i}" for i in some]
    for name, x, push, force in zip(rotors, sites, gear[:, :3], forces, strict=True):
        frame = standing(data.site_xpos[x], data.site_xmat[x])
        up = frame[:3, :3] @ push / np.linalg.norm(push) * (-1.0 if force < 0.0 else 1.0)
        links[name] = 0.0, frame, np.zeros((3, 3)), np.stack((up, up))
    if rotors and all(links[x][3][0, 2] < 0.3 for x in rotors):
        raise UserValueError(f"{path}: its rotors do not push along the body's z axis. Turn the body, so that they do.")
    held = []
    for i in (i for i in range(model.njnt) if model.jnt_bodyid[i] in own and model.jnt_bodyid[i] != base):
        body, axis = int(model.jnt_bodyid[i]), data.xaxis[i]
        above = [site for site, chain in zip(sites, chains, strict=False) if body in chain]
        arms = [np.cross(data.site_xpos[x] - data.xanchor[i], axis) for x in above]
        spins = model.jnt_type[i] == mujoco.mjtJoint.mjJNT_HINGE and abs(turn[:, 2] @ axis) > 0.7
        name = model.joint(i).name or f"joint {i}"
        if above and not (spins and all(np.linalg.norm(arm) < ACROSS for arm in arms)):
            why = f"the joint {shown(name)} turns rotors"
            raise UserValueError(f"{path}: {why}, and rotors here are fixed to the body. Take another drone.")
        held += [] if above else [name]
    found = one_body(links, rotors, True, held)
    if (gravity := np.linalg.norm(model.opt.gravity)) > 0.0:
        found["gravity"] = gravity, ""
    others = [x for x in range(1, model.nbody) if model.body_jntnum[x] and x not in own and model.body_rootid[x] == x]
    unread = [f"the body {model.body(x).name or x}, which moves by itself" for x in others if x not in shared]
    unread += ["drag of MuJoCo's air (density, viscosity)"] if model.opt.density or model.opt.viscosity else []
    unread += ["drag of joints (damping)"] if model.dof_damping.any() else []
    unread += ["what carries bodies (gravcomp)"] if model.body_gravcomp[own].any() else []
    left = [i for i in at_sites if i not in (*some, *turners)]
    unread += [f"the actuator {model.actuator(i).name or i}, which is no rotor" for i in left]
    if rotors:
        turning = (gear[:, :3] * gear[:, 3:]).sum(1) / np.square(gear[:, :3]).sum(1)
        rest = gear[:, 3:] - turning[:, None] * gear[:, :3]
        if (np.linalg.norm(rest, axis=1) > ACROSS * np.linalg.norm(gear[:, :3], axis=1)).any():
            raise UserValueError(f"{path}: the gear of a rotor turns across its thrust. Say by its site where it is.")
        found |= _of_motors(mujoco, model, some, ends, turning, given)
    else:
        found["rotor_positions"] = None, "no actuators push at sites, one for each rotor"
    return str(path), "MJCF of MuJoCo", found | given, unread


def _of_motors(mujoco: Any, model: Any, some: Sequence[int], ends: Array, turning: Array, given: Found) -> Found:
    """What the actuators of rotors say of motors: the ends of their forces [N], and torque per force [m]."""
    found: Found = {"rotor_spin": (None, "its actuators have no torque, or one that may turn either way")}
    if turning.all():
        found = {"rotor_spin": (np.sign(turning), "gear"), "yaw_torque_coefficient": same(abs(turning), "gear")}
    lags, times = (mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT), model.actuator_dynprm[some, 0]
    if all(mujoco.mjtDyn(x) in lags for x in model.actuator_dyntype[some]) and times.all():
        found["motor_time_constant"] = same(times, "their time constants")
    most, why = same(abs(ends).max(1) * ends.any(1).all(), "their greatest forces")  # 0 where one has no bounds
    least = abs(ends).min() if (ends.prod(1) > 0.0).all() else 0.0  # of rotors that never stand
    speed, curve = (given.get(x, (None,))[0] for x in ("rotor_speed_max", "thrust_map"))
    if most is None or not most > 0.0:
        found["thrust_map"] = None, why or "no range bounds the force of its actuators"
    elif curve is not None:
        found["rotor_speed_max"] = speed_at(most, curve), f"at {most:.4g} N, the most of its actuators"
    elif speed is not None:
        found["thrust_map"] = [most / speed**2, 0.0, 0.0], f"{most:.4g} N of its actuators at rotor_speed_max"
        curve = found["thrust_map"][0]
    else:
        found["thrust_map"] = None, f"it follows from {most:.4g} N, the most of its actuators, and rotor_speed_max"
    if least and curve is not None:
        found["rotor_speed_min"] = speed_at(least, curve), f"at {least:.4g} N, the least of its actuators"
    return found


def _ends(mujoco: Any, model: Any, i: int) -> Array:
    """The least and the greatest force [N] of an actuator, or torque per length of its gear; zeros without bounds."""
    ends, held = model.actuator_ctrlrange[i], bool(model.actuator_ctrllimited[i])
    plain = (mujoco.mjtDyn.mjDYN_NONE, mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT)
    if mujoco.mjtDyn(model.actuator_dyntype[i]) not in plain:
        ends, held = model.actuator_actrange[i], bool(model.actuator_actlimited[i])
    gain, bias = model.actuator_gainprm[i], model.actuator_biasprm[i]
    affine = model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE
    of_input = model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED and not (affine and bias[1:3].any())
    force: Array = gain[0] * ends + (bias[0] if affine else 0.0) if held and of_input else np.array([-np.inf, np.inf])
    if model.actuator_forcelimited[i]:
        force = force.clip(*model.actuator_forcerange[i])
    force = np.sort(force) * (float(np.linalg.norm(model.actuator_gear[i, :3])) or 1.0)
    return force if np.isfinite(force).all() else np.zeros(2)


def _chain(model: Any, body: int) -> list[int]:
    """A body and those above it, up to the one that stands in the world."""
    chain = [int(body)]
    while model.body_parentid[chain[-1]]:
        chain.append(int(model.body_parentid[chain[-1]]))
    return chain


def _compiled(path: Path) -> tuple[Any, Any]:
    """MuJoCo, and the model that it makes of a file, without pictures and what stands around."""
    with needing(f"{path}: MuJoCo reads its own format. Install it: pip install mujoco."):
        import mujoco
    try:
        with warnings.catch_warnings(action="ignore"):
            spec = mujoco.MjSpec.from_file(str(path))
            spec.memory, spec.compiler.fusestatic = -1, False
            at = {x.target for x in spec.actuators if x.trntype == mujoco.mjtTrn.mjTRN_SITE}
            roots, whole = spec.worldbody.bodies, spec.compiler.settotalmass > 0.0  # which all masses share
            flown = [x for x in roots if whole or any(site.name in at for site in x.find_all("site"))]
            flown = flown or [x for x in roots if x.find_all("joint")] or roots
            around = [x for root in roots if root not in flown for x in (root, *root.find_all("body"))]
            for x in (x for x in around if not x.explicitinertial):
                x.mass, x.inertia, x.explicitinertial = 1e-6, (1e-6,) * 3, True  # other parts need not be there
            for geom in spec.geoms:
                is_picture = geom.mass == 0.0 or (np.isnan(geom.mass) and geom.density == 0.0)
                is_picture = is_picture or geom.parent in (spec.worldbody, *around)
                if is_picture or (geom.parent.explicitinertial and geom.parent.compiler.inertiafromgeom != 1):
                    spec.delete(geom)  # whose files need not be there
            for x in (*spec.geoms, *spec.sites):
                x.material = ""
            meshes = [x for x in spec.meshes if x.name not in {geom.meshname for geom in spec.geoms}]
            held = (*spec.tendons, *spec.equalities, *spec.sensors, *spec.pairs, *spec.keys)
            for x in (*held, *meshes, *spec.materials, *spec.textures, *spec.hfields, *spec.skins):
                spec.delete(x)
            model = spec.compile()
    except (ValueError, RuntimeError) as error:
        raise UserValueError(f"{path}: MuJoCo does not read it: {one_line(error)}.") from None
    if not model.body_mass.any():
        raise UserValueError(f"{path}: no body of it has a mass. Give the file of the drone.")
    return mujoco, model


def _check_files(path: Path) -> None:
    """Refuse files that MuJoCo reads otherwise than we do, or that make much of little text; included ones, too."""
    if path.suffix != ".xml":
        raise UserValueError(f"{path}: MuJoCo reads files whose names end in .xml. Rename it.")
    todo, seen, parts, copies, folders = [(path, path.parent)], [path], 0, 1, set[Path]()
    while todo:
        file, home = todo.pop()  # home is the folder of the whole model that includes it
        tree, text = read_tree(file), file.read_bytes().decode("utf-8", "replace")
        if "�" in text or "\0" in text or "{#" in text:
            raise UserValueError(f"{file}: MuJoCo reads UTF-8, and no comments of Jinja. Save it so.")
        if re.search(r'[\s"\']nan[\s"\']', text, re.IGNORECASE):
            raise UserValueError(f"{file}: some of its numbers are nan. Write them.")
        counts = [x.get("count", "").strip() for x in tree.iter("replicate")]
        copies *= math.prod(min(int(x), MOST) if re.fullmatch(r"\d{1,9}", x) else MOST for x in counts)
        copies *= max(1, sum(x.tag == "attach" for x in tree.iter()))
        parts += sum(1 for _ in tree.iter())
        if copies * parts > 5 * MOST:
            raise UserValueError(f"{file}: more than {5 * MOST:,} parts, copies included. Leave one drone in it.")
        folders |= {home, *(home / x.get(k, "") for x in tree.iter("compiler") for k in ("meshdir", "assetdir"))}
        for x in tree.iter():
            sizes = [y for k, y in x.attrib.items() if x.tag == "size" and k != "memory"]
            asks = any(int(y) > MOST for y in [*sizes, x.get("nrow", ""), x.get("ncol", "")] if re.fullmatch(r"\d+", y))
            if x.tag in MANY or asks or (x.tag == "mesh" and "builtin" in x.attrib):
                raise UserValueError(f"{file}: a drone needs no such <{x.tag}>. Take it out, or write its parts out.")
            places = [folder / x.get("file", "") for folder in folders if x.tag == "mesh" and x.get("file")]
            if any(place.exists() and not place.is_file() for place in places):
                raise UserValueError(f"{file}: the mesh {shown(x.get('file'))} is no file.")
        for x in (x for x in tree.iter() if x.tag in ("include", "model")):
            name, is_model = x.get("file", ""), x.tag == "model"
            inner = next((x for x in (home / name, file.parent / name) if x.is_file()), None)
            if inner is None or inner in seen:
                why = "is not there" if inner is None else "is included twice. Name each file once"
                raise UserValueError(f"{file} includes {shown(name)}, which {why}.")
            todo.append((inner, inner.parent if is_model else home))
            seen.append(inner)
