// A table and the arm in MuJoCo. A macro-action replays commands that the package's planner made; the servos move the arm,
// and contact alone moves objects.

const ARM_JOINTS = 7;

/**
 * @typedef {object} SceneFacts
 * @property {number[]} qpos positions of everything at rest
 * @property {number[]} ctrl commands at rest
 * @property {number[]} arm_ctrl the servos of the arm's joints and of both fingers
 * @property {number[]} arm_qpos
 * @property {number[]} object_qpos where each object's pose begins
 * @property {number[][]} slots_m
 * @property {number[][]} fingertips_m
 * @property {string[]} hands bodies of the human's hands
 * @property {number} fovy_deg
 *
 * @typedef {object} Motion
 * @property {Float32Array} commands rows of seven joints and one opening
 * @property {number} rows
 * @property {number} steps
 */

/** Planned motions, looked up by their names. */
export class Motions {
  /**
   * @param {{every: number, columns: number, motions: [string, number, number, number][]}} index
   * @param {ArrayBuffer} rows
   */
  constructor(index, rows) {
    this.every = index.every;
    this.columns = index.columns;
    const values = new Float32Array(rows);
    /** @type {Map<string, Motion>} */
    this.found = new Map();
    for (const [name, first, count, steps] of index.motions) {
      const commands = values.subarray(first * this.columns, (first + count) * this.columns);
      this.found.set(name, { commands, rows: count, steps });
    }
  }

  /**
   * @param {string} name
   * @returns {Motion}
   */
  of(name) {
    return this.found.get(name);
  }
}

/** One scene with its arm. A task adds how macrostates are put and read, and which motions a macro-action has. */
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
    this.mocaps = facts.hands.map((name) => this.model.body_mocapid[this.model.body(name).id]);
    /** @type {{motion: Motion, step: number}[]} */
    this.under = [];
  }

  /** Put everything where it rests. */
  clear() {
    this.under = [];
    this.mujoco.mj_resetData(this.model, this.data);
    this.data.qpos.set(this.facts.qpos);
  }

  /**
   * Put the human's hands.
   * @param {number[][]} places_m one for each hand
   */
  putHands(places_m) {
    places_m.forEach((place, hand) => this.data.mocap_pos.set(place, 3 * this.mocaps[hand]));
    this.mujoco.mj_forward(this.model, this.data);
  }

  /**
   * @param {number} index
   * @returns {number[]} the place and the quaternion of an object
   */
  poseOf(index) {
    const begin = this.facts.object_qpos[index];
    return Array.from(this.data.qpos.slice(begin, begin + 7));
  }

  /**
   * The start of every macro-action: the arm at its observation pose, everything still, objects where they are.
   * @param {number|null} squeeze_m the command to each finger that holds something; null opens the fingers
   */
  rest(squeeze_m = null) {
    const { mujoco, model, data, facts } = this;
    const qpos = Float64Array.from(data.qpos);
    const hand = Float64Array.from(data.mocap_pos);
    const turned = Float64Array.from(data.mocap_quat);
    const put = squeeze_m === null ? facts.arm_qpos : facts.arm_qpos.slice(0, ARM_JOINTS);
    put.forEach((column) => { qpos[column] = facts.qpos[column]; });
    mujoco.mj_resetData(model, data);
    data.qpos.set(qpos);
    data.mocap_pos.set(hand);
    data.mocap_quat.set(turned);
    data.ctrl.set(facts.ctrl);
    if (squeeze_m !== null) facts.arm_ctrl.slice(ARM_JOINTS).forEach((column) => { data.ctrl[column] = squeeze_m; });
    mujoco.mj_forward(model, data);
  }

  /**
   * Begin a macro-action: its motions, one after another.
   * @param {string[]} names
   */
  perform(names) {
    this.under = names.map((name) => ({ motion: this.motions.of(name), step: 0 }));
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

  /** Free the memory of the WebAssembly module. */
  free() {
    this.data.delete();
    this.model.delete();
  }
}
