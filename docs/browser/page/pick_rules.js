// The rules of pick-and-place: the effect of a macro-action, its reward and whether the episode ends. They know no physics.
// Python's tests compare them with the package's own rules, outcome by outcome.

import { PICK_PLACE } from './constants.js';
import { drawn, varied } from './outcomes.js';

const { placed: PLACED, picked: PICKED, handedOver: HANDED_OVER } = PICK_PLACE;
const { openPalm: OPEN_PALM, withdrawn: WITHDRAWN, handOver: HAND_OVER, rewards: REWARDS } = PICK_PLACE;
const OBJECTS = PICK_PLACE.objects.length;
const POINTING = PICK_PLACE.objects.map((_, index) => index);
const ALL_PLACED = POINTING.map(() => PLACED);

/**
 * A macrostate: where each object is, and the gesture of the human.
 * @typedef {import('./outcomes.js').State} State
 *
 * @typedef {import('./outcomes.js').Outcome} Outcome
 */

/**
 * The object that the gripper holds.
 * @param {State} state
 * @returns {number|null}
 */
export function heldObject(state) {
  const held = state.slice(0, OBJECTS).indexOf(PICKED);
  return held < 0 ? null : held;
}

/** Objects of which one has another value. */
const changed = (objects, index, value) => objects.map((each, at) => (at === index ? value : each));

/** The possible next gestures when an object has been picked as asked. */
const wishesWith = (held) => [...POINTING.filter((each) => each !== held), OPEN_PALM];

/** The macrostate machine of a world of pick-and-place. */
export class PickRules {
  /** @param {import('./world.js').World} world */
  constructor(world) {
    this.world = world;
    this.nActions = OBJECTS + 1;
    this.horizon = PICK_PLACE.horizon;
    const held = POINTING.map((each) => changed(ALL_PLACED, each, PICKED));
    /** The macrostates in the order in which Python lists them. */
    this.states = [
      ...POINTING.map((gesture) => [...ALL_PLACED, gesture]),
      ...held.flatMap((objects, index) => wishesWith(index).map((gesture) => [...objects, gesture])),
      ...POINTING.map((each) => [...changed(ALL_PLACED, each, HANDED_OVER), OPEN_PALM]),
      ...[ALL_PLACED, ...held].map((objects) => [...objects, WITHDRAWN]),
    ];
    this.nStates = this.states.length;
    this.rows = new Map(this.states.map((state, row) => [state.join(), row]));
    /** Rows of the macrostates in which an episode may start. */
    this.starts = POINTING;
  }

  /**
   * @param {State} state
   * @returns {number|undefined}
   */
  rowOf(state) {
    return this.rows.get(state.join());
  }

  /**
   * @param {number} row
   * @returns {State}
   */
  stateOf(row) {
    return this.states[row];
  }

  /**
   * @param {unknown} state
   * @returns {boolean} whether it is a macrostate of this world
   */
  isState(state) {
    return Array.isArray(state) && state.every(Number.isInteger) && this.rowOf(state) !== undefined;
  }

  /**
   * Whether the human's hands are still there: they are withdrawn at the first wrong action.
   * @param {State} state
   * @returns {boolean}
   */
  isLegal(state) {
    return state[OBJECTS] !== WITHDRAWN;
  }

  /**
   * Whether an object was handed over.
   * @param {State} state
   * @returns {boolean}
   */
  isGoal(state) {
    return state.slice(0, OBJECTS).includes(HANDED_OVER);
  }

  /**
   * @param {State} state
   * @param {number} action
   * @returns {boolean} whether it is the human's present wish, or the step toward it
   */
  isAskedFor(state, action) {
    if (this.isGoal(state) || !this.isLegal(state)) return false;
    const held = heldObject(state);
    const gesture = state[OBJECTS];
    if (held === null) return action === gesture;
    return action === (gesture === OPEN_PALM ? HAND_OVER : held);
  }

  /**
   * Where the objects are after a macro-action, asked for or not: the robot does it as far as that is possible.
   * @param {State} state
   * @param {number} action
   * @returns {number[]}
   */
  objectsAfter(state, action) {
    const objects = state.slice(0, OBJECTS);
    const held = heldObject(state);
    if (this.isGoal(state)) return objects;
    if (action === HAND_OVER) {
      const isOffered = held !== null && state[OBJECTS] === OPEN_PALM;
      return isOffered ? changed(objects, held, HANDED_OVER) : objects;
    }
    if (held === null) return changed(objects, action, PICKED);
    return action === held ? changed(objects, held, PLACED) : objects;
  }

  /**
   * @param {State} state
   * @param {number} action
   * @returns {Outcome[]} without slips and changes of the goal
   */
  #plainOutcomes(state, action) {
    const objects = this.objectsAfter(state, action);
    const outcome = (gesture, reward, terminated, success = false, probability = 1) => (
      { probability, macrostate: [...objects, gesture], reward, terminated, success }
    );
    if (!this.isAskedFor(state, action)) {
      return [outcome(this.isGoal(objects) ? OPEN_PALM : WITHDRAWN, REWARDS.wrong, true)];
    }
    if (action === HAND_OVER) return [outcome(OPEN_PALM, REWARDS.handover, true, true)];
    if (!objects.includes(PICKED)) return [outcome(state[OBJECTS], REWARDS.place, false)];
    const wishes = wishesWith(action);
    return wishes.map((wish) => outcome(wish, REWARDS.pick, false, false, 1 / wishes.length));
  }

  /**
   * The outcomes where the human makes another gesture.
   * @param {Outcome} outcome
   * @returns {Outcome[]}
   */
  #askedOtherwise(outcome) {
    const { macrostate } = outcome;
    const held = heldObject(macrostate);
    const wishes = held === null ? POINTING : wishesWith(held);
    return wishes
      .filter((wish) => wish !== macrostate[OBJECTS])
      .map((wish) => ({ ...outcome, macrostate: [...macrostate.slice(0, OBJECTS), wish] }));
  }

  /**
   * Every possible outcome of a macro-action, in Python's order.
   * @param {State} state
   * @param {number} action
   * @returns {Outcome[]}
   */
  outcomes(state, action) {
    const found = this.#plainOutcomes(state, action);
    if (this.isGoal(state) || !this.isLegal(state)) return found;
    const slipped = { probability: 1, macrostate: [...state], reward: REWARDS.place, terminated: false, success: false };
    return varied(this.world, found, slipped, (outcome) => this.#askedOtherwise(outcome));
  }

  /**
   * The outcome of a macro-action that was read to have reached a macrostate; any other result is a wrong action.
   * @param {State} state before
   * @param {number} action
   * @param {State} reached
   * @returns {Outcome}
   */
  judged(state, action, reached) {
    const found = this.outcomes(state, action).find((outcome) => outcome.macrostate.join() === reached.join());
    return found ?? { probability: 1, macrostate: reached, reward: REWARDS.wrong, terminated: true, success: false };
  }

  /**
   * Whether the objects stay where they are on the way to a macrostate: the arm reaches out in vain.
   * @param {State} state
   * @param {number} action
   * @param {State} reached
   * @returns {boolean}
   */
  slips(state, action, reached) {
    return state.slice(0, OBJECTS).join() === reached.slice(0, OBJECTS).join();
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
