// Off the main thread: unpacks the model, prepares frames, works out shadows. Messages: {kind, ...} here and back, one frame at a time.
function preparing(post) {
  let engine = null, colour = null, known = "", settled = null, lit = "", cameras = [], maps = [], visible = null;

  async function begin({ page, numbers }) {
    const tensors = await numbersOf(numbers, page.numbers, page.count);
    const density = fieldScripts.density(page.fields.density, tensors, page.count, lib);
    colour = fieldScripts.colour(page.fields.colour, tensors, page.count, lib);
    engine = preparer(page, tensors, density, colour);
    const { neurons, units, moving, turns, K, H, edge, phaseTexels } = engine;
    const { where, fade } = colour.shadow || {}; // functions do not travel
    post({ kind: "ready", neurons, units, moving, turns, K, H, edge, phaseTexels, shadow: { where, fade } });
  }

  function frame(request) {
    const start = performance.now() - (request.spent || 0), { conditions, rows, phases } = request, shadow = colour.shadow, words = JSON.stringify(conditions);
    if (known !== words) { // while only the camera moves, who lives and where stays
      settled = engine.settle(conditions);
      known = words;
    }
    if (shadow && lit !== words) { // what the light sees has changed: the page draws it first, camera by camera, and asks again with the images
      cameras = settled.living.length ? lightCameras(engine.scene, engine.scales, settled.living, shadow.light(conditions), shadow) : [];
      lit = words;
      visible = null;
      maps = [];
    }
    if (maps.length < cameras.length) {
      const camera = cameras[maps.length], count = engine.frame(camera, conditions, settled, null, rows, phases, false);
      const ends = [...engine.within(rows, count, camera.edges), count], place = [maps.length, cameras.length];
      const spent = performance.now() - start;
      return post({ ...request, kind: "light", camera, ends, place, asked: request.camera, spent }, [rows.buffer, phases.buffer]);
    }
    if (cameras.length && shadow.where === "primitive" && !visible) {
      const source = shadow.light(conditions), { extents = 0, before = 0 } = shadow;
      const fade = i => shadow.fade * cameras[0].diameter + (extents && extents * engine.extentTowards(i, source));
      visible = new Float64Array(engine.scales.length);
      for (const i of settled.living) {
        const [x, y, z] = engine.scene.subarray(3 * i, 3 * i + 3);
        const k = facing(cameras, x, y, z);
        visible[i] = Math.fround(arrivingAt(x, y, z, cameras[k], maps[k], fade(i), before));
      }
    }
    const count = engine.frame(request.camera, conditions, settled, visible, rows, phases);
    post({ ...request, kind: "frame", count, light: cameras, milliseconds: performance.now() - start }, [rows.buffer, phases.buffer]);
  }

  return ({ data }) => {
    if (data.kind === "begin") begin(data).catch(error => post({ kind: "fault", text: error.message }));
    if (data.kind === "frame") frame(data);
    if (data.kind === "maps") {
      maps.push(data.maps);
      frame({ ...data, kind: "frame", maps: null });
    }
  };
}
