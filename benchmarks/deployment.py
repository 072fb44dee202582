"""How far torch, ONNX and C differ on what a policy has visited, and how long a call takes.

python -m benchmarks.deployment --checkpoints outputs/.../checkpoint.pt ...   # without them, untrained policies

Each policy is exported as it is, and once more behind an ObservationNormalizer. A time is the median of single calls
from Python: of C with what ctypes takes, of the bundle from the named quantities to newtons and radians per second.

With arm-none-eabi-gcc (the Debian package gcc-arm-none-eabi) it also compiles policy.c for a Cortex-M4 with a floating
point unit. Bytes are those of its sections without the self-test, and of the deepest stack of a call without libm.
Cycles are an estimate: instructions of the innermost loops in the compiled code, times how often they run, each at the
cycles that ARM's manual gives it, and 150 for each activation; memory without wait states.
"""

import ctypes
import re
import shutil
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
M4 = "-mcpu=cortex-m4 -mfloat-abi=hard -mfpu=fpv4-sp-d16 -std=c99 -O2 -fno-inline -ffunction-sections -fdata-sections"
CYCLES = {"vld": 2, "vst": 2, "vfm": 3, "vml": 3, "ldr": 2, "str": 2}  # of instructions by their beginning; others 1
ACTIVATION = 150  # cycles of an exponential function
ENVS = 64


def build(source: str) -> tuple[EnvBase, TensorDictModuleBase]:
    """The environment and the policy of a checkpoint, or of a task, untrained."""
    if source in TASKS:
        env = make_env(source, num_envs=ENVS, seed=7)
        return env, (make_visual_actor if "depth" in env.observation_spec else make_actor)(env)
    if source.endswith(" with memory"):
        env = make_env(source.removesuffix(" with memory"), num_envs=ENVS, seed=7)
        return env, make_actor(env, recurrent=True)
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


def innermost(code: str, function: str) -> int:
    """Cycles of one turn of the shortest loop with a multiplication in a function, from its disassembly."""
    lines = re.findall(
        r"^ +([0-9a-f]+):\t[^\t]*\t(\S+)\t?(.*)$", code.partition(f"<{function}>:\n")[2].partition("\n\n")[0], re.M
    )
    at = {address: i for i, (address, _, _) in enumerate(lines)}
    loops = []
    for i, (_, name, operands) in enumerate(lines):
        start = at.get(operands.partition(" ")[0], i) if name.startswith("b") else i
        body = [x for _, x, _ in lines[start : i + 1]]
        if start < i and any(x.startswith(("vmul", "vfma", "vmla")) for x in body):
            loops.append(2 + sum(CYCLES.get(x[:3], 1) for x in body))  # a branch that is taken costs 2 more
    return min(loops)


def on_microcontroller(folder: Path) -> dict[str, Any]:
    """Flash, stack and estimated cycles of a policy on a Cortex-M4; nothing without the compiler."""
    if shutil.which("arm-none-eabi-gcc") is None:
        return {}
    with tempfile.TemporaryDirectory() as name:
        target = Path(name) / "policy.o"
        compile_ = [
            "arm-none-eabi-gcc",
            *M4.split(),
            "-fstack-usage",
            "-c",
            str(folder / "policy.c"),
            "-o",
            str(target),
        ]
        subprocess.run(compile_, check=True)
        tools = (["size", "-A", str(target)], ["objdump", "-d", str(target)])
        sizes, code = (
            subprocess.run([f"arm-none-eabi-{x}", *rest], check=True, capture_output=True, text=True).stdout
            for x, *rest in tools
        )
        stack = sum(
            int(x)
            for x in re.findall(
                r":(?!policy_self_test|policy_command)\w+\t(\d+)\t", target.with_suffix(".su").read_text()
            )
        )
    sections = re.findall(r"^\.(?:text|rodata)\.(?!test_|policy_self_test)\S+ +(\d+)", sizes, re.M)
    text, number = (folder / "policy.c").read_text(), r"(\d+)"
    memory = int(*re.findall(r"POLICY_MEMORY (\d+)", (folder / "policy.h").read_text()) or [0])
    layers = re.findall(rf" sum\(weight_\d+, bias_\d+, {number}, \w+, {number}, ", text)
    images = re.findall(rf" convolve\(kernel_\d+, kernel_bias_\d+, {', '.join(3 * [number])}, \w+, {number}, ", text)
    read = re.findall(rf" remember\(.*own_bias, {number}, ", text)
    turns = {"sum": sum(int(n) * int(m) for n, m in layers) + sum(3 * memory * (int(n) + memory) for n in read)}
    turns["convolve"] = sum(9 * int(c) * int(d) * -(-int(h) // 2) * -(-int(w) // 2) for c, h, w, d in images)
    activations = sum(int(n) for n in re.findall(r"i < (\d+); \+\+i\) \w+\[i\] = \w+_of", text))
    cycles = ACTIVATION * activations + sum(n * innermost(code, name) for name, n in turns.items() if n)
    return {"flash [B]": sum(map(int, sections)), "stack [B]": stack, "M4 [kcycles, estimated]": round(cycles / 1000)}


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
        policy, chip = ctypes.CDLL(str(library)).policy_action, on_microcontroller(folder)
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
        **chip,
    }


def main() -> None:
    args = command_line(__doc__, "deployment.csv", checkpoints=list(TASKS), observations=10_000, calls=10_000)
    cases = [(source, normalizer) for source in args.checkpoints for normalizer in (False, True)]
    save(args.output, [measure(*case, args.observations, args.calls) for case in tqdm(cases)])


if __name__ == "__main__":
    main()
