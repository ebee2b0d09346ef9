// The words of the page about a world and about its episodes.

import { ARROW_PUZZLE } from './constants.js';

export const ARROWS = ['↑', '→', '↓', '←'];

/**
 * A share in percent, rounded down, so that 99.999 % is never shown as 100 %.
 * @param {number} share
 * @returns {string}
 */
export function percent(share) {
  return `${(Math.floor(1e4 * share + 1e-7) / 100).toFixed(2)} %`;
}

/**
 * The goal in one sentence, and the forbidden turns.
 * @param {import('./rules.js').ArrowRules} rules
 * @returns {string}
 */
export function goalOf(rules) {
  const { world } = rules;
  const toward = (direction) => `${ARROW_PUZZLE.directions[direction]} (${ARROWS[direction]})`;
  let goal;
  if (rules.pointed !== null) goal = `Make the cube that the hand points at point ${toward(rules.pointed)}`;
  else goal = `Make the arrows point ${rules.pattern.map((each) => ARROWS[each]).join(' ')}, from left to right`;
  const absent = rules.absent.map((each) => `, with no arrow ${toward(each)}`).join('');
  if (world.forbidden.includes('equal') && world.cubes > 1) return `${goal}${absent}. Two arrows may never point the same way.`;
  if (world.forbidden.includes('neighbours') && world.cubes > 1) return `${goal}${absent}. Two neighbours may never point the same way.`;
  return `${goal}${absent}.`;
}

/**
 * The parameters that make the world harder than the plain one.
 * @param {import('./world.js').World} world
 * @returns {string}
 */
export function oddities(world) {
  const said = [];
  const often = (share) => `${Number((100 * share).toPrecision(4))} %`;
  const moves = world.isPickPlace ? 'actions' : 'turns';
  const changes = world.isPickPlace ? 'The human wants something else' : 'The hand moves on';
  if (world.slip > 0) said.push(`The fingers slip in ${often(world.slip)} of the ${moves}.`);
  if (world.goal_change > 0) said.push(`${changes} after ${often(world.goal_change)} of the ${moves}.`);
  if (world.coupling === 'neighbour') said.push('The next cube to the right turns along.');
  if (world.gesture === 'first') said.push('The hand is shown at the start alone.');
  else if (world.gesture !== 'always') said.push(`The hand is shown ${often(world.gesture)} of the time.`);
  if (world.lag > 0) said.push('An agent sees frames that are late; you see the table as it is.');
  if (world.distractors > 0) said.push('An agent also sees moving distractors, which this page leaves out.');
  return said.join(' ');
}

/**
 * @param {import('./outcomes.js').Outcome} outcome
 * @returns {string}
 */
export function rewardOf(outcome) {
  return `Reward ${String(outcome.reward).replace('-', '−')}.`;
}

/**
 * @param {import('./game.js').Game} game
 * @param {import('./outcomes.js').Outcome} outcome
 * @param {boolean} slipped
 * @param {string|null} fault
 * @returns {{text: string, tone: string}}
 */
export function happened(game, outcome, slipped, fault) {
  const { world } = game.rules;
  const reward = rewardOf(outcome);
  if (fault) return { text: `The physics went wrong: ${fault}.`, tone: 'bad' };
  if (outcome.success) return { text: `Solved in ${game.steps} ${game.steps === 1 ? 'turn' : 'turns'}. ${reward}`, tone: 'good' };
  if (outcome.terminated) {
    const which = world.forbidden.includes('equal') ? 'Two arrows' : 'Two neighbours';
    return { text: `${which} point the same way now, which is forbidden. The episode is over. ${reward}`, tone: 'bad' };
  }
  if (game.over) return { text: 'No turns are left. The episode is over.', tone: 'bad' };
  if (slipped) return { text: `The fingers slipped: the cube stands as it did. ${reward}`, tone: 'bad' };
  return { text: `Turned. ${reward}`, tone: '' };
}
