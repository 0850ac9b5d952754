"use strict";
// The replay page. Meshcat's viewer draws; this moves it by one clock, which plots share.
(() => {
const data = JSON.parse(document.getElementById("data").textContent);
const { THREE } = MeshCat;
const byId = (id) => document.getElementById(id);
const COLOURS = ["#2f7ed8", "#e0671f", "#3a9d5d", "#a855c7", "#b58900", "#c2366b"];
const FULL = 1.5 * Math.PI; // [rad] what the largest torque of a joint spans as an arc
const POOR = 0.5; // residual over the torque's root mean square that is as red as it gets
const SLOW = 0.045; // [s] a frame
const COARSEST = 0.5; // share of the pixels' width that a slow processor draws at least
const LONGEST = 20000; // rows that a live page keeps of each table

function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

// ---- tables: times and rows of numbers -------------------------------------------------------

function unpack({ kind, data: text }) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  return kind === "<u4" ? new Uint32Array(bytes.buffer) : new Float32Array(bytes.buffer);
}

class Table {
  constructor(t, values) {
    this.t = t ? Array.from(unpack(t)) : [];
    const flat = values ? unpack(values) : [];
    const width = values ? values.shape[1] : 0;
    this.rows = this.t.map((_, k) => Array.from(flat.subarray(k * width, (k + 1) * width)));
  }
  get end() { return this.t.length ? this.t[this.t.length - 1] : 0; }
  before(time) { // the last row not after a time; 0 if all are
    let low = 0, high = this.t.length - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (this.t[middle] <= time) low = middle; else high = middle - 1;
    }
    return low;
  }
  at(time) { // linear between two rows
    const k = this.before(time), next = this.rows[k + 1];
    if (!next || time <= this.t[k]) return this.rows[k];
    const share = (time - this.t[k]) / (this.t[k + 1] - this.t[k]);
    return this.rows[k].map((x, i) => x + share * (next[i] - x));
  }
  push(t, row) {
    this.t.push(t);
    this.rows.push(row);
    if (this.t.length <= LONGEST) return;
    const half = (_, k) => k % 2 === 0;
    this.t = this.t.filter(half);
    this.rows = this.rows.filter(half);
  }
}

const motion = new Table(data.motion.t, data.motion.q);
const ghostMotion = data.ghost ? new Table(data.ghost.t, data.ghost.q) : null;
const torques = data.torques;
// one row: measured of every joint, then each prediction of every joint
const torqueTable = torques ? new Table(torques.t, torques.values) : null;
const bands = data.bands;
const bandTable = bands ? new Table(bands.t, bands.values) : null; // values, then standard errors

// ---- the scene -------------------------------------------------------------------------------

const onProcessor = (() => { // no graphics card draws: smooth edges would halve the frames
  const context = document.createElement("canvas").getContext("webgl");
  const info = context && context.getExtension("WEBGL_debug_renderer_info");
  const name = info ? context.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
})();

const pane = byId("meshcat-pane");
let viewer = null, fullRatio = 1; // pixels of the view per pixel of the page
try {
  const renderer = new THREE.WebGLRenderer({ antialias: !onProcessor, alpha: true });
  pane.append(renderer.domElement);
  viewer = new MeshCat.Viewer(pane, true, renderer);
  fullRatio = onProcessor ? 1 : window.devicePixelRatio;
  renderer.setPixelRatio(fullRatio);
} catch (error) { // the plots are of use without it
  pane.append(element("p", { class: "fault" }, `This browser shows no 3-D view: ${error.message}`));
}

function geometry(part) {
  const [a, b, c] = part.size;
  if (part.shape === "sphere") return new THREE.SphereGeometry(a, 24, 16);
  if (part.shape === "cylinder") return new THREE.CylinderGeometry(a, a, b, 28);
  if (part.shape === "box") return new THREE.BoxGeometry(a, b, c);
  return meshes[a];
}

const meshes = data.scene.meshes.map((mesh) => {
  const made = new THREE.BufferGeometry();
  made.setAttribute("position", new THREE.BufferAttribute(unpack(mesh.vertices), 3));
  made.setIndex(new THREE.BufferAttribute(unpack(mesh.faces), 1));
  made.computeVertexNormals();
  return made;
});

class Robot { // the nodes of one robot in the viewer's tree, posed by a row of a motion
  constructor(root, material) {
    this.root = viewer.scene_tree.find([root]).object;
    this.materials = new Map();
    const paths = [];
    this.joints = data.scene.nodes.map((node, i) => {
      const name = `${i} ${node.name.replaceAll("/", "|")}`;
      paths.push(i ? [...paths[node.parent], name] : [root]);
      const object = viewer.scene_tree.find(paths[i]).object;
      const rest = {
        position: new THREE.Vector3(...node.position),
        quaternion: new THREE.Quaternion(...node.quaternion),
      };
      object.position.copy(rest.position);
      object.quaternion.copy(rest.quaternion);
      return { ...node, object, rest, axis: new THREE.Vector3(...node.axis) };
    });
    data.scene.parts.forEach((part, k) => {
      if (!this.materials.has(part.colour)) this.materials.set(part.colour, material(part.colour));
      const mesh = new THREE.Mesh(geometry(part), this.materials.get(part.colour));
      new THREE.Matrix4().fromArray(part.matrix).decompose(mesh.position, mesh.quaternion, mesh.scale);
      viewer.set_object([...paths[part.node], `part ${k}`], mesh);
    });
  }
  pose(row) {
    if (!row) return;
    const turn = new THREE.Quaternion();
    for (const { kind, column, axis, object, rest } of this.joints) {
      if (kind === "turn") {
        object.quaternion.copy(rest.quaternion).multiply(turn.setFromAxisAngle(axis, row[column]));
      } else if (kind === "slide") {
        object.position.copy(axis).multiplyScalar(row[column]);
        object.position.applyQuaternion(rest.quaternion).add(rest.position);
      } else if (kind === "free") {
        object.position.set(row[0], row[1], row[2]);
        object.quaternion.set(row[3], row[4], row[5], row[6]).normalize();
      }
    }
  }
  fade(opacity) {
    for (const material of this.materials.values()) {
      material.transparent = opacity < 1;
      material.opacity = opacity;
      material.depthWrite = opacity === 1;
      material.needsUpdate = true;
    }
  }
}

const solid = (color) => new THREE.MeshLambertMaterial({ color });
const robot = viewer && new Robot("robot", solid);
const ghost = viewer && ghostMotion && new Robot("ghost", () => new THREE.MeshPhongMaterial(
  { color: "#3b82f6", transparent: true, opacity: 0.3, depthWrite: false }));

// ---- centres of mass and equimomental ellipsoids ---------------------------------------------

class Masses {
  constructor(set, colour) {
    this.bodies = set.bodies.map((body) => ({ ...body, objects: [] }));
    this.colour = colour;
    if (!viewer) return;
    const ball = new THREE.SphereGeometry(1, 20, 12);
    const size = 0.012 * data.scene.reach;
    for (const body of this.bodies) {
      const node = robot.joints[body.node].object;
      if (body.com) {
        const dot = new THREE.Mesh(ball, new THREE.MeshBasicMaterial({ color: colour, depthTest: false }));
        dot.position.set(...body.com);
        dot.scale.setScalar(size);
        dot.renderOrder = 3;
        body.objects.push(dot);
      }
      if (body.semi_axes) {
        const skin = new THREE.MeshPhongMaterial(
          { color: colour, transparent: true, opacity: 0.35, depthWrite: false });
        const solid = new THREE.Mesh(ball, skin);
        solid.position.set(...body.com);
        solid.quaternion.set(...body.quaternion);
        solid.scale.set(...body.semi_axes.map((a) => Math.max(a, 1e-4)));
        solid.renderOrder = 1;
        body.objects.push(solid);
      }
      body.objects.forEach((object) => node.add(object));
    }
  }
  show(index, visible) {
    for (const object of this.bodies[index].objects) object.visible = visible;
    if (viewer) viewer.set_dirty();
  }
}

const masses = data.masses.map((set, k) => new Masses(set, COLOURS[k % COLOURS.length]));

// ---- torque arcs -----------------------------------------------------------------------------

const UNSURE = "#8a97a5"; // of an arc without a prediction
const RAMP = ["#2b83ba", "#ffffbf", "#d7191c"].map((c) => new THREE.Color(c));
function residualColour(share) { // 0 to 1
  const x = 2 * Math.min(Math.max(share, 0), 1);
  return x < 1 ? RAMP[0].clone().lerp(RAMP[1], x) : RAMP[1].clone().lerp(RAMP[2], x - 1);
}

class Arc { // around a joint's axis, or a bar along it; grows with the torque
  constructor(joint, radius, thickness, colour) {
    this.material = new THREE.MeshBasicMaterial(
      { color: colour, side: THREE.DoubleSide, depthTest: false, transparent: true });
    this.slides = joint.kind === "slide";
    this.around = 6;
    this.along = 72;
    const shape = this.slides
      ? new THREE.CylinderGeometry(thickness, thickness, 1, 12).translate(0, 0.5, 0).rotateX(Math.PI / 2)
      : this.ring(radius, thickness);
    this.mesh = new THREE.Mesh(shape, this.material);
    this.mesh.renderOrder = 2;
    this.length = 2 * radius;
    const holder = new THREE.Group();
    holder.quaternion.setFromUnitVectors(new THREE.Vector3(0, 0, 1), joint.axis);
    holder.add(this.mesh);
    joint.object.add(holder);
  }
  ring(radius, thickness) {
    const shape = new THREE.TorusGeometry(radius, thickness, this.around, this.along, FULL);
    const index = [], across = this.along + 1; // its triangles, in the order of the sweep
    for (let i = 0; i < this.along; i++) {
      for (let j = 0; j < this.around; j++) {
        const a = across * j + i, b = across * (j + 1) + i;
        index.push(a, b, a + 1, b, b + 1, a + 1);
      }
    }
    shape.setIndex(index);
    return shape;
  }
  show(share) { // of the largest torque, -1 to 1
    if (!Number.isFinite(share)) { this.mesh.visible = false; return; }
    this.mesh.visible = true;
    const size = Math.min(Math.abs(share), 1);
    if (this.slides) {
      this.mesh.scale.z = this.length * Math.max(size, 1e-3) * Math.sign(share || 1);
    } else {
      this.mesh.scale.y = share < 0 ? -1 : 1;
      this.mesh.geometry.setDrawRange(0, Math.max(1, Math.round(size * this.along)) * this.around * 6);
    }
  }
}

const count = torques ? torques.joints.length : 0;
const predictions = torques ? torques.labels.length - 1 : 0;
const largest = new Array(count).fill(0), meanSquare = new Array(count).fill(0);
function measureTorques() { // what an arc is drawn in proportion to
  let rows = 0;
  largest.fill(0);
  meanSquare.fill(0);
  for (const row of torqueTable.rows) {
    if (!Number.isFinite(row[0])) continue;
    rows++;
    for (let j = 0; j < count; j++) {
      largest[j] = Math.max(largest[j], Math.abs(row[j]));
      meanSquare[j] += row[j] ** 2;
    }
  }
  for (let j = 0; j < count; j++) meanSquare[j] = Math.sqrt(meanSquare[j] / Math.max(rows, 1));
}
const arcs = [];
if (torques && viewer) {
  const radius = Math.max(0.06 * data.scene.reach, 0.06 * data.view.radius);
  torques.joints.forEach(({ node }) => {
    const joint = robot.joints[node];
    arcs.push({
      measured: new Arc(joint, radius, 0.15 * radius, UNSURE),
      predicted: predictions ? new Arc(joint, 0.72 * radius, 0.07 * radius, "#1c2126") : null,
    });
  });
}
function showArcs(row) {
  arcs.forEach(({ measured, predicted }, j) => {
    measured.show(row[j] / (largest[j] || 1));
    if (!predicted) return;
    predicted.show(row[count + j] / (largest[j] || 1));
    const share = Math.abs(row[j] - row[count + j]) / (meanSquare[j] || 1);
    const colour = Number.isFinite(share) ? residualColour(share / POOR) : new THREE.Color(UNSURE);
    measured.material.color.copy(colour);
  });
}

// ---- plots -----------------------------------------------------------------------------------

const plots = [];
const style = getComputedStyle(document.documentElement);
const ink = () => style.getPropertyValue("--text").trim();
const rule = () => style.getPropertyValue("--line").trim();

function axis(extra) {
  return { stroke: ink, grid: { stroke: rule, width: 1 }, ticks: { stroke: rule, width: 1 },
    font: "11px system-ui, sans-serif", ...extra };
}

class Plot { // one chart: columns of a table over time, the clock's cursor, click to seek
  constructor(parent, { title, unit, series, columns, bands: filled }) {
    this.columns = columns;
    this.value = element("output");
    const heading = element("h3", {}, title, this.value);
    this.place = element("div", { role: "img", "aria-label": `${title} over time [${unit}]` });
    this.section = element("section", { class: "plot" }, heading, this.place);
    parent.append(this.section);
    this.series = series;
    this.unit = unit;
    this.chart = new uPlot({
      width: Math.max(this.place.clientWidth, 120), height: 118,
      cursor: { show: false }, legend: { show: false },
      scales: { x: { time: false, range: () => this.range() } },
      axes: [axis({ size: 24, space: 60 }), axis({ size: 46, space: 24 })],
      series: [{}, ...series], bands: filled, padding: [6, 8, 0, 0],
    }, this.columns(), this.place);
    this.cursor = element("div", { class: "cursor" });
    this.chart.over.append(this.cursor);
    const scrub = (event) => {
      const left = event.clientX - this.chart.over.getBoundingClientRect().left;
      pause();
      seek(this.chart.posToVal(left, "x"));
    };
    this.chart.over.addEventListener("pointerdown", (event) => {
      this.chart.over.setPointerCapture(event.pointerId);
      scrub(event);
    });
    this.chart.over.addEventListener("pointermove", (event) => event.buttons && scrub(event));
    new ResizeObserver(() => {
      if (this.place.clientWidth) this.chart.setSize({ width: this.place.clientWidth, height: 118 });
      this.move(clock.time);
    }).observe(this.place);
    plots.push(this);
  }
  range() {
    const end = clock.end || 1;
    return [data.live ? Math.max(0, end - 60) : 0, end];
  }
  refresh() {
    const { top, bottom } = this.place.getBoundingClientRect();
    if (!this.stale || bottom < 0 || top > innerHeight) return;
    this.stale = false;
    this.chart.setData(this.columns());
    this.move(clock.time);
  }
  move(time) {
    this.cursor.style.transform = `translateX(${this.chart.valToPos(time, "x")}px)`;
  }
  say(numbers) {
    const words = numbers.map((x) => (Number.isFinite(x) ? x.toPrecision(3) : "–"));
    this.value.textContent = `${words.join(" / ")} ${this.unit}`;
  }
  remove() {
    this.chart.destroy();
    this.section.remove();
    plots.splice(plots.indexOf(this), 1);
  }
}

function column(table, index) { // numbers for a chart; gaps in time stay gaps
  return table.rows.map((row) => (Number.isFinite(row[index]) ? row[index] : null));
}

const torquePlots = [];
function drawTorques() {
  const names = torques.labels.map((label, k) =>
    element("span", { class: "key", style: `--key: ${COLOURS[k % COLOURS.length]}` }, label));
  const section = element("section", {}, element("h2", {}, "Torque"), element("p", {}, ...names));
  byId("plots").append(section);
  torques.joints.forEach((joint, j) => {
    const plot = new Plot(section, {
      title: joint.name, unit: joint.unit,
      series: torques.labels.map((label, k) => ({ label, stroke: COLOURS[k % COLOURS.length],
        width: 1.25, points: { show: false } })),
      columns: () => [torqueTable.t, ...torques.labels.map((_, k) => column(torqueTable, k * count + j))],
    });
    torquePlots.push(plot);
  });
}

const bandPlots = [];
function drawBands() {
  const owners = [...new Set(bands.names.map((name) => name.replace(/\.[^.]*$/, "")))];
  const choice = element("select", { id: "owner" }, ...owners.map((o) => element("option", {}, o)));
  const label = element("label", {}, "of ", choice);
  const section = element("section", {}, element("h2", {}, "Parameters"),
    element("p", {}, label, " with two standard errors"));
  byId("plots").append(section);
  const width = bands.names.length;
  const draw = () => {
    while (bandPlots.length) bandPlots.pop().remove();
    bands.names.forEach((name, i) => {
      if (name.replace(/\.[^.]*$/, "") !== choice.value) return;
      const error = (k) => bandTable.rows.map((row) => row[i] + k * row[width + i]);
      bandPlots.push(new Plot(section, {
        title: name, unit: bands.units[i],
        series: [{ width: 0, points: { show: false } }, { width: 0, points: { show: false } },
          { label: name, stroke: COLOURS[1], width: 1.5, points: { show: false } }],
        columns: () => [bandTable.t, error(2), error(-2), column(bandTable, i)],
        bands: [{ series: [1, 2], fill: "rgba(224, 103, 31, 0.22)" }],
      }));
      bandPlots[bandPlots.length - 1].index = i;
    });
  };
  choice.onchange = draw;
  draw();
}

// ---- the clock -------------------------------------------------------------------------------

const clock = { time: 0, playing: !matchMedia("(prefers-reduced-motion: reduce)").matches,
  speed: 1, loop: true, follow: Boolean(data.live), end: 0, frames: 0, at: 0 };
clock.end = Math.max(motion.end, ghostMotion ? ghostMotion.end : 0);
const slider = byId("time"), clockText = byId("clock"), playButton = byId("play");
let shown = null, told = null, spoken = -1;

function show() { // the robot in every frame, the page about it ten times a second
  if (shown !== clock.time) showRobot(clock.time);
  shown = clock.time;
  const now = performance.now();
  if (told && (told.time === clock.time || (clock.playing && now - told.at < 100))) return;
  told = { time: clock.time, at: now };
  showReadings(clock.time);
}

function showRobot(time) {
  if (!viewer) return;
  if (motion.rows.length) robot.pose(motion.at(time));
  if (ghost) ghost.pose(ghostMotion.at(time));
  if (arcs.length && torqueTable.rows.length) showArcs(torqueTable.at(time));
  viewer.set_dirty();
}

function showReadings(time) {
  if (torqueTable && torqueTable.rows.length) {
    const row = torqueTable.rows[torqueTable.before(time)];
    torquePlots.forEach((plot, j) => plot.say(torques.labels.map((_, k) => row[k * count + j])));
  }
  if (bandTable && bandTable.rows.length) {
    const row = bandTable.rows[bandTable.before(time)];
    bandPlots.forEach((plot) => plot.say([row[plot.index]]));
  }
  plots.forEach((plot) => plot.move(time));
  slider.value = time;
  clockText.textContent = `${time.toFixed(2)} / ${clock.end.toFixed(2)} s`;
  if (Math.abs(time - spoken) > 1 || !clock.playing) { // a screen reader hears it once a second
    spoken = time;
    slider.setAttribute("aria-valuetext", `${time.toFixed(1)} of ${clock.end.toFixed(1)} seconds`);
  }
}

function seek(time) {
  clock.follow = false;
  clock.time = Math.min(Math.max(time, 0), clock.end);
  told = null;
  buttons();
  show();
}
function play() {
  if (clock.time >= clock.end) clock.time = 0;
  clock.playing = true;
  buttons();
}
function pause() { clock.playing = false; clock.follow = false; told = null; buttons(); }
function toggle() { if (clock.playing) pause(); else play(); }
function buttons() {
  playButton.textContent = clock.playing ? "Pause" : "Play";
  byId("live").setAttribute("aria-pressed", clock.follow);
}

const pace = { mean: 0, frames: 0, pixels: 1 }; // of the last frames [s]; share of the pixels' width
function spare(passed) { // a slow processor draws fewer pixels rather than fewer frames
  pace.mean += (Math.min(passed, 0.5) - pace.mean) / Math.min(++pace.frames, 15);
  if (pace.frames < 15 || pace.mean < SLOW || pace.pixels <= COARSEST) return;
  pace.pixels = Math.max(0.8 * pace.pixels, COARSEST);
  pace.frames = 0;
  viewer.renderer.setPixelRatio(pace.pixels * fullRatio);
  viewer.set_3d_pane_size();
}

let last = null;
function tick(now) {
  const passed = last === null ? 0 : (now - last) / 1000;
  last = now;
  clock.at = now;
  clock.frames++;
  if (clock.playing && viewer && onProcessor) spare(passed);
  if (clock.follow) clock.time = clock.end;
  else if (clock.playing && clock.end > 0) {
    clock.time += passed * clock.speed;
    if (clock.time > clock.end) {
      clock.time = clock.loop ? clock.time % clock.end : clock.end;
      if (!clock.loop) pause();
    }
  }
  show();
  requestAnimationFrame(tick);
}

// ---- controls --------------------------------------------------------------------------------

playButton.onclick = toggle;
slider.oninput = () => { pause(); seek(Number(slider.value)); };
byId("speed").onchange = (event) => { clock.speed = Number(event.target.value); };
byId("loop").onchange = (event) => { clock.loop = event.target.checked; };
byId("live").onclick = () => { clock.follow = true; buttons(); };
byId("live").hidden = !data.live;

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  const at = event.target, isTime = at === slider;
  const own = !isTime && at.closest("button, input, select, summary, a");
  const step = event.shiftKey ? 1 / 30 : 1;
  const acts = { " ": toggle, ArrowLeft: () => seek(clock.time - step),
    ArrowRight: () => seek(clock.time + step), Home: () => seek(0), End: () => seek(clock.end) };
  if (!(event.key in acts) || (own && (event.key === " " || at.matches("select")))) return;
  event.preventDefault();
  acts[event.key]();
});

function addMark({ t, label, kind }) {
  const place = byId("marks");
  const button = element("button", { type: "button", class: kind }, `${t.toFixed(2)} s: ${label}`);
  button.onclick = () => { pause(); seek(t); };
  place.append(element("li", {}, button));
  place.hidden = false;
  const tick = element("span", { class: `mark ${kind}`, title: label });
  tick.dataset.time = t;
  byId("track").append(tick);
  placeMarks();
}
function placeMarks() {
  for (const tick of byId("track").querySelectorAll(".mark"))
    tick.style.left = `${(100 * tick.dataset.time) / (clock.end || 1)}%`;
}

function box(label, checked, act) {
  const input = element("input", { type: "checkbox" });
  input.checked = checked;
  input.onchange = () => { act(input.checked); if (viewer) viewer.set_dirty(); };
  if (checked !== undefined) act(checked);
  return { input, label: element("label", {}, input, ` ${label}`) };
}

function drawSwitches() {
  const place = byId("switches");
  const fade = (on) => robot && robot.fade(on ? 0.35 : 1);
  place.append(box("see through the robot", masses.length > 0, fade).label);
  if (arcs.length) {
    const each = (on) => arcs.flatMap((a) => [a.measured, a.predicted]).filter(Boolean)
      .forEach((arc) => { arc.mesh.parent.visible = on; });
    place.append(box("torque arcs", true, each).label);
  }
  if (ghost) place.append(box(`ghost: ${data.ghost.label}`, true,
    (on) => { ghost.root.visible = on; }).label);
  place.append(box(`grid of ${data.view.cell} m`, true,
    (on) => viewer && viewer.set_property(["Grid"], "visible", on)).label);
  byId("residuals").hidden = !predictions;
  if (masses.length) place.after(massTable());
}

function massTable() {
  const head = element("tr", {}, element("th", { scope: "col" }, "centre of mass, ellipsoid"));
  const rows = masses[0].bodies.map((body) =>
    element("tr", {}, element("th", { scope: "row" }, body.name)));
  masses.forEach((set, k) => {
    const label = data.masses[k].label;
    const boxes = set.bodies.map((body, i) => {
      const text = body.fault ? body.fault : `${body.mass.toPrecision(3)} kg`;
      const made = box(text, true, (on) => set.show(i, on));
      made.input.setAttribute("aria-label", `${label}: ${body.name}, ${text}`);
      rows[i].append(element("td", {}, made.label));
      return made.input;
    });
    const all = box(label, true, (on) => boxes.forEach((input) => {
      input.checked = on;
      input.onchange();
    }));
    all.label.style.setProperty("--key", set.colour);
    all.label.classList.add("key");
    head.append(element("th", { scope: "col" }, all.label));
  });
  const table = element("table", {}, element("thead", {}, head), element("tbody", {}, ...rows));
  return element("div", { class: "scroll", tabindex: 0, role: "region",
    "aria-label": "masses of the links" }, table);
}

// ---- camera ----------------------------------------------------------------------------------

function aim() { // the viewer's camera has y upwards: (x, y, z) of the robot is (x, z, -y) there
  const [x, y, z] = data.view.centre, camera = viewer.camera, half = (20 * Math.PI) / 180;
  const aspect = pane.clientWidth / Math.max(pane.clientHeight, 1);
  const narrow = Math.min(half, Math.atan(Math.tan(half) * aspect));
  const far = (0.9 * data.view.radius) / Math.sin(narrow); // corners of the sphere stay empty
  camera.fov = 40;
  camera.near = far / 200;
  camera.far = 200 * far;
  camera.position.set(x + 0.76 * far, z + 0.36 * far, -y + 0.54 * far);
  viewer.controls.target.set(x, z, -y);
  viewer.controls.update();
  viewer.set_dirty();
}

if (viewer) {
  viewer.gui.domElement.remove(); // the switches of this page are named and reached by keyboard
  viewer.renderer.domElement.setAttribute("aria-hidden", "true"); // the pane has the label
  const size = viewer.set_3d_pane_size.bind(viewer);
  viewer.set_3d_pane_size = () => size(pane.clientWidth, pane.clientHeight);
  viewer.set_property(["Background"], "top_color", [0.93, 0.95, 0.97]);
  viewer.set_property(["Background"], "bottom_color", [0.72, 0.77, 0.82]);
  const scale = data.view.cell / 0.5; // the viewer's own grid has cells of 0.5 m
  viewer.set_property(["Grid"], "scale", [scale, scale, scale]);
  viewer.set_property(["Grid"], "position", data.view.grid);
  viewer.set_property(["Axes"], "scale", [scale, scale, scale]);
  new ResizeObserver(() => viewer.set_3d_pane_size()).observe(pane);
  aim();
  byId("view").onclick = aim;
}

// ---- live ------------------------------------------------------------------------------------

let news = false;
function take(message) {
  if (message.mark) addMark(message.mark);
  if (message.t === undefined) return;
  motion.push(message.t, message.q);
  if (message.tau) { // these lie a filter's delay behind the motion
    torqueTable.push(message.at, [...message.tau, ...message.predicted]);
    bandTable.push(message.at, [...message.theta, ...message.std_error]);
  }
  clock.end = motion.end;
  slider.max = clock.end;
  news = true;
}

function refresh() { // the charts of a live page that are in sight, a few times a second
  if (news) {
    measureTorques();
    placeMarks();
    plots.forEach((plot) => { plot.stale = true; });
  }
  news = false;
  plots.forEach((plot) => plot.refresh());
}

function listen() {
  const source = new EventSource("events");
  const state = (text) => { byId("state").textContent = text; };
  source.onopen = () => state("live");
  source.onmessage = (event) => JSON.parse(event.data).forEach(take);
  source.addEventListener("end", () => {
    source.close();
    refresh();
    if (clock.follow) clock.time = clock.end;
    show();
    state("the tracker has finished");
  });
  source.onerror = () => state("no connection to the tracker");
  setInterval(refresh, 250);
}

// ---- start -----------------------------------------------------------------------------------

slider.max = clock.end;
if (torques) { measureTorques(); drawTorques(); }
if (bands) drawBands();
byId("side").hidden = false;
drawSwitches();
data.marks.forEach(addMark);
if (data.live) listen();
buttons();
show();
requestAnimationFrame(tick);

// for scripts and notebooks: the clock, and the world pose of every node as 16 numbers by columns
window.replay = { clock, seek, play, pause, viewer, plots, motion,
  poses: (which = robot) => {
    which.root.updateMatrixWorld(true);
    const inverse = viewer.scene.matrixWorld.clone().invert();
    return which.joints.map(({ object }) =>
      inverse.clone().multiply(object.matrixWorld).toArray());
  },
  ghost, robot };
})();
