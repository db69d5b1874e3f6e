"use strict";

const COLOURS = { left: "#0072b2", right: "#d55e00", middle: "#333333" };
const OBSERVED = 0, SUPPORTED = 1, FILLED = 2;

// Base64 of little-endian numbers.
function unpack(text, Kind) {
  const bytes = Uint8Array.from(atob(text), c => c.charCodeAt(0));
  return new Kind(bytes.buffer);
}

// Position of the frame that is shown at a frame number: the last at or before it, -1 in a gap of the recording.
function indexAt(frames, number, stride) {
  let low = 0, high = frames.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (frames[middle] <= number) low = middle + 1; else high = middle;
  }
  const index = low - 1;
  return index >= 0 && number - frames[index] < stride ? index : -1;
}

// Where a point (z up) is seen from: [right, up, depth, pixels per mm], or null behind the eye.
function look(view, point) {
  const x = point[0] - view.target[0], y = point[1] - view.target[1], z = point[2] - view.target[2];
  const cy = Math.cos(view.yaw), sy = Math.sin(view.yaw), cp = Math.cos(view.pitch), sp = Math.sin(view.pitch);
  const right = cy * x + sy * y, away = -sy * x + cy * y;
  const depth = view.distance + cp * away - sp * z, up = sp * away + cp * z;
  if (depth < view.distance * 0.02) return null;
  const scale = view.focal / depth;
  return [view.width / 2 + scale * right, view.height / 2 - scale * up, depth, scale];
}

function quantile(values, share) {
  const sorted = Float64Array.from(values).sort();
  return sorted.length ? sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))] : 0;
}

// Joints and bones of a frame: what is missing is not among them; a bone is filled if one of its ends is.
function drawn(data, index) {
  if (index < 0) return { joints: [], bones: [] };
  const count = data.joints.length, joints = [];
  for (let j = 0; j < count; j++) {
    const at = index * count + j, state = data.state[at];
    if (state <= FILLED) joints.push({ j, filled: state === FILLED, point: data.points.subarray(3 * at, 3 * at + 3) });
  }
  const of = new Map(joints.map(joint => [joint.j, joint]));
  const bones = data.bones.filter(([a, b]) => of.has(a) && of.has(b)).map(([a, b]) => {
    const side = data.sides[a] === data.sides[b] ? data.sides[a] : data.sides[a] === "middle" ? data.sides[b] : data.sides[a];
    return { from: of.get(a), to: of.get(b), filled: of.get(a).filled || of.get(b).filled, side };
  });
  return { joints, bones };
}

// The highest drawn joint of each of several people, where their names are written.
function heads(data, joints) {
  if (data.people.length < 2) return [];
  return data.people.map((places, person) => {
    const own = joints.filter(joint => places.includes(joint.j));
    return { person, point: own.reduce((top, joint) => !top || joint.point[2] > top[2] ? joint.point : top, null) };
  }).filter(head => head.point);
}

function load(text) {
  const data = JSON.parse(text);
  data.frame = unpack(data.frame, Float64Array);
  data.points = unpack(data.points, Float32Array);
  data.state = unpack(data.state, Uint8Array);
  data.error = unpack(data.error, Float32Array);
  return data;
}

// A view of everything: outliers beyond 99 % of the joints do not count.
function overview(data, width, height) {
  const columns = [[], [], []];
  for (let at = 0; at < data.state.length; at++)
    if (data.state[at] <= FILLED) for (let axis = 0; axis < 3; axis++) columns[axis].push(data.points[3 * at + axis]);
  const low = columns.map(c => quantile(c, 0.01)), high = columns.map(c => quantile(c, 0.99));
  const target = low.map((value, axis) => (value + high[axis]) / 2);
  const reach = Math.max(...low.map((value, axis) => (high[axis] - value) / 2), 500);
  const view = { target, yaw: 0.6, pitch: 0.25, distance: 5 * reach, focal: 1, width, height };
  return { view, floor: low[2], reach };
}

function start(document, window) {
  const element = id => document.getElementById(id);
  const data = load(element("data").textContent);
  const scene = element("scene"), plot = element("plot"), scrub = element("scrub");
  const first = data.frame[0], last = data.frame[data.frame.length - 1];
  const { view, floor, reach } = overview(data, 1, 1);
  const rate = data.rate_hz || 30;
  let number = first, playing = false, before = 0;

  document.title = data.title;
  element("title").textContent = data.title;
  element("about").textContent = data.about;
  element("key").textContent = "Blue: left. Orange: right. Hollow and dashed: filled in, not observed. "
    + "Missing joints are not drawn. Drag: turn; shift and drag: move; wheel: zoom; space: play.";
  element("rig").hidden = !data.cameras.length;
  scrub.min = first; scrub.max = last; scrub.step = 1; scrub.value = first;

  function line(context, from, to, colour, width, dash) {
    const a = look(view, from), b = look(view, to);
    if (!a || !b) return;
    context.strokeStyle = colour; context.lineWidth = width; context.setLineDash(dash || []);
    context.beginPath(); context.moveTo(a[0], a[1]); context.lineTo(b[0], b[1]); context.stroke();
    context.setLineDash([]);
  }

  function write(context, point, text, colour) {
    const at = look(view, point);
    if (!at) return;
    context.fillStyle = colour; context.font = "11px system-ui, sans-serif"; context.fillText(text, at[0] + 6, at[1] - 6);
  }

  function paintScene() {
    const context = fitted(scene);
    view.width = scene.clientWidth; view.height = scene.clientHeight;
    view.focal = 1.6 * Math.min(view.width, view.height);
    const cell = 500, half = Math.min(20, Math.ceil(1.5 * reach / cell)) * cell;
    const middle = [0, 1].map(axis => Math.round(view.target[axis] / cell) * cell);
    for (let at = -half; at <= half; at += cell) {
      line(context, [middle[0] + at, middle[1] - half, floor], [middle[0] + at, middle[1] + half, floor], "#e3e3e3", 1);
      line(context, [middle[0] - half, middle[1] + at, floor], [middle[0] + half, middle[1] + at, floor], "#e3e3e3", 1);
    }
    const corner = [middle[0] - half, middle[1] - half, floor];
    data.axes.forEach((axis, i) => {
      const tip = axis.map((value, k) => corner[k] + 400 * value);
      line(context, corner, tip, "#777777", 2); write(context, tip, "xyz"[i], "#555555");
    });
    if (element("cameras").checked) for (const camera of data.cameras) {
      camera.corners.forEach((point, i) => {
        line(context, camera.centre, point, "#999999", 1);
        line(context, point, camera.corners[(i + 1) % 4], "#999999", 1);
      });
      write(context, camera.centre, camera.name, "#666666");
    }
    const { joints, bones } = drawn(data, indexAt(data.frame, number, data.stride));
    for (const bone of bones) line(context, bone.from.point, bone.to.point, COLOURS[bone.side], 3, bone.filled ? [5, 4] : []);
    for (const joint of joints) {
      const at = look(view, joint.point);
      if (!at) continue;
      context.beginPath(); context.arc(at[0], at[1], 4, 0, 2 * Math.PI);
      context.fillStyle = joint.filled ? "#ffffff" : COLOURS[data.sides[joint.j]]; context.fill();
      context.strokeStyle = COLOURS[data.sides[joint.j]]; context.lineWidth = 1.5; context.stroke();
      if (element("names").checked) write(context, joint.point, data.joints[joint.j], "#333333");
    }
    for (const { person, point } of heads(data, joints)) write(context, point, `person ${person}`, "#333333");
  }

  function paintPlot() {
    const context = fitted(plot), width = plot.clientWidth, height = plot.clientHeight;
    const shown = data.error.filter(Number.isFinite), top = Math.max(1, 1.15 * quantile(shown, 0.99));
    const left = 56, right = width - 12, bottom = height - 8, count = data.joints.length;
    const x = value => left + (right - left) * (value - first) / Math.max(1, last - first);
    const y = value => bottom - (bottom - 18) * Math.min(1, value / top);
    context.fillStyle = "#555555"; context.font = "11px system-ui, sans-serif";
    context.fillText("reprojection error, px (mean over the joints); grey: share of joints missing", left, 12);
    context.fillText(top.toFixed(1), 12, 24); context.fillText("0", 12, bottom);
    const step = Math.max(1, 0.5 + (right - left) * data.stride / Math.max(1, last - first));
    context.fillStyle = "#dddddd";
    for (let i = 0; i < data.frame.length; i++) {
      let missing = 0;
      for (let j = 0; j < count; j++) missing += data.state[i * count + j] > FILLED;
      if (missing) context.fillRect(x(data.frame[i]), bottom - (bottom - 18) * missing / count, step, (bottom - 18) * missing / count);
    }
    context.strokeStyle = "#222222"; context.lineWidth = 1; context.beginPath();
    let pen = false;
    for (let i = 0; i < data.frame.length; i++) {
      const gap = i > 0 && data.frame[i] - data.frame[i - 1] > data.stride;
      if (!Number.isFinite(data.error[i])) { pen = false; continue; }
      if (pen && !gap) context.lineTo(x(data.frame[i]), y(data.error[i])); else context.moveTo(x(data.frame[i]), y(data.error[i]));
      pen = true;
    }
    context.stroke();
    context.strokeStyle = "#cc79a7"; context.lineWidth = 2;
    context.beginPath(); context.moveTo(x(number), 16); context.lineTo(x(number), bottom); context.stroke();
    plot.toNumber = pixel => first + Math.round((last - first) * (pixel - left) / (right - left));
  }

  function fitted(canvas) {
    const ratio = window.devicePixelRatio || 1;
    canvas.width = Math.round(canvas.clientWidth * ratio); canvas.height = Math.round(canvas.clientHeight * ratio);
    const context = canvas.getContext("2d");
    context.scale(ratio, ratio);
    return context;
  }

  function paint() {
    const index = indexAt(data.frame, number, data.stride);
    const error = index >= 0 && Number.isFinite(data.error[index]) ? `${data.error[index].toFixed(1)} px` : "no joint observed";
    const time = data.rate_hz ? `${((number - first) / rate).toFixed(2)} s` : "rate unknown";
    element("where").textContent = `frame ${Math.floor(number)} · ${time} · ${index < 0 ? "no frame" : error}`;
    paintScene(); paintPlot();
  }

  function seek(value) { number = Math.min(last, Math.max(first, value)); scrub.value = Math.floor(number); paint(); }

  function toggle() {
    playing = !playing;
    element("play").textContent = playing ? "Pause" : "Play";
    if (playing) { if (number >= last) number = first; before = window.performance.now(); window.requestAnimationFrame(tick); }
  }

  function tick(now) {
    if (!playing) return;
    const next = number + Math.max(0, now - before) / 1000 * rate * Number(element("speed").value);
    before = now;
    if (next >= last) toggle();
    seek(next);
    if (playing) window.requestAnimationFrame(tick);
  }

  let held = null;
  scene.addEventListener("pointerdown", event => { held = [event.clientX, event.clientY]; scene.setPointerCapture(event.pointerId); });
  scene.addEventListener("pointerup", () => { held = null; });
  scene.addEventListener("pointermove", event => {
    if (!held) return;
    const dx = event.clientX - held[0], dy = event.clientY - held[1];
    held = [event.clientX, event.clientY];
    if (event.shiftKey) {
      const scale = view.distance / view.focal;
      view.target[0] -= Math.cos(view.yaw) * dx * scale; view.target[1] -= Math.sin(view.yaw) * dx * scale;
      view.target[2] += dy * scale;
    } else {
      view.yaw -= dx / 150; view.pitch = Math.min(1.5, Math.max(-1.5, view.pitch + dy / 150));
    }
    paint();
  });
  scene.addEventListener("wheel", event => { event.preventDefault(); view.distance *= Math.exp(event.deltaY / 800); paint(); }, { passive: false });
  plot.addEventListener("pointerdown", event => seek(plot.toNumber(event.clientX - plot.getBoundingClientRect().left)));
  scrub.addEventListener("input", () => seek(Number(scrub.value)));
  element("play").addEventListener("click", toggle);
  for (const id of ["cameras", "names"]) element(id).addEventListener("change", paint);
  window.addEventListener("resize", paint);
  document.addEventListener("keydown", event => {
    if (["INPUT", "SELECT", "BUTTON"].includes(event.target.tagName)) return;
    if (event.key === " ") { event.preventDefault(); toggle(); }
    if (event.key === "ArrowRight") seek(Math.floor(number) + data.stride);
    if (event.key === "ArrowLeft") seek(Math.floor(number) - data.stride);
  });
  const asked = /^#frame=(-?\d+)$/.exec(window.location.hash);
  if (asked) seek(Number(asked[1])); else paint();
}

if (typeof module === "undefined") start(document, window);
else module.exports = { drawn, heads, indexAt, load, look, overview, quantile };
