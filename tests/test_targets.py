"""Code for a firmware compiles against its headers, as far as it uses them, and commands what the bundle does."""

import subprocess

import numpy as np
import pytest
from deploying import resting
from refusals import cases, refuses
from scipy.spatial.transform import Rotation

from torchrl_quad.deploy import autopilots, frames, load_bundle
from torchrl_quad.deploy.simulators.vehicle import Drone
from torchrl_quad.deploy.targets import write_target

STATES = [
    {"position": [0.3, -0.2, 1.1], "quaternion": [0.8, 0.2, -0.4, 0.4], "velocity": [0.5, -0.3, 0.2]},
    {"position": [1.4, 0.6, 1.3], "quaternion": [-0.5, 0.1, 0.1, 0.73**0.5], "velocity": [-1.0, 0.0, -0.6]},
]
RATE, NAMES = [0.4, -0.6, 0.3], ("position", "velocity", "quaternion", "angular_velocity")
FRAMES = {"crazyflie": frames.crazyflie(), "px4": frames.px4(), "betaflight": frames.betaflight()}
OBSERVE = """
void pilot_observe(const float a[3], const float b[4], const float c[3], const float d[3], float y[POLICY_OBSERVATION])
{ (void)a, (void)b, (void)c, (void)d; for (int i = 0; i < POLICY_OBSERVATION; ++i) y[i] = x[13 + i]; }
"""
MAIN = "\nint main(int n, char **given) { for (int i = 1; i < n; ++i) x[i - 1] = (float)atof(given[i]); fly(); }\n"
STUBS = {
    "crazyflie": {
        "app.h": "#pragma once\n#include <stdint.h>\n#include <stdio.h>\n#include <stdlib.h>\n#include <string.h>\n"
        "#define PARAM_GROUP_START(x)\n#define PARAM_ADD(a, b, c)\n#define PARAM_GROUP_STOP(x)\n#define M2T(x) (x)\n"
        "typedef uint32_t TickType_t; typedef int logVarId_t;\n"
        "enum { modeAbs = 1, modeVelocity, COMMANDER_PRIORITY_EXTRX };\n"
        "typedef struct { struct { float roll, pitch, yaw; } attitude, attitudeRate; float thrust;\n"
        "  struct { float x, y, z; } velocity; struct { int x, y, z, roll, pitch, yaw; } mode; } setpoint_t;\n"
        "TickType_t xTaskGetTickCount(void); void vTaskDelay(TickType_t);\n"
        "void vTaskDelayUntil(TickType_t *, TickType_t);\n"
        "logVarId_t logGetVarId(const char *, const char *); float logGetFloat(logVarId_t);\n"
        "void commanderSetSetpoint(const setpoint_t *, int);\n",
        **{name: '#include "app.h"\n' for name in ("FreeRTOS.h", "commander.h", "log.h", "param.h", "task.h")},
        "main.c": 'static float x[99];\n#include "policy_crazyflie.c"\n'
        'static const char *all = "x y z vx vy vz qw qx qy qz "; static int calls;\n'
        "TickType_t xTaskGetTickCount(void) { return 0; }\nvoid vTaskDelay(TickType_t x) { (void)x; exit(1); }\n"
        "void vTaskDelayUntil(TickType_t *t, TickType_t x) { if (x != 20) exit(2); (void)t; flies = calls++ > 0; }\n"
        "logVarId_t logGetVarId(const char *group, const char *name) { char key[9]; int i = 0; const char *at = all;\n"
        "  if (group[0] == 'g') return 10 + name[0] - 'x';\n  snprintf(key, sizeof key, \"%s \", name);\n"
        "  while (strncmp(at, key, strlen(key))) { at = strchr(at, ' ') + 1; ++i; }\n  return i; }\n"
        "float logGetFloat(logVarId_t i) { return x[i]; }\n"
        "void commanderSetSetpoint(const setpoint_t *s, int p) {\n"
        '  printf("%g %g %g %g %g %g %g %g %g %g %d%d%d%d%d%d",'
        "  s->attitude.roll, s->attitude.pitch, s->attitude.yaw, s->attitudeRate.roll, s->attitudeRate.pitch,\n"
        "  s->attitudeRate.yaw, s->velocity.x, s->velocity.y, s->velocity.z, s->thrust, s->mode.x, s->mode.y,\n"
        "  s->mode.z, s->mode.roll, s->mode.pitch, s->mode.yaw); exit(p != 3); }\n"
        "static void fly(void) { appMain(); }\n",
    },
    "px4": {
        "messages.h": "#pragma once\n#include <cstdio>\n#include <cstdlib>\n"
        "struct vehicle_attitude_s { unsigned long timestamp; float q[4]; };\n"
        "struct vehicle_local_position_s { float x, y, z, vx, vy, vz; };\n"
        "struct vehicle_angular_velocity_s { float xyz[3]; };\n"
        "struct vehicle_rates_setpoint_s { unsigned long timestamp; float roll, pitch, yaw, thrust_body[3]; };\n"
        "struct vehicle_attitude_setpoint_s { unsigned long timestamp; float q_d[4], yaw_sp_move_rate;\n"
        "  float thrust_body[3]; };\n"
        "struct trajectory_setpoint_s { float position[3], velocity[3], acceleration[3], jerk[3], yaw, yawspeed;\n"
        "  unsigned long timestamp; };\n",
        **{
            f"uORB/topics/{name}.h": '#include "messages.h"\n'
            for name in ("vehicle_rates_setpoint", "vehicle_attitude_setpoint", "trajectory_setpoint")
            + ("vehicle_attitude", "vehicle_local_position", "vehicle_angular_velocity")
        },
        "main.cpp": 'static float x[99];\n#include "policy_px4.cpp"\n'
        "inline void show(const vehicle_rates_setpoint_s &s) {\n"
        '  printf("%g %g %g %g", s.roll, s.pitch, s.yaw, s.thrust_body[2]); }\n'
        'inline void show(const vehicle_attitude_setpoint_s &s) { for (float q : s.q_d) printf("%g ", q);\n'
        '  printf("%g %g", s.yaw_sp_move_rate, s.thrust_body[2]); }\n'
        "inline void show(const trajectory_setpoint_s &s) {\n"
        "  const float *all[] = {s.position, s.velocity, s.acceleration};\n"
        '  for (auto *v : all) printf("%g %g %g ", v[0], v[1], v[2]);\n'
        '  printf("%g %g", s.yaw, s.yawspeed); }\n'
        "template <class S> static void send(bool call(pilot_t &, const vehicle_local_position_s &,\n"
        "  const vehicle_attitude_s &, const vehicle_angular_velocity_s &, float, S &)) {\n"
        "  pilot_t pilot; S s; policy_px4_start(pilot);\n"
        "  if (!call(pilot, {x[0], x[1], x[2], x[3], x[4], x[5]}, {0, {x[6], x[7], x[8], x[9]}},\n"
        "    {{x[10], x[11], x[12]}}, 0.5f, s)) exit(1);\n  show(s); }\nstatic void fly() { send(policy_px4); }\n",
    },
    "betaflight": {
        "rx/rx.h": "#include <stdint.h>\ntypedef struct { int x; } rxRuntimeState_t;",
        "main.c": '#include <stdio.h>\n#include <stdlib.h>\nstatic float x[99];\n#include "policy_betaflight.c"\n'
        "static void fly(void) { policyStart(); policyUpdate(x, x + 6, x + 3, x + 10);\n"
        '  for (int i = 0; i < 4; ++i) printf("%g ", policyReadRawRC(0, (uint8_t)i)); }\n',
    },
}


def assert_commands_what_the_bundle_does(target, folder, bundle, stubs):
    """In flights that begin in STATES, compiled with all warnings."""
    main = "main.cpp" if target == "px4" else "main.c"
    observe = OBSERVE if "Write this function" in (folder / "pilot.h").read_text() else ""
    for name, text in STUBS[target].items():
        (stubs / name).parent.mkdir(parents=True, exist_ok=True)
        (stubs / name).write_text(text + (observe + MAIN) * (name == main))
    strict = ["-O1", "-Wall", "-Wextra", "-Werror", f"-I{stubs}", f"-I{folder}"]
    subprocess.run(["gcc", "-c", *strict, folder / "policy.c", "-o", stubs / "policy.o"], check=True)
    program = ["g++" if target == "px4" else "gcc", *strict, stubs / main, stubs / "policy.o", "-lm"]
    subprocess.run([*program, "-o", stubs / "fly"], check=True)
    for state in STATES:
        bundle.reset()
        command = np.concatenate([np.atleast_1d(x) for x in bundle(resting(**state, angular_velocity=RATE))])
        frame = FRAMES[target]
        theirs = frame.to({**state, "angular_velocity": RATE})
        if target == "crazyflie":
            theirs["quaternion"] = np.roll(theirs["quaternion"], 1)  # its log has qw first
            theirs["angular_velocity"] = np.degrees(theirs["angular_velocity"])
        given = np.concatenate([*(theirs[name] for name in NAMES), bundle.observation]).astype(str)
        found = subprocess.run([stubs / "fly", *given], check=True, capture_output=True).stdout.split()
        found, expected = np.array(found, float), wanted(target, bundle, command, state)
        np.testing.assert_allclose(found, expected, rtol=2e-5, atol=2e-5 * np.nanmax(np.abs(expected)))


def wanted(target, bundle, command, state):
    """What the stubs print for a command of the bundle."""
    control, drone = bundle.contract["output"]["control"], Drone(bundle.contract["drone"])
    frame, full = FRAMES[target], 4 * drone.thrust_limits[1]
    rates = frame.to({"body_rate": command[1:]})["body_rate"]
    if target == "betaflight":
        idle = autopilots.idle(drone)
        throttle = frames.betaflight(min_check=autopilots.MIN_CHECK, motor_idle=idle)
        roll, pitch, yaw = 1500 + 500 * rates / autopilots.stick_rate(bundle.contract)
        return [roll, pitch, throttle.thrust(command[0], *autopilots.throttle(drone, idle)[:2]), yaw]
    none, angles = [0.0, 0.0, 0.0], np.degrees(command[1:]) * (1, -1, 1)  # cflib turns the signs of pitch and yaw
    if target == "crazyflie":
        thrust = 0.0 if control == "velocity" else frame.thrust(command[0], full)
        turn = [0.0, 0.0, angles[2]]
        return {
            "rates": [*none, *angles, *none, thrust, 222],
            "attitude": [*angles[:2], 0.0, *turn, *none, thrust, 112],
            "velocity": [*none, *turn, *command[:3], thrust, 222002],
        }[control]
    thrust = frame.thrust(command[0], drone.weight / 0.5)
    if control == "velocity":
        return [*3 * [np.nan], *frame.to({"velocity": command[:3]})["velocity"], *4 * [np.nan], -command[3]]
    if control == "rates":
        return [*rates, thrust]
    heading = Rotation.from_quat(state["quaternion"], scalar_first=True).as_euler("ZYX")[0]
    turned = Rotation.from_euler("ZYX", [heading, command[2], command[1]]).as_quat(scalar_first=True)
    theirs = frame.to({"quaternion": turned})["quaternion"]
    return [*theirs * np.sign(theirs[0]), -command[3], thrust]


def test_the_recipe_writes_code_for_a_firmware_that_commands_what_the_bundle_does(train, launch, trace_once, tmp_path):
    trace_once("hovering")
    train("bptt", tmp_path, "env.max_episode_steps=48")
    printed = launch("export", f"checkpoint={tmp_path}/checkpoint.pt", "target=betaflight", "episodes=8")
    assert printed.startswith(f"{tmp_path}/policy_betaflight: for the firmware of betaflight\n")
    bundle = load_bundle(tmp_path / "policy")
    assert_commands_what_the_bundle_does("betaflight", tmp_path / "policy_betaflight", bundle, tmp_path / "stubs")


@pytest.mark.parametrize("target", ["crazyflie", "px4"])
@pytest.mark.parametrize("task", ["hovering", "landing", "racing"], ids=["rates", "attitude", "velocity"])
def test_code_for_a_firmware_commands_in_each_mode_what_the_bundle_does(task, target, export_once, tmp_path):
    (tmp_path / "policy").symlink_to(export_once(task)[2])
    folder = write_target(tmp_path / "policy", target)
    assert_commands_what_the_bundle_does(target, folder, load_bundle(tmp_path / "policy"), tmp_path / "stubs")


@cases(
    (
        "landing",
        "betaflight",
        "this firmware takes rates, and the policy commands attitude. Train it with env.control=r",
    ),
    (
        "hovering, with memory",
        "px4",
        "takes rates or attitude or velocity, and the policy commands rotor_thrusts. Train",
    ),
    (
        "forest",
        "crazyflie",
        "policies that read what a drone measures, and this one reads an image. Call policy.c from",
    ),
    ("tracking", "px4", "and this one reads commands on their way"),
    ("hovering", "ardupilot", "target must be one of crazyflie, px4, betaflight, got 'ardupilot'"),
)
def test_a_policy_that_a_firmware_cannot_follow_is_refused_with_what_to_train(task, target, said, export_once):
    refuses(said, write_target, export_once(task)[2], target)
