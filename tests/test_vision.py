"""Solids, the distance to them, and rays: against MuJoCo's ray casting, finite differences and numbers by hand."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest
import torch
from helpers import cases, refuses

from torchrl_quad.dynamics import quaternion
from torchrl_quad.vision import DepthCamera, Primitives, closest_approach, nearest
from torchrl_quad.vision.primitives import SIZES, distances


def solids(seed=0, n=1, m=12):
    """Obstacles in front of the origin, with a ground and a wall."""
    random = torch.Generator().manual_seed(seed)

    def uniform(low, high):
        low, high = torch.tensor(low).double(), torch.tensor(high).double()
        return low + (high - low) * torch.rand(n, m, len(low), generator=random, dtype=torch.float64)

    turned = torch.nn.functional.normalize(torch.randn(n, m, 4, generator=random, dtype=torch.float64), dim=-1)
    planes = torch.tensor([[0.0, 0.0, 1.0, 0.0], [-0.6, 0.8, 0.0, -15.0]]).expand(n, 2, 4)
    spheres, cylinders = uniform([2, -6, 0, 0.05], [14, 6, 4, 0.6]), uniform([2, -6, 0, 0.05, 0.2], [14, 6, 3, 0.4, 4])
    boxes = torch.cat((uniform([2, -6, 0, 0.05, 0.05, 0.05], [14, 6, 4, 0.6, 0.6, 0.6]), turned), -1)
    return Primitives(spheres, cylinders, boxes, planes)


def mujoco_depth(scene, position, rays):
    """What MuJoCo measures along rays (p, 3), as multiples of them; infinity where it hits nothing."""
    geoms = [f'<geom type="sphere" size="{r}" pos="{x} {y} {z}"/>' for x, y, z, r in scene.spheres[0].tolist()]
    for x, y, z, r, height in scene.cylinders[0].tolist():
        geoms.append(f'<geom type="cylinder" size="{r} {height / 2}" pos="{x} {y} {z + height / 2}"/>')
    for x in scene.boxes[0].tolist():
        at, size, turned = (" ".join(map(str, part)) for part in (x[:3], x[3:6], x[6:]))
        geoms.append(f'<geom type="box" size="{size}" pos="{at}" quat="{turned}"/>')
    for x in scene.planes[0].tolist():
        at, normal = " ".join(str(x[3] * y) for y in x[:3]), " ".join(map(str, x[:3]))
        geoms.append(f'<geom type="plane" size="0 0 1" pos="{at}" zaxis="{normal}"/>')
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{''.join(geoms)}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    length = rays.norm(dim=-1).numpy()
    hit, found = np.zeros(len(rays), np.int32), np.zeros(len(rays))
    flat = (rays.numpy() / length[:, None]).flatten()
    mujoco.mj_multiRay(model, data, position.numpy(), flat, None, 1, -1, hit, found, None, len(rays), 1e6)
    return np.where(found < 0, np.inf, found / length)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_every_pixel_is_where_mujoco_sees_it_or_at_a_silhouette(dtype):
    camera = DepthCamera(width=80, height=60, position=(0.05, 0.0, -0.02), pitch=0.2, range=20.0)
    for seed in range(3):
        scene = solids(seed)
        attitude = quaternion.from_axis_angle(torch.tensor([[0.2, -0.1, 0.3 * seed]], dtype=torch.float64))
        position = torch.tensor([[-0.5, 0.2, 1.5 + 0.3 * seed]], dtype=torch.float64)
        place, look = camera.pose(position, attitude)
        plane = camera.plane(position)
        rays = torch.cat((torch.ones(1, camera.pixels, dtype=torch.float64), plane)).T
        truth = mujoco_depth(scene, place[0], quaternion.rotate(look, rays)).reshape(60, 80).clip(max=20.0)
        seen = camera.depth(Primitives(*(x.to(dtype) for x in scene)), position.to(dtype), attitude.to(dtype))
        wrong = np.abs(seen[0, 0].double().numpy() - truth) > 1e-3
        around = np.lib.stride_tricks.sliding_window_view(np.pad(truth, 1, mode="edge"), (3, 3))
        silhouette = around.max((2, 3)) - around.min((2, 3)) > 0.05
        assert not (wrong & ~silhouette).any()
        assert wrong.mean() < 1e-3, "hardly any pixel may differ at a silhouette"
        assert len(np.unique(truth.round(3))) > 500, "the picture shows something"
        ray = dataclasses.replace(camera, along_ray=True).depth(scene, position, attitude)[0, 0].numpy()
        near = truth < 12.0
        np.testing.assert_allclose(ray[near], (truth * rays.norm(dim=-1).numpy().reshape(60, 80))[near], atol=1e-3)


def test_distances_are_those_worked_by_hand():
    scene = Primitives(
        torch.tensor([[[0.0, 0.0, 5.0, 1.0]]]),
        torch.tensor([[[3.0, 0.0, 0.0, 0.5, 2.0]]]),
        torch.tensor([[[0.0, 4.0, 1.0, 1.0, 0.5, 1.0, math.cos(math.pi / 8), 0.0, 0.0, math.sin(math.pi / 8)]]]),
        torch.tensor([[[0.0, 0.0, 1.0, 0.0]]]),
    )
    points = torch.tensor([[[0.0, 0.0, 2.0], [3.0, 0.0, 1.0], [4.5, 0.0, 3.0], [0.0, 4.0, 1.0], [0.0, 4.0, 4.0]]])
    found = distances(scene, points)[0]
    assert found[0, :2].tolist() == pytest.approx([2.0, 2.5])  # below the ball, level with the top of the pillar
    # On its axis, half a metre from its side; a metre beside its edge, and a metre above.
    assert found[1:3, 1].tolist() == pytest.approx([-0.5, 2.0**0.5])
    assert found[3:, 2].tolist() == pytest.approx([-0.5, 2.0])  # in the middle of the box, and above it
    assert found[:, 3].tolist() == points[0, :, 2].tolist()


def test_the_gradient_of_the_distance_is_a_unit_vector_finite_everywhere_and_that_of_finite_differences():
    scene = solids(3)
    random = torch.Generator().manual_seed(0)
    points = torch.rand(200, 3, generator=random, dtype=torch.float64) * torch.tensor([14.0, 12.0, 4.0])
    points = (points - torch.tensor([0.0, 6.0, 0.0])).requires_grad_()
    distance, away = nearest(scene, points)
    (gradient,) = torch.autograd.grad(distance.sum(), points)
    torch.testing.assert_close(gradient, away, atol=1e-8, rtol=0)
    step = 1e-6 * torch.eye(3, dtype=torch.float64)
    slopes = [(nearest(scene, points + e)[0] - nearest(scene, points - e)[0]) / 2e-6 for e in step]
    assert ((torch.cat(slopes, -1) - gradient).norm(dim=-1) < 1e-5).float().mean() > 0.97  # but where surfaces change
    assert gradient.norm(dim=-1).allclose(torch.ones(200, dtype=torch.float64))
    # Centres, axes, edges, corners, and far away: nothing unique, and nothing infinite.
    x = scene.boxes[0, 0]
    corner = x[:3] + quaternion.rotate(x[6:], x[3:6])
    special = [scene.spheres[0, 0, :3], scene.cylinders[0, 0, :3], x[:3], corner, torch.full((3,), 1e5).double()]
    special = torch.stack(special).requires_grad_()
    distance, away = nearest(scene, special)
    (distance.sum() + (away * torch.rand(3).double()).sum()).backward()
    assert special.grad.isfinite().all()
    assert away.isfinite().all()


def test_a_fast_drone_does_not_pass_through_a_thin_tree_and_a_close_miss_is_none():
    tree = torch.tensor([[[0.5, 0.0, 0.0, 0.01, 5.0]]], dtype=torch.float64)
    scene = Primitives(*(tree if kind == "cylinders" else tree.new_zeros(1, 0, size) for kind, size in SIZES.items()))
    start, way = torch.tensor([[0.0, 0.0, 2.0]]).double(), torch.tensor([[1.0, 0.0, 0.0]]).double()
    for y, offset, error in ((0.0, 0.13, 1 / 64), (0.129, 0.1, 1e-3), (0.141, 0.2, 1e-3), (0.3, 0.0, 1e-4)):
        begin = start + torch.tensor([[offset, y, 0.0]])
        found = closest_approach(scene, begin, begin + way)
        assert found.item() == pytest.approx(y - 0.01, abs=error) and (found < 0.13) == (y < 0.14)
    # Against many samples, for all kinds of solids, in the steps of a drone at 20 m/s.
    scene = solids(4, n=64, m=6)
    random = torch.Generator().manual_seed(1)
    start = torch.rand(64, 3, generator=random, dtype=torch.float64) * torch.tensor([12.0, 10.0, 3.0])
    start = start - torch.tensor([0.0, 5.0, -0.3])
    end = start + 0.4 * torch.nn.functional.normalize(torch.randn(64, 3, generator=random, dtype=torch.float64))
    share = torch.linspace(0, 1, 401, dtype=torch.float64)[:, None]
    truth = distances(scene, start[:, None] + share * (end - start)[:, None]).flatten(1).amin(1, keepdim=True)
    found = closest_approach(scene, start, end)
    outside = truth > 0.05
    assert ((found - truth).abs()[outside] < 5e-4).all() and ((found - truth).abs() < 0.4 / 64).all()


def test_the_derivative_of_depth_in_the_pose_is_that_of_finite_differences_but_at_silhouettes():
    camera = DepthCamera(width=20, height=15, position=(0.05, 0.0, 0.02), pitch=0.1, range=18.0, differentiable=True)
    scene = solids(5)
    position = torch.tensor([[-0.5, 0.2, 1.6]], dtype=torch.float64, requires_grad=True)
    turn = torch.tensor([[0.2, -0.1, 0.1]], dtype=torch.float64, requires_grad=True)

    def depth(position, turn):
        return camera.depth(scene, position, quaternion.from_axis_angle(turn)).flatten()

    found = torch.autograd.functional.jacobian(depth, (position, turn))
    for which, jacobian in enumerate(found):
        for axis in range(3):
            step = torch.zeros(1, 3, dtype=torch.float64)
            step[0, axis] = 1e-6
            moved = [(position + s * step, turn) if which == 0 else (position, turn + s * step) for s in (1, -1)]
            slope = (depth(*moved[0]) - depth(*moved[1])) / 2e-6
            error = (slope - jacobian[:, 0, axis]).abs() / (1.0 + slope.abs())
            assert (error < 1e-4).float().mean() > 0.95  # the others graze a surface, or pass an edge
            assert jacobian.isfinite().all()
    assert found[0].abs().max() > 0.5


def test_noise_is_proportional_to_depth_and_drops_its_share_of_pixels():
    camera = DepthCamera(width=100, height=100, noise=0.05, dropout=0.2, range=10.0)
    depth = torch.full((4, 1, 100, 100), 4.0)
    depth[:, :, :50] = 10.0
    seen = camera.measure(depth, torch.randn(4, 10_000, generator=torch.Generator().manual_seed(0)))
    lost = seen == 0.0
    assert lost.float().mean() == pytest.approx(0.2, abs=0.01)
    assert (seen[:, :, :50][~lost[:, :, :50]] == 10.0).all(), "nothing is measured where nothing is"
    near = seen[:, :, 50:][~lost[:, :, 50:]]
    assert near.mean() == pytest.approx(4.0, abs=0.02) and near.std() == pytest.approx(0.2, rel=0.05)


@cases(
    ({"field_of_view": math.radians(171)}, "field_of_view must be at most 2.967, got 2.98"),
    ({"field_of_view": 90}, "got 90. The horizontal .*; 90 degrees are 1.571 rad"),
    ({"width": 10, "height": 300, "field_of_view": 1.0}, "10 square pixels span 173"),
    ({"quaternion": (1.0, 1.0, 0.0, 0.0)}, "of unit norm"),
    ({"pitch": 0.1, "quaternion": (1.0, 0.0, 0.0, 0.0)}, "Give one of them"),
)
def test_cameras_that_cannot_be_are_refused(options, message):
    refuses(message.replace("?", r"\?"), DepthCamera, **options)
