// A world model that was trained by the package, run by hand: an encoder, three networks that predict the next latents,
// reward and end, and a decoder. All are dense layers with ReLU; weights come as 16-bit floats.

const WHOLE = 64;
const STRIPS = 3;
const STRIP_WIDTH = 22;
const STARTS = [0, 21, 42];
const LUMA = [0.299, 0.587, 0.114];
const LEAST_VARIANCE = 0.005 ** 2;

/**
 * @param {number} bits of a 16-bit float
 * @returns {number}
 */
function half(bits) {
  const sign = bits & 0x8000 ? -1 : 1;
  const exponent = (bits >> 10) & 31;
  const fraction = bits & 1023;
  if (exponent === 0) return sign * fraction * 2 ** -24;
  return sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
}

/**
 * @typedef {{weight: Float32Array, bias: Float32Array, inputs: number, outputs: number}} Layer
 */

/**
 * @param {Layer[]} layers
 * @param {Float32Array} values
 * @returns {Float32Array}
 */
function dense(layers, values) {
  let current = values;
  layers.forEach((layer, index) => {
    const next = Float32Array.from(layer.bias);
    for (let input = 0; input < layer.inputs; input += 1) {
      const value = current[input];
      if (value === 0) continue;
      const row = input * layer.outputs;
      for (let output = 0; output < layer.outputs; output += 1) next[output] += value * layer.weight[row + output];
    }
    if (index < layers.length - 1) next.forEach((value, output) => { next[output] = Math.max(value, 0); });
    current = next;
  });
  return current;
}

/**
 * The gray strips of a frame, one a cube, in [0, 1].
 * @param {ArrayLike<number>} rgba 64 x 64 pixels
 * @returns {Float32Array[]}
 */
export function strips(rgba) {
  return STARTS.map((start) => {
    const strip = new Float32Array(WHOLE * STRIP_WIDTH);
    for (let row = 0; row < WHOLE; row += 1) {
      for (let column = 0; column < STRIP_WIDTH; column += 1) {
        const pixel = 4 * (row * WHOLE + start + column);
        const gray = LUMA[0] * rgba[pixel] + LUMA[1] * rgba[pixel + 1] + LUMA[2] * rgba[pixel + 2];
        strip[row * STRIP_WIDTH + column] = gray / 255;
      }
    }
    return strip;
  });
}

/**
 * @param {Float32Array} pixels
 * @returns {Float32Array} with mean 0 and standard deviation 1
 */
function standardised(pixels) {
  const mean = pixels.reduce((sum, value) => sum + value, 0) / pixels.length;
  const variance = pixels.reduce((sum, value) => sum + (value - mean) ** 2, 0) / pixels.length;
  return pixels.map((value) => (value - mean) / Math.sqrt(variance + LEAST_VARIANCE));
}

/** The trained model. */
export class WorldModel {
  /** @param {ArrayBuffer} buffer a header's length, a JSON header, and 16-bit floats */
  constructor(buffer) {
    const length = new DataView(buffer).getUint32(0, true);
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
    const bits = new Uint16Array(buffer.slice(4 + length));
    let offset = 0;
    const take = (count) => {
      const values = Float32Array.from(bits.subarray(offset, offset + count), half);
      offset += count;
      return values;
    };
    const network = (sizes) => sizes.slice(1).map((outputs, index) => {
      const inputs = sizes[index];
      return { inputs, outputs, weight: take(inputs * outputs), bias: take(outputs) };
    });
    this.header = header;
    this.encoder = network(header.encoder);
    this.decoder = network(header.decoder);
    this.members = header.members.map(network);
    this.reward = network(header.reward);
    this.termination = network(header.termination);
  }

  /**
   * The latents of a frame.
   * @param {ArrayLike<number>} rgba 64 x 64 pixels
   * @returns {Float32Array}
   */
  encode(rgba) {
    const found = strips(rgba).map((strip) => dense(this.encoder, standardised(strip)));
    const each = found[0].length / 2;
    const latents = new Float32Array(STRIPS * each);
    found.forEach((outputs, strip) => latents.set(outputs.subarray(0, each), strip * each));
    return latents;
  }

  /**
   * The image of latents: 64 x 64 gray values in [0, 1].
   * @param {Float32Array} latents
   * @returns {Float32Array}
   */
  decode(latents) {
    const { brightness, contrast } = this.header;
    const each = latents.length / STRIPS;
    const whole = new Float32Array(WHOLE * WHOLE).fill(0.5);
    for (let strip = STRIPS - 1; strip >= 0; strip -= 1) {
      const pixels = dense(this.decoder, latents.slice(strip * each, (strip + 1) * each));
      for (let row = 0; row < WHOLE; row += 1) {
        for (let column = 0; column < STRIP_WIDTH; column += 1) {
          const value = brightness + contrast * pixels[row * STRIP_WIDTH + column];
          whole[row * WHOLE + STARTS[strip] + column] = Math.min(Math.max(value, 0), 1);
        }
      }
    }
    return whole;
  }

  /**
   * One member's mean of the next latents.
   * @param {Layer[]} member
   * @param {Float32Array} latents
   * @param {number} action
   * @returns {Float32Array}
   */
  #meanOf(member, latents, action) {
    const { components, actions, predict_change: change } = this.header;
    const size = latents.length;
    const inputs = new Float32Array(size + actions);
    inputs.set(latents);
    inputs[size + action] = 1;
    const outputs = dense(member, inputs);
    const largest = Math.max(...outputs.subarray(0, components));
    const weights = Array.from(outputs.subarray(0, components), (value) => Math.exp(value - largest));
    const total = weights.reduce((sum, weight) => sum + weight, 0);
    const mean = new Float32Array(size);
    for (let component = 0; component < components; component += 1) {
      for (let index = 0; index < size; index += 1) {
        mean[index] += (weights[component] / total) * outputs[components + component * size + index];
      }
    }
    return change ? mean.map((value, index) => value + latents[index]) : mean;
  }

  /**
   * The outcome that the model expects of a macro-action.
   * @param {Float32Array} latents
   * @param {number} action
   * @returns {{latents: Float32Array, reward: number, ends: number, disagreement: number}}
   */
  imagine(latents, action) {
    const means = this.members.map((member) => this.#meanOf(member, latents, action));
    const next = means[0].map((_, index) => means.reduce((sum, mean) => sum + mean[index], 0) / means.length);
    const squares = means.map((mean) => mean.reduce((sum, value, index) => sum + (value - next[index]) ** 2, 0));
    const logit = dense(this.termination, next)[0];
    return {
      latents: next,
      reward: dense(this.reward, next)[0] * this.header.reward_scale,
      ends: 1 / (1 + Math.exp(-logit)),
      disagreement: squares.reduce((sum, value) => sum + value, 0) / means.length,
    };
  }
}
