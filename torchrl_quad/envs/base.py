"""What every task shares: state, specs, resets, time limit, gradients that stay where they belong."""

from __future__ import annotations

import abc
import dataclasses
import difflib
import inspect
import math
import numbers
import os
import shutil
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_quad.dynamics import (
    INTEGRATORS,
    FlightController,
    QuadrotorParams,
    QuadrotorState,
    load_drone,
    quaternion,
)
from torchrl_quad.dynamics.parameters import RawParams
from torchrl_quad.envs import horizon, options

if TYPE_CHECKING:
    import numpy as np

# The Markov state by name, each entry (num_envs, ...); ("drone", field) is the name of a randomised parameter.
State = dict[Any, Tensor]


def drawn(state: Mapping[str, Tensor]) -> State:
    """What pictures show of a state; a target that is no position, such as a height, is none of it."""
    return {
        key: state[key]
        for key in ("position", "quaternion", "target")
        if key in state and (key != "target" or state[key].shape == state["position"].shape)
    }


class QuadrotorEnv(EnvBase):
    """Base of all tasks: a batch of quadrotors, stateless and differentiable.

    A step is a pure function of its tensordict: the complete Markov state stands under ``"state"``, and gradients flow
    from every entry of ``"next"`` to the actions, to the state, and to ``env.params``. A task subclasses this and says
    what it starts from, observes, rewards and ends; see :class:`~torchrl_quad.envs.HoveringEnv` for the pattern.

    =============================  ============  =======================================================================
    entry of ``"state"``           shape         meaning
    =============================  ============  =======================================================================
    ``position``                   (3)           [m], world frame, z up
    ``quaternion``                 (4)           (w, x, y, z), body to world, unit norm
    ``velocity``                   (3)           [m/s], world frame
    ``angular_velocity``           (3)           [rad/s], body frame
    ``rotor_speed``                (4)           [rad/s]
    ``action_queue``               (delay, 4)    commands on their way, oldest first; absent when the delay is 0
    ``step``                       (1)           control steps since the start of the episode
    ``("drone", field)``           as the field  the randomised parameters, with ``randomize``
    ``mean_wind``, ``wind``        (3)           [m/s], world frame, with ``wind``
    ``measurements``               (d + 1, 13)   what the sensors told, oldest first, with noise or delay
    =============================  ============  =======================================================================

    Beside ``"observation"`` and ``"state"`` a step writes ``"success"``, ``"crash"``, ``("reward_terms", name)``, the
    weighted terms whose sum is the reward, and ``("metrics", name)``, what the task measures, without gradient. At a
    reset the terms are zero.

    ``env.params`` is the drone that flies and ``env.nominal`` what its controller believes. To change the drone, assign
    ``env.params = env.params.replace(mass=0.5)``, or under transforms ``env.set_params(...)``; a tensor that requires
    grad can so be fitted.

    The action is (4) in [-1, 1]: collective thrust (-1..1 maps to 0..max_thrust_to_weight times the nominal weight),
    then roll, pitch and yaw rate in units of the drone's max_body_rate.

    Args:
        num_envs: number of drones that fly in parallel.
        device: device of all tensors.
        dtype: torch.float32 or torch.float64.
        seed: seed of the environment's own random generator, or None for another one each time. Copies with one seed,
            as in ParallelEnv, fly alike: give each its own, or call ``set_seed`` on all of them. A run that shall go on
            as if it had not been stopped keeps ``env.rng.get_state()``, and gives it to ``env.rng.set_state``.
        drone: name of a preset, path of a YAML file, mapping, or :class:`~torchrl_quad.QuadrotorParams`.
        dt: physics step [s].
        control_dt: control step [s], a whole multiple of dt.
        action_delay: control steps between an action and its effect.
        integrator: "euler", "semi_implicit_euler" or "rk4".
        max_episode_steps: control steps after which an episode is truncated.
        observe_last_action: append the commands that are still on their way to the observation, which makes the delay
            visible to the policy. Off in the paper.
        observation_noise: standard deviations of white noise on what is observed, a mapping with any of ``position``
            [m], ``attitude`` [rad], ``velocity`` [m/s], ``angular_velocity`` [rad/s]; see
            :class:`~torchrl_quad.envs.options.Sensors`.
        observation_delay: control steps by which the observation of the drone lags behind.
        randomize: another drone in each episode: a mapping, or the path of a YAML file, from parameters to
            distributions; see :class:`~torchrl_quad.envs.options.DroneRandomization`.
        wind: a mapping with any of ``mean``, ``spread``, ``gust``, ``gust_time``; see
            :class:`~torchrl_quad.envs.options.Wind`.
        weights: other weights of the reward's terms, by name, in the place of the task's own: ``{"velocity": 0.0}``.
        random_start: a mapping with any of ``tilt``, ``yaw``, ``velocity``, ``angular_velocity``; see
            :class:`~torchrl_quad.envs.options.RandomStart`.
        compile: compile one control step with its observation, reward and termination, and its derivative; see
            ``docs/performance.md``. Takes half a minute for each number of environments, a few seconds once torch has
            it in its cache. First derivatives only.

    Raises:
        TypeError: an argument is unknown, with the closest one that is known, and all of them.
        ValueError: an argument is out of its range, with the allowed values. Of a step: the action or the state has
            the wrong shape, precision or device, or the action is not finite.
    """

    batch_locked = True
    _supports_set_state = True

    def __init__(
        self,
        num_envs: int = 64,
        *,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
        seed: int = 0,
        drone: Any = "visfly",
        dt: float = 0.005,
        control_dt: float = 0.02,
        action_delay: int = 1,
        integrator: str = "semi_implicit_euler",
        max_episode_steps: int = 256,
        observe_last_action: bool = False,
        observation_noise: Mapping[str, float] | None = None,
        observation_delay: int = 0,
        weights: Mapping[str, float] | None = None,
        randomize: str | Path | Mapping | None = None,
        wind: Mapping[str, Any] | None = None,
        random_start: Mapping[str, float] | None = None,
        **unknown: Any,
    ) -> None:
        self._refuse(unknown)
        _require_count("num_envs", num_envs, 1)
        _require(dtype in (torch.float32, torch.float64), f"dtype must be torch.float32 or torch.float64, got {dtype}.")
        for name, value in (("dt", dt), ("control_dt", control_dt)):
            is_time = isinstance(value, numbers.Real) and 0 < value < math.inf
            _require(is_time, f"{name} must be positive and finite, got {value!r}.")
        substeps = round(control_dt / dt)
        _require(
            substeps >= 1 and math.isclose(substeps * dt, control_dt, rel_tol=1e-6),
            f"control_dt must be a whole multiple of dt, got {control_dt} and {dt}; "
            f"try control_dt={max(substeps, 1) * dt:g}.",
        )
        _require_count("action_delay", action_delay, 0, "zero or more control steps")
        _require(
            integrator in INTEGRATORS, f"Unknown integrator {integrator!r}. Choose from: {', '.join(INTEGRATORS)}."
        )
        _require_count("max_episode_steps", max_episode_steps, 1)
        _require(
            action_delay > 0 or not observe_last_action,
            "observe_last_action shows the commands that are on their way; with action_delay=0 there are none.",
        )
        is_seed = seed is None or isinstance(seed, numbers.Integral)
        _require(is_seed, f"seed must be a whole number, or None for another one each time; got {seed!r}.")
        super().__init__(device=torch.device(device), batch_size=torch.Size([num_envs]))
        self.num_envs, self.dtype = num_envs, dtype
        self.dt, self.control_dt, self.substeps = dt, control_dt, substeps
        self.action_delay, self.integrator, self.max_episode_steps = action_delay, integrator, max_episode_steps
        self.observe_last_action = observe_last_action
        #: where resets start, see :meth:`set_initial_state_source`; None for the task's own starts
        self.initial_state_source: Callable[[int], TensorDictBase] | None = None
        params = drone if isinstance(drone, QuadrotorParams) else load_drone(drone)
        self.set_params(params)
        self.controller = FlightController(self.params)
        self.params = self.params if params.requires_grad else self.nominal
        self.weights = {**self.weights, **self._checked_weights({} if weights is None else weights)}
        self.sensors = options.build(
            options.Sensors, "observation_noise", observation_noise or {}, delay=observation_delay
        )
        self.wind = None if wind is None else options.build(options.Wind, "wind", wind)
        self.random_start = options.build(options.RandomStart, "random_start", random_start or {})
        self.randomization = options.DroneRandomization(randomize or {}, self.nominal)
        self._seen: State = {}  # what render() draws
        self._set_seed(seed)
        self.set_up()
        # Stands in for a state that is not finite, so that its environment computes on with harmless numbers.
        self.fallback = self.sample_initial_state(num_envs)
        self.task_entries = [key for key in self.initial_state(num_envs) if key not in QuadrotorState._fields]
        self.task_advances = type(self).advance is not QuadrotorEnv.advance
        self._check_task()
        self._no_observation = self.observation(self.fallback)
        self._make_specs()
        self.stepper = horizon.Stepper(self)
        self.set_seed(seed)

    # -- what a task says ----------------------------------------------------------------------------------------------

    @abc.abstractmethod
    def initial_state(self, n: int) -> State:
        """Draw n starts: what :meth:`hover_state` gives, moved and turned at will, and the entries the task adds."""

    @abc.abstractmethod
    def observe(self, state: State) -> Tensor:
        """The observation (num_envs, k) of a state."""

    @abc.abstractmethod
    def reward_terms(self, state: State) -> State:
        """The weighted reward terms by name, each (num_envs, 1), of the state a step has led to."""

    @abc.abstractmethod
    def is_crash(self, state: State) -> Tensor:
        """Where the drone is lost, bool (num_envs, 1): the episode terminates."""

    @abc.abstractmethod
    def is_success(self, state: State) -> Tensor:
        """Where the state, by itself, fulfils the task, bool (num_envs, 1)."""

    weights: Mapping[str, float] = {}  #: of the reward's terms, which an argument of the same name overrides
    ends_on_success = False  #: whether success terminates the episode, too

    def set_up(self) -> None:
        """Make the constant tensors of the task; called when device and precision are known, and after a move."""

    def advance(self, previous: State, state: State) -> State:
        """The state with the entries of the task brought from the previous step to this one; the drone has flown."""
        return state

    def metrics(self, state: State) -> State:
        """What to measure beside the reward, by name, each (num_envs, 1), without gradient."""
        return {}

    # -- what a task may use -------------------------------------------------------------------------------------------

    @property
    def nominal(self) -> QuadrotorParams:
        """The drone that the flight controller believes to fly; ``params`` is the one that flies."""
        return self.controller.nominal

    @property
    def params(self) -> QuadrotorParams:
        """The drone that flies."""
        return self._params

    @params.setter
    def params(self, params: QuadrotorParams) -> None:
        self.set_params(params)

    def set_params(self, params: QuadrotorParams) -> None:
        """Set :attr:`params`, also through a TransformedEnv, where assigning the attribute would not."""
        if not isinstance(params, QuadrotorParams):
            raise TypeError(
                f"params must be QuadrotorParams, such as env.params.replace(mass=0.5) or load_drone('visfly'); got "
                f"{type(params).__name__}."
            )
        for name, value in params.fields().items():
            batch = value.shape[0] if value.dim() > params.dim(name) else 1
            _require(
                batch in (1, self.num_envs),
                f"drone: field {name!r} is for {batch} environments, and num_envs={self.num_envs}.",
            )
        fits = all(x.dtype == self.dtype and x.device == self.device for x in params.fields().values())
        self._params = params if fits else params.to(device=self.device, dtype=self.dtype)

    @property
    def hover_action(self) -> Tensor:
        """The action (4) that holds the nominal drone where it is; (num_envs, 4) where drones differ in it."""
        return self.controller.hover_action

    def hover_state(self, position: Tensor) -> State:
        """Level, at rest, rotors at hover speed, at the given positions (n, 3) [m]."""
        n = position.shape[0]
        return {
            "position": position,
            "quaternion": quaternion.identity(torch.zeros_like(position[:, :1])),
            "velocity": torch.zeros_like(position),
            "angular_velocity": torch.zeros_like(position),
            "rotor_speed": self.controller.hover_speed.expand(n, 4).clone(),
        }

    def sample_initial_state(self, n: int) -> State:
        """Draw n complete Markov states from the task's own starts."""
        state = self.initial_state(n)
        if any(dataclasses.astuple(self.random_start)):
            state |= self.random_start.initial(self, state)
        state |= self.randomization.initial(self, n)
        if self.wind is not None:
            state |= self.wind.initial(self, n)
        if not self.sensors.are_perfect:
            state |= self.sensors.initial(state, self.normal(n, 12) if self.sensors.has_noise else None)
        if self.action_delay:
            hover = self.hover_action.expand(n, 4).unsqueeze(1)
            state["action_queue"] = hover.expand(n, self.action_delay, 4).clone()
        state["step"] = torch.zeros(n, 1, dtype=torch.int64, device=self.device)
        return state

    def tensor(self, values: Any) -> Tensor:
        """A tensor with the environment's device and floating-point type."""
        return torch.tensor(values, device=self.device, dtype=self.dtype)

    def uniform(self, *shape: int) -> Tensor:
        """Uniform random numbers in [-1, 1] from the environment's own generator."""
        return torch.rand(shape, generator=self.rng, device=self.device, dtype=self.dtype) * 2.0 - 1.0

    def normal(self, *shape: int) -> Tensor:
        """Standard normal random numbers from the environment's own generator."""
        return torch.randn(shape, generator=self.rng, device=self.device, dtype=self.dtype)

    def integers(self, high: int, *shape: int) -> Tensor:
        """Uniform random integers in [0, high) from the environment's own generator."""
        return torch.randint(high, shape, generator=self.rng, device=self.device)

    # -- what an evaluation asks ---------------------------------------------------------------------------------------

    def episode_metrics(self, rollout: TensorDictBase) -> dict[str, Tensor]:
        """What the first episode of each environment came to, in a rollout (num_envs, time) from fresh starts.

        Returns:
            by name, each (num_envs): ``return``, the undiscounted sum of rewards; ``crash`` and ``success``, 0 or 1;
            and the metrics of the task, as they are at the end of the episode. Here success means that the last state
            fulfils the task and that there was no crash; a task may ask more.
        """
        ends, first = rollout["next"], self.first_episode(rollout)
        crash = self.at_the_end(rollout, ends["crash"])
        success = self.at_the_end(rollout, ends["success"])
        return {
            "return": (ends["reward"] * first).sum(1).squeeze(-1),
            "crash": crash.to(self.dtype),
            "success": (success & ~crash).to(self.dtype),
            **{name: self.at_the_end(rollout, value) for name, value in ends.get("metrics", {}).items()},
        }

    @classmethod
    def at_the_end(cls, rollout: TensorDictBase, value: Tensor) -> Tensor:
        """The value (num_envs, time, 1) at the last step of the first episode of each environment, (num_envs)."""
        last = cls.first_episode(rollout).sum(1, keepdim=True) - 1
        return value.gather(1, last).flatten()

    @staticmethod
    def first_episode(rollout: TensorDictBase) -> Tensor:
        """Marks the steps of a rollout up to and with the first end of each environment, bool (num_envs, time, 1)."""
        done = rollout["next", "done"]
        return (done.cumsum(1) - done.int()) == 0

    # -- TorchRL's side ------------------------------------------------------------------------------------------------

    def compile(self, **kwargs: Any) -> QuadrotorEnv:
        """Compile the control step with its observation, reward and termination; the keywords go to torch.compile.

        Under transforms it is this environment that has to be compiled, ``TransformedEnv(HoveringEnv(compile=True),
        ...)``: TransformedEnv's own ``compile`` takes minutes and makes nothing faster.
        """
        kwargs.pop("warmup", None)  # TorchRL's option for steps whose input changes its layout: ours never does
        if shutil.which(os.environ.get("CXX", "g++")) or shutil.which("clang++"):
            self.stepper = horizon.Stepper(self, kwargs)
        else:
            warnings.warn(
                "compile: torch.compile needs a C++ compiler, and neither g++ nor clang++ is on the PATH. The "
                "environment stays eager: correct, but several times slower. Install one (Debian: apt install g++), or "
                "name yours in the environment variable CXX.",
                stacklevel=2,
            )
        return self

    def eager(self) -> QuadrotorEnv:
        """Undo :meth:`compile`."""
        self.stepper = horizon.Stepper(self)
        return self

    def to(self, device: torch.device | str) -> QuadrotorEnv:
        """Move the environment to a device, and start its random generator again from its seed."""
        super().to(device)
        follows = self.params is self.nominal
        self.controller = FlightController(self.nominal.to(device=self.device))
        self.params = self.nominal if follows else self.params
        self.fallback = {key: value.to(self.device) for key, value in self.fallback.items()}
        self._no_observation = self._no_observation.to(self.device)
        self.randomization = options.DroneRandomization(self.randomization.spec, self.nominal)
        self.set_up()
        self.set_seed(self._seed)
        self.stepper = horizon.Stepper(self, self.stepper.options)
        self._seen = {}
        return self

    def set_initial_state_source(self, source: Callable[[int], TensorDictBase] | None) -> None:
        """Set :attr:`initial_state_source`, also through a TransformedEnv, where assigning the attribute would not.

        ``source(n)`` returns n complete states (the content of ``td["state"]``); resets then start from them. None
        goes back to the task's own starts.
        """
        _require(
            source is None or callable(source),
            "initial_state_source must be a function from a number n to n states, or None for the task's own starts; "
            f"got {type(source).__name__}.",
        )
        self.initial_state_source = source

    def _set_seed(self, seed: int | None) -> None:
        self._seed = seed
        self.rng = torch.Generator(device=self.device)
        if seed is None:
            self.rng.seed()
        else:
            self.rng.manual_seed(seed)

    def _reset(self, tensordict: TensorDictBase | None = None, set_state: bool = False) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if set_state:
            source = "reset(..., set_state=True)"
            _require(
                tensordict is not None and "state" in tensordict,
                f'{source} needs a tensordict with the state to set under "state"; got none.',
            )
            state = self._checked_state(tensordict.get("state"), source, mask)
        else:
            state = self.draw_start()
        self._see(state, mask)
        return self._tensordict(self.first_entries(state))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        stepper, action = self.stepper, tensordict.get("action", None)
        state = stepper.layout.pack(self.required_state(tensordict.get("state", None), "step"))
        noise = {key: x[0] for key, x in self.draw_noise(1).items()}
        floats, valid = stepper.sound(state.floats)
        state = state._replace(floats=floats)
        # TorchRL resets by itself: what the episode after this one would start from is not used.
        end = stepper(state, valid, action, noise, state.detach(), self._no_observation)
        horizon.require_finite(action)
        entries = horizon.nested(stepper.entries(end.state, end.told))
        self._see(entries["state"])
        return self._tensordict({"observation": end.observation, **entries})

    def rollout(self, max_steps: int, policy: Any = None, callback: Any = None, **options: Any) -> TensorDictBase:
        """As TorchRL's rollout; several times faster where it flies on through the ends of episodes.

        That is with ``break_when_any_done=False``, a policy that is a TensorDictModule and reads the observation or
        the state, and no other option than ``tensordict`` (with ``auto_reset=False``). New starts are then drawn for 32
        steps at once: an environment whose episode ends twice within them begins at the same one both times.
        """
        _require_count("max_steps", max_steps, 1)
        start, auto_reset = options.get("tensordict"), options.get("auto_reset", True)
        quick = callback is None and options.get("break_when_any_done") is False and auto_reset == (start is None)
        cls = type(self)  # a step of a subclass's own is none that could be flown quickly
        quick = quick and (cls._step, cls._reset) == (QuadrotorEnv._step, QuadrotorEnv._reset)
        if quick and set(options) <= {"break_when_any_done", "auto_reset", "tensordict"}:
            start = self.reset() if start is None else start
            if horizon.can_fly(self, policy, start):
                rollout = horizon.fly(self, policy, start, max_steps)
                # Copied, so that not all of the rollout's memory is kept.
                self._see({key: x[:, -1].clone() for key, x in drawn(rollout["next", "state"]).items()})
                return rollout
            options |= {"tensordict": start, "auto_reset": False}
        return super().rollout(max_steps, policy, callback, **options)

    def render(self, drones: Sequence[int] | None = None, *, size: int = 336) -> np.ndarray:
        """Draw the drones as the last reset, step or rollout has left them, with their targets, into one picture.

        That is what TorchRL's ``PixelRenderTransform`` asks for, and ``VideoRecorder`` makes a video of:
        ``TransformedEnv(env, Compose(PixelRenderTransform(), VideoRecorder(logger, "flight", fps=50)))`` films every
        control step. Keywords of the transform come here: ``PixelRenderTransform(drones=[0, 1], size=480)``. The view
        grows when a drone leaves it.

        Args:
            drones: indices of those to draw; by default the first six.
            size: width and height [pixels].

        Returns:
            the picture (size, size, 3), uint8.

        Raises:
            ValueError: there is no state yet, as before the first reset and after ``to``; or an argument is out of its
                range.
            ImportError: matplotlib is missing.
        """
        _require(
            bool(self._seen),
            "render() draws the state that the last reset or step has led to, and there is none yet. Call env.reset() "
            "first.",
        )
        from torchrl_quad.render.frames import draw_frame  # only who draws needs matplotlib

        return draw_frame(self, self._seen, drones, size)

    def _see(self, state: Mapping[str, Tensor], mask: Tensor | None = None) -> None:
        """Keep of a state what render() draws; a mask tells which environments it is of.

        A step stays a pure function: nothing reads this but render(). Detached, it keeps no graph alive, and refers to
        tensors that are there anyway. A weak reference would be gone as soon as the caller has made a copy.
        """
        seen = {key: x.detach() for key, x in drawn(state).items()}
        if mask is not None and self._seen:
            seen = {key: torch.where(mask.reshape(-1, 1), x, self._seen[key]) for key, x in seen.items()}
        self._seen = seen

    # -- one step, as a function of its input --------------------------------------------------------------------------

    def draw_noise(self, steps: int) -> State:
        """What chance adds to each of a number of steps (steps, num_envs, k): a compiled step cannot draw it."""
        noise = {}
        if self.wind is not None and self.wind.gust:
            noise["wind"] = self.normal(steps, self.num_envs, 3)
        if self.sensors.has_noise:
            noise["sensors"] = self.normal(steps, self.num_envs, 12)
        return noise

    def draw_start(self) -> State:
        """States for all environments to begin an episode with."""
        if self.initial_state_source is None:
            return self.sample_initial_state(self.num_envs)
        return self._checked_state(self.initial_state_source(self.num_envs), "initial_state_source")

    def first_entries(self, state: State) -> dict[str, Any]:
        """What a reset to a state tells."""
        terms = {name: torch.zeros_like(term) for name, term in self.reward_terms(state).items()}
        return {"state": state, "reward_terms": terms, **self.told(state)}

    def told(self, state: State) -> dict[str, Any]:
        """What a state, by itself, tells: all entries but the state and the reward, as of an episode that goes on."""
        no = torch.zeros_like(state["step"], dtype=torch.bool)
        return {
            "observation": self.observation(state),
            "metrics": self.metrics({key: value.detach() for key, value in state.items()}),
            "success": self.is_success(state),
            "crash": no,
            "done": no.clone(),
            "terminated": no.clone(),
            "truncated": no.clone(),
        }

    def observation(self, state: State) -> Tensor:
        """What the policy is told of a state, through the sensors: (num_envs, k)."""
        observation = self.observe(state if self.sensors.are_perfect else self.sensors.observed(state))
        if self.observe_last_action:
            observation = torch.cat((observation, state["action_queue"].flatten(1)), -1)
        return observation

    def disturbed(self, state: State, noise: State) -> State:
        """The state with what wind and sensors have made of it after a step."""
        if "wind" in noise:
            state = {**state, **self.wind.advance(state, noise["wind"], self.control_dt)}
        if not self.sensors.are_perfect:
            state = {**state, **self.sensors.advance(state, noise.get("sensors"))}
        return state

    def flying(self, state: State) -> Any:
        """The parameters of the drones that fly: those of the environment, with what each episode has drawn."""
        if not self.randomization.spec:
            return self.params
        drawn = {name: state["drone", name] for name in self.randomization.spec}
        return RawParams(**{**self.params.fields(), **drawn})

    def required_state(self, state: Any, source: str) -> State:
        """The entries of a state, if all are there and of the right shape, precision and device."""
        checked = self._complete_state(state, source)
        for key, like in self.fallback.items():
            x = checked[key]
            _require(
                x.dtype == like.dtype and x.device == like.device,
                f"{source}: state {key!r} is {x.dtype} on {x.device}, and this environment {like.dtype} on "
                f"{like.device}. Convert it: env.reset(tensordict, set_state=True) does.",
            )
        return checked

    def _checked_state(self, state: Any, source: str, mask: Tensor | None = None) -> State:
        """A copy of a state that the next step can fly from, in the environments that the mask tells, or in all."""
        state = self._complete_state(state, source)
        state = {key: state[key].to(x.device, x.dtype, copy=True) for key, x in self.fallback.items()}
        if not horizon.cannot_look():
            broken = ~self.stepper.sound(self.stepper.layout.pack(state).floats)[1]
            broken &= True if mask is None else mask.flatten()
            _require(
                not broken.any(),
                f"{source}: the states of environments {horizon.first_ten(broken)} are none to fly from: not finite, a "
                "quaternion that is not of unit norm, or a speed beyond all bounds.",
            )
        return state

    def _complete_state(self, state: Any, source: str) -> State:
        _require(
            isinstance(state, TensorDictBase),
            f'{source}: a state is a tensordict, such as env.reset()["state"]; got {type(state).__name__}.',
        )
        given = dict(state.items(include_nested=True, leaves_only=True))
        missing = [key for key in self.fallback if key not in given]
        _require(
            not missing,
            f"{source}: the state lacks {_names(missing)}. A state is restored whole: take it from a tensordict of "
            f"this environment, which holds {_names(self.fallback)}.",
        )
        for key, like in self.fallback.items():
            shape, expected = tuple(given[key].shape), (self.num_envs, *like.shape[1:])
            _require(shape == expected, f"{source}: state {key!r} has shape {shape}, expected {expected}.")
        return given

    def _checked_weights(self, weights: Any) -> Mapping[str, float]:
        _require(
            isinstance(weights, Mapping),
            f"weights must be a mapping from terms of the reward to numbers, got {weights!r}.",
        )
        unknown = [str(name) for name in weights if name not in self.weights]
        _require(not unknown, f"weights: unknown term {_names(unknown)}. Choose from: {_names(self.weights)}.")
        for name, value in weights.items():
            x = value.detach() if isinstance(value, Tensor) else value
            is_number = x.numel() == 1 if isinstance(x, Tensor) else isinstance(x, numbers.Real)
            is_finite = is_number and math.isfinite(float(x))
            _require(is_finite, f"weights: {name} must be a finite number, got {value!r}.")
        return weights

    def _check_task(self) -> None:
        """Refuse a task whose methods return something else than the base class says.

        Rows that are not as many as they should be would be read as those of another entry.
        """
        task, state, n = type(self).__name__, self.fallback, self.num_envs

        def check(method: str, x: Any, dtype: torch.dtype | None, columns: int | None = 1, hint: str = "") -> None:
            is_right = isinstance(x, Tensor) and x.shape == (n, columns or x.shape[-1:].numel())
            if not is_right or dtype not in (None, x.dtype):
                got = f"{tuple(x.shape)}, {x.dtype}" if isinstance(x, Tensor) else type(x).__name__
                raise ValueError(
                    f"{task}.{method} must be a tensor ({n}, {columns or 'k'})"
                    f"{'' if dtype is None else f', {dtype}'}; got {got}.{hint}"
                )

        def named(method: str, entries: Any) -> Mapping[Any, Any]:
            _require(
                isinstance(entries, Mapping),
                f"{task}.{method} must be a mapping from names to tensors; got {type(entries).__name__}.",
            )
            return entries

        for key, x in state.items():
            _require(
                isinstance(x, Tensor) and x.dim() > 1 and len(x) == n,
                f"{task}.initial_state: entry {key!r} must be a tensor ({n}, ...) of at least two "
                f"dimensions; got {tuple(x.shape) if isinstance(x, Tensor) else type(x).__name__}.",
            )
        check("observe(state)", self.observe(state), self.dtype, None)
        for name, term in named("reward_terms(state)", self.reward_terms(state)).items():
            hint = " Sum a vector over its components: .sum(-1, keepdim=True)."
            check(f"reward_terms(state)[{name!r}]", term, self.dtype, hint=hint)
        for name, metric in named("metrics(state)", self.metrics(state)).items():
            check(f"metrics(state)[{name!r}]", metric, None)
        for method in ("is_crash", "is_success"):
            check(f"{method}(state)", getattr(self, method)(state), torch.bool)
        advanced = named("advance(previous, state)", self.advance(state, dict(state)))
        for key in self.task_entries:
            like, x = state[key], advanced.get(key)
            got = None if x is None else (tuple(x.shape), x.dtype)
            _require(
                got == (tuple(like.shape), like.dtype),
                f"{task}.advance must return the whole state, and {key!r} as initial_state gives it, "
                f"{(tuple(like.shape), like.dtype)}; got {got}. Start from {{**state, ...}}.",
            )

    def _refuse(self, unknown: Mapping[str, Any]) -> None:
        """Say of options that no task knows what they may have meant."""
        if not unknown:
            return
        known = ["compile"]
        for cls in reversed(type(self).__mro__[: type(self).__mro__.index(QuadrotorEnv) + 1]):
            parameters = inspect.signature(cls.__init__).parameters.values()
            known += [p.name for p in parameters if p.name not in ("self", *known) and p.kind is not p.VAR_KEYWORD]
        name = next(iter(unknown))
        close = difflib.get_close_matches(name, known, 1)
        hint = f" Did you mean {close[0]!r}?" if close else ""
        raise TypeError(
            f"{type(self).__name__} got an unexpected keyword argument {name!r}.{hint} Choose from: "
            f"{_names(sorted(known))}."
        )

    def _tensordict(self, entries: dict[str, Any]) -> TensorDict:
        return TensorDict(entries, batch_size=self.batch_size, device=self.device)

    def _make_specs(self) -> None:
        def unbounded(x: Tensor) -> Unbounded:
            return Unbounded((self.num_envs, *x.shape[1:]), device=self.device, dtype=x.dtype)

        def composite(entries: dict[Any, Any]) -> Composite:
            return Composite(entries, shape=self.batch_size, device=self.device)

        def flag() -> Binary:
            return Binary(1, (self.num_envs, 1), device=self.device, dtype=torch.bool)

        def like(entries: State) -> Composite:
            return composite({key: unbounded(x) for key, x in entries.items()})

        state, terms, metrics = self.fallback, self.reward_terms(self.fallback), self.metrics(self.fallback)
        self.observation_spec = composite(
            {
                "observation": unbounded(self.observation(state)),
                "state": like(state),
                "reward_terms": like(terms),
                "success": flag(),
                "crash": flag(),
                **({"metrics": like(metrics)} if metrics else {}),
            }
        )
        # A key that stands in the state spec alone would never be carried on: it stands in both.
        self.state_spec = composite({"state": like(state)})
        self.action_spec = Bounded(-1.0, 1.0, (self.num_envs, 4), device=self.device, dtype=self.dtype)
        self.reward_spec = unbounded(torch.zeros(1, 1, dtype=self.dtype))
        self.done_spec = composite({"done": flag(), "terminated": flag(), "truncated": flag()})


def _names(keys: Iterable[Any]) -> str:
    return ", ".join(str(key) for key in keys)


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)


def _require_count(name: str, value: Any, least: int, rule: str | None = None) -> None:
    _require(isinstance(value, numbers.Integral), f"{name} must be a whole number, got {value!r}.")
    _require(value >= least, f"{name} must be {rule or f'at least {least}'}, got {value}.")
