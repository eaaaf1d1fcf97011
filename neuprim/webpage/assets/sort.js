// Front to back by depth, stable. Keys are relative and have 32 bits: depths in float32 are equal from afar, and with 16 bits near ones swap.
function sorter(most) {
  const keys = new Uint32Array(most), spare = new Int32Array(most), order = new Int32Array(most), ends = new Uint32Array(65537);

  function pass(count, from, to, shift) { // counting sort by 16 bits
    ends.fill(0);
    for (let n = 0; n < count; n++) ends[((keys[from[n]] >>> shift) & 65535) + 1]++;
    for (let k = 0; k < 65536; k++) ends[k + 1] += ends[k];
    for (let n = 0; n < count; n++) to[ends[(keys[from[n]] >>> shift) & 65535]++] = from[n];
  }

  // rows: which ones, ascending; depth: of every row. Returns them in order; the array is used again.
  return (rows, count, depth) => {
    let low = Infinity, high = -Infinity;
    for (let n = 0; n < count; n++) {
      low = Math.min(low, depth[rows[n]]);
      high = Math.max(high, depth[rows[n]]);
    }
    const steps = 4294967295 / Math.max(high - low, 1e-300);
    for (let n = 0; n < count; n++) keys[rows[n]] = (depth[rows[n]] - low) * steps;
    pass(count, rows, spare, 0);
    pass(count, spare, order, 16);
    return order;
  };
}
