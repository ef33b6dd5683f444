// Drawing with WebGL 2. Everything is in the camera frame: x right, y down, z forward, metres.

const VERTEX_SHADER = `#version 300 es
precision highp float;
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
uniform mat3 turn;
uniform vec3 pivot, offset;
uniform vec4 lens;
uniform vec2 size, fit, range;
out vec3 towards;
out vec2 place;
void main() {
  int width = int(size.x);
  place = (vec2(gl_VertexID % width, gl_VertexID / width) + 0.5) / size;
  towards = turn * normal;
  vec3 p = turn * (position - pivot) + offset;
  vec2 pixel = lens.xy * p.xy + (lens.zw + 0.5) * p.z; // from the outer edge of the photo, times the depth
  vec2 screen = (2.0 * pixel / size - p.z) * vec2(1.0, -1.0) * fit;
  float far = range.y, near = range.x;
  gl_Position = vec4(screen, ((far + near) * p.z - 2.0 * far * near) / (far - near), p.z);
}`;

const FRAGMENT_SHADER = `#version 300 es
precision highp float;
in vec3 towards;
in vec2 place;
uniform vec3 light, tones;
uniform vec2 size;
uniform int kind; // 0 grey, 1 photo, 2 errors, 3 filled pixels in colour
uniform sampler2D photo, errors, colours;
out vec4 colour;
void main() {
  vec3 n = normalize(gl_FrontFacing ? towards : -towards);
  float shade = tones.x + (tones.y - tones.x) * pow(max(0.0, (1.0 + dot(n, light)) / 2.0), tones.z);
  vec3 matter = vec3(shade);
  if (kind == 1) matter = texture(photo, place).rgb * (0.25 + 1.05 * shade);
  if (kind == 2) {
    int level = int(255.0 * texelFetch(errors, ivec2(place * size), 0).r + 0.5);
    matter = level == 0 ? vec3(0.5) : texelFetch(colours, ivec2(level, 0), 0).rgb;
  }
  if (kind == 3 && texelFetch(errors, ivec2(place * size), 0).r > 0.0) matter = vec3(1.0, 0.62, 0.15) * (0.35 + 0.75 * shade);
  if (!gl_FrontFacing) matter = mix(vec3(0.10, 0.13, 0.16), vec3(0.34, 0.40, 0.46), shade);
  colour = vec4(min(matter, 1.0), 1.0);
}`;

const KINDS = { grey: 0, photo: 1, depth: 2, angle: 2, filled: 3 };
const UNIFORMS = ["turn", "pivot", "offset", "lens", "size", "fit", "range", "light", "tones", "kind", "photo", "errors", "colours"];

class Scene {
  /** Start WebGL on a canvas; throws if there is none. */
  constructor(canvas, colours, tones) {
    this.canvas = canvas;
    const gl = canvas.getContext("webgl2", { antialias: true, alpha: true, powerPreference: "high-performance" });
    if (!gl) throw new Error("no WebGL 2");
    this.gl = gl;
    this.tones = tones;
    this.program = this.compile();
    this.at = Object.fromEntries(UNIFORMS.map((name) => [name, gl.getUniformLocation(this.program, name)]));
    this.largest = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    this.palette = this.texture(gl.RGBA8, gl.RGBA, 256, 1, colours, gl.NEAREST);
    this.blank = this.texture(gl.RGBA8, gl.RGBA, 1, 1, new Uint8Array([128, 128, 128, 255]), gl.NEAREST);
    this.surfaces = {};
    this.photo = null;
    gl.enable(gl.DEPTH_TEST);
    gl.clearColor(0, 0, 0, 0); // what is behind the canvas shows through the holes
  }

  compile() {
    const gl = this.gl;
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX_SHADER], [gl.FRAGMENT_SHADER, FRAGMENT_SHADER]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program) ?? "no program");
    return program;
  }

  texture(format, layout, width, height, content, filter) {
    const gl = this.gl;
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage2D(gl.TEXTURE_2D, 0, format, width, height, 0, layout, gl.UNSIGNED_BYTE, content);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, filter);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, filter === gl.LINEAR ? gl.LINEAR_MIPMAP_LINEAR : filter);
    if (filter === gl.LINEAR) gl.generateMipmap(gl.TEXTURE_2D);
    return texture;
  }

  /** Take a decoded photo, or none. */
  setPhoto(image) {
    const gl = this.gl;
    if (this.photo) gl.deleteTexture(this.photo);
    this.photo = image ? this.texture(gl.RGBA8, gl.RGBA, image.width, image.height, image, gl.LINEAR) : null;
  }

  /** Take a surface under a name in place of the one before. */
  setSurface(name, grid, mesh) {
    this.dropSurface(name);
    const gl = this.gl;
    const surface = { grid, count: mesh.corners.length, array: gl.createVertexArray(), buffers: [], errors: {} };
    gl.bindVertexArray(surface.array);
    for (const [place, values] of [mesh.positions, mesh.normals].entries()) {
      surface.buffers.push(gl.createBuffer());
      gl.bindBuffer(gl.ARRAY_BUFFER, surface.buffers.at(-1));
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, 3, gl.FLOAT, false, 0, 0);
    }
    surface.buffers.push(gl.createBuffer());
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, surface.buffers.at(-1));
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, mesh.corners, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    for (const [kind, levels] of Object.entries(grid.errors)) {
      surface.errors[kind] = this.texture(gl.R8, gl.RED, grid.width, grid.height, levels, gl.NEAREST);
    }
    if (grid.flags.some((flags) => flags & FILLED)) {
      surface.errors.filled = this.texture(gl.R8, gl.RED, grid.width, grid.height, grid.flags.map((flags) => (flags & FILLED ? 255 : 0)), gl.NEAREST);
    }
    this.surfaces[name] = surface;
  }

  dropSurface(name) {
    const surface = this.surfaces[name];
    if (!surface) return;
    surface.buffers.forEach((buffer) => this.gl.deleteBuffer(buffer));
    Object.values(surface.errors).forEach((texture) => this.gl.deleteTexture(texture));
    this.gl.deleteVertexArray(surface.array);
    delete this.surfaces[name];
  }

  /** Fit the canvas to its element. */
  fit() {
    const canvas = this.canvas;
    const sharp = Math.min(devicePixelRatio || 1, 2);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((side) => clamp(Math.round(side * sharp), 1, this.largest));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  }

  /**
   * Draw parts: { surface, colour, view, from, to }: the view's left, top, width and height as fractions of the canvas,
   * and which part of its width is drawn, as fractions of it.
   */
  draw(parts, pose, light, aspect) {
    const gl = this.gl;
    if (gl.isContextLost()) return;
    this.fit();
    const { width, height } = this.canvas;
    gl.disable(gl.SCISSOR_TEST);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.SCISSOR_TEST);
    gl.useProgram(this.program);
    gl.uniformMatrix3fv(this.at.turn, true, pose.turn);
    gl.uniform3fv(this.at.pivot, pose.pivot);
    gl.uniform3fv(this.at.offset, pose.offset);
    gl.uniform2f(this.at.range, 0.01 * pose.offset[2], pose.offset[2] + 100 * pose.pivot[2]);
    gl.uniform3fv(this.at.light, light);
    gl.uniform3fv(this.at.tones, this.tones);
    for (const { surface: name, colour, view: [x, y, across, down], from, to } of parts) {
      const [start, wide, top, high] = [x * width, across * width, Math.round(y * height), Math.round(down * height)];
      const [left, right] = [Math.round(start + from * wide), Math.round(start + to * wide)];
      if (right <= left || !this.surfaces[name]) continue;
      const shape = wide / high / aspect; // the photo's shape is kept
      gl.viewport(Math.round(start), height - top - high, Math.round(wide), high);
      gl.uniform2fv(this.at.fit, shape > 1 ? [1 / shape, 1] : [1, shape]);
      this.drawPart(this.surfaces[name], colour, [left, height - top - high, right - left, high]);
    }
  }

  drawPart(surface, colour, box) {
    const gl = this.gl;
    const { grid } = surface;
    gl.scissor(...box);
    gl.uniform4fv(this.at.lens, grid.lens);
    gl.uniform2f(this.at.size, grid.width, grid.height);
    const has = colour === "photo" ? this.photo : KINDS[colour] > 1 ? surface.errors[colour] : true;
    gl.uniform1i(this.at.kind, has ? KINDS[colour] : 0);
    [["photo", this.photo], ["errors", surface.errors[colour]], ["colours", this.palette]].forEach(([name, texture], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture ?? this.blank);
      gl.uniform1i(this.at[name], unit);
    });
    gl.bindVertexArray(surface.array);
    gl.drawElements(gl.TRIANGLES, surface.count, gl.UNSIGNED_INT, 0);
    gl.bindVertexArray(null);
  }
}
