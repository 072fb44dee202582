"""Model predictive control with the simulator as its model."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.func import vjp, vmap
from torch.nn.functional import normalize, pad

from torchrl_quad.controllers.policy import Controller, Reference, State, follow
from torchrl_quad.dynamics import quaternion
from torchrl_quad.errors import UserValueError, shown
from torchrl_quad.options import between, checked

# Of the squared residuals: each is the square of what one unit of it weighs, and half of it counts.
WEIGHTS = {
    "position": 25.0,  # [1/m2]
    "attitude": 0.0,  # of the quaternion; thrust must follow the position in any case, and the heading is free
    "velocity": 2.25,  # [s2/m2]
    "angular_velocity": 0.01,  # [s2/rad2]
    "action": 0.01,
    "terminal": 10.0,  # factor of all but the action at the end of the horizon
}
SHORTENED = (1.0, 0.5, 0.2, 0.05)  # shares of a step of Gauss-Newton that are tried at once


@checked
class MPC(Controller):
    r"""Model predictive control: at each step, plan actions through the physics of the environment, and fly the first.

    The plan minimises the squared distance from the reference over a horizon of H control steps,

    .. math:: \tfrac12 \sum_{t=1}^{H} |x_t - \bar x_t|^2_{Q_t} + \tfrac12 \sum_{t=0}^{H-1} |u_t - \bar u_t|^2_R,
        \qquad x_{t+1} = f(x_t, u_t), \quad |u_t| \le 1,

    where f is a control step of the nominal drone, with rate loop, mixer and rotor lag, integrated as the environment
    does it. The reference gives position and velocity; its acceleration gives the attitude, by the shortest turn from
    the present one, and the thrust. The heading is free where attitude has no weight, as by default.

    A step of Gauss-Newton linearises f along the plan by automatic differentiation, and solves the linear-quadratic
    problem that is left by Riccati's recursion, within the bounds of the actions: iLQR (Li and Todorov 2004) with
    control limits (Tassa, Mansard and Todorov 2014). Of some lengths of the step it takes the best, and none where all
    are worse. The next control step starts from this plan, moved by one step, so that a single iteration is usual
    ("real-time iteration", Diehl 2001). The plan (num_envs, H, 4) stands in the tensordict under ``plan``, which a
    rollout hands on. Where it is missing, or an episode begins, the reference gives the first.

    Args:
        env, reference: as for :class:`~torchrl_quad.controllers.policy.Controller`, which gives the errors, too.
        horizon: control steps of a plan, 1 to 1000.
        iterations: steps of Gauss-Newton in each control step, 1 to 100.
        weights: changes of the default weights by name, 0 to 1e6; that of action is 1e-6 or more.
    """

    def __init__(
        self,
        env: Any,
        *,
        horizon: Annotated[int, between(1, 1_000)] = 20,
        iterations: Annotated[int, between(1, 100)] = 1,
        reference: Reference | None = None,
        weights: Mapping[str, Annotated[float, between(0.0, 1e6)]] | None = None,
    ) -> None:
        super().__init__(env, reference)
        for name in (name for name in weights or {} if name not in WEIGHTS):
            raise UserValueError(f"weights: unknown weight {shown(name)}. Choose from: {', '.join(WEIGHTS)}.")
        all_weights = {**WEIGHTS, **(weights or {})}
        if all_weights["action"] < 1e-6:
            raise UserValueError(f"weights: action must be at least 1e-6, got {all_weights['action']!r}.")
        self.out_keys.append("plan")
        self.horizon, self.iterations = horizon, iterations
        self.hover_speed, like = self.dynamics.controller.hover_speed, self.nominal.mass
        self.sizes = dict(self.dynamics.sizes)
        of_entries = {**all_weights, "quaternion": all_weights["attitude"]}
        costs = [like.new_full((k,), of_entries.get(name, 0.0)) for name, k in self.sizes.items()]
        self.state_cost = torch.cat(costs).repeat(horizon, 1)
        self.state_cost[-1] *= all_weights["terminal"]
        self.action_cost = like.new_full((4,), all_weights["action"])
        self.times = self.lead + self.control_dt * torch.arange(horizon + 1).to(like)
        self.shares = like.new_tensor(SHORTENED)[:, None, None]

    def compile(self, **options: Any) -> None:
        """Compile a control step of the model and its derivatives, with options of ``torch.compile``: two minutes the
        first time, and about four times faster from then on. The whole would unroll the horizon."""
        options = {"fullgraph": True, "dynamic": False, **options}
        self.step = torch.compile(self.step, **options)
        self.linearise = torch.compile(self.linearise, **options)

    def act(self, state: State, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the plan and its first action, for the drone as it will be when the action takes effect."""
        start = self.pack(state)
        goal, neutral = self.goal(state)
        actions = self.begin(tensordict.get("plan", None), state, neutral)
        states = self.predict(start, actions)
        for _ in range(self.iterations):
            states, actions = self.improve(states, actions, goal, neutral)
        tensordict.set("plan", actions.transpose(0, 1).contiguous())
        return tensordict.set("action", actions[0].clone())

    def goal(self, state: State) -> tuple[Tensor, Tensor]:
        """The wanted states at the end of each step, (H, n, 17) with four rotors, and actions that suit them."""
        attitude = state["quaternion"]
        motion = follow(self.reference, state, self.times)
        force = (motion.acceleration + pad(self.nominal.gravity, (2, 0)).view(-1, 1, 3)).transpose(0, 1)
        now = quaternion.rotate(attitude, pad(torch.ones_like(attitude[:, :1]), (2, 0))).expand_as(force)
        up = normalize(force, dim=-1)
        turn = torch.cat((1.0 + (now * up).sum(-1, keepdim=True), torch.linalg.cross(now, up)), -1)
        wanted = quaternion.multiply(quaternion.normalize(turn), attitude.expand(*up.shape[:-1], 4))
        position, velocity = motion.position.transpose(0, 1), motion.velocity.transpose(0, 1)
        hovering = up.new_ones(*up.shape[:-1], self.sizes["rotor_speed"])
        goal = torch.cat((position, wanted, velocity, torch.zeros_like(up), hovering), -1)
        thrust = self.nominal.mass * torch.linalg.vector_norm(force, dim=-1, keepdim=True)
        neutral = self.dynamics.controller.encode(pad(thrust, (0, 3))).clamp(-1.0, 1.0)
        return goal[1:], neutral[:-1]

    def begin(self, plan: Tensor | None, state: State, neutral: Tensor) -> Tensor:
        """The actions (H, n, 4) to improve: the last plan, moved by a step, or those that suit the reference."""
        if plan is None or plan.shape != (neutral.shape[1], self.horizon, 4):
            return neutral
        plan = plan.detach().transpose(0, 1)
        goes_on = (state["step"][:, 0] > 0) & plan.isfinite().all(-1).all(0)
        return torch.where(goes_on[:, None], torch.cat((plan[1:], plan[-1:])), neutral)

    def improve(self, states: Tensor, actions: Tensor, goal: Tensor, neutral: Tensor) -> tuple[Tensor, Tensor]:
        """One step of Gauss-Newton from a trajectory (H + 1, n, 17) and its actions (H, n, 4); never to a worse one."""
        of_states = self.state_cost, self.state_cost.unsqueeze(1) * (states[1:] - goal)
        of_actions = self.action_cost, self.action_cost * (actions - neutral)
        transition, bounds = self.linearise(states[:-1], actions), (-1.0 - actions, 1.0 - actions)
        steps, gains = feedback(transition, of_states, of_actions, bounds)
        state = states[0].expand(len(SHORTENED), -1, -1)
        tried, acted = [], []
        for t in range(self.horizon):
            deviation = (gains[t] @ (state - states[t]).unsqueeze(-1)).squeeze(-1)
            action = (actions[t] + self.shares * steps[t] + deviation).clamp(-1.0, 1.0)
            state = self.step(state, action)
            tried.append(state)
            acted.append(action)
        # The last of those to choose from is the old plan.
        new = torch.cat((torch.stack(tried, 1), states[None, 1:])), torch.cat((torch.stack(acted, 1), actions[None]))
        best = self.cost(*new, goal, neutral).nan_to_num(torch.inf).argmin(0)
        states_best, actions_best = (x[best, :, torch.arange(len(best))].transpose(0, 1) for x in new)
        return torch.cat((states[:1], states_best)), actions_best

    def cost(self, states: Tensor, actions: Tensor, goal: Tensor, neutral: Tensor) -> Tensor:
        """What trajectories cost, (*, n): states (*, H, n, 17) at the end of each step, and actions (*, H, n, 4)."""
        away = (self.state_cost.unsqueeze(1) * (states - goal).square()).sum(-1)
        return 0.5 * (away + (self.action_cost * (actions - neutral).square()).sum(-1)).sum(-2)

    def pack(self, state: Mapping[Any, Tensor]) -> Tensor:
        """The drone's entries as one state (*, 17), with rotor speeds in units of that of hovering."""
        entries = {name: state[name] for name in self.sizes}
        entries["rotor_speed"] = entries["rotor_speed"] / self.hover_speed
        return torch.cat(list(entries.values()), -1)

    def step(self, state: Tensor, action: Tensor) -> Tensor:
        """A control step of the nominal drone, from states (*, n, 17) and actions (*, n, 4)."""
        entries = dict(zip(self.sizes, state.split(list(self.sizes.values()), -1), strict=True))
        entries["quaternion"] = quaternion.normalize(entries["quaternion"])  # also of deviations
        entries["rotor_speed"] = entries["rotor_speed"] * self.hover_speed
        return self.pack(self.dynamics.control_step(entries, action, self.nominal, None))

    def predict(self, start: Tensor, actions: Tensor) -> Tensor:
        """Where actions (H, n, 4) lead from states (n, 17): (H + 1, n, 17), the start first."""
        return torch.stack(list(itertools.accumulate(actions, self.step, initial=start)))

    def linearise(self, states: Tensor, actions: Tensor) -> Tensor:
        """The derivatives of :meth:`step` by states (T, n, 17) and actions (T, n, 4): (T, n, 17, 21)."""
        k, start = states.shape[-1], torch.cat((states, actions), -1).flatten(0, 1)
        pull = vjp(lambda x: self.step(*x.split((k, 4), -1)), start)[1]
        one_each = torch.eye(k).to(start).unsqueeze(1).expand(-1, len(start), -1)
        return vmap(pull)(one_each)[0].transpose(0, 1).unflatten(0, states.shape[:2])


def feedback(
    transition: Tensor, states: Sequence[Tensor], actions: Sequence[Tensor], bounds: Sequence[Tensor]
) -> tuple[Tensor, Tensor]:
    """The actions u_t = k_t + K_t x_t that minimise a quadratic cost, by Riccati's recursion, for a batch of drones.

    The cost is the sum over t = 1..T of x_t' Q_t x_t / 2 + q_t' x_t, and over t = 0..T-1 of u_t' R u_t / 2 + r_t' u_t,
    where x_{t+1} = A_t x_t + B_t u_t. Where k_t would leave its bounds, it stops there, and the gains of that entry are
    zero; the other entries are optimal given that (control-limited DDP, with one round of its active set).

    ``transition`` (T, n, s, s + m) holds A_t and B_t side by side, ``states`` the diagonal of Q (T, s), and q
    (T, n, s), ``actions`` that of R (m), and r (T, n, m). The two bounds of k are (T, n, m). Returns k (T, n, m) and
    K (T, n, m, s).
    """
    (state_cost, state_slope), (action_cost, action_slope), (low, high) = states, actions, bounds
    s = transition.shape[-2]
    eye, penalty = torch.eye(len(action_cost)).to(transition), torch.diag(action_cost)
    value, slope = torch.diag(state_cost[-1]), state_slope[-1]
    steps, gains = [], []
    for t in reversed(range(len(transition))):
        pulled = transition[t].mT
        hessian = pulled @ value @ transition[t]
        gradient = (pulled @ slope.unsqueeze(-1)).squeeze(-1)
        of_actions, mixed = hessian[:, s:, s:] + penalty, hessian[:, s:, :s]
        slope_actions = gradient[:, s:] + action_slope[t]
        # Once without bounds; then with those entries held that have left theirs.
        step = -torch.linalg.solve_ex(of_actions, slope_actions.unsqueeze(-1))[0].squeeze(-1)
        held = ((step <= low[t]) | (step >= high[t])).unsqueeze(-1)
        stop = torch.where(held, step.clamp(low[t], high[t]).unsqueeze(-1), 0.0)
        wanted = torch.cat((slope_actions.unsqueeze(-1) + of_actions @ stop, mixed), -1)
        reduced = torch.where(held | held.mT, eye, of_actions)
        solution = -torch.linalg.solve_ex(reduced, torch.where(held, 0.0, wanted))[0]
        step, gain = (solution[..., :1] + stop).squeeze(-1).clamp(low[t], high[t]), solution[..., 1:]
        steps.append(step)
        gains.append(gain)
        if t > 0:
            left = slope_actions.unsqueeze(-1) + of_actions @ step.unsqueeze(-1)
            slope = gradient[:, :s] + (mixed.mT @ step.unsqueeze(-1) + gain.mT @ left).squeeze(-1) + state_slope[t - 1]
            crossed = gain.mT @ mixed
            value = hessian[:, :s, :s] + gain.mT @ of_actions @ gain + crossed + crossed.mT
            # What rounding makes unsymmetric would grow from step to step.
            value = 0.5 * (value + value.mT) + torch.diag(state_cost[t - 1])
    return torch.stack(steps[::-1]), torch.stack(gains[::-1])
