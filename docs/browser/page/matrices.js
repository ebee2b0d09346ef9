// 4 x 4 matrices, a column after another, as WebGL takes them.

/** @typedef {Float32Array} Matrix */

/**
 * @param {Matrix} left
 * @param {Matrix} right
 * @returns {Matrix}
 */
export function times(left, right) {
  const product = new Float32Array(16);
  for (let column = 0; column < 4; column += 1) {
    for (let row = 0; row < 4; row += 1) {
      let sum = 0;
      for (let each = 0; each < 4; each += 1) sum += left[4 * each + row] * right[4 * column + each];
      product[4 * column + row] = sum;
    }
  }
  return product;
}

/**
 * @param {number} fovy vertical field of view (rad)
 * @param {number} aspect
 * @param {number} near
 * @param {number} far
 * @returns {Matrix}
 */
export function perspective(fovy, aspect, near, far) {
  const scale = 1 / Math.tan(fovy / 2);
  const depth = near - far;
  return new Float32Array([
    scale / aspect, 0, 0, 0, 0, scale, 0, 0, 0, 0, (far + near) / depth, -1, 0, 0, (2 * far * near) / depth, 0,
  ]);
}

/**
 * @param {number} half half the width and height of the view
 * @param {number} near
 * @param {number} far
 * @returns {Matrix}
 */
export function orthographic(half, near, far) {
  const depth = near - far;
  return new Float32Array([
    1 / half, 0, 0, 0, 0, 1 / half, 0, 0, 0, 0, 2 / depth, 0, 0, 0, (far + near) / depth, 1,
  ]);
}

const minus = (a, b) => a.map((value, index) => value - b[index]);
const dot = (a, b) => a.reduce((sum, value, index) => sum + value * b[index], 0);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((value) => value / Math.hypot(...a));

/**
 * The view of a camera whose axes and place are given.
 * @param {number[]} right
 * @param {number[]} up
 * @param {number[]} back
 * @param {number[]} eye
 * @returns {Matrix}
 */
export function viewFrom(right, up, back, eye) {
  return new Float32Array([
    right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2], 0,
    -dot(right, eye), -dot(up, eye), -dot(back, eye), 1,
  ]);
}

/**
 * The view of a camera that looks from one point at another, with z up.
 * @param {number[]} eye
 * @param {number[]} target
 * @returns {Matrix}
 */
export function lookAt(eye, target) {
  const back = unit(minus(eye, target));
  const right = unit(cross([0, 0, 1], back));
  return viewFrom(right, cross(back, right), back, eye);
}
