// Orthographic camera with a view of the limb from the side.

import { dot, mix, norm, rotate, scale, subtract } from "./geometry.js";

const ELEVATION = 0.16;
const FOLLOW_S = 0.9;
const TURN_S = 3;
const MIDDLE = 0.46; // share of the height above the centre of the limb; the floor is then visible
const JUMP = 0.5; // distance, in lengths of the limb, above which the view jumps instead of moving smoothly

/** Return a camera; `turn` is the angle of the view about the vertical, rad; null until it is set. */
export function createCamera() {
  const camera = {
    turn: null,
    target: null,
    length: 0,
    facing: null,
    floor: null,

    /** Follow a limb: centre, size and facing direction change smoothly, or at once if `still`. */
    follow(points, length, firstSegment, seconds, still) {
      const center = scale(points.reduce((sum, p) => sum.map((v, i) => v + p[i]), [0, 0, 0]), 1 / points.length);
      const lowest = Math.min(...points.map((p) => p[2])) - 0.14 * length;
      // The position of the first joint jumps when the cameras start or stop locating it.
      const first = camera.target === null || norm(subtract(center, camera.target)) > JUMP * length;
      if (first) camera.floor = null;
      const share = (time) => (first || still ? 1 : 1 - Math.exp(-seconds / time));

      camera.target = first ? center : mix(camera.target, center, share(FOLLOW_S));
      camera.length = first ? length : camera.length + (length - camera.length) * share(FOLLOW_S);
      // The floor is the lowest point so far. It rises slowly in case the limb has moved to another position.
      camera.floor = camera.floor === null ? lowest : Math.min(lowest, camera.floor + 0.02 * seconds);
      camera.face(firstSegment, share(TURN_S));
    },

    // The x axis of a segment points to the subject's right. The facing direction is horizontal and normal to it.
    face(q, share) {
      if (!q) return;
      const right = rotate(q, [1, 0, 0]);
      const level = Math.hypot(right[0], right[1]);
      if (level < 0.3) return;
      const facing = [-right[1] / level, right[0] / level, 0];
      const mixed = camera.facing === null ? facing : mix(camera.facing, facing, share);
      const length = norm(mixed);
      camera.facing = length > 0.1 ? scale(mixed, 1 / length) : facing;
    },

    /** Return a function from world points to pixels, with depth (larger is farther away). */
    projection(width, height) {
      const f = camera.facing ?? [0, 1, 0];
      const right = [f[1], -f[0], 0];
      const [c, s] = [Math.cos(camera.turn), Math.sin(camera.turn)];
      const across = [f[0] * c + right[0] * s, f[1] * c + right[1] * s, 0];
      const away = [f[0] * s - right[0] * c, f[1] * s - right[1] * c, 0];
      const [cosine, sine] = [Math.cos(ELEVATION), Math.sin(ELEVATION)];
      const pixels = Math.min(height / (camera.length * 1.42), width / (camera.length * 1.3));

      const project = (point) => {
        const d = subtract(point, camera.target);
        const distance = dot(d, away);
        return {
          x: width / 2 + pixels * dot(d, across),
          y: height * MIDDLE - pixels * (d[2] * cosine + distance * sine),
          depth: distance * cosine - d[2] * sine,
        };
      };
      return { project, pixels, sine };
    },
  };
  return camera;
}
