"use strict";

const FILLED = 2, LAST_HUMAN = 17, MISSING = 65535;

// What Python packed: base64 of a deflated block of 16-bit numbers, low bytes before high ones, each number's
// difference from the frame before. The numbers count steps from an offset.
async function unpack(packed) {
  const letters = atob(packed.data), bytes = new Uint8Array(letters.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = letters.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const halves = new Uint8Array(await new Response(stream).arrayBuffer());
  const count = halves.length / 2, numbers = new Uint16Array(count), row = packed.row;
  for (let i = 0; i < count; i++)
    numbers[i] = (halves[i] | halves[count + i] << 8) + (i < row ? 0 : numbers[i - row]);
  if (packed.step === undefined) return numbers;
  const values = new Float32Array(count);
  for (let i = 0; i < count; i++) values[i] = numbers[i] === MISSING ? NaN : packed.offset + packed.step * numbers[i];
  return values;
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

// Where a point (z up) is seen from: [right, down, depth, pixels per mm], or null behind the eye.
function look(view, point) {
  const x = point[0] - view.target[0], y = point[1] - view.target[1], z = point[2] - view.target[2];
  const cy = Math.cos(view.yaw), sy = Math.sin(view.yaw), cp = Math.cos(view.pitch), sp = Math.sin(view.pitch);
  const right = cy * x + sy * y, away = -sy * x + cy * y;
  const depth = view.distance + cp * away - sp * z, up = sp * away + cp * z;
  if (depth < view.distance * 0.02) return null;
  const scale = view.focal / depth;
  return [view.width / 2 + scale * right, view.height / 2 - scale * up, depth, scale];
}

// The pixel of a point in a camera's image, through its lens (OpenCV's models, see ghpt.geometry.lens); null behind it.
function project(camera, point) {
  const R = camera.R, t = camera.t;
  const z = R[6] * point[0] + R[7] * point[1] + R[8] * point[2] + t[2];
  if (z <= 0) return null;
  const x = (R[0] * point[0] + R[1] * point[1] + R[2] * point[2] + t[0]) / z;
  const y = (R[3] * point[0] + R[4] * point[1] + R[5] * point[2] + t[1]) / z;
  return toPixel(camera, distorted(camera.lens, x, y));
}

function toPixel(camera, [x, y]) {
  const K = camera.K;
  return [K[0] * x + K[1] * y + K[2], K[4] * y + K[5]];
}

function distorted([k1, k2, p1, p2, k3, k4, k5, k6, fisheye], x, y) {
  const s = x * x + y * y;
  if (fisheye) {
    const radius = Math.sqrt(s), angle = Math.atan(radius), a = angle * angle;
    const factor = radius > 1e-9 ? angle * (1 + a * (k1 + a * (k2 + a * (p1 + a * p2)))) / radius : 1;
    return [factor * x, factor * y];
  }
  const factor = (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)));
  return [factor * x + 2 * p1 * x * y + p2 * (s + 2 * x * x), factor * y + 2 * p2 * x * y + p1 * (s + 2 * y * y)];
}

// Where the lens shows an ideal pixel, which is what key points are stored as.
function through(camera, u, v) {
  const K = camera.K, y = (v - K[5]) / K[4], x = (u - K[2] - K[1] * y) / K[0];
  return toPixel(camera, distorted(camera.lens, x, y));
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

// Mean distance (pixels) of a view's key points from the reprojected joints that they are; NaN where there is none.
function viewError(data, view, index) {
  if (index < 0 || !data.key_points) return NaN;
  let sum = 0, count = 0;
  for (const [k, j] of data.pairs) {
    const joint = index * data.joints.length + j, at = 2 * ((index * data.cameras.length + view) * data.kinds + k);
    if (data.state[joint] > FILLED || Number.isNaN(data.key_points[at])) continue;
    const camera = data.cameras[view], pixel = project(camera, data.points.subarray(3 * joint, 3 * joint + 3));
    if (!pixel) continue;
    const seen = through(camera, data.key_points[at], data.key_points[at + 1]);
    sum += Math.hypot(seen[0] - pixel[0], seen[1] - pixel[1]); count++;
  }
  return count ? sum / count : NaN;
}

// The highest drawn joint of each of several people, where their names are written.
function heads(data, joints) {
  if (data.people.length < 2) return [];
  return data.people.map((places, person) => {
    const own = joints.filter(joint => places.includes(joint.j));
    return { person, point: own.reduce((top, joint) => !top || joint.point[2] > top[2] ? joint.point : top, null) };
  }).filter(head => head.point);
}

async function load(text) {
  const data = JSON.parse(text);
  data.frame = Float64Array.from(data.frame.flatMap(([first, step, count]) => Array.from({ length: count }, (_, i) => first + i * step)));
  for (const name of ["points", "state", "error", "key_points"]) if (data[name]) data[name] = await unpack(data[name]);
  for (const other of data.others) other.points = await unpack(other.points);
  return data;
}

// The box that holds 98 % of the joints along each axis.
function extent(data) {
  const columns = [[], [], []], step = Math.max(1, Math.floor(data.state.length / 30000));
  for (let at = 0; at < data.state.length; at += step)
    if (data.state[at] <= FILLED) for (let axis = 0; axis < 3; axis++) columns[axis].push(data.points[3 * at + axis]);
  return { low: columns.map(c => quantile(c, 0.01)), high: columns.map(c => quantile(c, 0.99)) };
}

function corners({ low, high }) {
  return [0, 1, 2, 3, 4, 5, 6, 7].map(i => [0, 1, 2].map(axis => (i >> axis & 1 ? high : low)[axis]));
}

// A view in which these points are in the picture: around their middle, from as near as they allow.
function around(points, width, height) {
  const low = [0, 1, 2].map(axis => Math.min(...points.map(p => p[axis]))), high = [0, 1, 2].map(axis => Math.max(...points.map(p => p[axis])));
  const target = low.map((value, axis) => (value + high[axis]) / 2);
  const view = { target, yaw: 0.6, pitch: 0.35, distance: 1000, focal: 1.6 * Math.min(width, height), width, height };
  const inside = point => {
    const at = look(view, point);
    return at && Math.abs(at[0] - width / 2) < 0.44 * width && Math.abs(at[1] - height / 2) < 0.44 * height;
  };
  while (view.distance < 1e7 && !points.every(inside)) view.distance *= 1.05;
  return view;
}

// A view of everything: the people and all cameras.
function overview(data, width, height) {
  const box = extent(data), people = corners(box);
  const reach = Math.max(...box.low.map((value, axis) => (box.high[axis] - value) / 2), 500);
  const rig = data.cameras.flatMap(camera => [camera.centre, ...camera.corners]);
  return { view: around([...people, ...rig], width, height), near: around(people, width, height), floor: box.low[2], reach };
}

// The longest of 1, 2, 5, 10, ... that is at most ``most``.
function roundBelow(most) {
  const power = 10 ** Math.floor(Math.log10(most));
  return power * [5, 2, 1].find(factor => factor * power <= most);
}

async function start(document, window) {
  const element = id => document.getElementById(id);
  const data = await load(element("data").textContent);
  const scene = element("scene"), plot = element("plot"), scrub = element("scrub");
  const first = data.frame[0], last = data.frame[data.frame.length - 1];
  element("rig").hidden = !data.cameras.length;
  element("others").hidden = !data.others.length;
  element("other").textContent = data.others.map(other => other.name).join(", ");
  document.title = data.title;
  element("title").textContent = data.title;
  element("about").textContent = data.about;
  element("key").textContent = "Blue: left. Orange: right. Hollow and dashed: filled in, not observed. Missing joints are not drawn. "
    + "In the views: yellow dots are the detector's key points, lines the reprojected joints, px their mean distance; click a view to enlarge it. "
    + "Drag: turn; shift and drag: move; wheel: zoom; space: play; arrows: a frame.";
  const views = data.key_points || data.cameras.some(camera => camera.video) ? data.cameras.map(addView) : [];
  element("views").className = views.length > 8 ? "many" : "";
  const { view, near, floor, reach } = overview(data, scene.clientWidth || 1, scene.clientHeight || 1);
  const far = { ...view, target: [...view.target] };
  const rate = data.rate_hz || 30;
  let number = first, playing = false, before = 0, colours = {}, measured = null, chosen = -1;
  scrub.min = first; scrub.max = last; scrub.step = 1; scrub.value = first;

  function readColours() {
    const style = window.getComputedStyle(document.documentElement);
    for (const name of ["ink", "quiet", "paper", "line", "floor", "left", "right", "middle", "camera", "mark", "other", "point"])
      colours[name] = style.getPropertyValue(`--${name}`).trim();
  }

  function addView(camera, index) {
    const figure = document.createElement("figure"), frame = document.createElement("div"), canvas = document.createElement("canvas");
    const caption = document.createElement("figcaption"), name = document.createElement("span"), error = document.createElement("span");
    frame.style.aspectRatio = `${camera.size[0]} / ${camera.size[1]}`;
    name.textContent = camera.name; name.title = camera.name;
    let video = null;
    if (camera.video) {
      video = document.createElement("video");
      video.muted = true; video.preload = "auto"; video.src = camera.video;
      frame.append(video);
    }
    frame.append(canvas); caption.append(name, error); figure.append(frame, caption); element("views").append(figure);
    figure.addEventListener("click", () => {
      chosen = figure.classList.toggle("large") ? index : -1;
      for (const other of element("views").children) if (other !== figure) other.classList.remove("large");
      paint();
    });
    return { camera, canvas, error, video };
  }

  function line(context, from, to, colour, width, dash) {
    const a = look(view, from), b = look(view, to);
    if (!a || !b) return;
    stroke(context, a, b, colour, width, dash);
  }

  function stroke(context, a, b, colour, width, dash) {
    context.strokeStyle = colour; context.lineWidth = width; context.setLineDash(dash || []);
    context.beginPath(); context.moveTo(a[0], a[1]); context.lineTo(b[0], b[1]); context.stroke();
    context.setLineDash([]);
  }

  function write(context, point, text, colour) {
    const at = look(view, point);
    if (at) label(context, at[0] + 6, at[1] - 6, text, colour);
  }

  // On a halo of the paper's colour, so that it is read on any line.
  function label(context, x, y, text, colour) {
    context.font = "12px system-ui, sans-serif"; context.lineJoin = "round";
    const width = context.measureText(text).width;
    if (x + width > view.width) x = Math.max(4, x - width - 12);
    context.strokeStyle = colours.paper; context.lineWidth = 4; context.strokeText(text, x, y);
    context.fillStyle = colour; context.fillText(text, x, y);
  }

  function paintFloor(context) {
    const everything = data.cameras.length && element("cameras").checked ? data.cameras.map(camera => camera.centre) : [];
    const middle = [0, 1].map(axis => Math.round(near.target[axis] / 500) * 500);
    const wide = Math.max(1.5 * reach, ...everything.flatMap(p => [Math.abs(p[0] - middle[0]), Math.abs(p[1] - middle[1])]));
    const cell = wide > 10000 ? roundBelow(wide / 5) : wide > 5000 ? 1000 : 500, half = Math.ceil(wide / cell) * cell;
    const plane = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([a, b]) => look(view, [middle[0] + a * half, middle[1] + b * half, floor]));
    if (plane.every(Boolean)) {
      context.fillStyle = colours.floor; context.beginPath();
      plane.forEach((at, i) => i ? context.lineTo(at[0], at[1]) : context.moveTo(at[0], at[1]));
      context.fill();
    }
    for (let at = -half; at <= half; at += cell) {
      line(context, [middle[0] + at, middle[1] - half, floor], [middle[0] + at, middle[1] + half, floor], colours.line, 1);
      line(context, [middle[0] - half, middle[1] + at, floor], [middle[0] + half, middle[1] + at, floor], colours.line, 1);
    }
    const corner = [middle[0] - half, middle[1] - half, floor];
    data.axes.forEach((axis, i) => {
      const tip = axis.map((value, k) => corner[k] + 0.8 * cell * value);
      line(context, corner, tip, colours.quiet, 2); write(context, tip, "xyz"[i], colours.quiet);
    });
  }

  // How long a length is where the middle of the picture is.
  function paintScale(context) {
    const pixels = view.focal / view.distance, length = roundBelow(150 / pixels), y = view.height - 16;
    stroke(context, [16, y], [16 + length * pixels, y], colours.ink, 2);
    for (const x of [16, 16 + length * pixels]) stroke(context, [x, y - 4], [x, y + 4], colours.ink, 2);
    label(context, 16, y - 8, length >= 1000 ? `${length / 1000} m` : length >= 10 ? `${length / 10} cm` : `${length} mm`, colours.ink);
  }

  function paintCameras(context) {
    if (!element("cameras").checked) return;
    data.cameras.forEach((camera, index) => {
      const colour = index === chosen ? colours.mark : colours.camera;
      camera.corners.forEach((point, i) => {
        line(context, camera.centre, point, colour, 1);
        line(context, point, camera.corners[(i + 1) % 4], colour, 1);
      });
      write(context, camera.centre, camera.name, index === chosen ? colours.mark : colours.quiet);
    });
  }

  // Other estimators' poses, in one colour, below the person.
  function paintOthers(context, index) {
    if (index < 0 || !element("compared").checked) return;
    for (const other of data.others) {
      const point = j => other.points.subarray(3 * (index * other.joints + j), 3 * (index * other.joints + j) + 3);
      for (const [a, b] of other.bones) {
        const ends = [point(a), point(b)];
        if (!Number.isNaN(ends[0][0]) && !Number.isNaN(ends[1][0])) line(context, ends[0], ends[1], colours.other, 2);
      }
    }
  }

  function paintScene(index) {
    const context = fitted(scene);
    view.width = scene.clientWidth; view.height = scene.clientHeight;
    view.focal = 1.6 * Math.min(view.width, view.height);
    paintFloor(context); paintCameras(context); paintOthers(context, index);
    const { joints, bones } = drawn(data, index);
    const fine = data.joints.length / data.people.length > LAST_HUMAN;
    for (const bone of bones) line(context, bone.from.point, bone.to.point, colours[bone.side], fine ? 2 : 3, bone.filled ? [5, 4] : []);
    for (const joint of joints) {
      const at = look(view, joint.point);
      if (!at) continue;
      context.beginPath(); context.arc(at[0], at[1], Math.max(1.2, Math.min(fine ? 2.5 : 4, 30 * at[3])), 0, 2 * Math.PI);
      context.fillStyle = joint.filled ? colours.paper : colours[data.sides[joint.j]]; context.fill();
      context.strokeStyle = colours[data.sides[joint.j]]; context.lineWidth = joint.filled ? 1.5 : 1; context.stroke();
      if (element("names").checked) write(context, joint.point, data.joints[joint.j].replaceAll("_", " "), colours.ink);
    }
    for (const { person, point } of heads(data, joints)) write(context, point, `person ${person}`, colours.ink);
    paintScale(context);
  }

  function paintView({ camera, canvas, error, video }, index, viewIndex) {
    const context = fitted(canvas);
    const scale = [canvas.clientWidth / camera.size[0], canvas.clientHeight / camera.size[1]];
    const place = pixel => [pixel[0] * scale[0], pixel[1] * scale[1]];
    const { joints, bones } = drawn(data, index);
    const pixels = new Map(joints.map(joint => [joint.j, project(camera, joint.point)]));
    for (const { from, to, filled, side } of bones) {
      const a = pixels.get(from.j), b = pixels.get(to.j);
      if (a && b) stroke(context, place(a), place(b), colours[side], 1.5, filled ? [4, 3] : []);
    }
    const radius = Math.min(data.kinds > 40 ? 1.2 : 2.2, 0.012 * canvas.clientWidth);
    if (data.key_points && index >= 0) {
      context.fillStyle = colours.point; context.strokeStyle = colours.ink; context.lineWidth = 0.25 * radius;
      for (let k = 0; k < data.kinds; k++) {
        const at = 2 * ((index * data.cameras.length + viewIndex) * data.kinds + k);
        if (Number.isNaN(data.key_points[at])) continue;
        const [x, y] = place(through(camera, data.key_points[at], data.key_points[at + 1]));
        context.beginPath(); context.arc(x, y, radius, 0, 2 * Math.PI); context.fill(); context.stroke();
      }
    }
    const value = viewError(data, viewIndex, index);
    error.textContent = Number.isFinite(value) ? `${value.toFixed(1)} px` : "–";
    if (!video) return;
    const time = (number + 0.5) / rate;
    if (playing && video.paused) video.play().catch(() => {});
    if (!playing && !video.paused) video.pause();
    video.playbackRate = Number(element("speed").value);
    if (!video.seeking && Math.abs(video.currentTime - time) > (playing ? 0.15 : 0.4 / rate)) video.currentTime = time;
  }

  // The errors of the views in some of the frames, and the largest that is drawn; made when they are first looked at.
  function courses() {
    if (measured) return measured;
    const step = Math.max(1, Math.ceil(data.frame.length * data.cameras.length / 4000)), rows = [];
    for (let index = 0; data.key_points && index < data.frame.length; index += step)
      rows.push({ number: data.frame[index], errors: data.cameras.map((_, v) => viewError(data, v, index)) });
    const every = rows.flatMap(row => row.errors).filter(Number.isFinite), own = data.error.filter(Number.isFinite);
    measured = { rows, top: Math.max(1, 1.15 * quantile(own, 0.99), 1.05 * quantile(every, 0.98)) };
    return measured;
  }

  function paintPlot() {
    const context = fitted(plot), width = plot.clientWidth, height = plot.clientHeight;
    const { rows, top } = courses();
    const left = 44, right = width - 12, bottom = height - 8, count = data.joints.length;
    const x = value => left + (right - left) * (value - first) / Math.max(1, last - first);
    const y = value => bottom - (bottom - 18) * Math.min(1, value / top);
    context.fillStyle = colours.quiet; context.font = "11px system-ui, sans-serif";
    const words = rows.length ? "error, px; thin: each view; grey: joints missing" : "reprojection error, px; grey: joints missing";
    context.fillText(words, left, 12);
    context.fillText(top.toFixed(1), 8, 24); context.fillText("0", 8, bottom);
    const step = Math.max(1, 0.5 + (right - left) * data.stride / Math.max(1, last - first));
    const skip = Math.max(1, Math.floor(data.frame.length / 2000));
    context.fillStyle = colours.line;
    for (let i = 0; i < data.frame.length; i += skip) {
      let missing = 0;
      for (let j = 0; j < count; j++) missing += data.state[i * count + j] > FILLED;
      if (missing) context.fillRect(x(data.frame[i]), bottom - (bottom - 18) * missing / count, step * skip, (bottom - 18) * missing / count);
    }
    data.cameras.forEach((_, v) => {
      if (!rows.length || (data.cameras.length > 8 && v !== chosen)) return;
      context.globalAlpha = v === chosen ? 1 : 0.55;
      course(context, rows.length, i => rows[i].number, i => rows[i].errors[v], x, y, v === chosen ? colours.mark : colours.camera, 1);
    });
    context.globalAlpha = 1;
    course(context, data.frame.length, i => data.frame[i], i => data.error[i], x, y, colours.ink, skip);
    stroke(context, [x(number), 16], [x(number), bottom], colours.mark, 2);
    plot.toNumber = pixel => first + Math.round((last - first) * (pixel - left) / (right - left));
  }

  function course(context, count, numberAt, valueAt, x, y, colour, skip) {
    context.strokeStyle = colour; context.lineWidth = 1; context.beginPath();
    let pen = false, earlier = NaN;
    const widest = skip * data.stride * (count < data.frame.length ? Math.ceil(data.frame.length / count) : 1);
    for (let i = 0; i < count; i += skip) {
      const at = numberAt(i), value = valueAt(i);
      if (!Number.isFinite(value)) { pen = false; continue; }
      if (pen && at - earlier <= widest) context.lineTo(x(at), y(value)); else context.moveTo(x(at), y(value));
      pen = true; earlier = at;
    }
    context.stroke();
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
    paintScene(index); paintPlot();
    views.forEach((one, v) => paintView(one, index, v));
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

  function goTo(place) { view.target = [...place.target]; view.distance = place.distance; view.yaw = place.yaw; view.pitch = place.pitch; paint(); }

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
  element("near").addEventListener("click", () => goTo(near));
  element("far").addEventListener("click", () => goTo(far));
  for (const id of ["cameras", "names", "compared"]) element(id).addEventListener("change", paint);
  window.addEventListener("resize", paint);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { readColours(); paint(); });
  document.addEventListener("keydown", event => {
    if (["INPUT", "SELECT", "BUTTON"].includes(event.target.tagName)) return;
    if (event.key === " ") { event.preventDefault(); toggle(); }
    if (event.key === "ArrowRight") seek(Math.floor(number) + data.stride);
    if (event.key === "ArrowLeft") seek(Math.floor(number) - data.stride);
  });
  readColours();
  const asked = /^#frame=(-?\d+)$/.exec(window.location.hash);
  if (asked) seek(Number(asked[1])); else paint();
}

if (typeof module === "undefined") start(document, window);
else module.exports = { distorted, drawn, heads, indexAt, load, look, overview, project, quantile, viewError };
