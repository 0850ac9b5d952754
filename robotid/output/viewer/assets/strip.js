
// ---- the heat strip: residual of each joint along the time line -------------------------------

const UNUSED = 65534, GAP = 65535; // codes of a joint at rest, and of a time without samples
let levels = torques && torques.strips.length ? unpack(torques.strips[chosen]) : null; // [bin * count + joint]
const bins = levels ? torques.strips[0].shape[0] : 0;
const strip = byId("strip"), sheet = byId("sheet");

function level(bin, j) { // residual over its scale; NaN if there is none
  const code = levels[bin * count + j];
  return code >= UNUSED ? NaN : code / 100;
}

const rowHeight = () => Math.max(3, Math.min(18, Math.floor(130 / count)));

function hatch(colour, reversed) { // a tile of slanted lines
  const tile = document.createElement("canvas");
  tile.width = tile.height = 6;
  const pen = tile.getContext("2d");
  pen.strokeStyle = colour;
  for (const x of [-6, 0, 6]) {
    pen.moveTo(reversed ? x + 6 : x, 0);
    pen.lineTo(reversed ? x : x + 6, 6);
  }
  pen.stroke();
  return tile;
}

function drawStrip() {
  if (!levels) return;
  const high = rowHeight(), width = sheet.parentElement.clientWidth, ratio = devicePixelRatio;
  sheet.width = Math.max(1, Math.round(width * ratio));
  sheet.height = Math.round(high * count * ratio);
  sheet.style.height = `${high * count}px`;
  const pen = sheet.getContext("2d"), span = motion.end - data.start || 1;
  const x = (bin) => ((data.start + (bin / bins) * span - clock.start) / (clock.end - clock.start)) * width;
  pen.scale(ratio, ratio);
  const resting = pen.createPattern(hatch(tone("quiet"), false), "repeat");
  const gap = pen.createPattern(hatch(tone("text"), true), "repeat");
  for (let bin = 0; bin < bins; bin++) {
    for (let j = 0; j < count; j++) {
      const code = levels[bin * count + j];
      pen.fillStyle = code === GAP ? gap : code === UNUSED ? resting
        : residualColour(code / 100 / scale.full);
      // the columns overlap slightly; otherwise light lines are visible between them
      pen.fillRect(x(bin), j * high, x(bin + 1) - x(bin) + (code >= UNUSED ? 0 : 0.5), high - 1);
    }
  }
  byId("joints").style.lineHeight = `${high}px`;
}

function drawStripNames() {
  const names = byId("joints");
  const titles = torques.joints.map(({ name, node }) => {
    const title = element("span", { title: name }, name);
    title.dataset.node = node;
    title.style.height = `${rowHeight()}px`;
    title.style.fontSize = rowHeight() < 9 ? 0 : `${Math.min(12, rowHeight() - 1)}px`;
    return title;
  });
  names.append(...titles);
  names.onclick = ({ target }) => target.dataset.node && pick(Number(target.dataset.node));
}

function under(event) { // time and joint under the pointer
  const box = sheet.getBoundingClientRect();
  const share = Math.min(Math.max((event.clientX - box.left) / box.width, 0), 1);
  const j = Math.floor(((event.clientY - box.top) / box.height) * count);
  return { time: clock.start + share * (clock.end - clock.start), j: Math.min(Math.max(j, 0), count - 1) };
}

function describe({ time, j }) { // the residual of a joint at a time, as text
  const bin = Math.floor(((time - data.start) / (motion.end - data.start)) * bins);
  const code = bin < bins ? levels[bin * count + j] : GAP;
  const words = code === GAP ? "no samples" : code === UNUSED ? "at rest, not used"
    : `${(code / 100).toFixed(2)} × ${scale.unit}`;
  byId("reading").textContent = `${torques.joints[j].name}, ${time.toFixed(2)} s: ${words}`;
}

if (levels) {
  strip.hidden = false;
  byId("full").textContent = `${scale.full} × ${scale.unit}`;
  drawStripNames();
  sheet.addEventListener("pointermove", (event) => {
    const there = under(event);
    describe(there);
    if (event.buttons) { pause(); seek(there.time); }
  });
  sheet.addEventListener("pointerdown", (event) => {
    sheet.setPointerCapture(event.pointerId);
    const there = under(event);
    describe(there);
    pause();
    seek(there.time);
    pick(torques.joints[there.j].node);
  });
  sheet.addEventListener("keydown", (event) => {
    const by = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if (!by) return;
    event.preventDefault();
    const now = torques.joints.findIndex(({ node }) => node === picked);
    const j = now < 0 ? 0 : (now + by + count) % count;
    pick(torques.joints[j].node);
    describe({ time: clock.time, j });
  });
  new ResizeObserver(drawStrip).observe(sheet.parentElement);
  darkness.addEventListener("change", drawStrip);
}
