// The rules of a world, whichever family of tasks it is of.

import { PickRules } from './pick_rules.js';
import { ArrowRules } from './rules.js';

/**
 * @typedef {ArrowRules|PickRules} Rules
 *
 * @param {import('./world.js').World} world
 * @returns {Rules}
 */
export function rulesOf(world) {
  return world.isPickPlace ? new PickRules(world) : new ArrowRules(world);
}
