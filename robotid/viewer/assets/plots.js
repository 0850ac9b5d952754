
// ---- plots -----------------------------------------------------------------------------------

const plots = [];
const style = getComputedStyle(document.documentElement);
const tone = (name) => style.getPropertyValue(`--${name}`).trim();
const ink = () => tone("text");
const rule = () => tone("line");

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
    const end = Math.max(clock.end, clock.start + 1e-3);
    return [data.live ? Math.max(clock.start, end - 60) : clock.start, end];
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
