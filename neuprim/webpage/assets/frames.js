// Frames from the worker, one at a time: the buffers travel there and back.
function framesOf(page, source) {
  let worker = null, answer = null, paint = null, buffers = null;
  const script = new Blob([source + '\n"use strict"; onmessage = preparing((message, transfer) => postMessage(message, transfer || []));'], { type: "text/javascript" });
  const ready = new Promise((resolve, reject) => {
    worker = new Worker(URL.createObjectURL(script));
    worker.onerror = event => reject(new Error(event.message));
    worker.onmessage = ({ data }) => {
      if (data.kind === "ready") resolve(data);
      else if (data.kind === "fault") reject(new Error(data.text));
      else if (data.kind === "light") { // what the light sees is drawn here, then the frame goes on there
        const maps = paint.shadowMaps(data);
        const copies = maps.map(map => map.buffer);
        worker.postMessage({ ...data, kind: "maps", camera: data.asked, maps }, [data.rows.buffer, data.phases.buffer, ...copies]);
      } else if (data.kind === "frame") {
        buffers = { rows: data.rows, phases: data.phases };
        answer(data);
      }
    };
  });
  worker.postMessage({ kind: "begin", page, numbers: document.getElementById("numbers").textContent });
  return {
    ready,
    drawnBy(painter, made) {
      paint = painter;
      buffers = buffers || { rows: new Float32Array(ROW * page.count), phases: new Float32Array(4 * made.moving * page.count) };
    },
    // The caller draws a frame before it asks for the next one, whose numbers take the place of this one's.
    prepared(camera, conditions) {
      return new Promise(resolve => {
        answer = resolve;
        const { rows, phases } = buffers;
        worker.postMessage({ kind: "frame", camera, conditions, rows, phases }, [rows.buffer, phases.buffer]);
      });
    },
  };
}
