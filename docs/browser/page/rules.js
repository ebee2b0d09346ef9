// The rules of a world: which turns a macro-action makes, where it leads, its reward and whether the episode ends.
// They know no physics. Python's tests compare them with the package's own rules, outcome by outcome.

import { FAMILY } from './constants.js';
import { permutation } from './permutation.js';
import { WorldError } from './world.js';

/**
 * A quarter turn of one cube, as the robot's camera sees it.
 * @typedef {{cube: number, clockwise: boolean}} Turn
 *
 * A macrostate: the direction of each arrow, and the cube that the human points at.
 * @typedef {number[]} State
 *
 * @typedef {object} Outcome
 * @property {number} probability
 * @property {State} macrostate
 * @property {number} reward
 * @property {boolean} terminated
 * @property {boolean} success
 */

const DIRECTIONS = FAMILY.directions.length;

/** The macrostate machine of a world. */
export class Rules {
  /** @param {import('./world.js').World} world */
  constructor(world) {
    this.world = world;
    this.turns = this.#turns();
    this.nActions = this.turns.length;
    const pattern = world.goal === 'all' ? '0'.repeat(world.cubes) : world.goal;
    const named = Object.hasOwn(FAMILY.goals, world.goal) ? FAMILY.goals[world.goal] : null;
    /** @type {number[]} */
    this.pattern = named ? [] : [...pattern].map(Number);
    /** @type {number|null} */
    this.pointed = named ? named.pointed : null;
    this.absent = [...(named ? named.absent : []), ...(world.forbidden.includes('agent') ? [FAMILY.towardAgent] : [])];
    this.nStates = DIRECTIONS ** world.cubes * world.cubes;
    this.planLengths = this.#planLengths();
    /** Rows of the macrostates in which an episode may start. */
    this.starts = [...this.planLengths.keys()].filter((row) => this.planLengths[row] > 0);
    if (this.starts.length === 0) {
      throw new WorldError('The goal of this world cannot be reached from anywhere; give another goal or forbid less.');
    }
    const longest = this.planLengths.reduce((most, each) => Math.max(most, each), 0);
    this.horizon = world.horizon ?? Math.max(FAMILY.shortestHorizon, FAMILY.plansInHorizon * longest);
  }

  /** @returns {Turn[][]} */
  #turns() {
    const { cubes, coupling, shuffle } = this.world;
    const turns = [];
    for (let cube = 0; cube < cubes; cube += 1) {
      for (const clockwise of [true, false]) {
        const own = [{ cube, clockwise }];
        if (coupling === 'neighbour' && cube < cubes - 1) own.push({ cube: cube + 1, clockwise });
        turns.push(own);
      }
    }
    return shuffle === null ? turns : permutation(shuffle, turns.length).map((index) => turns[index]);
  }

  /**
   * The row of a macrostate in the order in which Python lists them.
   * @param {State} state
   * @returns {number}
   */
  rowOf(state) {
    const directions = state.slice(0, -1).reduce((row, direction) => row * DIRECTIONS + direction, 0);
    return directions * this.world.cubes + state[state.length - 1];
  }

  /**
   * @param {number} row
   * @returns {State}
   */
  stateOf(row) {
    const { cubes } = this.world;
    const state = [row % cubes];
    let left = Math.floor(row / cubes);
    for (let cube = 0; cube < cubes; cube += 1) {
      state.unshift(left % DIRECTIONS);
      left = Math.floor(left / DIRECTIONS);
    }
    return state;
  }

  /**
   * Fewest turns to a goal without slips: 0 at goals, -1 where no turns lead there.
   * @returns {Int32Array}
   */
  #planLengths() {
    const lengths = new Int32Array(this.nStates).fill(-1);
    let reached = [];
    for (let row = 0; row < this.nStates; row += 1) {
      if (this.isGoal(this.stateOf(row))) reached.push(row);
    }
    for (let length = 0; reached.length > 0; length += 1) {
      const fresh = reached.filter((row) => lengths[row] < 0);
      fresh.forEach((row) => { lengths[row] = length; });
      reached = fresh.flatMap((row) => this.#before(row)).filter((row) => lengths[row] < 0);
      reached = [...new Set(reached)];
    }
    return lengths;
  }

  /**
   * Rows of the legal macrostates from which one macro-action leads to a macrostate.
   * @param {number} row
   * @returns {number[]}
   */
  #before(row) {
    const state = this.stateOf(row);
    return this.turns
      .map((turns) => this.#turnedBy(state, turns, -1))
      .filter((each) => this.isLegal(each))
      .map((each) => this.rowOf(each));
  }

  /**
   * @param {State} state
   * @param {Turn[]} turns
   * @param {number} sense 1, or -1 to undo them
   * @returns {State}
   */
  #turnedBy(state, turns, sense) {
    const after = [...state];
    for (const { cube, clockwise } of turns) {
      after[cube] = (after[cube] + (clockwise ? sense : -sense) + DIRECTIONS) % DIRECTIONS;
    }
    return after;
  }

  /**
   * The macrostate after a macro-action that does not slip.
   * @param {State} state
   * @param {number} action
   * @returns {State}
   */
  turned(state, action) {
    return this.#turnedBy(state, this.turns[action], 1);
  }

  /**
   * Whether no two arrows are alike that may not be.
   * @param {State} state
   * @returns {boolean}
   */
  isLegal(state) {
    const directions = state.slice(0, -1);
    const { forbidden } = this.world;
    if (forbidden.includes('equal') && new Set(directions).size < directions.length) return false;
    if (!forbidden.includes('neighbours')) return true;
    return directions.every((direction, cube) => cube === 0 || direction !== directions[cube - 1]);
  }

  /**
   * @param {State} state
   * @returns {boolean}
   */
  isGoal(state) {
    const directions = state.slice(0, -1);
    const asked = directions[state[state.length - 1]];
    return this.isLegal(state)
      && (this.pointed === null || asked === this.pointed)
      && (this.pattern.length === 0 || directions.every((direction, cube) => direction === this.pattern[cube]))
      && !this.absent.some((direction) => directions.includes(direction));
  }

  /**
   * The outcome of reaching a macrostate, which alone decides about reward and end.
   * @param {State} reached
   * @param {number} probability
   * @returns {Outcome}
   */
  judge(reached, probability = 1) {
    const { goal, illegal, step } = FAMILY.rewards;
    const outcome = { probability, macrostate: reached };
    if (!this.isLegal(reached)) return { ...outcome, reward: illegal, terminated: true, success: false };
    if (this.isGoal(reached)) return { ...outcome, reward: goal, terminated: true, success: true };
    return { ...outcome, reward: step, terminated: false, success: false };
  }

  /**
   * Every possible outcome of a macro-action, in Python's order.
   * @param {State} state
   * @param {number} action
   * @returns {Outcome[]}
   */
  outcomes(state, action) {
    const { slip, goal_change: change, cubes } = this.world;
    let found = [this.judge(this.turned(state, action))];
    if (slip > 0) found = [{ ...found[0], probability: 1 - slip }, this.judge([...state], slip)];
    if (!(change > 0)) return found;
    /** @type {Map<string, Outcome>} */
    const merged = new Map();
    const add = (outcome, probability) => {
      const key = outcome.macrostate.join();
      const before = merged.get(key)?.probability ?? 0;
      merged.set(key, { ...outcome, probability: before + probability });
    };
    for (const outcome of found) {
      const asked = outcome.macrostate[cubes];
      const share = outcome.terminated ? 0 : change;
      add(outcome, outcome.probability * (1 - share));
      for (let cube = 0; share > 0 && cube < cubes; cube += 1) {
        const other = [...outcome.macrostate.slice(0, -1), cube];
        if (cube !== asked) add(this.judge(other), outcome.probability * (share / (cubes - 1)));
      }
    }
    return [...merged.values()].filter((outcome) => outcome.probability > 0);
  }

  /**
   * One outcome, drawn by its probability.
   * @param {State} state
   * @param {number} action
   * @param {number} drawn from 0 to 1
   * @returns {Outcome}
   */
  draw(state, action, drawn) {
    const outcomes = this.outcomes(state, action);
    let left = drawn;
    for (const outcome of outcomes) {
      left -= outcome.probability;
      if (left < 0) return outcome;
    }
    return outcomes[outcomes.length - 1];
  }
}
