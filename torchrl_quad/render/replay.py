"""Write flights as one page that opens in a browser, offline."""

from __future__ import annotations

import base64
import html
import json
import math
import re
from importlib import resources
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_quad.dynamics import QuadrotorParams
from torchrl_quad.dynamics.parameters import RawParams
from torchrl_quad.dynamics.rotors import Rotors
from torchrl_quad.envs.metrics import at_episode_end
from torchrl_quad.errors import MissingPackage, UserValueError
from torchrl_quad.files import replacing
from torchrl_quad.render.flights import Flight
from torchrl_quad.render.obstacles import depth_image, obstacle_shapes

_X_FRAME = [[0.053, 0.053], [-0.053, 0.053], [-0.053, -0.053], [0.053, -0.053]]  # [m], of a drone that is not known


def write_replay(
    rollout: TensorDictBase,
    path: str | Path,
    *,
    env: EnvBase | None = None,
    num_envs: int = 12,
    control_dt: float = 0.02,
    title: str | None = None,
) -> None:
    """Write the first episodes of a flight as an HTML page to play, pause, scrub and turn in a browser.

    The page shows the drones with attitude and rotor thrust, trails, and the task's markers; the obstacles of the
    environment that is followed, or of the first, and beside the flight what its camera saw; and over time the reward
    terms, the actions, the speed, and the distance to the target (or the height). It is one file of about 5 MB, most
    of it plotly.js, and needs no network. A drone stays where its episode ended, and the page says how it ended:
    "success" if the last state fulfils the task.

    Args:
        rollout: (num_envs, time), of any task. It must hold ``("next", "state", "position")`` and ``("next", "state",
            "quaternion")``; the page leaves out whatever else is missing.
        path: the HTML file to write, whole or not at all.
        env: the environment that flew, also under transforms. It provides the control step, the markers, the positions
            of the rotors, and their thrust in newtons. Without it, the page shows an X frame and the squared speed of
            each rotor.
        num_envs: how many environments to show, at most.
        control_dt: control step [s]; used only without ``env``.
        title: of the page; by default the name of the environment and the number of flights.

    Raises:
        ImportError: plotly is not installed.
        TypeError: ``env`` is not a quadrotor environment.
        ValueError: the rollout is not (num_envs, time), or has no position or quaternion; ``num_envs`` is less than 1;
            or ``env`` has individual drones, for fewer environments than the page shows.
    """
    plotlyjs = _plotlyjs()
    needed = [("next", "state", name) for name in ("position", "quaternion")]
    flight = Flight("write_replay", rollout, env, control_dt, needed, num_envs)
    page = {
        "title": html.escape(flight.title if title is None else title),
        "flight": json.dumps(_content(flight)).replace("<", "\\u003c"),  # "<" could close the script
        "plotly": plotlyjs,
        "script": _asset("replay.js"),
    }
    # In one pass, so that what has been filled in is not searched again.
    text = re.sub(r"\{\{(\w+)\}\}", lambda match: page[match[1]], _asset("replay.html"))
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _content(flight: Flight) -> dict[str, Any]:
    """The data of the page. Frame 0 is the start of the first step, frame k the state after the k-th step."""
    rollout, steps = flight.rollout, flight.steps
    n, time = rollout.shape
    starts = all(("state", name) in rollout.keys(True) for name in ("position", "quaternion"))
    first = 0 if starts else 1  # frame

    def state(name: str) -> Tensor | None:
        """An entry of the state (num_envs, frames, k), if there is one."""
        value = flight.state(name)
        return None if value is None else value[:, first:]

    position, target, velocity, rotor_speed = map(state, ("position", "target", "velocity", "rotor_speed"))
    rotors, lift = _rotors(flight, rotor_speed)
    content = {
        "environments": n,
        "frames": time + 1 - first,
        "start": first * flight.control_dt,
        "control_dt": flight.control_dt,
        "ended": (steps - first).tolist(),
        "endings": _endings(rollout),
        "knows_drone": flight.env is not None,
        "rotors": _encoded(rotors),
        "position": _encoded(position),
        "quaternion": _encoded(state("quaternion")),
        "lift": None if lift is None else _encoded(lift),
        "target": None if target is None else _encoded(target),
    }
    markers = flight.named
    content |= {
        "gates": None if markers.gates is None else _encoded(markers.rings()),
        "gate": None if (gate := flight.gate_index()) is None else _encoded(gate[:, first:].float()),
        "places": None if markers.places is None else _encoded(markers.places),
        "curve": None if markers.curve is None else _encoded(markers.curve),
        "shapes": [
            {
                "points": _encoded(shape.points),
                "faces": None if shape.faces is None else _encoded(shape.faces.float()),
                **{key: getattr(shape, key) for key in ("name", "color", "opacity")},
            }
            for shape in markers.shapes
        ],
        "obstacles": _obstacles(flight),
        "images": _images(flight, first),
    }

    series = _rewards_and_actions(flight)
    if velocity is not None:
        series.append(("speed [m/s]", {"speed": flight.state("velocity").norm(dim=-1)}, {}))
    if target is not None:
        distance = torch.from_numpy(flight.distance)
        options = {"log": flight.log_distance, "success": flight.near_enough}
        series.append((f"distance to the {markers.target} [m]", {"distance": distance}, options))
    else:
        series.append(("height [m]", {"height": flight.state("position")[..., 2]}, {}))
    ended = torch.arange(time + 1) > steps[:, None]  # panels show nothing after the end of the episode
    panels = [
        {
            "label": label,
            "names": list(lines),
            "values": _encoded(torch.stack([x.masked_fill(ended, math.nan)[:, first:] for x in lines.values()], -1)),
            **options,
        }
        for label, lines, options in series
    ]
    return {**content, "panels": panels}


def _obstacles(flight: Flight) -> list[dict[str, str]]:
    """The obstacles of each environment, of the first alone where all share them; none without a scene."""
    scene = getattr(flight.env, "scene", None)
    if scene is None:
        return []
    found = []
    for i in range(len(flight) if scene.is_random else 1):
        shapes = obstacle_shapes(flight.solids(i))
        points, faces = (shapes[0].points, shapes[0].faces.float()) if shapes else (torch.zeros(0, 3),) * 2
        found.append({"points": _encoded(points), "faces": _encoded(faces)})
    return found


def _images(flight: Flight, first: int) -> dict[str, Any] | None:
    """What the cameras showed, as bytes from far to near."""
    depth = flight.depth
    if depth is None:
        return None
    camera = getattr(flight.env, "camera", None)
    far = depth.amax().clamp_min(1.0).item() if camera is None else camera.range
    pixels = (255.0 * depth_image(depth[:, first:], far)).round().to(torch.uint8)
    data = base64.b64encode(pixels.contiguous().numpy().tobytes()).decode("ascii")
    return {"height": depth.shape[-2], "width": depth.shape[-1], "data": data}


def _rewards_and_actions(flight: Flight) -> list[tuple[str, dict[str, Tensor], dict[str, Any]]]:
    """The labels of the first panels, their lines (num_envs, time + 1) by name, and how to draw them."""
    rollout, panels = flight.rollout, []
    nothing = torch.full((len(rollout), 1), math.nan)
    terms = {name: x[..., 0] for name, x in rollout.get(("next", "reward_terms"), {}).items()}
    if ("next", "reward") in rollout.keys(True):
        terms = {"sum" if terms else "reward": rollout["next", "reward"][..., 0], **terms}
    elif terms:
        terms = {"sum": sum(terms.values()), **terms}
    if terms:
        lines = {name: torch.cat((nothing, x.float()), 1) for name, x in terms.items()}
        panels.append(("reward", lines, {"peaks": True}))
    if "action" in rollout:
        action = rollout["action"].float()
        over = torch.arange(rollout.shape[1]) >= flight.steps[:, None]
        lines = {
            name: torch.cat((x.masked_fill(over, math.nan), nothing), 1)
            for name, x in zip(flight.action_names, action.unbind(-1), strict=True)
        }
        panels.append(("action [-1, 1]", lines, {"held": True}))
    return panels


def _endings(rollout: TensorDictBase) -> list[str]:
    """How each first episode ended; "" if it did not."""
    endings, done = [""] * len(rollout), rollout.get(("next", "done"), None)
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
        flags = rollout.get(("next", name), None)
        if flags is not None:
            flags = at_episode_end(rollout, flags & done).tolist()
            endings = [word if flag else ending for flag, ending in zip(flags, endings, strict=True)]
    return endings


def _rotors(flight: Flight, speed: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """Positions of the rotors (num_envs, 4, 2) [m], and the lift of each (num_envs, frames, 4).

    The unit of lift is the thrust that hovers; without the environment, half of the greatest squared speed of the
    flight.
    """
    n = len(flight)
    if flight.env is None:
        positions = torch.tensor(_X_FRAME).expand(n, 4, 2)
        squared = None if speed is None else speed.square()
        return positions, None if speed is None else 2.0 * squared / squared.nan_to_num().amax().clamp_min(1e-12)
    fields = {}
    for name, value in flight.env.params.fields().items():
        randomised = flight.rollout.get(("next", "state", "drone", name), None)
        if randomised is not None:
            value = randomised[:, 0]
        elif value.dim() > QuadrotorParams.dim(name) and len(value) > 1:
            if len(value) < n:
                raise UserValueError(
                    f"write_replay: env has a {name} for each of its {len(value)} environments, and the page would "
                    f"show {n}. Pass the environment that flew, or num_envs={len(value)}."
                )
            value = value[:n]
        shape = value.shape[-QuadrotorParams.dim(name) :]
        fields[name] = value.detach().cpu().float().reshape(-1, 1, *shape)
    params = RawParams(**fields)  # each (num_envs or 1, 1, ...)
    lift = None if speed is None else Rotors(params).thrust(speed) * 4.0 / (params.mass * params.gravity)
    return params.rotor_positions[:, 0].expand(n, 4, 2), lift


def _encoded(value: Tensor) -> str:
    """Numbers as base64 of little-endian float32."""
    return base64.b64encode(value.contiguous().numpy().astype("<f4").tobytes()).decode("ascii")


def _asset(name: str) -> str:
    return (resources.files(__package__) / name).read_text(encoding="utf-8")


def _plotlyjs() -> str:
    try:
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise MissingPackage("Replays need plotly: pip install '.[render]' in a clone.") from error
    return get_plotlyjs()
