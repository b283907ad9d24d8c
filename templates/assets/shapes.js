// The shapes of Webots as triangles: three numbers per corner and per normal. Axes are along z.

/** A mesh as WebGL takes it. @typedef {{ positions: Float32Array, normals: Float32Array }} Triangles */
/** @typedef {import('./matrix.js').Vector} Vector */

/** A ring of a body of revolution. @typedef {[radius: number, height: number, outward: number, upward: number]} Ring */

const TURN = 2 * Math.PI;

class Mesh {
  /** @type {number[]} */
  positions = [];
  /** @type {number[]} */
  normals = [];

  /**
   * @param {Vector[]} corners
   * @param {Vector[]} normals of each corner, or one of all
   */
  triangle(corners, normals) {
    for (let index = 0; index < 3; ++index) {
      this.positions.push(...corners[index]);
      this.normals.push(...(normals[index] ?? normals[0]));
    }
  }

  /**
   * @param {[Vector, Vector, Vector, Vector]} corners
   * @param {Vector[]} normals of each corner, or one of all
   */
  quad([a, b, c, d], normals) {
    const n = normals.length === 1 ? [normals[0], normals[0], normals[0], normals[0]] : normals;
    this.triangle([a, b, c], [n[0], n[1], n[2]]);
    this.triangle([a, c, d], [n[0], n[2], n[3]]);
  }

  finish() {
    return { positions: new Float32Array(this.positions), normals: new Float32Array(this.normals) };
  }
}

/** @param {Vector} size */
function box([x, y, z]) {
  const mesh = new Mesh();
  for (let axis = 0; axis < 3; ++axis) {
    for (const sign of [-1, 1]) {
      /** @type {(u: number, v: number) => Vector} */
      const corner = (u, v) => {
        const point = [0, 0, 0];
        point[axis] = sign / 2;
        point[(axis + 1) % 3] = (sign * u) / 2;
        point[(axis + 2) % 3] = v / 2;
        return [point[0] * x, point[1] * y, point[2] * z];
      };
      const normal = [0, 0, 0];
      normal[axis] = sign;
      mesh.quad([corner(-1, -1), corner(1, -1), corner(1, 1), corner(-1, 1)], [normal]);
    }
  }
  return mesh.finish();
}

/**
 * A body of revolution.
 * @param {Ring[]} rings from bottom to top
 * @param {number} sides
 */
function turnedBody(rings, sides) {
  const mesh = new Mesh();
  /** @type {(ring: Ring, angle: number) => Vector} */
  const at = ([radius, height], angle) => [radius * Math.cos(angle), radius * Math.sin(angle), height];
  /** @type {(ring: Ring, angle: number) => Vector} */
  const normal = ([, , outward, upward], angle) => [outward * Math.cos(angle), outward * Math.sin(angle), upward];
  for (let index = 0; index + 1 < rings.length; ++index) {
    const [low, high] = [rings[index], rings[index + 1]];
    if (edges.has(low)) {
      continue;
    }
    for (let side = 0; side < sides; ++side) {
      const [one, two] = [(TURN * side) / sides, (TURN * (side + 1)) / sides];
      mesh.quad(
        [at(low, one), at(low, two), at(high, two), at(high, one)],
        [normal(low, one), normal(low, two), normal(high, two), normal(high, one)],
      );
    }
  }
  return mesh.finish();
}

/** @type {(subdivision: number) => number} */
const sidesOf = (subdivision) => Math.min(64, Math.max(12, subdivision || 24));
/** The rings that end a smooth part: nothing joins them to the next one. @type {WeakSet<Ring>} */
const edges = new WeakSet();

/** @type {(ring: Ring) => Ring} */
function edge(ring) {
  edges.add(ring);
  return ring;
}

/** @type {(radius: number, middle: number, from: number, to: number) => Ring[]} */
const halfBall = (radius, middle, from, to) =>
  Array.from({ length: 9 }, (_, index) => {
    const angle = from + ((to - from) * index) / 8;
    return [radius * Math.cos(angle), middle + radius * Math.sin(angle), Math.cos(angle), Math.sin(angle)];
  });

/** @type {(radius: number, height: number, sides: number) => Triangles} */
const cylinder = (radius, height, sides) =>
  turnedBody(
    [
      [0, -height / 2, 0, -1],
      edge([radius, -height / 2, 0, -1]),
      [radius, -height / 2, 1, 0],
      edge([radius, height / 2, 1, 0]),
      [radius, height / 2, 0, 1],
      [0, height / 2, 0, 1],
    ],
    sides,
  );

/** @type {(radius: number, height: number, sides: number) => Triangles} */
function cone(radius, height, sides) {
  const length = Math.hypot(radius, height) || 1;
  /** @type {[number, number]} */
  const slope = [height / length, radius / length];
  return turnedBody(
    [
      [0, -height / 2, 0, -1],
      edge([radius, -height / 2, 0, -1]),
      [radius, -height / 2, ...slope],
      [0, height / 2, ...slope],
    ],
    sides,
  );
}

/** @param {Vector} size */
function plane([x, y]) {
  const mesh = new Mesh();
  mesh.quad(
    [
      [-x / 2, -y / 2, 0],
      [x / 2, -y / 2, 0],
      [x / 2, y / 2, 0],
      [-x / 2, y / 2, 0],
    ],
    [[0, 0, 1]],
  );
  return mesh.finish();
}

/**
 * Faces as lists of corners; each is flat and convex.
 * @param {number[]} points
 * @param {number[]} indices
 */
function faces(points, indices) {
  const mesh = new Mesh();
  /** @type {(a: Vector, b: Vector) => Vector} */
  const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
  /** @type {Vector[]} */
  let face = [];
  for (const index of [...indices, -1]) {
    if (index >= 0) {
      face.push(points.slice(3 * index, 3 * index + 3));
      continue;
    }
    for (let corner = 2; corner < face.length; ++corner) {
      const [u, v] = [minus(face[corner - 1], face[0]), minus(face[corner], face[0])];
      const normal = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
      const length = Math.hypot(...normal) || 1;
      mesh.triangle([face[0], face[corner - 1], face[corner]], [normal.map((part) => part / length)]);
    }
    face = [];
  }
  return mesh.finish();
}

/**
 * The triangles of a geometry's element; `undefined` if it is not known.
 * @param {Element} element
 * @returns {Triangles | undefined}
 */
export function shape(element) {
  /** @type {(name: string, standard: number) => number} */
  const number = (name, standard) => Number(element.getAttribute(name) ?? standard);
  /** @type {(name: string, standard: string) => number[]} */
  const numbers = (name, standard) =>
    (element.getAttribute(name) ?? standard)
      .trim()
      .split(/[\s,]+/)
      .map(Number);
  const sides = sidesOf(number('subdivision', 24));
  switch (element.tagName) {
    case 'Box':
      return box(numbers('size', '2 2 2'));
    case 'Plane':
      return plane(numbers('size', '1 1'));
    case 'Sphere': {
      const radius = number('radius', 1);
      return turnedBody([...halfBall(radius, 0, -TURN / 4, 0), ...halfBall(radius, 0, 0, TURN / 4)], 24);
    }
    case 'Cylinder':
      return cylinder(number('radius', 1), number('height', 2), sides);
    case 'Cone':
      return cone(number('bottomRadius', 1), number('height', 2), sides);
    case 'Capsule': {
      const [radius, half] = [number('radius', 1), number('height', 2) / 2];
      return turnedBody([...halfBall(radius, -half, -TURN / 4, 0), ...halfBall(radius, half, 0, TURN / 4)], sides);
    }
    case 'IndexedFaceSet': {
      const points = element.querySelector('Coordinate')?.getAttribute('point') ?? '';
      return faces(
        points
          .trim()
          .split(/[\s,]+/)
          .map(Number),
        numbers('coordIndex', '-1'),
      );
    }
    default:
      return undefined;
  }
}
