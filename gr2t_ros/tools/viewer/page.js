// Copyright 2026 The gr2t_ros developers
// SPDX-License-Identifier: Apache-2.0
// The page of `gr2t view`: the camera that one turns, and the panel beside.
'use strict';

const FIELD = 1.3;  // focal length, in widths of a picture 1.6 times as wide as high

// ---- the camera: it turns about a pivot

class Camera {
  constructor(header) {
    Object.assign(this, header.view);  // pivot, eye, forward, upward
  }

  get right() {
    const {forward, upward} = this, right = cross(forward, upward);
    // straight up or down any side is right
    const [x, y, z] = upward;
    return unit(Math.hypot(...right) > 1e-6 ? right : cross(forward, [y, z, x]));
  }

  get down() { return cross(this.forward, this.right); }
  get distance() { return dot(add(this.pivot, this.eye, -1), this.forward); }

  turn(across, along) {
    const {right, upward, pivot} = this;
    const steep = Math.asin(Math.max(-1, Math.min(1, dot(this.forward, upward))));
    const angle = Math.max(-1.55, Math.min(1.55, steep + along)) - steep;
    const both = v => rotated(rotated(v, right, angle), upward, across);
    this.forward = unit(both(this.forward));
    this.eye = add(pivot, both(add(this.eye, pivot, -1)));
  }

  move(across, along) {  // metres at the pivot
    const step = add(scaled(this.right, across), this.down, along);
    this.eye = add(this.eye, step);
    this.pivot = add(this.pivot, step);
  }

  zoom(factor) {
    this.eye = add(this.eye, this.forward, this.distance * (1 - factor));
  }

  focal(canvas) {  // pixels
    return FIELD * Math.min(canvas.width, 1.6 * canvas.height);
  }

  matrix(canvas, size) {
    const {eye, right, down, forward} = this;
    const far = Math.hypot(...eye) + size;
    const near = Math.max(0.02 * this.distance, 1e-4 * far);
    const fx = 2 * this.focal(canvas) / canvas.width, fy = 2 * this.focal(canvas) / canvas.height;
    const a = (far + near) / (far - near), b = -2 * far * near / (far - near);
    const rows = [
      [...scaled(right, fx), -fx * dot(right, eye)], [...scaled(down, -fy), fy * dot(down, eye)],
      [...scaled(forward, a), b - a * dot(forward, eye)], [...forward, -dot(forward, eye)]];
    return new Float32Array([0, 1, 2, 3].flatMap(c => rows.map(row => row[c])));
  }

  ray(canvas, u, v) {
    const f = this.focal(canvas);
    return add(add(this.forward, this.right, (u - canvas.width / 2) / f),
      this.down, (v - canvas.height / 2) / f);
  }
}

// ---- the page

const HELP = 'Drag to turn, right button or shift to move, wheel to zoom; double click: turn '
  + 'about this point, and what is known of it.';

async function main() {
  const header = JSON.parse(element('header').textContent);
  const canvas = element('canvas');
  const gl = canvas.getContext('webgl2', {antialias: true, preserveDrawingBuffer: false});
  if (!gl) throw new Error('this browser has no WebGL 2');
  if (!window.DecompressionStream) throw new Error('this browser is too old: it cannot unpack');
  const mesh = await unpacked(header);
  const drawing = new Drawing(gl, mesh, header);
  const camera = new Camera(header);
  const state = {sorted: -1, coloured: false, threshold: 0, backs: false, frusta: false};
  let asked = false;

  function show() {
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => {
      asked = false;
      const ratio = window.devicePixelRatio || 1;
      canvas.width = Math.round(canvas.clientWidth * ratio);
      canvas.height = Math.round(canvas.clientHeight * ratio);
      drawing.draw(camera, state);
      showScale(camera, canvas);
    });
  }

  showPanel(header, state, show);
  steer(canvas, camera, show);
  canvas.addEventListener('dblclick', event => {
    const ratio = canvas.width / canvas.clientWidth;
    const ray = camera.ray(canvas, ratio * event.offsetX, ratio * event.offsetY);
    const found = hit(mesh, camera.eye, ray, state);
    if (!found) return;
    element('foot').textContent = described(header, found);
    const {eye, pivot} = camera;
    camera.move(dot(add(found.point, pivot, -1), camera.right),
      dot(add(found.point, pivot, -1), camera.down));
    camera.pivot = found.point;
    if (camera.distance <= 0) Object.assign(camera, {eye, pivot});
    show();
  });
  window.addEventListener('resize', show);
  canvas.addEventListener('webglcontextrestored', () => location.reload());
  element('foot').textContent = HELP;
  element('panel').hidden = false;
  element('message').hidden = true;
  show();
}

function showPanel(header, state, show) {
  const {scalars} = header;
  const modes = [...scalars.map(scalar => scalar.name), 'shaded'];
  const rgb = header.colours.filter((_, i) => i % 15 === 0).map(c => `rgb(${c})`);
  element('bar').style.background = `linear-gradient(90deg, ${rgb})`;
  element('cameras').hidden = !header.cameras.length;

  // shaded hides by the last, the confidence
  function choose(mode) {
    state.coloured = mode < scalars.length;
    state.sorted = state.coloured ? mode : scalars.length - 1;
    element('legend').hidden = !state.coloured;
    if (state.coloured) {
      const {name, unit: of} = scalars[mode];
      element('unit').textContent = of ? `${name}, ${of}` : name;
      [0, 0.5, 1].forEach((share, k) => {
        element('ticks').children[k].textContent = number(value(scalars[mode], 255 * share));
      });
    }
    hide(0);
  }

  function hide(threshold) {
    state.threshold = threshold;
    element('threshold').value = threshold;
    element('hiding').hidden = state.sorted < 0;
    if (state.sorted >= 0) {
      const scalar = scalars[state.sorted];
      const side = scalar.best > scalar.worst ? 'below' : 'above';
      element('said').textContent = threshold === 0 ? `nothing hidden (${scalar.name})` :
        `hidden: ${scalar.name} ${side} ${number(value(scalar, threshold))} ${scalar.unit}`;
    }
    show();
  }

  modes.forEach((name, mode) => {
    const label = document.createElement('label'), button = document.createElement('input');
    Object.assign(button, {type: 'radio', name: 'mode', value: name, checked: mode === 0});
    button.addEventListener('change', () => choose(mode));
    label.append(button, ` ${name}`);
    element('modes').append(label);
  });
  element('modes').hidden = modes.length === 1;
  element('threshold').addEventListener('input', event => hide(Number(event.target.value)));
  for (const name of ['backs', 'frusta']) {
    element(name).addEventListener('change', event => {
      state[name] = event.target.checked;
      show();
    });
  }
  choose(0);
}

const value = (scalar, level) => scalar.worst + level / 255 * (scalar.best - scalar.worst);
const number = x => String(Number(x.toPrecision(3)));

function described(header, {point, levels}) {
  const place = add(point, header.middle).map(x => x.toFixed(3)).join(', ');
  const rest = header.scalars.map(
    (scalar, k) => `${scalar.name} ${number(value(scalar, levels[k]))} ${scalar.unit}`.trim());
  return [`(${place}) m`, ...rest].join(', ');
}

function showScale(camera, canvas) {
  const perMetre = camera.focal(canvas) / camera.distance * canvas.clientWidth / canvas.width;
  const most = 200 / perMetre;
  const digit = 10 ** Math.floor(Math.log10(most));
  const length = [5, 2, 1].map(n => n * digit).find(n => n <= most);
  const [factor, of] = length >= 1 ? [1, 'm'] : length >= 0.01 ? [100, 'cm'] : [1000, 'mm'];
  element('scale').style.width = `${length * perMetre}px`;
  element('scale').textContent = `${number(factor * length)} ${of}`;
}

function steer(canvas, camera, show) {
  const pointers = new Map();
  const perPixel = () => camera.distance / camera.focal(canvas) * canvas.width / canvas.clientWidth;
  const spread = () => {
    const [a, b] = [...pointers.values()];
    return b ? Math.hypot(a.x - b.x, a.y - b.y) : 0;
  };
  canvas.addEventListener('contextmenu', event => event.preventDefault());
  canvas.addEventListener('pointerdown', event => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, {x: event.clientX, y: event.clientY});
  });
  canvas.addEventListener('pointermove', event => {
    const last = pointers.get(event.pointerId);
    if (!last) return;
    const before = spread();
    const x = event.clientX - last.x, y = event.clientY - last.y;
    pointers.set(event.pointerId, {x: event.clientX, y: event.clientY});
    if (pointers.size > 1) {
      camera.move(-x * perPixel() / pointers.size, -y * perPixel() / pointers.size);
      if (before && spread()) camera.zoom(before / spread());
    } else if (event.buttons & 6 || event.shiftKey || event.ctrlKey) {
      camera.move(-x * perPixel(), -y * perPixel());
    } else {
      camera.turn(-0.006 * x, -0.006 * y);
    }
    show();
  });
  for (const name of ['pointerup', 'pointercancel']) {
    canvas.addEventListener(name, event => pointers.delete(event.pointerId));
  }
  canvas.addEventListener('wheel', event => {
    event.preventDefault();
    const pixels = event.deltaY * [1, 20, 400][event.deltaMode];
    camera.zoom(Math.exp(0.0015 * Math.max(-300, Math.min(300, pixels))));
    show();
  }, {passive: false});
}

main().catch(error => {
  element('message').hidden = false;
  element('message').textContent = `Cannot show the mesh: ${error.message}.`;
  throw error;
});
