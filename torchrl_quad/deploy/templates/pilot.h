/* What the policy of the task "$task" keeps between two calls, in the conventions of policy.h. Generated. */
#include "policy.h"

#include <string.h>

typedef struct {
    float quaternion[4]; /* the last one, whose sign the next one continues */
@memory     float memory[POLICY_MEMORY];
} pilot_t;

static void pilot_start(pilot_t *pilot)
{
    memset(pilot, 0, sizeof *pilot);
    pilot->quaternion[0] = 1.0f;
}

@aims /* Where to fly, m, world frame: yours to change before a flight. */
@aims static float pilot_target[3] = {$target};
@aims
@aims static void pilot_observe(const float position[3], const float quaternion[4], const float velocity[3],
@aims                           const float body_rate[3], float observation[POLICY_OBSERVATION])
@aims {
@aims     for (int i = 0; i < 3; ++i) observation[i] = pilot_target[i] - position[i];
@aims     for (int i = 0; i < 4; ++i) observation[3 + i] = 10.0f * quaternion[i];
@aims     for (int i = 0; i < 3; ++i) observation[7 + i] = velocity[i], observation[10 + i] = body_rate[i];
@aims }
@yours /* Write this function by task.documentation and task.constants of contract.json, and check it against observe.onnx. */
@yours void pilot_observe(const float position[3], const float quaternion[4], const float velocity[3],
@yours                    const float body_rate[3], float observation[POLICY_OBSERVATION]);

/* The command for a state; call it every POLICY_CONTROL_DT. Returns 1, and commands hover, where the state is not finite. */
static int pilot_step(pilot_t *pilot, const float position[3], const float quaternion[4], const float velocity[3],
                      const float body_rate[3], float command[POLICY_ACTION])
{
    float observation[POLICY_OBSERVATION], action[POLICY_ACTION], along = 0.0f;

    for (int i = 0; i < 4; ++i) along += quaternion[i] * pilot->quaternion[i];
    for (int i = 0; i < 4; ++i) pilot->quaternion[i] = along < 0.0f ? -quaternion[i] : quaternion[i];
    pilot_observe(position, pilot->quaternion, velocity, body_rate, observation);
    const int broken = policy_action(observation,$memory action);
    if (broken) pilot->quaternion[0] = 1.0f, memset(pilot->quaternion + 1, 0, 3 * sizeof(float));
    policy_command(action, command);
    return broken;
}
