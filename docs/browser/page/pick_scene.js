// The table of pick-and-place: objects on their places, in the gripper or in the human's palm. The macrostate is read back
// from the objects' poses, and then the human answers.

import { PICK_PLACE } from './constants.js';
import { heldObject } from './pick_rules.js';
import { Scene } from './scene.js';

const { placed: PLACED, picked: PICKED, handedOver: HANDED_OVER, openPalm: OPEN_PALM, withdrawn: WITHDRAWN } = PICK_PLACE;
const OBJECTS = PICK_PLACE.objects.length;
const UPRIGHT = [1, 0, 0, 0];

/**
 * What the scene of pick-and-place has beside the facts of every scene; all values come from the package.
 * @typedef {object} PickFacts
 * @property {{grip_height_m: number, grip_opening_m: number, squeeze_m: number, upright: boolean}[]} objects
 * @property {number[]} tcp_m the point between the fingers at the observation pose
 * @property {number[]} idle_fingertip_m
 * @property {number[]} palm_m
 * @property {number[]} idle_palm_m
 * @property {number} table_m the height of the table
 * @property {Object<string, number>} limits
 */

/**
 * The quaternion of the rotation from one frame to another that is near it.
 * @param {number[]} before nine numbers, row by row
 * @param {number[]} after
 * @returns {number[]}
 */
function turnBetween(before, after) {
  const at = (row, column) => [0, 1, 2].reduce((sum, k) => sum + after[3 * row + k] * before[3 * column + k], 0);
  const w = Math.sqrt(1 + at(0, 0) + at(1, 1) + at(2, 2)) / 2;
  return [w, (at(2, 1) - at(1, 2)) / (4 * w), (at(0, 2) - at(2, 0)) / (4 * w), (at(1, 0) - at(0, 1)) / (4 * w)];
}

/**
 * @param {number[]} left
 * @param {number[]} right
 * @returns {number[]} the product of two quaternions
 */
function times([a, b, c, d], [w, x, y, z]) {
  return [
    a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y,
    a * y - b * z + c * w + d * x, a * z + b * y - c * x + d * w,
  ];
}

/**
 * @param {number[]} turn a quaternion
 * @param {number[]} place
 * @returns {number[]} the place, turned about the origin
 */
function turned(turn, place) {
  const [w, x, y, z] = turn;
  return times(times(turn, [0, ...place]), [w, -x, -y, -z]).slice(1);
}

const distance = (a, b) => Math.hypot(...a.map((value, axis) => value - b[axis]));

/** The scene of pick-and-place. */
export class PickScene extends Scene {
  /**
   * Set up a macrostate: each object on its place, in the gripper or in the palm, and the hands as the gesture says.
   * @param {import('./outcomes.js').State} state
   */
  place(state) {
    const { facts, data } = this;
    const held = heldObject(state);
    this.clear();
    facts.objects.forEach((object, index) => {
      const [x, y, z] = facts.palm_m;
      const places = { [PLACED]: facts.slots_m[index], [PICKED]: facts.tcp_m, [HANDED_OVER]: [x, y, z + object.grip_height_m] };
      data.qpos.set([...places[state[index]], ...UPRIGHT], facts.object_qpos[index]);
    });
    if (held !== null) {
      facts.arm_qpos.slice(-2).forEach((column) => { data.qpos[column] = facts.objects[held].grip_opening_m; });
    }
    super.rest(held === null ? null : facts.objects[held].squeeze_m);
    this.gesture(state);
  }

  /**
   * Put the hands as a macrostate says: the right one points, the left one opens its palm; idle hands rest at the edge.
   * @param {import('./outcomes.js').State} state
   */
  gesture(state) {
    const { facts } = this;
    const gesture = state[OBJECTS];
    const palm_m = gesture === OPEN_PALM ? facts.palm_m : facts.idle_palm_m;
    this.putHands([facts.fingertips_m[gesture] ?? facts.idle_fingertip_m, palm_m]);
  }

  /** @returns {number[]} the point between the fingers */
  get #tcp_m() {
    return Array.from(this.data.site_xpos.slice(3 * this.#tcp, 3 * this.#tcp + 3));
  }

  /** @returns {number} */
  get #tcp() {
    return this.model.site('tcp').id;
  }

  /**
   * The start of every macro-action. An object that is held goes with the gripper where the arm is put right.
   */
  rest() {
    const { mujoco, model, data, facts } = this;
    mujoco.mj_forward(model, data);
    const held = facts.objects.findIndex((_, index) => this.#isHeld(this.poseOf(index)));
    if (held < 0) {
      super.rest();
      return;
    }
    const frame = () => Array.from(data.site_xmat.slice(9 * this.#tcp, 9 * this.#tcp + 9));
    const before = { place: this.#tcp_m, frame: frame() };
    const pose = this.poseOf(held);
    super.rest(facts.objects[held].squeeze_m);
    const turn = turnBetween(before.frame, frame());
    const offset = turned(turn, pose.slice(0, 3).map((value, axis) => value - before.place[axis]));
    const place = this.#tcp_m.map((value, axis) => value + offset[axis]);
    data.qpos.set([...place, ...times(turn, pose.slice(3))], facts.object_qpos[held]);
    mujoco.mj_forward(model, data);
  }

  /**
   * @param {number[]} pose of an object
   * @returns {boolean}
   */
  #isHeld(pose) {
    const { limits, table_m } = this.facts;
    const isInTheAir = pose[2] > table_m + limits.in_the_air_m;
    return isInTheAir && distance(pose.slice(0, 3), this.#tcp_m) < limits.off_grip_m;
  }

  /**
   * Begin a macro-action.
   * @param {import('./pick_rules.js').PickRules} rules
   * @param {import('./outcomes.js').State} state before it
   * @param {number} action
   * @param {boolean} inVain whether all objects stay where they are: the arm reaches out and comes back
   */
  begin(rules, state, action, inVain) {
    this.perform([[action, heldObject(state) ?? -1, Number(inVain)].join()]);
  }

  /**
   * Where an object is, and why it is there wrongly, if it is.
   * @param {number} index
   * @returns {{value: number, fault: string|null}}
   */
  #valueOf(index) {
    const { objects, slots_m, palm_m, limits } = this.facts;
    const name = `the ${PICK_PLACE.objects[index]}`;
    const pose = this.poseOf(index);
    const [x, y, z, w, i, j, k] = pose;
    if (this.#isHeld(pose)) return { value: PICKED, fault: null };
    const isTipped = objects[index].upright && 1 - 2 * (i * i + j * j) < Math.cos(limits.tilt_rad);
    const tipped = isTipped ? `${name} is tipped` : null;
    const isInPalm = distance([x, y], palm_m.slice(0, 2)) < limits.palm_reach_m;
    const lift_m = z - palm_m[2] - objects[index].grip_height_m;
    if (isInPalm && Math.abs(lift_m) < limits.lift_off_m) return { value: HANDED_OVER, fault: tipped };
    const slot = slots_m[index];
    if (Math.abs(z - slot[2]) > limits.lift_off_m) {
      return { value: PLACED, fault: `${name} is neither on the table nor held nor in the palm` };
    }
    if (distance([x, y], slot.slice(0, 2)) > limits.off_slot_m) return { value: PLACED, fault: `${name} stands off its place` };
    const yaw = Math.atan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k));
    const isSkewed = objects[index].upright && Math.abs(yaw) > limits.skew_rad;
    return { value: PLACED, fault: tipped ?? (isSkewed ? `${name} is turned` : null) };
  }

  /**
   * The macrostate as the objects are, and why they are there wrongly, if they are. The human answers as intended if the
   * objects are as intended, and withdraws otherwise.
   * @param {import('./outcomes.js').State} intended the macrostate that the rules say
   * @returns {{macrostate: import('./outcomes.js').State, fault: string|null}}
   */
  read(intended) {
    const read = this.facts.objects.map((_, index) => this.#valueOf(index));
    const values = read.map((each) => each.value);
    const fault = read.find((each) => each.fault)?.fault ?? null;
    const isAsIntended = fault === null && values.join() === intended.slice(0, OBJECTS).join();
    let gesture = isAsIntended ? intended[OBJECTS] : WITHDRAWN;
    if (values.includes(HANDED_OVER)) gesture = OPEN_PALM;
    return { macrostate: [...values, gesture], fault };
  }
}
