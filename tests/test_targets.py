"""Code for a firmware compiles against its headers, as far as it uses them, and commands what the bundle does."""

import subprocess

import numpy as np
import pytest
from deploying import resting

from torchrl_quad.deploy import autopilots, frames, load_bundle
from torchrl_quad.deploy.simulators.vehicle import Drone
from torchrl_quad.deploy.targets import TARGETS, write_target

STATE = resting(position=[0.3, -0.2, 1.1], quaternion=[0.8, 0.2, -0.4, 0.4], velocity=[0.5, -0.3, 0.2])
STATE["angular_velocity"] = [0.4, -0.6, 0.3]
STUBS = {
    "crazyflie": {
        "app.h": "#pragma once\n#include <stdint.h>\n#include <stdio.h>\n#include <stdlib.h>\n#include <string.h>\n"
        "#define PARAM_GROUP_START(x)\n#define PARAM_ADD(a, b, c)\n#define PARAM_GROUP_STOP(x)\n#define M2T(x) (x)\n"
        "typedef uint32_t TickType_t; typedef int logVarId_t;\n"
        "enum { modeVelocity = 2, COMMANDER_PRIORITY_EXTRX = 3 };\n"
        "typedef struct { struct { float roll, pitch, yaw; } attitudeRate; float thrust;\n"
        "  struct { int roll, pitch, yaw; } mode; } setpoint_t;\n"
        "TickType_t xTaskGetTickCount(void); void vTaskDelay(TickType_t);\n"
        "void vTaskDelayUntil(TickType_t *, TickType_t);\n"
        "logVarId_t logGetVarId(const char *, const char *); float logGetFloat(logVarId_t);\n"
        "void commanderSetSetpoint(const setpoint_t *, int);\n",
        **{name: '#include "app.h"\n' for name in ("FreeRTOS.h", "commander.h", "log.h", "param.h", "task.h")},
        "main.c": '#include "policy_crazyflie.c"\nstatic const char *all = "x y z vx vy vz qw qx qy qz ";\n'
        "static const float values[] = {$all}; static int calls;\n"
        "TickType_t xTaskGetTickCount(void) { return 0; }\nvoid vTaskDelay(TickType_t x) { (void)x; exit(1); }\n"
        "void vTaskDelayUntil(TickType_t *t, TickType_t x) { if (x != 20) exit(2); (void)t; flies = calls++ > 0; }\n"
        "logVarId_t logGetVarId(const char *group, const char *name) { char key[9]; int i = 0; const char *at = all;\n"
        "  if (group[0] == 'g') return 10 + name[0] - 'x';\n  snprintf(key, sizeof key, \"%s \", name);\n"
        "  while (strncmp(at, key, strlen(key))) { at = strchr(at, ' ') + 1; ++i; }\n  return i; }\n"
        "float logGetFloat(logVarId_t i) { return values[i]; }\n"
        'void commanderSetSetpoint(const setpoint_t *s, int p) { printf("%g %g %g %g\\n", s->attitudeRate.roll,\n'
        "  s->attitudeRate.pitch, s->attitudeRate.yaw, s->thrust); exit(p != 3); }\nint main(void) { appMain(); }\n",
    },
    "px4": {
        "uORB/topics/vehicle_attitude.h": "struct vehicle_attitude_s { unsigned long timestamp; float q[4]; };",
        "uORB/topics/vehicle_local_position.h": "struct vehicle_local_position_s { float x, y, z, vx, vy, vz; };",
        "uORB/topics/vehicle_angular_velocity.h": "struct vehicle_angular_velocity_s { float xyz[3]; };",
        "uORB/topics/vehicle_rates_setpoint.h": "struct vehicle_rates_setpoint_s { unsigned long timestamp;\n"
        "  float roll, pitch, yaw, thrust_body[3]; bool reset_integral; };",
        "main.cpp": '#include <cstdio>\n#include "policy_px4.cpp"\nint main() {\n'
        "  pilot_t pilot; policy_px4_start(pilot);\n"
        "  vehicle_rates_setpoint_s s; const float x[] = {$all};\n"
        "  policy_px4(pilot, {x[0], x[1], x[2], x[3], x[4], x[5]}, {0, {x[6], x[7], x[8], x[9]}},\n"
        "    {{x[10], x[11], x[12]}},\n"
        '    0.5f, s); std::printf("%g %g %g %g\\n", s.roll, s.pitch, s.yaw, s.thrust_body[2]); }\n',
    },
    "betaflight": {
        "rx/rx.h": "#include <stdint.h>\ntypedef struct { int x; } rxRuntimeState_t;",
        "main.c": '#include <stdio.h>\n#include "policy_betaflight.c"\nint main(void) { const float x[] = {$all};\n'
        "  policyStart(); policyUpdate(x, x + 6, x + 3, x + 10);\n"
        '  for (int i = 0; i < 4; ++i) printf("%g ", policyReadRawRC(0, (uint8_t)i)); }\n',
    },
}


@pytest.mark.parametrize("target", TARGETS)
def test_code_for_a_firmware_compiles_and_commands_what_the_bundle_does(target, export_once, tmp_path):
    bundle = load_bundle(export_once("hovering")[2])
    (tmp_path / "policy").symlink_to(bundle.folder)
    folder, stubs = write_target(tmp_path / "policy", target), tmp_path / "stubs"
    names = ("position", "velocity", "quaternion", "angular_velocity")
    frame = {"crazyflie": frames.crazyflie, "px4": frames.px4, "betaflight": frames.betaflight}[target]()
    theirs = frame.to({name: STATE[name] for name in names})
    if frame.xyzw:
        theirs["quaternion"] = np.roll(theirs["quaternion"], 1)
    if target == "crazyflie":
        theirs["angular_velocity"] = np.degrees(theirs["angular_velocity"])
    given = ", ".join(f"{x}f" for name in names for x in theirs[name].astype(float))
    for name, text in STUBS[target].items():
        (stubs / name).parent.mkdir(parents=True, exist_ok=True)
        (stubs / name).write_text(text.replace("$all", given))
    strict = ["-O1", "-Wall", "-Wextra", "-Werror", f"-I{stubs}", f"-I{folder}"]
    subprocess.run(["gcc", "-c", *strict, folder / "policy.c", "-o", tmp_path / "policy.o"], check=True)
    main, compiler = ("main.cpp", "g++") if target == "px4" else ("main.c", "gcc")
    program = [compiler, *strict, stubs / main, tmp_path / "policy.o", "-lm", "-o", tmp_path / "fly"]
    subprocess.run(program, check=True)
    found = [float(x) for x in subprocess.run([tmp_path / "fly"], check=True, capture_output=True).stdout.split()]
    thrust, rates = bundle(STATE)
    expected = frame.to({"body_rate": rates})["body_rate"]
    drone, weight = bundle.contract["drone"], bundle.contract["output"]["thrust"]["weight"]
    full = weight / 0.5 if target == "px4" else 4 * np.polyval(drone["thrust_map"], drone["rotor_speed_max"])
    command = frame.thrust(thrust, full)
    if target == "crazyflie":
        expected = expected * (1, -1, -1)  # cflib turns both signs
    if target == "betaflight":
        nominal, stick = Drone(bundle.contract["drone"]), autopilots.stick_rate(bundle.contract)
        idle = autopilots.idle(nominal)
        throttle = frames.betaflight(min_check=autopilots.MIN_CHECK, motor_idle=idle)
        command = throttle.thrust(thrust, *autopilots.throttle(nominal, idle)[:2])
        expected = 1500 + 500 * expected / stick
        expected, command = [*expected[:2], command], expected[2]
    np.testing.assert_allclose(found, [*expected, command], rtol=2e-5, atol=2e-5 * np.abs(found).max())
