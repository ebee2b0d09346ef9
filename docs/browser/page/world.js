// A world by its line, `arrows:cubes=4,slip=0.1`, checked as Python checks it. Names, ranges and defaults are generated.

import { FAMILY } from './constants.js';

/** A line that names no world; its message says how to write one. */
export class WorldError extends Error {}

const LONGEST_LINE = 200;
const NUMBER = /^-?(0|[1-9]\d{0,15})(\.\d{1,17})?([eE][+-]?\d{1,3})?$/;
const INTEGER = /^-?(0|[1-9]\d{0,15})$/;

/**
 * @typedef {object} World
 * @property {number} cubes
 * @property {string} goal
 * @property {string[]} forbidden
 * @property {string} coupling
 * @property {number|null} shuffle
 * @property {number|null} horizon
 * @property {number} slip
 * @property {number} goal_change
 * @property {string|number} gesture
 * @property {number} lag
 * @property {number} distractors
 * @property {string} line the name that it was given by
 */

/**
 * A value as it is shown in a message: short, and in quotation marks.
 * @param {string} text
 * @returns {string}
 */
export function brief(text) {
  const shown = text.length > 40 ? `${text.slice(0, 37)}...` : text;
  return JSON.stringify(shown);
}

/**
 * @param {string} text
 * @returns {{text: string, number: number|null, integer: boolean}}
 */
function value(text) {
  if (/^"[^"\\]*"$/.test(text)) return { text: text.slice(1, -1), number: null, integer: false };
  const number = NUMBER.test(text) ? Number(text) : null;
  return { text, number, integer: INTEGER.test(text) };
}

/**
 * @param {string} name
 * @param {{text: string, number: number|null, integer: boolean}} given
 * @returns {number}
 */
function numberOf(name, given) {
  const [low, high, integer] = FAMILY.ranges[name];
  const right = given.number !== null && (!integer || given.integer);
  if (!right || given.number < low || given.number > high) {
    const kind = integer ? 'an integer' : 'a number';
    throw new WorldError(`${name} is ${brief(given.text)}; give ${kind} from ${low} to ${high}.`);
  }
  return given.number;
}

/**
 * @param {string} name
 * @param {string} text
 * @param {readonly string[]} allowed
 * @returns {string}
 */
function oneOf(name, text, allowed) {
  if (!allowed.includes(text)) throw new WorldError(`${name} is ${brief(text)}; give one of ${allowed.join(', ')}.`);
  return text;
}

/**
 * @param {World} world
 */
function checkGoal(world) {
  if (FAMILY.goals[world.goal] !== undefined && Object.hasOwn(FAMILY.goals, world.goal)) return;
  if (world.goal === 'all') return;
  if (!new RegExp(`^[0-3]{${world.cubes}}$`).test(world.goal)) {
    const names = [...Object.keys(FAMILY.goals), 'all'].join(', ');
    throw new WorldError(`goal is ${brief(world.goal)}; give ${names}, or ${world.cubes} digits from 0 to 3.`);
  }
}

/**
 * @param {World} world
 */
function checkForbidden(world) {
  world.forbidden.forEach((part) => oneOf('forbid', part, FAMILY.forbids));
  const repeated = new Set(world.forbidden).size < world.forbidden.length;
  if (repeated || (world.forbidden.includes('none') && world.forbidden.length > 1)) {
    throw new WorldError(`forbid is ${brief(world.forbidden.join('+'))}, which contradicts itself; give each part once.`);
  }
  if (world.forbidden.includes('equal') && world.cubes >= 4) {
    throw new WorldError('forbid=equal leaves no legal turn with four cubes or more; give at most 3 cubes.');
  }
}

/**
 * @param {string[]} pairs
 * @returns {Map<string, {text: string, number: number|null, integer: boolean}>}
 */
function readPairs(pairs) {
  const given = new Map();
  for (const pair of pairs) {
    const at = pair.indexOf('=');
    const spelled = pair.slice(0, Math.max(at, 0));
    if (!Object.hasOwn(FAMILY.spellings, spelled)) {
      const names = Object.keys(FAMILY.spellings).join(', ');
      throw new WorldError(`${brief(pair)} sets no parameter; give name=value with one of ${names}.`);
    }
    const name = FAMILY.spellings[spelled];
    if (given.has(name)) throw new WorldError(`${name} is given twice; give it once.`);
    given.set(name, value(pair.slice(at + 1)));
  }
  return given;
}

/**
 * The world that a line names.
 * @param {string} line such as `arrows:cubes=4,slip=0.1` or `arrow_puzzle`
 * @returns {World}
 * @throws {WorldError}
 */
export function readWorld(line) {
  if (line.length > LONGEST_LINE) {
    throw new WorldError(`The line of the world has ${line.length} characters; give at most ${LONGEST_LINE}.`);
  }
  const colon = line.indexOf(':');
  const name = colon < 0 ? line : line.slice(0, colon);
  if (!Object.hasOwn(FAMILY.named, name)) {
    const names = Object.keys(FAMILY.named).join(', ');
    throw new WorldError(`There is no world ${brief(name)}; give one of ${names}, or a line such as arrows:cubes=4,slip=0.1.`);
  }
  const given = readPairs(colon < 0 ? [] : line.slice(colon + 1).split(','));
  const world = { ...FAMILY.defaults, ...FAMILY.named[name], line };
  for (const [key, each] of given) {
    if (key === 'gesture' && FAMILY.gestures.includes(each.text)) world.gesture = each.text;
    else if (FAMILY.ranges[key]) world[key] = numberOf(key, each);
    else if (each.number !== null && !/^0\d/.test(each.text)) throw new WorldError(`${key} is a number; write "${brief(each.text).slice(1, -1)}" in quotation marks.`);
    else world[key] = each.text;
  }
  const usual = world.cubes < 4 ? 'equal' : 'neighbours';
  world.forbidden = String(world.forbid ?? usual).split('+');
  oneOf('coupling', world.coupling, FAMILY.couplings);
  checkGoal(world);
  checkForbidden(world);
  if (world.cubes === 1 && (world.goal_change > 0 || world.coupling !== 'none')) {
    throw new WorldError('goal_change and coupling need another cube; give at least 2 cubes.');
  }
  return world;
}
