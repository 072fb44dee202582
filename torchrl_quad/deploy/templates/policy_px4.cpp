/* For a PX4 module: the policy of the task "$task" as a setpoint of body rates. Generated. Untried on a drone.
 *
 * Call it every POLICY_CONTROL_DT from the Run() of a module in offboard mode, with the newest messages, and publish what
 * it writes as vehicle_rates_setpoint. Ours are x east, y north, z up, and a body with y left; PX4's are NED and FRD.
 */
#include <uORB/topics/vehicle_angular_velocity.h>
#include <uORB/topics/vehicle_attitude.h>
#include <uORB/topics/vehicle_local_position.h>
#include <uORB/topics/vehicle_rates_setpoint.h>

#include "pilot.h"

bool policy_px4(pilot_t &pilot, const vehicle_local_position_s &local, const vehicle_attitude_s &attitude,
                const vehicle_angular_velocity_s &gyro, float hover_thrust, vehicle_rates_setpoint_s &setpoint)
{
    const float half = 0.707106781f, *q = attitude.q; /* the body from NED and FRD to ENU and FLU */
    const float position[3] = {local.y, local.x, -local.z}, velocity[3] = {local.vy, local.vx, -local.vz};
    const float quaternion[4] = {half * (q[0] + q[3]), half * (q[1] + q[2]), half * (q[1] - q[2]), half * (q[0] - q[3])};
    const float rate[3] = {gyro.xyz[0], -gyro.xyz[1], -gyro.xyz[2]};
    float command[POLICY_ACTION];

    const bool broken = pilot_step(&pilot, position, quaternion, velocity, rate, command) != 0;
    setpoint = {};
    setpoint.timestamp = attitude.timestamp;
    setpoint.roll = command[1];
    setpoint.pitch = -command[2];
    setpoint.yaw = -command[3];
    setpoint.thrust_body[2] = -command[0] / ($weight / hover_thrust); /* MPC_THR_HOVER */
    if (setpoint.thrust_body[2] < -1.0f) setpoint.thrust_body[2] = -1.0f;
    return !broken;
}

void policy_px4_start(pilot_t &pilot) { pilot_start(&pilot); }
