// In a browser: ScatteringHarmonics. The page draws the depth images out of the light.
(settings, tensors, count, lib) => {
  const own = (TIME_HARMONICS)(settings, tensors, count, lib), { channels, typical } = settings, { scattered } = tensors, rest = { base: new Float64Array(channels) };
  const shadow = { where: "primitive", light: ({ light }) => light, size: 64, layers: 16, fade: 1 / 16, before: 0.5 };

  function at(conditions, eye) {
    const { look } = own.at(conditions, eye), { light_intensity } = conditions;
    return {
      look: (i, centre, out) => {
        look(i, centre, { base: rest.base });
        for (let c = 0; c < channels; c++) {
          out.ambient[c] = Math.max(rest.base[c], 0);
          out.base[c] = (Math.max(scattered[channels * i + c], 0) * light_intensity[c]) / typical;
        }
      },
    };
  }
  return { network: null, shadow, at };
}
