/* An app of the Crazyflie: the policy of the task "$task" sends body rates and thrust. Generated. Untried on a drone.
 *
 * Make it with `make CRAZYFLIE_BASE=path/to/crazyflie-firmware` in this folder. Frames as in torchrl_quad.deploy.frames:
 * both have z up and x forward; pitch counts with the other sign; rates are in deg/s.
 */
#include "FreeRTOS.h"
#include "app.h"
#include "commander.h"
#include "log.h"
#include "param.h"
#include "task.h"

#include "pilot.h"

#define DEGREES 57.2957795f
#define FULL_THRUST $full_thrust /* N, of four motors at 65535 */

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
        setpoint.mode.roll = setpoint.mode.pitch = setpoint.mode.yaw = modeVelocity;
        setpoint.attitudeRate.roll = DEGREES * command[1];
        setpoint.attitudeRate.pitch = -DEGREES * command[2];
        setpoint.attitudeRate.yaw = DEGREES * command[3];
        setpoint.thrust = command[0] / FULL_THRUST * 65535.0f;
        if (setpoint.thrust > 60000.0f) setpoint.thrust = 60000.0f;
        commanderSetSetpoint(&setpoint, COMMANDER_PRIORITY_EXTRX);
    }
}
