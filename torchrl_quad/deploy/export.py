"""Export a policy: the network as ONNX and C, the task's rules as ONNX, the contract, vectors, and a page to read."""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import os
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import set_recurrent_mode

from torchrl_quad.data import ObservationNormalizer, base_env, differentiable_rollout
from torchrl_quad.data.transforms import normalized
from torchrl_quad.data.unwrap import leaf, memory_keys, observed
from torchrl_quad.deploy import autopilots
from torchrl_quad.deploy import contract as contracts
from torchrl_quad.deploy.bundle import load_bundle
from torchrl_quad.deploy.contract import MEASURED
from torchrl_quad.deploy.describe import describe, envelope, results, seen_ranges, write_page
from torchrl_quad.deploy.folding import fold
from torchrl_quad.deploy.judging import judge
from torchrl_quad.deploy.network import write_c, write_onnx
from torchrl_quad.deploy.tracing import Rules, trace
from torchrl_quad.envs import QuadrotorEnv
from torchrl_quad.errors import UserValueError, needing
from torchrl_quad.files import check_place, replacing_folder

VECTORS, SELF_TEST_VECTORS = 1024, 16
IMAGES, SELF_TEST_IMAGES = 256, 4  # the same with images, which are large
STARTS = 2_000_000  # seed of the starts, that of recipes/evaluate.py
REPLAYED = 2  # environments whose first episode the bundle flies again
MOST_NUMBERS = 10_000_000  # that a part of a flight observes; a forest is flown in several parts
NEVER_JUDGED = (("depth",), ("state", "images"), ("state", "scene"))  # entries that take most of a flight's memory
TOLERANCE = 1e-5  # of an action, and of the memory after it
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
    """Write a policy and the rules of its task as a folder that flies without torch, or replace that folder.

    The policy flies one episode without noise from a fresh start in each environment, and further ones until there are
    1024 observations; the contract takes its ranges and results from there. Then the bundle repeats two episodes from
    what a drone measures. It must observe and judge as the environment does, and act and remember as the policy does.
    The same policy and environment give the same bytes. The environment then draws as if nothing had been exported.
    ``README.md`` in the folder says what its files hold, and how to fly it.

    Args:
        actor: of :func:`~torchrl_quad.make_actor` or :func:`~torchrl_quad.make_visual_actor`; it may only read the
            observation and the image.
        env: any task, or a TransformedEnv with nothing but an ObservationNormalizer. Its ``observe``, ``advance``,
            ``is_crash``, ``is_success``, ``metrics`` and ``episode_metrics`` consist of torch operations on the state.
        folder: where to write. Its parent is made if it is missing.
        normalizer: what the actor reads the observation through; by default that of the TransformedEnv, if it is one.
        origin: where the policy comes from, for the contract, by name: ``revision``, ``checkpoint_sha256``.

    Returns:
        the folder.

    Raises:
        ValueError: the policy or the task cannot be exported, or the bundle does not fly as they do.
        FileExistsError: something else than a bundle has that name, or there are files beside a bundle.
        ImportError: onnx, onnxruntime or onnxscript is missing.
    """
    needed = "onnx onnxruntime onnxscript"  # of which torch.onnx needs the last
    with needing(f"export_policy needs {needed}: pip install {needed}"):  # before anything flies
        for package in needed.split():
            importlib.import_module(package)
    task, normalizer = _unwrapped(env, normalizer)
    place = Path(folder) if Path(folder).name not in ("", "..") else Path(folder).resolve()
    check_place(place, "folder")
    check_bundle_only(place)
    camera = task.camera
    network = fold(actor, normalizer, None if camera is None else (camera.height, camera.width))
    reads, size = network.reads, observed(task)["observation"].shape[-1]
    if reads["observation"] != (size,):
        (width,) = reads["observation"]
        raise UserValueError(f"export_policy: the policy reads {width} numbers, the environment observes {size}.")
    policy = actor if normalizer is None else normalized(actor, normalizer)
    count, self_test = (IMAGES, SELF_TEST_IMAGES) if "depth" in reads else (VECTORS, SELF_TEST_VECTORS)
    first, whole, replayed, chosen = _fly(task, policy, count)
    vectors = _vectors(policy, task, chosen)
    n = 3 if task.num_envs != 3 else 4  # rules that only work for the environment's own number do not trace
    states = {key: leaf(replayed, ("state", key)).flatten(0, 1)[:n] for key in task.control_step.safe_state}
    rules = trace(task, states)
    models = {"policy": write_onnx(network), **rules.graphs}
    package = "torchrl_quad"
    with contextlib.suppress(metadata.PackageNotFoundError):
        package += f" {metadata.version(package)}"
    contract = {
        "version": contracts.VERSION,
        **describe(task, rules, models, memory=reads.get("memory", (0,))[0], visual="depth" in reads),
        "observation": seen_ranges(_array(leaf(whole, "observation").flatten(0, 1).float())),
        "envelope": envelope(whole),
        "results": results(task, whole),
        "origin": {
            "package": package,
            "weights_sha256": contracts.sha256(b"".join(x.tobytes() for x in network.weights())),
            **(origin or {}),
        },
    }
    keys = {name: name for name in MEASURED} | rules.entries | rules.obstacles
    starts = {name: _array(leaf(first, ("state", key))) for name, key in keys.items()}
    files = {f"{name}.onnx": x.SerializeToString(deterministic=True) for name, x in models.items()}
    files |= {"vectors.npz": _npz(vectors), "starts.npz": _npz(starts)}
    files["README.md"] = write_page(contract, type(task).__doc__)
    files |= write_c(network, contract, {name: x[:: count // self_test] for name, x in vectors.items()})
    files |= {name: text.encode() for name, text in autopilots.files(contract).items()}
    contract["sha256"] = {name: contracts.sha256(content) for name, content in files.items()}
    contract["digest"] = contracts.digest(contract)
    if problem := contracts.problem(contract):
        raise UserValueError(
            f"export_policy: {problem}. A bundle flies within the ranges of docs/deploy_contract.md: change the "
            "environment, or the drone."
        )
    files["contract.json"] = (json.dumps(contract, indent=2, allow_nan=False) + "\n").encode()
    with replacing_folder(place, check_bundle_only) as temporary:
        for name, content in files.items():
            with open(temporary / name, "wb") as file:
                file.write(content)
                os.fsync(file.fileno())
        _check_the_flight(temporary, task, policy, replayed, rules)
    return Path(folder)


def _unwrapped(
    env: EnvBase, normalizer: ObservationNormalizer | None
) -> tuple[QuadrotorEnv, ObservationNormalizer | None]:
    """The environment under its normaliser, and the normaliser."""
    if isinstance(env, TransformedEnv):
        if not isinstance(env.transform, ObservationNormalizer) or isinstance(env.base_env, TransformedEnv):
            raise UserValueError(
                "export_policy supports only one transform, an ObservationNormalizer: what others do to the "
                f"observation would be missing on the drone. Got {env.transform}."
            )
        normalizer = env.transform if normalizer is None else normalizer
    base = base_env(env)
    if not isinstance(base, QuadrotorEnv):
        raise UserValueError(f"export_policy needs an environment of this package, got {type(env).__name__}.")
    if normalizer is not None and list(normalizer.in_keys) != ["observation"]:
        raise UserValueError(f'export_policy: the normalizer must be that of "observation", got {normalizer.in_keys}.')
    return base, normalizer


@torch.no_grad()
def _fly(env: QuadrotorEnv, policy: TensorDictModuleBase, count: int) -> tuple[TensorDictBase, ...]:
    """A deterministic flight: its fresh starts (num_envs); (num_envs, time) without what is never judged; (REPLAYED,
    time) with everything; and (count), what the policy reads in single steps. The environment then continues as if not
    flown."""
    steps = max(env.max_episode_steps, -(-VECTORS // env.num_envs))
    at = torch.linspace(0, env.num_envs * steps - 1, count).long()
    drone, step = at // steps, at % steps
    keys = [key for key in policy.in_keys if key != "is_init"]
    mode = {"exploration_type": ExplorationType.DETERMINISTIC}
    random, source = env.random_state(), env.initial_state_source
    whole, replayed, read = [], [], []
    try:
        env.set_initial_state_source(None)
        env.randomness.seed(STARTS)
        carry, begin = env.reset(), 0
        first = carry.clone()
        longest = max(1, MOST_NUMBERS // sum(x.numel() for x in carry.values(True, True)))
        while begin < steps:
            part, carry = differentiable_rollout(env, policy, carry, min(longest, steps - begin), **mode)
            end = begin + part.shape[1]
            here = ((begin <= step) & (step < end)).nonzero().squeeze(-1)
            heavy = [key for name in NEVER_JUDGED for key in (name, ("next", *name))]
            whole.append(part.exclude(*heavy).clone())
            replayed.append(part[:REPLAYED].clone())
            read.append(cast(TensorDict, part.select(*keys)[drone[here], step[here] - begin]).set("place", here))
            begin = end
    finally:
        env.set_initial_state_source(source)
        env.set_random_state(random)
    all_of_it, again, chosen = (cast(TensorDict, torch.cat(x, i)) for i, x in ((1, whole), (1, replayed), (0, read)))
    return first, all_of_it, again, cast(TensorDict, chosen[leaf(chosen, "place").argsort()])


@torch.no_grad()
def _vectors(policy: TensorDictModuleBase, env: QuadrotorEnv, chosen: TensorDictBase) -> dict[str, np.ndarray]:
    """What the policy, as it is and not folded, reads and writes in single steps (n), its memory too: float32, by the
    names that its ONNX has for it."""
    seen = {key: leaf(chosen, key).float() for key in policy.in_keys if key != "is_init"}
    given = TensorDict({key: x.to(env.device, env.dtype) for key, x in seen.items()}, chosen.shape, env.device)
    if "is_init" in policy.in_keys:
        given["is_init"] = torch.zeros((*chosen.shape, 1), dtype=torch.bool, device=env.device)
    with set_exploration_type(ExplorationType.DETERMINISTIC), set_recurrent_mode(False):
        acted, memory = policy(given), memory_keys(policy)
    vectors = {name: seen[name] for name in ("observation", "depth") if name in seen}
    vectors |= {"memory": seen[memory[0]].flatten(1)} if memory else {}
    vectors |= {"action": leaf(acted, "action")}
    vectors |= {"next_memory": leaf(acted, ("next", memory[0])).flatten(1)} if memory else {}
    return {name: _array(x.float()) for name, x in vectors.items()}


def _check_the_flight(
    folder: Path, env: QuadrotorEnv, policy: TensorDictModuleBase, flights: TensorDictBase, rules: Rules
) -> None:
    """Fly the bundle through the first episodes of flights, from what a drone measures; compare what it observes and
    makes of them with the environment, and what it does and remembers with the policy."""
    bundle, task = load_bundle(folder), type(env).__name__
    bundle.check(TOLERANCE)
    how = "must depend on the state and on constants, and change nothing."
    for flight in flights:
        done = leaf(flight, ("next", "done")).flatten()
        length = int(done.nonzero()[0]) + 1 if done.any() else len(done)
        episode = flight[:length]
        seen = true = {key: leaf(episode, ("state", key)) for key in env.control_step.safe_state}
        for disturbance in env.disturbances.values():
            seen = disturbance.observe(seen)
        states = {name: _array(seen[name]) for name in MEASURED}
        states |= {"depth": _array(leaf(episode, "depth"))} if bundle.contract["camera"] else {}
        entries = {name: _array(seen[key]) for name, key in rules.entries.items()}
        observes_truth = all(torch.equal(true[name], seen[name]) for name in MEASURED)
        bundle.reset(**{name: x[0] for name, x in entries.items()})
        observations, actions, memories = [], [], [bundle.memory]
        for t in range(length):
            if not observes_truth:  # from which the environment advances the task; a drone only has measurements
                bundle._progress, bundle._step, bundle._before = {k: x[t][None] for k, x in entries.items()}, t, None
            bundle({name: x[t] for name, x in states.items()} | {"age": 0.0, "depth_age": 0.0})
            observations.append(bundle.observation)
            actions.append(bundle.action)
            memories.append(bundle.memory)
        observation = np.stack(observations)
        gaps = np.abs(observation - _array(leaf(episode, "observation").float())).max(1)
        if not gaps.max() <= OBSERVATION_TOLERANCE:
            step = int(np.argmax(~(gaps <= OBSERVATION_TOLERANCE)))
            raise UserValueError(
                f"export_policy: the bundle observes something else than {task} does, by {gaps[step]:.3g} in step "
                f"{step}. observe and advance {how}"
            )
        # Step by step from the bundle's own memory: over an episode a policy may amplify rounding errors without bound.
        read = episode.select(*(key for key in policy.in_keys if key != "is_init"))
        read["observation"] = torch.from_numpy(observation)
        for key in memory_keys(policy):
            read[key] = torch.from_numpy(np.stack(memories[:-1])).reshape(read[key].shape)
        own, found = _vectors(policy, env, read), {"action": actions, "next_memory": memories[1:]}
        gap = max(np.abs(np.stack(x) - own[name]).max() for name, x in found.items() if name in own)
        if not gap <= TOLERANCE:
            raise UserValueError(f"export_policy: the bundle acts differently from the policy, by {gap:.3g}.")
    if rules.unjudged:
        return
    flown = {"action": _array(leaf(flights, "action"))}
    for name in MEASURED:
        before, after = (leaf(flights, key) for key in (("state", name), ("next", "state", name)))
        flown[name] = _array(torch.cat((before[:, :1], after), 1))
    starts = rules.entries | rules.obstacles
    flown |= {name: _array(leaf(flights, ("state", key))[:, 0]) for name, key in starts.items()}
    expected = env.episode_metrics(flights)
    for name, found in judge(bundle, flown).items():
        own = _array(expected[name])
        if not np.allclose(found, own, rtol=METRIC_TOLERANCE, atol=METRIC_TOLERANCE, equal_nan=True):
            raise UserValueError(
                f"export_policy: the bundle judges flights differently from {task}: {name} is {found.tolist()} instead "
                f"of {own.tolist()}. is_crash, is_success, advance, metrics and episode_metrics {how}"
            )


def _array(x: Tensor) -> np.ndarray:
    return x.cpu().numpy()


def _npz(arrays: Mapping[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **cast(dict[str, Any], arrays))  # numpy writes no time into it
    return buffer.getvalue()


def check_bundle_only(folder: Path) -> None:
    """Raise FileExistsError for a folder that holds something else than a bundle, or files beside one."""
    found = [*folder.iterdir()] if folder.is_dir() else []
    if found and not (folder / "contract.json").is_file():
        raise FileExistsError(f"{folder} exists and is no bundle. Choose another folder, or empty this one.")
    own = {"contract.json", *contracts.OTHERS, *contracts.AUTOPILOTS, *(f"{name}.onnx" for name in contracts.GRAPHS)}
    if others := sorted(x.name for x in found if x.name not in own or not x.is_file() or x.is_symlink()):
        raise FileExistsError(
            f"{folder} also holds {', '.join(others)}: an export replaces the folder, and would delete that. Move it "
            "away, or choose another folder."
        )
