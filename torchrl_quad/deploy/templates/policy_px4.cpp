/* For a PX4 module: the policy of the task "$task" as a setpoint ($control). Generated. Untried on a drone.
 *
 * Call it every POLICY_CONTROL_DT from the Run() of a module in offboard mode, with the newest messages, and publish what
 * it writes as $message. Ours are x east, y north, z up, and a body with y left; PX4's are NED and FRD.
 */
#include <cmath>

#include <uORB/topics/$message.h>
#include <uORB/topics/vehicle_angular_velocity.h>
#include <uORB/topics/vehicle_attitude.h>
#include <uORB/topics/vehicle_local_position.h>

#include "pilot.h"

bool policy_px4(pilot_t &pilot, const vehicle_local_position_s &local, const vehicle_attitude_s &attitude,
                const vehicle_angular_velocity_s &gyro, float hover_thrust, ${message}_s &setpoint)
{
    const float half = 0.707106781f, *q = attitude.q; /* the body from NED and FRD to ENU and FLU */
    const float position[3] = {local.y, local.x, -local.z}, velocity[3] = {local.vy, local.vx, -local.vz};
    const float quaternion[4] = {half * (q[0] + q[3]), half * (q[1] + q[2]), half * (q[1] - q[2]), half * (q[0] - q[3])};
    const float rate[3] = {gyro.xyz[0], -gyro.xyz[1], -gyro.xyz[2]};
    float command[POLICY_ACTION];

    const bool broken = pilot_step(&pilot, position, quaternion, velocity, rate, command) != 0;
    setpoint = {};
    setpoint.timestamp = attitude.timestamp;
@rates     setpoint.roll = command[1], setpoint.pitch = -command[2], setpoint.yaw = -command[3];
@attitude     /* Turned by roll, then by pitch, then to the heading that the drone has. */
@attitude     const float heading = std::atan2(2.0f * (q[0] * q[3] + q[1] * q[2]), 1.0f - 2.0f * (q[2] * q[2] + q[3] * q[3]));
@attitude     const float sr = std::sin(0.5f * command[1]), sp = std::sin(-0.5f * command[2]), sy = std::sin(0.5f * heading);
@attitude     const float cr = std::cos(0.5f * command[1]), cp = std::cos(0.5f * command[2]), cy = std::cos(0.5f * heading);
@attitude     setpoint.q_d[0] = cy * cp * cr + sy * sp * sr, setpoint.q_d[1] = cy * cp * sr - sy * sp * cr;
@attitude     setpoint.q_d[2] = cy * sp * cr + sy * cp * sr, setpoint.q_d[3] = sy * cp * cr - cy * sp * sr;
@attitude     setpoint.yaw_sp_move_rate = -command[3];
@velocity     const float ned[3] = {command[1], command[0], -command[2]}; /* NAN: not commanded */
@velocity     for (int i = 0; i < 3; ++i) setpoint.velocity[i] = ned[i], setpoint.position[i] = setpoint.acceleration[i] = NAN;
@velocity     setpoint.yaw = NAN, (void)hover_thrust;
@velocity     setpoint.yawspeed = -command[3];
@thrust     setpoint.thrust_body[2] = std::fmax(-command[0] / ($weight / hover_thrust), -1.0f); /* MPC_THR_HOVER */
    return !broken;
}

void policy_px4_start(pilot_t &pilot) { pilot_start(&pilot); }
