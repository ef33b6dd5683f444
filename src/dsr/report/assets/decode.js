// From the page's data to maps: see dsr/report/surface_page.py, which writes them.

/** Undo the compression by zlib. */
async function inflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Return a surface: inverse depth (NaN in holes), flags, and the levels of the errors by name. */
async function decodeGrid(about, text) {
  const { width, height, levels, range: [low, high] } = about;
  const bytes = await inflate(decode(text));
  const count = width * height;
  if (bytes.length !== count * (4 + about.errors.length)) throw new Error("the data of this page are damaged");
  const inverse = new Float64Array(count);
  const step = (high - low) / (levels - 1);
  const above = new Int32Array(width + 1);
  let at = 0;
  for (let v = 0; v < height; v++) {
    let left = 0;
    let corner = 0;
    for (let u = 0; u < width; u++, at++) {
      const rest = (bytes[at] << 16) | (bytes[count + at] << 8) | bytes[2 * count + at];
      const level = (rest + left + above[u] - corner) & levels;
      corner = above[u];
      above[u] = level;
      left = level;
      inverse[at] = level === 0 ? NaN : low + (level - 1) * step;
    }
  }
  const plane = (number) => bytes.subarray(number * count, (number + 1) * count);
  const errors = Object.fromEntries(about.errors.map((name, number) => [name, plane(4 + number)]));
  return { ...about, inverse, flags: plane(3), errors };
}
