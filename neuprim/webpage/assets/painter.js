// WebGL2: instanced polygons over the silhouettes, blended front to back into float numbers, then shown.
const MODES = ["COLOUR", "ALPHA", "DEPTH", "SLICE", "ELLIPSOIDS"];
const MAX_WIDTH = 2048; // of textures; what every WebGL2 has
const CORNERS = 8;

// made: what the worker tells of the model ("ready"). Raises an Error where this browser cannot draw it.
function painter(canvas, page, made) {
  const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, depth: false, powerPreference: "high-performance" });
  if (!gl) throw new Error("this browser has no WebGL2");
  if (!gl.getExtension("EXT_color_buffer_float")) throw new Error("this browser's WebGL2 cannot draw into float textures");
  const exact = !!gl.getExtension("EXT_float_blend"); // else 16-bit floats, which always blend
  const horner = list => list.slice(1).reduce((text, c) => `(${text}) * z + (${c.toExponential(12)})`, list[0].toExponential(12));
  const { cos, sinc, edge, nodes, weights } = page.constants[made.edge];
  const words = { COS_POLY: horner(cos), SINC_POLY: horner(sinc), EDGE_POLY: horner(edge), NODES: nodes.join(), WEIGHTS: weights.join() };
  const sizes = {
    EDGE: made.edge, CORNERS, MAX_WIDTH, HIDDEN: made.H, NEURON_TEXELS: made.neurons.texels, MOVING: made.moving,
    ...Object.fromEntries(MODES.map((name, k) => [name, k])),
  };
  const head = Object.entries(sizes).map(([name, value]) => `#define ${name} ${value}\n`).join("");

  // Loops over neurons and units are unrolled: constant indices, which software rasterisers do not find by themselves.
  const component = k => "b." + "xyzw"[k % 4];
  const eachNeuron = (_, body) => Array.from({ length: made.K }, (_, k) => {
    const phases = made.turns ? `moving, movingAt + ivec2(${k >> 2}, 0)` : `neurons, at + ivec2(${made.K + (k >> 2)}, 0)`;
    return (k % 4 ? "" : `b = texelFetch(${phases}, 0);\n`) + `w = texelFetch(neurons, at + ivec2(${k}, 0), 0); ${body.replace("PHASE", component(k))}`;
  }).join("\n");
  const eachUnit = (_, body) => Array.from({ length: made.H }, (_, h) => {
    const first = made.turns ? made.phaseTexels : 0;
    return (h % 4 ? "" : `b = texelFetch(moving, movingAt + ivec2(${first + (h >> 2)}, 0), 0);\n`) +
      `w = texelFetch(units, unitAt + ivec2(${2 * h}, 0), 0); o = texelFetch(units, unitAt + ivec2(${2 * h + 1}, 0), 0); ${body.replace("PHASE", component(h))}`;
  }).join("\n");

  function program(vertex, fragment, more = "") {
    const linked = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      const whole = text.replace(/\b(COS_POLY|SINC_POLY|EDGE_POLY|NODES|WEIGHTS)\b/g, name => words[name])
        .replace(/EACH_NEURON\((.*)\)$/gm, eachNeuron).replace(/EACH_UNIT\((.*)\)$/gm, eachUnit);
      gl.shaderSource(shader, `#version 300 es\n${head}${more}precision highp float;\nprecision highp int;\nprecision highp sampler2D;\n${whole}`);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(linked, shader);
    }
    gl.linkProgram(linked);
    if (!gl.getProgramParameter(linked, gl.LINK_STATUS) && !gl.isContextLost()) throw new Error(gl.getProgramInfoLog(linked));
    const places = {};
    return { linked, at: name => (name in places ? places[name] : (places[name] = gl.getUniformLocation(linked, name))) };
  }
  const splat = program(shaders["splat.vert"], shaders["splat.frag"]);
  const show = program(shaders["screen.vert"], shaders["resolve.frag"], "#define FLIPPED 1\n");
  const numbers = program(shaders["screen.vert"], shaders["resolve.frag"], "#define FLIPPED 0\n");

  function texture(unit, format, width, height, layers = 0) {
    const kind = layers ? gl.TEXTURE_2D_ARRAY : gl.TEXTURE_2D, made = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(kind, made);
    if (layers) gl.texStorage3D(kind, 1, format, width, height, layers);
    else gl.texStorage2D(kind, 1, format, width, height);
    gl.texParameteri(kind, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(kind, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    return made;
  }

  // A table of `texels` vec4 per primitive, none of which runs over the end of a line. fill() loads those of the first primitives.
  function table(unit, texels, count) {
    const perRow = Math.floor(MAX_WIDTH / Math.max(texels, 1)), lines = Math.max(1, Math.ceil(count / perRow)), wide = Math.max(1, perRow * texels);
    texture(unit, gl.RGBA32F, wide, lines);
    const line = new Float32Array(4 * wide);
    return data => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      for (let y = 0, from = 0; from < data.length; y++, from += 4 * perRow * texels) {
        line.set(data.subarray(from, from + 4 * perRow * texels));
        gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, y, wide, 1, gl.RGBA, gl.FLOAT, line);
      }
    };
  }
  const NEURONS = 0, UNITS = 1, MOVING = 2, IMAGE = 3, DEPTHS = 4, MAPS = 5, SPARE = 6;
  table(NEURONS, made.neurons.texels, page.count)(made.neurons.data);
  table(UNITS, made.units.texels, page.count)(made.units.data);
  const load = table(MOVING, made.moving, page.count);
  gl.useProgram(splat.linked);
  gl.uniform1i(splat.at("neurons"), NEURONS);
  gl.uniform1i(splat.at("units"), UNITS);
  gl.uniform1i(splat.at("moving"), MOVING);
  const rowsBuffer = gl.createBuffer(), instances = gl.createVertexArray(), nothing = gl.createVertexArray();
  const format = exact ? gl.RGBA32F : gl.RGBA16F;

  function target(unit, width, height) {
    const image = texture(unit, format, width, height), frame = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, image, 0);
    return { image, frame, width, height };
  }
  function resized(old, unit, width, height) {
    if (old && old.width === width && old.height === height) return old;
    if (old) {
      gl.deleteTexture(old.image);
      gl.deleteFramebuffer(old.frame);
    }
    return target(unit, width, height);
  }
  const targets = {};
  let maps = null;

  function upload(rows, phases, count) {
    gl.bindBuffer(gl.ARRAY_BUFFER, rowsBuffer);
    gl.bufferData(gl.ARRAY_BUFFER, rows.subarray(0, ROW * count), gl.STREAM_DRAW);
    if (made.moving) load(phases.subarray(0, 4 * made.moving * count));
  }

  // Rows first..end of what was uploaded, into one of the targets.
  function splats(name, unit, camera, first, end, mode, plane = 0) {
    const to = (targets[name] = resized(targets[name], unit, camera.width, camera.height));
    gl.bindFramebuffer(gl.FRAMEBUFFER, to.frame);
    gl.viewport(0, 0, to.width, to.height);
    gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 1]);
    if (end <= first) return;
    gl.useProgram(splat.linked);
    gl.bindVertexArray(instances);
    gl.bindBuffer(gl.ARRAY_BUFFER, rowsBuffer);
    for (let k = 0; k < ROW / 4; k++) {
      gl.enableVertexAttribArray(k);
      gl.vertexAttribDivisor(k, 1);
      gl.vertexAttribPointer(k, 4, gl.FLOAT, false, 4 * ROW, 4 * ROW * first + 16 * k);
    }
    gl.uniform2f(splat.at("size"), to.width, to.height);
    gl.uniform4f(splat.at("lens"), 1 / camera.fx, 1 / camera.fy, camera.cx, camera.cy);
    gl.uniform2f(splat.at("limits"), page.renderer.alpha_min, page.renderer.alpha_max);
    gl.uniform1i(splat.at("mode"), MODES.indexOf(mode));
    gl.uniform1f(splat.at("plane"), plane);
    gl.enable(gl.BLEND);
    if (mode === "SLICE") gl.blendFunc(gl.ONE, gl.ONE); // densities add up
    else gl.blendFuncSeparate(gl.DST_ALPHA, gl.ONE, gl.ZERO, gl.ONE_MINUS_SRC_ALPHA); // C += T alpha c, T *= 1 - alpha
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, CORNERS, end - first);
    gl.disable(gl.BLEND);
  }

  function read(width, height, frame) {
    const values = new Float32Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, values);
    return values;
  }

  // Depth images out of the light, slab by slab: Float32Array (size, size, 4) each. place: the number of the light's camera, and how many there are.
  function shadowMaps({ camera, rows, phases, ends, place: [number, cameras] }) {
    upload(rows, phases, ends[ends.length - 1]);
    const found = ends.map((end, k) => {
      splats("light", SPARE, camera, k ? ends[k - 1] : 0, end, "DEPTH");
      return read(camera.width, camera.height, targets.light.frame);
    });
    if (made.shadow.where === "pixel") {
      if (number === 0) {
        if (maps) gl.deleteTexture(maps);
        maps = texture(MAPS, gl.RGBA32F, camera.width, camera.height, cameras * found.length);
      }
      gl.activeTexture(gl.TEXTURE0 + MAPS);
      found.forEach((map, k) => gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, number * found.length + k, camera.width, camera.height, 1, gl.RGBA, gl.FLOAT, map));
    }
    return found;
  }

  // One frame: {camera, rows, phases, count, light}, light: the light's cameras. view: {mode, plane, range, top, background}.
  function draw({ camera, rows, phases, count, light }, { mode, plane }) {
    upload(rows, phases, count);
    splats("image", IMAGE, camera, 0, count, mode, plane);
    if (pixelShadow(light) && mode === "COLOUR") splats("depths", DEPTHS, camera, 0, count, "DEPTH");
  }
  const pixelShadow = light => light.length > 0 && made.shadow.where === "pixel";

  function resolve(shader, { camera, light }, { mode, range = [0, 1], top = 1, background = page.background }) {
    gl.useProgram(shader.linked);
    gl.bindVertexArray(nothing);
    gl.viewport(0, 0, camera.width, camera.height);
    for (const [name, unit] of [["image", IMAGE], ["depths", DEPTHS], ["maps", MAPS]]) gl.uniform1i(shader.at(name), unit);
    gl.activeTexture(gl.TEXTURE0 + IMAGE);
    gl.bindTexture(gl.TEXTURE_2D, targets.image.image);
    gl.uniform3f(shader.at("background"), ...background);
    gl.uniform1i(shader.at("linear"), page.linear ? 1 : 0);
    gl.uniform1i(shader.at("mode"), MODES.indexOf(mode));
    gl.uniform2f(shader.at("range"), ...range);
    gl.uniform1f(shader.at("top"), top);
    const shaded = pixelShadow(light) && mode === "COLOUR";
    gl.uniform1i(shader.at("shaded"), shaded ? 1 : 0);
    if (shaded) {
      const { R, t, fx, fy, cx, cy } = camera, columns = [];
      for (const [a, b, c] of [[1 / fx, 0, 0], [0, 1 / fy, 0], [-cx / fx, -cy / fy, 1]]) columns.push(R[0] * a + R[3] * b + R[6] * c, R[1] * a + R[4] * b + R[7] * c, R[2] * a + R[5] * b + R[8] * c, 0);
      const eye = [0, 1, 2].map(a => -(R[a] * t[0] + R[3 + a] * t[1] + R[6 + a] * t[2]));
      gl.uniformMatrix4fv(shader.at("toScene"), false, [...columns, ...eye, 1]);
      const places = light.flatMap(({ R: L, t }) => [L[0], L[3], L[6], 0, L[1], L[4], L[7], 0, L[2], L[5], L[8], 0, ...t, 1]);
      gl.uniformMatrix4fv(shader.at("toLight"), false, places);
      gl.uniform1i(shader.at("cameras"), light.length);
      gl.uniform3f(shader.at("source"), ...light[0].from);
      gl.uniform3f(shader.at("light"), light[0].fx, light[0].near, light[0].diameter * made.shadow.fade);
    }
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  return {
    gl, exact, draw, shadowMaps,
    show(frame, view) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      resolve(show, frame, view);
    },
    numbers(frame, view) { // (height, width, 4) float32: colour before the background, T; also waits for the card
      const { width, height } = frame.camera;
      targets.numbers = resized(targets.numbers, SPARE, width, height);
      gl.bindFramebuffer(gl.FRAMEBUFFER, targets.numbers.frame);
      resolve(numbers, frame, view);
      return read(width, height, targets.numbers.frame);
    },
  };
}
