// In a browser: LightHarmonics, harmonics of any degree by the recurrence of harmonics.py.
({ degree, channels, falloff, typical }, { c_dc, light_sh }, count, lib) => {
  const bands = (degree + 1) ** 2 - 1, towards = new Float64Array(3), values = new Float64Array(bands + 1);
  const factorial = n => (n < 2 ? 1 : n * factorial(n - 1)), odd = m => (m < 1 ? 1 : (2 * m - 1) * odd(m - 1));
  const scale = [];
  for (let l = 0; l <= degree; l++) {
    for (let a = 0; a <= l; a++) {
      scale[l * (degree + 1) + a] = Math.sqrt(((2 * l + 1) / (4 * Math.PI)) * (factorial(l - a) / factorial(l + a))) * (a ? Math.SQRT2 : 1);
    }
  }

  function harmonics(x, y, z) {
    let cosine = 1, sine = 0;
    for (let m = 0; m <= degree; m++) {
      let before = 0, now = odd(m);
      for (let l = m; l <= degree; l++) {
        const value = scale[l * (degree + 1) + m] * now;
        values[l * l + l + m] = value * cosine;
        if (m) values[l * l + l - m] = value * sine;
        [before, now] = [now, ((2 * l + 1) * z * now - (l + m) * before) / (l + 1 - m)];
      }
      [cosine, sine] = [x * cosine - y * sine, x * sine + y * cosine];
    }
  }

  function at({ light, light_intensity }) {
    function look(i, centre, out) {
      for (let a = 0; a < 3; a++) towards[a] = light[a] - centre[a];
      const squared = Math.max(lib.dot(towards, towards), 1e-20);
      lib.unit(towards);
      harmonics(towards[0], towards[1], towards[2]);
      for (let c = 0; c < channels; c++) {
        let value = c_dc[channels * i + c];
        for (let k = 0; k < bands; k++) value += values[k + 1] * light_sh[(i * bands + k) * channels + c];
        out.base[c] = value;
        out.factor[c] = light_intensity[c] / typical / (falloff ? squared : 1);
      }
    }
    return { look };
  }
  return { at };
}
