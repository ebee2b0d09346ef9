// Triangles of MuJoCo's geoms: boxes, spheres, capsules, ellipsoids, cylinders, a floor and meshes.

const PLANE = 0;
const SPHERE = 2;
const CAPSULE = 3;
const ELLIPSOID = 4;
const CYLINDER = 5;
const BOX = 6;
const MESH = 7;
const AROUND = 28;
const UP = 14;

/**
 * Positions and normals, three numbers each, a corner after another.
 * @typedef {number[]} Corners
 */

/**
 * A surface that is round about z, from points (radius, height) and their normals.
 * @param {{r: number, z: number, nr: number, nz: number}[]} outline
 * @returns {Corners}
 */
function lathe(outline) {
  const corners = [];
  const put = ({ r, z, nr, nz }, turn) => {
    const angle = (2 * Math.PI * turn) / AROUND;
    const [x, y] = [Math.cos(angle), Math.sin(angle)];
    corners.push(r * x, r * y, z, nr * x, nr * y, nz);
  };
  for (let index = 0; index + 1 < outline.length; index += 1) {
    const [low, high] = [outline[index], outline[index + 1]];
    for (let turn = 0; turn < AROUND; turn += 1) {
      [[low, turn], [low, turn + 1], [high, turn + 1]].forEach(([point, at]) => put(point, at));
      [[low, turn], [high, turn + 1], [high, turn]].forEach(([point, at]) => put(point, at));
    }
  }
  return corners;
}

/**
 * @param {number} radius
 * @param {number} half half the length of the straight part
 * @returns {Corners}
 */
function capsule(radius, half) {
  const outline = [];
  for (let step = 0; step <= UP; step += 1) {
    const angle = -Math.PI / 2 + (Math.PI * step) / UP;
    const [nr, nz] = [Math.cos(angle), Math.sin(angle)];
    const shift = step * 2 < UP ? -half : half;
    if (step * 2 === UP) outline.push({ r: radius, z: -half, nr: 1, nz: 0 });
    outline.push({ r: radius * nr, z: radius * nz + shift, nr, nz });
  }
  return lathe(outline);
}

/**
 * @param {number[]} half the three half axes
 * @returns {Corners}
 */
function ellipsoid(half) {
  const corners = capsule(1, 0);
  for (let at = 0; at < corners.length; at += 6) {
    const normal = half.map((axis, index) => corners[at + 3 + index] / axis);
    const length = Math.hypot(...normal);
    for (let index = 0; index < 3; index += 1) {
      corners[at + index] *= half[index];
      corners[at + 3 + index] = normal[index] / length;
    }
  }
  return corners;
}

/**
 * @param {number} radius
 * @param {number} half
 * @returns {Corners}
 */
function cylinder(radius, half) {
  const flat = (z, nz) => [{ r: 0, z, nr: 0, nz }, { r: radius, z, nr: 0, nz }];
  const side = [{ r: radius, z: -half, nr: 1, nz: 0 }, { r: radius, z: half, nr: 1, nz: 0 }];
  return [...lathe(flat(-half, -1).reverse()), ...lathe(side), ...lathe(flat(half, 1))];
}

/**
 * @param {number[]} half
 * @returns {Corners}
 */
function box(half) {
  const corners = [];
  for (let axis = 0; axis < 3; axis += 1) {
    for (const side of [-1, 1]) {
      const [u, v] = [(axis + 1) % 3, (axis + 2) % 3];
      for (const [du, dv] of [[-1, -1], [1, -1], [1, 1], [-1, -1], [1, 1], [-1, 1]]) {
        const corner = [0, 0, 0, 0, 0, 0];
        corner[axis] = side * half[axis];
        corner[u] = du * half[u];
        corner[v] = dv * half[v];
        corner[3 + axis] = side;
        corners.push(...corner);
      }
    }
  }
  return corners;
}

/**
 * @param {any} model
 * @param {number} mesh
 * @returns {Corners}
 */
function mesh(model, mesh) {
  const first = model.mesh_vertadr[mesh];
  const firstNormal = model.mesh_normaladr[mesh];
  const begin = 3 * model.mesh_faceadr[mesh];
  const end = begin + 3 * model.mesh_facenum[mesh];
  const [vertices, normals, faces, faceNormals] = [
    model.mesh_vert, model.mesh_normal, model.mesh_face, model.mesh_facenormal,
  ];
  const corners = [];
  for (let at = begin; at < end; at += 1) {
    const vertex = 3 * (first + faces[at]);
    const normal = 3 * (firstNormal + faceNormals[at]);
    corners.push(vertices[vertex], vertices[vertex + 1], vertices[vertex + 2]);
    corners.push(normals[normal], normals[normal + 1], normals[normal + 2]);
  }
  return corners;
}

/**
 * The triangles of a geom in its own frame.
 * @param {any} model
 * @param {number} geom
 * @returns {Float32Array}
 */
export function trianglesOf(model, geom) {
  const [a, b, c] = model.geom_size.slice(3 * geom, 3 * geom + 3);
  const make = {
    [PLANE]: () => box([3, 3, 0.001]),
    [SPHERE]: () => capsule(a, 0),
    [CAPSULE]: () => capsule(a, b),
    [ELLIPSOID]: () => ellipsoid([a, b, c]),
    [CYLINDER]: () => cylinder(a, b),
    [BOX]: () => box([a, b, c]),
    [MESH]: () => mesh(model, model.geom_dataid[geom]),
  }[model.geom_type[geom]];
  return new Float32Array(make ? make() : []);
}
