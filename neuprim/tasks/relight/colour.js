// In a browser: LightNetwork. The page knows its closed form, a colour network per primitive, and draws the depth images out of the light.
({ hidden, channels, form, visibility, boost, falloff, typical }, { c_dc, net_x, net_view, net_light, net_phase, net_out }, count, lib) => {
  const multiplicative = form === "multiplicative";
  const base = (i, c) => (multiplicative ? Math.max(c_dc[channels * i + c], 0) : c_dc[channels * i + c]);
  const network = {
    hidden,
    input: (i, h, a) => boost * net_x[(i * hidden + h) * 3 + a],
    output: (i, h, c) => (multiplicative ? base(i, c) * net_out[i * hidden + h] : net_out[(i * channels + c) * hidden + h]),
  };
  const shadow = visibility === "none" ? null : { where: visibility, light: ({ light }) => light, size: 192, layers: 4, bias: 1 / 20, softness: 1 / 20 };
  const view = new Float64Array(3), towards = new Float64Array(3);

  function at({ light, light_intensity }, eye) {
    function look(i, centre, out) {
      for (let a = 0; a < 3; a++) {
        view[a] = centre[a] - eye[a];
        towards[a] = light[a] - centre[a];
      }
      const squared = Math.max(lib.dot(towards, towards), 1e-12);
      lib.unit(view);
      lib.unit(towards);
      for (let c = 0; c < channels; c++) {
        out.base[c] = base(i, c);
        out.factor[c] = light_intensity[c] / typical / (falloff ? squared : 1);
      }
      for (let h = 0; h < hidden; h++) {
        const o = (i * hidden + h) * 3;
        let phase = net_phase[i * hidden + h];
        for (let a = 0; a < 3; a++) phase += net_view[o + a] * view[a] + net_light[o + a] * towards[a];
        out.phases[h] = boost * phase;
      }
    }
    return { look };
  }
  return { network: hidden ? network : null, shadow, at };
}
