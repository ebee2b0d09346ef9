// Draws a scene with WebGL: one light with a shadow, the sky's light from above, and the robot's own view in a corner.

import { lookAt, orthographic, perspective, times, viewFrom } from './matrices.js';
import { trianglesOf } from './shapes.js';

const SHADOW_PX = 1024;
const LIGHT = [0.35, -0.55, 1.1];
const MIDDLE = [0.48, 0, 0.04];
const SHOWN = [0, 2, 3];
const SHOWN_TO_ROBOT = [0, 1];
const SKIES = { light: [0.929, 0.937, 0.949], dark: [0.098, 0.11, 0.133] };

const VERTEX = `#version 300 es
layout(location = 0) in vec3 place;
layout(location = 1) in vec3 normal;
uniform mat4 model, camera, light;
out vec3 facing, world;
out vec4 lit;
void main() {
  vec4 at = model * vec4(place, 1.0);
  world = at.xyz;
  facing = mat3(model) * normal;
  lit = light * (at + vec4(0.002 * facing, 0.0));
  gl_Position = camera * at;
}`;

const FRAGMENT = `#version 300 es
precision highp float;
precision highp sampler2DShadow;
in vec3 facing, world;
in vec4 lit;
uniform vec4 color;
uniform vec3 sun, eye, sky;
uniform float shine, fades;
uniform sampler2DShadow shadow;
out vec4 pixel;
float sunlit() {
  vec3 at = 0.5 * lit.xyz + 0.5;
  if (any(lessThan(at, vec3(0.0))) || any(greaterThan(at, vec3(1.0)))) return 1.0;
  float sum = 0.0;
  for (int x = -1; x <= 1; x++)
    for (int y = -1; y <= 1; y++)
      sum += texture(shadow, vec3(at.xy + 1.3 * vec2(x, y) / ${SHADOW_PX}.0, at.z - 0.0012));
  return sum / 9.0;
}
void main() {
  vec3 n = normalize(facing);
  vec3 look = normalize(eye - world);
  float direct = max(dot(n, sun), 0.0) * sunlit();
  vec3 around = mix(vec3(0.36, 0.34, 0.33), vec3(0.62, 0.64, 0.68), 0.5 + 0.5 * n.z);
  float gleam = shine * pow(max(dot(n, normalize(sun + look)), 0.0), 36.0) * direct;
  vec3 shade = color.rgb * (around + 0.62 * direct) + gleam;
  float away = fades * smoothstep(0.5, 1.6, length(world.xy - vec2(0.4, 0.0)));
  pixel = vec4(mix(shade, sky, away), 1.0);
}`;

const SHADOW_VERTEX = `#version 300 es
layout(location = 0) in vec3 place;
uniform mat4 model, light;
void main() { gl_Position = light * model * vec4(place, 1.0); }`;

const SHADOW_FRAGMENT = `#version 300 es
precision mediump float;
void main() {}`;

/**
 * @param {WebGL2RenderingContext} gl
 * @param {string} vertex
 * @param {string} fragment
 * @returns {{program: WebGLProgram, at: Object<string, WebGLUniformLocation>}}
 */
function programOf(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program) ?? 'no program');
  const at = {};
  for (let index = 0; index < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); index += 1) {
    const { name } = gl.getActiveUniform(program, index);
    at[name] = gl.getUniformLocation(program, name);
  }
  return { program, at };
}

/** The picture of a scene on a canvas. */
export class View {
  /**
   * @param {HTMLCanvasElement} canvas
   * @throws {Error} without WebGL 2
   */
  constructor(canvas) {
    const gl = canvas.getContext('webgl2', { antialias: true, alpha: false });
    if (!gl) throw new Error('This browser draws no WebGL 2; try a newer one.');
    this.canvas = canvas;
    this.gl = gl;
    this.lit = programOf(gl, VERTEX, FRAGMENT);
    this.dark = programOf(gl, SHADOW_VERTEX, SHADOW_FRAGMENT);
    this.#makeShadow();
    this.turn = -0.42;
    this.height = 0.62;
    this.distance = 1;
    this.hidesHand = false;
    this.parts = [];
  }

  #makeShadow() {
    const { gl } = this;
    this.shadow = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.shadow);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.DEPTH_COMPONENT24, SHADOW_PX, SHADOW_PX);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_COMPARE_MODE, gl.COMPARE_REF_TO_TEXTURE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
    this.shadowFrame = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.shadowFrame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, this.shadow, 0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  /**
   * Take up another scene.
   * @param {import('./scene.js').Scene} scene
   */
  show(scene) {
    const { gl } = this;
    const { model } = scene;
    this.parts.forEach((part) => { gl.deleteVertexArray(part.array); gl.deleteBuffer(part.buffer); });
    this.scene = scene;
    const hands = scene.facts.hands.map((name) => model.body(name).id);
    this.camera = model.cam('wrist').id;
    this.parts = [];
    for (let geom = 0; geom < model.ngeom; geom += 1) {
      const triangles = trianglesOf(model, geom);
      const group = model.geom_group[geom];
      if (triangles.length === 0 || (!SHOWN.includes(group) && !SHOWN_TO_ROBOT.includes(group))) continue;
      const array = gl.createVertexArray();
      const buffer = gl.createBuffer();
      gl.bindVertexArray(array);
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, triangles, gl.STATIC_DRAW);
      [0, 1].forEach((slot) => {
        gl.enableVertexAttribArray(slot);
        gl.vertexAttribPointer(slot, 3, gl.FLOAT, false, 24, 12 * slot);
      });
      const material = model.geom_matid[geom];
      const from = material < 0 ? model.geom_rgba : model.mat_rgba;
      const row = material < 0 ? geom : material;
      const isFloor = model.geom_type[geom] === 0;
      this.parts.push({
        geom, array, buffer, group, isFloor,
        count: triangles.length / 6,
        color: Array.from(from.slice(4 * row, 4 * row + 4)),
        isHand: hands.includes(model.geom_bodyid[geom]),
      });
    }
    gl.bindVertexArray(null);
  }

  /** The place that the camera looks from. */
  get eye() {
    const narrow = Math.max(1, 0.9 / this.aspect);
    const away = 1.24 * this.distance * narrow;
    return [
      MIDDLE[0] + away * Math.sin(this.turn) * Math.cos(this.height),
      MIDDLE[1] - away * Math.cos(this.turn) * Math.cos(this.height),
      MIDDLE[2] + away * Math.sin(this.height),
    ];
  }

  /** @returns {number} */
  get aspect() {
    return this.canvas.width / Math.max(this.canvas.height, 1);
  }

  /** Bring the canvas to the size at which it is shown. */
  #resize() {
    const scale = Math.min(globalThis.devicePixelRatio || 1, 2);
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight].map((px) => Math.round(px * scale));
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
  }

  /**
   * @param {number} geom
   * @returns {Float32Array} its pose
   */
  #poseOf(geom) {
    const place = this.scene.data.geom_xpos;
    const turn = this.scene.data.geom_xmat;
    const [p, m] = [3 * geom, 9 * geom];
    return new Float32Array([
      turn[m], turn[m + 3], turn[m + 6], 0, turn[m + 1], turn[m + 4], turn[m + 7], 0,
      turn[m + 2], turn[m + 5], turn[m + 8], 0, place[p], place[p + 1], place[p + 2], 1,
    ]);
  }

  /**
   * @param {any} drawn a program
   * @param {number[]} groups
   * @param {boolean} casts whether only bodies that cast a shadow are drawn
   */
  #drawParts(drawn, groups, casts) {
    const { gl } = this;
    for (const part of this.parts) {
      if (!groups.includes(part.group) || (part.isHand && this.hidesHand) || (casts && part.isFloor)) continue;
      gl.uniformMatrix4fv(drawn.at.model, false, this.#poseOf(part.geom));
      if (drawn.at.color) {
        gl.uniform4fv(drawn.at.color, part.isFloor ? [...this.sky.map((value) => 0.8 * value), 1] : part.color);
        gl.uniform1f(drawn.at.fades, part.isFloor ? 1 : 0);
        gl.uniform1f(drawn.at.shine, part.group === 2 ? 0.35 : 0.06);
      }
      gl.bindVertexArray(part.array);
      gl.drawArrays(gl.TRIANGLES, 0, part.count);
    }
  }

  /** @returns {number[]} the color behind everything */
  get sky() {
    return globalThis.matchMedia?.('(prefers-color-scheme: dark)').matches ? SKIES.dark : SKIES.light;
  }

  /**
   * @param {Float32Array} camera
   * @param {number[]} eye
   * @param {number[]} box left, bottom, width and height in pixels
   * @param {number[]} groups
   */
  #drawFrom(camera, eye, box, groups) {
    const { gl, lit } = this;
    gl.viewport(...box);
    gl.scissor(...box);
    gl.clearColor(...this.sky, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.useProgram(lit.program);
    gl.uniformMatrix4fv(lit.at.camera, false, camera);
    gl.uniformMatrix4fv(lit.at.light, false, this.light);
    const length = Math.hypot(...LIGHT);
    gl.uniform3fv(lit.at.sun, LIGHT.map((value) => value / length));
    gl.uniform3fv(lit.at.eye, eye);
    gl.uniform3fv(lit.at.sky, this.sky);
    gl.bindTexture(gl.TEXTURE_2D, this.shadow);
    gl.uniform1i(lit.at.shadow, 0);
    this.#drawParts(lit, groups, false);
  }

  /** Draw the scene as it is now. */
  draw() {
    if (!this.scene) return;
    this.#resize();
    const { gl } = this;
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.SCISSOR_TEST);
    this.light = times(orthographic(0.8, 0.2, 3), lookAt(LIGHT.map((value, axis) => value + MIDDLE[axis]), MIDDLE));
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.shadowFrame);
    gl.viewport(0, 0, SHADOW_PX, SHADOW_PX);
    gl.scissor(0, 0, SHADOW_PX, SHADOW_PX);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.useProgram(this.dark.program);
    gl.uniformMatrix4fv(this.dark.at.light, false, this.light);
    this.#drawParts(this.dark, SHOWN, true);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    const { width, height } = this.canvas;
    this.#drawFrom(this.camera4(), this.eye, [0, 0, width, height], SHOWN);
    this.#drawRobotsView(width, height);
  }

  /** @returns {Float32Array} the matrix from the world to the picture */
  camera4() {
    return times(perspective(0.68, this.aspect, 0.05, 8), lookAt(this.eye, MIDDLE));
  }

  /**
   * @param {number} width
   * @param {number} height
   */
  #drawRobotsView(width, height) {
    const { data, facts } = this.scene;
    const side = Math.round(Math.min(width * 0.24, height * 0.34));
    const edge = Math.round(side * 0.06);
    const axes = data.cam_xmat.slice(9 * this.camera, 9 * this.camera + 9);
    const column = (index) => [axes[index], axes[3 + index], axes[6 + index]];
    const eye = Array.from(data.cam_xpos.slice(3 * this.camera, 3 * this.camera + 3));
    const seen = viewFrom(column(0), column(1), column(2), eye);
    const camera = times(perspective((facts.fovy_deg * Math.PI) / 180, 1, 0.02, 4), seen);
    this.#drawFrom(camera, eye, [width - side - edge, height - side - edge, side, side], SHOWN_TO_ROBOT);
  }

  /**
   * Where a point of the world is on the canvas, as shares of its width and height from the top left.
   * @param {number[]} point
   * @returns {{x: number, y: number}}
   */
  project(point) {
    const camera = this.camera4();
    const at = [0, 1, 2, 3].map(
      (row) => camera[row] * point[0] + camera[4 + row] * point[1] + camera[8 + row] * point[2] + camera[12 + row],
    );
    return { x: 0.5 + at[0] / at[3] / 2, y: 0.5 - at[1] / at[3] / 2 };
  }
}
