"""Fit a drone to a real flight of a Crazyflie, see what it predicts better than before, and draw drones to train on."""

from pathlib import Path

import torchrl_quad
from torchrl_quad import HoveringEnv, load_drone
from torchrl_quad.identification import identify, prediction_error, read_log

ITERATIONS = 30

# 19 s in figures of eight; the folder names their source and licence.
log = read_log(Path(torchrl_quad.__file__).parents[1] / "examples/data/figure8.csv.gz")
print(log)

# A guess: little drag, which acts at the centre of mass, the inertia of the bare drone, and a thrust that rotors reach.
guess = load_drone("crazyflie").replace(
    inertia=[1.4e-5, 1.4e-5, 2.17e-5], linear_drag=[1e-3, 1e-3, 1e-3], drag_height=0.0, max_thrust_to_weight=1.7
)
# Motion tells only ratios to the mass, so weigh the drone. What the flight does not tell keeps the value of the guess.
wanted = ["thrust_map", "linear_drag", "drag_height", "inertia", "command_delay", "stream_delay"]
result = identify(log, guess, {"mass": 0.027}, wanted, iterations=ITERATIONS)
print(result)

print("\nerror of predictions over half a second, from motor commands only")
for name, drone in (("constant velocity", "constant_velocity"), ("guess", guess), ("fitted", result)):
    errors = prediction_error(log, drone)
    print(f"{name:18}", ", ".join(f"{quantity} {errors[quantity][0.5]:.3f}" for quantity in errors))

folder = result.save("outputs/figure8", pictures=False)
env = HoveringEnv(num_envs=2, drone=folder / "drone.yaml", randomize=folder / "randomization.yaml")
print("\ntwo drones to train on, their inertia:", env.reset()["state", "drone", "inertia"].tolist())
