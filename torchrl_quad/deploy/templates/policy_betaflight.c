/* For Betaflight: the policy of the task "$task" as four channels of a receiver, in acro mode. Generated. Untried.
 *
 * Betaflight estimates no position: state comes from outside. Call policyUpdate every POLICY_CONTROL_DT, and let the
 * receiver's rcReadRawFn be policyReadRawRC, channels AETR. Set it up with betaflight.txt of the bundle.
 */
#include <math.h>

#include "rx/rx.h"

#include "pilot.h"

#define FULL_STICK $stick /* rad/s */
#define MIN_CHECK $min_check
#define IDLE $idle /* the signal of motors at the least throttle */

static pilot_t pilot;
static float channels[4] = {1500.0f, 1500.0f, 1000.0f, 1500.0f};

void policyStart(void) { pilot_start(&pilot); }

int policyUpdate(const float position[3], const float quaternion[4], const float velocity[3], const float body_rate[3])
{
    const float curve = $curve; /* f of the thrust full (f s^2 + (1 - f) s) of a signal s */
    float command[POLICY_ACTION];
    const int broken = pilot_step(&pilot, position, quaternion, velocity, body_rate, command);

    const float share = fminf(command[0] / $full_curve, 1.0f);
    const float root = sqrtf((1.0f - curve) * (1.0f - curve) + 4.0f * curve * share);
    const float signal = 2.0f * share / fmaxf(1.0f - curve + root, 1e-6f);

    for (int i = 0; i < 2; ++i) channels[i] = 1500.0f + 500.0f * command[i + 1] / FULL_STICK;
    channels[3] = 1500.0f - 500.0f * command[3] / FULL_STICK; /* yaw to the right is positive */
    channels[2] = MIN_CHECK + (2000.0f - MIN_CHECK) * fmaxf(signal - IDLE, 0.0f) / (1.0f - IDLE);
    return broken;
}

float policyReadRawRC(const rxRuntimeState_t *state, uint8_t channel)
{
    (void)state;
    return channel < 4 ? channels[channel] : 1500.0f;
}
