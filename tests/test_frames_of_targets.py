"""Conventions of autopilots and simulators: round trips, and cases worked by hand that a wrong sign fails."""

import struct

import numpy as np
import pytest
from helpers import cases, refuses
from scipy.spatial.transform import Rotation

from torchrl_quad.deploy import frames

S = np.sqrt(0.5)
# Ours for a quarter turn: roll right, nose down, turn left.
ROLL, NOSE_DOWN, LEFT = (S, S, 0, 0), (S, 0, S, 0), (S, 0, 0, S)
TARGETS = [frames.px4(), frames.px4("nwu"), frames.ardupilot(), frames.ardupilot("nwu"), frames.betaflight()]
TARGETS += [frames.betaflight(sitl=True), frames.crazyflie(), frames.crazyflie(manual=True), frames.mavros()]
TARGETS += [frames.mavros("nwu", thrust_scaling=0.05), frames.mujoco(), frames.rotorpy(), frames.crazyflow()]
each_target = pytest.mark.parametrize("target", TARGETS, ids=lambda x: x.name)


@each_target
def test_there_and_back_gives_the_same(target):
    draw = np.random.default_rng(0)
    quaternion = draw.normal(size=(2, 50, 4))
    names = ("position", "velocity", "angular_velocity", "body_rate")
    quantities = {name: draw.normal(size=(2, 50, 3)) for name in names}
    quantities["quaternion"] = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    quantities |= {"motors": draw.normal(size=(2, 50, 4))} if target.motors else {}
    theirs = target.to(quantities)
    for one, other in ((target.back(theirs), quantities), (target.to(target.back(quantities)), quantities)):
        for name, x in other.items():
            np.testing.assert_allclose(one[name], x, rtol=0, atol=1e-12, err_msg=name)
    newtons = np.linspace(0.0, 8.0, 7)
    for factor in (0.0, 0.4, 1.0):
        command = target.thrust(newtons, 10.0, factor)
        tolerance = 10.0 / 65535 if target.whole_thrust else 1e-12  # half a step, on a slope of at most 2
        np.testing.assert_allclose(target.newtons(command, 10.0, factor), newtons, rtol=0, atol=tolerance)


@each_target
def test_an_attitude_turns_vectors_as_the_target_would(target):
    """Body to world in their frames is the same arrow as in ours."""
    draw = np.random.default_rng(1)
    q, arrow = draw.normal(size=4), draw.normal(size=3)
    q /= np.linalg.norm(q)
    theirs = target.to({"quaternion": q, "angular_velocity": arrow, "velocity": turned(q, arrow)})
    quaternion = np.roll(theirs["quaternion"], 1) if target.xyzw else theirs["quaternion"]
    np.testing.assert_allclose(turned(quaternion, theirs["angular_velocity"]), theirs["velocity"], atol=1e-12)


def turned(q, v):
    return Rotation.from_quat(q, scalar_first=True).apply(v)


def assert_to(target, name, ours, theirs):
    found = target.to({name: ours})[name]
    if name == "quaternion" and np.dot(found, theirs) < 0:
        found = -found
    np.testing.assert_allclose(found, theirs, rtol=0, atol=1e-12)


@pytest.mark.parametrize("make", [frames.px4, frames.ardupilot])
def test_aerospace_frames_by_hand(make):
    enu, nwu = make("enu"), make("nwu")
    # 1 m east, 2 m north, 3 m up.
    assert_to(enu, "position", (1, 2, 3), (2, 1, -3))
    assert_to(nwu, "position", (2, -1, 3), (2, 1, -3))
    assert_to(enu, "velocity", (0, 0, -1), (0, 0, 1))  # falling is positive
    # Level, nose to the east: in NED a quarter turn to the right from north.
    assert_to(enu, "quaternion", (1, 0, 0, 0), (S, 0, 0, S))
    assert_to(enu, "quaternion", LEFT, (1, 0, 0, 0))  # then to the left: north
    assert_to(nwu, "quaternion", (1, 0, 0, 0), (1, 0, 0, 0))
    # Aerospace: roll right is +x, nose up is +y, turning right is +z.
    for ours, theirs in ((ROLL, (S, S, 0, 0)), (NOSE_DOWN, (S, 0, -S, 0)), (LEFT, (S, 0, 0, -S))):
        assert_to(nwu, "quaternion", ours, theirs)
    for name in ("angular_velocity", "body_rate"):
        assert_to(enu, name, (1, 2, 3), (1, -2, -3))


def test_body_rates_and_worlds_with_z_up_by_hand():
    """On sticks roll right, nose down and turning right are positive, in degrees; so in cflib's send_setpoint."""
    for target in (frames.betaflight(), frames.crazyflie()):
        assert_to(target, "body_rate", (np.pi, np.pi, np.pi), (180, 180, -180))
    assert_to(frames.crazyflie(manual=True), "body_rate", (0, np.pi, np.pi), (0, 180, 180))
    for target in (frames.mavros(), frames.mujoco(), frames.rotorpy(), frames.crazyflow()):
        assert_to(target, "body_rate", (1, 2, 3), (1, 2, 3))
    for target in (frames.crazyflie(), frames.mavros(), frames.rotorpy(), frames.crazyflow()):
        for ours, theirs in ((ROLL, (S, 0, 0, S)), (NOSE_DOWN, (0, S, 0, S)), (LEFT, (0, 0, S, S))):
            assert_to(target, "quaternion", ours, theirs)
            assert_to(frames.mujoco(), "quaternion", ours, ours)
        assert_to(target, "position", (1, 2, 3), (1, 2, 3))
    assert_to(frames.mavros("nwu"), "position", (2, -1, 3), (1, 2, 3))  # 1 m east, 2 m north
    assert_to(frames.mavros("nwu"), "quaternion", (1, 0, 0, 0), (0, 0, S, S))  # north is a quarter left of east


# The motors of each target by their places, as its own pages number them.
FL, BL, BR, FR = range(4)


@cases(
    ((frames.px4(), frames.ardupilot(), frames.betaflight(sitl=True)), (FR, BL, FL, BR)),
    ((frames.betaflight(),), (BR, FR, BL, FL)),
    ((frames.crazyflie(), frames.crazyflow()), (FR, BR, BL, FL)),
    ((frames.rotorpy(),), (FL, FR, BR, BL)),
)
def test_one_motor_alone_lands_at_its_place(targets, places):
    for target in targets:
        for place in (FL, BL, BR, FR):
            assert target.to({"motors": np.eye(4)[place]})["motors"].tolist() == [float(p == place) for p in places]


def test_thrust_by_hand():
    weight = 4.0
    assert frames.px4().thrust(weight, full_thrust=weight / 0.4) == pytest.approx(-0.4)  # hovers at MPC_THR_HOVER
    assert frames.px4().thrust(100.0, 10.0) == -1.0
    assert frames.ardupilot().thrust(2 * weight, full_thrust=weight / 0.4) == pytest.approx(0.8)
    # mavros sends clip(thrust_scaling x what it gets, 0, 1) to the autopilot, which hovers at 0.4 here.
    for scaling in (1.0, 0.05, 0.4 / weight):
        for newtons, share in ((weight, 0.4), (2 * weight, 0.8), (10 * weight, 1.0)):
            command = frames.mavros(thrust_scaling=scaling).thrust(newtons, full_thrust=weight / 0.4)
            assert np.clip(scaling * command, 0.0, 1.0) == pytest.approx(share)
    newtons = frames.mavros(thrust_scaling=0.4 / weight).thrust(weight, full_thrust=weight / 0.4)
    assert newtons == pytest.approx(weight)
    assert frames.betaflight().thrust(2.5, 10.0) == pytest.approx(1250.0)
    assert frames.betaflight().thrust(2.5, 10.0, model_factor=1.0) == pytest.approx(1500.0)  # thrust = signal squared
    stock = frames.betaflight(min_check=1050, motor_idle=0.055)  # half of what is left is 0.055 + 0.945 / 2
    assert stock.thrust([0.0, 5.275, 10.0], 10.0) == pytest.approx([1050.0, 1525.0, 2000.0])
    assert stock.newtons(1050, 10.0) == pytest.approx(0.55)
    refuses("min_check must lie from 750 .* 0.055 for the firmware's defaults", frames.betaflight, motor_idle=5.5)
    command = frames.crazyflie().thrust(0.2, 4 * 0.15)
    assert struct.unpack("<H", struct.pack("<H", command)) == (65535 // 3,)  # as cflib sends it
    assert frames.crazyflie().thrust([0.2, 0.6], 4 * 0.15).tolist() == [65535 // 3, 60000]
    assert frames.crazyflie_percentage([10001, 60000]).tolist() == [0.0, 100.0] and frames.mujoco().thrust(1.25) == 1.25
    assert frames.motor_thrust(0.5, 0.4) == pytest.approx(0.4 * 0.25 + 0.6 * 0.5)


@cases(
    (lambda: frames.px4("ned"), "Unknown world 'ned'"),
    (lambda: frames.px4().to({"speed": 1.0}), "Unknown quantity 'speed'. Choose from: position"),
    (lambda: frames.px4().back({"quaternion": [1, 0, 0]}), r"quaternion must have shape \(..., 4\), got \(3,\)"),
    (lambda: frames.mujoco().to({"motors": [1, 2, 3, 4]}), "MuJoCo has no order of motors"),
    (lambda: frames.mavros(thrust_scaling=0.0), "thrust_scaling must be above 0, got 0.0: .* Write its parameter"),
    (lambda: frames.px4().thrust([1.0, np.nan], 10.0), "newtons must be finite: there is no command for"),
    (lambda: frames.mujoco().thrust([1.0, np.nan], 10.0), "newtons must be finite: there is no command for"),
)
def test_what_has_no_meaning_is_refused(make, message):
    refuses(message, make)


@pytest.mark.parametrize("translate", [frames.px4().thrust, frames.px4().newtons])
def test_a_thrust_without_its_scale_is_refused(translate):
    for full_thrust in (None, 0.0, -1.0, np.nan, np.inf):
        refuses(r"full_thrust must be the thrust \[N\] of the full command of PX4", translate, 0.5, full_thrust)
    for factor in (-0.1, 1.1, np.nan):
        refuses("model_factor must lie from 0 to 1", translate, 0.5, 10.0, factor)
