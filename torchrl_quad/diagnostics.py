"""Diagnostics of rewards and policy gradients: terms without gradient, critic against simulator, variance."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.autograd.graph import GradientEdge
from torchrl.envs import EnvBase

from torchrl_quad.data import differentiable_rollout
from torchrl_quad.data.unwrap import check_env, check_tensordict, group, leaf
from torchrl_quad.errors import UserTypeError, UserValueError, WrongState
from torchrl_quad.objectives.calls import discounts, sources_of_steps, total
from torchrl_quad.objectives.pathwise import PathwiseLoss
from torchrl_quad.options import Entry, Fraction, Horizon, NonNegative, Size, checked, entries
from torchrl_quad.traps import costly_ends, flat_terms, jumping_targets, large_observations, paid_arrivals

Inputs = nn.Module | Tensor | Iterable[Tensor]


class _Row:
    """Numbers that are shown as a table of one row."""

    def __repr__(self) -> str:
        cells = [(name, f"{value:.4g}") for name, value in vars(self).items()]
        columns = [[f"{x:>{max(map(len, cell))}}" for x in cell] for cell in cells]
        return "\n".join(map("  ".join, zip(*columns, strict=True)))


@dataclass(frozen=True)
class TermAudit:
    """The contribution of one reward term to the return of a rollout and to its gradient.

    =====================  ===========================================================================================
    verdict                meaning
    =====================  ===========================================================================================
    differentiable         its gradient is not zero
    gradient in time only  its value is zero in every step, and its gradient is not: that of an event's time
    no gradient            it was paid, and its gradient is exactly zero: a first-order method does not climb it
    constant               every step pays the same: only the length of the episode changes its return
    not seen               this rollout never paid it, so its gradient is unknown
    not finite             its gradient is NaN or infinite
    =====================  ===========================================================================================
    """

    mean_return: float  #: over environments, with its sign
    return_share: float  #: of the mean absolute returns of all terms, 0 to 1
    gradient_norm: float  #: of the gradient of the mean return
    gradient_share: float  #: of these norms of all terms, 0 to 1
    verdict: str


class RewardAudit(dict[str, TermAudit]):
    """The audit of each reward term by name, which shows as a table, with the traps below it."""

    traps: Sequence[str] = ()  #: what will keep a policy from learning the task, each a sentence with its remedy
    unseen: Sequence[str] = ()  #: ends that this rollout lacks, "success" or "crash", whose traps stay hidden

    @property
    def without_gradient(self) -> list[str]:
        """The terms that were paid without a finite gradient; if there are none, the reward is "fully DIFF" (paper)."""
        return [name for name, term in self.items() if term.verdict in ("no gradient", "not finite")]

    def metrics(self) -> dict[str, float]:
        """For loggers: ``<term>_return_share`` and ``<term>_gradient_share``."""
        shares = ("return_share", "gradient_share")
        return {f"{name}_{share}": getattr(term, share) for name, term in self.items() for share in shares}

    def __repr__(self) -> str:
        width, lost = max(map(len, self), default=0), self.without_gradient
        lines = [f"{'term':{width}}     return  share   gradient  share  verdict"]
        for name, x in self.items():
            lines.append(
                f"{name:{width}} {x.mean_return:10.4g} {x.return_share:6.1%} {x.gradient_norm:10.4g} "
                f"{x.gradient_share:6.1%}  {x.verdict}"
            )
        share = sum(self[name].return_share for name in lost)
        partially = f"partially differentiable: all but {', '.join(lost)}, {share:.1%} of the return"
        unseen = "".join(f"; not seen: {name}" for name, x in self.items() if x.verdict == "not seen")
        lines += [(partially if lost else "fully differentiable") + unseen, *(f"trap: {trap}" for trap in self.traps)]
        lines += [f"not seen, start some drones close to it: {end}" for end in self.unseen]
        return "\n".join(lines)


@checked
@torch.enable_grad()
def audit_reward(
    rollout: TensorDictBase,
    inputs: Inputs,
    *,
    gamma: Fraction = 1.0,
    terms_key: Entry = ("next", "reward_terms"),
    reward_key: Entry = ("next", "reward"),
    done_key: Entry = ("next", "done"),
    tolerance: NonNegative = 1e-4,
) -> RewardAudit:
    """Find out which terms of a reward have a gradient, how much each adds to the return, and what traps there are.

    A verdict holds for this rollout alone, of any differentiable environment. Start it where all terms are paid, and
    make it longer than the delay between an action and its effect. Its ``traps`` mislead a policy: waiting pays
    more than an arrival after which the target jumps (if at least four flights show that it does so by a clock, it is
    no trap); every step after an arrival pays for it; dying is cheap where steps pay less than nothing; loitering pays
    more than a success that ends the episode; success is always true; starts crash at once; a term is flat in most
    flights, too small to matter, or without a finite gradient; an observation is far from one. To go on counts as
    1 / (1 - gamma) steps, for a gamma of 1 as the horizon.

    Args:
        rollout: (*, horizon) with its graph, as ``differentiable_rollout`` returns it.
        inputs: to differentiate with respect to: the actor or a loss, for the actor's parameters, or tensors.
            ``rollout["action"]`` means the actions before TorchRL stacked them.
        gamma: discount of the returns, from 1 at the start of each episode in the rollout.
        terms_key: the weighted terms by name, each (*, horizon, 1); or a reward that is a single term.
        reward_key: their sum, (*, horizon, 1).
        done_key: the ends of episodes, bool (*, horizon, 1).
        tolerance: how far the sum of the terms may be from the reward, in units of 1 + their absolute sum.

    Raises:
        ValueError: an entry is missing, the terms do not add up to the reward, or it does not depend on the inputs.
        RuntimeError: the rollout has lost its graph.
    """
    check_tensordict("audit_reward", rollout)
    if missing := [key for key in (terms_key, reward_key, done_key) if key not in rollout]:
        raise UserValueError(
            f"audit_reward reads {missing[0]!r}, which is not in the rollout. Name the terms, the reward and the ends "
            "of episodes as the rollout does: terms_key, reward_key, done_key."
        )
    reward, done = leaf(rollout, reward_key), leaf(rollout, done_key)
    if not (isinstance(reward, Tensor) and reward.numel() and reward.is_floating_point() and reward.ndim > 1):
        raise UserValueError(f"{reward_key!r} must be floating-point numbers (*, horizon, 1) of at least one step.")
    shape = tuple(reward.shape)
    if not (isinstance(done, Tensor) and done.dtype == torch.bool and done.shape == shape):
        raise UserValueError(f"{done_key!r} must be the ends of episodes, bool {shape}.")
    if isinstance(entry := rollout.get(terms_key), Tensor):
        terms: dict[str, Tensor] = {terms_key if isinstance(terms_key, str) else terms_key[-1]: entry}
    else:
        terms = dict(cast(Any, group(rollout, terms_key).flatten_keys("/").items()))
    for name, term in terms.items():
        if term.shape != shape:
            raise UserValueError(f"The term {name!r} has shape {tuple(term.shape)}, and the reward {shape}.")
        if broken := int((~term.isfinite()).sum()):
            raise UserValueError(
                f"The term {name!r} is not finite in {broken} of {term.numel()} steps. Look for a logarithm, a root or "
                "a quotient near zero, and keep its argument away from there: .clamp_min(1e-6)."
            )
    gap = (total(terms.values()) - reward).detach().abs()
    worst = (gap / (1.0 + total(term.detach().abs() for term in terms.values()))).max().item()
    if not worst <= tolerance:
        raise UserValueError(
            f"The terms under {terms_key!r}, {', '.join(terms)}, do not add up to the reward: they are off by up to "
            f"{gap.max().item():.3g}. Either a term is missing or not weighted, or a transform has changed the reward: "
            "name the one before it, reward_key=..."
        )
    steps = _steps(rollout.get("action", None))
    if not reward.requires_grad and (not steps or any(x.requires_grad for x in terms.values())):
        raise WrongState(
            f"{reward_key!r} carries no gradient. Collectors, ParallelEnv, replay buffers, .detach() and "
            "torch.no_grad() cut it. Use differentiable_rollout(env, actor, carry, horizon) with gradients enabled."
        )
    sources = _sources(inputs)
    if reward.requires_grad and not any(g is not None for g in _gradients(reward.sum(), sources)):
        raise UserValueError(
            f"{reward_key!r} does not depend on the inputs. Give the actor that flew this rollout, or tensors "
            "from which its actions were computed."
        )
    discount = discounts(done, torch.as_tensor(gamma, dtype=reward.dtype, device=reward.device))
    returns = {name: (discount * term).sum((-2, -1)) for name, term in terms.items()}
    sizes = {name: x.detach().abs().mean().item() for name, x in returns.items()}
    grads = {name: _gradients(x.mean(), [*sources, *steps]) for name, x in returns.items()}
    norms = {name: _vector(x, sources).norm().item() for name, x in grads.items()}
    all_sizes, all_norms = (sum(filter(math.isfinite, x.values())) or 1.0 for x in (sizes, norms))
    audit = RewardAudit()
    for name, term in terms.items():
        shares = sizes[name] / all_sizes, norms[name] / all_norms
        verdict = _verdict(term, norms[name])
        audit[name] = TermAudit(returns[name].mean().item(), shares[0], norms[name], shares[1], verdict)
    beside = () if isinstance(done_key, str) else done_key[:-1]
    said = [name for name in ("success", "crash", "terminated") if (*beside, name) in rollout]
    ends = {name: leaf(rollout, (*beside, name)) for name in said}
    audit.unseen = [name for name in said if name != "terminated" and not ends[name].any()]
    state: Any = rollout.get((*beside, "state"), None)
    traps = [*jumping_targets(reward.detach(), done, state)]
    collided: Any = rollout.get((*beside, "state", "collided"), torch.zeros_like(done))
    traps += costly_ends(reward.detach(), ends, collided, shape[-2] if gamma == 1.0 else 1.0 / (1.0 - gamma))
    traps += large_observations(rollout.get("observation", None))
    if not reward.requires_grad:
        traps.append(
            "no term has a gradient, so first-order methods cannot learn from this reward: reward a distance, or say "
            "by events when a bonus is paid, and give event_discount"
        )
    for name, x in audit.items():
        if x.verdict == "not finite":
            traps.append(f"the gradient of {name!r} is not finite: clamp the arguments of roots, quotients and acos")
        if x.verdict == "no gradient" and 2 * len(terms[name].unique()) > terms[name].numel():  # and no bonus
            traps.append(f"{name!r} changes from step to step without a gradient: no numpy, .detach() or .item() in it")
        if x.verdict == "no gradient" and x.return_share > 0.5:
            traps += paid_arrivals(name, terms[name], done, state)
        if x.verdict == "differentiable":
            traps += flat_terms(name, terms[name], returns[name], grads[name][len(sources) :])
            if max(x.return_share, x.gradient_share) < 1e-3:
                traps.append(f"{name!r} is less than a thousandth of return and gradient: it teaches nothing")
    begins = torch.cat((torch.zeros_like(done[..., :1, :]), done[..., :-1, :]), -2)  # a rollout may begin within one
    dead = ends.get("crash", done)[begins].double().mean().item()
    if dead > 0.05:  # which NaN is not, where no episode begins
        first = f"{dead:.0%} of the episodes end in their first step: look at the start, is_crash and is_success"
        traps = [first] if done[..., 0, :].all() else [first, *traps]
    audit.traps = traps
    return audit


@dataclass(frozen=True, repr=False)
class GradientComparison(_Row):
    """The gradient of the return from the simulator, compared with that from a critic."""

    cosine: float  #: between the two, -1 to 1; NaN where one is zero or does not exist
    first_order_norm: float
    value_norm: float


@torch.enable_grad()
def compare_gradients(loss: PathwiseLoss, rollout: TensorDictBase) -> GradientComparison:
    """Compare the first-order and the value gradient of an objective in the actor's parameters (paper, section IV-B).

    With ABPT they are the gradients of the N-step and of the 0-step return, with SHAC those of the rewards of the
    horizon and of the terminal value; their sum, a mean over environments, is the gradient of the objective. Without
    one of them, as with BPTT, its norm and the cosine are NaN. ABPT samples actions for this, as its loss does.
    ``clip_action_gradient`` is not applied. No ``.grad`` changes.
    """
    _check_loss(loss)
    parts, sources = loss.objective_parts(rollout), _sources(loss)
    value = [parts.pop(loss.value_part)] if loss.value_part in parts else []
    nothing = torch.tensor([math.nan], dtype=torch.float64)
    first_order, value = (
        _gradient(total(part).mean(), sources) if part else nothing for part in (parts.values(), value)
    )
    norms = first_order.norm().item(), value.norm().item()
    cosine = (first_order * value.to(first_order)).sum().item() / (math.prod(norms) or math.nan)
    return GradientComparison(cosine, *norms)


@dataclass(frozen=True, repr=False)
class GradientStatistics(_Row):
    """Mean and spread of the policy gradients of single environments."""

    norm: float  #: of their mean
    variance: float  #: over environments, summed over parameters, which is the trace of the covariance
    signal_to_noise: float  #: the norm of the mean over the standard deviation, the root of the variance


@checked
@torch.enable_grad()
def gradient_statistics(loss: PathwiseLoss, rollout: TensorDictBase, *, max_envs: Size = 16) -> GradientStatistics:
    """Mean and spread of the policy gradients of single environments, without the entropy bonus.

    Each of the first ``max_envs``, at least two, takes a backward pass through the whole rollout. No ``.grad`` changes.
    """
    _check_loss(loss)
    objectives = total(loss.objective_parts(rollout).values()).flatten()[:max_envs]
    if len(objectives) < 2:
        raise UserValueError(
            f"A variance over environments needs at least two of them, got {len(objectives)}. Fly more at once, "
            f"or raise max_envs={max_envs}."
        )
    sources = _sources(loss)
    gradients = torch.stack([_gradient(objective, sources) for objective in objectives])
    norm, variance = gradients.mean(0).norm(), gradients.var(0).sum()
    return GradientStatistics(norm.item(), variance.item(), (norm / variance.sqrt()).item())


@checked
def gradient_by_horizon(
    env: EnvBase,
    actor: TensorDictModuleBase,
    loss: PathwiseLoss,
    horizons: Annotated[Sequence[Horizon], entries(1, 1000)],
    *,
    start: TensorDictBase | None = None,
    max_envs: Size = 16,
) -> dict[int, GradientStatistics]:
    """Measure how norm and variance of the policy gradient grow with the horizon, flown from the same starts.

    Args:
        env: any differentiable TorchRL environment.
        actor: the policy of the loss.
        loss: any pathwise loss.
        horizons: numbers of control steps.
        start: a reset tensordict of at least two environments; ``env.reset()`` by default.
        max_envs: as for :func:`gradient_statistics`, whose errors it raises.
    """
    check_env(env)
    start = env.reset() if start is None else start
    return {
        horizon: gradient_statistics(loss, differentiable_rollout(env, actor, start, horizon)[0], max_envs=max_envs)
        for horizon in dict.fromkeys(horizons)
    }


def _check_loss(loss: PathwiseLoss) -> None:
    if not isinstance(loss, PathwiseLoss):
        raise UserTypeError(
            f"loss must be a pathwise loss of the actor, such as BPTTLoss(actor); got {type(loss).__name__}."
        )


def _sources(inputs: Inputs) -> list[Tensor | GradientEdge]:
    """The tensors to differentiate with respect to; of a loss or an actor, the actor's parameters."""
    if isinstance(inputs, nn.Module):
        inputs = [p for p in getattr(inputs, "actor_network_params", inputs).parameters() if p.requires_grad]
    elif isinstance(inputs, Tensor):
        if steps := _steps(inputs):
            return steps
        inputs = [inputs]
    sources: list[Any] = [*inputs] if isinstance(inputs, Sequence | Iterator) else []
    if not sources or not all(isinstance(x, Tensor) and x.requires_grad for x in sources):
        raise UserValueError(
            "There is nothing to differentiate with respect to: give the actor or its loss with parameters that "
            "require grad, or tensors that do."
        )
    return sources


def _gradients(value: Tensor, sources: list[Tensor | GradientEdge]) -> Sequence[Tensor | None]:
    if not value.requires_grad:
        return [None] * len(sources)
    return torch.autograd.grad(value, cast(Any, sources), retain_graph=True, allow_unused=True)


def _gradient(value: Tensor, sources: list[Tensor | GradientEdge]) -> Tensor:
    """The gradient of a scalar as one vector."""
    return _vector(_gradients(value, sources), sources)


def _vector(grads: Sequence[Tensor | None], sources: list[Tensor | GradientEdge]) -> Tensor:
    """The first gradients, those in sources, as one vector in double precision, for squares of small ones."""
    pairs = zip(grads, sources, strict=False)
    grads = [torch.zeros_like(x) if g is None and isinstance(x, Tensor) else g for g, x in pairs]
    known = [g.flatten().double() for g in grads if g is not None]
    return torch.cat(known) if known else torch.zeros(1, dtype=torch.float64)


def _steps(action: Any) -> list[Tensor | GradientEdge]:
    """The actions of a rollout as sources, of each step or all at once; none where they have no graph."""
    steps = sources_of_steps(action) if isinstance(action, Tensor) else None
    return [] if steps is None else [steps] if isinstance(steps, Tensor) else [*steps]


def _verdict(term: Tensor, gradient_norm: float) -> str:
    if not math.isfinite(gradient_norm):
        return "not finite"
    if not term.any():
        return "gradient in time only" if gradient_norm else "not seen"
    if gradient_norm:
        return "differentiable"
    return "constant" if term.min() == term.max() else "no gradient"
