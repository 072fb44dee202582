"""Describe an environment as a contract: what its policy reads and writes, the drone, and the task beside it."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_quad.deploy.simulators.vehicle import bandwidth, damping_ratio
from torchrl_quad.dynamics import DYNAMICS, QuadrotorParams
from torchrl_quad.envs import ForestEnv, HoveringEnv, LandingEnv, QuadrotorEnv, RacingEnv, TrackingEnv
from torchrl_quad.envs.disturbances import DroneRandomization, Sensors, Wind
from torchrl_quad.envs.metrics import describe_metric
from torchrl_quad.errors import UserValueError

MAX_HARMONICS = 64  # of a curve
Inputs = list[tuple[str, int, str, str, float, str]]  # of each name, size, unit, frame, scale and meaning
_BODY: Inputs = [
    ("quaternion", 4, "1", "body to world", 10.0, "attitude (w, x, y, z), unit norm"),
    ("velocity", 3, "m/s", "world", 1.0, "velocity"),
    ("angular_velocity", 3, "rad/s", "body", 1.0, "body rates"),
]
_SIGN = (
    "q and -q are one attitude, and give different actions. The first quaternion of a flight has w >= 0; each further "
    "one has the sign that brings it nearer to the one before."
)


def numbers(x: Any) -> Any:
    """A tensor as numbers, in as few digits as its precision has: 0.46 and not 0.46000000834."""
    x = x.detach().cpu().numpy() if isinstance(x, Tensor) else np.asarray(x)
    if x.ndim:
        return [numbers(row) for row in x]
    return float(str(x)) if x.dtype.kind == "f" else x.item()


# -- tasks -------------------------------------------------------------------------------------------------------------


def _hovering(env: HoveringEnv) -> dict[str, Any]:
    return {
        "rule": "target",
        "target": list(env.target),
        "success": f"an episode: mean distance below {env.success_radius} m over its last second, without a crash",
        "criteria": {"radius": env.success_radius, "window": 1.0},
        "box": _box(env.target, env.box_half_width, env.box_height),
        "inputs": [("to_target", 3, "m", "world", 1.0, "target - position"), *_BODY],
    }


def _landing(env: LandingEnv) -> dict[str, Any]:
    success = (
        f"z <= {env.success_height} m, x and y within {env.success_radius} m of the target, speed <= "
        f"{env.success_speed} m/s; then cut the motors"
    )
    return {
        "rule": "target",
        "target": list(env.target),
        "success": success,
        "criteria": {"height": env.success_height, "radius": env.success_radius, "speed": env.success_speed},
        "box": _box(env.target, env.box_half_width, env.box_height),
        "inputs": [("to_target", 3, "m", "world", 1.0, "target - position; the target lies on the ground"), *_BODY],
    }


def _tracking(env: TrackingEnv) -> dict[str, Any]:
    about = f"next {env.lookahead} points of the curve - position, nearest first, {env.lookahead_interval} s apart"
    return {
        "rule": "curve",
        "period": env.period,
        "lookahead": env.lookahead,
        "lookahead_interval": env.lookahead_interval,
        **_harmonics(env),
        "success": f"an episode: root mean square distance below {env.success_radius} m from {env.settling_time} s on, "
        "without a crash",
        "criteria": {"radius": env.success_radius, "settling_time": env.settling_time},
        "box": _box(numbers(env.centre), numbers(env.half_width), env.ceiling),
        "inputs": [("to_points", 3 * env.lookahead, "m", "world", 1.0, about), *_BODY],
    }


def _racing(env: RacingEnv) -> dict[str, Any]:
    return {
        "rule": "gates",
        "gates": env.track["gates"],
        "gate_radius": env.track["gate_radius"],
        "success": f"an episode: {env.success_gates} gates passed, without a crash",
        "criteria": {"gates": env.success_gates},
        "box": _box(numbers(env.centre), numbers(env.half_width), env.ceiling),
        "inputs": [
            ("to_gate", 3, "m", "world", 1.0, "centre of the next gate - position"),
            ("to_gate_after", 3, "m", "world", 1.0, "centre of the gate after that - position"),
            *_BODY,
        ],
    }


def _forest(env: ForestEnv) -> dict[str, Any]:
    inputs: Inputs = [
        ("up_in_body", 3, "1", "body", 10.0, "the world's z axis"),
        (
            "command_in_body",
            3,
            "m/s",
            "body",
            1.0,
            "speed x way / max(length of way, 1 m), with way = target - position",
        ),
    ]
    if env.observe_velocity:
        inputs.insert(0, ("velocity_in_body", 3, "m/s", "body", 1.0, "velocity"))
    return {
        "rule": "course",
        "target": [env.length + env.run_out, 0.0, env.cruise_height],
        "speed": 0.5 * sum(env.speeds),
        "speeds": list(map(float, env.speeds)),
        "success": f"an episode: x >= {env.length} m, without having touched a tree or the ground",
        "criteria": {"distance": env.length},
        "box": _box(numbers(env.centre), numbers(env.extent), env.ceiling, env.scene.radius),
        "inputs": inputs,
    }


_TASKS: dict[type[QuadrotorEnv], tuple[str, Callable[[Any], dict[str, Any]]]] = {
    ForestEnv: ("forest", _forest),
    HoveringEnv: ("hovering", _hovering),
    LandingEnv: ("landing", _landing),
    RacingEnv: ("racing", _racing),
    TrackingEnv: ("tracking", _tracking),
}


def _box(centre: Any, half_width: Any, height: float, ground: float = 0.0) -> dict[str, list[float]]:
    half = np.broadcast_to(half_width, 2)
    low, high = ([float(np.round(c + s * h, 6)) for c, h in zip(centre, half, strict=False)] for s in (-1, 1))
    return {"low": [*low, float(np.round(ground, 6))], "high": [*high, float(height)]}


def _harmonics(env: TrackingEnv) -> dict[str, Any]:
    """The curve of an environment as a sum of harmonics.

    Raises:
        ValueError: it needs too many of them.
    """
    n = 8 * MAX_HARMONICS
    phase = torch.arange(n, dtype=torch.float64) * (2 * math.pi / n)
    points = env.curve(phase.to(env.device, env.dtype)).double().cpu().numpy()
    spectrum = np.fft.rfft(points, axis=0) / n
    count = int(np.flatnonzero((np.abs(spectrum) > 1e-6).any(1)).max(initial=0))
    spectrum[np.abs(spectrum) < 1e-7] = 0.0
    if count > MAX_HARMONICS:
        raise UserValueError(
            f"export_policy: the curve has corners: it needs more than {MAX_HARMONICS} harmonics of above 1e-6 m. "
            "Give TrackingEnv a smoother curve."
        )
    used = spectrum[1 : count + 1]
    cosine, sine = (np.round(x, 9) + 0.0 for x in (2 * used.real, -2 * used.imag))
    return {"offset": numbers(np.round(spectrum[0].real, 9)), "cosine": numbers(cosine), "sine": numbers(sine)}


# -- the contract ------------------------------------------------------------------------------------------------------


def describe(env: QuadrotorEnv, sees: bool = False, memory: int = 0) -> dict[str, Any]:
    """What a contract says of an environment, before anything has flown.

    Args:
        env: the environment.
        sees: whether the policy reads the images of its camera.
        memory: numbers that the policy keeps.

    Raises:
        ValueError: it is none of the tasks that a bundle can compute, or flies what a contract cannot say yet.
    """
    kind = next((cls for cls in type(env).__mro__ if cls in _TASKS), None)
    if kind is None:
        raise UserValueError(
            f"export_policy cannot say what {type(env).__name__} observes. It knows "
            f"{', '.join(name for name, _ in _TASKS.values())}, and tasks that inherit from these."
        )
    if env.control != "rates":
        raise UserValueError(
            f'export_policy exports thrust and body rates alone, control="rates"; got {env.control!r}.'
        )
    name, describe_task = _TASKS[kind]
    task = describe_task(env)
    box, layout = task.pop("box"), task.pop("inputs")
    camera = env.camera if sees else None
    if env.observe_last_action:
        about = "commands on their way, oldest first, each (thrust, roll rate, pitch rate, yaw rate)"
        layout.append(("action_queue", 4 * env.action_delay, "1", "action", 1.0, about))
    nominal, sensors = _fields(env.nominal), env.disturbances.get("sensors", Sensors())
    weight = nominal["mass"] * nominal["gravity"]
    most = float(np.float32(nominal["max_thrust_to_weight"] * weight))
    rates = nominal["max_body_rate"]
    return {
        "task": {"name": name, "max_episode_steps": env.max_episode_steps, **task},
        "inputs": _inputs(layout),
        "camera": None if camera is None else _camera(camera),
        "memory": memory,
        "quaternion": {
            "order": "wxyz",
            "frame": "body (x forward, y left, z up) to world (z up)",
            "sign": _SIGN if _BODY[0] in layout else "q and -q are one attitude, and give the same action.",
        },
        "action_queue": {"length": env.action_delay, "observed": env.observe_last_action},
        "output": {
            "order": ["thrust", "roll_rate", "pitch_rate", "yaw_rate"],
            "thrust": {
                "unit": "N",
                "range": [0.0, numbers(np.float32(most))],
                "weight": numbers(np.float32(weight)),
                "range_in_weights": [0.0, nominal["max_thrust_to_weight"]],
            },
            "body_rate": {"unit": "rad/s", "frame": "body", "range": [[-rate, rate] for rate in rates]},
            "hover_action": numbers(_single("hover_action", env.hover_action, 1)),
        },
        "control_dt": env.control_dt,
        "action_delay": env.action_delay,
        "observation_delay": sensors.delay,
        "drone": nominal,
        "plant": {k: v for k, v in _fields(env.params).items() if v != nominal[k]},
        "randomized": _randomized(env),
        "disturbances": _disturbances(env),
        "rate_loop": _rate_loop(env, nominal),
        "simulator": {
            "dynamics": next(k for k, cls in DYNAMICS.items() if cls is type(env.dynamics)),
            "integrator": getattr(env.dynamics, "integrator", "semi_implicit_euler"),
            "dt": env.dynamics.dt,
        },
        "limits": {
            "max_state_age": round((1 + sensors.delay) * env.control_dt, 9),
            "max_depth_age": camera and round((camera.rate + camera.delay) * env.control_dt, 9),
            "quaternion_norm_error": 1e-3,
            "max_value": 1e6,
        },
        "safety": {"position": box},
    }


def _camera(camera: Any) -> dict[str, Any]:
    """A depth camera, in numbers alone."""
    fields = {k: v for k, v in vars(camera).items() if k not in ("pitch", "differentiable")}
    mount = numbers(camera.mount(torch.zeros((), dtype=torch.float64)) + 0.0)
    return fields | {"position": list(map(float, camera.position)), "quaternion": mount}


def _inputs(layout: Inputs) -> list[dict[str, Any]]:
    entries, start = [], 0
    for name, size, unit, frame, scale, meaning in layout:
        about = {"unit": unit, "frame": frame, "scale": scale, "meaning": meaning}
        entries.append({"name": name, "start": start, "stop": start + size, **about})
        start += size
    return entries


def _single(name: str, value: Tensor, dim: int) -> Tensor:
    """The value of one drone, where all environments have the same."""
    if value.dim() == dim:
        return value
    if not (value == value[:1]).all():
        raise UserValueError(
            f"export_policy: {name} differs between environments; a contract is for one nominal drone."
        )
    return value[0]


def _fields(params: QuadrotorParams) -> dict[str, Any]:
    fields = {}
    for name, value in params.fields().items():
        one = numbers(_single(f"drone field {name!r}", value, QuadrotorParams.dim(name)))
        fields[name] = one[0] if len(one) == 1 else one
    return fields


def _randomized(env: QuadrotorEnv) -> dict[str, Any]:
    found = [x for x in env.disturbances.values() if isinstance(x, DroneRandomization)]
    spec = {name: value for x in found for name, value in x.spec.items()}
    return {name: {kind: list(map(float, pair)) for kind, pair in spec[name].items()} for name in spec}


def _disturbances(env: QuadrotorEnv) -> dict[str, Any]:
    described = {}
    for name, x in env.disturbances.items():
        if x is env.disturbances.get("camera"):
            continue  # a field of its own
        fields = {} if isinstance(x, DroneRandomization) else vars(x)
        plain = {k: numbers(np.asarray(v)) for k, v in fields.items() if _is_plain(v)}
        described[name] = {"kind": type(x).__name__, **plain}
        if isinstance(x, Wind | Sensors):
            described[name]["about"] = str(type(x).__doc__).splitlines()[0]
    return described


def _is_plain(x: Any) -> bool:
    """Whether it is a number, or numbers in an array; the obstacles of a scene are not."""
    with contextlib.suppress(ValueError, TypeError):
        return np.asarray(x).dtype.kind in "fiub"
    return False


def _rate_loop(env: QuadrotorEnv, drone: Mapping[str, Any]) -> dict[str, Any] | None:
    """The rate loop about hover, a second-order system per axis; None where rates follow the command at once."""
    if "rotor_speed" not in env.dynamics.sizes:
        return None
    gain, inertia, loss = (np.array(drone[k]) for k in ("rate_gain", "inertia", "rate_damping"))
    tau = np.mean(drone["motor_time_constant"])  # where it differs up and down, their mean
    values = {
        "natural_frequency": np.sqrt(gain / tau),
        "damping_ratio": damping_ratio(gain, inertia, loss, tau),
        "bandwidth": bandwidth(gain, inertia, loss, tau),
    }
    law = "tau w'' + 2 damping_ratio sqrt(gain tau) w' + gain w = gain desired, tau = motor_time_constant"
    return {"law": law, "gain": drone["rate_gain"], **{k: numbers(np.float32(v)) for k, v in values.items()}}


# -- what has flown ----------------------------------------------------------------------------------------------------


def seen_ranges(inputs: list[dict[str, Any]], observation: np.ndarray) -> list[dict[str, Any]]:
    """The inputs with the range of each entry in observations (n, k), in the unit of the input."""
    found = []
    for entry in inputs:
        values = observation[:, entry["start"] : entry["stop"]] / np.float32(entry["scale"])
        marks = np.percentile(values, (0, 1, 99, 100), axis=0).astype(np.float32)
        found.append(entry | {"seen": dict(zip(("least", "p1", "p99", "greatest"), numbers(marks), strict=True))})
    return found


def results(env: QuadrotorEnv, flight: TensorDictBase) -> dict[str, Any]:
    """How well a flight (num_envs, time) from fresh starts went; None where no episode has a value."""
    summary: dict[str, Any] = {"episodes": env.num_envs}
    for name, values in env.episode_metrics(flight).items():
        value = describe_metric(name, env.metric_info).summarise(values)
        summary[name] = None if math.isnan(value) else value
    return summary


def envelope(flight: TensorDictBase) -> dict[str, float]:
    """The greatest speed, body rate and tilt in a flight."""
    state = flight["state"]
    _, x, y, _ = state["quaternion"].unbind(-1)
    tilt = torch.acos((1.0 - 2.0 * (x * x + y * y)).clamp(-1.0, 1.0))
    norms = {"max_speed": state["velocity"].norm(dim=-1), "max_body_rate": state["angular_velocity"].norm(dim=-1)}
    return {name: numbers(x.max()) for name, x in {**norms, "max_tilt": tilt}.items()}
