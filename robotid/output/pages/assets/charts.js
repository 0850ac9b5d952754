"use strict";
// Charts of the pages. uPlot draws axes and lines; this draws what is below them, and has the cursor,
// the legend, and links: charts of one link share cursor and zoom.
window.charts = (() => {
const BAND = 0.2, AREA = 0.7, FAINT = 0.5, GROUND = 0.09; // opacities
const MARGIN = 300; // [px] about the window in which charts count as in sight
const CLOSER = 0.5; // zoom factor of a key
const HINT = "Arrow keys move the cursor, plus and minus zoom, Escape shows all, digits hide lines.";
const STEPS = Array.from({ length: 24 }, (_, k) => [1, 2, 5].map((x) => x * 10 ** (k - 12))).flat();
const all = [];
const idle = (act) => { // a busy browser is idle at last
  if (window.requestIdleCallback) requestIdleCallback(act, { timeout: 300 }); else setTimeout(act, 30);
};

function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

// ---- colours and numbers ---------------------------------------------------------------------

const tones = new Map();
function tone(name) {
  if (!tones.has(name)) {
    const style = getComputedStyle(document.documentElement);
    tones.set(name, style.getPropertyValue(`--${name}`).trim());
  }
  return tones.get(name);
}

matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  tones.clear();
  for (const chart of all) {
    const redraw = () => chart.plot && chart.plot.redraw(false);
    if (chart.link.seen.has(chart)) redraw(); else idle(redraw);
  }
});

function words(x, digits = 4) {
  if (!Number.isFinite(x)) return "–";
  const isSmall = x !== 0 && Math.abs(x) < 1e-3; // a long number would move its neighbours
  const text = isSmall ? Number(x.toPrecision(3)).toExponential() : String(Number(x.toPrecision(digits)));
  return text.replaceAll("-", "−");
}

function powers(low, high) { // ticks of a logarithmic axis
  const first = Math.floor(Math.log10(low)), last = Math.ceil(Math.log10(high));
  const steps = Math.log10(high / low) < 1.5 ? [1, 2, 5] : [1];
  const every = Array.from({ length: last - first + 1 }, (_, k) => first + k);
  const ticks = every.flatMap((power) => steps.map((step) => step * 10 ** power));
  return ticks.filter((tick) => tick >= low && tick <= high);
}

function steady(x, span) { // a number of an axis, with the digits that its span needs
  const digits = Math.min(Math.max(Math.ceil(4 - Math.log10(span || 1)), 0), 9);
  return x.toFixed(digits).replaceAll("-", "−");
}

function tickWords(_, ticks) { // with as many digits as their step needs
  const step = ticks.length > 1 ? ticks[1] - ticks[0] : 1;
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  return ticks.map((tick) => (tick + 0).toFixed(digits).replaceAll("-", "−"));
}

function unpack({ kind, data, low, step, log }) { // numbers in steps from the lowest
  const bytes = Uint8Array.from(atob(data), (c) => c.charCodeAt(0));
  const codes = kind === "<u4" ? new Uint32Array(bytes.buffer) : new Uint16Array(bytes.buffer);
  const last = 2 ** (8 * codes.BYTES_PER_ELEMENT) - 1; // which is no number
  return Float64Array.from(codes, (code) => {
    const value = code === last ? NaN : low + code * step;
    return log ? 10 ** value : value;
  });
}

// ---- links -----------------------------------------------------------------------------------

class Link { // a cursor and a range of x that charts share
  constructor() {
    this.time = NaN; // the set position: a clock, a click or a key
    this.shown = NaN; // its position: under the pointer, or the set one
    this.range = null; // zoomed to, or null
    this.whole = null; // range without zoom; each chart's own x if null
    this.seen = new Set(); // charts in sight
    this.listeners = new Set();
  }
  set(x, how = "set") { // how: "set", "hover", "click", "key"
    if (how !== "hover") this.time = x;
    this.shown = x;
    for (const chart of this.seen) chart.move();
    clearTimeout(this.rest); // the others when the cursor rests: after Pause, a click, a key
    this.rest = setTimeout(() => { for (const chart of all) if (chart.link === this) chart.move(); }, 200);
    for (const listener of this.listeners) listener(x, how);
  }
  leave() { this.set(this.time, "hover"); }
  zoom(range) {
    this.range = range;
    for (const chart of this.seen) chart.scale();
  }
  on(listener) {
    this.listeners.add(listener);
    return () => this.listeners.delete(listener);
  }
}

const links = new Map();
function link(name) {
  if (!name) return new Link();
  if (!links.has(name)) links.set(name, new Link());
  return links.get(name);
}

// ---- a chart ---------------------------------------------------------------------------------

const sight = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) {
    const chart = all.find((one) => one.place === target);
    if (chart) chart.see(isIntersecting);
  }
}, { rootMargin: `${MARGIN}px` });

class Chart { // what: as charts.py says; x, y and half are arrays, NaN where there is no number
  constructor(parent, what, shared = null) {
    this.what = what;
    this.shared = shared; // the legend of several charts; its values are those of the last one pointed at
    this.buttons = [];
    this.link = link(what.link);
    this.hidden = new Set(what.series.flatMap((series, i) => (series.is_hidden ? [i] : [])));
    this.below = what.x_label ? 56 : 36; // [px] that the x axis takes
    this.plot = null;
    this.index = -1; // row under the cursor
    this.keys = element("div", { class: "keys" }, element("span", {}, what.y_label));
    this.at = element("b", { class: "at" });
    this.values = what.series.map((series, i) => this.key(series, i));
    this.unit = (/\[(.*)\]/.exec(what.x_label) || ["", ""])[1];
    this.keys.append(this.at);
    this.whole = element("button", { type: "button", class: "whole", hidden: "" }, "Show all");
    this.whole.onclick = () => { this.link.zoom(null); this.place.focus(); };
    this.keys.append(this.whole);
    this.place = element("div", { class: "place", tabindex: 0, role: "slider",
      "aria-label": what.title, "aria-description": HINT });
    this.place.style.height = `${what.height + this.below}px`;
    this.place.onkeydown = (event) => this.press(event);
    this.live = element("div", { class: "explore" }, this.keys, this.place);
    parent.append(this.live);
    this.setData(what.x, what.series.map((s) => s.y), what.series.map((s) => s.half));
    this.move(); // no cursor yet
    all.push(this);
    sight.observe(this.place);
    this.resized = new ResizeObserver(() => this.fit());
    this.resized.observe(this.place);
  }

  key(series, i) { // the legend's button of a series; it hides and shows it
    const known = this.shared && this.shared.get(series.label);
    if (known) {
      this.buttons.push(known.button);
      known.charts.push([this, i]);
      return known.value;
    }
    const charts = [[this, i]];
    const swatch = element("i", { style: `--key: var(--${series.tone})` });
    const value = element("b");
    const button = element("button",
      { type: "button", tabindex: -1, "aria-pressed": !this.hidden.has(i) }, swatch, series.label, value);
    button.onclick = () => { for (const [chart, k] of charts) chart.toggle(k); };
    this.buttons.push(button);
    (this.shared ? this.shared.keys : this.keys).append(button);
    if (this.shared) this.shared.set(series.label, { button, value, charts });
    if (series.half) value.className = "wide";
    return value;
  }

  toggle(i) {
    if (!this.hidden.delete(i)) this.hidden.add(i);
    this.buttons[i].setAttribute("aria-pressed", !this.hidden.has(i));
    this.stack();
    if (this.plot) this.plot.setSeries(i + 1, { show: !this.hidden.has(i) });
  }

  setData(x, ys, halves = []) { // x increases; one y of each series, and its half width if it has one
    this.x = x;
    this.ys = ys;
    this.halves = halves;
    this.place.setAttribute("aria-valuemin", x.length ? x[0] : 0);
    this.place.setAttribute("aria-valuemax", x.length ? x[x.length - 1] : 1);
    this.stack();
    if (!this.plot) return;
    this.plot.setData(this.columns(), false);
    this.scale();
  }

  columns() {
    const log = this.what.logarithmic.includes("y");
    const plain = (y) => (Number.isFinite(y) && !(log && y <= 0) ? y : null);
    return [Array.from(this.x), ...this.ys.map((y) => Array.from(y, plain))];
  }

  stack() { // lower and upper edges of what each series covers: of an area, above and below zero
    const size = this.x.length;
    let up = new Float64Array(size), down = new Float64Array(size);
    this.covers = this.what.series.map(({ kind }, i) => {
      const y = this.ys[i], half = this.halves[i];
      const low = new Float64Array(size), high = new Float64Array(size);
      for (let k = 0; k < size; k += 1) {
        const margin = half && Number.isFinite(half[k]) ? half[k] : 0;
        [low[k], high[k]] = [y[k] - margin, y[k] + margin];
        if (kind === "area") {
          [low[k], high[k]] = [down[k] + Math.min(0, y[k] || 0), up[k] + Math.max(0, y[k] || 0)];
        }
      }
      if (kind !== "area") return [[low, high]];
      const cover = [[up, high], [low, down]];
      if (!this.hidden.has(i)) [up, down] = [high, low];
      return cover;
    });
  }

  // ---- what is in sight ----

  window() { // the visible range of x
    if (this.link.range) return this.link.range;
    if (this.link.whole) return this.link.whole;
    const first = this.x[0], last = this.x[this.x.length - 1];
    if (first === last) return [first - 0.5, last + 0.5];
    return this.x.length ? [first, last] : [0, 1];
  }

  extent() { // of y in the window
    const [from, to] = this.window(), log = this.what.logarithmic.includes("y");
    let low = Infinity, high = -Infinity;
    this.covers.forEach((cover, i) => {
      if (this.hidden.has(i)) return;
      for (const [bottom, top] of cover) {
        for (let k = this.near(from); k < bottom.length && this.x[k] <= to; k += 1) {
          if (bottom[k] < low && !(log && bottom[k] <= 0)) low = bottom[k];
          if (top[k] > high) high = top[k];
        }
      }
    });
    if (!(low <= high)) return log ? [0.1, 1] : [0, 1];
    if (log) return [low / 1.2, high * 1.2];
    const room = 0.04 * (high - low || 2 * Math.abs(low) || 2);
    return [low - room, high + room];
  }

  near(x) { // the row whose x is nearest
    let low = 0, high = this.x.length - 1;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.x[middle] < x) low = middle + 1; else high = middle;
    }
    return low > 0 && x - this.x[low - 1] < this.x[low] - x ? low - 1 : low;
  }

  see(isSeen) {
    if (!isSeen) { this.link.seen.delete(this); return; }
    this.link.seen.add(this);
    if (!this.plot) this.draw();
    this.scale();
    this.move();
  }

  fit() {
    const width = this.place.clientWidth;
    if (this.plot && width && width !== this.plot.width) {
      this.plot.setSize({ width, height: this.plot.height });
      this.move();
    }
  }

  scale() {
    const [min, max] = this.window();
    this.whole.hidden = !this.link.range;
    this.at.style.minWidth = `${Math.max(...[min, max].map((x) => this.where(x).length))}ch`;
    if (!this.plot) return;
    this.plot.setScale("x", { min, max });
    this.move();
  }

  // ---- drawing ----

  draw() {
    const { series, logarithmic, height, x_label: name } = this.what;
    const distribution = (axis) => (logarithmic.includes(axis) ? 3 : 1);
    const axis = (extra) => ({ stroke: () => tone("text"), font: "11px system-ui, sans-serif",
      grid: { stroke: () => tone("line"), width: 1 }, values: tickWords, incrs: STEPS,
      ticks: { stroke: () => tone("line"), width: 1, size: 6 }, ...extra });
    const decades = (is) => (logarithmic.includes(is) ? { filter: (_, splits) => splits,
      splits: (u, i, low, high) => powers(low, high),
      values: (_, splits) => splits.map((v) => words(v)) } : {});
    this.plot = new uPlot({
      width: Math.max(this.place.clientWidth, 120), height: height + this.below, padding: [8, 10, 0, 0],
      legend: { show: false },
      cursor: { x: false, y: false, points: { show: false },
        drag: { x: true, y: false, setScale: false, dist: 4 },
        bind: { dblclick: () => () => this.link.zoom(null) } },
      scales: { x: { time: false, distr: distribution("x"), range: () => this.window() },
        y: { distr: distribution("y"), range: () => this.extent() } },
      axes: [axis({ size: 28, label: name || null, labelSize: name ? 20 : 0, labelGap: 2,
        space: (u, i, low, high) => 36 + 7 * String(Math.trunc(high)).length,
        labelFont: "11px system-ui, sans-serif", ...decades("x") }),
      // at least two labels: steps of ticks differ by at most 2.5, and a range is twice as long as its half
      axis({ size: 54, space: Math.min(22, height / 5.5), ...decades("y") })],
      series: [{}, ...series.map(({ tone: colour, kind, is_weak: weak }, i) => ({ show: !this.hidden.has(i),
        stroke: () => tone(colour), width: 1.3, alpha: weak ? FAINT : 1, points: { show: false },
        ...(kind === "line" ? {} : { paths: () => null }) }))],
      hooks: { draw: [() => this.move()], drawAxes: [(u) => this.paint(u)], setSelect: [(u) => this.select(u)] },
    }, this.columns(), this.place);
    this.cursor = element("div", { class: "line", hidden: "" });
    this.plot.over.append(this.cursor);
    this.listen(this.plot.over);
  }

  paint(u) { // what is under the lines
    const { ctx, bbox } = u, ratio = devicePixelRatio;
    const X = (v) => u.valToPos(v, "x", true), Y = (v) => u.valToPos(v, "y", true);
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    ctx.fillStyle = ctx.strokeStyle = tone("text");
    ctx.globalAlpha = GROUND;
    for (const [start, end] of this.what.spans || []) {
      ctx.fillRect(X(start), bbox.top, Math.max(X(end) - X(start), ratio / 2), bbox.height);
    }
    ctx.globalAlpha = 0.6;
    ctx.lineWidth = ratio;
    ctx.beginPath();
    if (!this.what.logarithmic.includes("y")) {
      ctx.moveTo(bbox.left, Y(0));
      ctx.lineTo(bbox.left + bbox.width, Y(0));
    }
    ctx.stroke();
    ctx.setLineDash([ratio, 3 * ratio]);
    ctx.beginPath();
    for (const mark of this.what.marks || []) {
      ctx.moveTo(X(mark), bbox.top);
      ctx.lineTo(X(mark), bbox.top + bbox.height);
    }
    ctx.stroke();
    ctx.setLineDash([]);
    this.what.series.forEach((series, i) => {
      if (this.hidden.has(i)) return;
      ctx.fillStyle = ctx.strokeStyle = tone(series.tone);
      const opacity = series.is_weak ? FAINT : 1;
      ctx.globalAlpha = opacity;
      if (series.kind === "dots") this.dots(ctx, this.ys[i], X, Y, ratio);
      if (series.kind === "area" || (series.kind === "line" && this.halves[i])) {
        ctx.globalAlpha = opacity * (series.kind === "area" ? AREA : BAND);
        for (const edges of this.covers[i]) this.band(ctx, this.ys[i], edges, X, Y);
      }
    });
    ctx.restore();
  }

  band(ctx, y, [low, high], X, Y) {
    const close = (from, to) => {
      ctx.beginPath();
      for (let k = from; k < to; k += 1) ctx.lineTo(X(this.x[k]), Y(high[k]));
      for (let k = to - 1; k >= from; k -= 1) ctx.lineTo(X(this.x[k]), Y(low[k]));
      ctx.fill();
    };
    let from = 0;
    for (let k = 0; k <= y.length; k += 1) {
      if (k < y.length && Number.isFinite(y[k])) continue;
      if (k > from) close(from, k);
      from = k + 1;
    }
  }

  dots(ctx, y, X, Y, ratio) {
    ctx.beginPath();
    y.forEach((v, k) => {
      if (!Number.isFinite(v)) return;
      ctx.moveTo(X(this.x[k]), Y(v));
      ctx.arc(X(this.x[k]), Y(v), 1.7 * ratio, 0, 2 * Math.PI);
    });
    ctx.fill();
  }

  // ---- cursor and zoom ----

  move() { // the cursor to where the link shows it
    const x = this.link.shown, shown = Number.isFinite(x) && this.x.length > 0;
    this.index = shown ? this.near(x) : -1;
    this.at.textContent = shown ? this.where(this.x[this.index]) : "";
    const values = this.what.series.map((_, i) => (shown ? this.value(i) : ""));
    if (!this.shared || this.shared.reader === this)
      this.values.forEach((value, i) => { value.textContent = values[i]; });
    const readings = this.what.series.map((s, i) => `${s.label} ${values[i]}`);
    this.place.setAttribute("aria-valuenow", shown ? this.x[this.index] : 0);
    this.place.setAttribute("aria-valuetext",
      shown ? `${this.at.textContent}: ${readings.join(", ")}` : "no cursor");
    if (!this.cursor) return;
    const [from, to] = this.window();
    this.cursor.hidden = !(shown && x >= from && x <= to);
    if (!this.cursor.hidden) {
      this.cursor.style.transform = `translateX(${this.plot.valToPos(x, "x")}px)`;
    }
  }

  value(i) { // of a series under the cursor, with half the width of its band
    const y = this.ys[i][this.index], half = this.halves[i] && this.halves[i][this.index];
    return `${words(y)}${Number.isFinite(y) && Number.isFinite(half) ? ` ± ${words(half, 2)}` : ""}`;
  }

  where(x) { // an x as text
    const { logarithmic } = this.what;
    const [from, to] = this.window();
    return `${logarithmic.includes("x") ? words(x) : steady(x, to - from)} ${this.unit}`;
  }

  read() { // the shared legend has the values of this chart
    if (!this.shared || this.shared.reader === this) return;
    this.shared.reader = this;
    for (const { value } of this.shared.values()) value.textContent = "";
  }

  under(event) { // x of the row nearest to the pointer
    this.read();
    const left = event.clientX - this.plot.over.getBoundingClientRect().left;
    return this.x[this.near(this.plot.posToVal(left, "x"))];
  }

  listen(over) {
    over.addEventListener("pointermove", (event) => this.link.set(this.under(event), "hover"));
    over.addEventListener("pointerleave", () => this.link.leave());
    over.addEventListener("click", (event) => this.link.set(this.under(event), "click"));
  }

  select(u) {
    const { left, width } = u.select;
    if (!width) return;
    u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    this.link.zoom([u.posToVal(left, "x"), u.posToVal(left + width, "x")]);
  }

  press(event) {
    const { key, shiftKey } = event;
    if (event.ctrlKey || event.altKey || event.metaKey || !this.x.length) return;
    this.read();
    const [from, to] = this.window(), log = this.what.logarithmic.includes("x");
    const centre = this.index >= 0 ? this.x[this.index] : (from + to) / 2;
    const step = (shiftKey ? 10 : 1) * (key === "ArrowLeft" ? -1 : 1);
    const last = this.x.length - 1, share = key === "-" ? 1 / CLOSER : CLOSER;
    if (key === "ArrowLeft" || key === "ArrowRight") {
      const row = this.index < 0 ? this.near(centre) : this.index + step;
      this.link.set(this.x[Math.min(Math.max(row, 0), last)], "key");
    } else if ("+=-".includes(key) && !log) {
      const low = centre + share * (from - centre), high = centre + share * (to - centre);
      const isAll = low <= this.x[0] && high >= this.x[last];
      this.link.zoom(isAll ? null : [Math.max(low, this.x[0]), Math.min(high, this.x[last])]);
    } else if (key === "Escape" || key === "0") {
      this.link.zoom(null);
      this.link.set(NaN, "key");
    } else if (key >= "1" && key <= "9" && key <= this.what.series.length) {
      this.buttons[Number(key) - 1].click();
    } else return;
    event.preventDefault();
    event.stopPropagation();
  }

  remove() {
    sight.unobserve(this.place);
    this.resized.disconnect();
    this.link.seen.delete(this);
    all.splice(all.indexOf(this), 1);
    if (this.plot) this.plot.destroy();
    this.live.remove();
  }
}

// ---- the charts of the page -------------------------------------------------------

const legends = new Map();
function legend(plots) { // one legend above all charts of a group
  if (!plots || legends.has(plots)) return legends.get(plots);
  const keys = element("div", { class: "keys" }), shared = Object.assign(new Map(), { keys, reader: null });
  plots.before(element("div", { class: "explore shared" }, keys));
  legends.set(plots, shared);
  return shared;
}

for (const figure of document.querySelectorAll("figure.chart")) {
  const what = JSON.parse(figure.querySelector("script").textContent);
  what.x = unpack(what.x);
  for (const series of what.series) {
    series.y = unpack(series.y);
    series.half = series.half && unpack(series.half);
  }
  new Chart(figure, what, legend(figure.closest(".plots")));
}

// charts in sight are drawn with the page; one layout gives all places
const unfolded = all.filter((chart) => !chart.live.closest("details:not([open])"));
const tops = unfolded.map((chart) => chart.place.getBoundingClientRect().top);
unfolded.forEach((chart, k) => { if (tops[k] < innerHeight + MARGIN) chart.see(true); });

// charts out of sight are drawn when the browser is idle, one at a time; folded ones wait
function drawNext() {
  const next = all.find((chart) => !chart.plot && !chart.live.closest("details:not([open])"));
  if (!next) return;
  next.draw();
  idle(drawNext);
}
idle(drawNext);
document.addEventListener("toggle", () => idle(drawNext), true);

function print(isPrinted) { // all charts, in the colours of paper
  document.documentElement.classList.toggle("printing", isPrinted);
  tones.clear();
  for (const chart of all) if (chart.plot) chart.plot.redraw(false); else chart.draw();
}
addEventListener("beforeprint", () => print(true));
addEventListener("afterprint", () => print(false));

return { link, Chart, all };
})();
