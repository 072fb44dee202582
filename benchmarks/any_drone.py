"""One policy for every quadrotor: ours and RAPTOR, each flown in two simulators and on the drones that ship.

python -m benchmarks.any_drone --seeds 0 1 2 --cores 2   # trains and flies what is missing; fills in docs/any_drone.md

Both fly through one door: position relative to the target, attitude, velocity and body rates every 10 ms give what the
motors are told. RAPTOR's action is a share of the greatest rotor speed, ours of the greatest thrust. Each flight lasts
10 s, and is solved if its mean distance over the last second is below 10 cm, and it never left the box of hovering.
The drones of "l2f" are those of RAPTOR's own sampler (arXiv:2509.11481), in its own simulator, tilted by up to 90
degrees. Needs pip install l2f foundation-policy.
"""

import functools
import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.paper.running import kept, run, side_by_side
from benchmarks.pilots import DT, SPIN, Informed, Motion, Ours, Raptor
from benchmarks.report import RESULTS, command_line, publish
from torchrl_quad import HoveringEnv, available_drones, load_drone
from torchrl_quad.deploy.simulators import simulator_class
from torchrl_quad.dynamics.rigid_body import Rotors
from torchrl_quad.engine.simulation import State
from torchrl_quad.envs.disturbances import Disturbance
from torchrl_quad.envs.randomness import Randomness
from torchrl_quad.files import add_rows, machine, read_rows
from torchrl_quad.render.canvas import make_figure
from torchrl_quad.render.canvas import save as save_figure

PAGE = Path(__file__).parents[1] / "docs/any_drone.md"
PICTURE = PAGE.parent / "images/any_drone.png"
STEPS, STARTS = 1000, 2_000_000  # of a flight; the seed
BOX = torch.tensor([[-5.0, -5.0, -1.5], [5.0, 5.0, 4.5]])  # [m], around the target, as in hovering
# Per rotor of l2f's Crazyflie: thrust = c0 + c1 u + c2 u^2 [N] at the share u of the greatest speed; all others of its
# sampler have a multiple of it.
CURVE = np.array([0.003525, 0.014373, 0.092230])
LAYOUT = [[1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]]  # front right, back right, back left, front left


class Worn(Disturbance):
    """A rotor that gives 70 to 100 % of its thrust, and a centre of mass off the middle, by up to a tenth of the arm
    along x and y."""

    def start(self, random: Randomness, state: State) -> State:
        places = state["drone", "rotor_positions"]
        which, lost = random.uniform(len(places), 4), 0.15 + 0.15 * random.uniform(len(places), 1)
        weak = torch.nn.functional.one_hot(which.argmax(-1), 4)
        arm = places.norm(dim=-1, keepdim=True).mean(1, keepdim=True)
        off = 0.1 * arm * random.uniform(len(places), 1, 2)
        return {("drone", "rotor_effectiveness"): 1.0 - lost * weak, ("drone", "rotor_positions"): places + off}


def judge(pilot: Any, motion: Motion, step: Callable[[Tensor], Motion], box: Tensor = BOX) -> dict[str, float]:
    """Fly n drones, which ``step`` moves on by what the pilot tells the motors, and judge them."""
    pilot.reset(len(motion[0]))
    lost, late = torch.zeros(len(motion[0]), dtype=torch.bool), []
    for k in range(STEPS):
        motion = step(pilot(motion))
        lost |= ~((motion[0] > box[0]) & (motion[0] < box[1])).all(-1)
        if k >= STEPS - round(1.0 / DT):
            late.append(motion[0].norm(dim=-1))
    error = torch.stack(late).mean(0)
    return {
        "solved": 100 * ((error < 0.1) & ~lost).double().mean().item(),
        "crash": 100 * lost.double().mean().item(),
        "median": 100 * error[~lost].median().item() if not lost.all() else float("nan"),
    }


def shares(pilot: Any, told: Tensor, env: HoveringEnv) -> Tensor:
    """The shares of the greatest thrust of each rotor of an environment that a pilot tells."""
    if not pilot.tells_speed:
        return told
    rotors, slowest, full = Rotors(env.nominal), env.nominal.rotor_speed_min, 2.0 * env.dynamics.controller.scale
    return rotors.thrust(slowest + told * (rotors.speed(full) - slowest)) / full


def in_ours(pilot: Any, env: HoveringEnv) -> dict[str, float]:
    """In an environment that hovers by rotor thrusts."""
    td = env.reset()

    def motion() -> Motion:
        state, names = td["state"], ("quaternion", "velocity", "angular_velocity")
        pilot.state = state
        return (state["position"] - state["target"], *(state[name] for name in names))

    def step(told: Tensor) -> Motion:
        nonlocal td
        td = env.step_mdp(env.step(td.set("action", 2.0 * shares(pilot, told, env) - 1.0)))
        return motion()

    with torch.no_grad():
        return judge(pilot, motion(), step, torch.tensor([[-5.0], [5.0]]))  # its drones start where a floor would be


def any_drone(n: int, tilt: float = 0.6, delay: int = 3) -> HoveringEnv:
    """Our distribution, in our simulator, with delays up to this many steps."""
    options = {"control": "rotor_thrusts", "control_dt": DT, "max_episode_steps": STEPS}
    ranges, start = {"any": {"delay": [0, delay]}}, {"tilt": tilt, "velocity": 1.0, "angular_velocity": 1.0}
    return HoveringEnv(n, seed=STARTS, drone="cf2x", randomize=ranges, random_start=start, **options)


def probe(pilot: Ours, n: int, path: Path) -> None:
    """Draw how well a linear function of the memory tells which drone it is, over the time after take-off."""
    pilot.remembered, env = [], any_drone(n)
    state, half = env.reset()["state"], n // 2
    in_ours(pilot, any_drone(n))  # the same drones
    traits, mass = state["traits"], state["drone", "mass"].log()
    known = {"thrust to weight": traits[:, :1], "torque to inertia": traits[:, 1:2], "mass": mass}
    known |= {"lag, rising": traits[:, 4:5], "lag, falling": traits[:, 5:6], "delay": traits[:, 8:9]}
    figure = make_figure(figsize=(7, 4), layout="constrained")
    axes = figure.add_subplot(xlabel="time after take-off [s]", ylabel="R2 on drones not fitted", ylim=(0, 1))
    for name, x in known.items():
        told = []
        for memory in pilot.remembered:
            read = torch.cat((memory, torch.ones(n, 1)), 1).double()
            normal = read[:half].t() @ read[:half] + 1e-3 * torch.eye(read.shape[1], dtype=torch.float64)
            weights = torch.linalg.solve(normal, read[:half].t() @ x[:half].double())
            rest = x[half:].double()
            told.append(1 - ((read[half:] @ weights - rest).square().mean() / rest.var(correction=0)).item())
        axes.plot(np.arange(1, 1 + len(told)) * DT, np.clip(told, 0, 1), label=name)
        after = [told[min(k, len(told)) - 1] for k in (10, 30, 100)]
        print(f"{name:18s} R2 after 0.1, 0.3 and 1 s: {after[0]:.2f} {after[1]:.2f} {after[2]:.2f}")
    axes.legend()
    save_figure(figure, path)
    pilot.remembered = None


def shipped(n: int, name: str, delay: int) -> HoveringEnv:
    """A drone that ships, in our simulator: its rotors in the order of the policies, its frame turned to fit."""
    drone = load_drone(name)
    place, spin = drone.rotor_positions[:, :2], drone.rotor_spin
    if (place.abs().amin(-1) < 0.1 * place.norm(dim=-1)).all():  # a plus: turned by 45 degrees
        place = torch.stack((place[:, 0] - place[:, 1], place[:, 0] + place[:, 1]), -1) / 2**0.5
    if spin[(place @ torch.tensor(LAYOUT[0])).argmax()] > 0:  # the front right turns the other way: by 90 degrees more
        place = torch.stack((-place[:, 1], place[:, 0]), -1)
        fields = {x: getattr(drone, x)[[1, 0, 2]] for x in ("inertia", "linear_drag", "quadratic_drag")}
        drone = drone.replace(**fields)
    order = [(place @ torch.tensor(corner)).argmax().item() for corner in LAYOUT]
    drone = drone.replace(rotor_positions=place[order], rotor_spin=spin[order])
    assert drone.rotor_spin.tolist() == SPIN, name
    options = {"control": "rotor_thrusts", "control_dt": DT, "max_episode_steps": STEPS, "action_delay": delay}
    start = {"tilt": 0.6, "velocity": 1.0, "angular_velocity": 1.0}
    return HoveringEnv(n, seed=STARTS, drone=drone, random_start=start, **options)


def in_mujoco(pilot: Any, n: int, name: str, changed: int | None = None) -> dict[str, float]:
    """On a drone that ships, in MuJoCo, as a contract describes it, or changed, as a seed draws it; one step late."""
    env = shipped(n, name, delay=1)
    full, state = 2.0 * env.dynamics.controller.scale, env.reset()["state"]  # [N], of each rotor
    fields = {k: x.tolist() for k, x in env.nominal.to(dtype=torch.float64).fields().items()}
    fields = {k: x[0] if len(x) == 1 else x for k, x in fields.items()}
    limits = {"body_rate": {"range": [[-1.0, 1.0]] * 3}, "thrust": {"range": [0.0, 1.0]}}  # of the other modes
    output = {"control": "rotor_thrusts", "gains": {}, **limits}
    rest = {"control_dt": DT, "plant": {}, "camera": None, "obstacles": None}
    contract = {"drone": fields, "output": output, **rest}
    if changed is None:
        simulator = simulator_class("mujoco")(contract, "contract", range(4))
    else:
        from benchmarks.adaptation import Changed

        simulator = Changed(contract, changed)
    names = ("position", "quaternion", "velocity", "angular_velocity")
    simulator.reset({k: state[k].double().numpy() for k in names})
    waiting = Rotors(env.nominal).thrust(env.dynamics.controller.hover_speed).expand(n, 4)

    def motion() -> Motion:
        position, *rest = (torch.tensor(simulator.state()[k], dtype=torch.float32) for k in names)
        return (position - state["target"], *rest)

    def step(told: Tensor) -> Motion:
        nonlocal waiting
        simulator.step(waiting.double().numpy())
        waiting = full * shares(pilot, told, env)
        return motion()

    return judge(pilot, motion(), step)


def l2f_drone(rng: np.random.Generator, about: dict[str, Any]) -> dict[str, Any]:
    """A drone of RAPTOR's sampler, as l2f takes it: its nominal one with other numbers."""
    dynamics, init = json.loads(json.dumps(about["dynamics"])), about["mdp"]["init"]
    mass = rng.uniform(0.02 ** (1 / 3), 5.0 ** (1 / 3)) ** 3
    thrust = rng.uniform(1.5, 5.0) * mass * 9.81 / 4
    deviation = rng.uniform(-0.1, 0.1)
    size = (mass / dynamics["mass"]) ** (1 / 3) * (1 + deviation if deviation > 0 else 1 / (1 - deviation))
    place = np.array(dynamics["rotor_positions"]) * size
    inertia = np.array(dynamics["J"])
    inertia *= 2**0.5 * abs(place[0, 0]) * thrust / rng.uniform(40.0, 1200.0) / inertia[0, 0]
    dynamics |= {
        "mass": mass, "rotor_positions": place.tolist(), "J": inertia.tolist(),
        "J_inv": np.linalg.inv(inertia).tolist(),
        "rotor_thrust_coefficients": [(CURVE * thrust / CURVE.sum()).tolist()] * 4,
        "rotor_torque_constants": [rng.uniform(0.005, 0.05)] * 4,
        "rotor_time_constants_rising": [rng.uniform(0.03, 0.1)] * 4,
        "rotor_time_constants_falling": [rng.uniform(0.03, 0.3)] * 4,
    }  # fmt: skip
    mdp = {**about["mdp"], "init": {**init, "max_position": 10 * np.linalg.norm(place[0])}}
    return {**about, "dynamics": dynamics, "mdp": mdp}


def in_l2f(pilot: Any, n: int) -> dict[str, float]:
    """On RAPTOR's distribution, in its own simulator."""
    import l2f

    vector, device, rng = getattr(l2f, f"vector{n}"), l2f.Device(), np.random.default_rng(0)
    draws, env, params = vector.VectorRng(), vector.VectorEnvironment(), vector.VectorParameters()
    state, after = vector.VectorState(), vector.VectorState()
    vector.initialize_rng(device, draws, 0)
    vector.initialize_environment(device, env)
    vector.initial_parameters(device, env, params)
    about = json.loads(l2f.parameters_to_json(device, env.environments[0], params.parameters[0]))
    for each in params.parameters:
        l2f.parameters_from_json(device, env.environments[0], json.dumps(l2f_drone(rng, about)), each)
    vector.sample_initial_state(device, env, params, state, draws)

    def motion() -> Motion:
        names = ("position", "orientation", "linear_velocity", "angular_velocity")
        return tuple(torch.tensor(np.array([getattr(x, name) for x in state.states])) for name in names)

    def step(told: Tensor) -> Motion:
        share = told.double().numpy()
        if not pilot.tells_speed:  # the speed that gives this share of the thrust
            c0, c1, c2 = CURVE
            root = c1**2 - 4 * c2 * (c0 - share * CURVE.sum())
            share = ((np.sqrt(np.maximum(root, c1**2)) - c1) / (2 * c2)).clip(0.0, 1.0)
        vector.step(device, env, params, state, (2.0 * share - 1.0).astype(np.float32), after, draws)
        state.assign(after)
        return motion()

    return judge(pilot, motion(), step, torch.tensor([[-5.0], [5.0]]))  # its drones start where a floor would be


SHIPPED = [name for name in available_drones() if load_drone(name).rotor_spin.shape == (4,)]
# By the drones that fly, and the name of the one if it is one.
ARENAS: dict[tuple[str, str], Callable[..., dict[str, float]]] = {
    ("any", ""): lambda pilot, n: in_ours(pilot, any_drone(n)),
    ("any, no delay", ""): lambda pilot, n: in_ours(pilot, any_drone(n, delay=0)),
    ("any, tilted by 1.2", ""): lambda pilot, n: in_ours(pilot, any_drone(n, tilt=1.2)),
    ("any, any attitude", ""): lambda pilot, n: in_ours(pilot, any_drone(n, tilt=math.pi)),
    ("l2f", ""): in_l2f,
    **{("shipped", x): lambda pilot, n, x=x: in_ours(pilot, shipped(n, x, delay=1)) for x in SHIPPED},
    **{("shipped, no delay", x): lambda pilot, n, x=x: in_ours(pilot, shipped(n, x, delay=0)) for x in SHIPPED},
    **{("mujoco", x): functools.partial(in_mujoco, name=x) for x in SHIPPED},
    **{("changed", str(x)): functools.partial(in_mujoco, name="visfly", changed=x) for x in range(10)},
}
WINDY = [  # trained in wind, and with a weak rotor and a centre of mass off the middle
    "env.wind={spread: [4,4,1], gust: 0.5}",
    "env.disturbances=[benchmarks.any_drone.Worn]",
    "critic.in_keys=[observation,[state,traits],[state,rotor_speed],[reward_terms,position],[state,wind],"
    "[state,drone,rotor_effectiveness]]",
    "critic.input_scale=[0.5,1.0,0.001,100.0,0.3,3.0]",
]
POLICIES = {
    "large": [],
    "small": ["actor.num_cells=[24]", "actor.hidden_size=24"],
    "tiny": ["actor.num_cells=[15]", "actor.hidden_size=15", "total_steps=55_296_000"],
    "recovers": ["env.random_start.tilt=3.14", "+env.weights.survival=0.2"],  # else seed 1 learns to crash
    "windy": WINDY,
    "raptor": [],
    "informed": [],
}
PILOTS = {"raptor": Raptor, "informed": Informed}  # that are not trained here
KEY = ("policy", "seed", "drones", "drone")


def table(rows: list[dict[str, str]]) -> str:
    """Give the table of the page, a row for each policy: means over seeds, and of several drones the worst."""
    arenas = [x for x in dict.fromkeys(key[0] for key in ARENAS) if x != "any, tilted by 1.2"]  # much as any
    lines = [f"| policy | numbers | seeds | {' | '.join(arenas)} |", "| --- |" + " --- |" * (len(arenas) + 2)]
    for policy in POLICIES:
        own = [x for x in rows if x["policy"] == policy]
        cells = [_cell([x for x in own if x["drones"] == drones]) for drones in arenas]
        if own:
            seeds = len({x["seed"] for x in own})
            lines.append(f"| {policy} | {own[0]['numbers']} | {seeds} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _cell(some: list[dict[str, str]]) -> str:
    means = [
        {name: np.mean([float(x[name]) for x in some if x["drone"] == drone]) for name in ("solved", "crash", "median")}
        for drone in {x["drone"] for x in some}
    ]
    if not means:
        return ""
    solved, (crash, error) = min(x["solved"] for x in means), (max(x[k] for x in means) for k in ("crash", "median"))
    return f"{solved:.1f}, {crash:.1f} %, {error:.1f} cm"


def main() -> None:
    options = {
        "seeds": [0],
        "policies": list(POLICIES),
        "drones": list(dict.fromkeys(key[0] for key in ARENAS)),
        "episodes": 2048,
    }
    more = {"cores": os.cpu_count() or 1, "runs": "outputs/any_drone", "overrides": [""]}
    args = command_line(__doc__, "any_drone.csv", **options, **more)
    done, ships = kept(args.output, *KEY), args.output.resolve() == (RESULTS / "any_drone.csv").resolve()

    def fly(policy: str, seed: int) -> None:
        missing = [x for x in ARENAS if x[0] in args.drones and (policy, str(seed), *x) not in done]
        if policy == "informed":  # of drones that tell all of themselves
            missing = [x for x in missing if x[0] in ("any", "any, tilted by 1.2", "any, any attitude")]
        if not missing:
            return
        folder, seconds = Path(args.runs, f"{policy}_{seed}"), ""
        if policy in PILOTS:
            pilot: Any = PILOTS[policy]()
        else:
            wanted = ["task=hovering", "tuned=shac_hovering_any", f"seed={seed}", *POLICIES[policy]]
            run("shac", [*wanted, *(x for x in args.overrides if x)], folder)
            seconds = f"{float(read_rows(folder / 'metrics.csv')[-1]['time/processor_seconds']):.0f}"
            pilot = Ours(folder / "checkpoint.pt")
        about = {"numbers": pilot.size, "seconds": seconds, "machine": machine(), "torch": torch.__version__}
        for arena in missing:
            n = min(args.episodes, 128) if arena[1] else args.episodes
            found = {name: round(x, 2) for name, x in ARENAS[arena](pilot, n).items()}
            add_rows(args.output, [dict(zip(KEY, (policy, seed, *arena), strict=True)) | found | about])
        if policy not in PILOTS and ("any", "") in missing:
            probe(pilot, args.episodes, PICTURE if ships and (policy, seed) == ("large", 0) else folder / "probe.png")

    jobs = [(fly, name, seed) for seed in args.seeds for name in args.policies if name not in PILOTS or seed == 0]
    side_by_side(args.cores, jobs)
    text = table(read_rows(args.output))
    print(text)
    publish(args.output, PAGE, text)


if __name__ == "__main__":
    main()
