// In a browser: TimeDensity, whose parts are those of density.py.
({ neurons, omega0 = 30, edge = 0, time, seams = [] }, tensors, count, lib) => {
  const { b1, b2, log_gain, W_t, offset_cos, offset_sin, window_center, log_window, velocity, acceleration, chunk } = tensors;
  const parts = new Set(time.split("+")), gains = lib.gains(log_gain, count), TERMS = 4;
  const tau = parts.has("window") ? Float64Array.from(log_window, Math.exp) : null;
  const birth = i => (tau ? window_center[i] : 0.5);
  const shares = new Float64Array(seams.length + 1);
  const share = i => (seams.length ? shares[Math.round(chunk[i])] : 1);
  const cosines = new Float64Array(TERMS), sines = new Float64Array(TERMS);

  function at({ time: xi }) {
    for (let j = 0; j < TERMS; j++) {
      cosines[j] = Math.cos(Math.PI * xi * (j + 1));
      sines[j] = Math.sin(Math.PI * xi * (j + 1));
    }
    shares.fill(1);
    seams.forEach(([begin, end], n) => {
      const handed = Math.min(Math.max((xi - begin) / (end - begin), 0), 1);
      for (let c = 0; c < shares.length; c++) shares[c] *= c > n ? handed : 1 - handed;
    });
    const frame = {};
    frame.weight = i => {
      const gain = gains[i] * share(i);
      if (!tau) return gain;
      const u = (xi - window_center[i]) / tau[i], left = Math.max(1 - u * u, 0);
      return gain * left * left;
    };
    frame.offset = i => {
      let offset = b2[i];
      if (parts.has("offset")) {
        for (let j = 0; j < TERMS; j++) offset += offset_cos[TERMS * i + j] * cosines[j] + offset_sin[TERMS * i + j] * sines[j];
      }
      return offset;
    };
    if (tau || seams.length) frame.alive = i => (!tau || Math.abs(xi - window_center[i]) < tau[i]) && share(i) > 0;
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
