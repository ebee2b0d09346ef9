// The table and the arm in MuJoCo. A macro-action replays commands that the package's planner made; the servos move the
// arm, contact alone turns the cube, and the macrostate is read back from the cubes' poses.

const QUARTER = Math.PI / 2;
const MOST_SKEW = (20 * Math.PI) / 180;
const MOST_OFF_M = 0.015;
const MOST_LIFT_M = 0.01;
const LEAST_UPRIGHT = Math.cos((10 * Math.PI) / 180);

/**
 * @typedef {object} SceneFacts
 * @property {number} cubes
 * @property {number[]} qpos positions of everything at rest
 * @property {number[]} ctrl commands at rest
 * @property {number[]} arm_ctrl the servos of the arm's joints and of both fingers
 * @property {number[]} arm_qpos
 * @property {number[]} cube_qpos where each cube's pose begins
 * @property {number[][]} slots_m
 * @property {number[][]} fingertips_m
 *
 * @typedef {object} Motion
 * @property {Float32Array} commands rows of seven joints and one opening
 * @property {number} rows
 * @property {number} steps
 */

/** Planned motions, looked up by the turn. */
export class Motions {
  /**
   * @param {{every: number, columns: number, motions: number[][]}} index
   * @param {ArrayBuffer} rows
   */
  constructor(index, rows) {
    this.every = index.every;
    this.columns = index.columns;
    const values = new Float32Array(rows);
    /** @type {Map<string, Motion>} */
    this.found = new Map();
    for (const [cubes, cube, clockwise, slips, first, count, steps] of index.motions) {
      const commands = values.subarray(first * this.columns, (first + count) * this.columns);
      this.found.set([cubes, cube, clockwise, slips].join(), { commands, rows: count, steps });
    }
  }

  /**
   * @param {number} cubes
   * @param {import('./rules.js').Turn} turn
   * @param {boolean} slips
   * @returns {Motion}
   */
  of(cubes, turn, slips) {
    return this.found.get([cubes, turn.cube, Number(turn.clockwise), Number(slips)].join());
  }
}

/** One scene with its arm. */
export class Scene {
  /**
   * @param {any} mujoco the WebAssembly module
   * @param {string} xml
   * @param {SceneFacts} facts
   * @param {Motions} motions
   */
  constructor(mujoco, xml, facts, motions) {
    this.mujoco = mujoco;
    this.facts = facts;
    this.motions = motions;
    this.model = mujoco.MjModel.from_xml_string(xml);
    this.data = new mujoco.MjData(this.model);
    this.timestep = this.model.opt.timestep;
    this.hand = this.#handOf();
    /** @type {{motion: Motion, step: number}[]} */
    this.under = [];
  }

  #handOf() {
    const body = this.model.body('hand').id;
    return this.model.body_mocapid[body];
  }

  /**
   * Set up a macrostate: each cube on its slot, the hand over the cube that it points at.
   * @param {import('./rules.js').State} state
   */
  place(state) {
    this.under = [];
    const { mujoco, model, data, facts } = this;
    mujoco.mj_resetData(model, data);
    data.qpos.set(facts.qpos);
    facts.slots_m.forEach((slot, cube) => {
      const half = (-QUARTER * state[cube]) / 2;
      data.qpos.set([...slot, Math.cos(half), 0, 0, Math.sin(half)], facts.cube_qpos[cube]);
    });
    this.rest();
    this.point(state[state.length - 1]);
  }

  /** The start of every macro-action: the arm at its observation pose, everything still, cubes where they are. */
  rest() {
    const { mujoco, model, data, facts } = this;
    const qpos = Float64Array.from(data.qpos);
    const hand = Float64Array.from(data.mocap_pos);
    const turned = Float64Array.from(data.mocap_quat);
    facts.arm_qpos.forEach((column) => { qpos[column] = facts.qpos[column]; });
    mujoco.mj_resetData(model, data);
    data.qpos.set(qpos);
    data.mocap_pos.set(hand);
    data.mocap_quat.set(turned);
    data.ctrl.set(facts.ctrl);
    mujoco.mj_forward(model, data);
  }

  /**
   * Let the hand point at a cube.
   * @param {number} cube
   */
  point(cube) {
    this.data.mocap_pos.set(this.facts.fingertips_m[cube], 3 * this.hand);
    this.mujoco.mj_forward(this.model, this.data);
  }

  /**
   * Begin a macro-action.
   * @param {import('./rules.js').Turn[]} turns
   * @param {boolean} slips whether the fingers open too early
   */
  begin(turns, slips) {
    this.under = turns.map((turn) => ({ motion: this.motions.of(this.facts.cubes, turn, slips), step: 0 }));
    this.rest();
  }

  /**
   * Carry on with the macro-action for so many timesteps.
   * @param {number} steps
   * @returns {boolean} whether the arm still moves
   */
  advance(steps) {
    for (let each = 0; each < steps && this.under.length > 0; each += 1) {
      const current = this.under[0];
      this.#command(current.motion, current.step);
      this.mujoco.mj_step(this.model, this.data);
      current.step += 1;
      if (current.step >= current.motion.steps) {
        this.under.shift();
        this.rest();
      }
    }
    return this.under.length > 0;
  }

  /**
   * @param {Motion} motion
   * @param {number} step
   */
  #command(motion, step) {
    const { every, columns } = this.motions;
    const before = Math.min(Math.floor(step / every), motion.rows - 2);
    const begun = before * every;
    const length = before === motion.rows - 2 ? motion.steps - 1 - begun : every;
    const share = Math.min((step - begun) / length, 1);
    const ctrl = this.data.ctrl;
    this.facts.arm_ctrl.forEach((column, servo) => {
      const at = before * columns + Math.min(servo, columns - 1);
      const { commands } = motion;
      ctrl[column] = commands[at] + share * (commands[at + columns] - commands[at]);
    });
  }

  /**
   * The macrostate as the cubes stand, and why they stand wrong, if they do.
   * @param {number} pointed
   * @returns {{macrostate: import('./rules.js').State, fault: string|null}}
   */
  read(pointed) {
    const macrostate = [];
    let fault = null;
    this.facts.slots_m.forEach((slot, cube) => {
      const [x, y, z, w, i, j, k] = this.data.qpos.slice(this.facts.cube_qpos[cube], this.facts.cube_qpos[cube] + 7);
      const yaw = Math.atan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k));
      const quarters = Math.round(yaw / QUARTER);
      macrostate.push((4 - (quarters % 4)) % 4);
      const upright = 1 - 2 * (i * i + j * j);
      if (upright < LEAST_UPRIGHT) fault ??= `cube ${cube + 1} is tipped`;
      if (Math.hypot(x - slot[0], y - slot[1]) > MOST_OFF_M) fault ??= `cube ${cube + 1} stands off its place`;
      if (Math.abs(z - slot[2]) > MOST_LIFT_M) fault ??= `cube ${cube + 1} is not on the table`;
      if (Math.abs(yaw - quarters * QUARTER) > MOST_SKEW) fault ??= `cube ${cube + 1} stands off a right angle`;
    });
    return { macrostate: [...macrostate, pointed], fault };
  }

  /** Free the memory of the WebAssembly module. */
  free() {
    this.data.delete();
    this.model.delete();
  }
}
