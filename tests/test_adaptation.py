"""From seconds of flight to a better policy: flights whose truth is known, and what must change nothing."""

import dataclasses

import numpy as np
import pytest
import torch
from helpers import SMALL, cases, refuses
from log_writers import OURS, write_csv

from benchmarks import adaptation as benchmark
from torchrl_quad import GeometricController, HoveringEnv, make_actor, make_visual_actor
from torchrl_quad.adaptation import Adapter, adapt, fit_flight, simulated_log
from torchrl_quad.adaptation.fit import wind_at
from torchrl_quad.deploy import load_bundle
from torchrl_quad.dynamics import MotorCommand
from torchrl_quad.files import read_rows
from torchrl_quad.training.checkpoints import read_checkpoint

GIVES, WIND, DT = [0.9, 0.7, 0.8, 0.85], (4.0, -2.0, 0.0), 0.01
MOTORS = MotorCommand(3500.0, 1.0)
BRIEF = {"steps": 3, "num_envs": 4, "horizon": 8}


def flown(gives, wind, seconds):
    """A log of a drone that swings about its target, in our own simulator."""
    steps = round(seconds / DT)
    fixed = {"dtype": torch.float64, "dt": DT, "control_dt": DT, "action_delay": 0, "max_episode_steps": 10_000}
    env = HoveringEnv(num_envs=1, wind={"mean": wind}, **fixed)
    env.set_params(env.params.replace(rotor_effectiveness=gives))

    def swings(state, t):
        now = DT * state["step"] + t
        return state["target"].unsqueeze(1) + torch.stack((now.sin(), (1.7 * now).sin(), 0.3 * (2.0 * now).sin()), -1)

    with torch.no_grad():
        flight = env.rollout(steps, GeometricController(env, reference=swings, heading=0.0))
    return simulated_log(flight, env)


@pytest.fixture(scope="module")
def log():
    return flown(GIVES, WIND, 4.0)


@pytest.fixture
def hovering():
    return HoveringEnv(num_envs=4, max_episode_steps=20, control_dt=0.02, dt=0.01)


def test_a_fit_finds_each_rotor_and_the_wind_of_a_flight_and_predicts_what_was_held_out(log, hovering):
    fit = fit_flight([log], hovering.params, MOTORS)
    assert (fit.fields(fit.mean)["rotor_effectiveness"] - torch.tensor(GIVES)).abs().max() < 0.01
    missed = (fit.mean[7:9] - torch.tensor(WIND[:2])).abs()
    assert (missed < 3.0 * fit.spread()[7:9]).all() and (missed < 0.5).all()
    assert fit.gain > 0.95 and fit.after["angular_acceleration"] < 0.1 * fit.before["angular_acceleration"]


def test_wind_grows_with_height_as_far_as_the_drone_has_flown():
    air = torch.tensor([3.0, 0.0, 0.5, -1.0, 2.0, 1.0])  # 3 m/s along x at 2 m, flown from 1 to 3 m
    heights = torch.tensor([[0.0, 0.0, 2.5], [0.0, 0.0, 9.0], [0.0, 0.0, 0.0]])
    expected = [[3.25, -0.5, 0.0], [3.5, -1.0, 0.0], [2.5, 1.0, 0.0]]
    assert wind_at(air.expand(3, 6), heights).tolist() == expected


@cases(("rates", False), ("attitude", True))
def test_a_policy_changes_within_its_bound_and_only_for_a_greater_return(control, recurrent, log):
    env = HoveringEnv(num_envs=4, max_episode_steps=20, control=control)
    actor = make_actor(env, recurrent=recurrent)
    before = {name: x.clone() for name, x in actor.state_dict().items()}
    adapter = Adapter(actor, env, MOTORS, max_kl=0.02, lr=0.02, **BRIEF)
    found = adapter(log)
    assert found.changed and found.after["return"] > found.before["return"]
    assert 0.0 < found.kl < 0.03  # a mean over other states than those that bounded it
    assert all((x == before[name]).all() for name, x in actor.state_dict().items())
    assert any((x != before[name]).any() for name, x in found.policy.state_dict().items())
    assert adapter(log).before["return"] == pytest.approx(found.after["return"], rel=1e-5)  # it flies on from there


def thrown(log):
    """With accelerations that no rotor made."""
    shaken = log.velocity + 2.0 * np.sin(9.0 * log.time)[:, None]
    return dataclasses.replace(log, velocity=shaken)


@cases(
    (lambda log: dataclasses.replace(log, motor_command=0.0 * log.motor_command), "not tell what each rotor gives"),
    (lambda log: dataclasses.replace(log, segments=((0, 60),)), "no piece of the flight is"),
    (lambda log: flown([1.0] * 4, (0.0, 0.0, 0.0), 2.0), "predicts what was held out no better than"),
    (lambda log: dataclasses.replace(log, motor_command=0.7 * log.motor_command), "all rotors together would give 1."),
    (lambda log: [log, flown([1.0] * 4, WIND, 2.0)], "does not agree with the others"),
    (lambda log: [log, flown(GIVES, (-4.0, 2.0, 0.0), 4.0)], "does not agree with the others"),
    (thrown, "the fit still misses the acceleration by"),
    ids=["silent", "short", "as expected", "other commands", "two drones", "two winds", "thrown"],
)
def test_a_flight_that_tells_nothing_changes_nothing_and_says_why(change, why, log, hovering):
    actor = make_actor(hovering)
    found = adapt(actor, hovering, change(log), motors=MOTORS, **BRIEF)
    assert not found.changed and why in found.reason and found.kl == 0.0
    assert all((x == found.policy.state_dict()[name]).all() for name, x in actor.state_dict().items())


def test_a_policy_that_no_step_improves_stays(log, hovering, monkeypatch):
    monkeypatch.setattr("torchrl_quad.adaptation.adapting._score", lambda flight: 1.0)
    found = adapt(make_actor(hovering), hovering, log, motors=MOTORS, **BRIEF)
    assert not found.changed and "no step made the policy better" in found.reason
    monkeypatch.undo()
    rising = iter([{"return": 1.0, "crash": 1.0}, {"return": 2.0, "crash": 1.0}])
    monkeypatch.setattr(Adapter, "_measure", lambda self, flight: next(rising))
    found = adapt(make_actor(hovering), hovering, [log, log], motors=MOTORS, **BRIEF)  # which agree
    assert not found.changed and "the new policy crashes in 100% of the episodes" in found.reason


def test_what_cannot_be_adapted_is_refused_by_name(hovering):
    actor = make_actor(hovering)
    refuses("PointMass has no rotors", Adapter, actor, HoveringEnv(num_envs=2, dynamics="point_mass"))
    any_drone = HoveringEnv(num_envs=2, randomize="any", control="rotor_thrusts")
    refuses("for any drone", Adapter, actor, any_drone, MOTORS)
    refuses("no motor_command", Adapter, actor, hovering)
    refuses("motors must be a MotorCommand, not str", Adapter, actor, hovering, "fast", error=TypeError)
    refuses("GeometricController is no policy", Adapter, GeometricController(hovering), hovering, error=TypeError)
    refuses("must be a QuadrotorEnv", Adapter, actor, None, MOTORS, error=TypeError)
    seeing = HoveringEnv(num_envs=2, camera={"width": 4, "height": 3})
    refuses("reads images", Adapter, make_visual_actor(seeing, channels=[2]), seeing, MOTORS)


def test_the_recipe_writes_a_policy_a_bundle_and_a_page_and_leaves_the_checkpoint_alone(
    log, launch, refused, no_pictures, tmp_path, trace_once
):
    trace_once("hovering")
    launch("bptt", *SMALL, f"hydra.run.dir={tmp_path}", "task=hovering", "env.max_episode_steps=48")
    checkpoint, columns = tmp_path / "checkpoint.pt", {"t": log.time}
    for quantity in ("position", "quaternion", "velocity", "angular_velocity", "motor_command"):
        columns |= dict(zip(OURS[quantity], getattr(log, quantity).T, strict=True))
    csv, old = write_csv(tmp_path / "swing.csv", columns), checkpoint.read_bytes()
    named = ", ".join(f"{q}: [{', '.join(OURS[q])}]" for q in OURS if q != "acceleration")
    settings = ["steps=3", "num_envs=4", "compile=false", "motor_command={speed_per_volt: 3500, nominal_voltage: 1}"]
    arguments = f"checkpoint={checkpoint}", f"logs=[{csv}]", f"columns={{time: t, {named}}}", *settings
    folder, said = tmp_path / "adapted", launch("adapt", *arguments)
    assert "swing: " in said and "the return in the fitted simulator rose" in said
    assert "adapted holds checkpoint.pt, policy already. Choose another folder" in refused("adapt", *arguments)
    assert " config.yaml" in refused("adapt", *arguments, f"folder={tmp_path}")
    assert {x.name for x in folder.iterdir()} == {"checkpoint.pt", "policy", "report.html"}
    assert checkpoint.read_bytes() == old
    new = read_checkpoint(folder / "checkpoint.pt")["best"]["actor"]
    assert any((x != new[name]).any() for name, x in read_checkpoint(checkpoint)["best"]["actor"].items())
    page = (folder / "report.html").read_text()
    assert "What is not covered" in page and page.count("data:image/png") == 2 and "http" not in page
    bundle = load_bundle(folder / "policy")
    np.testing.assert_allclose(bundle.contract["plant"]["rotor_effectiveness"], GIVES, atol=0.05)
    assert "an adapted policy, and no run to continue" in refused("bptt", f"resume={folder}/checkpoint.pt")
    flight, world = benchmark.fly(bundle, 3, 0, 1)  # the bundle meets what the benchmark does
    steps = int(flight["done"][0].argmax()) + 1
    assert len(world.samples) == 20 * steps == benchmark.LOGGED * len(world.log(0).time)


@pytest.mark.slow
def test_the_benchmark_flies_every_policy_in_mujoco_and_flies_no_row_twice(launch, tmp_path, monkeypatch):
    launch("bptt", *SMALL, f"hydra.run.dir={tmp_path}", "task=hovering")
    arguments = ["", "--base", f"{tmp_path}/checkpoint.pt", "--seeds", "3", "--output", f"{tmp_path}/table.csv"]
    monkeypatch.setattr("sys.argv", arguments)
    for _ in range(2):
        benchmark.main()
        rows = read_rows(tmp_path / "table.csv")
        assert [(row["policy"], row["seed"]) for row in rows] == [(x, "3") for x in ("base", "integral", "adapted")]
