// In a browser: LightNetwork. The page knows its closed form, a colour network per primitive, and draws the depth images out of the light.
({ hidden, channels, form, visibility, boost, falloff, typical }, { c_dc, net_x, net_view, net_light, net_phase, net_out }, count, lib) => {
  const multiplicative = form === "multiplicative";
  const base = (i, c) => (multiplicative ? Math.max(c_dc[channels * i + c], 0) : c_dc[channels * i + c]);
  const network = {
    hidden,
    input: (i, h, a) => boost * net_x[(i * hidden + h) * 3 + a],
    output: (i, h, c) => (multiplicative ? base(i, c) * net_out[i * hidden + h] : net_out[(i * channels + c) * hidden + h]),
  };
  const shadow = visibility === "none" ? null : { where: visibility, light: ({ light }) => light, size: 192, layers: 4, fade: visibility === "pixel" ? 1 / 10 : 1 / 50, extents: 1.5 };
  const view = new Float64Array(3), towards = new Float64Array(3);
  // What the light alone decides, kept while nothing but the camera moves: of each primitive its part of the phases, and what it gets of the light.
  const lit = new Float64Array(count * hidden), share = new Float64Array(count), done = new Int32Array(count);
  let known = "", turn = 0;

  function illuminate(i, centre, light) {
    for (let a = 0; a < 3; a++) towards[a] = light[a] - centre[a];
    share[i] = 1 / typical / (falloff ? Math.max(lib.dot(towards, towards), 1e-20) : 1);
    lib.unit(towards);
    for (let h = 0, o = 3 * hidden * i; h < hidden; h++, o += 3) {
      lit[i * hidden + h] = net_phase[i * hidden + h] + net_light[o] * towards[0] + net_light[o + 1] * towards[1] + net_light[o + 2] * towards[2];
    }
    done[i] = turn;
  }

  function at(conditions, eye) {
    const { light, light_intensity } = conditions, words = JSON.stringify(conditions);
    if (words !== known) {
      known = words;
      turn++;
    }
    function look(i, centre, out) {
      if (done[i] !== turn) illuminate(i, centre, light);
      for (let a = 0; a < 3; a++) view[a] = centre[a] - eye[a];
      lib.unit(view);
      for (let c = 0; c < channels; c++) {
        out.base[c] = base(i, c);
        out.factor[c] = light_intensity[c] * share[i];
      }
      for (let h = 0, o = 3 * hidden * i; h < hidden; h++, o += 3) {
        out.phases[h] = boost * (lit[i * hidden + h] + net_view[o] * view[0] + net_view[o + 1] * view[1] + net_view[o + 2] * view[2]);
      }
    }
    return { look };
  }
  return { network: hidden ? network : null, shadow, at };
}
