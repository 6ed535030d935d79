// Quaternions and vectors. Quaternions are Hamilton, scalar first; the world's z points up.

/** Return the sum of a and b. */
export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
/** Return a minus b. */
export const subtract = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
/** Return a times a number. */
export const scale = (a, factor) => [a[0] * factor, a[1] * factor, a[2] * factor];
/** Return the scalar product. */
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
/** Return the length of a vector. */
export const norm = (a) => Math.hypot(a[0], a[1], a[2]);
/** Return the point between a (share 0) and b (share 1). */
export const mix = (a, b, share) => add(scale(a, 1 - share), scale(b, share));

/** Return the conjugate, the inverse rotation. */
export const conjugate = (q) => [q[0], -q[1], -q[2], -q[3]];

/** Return the product a ⊗ b. */
export function multiply(a, b) {
  return [
    a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
    a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
    a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
    a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
  ];
}

/** Return the vector rotated by q. */
export function rotate(q, v) {
  const [, x, y, z] = multiply(multiply(q, [0, ...v]), conjugate(q));
  return [x, y, z];
}

/** Return the rotation between a (share 0) and b (share 1); q and −q are the same rotation. */
export function mixRotations(a, b, share) {
  const sign = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] < 0 ? -1 : 1;
  const q = a.map((value, i) => value * (1 - share) + sign * b[i] * share);
  const length = Math.hypot(...q) || 1;
  return q.map((value) => value / length);
}
