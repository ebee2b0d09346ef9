// Kept episodes of an agent, to be played again by the arm. They are read from this folder alone, and everything in
// them is checked against the rules before anything moves.

import { rulesOf } from './families.js';
import { brief, readWorld, WorldError } from './world.js';

const NAME = /^[a-z0-9][a-z0-9_.,=-]{0,79}$/;
const MOST_EPISODES = 2000;

/**
 * @typedef {object} Row
 * @property {string} title
 * @property {import('./world.js').World} world
 * @property {Episode[]} episodes
 *
 * @typedef {object} Episode
 * @property {number[]} start
 * @property {number[]} actions
 * @property {number[][]} states after each of them
 * @property {boolean} success
 * @property {boolean} [reproducible] if it is false, the episode counts as failed even at a goal
 */

/**
 * The address of a row's file, relative to the page.
 * @param {string} name
 * @returns {string}
 */
export function rowFile(name) {
  if (!NAME.test(name) || name.includes('..')) {
    throw new WorldError(`There is no row ${brief(name)}; give a name of lower-case letters, digits, dots and dashes.`);
  }
  return `data/rows/${name}.json`;
}

/**
 * @param {unknown} numbers
 * @param {number} least
 * @param {number} below
 * @returns {boolean}
 */
function areIntegers(numbers, least, below) {
  return Array.isArray(numbers) && numbers.every((each) => Number.isInteger(each) && each >= least && each < below);
}

/**
 * @param {import('./families.js').Rules} rules
 * @param {any} episode
 * @param {number} index
 */
function checkEpisode(rules, episode, index) {
  const fail = (why) => { throw new WorldError(`Episode ${index + 1} of this row ${why}; it is not played.`); };
  if (!rules.isState(episode?.start)) fail('starts in no macrostate of its world');
  const { actions, states } = episode;
  if (!areIntegers(actions, 0, rules.nActions) || actions.length > rules.horizon) fail('has macro-actions of no such world');
  if (!Array.isArray(states) || states.length !== actions.length) fail('does not say where each macro-action led');
  let before = episode.start;
  actions.forEach((action, at) => {
    if (!rules.isState(states[at])) fail('reaches no macrostate of its world');
    if (rules.isGoal(before) || !rules.isLegal(before)) fail('goes on after its end');
    const possible = rules.outcomes(before, action).some((outcome) => outcome.macrostate.join() === states[at].join());
    if (!possible) fail(`claims a result of macro-action ${at + 1} that the rules do not allow`);
    before = states[at];
  });
  const counts = episode.reproducible !== false;
  if (Boolean(episode.success) !== (counts && rules.isGoal(before))) fail('claims another end than the one that it reaches');
}

/**
 * A row, checked.
 * @param {any} given the content of its file
 * @returns {Row}
 */
export function readRow(given) {
  const { title, world: line, episodes } = given ?? {};
  if (typeof title !== 'string' || typeof line !== 'string' || !Array.isArray(episodes) || episodes.length === 0) {
    throw new WorldError('This file is no row: it needs a title, a world and episodes.');
  }
  if (episodes.length > MOST_EPISODES) throw new WorldError(`This row has more than ${MOST_EPISODES} episodes.`);
  const world = readWorld(line);
  const rules = rulesOf(world);
  episodes.forEach((episode, index) => checkEpisode(rules, episode, index));
  return { title: title.slice(0, 120), world, episodes };
}
