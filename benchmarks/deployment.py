"""How far torch, ONNX and C differ on what a policy has visited, and how long a call takes.

python -m benchmarks.deployment --checkpoints outputs/.../checkpoint.pt ...   # without them, untrained policies

Each policy is exported as it is, and once more behind an ObservationNormalizer. A time is the median of single calls
from Python: of C with what ctypes takes, of the bundle from the named quantities to newtons and radians per second.
"""

import ctypes
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType
from tqdm import tqdm

from benchmarks.report import command_line, save
from torchrl_quad import ObservationNormalizer, differentiable_rollout, make_actor, make_env, make_visual_actor
from torchrl_quad.deploy import export_policy, load_bundle
from torchrl_quad.envs import TASKS
from torchrl_quad.training.building import build_env
from torchrl_quad.training.evaluation import load_policy

GCC = ["gcc", "-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic", "-shared", "-fPIC"]
ENVS = 64


def build(source: str) -> tuple[EnvBase, TensorDictModuleBase]:
    """The environment and the policy of a checkpoint, or of a task, untrained."""
    if source in TASKS:
        env = make_env(source, num_envs=ENVS, seed=7)
        return env, (make_visual_actor if "depth" in env.observation_spec else make_actor)(env)
    cfg, actor, normalizer = load_policy(Path(source))
    if normalizer is not None:
        raise SystemExit(f"{source} has a normaliser already: give checkpoints without one.")
    return build_env(cfg, ENVS, 7), actor


@torch.no_grad()
def normalized(env: EnvBase, actor: TensorDictModuleBase) -> EnvBase:
    """The environment behind a normaliser; the first layer of the policy changes so that it does the same as before."""
    env = TransformedEnv(env, ObservationNormalizer(env))
    env.transform.update(fly(env.base_env, actor))
    network, normalizer = actor[0][0].module.trunk if "depth" in actor.in_keys else actor[0].module, env.transform
    first, size = network.mlp[0], len(normalizer.loc)  # the observation is the last that it reads
    first.bias.add_(first.weight[:, -size:] @ (network.scales[-1] * normalizer.loc))
    first.weight[:, -size:].mul_(normalizer.scale)
    return env


@torch.no_grad()
def fly(env: EnvBase, actor: TensorDictModuleBase) -> Any:
    """Deterministic flights from fresh starts (num_envs, time)."""
    steps = env.max_episode_steps
    return differentiable_rollout(env, actor, None, steps, exploration_type=ExplorationType.DETERMINISTIC)[0]


def median_us(call: Callable[[], Any], calls: int) -> float:
    durations = []
    for _ in range(calls):
        begin = time.perf_counter()
        call()
        durations.append(time.perf_counter() - begin)
    return round(1e6 * float(np.median(durations)), 2)


def measure(source: str, with_normalizer: bool, count: int, calls: int) -> dict[str, Any]:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    env, actor = build(source)
    env = normalized(env, actor) if with_normalizer else env
    flight = fly(env, actor)
    at = torch.linspace(0, flight.numel() - 1, count).long()
    names = {"observation": "observation", "depth": "depth", "recurrent_state": "memory"}
    read = {name: flight[key].flatten(0, 1)[at] for key, name in names.items() if key in actor.in_keys}
    expected = flight["action"].flatten(0, 1)[at]
    if with_normalizer:
        read["observation"] = env.transform.undo(read["observation"])
    raw = {name: np.ascontiguousarray(x.flatten(1) if name == "memory" else x) for name, x in read.items()}
    with tempfile.TemporaryDirectory() as name:
        folder = export_policy(actor, env, Path(name) / "policy")
        bundle = load_bundle(folder)
        library = Path(name) / "policy.so"
        subprocess.run([*GCC, str(folder / "policy.c"), "-o", str(library), "-lm"], check=True)
        policy = ctypes.CDLL(str(library)).policy_action
    by_onnx = bundle.graphs["policy"](raw)["action"]
    by_c, pointer = np.empty((count, 4), np.float32), ctypes.POINTER(ctypes.c_float)
    for *x, y in zip(*raw.values(), by_c, strict=True):
        ends = [z.ctypes.data_as(pointer) for z in (*x, y)]
        policy(*ends)
    still = {"position": [1.0, 0.0, 1.4], "quaternion": [1.0, 0, 0, 0], "velocity": np.zeros(3)}
    image = {"depth": raw["depth"][0], "depth_age": 0.0} if "depth" in actor.in_keys else {}
    state = {**still, "angular_velocity": np.zeros(3), "age": 0.0, **image}
    return {
        "task": bundle.contract["task"]["name"],
        "policy": "untrained" if source in TASKS else "trained",
        "normalizer": with_normalizer,
        "observations": count,
        "torch - ONNX": f"{np.abs(expected.numpy() - by_onnx).max():.1e}",
        "torch - C": f"{np.abs(expected.numpy() - by_c).max():.1e}",
        "ONNX - C": f"{np.abs(by_onnx - by_c).max():.1e}",
        "C [us]": median_us(lambda: policy(*ends), calls),
        "bundle [us]": median_us(lambda: bundle(state), calls),
    }


def main() -> None:
    args = command_line(__doc__, "deployment.csv", checkpoints=list(TASKS), observations=10_000, calls=10_000)
    cases = [(source, normalizer) for source in args.checkpoints for normalizer in (False, True)]
    save(args.output, [measure(*case, args.observations, args.calls) for case in tqdm(cases)])


if __name__ == "__main__":
    main()
