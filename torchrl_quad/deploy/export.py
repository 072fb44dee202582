"""Export a policy: the network as ONNX and C, the contract, vectors to check it with, and a page to read."""

from __future__ import annotations

import contextlib
import io
import itertools
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
from torchrl_quad.deploy.bundle import QUANTITIES, load_bundle
from torchrl_quad.deploy.describe import describe, envelope, results, seen_ranges
from torchrl_quad.deploy.folding import fold
from torchrl_quad.deploy.network import write_c, write_onnx
from torchrl_quad.deploy.page import write_page
from torchrl_quad.deploy.tasks import PROGRESS, RULES, Rule, progress_of
from torchrl_quad.envs import QuadrotorEnv
from torchrl_quad.errors import MissingPackage, UserValueError
from torchrl_quad.files import check_folder, replacing_folder

VECTORS, SELF_TEST_VECTORS = 1024, 16
IMAGES, SELF_TEST_IMAGES = 256, 4  # the same with images, which are large
STARTS = 2_000_000  # seed of the starts, that of recipes/evaluate.py
REPLAYED = 2  # environments whose first episode the bundle flies again
MOST_NUMBERS = 10_000_000  # that a part of a flight observes; a forest is flown in several parts
NEVER_JUDGED = (("depth",), ("state", "images"), ("state", "scene"))  # entries that take most of a flight's memory
TOLERANCE = 1e-5  # of an action
MEMORY_TOLERANCE = 1e-4  # of an action within an episode: rounding errors go on in the memory
OBSERVATION_TOLERANCE = 1e-3  # of an entry of the observation: float32 adds up a phase less exactly than a bundle


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
    try:
        import onnx  # noqa: F401, asked for before anything flies
        import onnxruntime  # noqa: F401
    except ImportError as error:
        raise MissingPackage("export_policy needs onnx and onnxruntime: pip install onnx onnxruntime") from error
    env, normalizer = _unwrapped(env, normalizer)
    place = Path(folder) if Path(folder).name not in ("", "..") else Path(folder).resolve()
    check_folder(place)
    require_bundle(place)
    camera = env.camera
    network = fold(actor, normalizer, camera and (camera.height, camera.width))
    reads = network.reads
    contract = {"version": contracts.VERSION}
    contract |= describe(env, sees="depth" in reads, memory=reads.get("memory", (0,))[0])
    (width,), size = reads["observation"], contract["inputs"][-1]["stop"]
    shape = env.observation_spec["observation"].shape
    if not width == size == shape[-1]:
        raise UserValueError(
            f"export_policy: the policy reads {width} numbers, the environment observes {shape[-1]}, and "
            f"{type(env).__name__} is known to observe {size}."
        )
    policy = actor if normalizer is None else NormalizedPolicy(actor, normalizer)
    count, self_test = (IMAGES, SELF_TEST_IMAGES) if "depth" in reads else (VECTORS, SELF_TEST_VECTORS)
    flight = _fly(env, policy, count)
    vectors = _vectors(policy, env, flight.chosen)
    visited = flight.whole["observation"].flatten(0, 1)
    contract["inputs"] = seen_ranges(contract["inputs"], visited.float().cpu().numpy())
    contract["safety"]["seen"] = envelope(flight.whole)
    contract["results"] = results(env, flight.whole)
    weights = b"".join(x.tobytes() for x in network.weights())
    package = {"package": _version(), "weights_sha256": contracts.sha256(weights)}
    contract["origin"] = package | dict(origin or {})
    files = {"policy.onnx": write_onnx(network), "vectors.npz": _npz(vectors), "README.md": write_page(contract)}
    files["starts.npz"] = _npz(_starts(flight.whole, contract["task"]["rule"]))
    files |= write_c(network, contract, {name: x[:: count // self_test] for name, x in vectors.items()})
    contract["sha256"] = {name: contracts.sha256(files[name]) for name in contracts.FILES}
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
        _require_the_same_flight(temporary, env, policy, flight.replayed)
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


def _starts(flight: TensorDictBase, rule: str) -> dict[str, np.ndarray]:
    """The first states of a flight (num_envs, ...), without what the environment drew beside them."""
    names = [*QUANTITIES, *PROGRESS[rule]]
    return {name: flight["state", name][:, 0].cpu().numpy() for name in names}


def _require_the_same_flight(
    folder: Path, env: QuadrotorEnv, policy: TensorDictModuleBase, flights: TensorDictBase
) -> None:
    """Fly the bundle through the first episodes of flights, from what a drone knows.

    Compare what it observes with what the environment did, and what it then does and remembers with what the policy
    does, in the same order, with the same observations.
    """
    bundle = load_bundle(folder)
    bundle.check(TOLERANCE)
    for flight in flights:
        done = flight["next", "done"].flatten()
        length = int(done.nonzero()[0]) + 1 if done.any() else len(done)
        episode = flight[:length]
        seen = {key: episode["state", key] for key in env.control_step.safe_state}
        for disturbance in env.disturbances.values():
            seen = disturbance.observe(seen)
        rule = bundle.contract["task"]["rule"]
        bundle.reset(**progress_of(rule, {key: seen[key][0].cpu().numpy() for key in PROGRESS[rule]}))
        states = {k: seen[k].cpu().numpy() for k in QUANTITIES}
        states |= {"depth": episode["depth"].cpu().numpy()} if bundle.contract["camera"] else {}
        true = episode["state", "position"].cpu().numpy()
        if not np.array_equal(true, states["position"]):
            # The environment counts gates from there, a bundle from what it measures.
            _go_by(bundle.rule, RULES[rule], true)
        observed, acted = [], []
        for t in range(length):
            bundle({name: x[t] for name, x in states.items()} | {"age": 0.0, "depth_age": 0.0})
            observed.append(bundle.observation)
            acted.append(bundle.action)
            gap = np.abs(bundle.observation - episode["observation"][t].float().cpu().numpy()).max()
            if not gap <= OBSERVATION_TOLERANCE:
                raise UserValueError(
                    f"export_policy: {type(env).__name__} observes something else than the contract says, by {gap:.3g} "
                    f"in step {t}. A contract describes the package's own observations and rules; this environment has "
                    "others."
                )
        read = {key: episode[key] for key in policy.in_keys if key != "is_init"}
        read["observation"] = torch.from_numpy(np.stack(observed))
        again = _act(policy, env, {key: x[None] for key, x in read.items()})["action"][0].float().cpu().numpy()
        gap = np.abs(np.stack(acted) - again).max()
        if not gap <= MEMORY_TOLERANCE:
            raise UserValueError(
                f"export_policy: the bundle acts otherwise than the policy, by {gap:.3g} within an episode."
            )


def _go_by(rule: Rule, kind: type, positions: np.ndarray) -> None:
    """Let a rule, and its copies, advance along positions (t, 3), whatever the bundle tells it."""
    steps = itertools.pairwise(positions)
    rule.__class__ = type(kind.__name__, (kind,), {"advance": lambda self, *_: kind.advance(self, *next(steps))})


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
    if others := sorted(names - (plain & {*contracts.FILES, "contract.json"})):
        raise FileExistsError(
            f"{folder} also holds {', '.join(others)}: an export replaces the folder, and would delete that. Move it "
            "away, or choose another folder."
        )
