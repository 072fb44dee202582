"""Fly a bundle in a simulator, through its contract and without torch, judge the flights, and keep a table of them.

.. code-block:: python

    flight = fly("outputs/policy", "mujoco")
    print(flight["solved"].mean())
"""

from __future__ import annotations

import copy
import csv
import json
import time
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from torchrl_quad.deploy.bundle import Bundle, load_bundle
from torchrl_quad.deploy.contract import ENDS, MEASURED, Arrays, Contract, Fields, drone_problem, naming
from torchrl_quad.deploy.judging import Judge
from torchrl_quad.deploy.simulators import Array, Simulator, make_simulator
from torchrl_quad.errors import UserTypeError, UserValueError, shown
from torchrl_quad.files import add_rows, machine, read_rows

if TYPE_CHECKING:
    from tensordict import TensorDict

OF_THE_LOOP = ("rate_gain", "rate_damping", "max_body_rate", "max_thrust_to_weight")  # it does not know the true drone
MOST_SCALE = 1000.0
KEY = ("bundle", "simulator", "loop", "mutant", "drone", "episodes")  # of a row; the others are its results
SHOWN = ("task", *KEY[1:], "solved", "crash", "metrics", "seconds")


@dataclass(frozen=True)
class Mutant:
    """A mistake in a port, made on purpose. Some tasks forgive some of them, as hovering forgives a late command."""

    about: str
    quaternion: tuple[int, ...] = (0, 1, 2, 3)  #: the order in which the bundle gets the entries of the quaternion
    attitude: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)  #: times the quaternion that the bundle gets
    measured: tuple[float, ...] = (1.0, 1.0, 1.0)  #: times the body rates that the bundle gets
    commanded: tuple[float, ...] = (1.0, 1.0, 1.0)  #: times the rates, angles or velocity that it commands
    motors: tuple[int, ...] = (0, 1, 2, 3)  #: for each rotor the motor whose command it gets
    delay: int | None = None  #: control steps until a command takes effect, instead of the contract's
    keeps_queue: bool = True  #: whether the bundle keeps the commands on their way


MUTANTS = {
    "xyzw": Mutant("quaternion as x y z w", quaternion=(1, 2, 3, 0)),
    "yaw": Mutant("yaw rate commanded with the other sign", commanded=(1, 1, -1)),
    "heading": Mutant("heading counted clockwise", attitude=(1, 1, 1, -1)),
    "motors": Mutant("front motors swapped", motors=(3, 1, 2, 0)),
    "frd": Mutant("rates commanded in FRD", commanded=(1, -1, -1)),
    "frd_gyro": Mutant("rates measured in FRD", measured=(1, -1, -1)),
    "delay": Mutant("commands take effect at once", delay=0),
    "queue": Mutant("the commands on their way are not kept", keeps_queue=False),
}


def mistakes(bundle: Bundle) -> list[str]:
    """The names of the mutants that change something for a bundle."""
    delay, reads = bundle.contract["action_delay"], bundle.contract["graphs"]["observe"]["reads"]

    def is_idle(mutant: Mutant) -> bool:
        signs = mutant.commanded != Mutant.commanded and (_commanded(bundle, mutant) > 0.0).all()
        return bool(signs) or mutant.delay == delay or not (mutant.keeps_queue or "action_queue" in reads)

    return [name for name, mutant in MUTANTS.items() if not is_idle(mutant)]


def fly(
    folder: str | Path | Bundle,
    simulator: str,
    loop: str = "contract",
    mutant: Mutant | None = None,
    *,
    scale: Mapping[str, float] | None = None,
    late: int = 0,
    episodes: int | None = None,
) -> Fields:
    """Fly a bundle from its fresh starts, one episode each, in a simulator.

    The contract's ``action_delay`` holds: the hover command is on its way at the start. States are reported as late as
    its ``observation_delay``, and images as its camera takes them, but exactly.

    Args:
        folder: a bundle.
        simulator: one of ``torchrl_quad.deploy.simulators.SIMULATORS``.
        loop: the rate loop: "contract", "pid", "pd", or "own", that of the simulator; of Betaflight "own" or "stock".
        mutant: a mistake to make.
        scale: fields of the drone that flies, times a factor: ``{"mass": 1.2}``. The rate loop does not know of it.
        late: control steps by which commands take effect later than the contract says.
        episodes: of the starts, how many; by default all.

    Returns:
        by name: the states (n, time + 1, ...), with the task's entries, the first of which is the start, the last one
        repeated after the end of an episode; ``action`` (n, time, k); how states end the episode (n, time):
        ``terminated``, ``truncated``, ``success`` and ``done``; ``metrics``, the contract's ``task.metrics`` (n) by
        name; ``simulator``, name and version; ``faults``, the bundle's refusals by name.

    Raises:
        ValueError: the policy reads images, and the simulator has no camera; or an argument is unknown or out of its
            range.
    """
    bundle = folder if isinstance(folder, Bundle) else load_bundle(folder, on_fault="hover")
    with naming(bundle.folder), np.errstate(all="ignore"):  # what a simulator cannot fly becomes NaN, and a crash
        for name, value, least in (("late", late, 0), ("episodes", 1 if episodes is None else episodes, 1)):
            if not isinstance(value, int) or isinstance(value, bool) or value < least:
                raise UserValueError(f"{name} must be a whole number, at least {least}, got {shown(value)}.")
        mutant = Mutant("none") if mutant is None else mutant
        if not isinstance(mutant, Mutant):
            raise UserTypeError(f"mutant must be one of MUTANTS.values(), got {shown(mutant)}.")
        contract = other_drone(bundle.contract, scale or {})
        starts = {name: x[:episodes] for name, x in bundle.starts().items()}
        world, judge = make_simulator(simulator, contract, loop, mutant.motors), Judge(bundle, starts)
        delay = late + (contract["action_delay"] if mutant.delay is None else mutant.delay)
        return _fly(bundle, world, judge, starts, delay, mutant)


def _fly(bundle: Bundle, world: Simulator, judge: Judge, starts: Arrays, delay: int, mutant: Mutant) -> Fields:
    n, steps = len(starts["position"]), bundle.contract["task"]["max_episode_steps"]
    world.reset({name: starts[name] for name in MEASURED})
    world.place({name.removeprefix("scene."): x for name, x in starts.items() if name.startswith("scene.")})
    camera = bundle.contract["camera"] or {"rate": 1, "delay": 0}
    rate, delay_of_images = camera["rate"], camera["delay"]
    images: deque[Array] = deque(maxlen=1 - (-delay_of_images // rate))
    pilots = [_pilot(bundle, {k: x[i] for k, x in starts.items()}) for i in range(n)]
    turn = _commanded(bundle, mutant)
    queue = deque([np.tile(bundle.commanded(bundle._hover), (n, 1))] * delay)
    state, memory = world.state(), bundle.contract["observation_delay"] + 1
    seen = deque([state] * memory, memory)
    flight = {name: np.repeat(x[:, None], steps + 1, 1) for name, x in state.items()}
    flight["action"] = np.tile(bundle.action.astype(float), (n, steps, 1))
    alive = np.arange(n)
    for t in range(1, steps + 1):
        if len(alive):
            command = np.empty((len(alive), len(turn)))
            if bundle.contract["camera"] and (t - 1) % rate == 0:
                images.append(world.look())
            shown = (t - 1) // rate - max((t - 1 - delay_of_images) // rate, 0)  # images since the one that it gets
            for k, i in enumerate(alive):
                now = {name: seen[0][name][k] for name in MEASURED}
                now |= {"depth": images[-1 - shown][k], "depth_age": 0.0} if images else {}
                command[k] = _ask(pilots[i], now, mutant)
                flight["action"][i, t - 1] = pilots[i].action
            queue.append(command)
            world.step(queue.popleft() * turn)
            state = world.state()
            for name, x in state.items():
                flight[name][alive, t:] = x[:, None]
            seen.append(state)
        on = ~judge.step(flight["action"][:, t - 1], {name: flight[name][:, t] for name in MEASURED})[alive]
        if not on.all():
            alive = alive[on]
            queue = deque(x[on] for x in queue)
            images = deque((x[on] for x in images), images.maxlen)
            seen = deque(({k: x[on] for k, x in y.items()} for y in seen), seen.maxlen)
            world.keep(on)
    faults = sum((pilot.faults for pilot in pilots), Counter())
    found = {"metrics": judge.metrics(), "simulator": world.version, "faults": dict(faults)}
    return flight | judge.flight() | found


def other_drone(contract: Contract, scale: Mapping[str, float]) -> Fields:
    """The contract with another drone in its ``plant``: fields times a factor.

    Raises:
        ValueError: a field is unknown, or belongs to the rate loop, or its factor makes no drone.
    """
    drone, plant = contract["drone"] | contract["plant"], dict(contract["plant"])
    fields = [name for name in drone if name not in OF_THE_LOOP]
    for name, factor in scale.items():
        if name not in fields:
            raise UserValueError(f"scale: the drone has no {shown(name)} to scale. Choose from: {', '.join(fields)}.")
        if not isinstance(factor, (int, float)) or isinstance(factor, bool) or not 0.0 <= factor <= MOST_SCALE:
            raise UserValueError(f"scale: {name} must be a number from 0 to {MOST_SCALE:g}, got {shown(factor)}.")
        plant[name] = (factor * np.array(drone[name], float)).tolist()
    scaled = {**contract, "plant": plant}
    if scale and (problem := drone_problem(scaled)):
        raise UserValueError(f"scale: {problem}. Choose other factors.")
    return scaled


def _pilot(bundle: Bundle, start: Arrays) -> Bundle:
    """Another bundle of the same policy, with a flight and a memory of its own."""
    pilot = copy.copy(bundle)
    pilot.faults = Counter()
    pilot.reset(**{name: start[name] for name in bundle.contract["task"]["entries"]})
    return pilot


def _ask(pilot: Bundle, state: dict[str, Array], mutant: Mutant) -> Array:
    """The command (k) of a bundle in a state."""
    if not mutant.keeps_queue:
        pilot.queue = np.tile(pilot._hover, (len(pilot.queue), 1))
    attitude = state["quaternion"] * mutant.attitude
    seen = {"quaternion": attitude[list(mutant.quaternion)], "age": 0.0}
    seen["angular_velocity"] = state["angular_velocity"] * mutant.measured
    pilot({**state, **seen})
    return pilot.commanded(pilot.action)


def _commanded(bundle: Bundle, mutant: Mutant) -> Array:
    """The signs of a command (k): those of the three axes, and of yaw the last; thrusts keep theirs."""
    x, y, z = mutant.commanded
    control, n = bundle.contract["output"]["control"], len(bundle.action)
    return np.array({"rotor_thrusts": n * [1.0], "velocity": [x, y, z, z]}.get(control, [1.0, x, y, z]))


def as_rollout(flight: Contract) -> TensorDict:
    """What :func:`fly` returns as a rollout (n, time) for the package's pictures; this needs torch."""
    import torch
    from tensordict import TensorDict

    n, time = flight["done"].shape
    names = [*MEASURED, "rotor_speed", *(["target"] if "target" in flight else [])]
    states = {name: torch.from_numpy(flight[name]).float() for name in names}
    first = flight["done"].cumsum(1) - flight["done"] == 0  # what comes after the first episode has not flown
    ends = {name: torch.from_numpy(flight[name] & first).unsqueeze(-1) for name in (*ENDS, "done")}
    rollout: dict[Any, torch.Tensor] = {"action": torch.from_numpy(flight["action"]).float()}
    rollout |= {("state", name): x[:, :-1] for name, x in states.items()}
    rollout |= {("next", "state", name): x[:, 1:] for name, x in states.items()}
    rollout |= {("next", name): x for name, x in ends.items()}
    return TensorDict(cast(Any, rollout), [n, time])


# -- a table of flights -----------------------------------------------------------------------------------------------


def measure(
    bundle: Bundle,
    path: Path,
    simulator: str,
    loop: str,
    mutant: str = "none",
    *,
    scale: Mapping[str, float] | None = None,
    late: int = 0,
    episodes: int | None = None,
) -> None:
    """Fly once, and add the result to a table, unless it is there; the arguments are those of :func:`fly`."""
    if mutant not in ("none", *MUTANTS):
        raise UserValueError(f"mutant must be none or one of {', '.join(MUTANTS)}; got {shown(mutant)}.")
    task = bundle.contract["task"]
    drone = {**(scale or {}), **({"late": late} if late else {})}
    starts = len(bundle.starts()["position"])
    with naming(bundle.folder):
        version = make_simulator(simulator, bundle.contract, loop).version
    flown = {
        "bundle": bundle.contract["digest"][:12],
        "simulator": version,
        "loop": loop,
        "mutant": mutant,
        "drone": json.dumps(drone, sort_keys=True) if drone else "nominal",
        "episodes": str(min(starts, episodes or starts)),
    }
    if any(all(row[name] == flown[name] for name in KEY) for row in _rows(path)):
        return
    begin, ends = time.perf_counter(), ("solved", "crash")
    flight = fly(bundle, simulator, loop, MUTANTS.get(mutant), scale=scale, late=late, episodes=episodes)
    totals = []
    for name, about in task["metrics"].items():
        known = flight["metrics"][name][~np.isnan(flight["metrics"][name])]
        total = (np.median if about["median"] else np.mean)(known) if len(known) else None
        text = "none" if total is None else f"{about['scale'] * total:.3g} {about['unit']}".rstrip()
        totals += [] if name in ends else [f"{about['label']} {text}"]
    row = {
        "task": task["name"],
        **flown,
        **{name: f"{flight['metrics'][name].mean():.4f}" for name in ends},
        "metrics": "; ".join(totals),
        "seconds": f"{time.perf_counter() - begin:.1f}",
        "faults": sum(flight["faults"].values()),
        "machine": machine(),
    }
    add_rows(path, [row])


def table(path: Path, bundle: Bundle) -> str:
    """The flights of a bundle as a table, and the path of the file."""
    own = [row for row in _rows(path) if row["bundle"] == bundle.contract["digest"][:12]]
    rows = [dict(zip(SHOWN, SHOWN, strict=True)), *own]
    widths = {name: max(len(row[name]) for row in rows) for name in SHOWN}
    lines = ["  ".join(row[name].rjust(widths[name]) for name in SHOWN) for row in rows]
    return "\n".join((*lines, "", str(path)))


def _rows(path: Path) -> list[dict[str, str]]:
    try:
        rows = read_rows(path)
        if not all(isinstance(row.get(name), str) for row in rows for name in (*KEY, *SHOWN)):
            raise csv.Error(f"a row lacks one of {', '.join(KEY)} or its results")
    except (UnicodeDecodeError, csv.Error) as error:
        why = f"{path} is no table of flights: {error}. Move it away, or choose another folder=..."
        raise UserValueError(why) from error
    return rows
