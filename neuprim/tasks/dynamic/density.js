// In a browser: TimeDensity, whose parts are those of density.py.
({ neurons, omega0 = 30, edge = 0, time }, tensors, count, lib) => {
  const { b1, b2, log_gain, W_t, offset_cos, offset_sin, window_center, log_window, velocity, acceleration } = tensors;
  const parts = new Set(time.split("+")), gains = lib.gains(log_gain, count), TERMS = 4;
  const tau = parts.has("window") ? Float64Array.from(log_window, Math.exp) : null;
  const birth = i => (tau ? window_center[i] : 0.5);
  const cosines = new Float64Array(TERMS), sines = new Float64Array(TERMS);

  function at({ time: xi }) {
    for (let j = 0; j < TERMS; j++) {
      cosines[j] = Math.cos(Math.PI * xi * (j + 1));
      sines[j] = Math.sin(Math.PI * xi * (j + 1));
    }
    const frame = {};
    frame.weight = i => {
      if (!tau) return gains[i];
      const u = (xi - window_center[i]) / tau[i], left = Math.max(1 - u * u, 0);
      return gains[i] * left * left;
    };
    frame.offset = i => {
      let offset = b2[i];
      if (parts.has("offset")) {
        for (let j = 0; j < TERMS; j++) offset += offset_cos[TERMS * i + j] * cosines[j] + offset_sin[TERMS * i + j] * sines[j];
      }
      return offset;
    };
    if (tau) frame.alive = i => Math.abs(xi - window_center[i]) < tau[i];
    if (parts.has("motion")) {
      frame.move = (i, centre) => {
        const since = xi - birth(i);
        for (let a = 0; a < 3; a++) centre[a] += (velocity[3 * i + a] + acceleration[3 * i + a] * since) * since;
      };
    }
    if (parts.has("phase")) frame.phase = (i, k) => b1[i * neurons + k] + xi * W_t[i * neurons + k];
    return frame;
  }
  return { neurons, omega0, edge, turns: parts.has("phase"), at };
}
