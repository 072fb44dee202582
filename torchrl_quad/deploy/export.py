"""Export a policy: the network as ONNX and C, the contract, vectors to check it with, and a page to read."""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import os
from collections.abc import Mapping
from importlib import metadata, resources
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_quad.data import ObservationNormalizer, base_env, differentiable_rollout
from torchrl_quad.data.normalizer import NormalizedPolicy
from torchrl_quad.deploy import contract as contracts
from torchrl_quad.deploy.bundle import QUANTITIES, load_bundle
from torchrl_quad.deploy.describe import describe, envelope, results, seen_ranges
from torchrl_quad.deploy.folder import replacing_folder, require_replaceable, restore
from torchrl_quad.deploy.network import ACTIVATIONS, Layer, write_c, write_onnx
from torchrl_quad.deploy.tasks import PROGRESS, Rule
from torchrl_quad.envs import QuadrotorEnv

VECTORS, SELF_TEST_VECTORS = 1024, 16
STARTS = 2_000_000  # seed of the starts, that of recipes/evaluate.py
REPLAYED = 2  # environments whose first episode the bundle flies again
TOLERANCE = 1e-5  # of an action
OBSERVATION_TOLERANCE = 1e-3  # of an entry of the observation: float32 adds up a phase less exactly than a bundle


def export_policy(
    actor: TensorDictModuleBase,
    env: EnvBase,
    folder: str | Path,
    normalizer: ObservationNormalizer | None = None,
    *,
    origin: Mapping[str, str] | None = None,
) -> Path:
    """Write a policy of :func:`~torchrl_quad.make_actor` as a folder that flies without torch, or replace that folder.

    The deterministic policy flies one episode from a fresh start in each environment, and further ones until there are
    1024 observations. The contract takes its ranges and results from this flight. Then the bundle flies two episodes
    again from the named quantities of the state, and must observe what the environment did. The same policy and
    environment give the same bytes. The environment draws afterwards as if nothing had been exported.

    ==================  ================================================================================================
    file                holds
    ==================  ================================================================================================
    ``policy.onnx``     ``observation`` (batch, k) to ``action`` (batch, 4), float32, with normaliser and scaling in it
    ``policy.h, .c``    the same in C99, with a self-test
    ``contract.json``   what each number means; :func:`~torchrl_quad.deploy.contract.schema` is its JSON schema
    ``starts.npz``      the states (num_envs, ...) in which these episodes began, and where in the task
    ``vectors.npz``     1024 visited ``observation`` with the ``action`` that the actor gave
    ``README.md``       how to fly it
    ==================  ================================================================================================

    Args:
        actor: the policy; it must read the observation alone.
        env: one of the package's tasks, or a TransformedEnv with an ObservationNormalizer alone.
        folder: where to write. Its parent is made if it is missing.
        normalizer: what the actor reads the observation through; by default that of the TransformedEnv, if it is one.
        origin: where the policy comes from, for the contract, by name: ``revision``, ``checkpoint_sha256``.

    Returns:
        the folder.

    Raises:
        ValueError: the policy or the task cannot be exported, or the bundle does not fly as they do.
        FileExistsError: the folder exists and holds something else than a bundle, or files beside it.
        ImportError: onnx or onnxruntime is missing.
    """
    try:
        import onnx  # noqa: F401, asked for before anything flies
        import onnxruntime  # noqa: F401
    except ImportError as error:
        raise ImportError("export_policy needs onnx and onnxruntime: pip install onnx onnxruntime") from error
    env, normalizer = _unwrapped(env, normalizer)
    place = Path(folder).resolve()  # a link stays, what it points to is replaced
    require_replaceable(place)
    restore(place)
    contract = {"version": contracts.VERSION, **describe(env)}
    layers = fold(actor, normalizer)
    width, size = layers[0].weight.shape[1], contract["inputs"][-1]["stop"]
    shape = env.observation_spec["observation"].shape
    if not width == size == shape[-1]:
        raise ValueError(
            f"export_policy: the policy reads {width} numbers, the environment observes {shape[-1]}, and "
            f"{type(env).__name__} is known to observe {size}."
        )
    policy = actor if normalizer is None else NormalizedPolicy(actor, normalizer)
    flight = _fly(env, policy)
    visited = flight["observation"].flatten(0, 1)
    observation = visited[torch.linspace(0, len(visited) - 1, VECTORS).long()].float()
    vectors = {"observation": observation.cpu().numpy(), "action": _act(policy, env, observation).cpu().numpy()}
    contract["inputs"] = seen_ranges(contract["inputs"], visited.float().cpu().numpy())
    contract["safety"]["seen"] = envelope(flight)
    contract["results"] = results(env, flight)
    weights = b"".join(x.tobytes() for layer in layers for x in layer[:2])
    package = {"package": _version(), "weights_sha256": contracts.sha256(weights)}
    contract["origin"] = package | dict(origin or {})
    files = {"policy.onnx": write_onnx(layers), "vectors.npz": _npz(vectors), "README.md": _readme(contract)}
    files["starts.npz"] = _npz(_starts(flight, contract["task"]["rule"]))
    files |= write_c(layers, contract, *(x[:: VECTORS // SELF_TEST_VECTORS] for x in vectors.values()))
    contract["sha256"] = {name: contracts.sha256(files[name]) for name in contracts.FILES}
    contract["digest"] = contracts.digest(contract)
    files["contract.json"] = (json.dumps(contract, indent=2, allow_nan=False) + "\n").encode()
    with replacing_folder(place) as temporary:
        for name, content in files.items():
            with open(temporary / name, "wb") as file:
                file.write(content)
                os.fsync(file.fileno())
        _require_the_same_flight(temporary, env, flight)
    return Path(folder)


def fold(actor: TensorDictModuleBase, normalizer: ObservationNormalizer | None = None) -> list[Layer]:
    """The layers of a policy's mean action, in float32, with the normaliser and the input's scale in the first.

    Raises:
        ValueError: the policy is not one that :func:`~torchrl_quad.make_actor` builds, or reads more than observations.
    """
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        plain = actor.plain() if hasattr(actor, "plain") and not isinstance(actor, NormalizedPolicy) else None
    if plain is None:
        raise ValueError(
            "export_policy exports what make_actor builds, with its parts as they are and without hooks: a "
            f"tanh-Gaussian multi-layer perceptron. This {type(actor).__name__} is something else; build the policy "
            "with make_actor(env, ...), and load your weights into it."
        )
    if plain.in_keys != ["observation"]:
        raise ValueError(
            f'export_policy: the policy reads {plain.in_keys}. A drone can give it the "observation" alone: train it '
            "with in_keys=['observation']."
        )
    if plain.low is not None:
        raise ValueError(f"export_policy: actions must lie from -1 to 1, got {plain.low} to {plain.high}.")
    names = [type(activation).__name__ for activation in plain.activations]
    for name, activation in zip(names, plain.activations, strict=True):
        if name not in ACTIVATIONS or repr(activation) != repr(type(activation)()):
            raise ValueError(
                f"export_policy cannot write {activation} as ONNX and C. Choose from: {', '.join(ACTIVATIONS)}, with "
                "their default arguments."
            )
    values = [x.detach().double().cpu().numpy() for x in plain.weights]
    weights, biases = values[::2], values[1::2]
    weights[0] = weights[0] * plain.scales[0]
    if normalizer is not None:
        loc, scale = (x.double().cpu().numpy() for x in (normalizer.loc, normalizer.scale))
        weights[0] = weights[0] / scale
        biases[0] = biases[0] - weights[0] @ loc
    weights[-1], biases[-1] = weights[-1][: plain.size], biases[-1][: plain.size]  # the rest is the noise's
    if not all(np.isfinite(x).all() for x in (*weights, *biases)):
        raise ValueError("export_policy: the weights of the policy, or its normaliser, are not finite.")
    layers = zip(weights, biases, [*names, "Tanh"], strict=True)
    return [Layer(w.astype(np.float32), b.astype(np.float32), name) for w, b, name in layers]


def _unwrapped(
    env: EnvBase, normalizer: ObservationNormalizer | None
) -> tuple[QuadrotorEnv, ObservationNormalizer | None]:
    """The environment under its normaliser, and the normaliser."""
    if isinstance(env, TransformedEnv):
        if not isinstance(env.transform, ObservationNormalizer) or isinstance(env.base_env, TransformedEnv):
            raise ValueError(
                "export_policy knows one transform, a single ObservationNormalizer: what others do to the observation "
                f"would be missing on the drone. Got {env.transform}."
            )
        normalizer = env.transform if normalizer is None else normalizer
    if not isinstance(base_env(env), QuadrotorEnv):
        raise ValueError(f"export_policy needs an environment of this package, got {type(env).__name__}.")
    if normalizer is not None and list(normalizer.in_keys) != ["observation"]:
        raise ValueError(f'export_policy: the normalizer must be that of "observation", got {normalizer.in_keys}.')
    return base_env(env), normalizer


@torch.no_grad()
def _fly(env: QuadrotorEnv, policy: TensorDictModuleBase) -> TensorDictBase:
    """A deterministic flight (num_envs, time) from fresh starts; the environment then goes on as if there was none."""
    steps = max(env.max_episode_steps, -(-VECTORS // env.num_envs))
    random, source = env.random_state(), env.initial_state_source
    try:
        env.set_initial_state_source(None)
        env.randomness.seed(STARTS)
        flight, _ = differentiable_rollout(env, policy, None, steps, exploration_type=ExplorationType.DETERMINISTIC)
    finally:
        env.set_initial_state_source(source)
        env.set_random_state(random)
    return flight


@torch.no_grad()
def _act(policy: TensorDictModuleBase, env: QuadrotorEnv, observation: Tensor) -> Tensor:
    """What the policy does (n, 4), as it is and not folded."""
    seen = TensorDict({"observation": observation.to(env.dtype)}, [len(observation)], env.device)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        return policy(seen)["action"].float()


def _starts(flight: TensorDictBase, rule: str) -> dict[str, np.ndarray]:
    """The first states of a flight (num_envs, ...), without what the environment drew beside them."""
    names = [*QUANTITIES, PROGRESS[rule]]
    return {name: flight["state", name][:, 0].cpu().numpy() for name in names}


def _require_the_same_flight(folder: Path, env: QuadrotorEnv, flight: TensorDictBase) -> None:
    """Fly the bundle through the first episodes of a flight, from what a drone knows, and compare what it observes."""
    bundle = load_bundle(folder)
    bundle.check(TOLERANCE)
    entry = PROGRESS[bundle.contract["task"]["rule"]]
    for i in range(min(REPLAYED, env.num_envs)):
        done = flight[i]["next", "done"].flatten()
        length = int(done.nonzero()[0]) + 1 if done.any() else len(done)
        episode = flight[i, :length]
        seen = {key: episode["state", key] for key in env.control_step.safe_state}
        for disturbance in env.disturbances.values():
            seen = disturbance.observe(seen)
        start = seen[entry][0].cpu().numpy()
        bundle.reset(**{entry: start if start.size > 1 else start.item()})
        states = {k: seen[k].cpu().numpy() for k in ("position", "quaternion", "velocity", "angular_velocity")}
        true = episode["state", "position"].cpu().numpy()
        if not np.array_equal(true, states["position"]):
            _go_by(bundle.rule, true)  # the environment counts gates from there, a bundle from what it measures
        for t in range(length):
            bundle({name: x[t] for name, x in states.items()} | {"age": 0.0})
            gap = np.abs(bundle.observation - episode["observation"][t].float().cpu().numpy()).max()
            if not gap <= OBSERVATION_TOLERANCE:
                raise ValueError(
                    f"export_policy: {type(env).__name__} observes something else than the contract says, by {gap:.3g} "
                    f"in step {t}. A contract describes the package's own observations and rules; this environment has "
                    "others."
                )


def _go_by(rule: Rule, positions: np.ndarray) -> None:
    """Let a rule advance along positions (t, 3), whatever the bundle tells it."""
    advance, steps = type(rule).advance, itertools.pairwise(positions)
    vars(rule)["advance"] = lambda before, position: advance(rule, *next(steps))


def _npz(arrays: Mapping[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # numpy writes no time into it
    return buffer.getvalue()


def _version() -> str:
    with contextlib.suppress(metadata.PackageNotFoundError):
        return f"torchrl_quad {metadata.version('torchrl_quad')}"
    return "torchrl_quad"


def _readme(contract: Mapping[str, Any]) -> bytes:
    """The page for people who have not read ours."""
    task, output = contract["task"], contract["output"]
    columns = ("name", "scale", "unit", "frame", "meaning")
    inputs = [
        " | ".join((f"| {x['start']} to {x['stop'] - 1}", *(f"{x[column]}" for column in columns), "")).rstrip()
        for x in contract["inputs"]
    ]
    rules = {
        "target": "The target is `task.target`; give another one if you like, the policy sees the difference alone.",
        "curve": "The point moves along the curve of `task`: offset + sum over k = 1, 2, ... of cosine[k-1] "
        "cos(k phase) + sine[k-1] sin(k phase). The phase starts anywhere, and grows by 2 pi control_dt / period in "
        "each control step after the first. Point i = 1, 2, ... has the phase + 2 pi i lookahead_interval / period.",
        "gates": "A gate is passed when the straight line between the measured positions of two control steps comes "
        "nearer to its centre than `task.gate_radius`; training counted with true positions. The observation of that "
        "step is already about the gate after it. After the last gate comes the first.",
    }
    queue = contract["action_queue"]
    values = {
        "task": task["name"],
        "size": contract["inputs"][-1]["stop"],
        "inputs": "\n".join(inputs),
        "rule": rules[task["rule"]],
        "success": task["success"],
        "progress": PROGRESS[task["rule"]],
        "sign": contract["quaternion"]["sign"],
        "queue": (
            "They start as hover actions. After each step drop the oldest four numbers and append the action."
            if queue["observed"]
            else "This policy does not observe the commands on their way."
        ),
        "max_thrust": f"{output['thrust']['range'][1]:.6g}",
        "weight": f"{output['thrust']['weight']:.6g}",
        "rates": ", ".join(f"{high:g}" for _, high in output["body_rate"]["range"]),
        "hover": ", ".join(f"{x:.6g}" for x in output["hover_action"]),
        "control_dt": f"{contract['control_dt']:g}",
        "delay": contract["action_delay"],
        "delay_seconds": f"{contract['action_delay'] * contract['control_dt']:g}",
        "age": f"{contract['limits']['max_state_age']:g}",
        "fields": contracts.schema_table(),
        "package": contract["origin"]["package"],
    }
    template = (resources.files(__package__) / "templates" / "README.md").read_text()
    return Template(template).substitute(values).encode()
