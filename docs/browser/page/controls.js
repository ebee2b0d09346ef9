// The buttons and keys of the arrow puzzle, and its words: each cube has a card with its arrow and two buttons.

import { cardOf, keysOf } from './elements.js';
import { ARROWS, goalOf, happened, oddities } from './words.js';

const ORDINALS = ['first', 'second', 'third', 'fourth', 'fifth', 'sixth'];

/** The controls of a world of the arrow puzzle. */
export class ArrowControls {
  /**
   * @param {import('./rules.js').ArrowRules} rules
   * @param {(action: number) => void} act called with a macro-action that somebody asked for
   * @param {() => void} changed called when another cube is chosen
   */
  constructor(rules, act, changed) {
    this.rules = rules;
    this.act = act;
    this.changed = changed;
    this.chosen = 0;
    this.title = 'The arrow puzzle';
    this.unit = ['turn', 'turns'];
    const { cubes } = rules.world;
    this.columns = cubes > 3 ? Math.ceil(cubes / 2) : cubes;
    this.nObjects = cubes;
    this.cards = Array.from({ length: cubes }, (_, cube) => cardOf(`cube ${cube + 1}`, [
      ['↺', `Turn the ${ORDINALS[cube]} cube counter-clockwise`, () => this.#turn(cube, false)],
      ['↻', `Turn the ${ORDINALS[cube]} cube clockwise`, () => this.#turn(cube, true)],
    ]));
  }

  /** @returns {string} */
  get goal() {
    return [goalOf(this.rules), oddities(this.rules.world)].join(' ').trim();
  }

  /** @returns {Node[]} */
  get keys() {
    const last = String(this.rules.world.cubes);
    return keysOf`Keys: ${'1'} to ${last} choose a cube, ${'→'} turns it clockwise, ${'←'} the other way, ${'N'} starts anew.`;
  }

  /**
   * @param {import('./outcomes.js').State} state
   * @returns {string} whose turn it is, and the human's wish
   */
  opening(state) {
    return `Your turn. The hand points at cube ${state.at(-1) + 1}.`;
  }

  /** The sentence about an episode without macro-actions. */
  get still() {
    return 'No arrow was turned in it, so the arm stands still here.';
  }

  /**
   * @param {number} cube
   * @param {boolean} clockwise
   */
  #turn(cube, clockwise) {
    this.#choose(cube);
    this.act(this.rules.turns.findIndex(([own]) => own.cube === cube && own.clockwise === clockwise));
  }

  /** @param {number} cube */
  #choose(cube) {
    this.chosen = cube;
    this.changed();
  }

  /**
   * @param {string} key
   * @returns {boolean} whether the key means something
   */
  key(key) {
    const cube = Number(key) - 1;
    if (cube >= 0 && cube < this.rules.world.cubes) this.#choose(cube);
    else if (key === 'ArrowRight') this.#turn(this.chosen, true);
    else if (key === 'ArrowLeft') this.#turn(this.chosen, false);
    else return false;
    return true;
  }

  /**
   * @param {import('./game.js').Game} game
   * @param {boolean} isOff whether nothing can be asked for now
   */
  update({ state, shown }, isOff) {
    const pointed = state.at(-1);
    this.cards.forEach((card, cube) => {
      card.box.classList.toggle('chosen', cube === this.chosen);
      card.value.textContent = ARROWS[state[cube]];
      card.asked.textContent = shown && cube === pointed ? 'pointed at' : '';
      card.buttons.forEach((button) => { button.disabled = isOff; });
    });
  }

  /**
   * @param {import('./game.js').Game} game after a macro-action
   * @param {import('./outcomes.js').Outcome} outcome
   * @param {boolean} slipped
   * @param {string|null} fault
   * @returns {{text: string, tone: string}}
   */
  happened(game, outcome, slipped, fault) {
    return happened(game, outcome, slipped, fault);
  }
}
