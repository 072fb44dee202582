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

@depth /* Kernels of 3 x 3 on every other pixel of every other row; beyond the edge is 0. */
@depth static void convolve(const float *weight, const float *bias, int inputs, int height, int width, const float *x,
@depth                      int outputs, float *y)
@depth {
@depth     for (int j = 0; j < outputs; ++j)
@depth         for (int row = 0; row < height; row += 2)
@depth             for (int column = 0; column < width; column += 2) {
@depth                 float total = bias[j];
@depth                 for (int i = 0; i < inputs; ++i) {
@depth                     const float *kernel = weight + 9 * (j * inputs + i);
@depth                     for (int r = row == 0; r < 3 && row + r <= height; ++r)
@depth                         for (int c = column == 0; c < 3 && column + c <= width; ++c)
@depth                             total += kernel[3 * r + c] * x[(i * height + row + r - 1) * width + column + c - 1];
@depth                 }
@depth                 *y++ = total;
@depth             }
@depth }
@depth
@memory static float gate(float x) { return 1.0f / (1.0f + expf(-x)); }
@memory
@memory /* A gated recurrent unit: gates that reset and update, then the new value. */
@memory static void remember(const float *weight, const float *bias, const float *own_weight, const float *own_bias,
@memory                      int inputs, const float *x, const float *memory, float *next)
@memory {
@memory     float read[3 * POLICY_MEMORY], own[3 * POLICY_MEMORY];
@memory
@memory     sum(weight, bias, inputs, x, 3 * POLICY_MEMORY, read);
@memory     sum(own_weight, own_bias, POLICY_MEMORY, memory, 3 * POLICY_MEMORY, own);
@memory     for (int i = 0; i < POLICY_MEMORY; ++i) {
@memory         const float reset = gate(read[i] + own[i]);
@memory         const float update = gate(read[POLICY_MEMORY + i] + own[POLICY_MEMORY + i]);
@memory         const float value = tanhf(read[2 * POLICY_MEMORY + i] + reset * own[2 * POLICY_MEMORY + i]);
@memory         next[i] = value + update * (memory[i] - value);
@memory     }
@memory }
@memory
int policy_action(const float observation[POLICY_OBSERVATION],$parameters float action[POLICY_ACTION])
{
    const float limit = $limit;
    float one[WIDTH], two[WIDTH];
@depth     float features[$features + POLICY_OBSERVATION];
@memory     float recalled[$recalled], *next = recalled + $recalled - POLICY_MEMORY;
    int broken = 0;

    (void)one;
    (void)two;
    /* A layer may turn NaN into a number, and saturate infinity. */
    for (int i = 0; i < POLICY_OBSERVATION; ++i)
        if (!isfinite(observation[i])) broken = 1;
@depth     for (int i = 0; i < POLICY_DEPTH; ++i)
@depth         if (!isfinite(depth[i])) broken = 1;
@memory     for (int i = 0; i < POLICY_MEMORY; ++i)
@memory         if (!isfinite(memory[i])) broken = 1;
$layers
@memory     for (int i = 0; i < POLICY_MEMORY; ++i)
@memory         if (!isfinite(next[i])) broken = 1;
    for (int i = 0; i < POLICY_ACTION; ++i) {
        if (!isfinite(action[i])) broken = 1;
        if (action[i] > limit) action[i] = limit;
        if (action[i] < -limit) action[i] = -limit;
    }
    for (int i = 0; broken && i < POLICY_ACTION; ++i) action[i] = policy_hover_action[i];
@memory     for (int i = 0; !broken && i < POLICY_MEMORY; ++i) memory[i] = next[i];
    return broken;
}

void policy_command(const float action[POLICY_ACTION], float command[POLICY_ACTION])
{
    static const float middle[POLICY_ACTION] = {$middle};
    static const float half[POLICY_ACTION] = {$half};

    for (int i = 0; i < POLICY_ACTION; ++i) command[i] = middle[i] + half[i] * action[i];
}

@rotors void policy_signal(const float command[POLICY_ACTION], float signal[POLICY_ACTION])
@rotors {
@rotors     for (int i = 0; i < POLICY_ACTION; ++i) {
@rotors         const float thrust = fminf(fmaxf(command[i], $least), $most);
@rotors         const float share = $signal_0 + $per_speed * sqrtf(fmaxf((thrust - $thrust_0) * $bend, 0.0f));
@rotors         signal[i] = fminf(fmaxf(share, 0.0f), 1.0f);
@rotors     }
@rotors }
@rotors

static const float test_observation[VECTORS * POLICY_OBSERVATION] = {
$test_observation
};
@depth static const float test_depth[VECTORS * POLICY_DEPTH] = {
@depth $test_depth
@depth };
@memory static const float test_memory[VECTORS * POLICY_MEMORY] = {
@memory $test_memory
@memory };
@memory static const float test_next_memory[VECTORS * POLICY_MEMORY] = {
@memory $test_next_memory
@memory };
static const float test_action[VECTORS * POLICY_ACTION] = {
$test_action
};

float policy_self_test(void)
{
    float worst = 0.0f;

    for (int n = 0; n < VECTORS; ++n) {
        float action[POLICY_ACTION];
@memory         float memory[POLICY_MEMORY];
@memory         for (int i = 0; i < POLICY_MEMORY; ++i) memory[i] = test_memory[n * POLICY_MEMORY + i];
        if (policy_action(test_observation + n * POLICY_OBSERVATION$arguments, action) != 0) return 1e30f;
        for (int i = 0; i < POLICY_ACTION; ++i) {
            const float error = fabsf(action[i] - test_action[n * POLICY_ACTION + i]);
            if (!(error <= worst)) worst = error;
        }
@memory         for (int i = 0; i < POLICY_MEMORY; ++i) {
@memory             const float error = fabsf(memory[i] - test_next_memory[n * POLICY_MEMORY + i]);
@memory             if (!(error <= worst)) worst = error;
@memory         }
    }
    return worst;
}
