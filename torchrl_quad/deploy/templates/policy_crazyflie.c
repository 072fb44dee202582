/* An app of the Crazyflie: the policy of the task "$task" commands $control. Generated. Untried on a drone.
 *
 * Make it with `make CRAZYFLIE_BASE=path/to/crazyflie-firmware` in this folder. Frames as in torchrl_quad.deploy.frames:
 * both have z up and x forward; pitch counts with the other sign; angles are in degrees. The firmware turns a wanted yaw
 * angle at the rate of yaw, and follows that angle.
@velocity  * It reaches velocities by loops of its own (velCtlPid), with 20 degrees of tilt at most, and not by those of the training.
 */
#include <math.h>

#include "FreeRTOS.h"
#include "app.h"
#include "commander.h"
#include "log.h"
#include "param.h"
#include "task.h"

#include "pilot.h"

#define DEGREES 57.2957795f
@thrust #define FULL_THRUST $full_thrust /* N, of four motors at 65535 */

static uint8_t flies; /* the parameter policy.flies: 1 lets the policy fly, 0 lets go */

PARAM_GROUP_START(policy)
PARAM_ADD(PARAM_UINT8, flies, &flies)
PARAM_GROUP_STOP(policy)

static void read_logs(const char *group, const char *const names[], int count, float scale, float x[])
{
    for (int i = 0; i < count; ++i) x[i] = scale * logGetFloat(logGetVarId(group, names[i]));
}

void appMain(void)
{
    static const char *const at[] = {"x", "y", "z"}, *const speed[] = {"vx", "vy", "vz"};
    static const char *const attitude[] = {"qw", "qx", "qy", "qz"};
    pilot_t pilot;
    TickType_t now = xTaskGetTickCount();

    while (policy_self_test() > 1e-5f) vTaskDelay(M2T(1000)); /* never flies */
    for (;;) {
        float position[3], quaternion[4], velocity[3], rate[3], command[POLICY_ACTION];
        setpoint_t setpoint;

        vTaskDelayUntil(&now, M2T($period));
        if (!flies) {
            pilot_start(&pilot);
            continue;
        }
        read_logs("stateEstimate", at, 3, 1.0f, position);
        read_logs("stateEstimate", attitude, 4, 1.0f, quaternion);
        read_logs("stateEstimate", speed, 3, 1.0f, velocity);
        read_logs("gyro", at, 3, 1.0f / DEGREES, rate);
        if (pilot_step(&pilot, position, quaternion, velocity, rate, command)) flies = 0;
        memset(&setpoint, 0, sizeof setpoint);
        setpoint.mode.yaw = modeVelocity;
        setpoint.attitudeRate.yaw = DEGREES * command[3];
@rates         setpoint.mode.roll = setpoint.mode.pitch = modeVelocity;
@rates         setpoint.attitudeRate.roll = DEGREES * command[1], setpoint.attitudeRate.pitch = -DEGREES * command[2];
@attitude         setpoint.mode.roll = setpoint.mode.pitch = modeAbs;
@attitude         setpoint.attitude.roll = DEGREES * command[1], setpoint.attitude.pitch = -DEGREES * command[2];
@velocity         setpoint.mode.x = setpoint.mode.y = setpoint.mode.z = modeVelocity; /* in the world frame */
@velocity         setpoint.velocity.x = command[0], setpoint.velocity.y = command[1], setpoint.velocity.z = command[2];
@thrust         setpoint.thrust = fminf(command[0] / FULL_THRUST * 65535.0f, 60000.0f);
        commanderSetSetpoint(&setpoint, COMMANDER_PRIORITY_EXTRX);
    }
}
