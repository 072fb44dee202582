"""What every task shares: TorchRL's specs, resets, steps, seeds and devices."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_quad.dynamics import QuadrotorParams, load_drone
from torchrl_quad.dynamics.gains import PhysicsStep
from torchrl_quad.dynamics.rigid_body import Integrator
from torchrl_quad.engine import Stepper, can_fly, flies_inside, fly, has_compiler, nested
from torchrl_quad.engine.simulation import State
from torchrl_quad.envs import config, guard
from torchrl_quad.envs.any_drone import AnyDrone
from torchrl_quad.envs.markers import merge_reset, visible_state
from torchrl_quad.envs.randomness import Randomness
from torchrl_quad.envs.scenes import MountedCamera
from torchrl_quad.envs.step import ControlStep, sample_state
from torchrl_quad.envs.task import Task, check_task
from torchrl_quad.errors import UserTypeError, UserValueError, shown
from torchrl_quad.options import Delay, Device, Horizon, Seed, Share, Size, check_value, checked


class _Build(type(EnvBase)):
    defaults: Mapping[str, Any]

    def __call__(cls, *args: Any, auto_reset: bool = False, **kwargs: Any) -> Any:
        if auto_reset:  # TorchRL would wrap it, and no episode would ever begin again
            raise UserValueError(
                "auto_reset=True is for environments that reset themselves in the step that ends an episode, and this "
                "one waits for a reset. Leave it out: rollouts and collectors reset where an episode ends."
            )
        given = dict(zip(inspect.signature(cls).parameters, args, strict=False))
        kwargs = {name: x for name, x in cls.defaults.items() if name not in given} | kwargs
        try:
            env = super().__call__(*args, **kwargs)
        except AttributeError as error:
            is_own = cls.__init__ is not QuadrotorEnv.__init__  # without one, nothing is set too early or too late
            if is_own and str(error).startswith(f"{cls.__name__!r} object"):
                when = "super().__init__() calls the methods of the task: set what they read before it"
                error.add_note(f"{when}, and make tensors in set_up, where self.tensor works.")
            raise
        env._built_with = given | kwargs
        return env


@checked
class QuadrotorEnv(Task, EnvBase, metaclass=_Build):
    """Base of all tasks: a batch of quadrotors, stateless and differentiable.

    A step is a pure function of its tensordict. The complete Markov state is in ``"state"``, and gradients flow from
    every entry of ``"next"`` to the actions, to the state, and to ``env.params``. A task subclasses this and defines
    what :class:`~torchrl_quad.envs.Task` asks for, as :class:`~torchrl_quad.envs.HoveringEnv` does.

    A step also writes ``"success"``, ``"crash"``, ``("reward_terms", name)``, whose sum is the reward, and
    ``("metrics", name)``, what the task measures, without gradient.

    ``env.params`` is the drone that flies; ``env.params = env.params.replace(mass=0.5)`` changes it, and a parameter
    that requires grad can be fitted. ``env.nominal`` is the drone that its controller believes in.

    Args:
        num_envs: number of drones that fly in parallel.
        device: of all tensors, such as "cpu" or "cuda".
        dtype: torch.float32 or torch.float64.
        seed: of the environment's own random generator, from 0; None takes a new one each time. One seed gives one
            flight: give each of several copies its own, as in ParallelEnv.
        drone: name of a preset, path of a YAML file, mapping, or :class:`~torchrl_quad.QuadrotorParams`.
        dynamics: "quadrotor", or "point_mass", whose thrust and body rates follow the action at once.
        control: what an action (4) in [-1, 1] commands: "rates" (thrust, body rates), "attitude" (thrust, roll, pitch,
            yaw rate), "rotor_thrusts" (n, of n rotors), "velocity" (and yaw rate), or a mapping with limits, such as
            {mode: velocity, max_speed: 5.0}. See ``docs/actions.md``.
        firmware: "betaflight" or "pid", to train for the rate loop of :class:`~torchrl_quad.dynamics.Betaflight` or
            :class:`~torchrl_quad.dynamics.PID`.
        dt: the physics step, 1e-6 to 0.1 s.
        control_dt: the control step, 1e-6 to 1 s, 1 to 200 times dt. Hovering is judged by its last second.
        action_delay: control steps from a command to its effect, 0 to 1000; 1 is usual.
        integrator: of the rigid body in a physics step.
        max_episode_steps: control steps after which an episode is truncated.
        observe_last_action: whether the commands on their way are appended to the observation; off in the paper.
        observation_noise: white noise: a mapping, or :class:`~torchrl_quad.envs.disturbances.Sensors`.
        observation_delay: control steps by which the observation of the drone lags behind, 0 to 1000.
        weights: other weights of reward terms, by name, each within a million: ``{"velocity": 0.0}``.
        event_discount: the discount per control step by which the time of an event counts, above 0, at most 1; None
            for no gradient in it.
        randomize: draws a drone for each episode, about this one, as
            :class:`~torchrl_quad.envs.disturbances.DroneRandomization` says; or "any" of all quadrotors, as
            :class:`~torchrl_quad.envs.any_drone.AnyDrone` says.
        wind: a mapping with fields of :class:`~torchrl_quad.envs.disturbances.Wind`, or an instance.
        random_start: a mapping with fields of :class:`~torchrl_quad.envs.disturbances.RandomStart`, or an instance.
        disturbances: your own, a list; see :class:`~torchrl_quad.envs.disturbances.Disturbance`. Each is an instance, a
            class, or as on a command line a path, "mypackage.GyroBias", or {_target_: mypackage.GyroBias, spread: 0.1}.
        scene: obstacles, which drones crash into: a mapping or a YAML file; see :class:`~torchrl_quad.Scene`.
        camera: adds ``"depth"`` (num_envs, 1, height, width) [m] to what a policy may read: a
            :class:`~torchrl_quad.DepthCamera`, or a mapping of its fields. Without a scene it shows the ground z = 0.
        compile: compile the step and its first derivative: a minute the first time; see ``docs/performance.md``.

    Raises:
        TypeError: an argument is unknown.
        ValueError: an argument is out of range. Of a step: action or state do not fit, or an action is not finite.
    """

    batch_locked, _supports_set_state = True, True
    _built_with: dict[str, Any]  # its arguments, by name

    def __init__(
        self,
        num_envs: Size = 64,
        *,
        device: Device = "cpu",
        dtype: config.FloatType = torch.float32,
        seed: Seed | None = 0,
        drone: config.DroneOption = "visfly",
        dynamics: config.DynamicsOption = "quadrotor",
        control: config.ControlOption = "rates",
        firmware: config.FirmwareOption = None,
        dt: PhysicsStep = 0.005,
        control_dt: config.ControlPeriod = 0.02,
        action_delay: Delay = 1,
        integrator: Integrator = "semi_implicit_euler",
        max_episode_steps: Size = 256,
        observe_last_action: bool = False,
        observation_noise: config.NoiseOption = None,
        observation_delay: Delay = 0,
        weights: config.WeightsOption = None,
        event_discount: Share | None = None,
        randomize: config.RandomizeOption = None,
        wind: config.WindOption = None,
        random_start: config.StartOption = None,
        disturbances: config.DisturbancesOption = (),
        scene: config.SceneOption = None,
        camera: config.CameraOption = None,
    ) -> None:
        # What is built of these is built again on another device.
        self._options: dict[str, Any] = {
            "dynamics": dynamics, "control": control, "firmware": firmware, "dt": dt, "control_dt": control_dt,
            "integrator": integrator,
            "random_start": random_start, "randomize": randomize, "wind": wind, "observation_noise": observation_noise,
            "observation_delay": observation_delay, "disturbances": config.as_disturbances(disturbances),
            "scene": scene, "camera": camera,
        }  # fmt: skip
        super().__init__(device=torch.device(device), batch_size=torch.Size([num_envs]))
        self.num_envs, self.dtype, self.control_dt, self.action_delay = num_envs, dtype, control_dt, action_delay
        self.max_episode_steps, self.observe_last_action = max_episode_steps, observe_last_action
        self.event_discount, self.control, self.initial_state_source = event_discount, control, None
        self._drone = str(drone) if isinstance(drone, str | Path) else "own"
        params = drone if isinstance(drone, QuadrotorParams) else load_drone(drone, dtype)
        params = params.to(device=self.device, dtype=dtype)
        config.check_params(params, num_envs)
        self.weights = config.known_weights(self.weights, weights or {})
        self._place(params)
        drawn = self.disturbances.get("randomize")
        if isinstance(drawn, AnyDrone):
            self.action_delay = drawn.queue_length(action_delay)
            if params.requires_grad:
                raise UserValueError("randomize='any' draws the drone, so that no gradient reaches yours: detach it.")
            params = self.nominal.replace(rotor_effectiveness=params.rotor_effectiveness)
        if self.action_delay == 0 and observe_last_action:
            raise UserValueError(
                "observe_last_action shows commands on their way, and without a delay there are none. Leave it out."
            )
        self._params = params if params.requires_grad or params.rotor_effectiveness is not None else self.nominal
        self.randomness.seed(seed)
        self.set_up()
        try:
            start = self.initial_state(num_envs)
        except KeyError as error:
            raise UserValueError(
                f"{type(self).__name__}.initial_state asks for {error}, which hover_state does not give: it has "
                f"{', '.join(self.dynamics.sizes)}. What the environment adds, such as step, comes after it."
            ) from error
        if not (isinstance(start, dict) and start.keys() >= self.dynamics.sizes.keys()):
            got = ", ".join(map(str, start)) if isinstance(start, dict) else type(start).__name__
            raise UserValueError(
                f"{type(self).__name__}.initial_state must return the state that hover_state gives, and your entries: "
                f"{{**self.hover_state(position), 'goal': goal}}; got {got}."
            )
        self.task_entries = [key for key in start if key not in self.dynamics.sizes]
        state = sample_state(self, num_envs)
        self._starts = check_task(self, state)
        config.check_changes(self.dynamics, self.params, self.params, self._starts)
        self._connect(state)
        self.control_step.restore(TensorDict(cast(Any, nested(state))), f"{type(self).__name__}.initial_state")
        for name, spec in self.control_step.specs().items():
            setattr(self, name, spec)
        self.set_seed(seed)

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        cls.defaults = {k: x for base in reversed(cls.__mro__) for k, x in getattr(base, "defaults", {}).items()}
        if "__init__" in vars(cls):
            checked(cls)
        cls.__signature__ = config.full_signature(cls, EnvBase)
        for name in sorted(cls.__signature__.parameters.keys() & vars(cls).keys() - {"weights"}):
            if not hasattr(value := vars(cls)[name], "__get__"):  # as methods and properties have
                raise UserTypeError(
                    f"{cls.__name__}.{name} is an argument, which an attribute of the class does not change. Write "
                    f"defaults = {shown({**cls.defaults, name: value})}."
                )

    def __repr__(self) -> str:
        changed = "" if self.params is self.nominal else " with other parameters"
        more = f", disturbances={'+'.join(self.disturbances)}" if self.disturbances else ""
        return (
            f"{type(self).__name__}(num_envs={self.num_envs}, drone={self._drone!r}{changed}, "
            f"control_dt={self.control_dt:g} s, max_episode_steps={self.max_episode_steps}{more}, "
            f"device={self.device}, dtype={self.dtype}, compiled={self.is_compiled})"
        )

    @property
    def params(self) -> QuadrotorParams:
        """The drone that flies."""
        return self._params

    @params.setter
    def params(self, params: QuadrotorParams) -> None:
        self.set_params(params)

    def set_params(self, params: QuadrotorParams) -> None:
        """Set :attr:`params`, also through a TransformedEnv, where an assignment would not reach this environment."""
        config.check_params(params, self.num_envs, self.nominal)
        fits = all(x.dtype == self.dtype and x.device == self.device for x in params.fields().values())
        params = params if fits else params.to(device=self.device, dtype=self.dtype)
        config.check_flown(self.dynamics, params)
        config.check_changes(self.dynamics, self.params, params, self._starts)
        self._params = params

    def set_initial_state_source(self, source: Callable[[int], TensorDictBase] | None) -> None:
        """Choose where resets start, also through a TransformedEnv: ``source(n)`` returns n complete states, the
        content of ``td["state"]``; None means the task's own starts."""
        if not (source is None or callable(source)):
            raise UserValueError(
                "initial_state_source must be a function from a number n to n states, or None for the task's own "
                f"starts; got {type(source).__name__}."
            )
        self.initial_state_source = source
        self.randomness.forget_starts()

    @checked
    def sample_start(self, n: Size) -> TensorDict:
        """Draw n complete Markov states from the task's own starts: a tensordict [n] with ``state``."""
        return TensorDict({"state": cast(Any, nested(sample_state(self, n)))}, [n], self.device)

    def random_state(self) -> dict[str, Any]:
        """Everything random in this environment, to resume from later; torch can save it."""
        return self.randomness.state()

    def set_random_state(self, state: dict[str, Any]) -> None:
        """Resume from what :meth:`random_state` returned."""
        self.randomness.set_state(state)

    @property
    def is_compiled(self) -> bool:
        """Whether steps run compiled."""
        return self._stepper.is_compiled

    def compile(self, **kwargs: Any) -> QuadrotorEnv:
        """Compile the control step and its derivative; the keywords go to torch.compile. Under transforms, compile the
        environment inside, ``TransformedEnv(HoveringEnv(compile=True), ...)``: TransformedEnv's own takes minutes."""
        kwargs.pop("warmup", None)  # TorchRL's option for steps whose input changes its layout: ours never does
        return self._run(kwargs if has_compiler() else None)

    def flies_inside(self, policy: Any) -> bool:
        """Whether :meth:`rollout` flies a policy inside the compiled step, which is fastest, or calls it before each
        step. It ignores transforms; :func:`torchrl_quad.data.flight_mode` does not."""
        return flies_inside(self._stepper, policy)

    def eager(self) -> QuadrotorEnv:
        """Undo :meth:`compile`."""
        return self._run(None)

    @checked
    def to(self, device: Device) -> QuadrotorEnv:
        """Move the environment to a device, where its random generator restarts from its seed."""
        if torch.device(device) == self.device:
            return self
        super().to(device)
        flying = None if self.params is self.nominal else self.params.to(device=self.device)
        self._place(self._built.to(device=self.device))
        self._params = self.nominal if flying is None else flying
        self.set_up()
        safe_state = {key: x.to(self.device) for key, x in self.control_step.safe_state.items()}
        self._connect(safe_state, self._stepper.options)
        self.set_seed(self._seed)
        return self

    def render(self, drones: Sequence[int] | None = None, *, size: int = 336) -> Any:
        """Draw drones as the last reset, step or rollout left them; TorchRL's ``PixelRenderTransform`` calls it.

        The indices are by default the first six. The picture is a numpy array (size, size, 3) of uint8.
        """
        from torchrl_quad.render.video import draw_frame  # matplotlib is needed only here

        return draw_frame(self, drones, size)

    def rebuilt(self, **changes: Any) -> Any:
        """The same environment with other arguments, built again: ``env.rebuilt(num_envs=8, wind=None)``. It flies the
        same drone, if none is given, from its own starts."""
        now = {"compile": self._stepper.options or self.is_compiled, "device": self.device}
        env = cast(Any, type(self))(**{**self._built_with, **now, **changes})
        flying = env.nominal if self.params is self.nominal else self.params
        if "drone" not in changes and flying is not env.params:
            env.set_params(flying)
        return env

    def _place(self, drone: QuadrotorParams) -> None:
        """Build what holds tensors on the device and in the precision of the environment."""
        self._built = drone = drone.detach()
        self.dynamics = config.build_dynamics(drone, self._options)
        self.disturbances = config.build_disturbances(self.dynamics, drone, self._options)
        self.randomness = Randomness(self.device, self.dtype)

    def _connect(self, safe_state: State, options: dict[str, Any] | None = None) -> None:
        """Join what belongs together on one device."""
        self.control_step = ControlStep(self, safe_state)
        self._run(options)
        sizes = {name: x.noise_size for name, x in self.disturbances.items()}
        self.randomness.noise_shapes = {name: (self.num_envs, size) for name, size in sizes.items() if size}
        self.randomness.draw_start = self.control_step.draw_start
        self.render_state: State = {}  # positions, quaternions and targets, for render()

    def _run(self, options: dict[str, Any] | None) -> QuadrotorEnv:
        """Run steps compiled with these options, eager for None; and the camera, which starts use, too, likewise."""
        if options is not None:
            config.check_forms(type(self.dynamics))
        self._stepper = Stepper(self.control_step, options)
        if isinstance(camera := self.disturbances.get("camera"), MountedCamera):
            camera.is_compiled = self.is_compiled
        return self

    def reset(self, tensordict: TensorDictBase | None = None, *, set_state: bool | None = None, **options: Any) -> Any:
        """As TorchRL's; of a mask and a state in one tensordict, ``set_state`` says which of them counts."""
        is_said = set_state is not None or options.get("select_reset_only")
        # Of the two TorchRL 0.14 takes the state, and 0.15 the mask.
        if not is_said and tensordict is not None and {"_reset", "state"} <= set(tensordict.keys()):
            raise UserValueError(
                'reset: the tensordict has a mask in "_reset" and a state. For fresh starts in the environments of the '
                "mask write env.reset(tensordict, set_state=False); to set them to this state, set_state=True."
            )
        return super().reset(tensordict, set_state=set_state, **options)

    def _set_seed(self, seed: int | None) -> None:
        self._seed = check_value("seed", seed, Seed | None)
        self.randomness.seed(seed)

    def _reset(
        self, tensordict: TensorDictBase | None = None, set_state: bool = False, **kwargs: Any
    ) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if set_state:
            source = "reset(..., set_state=True)"
            if tensordict is None or "state" not in tensordict:
                raise UserValueError(f'{source} needs a tensordict with the state to set in "state"; got none.')
            entries = self.control_step.reset(self.control_step.restore(tensordict.get("state"), source, mask))
        else:
            entries = self.randomness.starts(None if mask is None else mask.reshape(-1))
        self.render_state = merge_reset(self.render_state, visible_state(entries["state"]), mask)
        return TensorDict(cast(Any, entries), [self.num_envs], self.device)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action, step = cast(Tensor, tensordict.get("action", None)), self.control_step
        step.check_action(action)
        state, valid = step.guard(guard.read_state(tensordict.get("state", None), step.safe_state, "step"))
        state, outputs = self._stepper.step(state, valid, action, self.randomness.noise())
        guard.check_finite(action)
        self.render_state = visible_state(state)
        return TensorDict(cast(Any, {"state": nested(state), **outputs}), [self.num_envs], self.device)

    def rollout(self, max_steps: int, policy: Any = None, callback: Any = None, **options: Any) -> TensorDictBase:
        """As TorchRL's, with the same numbers; several times faster with ``break_when_any_done=False``, no other option
        than ``tensordict`` (with ``auto_reset=False``), and a TensorDictModule that reads observation or state."""
        max_steps = check_value("max_steps", max_steps, Horizon)
        start, auto_reset = options.get("tensordict"), options.get("auto_reset", True)
        quick = callback is None and options.get("break_when_any_done") is False and auto_reset == (start is None)
        # The engine would pass over a step of a subclass's own.
        quick = quick and (type(self)._step, type(self)._reset) == (QuadrotorEnv._step, QuadrotorEnv._reset)
        if quick and set(options) <= {"break_when_any_done", "auto_reset", "tensordict"}:
            start = self.reset() if start is None else start
            if can_fly(self._stepper, policy, start):
                state = guard.read_state(start.get("state"), self.control_step.safe_state, "rollout")
                rollout = fly(self._stepper, self.randomness, policy, state, start, max_steps)
                guard.check_finite(cast(Tensor, rollout["action"]))
                self.render_state = visible_state(cast(TensorDict, rollout["next", "state"])[:, -1].clone())
                return rollout
            options |= {"tensordict": start, "auto_reset": False}
        return super().rollout(max_steps, policy, callback, **options)


QuadrotorEnv.__signature__ = config.full_signature(QuadrotorEnv, EnvBase)
