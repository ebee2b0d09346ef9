// The rules of a world: which turns a macro-action makes, where it leads, its reward and whether the episode ends.
// They know no physics. Python's tests compare them with the package's own rules, outcome by outcome.

import { ARROW_PUZZLE } from './constants.js';
import { drawn, varied } from './outcomes.js';
import { permutation } from './permutation.js';
import { WorldError } from './world.js';

/**
 * A quarter turn of one cube, as the robot's camera sees it.
 * @typedef {{cube: number, clockwise: boolean}} Turn
 *
 * @typedef {import('./outcomes.js').Outcome} Outcome
 *
 * A macrostate: the direction of each arrow, and the cube that the human points at.
 * @typedef {import('./outcomes.js').State} State
 */

const DIRECTIONS = ARROW_PUZZLE.directions.length;

/** The macrostate machine of a world of the arrow puzzle. */
export class ArrowRules {
  /** @param {import('./world.js').World} world */
  constructor(world) {
    this.world = world;
    this.turns = this.#turns();
    this.nActions = this.turns.length;
    const pattern = world.goal === 'all' ? '0'.repeat(world.cubes) : world.goal;
    const named = Object.hasOwn(ARROW_PUZZLE.goals, world.goal) ? ARROW_PUZZLE.goals[world.goal] : null;
    /** @type {number[]} */
    this.pattern = named ? [] : [...pattern].map(Number);
    /** @type {number|null} */
    this.pointed = named ? named.pointed : null;
    this.absent = [...(named ? named.absent : []), ...(world.forbidden.includes('agent') ? [ARROW_PUZZLE.towardAgent] : [])];
    this.nStates = DIRECTIONS ** world.cubes * world.cubes;
    this.planLengths = this.#planLengths();
    /** Rows of the macrostates in which an episode may start. */
    this.starts = [...this.planLengths.keys()].filter((row) => this.planLengths[row] > 0);
    if (this.starts.length === 0) {
      throw new WorldError('The goal of this world cannot be reached from anywhere; give another goal or forbid less.');
    }
    const longest = this.planLengths.reduce((most, each) => Math.max(most, each), 0);
    this.horizon = world.horizon ?? Math.max(ARROW_PUZZLE.shortestHorizon, ARROW_PUZZLE.plansInHorizon * longest);
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
    const { goal, illegal, step } = ARROW_PUZZLE.rewards;
    const outcome = { probability, macrostate: reached };
    if (!this.isLegal(reached)) return { ...outcome, reward: illegal, terminated: true, success: false };
    if (this.isGoal(reached)) return { ...outcome, reward: goal, terminated: true, success: true };
    return { ...outcome, reward: step, terminated: false, success: false };
  }

  /**
   * The outcome of a macro-action that was read to have reached a macrostate.
   * @param {State} state before
   * @param {number} action
   * @param {State} reached
   * @returns {Outcome}
   */
  judged(state, action, reached) {
    return this.judge(reached);
  }

  /**
   * Whether the fingers open too early on the way to a macrostate.
   * @param {State} state
   * @param {number} action
   * @param {State} reached
   * @returns {boolean}
   */
  slips(state, action, reached) {
    const { cube } = this.turns[action][0];
    return reached[cube] === state[cube];
  }

  /**
   * @param {unknown} state
   * @returns {boolean} whether it is a macrostate of this world
   */
  isState(state) {
    const { cubes } = this.world;
    const isBelow = (each, limit) => Number.isInteger(each) && each >= 0 && each < limit;
    return Array.isArray(state) && state.length === cubes + 1
      && state.slice(0, cubes).every((each) => isBelow(each, DIRECTIONS)) && isBelow(state[cubes], cubes);
  }

  /**
   * Every possible outcome of a macro-action, in Python's order.
   * @param {State} state
   * @param {number} action
   * @returns {Outcome[]}
   */
  outcomes(state, action) {
    const found = [this.judge(this.turned(state, action))];
    return varied(this.world, found, this.judge([...state]), (outcome) => this.#askedOtherwise(outcome));
  }

  /**
   * The outcomes where the hand points at another cube.
   * @param {Outcome} outcome
   * @returns {Outcome[]}
   */
  #askedOtherwise({ macrostate }) {
    const { cubes } = this.world;
    const others = Array.from({ length: cubes }, (_, cube) => cube).filter((cube) => cube !== macrostate[cubes]);
    return others.map((cube) => this.judge([...macrostate.slice(0, -1), cube]));
  }

  /**
   * One outcome, drawn by its probability.
   * @param {State} state
   * @param {number} action
   * @param {number} share from 0 to 1
   * @returns {Outcome}
   */
  draw(state, action, share) {
    return drawn(this.outcomes(state, action), share);
  }
}
