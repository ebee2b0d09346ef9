// The table of the arrow puzzle: the macrostate is read back from the cubes' poses.

import { Scene } from './scene.js';

const QUARTER = Math.PI / 2;
const MOST_SKEW = (20 * Math.PI) / 180;
const MOST_OFF_M = 0.015;
const MOST_LIFT_M = 0.01;
const LEAST_UPRIGHT = Math.cos((10 * Math.PI) / 180);

/** The scene of the arrow puzzle. */
export class ArrowScene extends Scene {
  /**
   * Set up a macrostate: each cube on its slot, the hand over the cube that it points at.
   * @param {import('./outcomes.js').State} state
   */
  place(state) {
    this.clear();
    this.facts.slots_m.forEach((slot, cube) => {
      const half = (-QUARTER * state[cube]) / 2;
      this.data.qpos.set([...slot, Math.cos(half), 0, 0, Math.sin(half)], this.facts.object_qpos[cube]);
    });
    this.rest();
    this.gesture(state);
  }

  /**
   * Let the hand point at the cube that a macrostate says.
   * @param {import('./outcomes.js').State} state
   */
  gesture(state) {
    this.putHands([this.facts.fingertips_m[state.at(-1)]]);
  }

  /**
   * Begin a macro-action.
   * @param {import('./rules.js').ArrowRules} rules
   * @param {import('./outcomes.js').State} state before it
   * @param {number} action
   * @param {boolean} slips whether the fingers open too early
   */
  begin(rules, state, action, slips) {
    const cubes = this.facts.slots_m.length;
    const name = ({ cube, clockwise }) => [cubes, cube, Number(clockwise), Number(slips)].join();
    this.perform(rules.turns[action].map(name));
  }

  /**
   * The macrostate as the cubes stand, and why they stand wrong, if they do.
   * @param {import('./outcomes.js').State} intended the one that the rules say
   * @returns {{macrostate: import('./outcomes.js').State, fault: string|null}}
   */
  read(intended) {
    const macrostate = [];
    let fault = null;
    this.facts.slots_m.forEach((slot, cube) => {
      const [x, y, z, w, i, j, k] = this.poseOf(cube);
      const yaw = Math.atan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k));
      const quarters = Math.round(yaw / QUARTER);
      macrostate.push((4 - (quarters % 4)) % 4);
      const upright = 1 - 2 * (i * i + j * j);
      if (upright < LEAST_UPRIGHT) fault ??= `cube ${cube + 1} is tipped`;
      if (Math.hypot(x - slot[0], y - slot[1]) > MOST_OFF_M) fault ??= `cube ${cube + 1} stands off its place`;
      if (Math.abs(z - slot[2]) > MOST_LIFT_M) fault ??= `cube ${cube + 1} is not on the table`;
      if (Math.abs(yaw - quarters * QUARTER) > MOST_SKEW) fault ??= `cube ${cube + 1} stands off a right angle`;
    });
    return { macrostate: [...macrostate, intended.at(-1)], fault };
  }
}
