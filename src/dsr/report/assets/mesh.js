// Triangles of a surface: what dsr/geometry/mesh.py makes, with the cuts that it has found.

const RIGHT = 1;
const BELOW = 2;
const WITH_DOUBTFUL = 2; // the same two flags, two bits higher
const DOUBTFUL = 16;
const FILLED = 32;

/** Return positions and normals of all pixels, 3 numbers each, and corners of the triangles, 3 indices each. */
function buildMesh(grid, withDoubtful) {
  const positions = positionsOf(grid);
  const corners = trianglesOf(grid, withDoubtful);
  return { positions, normals: normalsOf(positions, corners), corners };
}

/** Return the points in the camera frame: x right, y down, z forward, metres; 0 in holes. */
function positionsOf({ width, height, inverse, lens: [fx, fy, cx, cy] }) {
  const positions = new Float32Array(3 * width * height);
  for (let v = 0, i = 0; v < height; v++) {
    for (let u = 0; u < width; u++, i++) {
      const z = 1 / inverse[i];
      if (!(z > 0)) continue;
      positions[3 * i] = ((u - cx) / fx) * z;
      positions[3 * i + 1] = ((v - cy) / fy) * z;
      positions[3 * i + 2] = z;
    }
  }
  return positions;
}

/** Return the triangles, counterclockwise as the camera sees them. */
function trianglesOf({ width, height, inverse, flags }, withDoubtful) {
  const right = withDoubtful ? RIGHT << WITH_DOUBTFUL : RIGHT;
  const below = withDoubtful ? BELOW << WITH_DOUBTFUL : BELOW;
  const value = (i) => (!withDoubtful && flags[i] & DOUBTFUL ? NaN : inverse[i]);
  const change = (i, j) => { const by = Math.abs(value(i) - value(j)); return by >= 0 ? by : Infinity; };
  const corners = new Uint32Array(6 * (width - 1) * (height - 1));
  let count = 0;
  const add = (a, b, c) => { corners[count] = a; corners[count + 1] = b; corners[count + 2] = c; count += 3; };
  for (let v = 0; v + 1 < height; v++) {
    for (let u = 0; u + 1 < width; u++) {
      const a = v * width + u; // upper left, upper right, lower left, lower right
      const [b, c, d] = [a + 1, a + width, a + width + 1];
      const [top, left, bottom, end] = [flags[a] & right, flags[a] & below, flags[c] & right, flags[b] & below];
      if (!(change(a, d) > change(c, b))) {
        if (left && bottom) add(a, c, d);
        if (top && end) add(a, d, b);
      } else {
        if (left && top) add(a, c, b);
        if (bottom && end) add(c, d, b);
      }
    }
  }
  return corners.slice(0, count);
}

/** Return the unit normals of the points: the mean of their triangles', weighted by area. */
function normalsOf(p, corners) {
  const normals = new Float32Array(p.length);
  for (let k = 0; k < corners.length; k += 3) {
    const [a, b, c] = [3 * corners[k], 3 * corners[k + 1], 3 * corners[k + 2]];
    const [ux, uy, uz] = [p[b] - p[a], p[b + 1] - p[a + 1], p[b + 2] - p[a + 2]];
    const [vx, vy, vz] = [p[c] - p[a], p[c + 1] - p[a + 1], p[c + 2] - p[a + 2]];
    const [x, y, z] = [uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx];
    for (const i of [a, b, c]) { normals[i] += x; normals[i + 1] += y; normals[i + 2] += z; }
  }
  for (let i = 0; i < normals.length; i += 3) {
    const length = Math.hypot(normals[i], normals[i + 1], normals[i + 2]);
    if (length > 0) { normals[i] /= length; normals[i + 1] /= length; normals[i + 2] /= length; }
  }
  return normals;
}
