/* For Betaflight: the policy of the task "$task" as four channels of a receiver, in acro mode. Generated. Untried.
 *
 * Betaflight estimates no position: state comes from outside. Call policyUpdate every POLICY_CONTROL_DT, and let the
 * receiver's rcReadRawFn be policyReadRawRC, channels AETR. Rates: linear, $stick deg/s at full stick; min_check=1000.
 */
#include "rx/rx.h"

#include "pilot.h"

#define FULL_THRUST $full_thrust /* N, of all motors at 2000 us */

static pilot_t pilot;
static float channels[4] = {1500.0f, 1500.0f, 1000.0f, 1500.0f};

void policyStart(void) { pilot_start(&pilot); }

int policyUpdate(const float position[3], const float quaternion[4], const float velocity[3], const float body_rate[3])
{
    static const float most[3] = {$max_rates}; /* rad/s at full stick: roll, pitch, yaw */
    float command[POLICY_ACTION];
    const int broken = pilot_step(&pilot, position, quaternion, velocity, body_rate, command);

    channels[0] = 1500.0f + 500.0f * command[1] / most[0];
    channels[1] = 1500.0f + 500.0f * command[2] / most[1];
    channels[3] = 1500.0f - 500.0f * command[3] / most[2]; /* yaw to the right is positive */
    channels[2] = 1000.0f + 1000.0f * (command[0] < FULL_THRUST ? command[0] / FULL_THRUST : 1.0f);
    return broken;
}

float policyReadRawRC(const rxRuntimeState_t *state, uint8_t channel)
{
    (void)state;
    return channel < 4 ? channels[channel] : 1500.0f;
}
