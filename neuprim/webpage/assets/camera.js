// Where a person looks from: around a target, without a pole's flip; and the held-out cameras as they are.
function lookout(page) {
  const up = lib.unit([...page.up]), rows = R => [R.slice(0, 3), R.slice(3, 6), R.slice(6, 9)];
  const now = { R: null, target: null, distance: 1, lens: null, zoom: 1 };

  // v turned round a unit axis by an angle.
  function turned(v, axis, angle) {
    const c = Math.cos(angle), s = Math.sin(angle), along = lib.dot(v, axis) * (1 - c), across = lib.cross(axis, v);
    return v.map((x, a) => x * c + across[a] * s + axis[a] * along);
  }
  function straightened(R) { // rounding must not build up
    const z = lib.unit([...R.slice(6, 9)]), x = R.slice(0, 3), along = lib.dot(x, z);
    const level = lib.unit(x.map((v, a) => v - along * z[a]));
    return [...level, ...lib.cross(z, level), ...z];
  }

  function at({ R, t, fx, fy, cx, cy, width, height }) {
    const eye = [0, 1, 2].map(a => -(R[a] * t[0] + R[3 + a] * t[1] + R[6 + a] * t[2])), ahead = R.slice(6, 9);
    const away = page.center.map((x, a) => x - eye[a]);
    now.R = [...R];
    now.distance = Math.max(lib.dot(away, ahead), 0.1 * page.radius); // the target is as far ahead as the middle of everything
    now.target = eye.map((x, a) => x + ahead[a] * now.distance);
    now.lens = { fx, fy, cx, cy, width, height };
    now.zoom = 1;
  }
  function turn(yaw, pitch) {
    const level = rows(now.R).map(axis => turned(axis, up, yaw)), tipped = level.map(axis => turned(axis, level[0], pitch));
    now.R = straightened((Math.abs(lib.dot(tipped[2], up)) < 0.9995 ? tipped : level).flat());
  }
  function pan(dx, dy) { // in heights of the picture
    const size = (now.distance * now.lens.height) / now.lens.fy / now.zoom;
    now.target = now.target.map((v, a) => v - size * (dx * now.R[a] + dy * now.R[3 + a]));
  }
  // The view on width x height pixels, of which so many at the bottom are covered.
  function camera(width, height, covered = 0) {
    const { R, target, distance, lens, zoom } = now, free = Math.max(height - covered, 0.4 * height);
    const scale = Math.min(width / lens.width, free / lens.height);
    const eye = target.map((v, a) => v - R[6 + a] * distance);
    return {
      R, t: rows(R).map(axis => -lib.dot(axis, eye)), width, height,
      fx: lens.fx * scale * zoom, fy: lens.fy * scale * zoom,
      cx: width / 2 + (lens.cx - lens.width / 2) * scale * zoom, cy: free / 2 + (lens.cy - lens.height / 2) * scale * zoom,
    };
  }
  return { now, at, turn, pan, camera, nearer: factor => (now.distance *= factor) };
}
