// In a browser: TimeHarmonics.
({ degree, channels, powers, waves, frequencies }, { sh_dc, sh_rest, time_poly, time_cos, time_sin }, count, lib) => {
  const look = lib.harmonics(degree, channels, sh_rest), turn = frequencies === "printed" ? 1 : 2 * Math.PI;

  function at({ time: xi }, eye) {
    const terms = []; // [tensor, how many it has of each primitive, values]
    const upTo = (n, value) => Float64Array.from({ length: n }, (_, j) => value(j + 1));
    if (powers) terms.push([time_poly, powers, upTo(powers, j => xi ** j)]);
    if (waves) {
      terms.push([time_cos, waves, upTo(waves, j => Math.cos(turn * xi * j))]);
      terms.push([time_sin, waves, upTo(waves, j => Math.sin(turn * xi * j))]);
    }
    const lowest = i => c => {
      let value = sh_dc[channels * i + c];
      for (const [tensor, n, values] of terms) for (let j = 0; j < n; j++) value += tensor[(i * n + j) * channels + c] * values[j];
      return value;
    };
    return { look: (i, centre, out) => look(i, centre, eye, lowest(i), out.base) };
  }
  return { at };
}
