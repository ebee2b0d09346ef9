// The buttons and keys of pick-and-place, and its words: each object has a card, and so has the human's palm.

import { PICK_PLACE } from './constants.js';
import { cardOf, keysOf } from './elements.js';
import { heldObject } from './pick_rules.js';
import { oddities, rewardOf } from './words.js';

const OBJECTS = PICK_PLACE.objects.length;
const { picked: PICKED, openPalm: OPEN_PALM, withdrawn: WITHDRAWN, handOver: HAND_OVER } = PICK_PLACE;
const PLACES = ['on the table', 'in the gripper', 'handed over'];

/** The controls of a world of pick-and-place. */
export class PickControls {
  /**
   * @param {import('./pick_rules.js').PickRules} rules
   * @param {(action: number) => void} act called with a macro-action that somebody asked for
   */
  constructor(rules, act) {
    this.rules = rules;
    this.act = act;
    this.chosen = null;
    this.title = 'Pick-and-place with a human';
    this.unit = ['action', 'actions'];
    this.columns = 2;
    this.nObjects = OBJECTS;
    this.cards = PICK_PLACE.objects.map(
      (name, index) => cardOf(`${index + 1} · ${name}`, [['pick up', `Pick up or put back the ${name}`, () => act(index)]]),
    );
    this.cards.push(cardOf(`${HAND_OVER + 1} · palm`, [['hand over', 'Hand over', () => act(HAND_OVER)]]));
    this.cards.forEach((card) => card.box.classList.add('words'));
  }

  /** @returns {string} */
  get goal() {
    const goal = 'Do as the human shows: pick up the object that they point at, put it back if they then point at '
      + 'another one, and hand it over if they open their palm. A wrong action ends the episode.';
    return `${goal} ${oddities(this.rules.world)}`.trim();
  }

  /** @returns {Node[]} */
  get keys() {
    const last = String(OBJECTS);
    return keysOf`Keys: ${'1'} to ${last} pick up or put back an object, ${String(HAND_OVER + 1)} hands over, ${'N'} starts anew.`;
  }

  /**
   * @param {import('./outcomes.js').State} state
   * @returns {string} whose turn it is, and the human's wish
   */
  opening(state) {
    return `Your turn. ${this.#wish(state)}`;
  }

  /** The sentence about an episode without macro-actions. */
  get still() {
    return 'No object was picked up in it, so the arm stands still here.';
  }

  /** @param {import('./outcomes.js').State} state */
  #wish(state) {
    const gesture = state[OBJECTS];
    if (gesture === OPEN_PALM) return 'The human opens their palm.';
    return gesture === WITHDRAWN ? '' : `The human points at the ${PICK_PLACE.objects[gesture]}.`;
  }

  /**
   * @param {string} key
   * @returns {boolean} whether the key means something
   */
  key(key) {
    const action = Number(key) - 1;
    if (!Number.isInteger(action) || action < 0 || action >= this.rules.nActions) return false;
    this.act(action);
    return true;
  }

  /**
   * @param {import('./game.js').Game} game
   * @param {boolean} isOff whether nothing can be asked for now
   */
  update({ state, shown }, isOff) {
    const gesture = state[OBJECTS];
    this.cards.forEach((card, index) => {
      const isPalm = index === HAND_OVER;
      if (isPalm) card.value.textContent = shown && gesture === OPEN_PALM ? 'open' : '';
      else card.value.textContent = PLACES[state[index]];
      card.asked.textContent = shown && !isPalm && gesture === index ? 'pointed at' : '';
      if (!isPalm) card.buttons[0].textContent = state[index] === PICKED ? 'put back' : 'pick up';
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
    const reward = rewardOf(outcome);
    if (fault) return { text: `The physics went wrong: ${fault}.`, tone: 'bad' };
    if (outcome.success) return { text: `Solved: handed over after ${game.steps} actions. ${reward}`, tone: 'good' };
    if (outcome.terminated) {
      return { text: `The human did not ask for this and withdraws. The episode is over. ${reward}`, tone: 'bad' };
    }
    if (game.over) return { text: 'No actions are left. The episode is over.', tone: 'bad' };
    if (slipped) return { text: `The fingers slipped: everything is as it was. ${reward}`, tone: 'bad' };
    const done = heldObject(outcome.macrostate) === null ? 'Put back.' : 'Picked up.';
    const wish = game.shown ? this.#wish(outcome.macrostate) : '';
    return { text: [done, wish, reward].filter(Boolean).join(' '), tone: '' };
  }
}
