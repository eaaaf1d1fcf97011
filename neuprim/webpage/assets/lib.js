// Shared by the fields' own scripts and by the page: vectors, gains, spherical harmonics. No script here knows a task.
const lib = {
  dot: (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2],
  cross: (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]],
  crossed(a, b, into) {
    into[0] = a[1] * b[2] - a[2] * b[1];
    into[1] = a[2] * b[0] - a[0] * b[2];
    into[2] = a[0] * b[1] - a[1] * b[0];
  },

  // To length 1, in place. Vectors shorter than 1e-10 keep their share of it, so that zero stays zero.
  unit(v) {
    const top = Math.max(Math.abs(v[0]), Math.abs(v[1]), Math.abs(v[2]), 1e-10);
    const x = v[0] / top, y = v[1] / top, z = v[2] / top, length = Math.max(Math.sqrt(x * x + y * y + z * z), 1) * top; // Math.hypot is slow
    for (let a = 0; a < 3; a++) v[a] /= length;
    return v;
  },

  // exp(log_gain), which counts as no further from 0 than 20; 1 without a gain.
  gains: (log_gain, count) =>
    log_gain ? Float64Array.from(log_gain, g => Math.exp(Math.min(Math.max(g, -20), 20))) : new Float64Array(count).fill(1),

  // (i, centre, eye, lowest(c), into) => SH(direction eye -> centre) + 1/2 of each channel, in the order and signs of 3D Gaussian splatting.
  harmonics(degree, channels, rest) {
    const PI = Math.PI, root = (n, d) => Math.sqrt(n / (d * PI)), C0 = 0.5 / Math.sqrt(PI), C1 = Math.sqrt(3 / (4 * PI));
    const C2 = [root(15, 4), -root(15, 4), root(5, 16), -root(15, 4), root(15, 16)];
    const C3 = [-root(35, 32), root(105, 4), -root(21, 32), root(7, 16), -root(21, 32), root(105, 16), -root(35, 32)];
    const bands = (degree + 1) ** 2 - 1, Y = new Float64Array(15);
    return (i, centre, eye, lowest, into) => {
      let x = centre[0] - eye[0], y = centre[1] - eye[1], z = centre[2] - eye[2];
      const length = Math.max(Math.sqrt(x * x + y * y + z * z), 1e-30);
      x /= length;
      y /= length;
      z /= length;
      if (degree > 0) {
        Y[0] = -C1 * y;
        Y[1] = C1 * z;
        Y[2] = -C1 * x;
      }
      const xx = x * x, yy = y * y, zz = z * z;
      if (degree > 1) {
        Y[3] = C2[0] * x * y;
        Y[4] = C2[1] * y * z;
        Y[5] = C2[2] * (2 * zz - xx - yy);
        Y[6] = C2[3] * x * z;
        Y[7] = C2[4] * (xx - yy);
      }
      if (degree > 2) {
        Y[8] = C3[0] * y * (3 * xx - yy);
        Y[9] = C3[1] * x * y * z;
        Y[10] = C3[2] * y * (4 * zz - xx - yy);
        Y[11] = C3[3] * z * (2 * zz - 3 * xx - 3 * yy);
        Y[12] = C3[4] * x * (4 * zz - xx - yy);
        Y[13] = C3[5] * z * (xx - yy);
        Y[14] = C3[6] * x * (xx - 3 * yy);
      }
      for (let c = 0; c < channels; c++) {
        let value = C0 * lowest(c) + 0.5;
        for (let k = 0; k < bands; k++) value += Y[k] * rest[(i * bands + k) * channels + c];
        into[c] = value;
      }
    };
  },
};
