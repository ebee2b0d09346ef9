// A world by its line, `arrows:cubes=4,slip=0.1`, checked as Python checks it. Names, ranges and defaults are generated.

import { ARROW_PUZZLE, PICK_PLACE } from './constants.js';

/** A line that names no world; its message says how to write one. */
export class WorldError extends Error {}

const FAMILIES = [ARROW_PUZZLE, PICK_PLACE];
const LONGEST_LINE = 200;
const NUMBER = /^-?(0|[1-9]\d{0,15})(\.\d{1,17})?([eE][+-]?\d{1,3})?$/;
const INTEGER = /^-?(0|[1-9]\d{0,15})$/;

/**
 * A world of the arrow puzzle or of pick-and-place; the first six parameters are the arrow puzzle's alone.
 * @typedef {object} World
 * @property {boolean} isPickPlace
 * @property {number} [cubes]
 * @property {string} [goal]
 * @property {string[]} [forbidden]
 * @property {string} [coupling]
 * @property {number|null} [shuffle]
 * @property {number|null} [horizon]
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
 * @param {[number, number, boolean]} range the lowest and the highest value, and whether they are integers
 * @param {string} name
 * @param {{text: string, number: number|null, integer: boolean}} given
 * @returns {number}
 */
function numberOf([low, high, integer], name, given) {
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
  if (ARROW_PUZZLE.goals[world.goal] !== undefined && Object.hasOwn(ARROW_PUZZLE.goals, world.goal)) return;
  if (world.goal === 'all') return;
  if (!new RegExp(`^[0-3]{${world.cubes}}$`).test(world.goal)) {
    const names = [...Object.keys(ARROW_PUZZLE.goals), 'all'].join(', ');
    throw new WorldError(`goal is ${brief(world.goal)}; give ${names}, or ${world.cubes} digits from 0 to 3.`);
  }
}

/**
 * @param {World} world
 */
function checkForbidden(world) {
  world.forbidden.forEach((part) => oneOf('forbid', part, ARROW_PUZZLE.forbids));
  const repeated = new Set(world.forbidden).size < world.forbidden.length;
  if (repeated || (world.forbidden.includes('none') && world.forbidden.length > 1)) {
    throw new WorldError(`forbid is ${brief(world.forbidden.join('+'))}, which contradicts itself; give each part once.`);
  }
  if (world.forbidden.includes('equal') && world.cubes >= 4) {
    throw new WorldError('forbid=equal leaves no legal turn with four cubes or more; give at most 3 cubes.');
  }
}

/**
 * @param {Object<string, string>} spellings
 * @param {string[]} pairs
 * @returns {Map<string, {text: string, number: number|null, integer: boolean}>}
 */
function readPairs(spellings, pairs) {
  const given = new Map();
  for (const pair of pairs) {
    const at = pair.indexOf('=');
    const spelled = pair.slice(0, Math.max(at, 0));
    if (!Object.hasOwn(spellings, spelled)) {
      const names = Object.keys(spellings).join(', ');
      throw new WorldError(`${brief(pair)} sets no parameter; give name=value with one of ${names}.`);
    }
    const name = spellings[spelled];
    if (given.has(name)) throw new WorldError(`${name} is given twice; give it once.`);
    given.set(name, value(pair.slice(at + 1)));
  }
  return given;
}

/**
 * Check the parameters that the arrow puzzle alone has, and read the forbidden turns.
 * @param {World} world
 */
function checkArrows(world) {
  const usual = world.cubes < 4 ? 'equal' : 'neighbours';
  world.forbidden = String(world.forbid ?? usual).split('+');
  oneOf('coupling', world.coupling, ARROW_PUZZLE.couplings);
  checkGoal(world);
  checkForbidden(world);
  if (world.cubes === 1 && (world.goal_change > 0 || world.coupling !== 'none')) {
    throw new WorldError('goal_change and coupling need another cube; give at least 2 cubes.');
  }
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
  const family = FAMILIES.find((each) => Object.hasOwn(each.named, name));
  if (!family) {
    const names = FAMILIES.flatMap((each) => Object.keys(each.named)).join(', ');
    throw new WorldError(`There is no world ${brief(name)}; give one of ${names}, or a line such as arrows:cubes=4,slip=0.1.`);
  }
  const given = readPairs(family.spellings, colon < 0 ? [] : line.slice(colon + 1).split(','));
  const world = { ...family.defaults, ...family.named[name], isPickPlace: family === PICK_PLACE, line };
  for (const [key, each] of given) {
    if (key === 'gesture' && family.gestures.includes(each.text)) world.gesture = each.text;
    else if (family.ranges[key]) world[key] = numberOf(family.ranges[key], key, each);
    else if (each.number !== null && !/^0\d/.test(each.text)) throw new WorldError(`${key} is a number; write "${brief(each.text).slice(1, -1)}" in quotation marks.`);
    else world[key] = each.text;
  }
  if (!world.isPickPlace) checkArrows(world);
  return world;
}
