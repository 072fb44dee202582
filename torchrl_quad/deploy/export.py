"""Export a policy: the network as ONNX and C, the contract, vectors to check it with, and a page to read."""

from __future__ import annotations

import contextlib
import io
import json
import os
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import set_recurrent_mode

from torchrl_quad.data import ObservationNormalizer, base_env, differentiable_rollout
from torchrl_quad.data.normalizer import NormalizedPolicy
from torchrl_quad.data.unwrap import memory_keys
from torchrl_quad.deploy import contract as contracts
from torchrl_quad.deploy.bundle import Bundle, load_bundle
from torchrl_quad.deploy.contract import MEASURED
from torchrl_quad.deploy.describe import describe, envelope, results, seen_ranges
from torchrl_quad.deploy.folding import fold
from torchrl_quad.deploy.judging import judge
from torchrl_quad.deploy.network import write_c, write_onnx
from torchrl_quad.deploy.page import write_page
from torchrl_quad.deploy.reading import MOST_BYTES
from torchrl_quad.deploy.tracing import Rules, trace
from torchrl_quad.envs import QuadrotorEnv
from torchrl_quad.errors import MissingPackage, UserValueError
from torchrl_quad.files import check_place, replacing_folder

VECTORS, SELF_TEST_VECTORS = 1024, 16
IMAGES, SELF_TEST_IMAGES = 256, 4  # the same with images, which are large
STARTS = 2_000_000  # seed of the starts, that of recipes/evaluate.py
REPLAYED = 2  # environments whose first episode the bundle flies again
MOST_NUMBERS = 10_000_000  # that a part of a flight observes; a forest is flown in several parts
NEVER_JUDGED = (("depth",), ("state", "images"), ("state", "scene"))  # entries that take most of a flight's memory
TOLERANCE = 1e-5  # of an action
MEMORY_TOLERANCE = 1e-4  # of an action within an episode: rounding errors go on in the memory
OBSERVATION_TOLERANCE = 1e-4  # of an entry of the observation
METRIC_TOLERANCE = 1e-3  # of a metric of an episode, relative above 1


def export_policy(
    actor: TensorDictModuleBase,
    env: EnvBase,
    folder: str | Path,
    normalizer: ObservationNormalizer | None = None,
    *,
    origin: Mapping[str, str] | None = None,
) -> Path:
    """Write a policy as a folder that flies without torch, or replace that folder.

    The policy is one of :func:`~torchrl_quad.make_actor` or :func:`~torchrl_quad.make_visual_actor`. Without noise it
    flies one episode from a fresh start in each environment, and further ones until there are 1024 observations. The
    contract takes its ranges and results from this flight. Then the bundle flies two episodes again, from the named
    quantities of the state and the images. It must observe what the environment did, and act and remember as the policy
    does. The same policy and environment give the same bytes. The environment draws afterwards as if nothing had been
    exported.

    ==================  ================================================================================================
    file                holds
    ==================  ================================================================================================
    ``policy.onnx``     ``observation`` (batch, k) to ``action`` (batch, 4), float32, with normaliser and scaling in it;
                        of a policy that sees also ``depth`` (batch, 1, height, width), of one that remembers
                        ``memory`` (batch, m) to ``next_memory``
    ``policy.h, .c``    the same in C99, with a self-test
    ``contract.json``   what each number means; :func:`~torchrl_quad.deploy.contract.schema` is its JSON schema
    ``starts.npz``      the states (num_envs, ...) in which these episodes began, and where in the task
    ``vectors.npz``     1024 visited ``observation`` (256 of a policy that sees) and the ``action`` that the actor gave;
                        ``depth``, ``memory`` and ``next_memory`` of a policy that has them
    ``README.md``       how to fly it
    ==================  ================================================================================================

    Args:
        actor: the policy; it must read the observation alone, or beside it the image.
        env: one of the package's tasks, or a TransformedEnv with an ObservationNormalizer alone.
        folder: where to write. Its parent is made if it is missing.
        normalizer: what the actor reads the observation through; by default that of the TransformedEnv, if it is one.
        origin: where the policy comes from, for the contract, by name: ``revision``, ``checkpoint_sha256``.

    Returns:
        the folder.

    Raises:
        ValueError: the policy or the task cannot be exported, or the bundle does not fly as they do.
        FileExistsError: there is something of that name that is no folder, or a folder that holds something else than a
            bundle, or files beside it.
        ImportError: onnx or onnxruntime is missing.
    """
    try:  # before anything flies
        import onnx
        import onnxruntime  # noqa: F401
        import onnxscript  # noqa: F401, which torch.onnx needs
    except ImportError as error:
        needed = "onnx onnxruntime onnxscript"
        raise MissingPackage(f"export_policy needs {needed}: pip install {needed}") from error
    env, normalizer = _unwrapped(env, normalizer)
    place = Path(folder) if Path(folder).name not in ("", "..") else Path(folder).resolve()
    check_place(place, "folder")
    require_bundle(place)
    camera = env.camera
    network = fold(actor, normalizer, camera and (camera.height, camera.width))
    reads = network.reads
    (width,), shape = reads["observation"], env.observation_spec["observation"].shape
    if width != shape[-1]:
        raise UserValueError(f"export_policy: the policy reads {width} numbers, the environment observes {shape[-1]}.")
    policy = actor if normalizer is None else NormalizedPolicy(actor, normalizer)
    count, self_test = (IMAGES, SELF_TEST_IMAGES) if "depth" in reads else (VECTORS, SELF_TEST_VECTORS)
    flight = _fly(env, policy, count)
    vectors = _vectors(policy, env, flight.chosen)
    rules, written = trace(env, _states(env, flight.replayed)), write_onnx(network)
    models = {"policy": onnx.load_from_string(written), **rules.graphs}
    about = describe(env, rules, models, memory=reads.get("memory", (0,))[0], visual="depth" in reads)
    contract = {"version": contracts.VERSION, **about}
    contract["observation"] = seen_ranges(flight.whole["observation"].flatten(0, 1).float().cpu().numpy())
    contract["envelope"] = envelope(flight.whole)
    contract["results"] = results(env, flight.whole)
    weights = b"".join(x.tobytes() for x in network.weights())
    package = {"package": _version(), "weights_sha256": contracts.sha256(weights)}
    contract["origin"] = package | dict(origin or {})
    files = {f"{name}.onnx": x.SerializeToString(deterministic=True) for name, x in rules.graphs.items()}
    files |= {
        "policy.onnx": written,
        "vectors.npz": _npz(vectors),
        "README.md": write_page(contract, type(env).__doc__),
    }
    files["starts.npz"] = _npz(_starts(flight.whole, rules))
    files |= write_c(network, contract, {name: x[:: count // self_test] for name, x in vectors.items()})
    contract["sha256"] = {name: contracts.sha256(content) for name, content in files.items()}
    contract["digest"] = contracts.digest(contract)
    if problem := contracts.problem(contract):
        raise UserValueError(
            f"export_policy: {problem}. A bundle flies within the ranges of docs/deploy_contract.md: change the "
            "environment, or the drone."
        )
    files["contract.json"] = (json.dumps(contract, indent=2, allow_nan=False) + "\n").encode()
    with replacing_folder(place, require_bundle) as temporary:
        for name, content in files.items():
            with open(temporary / name, "wb") as file:
                file.write(content)
                os.fsync(file.fileno())
        _check_the_flight(temporary, env, policy, flight.replayed, rules)
    return Path(folder)


def _unwrapped(
    env: EnvBase, normalizer: ObservationNormalizer | None
) -> tuple[QuadrotorEnv, ObservationNormalizer | None]:
    """The environment under its normaliser, and the normaliser."""
    if isinstance(env, TransformedEnv):
        if not isinstance(env.transform, ObservationNormalizer) or isinstance(env.base_env, TransformedEnv):
            raise UserValueError(
                "export_policy knows one transform, a single ObservationNormalizer: what others do to the observation "
                f"would be missing on the drone. Got {env.transform}."
            )
        normalizer = env.transform if normalizer is None else normalizer
    if not isinstance(base_env(env), QuadrotorEnv):
        raise UserValueError(f"export_policy needs an environment of this package, got {type(env).__name__}.")
    if normalizer is not None and list(normalizer.in_keys) != ["observation"]:
        raise UserValueError(f'export_policy: the normalizer must be that of "observation", got {normalizer.in_keys}.')
    return base_env(env), normalizer


class _Flight(NamedTuple):
    """A deterministic flight from fresh starts."""

    whole: TensorDictBase  #: (num_envs, time), without what nobody judges
    replayed: TensorDictBase  #: (REPLAYED, time), everything
    chosen: TensorDictBase  #: (n), what the policy reads in single steps


@torch.no_grad()
def _fly(env: QuadrotorEnv, policy: TensorDictModuleBase, count: int) -> _Flight:
    """Fly, and choose single steps; the environment then goes on as if there was no flight."""
    steps = max(env.max_episode_steps, -(-VECTORS // env.num_envs))
    chosen = torch.linspace(0, env.num_envs * steps - 1, count).long()
    drone, step = chosen // steps, chosen % steps
    keys = [key for key in policy.in_keys if key != "is_init"]
    mode = {"exploration_type": ExplorationType.DETERMINISTIC}
    random, source = env.random_state(), env.initial_state_source
    parts: list[tuple[TensorDictBase, ...]] = []
    try:
        env.set_initial_state_source(None)
        env.randomness.seed(STARTS)
        carry, begin = env.reset(), 0
        longest = max(1, MOST_NUMBERS // sum(x.numel() for x in carry.values(True, True)))
        while begin < steps:
            part, carry = differentiable_rollout(env, policy, carry, min(longest, steps - begin), **mode)
            end = begin + part.shape[1]
            here = ((begin <= step) & (step < end)).nonzero().squeeze(-1)
            heavy = [key for name in NEVER_JUDGED for key in (name, ("next", *name))]
            read = part.select(*keys)[drone[here], step[here] - begin]
            parts.append((part.exclude(*heavy).clone(), part[:REPLAYED].clone(), read.set("place", here)))
            begin = end
    finally:
        env.set_initial_state_source(source)
        env.set_random_state(random)
    whole, replayed, read = zip(*parts, strict=True)
    read = torch.cat(read)
    return _Flight(torch.cat(whole, 1), torch.cat(replayed, 1), read[read["place"].argsort()])


@torch.no_grad()
def _act(policy: TensorDictModuleBase, env: QuadrotorEnv, seen: Mapping[Any, Tensor]) -> TensorDictBase:
    """What the policy does, as it is and not folded, with what it reads: in single steps (n), or in an episode
    (1, time), in which its memory comes about anew."""
    shape = seen["observation"].shape[:-1]
    given = TensorDict({key: x.to(env.device, env.dtype) for key, x in seen.items()}, shape, env.device)
    if "is_init" in policy.in_keys:
        given["is_init"] = torch.zeros((*shape, 1), dtype=torch.bool, device=env.device)
        given["is_init"][:, 0] = len(shape) > 1
    with set_exploration_type(ExplorationType.DETERMINISTIC), set_recurrent_mode(len(shape) > 1):
        return policy(given)


def _vectors(policy: TensorDictModuleBase, env: QuadrotorEnv, chosen: TensorDictBase) -> dict[str, np.ndarray]:
    """What the policy reads and writes in single steps, float32, by the names that its ONNX has for it."""
    seen = {key: chosen[key].float() for key in policy.in_keys if key != "is_init"}
    acted, memory = _act(policy, env, seen), memory_keys(policy)
    vectors = {name: seen[name] for name in ("observation", "depth") if name in seen}
    vectors |= {"memory": seen[memory[0]].flatten(1)} if memory else {}
    vectors |= {"action": acted["action"]}
    vectors |= {"next_memory": acted["next", memory[0]].flatten(1)} if memory else {}
    return {name: x.float().cpu().numpy() for name, x in vectors.items()}


def _starts(flight: TensorDictBase, rules: Rules) -> dict[str, np.ndarray]:
    """The first states of a flight (num_envs, ...), without what the environment drew beside them."""
    keys = dict(zip(MEASURED, MEASURED, strict=True)) | rules.entries
    return {name: flight["state", key][:, 0].cpu().numpy() for name, key in keys.items()}


def _states(env: QuadrotorEnv, flight: TensorDictBase) -> dict[Any, Tensor]:
    """A few states of a flight, as many as the environment has not."""
    n = 3 if env.num_envs != 3 else 4
    return {key: flight["state", key].flatten(0, 1)[:n] for key in env.control_step.safe_state}


def _check_the_flight(
    folder: Path, env: QuadrotorEnv, policy: TensorDictModuleBase, flights: TensorDictBase, rules: Rules
) -> None:
    """Fly the bundle through the first episodes of flights, from what a drone knows.

    Compare what it observes with what the environment did, what it then does and remembers with what the policy does,
    in the same order, with the same observations, and what it makes of the episode with the environment's own metrics.
    """
    bundle = load_bundle(folder)
    bundle.check(TOLERANCE)
    task = type(env).__name__
    for flight in flights:
        done = flight["next", "done"].flatten()
        length = int(done.nonzero()[0]) + 1 if done.any() else len(done)
        episode = flight[:length]
        true = {key: episode["state", key] for key in env.control_step.safe_state}
        seen = true
        for disturbance in env.disturbances.values():
            seen = disturbance.observe(seen)
        states = {name: seen[name].cpu().numpy() for name in MEASURED}
        states |= {"depth": episode["depth"].cpu().numpy()} if bundle.contract["camera"] else {}
        entries = {name: seen[key].cpu().numpy() for name, key in rules.entries.items()}
        sees_truth = all(torch.equal(true[name], seen[name]) for name in MEASURED)
        bundle.reset(**{name: x[0] for name, x in entries.items()})
        observed, acted = [], []
        for t in range(length):
            if not sees_truth:  # from which the environment advances the task; a drone only knows what it measures
                bundle._progress, bundle._step, bundle._before = {k: x[t][None] for k, x in entries.items()}, t, None
            bundle({name: x[t] for name, x in states.items()} | {"age": 0.0, "depth_age": 0.0})
            observed.append(bundle.observation)
            acted.append(bundle.action)
            gap = np.abs(bundle.observation - episode["observation"][t].float().cpu().numpy()).max()
            if not gap <= OBSERVATION_TOLERANCE:
                raise UserValueError(
                    f"export_policy: the bundle observes something else than {task} does, by {gap:.3g} in step {t}. "
                    "observe and advance must depend on the state and on constants, and change nothing."
                )
        read = {key: episode[key] for key in policy.in_keys if key != "is_init"}
        read["observation"] = torch.from_numpy(np.stack(observed))
        again = _act(policy, env, {key: x[None] for key, x in read.items()})["action"][0].float().cpu().numpy()
        gap = np.abs(np.stack(acted) - again).max()
        if not gap <= MEMORY_TOLERANCE:
            raise UserValueError(
                f"export_policy: the bundle acts differently from the policy, by {gap:.3g} within an episode."
            )
    if rules.unjudged is None:
        _check_the_judgement(bundle, env, flights, rules)


def _check_the_judgement(bundle: Bundle, env: QuadrotorEnv, flights: TensorDictBase, rules: Rules) -> None:
    """Compare what the bundle's graphs make of flights with the metrics of the environment."""
    flown = {"action": flights["action"].cpu().numpy()}
    for name in MEASURED:
        states = torch.cat((flights["state", name][:, :1], flights["next", "state", name]), 1)
        flown[name] = states.cpu().numpy()
    flown |= {name: flights["state", key][:, 0].cpu().numpy() for name, key in rules.entries.items()}
    found, expected = judge(bundle, flown), env.episode_metrics(flights)
    for name, values in found.items():
        own = expected[name].cpu().numpy()
        if not np.allclose(values, own, rtol=METRIC_TOLERANCE, atol=METRIC_TOLERANCE, equal_nan=True):
            raise UserValueError(
                f"export_policy: the bundle judges a flight differently from {type(env).__name__}: {name} is "
                f"{values.tolist()} instead of {own.tolist()}. is_crash, is_success, advance, metrics and "
                "episode_metrics must depend on the state and on constants, and change nothing."
            )


def _npz(arrays: Mapping[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # numpy writes no time into it
    return buffer.getvalue()


def _version() -> str:
    with contextlib.suppress(metadata.PackageNotFoundError):
        return f"torchrl_quad {metadata.version('torchrl_quad')}"
    return "torchrl_quad"


def require_bundle(folder: Path) -> None:
    """Refuse a folder that holds something else than a bundle, or files beside one.

    Raises:
        FileExistsError: it does.
    """
    found = list(folder.iterdir()) if folder.is_dir() else []
    plain = {path.name for path in found if path.is_file() and not path.is_symlink()}
    names = {path.name for path in found}
    if names and not (folder / "contract.json").is_file():
        raise FileExistsError(f"{folder} exists and is no bundle. Choose another folder, or empty this one.")
    if others := sorted(names - (plain & {*MOST_BYTES})):
        raise FileExistsError(
            f"{folder} also holds {', '.join(others)}: an export replaces the folder, and would delete that. Move it "
            "away, or choose another folder."
        )
