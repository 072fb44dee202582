/* The policy of the task "$task". Generated: change nothing here, export it again instead.
 *
 * C99, without dependencies but math.h, without malloc, without state.
 */
#include "policy.h"

#include <math.h>

#define WIDTH $width /* of the widest layer */
#define VECTORS $vectors

const float policy_hover_action[POLICY_ACTION] = {$hover_action};

/* Weights: one row for each input of the layer. */
$weights

$activations

static void sum(const float *weight, const float *bias, int inputs, const float *x, int outputs, float *y)
{
    for (int j = 0; j < outputs; ++j) y[j] = bias[j];
    for (int i = 0; i < inputs; ++i)
        for (int j = 0; j < outputs; ++j) y[j] += weight[i * outputs + j] * x[i];
}

int policy_action(const float observation[POLICY_OBSERVATION], float action[POLICY_ACTION])
{
    const float limit = $limit;
    float one[WIDTH], two[WIDTH];
    int broken = 0;

    (void)one;
    (void)two;
    /* A layer may turn NaN into a number, and saturate infinity. */
    for (int i = 0; i < POLICY_OBSERVATION; ++i)
        if (!isfinite(observation[i])) broken = 1;
$layers
    for (int i = 0; i < POLICY_ACTION; ++i) {
        if (!isfinite(action[i])) broken = 1;
        if (action[i] > limit) action[i] = limit;
        if (action[i] < -limit) action[i] = -limit;
    }
    for (int i = 0; broken && i < POLICY_ACTION; ++i) action[i] = policy_hover_action[i];
    return broken;
}

void policy_command(const float action[POLICY_ACTION], float *thrust, float body_rate[3])
{
    static const float max_rate[3] = {$max_rates};

    *thrust = 0.5f * (action[0] + 1.0f) * $max_thrust;
    for (int i = 0; i < 3; ++i) body_rate[i] = action[i + 1] * max_rate[i];
}

static const float test_observation[VECTORS * POLICY_OBSERVATION] = {
$test_observation
};
static const float test_action[VECTORS * POLICY_ACTION] = {
$test_action
};

float policy_self_test(void)
{
    float worst = 0.0f;

    for (int n = 0; n < VECTORS; ++n) {
        float action[POLICY_ACTION];
        if (policy_action(test_observation + n * POLICY_OBSERVATION, action) != 0) return 1e30f;
        for (int i = 0; i < POLICY_ACTION; ++i) {
            const float error = fabsf(action[i] - test_action[n * POLICY_ACTION + i]);
            if (!(error <= worst)) worst = error;
        }
    }
    return worst;
}
