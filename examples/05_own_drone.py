"""Your own drone is a mapping of sixteen fields. A mistyped one is refused, with the allowed values."""

from torchrl_quad import HoveringEnv

STEPS = 50

# A camera drone of 1.8 kg: four times the mass of visfly, forty times the inertia, slow rotors. SI units throughout.
camera_drone = {
    "mass": 1.8,
    "inertia": [0.030, 0.034, 0.055],
    "rotor_positions": [[0.16, 0.16], [-0.16, 0.16], [-0.16, -0.16], [0.16, -0.16]],  # x forward, y left
    "rotor_spin": [1, -1, 1, -1],
    "yaw_torque_coefficient": 0.02,
    "thrust_map": [1.0e-5, 0.0, 0.0],  # thrust [N] = 1e-5 w^2, w in rad/s
    "rotor_speed_min": 100.0,
    "rotor_speed_max": 1150.0,
    "motor_time_constant": 0.06,
    "linear_drag": [0.05, 0.05, 0.05],
    "quadratic_drag": [0.02, 0.02, 0.05],
    "rate_gain": [15.0, 15.0, 6.0],
    "rate_damping": [0.0, 0.0, 0.0],
    "max_body_rate": [2.0, 2.0, 1.0],
    "max_thrust_to_weight": 2.5,
    "gravity": 9.81,
}


def fly(env, action):
    """The flight (1, STEPS) of a drone under a constant action."""
    return env.rollout(STEPS, lambda td: td.set("action", action.expand(1, 4)))


print("drone    hover thrust [N]  rotors [rad/s]  sinks in 1 s [m]  roll rate after 0.1 s [rad/s], 1.0 commanded")
for name, drone in (("visfly", "visfly"), ("camera", camera_drone)):
    env = HoveringEnv(num_envs=1, drone=drone)
    hover = fly(env, env.hover_action)
    sunk = (hover["state", "position"][0, 0, 2] - hover["next", "state", "position"][0, -1, 2]).item()
    rolling = env.hover_action.clone()
    rolling[1] = 1.0 / env.nominal.max_body_rate[0]
    rate = fly(env, rolling)["next", "state", "angular_velocity"][0, :5, 0][-1]
    thrust, speed = (env.params.mass * env.params.gravity).item(), hover["state", "rotor_speed"][0, 0, 0]
    print(f"{name:7} {thrust:17.2f} {speed:15.0f} {sunk:17.3f} {rate:12.2f}")

# A wrong drone is refused when it is built, not when it crashes.
for mistake in ({"mas": 1.8}, {"mass": -1.8}, {"inertia": [0.03, 0.055]}):
    try:
        HoveringEnv(num_envs=1, drone={**camera_drone, **mistake})
    except ValueError as error:
        print(f"\n{mistake}\n  {error}")
