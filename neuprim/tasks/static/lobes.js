// In a browser: SphericalLobes.
({ lobes, channels }, { sh_dc, lobe_amplitude, lobe_axis, lobe_log_sharpness }, count, lib) => {
  const C0 = 0.5 / Math.sqrt(Math.PI), shortest = 1e-24, weights = new Float64Array(lobes);
  const axes = new Float64Array(3 * lobes * count), sharpness = new Float64Array(lobes * count);
  for (let k = 0; k < lobes * count; k++) {
    const x = lobe_axis[3 * k], y = lobe_axis[3 * k + 1], z = lobe_axis[3 * k + 2], length = Math.sqrt(x * x + y * y + z * z);
    axes.set(length > shortest ? [x / length, y / length, z / length] : [0, 0, 0], 3 * k);
    sharpness[k] = Math.exp(Math.min(Math.max(lobe_log_sharpness[k], -20), 20));
  }
  const look = (i, centre, eye, out) => {
    const x = centre[0] - eye[0], y = centre[1] - eye[1], z = centre[2] - eye[2], length = Math.sqrt(x * x + y * y + z * z);
    const over = length > shortest ? 1 / length : 0;
    for (let j = 0; j < lobes; j++) {
      const k = i * lobes + j;
      const cosine = (axes[3 * k] * x + axes[3 * k + 1] * y + axes[3 * k + 2] * z) * over;
      weights[j] = Math.exp(sharpness[k] * Math.min(cosine - 1, 0));
    }
    for (let c = 0; c < channels; c++) {
      let value = C0 * sh_dc[channels * i + c] + 0.5;
      for (let j = 0; j < lobes; j++) value += weights[j] * lobe_amplitude[(i * lobes + j) * channels + c];
      out[c] = value;
    }
  };
  return { at: ({}, eye) => ({ look: (i, centre, out) => look(i, centre, eye, out.base) }) };
}
