"""Replays: flights as one page that opens in a browser, offline."""

from __future__ import annotations

import base64
import html
import json
import math
import os
import re
from importlib import resources
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_quad.dynamics import QuadrotorParams
from torchrl_quad.dynamics.parameters import RawParams
from torchrl_quad.dynamics.rotors import Rotors
from torchrl_quad.envs import QuadrotorEnv, RacingEnv
from torchrl_quad.envs.terms import norm
from torchrl_quad.render.frames import checked, episode_steps, first_episodes

_X_FRAME = [[0.053, 0.053], [-0.053, 0.053], [-0.053, -0.053], [0.053, -0.053]]  # [m], where no drone is known


def write_replay(
    rollout: TensorDictBase,
    path: str | Path,
    *,
    env: QuadrotorEnv | None = None,
    num_envs: int = 12,
    control_dt: float = 0.02,
) -> None:
    """Write the first episodes of a flight as an HTML page to play, pause, scrub and turn about in a browser.

    The page shows the drones with their attitude and rotor thrust, gates, targets and trails, and over time the reward
    terms, the actions, the speed, and the distance to the target (or the height). It is one file of about 5 MB, most of
    it plotly.js, that needs no network. A drone stays where its episode has ended, and the page says how: "success"
    where the last state fulfils the task.

    Args:
        rollout: (num_envs, time), of any task. Only ``("next", "state", "position")`` and ``("next", "state",
            "quaternion")`` are needed; what else is missing is left out.
        path: where the HTML file goes; it is complete or not there.
        env: the environment that flew, also under transforms. It tells the control step, where the rotors sit, their
            thrust in newtons, and the gates. Without it an X frame is drawn, with the squared speed of each rotor.
        num_envs: how many environments are shown, at most.
        control_dt: control step [s], where ``env`` does not tell it.

    Raises:
        ImportError: plotly is not installed.
        TypeError: ``env`` is no :class:`~torchrl_quad.envs.QuadrotorEnv`.
        ValueError: the rollout is not (num_envs, time), or has no position or quaternion; ``num_envs`` is less than 1;
            or ``env`` has drones of its own for fewer environments than are shown.
    """
    plotlyjs = _plotlyjs()
    while hasattr(env, "base_env"):
        env = env.base_env
    if not isinstance(env, QuadrotorEnv | None):
        raise TypeError(f"env must be a QuadrotorEnv, also under transforms, or None; got {type(env).__name__}.")
    keys = (("next", "state", name) for name in ("position", "quaternion"))
    flight = checked(rollout, "write_replay", num_envs, *keys)
    content = json.dumps(_content(flight, env, control_dt if env is None else env.control_dt))
    page = {
        "title": html.escape(f"{'Flight' if env is None else type(env).__name__}, {len(flight)} environments"),
        "flight": content.replace("<", "\\u003c"),  # which could close the script
        "plotly": plotlyjs,
        "script": _asset("replay.js"),
    }
    # In one pass, so that nothing is looked for in what has been put in.
    text = re.sub(r"\{\{(\w+)\}\}", lambda match: page[match[1]], _asset("replay.html"))
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_text(text, encoding="utf-8")
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _content(flight: TensorDictBase, env: QuadrotorEnv | None, control_dt: float) -> dict[str, Any]:
    """What the page shows. Frame 0 is the start of the first step, frame k what the k-th step has led to."""
    n, time = flight.shape
    steps, frames = episode_steps(flight), torch.arange(time + 1)
    first = 0 if all(("state", name) in flight.keys(True) for name in ("position", "quaternion")) else 1

    def state(name: str) -> Tensor | None:
        """An entry of the state (num_envs, frames, k), where there is one."""
        value = first_episodes(flight, name)
        return None if value is None else value[:, first:]

    def panel(label: str, names: list[str], value: Tensor, **more: Any) -> dict[str, Any]:
        """A time series of which there is nothing after the end of the episode."""
        value = value.float().masked_fill((frames > steps[:, None])[:, -value.shape[1] :, None], math.nan)
        return {"label": label, "names": names, "values": _encoded(value), **more}

    position, target, velocity, rotor_speed = map(state, ("position", "target", "velocity", "rotor_speed"))
    rotors, lift = _rotors(flight, env, rotor_speed)
    content = {
        "environments": n,
        "frames": time + 1 - first,
        "start": first * control_dt,
        "control_dt": control_dt,
        "ended": (steps - first).tolist(),
        "endings": _endings(flight),
        "knows_drone": env is not None,
        "rotors": _encoded(rotors),
        "position": _encoded(position),
        "quaternion": _encoded(state("quaternion")),
        "lift": None if lift is None else _encoded(lift),
        "target": None if target is None else _encoded(target),
    }
    if isinstance(env, RacingEnv) and (gate := state("gate")) is not None:
        content |= {"gate": _encoded(gate), "gates": _encoded(_rings(env.gates.cpu(), env.track["gate_radius"]))}

    panels, nothing = [], torch.full((n, 1, 1), math.nan)
    terms = dict(flight.get(("next", "reward_terms"), {}).items())
    reward = flight.get(("next", "reward"), sum(terms.values()) if terms else None)
    if reward is not None:
        values = torch.cat((reward, *terms.values()), -1)
        values = torch.cat((nothing.expand(-1, -1, values.shape[-1]), values), 1)[:, first:]
        panels.append(panel("reward", ["sum" if terms else "reward", *terms], values, peaks=True))
    action = flight.get("action", None)
    if action is not None:
        names = ["thrust", "roll rate", "pitch rate", "yaw rate"]
        names = names if action.shape[-1] == 4 else [str(i) for i in range(action.shape[-1])]
        action = action.masked_fill((frames[:-1] >= steps[:, None]).unsqueeze(-1), math.nan)
        action = torch.cat((action, nothing.expand(-1, -1, action.shape[-1])), 1)[:, first:]
        panels.append(panel("action [-1, 1]", names, action, held=True))
    if velocity is not None:
        panels.append(panel("speed [m/s]", ["speed"], norm(velocity)))
    if target is not None:
        panels.append(panel("distance to the target [m]", ["distance"], norm(position - target)))
    else:
        panels.append(panel("height [m]", ["height"], position[..., 2:]))
    return {**content, "panels": panels}


def _endings(flight: TensorDictBase) -> list[str]:
    """How each first episode ended: "" where it did not."""
    endings, done = [""] * len(flight), flight.get(("next", "done"), None)
    if done is None:
        return endings
    # The later ones override the earlier ones.
    for name, word in (
        ("done", "ended"),
        ("terminated", "terminated"),
        ("truncated", "truncated"),
        ("success", "success"),
        ("crash", "crashed"),
    ):
        flags = flight.get(("next", name), None)
        if flags is not None:
            flags = QuadrotorEnv.at_the_end(flight, flags & done).tolist()
            endings = [word if flag else ending for flag, ending in zip(flags, endings, strict=True)]
    return endings


def _rotors(flight: TensorDictBase, env: QuadrotorEnv | None, speed: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """Where the rotors sit, (num_envs, 4, 2) [m], and how strongly each lifts, (num_envs, frames, 4).

    The unit is the thrust that hovers; without the environment, half of the greatest squared speed of the flight.
    """
    n = len(flight)
    if env is None:
        positions = torch.tensor(_X_FRAME).expand(n, 4, 2)
        squared = None if speed is None else speed.square()
        return positions, None if speed is None else 2.0 * squared / squared.nan_to_num().amax().clamp_min(1e-12)
    fields = {}
    for name, value in env.params.fields().items():
        drawn = flight.get(("next", "state", "drone", name), None)
        if drawn is not None:
            value = drawn[:, 0]
        elif value.dim() > QuadrotorParams.dim(name) and len(value) > 1:
            if len(value) < n:
                raise ValueError(
                    f"write_replay: env has a {name} for each of its {len(value)} environments, and {n} are to be "
                    f"shown. Give the environment that flew, or num_envs={len(value)}."
                )
            value = value[:n]
        shape = value.shape[-QuadrotorParams.dim(name) :]
        fields[name] = value.detach().cpu().float().reshape(-1, 1, *shape)
    params = RawParams(**fields)  # each (num_envs or 1, 1, ...)
    lift = None if speed is None else Rotors(params).thrust(speed) * 4.0 / (params.mass * params.gravity)
    return params.rotor_positions[:, 0].expand(n, 4, 2), lift


def _rings(gates: Tensor, radius: float, points: int = 33) -> Tensor:
    """A circle (gates, points, 3) around each gate, which faces along the course."""
    ahead, behind = (torch.nn.functional.normalize(gates.roll(-k, 0) - gates, dim=-1) for k in (1, -1))
    along = ahead - behind
    along = torch.where(norm(along) > 1e-3, along, ahead)  # the course turns back
    up = torch.tensor([0.0, 0.0, 1.0]).expand_as(gates)
    side = torch.linalg.cross(along.float(), up)
    side = torch.where(norm(side) > 1e-3, side, torch.tensor([0.0, 1.0, 0.0]))  # the course climbs straight
    side = torch.nn.functional.normalize(side, dim=-1)
    upright = torch.nn.functional.normalize(torch.linalg.cross(side, along.float()), dim=-1)
    angle = torch.linspace(0, 2 * math.pi, points)[:, None]
    return gates[:, None].float() + radius * (angle.cos() * side[:, None] + angle.sin() * upright[:, None])


def _encoded(value: Tensor) -> str:
    """As base64 of little-endian float32."""
    return base64.b64encode(value.contiguous().numpy().astype("<f4").tobytes()).decode("ascii")


def _asset(name: str) -> str:
    return (resources.files(__package__) / name).read_text(encoding="utf-8")


def _plotlyjs() -> str:
    try:
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise ImportError("Replays need plotly: pip install 'torchrl_quad[render]'.") from error
    return get_plotlyjs()
