"""The interface for a task's author: what a task defines, what it may use, and the check of what it returns."""

from __future__ import annotations

import abc
import math
import numbers
from collections.abc import Callable, Iterator, Mapping
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_quad.dynamics import Dynamics, QuadrotorParams
from torchrl_quad.dynamics.parameters import LIMITS
from torchrl_quad.engine.packing import Key
from torchrl_quad.engine.simulation import State
from torchrl_quad.envs.disturbances import Disturbance
from torchrl_quad.envs.markers import Markers
from torchrl_quad.envs.metrics import EPISODE_METRICS, Metric, at_episode_end, first_episode, read
from torchrl_quad.envs.randomness import Randomness
from torchrl_quad.envs.scenes import MountedCamera, Scene
from torchrl_quad.envs.terms import Event
from torchrl_quad.errors import UserValueError
from torchrl_quad.vision import DepthCamera


class Task(abc.ABC):
    """The part of an environment that its author writes; :class:`~torchrl_quad.QuadrotorEnv` inherits from it.

    A state is a mapping of names to tensors (num_envs, ...):

    =============================  ============  =======================================================================
    entry                          shape         meaning
    =============================  ============  =======================================================================
    ``position``                   (3)           [m], world frame, z up
    ``quaternion``                 (4)           (w, x, y, z), body to world, unit norm
    ``velocity``                   (3)           [m/s], world frame
    ``angular_velocity``           (3)           [rad/s], body frame
    ``rotor_speed``                (n)           [rad/s], of n rotors; absent with ``dynamics="point_mass"``
    ``action_queue``               (delay, k)    commands on their way, oldest first; absent when the delay is 0
    ``step``                       (1)           control steps since the start of the episode
    ``("drone", field)``           as the field  the randomised parameters, with ``randomize``
    ``mean_wind``, ``wind``        (3)           [m/s], world frame, with ``wind``
    ``measurements``               (d + 1, 13)   sensor readings, oldest first, with noise or delay
    ``("scene", kind)``            (m, k)        the random obstacles of a ``scene``; see :class:`~torchrl_quad.Scene`
    ``collided``                   (1)           whether the drone touched an obstacle in this step, with a ``scene``
    ``images``                     (k, h, w)     of a ``camera`` with rate, delay or noise, oldest first [m]
    =============================  ============  =======================================================================

    and the entries that the task adds.
    """

    num_envs: int  #: drones that fly in parallel
    dtype: torch.dtype  #: floating-point type of all that flies
    control_dt: float  #: [s]
    max_episode_steps: int  #: control steps after which an episode is truncated
    action_delay: int  #: control steps from a command to its effect
    observe_last_action: bool  #: whether the commands on their way are observed
    event_discount: float | None  #: discount per control step of the time of events
    params: QuadrotorParams  #: the drone that flies
    dynamics: Dynamics  #: the model of the drone
    randomness: Randomness  #: the source of all random numbers
    disturbances: Mapping[str, Disturbance]  #: by name; see :mod:`~torchrl_quad.envs.disturbances`
    task_entries: list[Key]  #: the names of the task's own entries of the state
    initial_state_source: Callable[[int], TensorDictBase] | None  #: where resets start, if not as the task says

    defaults: Mapping[str, Any] = {}  #: of arguments, by name, where the task has others than its parent
    weights: Mapping[str, Any] = {}  #: of the reward's terms; an argument of the same name overrides some
    ends_on_success = False  #: whether success terminates the episode, too
    metric_info: Mapping[str, Metric] = EPISODE_METRICS  #: how each metric is summed up, printed and drawn, by name
    #: Entries of the state, such as "position", that only critics know, with factors that bring them to about one. In
    #: recipes the critics read them beside the observation, and the policy gets a memory.
    privileged: Mapping[Key, float] = {}

    @abc.abstractmethod
    def initial_state(self, n: int) -> State:
        """Draw n starts: what :meth:`hover_state` gives, moved and turned at will, and the entries the task adds."""

    @abc.abstractmethod
    def observe(self, state: State) -> Tensor:
        """The observation (num_envs, k) of a state."""

    @abc.abstractmethod
    def reward_terms(self, state: State) -> State:
        """The weighted reward terms by name, each (num_envs, 1), of the state at the end of a step."""

    @abc.abstractmethod
    def is_crash(self, state: State) -> Tensor:
        """Where the drone is lost, bool (num_envs, 1): the episode terminates."""

    @abc.abstractmethod
    def is_success(self, state: State) -> Tensor:
        """Where this state fulfils the task, bool (num_envs, 1)."""

    def set_up(self) -> None:  # noqa: B027, most tasks need none
        """Make the constant tensors of the task; called when device and precision are known, and after a move."""

    def advance(self, previous: State, state: State) -> State:
        """The state with the task's own entries brought from the previous step to this one; the drone has flown."""
        return state

    def events(self, previous: State, state: State) -> dict[str, Event]:
        """What pays at an instant within a step, by name: the same names in each step.

        With ``event_discount``, the return gets its derivative in the time of each event; see
        :class:`~torchrl_quad.envs.Event`. ``previous`` is the state at the start of the control step, ``state`` the one
        at its end, with the task's own entries advanced.
        """
        return {}

    def metrics(self, state: State) -> State:
        """Measurements in addition to the reward, by name, each (num_envs, 1), without gradient."""
        return {}

    def state_bounds(self) -> dict[Key, tuple[float, float]]:
        """The least and the greatest value of the task's own entries; states beyond them cannot be restored."""
        return {}

    def observation_bounds(self) -> Tensor | None:
        """The greatest magnitude (k) of each entry of :meth:`observe` in a useful flight; None if unknown.

        gymnasium's observation spaces have these bounds, and its observations are clipped to them.
        """
        return None

    def markers(self) -> Markers:
        """What pictures show in addition to the drones."""
        return Markers()

    def markers_of(self, drawn: State) -> Markers:
        """The same for one environment, from what its episode has drawn, (1, ...): gates, for example."""
        return self.markers()

    def episode_metrics(self, rollout: TensorDictBase) -> dict[str, Tensor]:
        """Judge the first episode of each environment, in a rollout (num_envs, time) from fresh starts.

        Returns:
            by name, each (num_envs): ``return``, the undiscounted sum of rewards; ``crash`` and ``solved``, 0 or 1;
            and the metrics of the task, as they are at the end of the episode. Here an episode is solved when its last
            state fulfils the task and the drone has not crashed; a task may ask more.
        """
        missing = [name for name in ("crash", "success", "reward", "done") if ("next", name) not in rollout]
        if missing:
            raise UserValueError(
                f'episode_metrics reads ("next", {missing[0]!r}), which is not in the rollout. Judge a rollout before '
                "you leave out entries, and evaluate without the transform that drops this one."
            )
        reward, measured = read(rollout, "reward"), cast(Mapping, rollout.get(("next", "metrics"), {}))
        crash, success = (at_episode_end(rollout, read(rollout, name)) for name in ("crash", "success"))
        return {
            "return": (reward * first_episode(rollout)).sum(1).squeeze(-1),
            "crash": crash.to(reward.dtype),
            "solved": (success & ~crash).to(reward.dtype),
            **{name: at_episode_end(rollout, value) for name, value in measured.items()},
        }

    @property
    def scene(self) -> Scene | None:
        """The obstacles, with the distance to them, if there are any."""
        scene = self.disturbances.get("scene")
        return scene if isinstance(scene, Scene) else None

    @property
    def camera(self) -> DepthCamera | None:
        """The depth camera, if there is one."""
        mounted = self.disturbances.get("camera")
        return mounted.camera if isinstance(mounted, MountedCamera) else None

    @property
    def nominal(self) -> QuadrotorParams:
        """The drone that the flight controller believes in; ``params`` is the one that flies."""
        return self.dynamics.nominal

    @property
    def hover_action(self) -> Tensor:
        """The action (k) that holds the nominal drone where it is; (num_envs, k) where drones differ in it."""
        return self.dynamics.hover_action

    @property
    def action_units(self) -> dict[str, str]:
        """What the entries of an action command, by name, and the unit of each, such as "N" and "rad/s"."""
        return getattr(self.dynamics, "action_units", dict.fromkeys("0123", ""))

    @property
    def neutral_action(self) -> Tensor:
        """The action that a new policy starts from, which hovers."""
        return self.hover_action

    def hover_state(self, position: Tensor) -> State:
        """Level, still, rotors at hover speed, at the positions (n, 3) [m]."""
        return self.dynamics.rest(position)

    def tensor(self, values: Any) -> Tensor:
        """A tensor with the environment's device and floating-point type."""
        return self.randomness.tensor(values)

    def uniform(self, *shape: int) -> Tensor:
        """Uniform random numbers in [-1, 1] from the environment's own generator."""
        return self.randomness.uniform(*shape)

    def normal(self, *shape: int) -> Tensor:
        """Standard normal random numbers from the environment's own generator."""
        return self.randomness.normal(*shape)

    def integers(self, high: int, *shape: int) -> Tensor:
        """Uniform random integers in [0, high) from the environment's own generator."""
        return self.randomness.integers(high, *shape)


def check_task(env: Task, state: State) -> dict[Key, Disturbance]:
    """Check that the methods of a task return what :class:`Task` says; return who starts which entry of the state."""
    task, n = type(env).__name__, env.num_envs

    def check(condition: bool, message: str) -> None:
        _check(condition, f"{task}.{message}")

    def check_tensor(method: str, x: Any, dtype: torch.dtype | None, columns: int | None = 1) -> None:
        is_right = isinstance(x, Tensor) and x.shape == (n, columns or x.shape[-1:].numel())
        wanted = f"({n}, {columns or 'k'})" + ("" if dtype is None else f", {dtype}")
        hint = ""
        if isinstance(x, numbers.Real):
            kind_of = ", dtype=torch.bool" if dtype == torch.bool else ""
            hint = f" Write torch.full_like(state['position'][:, :1], {x}{kind_of})." if columns else ""
        elif columns and isinstance(x, Tensor) and x.shape[1:] != (1,):
            hint = " Keep the last dimension: x[:, 2:3], not x[:, 2]; norm(x) of envs.terms; .sum(-1, keepdim=True)."
        hint = " Convert it: .to(self.dtype)." if is_right and dtype == env.dtype else hint
        check(is_right and dtype in (None, x.dtype), f"{method} must be a tensor {wanted}; got {_kind(x)}.{hint}")
        broken = f"{method} is not finite at the start. Look for a quotient, a root or a logarithm near zero."
        check(not method.startswith(("observe", "reward")) or bool(x.isfinite().all()), broken)

    def call(name: str, *states: State) -> Any:
        """What a method returns of states, into which it must not write: the physics goes on from them."""
        before = [(key, x, x._version) for given in states for key, x in given.items()]
        try:
            found = getattr(env, name)(*map(dict, states))
        except KeyError as error:
            raise UserValueError(
                f"{task}.{name} asks for {error}, which is no entry of the state or of weights. The state has: "
                f"{', '.join(map(str, states[0]))}; the weights: {', '.join(env.weights) or 'nothing'}."
            ) from error
        except AttributeError as error:
            if error.name is None or error.obj is not None or env.scene is not None:
                raise
            raise UserValueError(
                f"{task}.{name} asks None for {error.name!r}. If it asks self.scene: this environment has none. "
                "Give it obstacles, such as scene={'ground': True}."
            ) from error
        for key, x, version in before:
            changes = f"{name} writes into {key!r} in place, which changes the flight itself."
            check(x._version == version, f"{changes} Write x = x.clone() first, or use torch.where.")
        return found

    def named(method: str, entries: Any) -> Iterator[tuple[str, Any]]:
        is_mapping = isinstance(entries, Mapping)
        check(is_mapping, f"{method} must be a mapping from names to tensors; got {type(entries).__name__}.")
        return ((f"{method}[{name!r}]", x) for name, x in entries.items())

    random, twice = env.randomness.state(), []
    for _ in range(2):
        twice.append(env.initial_state(n))
        env.randomness.set_state(random)
    for key, x in twice[0].items():
        same = _kind(x) == _kind(other := twice[1].get(key))
        again = same and (not isinstance(x, Tensor) or torch.allclose(x, other, equal_nan=True))
        mend = "Draw from self.uniform, and count nothing."
        check(again, f"initial_state: {key!r} differs between calls with one seed. {mend}")
    taken = {"step", "action_queue", "collided", "drone", "scene"}
    starts = {key: x for x in env.disturbances.values() for key in x.start(env.randomness, state)}
    taken |= {key for key in starts if isinstance(key, str)}
    for key in env.task_entries:
        own = f"initial_state: entry {key!r} is the environment's own; give yours another name."
        check(key not in taken, own)
    fields, kinds = env.dynamics.plant_fields, (env.dtype, torch.int64, torch.bool)
    check_changes(env, state)
    for key, x in state.items():
        who = f", from {type(starts[key]).__name__}.start," if key in starts else ""
        entry = f"initial_state: entry {key!r}{who}"
        check(
            isinstance(x, Tensor) and x.dim() > 1 and len(x) == n and x.dtype in kinds,
            f"{entry} must be a tensor ({n}, ...) of at least two dimensions, {env.dtype}, int64 or bool; got "
            f"({_kind(x)}).",
        )
        mend = "Look for a quotient, a root or a logarithm near zero; for infinity write a large number"
        check(bool(x.isfinite().all()), f"{entry} is not finite. {mend}.")
        if size := env.dynamics.sizes.get(key):
            check(x.shape == (n, size), f"{entry} must have shape {(n, size)}, got {tuple(x.shape)}.")
        if isinstance(key, tuple) and key[0] == "drone" and key[1] not in fields:
            raise UserValueError(f"Entry {key!r} changes no parameter of the drone. Choose from: {', '.join(fields)}.")
        if isinstance(key, tuple) and key[0] == "drone":
            check(LIMITS[key[1]][0] <= 0.0 or bool((x > 0).all()), f"{entry} must be above zero, as in any drone.")
            one = env.nominal.value(key[1])
            shape = (n, *one.shape[-env.nominal.dim(key[1]) :])
            fits = x.shape == shape or key[1] == "motor_time_constant"  # which may be two
            check(fits, f"{entry} must have shape {shape}, got {tuple(x.shape)}.")
    for key, bounds in env.state_bounds().items():
        is_right = key in state and isinstance(bounds, tuple | list) and len(bounds) == 2
        pairs = "state_bounds must give entries of the state their least and greatest value, {'goal': (-5.0, 5.0)}"
        check(is_right, f"{pairs}; got {key!r}: {bounds!r}.")
    clip = env.observation_bounds()
    is_right = clip is None or (isinstance(clip, Tensor) and clip.dim() == 1 and bool((clip > 0.0).all()))
    check(is_right, f"observation_bounds must be a tensor (k,) above zero, or None; got {clip}.")
    check_tensor("observe(state)", call("observe", state), env.dtype, None)
    terms, metrics, events = call("reward_terms", state), call("metrics", state), call("events", state, state)
    for method, term in named("reward_terms(state)", terms):
        check_tensor(method, term, env.dtype)
    for (method, event), name in zip(named("events(previous, state)", events), events, strict=True):
        check(isinstance(event, Event), f"{method} must be an Event; got {type(event).__name__}.")
        check_tensor(f"{method}.happened", event.happened, torch.bool)
        check_tensor(f"{method}.time", event.time, env.dtype)
        if not isinstance(event.amount, numbers.Real) and getattr(event.amount, "numel", lambda: 0)() != 1:
            check_tensor(f"{method}.amount", event.amount, env.dtype)
        known = f"{method} gives the term '{name}_time', which the reward has already: rename one of them."
        check(f"{name}_time" not in terms, known)
        is_term = event.term is None or event.term in terms
        check(is_term, f"{method}.term must be one of {', '.join(terms)}, or None; got {event.term!r}.")
    for method, metric in named("metrics(state)", metrics):
        check_tensor(method, metric, env.dtype)
    clash = ", ".join(EPISODE_METRICS.keys() & metrics.keys())
    check(not clash, f"metrics(state): every task has {clash} already; give yours another name.")
    missing = sorted(env.metric_info.keys() - EPISODE_METRICS.keys() - metrics.keys())
    adds_some = type(env).episode_metrics is not Task.episode_metrics  # which may give what metrics() lacks
    check(adds_some or not missing, f"metrics(state) lacks {', '.join(missing)}, which metric_info describes.")
    for each in (env, *env.disturbances.values()):
        wanted = "entries of the state, (n, k), each with a factor, such as {'position': 1.0}"
        hint = f"{type(each).__name__}.privileged must be {wanted}; got"
        _check(isinstance(each.privileged, Mapping), f"{hint} {each.privileged!r}.")
        for key, factor in each.privileged.items():
            is_factor = isinstance(factor, numbers.Real) and math.isfinite(factor)
            is_right = is_factor and key in state and state[key].dim() == 2
            _check(is_right, f"{hint} {key!r}: {factor!r}. The state has: {', '.join(map(str, state))}.")
    for method in ("is_crash", "is_success"):
        check_tensor(f"{method}(state)", call(method, state), torch.bool)
    advanced = call("advance", state, state)
    named("advance(previous, state)", advanced)
    for key in advanced:
        lost = f"advance gives {key!r}, which the state lacks and would lose. Give it in initial_state, too."
        check(key in state, lost)
    for key in env.task_entries:
        got, wanted = _kind(advanced.get(key)), _kind(state[key])
        whole = f"advance must return the whole state, and {key!r} as initial_state gives it, ({wanted}); got ({got})."
        check(got == wanted, f"{whole} Start from {{**state, ...}}.")
    return starts


def check_changes(env: Task, state: State) -> None:
    """Check that disturbances change what their ``start`` gives or the drone has, and nothing that the physics sets."""
    for disturbance in env.disturbances.values():
        who = type(disturbance).__name__
        noise = state["position"].new_zeros(env.num_envs, disturbance.noise_size) if disturbance.noise_size else None
        changed, seen = disturbance.advance(dict(state), noise, env.control_dt), disturbance.observe(dict(state))
        is_right, got = isinstance(changed, Mapping), type(changed).__name__
        _check(is_right, f"{who}.advance must return a mapping of the entries that it changes, or {{}}; got {got}.")
        is_whole = isinstance(seen, Mapping) and state.keys() <= seen.keys()
        _check(is_whole, f"{who}.observe must return the whole state. Start from {{**state, ...}}.")
        for key, x in changed.items():
            writes = f"{who}.advance writes {key!r}, which"
            mend = (
                ' A motor that fails has a ("drone", "rotor_effectiveness") of 0: give that in start and in advance, '
                "(num_envs, n) for n rotors."
            )
            undone = "follows the command within the next control step: the change would be undone."
            mend = mend if "rotor_effectiveness" in env.dynamics.plant_fields else ""
            _check(key not in getattr(env.dynamics, "commanded", ()), f"{writes} {undone}{mend}")
            _check(key in state, f"{writes} the state lacks, so that it would be lost. Give it in start, too.")
            got, wanted = _kind(x), _kind(state[key])
            given = f"{who}.advance must give {key!r} as the state has it, ({wanted}); got ({got})."
            _check(got == wanted, given)


def _check(condition: bool, message: str) -> None:
    if not condition:
        raise UserValueError(message)


def _kind(x: object) -> str:
    return f"{tuple(x.shape)}, {x.dtype}" if isinstance(x, Tensor) else type(x).__name__
