// Copyright 2026 The gr2t_ros developers
// SPDX-License-Identifier: Apache-2.0
// The mesh of the page of `gr2t view`: unpacked, drawn with WebGL 2, and asked what is at a pixel.
// tools/view.py packs what is unpacked here, and says what the header's fields are.
'use strict';

const VERTEX = `#version 300 es
uniform mat4 view_projection;
in vec3 position;            // metres, about the middle of the mesh
in vec3 normal;
in vec3 levels;              // of likelihood, sigma, confidence; 0 doubtful, 1 sure
uniform vec3 mode;           // which of them counts
out vec3 world, outward;
out float level;
void main() {
  gl_Position = view_projection * vec4(position, 1.0);
  world = position;
  outward = normal;
  level = dot(levels, mode);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D colours;
uniform float threshold;     // what is less sure is not drawn
uniform bool coloured;
uniform vec3 eye, right, up;
in vec3 world, outward;
in float level;
out vec4 colour;
void main() {
  if (level < threshold) discard;
  vec3 base = coloured ? texture(colours, vec2((level * 255.0 + 0.5) / 256.0, 0.5)).rgb
                       : vec3(0.74, 0.75, 0.77);
  vec3 towards = normalize(eye - world);
  vec3 n = normalize(outward);
  if (dot(n, towards) < 0.0) n = -n;
  vec3 key = normalize(0.55 * towards - 0.45 * right + 0.75 * up);
  vec3 fill = normalize(0.6 * towards + 0.75 * right + 0.1 * up);
  float light = 0.5 + 0.5 * max(dot(n, key), 0.0) + 0.2 * max(dot(n, fill), 0.0);
  colour = vec4(min(base * light, 1.0), 1.0);
}`;
const LINE_VERTEX = `#version 300 es
uniform mat4 view_projection;
in vec3 position;
void main() { gl_Position = view_projection * vec4(position, 1.0); }`;
const LINE_FRAGMENT = `#version 300 es
precision mediump float;
out vec4 colour;
void main() { colour = vec4(0.17, 0.2, 0.25, 1.0); }`;

const element = id => document.getElementById(id);
const add = (a, b, s = 1) => a.map((x, i) => x + s * b[i]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const scaled = (a, s) => a.map(x => s * x);
const unit = a => scaled(a, 1 / Math.hypot(...a));
const rotated = (v, axis, angle) => add(
  add(scaled(v, Math.cos(angle)), cross(axis, v), Math.sin(angle)),
  axis, dot(axis, v) * (1 - Math.cos(angle)));

// ---- unpacking

async function unpacked(header) {
  const text = atob(element('data').textContent);
  const packed = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) packed[i] = text.charCodeAt(i);
  element('data').remove();
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream('deflate'));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  let begin = 0;
  // whole numbers: differences, their sign in the lowest bit, byte by byte
  function numbers(count) {
    const found = new Int32Array(count);
    const [b, c, d, end] = [1, 2, 3, 4].map(n => begin + n * count);
    for (let i = 0, last = 0; i < count; i++) {
      const coded = bytes[begin + i] | bytes[b + i] << 8 | bytes[c + i] << 16 | bytes[d + i] << 24;
      last = found[i] = last + ((coded >>> 1) ^ -(coded & 1)) | 0;
    }
    begin = end;
    return found;
  }
  const n = header.vertices;
  const mesh = {
    positions: new Float32Array(3 * n), levels: new Uint8Array(4 * n),
    faces: null, normals: new Int8Array(4 * n)};
  for (let axis = 0; axis < 3; axis++) {
    const steps = numbers(n);
    for (let i = 0; i < n; i++) mesh.positions[3 * i + axis] = header.step * steps[i];
  }
  header.scalars.forEach((_, k) => {
    const levels = numbers(n);
    for (let i = 0; i < n; i++) mesh.levels[4 * i + k] = levels[i];
  });
  mesh.faces = new Uint32Array(numbers(3 * header.faces).buffer);
  addNormals(mesh, n);
  return mesh;
}

function addNormals({positions: p, faces, normals}, n) {
  const sums = new Float32Array(3 * n);
  for (let f = 0; f < faces.length; f += 3) {
    const a = 3 * faces[f], b = 3 * faces[f + 1], c = 3 * faces[f + 2];
    const ux = p[b] - p[a], uy = p[b + 1] - p[a + 1], uz = p[b + 2] - p[a + 2];
    const vx = p[c] - p[a], vy = p[c + 1] - p[a + 1], vz = p[c + 2] - p[a + 2];
    const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
    for (const i of [a, b, c]) { sums[i] += x; sums[i + 1] += y; sums[i + 2] += z; }
  }
  for (let i = 0; i < n; i++) {
    const x = sums[3 * i], y = sums[3 * i + 1], z = sums[3 * i + 2];
    const to = 127 / (Math.sqrt(x * x + y * y + z * z) || 1);
    normals[4 * i] = x * to;
    normals[4 * i + 1] = y * to;
    normals[4 * i + 2] = z * to;
  }
}

// ---- drawing

class Drawing {
  constructor(gl, mesh, header) {
    this.gl = gl;
    this.header = header;
    this.program = program(gl, VERTEX, FRAGMENT);
    this.lines = program(gl, LINE_VERTEX, LINE_FRAGMENT);
    this.count = mesh.faces.length;
    this.array = array(gl, this.program, [
      ['position', mesh.positions, 3, gl.FLOAT], ['normal', mesh.normals, 4, gl.BYTE],
      ['levels', mesh.levels, 4, gl.UNSIGNED_BYTE]]);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, mesh.faces, gl.STATIC_DRAW);
    const corners = frusta(header.cameras);
    this.corners = corners.length / 3;
    this.frusta = array(gl, this.lines, [['position', corners, 3, gl.FLOAT]]);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, 256, 1, 0, gl.RGB, gl.UNSIGNED_BYTE,
      new Uint8Array(header.colours.flat()));
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    gl.enable(gl.DEPTH_TEST);
    gl.cullFace(gl.BACK);
  }

  draw(camera, state) {
    const {gl} = this, {right, down, eye} = camera;
    const set = (name, kind, ...values) =>
      gl[`uniform${kind}`](gl.getUniformLocation(this.program, name), ...values);
    gl.viewport(0, 0, gl.canvas.width, gl.canvas.height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    (state.backs ? gl.enable : gl.disable).call(gl, gl.CULL_FACE);
    const matrix = camera.matrix(gl.canvas, this.header.size);
    gl.useProgram(this.program);
    gl.bindVertexArray(this.array);
    set('view_projection', 'Matrix4fv', false, matrix);
    set('mode', '3f', ...[0, 1, 2].map(k => Number(k === state.sorted)));
    set('threshold', '1f', state.sorted < 0 ? 0 : (state.threshold - 0.5) / 255);
    set('coloured', '1i', state.coloured);
    set('eye', '3f', ...eye);
    set('right', '3f', ...right);
    set('up', '3f', ...scaled(down, -1));
    gl.drawElements(gl.TRIANGLES, this.count, gl.UNSIGNED_INT, 0);
    if (!state.frusta) return;
    gl.useProgram(this.lines);
    gl.bindVertexArray(this.frusta);
    gl.uniformMatrix4fv(gl.getUniformLocation(this.lines, 'view_projection'), false, matrix);
    gl.drawArrays(gl.LINES, 0, this.corners);
  }
}

function program(gl, ...sources) {
  const made = gl.createProgram();
  sources.forEach((source, k) => {
    const shader = gl.createShader([gl.VERTEX_SHADER, gl.FRAGMENT_SHADER][k]);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  });
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS) && !gl.isContextLost()) {
    throw new Error(gl.getProgramInfoLog(made));
  }
  return made;
}

function array(gl, made, attributes) {
  const found = gl.createVertexArray();
  gl.bindVertexArray(found);
  for (const [name, data, size, type] of attributes) {
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    const place = gl.getAttribLocation(made, name);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, size, type, type !== gl.FLOAT, 0, 0);
  }
  return found;
}

// the poses are 3 rows of 4 numbers: T_world_camera, x right, y down, z forward
function frusta(poses) {
  const points = [];
  const far = poses.reduce((sum, T) => sum + Math.hypot(T[3], T[7], T[11]), 0) / poses.length;
  const length = 0.06 * far;
  poses.forEach((T, k) => {
    const at = (x, y, z) => [0, 1, 2].map(
      r => length * (T[4 * r] * x + T[4 * r + 1] * y + T[4 * r + 2] * z) + T[4 * r + 3]);
    const eye = at(0, 0, 0);
    const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(
      ([x, y]) => at(0.5 * x, 0.38 * y, 0.9));
    corners.forEach((corner, i) => points.push(eye, corner, corner, corners[(i + 1) % 4]));
    points.push(corners[0], at(0, -0.55, 0.9), at(0, -0.55, 0.9), corners[1]);  // what is up
    const last = poses[k - 1];
    if (last) points.push([last[3], last[7], last[11]], eye);
  });
  return new Float32Array(points.flat());
}

// Moeller and Trumbore 1997, for each triangle: once a click
function hit(mesh, eye, ray, state) {
  const {positions: p, faces, levels} = mesh;
  let nearest = Infinity, level = null;
  for (let f = 0; f < faces.length; f += 3) {
    const i = faces[f], j = faces[f + 1], k = faces[f + 2], a = 3 * i, b = 3 * j, c = 3 * k;
    const e1x = p[b] - p[a], e1y = p[b + 1] - p[a + 1], e1z = p[b + 2] - p[a + 2];
    const e2x = p[c] - p[a], e2y = p[c + 1] - p[a + 1], e2z = p[c + 2] - p[a + 2];
    const px = ray[1] * e2z - ray[2] * e2y, py = ray[2] * e2x - ray[0] * e2z;
    const pz = ray[0] * e2y - ray[1] * e2x, det = e1x * px + e1y * py + e1z * pz;
    if (det === 0 || (state.backs && det < 0)) continue;
    const tx = eye[0] - p[a], ty = eye[1] - p[a + 1], tz = eye[2] - p[a + 2];
    const u = (tx * px + ty * py + tz * pz) / det;
    if (u < 0 || u > 1) continue;
    const qx = ty * e1z - tz * e1y, qy = tz * e1x - tx * e1z, qz = tx * e1y - ty * e1x;
    const v = (ray[0] * qx + ray[1] * qy + ray[2] * qz) / det;
    const t = (e2x * qx + e2y * qy + e2z * qz) / det;
    if (v < 0 || u + v > 1 || t <= 0 || t >= nearest) continue;
    const here = [0, 1, 2].map(m =>
      (1 - u - v) * levels[4 * i + m] + u * levels[4 * j + m] + v * levels[4 * k + m]);
    if (state.sorted >= 0 && here[state.sorted] < state.threshold - 0.5) continue;
    nearest = t;
    level = here;
  }
  return level && {point: add(eye, ray, nearest), levels: level};
}
