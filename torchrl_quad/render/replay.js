"use strict";

const element = (id) => document.getElementById(id);
const decoded = (text) => text && new Float32Array(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);

const flight = JSON.parse(element("flight").textContent);
const { environments, frames, ended, endings } = flight;
const [position, attitude, lift, target, gate, allRings, places, path, rotors] = ["position", "quaternion", "lift", "target",
  "gate", "gates", "places", "curve", "rotors"].map((name) => decoded(flight[name]));
const allShapes = flight.shapes.map((shape) => ({ ...shape, points: decoded(shape.points), faces: decoded(shape.faces) }));
const obstacles = flight.obstacles.map(({ points, faces }) => ({ points: decoded(points), faces: decoded(faces) }));
const images = flight.images && Uint8Array.from(atob(flight.images.data), (c) => c.charCodeAt(0));
const times = Float64Array.from({ length: frames }, (_, k) => flight.start + k * flight.control_dt);

const RED = "#c8452f", ORANGE = "#e8912d", INK = "#222222", PALE = "#dcdfe3";
const CURVES = [INK, "#2f6db5", "#e8912d", "#3a9a5b", "#c8452f", "#8a5fb0", "#8c6d4f", "#d17ba6", "#5bb0c0"];
const RING = 33; // points around a gate
let rings = allRings && own(allRings, null), shapes = own(allShapes, null);
const TRAIL = Math.min(Math.round(2 / flight.control_dt), frames - 1); // steps behind a drone

const everyone = Array.from({ length: environments }, (_, i) => i);
const colors = everyone.map((i) => viridis(environments > 1 ? 0.05 + (0.8 * i) / (environments - 1) : 0.3));

// The view: the frame (between two while it plays), the chosen drone, the drone size, and the speed of play.
let frame = 0, chosen = null, size = 1, speed = 1, playing = false, last = null;

// -- the state between two frames -------------------------------------------------------------------------------------

function between(array, k, i, mirrored = false) {
  const low = Math.floor(frame), part = frame - low;
  const a = (i * frames + low) * k, b = (i * frames + Math.min(low + 1, frames - 1)) * k;
  let dot = 0;
  for (let j = 0; mirrored && j < k; j++) dot += array[a + j] * array[b + j];
  const sign = dot < 0 ? -1 : 1; // q and -q are one attitude
  // At a frame only that frame counts: the next may not be finite.
  return Array.from({ length: k }, (_, j) => array[a + j] + (part && part * (sign * array[b + j] - array[a + j])));
}

function turned([w, x, y, z]) {
  const s = 2 / (w * w + x * x + y * y + z * z);
  return ([a, b, c]) => [
    a - s * ((y * y + z * z) * a - (x * y - w * z) * b - (x * z + w * y) * c),
    b - s * ((x * x + z * z) * b - (x * y + w * z) * a - (y * z - w * x) * c),
    c - s * ((x * x + y * y) * c - (x * z - w * y) * a - (y * z + w * x) * b),
  ];
}

// -- lines ------------------------------------------------------------------------------------------------------------

const NOWHERE = [NaN, NaN, NaN];

// Collects the points of a trace; all bodies are one trace, with gaps.
class Pen {
  x = []; y = []; z = [];
  to(point) { this.x.push(point[0]); this.y.push(point[1]); this.z.push(point[2]); }
  lift() { this.to(NOWHERE); }
}

const plus = (a, b, scale = 1) => a.map((value, j) => value + scale * b[j]);
const arm = Math.hypot(...rotors.slice(0, 2)), hubs = rotors.length / (2 * environments);

function drawBody(pen, i, centre, world) {
  for (let j = 0; j < hubs; j++) {
    pen.to(centre);
    pen.to(plus(centre, world(hub(i, j)), size));
  }
  pen.lift();
  for (let j = 0; j < hubs; j++) {
    for (let k = 0; k <= 8; k++) {
      const angle = (k * Math.PI) / 4, radius = 0.45 * arm;
      const rim = plus(hub(i, j), [radius * Math.cos(angle), radius * Math.sin(angle), 0]);
      pen.to(plus(centre, world(rim), size));
    }
    pen.lift();
  }
}

function hub(i, j) {
  const k = 2 * (hubs * i + j);
  return [rotors[k], rotors[k + 1], 0];
}

function drawTrail(pen, i, centre) {
  const now = Math.min(Math.floor(frame), ended[i]);
  for (let k = now - TRAIL; k <= now; k++) {
    const index = 3 * (i * frames + Math.max(k, 0));
    pen.to(position.subarray(index, index + 3));
  }
  pen.to(centre);
  pen.lift();
}

// Of all gates, or the shapes around them, those of the environment that is followed, or else of the first.
function own(all, i) {
  const size = all.length / flight.tracks, first = flight.tracks > 1 ? size * (i ?? 0) : 0; // which all may share
  return all.slice(first, first + size);
}

const shapeTrace = (shape, k) => object({ ...shape, name: shape.name || `shape ${k}` });

function drawNextGates(pen) {
  const next = new Set((flight.tracks > 1 ? [chosen ?? 0] : shown()).map((i) => gate[i * frames + Math.floor(frame)]));
  for (let g = 0; g < rings.length / (3 * RING); g++) drawRing(pen, next.has(g) ? g : null);
}

function drawRing(pen, g) {
  for (let k = 0; k < RING; k++) {
    pen.to(g === null ? NOWHERE : rings.subarray(3 * (g * RING + k), 3 * (g * RING + k) + 3));
  }
  pen.lift();
}

// The traces that move, by name, at the present frame.
function moving() {
  const pens = Object.fromEntries(MOVING.map((name) => [name, new Pen()]));
  for (const i of everyone) {
    const real = between(position, 3, i), world = turned(between(attitude, 4, i, true));
    drawTrail(pens.trail, i, real);
    pens.shadow.to([real[0], real[1], 0]);
    const centre = chosen === null || chosen === i ? real : NOWHERE;
    drawBody(pens.body, i, centre, world);
    pens.nose.to(centre);
    pens.nose.to(plus(centre, world([1.5 * arm, 0, 0]), size));
    pens.nose.lift();
    pens.crash.to(endings[i] === "crashed" && frame >= ended[i] ? centre : NOWHERE);
    if (pens.target) pens.target.to(centre === NOWHERE ? NOWHERE : between(target, 3, i));
    if (lift) {
      const thrust = between(lift, hubs, i);
      for (let j = 0; j < hubs; j++) {
        pens.thrust.to(plus(centre, world(hub(i, j)), size));
        pens.thrust.to(plus(centre, world(plus(hub(i, j), [0, 0, arm * thrust[j]])), size));
        pens.thrust.lift();
      }
    }
  }
  if (gate) drawNextGates(pens.next);
  return pens;
}

const shown = () => (chosen === null ? everyone : [chosen]);

// The colour of each point of a trace with so many points for each drone.
const each = (points, colorOf) => everyone.flatMap((i) => Array(points).fill(colorOf(i)));
const trailColors = () => each(TRAIL + 3, (i) => (shown().includes(i) ? colors[i] : PALE));

// -- space ------------------------------------------------------------------------------------------------------------

const MOVING = ["shadow", "trail", "body", "nose", ...(lift ? ["thrust"] : []), ...(target && !gate ? ["target"] : []),
  ...(gate ? ["next"] : []), "crash"];
const [low, high] = bounds(...[position, target, allRings, places, path].filter(Boolean),
  ...allShapes.map((shape) => shape.points));
const extent = Math.max(...high.map((value, j) => value - low[j]), 1);
const grounded = low[2] < 2 * extent; // otherwise the ground is too far below to be shown

function bounds(...arrays) {
  const least = [Infinity, Infinity, Infinity], most = [-Infinity, -Infinity, -Infinity];
  for (const array of arrays) {
    array.forEach((value, index) => {
      if (!Number.isFinite(value)) return;
      least[index % 3] = Math.min(least[index % 3], value);
      most[index % 3] = Math.max(most[index % 3], value);
    });
  }
  return least[0] <= most[0] ? [least, most] : [[-0.5, -0.5, 0], [0.5, 0.5, 1]]; // nothing is finite
}

function spaceRange(j) {
  const middle = (low[j] + high[j]) / 2, half = Math.max((high[j] - low[j]) / 2 + 0.08 * extent, 0.3 * extent);
  return j === 2 && grounded ? [Math.min(0, low[2]) - 0.01 * extent, Math.max(middle + half, 0.4 * extent)]
    : [middle - half, middle + half];
}

function ground() {
  const pen = new Pen(), unit = 10 ** Math.floor(Math.log10(extent)), step = extent / unit > 4 ? unit : unit / 2;
  const [[x0, x1], [y0, y1]] = [spaceRange(0), spaceRange(1)];
  for (let x = Math.ceil(x0 / step) * step; grounded && x <= x1; x += step) {
    pen.to([x, y0, 0]); pen.to([x, y1, 0]); pen.lift();
  }
  for (let y = Math.ceil(y0 / step) * step; grounded && y <= y1; y += step) {
    pen.to([x0, y, 0]); pen.to([x1, y, 0]); pen.lift();
  }
  return line("ground", pen, "#e3e6e9", 1);
}

function trace(name, mode, { x, y, z }, style) {
  return { name, type: "scatter3d", mode, x, y, z, ...style, hoverinfo: "skip" };
}

const line = (name, pen, color, width) => trace(name, "lines", pen, { line: { color, width } });
const markers = (name, pen, color, symbol, size) => trace(name, "markers", pen, { marker: { color, symbol, size } });

// A pen that has gone through the points of an array.
function through(array) {
  const pen = new Pen();
  for (let k = 0; k < array.length; k += 3) pen.to(array.subarray(k, k + 3));
  return pen;
}

// Words above objects, each of them an array of points.
function labels(name, words, objects) {
  const pen = new Pen();
  for (const [[x0, y0, z0], [x1, y1, z1]] of objects.map((points) => bounds(points))) {
    pen.to([(x0 + x1) / 2, (y0 + y1) / 2, z1 + Math.max(0.15 * (z1 - z0), 0.02 * extent)]);
  }
  return trace(name, "text", pen, { text: words, textfont: { color: "#777", size: 12 } });
}

function gates() {
  const pen = new Pen(), each = Array.from({ length: rings.length / (3 * RING) }, (_, g) => g);
  for (const g of each) drawRing(pen, g);
  const objects = each.map((g) => rings.subarray(3 * g * RING, 3 * (g + 1) * RING));
  return [line("gates", pen, "#9aa3ad", 5), labels("labels", each.map((g) => `${g + 1}`), objects)];
}

// A line, or a surface of triangles.
function object({ name, points, faces, color, opacity }) {
  const pen = through(points);
  if (!faces) return line(name, pen, color, 4);
  const [i, j, k] = [0, 1, 2].map((corner) => faces.filter((_, index) => index % 3 === corner));
  return { name, type: "mesh3d", x: pen.x, y: pen.y, z: pen.z, i, j, k, color, opacity, flatshading: true,
    lighting: { ambient: 0.75, diffuse: 0.5, specular: 0.05 }, hoverinfo: "skip" };
}

// The obstacles of the environment that is followed, or else of the first; all may share those of the first.
function obstacle() {
  const { points, faces } = obstacles[chosen ?? 0] ?? obstacles[0];
  return object({ name: "obstacles", points, faces, color: "#3a7d4f", opacity: 0.7 });
}

// What the task's markers name.
function taskMarkers() {
  const named = shapes.filter((shape) => shape.name);
  return [...shapes.map(shapeTrace), ...(obstacles.length ? [obstacle()] : []),
    ...(named.length ? [labels("names", named.map((shape) => shape.name), named.map((shape) => shape.points))] : []),
    ...(rings ? gates() : []), ...(places ? [markers("places", through(places), "#e9b8ae", "diamond", 5)] : []),
    ...(path ? [line("path", through(path), "#e9b8ae", 2)] : target && !gate ? [course()] : [])];
}

// The way of a target that moves, of the environment that is followed or else of the first.
function course() {
  const pen = new Pen(), i = chosen ?? 0, stride = Math.ceil(frames / 200);
  for (let k = 0; k < frames; k += stride) {
    const index = 3 * (i * frames + Math.min(k, ended[i]));
    pen.to(target.subarray(index, index + 3));
  }
  return line("course", pen, "#e9b8ae", 2);
}

function drawSpace() {
  const pens = moving();
  const traces = {
    shadow: () => markers("shadow", pens.shadow, "#b9bec4", "circle", grounded ? 2.5 : 0),
    trail: () => line("trail", pens.trail, trailColors(), 2),
    body: () => line("body", pens.body, each(12 * hubs + 1, (i) => colors[i]), 4),
    nose: () => line("nose", pens.nose, RED, 6),
    thrust: () => line("thrust", pens.thrust, ORANGE, 3),
    target: () => markers("target", pens.target, RED, "diamond", 7),
    next: () => line("next", pens.next, ORANGE, 9),
    crash: () => markers("crash", pens.crash, RED, "circle-open", 12),
  };
  const axis = (title, j) => ({ title: { text: title }, range: spaceRange(j), showgrid: false, zeroline: false,
    showbackground: false, showspikes: false, color: "#777", nticks: 6 });
  const still = [ground(), ...taskMarkers()];
  const sides = [0, 1, 2].map((j) => spaceRange(j)[1] - spaceRange(j)[0]), scale = Math.hypot(...sides) / 1.65;
  return Plotly.newPlot("space", [...still, ...MOVING.map((name) => traces[name]())], {
    scene: { xaxis: axis("x [m]", 0), yaxis: axis("y [m]", 1), zaxis: axis("z [m]", 2), aspectmode: "manual",
      aspectratio: { x: sides[0] / scale, y: sides[1] / scale, z: sides[2] / scale },
      camera: { eye: { x: -0.9, y: -1.3, z: 0.85 }, center: { x: 0, y: 0, z: -0.08 } } },
    margin: { l: 0, r: 0, t: 0, b: 0 }, showlegend: false, hovermode: false,
  }, { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["tableRotation", "resetCameraLastSave3d"] });
}

const indexOf = (name) => element("space").data.findIndex((trace) => trace.name === name);

// -- time series ------------------------------------------------------------------------------------------------------

const MARGIN = { l: 52, r: 14, t: 26, b: 40 }, GAP = 0.06; // around the panels [pixels], and between them
const panels = flight.panels.map((panel) => ({ ...panel, values: decoded(panel.values) }));

// Where a panel is, as shares of the height of them all.
function domain(p) {
  const height = (1 + GAP) / panels.length, top = 1 - p * height;
  return [Math.max(top - height + GAP, 0), top];
}

function curve(panel, i, j) {
  const k = panel.names.length;
  return Float32Array.from({ length: frames }, (_, index) => panel.values[(i * frames + index) * k + j]);
}

// The range of all but rare peaks, such as a bonus, where these would flatten all the rest.
function range(curves) {
  const values = Float32Array.from(curves.flatMap((y) => Array.from(y.filter(Number.isFinite)))).sort();
  const [least, low, high, most] = [0, 0.03, 0.97, 1].map((q) => values[Math.round(q * (values.length - 1))]);
  const from = low - least > 3 * (high - low) ? low : least, to = most - high > 3 * (high - low) ? high : most;
  return high > low ? { range: [from - 0.1 * (to - from), to + 0.1 * (to - from)] } : {};
}

// A logarithmic axis around all that is positive, with ticks at 1, 2, 5, or where it is long at each power of ten.
function logarithmic(curves, success) {
  const powers = [...curves.flatMap((y) => Array.from(y.filter((value) => value > 0))), ...(success ? [success] : [])]
    .map(Math.log10);
  const [from, to] = [Math.min(...powers) - 0.1, Math.max(...powers) + 0.1];
  return powers.length ? { type: "log", range: [from, to], dtick: to - from > 1.6 ? 1 : "D2", tickformat: "~g" } : {};
}

function drawSeries() {
  const traces = [], layout = {
    xaxis: { title: { text: "time [s]" }, range: [0, times[frames - 1]], anchor: `y${panels.length}`, gridcolor: "#eee",
      zeroline: false },
    margin: MARGIN, font: { size: 11, color: "#555" }, showlegend: false, annotations: [], shapes: [],
    hovermode: "x unified", hoverdistance: -1,
  };
  panels.forEach((panel, p) => {
    const axis = p ? `y${p + 1}` : "y", [bottom, top] = domain(p);
    const curves = chosen === null ? everyone.map((i) => [curve(panel, i, 0), colors[i], `${i}`])
      : panel.names.map((name, j) => [curve(panel, chosen, j), panel.names.length > 1 ? CURVES[j % CURVES.length]
        : colors[chosen], name]);
    for (const [y, color, name] of curves) {
      traces.push({ x: times, y, yaxis: axis, name, mode: "lines", type: "scatter", meta: panel.label,
        line: { color, width: 1.3, shape: panel.held ? "hv" : "linear" }, hovertemplate: "%{y:.4g}" });
    }
    layout[axis.replace("y", "yaxis")] = { domain: [bottom, top], gridcolor: "#eee", zerolinecolor: "#ddd",
      ...(panel.log ? logarithmic(curves.map(([y]) => y), panel.success) : { nticks: 5 }),
      ...(panel.peaks ? range(curves.map(([y]) => y)) : {}) };
    if (panel.success != null) {
      layout.shapes.push({ type: "line", xref: "paper", x0: 0, x1: 1, yref: axis, y0: panel.success, y1: panel.success,
        line: { color: RED, width: 1, dash: "dash" } });
    }
    const names = panel.names.length === 1 ? "" : chosen === null ? `, ${panel.names[0]}` : ": " + curves
      .map(([, color, name]) => `<span style="color:${color}">${name.replaceAll("_", " ")}</span>`).join("  ");
    const success = panel.success == null ? "" : `  <span style="color:${RED}">dashed: success below it</span>`;
    layout.annotations.push({ text: panel.label + names + success, xref: "paper", yref: "paper", x: 0, y: top, xanchor: "left",
      yanchor: "bottom", showarrow: false, font: { size: 11.5, color: INK } });
  });
  return Plotly.react("series", traces, layout, { responsive: true, displayModeBar: false });
}

// A line over each panel: a shape of Plotly's would have all curves drawn again for each frame.
element("cursor").style.inset = `${MARGIN.t}px auto ${MARGIN.b}px -0.75px`;
element("cursor").append(...panels.map((_, p) => {
  const part = document.createElement("div"), [bottom, top] = domain(p);
  Object.assign(part.style, { top: `${100 * (1 - top)}%`, height: `${100 * (top - bottom)}%` });
  return part;
}));

function moveCursor() {
  const [from, to] = element("series").layout.xaxis.range, share = (now() - from) / (to - from);
  element("cursor").style.transform = `translateX(${MARGIN.l + share * plotWidth()}px)`;
  element("cursor").style.visibility = share >= 0 && share <= 1 ? "visible" : "hidden";
}

function goTo({ event }) {
  const [from, to] = element("series").layout.xaxis.range;
  const share = (event.clientX - element("series").getBoundingClientRect().x - MARGIN.l) / plotWidth();
  play(false);
  seek(Math.round((from + share * (to - from) - flight.start) / flight.control_dt));
}

const plotWidth = () => element("series").clientWidth - MARGIN.l - MARGIN.r;

// -- control ----------------------------------------------------------------------------------------------------------

const now = () => flight.start + frame * flight.control_dt;
const seconds = (frame) => `${(flight.start + frame * flight.control_dt).toFixed(2)} s`;

function show() {
  const pens = moving();
  const all = (key) => MOVING.map((name) => pens[name][key]);
  Plotly.restyle("space", { x: all("x"), y: all("y"), z: all("z") }, MOVING.map(indexOf));
  moveCursor();
  showImage();
  element("time").value = Math.round(frame);
  element("clock").textContent = `${seconds(frame)} of ${seconds(frames - 1)}`;
  const counts = new Map();
  for (const i of shown()) {
    const word = endings[i] && frame >= ended[i] ? endings[i] : "flying";
    counts.set(word, (counts.get(word) ?? 0) + 1);
  }
  element("status").textContent = chosen === null ? Array.from(counts, ([word, count]) => `${count} ${word}`).join(", ")
    : `environment ${chosen}: ${Array.from(counts.keys())}`;
}

// What the camera of the drone that is followed saw, or else of the first: the nearer the brighter.
function showImage() {
  if (!images) return;
  const { width, height } = flight.images, canvas = element("depth"), context = canvas.getContext("2d");
  const first = ((chosen ?? 0) * frames + Math.floor(frame)) * width * height;
  const picture = context.createImageData(width, height);
  for (let k = 0; k < width * height; k++) {
    const value = images[first + k];
    picture.data.set([value, value, value, 255], 4 * k);
  }
  context.putImageData(picture, 0, 0);
}

function seek(to) {
  frame = Math.min(Math.max(to, 0), frames - 1);
  show();
}

function play(on) {
  if (on && frame >= frames - 1) frame = 0;
  playing = on;
  last = null;
  element("play").textContent = on ? "Pause" : "Play";
  if (on) requestAnimationFrame(tick);
}

// Real time by the clock, however many frames the browser draws.
function tick(time) {
  if (!playing) return;
  if (last !== null) seek(frame + ((time - last) / 1000) * speed / flight.control_dt);
  last = time;
  if (frame < frames - 1) requestAnimationFrame(tick);
  else play(false);
}

function choose(i) {
  chosen = i;
  element("environment").value = i ?? "all";
  Plotly.restyle("space", { "line.color": [trailColors()] }, [indexOf("trail")]);
  if (indexOf("course") >= 0) moveTrace(course());
  if (rings && flight.tracks > 1) {
    [rings, shapes] = [own(allRings, i), own(allShapes, i)];
    [...gates(), ...shapes.map(shapeTrace)].forEach(moveTrace);
  }
  if (obstacles.length > 1) moveTrace(obstacle());
  drawSeries();
  show();
}

// Draw a still trace, of lines, words or triangles, elsewhere.
function moveTrace({ name, x, y, z, i, j, k }) {
  Plotly.restyle("space", { x: [x], y: [y], z: [z], ...(i && { i: [i], j: [j], k: [k] }) }, [indexOf(name)]);
}

function options(id, values, label, value, change) {
  element(id).append(...values.map((v) => new Option(label(v), v ?? "all")));
  element(id).value = value ?? "all";
  element(id).addEventListener("change", (event) => {
    change(event.target.value);
    event.target.blur(); // so that the keys are those of the page again
  });
}

if (images) Object.assign(element("depth"), { width: flight.images.width, height: flight.images.height, hidden: false });
const sizes = [1, 2, 3, 5, 10, 20, 50];
size = sizes.find((factor) => 2 * arm * factor > 0.05 * extent) ?? 50;
element("time").max = frames - 1;
options("speed", [0.1, 0.25, 0.5, 1, 2, 4], (v) => (v === 1 ? "real time" : `${v}x`), 1, (v) => { speed = Number(v); });
options("environment", [null, ...everyone], (i) => i === null ? "all" : `${i}${endings[i] && `: ${endings[i]} at ${
  seconds(ended[i])}`}`, null, (v) => choose(v === "all" ? null : Number(v)));
options("size", sizes, (v) => (v === 1 ? "to scale" : `${v}x`), size, (v) => { size = Number(v); show(); });
element("note").textContent = (flight.knows_drone
  ? "The line up from each rotor is its thrust: as long as an arm where the drone hovers. "
  : "The frame of the drone is a guess, as no environment was given; the line up from each rotor is its squared speed. ")
  + "The red arm is the nose; a drone in a red circle has crashed. Success: the last state of the episode fulfils the task. "
  + "Keys: space, left and right (a step), up and down (environment). Click into the time series to go there, "
  + "double-click to see all of it.";

element("play").addEventListener("click", () => play(!playing));
element("time").addEventListener("input", (event) => { play(false); seek(Number(event.target.value)); });
window.addEventListener("resize", moveCursor);
document.addEventListener("visibilitychange", () => { last = null; });
document.addEventListener("keydown", (event) => {
  const key = event.key;
  if (event.altKey || event.ctrlKey || event.metaKey) return; // the browser's own
  if (event.target.tagName === "SELECT" || (key === " " && event.target.tagName === "BUTTON")) return;
  const next = (chosen ?? -1) + (key === "ArrowDown" ? 1 : -1);
  if (key === " ") { if (!event.repeat) play(!playing); } // held, it must not scroll either
  else if (key === "ArrowLeft" || key === "ArrowRight") {
    play(false);
    seek(Math.round(frame) + (key === "ArrowRight" ? 1 : -1));
  } else if (key === "ArrowUp" || key === "ArrowDown") {
    if (next < environments && next >= -1) choose(next < 0 ? null : next);
  } else return;
  event.preventDefault();
});

Promise.all([drawSpace(), drawSeries()]).then(() => {
  element("series").on("plotly_relayout", moveCursor);
  element("series").on("plotly_click", goTo);
  show();
  document.body.dataset.ready = "yes";
});

function viridis(share) {
  const stops = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
  const k = Math.min(Math.floor(4 * share), 3), part = 4 * share - k;
  return `rgb(${stops[k].map((value, j) => Math.round(value + part * (stops[k + 1][j] - value)))})`;
}
