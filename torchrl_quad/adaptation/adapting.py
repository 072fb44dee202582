"""From seconds of flight to a better policy: fit the simulator to the flight, and take gradient steps through it."""

from __future__ import annotations

import copy
import dataclasses
import time
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, cast

import torch
from pydantic import Field
from tensordict import TensorDictBase
from torch import nn
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType

from torchrl_quad.adaptation.fit import FlightFit, Flown, fit_flight
from torchrl_quad.data import differentiable_rollout, restart
from torchrl_quad.data.unwrap import base_env, leaf
from torchrl_quad.dynamics import MotorCommand, Quadrotor
from torchrl_quad.envs import QuadrotorEnv
from torchrl_quad.envs.any_drone import AnyDrone
from torchrl_quad.envs.metrics import first_episode
from torchrl_quad.errors import Unsupported, UserTypeError, UserValueError
from torchrl_quad.identification import FlightLog, LogError, prediction
from torchrl_quad.objectives import BPTTLoss
from torchrl_quad.objectives.trust_region import TrustRegion
from torchrl_quad.options import Horizon, Positive, Seed, Size, checked

LEAST_GAIN = 0.1  # of the prediction of what was held out; a flight that tells less changes nothing
MOST_CRASHES = 0.5  # of a policy that is flown: where more crash, return and simulator tell little
_TESTED = 20  # steps between tests of the policy
_EVERY = 8  # of the states in an episode count for the bound, which is quicker


@dataclasses.dataclass(frozen=True)
class Adaptation:
    """What became of a policy, and why."""

    policy: Any  #: the one to fly from now on, better or a copy of the old one
    changed: bool  #: whether it is another one
    reason: str  #: in a sentence
    seconds: Mapping[str, float]  #: of the processor, for ``fit``, ``steps`` and ``test``
    control_dt: float  #: [s], between the steps of ``flights``
    fit: FlightFit | None = None  #: what the flights say; None where they could not be fitted
    #: of the old policy in the fitted simulator, its ``return`` and the task's metrics
    before: Mapping[str, float] = dataclasses.field(default_factory=dict)
    after: Mapping[str, float] = dataclasses.field(default_factory=dict)  #: of ``policy``, from the same fresh starts
    kl: float = 0.0  #: how far ``policy`` is from the old one, KL(old || new), a mean over the old one's states
    flights: tuple[TensorDictBase, ...] = dataclasses.field(default=(), repr=False)  #: of both policies in this test


@checked
class Adapter:
    """Adapts a policy to flights, again and again: an online loop calls it after each flight.

    An environment with ``compile=True`` compiles once, in the first call or by :meth:`warm_up`; steps then take a fifth
    of the time.

    A call fits rotors, inertia and wind to the logs (:func:`~torchrl_quad.adaptation.fit_flight`), draws drones and
    wind from that fit, and takes steps of backpropagation through time in them, with the task's own reward. The policy
    stays within ``max_kl`` of the one that flew. It is replaced only if all of this holds:

    - The flights agree with each other and with the drone, as :func:`~torchrl_quad.adaptation.fit_flight` checks.
    - They tell what each rotor gives, and the fit predicts what was held out of them better.
    - In the fitted simulator, from fresh starts, the new policy has the greater return, crashes no more often, and in
      at most half of the episodes.

    Each call fits its own flights alone: give earlier ones of the same wind again. Disturbances of your own stay in
    the fitted simulator; leave out those that the flights show as well, as a random mass.

    .. code-block:: python

        adapter = Adapter(actor, env)
        for _ in range(3):
            found = adapter(read_log(fly(adapter.policy)))
            print(found.reason)

    Args:
        policy: as :func:`~torchrl_quad.make_actor` builds it, with or without a memory. It is copied.
        env: what it was trained in: any task of a quadrotor, in any control mode, also under an ObservationNormalizer,
            best with ``compile=True``. What it randomises, and its wind, give way to what the flights say.
        motors: from the motor commands of the logs to rotor speeds; None takes ``env.params.motor_command``.
        max_kl: the bound on the change of the policy in one call, KL(old || new) over states that the old one flies
            through in the fitted simulator.
        steps: of the policy.
        num_envs: drones that fly in a step.
        horizon: control steps that each flies.
        lr: of Adam, at the start; it falls to a tenth.
        seed: of the starts and the draws.

    Raises:
        TypeError: the policy has no parameters or no distribution, or the environment is none of quadrotors.
        ValueError: the drone flies as a point mass, or is seen through a camera, or its motors are not known.
    """

    def __init__(
        self,
        policy: Any,
        env: EnvBase,
        motors: MotorCommand | None = None,
        *,
        max_kl: Positive = 100.0,
        steps: Size = 60,
        num_envs: Annotated[int, Field(ge=2, le=100_000)] = 32,
        horizon: Horizon = 64,
        lr: Positive = 3e-3,
        seed: Seed = 0,
    ) -> None:
        base = base_env(env)
        if not isinstance(base, QuadrotorEnv):
            raise UserTypeError(
                f"Adapter: env must be a QuadrotorEnv, such as HoveringEnv(), not {type(env).__name__}."
            )
        learns = isinstance(policy, nn.Module) and hasattr(policy, "get_dist_params")
        if not learns:
            raise UserTypeError(
                f"Adapter: {type(policy).__name__} is no policy that can learn. Give one that make_actor has built."
            )
        if not isinstance(base.dynamics, Quadrotor):
            raise Unsupported(
                f"Adapter: a {type(base.dynamics).__name__} has no rotors, which the motor commands of a log turn. "
                "Train the policy in dynamics='quadrotor'."
            )
        if isinstance(base.disturbances.get("randomize"), AnyDrone):
            raise Unsupported(
                "Adapter: a policy for any drone (randomize='any') acts on no nominal drone, which a fit could differ "
                "from. Such a policy adapts in flight, by its memory."
            )
        if "depth" in policy.in_keys:
            raise Unsupported("Adapter: this policy reads images, which no log holds. Train with actor.vision=false.")
        self.motors = base.params.motor_command if motors is None else motors
        if self.motors is None:
            raise UserValueError(
                "Adapter: the drone has no motor_command, so the motor commands of a log cannot be turned into rotor "
                "speeds. Give motors=MotorCommand(speed_per_volt, nominal_voltage), of a recipe "
                "motor_command={speed_per_volt: ..., nominal_voltage: ...}: [rad/s] per volt, and the volts of a full "
                "battery. For commands that are shares of 4000 rad/s, without a battery, these are 4000 and 1."
            )
        if not isinstance(self.motors, MotorCommand):
            raise UserTypeError(f"Adapter: motors must be a MotorCommand, not {type(self.motors).__name__}.")
        self.policy: Any = copy.deepcopy(policy)
        self.flown = Flown(prediction.as_params(base.params))
        self.max_kl, self.steps, self.horizon, self.lr, self.seed = max_kl, steps, horizon, lr, seed
        kept = [*base._options["disturbances"], self.flown]
        inner = base.rebuilt(num_envs=num_envs, seed=seed, randomize=None, wind=None, disturbances=kept)
        self.task, self.env = inner, inner
        if isinstance(env, TransformedEnv):
            self.env = TransformedEnv(inner, cast(Any, env.transform).clone())

    def warm_up(self) -> float:
        """Compile all that a call needs, and return the seconds that it took; a call does so by itself otherwise."""
        began = time.perf_counter()
        actor = copy.deepcopy(self.policy)
        BPTTLoss(actor).loss_actor(self._horizon(actor, None)[0])[0].backward()
        self._fly(actor, self.seed)
        return time.perf_counter() - began

    def __call__(self, log: FlightLog | Sequence[FlightLog]) -> Adaptation:
        """Adapt the policy to a flight, or to several of the same drone in the same air, and fly on with the result."""
        logs, clock = prediction.as_logs(log, "Adapter"), _Clock()
        try:
            fit = fit_flight(logs, self.task.params, cast(MotorCommand, self.motors))
        except LogError as error:
            return self._found(str(error), clock)
        clock.lap("fit")
        if "rotors" in fit.not_told:
            why = "the flight does not tell what each rotor gives, or its motor commands do not tell how it moves"
            return self._found(why, clock, fit=fit)
        if not fit.gain >= LEAST_GAIN:  # NaN where nothing was held out
            better = f"only {fit.gain:.0%} better than" if fit.gain > 0.0 else "no better than"
            return self._found(f"the fit predicts what was held out {better} the simulator does", clock, fit=fit)
        self.flown.fit, old = fit, self.policy
        with torch.random.fork_rng([]):
            torch.manual_seed(self.seed)
            new = self._improve(old)
        clock.lap("steps")
        flights = self._fly(old, self.seed + 1), self._fly(new, self.seed + 1)  # from starts that no step has seen
        before, after = map(self._measure, flights)
        kl = float(TrustRegion(new, 1.0).divergence(flights[0]))
        clock.lap("test")
        why = ""
        if after["return"] <= before["return"]:
            why = "no step made the policy better in the fitted simulator"
        elif after["crash"] > min(before["crash"], MOST_CRASHES):
            why = f"in the fitted simulator the new policy crashes in {after['crash']:.0%} of the episodes"
        if why:
            return self._found(why, clock, fit=fit, before=before, after=before, flights=flights)
        self.policy = new
        reason = f"the return in the fitted simulator rose from {before['return']:.4g} to {after['return']:.4g}"
        if abs(fit.thrust - 1.0) > 0.1:
            reason += f"; all rotors give {fit.thrust:.2f} of the thrust, by a load or a wrong motor_command"
        return self._found(reason, clock, True, fit=fit, before=before, after=after, kl=kl, flights=flights)

    def _improve(self, old: Any) -> Any:
        """The best of the policies on the way up the return."""
        actor = copy.deepcopy(old)
        loss, bound, carry = BPTTLoss(actor), TrustRegion(actor, self.max_kl), self.env.reset()
        optimizer = torch.optim.Adam(actor.parameters(), self.lr, betas=(0.7, 0.95))
        schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.1, self.steps)
        reference = self._fly(old, self.seed)
        best, best_score, reference = old, _score(reference), cast(TensorDictBase, reference[:, ::_EVERY])
        for step in range(1, self.steps + 1):
            rollout, end = self._horizon(actor, carry)
            optimizer.zero_grad()
            loss.loss_actor(rollout)[0].backward()
            nn.utils.clip_grad_norm_(actor.parameters(), 0.5)
            with bound.around(reference):  # of the whole change, since the old policy flew it
                optimizer.step()
            schedule.step()
            carry = restart(self.env, end, 0.3)
            if step % _TESTED and step < self.steps:
                continue
            if (score := _score(self._fly(actor, self.seed))) > best_score:
                best, best_score = copy.deepcopy(actor), score
        return best

    def _horizon(self, actor: Any, carry: TensorDictBase | None) -> tuple[TensorDictBase, TensorDictBase]:
        kind = ExplorationType.DETERMINISTIC  # as it flies on board
        return differentiable_rollout(self.env, actor, carry, self.horizon, exploration_type=kind)

    def _found(self, why: str, clock: _Clock, changed: bool = False, **told: Any) -> Adaptation:
        policy, reason = copy.deepcopy(self.policy), why if changed else f"nothing changed: {why}"
        return Adaptation(policy, changed, reason, clock.laps, self.task.control_dt, **told)

    @torch.no_grad()
    def _fly(self, policy: Any, seed: int) -> TensorDictBase:
        """An episode in every environment, from starts and drones that a seed draws."""
        self.env.set_seed(seed)
        steps = self.task.max_episode_steps
        return differentiable_rollout(self.env, policy, None, steps, exploration_type=ExplorationType.DETERMINISTIC)[0]

    def _measure(self, flight: TensorDictBase) -> dict[str, float]:
        """The return and the task's metrics of a flight."""
        metrics = {name: float(x.float().nanmean()) for name, x in self.task.episode_metrics(flight).items()}
        return {"return": _score(flight), **metrics}


def adapt(policy: Any, env: EnvBase, log: FlightLog | Sequence[FlightLog], **options: Any) -> Adaptation:
    """Adapt a policy to a flight, once; the arguments, options and errors are those of :class:`Adapter`."""
    return Adapter(policy, env, **options)(log)


def _score(flight: TensorDictBase) -> float:
    """The mean return of first episodes."""
    return float((leaf(flight, ("next", "reward")) * first_episode(flight)).sum(1).mean())


class _Clock:
    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self.now = time.process_time()

    def lap(self, name: str) -> None:
        before, self.now = self.now, time.process_time()
        self.laps[name] = self.now - before
