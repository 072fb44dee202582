"""Code for a firmware compiles against its headers and commands what the bundle does; the conventions of targets."""

import re
import struct
import subprocess

import numpy as np
import pytest
from deploying import resting
from helpers import cases, refuses
from scipy.spatial.transform import Rotation

from torchrl_quad.deploy import autopilots, frames, load_bundle
from torchrl_quad.deploy.simulators.vehicle import Drone
from torchrl_quad.deploy.targets import write_target

STATES = [
    {"position": [0.3, -0.2, 1.1], "quaternion": [0.8, 0.2, -0.4, 0.4], "velocity": [0.5, -0.3, 0.2]},
    {"position": [1.4, 0.6, 1.3], "quaternion": [-0.5, 0.1, 0.1, 0.73**0.5], "velocity": [-1.0, 0.0, -0.6]},
]
RATE, NAMES = {"angular_velocity": [0.4, -0.6, 0.3]}, ("position", "velocity", "quaternion", "angular_velocity")
FRAMES = {"crazyflie": frames.crazyflie(), "px4": frames.px4(), "betaflight": frames.betaflight()}
FLAGS = "-O1 -Wall -Wextra -Werror -include stdint.h -include stdio.h -include stdlib.h -include string.h "
FLAGS += "-DPARAM_GROUP_START(x)= -DPARAM_ADD(a,b,c)= -DPARAM_GROUP_STOP(x)= -DM2T(x)=x"
MAIN = """
int main(int n, char **given) { for (int i = 1; i < n; ++i) x[i - 1] = (float)atof(given[i]);
  fly(); for (int i = 0; i < count; ++i) printf("%g ", said[i]); }
"""
OBSERVE = """
void pilot_observe(const float a[3], const float b[4], const float c[3], const float d[3], float y[POLICY_OBSERVATION])
{ (void)a, (void)b, (void)c, (void)d; memcpy(y, x + 13, POLICY_OBSERVATION * sizeof *y); }
"""
STUBS = {  # what its headers declare, then what calls the code
    "crazyflie": """#include <setjmp.h>
typedef uint32_t TickType_t; typedef int logVarId_t; enum { modeAbs = 1, modeVelocity, COMMANDER_PRIORITY_EXTRX };
typedef struct { struct { float roll, pitch, yaw; } attitude, attitudeRate; struct { float x, y, z; } velocity;
  float thrust; struct { float x, y, z, roll, pitch, yaw; } mode; } setpoint_t;
static jmp_buf end; static const char *all = "x y z vx vy vz qw qx qy qz "; static int calls; static uint8_t flies;
static TickType_t xTaskGetTickCount(void) { return 0; }
static void vTaskDelay(TickType_t x) { (void)x; exit(1); }
static void vTaskDelayUntil(TickType_t *t, TickType_t x) { if (x != 20) exit(2); (void)t; flies = calls++ > 0; }
static logVarId_t logGetVarId(const char *group, const char *name) {
  char key[9]; snprintf(key, sizeof key, "%s ", name); int i = 0;
  for (const char *at = all; strncmp(at, key, strlen(key)); at = strchr(at, ' ') + 1) ++i;
  return group[0] == 'g' ? 10 + i : i; }
static float logGetFloat(logVarId_t i) { return x[i]; }
static void commanderSetSetpoint(const setpoint_t *s, int p) { memcpy(said, s, sizeof *s); longjmp(end, p); }
@
static void fly(void) { count = 16; if (!setjmp(end)) appMain(); }""",
    "px4": """
struct vehicle_attitude_s { unsigned long timestamp; float q[4]; };
struct vehicle_local_position_s { float x, y, z, vx, vy, vz; };
struct vehicle_angular_velocity_s { float xyz[3]; };
struct vehicle_rates_setpoint_s { float roll, pitch, yaw, thrust_body[3]; int timestamp; };
struct vehicle_attitude_setpoint_s { float q_d[4], yaw_sp_move_rate, thrust_body[3]; int timestamp; };
struct trajectory_setpoint_s { float position[3], velocity[3], acceleration[3], jerk[3], yaw, yawspeed; int timestamp;};
@
template <class S> static void send(bool call(pilot_t &, const vehicle_local_position_s &, const vehicle_attitude_s &,
                                              const vehicle_angular_velocity_s &, float, S &)) {
  pilot_t pilot; S s; policy_px4_start(pilot); count = sizeof s / sizeof(float) - 1;
  const vehicle_local_position_s at = {x[0], x[1], x[2], x[3], x[4], x[5]};
  if (!call(pilot, at, {0, {x[6], x[7], x[8], x[9]}}, {{x[10], x[11], x[12]}}, 0.5f, s)) exit(1);
  memcpy(said, &s, count * sizeof(float)); }
static void fly() { send(policy_px4); }""",
    "betaflight": """
typedef struct { int x; } rxRuntimeState_t;
@
static void fly(void) { policyStart(); policyUpdate(x, x + 6, x + 3, x + 10);
  for (count = 0; count < 4; ++count) said[count] = policyReadRawRC(0, (uint8_t)count); }""",
}


def assert_commands_what_the_bundle_does(target, folder, bundle):
    """In the first step of a flight from each of STATES, compiled with all warnings."""
    name, stubs = next(x.name for x in folder.glob("policy_*.c*")), folder.with_suffix(".stubs")
    before, after = STUBS[target].split("@")
    observe = OBSERVE if "Write this function" in (folder / "pilot.h").read_text() else ""
    data, own = "static float x[99], said[20]; static int count;", (folder / name).read_text()
    for header in set(re.findall(r'#include ["<](.+[.]h)', own)) - {"math.h", "pilot.h"}:
        (stubs / header).parent.mkdir(parents=True, exist_ok=True)
        (stubs / header).touch()
    (stubs / name).write_text("\n".join((data, before, own, observe, after, MAIN)))
    command = [{"px4": "g++"}.get(target, "gcc"), *FLAGS.split(), f"-I{stubs}", f"-I{folder}"]
    subprocess.run(["gcc", "-c", *command[1:], folder / "policy.c", "-o", stubs / "policy.o"], check=True)
    subprocess.run([*command, stubs / name, stubs / "policy.o", "-lm", "-o", stubs / "fly"], check=True)
    for state in STATES:
        bundle.reset()
        command = np.concatenate([np.atleast_1d(x) for x in bundle(resting(**state, **RATE))])
        theirs = FRAMES[target].to(state | RATE)
        if target == "crazyflie":
            theirs["quaternion"] = np.roll(theirs["quaternion"], 1)  # its log has qw first
            theirs["angular_velocity"] = np.degrees(theirs["angular_velocity"])
        given = np.concatenate([*(theirs[name] for name in NAMES), bundle.observation]).astype(str)
        found = subprocess.run([stubs / "fly", *given], check=True, capture_output=True).stdout.split()
        expected = np.concatenate(wanted(target, bundle.contract, command, state), None)
        np.testing.assert_allclose(np.array(found, float), expected, rtol=2e-5, atol=2e-5 * np.nanmax(abs(expected)))


def wanted(target, contract, command, state):
    """What a firmware is told to follow a command of the bundle: all numbers of its setpoint."""
    control, drone, frame = contract["output"]["control"], Drone(contract["drone"]), FRAMES[target]
    rates, none, unset = frame.to({"body_rate": command[1:]})["body_rate"], np.zeros(3), np.full(3, np.nan)
    if target == "betaflight":
        idle, stick = autopilots.idle(drone), 1500 + 500 * rates / autopilots.stick_rate(contract)
        throttle = frames.betaflight(min_check=autopilots.MIN_CHECK, motor_idle=idle)
        return stick[:2], throttle.thrust(command[0], *autopilots.throttle(drone, idle)[:2]), stick[2]
    if target == "crazyflie":
        thrust, turn = frame.thrust(command[0], 4 * drone.thrust_limits[1]), np.degrees(command[1:]) * (1, -1, 1)
        return {
            "rates": (none, turn, none, thrust, none, [2, 2, 2]),
            "attitude": (turn[:2], none, turn[2], none, thrust, none, [1, 1, 2]),
            "velocity": (none, 0, 0, turn[2], command[:3], 0, [2, 2, 2, 0, 0, 2]),
        }[control]
    thrust = 0, 0, frame.thrust(command[0], drone.weight / 0.5)
    heading = Rotation.from_quat(state["quaternion"], scalar_first=True).as_euler("ZYX")[0]
    turned = Rotation.from_euler("ZYX", [heading, command[2], command[1]]).as_quat(scalar_first=True)
    turned, velocity = frame.to({"quaternion": turned})["quaternion"], frame.to({"velocity": command[:3]})["velocity"]
    return {
        "rates": (rates, thrust),
        "attitude": (turned * np.sign(turned[0]), -command[3], thrust),
        "velocity": (unset, velocity, unset, none, np.nan, -command[3]),
    }[control]


def test_the_recipe_writes_code_for_a_firmware_that_commands_what_the_bundle_does(train, launch, trace_once, tmp_path):
    trace_once("hovering")
    train("bptt", tmp_path, "env.max_episode_steps=48")
    printed = launch("export", f"checkpoint={tmp_path}/checkpoint.pt", "target=betaflight", "episodes=8")
    assert printed.startswith(f"{tmp_path}/policy_betaflight: for the firmware of betaflight\n")
    bundle = load_bundle(tmp_path / "policy")
    assert_commands_what_the_bundle_does("betaflight", tmp_path / "policy_betaflight", bundle)


@pytest.mark.parametrize("target", ["crazyflie", "px4"])
@pytest.mark.parametrize("task", ["hovering", "landing", "racing"], ids=["rates", "attitude", "velocity"])
def test_code_for_a_firmware_commands_in_each_mode_what_the_bundle_does(task, target, export_once, tmp_path):
    (tmp_path / "policy").symlink_to(export_once(task)[2])
    folder = write_target(tmp_path / "policy", target)
    assert_commands_what_the_bundle_does(target, folder, load_bundle(tmp_path / "policy"))


@cases(
    ("landing", "betaflight", "commands rates from what a drone measures; this policy commands attitude. Train it"),
    ("hovering, with memory", "px4", "rates or attitude .* commands rotor_thrusts. Train it with env.control=rates,"),
    ("tracking", "crazyflie", "Train it with env.observe_last_action=false, or call policy.c from code of your own"),
    ("hovering", "ardupilot", "target must be one of crazyflie, px4, betaflight, got 'ardupilot'"),
)
def test_a_policy_that_a_firmware_cannot_follow_is_refused_with_what_to_train(task, target, said, export_once):
    refuses(said, write_target, export_once(task)[2], target)


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
