// Outcomes of macro-actions, with what the parameters of a world add to them: slips, and a human who changes their mind.

/**
 * A macrostate: the value of each object, and the gesture of the human.
 * @typedef {number[]} State
 *
 * @typedef {object} Outcome
 * @property {number} probability
 * @property {State} macrostate
 * @property {number} reward
 * @property {boolean} terminated
 * @property {boolean} success
 */

/**
 * The outcomes of a macro-action in a world that slips, and in which the goal changes; those of one
 * macrostate, which have the same reward and end, are one.
 * @param {{slip: number, goal_change: number}} world
 * @param {Outcome[]} outcomes without both
 * @param {Outcome} slipped that of a macro-action that leaves all as it is
 * @param {(outcome: Outcome) => Outcome[]} askedOtherwise the outcomes in place of one, each equally likely
 * @returns {Outcome[]}
 */
export function varied(world, outcomes, slipped, askedOtherwise) {
  const { slip, goal_change: change } = world;
  let found = outcomes;
  if (slip > 0) {
    const kept = outcomes.map((each) => ({ ...each, probability: (1 - slip) * each.probability }));
    found = [...kept, { ...slipped, probability: slip }];
  }
  if (!(change > 0)) return found;
  /** @type {Map<string, Outcome>} */
  const merged = new Map();
  const add = (outcome, probability) => {
    const key = outcome.macrostate.join();
    const before = merged.get(key)?.probability ?? 0;
    merged.set(key, { ...outcome, probability: before + probability });
  };
  for (const outcome of found) {
    const others = outcome.terminated ? [] : askedOtherwise(outcome);
    const share = others.length > 0 ? change : 0;
    add(outcome, outcome.probability * (1 - share));
    others.forEach((other) => add(other, outcome.probability * (share / others.length)));
  }
  return [...merged.values()].filter((outcome) => outcome.probability > 0);
}

/**
 * One of several outcomes, by their probabilities.
 * @param {Outcome[]} outcomes
 * @param {number} share from 0 to 1
 * @returns {Outcome}
 */
export function drawn(outcomes, share) {
  let left = share;
  for (const outcome of outcomes) {
    left -= outcome.probability;
    if (left < 0) return outcome;
  }
  return outcomes[outcomes.length - 1];
}
