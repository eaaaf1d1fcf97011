// In a browser: ScatteringHarmonics. The page draws the depth images out of the light.
(settings, tensors, count, lib) => {
  const own = (TIME_HARMONICS)(settings, tensors, count, lib), { channels, typical, octaves, share, anisotropy } = settings;
  const { scattered } = tensors, rest = { base: new Float64Array(channels) }, weight = new Float64Array(octaves);
  const shadow = { where: "primitive", light: ({ light }) => light, size: 96, layers: 24, fade: 1 / 24, before: 0.5 };
  const away = (to, from) => {
    const d = to.map((x, a) => x - from[a]), length = Math.hypot(...d);
    return d.map(x => x / Math.max(length, 1e-30));
  };

  function at(conditions, eye) {
    const { look } = own.at(conditions, eye), { light, light_intensity } = conditions;
    let unoccluded = 0; // the sum of the octaves' weights: the same for all primitives, or of the one that `look` was last called for
    const weigh = cosine => {
      unoccluded = 0;
      for (let o = 0; o < octaves; o++) {
        const g = anisotropy / 2 ** o;
        weight[o] = (share ** o * (1 - g * g)) / (1 + g * g - 2 * g * cosine) ** 1.5;
        unoccluded += weight[o];
      }
    };
    weigh(0);
    return {
      look: (i, centre, out) => {
        look(i, centre, { base: rest.base });
        if (anisotropy) weigh(lib.dot(away(light, centre), away(centre, eye)));
        for (let c = 0; c < channels; c++) {
          out.ambient[c] = Math.max(rest.base[c], 0);
          out.base[c] = (unoccluded * Math.max(scattered[channels * i + c], 0) * light_intensity[c]) / typical;
        }
      },
      scatter: (i, transmittance) => {
        let found = 0;
        for (let o = 0; o < octaves; o++) {
          found += weight[o] * transmittance;
          transmittance = Math.sqrt(transmittance);
        }
        return found / unoccluded;
      },
    };
  }
  return { network: null, shadow, at };
}
