"""The page of a bundle, for people who write firmware and have read nothing of ours."""

from __future__ import annotations

import inspect
import math

from torchrl_quad.deploy import contract as contracts
from torchrl_quad.deploy.contract import Contract
from torchrl_quad.deploy.network import fill_in


def write_page(contract: Contract, documentation: str | None) -> bytes:
    """The content of ``README.md``.

    Args:
        contract: of the bundle.
        documentation: of the class of its task.
    """
    task, output, graphs = contract["task"], contract["output"], contract["graphs"]
    reads = [(name, f"{x['shape']} {x.get('unit', '')}") for name, x in graphs["policy"]["reads"].items()]
    columns = ("dtype", "unit", "frame")
    tensors = [
        f"| `{graph}.onnx` | {side} | `{name}` | {'x'.join(map(str, x['shape'])) or '1'} | "
        + " | ".join(x.get(column, "") for column in columns)
        + " |"
        for graph, sides in graphs.items()
        for side in ("reads", "writes")
        for name, x in sides[side].items()
    ]
    camera, memory = contract["camera"], contract["memory"]
    entries = ", ".join(f"`{name}`" for name in task["entries"]) or "none"
    lines = inspect.cleandoc(documentation or "There is none.").splitlines()
    values = {
        "task": task["name"],
        "reads": " and ".join(f"`{name}` {about.strip()}" for name, about in reads),
        "documentation": "\n".join(f"    {line}".rstrip() for line in lines),
        "tensors": "\n".join(tensors),
        "entries": entries,
        "starts": ", ".join(f"`{name}`" for name in (*contracts.MEASURED, *task["entries"])),
        "memory": memory,
        "sign": contract["quaternion"]["sign"],
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
    features += ["advance"] if "advance" in graphs else []
    features += [] if task["unjudged"] else ["judged"]
    return fill_in("README.md", values, features).encode()
