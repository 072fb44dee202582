"""Fit simulated flights whose truth is known: how close does the fit come, and do its intervals hold the truth?

python -m benchmarks.identification            # ten flights: minutes
"""

from __future__ import annotations

import dataclasses
import math
import time

import numpy as np
import torch
from scipy.signal import savgol_filter
from tqdm import tqdm

from benchmarks.report import command_line, save
from torchrl_quad import QuadrotorParams, load_drone
from torchrl_quad.dynamics import MotorCommand, quaternion
from torchrl_quad.dynamics.control import make_controller
from torchrl_quad.dynamics.model import QuadrotorState
from torchrl_quad.dynamics.rigid_body import RigidBodyState, Rotors, accelerations, rk4
from torchrl_quad.files import read_rows
from torchrl_quad.identification import FlightLog, identify

STEP = 0.001  # [s], of the simulated truth
CONTROL = 2  # steps of the on-board controller's loop: 500 Hz
SAMPLE = 10  # steps between samples of the log: 100 Hz
NOISE = {"position": 1e-3, "attitude": 3e-3, "gyro": 2e-2, "bias": 1e-2, "voltage": 1e-2}  # m, rad, rad/s, rad/s, V


def true_drone() -> QuadrotorParams:
    """A drone like a Crazyflie that carries markers."""
    drone = load_drone("crazyflie", torch.float64).replace(
        rotor_speed_max=2270.0,
        mass=0.033,
        inertia=[1.9e-5, 2.1e-5, 3.3e-5],
        thrust_map=[2.7e-8, 0.0, 0.0],
        yaw_torque_coefficient=0.0065,
        motor_time_constant=0.045,
        linear_drag=[0.014, 0.014, 0.011],
        quadratic_drag=[0.0, 0.0, 0.0],
        drag_height=0.01,
        max_thrust_to_weight=1.7,  # which its rotors reach
    )
    return dataclasses.replace(drone, motor_command=MotorCommand(700.0, 3.7, delay=0.012))


def simulate_flight(
    seed: int, drone: QuadrotorParams | None = None, seconds: float = 20.0, stream_delay: float = 0.017
) -> FlightLog:
    """A log of a simulated flight under random velocity commands: 100 Hz, noisy, with a battery that runs down.

    The commands of a log are samples of a controller that runs at 500 Hz, and its clock is ``stream_delay`` [s] late.
    """
    drone = true_drone() if drone is None else drone
    random = np.random.default_rng(seed)
    total, motors = round(seconds / STEP), drone.motor_command
    # It believes in a lighter drone, and is so gentle that samples at 100 Hz hold what it does.
    believed = drone.replace(
        inertia=[1.4e-5, 1.4e-5, 2.17e-5],
        yaw_torque_coefficient=0.006,
        rate_gain=[16.0, 16.0, 6.0],
        rate_damping=[0.0, 0.0, 0.0],
        max_body_rate=[6.0, 6.0, 6.0],
        max_thrust_to_weight=2.0,
    )
    controller = make_controller({"mode": "velocity", "max_speed": 4.0}, believed)
    rotors = Rotors(drone)
    hover = (drone.mass * drone.gravity / (4.0 * drone.thrust_map[:1])).sqrt().expand(1, 4)
    still = ([0.0, 0.0, 2.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    state = QuadrotorState(*(torch.tensor([x], dtype=torch.float64) for x in still), hover.clone())
    lag = round(motors.delay / STEP)
    queue, rows, load = [], [], 1.0
    push = dither = torch.zeros(1, 4, dtype=torch.float64)
    for k in range(total):
        if k % 600 == 0:
            away = state.position[0].numpy() - np.array([0.0, 0.0, 2.0])
            goal = random.uniform(-2.2, 2.2, 3) * np.array([1.0, 1.0, 0.8]) - 0.5 * away
            setpoint = controller.setpoint(
                controller.encode(torch.from_numpy(np.append(goal, random.uniform(-3.0, 3.0))).unsqueeze(0))
            )
        load += STEP / 0.3 * (float((state.rotor_speed / hover).square().mean()) - load)
        voltage = 4.2 - 0.35 * k / total - 0.2 * load
        if k % CONTROL == 0:
            # Smooth noise of 0.1 s in each rotor excites all axes.
            white = torch.from_numpy(random.standard_normal((1, 4)))
            push = push + 0.04 * (60.0 * math.sqrt(4.0 / 0.04) * white - push)
            dither = dither + 0.04 * (push - dither)
            wanted = controller.command(setpoint, state, controller.rotors.wrench(state.rotor_speed)) + dither
            command = (wanted / (motors.speed_per_volt * voltage)).clamp(0.0, 1.0)
        queue.append(command)
        rows.append(torch.cat((*state[:4], command, command.new_tensor([[voltage]])), 1))
        applied = queue[max(0, k - lag)] * motors.speed_per_volt * voltage
        after = rotors.follow(state.rotor_speed, applied, STEP)
        wrench = rotors.wrench(0.5 * (state.rotor_speed + after))
        body = rk4(RigidBodyState(*state[:4]), lambda s, w=wrench: accelerations(s, w, drone), STEP)
        state = QuadrotorState(*body, after)
    return _measured(torch.cat(rows).numpy(), random, stream_delay, f"simulated_{seed}")


def _measured(table: np.ndarray, random: np.random.Generator, late: float, name: str) -> FlightLog:
    """What motion capture and the on-board log say of a flight whose states and commands stand in rows, one a STEP."""
    dt = SAMPLE * STEP
    index = np.arange(0, len(table), SAMPLE)
    onboard, table = table[np.clip(index - round(late / STEP), 0, None)], table[index]
    position = table[:, :3] + NOISE["position"] * random.standard_normal((len(table), 3))
    velocity = savgol_filter(position, 11, 3, deriv=1, delta=dt, axis=0)
    turn = torch.from_numpy(NOISE["attitude"] * random.standard_normal((len(table), 3)))
    attitude = quaternion.multiply(torch.from_numpy(table[:, 3:7]), quaternion.from_axis_angle(turn)).numpy()
    gyro = onboard[:, 10:13] + NOISE["gyro"] * random.standard_normal((len(table), 3))
    gyro += NOISE["bias"] * random.uniform(-1.0, 1.0, 3)
    voltage = onboard[:, 17] + NOISE["voltage"] * random.standard_normal(len(table))
    voltage = voltage[10 * (np.arange(len(table)) // 10)]  # at 10 Hz, held
    fields = ("angular_velocity", "acceleration", "motor_command", "battery_voltage")
    pieces = ((10, len(table) - 10),)
    time = dt * np.arange(len(table))
    command = onboard[:, 13:17]
    return FlightLog(name, time, position, attitude, velocity, gyro, None, command, voltage, None, pieces, fields, ())


def start(seed: int, truth: QuadrotorParams) -> QuadrotorParams:
    """A drone that is 30 % off, up or down, in everything that is fitted; the mass is right, and a body can have it."""
    off = np.random.default_rng(1000 + seed).choice([0.7, 1.3], 7)
    inertia = truth.inertia * torch.tensor(off[:3])
    inertia[2] = inertia[2].minimum(inertia[:2].sum())
    motors = dataclasses.replace(truth.motor_command, delay=truth.motor_command.delay * off[3])
    return dataclasses.replace(
        truth.replace(
            thrust_map=truth.thrust_map * off[4],
            inertia=inertia,
            motor_time_constant=truth.motor_time_constant * off[5],
            linear_drag=truth.linear_drag * off[6],
            yaw_torque_coefficient=truth.yaw_torque_coefficient * off[3],
            drag_height=truth.drag_height * off[1],
        ),
        motor_command=motors,
    )


def truths(drone: QuadrotorParams, stream_delay: float = 0.017) -> dict[str, float]:
    """What a fit should find, by the names of its result."""
    k2, mass = float(drone.thrust_map[0]), float(drone.mass)
    arm, inertia = drone.rotor_positions.abs().mean(0).tolist(), drone.inertia.tolist()
    return {
        "k2/m": k2 / mass,
        "motor_time_constant": float(drone.motor_time_constant),
        "arm k2/Jx": arm[1] * k2 / inertia[0],
        "arm k2/Jy": arm[0] * k2 / inertia[1],
        "kappa k2/Jz": float(drone.yaw_torque_coefficient) * k2 / inertia[2],
        "drag xy/m": float(drone.linear_drag[0]) / mass,
        "drag z/m": float(drone.linear_drag[2]) / mass,
        "command_delay": drone.motor_command.delay,
        "stream_delay": stream_delay,
        "drag_height": float(drone.drag_height),
    }


def fit(seed: int, seconds: float = 20.0) -> list[dict[str, object]]:
    """A row for each parameter of one simulated flight."""
    truth = true_drone()
    log = simulate_flight(seed, truth, seconds)
    begun, clock = time.process_time(), time.perf_counter()
    result = identify(log, start(seed, truth), {"mass": float(truth.mass)})
    took, wall = time.process_time() - begun, time.perf_counter() - clock
    found = {**result.parameters, **result.ratios, "stream_delay": result.stream_delay[log.name]}
    if "motor_time_constant.rising" in found:
        found["motor_time_constant"] = found["motor_time_constant.rising"]
    rows = []
    for name, value in truths(truth).items():
        row: dict[str, object] = {"seed": seed, "parameter": name, "truth": value}
        rows.append(row)
        if name not in found:
            row["reason"] = "not identifiable"
            continue
        x = found[name]
        row |= {key: x[key] for key in ("value", "low", "high")} | {"holds": int(x["low"] <= value <= x["high"])}
        row["bootstrap_low"], row["bootstrap_high"] = result.bootstrap.get(name, (math.nan, math.nan))
        row |= {"error": x["value"] - value, "relative": x["value"] / value - 1.0, "cpu_s": took, "wall_s": wall}
    return rows


def table(rows: list[dict[str, object]]) -> str:
    """One line for each parameter: worst and median error, how many intervals hold the truth."""
    lines = ["| parameter | median error | worst | intervals that hold the truth |", "|---|---|---|---|"]
    for name in dict.fromkeys(str(row["parameter"]) for row in rows):
        own = [row for row in rows if row["parameter"] == name and row.get("value") not in (None, "")]
        kind, scale, unit = ("error", 1e3, " ms") if name.endswith("delay") else ("relative", 1e2, " %")
        errors = [abs(float(row[kind])) * scale for row in own] or [math.nan]
        holds = sum(int(row["holds"]) for row in own)
        lines.append(f"| {name} | {np.median(errors):.2g}{unit} | {max(errors):.2g}{unit} | {holds} of {len(own)} |")
    return "\n".join(lines)


def main() -> None:
    options = command_line(__doc__, "identification.csv", seeds=list(range(10)), seconds=20.0)
    rows = [row for row in read_rows(options.output) if row["seed"] not in map(str, options.seeds)]
    for seed in tqdm(options.seeds):
        rows += fit(seed, options.seconds)
        save(options.output, rows)
    print(table(rows))


if __name__ == "__main__":
    main()
