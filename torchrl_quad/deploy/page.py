"""The page of a bundle, for people who write firmware and have read nothing of ours."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from torchrl_quad.deploy import contract as contracts
from torchrl_quad.deploy.network import fill_in
from torchrl_quad.deploy.tasks import PROGRESS


def write_page(contract: Mapping[str, Any]) -> bytes:
    """The content of ``README.md``, for people who have not read ours."""
    task, output = contract["task"], contract["output"]
    columns = ("name", "scale", "unit", "frame", "meaning")
    inputs = [
        " | ".join((f"| {x['start']} to {x['stop'] - 1}", *(f"{x[column]}" for column in columns), "")).rstrip()
        for x in contract["inputs"]
    ]
    rules = {
        "target": "The target is `task.target`; give another one if you like, the policy sees the difference alone.",
        "curve": "The point moves along the curve of `task`: offset + sum over k = 1, 2, ... of cosine[k-1] "
        "cos(k phase) + sine[k-1] sin(k phase). The phase starts anywhere, and grows by 2 pi control_dt / period in "
        "each control step after the first. Point i = 1, 2, ... has the phase + 2 pi i lookahead_interval / period.",
        "course": "The command leads to `task.target` at `task.speed`; give others if you like. Speeds in training "
        "were {:g} to {:g} m/s.".format(*task.get("speeds", (0, 0))),
        "gates": "A gate is passed when the straight line between the measured positions of two control steps comes "
        "nearer to its centre than `task.gate_radius`; training counted with true positions. The observation of that "
        "step is already about the gate after it. After the last gate comes the first.",
    }
    queue, camera, memory = (contract[name] for name in ("action_queue", "camera", "memory"))
    size = contract["inputs"][-1]["stop"]
    reads, given, written = [f"{size} numbers"], [f"`observation` (batch, {size})"], ["`action` (batch, 4)"]
    if camera:
        reads.append(f"an image of {camera['width']} x {camera['height']} pixels")
        given.append(f"`depth` (batch, 1, {camera['height']}, {camera['width']})")
    if memory:
        reads.append("its own memory")
        given.append(f"`memory` (batch, {memory})")
        written.append(f"`next_memory` (batch, {memory})")
    values = {
        "task": task["name"],
        "reads": " and ".join((", ".join(reads[:-1]), f"{reads[-1]},")) if reads[1:] else reads[0],
        "inputs_of_onnx": ", ".join(given),
        "outputs_of_onnx": ", ".join(written),
        "memory": memory,
        "inputs": "\n".join(inputs),
        "rule": rules[task["rule"]],
        "success": task["success"],
        "progress": "`, `".join(PROGRESS[task["rule"]]),
        "sign": contract["quaternion"]["sign"],
        "queue": (
            "They start as hover actions. After each step drop the oldest four numbers and append the action."
            if queue["observed"]
            else "This policy does not observe the commands on their way."
        ),
        "max_thrust": f"{output['thrust']['range'][1]:.6g}",
        "weight": f"{output['thrust']['weight']:.6g}",
        "rates": ", ".join(f"{high:g}" for _, high in output["body_rate"]["range"]),
        "hover": ", ".join(f"{x:.6g}" for x in output["hover_action"]),
        "control_dt": f"{contract['control_dt']:g}",
        "delay": contract["action_delay"],
        "delay_seconds": f"{contract['action_delay'] * contract['control_dt']:g}",
        "age": f"{contract['limits']['max_state_age']:g}",
        "fields": contracts.schema_table(),
        "package": contract["origin"]["package"],
    }
    if camera:
        values |= {f"camera_{name}": f"{x:g}" for name, x in camera.items() if isinstance(x, int | float)}
        values |= {f"camera_{name}": ", ".join(f"{x:.6g}" for x in camera[name]) for name in ("position", "quaternion")}
        values["camera_angle"] = f"{math.degrees(camera['field_of_view']):g}"
        values["camera_age"] = f"{contract['limits']['max_depth_age']:g}"
        values["camera_pixel"] = (
            "the length of its ray to" if camera["along_ray"] else "the depth, along the optical axis, of"
        )
    features = [name for name in ("camera", "memory") if contract[name]]
    return fill_in("README.md", values, features).encode()
