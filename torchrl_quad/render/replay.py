"""Write flights as one page that opens in a browser, offline."""

from __future__ import annotations

import base64
import html
import json
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import pad
from torchrl.envs import EnvBase

from torchrl_quad.dynamics import QuadrotorParams
from torchrl_quad.envs.metrics import at_episode_end
from torchrl_quad.errors import UserValueError, needing
from torchrl_quad.files import replacing
from torchrl_quad.options import Positive, Size, checked
from torchrl_quad.render.flights import Flight, depth_image, obstacle_shapes

_Panel = tuple[str, dict[str, Tensor], dict[str, Any]]  # a label, lines (num_envs, time + 1) by name, how to draw them


@dataclass(frozen=True, repr=False)
class Replay:
    """A page that plays a flight. A notebook shows it below the cell.

    Args:
        html: the page.
    """

    html: str

    def __repr__(self) -> str:
        return f"Replay({len(self.html) / 1e6:.1f} MB)"

    def _repr_html_(self) -> str:
        return f'<iframe srcdoc="{html.escape(self.html)}" style="width: 100%; height: 640px; border: 0"></iframe>'


@checked
def write_replay(
    rollout: TensorDictBase,
    path: str | Path | None = None,
    *,
    env: EnvBase | None = None,
    num_envs: Size = 12,
    control_dt: Positive = 0.02,
    title: str | None = None,
) -> Replay:
    """Make the first episodes of a flight an HTML page to play, pause, scrub and turn in a browser or a notebook.

    The page shows the drones with attitude and rotor thrust, trails, and the task's markers; the obstacles of the
    environment that is followed, or of the first, with its depth images; and over time the reward terms, the actions,
    the speed, and the distance to the target (or the height). It is one file of about 5 MB, most of it plotly.js, and
    needs no network. A drone stays where its episode ended, and the page says how it ended: "success" if the last state
    fulfils the task.

    The other arguments, and errors, are those of :func:`plot_flight`.

    Args:
        rollout: (num_envs, time), of any task. It must hold ``("next", "state", "position")`` and ``("next", "state",
            "quaternion")``; the page leaves out whatever else is missing.
        env: the environment that flew, also under transforms. Without it, the page shows an X frame and the squared
            speed of each rotor.
    """
    with needing("Replays need plotly: pip install '.[render]' in a clone."):
        from plotly.offline import get_plotlyjs
    needed = [("next", "state", name) for name in ("position", "quaternion")]
    flight = Flight("write_replay", rollout, env, control_dt, needed, num_envs)
    content = json.dumps(_content(flight), default=_encoded)
    replay = page_of(content, flight.title if title is None else title, get_plotlyjs())
    if path is not None:
        with replacing(path) as temporary:
            temporary.write_text(replay.html, encoding="utf-8")
    return replay


def page_of(content: str, title: str, plotlyjs: str) -> Replay:
    """The page of a flight, from its content as JSON."""
    page, script = (Path(__file__).with_name(f"replay.{x}").read_text(encoding="utf-8") for x in ("html", "js"))
    flight = content.replace("<", "\\u003c")  # "<" could close the script
    parts = {"title": html.escape(title), "flight": flight, "plotly": plotlyjs, "script": script}
    # In one pass, so that what has been filled in is not searched again.
    return Replay(re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], page))


def _content(flight: Flight) -> dict[str, Any]:
    """The data of the page. Frame 0 is the start of the first step, frame k the state after the k-th step."""
    rollout, steps = flight.rollout, flight.steps
    starts = all(("state", name) in rollout.keys(True) for name in ("position", "quaternion"))
    first = 0 if starts else 1  # frame

    def frames(values: Tensor | None) -> Tensor | None:
        return None if values is None else values[:, first:]

    over = torch.arange(rollout.shape[1] + 1) > steps[:, None]  # panels show nothing after the end of the episode

    def panel(label: str, lines: dict[str, Tensor]) -> dict[str, Any]:
        values = torch.stack([x.masked_fill(over, math.nan) for x in lines.values()], -1)
        return {"label": label, "names": list(lines), "values": values[:, first:]}

    of_rotors = (["rotor_speed"], ["drone", "rotor_effectiveness"])
    rotors, lift = _rotors(flight, *(frames(flight.state(*name)) for name in of_rotors))
    markers, of_each = flight.named, range(len(flight) if flight.tracks else 1)
    rings = [x for i in of_each if (x := flight.markers_of(i).rings()) is not None]
    return {
        "environments": len(flight),
        "frames": rollout.shape[1] + 1 - first,
        "start": first * flight.control_dt,
        "control_dt": flight.control_dt,
        "ended": (steps - first).tolist(),
        "endings": _endings(rollout),
        "knows_drone": flight.env is not None,
        "rotors": rotors,
        "position": frames(flight.position),
        "quaternion": frames(flight.state("quaternion")),
        "lift": lift,
        "target": frames(flight.target),
        "gates": torch.cat(rings) if rings else None,
        "tracks": max(len(rings), 1),
        "gate": frames(flight.gate_index()),
        "places": markers.places,
        "curve": markers.curve,
        "shapes": [vars(shape) for i in of_each for shape in flight.markers_of(i).shapes],
        "obstacles": _obstacles(flight),
        "images": _images(flight, first),
        "panels": [panel(label, lines) | options for label, lines, options in _panels(flight)],
    }


def _obstacles(flight: Flight) -> list[dict[str, Any]]:
    """The obstacles of each environment, or of the first if all share them; none without a scene."""
    count = 0 if flight.solids(0) is None else len(flight) if flight.has_own_obstacles else 1
    nothing = {"points": torch.zeros(0, 3), "faces": torch.zeros(0, 3)}
    shapes = (obstacle_shapes(flight.solids(i)) for i in range(count))
    return [vars(shape[0]) if shape else nothing for shape in shapes]


def _images(flight: Flight, first: int) -> dict[str, Any] | None:
    """What the cameras showed, as bytes from far to near."""
    if (depth := flight.depth) is None:
        return None
    camera = None if flight.env is None else flight.env.camera
    far = depth.amax().clamp_min(1.0).item() if camera is None else camera.range
    pixels = (255.0 * depth_image(depth[:, first:], far)).round().to(torch.uint8)
    data = base64.b64encode(pixels.contiguous().numpy().tobytes()).decode("ascii")
    return {"height": depth.shape[-2], "width": depth.shape[-1], "data": data}


def _panels(flight: Flight) -> list[_Panel]:
    """What to show over time: rewards, actions, the speed, and the distance to the target or the height."""
    panels: list[_Panel] = []
    terms = flight.entries("next", "reward_terms")
    if (reward := flight.entry("next", "reward")) is not None:
        terms = {"sum" if terms else "reward": reward, **terms}
    if terms:
        lines = {name: pad(x[..., 0].float(), (1, 0), value=math.nan) for name, x in terms.items()}
        panels.append(("reward", lines, {"peaks": True}))
    if (action := flight.entry("action")) is not None:
        over = torch.arange(action.shape[1]) >= flight.steps[:, None]
        actions = pad(action.float().masked_fill(over.unsqueeze(-1), math.nan), (0, 0, 0, 1), value=math.nan)
        lines = dict(zip(flight.action_names, actions.unbind(-1), strict=True))
        panels.append(("action [-1, 1]", lines, {"held": True}))
    if flight.state("velocity") is not None:
        panels.append(("speed [m/s]", {"speed": flight.speed}, {}))
    if (distance := flight.distance) is None:
        return [*panels, ("height [m]", {"height": flight.position[..., 2]}, {})]
    label, options = f"distance to the {flight.named.target} [m]", {"log": flight.log_distance}
    return [*panels, (label, {"distance": torch.from_numpy(distance)}, options | {"success": flight.near_enough})]


def _endings(rollout: TensorDictBase) -> list[str]:
    """How each first episode ended; "" if it did not."""
    endings, done = [""] * len(rollout), rollout.get(("next", "done"), None)
    words = {"done": "ended", "terminated": "terminated", "truncated": "truncated", "success": "success"}
    for name, word in {**words, "crash": "crashed"}.items():  # the later ones override the earlier ones
        flags = rollout.get(("next", name), None)
        if flags is not None and done is not None:
            flags = at_episode_end(rollout, flags & done).tolist()
            endings = [word if flag else ending for flag, ending in zip(flags, endings, strict=True)]
    return endings


def _rotors(flight: Flight, speed: Tensor | None, works: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """Positions of m rotors (num_envs, m, 2) [m], and the lift of each (num_envs, frames, m), in thrusts that hover.

    It follows from their speeds [rad/s] and effectiveness.

    Without the environment the unit is half of the greatest squared speed of the flight.
    """
    n = len(flight)
    if flight.env is None:
        lift = None if speed is None else 2.0 * speed.square() / speed.nan_to_num().square().amax().clamp_min(1e-12)
        m = 4 if speed is None else speed.shape[-1]
        angles = 2.0 * math.pi * (torch.arange(m) + 0.5) / m
        return 0.075 * torch.stack((angles.cos(), angles.sin()), -1).expand(n, m, 2), lift

    def field(name: str) -> Tensor:
        """A field of each drone (num_envs or 1, 1, ...)."""
        value, dim = flight.env.params.value(name), QuadrotorParams.dim(name)
        if (randomised := flight.entry("next", "state", "drone", name)) is not None:
            value = randomised[:, 0]
        elif value.dim() > dim and 1 < len(value) < n:
            raise UserValueError(
                f"write_replay: env has a {name} for each of its {len(value)} environments, and the page would "
                f"show {n}. Pass the environment that flew, or num_envs={len(value)}."
            )
        return value.detach().cpu().float().reshape(-1, 1, *value.shape[-dim:])[:n]

    if speed is not None:
        k2, k1, k0 = field("thrust_map").split(1, -1)
        speed = ((k2 * speed + k1) * speed + k0) * speed.shape[-1] / (field("mass") * field("gravity"))
        speed = speed * (field("rotor_effectiveness") if works is None else works)
    places = field("rotor_positions")[:, 0, :, :2]
    return places.expand(n, *places.shape[1:]), speed


def _encoded(value: Tensor) -> str:
    """Numbers as base64 of little-endian float32."""
    return base64.b64encode(value.contiguous().numpy().astype("<f4").tobytes()).decode()
