"""What URDF and SDF say of a drone: all their links are one rigid body."""

from __future__ import annotations

import itertools
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_quad.dynamics import import_formats as formats
from torchrl_quad.dynamics import presets
from torchrl_quad.dynamics.import_formats import Array, Found, Said
from torchrl_quad.errors import UserValueError, one_line, shown

# What the name of a rotor's link says beside rotor, prop or motor, {0}: a number, or else where it is.
_NUMBERED, _PLACED = r"{0}\D{{0,20}}\d", r"\d_?{0}|(left|right|front|rear|back).*{0}|{0}.*(left|right|front|rear|back)"
_OTHER = "guard|arm|mount|adapter|hub|base|shaft", "guard"  # what a rotor is not called; the second where all are
_TURNING = ("revolute", "continuous", "prismatic", "universal", "ball", "screw")  # joints
# What links of other vehicles are called.
_OTHERS = r"(?<![a-z])(left|right|main|front|rear|back)?(wheel|wing|aileron|elevon|elevator|rudder)s?(?![a-z])"
DEPTH = 20  # of models, joints and frames within each other
# Of each link: its mass, the frame of its centre of mass, its inertia there (NaN where nothing is said), and two
# directions: of its z axis, and of the axis that it turns about.
Links = dict[str, tuple[float, Array, Array, Array]]


def read_model(root: ET.Element, path: Path, given: Found) -> tuple[str, str, Found, list[str]]:
    """Of a URDF or SDF: its path, its kind, what it says, and which of its attributes were not read."""
    links, parts = Links(), [root]  # what is read: the drone, and what it includes
    models = [root] if root.tag == "model" else [*root.iterfind("model"), *root.iterfind("world/model")]
    if root.tag == "robot":
        _add_urdf(root, links, str(path))
    elif models:
        parts = [max(models, key=lambda model: len([*model.iter("plugin"), *model.iter("include")]))]  # not the ground
        _add_sdf(parts[0], np.eye(4), path, links, parts)
    plugins = {y: None for x in parts for y in x.iter("plugin")}  # each once, in their order
    world = UserValueError(f"{path}: a world that includes its models. Give the file of the drone's own model.")
    includes = root.find("world/include") is not None
    if not models and root.tag != "robot":
        what = f"XML with the root <{one_line(root.tag)}> is no URDF or SDF with a model. {formats.READABLE}"
        raise world if includes else UserValueError(f"{path}: {what}")
    motors = [x for x in plugins if x.find("motorConstant") is not None]
    motors.sort(key=lambda x: _digits(x.findtext("motorNumber")))
    short = {_last(name): name for name in links}
    motor_links = [(x.findtext("linkName") or "").strip() for x in motors]
    rotors = [x if x in links else short.get(_last(x), "") for x in motor_links]
    plain = {x: re.sub("(quad|hexa|octo|multi)_?rotor", "", x.lower()) for x in links}
    bodies = {x: name for x, name in plain.items() if not _is_bare(links[x])}  # others may be pictures of rotors
    ways = itertools.product((bodies, plain), _OTHER, (_NUMBERED, _PLACED), ("rotor", "prop", "motor"))
    for known, other, like, word in ways:
        named = [x for x, name in known.items() if re.search(like.format(word), name) and not re.search(other, name)]
        rotors = rotors or sorted(named, key=_digits)
    if "" in rotors:
        which = shown(motor_links[rotors.index("")])
        raise UserValueError(f"{path}: the linkName of a motor, {which}, is that of no link. Name its link.")
    if includes and not rotors:  # the world's own model is the ground
        raise world
    if others := [x for x in links if re.search(_OTHERS, _last(x).lower()) and x not in rotors]:
        which = f"the link {shown(_last(others[0]))} looks like a wheel or a wing"
        raise UserValueError(f"{path}: {which}, and a drone here has rotors alone. Take a multicopter.")
    lifts = [x for x in plugins if "liftdrag" in re.sub(r"\W|_", "", x.get("filename", "").lower())]
    blades = {*map(_last, rotors)}
    if any(_last(x.findtext("link_name")) not in blades for x in lifts):
        raise UserValueError(f"{path}: it has wings (LiftDrag), and a drone here has rotors alone. Take a multicopter.")
    held = _held_joints(parts, [_last(x) for x in rotors], path)
    found = one_body(links, rotors, bool(motors), held) | given
    _add_motors(found, motors, str(path), given)
    dropped = ("velocity_decay/linear", "velocity_decay/angular", "rollingMomentCoefficient")
    unread = [x for x in dropped if any((y.text or "").strip("0. \n\t") for z in parts for y in z.iterfind(f".//{x}"))]
    if (properties := root.find("properties")) is not None and root.tag == "robot":
        values = {name: presets.parse(text.encode(), name) for name, text in properties.attrib.items()}
        said = Said(values, str(path), given)
        _add_attributes(found, said, root.get("name", ""))
        return str(path), "URDF of gym-pybullet-drones", found, [*said.unread]
    return str(path), "URDF" if root.tag == "robot" else "SDF", found, unread


def _held_joints(parts: Sequence[ET.Element], rotors: Sequence[str], path: Path) -> list[str]:
    """Refuse rotors that a joint turns against the body; the joints of other parts that move, which are read as fixed.

    A rotor spins by the first joint above it that turns about z. What is above all rotors moves the whole drone.
    """
    joints = {}
    for joint in (x for part in parts for x in part.iter("joint")):
        ends = [joint.find(name) for name in ("parent", "child")]
        parent, child = ("" if x is None else _last(x.get("link") or x.text) for x in ends)
        if parent and child:
            joints[child] = parent, joint

    def above(link: str) -> list[str]:
        chain = [link]
        while chain[-1] in joints and len(chain) <= DEPTH:
            chain.append(joints[chain[-1]][0])
        return chain

    chains = [above(rotor) for rotor in rotors]
    shared = set(chains[0]).intersection(*chains[1:]) if len(chains) > 1 else set[str]()
    for chain in chains:
        spins = False
        for link in [x for x in chain if x not in shared and x in joints and _moves(joints[x][1])]:
            joint = joints[link][1]
            said = next((x.get("xyz") or x.findtext("xyz") for x in joint.iter("axis")), "0 0 1")
            axis = _numbers(said, 3, str(path))
            if spins or (link != chain[0] and abs(axis[2]) < 0.7 * np.linalg.norm(axis)):
                why = f"the joint {shown(joint.get('name'))} turns the rotor {shown(chain[0])}"
                raise UserValueError(f"{path}: {why}, and rotors here are fixed to the body. Take another drone.")
            spins = True
    free = {link for link in joints if _moves(joints[link][1])} - {x for chain in chains for x in chain} - shared
    return [joints[link][1].get("name", link) for link in joints if link in free]


def _moves(joint: ET.Element) -> bool:
    """Whether a joint lets its link move: its type does, and no equal limits lock it."""
    limit = next(joint.iter("limit"), joint)
    ends = [limit.get(k) or limit.findtext(k) for k in ("lower", "upper")]
    low, high = (_numbers(x, 1, f"the limits of the joint {shown(joint.get('name'))}", np.nan)[0] for x in ends)
    return joint.get("type") in _TURNING and low != high


def _last(name: str | None) -> str:
    """A name without those of the models around it."""
    return re.split("/|::", (name or "").strip())[-1]


def _digits(name: str | None) -> list[int]:
    return [int(x) for x in re.findall(r"\d+", name or "")]


def read_tree(path: Path) -> ET.Element:
    """The tree of an XML file, without namespaces."""
    text = formats.read_text(path)
    text = re.sub(r"{#.*?#}", "", text[max(text.find("<?xml"), 0) :], flags=re.DOTALL)  # comments of Jinja, of Gazebo
    if chosen := re.search(r"{%-?\s*\w.*|{{.*", re.sub("<!--.*?-->", "", text, flags=re.DOTALL)):
        raise UserValueError(f"{path}: a template of Jinja, with {shown(chosen[0][:40])}. Render it first.")
    if re.match(r"\s*<(!doctype )?html", text.lower()):
        raise UserValueError(f"{path}: this is a web page. Download the file itself, which GitHub calls raw.")
    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # a few lines of which can mean billions of characters
        raise UserValueError(f"{path}: it declares entities or a type. Write the values out instead.")
    expand = UserValueError(f"{path}: a template of xacro. Expand it first: xacro FILE > NEW_FILE.urdf.")
    try:
        root = ET.fromstring(text)
    except (ET.ParseError, ValueError) as error:
        if "unbound prefix" in str(error) and "<xacro:" in text:
            raise expand from None
        raise UserValueError(f"{path}: not an XML file: {one_line(error)}.") from None
    if any("xacro" in x.tag or "${" in "".join(x.attrib.values()) for x in root.iter()):
        raise expand
    for x in root.iter():
        x.tag = x.tag.rpartition("}")[2]  # without its namespace
    return root


def _numbers(text: str | None, n: int, source: str, nothing: float = 0.0) -> Array:
    """So many numbers, or as many times what stands for nothing."""
    try:
        values = np.array((text or "").split() or [nothing] * n, float)
    except ValueError:
        values = np.empty(0)
    if len(values) != n:
        raise UserValueError(f"{source}: expected {n} number{'s' * (n > 1)}, got {shown(text)}.")
    return values


def _frame(xyz: Array, rpy: Array) -> Array:
    """Where something stands in what holds it, (4, 4): turned about x, then y, then z."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    about = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]) @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = about @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]]), xyz
    return frame


def _add_urdf(root: ET.Element, links: Links, source: str) -> None:
    def origin(element: ET.Element) -> Array:
        found = element.find("origin")
        return np.eye(4) if found is None else _frame(*(_numbers(found.get(x), 3, source) for x in ("xyz", "rpy")))

    def end(joint: ET.Element, name: str) -> str:
        return getattr(joint.find(name), "attrib", {}).get("link", "")

    joints = {end(joint, "child"): joint for joint in root.iterfind("joint")}
    for link in root.iterfind("link"):
        name, frame = link.get("name", ""), np.eye(4)
        inertial, above = next(link.iterfind("inertial"), ET.Element("inertial")), name
        for _ in range(DEPTH):  # up to the root; no further where they make a circle
            if above in joints:
                frame, above = origin(joints[above]) @ frame, end(joints[above], "parent")
        about = {x.tag: x.attrib for x in inertial}
        names = (("mass", "value"), *(("inertia", f"i{axes}") for axes in formats.AXES))
        said = (about.get(tag, {}).get(key) for tag, key in names)
        mass, inertia = _inertial(said, f"{source}: the link {shown(name)}")
        axis = joints[name].find("axis") if name in joints and joints[name].get("type") != "fixed" else None
        turns = np.array([0.0, 0.0, 1.0]) if axis is None else _numbers(axis.get("xyz"), 3, source)
        turns = frame[:3, :3] @ turns / max(np.linalg.norm(turns), 1e-9)
        turns *= -1.0 if turns[2] < 0.0 else 1.0  # a rotor may turn either way about it
        links[name] = mass, frame @ origin(inertial), inertia, np.stack((frame[:3, 2], turns))


def _add_sdf(
    model: ET.Element, outer: Array, path: Path, links: Links, parts: list[ET.Element], depth: int = 0
) -> dict[str, Array]:
    """Add the links of a model and of those within it, in the frame of the outermost, and what is included; what stands
    where."""

    def own(element: ET.Element) -> Array:
        pose = _numbers(element.findtext("pose"), 6, str(path))
        in_degrees = any(x.get("degrees") in ("true", "1") for x in element.iterfind("pose"))
        return _frame(pose[:3], np.radians(pose[3:]) if in_degrees else pose[3:])

    def standing(element: ET.Element, steps: int = 0) -> Array:
        pose, child = element.find("pose"), element.findtext("child", "").strip() if element.tag == "joint" else ""
        base = ("" if pose is None else pose.get("relative_to", "")) or element.get("attached_to", "") or child
        if base in names and steps < DEPTH:
            return standing(names[base], steps + 1) @ own(element)
        if base not in ("", "__model__", "world", *names, *inside):
            raise UserValueError(f"{path}: a pose names {shown(base)}, which is no link, joint, frame or model.")
        return inside.get(base, outer) @ own(element)

    if depth > DEPTH // 2:
        raise UserValueError(f"{path}: more than {DEPTH // 2} models lie within each other. Write it flatter.")

    names = {x.get("name", ""): x for x in model if x.tag in ("link", "joint", "frame", "model")}
    inside = dict[str, Array]()  # what the models within have
    for inner in (x for x in model if x.tag in ("model", "include")):
        file, said, place = path, inner, standing(inner)
        if inner.find("placement_frame") is not None:
            raise UserValueError(f"{path}: a placement_frame is not read. Write the pose of the model's own frame.")
        if inner.tag == "include":
            file, said = _included(path, inner.findtext("uri", ""))
            parts.append(said)
            place = place if inner.find("pose") is not None else place @ own(said)
        found = _add_sdf(said, place, file, links, parts, depth + 1)
        name = inner.findtext("name") or said.get("name", "")
        inside |= found if inner.get("merge") in ("true", "1") else {f"{name}::{k}": x for k, x in found.items()}
        inside[name] = place
    for link in model.iterfind("link"):
        inertial = next(link.iterfind("inertial"), ET.Element("inertial"))
        if inertial.get("auto") in ("true", "1"):
            why = f"Gazebo computes the inertia of the link {shown(link.get('name'))} from its shapes"
            raise UserValueError(f'{path}: {why}. Write its <mass> and <inertia>, without auto="true".')
        name, frame = link.get("name", ""), standing(link)
        said = map(inertial.findtext, ("mass", *(f"inertia/i{axes}" for axes in formats.AXES)))
        mass, inertia = _inertial(said, f"{path}: the link {shown(name)}")
        if name in links:  # of another model
            name = f"other{len(links)}::{name}"
        links[name] = mass, frame @ own(inertial), inertia, frame[:3, [2, 2]].T
    return inside | {x: standing(names[x]) for x in names if names[x].tag in ("link", "frame")}


def _inertial(said: Iterable[str | None], link: str) -> tuple[float, Array]:
    """The mass of a link, and its inertia (3, 3), in which moments that are not said are NaN, and products 0."""
    mass, *moments = (_numbers(text, 1, link, 0.0 if k > 3 else np.nan)[0] for k, text in enumerate(said))
    if np.isnan(mass) and not np.isnan(moments[:3]).all():
        raise UserValueError(f"{link} has an inertia without a mass. Write it, or take the <inertial> out.")
    return np.nan_to_num(mass), formats.symmetric(*moments)


def _is_bare(link: tuple[float, Array, Array, Array]) -> bool:
    """Whether a link says neither a mass nor an inertia."""
    return link[0] == 0.0 and bool(np.isnan(link[2].diagonal()).all())


def _included(path: Path, uri: str) -> tuple[Path, ET.Element]:
    """The file and the model that a model includes, which lie beside it."""
    name = re.sub(r"/(model\.sdf|\d+)?$", "", uri.strip()).rsplit("/", 1)[-1]
    beside = path.absolute().parent.parent / name
    places = [beside / "model.sdf", beside / f"{name}.sdf", path.parent / f"{name}.sdf"]
    file = next((x for x in places if re.fullmatch(r"(?!\.)[\w. -]+", name) and x.is_file()), None)
    if file is None or (inner := read_tree(file).find("model")) is None:
        raise UserValueError(
            f"{path} includes the model {shown(uri.strip())}: put it at {places[0]} or {places[-1]}, or take it out."
        )
    return file, inner


def one_body(links: Links, rotors: Sequence[str], by_motors: bool, held: Sequence[str]) -> Found:
    """All links as one rigid body, and where its rotors are from the centre of mass."""
    mass = sum(m for m, *_ in links.values())
    centre = sum((m * frame[:3, 3] for m, frame, *_ in links.values()), np.zeros(3)) / max(mass, 1e-9)
    whole = np.zeros((3, 3))
    for m, frame, inertia, _ in links.values():
        turn, arm = frame[:3, :3], frame[:3, 3] - centre
        whole += turn @ np.nan_to_num(inertia) @ turn.T + m * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    bare = [_last(x) for x, link in links.items() if _is_bare(link)]
    parts = ["all links together"] if sum(m > 0.0 for m, *_ in links.values()) > 1 else []
    parts += [f"as if these joints were fixed: {one_line(', '.join(held))}"] if held else []
    note = "; ".join([*parts, f"links without a mass: {one_line(', '.join(bare))}"] if bare else parts)
    found: Found = ({"mass": (mass, note)} if mass > 0.0 else {}) | formats.diagonal(whole, "; ".join(parts))
    points = [x for x, (m, _, inertia, _) in links.items() if np.isnan(inertia).any() and m > 0.2 * mass]
    if points:
        found["inertia"] = None, f"the link {shown(points[0])} has a mass, and no ixx, iyy and izz"
    if not rotors:
        why = "relative to the centre of mass; no link is named rotor, prop or motor with a number"
        return found | {"rotor_positions": (None, why)}
    places = [links[x][1][:3, 3] for x in rotors]
    same_place = [any(np.linalg.norm(x - y) < 1e-3 for y in places[:k]) for k, x in enumerate(places)]
    rotors = [x for x, again in zip(rotors, same_place, strict=True) if by_motors or not again]
    frames = np.array([links[x][1] for x in rotors]).round(12)
    up = np.array([links[x][3][0 if by_motors else 1] for x in rotors]).round(12)  # a motor pushes along the link's z
    if np.all(up[:, 2] < 0.3):  # as where a mesh was exported lying
        found["rotor_direction"] = None, f"the axis of {rotors[0]} does not point up: give a direction for each rotor"
        return found | {"rotor_positions": ((frames[:, :3, 3] - centre).round(12), f"of {', '.join(rotors)}")}
    return found | formats.placed((frames[:, :3, 3] - centre).round(12), up, note=f"of {', '.join(rotors)}")


def _add_motors(found: Found, motors: Sequence[ET.Element], source: str, given: Found) -> None:
    """What the motors of Gazebo and RotorS say."""

    def said(*names: str) -> tuple[Any, str]:
        if any(x.find(name) is None for x in motors for name in names):
            return None, ""
        each = np.array([[_numbers(x.findtext(name), 1, source)[0] for name in names] for x in motors])
        value, why = formats.same(each, names[0])
        return (value if value is None or len(set(value)) > 1 else value[0]), why

    if not motors:
        return
    turns = [(x.findtext("turningDirection") or "").strip().lower() for x in motors]
    if set(turns) <= {"cw", "ccw"}:
        found["rotor_spin"] = [1 if x == "cw" else -1 for x in turns], "against turningDirection"
    found["yaw_torque_coefficient"], found["rotor_speed_max"] = said("momentConstant"), said("maxRotVelocity")
    found["motor_time_constant"], (k2, why) = said("timeConstantUp", "timeConstantDown"), said("motorConstant")
    found["thrust_map"] = (None if k2 is None else [k2, 0.0, 0.0]), why
    found |= given
    drag, why = said("rotorDragCoefficient")
    formats.add_drag(found, drag, None)
    if why:
        found["linear_drag"] = None, why


def _add_attributes(found: Found, said: Said, name: str) -> None:
    """What gym-pybullet-drones says of a drone, of rotors in rpm."""
    force, torque, ratio = said("kf"), said("km"), said("thrust2weight")
    mass, places = (found.get(x, (None,))[0] for x in ("mass", "rotor_positions"))
    if places is not None and len(places) == 4:
        spin = np.array([1, -1, 1, -1]) if name == "racer" else np.array([-1, 1, -1, 1])
        found["rotor_spin"] = spin, "of the code of gym-pybullet-drones, not in the file"
    if force is not None and force > 0.0:
        found["thrust_map"] = [force / formats.RPM**2, 0.0, 0.0], "kf"
        found |= said.given
        if torque is not None:
            found["yaw_torque_coefficient"] = torque / force, "km per kf"
        if ratio is not None and mass and places is not None:
            most = formats.speed_at(ratio * 9.81 * mass / len(places), found["thrust_map"][0])
            found["rotor_speed_max"] = most, "of thrust2weight"
        elif ratio is not None:
            found["rotor_speed_max"] = None, "it follows from thrust2weight once mass and places are known"
        formats.add_drag(found, said("drag_coeff_xy"), said("drag_coeff_z"))
