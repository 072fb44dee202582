"""The pilots of any_drone.py: ours, RAPTOR, and a regulator that knows each drone."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_quad import load_drone
from torchrl_quad.dynamics import quaternion
from torchrl_quad.training.building import build_env, task_of
from torchrl_quad.training.evaluation import load_policy

DT = 0.01  # [s]
SPIN = [-1.0, 1.0, -1.0, 1.0]  # front right, back right, back left, front left
Motion = tuple[Tensor, Tensor, Tensor, Tensor]  # position from the target, quaternion, velocity, body rates: (n, k)


class Ours:
    """A trained policy, with its memory and the commands that it has given; tells shares of thrust (n, 4)."""

    tells_speed = False

    def __init__(self, checkpoint: Path) -> None:
        cfg, self.actor, _ = load_policy(checkpoint, trust=["benchmarks.any_drone.Worn"])
        self.env = task_of(build_env(cfg, 1, 0))
        self.size = sum(p.numel() for p in self.actor.parameters())
        self.remembered: list[Tensor] | None = None  # its memory after each of the first 100 steps, for the probe

    def reset(self, n: int) -> None:
        queue = self.env.hover_action.expand(n, self.env.action_delay, 4).clone()
        memory = self.actor.make_tensordict_primer().primers["recurrent_state"]
        self.td = TensorDict({"recurrent_state": torch.zeros(n, *memory.shape[-2:])}, [n])
        self.td["is_init"], self.queue = torch.ones(n, 1, dtype=torch.bool), queue

    def __call__(self, motion: Motion) -> Tensor:
        position, attitude, velocity, rates = motion
        self.td["observation"] = torch.cat((-position, 10 * attitude, velocity, rates, self.queue.flatten(1)), -1)
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            self.td = self.actor(self.td)
        action = self.td["action"]
        self.queue = torch.cat((self.queue[:, 1:], action.unsqueeze(1)), 1)
        self.td["recurrent_state"] = self.td["next", "recurrent_state"]
        self.td["is_init"] = torch.zeros_like(self.td["is_init"])
        if self.remembered is not None and len(self.remembered) < 100:
            self.remembered.append(self.td["recurrent_state"].flatten(1))
        return 0.5 + 0.5 * action


class Raptor:
    """RAPTOR as it is published; tells shares of rotor speed (n, 4)."""

    tells_speed, size = True, 2084

    def __init__(self) -> None:
        from foundation_policy import QuadrotorPolicy

        self.policy = QuadrotorPolicy()

    def reset(self, n: int) -> None:
        self.policy.reset()
        self.action = np.zeros((n, 4))

    def __call__(self, motion: Motion) -> Tensor:
        position, attitude, velocity, rates = motion
        axes = torch.eye(3).expand(len(attitude), 3, 3).unbind(1)
        turned = torch.stack([quaternion.rotate(attitude, axis) for axis in axes], -1)
        read = torch.cat((position, turned.flatten(1), velocity, rates), -1).double().numpy()
        self.action = self.policy.evaluate_step(np.concatenate((read, self.action), -1)).clip(-1.0, 1.0)
        return torch.tensor(0.5 + 0.5 * self.action, dtype=torch.float32)


class Informed:
    """A linear-quadratic regulator that knows each drone, its lag, its delay and its rotor speeds: what it flies can be
    flown. It tells shares of thrust (n, 4)."""

    tells_speed, size = False, ""
    state: Any  # of the environment, now

    def reset(self, n: int) -> None:
        self.gains: list[Tensor] = []

    def __call__(self, motion: Motion) -> Tensor:
        position, attitude, velocity, rates = (x.double() for x in motion)
        if not self.gains:
            self.know()
        # Along the nose and to the left, how far off (as of one metre at most), how fast, how tilted and how turning.
        nose = quaternion.rotate(attitude, torch.eye(3).double()[:1].expand(len(rates), 3))[:, :2]
        nose = nose / nose.norm(dim=-1, keepdim=True)
        level = torch.stack((nose, torch.stack((-nose[:, 1], nose[:, 0]), -1)), 1)
        off = (level @ position[:, :2, None]) / position[:, :2].norm(dim=-1).clamp_min(1.0).view(-1, 1, 1)
        speed, up = level @ velocity[:, :2, None], quaternion.up_in_body(attitude)
        now = self.accelerations(self.share(self.state["rotor_speed"].double()).unsqueeze(1))
        coming = self.accelerations(0.5 + 0.5 * self.state["action_queue"].double())
        wanted = []
        for axis, x in ((0, (position[:, 2].clamp(-1.0, 1.0), velocity[:, 2])), (1, ()), (2, ())):
            if axis:  # a roll to the right and a pitch forward
                side, sign = 2 - axis, 2.0 * axis - 3.0
                tilt = torch.atan2(-sign * up[:, side], up[:, 2])
                x = (sign * off[:, side, 0], sign * speed[:, side, 0], tilt, rates[:, axis - 1])
            known = torch.cat((torch.stack(x, 1), now[..., axis], coming[..., axis]), 1)
            wanted.append(-(self.gains[axis] * known).sum(1))
        lift = (wanted[0] + 9.81) / up[:, 2].clamp_min(0.5)
        mean = (lift / self.effect[:, 0].sum(-1)).maximum(0.2 * self.hover).clamp_max(0.85).unsqueeze(1)
        room, none = torch.minimum(mean, 1.0 - mean), torch.zeros_like(lift)
        for part, share in (((none, wanted[1], wanted[2], none), 0.9), ((none, none, none, -rates[:, 2]), 0.1)):
            more = torch.linalg.solve(self.effect, torch.stack(part, -1))
            mean = mean + more * (share * room / more.abs().amax(1, keepdim=True).clamp_min(1e-12)).clamp_max(1.0)
        return mean.clamp(0.0, 1.0).float()

    def share(self, speed: Tensor) -> Tensor:
        """The share of the greatest thrust of rotors (n, 4) at their speeds."""
        powers = (speed.unsqueeze(-1) ** torch.arange(2, -1, -1)) @ self.curve.unsqueeze(-1)
        return powers.squeeze(-1) / self.full

    def accelerations(self, share: Tensor) -> Tensor:
        """Up, beyond gravity, and about x, y and z, (n, k, 4), of the shares of thrust (n, k, 4)."""
        return share @ self.effect.mT - torch.tensor([9.81, 0.0, 0.0, 0.0]).double()

    def know(self) -> None:
        """Work out what each drone's rotors do, and its gains."""
        drone = {name: x.double() for name, x in self.state["drone"].items()}
        self.curve, self.full = drone["thrust_map"], 1.0
        self.full = self.share(load_drone("cf2x", torch.float64).rotor_speed_max.expand(len(self.curve), 1))
        x, y = drone["rotor_positions"].unbind(-1)
        turn = torch.stack((y, -x, drone["yaw_torque_coefficient"] * torch.tensor(SPIN)), 1)
        lift = torch.ones_like(x).unsqueeze(1) / drone["mass"].unsqueeze(-1)
        self.effect = self.full.unsqueeze(-1) * torch.cat((lift, turn / drone["inertia"].unsqueeze(-1)), 1)
        self.hover = 9.81 / self.effect[:, 0].sum(-1)
        most = 0.5 * self.effect.abs().sum(-1)  # acceleration
        usual = [0.5 * (most[:, 0] * 2 - 9.81), *(0.12 * most[:, 1:3]).clamp_max(30.0).unbind(1)]
        lag = drone["motor_time_constant"].mean(-1)
        chains = [[1.0, 1.0], [1.0, 9.81, 1.0, 1.0], [1.0, 9.81, 1.0, 1.0]]  # from a position to an acceleration
        self.gains = [self.regulator(chain, lag, u) for chain, u in zip(chains, usual, strict=True)]

    def regulator(self, chain: list[float], lag: Tensor, usual: Tensor) -> Tensor:
        """Gains (n, k) for a chain of integrators, its lagged input and three commands on their way."""
        n, k = len(lag), len(chain)
        flow = torch.zeros(n, k + 2, k + 2).double()
        for i, factor in enumerate(chain):
            flow[:, i, i + 1] = factor
        flow[:, k, k], flow[:, k, k + 1] = -1 / lag, 1 / lag
        moved = torch.linalg.matrix_exp(DT * flow)
        both = torch.zeros(n, k + 4, k + 5).double()
        both[:, : k + 1, : k + 1] = moved[:, : k + 1, : k + 1]
        both[torch.arange(n), : k + 1, k + 4 - self.state["delay"][:, 0]] = moved[:, : k + 1, k + 1]
        both[:, range(k + 1, k + 4), range(k + 2, k + 5)] = 1.0
        a, b = both.split((k + 4, 1), -1)
        cost = usual.view(-1, 1, 1) ** -2.0
        one, x, y = torch.eye(k + 4).double(), a, b @ b.mT / cost
        p = torch.diag(torch.tensor([1.0, 0.1] + [0.0] * (k + 2)).double()).expand(n, -1, -1)
        for _ in range(20):  # the doubling of Anderson 1978: to Riccati's solution of 2^20 steps
            half = torch.linalg.inv(one + y @ p)
            x, y, p = x @ half @ x, y + x @ half @ y @ x.mT, p + x.mT @ p @ half @ x
        return torch.linalg.solve(cost + b.mT @ p @ b, b.mT @ p @ a)[:, 0]
