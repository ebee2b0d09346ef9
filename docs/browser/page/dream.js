// The world model beside the game: it sees one frame, then imagines every turn from its own imagination.

import { WorldModel } from './model.js';

const WHOLE = 64;
const COLUMNS = 16;

/** The panel of the world model. */
export class Dream {
  /**
   * @param {ArrayBuffer} weights
   * @param {ImageBitmap} atlas a frame of every macrostate
   */
  constructor(weights, atlas) {
    this.model = new WorldModel(weights);
    this.real = document.getElementById('real').getContext('2d', { willReadFrequently: true });
    this.imagined = document.getElementById('imagined').getContext('2d');
    this.atlas = atlas;
    this.latents = null;
    this.turns = 0;
  }

  /**
   * @param {number} row of the macrostate
   */
  #showReal(row) {
    const [x, y] = [WHOLE * (row % COLUMNS), WHOLE * Math.floor(row / COLUMNS)];
    this.real.drawImage(this.atlas, x, y, WHOLE, WHOLE, 0, 0, WHOLE, WHOLE);
  }

  #showImagined() {
    const image = this.imagined.createImageData(WHOLE, WHOLE);
    this.model.decode(this.latents).forEach((gray, pixel) => {
      image.data.set([255 * gray, 255 * gray, 255 * gray, 255], 4 * pixel);
    });
    this.imagined.putImageData(image, 0, 0);
  }

  /**
   * Let the model see the frame of a macrostate.
   * @param {number} row
   */
  look(row) {
    this.#showReal(row);
    this.latents = this.model.encode(this.real.getImageData(0, 0, WHOLE, WHOLE).data);
    this.turns = 0;
    this.#showImagined();
    this.#say('The model has just seen this frame. Turn a cube: it will imagine the next frame.');
  }

  /**
   * Imagine a macro-action, and say the expected outcome.
   * @param {import('./rules.js').Turn[]} turns
   * @param {number} row of the macrostate that was reached
   * @param {import('./outcomes.js').Outcome} outcome
   */
  follow(turns, row, outcome) {
    let found = null;
    for (const turn of turns) {
      found = this.model.imagine(this.latents, 2 * turn.cube + Number(!turn.clockwise));
      this.latents = found.latents;
    }
    this.turns += 1;
    this.#showReal(row);
    this.#showImagined();
    const ends = Math.round(100 * found.ends);
    this.#say(
      `Imagined for ${this.turns} ${this.turns === 1 ? 'turn' : 'turns'} without looking. It expected a reward of `
      + `${found.reward.toFixed(1)} (really ${outcome.reward}) and an end with ${ends} %. `
      + `Its three networks disagree by ${found.disagreement.toFixed(2)}.`,
    );
  }

  /** @param {string} text */
  #say(text) {
    document.getElementById('dream-text').textContent = text;
  }
}
