"""Describe an environment: as a contract, and as the page of a bundle for people who write firmware."""

from __future__ import annotations

import contextlib
import inspect
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.linalg import vector_norm

from torchrl_quad.airframe import RateLoop
from torchrl_quad.data.unwrap import leaf
from torchrl_quad.deploy import autopilots
from torchrl_quad.deploy.contract import GRAPHS, MEASURED, Contract, Fields, schema_table
from torchrl_quad.deploy.network import fill_in
from torchrl_quad.deploy.tracing import Rules
from torchrl_quad.dynamics import CONTROLS, DYNAMICS, QuadrotorParams, make_controller
from torchrl_quad.dynamics.firmware import PIDController
from torchrl_quad.dynamics.parameters import LIMITS
from torchrl_quad.envs import TASKS, QuadrotorEnv
from torchrl_quad.envs.disturbances import DroneRandomization, Sensors, Wind
from torchrl_quad.envs.metrics import describe_metric
from torchrl_quad.errors import UserValueError
from torchrl_quad.vision import DepthCamera

if TYPE_CHECKING:
    from onnx import ModelProto

DTYPES = {1: "float32", 11: "float64", 7: "int64", 9: "bool"}  # by their numbers in ONNX
NO_RULE = ("training", "is_closed", "num_envs", "control_dt", "action_delay", "max_episode_steps")  # of an environment
MOST_LETTERS, MOST_NUMBERS = 20_000, 4096  # of the documentation of a task, and of one of its constants
UNITS = {  # unit and frame of what is measured and commanded
    "position": {"unit": "m", "frame": "world"},
    "quaternion": {"unit": "1", "frame": "body to world"},
    "velocity": {"unit": "m/s", "frame": "world"},
    "angular_velocity": {"unit": "rad/s", "frame": "body"},
    "action_queue": {"unit": "1", "frame": "action"},
    "depth": {"unit": "m"},
}
SIGN = (
    "q and -q are one attitude, and give different actions. The first quaternion of a flight has w >= 0; each further "
    "one has the sign that brings it nearer to the one before."
)


def numbers(x: Any) -> Any:
    """A tensor as numbers, in as few digits as its precision has: 0.46 and not 0.46000000834."""
    x = x.detach().cpu().numpy() if isinstance(x, Tensor) else np.asarray(x)
    if x.ndim:
        return [numbers(row) for row in x]
    return float(str(x)) if x.dtype.kind == "f" else x.item()


# -- the contract ------------------------------------------------------------------------------------------------------


def describe(env: QuadrotorEnv, rules: Rules, models: Mapping[str, ModelProto], memory: int, visual: bool) -> Fields:
    """What a contract says of an environment whose policy keeps ``memory`` numbers, before anything has flown."""
    camera = env.camera if visual else None
    nominal, believed = (_fields(env.nominal, all=x) for x in (False, True))
    delay = getattr(env.disturbances.get("sensors"), "delay", 0)
    weight = nominal["mass"] * nominal["gravity"]
    most = float(np.float32(nominal["max_thrust_to_weight"] * weight))
    return {
        "task": _task(env, rules),
        "graphs": {name: _graph(models[name]) for name in GRAPHS if name in models},
        "camera": None if camera is None else _camera(camera),
        "obstacles": None if env.scene is None else {"radius": env.scene.radius, **env.scene.fixed},
        "memory": memory,
        "quaternion": {"order": "wxyz", "frame": "body (x forward, y left, z up) to world (z up)", "sign": SIGN},
        "output": {
            **_commands(env),
            "thrust": {
                "unit": "N",
                "range": [0.0, numbers(np.float32(most))],
                "weight": numbers(np.float32(weight)),
                "range_in_weights": [0.0, nominal["max_thrust_to_weight"]],
            },
            "body_rate": {
                "unit": "rad/s",
                "frame": "body",
                "range": [[-rate, rate] for rate in nominal["max_body_rate"]],
            },
            "hover_action": numbers(_single("hover_action", env.hover_action, 1)),
        },
        "control_dt": env.control_dt,
        "action_delay": env.action_delay,
        "observation_delay": delay,
        "drone": nominal,
        "plant": {k: v for k, v in _fields(env.params, all=True).items() if v != believed[k]},
        "randomized": _randomized(env),
        "disturbances": _disturbances(env),
        "rate_loop": _rate_loop(env, nominal),
        "simulator": {
            "dynamics": next(k for k, cls in DYNAMICS.items() if cls is type(env.dynamics)),
            "integrator": getattr(env.dynamics, "integrator", "semi_implicit_euler"),
            "dt": getattr(env.dynamics, "dt"),  # noqa: B009
        },
        "limits": {
            "max_state_age": round((1 + delay) * env.control_dt, 9),
            "max_depth_age": camera and round((camera.rate + camera.delay) * env.control_dt, 9),
            "quaternion_norm_error": 1e-3,
            "max_value": 1e6,
        },
    }


def _task(env: QuadrotorEnv, rules: Rules) -> Fields:
    cls, bounds = type(env), env.state_bounds()
    entries = {}
    for name, key in rules.entries.items():
        x, ends = env.control_step.safe_state[key], bounds.get(key, (-math.inf, math.inf))
        # In the precision of the entry: in float32 a phase may be a little above 2 pi.
        low, high = (torch.tensor(end, dtype=x.dtype).item() if math.isfinite(end) else None for end in ends)
        kind = str(x.dtype).removeprefix("torch.")
        entries[name] = {"shape": [*x.shape[1:]], "dtype": kind, "low": low, "high": high}
    metrics = {}
    for x in rules.graphs["episode"].graph.output if "episode" in rules.graphs else ():
        about = describe_metric(x.name, env.metric_info)
        metrics[x.name] = {name: getattr(about, name) for name in ("label", "unit", "scale", "median")}
    return {
        "name": next((name for name, known in TASKS.items() if known is cls), f"{cls.__module__}.{cls.__qualname__}"),
        "about": next(iter((cls.__doc__ or "").strip().splitlines()), ""),
        "documentation": inspect.cleandoc(cls.__doc__ or "")[:MOST_LETTERS],
        "constants": _constants(env),
        "max_episode_steps": env.max_episode_steps,
        "dtype": str(env.dtype).removeprefix("torch."),
        "entries": entries,
        "metrics": metrics,
        "unjudged": rules.unjudged,
    }


def _constants(env: QuadrotorEnv) -> Fields:
    """The numbers of a task by the names that its class gives them, such as gates, and the radius of success."""
    cls, found = type(env), {}
    for part in reversed(cls.__mro__[: cls.__mro__.index(QuadrotorEnv)]):
        found |= vars(part)
    found |= {name: x.detach().cpu() if isinstance(x, Tensor) else x for name, x in vars(env).items()}
    plain = {
        name: np.asarray(x) for name, x in found.items() if name[0] != "_" and name not in NO_RULE and _is_plain(x)
    }
    return {name: numbers(x) for name, x in plain.items() if 0 < x.size <= MOST_NUMBERS and np.isfinite(x).all()}


def _graph(model: ModelProto) -> Fields:
    """What an ONNX model reads and writes."""
    described = {}
    for side, ends in (("reads", model.graph.input), ("writes", model.graph.output)):
        described[side] = {}
        for x in ends:
            kind, unit = x.type.tensor_type, UNITS.get(x.name.rpartition(".")[2], {})
            shape = [size.dim_value for size in kind.shape.dim if not size.dim_param]
            described[side][x.name] = {"shape": shape, "dtype": DTYPES[kind.elem_type], **unit}
    return described


def _camera(camera: DepthCamera) -> Fields:
    """A depth camera as numbers."""
    fields = {k: v for k, v in vars(camera).items() if k not in ("pitch", "differentiable")}
    mount = numbers(camera.mount(torch.zeros((), dtype=torch.float64)) + 0.0)
    return fields | {"position": list(map(float, camera.position)), "quaternion": mount}


def _single(name: str, value: Tensor, dim: int) -> Tensor:
    """The value of one drone, where all environments have the same."""
    if value.dim() == dim:
        return value
    if not (value == value[:1]).all():
        raise UserValueError(f"export_policy: {name} differs between environments; a contract is for one drone.")
    return value[0]


def _fields(params: QuadrotorParams, all: bool = False) -> Fields:
    """Those that are given, or all, with what None stands for."""
    fields = {}
    for name, value in ((name, params.value(name)) for name in (LIMITS if all else params.fields())):
        one = numbers(_single(f"drone field {name!r}", value, QuadrotorParams.dim(name)))
        fields[name] = one[0] if len(one) == 1 else one
    return fields


def _randomized(env: QuadrotorEnv) -> Fields:
    specs = [x.spec for x in env.disturbances.values() if isinstance(x, DroneRandomization)]
    found = [(name, ranges) for spec in specs for name, ranges in spec.items()]
    return {name: {kind: list(map(float, pair)) for kind, pair in ranges.items()} for name, ranges in found}


def _disturbances(env: QuadrotorEnv) -> Fields:
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


def _rate_loop(env: QuadrotorEnv, drone: Contract) -> Fields | None:
    """The rate loop about hover, in the steps that were flown; None where rates follow the command at once."""
    if "rotor_speed" not in env.dynamics.sizes:
        return None
    tau, dt = drone["motor_time_constant"], getattr(env.dynamics, "dt")  # noqa: B009
    loop = RateLoop(drone["rate_gain"], drone["inertia"], drone["rate_damping"], tau, dt)
    values = {k: numbers(np.float32(getattr(loop, k))) for k in ("natural_frequency", "damping_ratio", "bandwidth")}
    law = (
        "every simulator.dt: w += dt a and, at once, a += (1 - exp(-dt / motor_time_constant)) "
        "(gain (desired - w) - (1 + rate_damping / inertia) a)"
    )
    torque = (
        "torque = inertia gain (desired - w) - rate_damping a + w x (inertia w), with a = (the torque of the rotors at "
        "their present speeds - w x (inertia w)) / inertia; so no moment of the air is known to it, and there is no "
        "integral. The rotor thrusts are those of least squares that make this torque and the collective thrust. Where "
        "one would leave its limits, in this order: roll and pitch torque shrink by one factor, if they need more than "
        "the whole range; collective thrust moves by as little as makes room for them; yaw torque shrinks to what fits"
    )
    if type(getattr(env.dynamics, "controller", None)) not in (*CONTROLS.values(), PIDController):
        torque = inspect.cleandoc(type(env.dynamics).__doc__ or "")[:2000]
    if "rate_integral" in env.dynamics.sizes:
        torque = torque.replace(", and there is no integral", "")
        rest, slow = ", unless a rotor is asked for more than it can", ""
        if "slow_rate" in env.dynamics.sizes:
            rest, slow = " max(0, 1 - |commanded - l| / 40 deg/s)", "l += (1 - exp(-2 pi 15 dt)) (commanded - l) and "
        law += (
            f". With desired = commanded + i; each step also {slow}i += dt 0.1 B (commanded - w){rest}, B being the "
            "bandwidth for dt to 0"
        )
    return {"law": law, "torque": torque, "gain": drone["rate_gain"], **values}


LAWS = {  # from a command to what rotors do; in each physics step
    "rates": "the collective thrust and the body rates go to the rate loop",
    "attitude": "collective thrust goes to the rate loop. Roll and pitch are Euler angles, in the order z, y, x; the "
    "heading is free. With the world's up in the body frame, u, the wanted one, u' = (-sin(pitch), sin(roll) "
    "cos(pitch), cos(roll) cos(pitch)), e = u' x u, and s(x, l) = x / sqrt(1 + |x / l|^2), the body rates are x and y: "
    "s(tilt_gain e, body_rate.range) + yaw_rate u, and z: yaw_rate u",
    "velocity": "with s(x, l) = x / sqrt(1 + |x / l|^2) and the error of the velocity e, the wanted acceleration is z: "
    "gravity + s(velocity_gain e, max_climb), and x and y, as one vector: s(velocity_gain e, z tan(max_tilt)). In the "
    "body frame it is a. The collective thrust is mass a_z, within thrust.range; the body rates are x and y: "
    "s(tilt_gain (-a_y, a_x) / |a|, body_rate.range), and z: yaw_rate times the world's up along body z",
    "rotor_thrusts": "each rotor is asked for the speed at which drone.thrust_map gives its thrust, within "
    "drone.rotor_speed_min and drone.rotor_speed_max; as a signal from 0 to 1 it is (speed - min) / (max - min)",
}
GAINS = ("tilt_gain", "velocity_gain", "max_climb", "max_tilt")  # of the controllers that have them


def _commands(env: QuadrotorEnv) -> Fields:
    """What the entries of an action command, and the law that follows a command."""
    controller = getattr(env.dynamics, "controller", None) or make_controller("rates", env.nominal)
    names = (name for name, cls in reversed(CONTROLS.items()) if isinstance(controller, cls))  # rates, their base, last
    mode = next(names, type(controller).__name__)
    if mode not in LAWS or (mode == "rates" and controller.action_units != CONTROLS[mode].action_units):
        raise UserValueError(f"export_policy exports the controls {', '.join(LAWS)}; got {mode!r}.")
    one = torch.ones_like(controller.hover_action)
    low, high = (numbers(_single("the range of actions", controller.decode(x).float(), 1)) for x in (-one, one))
    gains = {name: torch.as_tensor(getattr(controller, name)) for name in GAINS if hasattr(controller, name)}
    return {
        "control": mode,
        "order": [name.replace(" ", "_") for name in controller.action_units],
        "units": [*controller.action_units.values()],
        "range": [list(pair) for pair in zip(low, high, strict=True)],
        "law": LAWS[mode],
        "gains": {name: numbers(_single(name, torch.atleast_1d(x.float()), 1)) for name, x in gains.items()},
    }


# -- what has flown ----------------------------------------------------------------------------------------------------


def seen_ranges(observation: np.ndarray) -> Fields:
    """The range of each entry in observations (n, k)."""
    marks = np.percentile(observation, (0, 1, 99, 100), axis=0).astype(np.float32)
    seen = dict(zip(("least", "p1", "p99", "greatest"), numbers(marks), strict=True))
    return {"size": observation.shape[1], "seen": seen}


def results(env: QuadrotorEnv, flight: TensorDictBase) -> Fields:
    """How well a flight (num_envs, time) from fresh starts went; None where no episode has a value."""
    summary: Fields = {"episodes": env.num_envs}
    for name, values in env.episode_metrics(flight).items():
        value = describe_metric(name, env.metric_info).summarise(values)
        summary[name] = None if math.isnan(value) else value
    return summary


def envelope(flight: TensorDictBase) -> Fields:
    """Where a flight has been: the range of its positions, its greatest speed, body rate and tilt."""
    position, quaternion, velocity, rates = (leaf(flight, ("state", name)).flatten(0, 1) for name in MEASURED)
    _, x, y, _ = quaternion.unbind(-1)
    return {
        "low": numbers(position.amin(0)),
        "high": numbers(position.amax(0)),
        "max_speed": numbers(vector_norm(velocity, dim=-1).max()),
        "max_body_rate": numbers(vector_norm(rates, dim=-1).max()),
        "max_tilt": numbers(torch.acos((1.0 - 2.0 * (x * x + y * y)).clamp(-1.0, 1.0)).max()),
    }


# -- the page of a bundle ----------------------------------------------------------------------------------------------


def write_page(contract: Contract, documentation: str | None) -> bytes:
    """The content of ``README.md``, with the documentation of the class of the task."""
    task, output, graphs = contract["task"], contract["output"], contract["graphs"]
    reads = [(name, f"{x['shape']} {x.get('unit', '')}") for name, x in graphs["policy"]["reads"].items()]
    tensors = [
        f"| `{graph}.onnx` | {side} | `{name}` | {'x'.join(map(str, x['shape'])) or '1'} | {x['dtype']} "
        f"| {x.get('unit', '')} | {x.get('frame', '')} |"
        for graph, sides in graphs.items()
        for side in ("reads", "writes")
        for name, x in sides[side].items()
    ]
    camera, delay, dt, drone = (contract[x] for x in ("camera", "action_delay", "control_dt", "drone"))
    drawn = contract["randomized"].get("delay", {}).get("any")  # by randomize="any"
    flown = "drones from the ranges in `randomized`, of which the one in `drone` is the middle"
    lines = inspect.cleandoc(documentation or "There is none.").splitlines()
    values = {
        "task": task["name"],
        "reads": " and ".join(f"`{name}` {about.strip()}" for name, about in reads),
        "documentation": "\n".join(f"    {line}".rstrip() for line in lines),
        "tensors": "\n".join(tensors),
        "entries": ", ".join(f"`{name}`" for name in task["entries"]) or "none",
        "starts": ", ".join(f"`{name}`" for name in (*MEASURED, *task["entries"])),
        "memory": contract["memory"],
        "sign": contract["quaternion"]["sign"],
        "actions": len(output["order"]),
        "answers": ", ".join(name.replace("_", " ") for name in output["order"]),
        "commands": "\n".join(
            f"| {i} | {name.replace('_', ' ')} | {low:.6g} | {high:.6g} | {unit} |"
            for i, (name, unit, (low, high)) in enumerate(
                zip(output["order"], output["units"], output["range"], strict=True)
            )
        ),
        "law": output["law"],
        "rotors": "\n".join(
            f"| {i} | {place[0]:.4g} | {place[1]:.4g} | {'counter-clockwise' if spin < 0 else 'clockwise'} |"
            for i, (place, spin) in enumerate(zip(drone["rotor_positions"], drone["rotor_spin"], strict=True), 1)
        ),
        "weight": f"{output['thrust']['weight']:.6g}",
        "hover": ", ".join(f"{x:.6g}" for x in output["hover_action"]),
        "control_dt": f"{dt:g}",
        "delay": f"{drawn[0]:g} to {drawn[1]:g}" if drawn else delay,
        "delay_seconds": f"{drawn[0] * dt:g} to {drawn[1] * dt:g}" if drawn else f"{delay * dt:g}",
        "most": f"{output['range'][0][1]:.6g}",
        "flown": flown if drawn else "the drone in `drone` and the rate loop in `rate_loop`",
        "age": f"{contract['limits']['max_state_age']:g}",
        "fields": schema_table(),
        "package": contract["origin"]["package"],
    }
    if camera:
        values |= {f"camera_{name}": f"{x:g}" for name, x in camera.items() if isinstance(x, int | float)}
        values |= {f"camera_{name}": ", ".join(f"{x:.6g}" for x in camera[name]) for name in ("position", "quaternion")}
        values["camera_angle"] = f"{math.degrees(camera['field_of_view']):g}"
        values["camera_age"] = f"{contract['limits']['max_depth_age']:g}"
        ray, axis = "the length of its ray to", "the depth, along the optical axis, of"
        values["camera_pixel"] = ray if camera["along_ray"] else axis
    has = {"camera": camera, "memory": contract["memory"], "autopilots": autopilots.fit(contract), "any": drawn}
    has |= {"advance": "advance" in graphs, "judged": not task["unjudged"]}
    return fill_in("README.md", values, [name for name, there in has.items() if there]).encode()
