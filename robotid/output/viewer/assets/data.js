// The data of the page, and tables of numbers.
const data = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const COLOURS = ["#2f7ed8", "#e0671f", "#3a9d5d", "#a855c7", "#b58900", "#c2366b"];

function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

function unpack({ kind, shape, data: text, low, step }) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  if (kind === "<f4") return new Float32Array(bytes.buffer);
  const codes = kind === "<u2" ? new Uint16Array(bytes.buffer) : new Uint32Array(bytes.buffer);
  const width = shape[1];
  return !step ? codes : Float32Array.from(codes, (code, i) => // in steps of their column
    (code === 65535 ? NaN : low[i % width] + step[i % width] * code));
}

class Table { // times of the log and rows of numbers; in the page times are from the start
  constructor(t, values) {
    this.t = t ? Array.from(unpack(t), (x) => data.start + x) : [];
    const flat = values ? unpack(values) : [];
    const width = values ? values.shape[1] : 0;
    this.rows = this.t.map((_, k) => Array.from(flat.subarray(k * width, (k + 1) * width)));
  }
  get end() { return this.t.length ? this.t[this.t.length - 1] : data.start; }
  before(time) { // the last row not after a time; 0 if all are after it
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
}

const motion = new Table(data.motion.t, data.motion.q);
const ghostMotions = data.ghosts.map(({ t, q }) => new Table(t, q));
const torques = data.torques;
// one row: measured of every joint, then each prediction of every joint
const torqueTable = torques ? new Table(torques.t, torques.values) : null;
const count = torques ? torques.joints.length : 0;
const isTorque = torques && torques.quantity === "torque"; // else positions, which have no arcs
const predictions = torques ? torques.labels.length - 1 : 0;
let chosen = 0; // the prediction that arcs, links, heat strip and residuals show
const predictedOf = (row, j) => row[(1 + chosen) * count + j];
const bands = data.bands;
const bandTable = bands ? new Table(bands.t, bands.values) : null; // values, then standard errors

// ---- residuals: one scale of colour for arcs, links and the heat strip ------------------------

const style = getComputedStyle(document.documentElement);
const tone = (name) => style.getPropertyValue(`--${name}`).trim();
const UNSURE = "#8a97a5"; // without prediction
const RAMP = [[43, 131, 186], [255, 255, 191], [215, 25, 28]]; // at 0, a half and 1
function residualColour(share) { // 0 to 1; grey for NaN
  if (!Number.isFinite(share)) return UNSURE;
  const x = 2 * Math.min(Math.max(share, 0), 1), k = x < 1 ? 0 : 1;
  return `rgb(${RAMP[k].map((c, i) => Math.round(c + (x - k) * (RAMP[k + 1][i] - c)))})`;
}

const scale = torques ? torques.scale : null;
const largest = new Array(count).fill(0); // [N m or N] torque of a full arc
for (const row of torques ? torqueTable.rows : [])
  for (let j = 0; j < count; j++) largest[j] = Math.max(largest[j], Math.abs(row[j]) || 0);
const residualShare = (row, j) => // 1 is full red; NaN without a prediction
  predictions ? Math.abs(row[j] - predictedOf(row, j)) / scale.of[j] / scale.full : NaN;
