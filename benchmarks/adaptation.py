"""A policy that adapts to ten seconds of flight, against others, in MuJoCo with what the simulator here does not know.

    python -m benchmarks.adaptation --base outputs/base/checkpoint.pt --others random=outputs/random/checkpoint.pt

A payload of 30 % of the drone's mass hangs off its centre, a wind of 3 to 5 m/s grows with height, and a rotor gives
80 % of its thrust. Each seed draws where the payload is, where the wind blows to, and which rotor it is. Logs are
noisy. Rows that are in the table are not flown again.
"""

from __future__ import annotations

import re
import tempfile
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from benchmarks.report import command_line, save
from torchrl_quad.adaptation import Adapter
from torchrl_quad.deploy import export_policy, load_bundle
from torchrl_quad.deploy.bundle import Bundle
from torchrl_quad.deploy.judging import Judge
from torchrl_quad.deploy.simulators.mujoco import STATE, MuJoCo, model
from torchrl_quad.deploy.simulators.vehicle import Drone
from torchrl_quad.deploy.transfer import Mutant, _fly
from torchrl_quad.dynamics import MotorCommand
from torchrl_quad.files import read_rows
from torchrl_quad.identification import FlightLog
from torchrl_quad.render.canvas import BLUE, INK, make_figure
from torchrl_quad.render.canvas import save as write_picture
from torchrl_quad.training.building import build_env
from torchrl_quad.training.evaluation import load_policy

FLIGHTS, EPISODES, LOGGED = 2, 16, 5  # that the policy learns from; that judge; physics steps between samples of a log
NOISE = {"position": 1e-3, "quaternion": 2e-3, "velocity": 0.01, "angular_velocity": 0.02}  # SI units, of each sample


class Changed(MuJoCo):
    """MuJoCo with a payload, wind, and a weak rotor, as a seed draws them."""

    def __init__(self, contract: Any, seed: int) -> None:
        super().__init__(contract, "contract", (0, 1, 2, 3))
        random, drone = np.random.default_rng(seed), self.drone
        around, towards = random.uniform(-np.pi, np.pi, 2)
        arm, payload = np.linalg.norm(drone.rotor_positions[0, :2]), 0.3 * drone.mass
        place = arm * np.array([0.3 * np.cos(around), 0.3 * np.sin(around), -0.2])
        wind = random.uniform(3.0, 5.0) * np.array([np.cos(towards), np.sin(towards), 0.0])
        mass = drone.mass + payload
        centre = payload / mass * place
        j = np.diag(drone.inertia) + _point(drone.mass, centre) + _point(payload, place - centre)
        whole = " ".join(map(str, (j[0, 0], j[1, 1], j[2, 2], j[0, 1], j[0, 2], j[1, 2])))
        body = f'<inertial pos="{" ".join(map(str, centre))}" mass="{mass}" fullinertia="{whole}"/>'
        self.model = mujoco.MjModel.from_xml_string(re.sub("<inertial .*/>", body, model(drone, self.dt)))
        self.model.actuator_gear[len(drone.rotor_spin) + random.integers(4)] *= 0.8
        self.data, self.samples, loop, still = mujoco.MjData(self.model), [], self.control.loop, drone.drag

        def recorded(*asked: Any) -> Any:
            command = np.clip(loop(*asked), drone.rotor_speed_min, drone.rotor_speed_max)
            self.samples.append(np.concatenate((self.x[0], command[0])))
            return command

        def blown(quaternion: Any, velocity: Any) -> Any:  # the wind at 1.5 m, and a fifth of it more with each metre
            height = self.x[:, STATE["position"]][:, 2:]
            return still(quaternion, velocity - wind * np.clip(0.7 + 0.2 * height, 0.0, 2.0))

        recorded.keep, recorded.drone = loop.keep, drone
        self.control.loop, drone.drag = recorded, blown

    def log(self, seed: int) -> FlightLog:
        """The flight of the first drone, as its sensors measured it."""
        random, rows = np.random.default_rng(seed), np.array(self.samples)
        n = len(rows) // LOGGED * LOGGED
        command = rows[:n, -4:].reshape(-1, LOGGED, 4).mean(1) / self.drone.rotor_speed_max
        rows = rows[LOGGED // 2 : n : LOGGED]
        seen = {name: rows[:, STATE[name]] for name in NOISE}
        seen = {name: x + random.normal(0.0, NOISE[name], x.shape) for name, x in seen.items()}
        seen["quaternion"] /= np.linalg.norm(seen["quaternion"], axis=1, keepdims=True)
        none = dict.fromkeys(("acceleration", "battery_voltage", "setpoint"))
        time = LOGGED * self.dt * np.arange(len(rows))
        whole = ((0, len(rows)),)
        return FlightLog(
            f"flight{seed}", time=time, motor_command=command, segments=whole, onboard=(), notes=(), **seen, **none
        )


def _point(mass: float, place: Any) -> Any:
    """The inertia (3, 3) [kg m2] of a mass at a place."""
    return mass * (place @ place * np.eye(3) - np.outer(place, place))


class Integral(Bundle):
    """A policy that sees its position shifted by the integral of its error: 1/s, at most a metre."""

    gain = 0.6

    def reset(self, **entries: Any) -> None:
        super().reset(**entries)
        self.sum = np.zeros(3)

    def __call__(self, state: Any) -> Any:
        error = np.asarray(state["position"]) - self._progress["target"][0]
        self.sum = np.clip(self.sum + self.gain * self.contract["control_dt"] * error, -1.0, 1.0)
        return super().__call__({**state, "position": np.asarray(state["position"]) + self.sum})


def fly(bundle: Bundle, seed: int, first: int, count: int) -> tuple[dict[str, Any], Changed]:
    """Some of a bundle's starts, flown to their end, and the world in which they were."""
    starts = {name: x[first : first + count] for name, x in bundle.starts().items()}
    world = Changed(bundle.contract, seed)
    return _fly(bundle, world, Judge(bundle, starts), starts, bundle.contract["action_delay"], Mutant("none")), world


def row(name: str, bundle: Bundle, seed: int, **more: Any) -> dict[str, Any]:
    """How a policy hovers: the distance from the target over the last second [cm], a mean over episodes."""
    metrics = fly(bundle, seed, 8, EPISODES)[0]["metrics"]
    error = 100.0 * float(np.mean(metrics["position_error"]))
    found = {"error_cm": f"{error:.2f}", "solved": metrics["solved"].mean(), "crash": metrics["crash"].mean()}
    return {"policy": name, "seed": seed, **found, **more}


def draw(rows: list[dict[str, Any]], path: str) -> None:
    """The errors of all policies, a dot for each seed, and their means."""
    figure = make_figure(figsize=(6.0, 2.6), layout="constrained")
    axes = figure.subplots()
    for k, name in enumerate(names := ["base", "integral", "random", "adapted"]):
        errors = [float(row["error_cm"]) for row in rows if row["policy"] == name]
        axes.semilogy([k] * len(errors), errors, "o", color=BLUE, alpha=0.5)
        axes.semilogy([k - 0.2, k + 0.2], [np.mean(errors)] * 2, color=INK)
    axes.set_xticks(range(4), names)
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_ylabel("error of hovering [cm]")
    write_picture(figure, path, dpi=110)


def main() -> None:
    options = command_line(__doc__, "adaptation.csv", base="", others=[""], seeds=[0, 1, 2], picture="")
    rows: list[dict[str, Any]] = [*read_rows(options.output)]
    done = {(x["policy"], int(x["seed"])) for x in rows}
    about = {"flights": FLIGHTS, "episodes": EPISODES}
    with tempfile.TemporaryDirectory() as folder:
        policies = dict(x.split("=", 1) for x in options.others if x) | {"base": options.base}
        bundles, loaded = {}, {}
        for name, path in policies.items():
            cfg, actor, normalizer = load_policy(Path(path))
            loaded[name] = actor, build_env(cfg, 32, 2_000_000, normalizer=normalizer)
            bundles[name] = load_bundle(export_policy(*loaded[name], Path(folder) / name), on_fault="hover")
        bundles["integral"] = Integral(bundles["base"].folder, "hover")
        actor, env = loaded["base"]
        env.compile()
        motors = MotorCommand(float(Drone(bundles["base"].contract["drone"]).rotor_speed_max), 1.0)
        adapter = Adapter(actor, env, motors)
        print(f"compiled in {adapter.warm_up():.0f} s")
        for seed in options.seeds:
            for name, bundle in bundles.items():
                if (name, seed) not in done:
                    rows.append(row(name, bundle, seed))
                    save(options.output, rows, **about)
            if ("adapted", seed) in done:
                continue
            adapter.policy = actor
            logs = [fly(bundles["base"], seed, k, 1)[1].log(k) for k in range(FLIGHTS)]
            found = adapter(logs)
            print(found.reason)
            adapted = load_bundle(export_policy(found.policy, env, Path(folder) / f"adapted{seed}"), on_fault="hover")
            seconds = {f"seconds_{name}": f"{x:.2f}" for name, x in found.seconds.items()}
            rows.append(row("adapted", adapted, seed, kl=f"{found.kl:.2f}", changed=found.changed, **seconds))
            save(options.output, rows, **about)
    if options.picture:
        draw(rows, options.picture)


if __name__ == "__main__":
    main()
