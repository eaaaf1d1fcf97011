// Light that arrives at primitives or points, by depth images out of the light in slabs: neuprim/core/render/light.py has the mathematics.
const FAR = 1e3, OUTSIDE = 1 / 0.94; // scene radii

// The light's camera over all living primitives; six along the axes if the light is among them. Each has the depths between its slabs.
function lightCameras(scene, scales, living, light, { size, layers }) {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  for (const i of living) {
    for (let a = 0; a < 3; a++) {
      low[a] = Math.min(low[a], scene[3 * i + a]);
      high[a] = Math.max(high[a], scene[3 * i + a]);
    }
  }
  const middle = low.map((x, a) => (x + high[a]) / 2);
  let far = 0, largest = 0;
  for (const i of living) {
    far = Math.max(far, Math.hypot(scene[3 * i] - middle[0], scene[3 * i + 1] - middle[1], scene[3 * i + 2] - middle[2]));
    largest = Math.max(largest, scales[i]);
  }
  const radius = far + largest;
  let away = light.map((x, a) => x - middle[a]), distance = Math.hypot(...away);
  if (distance > FAR * radius) { // from there all rays are parallel
    away = away.map(x => (x * FAR * radius) / distance);
    distance = FAR * radius;
  }
  const from = away.map((x, a) => x + middle[a]);
  function towards(z, up, focal, near) {
    const x = lib.unit(lib.cross(z, up)), y = lib.cross(z, x), t = [x, y, z].map(axis => -lib.dot(axis, from));
    let nearest = Infinity, furthest = -Infinity;
    for (const i of living) {
      const d = z[0] * scene[3 * i] + z[1] * scene[3 * i + 1] + z[2] * scene[3 * i + 2] + t[2];
      if (!(d + scales[i] > near)) continue;
      nearest = Math.min(nearest, d);
      furthest = Math.max(furthest, d);
    }
    const edges = Array.from({ length: layers - 1 }, (_, k) => nearest + ((furthest - nearest) * (k + 1)) / layers);
    return { R: [...x, ...y, ...z], t, fx: focal, fy: focal, cx: size / 2, cy: size / 2, width: size, height: size, near, edges, from, diameter: 2 * radius };
  }
  if (distance > OUTSIDE * radius) {
    const up = Math.abs(away[2]) < 0.9 * distance ? [0, 0, 1] : [0, 1, 0], near = Math.max(1e-4 * radius, distance - 1.5 * radius);
    return [towards(away.map(x => -x / distance), up, (0.5 * size) / Math.tan(Math.asin(radius / distance)), near)];
  }
  const axis = (a, sign) => [0, 1, 2].map(b => (a === b ? sign : 0));
  return [0, 1, 2, 3, 4, 5].map(k => towards(axis(k % 3, k < 3 ? 1 : -1), axis((k + 1) % 3, 1), 0.5 * size - 1, 1e-4 * radius));
}

// Which of the light's cameras looks towards the point.
function facing(cameras, px, py, pz) {
  if (cameras.length === 1) return 0;
  const { from } = cameras[0], away = [px - from[0], py - from[1], pz - from[2]], sizes = away.map(Math.abs);
  const a = sizes.indexOf(Math.max(...sizes));
  return away[a] < 0 ? a + 3 : a;
}

// Visibility of the point (x, y, z); light fades over `fade` scene units, the share `before` of them in front of a depth image. maps: per slab Float32Array (size, size, 4) whose first number is sum of w z and whose last is T.
function arrivingAt(px, py, pz, camera, maps, fade, before = 0) {
  const { R, t, fx, width: size, near } = camera;
  const x = R[0] * px + R[1] * py + R[2] * pz + t[0], y = R[3] * px + R[4] * py + R[5] * pz + t[1], z = R[6] * px + R[7] * py + R[8] * pz + t[2];
  if (!(z > near)) return 1;
  const u = (fx * x) / z + 0.5 * size - 0.5, v = (fx * y) / z + 0.5 * size - 0.5; // in pixels, 0 the middle of the first
  if (!(u > -1 && u < size && v > -1 && v < size)) return 1;
  const i = Math.floor(v), j = Math.floor(u), down = v - i, right = u - j;
  let found = 1;
  for (const map of maps) {
    let alpha = 0, nearness = 0;
    for (let k = 0; k < 4; k++) {
      const row = i + (k >> 1), column = j + (k & 1);
      if (row < 0 || row >= size || column < 0 || column >= size) continue;
      const o = 4 * (row * size + column), opacity = 1 - map[o + 3];
      if (!(opacity > 0)) continue;
      const weight = (k >> 1 ? down : 1 - down) * (k & 1 ? right : 1 - right) * opacity;
      alpha += weight;
      nearness += weight / Math.max(map[o] / opacity, near);
    }
    const behind = z - alpha / Math.max(nearness, 1e-30);
    const s = Math.min(Math.max(behind / fade + before, 0), 1);
    found *= 1 - alpha * s * s * (3 - 2 * s);
  }
  return found;
}
