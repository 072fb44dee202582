/* The policy of the task "$task". Generated: change nothing here, export it again instead.
 *
 * contract.json says what each number means, in which unit, frame and order; README.md says how to fly it.
 */
#ifndef POLICY_H
#define POLICY_H

#ifdef __cplusplus
extern "C" {
#endif

#define POLICY_CONTRACT_VERSION $version
#define POLICY_OBSERVATION $observation /* floats that the network reads */
@depth #define POLICY_DEPTH $depth /* floats of an image: $rows rows of $columns */
@memory #define POLICY_MEMORY $memory /* floats that the network keeps */
#define POLICY_ACTION $actions /* floats that it writes, each in -1..1 */
#define POLICY_CONTROL_DT $control_dt /* s, between two calls */
#define POLICY_ACTION_DELAY $action_delay /* control steps between a call and its effect, as trained */

extern const float policy_hover_action[POLICY_ACTION];

/* The action for an observation. Returns 0; or 1, and writes the action that hovers, where an entry of the observation
 * or the result is not finite. Do not compile with -ffast-math: it removes this check.
@depth  *
@depth  * depth [m]: rows from the top, each from the left. 0 where the camera measures nothing, its range where nothing is nearer.
@memory  *
@memory  * memory: yours to keep. Zeros when a flight begins, then what the call before left in it; a call that returns 1 leaves
@memory  * it as it was.
 */
int policy_action(const float observation[POLICY_OBSERVATION],$parameters float action[POLICY_ACTION]);

/* What an action commands: $names; body frame x forward, y left, z up. */
void policy_command(const float action[POLICY_ACTION], float command[POLICY_ACTION]);

@rotors /* The same as motor signals, from 0 at the least rotor speed to 1 at the greatest, linear in the speed. */
@rotors void policy_signal(const float command[POLICY_ACTION], float signal[POLICY_ACTION]);
@rotors

/* The greatest error over the built-in vectors. Fly only if it is below 1e-5 on the processor that flies. */
float policy_self_test(void);

#ifdef __cplusplus
}
#endif

#endif
