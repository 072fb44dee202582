"""Rays per second of the depth camera on one core, compared with MuJoCo's ray casting: python -m benchmarks.camera

Every camera has a scene of its own: upright cylinders, or a third each of balls, cylinders and boxes turned at random.
Time is that of the processor; the best of all rounds counts.
"""

import time
from collections.abc import Callable

import mujoco
import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks.report import command_line, save
from torchrl_quad.dynamics import quaternion
from torchrl_quad.vision import DepthCamera, Primitives

KINDS = {"trees": ("cylinders",), "mixed": ("spheres", "cylinders", "boxes")}
FAR = 20.0  # [m]


def scenes(n: int, count: int, kinds: tuple[str, ...]) -> Primitives:
    """So many obstacles in each of n scenes, 1 m to 20 m ahead."""
    share = {kind: len(range(i, count, len(kinds))) for i, kind in enumerate(kinds)}

    def place(m: int, low: float, high: float) -> Tensor:
        ground = torch.rand(n, m, 2) * torch.tensor([19.0, 20.0]) + torch.tensor([1.0, -10.0])
        return torch.cat((ground, low + (high - low) * torch.rand(n, m, 1)), -1)

    balls, trees, boxes = (share.get(kind, 0) for kind in ("spheres", "cylinders", "boxes"))
    turned = torch.nn.functional.normalize(torch.randn(n, boxes, 4), dim=-1)
    return Primitives(
        torch.cat((place(balls, 0.0, 4.0), 0.1 + 0.3 * torch.rand(n, balls, 1)), -1),
        torch.cat((place(trees, 0.0, 0.0), 0.1 + 0.3 * torch.rand(n, trees, 1), 1 + 4 * torch.rand(n, trees, 1)), -1),
        torch.cat((place(boxes, 0.0, 4.0), 0.1 + 0.3 * torch.rand(n, boxes, 3), turned), -1),
        torch.zeros(n, 0, 4),
    )


def fastest(function: Callable[[], object], rounds: int) -> float:
    """The least processor time of a call [s]."""
    times = []
    for _ in range(rounds):
        begin = time.process_time()
        function()
        times.append(time.process_time() - begin)
    return min(times)


def in_mujoco(solids: Primitives, i: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
    geoms = []
    for x, y, z, radius in solids.spheres[i].tolist():
        geoms.append(f'<geom type="sphere" size="{radius}" pos="{x} {y} {z}"/>')
    for x, y, z, radius, height in solids.cylinders[i].tolist():
        geoms.append(f'<geom type="cylinder" size="{radius} {height / 2}" pos="{x} {y} {z + height / 2}"/>')
    for x in solids.boxes[i].tolist():
        at, size, turned = (" ".join(map(str, part)) for part in (x[:3], x[3:6], x[6:]))
        geoms.append(f'<geom type="box" size="{size}" pos="{at}" quat="{turned}"/>')
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{''.join(geoms)}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def measure(name: str, count: int, n: int, width: int, height: int, rounds: int) -> dict[str, float | str]:
    """Million rays per second of ours, compiled and eager, and of MuJoCo."""
    torch.manual_seed(0)
    solids, camera = scenes(n, count, KINDS[name]), DepthCamera(width=width, height=height, range=FAR)
    position = torch.tensor([0.0, 0.0, 1.5]).repeat(n, 1)
    attitude = quaternion.from_axis_angle(0.05 * torch.randn(n, 3))
    ours = camera.depth(solids, position, attitude, fused=True)
    compiled = fastest(lambda: camera.depth(solids, position, attitude, fused=True), rounds)
    eager = fastest(lambda: camera.depth(solids, position, attitude), max(rounds // 8, 1))

    directions = torch.cat((torch.ones(1, camera.pixels), camera.plane(position))).T
    rays = quaternion.rotate(attitude.unsqueeze(1), directions.expand(n, -1, -1)).double()
    length = rays.norm(dim=-1, keepdim=True)
    rays, length = (rays / length).flatten(1).numpy(), length.squeeze(-1).numpy()
    worlds = [in_mujoco(solids, i) for i in range(n)]
    origin, hit, found = np.array([0.0, 0.0, 1.5]), np.zeros(camera.pixels, np.int32), np.zeros((n, camera.pixels))

    def cast() -> None:
        for i, (model, data) in enumerate(worlds):
            mujoco.mj_multiRay(
                model, data, origin, rays[i], None, 1, -1, hit, found[i], None, camera.pixels, FAR * length[i].max()
            )

    theirs = fastest(cast, max(rounds // 4, 1))
    truth = np.where(found < 0, FAR, found / length).clip(max=FAR).reshape(ours.shape)
    million = 1e-6 * n * camera.pixels
    return {
        "scene": name,
        "primitives": count,
        "image": f"{width} x {height}",
        "cameras": n,
        "compiled [Mray/s]": round(million / compiled, 2),
        "eager [Mray/s]": round(million / eager, 2),
        "MuJoCo [Mray/s]": round(million / theirs, 2),
        "compiled / MuJoCo": round(theirs / compiled, 1),
        "other pixels [%]": round(100 * float((np.abs(ours.numpy() - truth) > 1e-3).mean()), 4),
    }


def main() -> None:
    images = ["256x16x12", "16x64x48"]  # cameras x width x height
    options = {"primitives": [10, 30, 100], "scenes": list(KINDS), "images": images, "rounds": 32}
    args = command_line(__doc__, "camera.csv", **options)
    cases = [
        (name, count, *map(int, image.split("x")))
        for name in args.scenes
        for image in args.images
        for count in args.primitives
    ]
    save(args.output, [measure(*case, args.rounds) for case in tqdm(cases)], mujoco=mujoco.__version__)


if __name__ == "__main__":
    main()
