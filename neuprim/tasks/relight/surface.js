// In a browser: SurfaceColour. The page draws the depth images out of the light.
({ lobes, indirect, channels, visibility, falloff, typical }, { c_dc, normal, highlight, log_gloss, indirect: around }, count, lib) => {
  const shadow = visibility === "none" ? null : { where: visibility, light: ({ light }) => light, size: 192, layers: 4, fade: 1 / 50, extents: 1.5 };
  const wrap = 0.01, gate = 20, shortest = 1e-6;
  const towards = new Float64Array(3), view = new Float64Array(3), half = new Float64Array(3), weights = new Float64Array(lobes);
  const normals = Float64Array.from(normal), gloss = Float64Array.from(log_gloss || [], x => Math.exp(Math.min(Math.max(x, -20), 20)));
  for (let i = 0; i < count; i++) {
    const own = normals.subarray(3 * i, 3 * i + 3), length = Math.max(Math.sqrt(lib.dot(own, own)), shortest);
    for (let a = 0; a < 3; a++) own[a] /= length;
  }

  function at({ light, light_intensity }, eye) {
    function look(i, centre, out) {
      const n = normals.subarray(3 * i, 3 * i + 3);
      for (let a = 0; a < 3; a++) {
        towards[a] = light[a] - centre[a];
        view[a] = eye[a] - centre[a];
      }
      const share = 1 / typical / (falloff ? Math.max(lib.dot(towards, towards), 1e-20) : 1);
      lib.unit(towards);
      lib.unit(view);
      for (let a = 0; a < 3; a++) half[a] = towards[a] + view[a];
      lib.unit(half);
      const cosine = lib.dot(n, towards), near = Math.min(lib.dot(n, half) - 1, 0);
      const diffuse = 0.5 * (cosine + Math.sqrt(cosine * cosine + wrap)), open = 1 / (1 + Math.exp(-gate * cosine));
      for (let j = 0; j < lobes; j++) weights[j] = open * Math.exp(gloss[i * lobes + j] * near);
      for (let c = 0; c < channels; c++) {
        let value = Math.max(c_dc[channels * i + c], 0) * diffuse;
        for (let j = 0; j < lobes; j++) value += Math.max(highlight[(i * lobes + j) * channels + c], 0) * weights[j];
        out.base[c] = value;
        value = indirect ? around[indirect * i * channels + c] : 0;
        for (let b = 1; b < indirect; b++) value += towards[b - 1] * around[(indirect * i + b) * channels + c];
        out.ambient[c] = Math.max(value, 0);
        out.factor[c] = light_intensity[c] * share;
      }
    }
    return { look };
  }
  return { network: null, shadow, at };
}
