// One episode after another in a world: whose turn it is, the outcome of each turn, and how it ended. No page, no drawing.

/**
 * Numbers in [0, 1) that repeat with their seed (Mulberry32).
 * @param {number} seed
 * @returns {() => number}
 */
export function generator(seed) {
  let state = seed >>> 0;
  return () => {
    state = (state + 0x6d2b79f5) >>> 0;
    let word = Math.imul(state ^ (state >>> 15), state | 1);
    word ^= word + Math.imul(word ^ (word >>> 7), word | 61);
    return ((word ^ (word >>> 14)) >>> 0) / 4294967296;
  };
}

/** The game in a world. */
export class Game {
  /**
   * @param {import('./families.js').Rules} rules
   * @param {() => number} random
   */
  constructor(rules, random) {
    this.rules = rules;
    this.random = random;
    this.played = 0;
    this.solved = 0;
    this.reset();
  }

  /**
   * Begin an episode.
   * @param {import('./outcomes.js').State} [start] drawn if it is left out
   */
  reset(start) {
    const { starts } = this.rules;
    this.state = start ?? this.rules.stateOf(starts[Math.floor(this.random() * starts.length)]);
    this.left = this.rules.horizon;
    this.steps = 0;
    this.over = false;
    this.shown = this.#showsGesture();
  }

  /** @returns {boolean} whether the hand is in view */
  #showsGesture() {
    const { gesture } = this.rules.world;
    if (gesture === 'always') return true;
    if (gesture === 'first') return this.steps === 0;
    return this.random() < gesture;
  }

  /**
   * The macrostate that a macro-action shall lead to.
   * @param {number} action
   * @returns {import('./outcomes.js').State}
   */
  intend(action) {
    return this.rules.draw(this.state, action, this.random()).macrostate;
  }

  /**
   * Take in the macrostate that was read from the scene.
   * @param {number} action
   * @param {import('./outcomes.js').State} reached
   * @returns {import('./outcomes.js').Outcome}
   */
  reach(action, reached) {
    const outcome = this.rules.judged(this.state, action, reached);
    this.state = reached;
    this.steps += 1;
    this.left -= 1;
    this.over = outcome.terminated || this.left === 0;
    this.shown = this.#showsGesture();
    if (this.over) {
      this.played += 1;
      this.solved += Number(outcome.success);
    }
    return outcome;
  }
}
