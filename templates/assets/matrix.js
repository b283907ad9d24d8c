// Vectors of three numbers and matrices of four by four, in column-major order as WebGL expects.

/** A point, a direction or a colour: three numbers. @typedef {number[]} Vector */
/** Sixteen numbers. @typedef {number[]} Matrix */

/** @type {(a: Vector, b: Vector) => Vector} */
export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
/** @type {(a: Vector, factor: number) => Vector} */
export const scale = (a, factor) => [a[0] * factor, a[1] * factor, a[2] * factor];
/** @type {(a: Vector, b: Vector) => number} */
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
/** @type {(a: Vector, b: Vector) => Vector} */
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

/** @param {Vector} a */
export function unit(a) {
  const length = Math.hypot(...a);
  return length > 0 ? scale(a, 1 / length) : [0, 0, 1];
}

/** @type {() => Matrix} */
export const identity = () => [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];

/**
 * The product: applies b, then a.
 * @param {Matrix} a
 * @param {Matrix} b
 * @returns {Matrix}
 */
export function times(a, b) {
  const product = new Array(16);
  for (let column = 0; column < 4; ++column) {
    for (let row = 0; row < 4; ++row) {
      let sum = 0;
      for (let k = 0; k < 4; ++k) {
        sum += a[4 * k + row] * b[4 * column + k];
      }
      product[4 * column + row] = sum;
    }
  }
  return product;
}

/**
 * The matrix of a pose: a translation, a rotation as axis and angle, and a scale.
 * @param {Vector} translation
 * @param {number[]} rotation
 * @param {Vector} factors
 * @returns {Matrix}
 */
export function pose(translation, rotation, factors = [1, 1, 1]) {
  const [x, y, z] = unit(rotation.slice(0, 3));
  const [c, s] = [Math.cos(rotation[3]), Math.sin(rotation[3])];
  const t = 1 - c;
  const columns = [
    [t * x * x + c, t * x * y + s * z, t * x * z - s * y],
    [t * x * y - s * z, t * y * y + c, t * y * z + s * x],
    [t * x * z + s * y, t * y * z - s * x, t * z * z + c],
  ];
  return [...columns.flatMap((column, index) => [...scale(column, factors[index]), 0]), ...translation, 1];
}

/**
 * The view matrix of an eye that looks at a target.
 * @param {Vector} eye
 * @param {Vector} target
 * @param {Vector} up
 * @returns {Matrix}
 */
export function lookAt(eye, target, up) {
  const back = unit(add(eye, scale(target, -1)));
  const right = unit(cross(up, back));
  const above = cross(back, right);
  return [
    right[0],
    above[0],
    back[0],
    0,
    right[1],
    above[1],
    back[1],
    0,
    right[2],
    above[2],
    back[2],
    0,
    -dot(right, eye),
    -dot(above, eye),
    -dot(back, eye),
    1,
  ];
}

/**
 * A perspective projection; `angle` is the vertical field of view.
 * @param {number} angle
 * @param {number} aspect
 * @param {number} near
 * @param {number} far
 * @returns {Matrix}
 */
export function perspective(angle, aspect, near, far) {
  const f = 1 / Math.tan(angle / 2);
  return [
    f / aspect,
    0,
    0,
    0,
    0,
    f,
    0,
    0,
    0,
    0,
    (far + near) / (near - far),
    -1,
    0,
    0,
    (2 * far * near) / (near - far),
    0,
  ];
}

/** A direction turned by a matrix. @type {(m: Matrix, v: Vector) => Vector} */
export const turned = (m, v) => [0, 1, 2].map((row) => m[row] * v[0] + m[4 + row] * v[1] + m[8 + row] * v[2]);
