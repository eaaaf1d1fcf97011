// The model's numbers out of the page: byte planes, gzipped, in base64. What codes stand for: neuprim/core/compression.
async function numbersOf(text, parts, count) {
  if (typeof DecompressionStream === "undefined") throw new Error("this browser is too old to unpack the model (no DecompressionStream)");
  const packed = Uint8Array.from(atob(text), letter => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  let at = 0;

  function plane() {
    at += count;
    if (at > bytes.length) throw new Error("the model in this page is cut short");
    return bytes.subarray(at - count, at);
  }
  function codes(bits) { // (count,) whole numbers, low bytes of all first
    const whole = new Uint32Array(count);
    for (let shift = 0; shift < bits; shift += 8) {
      const part = plane();
      for (let n = 0; n < count; n++) whole[n] += part[n] * 2 ** shift;
    }
    return whole;
  }
  const decoders = {
    float32(columns, values) {
      for (let c = 0; c < columns; c++) {
        const numbers = new Float32Array(codes(32).buffer);
        for (let n = 0; n < count; n++) values[n * columns + c] = numbers[n];
      }
    },
    columns(columns, values, { bits, low, high }) {
      for (let c = 0; c < columns; c++) {
        const whole = codes(bits[c]), most = 2 ** bits[c] - 1;
        for (let n = 0; n < count; n++) values[n * columns + c] = (low[c] * (most - whole[n]) + high[c] * whole[n]) / most;
      }
    },
    rotations(columns, values, { bits }) { // which component is the largest, and the other three
      const largest = codes(2), half = 2 ** (bits - 1) - 1, norm = Math.sqrt(2 * half * half);
      const others = [0, 1, 2].map(() => codes(bits));
      for (let n = 0; n < count; n++) {
        let left = 2 * half * half;
        for (let j = 0; j < 3; j++) {
          const u = others[j][n] - half;
          values[4 * n + j + (j >= largest[n])] = u / norm;
          left -= u * u;
        }
        values[4 * n + largest[n]] = Math.sqrt(Math.max(left, 0)) / norm;
      }
    },
  };
  const tensors = {};
  for (const part of parts) {
    const columns = part.shape.reduce((product, n) => product * n, 1);
    tensors[part.name] = new Float32Array(count * columns);
    decoders[part.coding](columns, tensors[part.name], part);
  }
  return tensors;
}
