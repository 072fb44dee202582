"""How a horizon is flown quickly: a step on plain tensors, its derivative, and the loop around them.

A tensordict with its thirty entries costs far more than the physics of a step. Here all entries of one kind stand below
each other as the rows of one tensor, and only the finished horizon becomes a tensordict again.
"""

from __future__ import annotations

import types
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.func import vjp

from torchrl_quad.dynamics import QuadrotorParams, QuadrotorState, control_step
from torchrl_quad.dynamics.compiled import ROWS, CompiledControlStep
from torchrl_quad.dynamics.parameters import PLANT_FIELDS

if TYPE_CHECKING:
    from torchrl_quad.envs.base import QuadrotorEnv

# New starts are drawn this often: an environment that ends twice in between begins at the same one both times.
STEPS_PER_DRAW = 32

# Beyond these the model means nothing, and its numbers or their derivatives may overflow: the episode ends.
_MAX_VALUE = 1e6  # of any entry of the state, in its unit
_MAX_SPEED = 1e3  # [m/s] and [rad/s]
_MAX_ROTOR_SPEED = 2.0  # of the nominal drone's rotor_speed_max
_MAX_NORM_ERROR = 0.1  # of the quaternion's squared norm

Key = str | tuple[str, ...]


class Rows(NamedTuple):
    """Entries of a batch of n, below each other by kind; each (rows, n), or (time, rows, n) for a horizon."""

    floats: Tensor
    integers: Tensor
    flags: Tensor

    def detach(self) -> Rows:
        """The same without gradient."""
        return Rows(*(x.detach() for x in self))

    def where(self, condition: Tensor, other: Rows) -> Rows:
        """These where the condition holds, the others elsewhere."""
        return Rows(*(torch.where(condition, mine, its) for mine, its in zip(self, other, strict=True)))


class Layout:
    """Which rows hold which entry (n, ...), in the order of the entries."""

    def __init__(self, entries: Mapping[Key, Tensor]) -> None:
        self.place: dict[Key, tuple[int, slice, torch.Size]] = {}
        heights = [0, 0, 0]
        for key, x in entries.items():
            kind = 0 if x.is_floating_point() else 2 if x.dtype == torch.bool else 1
            height = x[0].numel()
            self.place[key] = (kind, slice(heights[kind], heights[kind] + height), x.shape[1:])
            heights[kind] += height
        self.dtypes = next(x.dtype for x in entries.values() if x.is_floating_point()), torch.int64, torch.bool

    def pack(self, entries: Mapping[Key, Tensor]) -> Rows:
        """The rows of the entries, each (n, ...)."""
        columns: list[list[Tensor]] = [[], [], []]
        for key, (kind, _, _) in self.place.items():
            columns[kind].append(entries[key].flatten(1).t())
        like = next(iter(entries.values()))
        return Rows(
            *(
                torch.cat(column) if column else like.new_empty((0, len(like)), dtype=dtype)
                for column, dtype in zip(columns, self.dtypes, strict=True)
            )
        )

    def unpack(self, rows: Rows) -> dict[Key, Tensor]:
        """Views of the entries, each (n, ...), or (n, time, ...) of a horizon."""
        entries = {}
        for key, (kind, where, shape) in self.place.items():
            x = rows[kind][..., where, :].movedim(-1, 0)
            entries[key] = x if len(shape) == 1 else x.unflatten(-1, shape)
        return entries


class Ends(NamedTuple):
    """What a step leads to."""

    state: Rows  # at its end
    told: Rows  # reward, flags and so on
    observation: Tensor  # (n, k)
    carried: Rows  # the state to go on from: that at its end, or another where the episode is over
    first: Tensor  # (n, k), the observation to go on from

    def leaves(self) -> tuple[Tensor, ...]:
        """All tensors in a row, which is what autograd can pass on."""
        return (*self.state, *self.told, self.observation, *self.carried, self.first)

    @classmethod
    def of(cls, leaves: Sequence[Tensor]) -> Ends:
        """The reverse of :meth:`leaves`."""
        return cls(Rows(*leaves[:3]), Rows(*leaves[3:6]), leaves[6], Rows(*leaves[7:10]), leaves[10])


class Stepper:
    """A control step of an environment on rows: eager, or compiled with its derivative.

    The rows of a state begin with those of the drone; what the task has added comes last.

    Args:
        env: the environment, whose specs need not be there yet.
        options: keywords of ``torch.compile``; None stands for an eager step.
    """

    def __init__(self, env: QuadrotorEnv, options: dict[str, Any] | None = None) -> None:
        self.env = env
        n, start, of_task = env.num_envs, env.fallback, env.task_entries
        order = [*QuadrotorState._fields, "step", *(k for k in start if k not in of_task), *of_task]
        self.layout = Layout({key: start[key] for key in order})
        told = env.told(start)
        observation = told.pop("observation")
        told = flat({**told, "reward": observation[:, :1], "reward_terms": env.reward_terms(start)})
        self.told_layout = Layout(told)

        self.fallback = self.layout.pack(start).floats
        self.is_of_task = torch.zeros_like(self.fallback[:, :1], dtype=torch.bool)
        limits = torch.full_like(self.fallback, _MAX_VALUE)
        for key, (kind, where, _) in self.layout.place.items():
            if kind == 0:
                self.is_of_task[where] = key in of_task
            if key in ("velocity", "angular_velocity"):
                limits[where] = _MAX_SPEED
            elif key == "rotor_speed":
                limits[where] = (_MAX_ROTOR_SPEED * env.nominal.rotor_speed_max).expand(n, 4).t()
        self.inverse_limits = 1.0 / limits

        self.options, self.is_compiled = options, options is not None
        self.control_step = self.forward = self.adjoint = None
        if self.is_compiled:
            state, told = torch.zeros_like(self.fallback), torch.zeros_like(self.told_layout.pack(told).floats)
            observation = torch.zeros_like(observation)
            self.zeros = state, told, observation, state, observation  # gradients of ends that nothing depends on
            self._compile()

    def _compile(self) -> None:
        env, options = self.env, self.options
        self.control_step = CompiledControlStep(env.controller, env.dt, env.substeps, env.integrator)
        mode = torch._inductor.list_mode_options(options["mode"]) if options.get("mode") else {}
        more = {**mode, **options.get("options", {}), "guard_filter_fn": _watched, "cpp.vec_isa_ok": True}
        options = {"fullgraph": True, "dynamic": False, **options, "mode": None, "options": more}
        self.forward = torch.compile(_own(self._forward), **options)
        self.adjoint = torch.compile(_own(self._adjoint), **options)

    def __getstate__(self) -> dict[str, Any]:
        # Compiled functions stay bound to the environment that they were made of: a copy makes its own.
        return {**self.__dict__, "control_step": None, "forward": None, "adjoint": None}

    def __call__(
        self, state: Rows, valid: Tensor, action: Tensor, noise: Mapping[str, Tensor], fresh: Rows, first: Tensor
    ) -> Ends:
        """One control step.

        Args:
            state: where it starts, made sound.
            valid: which drones were sound, bool (n); the others crash.
            action: (n, 4).
            noise: what ``env.draw_noise`` gives for one step.
            fresh: states to begin the next episode with where this one ends.
            first: their observations (n, k).
        """
        if action is None or action.shape != (self.env.num_envs, 4):
            got = "there is none" if action is None else f"got {tuple(action.shape)}"
            raise ValueError(
                f"The action must have shape ({self.env.num_envs}, 4), thrust and three body rates for each "
                f'environment; {got}. A policy writes it under "action", as make_actor(env) does.'
            )
        if action.device != state.floats.device:
            raise ValueError(f"The action is on {action.device}, and the environment on {state.floats.device}.")
        action = action.to(state.floats.dtype)
        if self.is_compiled:
            if self.forward is None:
                self._compile()
            theta = () if self.env.params is self.env.nominal else self.env.params.plant()
            return Ends.of(_Step.apply(self, *state[1:], valid, noise, fresh, first, state.floats, action, *theta))
        floats, applied, valid = self._begin(state.floats, action, valid)
        before = self.layout.unpack(state._replace(floats=floats))
        flown = control_step(
            QuadrotorState(*(before[name] for name in QuadrotorState._fields)),
            applied.t(),
            self.env.flying(before),
            self.env.controller,
            self.env.dt,
            self.env.substeps,
            self.env.integrator,
            before.get("wind"),
        )
        return self._finish(state._replace(floats=floats), torch.cat(flown, -1).t(), valid, noise, fresh, first)

    def entries(self, state: Rows, told: Rows) -> dict[Key, Tensor]:
        """The entries of a tensordict by name, but the observation; metrics have no gradient."""
        told = {key: x.detach() if "metrics" in key else x for key, x in self.told_layout.unpack(told).items()}
        return {**flat({"state": self.layout.unpack(state)}), **told}

    # -- before and after the drone flies ------------------------------------------------------------------------------

    def _begin(self, floats: Tensor, action: Tensor, valid: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The state with the action (n, 4) queued, the action (4, n) that takes effect, and where all is valid (n)."""
        env, action = self.env, action.t()
        with torch.no_grad():
            valid = valid & (action.abs().amax(0) < _MAX_VALUE)
        action = torch.where(valid, action, env.hover_action.expand(env.num_envs, 4).t())
        if not env.action_delay:
            return floats, action, valid
        queue = self.layout.place["action_queue"][1]
        sizes = (queue.start, 4, queue.stop - queue.start - 4, len(floats) - queue.stop)
        before, applied, later, after = floats.split(sizes)
        return torch.cat((before, later, action, after)), applied, valid

    def _finish(
        self, before: Rows, drone: Tensor, valid: Tensor, noise: Mapping[str, Tensor], fresh: Rows, first: Tensor
    ) -> Ends:
        """What follows from the state before, and where the drone (17, n) has flown."""
        env, layout = self.env, self.layout
        previous = layout.unpack(before)
        floats = torch.cat((drone, before.floats[len(drone) :]))
        state = {**layout.unpack(before._replace(floats=floats)), "step": previous["step"] + 1}
        state = env.disturbed(state, noise)
        if noise or not env.sensors.are_perfect:
            floats = layout.pack(state).floats
        floats, still_valid = self.sound(floats)
        valid = (valid & still_valid).unsqueeze(-1)
        rows = before._replace(floats=floats, integers=torch.cat((previous["step"].t() + 1, before.integers[1:])))
        state = layout.unpack(rows)
        if env.task_advances:
            advanced = env.advance(previous, state)
            for key in env.task_entries:
                keep = valid.reshape(-1, *(1 for _ in state[key].shape[1:]))
                state[key] = torch.where(keep, advanced[key], state[key])
            rows = layout.pack(state)

        terms = {name: torch.where(valid, term, 0.0) for name, term in env.reward_terms(state).items()}
        told = {**env.told(state), "reward_terms": terms, "reward": sum(terms.values())}
        told["crash"] = env.is_crash(state) | ~valid
        told["success"] = told["success"] & valid
        told["terminated"] = told["crash"] | told["success"] if env.ends_on_success else told["crash"]
        told["truncated"] = state["step"] >= env.max_episode_steps
        told["done"] = told["terminated"] | told["truncated"]
        done, observation = told["done"], told.pop("observation")
        first = torch.where(done, first, observation)
        return Ends(rows, self.told_layout.pack(flat(told)), observation, fresh.where(done.t(), rows), first)

    def sound(self, floats: Tensor) -> tuple[Tensor, Tensor]:
        """Put the fallback in the place of drones that are not finite, or beyond what the model can compute.

        What the task has added stays as it was, unless it is itself the trouble. Selecting before the physics keeps the
        gradients of the others clean: a gradient of zero is never multiplied by an infinite derivative.

        Returns:
            the sound state, and which drones (n) were sound before.
        """
        with torch.no_grad():
            share = floats.abs() * self.inverse_limits
            norm_error = floats[3:7].square().sum(0) - 1.0
            # NaN compares as false, and so counts as beyond every bound.
            valid = (share.amax(0) < 1.0) & (norm_error.abs() < _MAX_NORM_ERROR)
            keep = torch.where(self.is_of_task, share < 1.0, valid)
        return torch.where(keep, floats, self.fallback), valid

    # -- for the compiler ----------------------------------------------------------------------------------------------

    def _forward(
        self,
        floats: Tensor,
        action: Tensor,
        theta: tuple[Tensor, ...],
        integers: Tensor,
        flags: Tensor,
        valid: Tensor,
        noise: Mapping[str, Tensor],
        fresh: Rows,
        first: Tensor,
    ) -> tuple[list[Tensor], Ends]:
        (drone, *forces, before), valid = self._enter(floats, action, theta, integers, flags, valid)
        states = self.control_step.fly(drone, *forces)
        return states, self._finish(Rows(before, integers, flags), states[-1], valid, noise, fresh, first)

    def _adjoint(
        self,
        states: list[Tensor],
        floats: Tensor,
        action: Tensor,
        theta: tuple[Tensor, ...],
        integers: Tensor,
        flags: Tensor,
        valid: Tensor,
        noise: Mapping[str, Tensor],
        grad: tuple[Tensor, ...],
    ) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
        def finish(before: Tensor, drone: Tensor) -> tuple[Tensor, ...]:
            # Where an episode has ended no gradient comes through: what the next one starts from does not matter.
            fresh = Rows(floats, integers, flags)
            ends = self._finish(Rows(before, integers, flags), drone, is_valid, noise, fresh, grad[-1])
            return ends.state.floats, ends.told.floats, ends.observation, ends.carried.floats, ends.first

        (_, *forces, before), pull_begin, is_valid = vjp(
            lambda *x: self._enter(*x, integers, flags, valid), floats, action, theta, has_aux=True
        )
        grad_before, grad_drone = vjp(finish, before, states[-1])[1](grad)
        return pull_begin((*self.control_step.pull_back(states, *forces, grad_drone), grad_before))

    def _enter(
        self, floats: Tensor, action: Tensor, theta: tuple[Tensor, ...], integers: Tensor, flags: Tensor, valid: Tensor
    ) -> tuple[tuple, Tensor]:
        """The arguments of ``control_step.fly``, and the state with the action queued; and where all is valid."""
        env = self.env
        floats, applied, valid = self._begin(floats, action, valid)
        state = self.layout.unpack(Rows(floats, integers, flags))
        params = {**env.nominal.fields(), **dict(zip(PLANT_FIELDS, theta, strict=False))}
        # Compiled regions must not share memory between their inputs: what is a view of the state is copied.
        drawn = {name: state["drone", name].clone() for name in env.randomization.spec}
        plant = ()
        if theta or drawn:
            plant = tuple(_parameter_rows({**params, **drawn}[name], name) for name in PLANT_FIELDS)
        wind = (state["wind"].t().clone(),) if "wind" in state else ()
        setpoint = torch.cat([x.t() for x in env.controller.setpoint(applied.t())])
        return (floats[: sum(ROWS)], setpoint, plant, wind, floats), valid


def _own(method: types.MethodType) -> types.MethodType:
    """The same method with a code object of its own: what is compiled for it is not shared with other environments."""
    f = method.__func__
    copy = types.FunctionType(f.__code__.replace(), f.__globals__, f.__name__, f.__defaults__, f.__closure__)
    return types.MethodType(copy, method.__self__)


def _watched(guards: Sequence[Any]) -> list[bool]:
    """Which assumptions the compiled step checks at each call: on its input, on torch's state, on the environment's own
    attributes. The rest, several hundred that cost more than the physics, is about what never changes."""
    fixed = ("G[", "__import__", "list(dict.keys(__import__", "self.control_step", "self.layout", "self.told_layout")
    never = ("NOT_PRESENT_IN_GENERIC_DICT", "TYPE_MATCH", "BUILTIN_MATCH")
    return [
        not (guard.name.startswith(fixed) or "__dict__" in guard.name or guard.guard_type in never) for guard in guards
    ]


class _Step(torch.autograd.Function):
    """The compiled step as one node of the graph; it keeps the states between its physics steps and nothing else."""

    @staticmethod
    def forward(ctx: Any, stepper: Stepper, integers, flags, valid, noise, fresh, first, floats, action, *theta):
        floats, action, *theta = (x.detach().contiguous() for x in (floats, action, *theta))
        states, ends = stepper.forward(floats, action, tuple(theta), integers, flags, valid, noise, fresh, first)
        ctx.stepper, ctx.noise = stepper, noise
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(floats, action, integers, flags, valid, *states, *theta)
        ctx.mark_non_differentiable(*ends.state[1:], *ends.told[1:], *ends.carried[1:])
        return ends.leaves()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads):
        floats, action, integers, flags, valid, *more = ctx.saved_tensors
        count = ctx.stepper.env.substeps + 1
        states, theta = more[:count], tuple(more[count:])
        ends = Ends.of(grads)
        grads = ends.state.floats, ends.told.floats, ends.observation, ends.carried.floats, ends.first
        grad = tuple(zero if x is None else x.contiguous() for x, zero in zip(grads, ctx.stepper.zeros, strict=True))
        grad_floats, grad_action, grad_theta = ctx.stepper.adjoint(
            states, floats, action, theta, integers, flags, valid, ctx.noise, grad
        )
        return None, None, None, None, None, None, None, grad_floats, grad_action, *grad_theta


def can_fly(env: QuadrotorEnv, policy: Any, tensordict: TensorDictBase) -> bool:
    """Whether :func:`fly` gives what TorchRL's own loop does: the policy reads nothing but observation and state."""
    if not isinstance(policy, TensorDictModuleBase) or "_" in policy.out_keys:
        return False
    state = {_path("state", *_tuple(key)) for key in env.stepper.layout.place}
    needed = {"observation", *env.stepper.told_layout.place} - {"reward"}
    writes, reads = ({flat_key(key) for key in keys} for keys in (policy.out_keys, policy.in_keys))
    given = set(tensordict.keys(True, True))
    return reads <= state | {"observation"} and "action" in writes and needed <= given <= state | needed | writes


def fly(env: QuadrotorEnv, policy: TensorDictModuleBase, tensordict: TensorDictBase, steps: int) -> TensorDict:
    """A rollout (n, steps) from a reset tensordict, through the ends of episodes."""
    stepper, n = env.stepper, env.num_envs
    start = stepper.layout.pack(env.required_state(tensordict.get("state"), "rollout"))
    told = {key: tensordict.get(key) for key in stepper.told_layout.place if key != "reward"}
    no_reward = {"reward": torch.zeros(n, 1, device=env.device, dtype=env.dtype)}
    roots = start, stepper.told_layout.pack({**told, **no_reward}), (tensordict.get("observation"),)
    floats, valid = stepper.sound(start.floats)
    state, observation = start._replace(floats=floats), roots[2][0]
    reads_state = any(flat_key(key) != "observation" for key in policy.in_keys)
    ends, draws, written = [], [], []
    for t in range(steps):
        if t % STEPS_PER_DRAW == 0:
            noise = env.draw_noise(min(STEPS_PER_DRAW, steps - t))
            entries = env.first_entries(env.draw_start())
            fresh, first = stepper.layout.pack(entries["state"]).detach(), entries["observation"].detach()
            draws.append((fresh, stepper.told_layout.pack(flat({**entries, **no_reward})), (first,)))
        td = TensorDict({"observation": observation}, env.batch_size, env.device)
        if reads_state:
            td["state"] = nested(stepper.layout.unpack(state))
        td = policy(td)
        written.append([td.get(key) for key in policy.out_keys])
        step_noise = {key: x[t % STEPS_PER_DRAW] for key, x in noise.items()}
        end = stepper(state, valid, td.get("action"), step_noise, fresh, first)
        ends.append((end.state, end.told, (end.observation,)))
        state, observation = end.carried, end.first
        if t == 0:
            valid = torch.ones_like(valid)  # what a step leads to is sound
    by_policy = {
        flat_key(key): torch.stack(x, 1) for key, x in zip(policy.out_keys, zip(*written, strict=True), strict=True)
    }
    # Once for all steps: to look at a value makes the processor wait for the accelerator.
    require_finite(by_policy["action"])
    rollout = _rollout(stepper, roots, draws, ends) | by_policy
    return TensorDict(nested(rollout), (n, steps), env.device, names=[None, "time"])


def _rollout(
    stepper: Stepper, roots: Sequence[tuple], draws: Sequence[tuple], ends: Sequence[tuple]
) -> dict[Key, Tensor]:
    """All entries of a rollout but those of the policy, each (n, time, ...).

    Root, draws and ends each have three parts: the state's rows, the rows told, and the observation. A draw serves
    ``STEPS_PER_DRAW`` steps.
    """
    following = [[torch.stack(x) for x in zip(*rows, strict=True)] for rows in zip(*ends, strict=True)]
    kind, where, _ = stepper.told_layout.place["done"]
    done = following[1][kind][:, where]

    def from_the_root(over: Tensor, root: Tensor, later: Tensor, drawn: Iterable[Tensor]) -> Tensor:
        """What stands at the root of each step: as the step before left it, or anew where its episode was over."""
        blocks = zip(over[:-1].split(STEPS_PER_DRAW), drawn, later[:-1].split(STEPS_PER_DRAW), strict=False)
        return torch.cat((root.unsqueeze(0), *(torch.where(*block) for block in blocks)))

    before = [
        [from_the_root(over, *x) for x in zip(root, later, zip(*drawn, strict=True), strict=True)]
        for over, root, later, drawn in zip(
            (done, done, done.transpose(1, 2)), roots, following, zip(*draws, strict=True), strict=True
        )
    ]
    rollout = {}
    for prefix, (state, told, (observation,)) in (((), before), (("next",), following)):
        entries = stepper.entries(Rows(*state), Rows(*told))
        entries["observation"] = observation.transpose(0, 1)
        rollout |= {_path(*prefix, *_tuple(key)): x for key, x in entries.items()}
    del rollout["reward"]
    return rollout


def require_finite(action: Tensor) -> None:
    """Refuse actions (n, 4), or (n, time, 4) of a horizon, that are not finite.

    Raises:
        ValueError: some are not, with their environments and the first step.
    """
    if cannot_look():
        return
    finite = action.isfinite().all(-1)
    if finite.all():
        return
    broken = ~finite if action.dim() == 3 else ~finite.unsqueeze(1)
    at = f", first at step {broken.any(0).nonzero()[0].item()} of the rollout" if action.dim() == 3 else ""
    raise ValueError(
        f"The action is not finite in environments {first_ten(broken.any(1))}{at}: the weights of the policy are "
        "broken, or what it reads is. Look for NaN in both; if training made them, clip the norm of the gradient, and "
        "skip updates whose gradient is not finite."
    )


def cannot_look() -> bool:
    """Whether no value of a tensor can be looked at here."""
    return torch.compiler.is_compiling() or torch._C._are_functorch_transforms_active()


def first_ten(flags: Tensor) -> str:
    """The indices of the first flags (n) that are set, for a message."""
    who = flags.nonzero().flatten().tolist()
    return ", ".join(str(i) for i in who[:10]) + (", ..." if len(who) > 10 else "")


def flat(entries: Mapping[Any, Any], *prefix: str) -> dict[Key, Tensor]:
    """The entries of nested mappings, by one key each."""
    result = {}
    for key, value in entries.items():
        path = (*prefix, *_tuple(key))
        result |= flat(value, *path) if isinstance(value, Mapping) else {_path(*path): value}
    return result


def nested(entries: Mapping[Key, Tensor]) -> dict[str, Any]:
    """The reverse of :func:`flat`."""
    result: dict[str, Any] = {}
    for key, value in entries.items():
        *path, last = _tuple(key)
        inner = result
        for name in path:
            inner = inner.setdefault(name, {})
        inner[last] = value
    return result


def flat_key(key: Any) -> Key:
    """A key of a tensordict as it stands in a layout."""
    return _path(*_tuple(key))


def _path(*names: str) -> Key:
    return names if len(names) > 1 else names[0]


def _tuple(key: Key) -> tuple[str, ...]:
    return key if isinstance(key, tuple) else (key,)


def _parameter_rows(parameter: Tensor, name: str) -> Tensor:
    batched = parameter.dim() > QuadrotorParams.dim(name)
    return parameter.flatten(1).t() if batched else parameter.reshape(-1, 1)
