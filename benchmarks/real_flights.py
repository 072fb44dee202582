"""Fit a drone to real flights, and judge it on flights of other shapes, next to what published drones predict.

python -m benchmarks.real_flights --flights FOLDER    # minutes

The last row is a small network that learns on the same flights what the fitted physics leaves out.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from tqdm import tqdm

from benchmarks.report import command_line, save
from torchrl_quad import QuadrotorParams, load_drone
from torchrl_quad.dynamics import quaternion
from torchrl_quad.dynamics.rigid_body import RigidBodyState
from torchrl_quad.identification import FlightLog, NoFlight, TooShort, identify, prediction_error, read_log
from torchrl_quad.identification.prediction import (
    CONSTANT_VELOCITY,
    ERRORS,
    PAST,
    Plant,
    Push,
    Windows,
    cut,
    differences,
    plant_of,
    states_at,
    stream_delay,
)

JUDGED = ("figure8", "trefoil")  # in the names of flights that are judged; all others are fitted
MASS = 0.027  # [kg], take-off weight, arXiv:2603.09908
HORIZONS = (0.1, 0.25, 0.5)


def old_preset() -> QuadrotorParams:
    """The preset as it was before these flights."""
    values = {
        "mass": [0.027],
        "inertia": [1.4e-5, 1.4e-5, 2.17e-5],
        "yaw_torque_coefficient": [0.00596],
        "thrust_map": [2.88e-8, 0.0, 0.0],
        "rotor_speed_max": [2270.0],
        "motor_time_constant": [0.072],
        "linear_drag": [1e-3, 1e-3, 1e-3],
        "quadratic_drag": [1e-4, 1e-4, 2e-4],
        "drag_height": [0.0],
    }
    fields = {name: torch.tensor(value, dtype=torch.float64) for name, value in values.items()}
    return QuadrotorParams(**{**load_drone("crazyflie", torch.float64).fields(), **fields})


def published() -> dict[str, QuadrotorParams]:
    """What others identified of a Crazyflie 2.x; the fields that they do not give are those of the old preset."""
    none = [0.0, 0.0, 0.0]
    rows: dict[str, dict[str, Any]] = {
        "Crazyflow L250": {"mass": 0.0328, "inertia": [1.68e-5, 1.68e-5, 2.98e-5], "quadratic_drag": none,
                           "thrust_map": [2.24e-8, -5.1e-6, 0.0], "rotor_speed_min": 120.0,
                           "yaw_torque_coefficient": 0.00735, "motor_time_constant": [0.14, 0.12],
                           "linear_drag": [0.015, 0.015, 0.0139]},
        "rl-tools": {"mass": 0.0306, "inertia": [9.4e-6, 9.4e-6, 1.75e-5], "yaw_torque_coefficient": 0.00467,
                     "motor_time_constant": [0.055, 0.249]},
        "Foerster": {"inertia": [1.66e-5, 1.66e-5, 2.93e-5]},
    }  # fmt: skip
    return {name: old_preset().replace(**changes) for name, changes in rows.items()}


class Residual(nn.Module):
    """Specific force and angular acceleration that the physics leaves out, from velocity, rates and rotor thrusts."""

    def __init__(self, plant: Plant) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(13, 32), nn.Tanh(), nn.Linear(32, 32), nn.Tanh(), nn.Linear(32, 6)).double()
        nn.init.zeros_(self.net[-1].weight)
        nn.init.zeros_(self.net[-1].bias)
        params = plant.params
        self.mass, self.inertia = params.mass, params.inertia

    def forward(self, state: RigidBodyState, wrench: Tensor) -> Push:
        """What is added at a state (W) under a wrench (W, 4)."""
        seen = quaternion.rotate_inverse(state.quaternion, state.velocity)
        turn = wrench[:, 1:] / self.inertia / 10.0
        features = (
            seen,
            state.angular_velocity,
            quaternion.up_in_body(state.quaternion),
            wrench[:, :1] / self.mass / 9.81,
        )
        out = self.net(torch.cat((*features, turn), -1))
        return Push(out[:, :3], 10.0 * out[:, 3:])


def learn(logs: list[FlightLog], drone: QuadrotorParams, steps: int) -> Residual:
    """Train the network on half a second of prediction, on top of a fitted drone."""
    torch.manual_seed(0)
    windows = cut(logs, 0.5, PAST, 0.1, step=0.02)
    late = torch.tensor([stream_delay(log) for log in logs], dtype=torch.float64)
    network = Residual(plant_of(drone, drone.motor_command, late[windows.log]))
    optimizer = torch.optim.Adam(network.parameters(), 3e-3, weight_decay=1e-5)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.05, steps)
    scale = None
    for _ in tqdm(range(steps), desc="network"):
        part = windows.select(torch.randint(len(windows), (128,)))
        error = _errors(part, plant_of(drone, drone.motor_command, late[part.log]), network)[:, [5, 12, 25]]
        scale = error.detach().abs().median(0).values.clamp_min(1e-4) * 1.5 if scale is None else scale
        loss = nn.functional.smooth_l1_loss(error / scale, torch.zeros_like(error), beta=2.0)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return network


@torch.no_grad()
def network_error(logs: list[FlightLog], drone: QuadrotorParams, network: Residual) -> dict[str, dict[float, float]]:
    """As :func:`prediction_error`, with the network."""
    windows = cut(logs, max(HORIZONS), PAST, 0.1)
    late = torch.tensor([stream_delay(log) for log in logs], dtype=torch.float64)[windows.log]
    errors = _errors(windows, plant_of(drone, drone.motor_command, late), network)
    rms = errors[:, [round(h / windows.dt) for h in HORIZONS]].square().sum(-1).mean(0).sqrt()
    return {name: dict(zip(HORIZONS, rms[:, i].tolist(), strict=True)) for i, name in enumerate(ERRORS)}


def _errors(windows: Windows, plant: Plant, network: Residual) -> Tensor:
    with torch.no_grad():
        speed = windows.rotor_speed(plant)
        push = windows.push(plant, speed)
        seen = windows.measured(plant.stream_delay, torch.arange(0, windows.future + 1, windows.stride))
    return differences(windows.fly(plant, states_at(seen, 0), speed, push, network), seen)


def read_all(folder: Path) -> dict[str, FlightLog]:
    """The flights of a folder that fly long enough, by name."""
    found = {}
    for path in sorted(folder.glob("*.csv*")):
        try:
            log = read_log(path)
            cut([log], max(HORIZONS), PAST, 0.1)
            found[log.name] = log
        except (NoFlight, TooShort) as error:
            print(f"left out: {error}")
    return found


def main() -> None:
    folders = {"flights": Path("flights"), "folder": Path("outputs/real_flights")}  # of logs, and where fits are saved
    options = command_line(__doc__, "real_flights.csv", network_steps=300, **folders)
    logs = read_all(options.flights)
    judged = [log for name, log in logs.items() if any(shape in name for shape in JUDGED)]
    fitted = [log for name, log in logs.items() if not any(shape in name for shape in JUDGED)]
    result = identify(fitted, old_preset(), {"mass": MASS}, progress=True)
    result.save(options.folder / "fitted")
    print(result)
    models = {
        "constant velocity": CONSTANT_VELOCITY,
        "preset before": old_preset(),
        **published(),
        "preset, fitted on all eight": "crazyflie",
        "fitted": result.drone,
    }
    errors = {name: prediction_error(judged, drone, HORIZONS) for name, drone in models.items()}
    if options.network_steps:
        network = learn(fitted, result.drone, options.network_steps)
        errors["fitted, and a network"] = network_error(judged, result.drone, network)
    rows = [
        {"model": name, "horizon_s": h, **{k: float(f"{found[k][h]:.4g}") for k in ERRORS}}
        for name, found in errors.items()
        for h in HORIZONS
    ]
    flights = {"fitted_on": " ".join(x.name for x in fitted), "judged_on": " ".join(x.name for x in judged)}
    save(options.output, rows, **flights)


if __name__ == "__main__":
    main()
