"""Drones from files of other projects, and what is said of those that cannot become ours."""

import json
import re
from contextlib import nullcontext

import numpy as np
import pytest
import torch
from helpers import cases, refuses

from torchrl_quad import HoveringEnv, load_drone
from torchrl_quad.dynamics import import_drone
from torchrl_quad.errors import DroneWarning

MOTOR = {"timeConstantUp": 0.0125, "timeConstantDown": 0.025, "maxRotVelocity": 1000, "momentConstant": 0.02}
MOTOR |= {"motorConstant": 1e-5, "rotorDragCoefficient": 1e-4}
CORNERS = ((0.2, -0.1), (-0.2, 0.1), (0.2, 0.1), (-0.2, -0.1))
J = "<inertia><ixx>0.01</ixx><iyy>0.02</iyy><izz>0.025</izz></inertia>"


def sdf(content):
    return f"<sdf version='1.9'><model name='x'>{content}</model></sdf>"


def motors(**changes):
    """Of an SDF: of four rotors, the first of which may differ."""
    turns = ({"turningDirection": x} for x in ("ccw", "ccw", "cw", "cw"))
    said = [MOTOR | {"linkName": f"rotor_{i}", "motorNumber": i} | x for i, x in enumerate(turns)]
    said[0] |= changes
    return "".join(f"<plugin>{''.join(f'<{k}>{v}</{k}>' for k, v in x.items())}</plugin>" for x in said)


FRAME = f"<link name='base_link'><inertial><mass>1</mass>{J}</inertial></link>" + "".join(
    f"<joint name='j{i}'><pose relative_to='base_link'>{x} {y} 0.1 0 0 0</pose></joint><link name='rotor_{i}'>"
    f"<pose relative_to='j{i}'/><inertial><mass>0.25</mass></inertial></link>"
    for i, (x, y) in enumerate(CORNERS)
)
URDF = "<robot name='{}'><properties kf='1e-9' km='2e-11' thrust2weight='2' drag_coeff_xy='1e-6'/>"
URDF += "<link name='base_link'><inertial><mass value='0.4'/>"
URDF += "<inertia ixx='1e-3' ixy='{}' iyy='1e-3' izz='1.5e-3'/></inertial></link>"
for i, (x, y) in enumerate(CORNERS[k] for k in (0, 3, 1, 2)):
    URDF += f"<link name='prop{i}_link'><inertial><origin xyz='{x} {y} 0'/></inertial></link>"
URDF += "</robot>"
L2F = {"mass": 1.0, "gravity": [0, 0, 9.8], "J": np.diag([0.01, 0.01, 0.015]).tolist(), "action_limit": [0, 1]}
L2F |= {"rotor_positions": [[x, -y, 0] for x, y in CORNERS], "rotor_thrust_directions": [[0, 0, -1]] * 4}  # z is down
L2F |= {"rotor_torque_directions": [[0, 0, x] for x in (1, 1, -1, -1)], "rotor_torque_constants": [0.02] * 4}
L2F |= {"rotor_thrust_coefficients": [[0.1, 0.5, 5.0]] * 4, "rotor_time_constants_rising": [0.03] * 4}
L2F |= {"rotor_time_constants_falling": [0.06] * 4}
HEXAGON = [[0.2 * np.cos(x), 0.2 * np.sin(x), 0.0] for x in np.arange(6) * np.pi / 3]
ROTORPY = {"mass": 1.0, "Ixx": 0.01, "Iyy": 0.01, "Izz": 0.015, "rotor_directions": [1, -1] * 3}
ROTORPY |= {"rotor_pos": {f"r{i}": x for i, x in enumerate(HEXAGON)}, "tau_m": 0.02}
ROTORPY |= {"k_eta": 1e-5, "k_m": 2e-7, "k_d": 1e-4, "k_z": 2e-4}
ROTORPY |= {"rotor_speed_min": 0, "rotor_speed_max": 900, "c_Dx": 0.01, "c_Dy": 0.01, "c_Dz": 0.02}
MODELS = {"mass": 0.03, "L": 0.03, "J": np.diag([1e-5, 1e-5, 1.9e-5]).tolist(), "thrust_tau": 0.05, "thrust_max": 0.12}
MODELS |= {"rpm2thrust": [0, 0, 4e-10], "rpm2torque": [0, 0, 8e-12]}
MODELS |= {"mixing_matrix": [[-1, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]]}
TOML = "\n".join(f"[{x}]\n" + "\n".join(f"{k} = {v}" for k, v in MODELS.items()) for x in "ab")
HOVER_RPM = np.sqrt(0.03 * 9.81 / 4 / 4e-10)
CRAZYFLOW = "[cf]\n" + "\n".join(f"{k} = {v}" for k, v in MODELS.items() if k != "thrust_tau")
CRAZYFLOW += "\nrotor_dyn_coef = [10.0, 1e-4, 0.0, 2e-4]\ndrag_matrix = [[-0.02, 0, 0], [0, -0.02, 0], [0, 0, -0.03]]"
VISFLY = {"mass": 0.46, "inertia": [0.00101, 0.00153, 0.00203], "arm_length": 0.075, "kappa": 0.016, "motor_tau": 0.033}
VISFLY |= {"quad_drag_coeffs": [0.5] * 3, "linear_drag_coeffs": [0.005, 0.005, 0.00575], "motor_omega_max": 3500}
VISFLY |= {"cross_sections": [0.01, 0.01, 0.03], "thrust_map": [4.0426e-7, 2.5583e-5, -0.026215]}
VISFLY["motor_omega_min"] = 200
AGILICIOUS = {"mass": 0.75, "tbm_fr": [0.2, -0.1, 0], "tbm_bl": [-0.2, 0.1, 0], "tbm_br": [-0.2, -0.1, 0]}
AGILICIOUS |= {"tbm_fl": [0.2, 0.1, 0], "inertia": [0.0025, 0.0021, 0.0043], "motor_omega_min": 150, "motor_tau": 0.033}
AGILICIOUS |= {"motor_omega_max": 2000, "kappa": 0.022, "thrust_max": 8, "aero_coeff_1": [0.1, 0.1, 0.2]}
AGILICIOUS |= {"omega_max": [10, 10, 4]}
FLIGHTMARE = "rgb_camera: {on: yes}\n"
FLIGHTMARE += "quadrotor_dynamics: {mass: 0.73, arm_l: 0.17, thrust_map: [1.3e-6, 0, 0], kappa: 0.016, motor_tau: 0.03}"
ROTORS = {"name": "hum", "mass": 0.7, "inertia": {"xx": 0.007, "xy": 0, "xz": 0, "yy": 0.008, "yz": 0, "zz": 0.012}}
OMNI = {"rotor_angles": [0, np.pi / 2, np.pi, -np.pi / 2], "arm_lengths": [0.2] * 4, "directions": [-1, 1, -1, 1]}
OMNI |= {"force_constants": [8e-6] * 4, "moment_constants": [1.28e-7] * 4, "max_rotation_velocities": [838] * 4}
OMNI = ROTORS | {"drag_coef": 0.2, "rotor_configuration": OMNI | {"num_rotors": 4, "tau": 0.4}}
ROTOR = {"arm_length": 0.2, "rotor_force_constant": 8e-6, "rotor_moment_constant": 0.016}
TURNS = ({"angle": (np.pi / 2) * k, "direction": -((-1) ** k)} for k in (0, 2, 1, 3))
ROTORS["rotor_configuration"] = {str(k): ROTOR | x for k, x in zip((0, 2, 1, 3), TURNS, strict=True)}
PLUS = {"rotor_positions": [(0.2, 0), (0, 0.2), (-0.2, 0), (0, -0.2)], "rotor_spin": [1, -1, 1, -1]}
PLUS |= {"thrust_map": [8e-6, 0, 0], "yaw_torque_coefficient": 0.016, "inertia": [0.007, 0.008, 0.012]}
REST = {"motor_time_constant": 0.03, "linear_drag": [0.1] * 3}
SPUN = "<joint name='spin{0}' axis='0 0 1'/><geom size='0.1' mass='0.25'/><site name='s{0}'/>"
TURNED = "".join(f"<body pos='{x} {y} 0.1'>{SPUN.format(i)}</body>" for i, (x, y) in enumerate(CORNERS))
PUSH_AT = "<general site='s{}' gear='0 0 2 0 0 {}' dyntype='filter' dynprm='0.05'/>"
PUSHED = "".join(PUSH_AT.format(i, x) for i, x in enumerate((-0.04, -0.04, 0.04, 0.04)))
MJCF = f"""<mujoco><size memory='9000G'/>
<default><geom material='m'/><general ctrllimited='true' ctrlrange='0 3'/></default>
<asset><mesh file='gone.obj' name='a'/><texture name='t' type='2d' file='gone.png'/><material name='m' texture='t'/>
<hfield name='h' nrow='9' ncol='9' size='1 1 1 1'/></asset>
<worldbody><geom type='hfield' hfield='h'/><body name='gate'><geom type='mesh' mesh='a'/></body>
<body><freejoint/><geom type='mesh' mesh='a'/></body>
<body name='x' euler='0 0 90' pos='0 0 3'><freejoint/><inertial pos='0 0 0' mass='1' diaginertia='0.01 0.02 0.025'/>
<geom type='mesh' mesh='a' mass='0'/>{TURNED}</body>
<body name='load'><freejoint/><geom size='0.1' mass='0.1'/><site name='hook'/></body></worldbody>
<tendon><spatial material='m'><site site='s0'/><site site='hook'/></spatial></tendon>
<actuator>{PUSHED}<motor site='hook' gear='0 0 0 1 0 0'/></actuator></mujoco>"""
PAIRED = re.sub(r"(site='s.' gear='0 0 2 0 0) (-?)0.04'", r"\1 0'", MJCF).replace("</actuator>", "{}</actuator>")
TURNERS = "".join(f"<motor site='s{i}' gear='0 0 0 0 0 {x}' ctrlrange='0 0.12'/>" for i, x in enumerate((-1, -1, 1, 1)))
ARM = "<body name='arm' pos='0.2 0 0'><geom size='0.1' mass='0.25'/><site name='s'/></body>"
PUSH = "<actuator><motor site='s' gear='0 0 1 0 0 0.02' ctrlrange='1.5 6'/></actuator></mujoco>"
REPEATED = "<mujoco><worldbody><body><geom size='0.1' mass='1'/><replicate count='4' euler='0 0 90'>" + ARM
REPEATED += "</replicate></body></worldbody>" + PUSH
BIASED = MJCF.replace("ctrlrange='0 3'", "ctrlrange='-1 1' gainprm='1.5' biastype='affine' biasprm='1.5'")
HELD_FORCE = MJCF.replace("ctrlrange='0 3'", "ctrlrange='0 30' forcelimited='true' forcerange='0 3'")
PULLED = MJCF.replace("ctrlrange='0 3'", "ctrlrange='-3 0'").replace("gear='0 0 2", "gear='0 0 -2")
STOOD = MJCF.replace("<freejoint/><inertial", "<joint type='slide'/><joint name='b' type='ball'/><inertial")
STOOD = STOOD.replace("<body name='x'", "<body><joint axis='1 0 0'/><geom size='1' mass='7'/><body name='x'")
STOOD = STOOD.replace("</body>\n<body name='load'", "</body></body><body name='load'")
BY_GEOMS = MJCF.replace("<mujoco>", "<mujoco><compiler inertiafromgeom='true'/>")
BY_GEOMS = BY_GEOMS.replace("<geom type='mesh' mesh='a' mass='0'/>", "<geom size='0.1' mass='0.9'/>")
TILTING = "<joint name='k' type='fixed'><parent>arm</parent><child>x::rotor_0</child></joint>"
TILTING += "<joint name='tilt' type='revolute'><parent>base_link</parent><child>arm</child><axis><xyz>0 1 0</xyz>"
TILTING += "<limit><effort>1</effort></limit></axis></joint>"
HOVER, FAST = np.sqrt(9.81 * 2 / 4 / 1e-5), 2 * np.pi / 60  # of a rotor of the SDF [rad/s]; of one rpm


@cases(
    ("x.sdf", sdf(FRAME + motors()), {}, {"mass": 2.0, "inertia": [0.025, 0.065, 0.075],
     "rotor_positions": CORNERS, "rotor_spin": [-1, -1, 1, 1], "motor_time_constant": [0.0125, 0.025],
     "thrust_map": [1e-5, 0, 0], "linear_drag": [4e-4 * HOVER, 4e-4 * HOVER, 0]}),
    ("x.sdf", sdf(FRAME.replace("<inertial><mass>0.25</mass></inertial>", "") + motors()), {}, {"mass": 1.0,
     "rotor_positions": CORNERS, "inertia": [0.01, 0.02, 0.025]}),
    ("x.urdf", URDF.format("racer", 0), {"motor_time_constant": 0.05}, {
     "rotor_positions": [CORNERS[i] for i in (0, 3, 1, 2)],
     "rotor_spin": [1, -1, 1, -1], "thrust_map": [1e-9 / FAST**2, 0, 0], "yaw_torque_coefficient": 0.02,
     "rotor_speed_max": np.sqrt(2 * 0.4 * 9.81 / 4e-9) * FAST, "motor_time_constant": 0.05}),
    ("x.json", json.dumps({"dynamics": L2F}), {"linear_drag": [0.1] * 3}, {"rotor_positions": CORNERS, "gravity": 9.8,
     "rotor_spin": [-1, -1, 1, 1], "thrust_map": [5e-6, 5e-4, 0.1], "motor_time_constant": [0.03, 0.06]}),
    ("x.json", json.dumps(ROTORPY), {}, {"rotor_positions": np.array(HEXAGON)[:, :2], "rotor_spin": [1, -1] * 3,
     "yaw_torque_coefficient": 0.02, "quadratic_drag": [0.01, 0.01, 0.02],
     "linear_drag": 6 * np.sqrt(9.81 / 6e-5) * np.array([1e-4, 1e-4, 2e-4])}),
    ("x.toml", TOML, {"entry": "b", "linear_drag": [0.01] * 3}, {"rotor_spin": [-1, 1, -1, 1], "mass": 0.03,
     "rotor_positions": 0.03 * np.array([[1, -1], [-1, -1], [-1, 1], [1, 1]]),
      "yaw_torque_coefficient": 0.02, "rotor_speed_max": np.sqrt(0.12 / 4e-10) * FAST}),
    ("x.yaml", json.dumps(AGILICIOUS), {}, {"rotor_positions": [CORNERS[i] for i in (0, 1, 3, 2)],
     "rotor_spin": [-1, -1, 1, 1], "thrust_map": [2e-6, 0, 0], "max_body_rate": [10, 10, 4],
     "linear_drag": [0.1, 0.1, 0.2]}),
    ("x.yaml", json.dumps(AGILICIOUS | {"gravity": -3.7}), {}, {"gravity": 3.7}),
    ("x.yaml", FLIGHTMARE, {"linear_drag": [0.1] * 3, "rotor_speed_max": 3000}, {"rotor_spin": [1, -1, 1, -1],
     "inertia": [0.00791138, 0.00791138, 0.01230658]}),
    ("x.yaml", json.dumps(AGILICIOUS | {"aero_coeff_1": [0, 0, 0], "thrust_map": [5e-6, 0, 0]} | dict.fromkeys(
     ("linear_drag_coeff_x", "linear_drag_coeff_y", "linear_drag_coeff_z"), 0.3)), {},
     {"linear_drag": [0.3] * 3, "rotor_speed_max": np.sqrt(8 / 5e-6), "thrust_map": [5e-6, 0, 0]}),
    ("x.json", json.dumps(VISFLY), {}, {name: getattr(load_drone("visfly"), name).squeeze() for name in (
     "mass", "inertia", "rotor_spin", "thrust_map", "linear_drag", "quadratic_drag")}),
    ("x.json", json.dumps({"dynamics": {**L2F, "rotor_thrust_coefficients": [0.1, 0.5, 5.0]}}),
     {"linear_drag": [0.1] * 3}, {"thrust_map": [5e-6, 5e-4, 0.1]}),
    ("x.json", json.dumps({**L2F, "J_inv": np.diag([104, 100, 65]).tolist()}), {"linear_drag": [0.1] * 3},
     {"inertia": [1 / 104, 1 / 100, 1 / 65]}),
    ("x.yaml", json.dumps(OMNI), REST, PLUS | {"rotor_speed_max": 838,
     "unread": "Not read: drag_coef, tau of rotor_configuration"}),
    ("x.yaml", json.dumps(ROTORS), REST | {"rotor_speed_max": 838}, PLUS | {"mass": 0.7}),
    ("x.toml", CRAZYFLOW, {}, {"linear_drag": [0.02, 0.02, 0.03], "motor_time_constant": [
     1 / (10 + 2e-4 * HOVER_RPM), 1 / (4e-4 * HOVER_RPM)]}),
    ("x.json", json.dumps(ROTORPY | {"c_Dz": None}), {}, {"quadratic_drag": [0, 0, 0],
     "unread": "Not read: c_Dx, c_Dy, c_Dz"}),
    ("x.xml", MJCF, {"rotor_speed_max": 1000, "linear_drag": [0.1] * 3}, {"mass": 2, "rotor_positions": CORNERS,
     "inertia": [0.029, 0.069, 0.079], "rotor_spin": [-1, -1, 1, 1], "yaw_torque_coefficient": 0.02,
     "thrust_map": [6e-6, 0, 0], "motor_time_constant": 0.05}),
    *(("x.xml", text, {"thrust_map": [6e-6, 0, 0], "linear_drag": [0.1] * 3}, {"rotor_speed_max": 1000, "mass": 2})
      for text in (BIASED, HELD_FORCE, STOOD)),
    ("x.xml", PAIRED.format(TURNERS), {"rotor_speed_max": 1000, "linear_drag": [0.1] * 3}, {"thrust_map": [6e-6, 0, 0],
     "rotor_spin": [-1, -1, 1, 1], "yaw_torque_coefficient": 0.02}),
    ("x.xml", REPEATED, REST | {"rotor_speed_max": 1000, "rotor_spin": [1, -1, 1, -1]}, {"mass": 2,
     "rotor_positions": [(0.2, 0), (0, 0.2), (-0.2, 0), (0, -0.2)], "thrust_map": [6e-6, 0, 0],
     "rotor_speed_min": 500}),
    ("x.xml", PULLED, {"rotor_speed_max": 1000, "linear_drag": [0.1] * 3}, {"thrust_map": [6e-6, 0, 0],
     "rotor_spin": [1, 1, -1, -1]}),
    ("x.xml", BY_GEOMS, {"rotor_speed_max": 1000, "linear_drag": [0.1] * 3}, {"mass": 1.9}),
)  # fmt: skip
def test_drones_of_other_projects_become_ours_and_their_yaml_says_what_is_given(file, text, given, wanted, tmp_path):
    path, unread, wanted = tmp_path / file, wanted.get("unread", ""), {k: x for k, x in wanted.items() if k != "unread"}
    path.write_text(text)
    page = import_drone(path, **given)
    with pytest.warns(DroneWarning, match="; not read: ") if "# Not read: " in page else nullcontext():
        drone = load_drone(path, torch.float64, **given)
    for name, value in wanted.items():
        np.testing.assert_allclose(getattr(drone, name).squeeze(), np.asarray(value, float), rtol=1e-5, err_msg=name)
    written = tmp_path / "ours.yaml"
    written.write_text(page)
    for name, value in load_drone(written, torch.float64).fields().items():
        torch.testing.assert_close(value, getattr(drone, name), rtol=1e-6, atol=1e-12)
    assert page.startswith(f"# Source: {file}") and "chosen here: suggest_gains" in page
    assert all(f"{x}: " in page and "given, not in the file" in page for x in given if x != "entry")
    assert unread in page
    assert ("without a mass: rotor_0, " in page) == ("rotor_0" in text and ">0.25<" not in text)
    assert HoveringEnv(num_envs=1, drone=str(written)).nominal.mass.item() == pytest.approx(drone.mass.item())


@cases(
    ("x.sdf", sdf(FRAME),
        r"does not say rotor_spin \[1\], yaw_torque_coefficient \[m\], thrust_map .*, motor_time_constant"),
    ("x.urdf", URDF.format("cf", 0),
        r"\(URDF.*\) does not say motor_time_constant \[s\]. Give .*motor_time_constant=0.03\)"),
    ("x.urdf", URDF.format("cf", 4e-4), r"inertia \[kg m2\]: its products of inertia are not small, 0.0004 kg m2"),
    ("x.sdf", sdf(FRAME + motors(motorConstant=2e-5)), "rotors differ in motorConstant"),
    ("x.sdf", sdf(FRAME.replace(J, "") + motors()),
        "inertia .*: the link 'base_link' has a mass, and no ixx, iyy and izz"),
    ("x.sdf", sdf(FRAME + motors() + "<plugin filename='gz-sim-lift-drag'/>"), r"it has wings \(LiftDrag\)"),
    ("x.sdf", sdf("<include><placement_frame>a</placement_frame></include>"), "a placement_frame is not read"),
    ("x.sdf", sdf(FRAME.replace("'j0'/>", "'j9'/>")), "a pose names 'j9', which is no link"),
    ("x.sdf", sdf(FRAME.replace("0.1 0 0 0<", "0.1 3.141592654 0 0<") + motors()),
        r"does not say rotor_direction .*: the axis of rotor_0 does not point up.*, rotor_direction=\[\[0,0,1\],"),
    ("x.urdf", URDF.format("cf", 0).replace("'prop", "'w"), "rotor_positions .* no link is named"),
    ("x.json", json.dumps({**ROTORPY, "mass": None}),
        "mass .*, linear_drag .*: it follows from the drag of the rotors"),
    ("x.sdf", sdf(FRAME + motors(rotorDragCoefficient=1)), "linear_drag .*: rotors differ in rotorDragCoefficient"),
    ("x.sdf", sdf(FRAME.replace("base_link", "wheel_1")), "the link 'wheel_1' looks like a wheel or a wing"),
    ("x.sdf", "<sdf><world><include/></world></sdf>", "a world that includes its models"),
    ("x.sdf", sdf(FRAME + motors(linkName="gone")), "the linkName of a motor, 'gone', is that of no link"),
    ("x.urdf", "<robot><link name='{{ name }}'/></robot>", "a template of Jinja"),
    ("x.json", json.dumps(ROTORPY | {"k_eta": 1e-3}), "would lift 49.* times the weight. rotor_speed_max"),
    ("x.sdf", sdf("<include><uri>model://other</uri></include>"), "includes the model 'model://other': put it at "),
    ("x.urdf", "<!DOCTYPE x [<!ENTITY a 'b'>]><robot>&a;</robot>", "declares entities or a type"),
    ("x.sdf", sdf(FRAME.replace("0.02<", "much<")), "expected 1 number, got 'much'"),
    ("x.xml", "<svg/>", "XML with the root <svg> is no URDF or SDF .* These can be read: URDF"),
    ("x.xml", "<mujoco/>", "no body of it has a mass"),
    ("x.xml", "<mujoco><worldbody><body/></worldbody></mujoco>", "no body of it has a mass"),
    ("x.xml", "<mujoco><world/></mujoco>", "MuJoCo does not read it: .*unrecognized element"),
    ("x.xml", MJCF, r"thrust_map .* from 6 N, the most of its actuators, and rotor_speed_max, rotor_speed_m"),
    ("x.xml", MJCF.replace(" 2 0 0", " 0 0 0"), "rotor_positions .* no actuators push at sites, one for each rotor"),
    ("x.xml", MJCF.replace(" ctrllimited='true'", " ctrllimited='false'"), "thrust_map .* no range bounds the force"),
    ("x.xml", MJCF.replace("<general site='s0'", "<general ctrllimited='false' site='s0'"),
        "thrust_map .* no range bounds the force"),
    ("x.xml", MJCF.replace("name='spin0' axis='0", "name='k' axis='9"), "the joint 'k' turns rotors, and rotors"),
    ("x.xml", MJCF.replace("name='spin0'", "name='k' type='ball'"), "the joint 'k' turns rotors, and rotors"),
    ("x.xml", MJCF.replace("name='spin0'", "name='k' pos='1 0 0'"), "the joint 'k' turns rotors, and rotors"),
    ("x.xml", MJCF.replace("0 0 2 0 0", "0 0 2 1 0"), "the gear of a rotor turns across its thrust"),
    ("x.xml", MJCF.replace("0 0 2 0 0", "2 0 0 0 0"), "its rotors do not push along the body's z axis"),
    ("x.xml", PAIRED.format(TURNERS.replace("'0 0.12'", "'-0.12 0.12'")), "rotor_spin .*, or one that may turn either"),
    ("x.xml", REPEATED.replace("'4'", "'1001'"), "more than 10,000 parts, copies included. Leave one"),
    ("x.xml", MJCF.replace("</default>", "</default><plugin/>"), "a drone needs no such <plugin>"),
    ("x.xml", MJCF.replace("memory=", "nkey='300000' memory="), "a drone needs no such <size>"),
    ("x.xml", MJCF.replace("nrow='9'", "nrow='90000'"), "a drone needs no such <hfield>"),
    ("x.xml", MJCF.replace("</asset>", "<model name='d' file='x.xml'/></asset>"), "'x.xml', which is included twice"),
    ("x.xml", MJCF.replace("</asset>", "</asset>{#<plugin/>#}"), "MuJoCo reads UTF-8, and no comments of Jinja"),
    ("x.xml", MJCF.replace("ctrlrange='0 3'", "ctrlrange='0 nan'"), "some of its numbers are nan"),
    ("x.XML", MJCF, "names end in .xml. Rename it"),
    ("x.xml", "<mujoco><include file='x.xml'/></mujoco>", "includes 'x.xml', which is included twice"),
    ("x.xml", "<mujoco><include file='y.xml'/></mujoco>", "includes 'y.xml', which is not there"),
    ("x.xml", MJCF.replace("gear='0 0 0 1", "gear='0 0 1 1"), r"rotors push several drones, \['load', 'x'\]. Leave"),
    ("x.json", "5", "this file is of no kind that is known. These can be read"),
    ("x.json", "[1]", "this file is of no kind that is known. These can be read"),
    ("x.json", json.dumps({"dynamics": {**L2F, "rotor_positions": [1, 2]}}),
        r"'rotor_positions' has shape \(2,\); it must be"),
    ("x.toml", CRAZYFLOW.replace("[-1, 1, -1, 1]]", "[-2, 2, -2, 2]]"),
        "third row of mixing_matrix is .* Write the rest"),
    ("x.toml", TOML, r"choose one drone of the file, by entry='a' or another of"),
    ("x.xacro", "", "a .xacro file has to be run before its numbers can be read. Expand it first"),
    ("x.toml", "[cf2x]\nacc_coef = 1", "this file is of no kind that is known. These can be read"),
    ("x.toml", "[cf2x]\nacc_coef = 1\nrpy_coef = [1.0]",
        "a model fitted to attitude commands .* has no rotors. Give the params.toml that has them"),
    ("x.stl", "", "no drone can be read from a .stl file. These can be read"),
    ("x.yaml", "mass: 1", "has fields of our own format, which load_drone reads, and no others"),
    ("x.yaml", "{mass: 1, arm_length: 0.2, TWR_max: 5, omega_max_xy: 9}", "this file is of no kind that is known"),
    ("x.toml", "[cf]\nmass = 0.03\ngravity_vec = [0, 0, -9.81]", "drone-models.* does not say inertia"),
    ("x.usd", "", "no drone can be read from a .usd file. These can be read"),
    ("x.urdf", "<robot><xacro:include/></robot>", "a template of xacro. Expand it first: xacro FILE"),
    ("x.urdf", URDF.format("cf", 0).replace("'1e-3'", '"${j}"'), "a template of xacro"),
    ("x.sdf", "<!DOCTYPE html><html></html>", "this is a web page. Download the file itself"),
    ("x.world", "<sdf><world><include/><model name='ground'/></world></sdf>", "Give the file of the drone's own model"),
    ("x.sdf", sdf(FRAME.replace("<inertial>", "<inertial auto='true'>", 1)), "computes the inertia of the link 'base"),
    ("x.urdf", URDF.format("cf", 0).replace("<mass value='0.4'/>", "<mass>0.4</mass>"),
        "'base_link' has an inertia without a m"),
    ("x.sdf", sdf(FRAME.replace("<mass>1<", "<Mass>1<").replace("</mass>", "</Mass>", 1)),
        "'base_link' has an inertia wi"),
    ("x.sdf", sdf(FRAME.replace("izz", "jzz")), "'base_link' has a mass, and no ixx, iyy and izz"),
    ("x.sdf.jinja", "<sdf>{% if heavy %}<mass>5</mass>{% endif %}</sdf>", "a template of Jinja, with '{% if heavy"),
    ("x.urdf", URDF.format("cf", 0).replace("value='0.4'", "value='0'"), "mass .* it follows from thrust2weight"),
    ("x.json", '{"k_eta": 1, "k_eta": 2}', "not JSON that can be read: .*k_eta.* has a name twice"),
    ("x.json", json.dumps({**L2F, "J_inv": np.eye(3).tolist()}), "inertia .* J_inv is not the inverse of J"),
    ("x.yaml", json.dumps(VISFLY | {"motor_omega_min": None, "thrust_map": [4e-7, -1e-5, 0]}), "rotor_speed_min=13.8"),
    ("x.yaml", FLIGHTMARE.replace("mass:", "rotors_config: plus, mass:"), "rotor_spin .1.: rotors_config is 'plus'"),
    ("x.yaml", json.dumps(OMNI | {"rotor_configuration": OMNI["rotor_configuration"] | {"tilt_angles": [0.3] * 4}}),
        "time_constant .*rotor_direction .1.: tilt_angles do not say .*; not read: drag_coef, tau of rotor_conf"),
    ("x.yaml", "{mass: 1, inertia: [1, 1, 1], T_bm: [0, 0, 1]}", "this file is of no kind that is known"),
    ("x.sdf", sdf(FRAME + motors() + TILTING), "the joint 'tilt' turns the rotor 'rotor_0', and rotors here are fixed"),
)  # fmt: skip
def test_what_cannot_become_a_drone_is_refused_with_all_that_is_missing(file, text, message, tmp_path):
    (tmp_path / file).write_text(text)
    refuses(message, import_drone, tmp_path / file)


def test_parts_of_a_model_stand_where_its_simulator_puts_them(tmp_path, monkeypatch):
    """A payload 0.2 m below the body, which is written in several ways; frames of masses turn no rotor."""
    given = {"yaw_torque_coefficient": 0.02}
    load = "<link name='load'><pose relative_to='{}'>0 0 {} 0 0 0</pose><inertial><mass>1</mass>" + J
    load += "</inertial></link>"
    turned = FRAME.replace("<inertial><mass>0.25<", "<inertial><pose>0 0 0 0 0.2 0</pose><mass>0.25<")
    (tmp_path / "frame").mkdir()
    (tmp_path / "frame/model.sdf").write_text(sdf("<pose>0 0 0.24 0 0 0</pose>" + FRAME))
    include = "<include{}><uri>{}</uri>{}</include>"
    ways = (
        FRAME + load.format("base_link", -0.2),
        turned + load.format("__model__", -0.2),
        include.format(" merge='true'", "model://frame/", "") + load.format("base_link", -0.2),
        include.format("", "https://host/1.0/owner/models/frame/3", "<name>v</name>") + load.format("v", 0.04 - 0.24),
        include.format("", "file://frame/model.sdf", "<pose>0 0 1 0 0 0</pose>") + load.format("x::base_link", -0.2),
        f"<model name='m'><pose>0 0 3 0 0 0</pose>{FRAME}</model>" + load.format("m::base_link", -0.2),
        FRAME + "<plugin filename='gz-sim-lift-drag'><link_name>x::rotor_0</link_name></plugin>"
        "<frame name='f' attached_to='base_link'><pose degrees='true'>0.2 0.5 0 0 0 90</pose></frame>"
        + load.format("f", -0.2).replace("0 0 -0.2 0 0 0", "-0.5 0.2 -0.2 0 0 -1.5707963"),
        f"<model name='m'><pose>1 0 3 0 0 3.14159265</pose>{FRAME}</model><frame name='g' attached_to='m::base_link'/>"
        + load.format("g", -0.2),
    )
    for i, way in enumerate(ways):
        (tmp_path / f"{i}").mkdir()
        (tmp_path / f"{i}/MODEL.SDF").write_text(sdf(way + motors()))
        drone = load_drone(tmp_path / f"{i}/MODEL.SDF", torch.float64, **given)
        height = 2 * 1 / 3 * (0.2 + 0.05) ** 2  # of the other 2 kg, whose centre is 5 cm above the body
        np.testing.assert_allclose(drone.inertia, [0.035 + height, 0.085 + height, 0.1], atol=1e-6, err_msg=way)
        assert drone.rotor_direction is None
    (tmp_path / "frame/arm.xml").write_text(f"<mujoco><worldbody>{ARM}</worldbody>{PUSH}")
    arms = (f"<frame euler='0 0 {x}'><attach model='a' body='arm' prefix='{x}'/></frame>" for x in (0, 90, 180, 270))
    whole = "<asset><model name='a' file='frame/arm.xml'/></asset><worldbody><body><geom size='0.1' mass='1'/>"
    (tmp_path / "x.xml").write_text(f"<mujoco>{whole}{''.join(arms)}</body></worldbody></mujoco>")
    drone = load_drone(tmp_path / "x.xml", **REST, rotor_speed_max=1000, rotor_spin=[1, -1, 1, -1])
    np.testing.assert_allclose(drone.rotor_positions, PLUS["rotor_positions"], atol=1e-6)
    monkeypatch.chdir(tmp_path / "2")
    assert load_drone("MODEL.SDF", **given).mass.item() == 3.0


def test_rotors_are_found_by_their_names_and_axes_and_what_follows_from_a_given_mass_follows(tmp_path):
    flat = URDF.format("cf", 0).replace("'prop", "'motor")
    guards = "".join(f"<link name='prop_guard_{i}'><inertial/></link>" for i in range(4))
    turned = "".join(
        f"<joint name='j{i}' type='continuous'><parent link='base_link'/><child link='motor{i}_link'/>"
        f"<origin rpy='1.5707963 0 0'/><axis xyz='0 {-2 if i else 1} 0'/></joint>"
        for i in range(4)
    )
    guards += "<link name='rotor_0_guard'><inertial/></link>"
    guarded = flat.replace("base_link", "quad_rotor1_base").replace("</robot>", guards + "</robot>")
    (tmp_path / "x.urdf").write_text(guarded)
    wanted = load_drone(tmp_path / "x.urdf", torch.float64, motor_time_constant=0.05)
    assert "of motor0_link, motor1_link" in import_drone(tmp_path / "x.urdf", motor_time_constant=0.05)
    own = ["motor_{}/link", "x::motor_{}::link", "quadrotor/motor_{}", "quadrotor/m{}_prop"]  # as other projects write
    sides = ["front_left_prop", "front_right_prop", "back_left_prop", "back_right_prop"]
    for names in (sides, *([form.format(i) for i in range(4)] for form in own)):
        renamed = flat
        for i, name in enumerate(names):
            renamed = renamed.replace(f"motor{i}_link", name)
        (tmp_path / "z.urdf").write_text(renamed)
        named = load_drone(tmp_path / "z.urdf", torch.float64, motor_time_constant=0.05)
        torch.testing.assert_close(named.rotor_positions, wanted.rotor_positions)
    # Names of models, mounts and guards are no rotors, and what does not turn rotors does not matter.
    besides = "<link name='motor_mount_back'><inertial/></link>"
    besides += "<transmission><joint name='a'/></transmission><!-- ${x} -->"
    besides += "<joint name='world' type='floating'><parent link='w'/><child link='base_link'/></joint>"
    besides += "<joint name='arm' type='revolute'><limit lower='0' upper='0'/><parent link='base_link'/>"
    besides += "<child link='arm'/></joint>"
    besides += "<joint name='m' type='fixed'><parent link='arm'/><child link='motor0_link'/></joint>"
    (tmp_path / "z.urdf").write_text(flat.replace("</robot>", besides + "</robot>"))
    assert len(load_drone(tmp_path / "z.urdf", torch.float64, motor_time_constant=0.05).rotor_positions) == 4
    for rotor, other in (("motor_{}", "arm_motor_{}"), ("prop_{}_left", "rotor_mount_{}")):
        arms = "".join(f"<link name='{other.format(i)}'><inertial/></link>" for i in range(4))
        armed = flat.replace("</robot>", arms + "</robot>")
        for i in range(4):
            armed = armed.replace(f"motor{i}_link", rotor.format(i))
        (tmp_path / "z.urdf").write_text(armed, encoding="utf-16")
        named = load_drone(tmp_path / "z.urdf", torch.float64, motor_time_constant=0.05)
        torch.testing.assert_close(named.rotor_positions, wanted.rotor_positions)
    lying = flat.replace("<origin xyz='0.2 -0.1 0'", "<origin xyz='0.2 0 0.1'").replace("</robot>", turned + "</robot>")
    (tmp_path / "y.URDF").write_text(lying)
    upright = load_drone(tmp_path / "y.URDF", torch.float64, motor_time_constant=0.05)
    assert upright.rotor_direction is None
    heavy = load_drone(tmp_path / "x.urdf", torch.float64, motor_time_constant=0.05, mass=1.6)
    torch.testing.assert_close(heavy.linear_drag, 2.0 * wanted.linear_drag)  # rotors turn twice as fast to carry it
    torch.testing.assert_close(heavy.rotor_speed_max, 2.0 * wanted.rotor_speed_max)
    more = {"thrust_map": (4.0 * wanted.thrust_map).tolist(), "motor_time_constant": 0.05}
    strong = load_drone(tmp_path / "x.urdf", torch.float64, **more)
    torch.testing.assert_close(2.0 * strong.rotor_speed_max, wanted.rotor_speed_max)  # by the file's thrust2weight


def test_the_recipe_writes_a_drone_from_a_model_and_what_it_includes(launch, refused, tmp_path):
    include = "<include><uri>model://{}</uri></include>" + motors()
    (tmp_path / "x.sdf").write_text(sdf(include.format("frame")))
    (tmp_path / "tilted.sdf").write_text(sdf(FRAME + TILTING))
    (tmp_path / "y.sdf").write_text(sdf(include.format("tilted")))
    refuses("the joint 'tilt' turns the rotor 'rotor_0'", load_drone, tmp_path / "y.sdf")
    slowed = FRAME.replace("<inertial>", "<velocity_decay><linear>1</linear></velocity_decay><inertial>", 1)
    (tmp_path / "frame.sdf").write_text(sdf(slowed))
    path = tmp_path / "o/x.yaml"
    assert f"env.drone={path}" in launch("import_drone", tmp_path / "x.sdf", "mass=3", f"output={path}")
    assert "# Not read: velocity_decay/linear." in path.read_text() and load_drone(path).mass == 3.0
    for output, said in (("x.urdf", "its name must end in .yaml"), (path, "says something else")):
        assert said in refused("import_drone", tmp_path / "x.sdf", "mass=4", f"output={output}")
    advice = re.search(r"load_drone\(.*\)(?=, or)", refused("import_drone", tmp_path / "frame.sdf"))[0]
    with pytest.warns(DroneWarning, match="not read: velocity_decay/linear"):
        assert HoveringEnv(num_envs=1, drone=eval(advice)).nominal.mass.item() == 2.0
    (tmp_path / "x.toml").write_text(TOML)
    said = refuses("entry='b', linear_drag=", load_drone, tmp_path / "x.toml", entry="b")
    assert eval(re.search(r"load_drone\(.*\)(?=, or)", said)[0]).mass.item() == pytest.approx(0.03)
