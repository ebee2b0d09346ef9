// The order that numpy's default generator gives to numbers: the parameter `shuffle` of a world is its seed.
// SeedSequence mixes the seed, PCG64 draws, and the order is a Fisher-Yates shuffle. 32-bit words are plain numbers.

const MASK_64 = (1n << 64n) - 1n;
const MASK_128 = (1n << 128n) - 1n;
const MULTIPLIER = (2549297995355413924n << 64n) | 4865540595714422341n;

/**
 * Four 64-bit words from a seed below 2^32, as numpy's SeedSequence makes them.
 * @param {number} seed
 * @returns {bigint[]}
 */
function seedWords(seed) {
  let hash = 0x43b0d7e5;
  const hashed = (value) => {
    let word = (value ^ hash) >>> 0;
    hash = Math.imul(hash, 0x931e8875) >>> 0;
    word = Math.imul(word, hash) >>> 0;
    return (word ^ (word >>> 16)) >>> 0;
  };
  const mixed = (left, right) => {
    const word = (Math.imul(left, 0xca01f9dd) - Math.imul(right, 0x4973f715)) >>> 0;
    return (word ^ (word >>> 16)) >>> 0;
  };
  const pool = [seed, 0, 0, 0].map(hashed);
  for (let from = 0; from < 4; from += 1) {
    for (let to = 0; to < 4; to += 1) {
      if (from !== to) pool[to] = mixed(pool[to], hashed(pool[from]));
    }
  }
  let output = 0x8b51f9dd;
  const words = [];
  for (let index = 0; index < 8; index += 1) {
    let word = (pool[index % 4] ^ output) >>> 0;
    output = Math.imul(output, 0x58f38ded) >>> 0;
    word = Math.imul(word, output) >>> 0;
    words.push(BigInt((word ^ (word >>> 16)) >>> 0));
  }
  return [0, 2, 4, 6].map((index) => words[index] | (words[index + 1] << 32n));
}

/**
 * Numbers below 2^32, one after another, as PCG64 gives them: each 64-bit word serves twice, its lower half first.
 * @param {number} seed
 * @returns {() => number}
 */
function wordsOf(seed) {
  const [high, low, streamHigh, streamLow] = seedWords(seed);
  const increment = ((((streamHigh << 64n) | streamLow) << 1n) | 1n) & MASK_128;
  let state = (increment + ((high << 64n) | low)) & MASK_128;
  const advance = () => {
    state = (state * MULTIPLIER + increment) & MASK_128;
  };
  advance();
  let kept = null;
  return () => {
    if (kept !== null) {
      const word = kept;
      kept = null;
      return word;
    }
    advance();
    const folded = (state >> 64n) ^ (state & MASK_64);
    const turn = state >> 122n;
    const drawn = ((folded >> turn) | (folded << (64n - turn))) & MASK_64;
    kept = Number(drawn >> 32n);
    return Number(drawn & 0xffffffffn);
  };
}

/**
 * The numbers from 0 to `count` - 1 in the order of `numpy.random.default_rng(seed).permutation(count)`.
 * @param {number} seed
 * @param {number} count
 * @returns {number[]}
 */
export function permutation(seed, count) {
  const next = wordsOf(seed);
  const order = Array.from({ length: count }, (_, index) => index);
  for (let last = count - 1; last > 0; last -= 1) {
    const bits = 2 ** Math.ceil(Math.log2(last + 1)) - 1;
    let chosen = (next() & bits) >>> 0;
    while (chosen > last) chosen = (next() & bits) >>> 0;
    [order[last], order[chosen]] = [order[chosen], order[last]];
  }
  return order;
}
