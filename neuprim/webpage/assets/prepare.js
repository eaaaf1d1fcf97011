// Per primitive and frame, in float64: conditions folded in, anchors, whitening, silhouettes, colours. The same quantities by the same names
// as the cpu backend's prepare.py, and a row of float32 per primitive, which the splat shaders read:
//   0 E0, anchor x   1 EX, anchor y   2 EY, TU   3 XA, TV   4 XU, near   5 XV, offset   6 factor, weight   7 m, anchor z, id, row   8 skew, xc, yc, hx
//   9 hy   and with a colour network   10 base
const ROW = 11 * 4;
const ANCHOR_RADII = 1.5;

// page: the header of the model; tensors: name -> Float32Array; density, colour: what the fields' scripts made.
function preparer(page, tensors, density, colour) {
  const count = page.count, K = density.neurons, turns = density.omega0 / (2 * Math.PI), H = colour.network ? colour.network.hidden : 0;
  const { means, log_scales, quats, W1, b1, w2 } = tensors, pick = page.rgb;
  const local = new Float64Array(9 * count), axes = new Float64Array(3 * count), unit = new Float64Array(count);
  for (let i = 0; i < count; i++) { // what no camera and no condition changes
    let [w, x, y, z] = quats.subarray(4 * i, 4 * i + 4);
    const n = 1 / Math.hypot(w, x, y, z);
    [w, x, y, z] = [w * n, x * n, y * n, z * n];
    local.set([
      1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
      2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
      2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ], 9 * i);
    const top = Math.max(log_scales[3 * i], log_scales[3 * i + 1], log_scales[3 * i + 2]);
    unit[i] = Math.exp(top);
    for (let a = 0; a < 3; a++) axes[3 * i + a] = Math.exp(log_scales[3 * i + a] - top);
  }
  const reduced = phase => phase - Math.round(phase);

  // One rate on whitened axes, in turns, of a wave whose rate on scene axes is (r0, r1, r2).
  function whitened(i, a, r0, r1, r2) {
    return axes[3 * i + a] * (r0 * local[9 * i + a] + r1 * local[9 * i + 3 + a] + r2 * local[9 * i + 6 + a]);
  }

  // Textures that frames share, vec4 per texel, `texels` a primitive: K of rate and amplitude, then the phases; and two per unit of a network.
  const phaseTexels = Math.ceil(K / 4), unitTexels = Math.ceil(H / 4);
  const moving = (density.turns ? phaseTexels : 0) + unitTexels; // texels per primitive that every frame has anew
  const neurons = { texels: K + phaseTexels, data: new Float32Array(4 * (K + phaseTexels) * count) };
  const units = { texels: 2 * H, data: new Float32Array(8 * H * count) };
  for (let i = 0; i < count; i++) {
    for (let k = 0; k < K; k++) {
      const o = 4 * (i * neurons.texels + k), j = 3 * (i * K + k);
      for (let a = 0; a < 3; a++) neurons.data[o + a] = turns * whitened(i, a, W1[j], W1[j + 1], W1[j + 2]);
      neurons.data[o + 3] = w2[i * K + k];
      neurons.data[4 * (i * neurons.texels + K) + k] = reduced(turns * b1[i * K + k]);
    }
    for (let h = 0; h < H; h++) {
      const o = 4 * (i * units.texels + 2 * h), net = colour.network, rate = a => net.input(i, h, a) / (2 * Math.PI);
      for (let a = 0; a < 3; a++) {
        units.data[o + a] = whitened(i, a, rate(0), rate(1), rate(2));
        units.data[o + 4 + a] = net.output(i, h, pick[a]);
      }
    }
  }

  // What frames read, axis by axis: scene axes -> whitened axes. Rows are made in the order of storage, each in the place that its depth gave it,
  // because fetching parameters in order of depth takes as long as all the rest.
  const whitening = new Float64Array(9 * count), squares = new Float64Array(3 * count);
  for (let i = 0; i < count; i++) {
    for (let a = 0; a < 3; a++) {
      const s = axes[3 * i + a];
      squares[3 * i + a] = s * s;
      for (let b = 0; b < 3; b++) whitening[9 * i + 3 * a + b] = local[9 * i + 3 * b + a] / s;
    }
  }
  const centre = new Float64Array(3 * count), depth = new Float64Array(count), seen = new Int32Array(count), sort = sorter(count), rank = new Int32Array(count);
  const place = new Float64Array(3), eye = new Float64Array(3), R = new Float64Array(9), channels = Math.max(...pick) + 1;
  const look = { base: new Float64Array(channels), ambient: new Float64Array(channels), factor: new Float64Array(channels), phases: new Float64Array(H) };
  const scene = new Float64Array(3 * count); // where the centres are under these conditions
  const A = new Float64Array(9); // of one primitive: camera axes -> whitened axes
  const e0 = new Float64Array(3), ex = new Float64Array(3), ey = new Float64Array(3), xa = new Float64Array(3), span = new Float64Array(5);
  const k0 = new Float64Array(3), ka = new Float64Array(3), kb = new Float64Array(3), ra = new Float64Array(3), rb = new Float64Array(3);

  function turn(i) {
    for (let o = 9 * i, to = 0; to < 9; o += 3, to += 3) {
      const x = whitening[o], y = whitening[o + 1], z = whitening[o + 2];
      A[to] = R[0] * x + R[1] * y + R[2] * z;
      A[to + 1] = R[3] * x + R[4] * y + R[5] * z;
      A[to + 2] = R[6] * x + R[7] * y + R[8] * z;
    }
  }

  // Component (p, q) of the ellipsoid's covariance on the camera's axes, over its largest half axis squared; after turn(i).
  const covariance = (i, p, q) => A[p] * A[q] * squares[3 * i] ** 2 + A[3 + p] * A[3 + q] * squares[3 * i + 1] ** 2 + A[6 + p] * A[6 + q] * squares[3 * i + 2] ** 2;

  // Screen silhouette relative to the anchor into `span`; false where no ray meets it.
  function silhouette(tc, aa, xe, ye) {
    const { dot, crossed } = lib;
    crossed(xa, e0, k0);
    crossed(xa, ex, ka);
    crossed(xa, ey, kb);
    crossed(ex, e0, ra);
    crossed(ey, e0, rb);
    for (let j = 0; j < 3; j++) {
      ka[j] += tc * ra[j];
      kb[j] += tc * rb[j];
    }
    // |e|^2 - |x x e|^2 > 0, a quadratic in the pixel's offset
    const q0 = aa - dot(k0, k0), q1 = xe - dot(k0, ka), q2 = ye - dot(k0, kb);
    const q3 = dot(ex, ex) - dot(ka, ka), q4 = dot(ex, ey) - dot(ka, kb), q5 = dot(ey, ey) - dot(kb, kb);
    const d0 = q1 * q1 - q3 * q0, d1 = q1 * q4 - q3 * q2, d2 = q4 * q4 - q3 * q5;
    if (!(q3 < 0 && d2 < 0)) return true; // no ellipse: the whole screen
    const yc = -d1 / d2, peak = d0 + d1 * yc;
    if (!(peak > 0)) return false;
    span[0] = -q4 / q3;
    span[1] = -(q1 + q4 * yc) / q3;
    span[2] = yc;
    span[3] = Math.sqrt(peak) / -q3;
    span[4] = Math.sqrt(-peak / d2);
    return true;
  }

  // Whether the exact screen box of primitive i, whose whole is in front, misses the image; after turn(i).
  function outside(i, camera, szz) {
    const m = unit[i], z = centre[3 * i + 2] / m, den = z * z - szz;
    for (let axis = 0; axis < 2; axis++) {
      const c = centre[3 * i + axis] / m, f = axis ? camera.fy : camera.fx, p = axis ? camera.cy : camera.cx;
      const sii = covariance(i, axis, axis), siz = covariance(i, axis, 2);
      const root = Math.sqrt(Math.max(z * z * sii - 2 * c * z * siz + c * c * szz - (sii * szz - siz * siz), 0)), mid = c * z - siz;
      if ((f * (mid + root)) / den + p <= 0 || (f * (mid - root)) / den + p >= (axis ? camera.height : camera.width)) return true;
    }
    return false;
  }
  const wholeInFront = (i, reach) => centre[3 * i + 2] - reach > 1e-3 * reach;

  // How long primitive i is in the direction to a point, in scene units.
  function extentTowards(i, point) {
    for (let a = 0; a < 3; a++) place[a] = point[a] - scene[3 * i + a];
    lib.unit(place);
    const [x, y, z] = place;
    const a = whitened(i, 0, x, y, z), b = whitened(i, 1, x, y, z), c = whitened(i, 2, x, y, z);
    return 2 * unit[i] * Math.sqrt(a * a + b * b + c * c);
  }

  // Which primitives live under these conditions, ascending, and in `scene` where they are.
  function settle(conditions) {
    const folded = density.at(conditions), living = new Int32Array(count);
    let n = 0;
    for (let i = 0; i < count; i++) {
      if (folded.alive && !folded.alive(i)) continue;
      for (let a = 0; a < 3; a++) place[a] = means[3 * i + a];
      if (folded.move) folded.move(i, place);
      for (let a = 0; a < 3; a++) scene[3 * i + a] = place[a];
      living[n++] = i;
    }
    return { folded, living: living.subarray(0, n) };
  }

  // Which of them the camera sees, ascending, into `seen`, and their centres; returns how many.
  function visible(camera, living, near) {
    const { t } = camera;
    let n = 0;
    for (let p = 0; p < living.length; p++) {
      const i = living[p], o = 3 * i, m = unit[i], x = scene[o], y = scene[o + 1], z = scene[o + 2], c2 = R[6] * x + R[7] * y + R[8] * z + t[2];
      if (c2 + m <= near) continue;
      centre[o] = R[0] * x + R[1] * y + R[2] * z + t[0];
      centre[o + 1] = R[3] * x + R[4] * y + R[5] * z + t[1];
      depth[i] = centre[o + 2] = c2;
      turn(i);
      const szz = covariance(i, 2, 2), reach = m * Math.sqrt(szz);
      if (c2 + reach <= near || (wholeInFront(i, reach) && outside(i, camera, szz))) continue;
      seen[n++] = i;
    }
    return n;
  }

  // camera: {R: 9 numbers, t: 3, fx, fy, cx, cy, width, height, near}, OpenCV axes; settled: of settle; arriving: null, or (count,) light that
  // arrives at each primitive; coloured: whether colours are needed, which depth images have none of. Fills rows (Float32Array of ROW a primitive)
  // and phases (4 `moving` numbers a primitive), front to back.
  function frame(camera, conditions, { folded, living }, arriving, rows, phases, coloured = true) {
    const { t, fx, fy, cx, cy, near = page.near } = camera;
    R.set(camera.R);
    for (let a = 0; a < 3; a++) eye[a] = -(R[a] * t[0] + R[3 + a] * t[1] + R[6 + a] * t[2]);
    const tint = colour.at(conditions, eye), count = visible(camera, living, near), order = sort(seen, count, depth);
    for (let n = 0; n < count; n++) rank[order[n]] = n;

    for (let p = 0; p < count; p++) {
      const i = seen[p], n = rank[i], m = unit[i], c0 = centre[3 * i], c1 = centre[3 * i + 1], c2 = centre[3 * i + 2];
      turn(i);
      let az = 0, ax = Math.fround(cx), ay = Math.fround(cy); // the anchor: the projected centre, or the camera where that is too near
      if (c2 > ANCHOR_RADII * m) {
        az = m * Math.fround(c2 / m);
        ax = Math.fround((fx * c0) / c2 + cx);
        ay = Math.fround((fy * c1) / c2 + cy);
      }
      const tc = az / m, u = (ax - cx) / fx, v = (ay - cy) / fy, x0 = tc * u - c0 / m, x1 = tc * v - c1 / m, x2 = tc - c2 / m;
      let aa = 0, xe = 0, ye = 0;
      for (let a = 0; a < 3; a++) {
        const A0 = A[3 * a], A1 = A[3 * a + 1], A2 = A[3 * a + 2];
        e0[a] = A0 * u + A1 * v + A2;
        ex[a] = A0 / fx;
        ey[a] = A1 / fy;
        xa[a] = A0 * x0 + A1 * x1 + A2 * x2;
        aa += e0[a] * e0[a];
        xe += ex[a] * e0[a];
        ye += ey[a] * e0[a];
      }
      let weight = folded.weight(i);
      span[0] = span[1] = span[2] = 0;
      span[3] = span[4] = -1; // the whole screen
      if (wholeInFront(i, m * Math.sqrt(covariance(i, 2, 2))) && !silhouette(tc, aa, xe, ye)) {
        weight = span[3] = span[4] = 0; // nothing to draw, in a place that is already given
      }
      if (coloured) {
        for (let a = 0; a < 3; a++) place[a] = scene[3 * i + a];
        look.factor.fill(1);
        tint.look(i, place, look);
      }
      const light = arriving ? (tint.scatter ? tint.scatter(i, arriving[i]) : arriving[i]) : 1, o = ROW * n, tu = (-tc * xe) / aa, tv = (-tc * ye) / aa;
      for (let a = 0; a < 3; a++) {
        rows[o + a] = e0[a];
        rows[o + 4 + a] = ex[a];
        rows[o + 8 + a] = ey[a];
        rows[o + 12 + a] = xa[a];
        rows[o + 16 + a] = tc * ex[a] + tu * e0[a];
        rows[o + 20 + a] = tc * ey[a] + tv * e0[a];
        const factor = look.factor[pick[a]], base = look.base[pick[a]];
        rows[o + 24 + a] = H ? factor * light : factor * (light * Math.max(base, 0) + look.ambient[pick[a]]); // no shadow reaches these
        rows[o + 40 + a] = base;
      }
      rows[o + 3] = ax;
      rows[o + 7] = ay;
      rows[o + 11] = tu;
      rows[o + 15] = tv;
      rows[o + 19] = (near - az) / m;
      rows[o + 23] = folded.offset(i);
      rows[o + 27] = weight;
      rows[o + 28] = m;
      rows[o + 29] = az;
      rows[o + 30] = i;
      rows[o + 31] = n;
      for (let j = 0; j < 5; j++) rows[o + 32 + j] = span[j];
      if (phases) {
        let q = 4 * moving * n;
        if (density.turns) {
          for (let k = 0; k < K; k++) phases[q + k] = reduced(turns * folded.phase(i, k));
          q += 4 * phaseTexels;
        }
        for (let h = 0; h < H; h++) phases[q + h] = reduced(look.phases[h] / (2 * Math.PI));
      }
    }
    return count;
  }

  // How many of the first n rows, which are in order, are no further away than each of the edges.
  function within(rows, n, edges) {
    const ends = [];
    let at = 0;
    for (const edge of edges) {
      while (at < n && depth[rows[ROW * at + 30]] <= edge) at++;
      ends.push(at);
    }
    return ends;
  }

  return { settle, frame, within, extentTowards, neurons, units, moving, turns: !!density.turns, K, H, edge: density.edge, phaseTexels, scene, scales: unit };
}
