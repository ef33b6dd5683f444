// Pictures of values: decoding them, and what is drawn from them.

const HOLE = 0, DEPTH = 128, NORMAL = 255;
const ANGLE_LIMIT = 60;
const decoded = new Map();

/** Return the pixels of a stored picture, RGBA, without any colour conversion. */
async function pixelsOf(id) {
  const bytes = decode(textOf(id));
  const blob = new Blob([bytes], { type: bytes[0] === 0x89 ? "image/png" : "image/webp" });
  const bitmap = await createImageBitmap(blob, { colorSpaceConversion: "none", premultiplyAlpha: "none" });
  const canvas = make("canvas", { width: bitmap.width, height: bitmap.height });
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(bitmap, 0, 0);
  bitmap.close();
  return context.getImageData(0, 0, canvas.width, canvas.height);
}

/** Return the first channel of a picture as bytes. */
async function bytesOf(id) {
  const { data, width, height } = await pixelsOf(id);
  const values = new Uint8Array(width * height);
  for (let i = 0; i < values.length; i++) values[i] = data[4 * i];
  return values;
}

/** Decode a scene once: the photo, and of each surface its shadings, depth, errors and what is known of them. */
async function loadScene(entry) {
  if (decoded.has(entry.data)) return decoded.get(entry.data);
  const scene = block(entry.data);
  const loading = (async () => {
    scene.pixels = await pixelsOf(scene.photo);
    scene.width = scene.pixels.width;
    scene.height = scene.pixels.height;
    await Promise.all(scene.surfaces.map(loadSurface));
    return scene;
  })();
  decoded.set(entry.data, loading);
  if (decoded.size > 3) decoded.delete(decoded.keys().next().value);
  return loading;
}

/** Decode a surface. */
async function loadSurface(surface) {
  const [width, height] = surface.size;
  surface.width = width;
  surface.height = height;
  const tiles = await bytesOf(surface.normals);
  surface.shadings = [0, 1, 2].map((k) => {
    const values = new Uint8Array(width * height);
    for (let v = 0; v < height; v++) values.set(tiles.subarray(v * 3 * width + k * width, v * 3 * width + (k + 1) * width), v * width);
    return values;
  });
  surface.depths = await bytesOf(surface.depth);
  surface.known = surface.mask ? await bytesOf(surface.mask) : null;
  if (surface.error) {
    surface.errors = await bytesOf(surface.error.values);
    surface.errorsKnown = surface.error.mask ? await bytesOf(surface.error.mask) : null;
  }
  if (surface.expected) {
    const { depth, angle, mask } = surface.expected;
    surface.expectedValues = { depth: await bytesOf(depth), angle: await bytesOf(angle) };
    surface.expectedKnown = mask ? await bytesOf(mask) : null;
  }
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

/** Return the error in metres that a stored value stands for. */
const errorOf = (stored, largest) => (Math.sign(stored - 128) * (stored - 128) ** 2 * largest) / 127 ** 2;

/** Return the error of the truth at its pixel i: 0, NaN where its mask is less than `least`. */
const ofTruth = (truth, i, least) => (truth.known && truth.known[i] < least ? NaN : 0);

/** What can be asked of a surface at its pixel i; NaN where it is not known. */
const probe = {
  shade(surface, i, weights) {
    if (surface.known && surface.known[i] !== NORMAL) return NaN;
    const s = surface.shadings;
    const value = weights[0] * (s[0][i] / 127.5 - 1) + weights[1] * (s[1][i] / 127.5 - 1) + weights[2] * (s[2][i] / 127.5 - 1);
    return clamp(value, 0, 1);
  },
  depth(surface, i, [low, high]) {
    return surface.known && surface.known[i] === HOLE ? NaN : low + (surface.depths[i] / 255) * (high - low);
  },
  error(surface, i, largest) {
    if (!surface.errors || (surface.errorsKnown && surface.errorsKnown[i] === HOLE)) return NaN;
    return errorOf(surface.errors[i], largest);
  },
  /** The expected error of the depth in metres, or of the normal, the "angle", in degrees. */
  expected(surface, i, name, largest) {
    if (!surface.expected) return NaN;
    const known = surface.expectedKnown?.[i] ?? NORMAL;
    return known === HOLE || (name === "angle" && known !== NORMAL) ? NaN : (surface.expectedValues[name][i] / 255) ** 2 * largest[name];
  },
  /** Degrees between two normals; from the chord, which loses no digits where they are close. */
  angle(surface, i, other, j) {
    if ((surface.known && surface.known[i] !== NORMAL) || (other.known && other.known[j] !== NORMAL)) return NaN;
    let square = 0;
    for (let k = 0; k < 3; k++) square += ((surface.shadings[k][i] - other.shadings[k][j]) / 127.5) ** 2;
    return (2 * Math.asin(Math.min(1, Math.sqrt(square) / 2)) * 180) / Math.PI;
  },
};

/** Return the pixel of a surface that lies at pixel (u, v) of the scene. */
const pixelAt = (surface, scene, u, v) =>
  Math.floor(((v + 0.5) * surface.height) / scene.height) * surface.width + Math.floor(((u + 0.5) * surface.width) / scene.width);

/** Return the weights of the stored shadings, those under an orthonormal basis, that make up the one under a light. */
const weightsOf = (light, basis) => basis.map((direction) => dot(light, direction));

/** The views of expected errors, and under which name their values are stored. */
const EXPECTED = { expectedError: "depth", expectedAngle: "angle" };

/**
 * Return what draws a view: the function of a surface's pixel, the colours and limits of its values, whether a surface
 * has it at all, and what stands in place of the picture if not.
 */
function viewOf(name, scene, state) {
  const truth = scene.surfaces.find((surface) => surface.kind === "truth");
  if (name === "depth") return { of: (s, i) => probe.depth(s, i, scene.depth), colours: "depth", low: scene.depth[0], high: scene.depth[1] };
  if (name === "error") {
    const { limit, largest } = scene.error;
    const of = (s, i) => (s.kind === "truth" ? ofTruth(s, i, DEPTH) : probe.error(s, i, largest));
    return { of, has: (s) => s.kind === "truth" || Boolean(s.errors), silent: "is not compared with the truth", colours: "error", low: -limit, high: limit };
  }
  if (name in EXPECTED) {
    const what = EXPECTED[name];
    const of = (s, i) => (s.kind === "truth" ? ofTruth(s, i, what === "angle" ? NORMAL : DEPTH) : probe.expected(s, i, what, scene.expected));
    const limits = what === "angle" ? { colours: "angle", low: 0, high: ANGLE_LIMIT } : { colours: "error", low: -scene.error.limit, high: scene.error.limit };
    return { of, has: (s) => s.kind === "truth" || Boolean(s.expected), silent: "says nothing of its errors", ...limits };
  }
  if (name === "angle") return { of: (s, i, u, v) => probe.angle(s, i, truth, pixelAt(truth, scene, u, v)), colours: "angle", low: 0, high: ANGLE_LIMIT };
  return { of: (s, i) => probe.shade(s, i, state.weights), weights: state.weights, colours: null, low: 0, high: 1 };
}

/** Draw a surface at the scene's size. */
function paint(canvas, surface, scene, view, colours, hole) {
  if (canvas.width !== scene.width || canvas.height !== scene.height) {
    canvas.width = scene.width;
    canvas.height = scene.height;
  }
  const context = canvas.getContext("2d", { willReadFrequently: true });
  if (surface === null) {
    context.putImageData(scene.pixels, 0, 0);
    return;
  }
  const image = context.createImageData(scene.width, scene.height);
  if (view.has && !view.has(surface)) {
    context.putImageData(image, 0, 0);
    return;
  }
  const out = new Uint32Array(image.data.buffer);
  if (view.weights && surface.width === scene.width && surface.height === scene.height) {
    paintShades(out, surface, view.weights, hole);
    context.putImageData(image, 0, 0);
    return;
  }
  const table = colours[view.colours] ?? GREY;
  const factor = 255 / (view.high - view.low);
  const same = surface.width === scene.width && surface.height === scene.height;
  for (let v = 0, at = 0; v < scene.height; v++) {
    for (let u = 0; u < scene.width; u++, at++) {
      const value = view.of(surface, same ? at : pixelAt(surface, scene, u, v), u, v);
      out[at] = value === value ? table[clamp(Math.round((value - view.low) * factor), 0, 255)] : hole;
    }
  }
  context.putImageData(image, 0, 0);
}

/** Draw the rendering of a surface of the scene's size: the same as by pixel, many times faster. */
function paintShades(out, surface, weights, hole) {
  const [a, b, c] = weights.map((weight) => Float64Array.from({ length: 256 }, (_, q) => 255 * weight * (q / 127.5 - 1)));
  const [s0, s1, s2] = surface.shadings;
  const { known } = surface;
  for (let i = 0; i < out.length; i++) {
    const value = a[s0[i]] + b[s1[i]] + c[s2[i]];
    out[i] = known !== null && known[i] !== NORMAL ? hole : GREY[value <= 0 ? 0 : value >= 255 ? 255 : (value + 0.5) | 0];
  }
}

/** Return whether pixels can be read back as they are; browsers that hide from trackers change them. */
function pixelsAreTrue() {
  const canvas = make("canvas", { width: 16, height: 16 });
  const context = canvas.getContext("2d", { willReadFrequently: true });
  const image = context.createImageData(16, 16);
  for (let i = 0; i < 1024; i++) image.data[i] = i % 4 === 3 ? 255 : (37 * i) % 256;
  context.putImageData(image, 0, 0);
  const read = context.getImageData(0, 0, 16, 16).data;
  return image.data.every((value, i) => value === read[i]);
}

/** Return colours as packed ones. */
const packed = (colours) => new Uint32Array(colours.buffer);

const GREY = packed(Uint8Array.from({ length: 1024 }, (_, i) => (i % 4 === 3 ? 255 : i >> 2)));

/** Fill an element with a colour bar, of the colours from the `first` on, and what its ends and middle stand for. */
function colourBar(element, map, texts, first = 0) {
  const canvas = make("canvas", { width: 256 - first, height: 1, "aria-hidden": "true" });
  const context = canvas.getContext("2d");
  const image = context.createImageData(256 - first, 1);
  new Uint32Array(image.data.buffer).set(map.subarray(first));
  context.putImageData(image, 0, 0);
  element.replaceChildren(canvas, make("div", {}, ...texts.map((text) => make("span", { textContent: text }))));
}
