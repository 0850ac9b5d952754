
// ---- controls --------------------------------------------------------------------------------

playButton.onclick = toggle;
slider.oninput = () => { pause(); seek(Number(slider.value)); };
byId("speed").onchange = (event) => { clock.speed = Number(event.target.value); };
byId("loop").onchange = (event) => { clock.loop = event.target.checked; };

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  const at = event.target, isTime = at === slider;
  const own = !isTime && at.closest("button, input, select, summary, a");
  const step = event.shiftKey ? 1 / 30 : 1;
  const acts = { " ": toggle, ArrowLeft: () => seek(clock.time - step),
    ArrowRight: () => seek(clock.time + step), Home: () => seek(clock.start), End: () => seek(clock.end) };
  if (!(event.key in acts) || (own && (event.key === " " || at.matches("select, [type=radio]")))) return;
  event.preventDefault();
  acts[event.key]();
});

function addMark({ t, label, kind, joint }) {
  const place = byId("marks");
  const button = element("button", { type: "button", class: kind }, `${digits(t)} s: ${label}`);
  button.onclick = () => {
    pause();
    seek(t);
    if (joint) pick(nodeOf(joint));
  };
  place.append(element("li", {}, button));
  byId("events").hidden = false;
  const mark = element("span", { class: `mark ${kind}`, title: label });
  mark.dataset.time = t;
  byId("track").append(mark);
  placeMarks();
}
function placeMarks() {
  const span = clock.end - clock.start || 1;
  for (const mark of byId("track").querySelectorAll(".mark"))
    mark.style.left = `${(100 * (mark.dataset.time - clock.start)) / span}%`;
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
  const add = (label, checked, act) => place.append(box(label, checked, act).label);
  if (viewer) {
    add("transparent robot", false, (on) => robot.fade(on ? 0.35 : 1));
    if (isTorque) add("torque arcs", true, (on) => { showsArcs = on; chooseArcs(); });
    if (predictions) add("links coloured by residual", false, tint);
    ghosts.forEach((ghost, k) => {
      const made = box(`ghost: ${data.ghosts[k].label}`, true, (on) => { ghost.root.visible = on; });
      made.label.style.setProperty("--key", GHOSTS[k % GHOSTS.length]);
      made.label.classList.add("key");
      place.append(made.label);
    });
    if (torques && !isTorque && !floats)
      add(`ghost distance × ${BOOST}`, false, (on) => { boost = on ? BOOST : 1; shown = null; });
    if (floats) add("camera follows the robot", true, (on) => { follows = on; });
    add(`grid of ${cell} m`, true, (on) => { ground.visible = on; });
    add("frames", false, showFrames);
    add("names", false, showNames);
  }
  byId("residuals").hidden = !predictions;
  byId("arcs").hidden = !isTorque;
  if (scale) byId("most").textContent = `${scale.full} × ${scale.unit}`;
  if (masses.length) place.after(massTable());
}

function tint(on) {
  tints = on;
  if (!on) torques.joints.forEach(({ node }) => robot.tint(node, null));
  shown = null; // the next frame colours them
}

function massTable() {
  const head = element("tr", {}, element("th", { scope: "col" }, "link"));
  const rows = masses[0].bodies.map((body) => {
    const name = element("button", { type: "button", class: "plain" }, body.name);
    name.onclick = () => pick(body.node);
    const row = element("tr", {}, element("th", { scope: "row" }, name));
    row.dataset.node = body.node;
    return row;
  });
  masses.forEach((set, k) => {
    const label = data.masses[k].label;
    const boxes = set.bodies.map((body, i) => {
      const text = body.fault ? body.fault : `${body.mass.toPrecision(3)} kg`;
      const made = box(text, false, (on) => { body.isAsked = on; showMasses(); });
      made.input.setAttribute("aria-label", `${label}: ${body.name}, ${text}`);
      rows[i].append(element("td", {}, made.label));
      return made.input;
    });
    const all = box(label, false, (on) => boxes.forEach((input) => {
      input.checked = on;
      input.onchange();
    }));
    all.label.style.setProperty("--key", set.colour);
    all.label.classList.add("key");
    head.append(element("th", { scope: "col" }, all.label));
  });
  const table = element("table", {}, element("thead", {}, head), element("tbody", {}, ...rows));
  const scroll = element("div", { class: "scroll", tabindex: 0, role: "region",
    "aria-label": "masses of the links" }, table);
  return element("details", {}, element("summary", {}, "Centres of mass and ellipsoids"), scroll);
}

// ---- pictures and films ----------------------------------------------------------------------

function save(blob, ending) {
  const link = element("a", { href: URL.createObjectURL(blob),
    download: `${data.title}_${digits(clock.time)}s.${ending}`.replace(/[^\w.-]+/g, "_") });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

let recorder = null;
function record() { // until the button is pressed again
  if (recorder) { recorder.stop(); return; }
  const parts = [];
  recorder = new MediaRecorder(viewer.renderer.domElement.captureStream(30), { mimeType: "video/webm" });
  recorder.ondataavailable = (event) => parts.push(event.data);
  recorder.onstop = () => {
    recorder = null;
    showRecording();
    save(new Blob(parts, { type: "video/webm" }), "webm");
  };
  recorder.start();
  play();
  showRecording();
}
function showRecording() {
  byId("film").setAttribute("aria-pressed", recorder !== null);
  byId("film").textContent = recorder ? "Stop and save" : "Film";
}

if (viewer) {
  byId("picture").onclick = () => {
    sharpen();
    viewer.render(); // a canvas has its picture only until the next frame
    viewer.renderer.domElement.toBlob((blob) => save(blob, "png"));
  };
  byId("film").onclick = record;
  byId("film").hidden = !window.MediaRecorder || !MediaRecorder.isTypeSupported("video/webm");
}
