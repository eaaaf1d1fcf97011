// In a browser: ScatteringHarmonics. The page draws the depth images out of the light.
(settings, tensors, count, lib) => {
  const own = (TIME_HARMONICS)(settings, tensors, count, lib), { channels, typical, octaves, share } = settings, { scattered } = tensors, rest = { base: new Float64Array(channels) };
  const sum = transmittance => {
    let found = 0, weight = 1;
    for (let o = 0; o < octaves; o++) {
      found += weight * transmittance;
      transmittance = Math.sqrt(transmittance);
      weight *= share;
    }
    return found;
  };
  const brightest = sum(1), scatter = transmittance => sum(transmittance) / brightest;
  const shadow = { where: "primitive", light: ({ light }) => light, size: 64, layers: 16, fade: 1 / 16, before: 0.5, scatter };

  function at(conditions, eye) {
    const { look } = own.at(conditions, eye), { light_intensity } = conditions;
    return {
      look: (i, centre, out) => {
        look(i, centre, { base: rest.base });
        for (let c = 0; c < channels; c++) {
          out.ambient[c] = Math.max(rest.base[c], 0);
          out.base[c] = (brightest * Math.max(scattered[channels * i + c], 0) * light_intensity[c]) / typical;
        }
      },
    };
  }
  return { network: null, shadow, at };
}
