// For tests and measurements: frames at any camera, as numbers.
const probe = {
  idle: () => !!paint && !busy && drawn > 0,
  async frame(camera, values) {
    while (!probe.idle()) await new Promise(resolve => setTimeout(resolve, 5));
    busy = true;
    return frames.prepared(camera, values);
  },
  base64(bytes) {
    let text = "";
    for (let i = 0; i < bytes.length; i += 32768) text += String.fromCharCode(...bytes.subarray(i, i + 32768));
    return btoa(text);
  },
  // base64 of (height, width, 4) float32, bottom row last: colour before the background (of DEPTH, sum of w z), T.
  async numbers(camera, values, mode = "COLOUR", plane = 1) {
    const frame = await probe.frame(camera, values);
    paint.draw(frame, { mode, plane });
    const found = paint.numbers(frame, { mode });
    busy = false;
    return { count: frame.count, milliseconds: frame.milliseconds, exact: paint.exact, pixels: probe.base64(new Uint8Array(found.buffer)) };
  },
  // base64 of (height, width, 4) bytes of the canvas, bottom row first: what a person sees.
  async shown(camera, values) {
    const frame = await probe.frame(camera, values), { gl } = paint, bytes = new Uint8Array(4 * camera.width * camera.height);
    Object.assign(canvas, { width: camera.width, height: camera.height });
    paint.draw(frame, { mode: "COLOUR" });
    paint.show(frame, { mode: "COLOUR" });
    gl.readPixels(0, 0, camera.width, camera.height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    busy = false;
    return probe.base64(bytes);
  },
};
