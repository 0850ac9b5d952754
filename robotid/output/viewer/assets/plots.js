
// ---- charts: torques of each joint, parameters over time --------------------------------------

const timeLine = charts.link("time"); // the charts' cursor is the clock's
const torqueCharts = [], bandCharts = [];
timeLine.on((time, how) => {
  if (how === "set" || how === "hover" || !Number.isFinite(time)) return;
  pause();
  seek(time);
});

function moveCursor(time) { // of the charts, except one under the pointer
  const isHovered = timeLine.shown !== timeLine.time && Number.isFinite(timeLine.shown);
  if (isHovered) timeLine.time = time; else timeLine.set(time);
}

function span() { // range of the charts without zoom
  return [clock.start, Math.max(clock.end, clock.start + 1e-3)];
}

function resting(j) { // segments in which a joint is not used, from the columns of the strip
  const found = [], wide = (motion.end - data.start) / bins;
  for (let bin = 0; bin < bins; bin++) {
    if (levels[bin * count + j] !== UNUSED) continue;
    const start = data.start + bin * wide, before = found[found.length - 1];
    if (before && Math.abs(before[1] - start) < wide / 2) before[1] = start + wide;
    else found.push([start, start + wide]);
  }
  return found;
}

function torqueRows(j) { // measured and predictions, and the residual of the shown prediction
  const { rows } = torqueTable;
  const ys = torques.labels.map((_, k) => rows.map((row) => row[k * count + j]));
  return [ys, predictions ? ys[0].map((y, k) => y - ys[1 + chosen][k]) : null];
}

function drawTorques() {
  const tones = torques.labels.map((label, k) => ["text", "predicted"][k]
    || { commanded: "tone-5", URDF: "urdf" }[label] || `tone-${k + 1}`);
  const marks = data.marks.map(({ t }) => t);
  const section = element("section", {}, element("h2", {}, isTorque ? "Torque" : "Position"));
  byId("plots").append(section);
  torques.joints.forEach(({ name, unit, node }, j) => {
    const heading = element("button", { type: "button", class: "plain" }, name);
    heading.onclick = () => pick(node);
    const place = element("section", { class: "plot" }, element("h3", {}, heading));
    place.dataset.node = node;
    section.append(place);
    const [ys, residual] = torqueRows(j);
    const add = (title, y_label, series, height) => new charts.Chart(place, { title, link: "time",
      x: torqueTable.t, series, x_label: "time [s]", y_label,
      spans: levels ? resting(j) : [], marks, logarithmic: "", height });
    const chart = add(`${torques.quantity} of ${name} over time`, `${torques.quantity} [${unit}]`,
      torques.labels.map((label, k) =>
        ({ label, tone: tones[k], kind: "line", y: ys[k], half: null, is_weak: k > 1,
          is_hidden: models.length > 0 && k > 0 && k - 1 !== chosen })), 100);
    // on an axis of its own, where a small one is visible
    const label = `measured − ${models.length ? "shown" : torques.labels[1]}`;
    const below = predictions ? add(`residual of ${name} over time`, `residual [${unit}]`,
      [{ label, tone: "residual", kind: "line", y: residual, half: null }], 84) : null;
    torqueCharts.push({ chart, below });
  });
}

const bandRows = (i) => [bandTable.rows.map((row) => row[i])];
const bandHalves = (i) => [bandTable.rows.map((row) => 2 * row[bands.names.length + i])];

function drawBands() {
  const ownerOf = (name) => name.replace(/\.[^.]*$/, "");
  const owners = [...new Set(bands.names.map(ownerOf))];
  const choice = element("select", { id: "owner" }, ...owners.map((o) => element("option", {}, o)));
  const label = element("label", {}, "of ", choice);
  const section = element("section", {}, element("h2", {}, "Parameters"),
    element("p", {}, label, " with two standard errors"));
  byId("plots").append(section);
  const draw = () => {
    while (bandCharts.length) bandCharts.pop().chart.remove();
    bands.names.forEach((name, i) => {
      if (ownerOf(name) !== choice.value) return;
      const series = [{ label: name, tone: "tone-2", kind: "line", y: bandRows(i)[0],
        half: bandHalves(i)[0] }];
      const chart = new charts.Chart(section, { title: `${name} over time`, link: "time",
        x: bandTable.t, series, x_label: "time [s]", y_label: bands.units[i], logarithmic: "",
        height: 100 });
      bandCharts.push({ i, chart });
    });
  };
  choice.onchange = draw;
  draw();
}
