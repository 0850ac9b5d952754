
// ---- the clock: the log's own time -----------------------------------------------------------

const SLOW = 0.045; // [s] a frame
const READINGS = onProcessor ? 250 : 100; // [ms] between two changes of the page about the view
const COARSEST = 0.5; // share of the pixels' width that a slow processor draws at least
const begin = data.marks.find(({ kind }) => kind === "validation") || { t: data.start };
const clock = { time: begin.t, playing: !matchMedia("(prefers-reduced-motion: reduce)").matches,
  speed: 1, loop: true, start: data.start, end: 0, frames: 0, at: 0 };
clock.end = Math.max(motion.end, ...ghostMotions.map(({ end }) => end));
const slider = byId("time"), clockText = byId("clock"), playButton = byId("play");
let shown = null, readings = null, announced = -Infinity;
const digits = (time) => time.toFixed(2);

function show() { // the robot in every frame, the page about it less often
  if (shown !== clock.time) showRobot(clock.time);
  shown = clock.time;
  const now = performance.now();
  if (readings && (readings.time === clock.time || (clock.playing && now - readings.at < READINGS))) return;
  readings = { time: clock.time, at: now };
  showReadings(clock.time);
}

function showRobot(time) {
  if (!viewer || !motion.rows.length) return;
  const row = motion.at(time);
  robot.pose(row);
  follow(row);
  castShadow();
  ghosts.forEach((ghost, k) => {
    const own = ghostMotions[k].at(time); // how far it is from the robot may be shown larger
    ghost.pose(boost === 1 ? own : own.map((x, i) => row[i] + boost * (x - row[i])));
  });
  if (torques && torqueTable.rows.length) showArcs(torqueTable.at(time));
  viewer.set_dirty();
}

function showReadings(time) {
  const from = clock.end - clock.start || 1;
  moveCursor(time);
  tellReport(time);
  byId("now").style.left = `${(100 * (time - clock.start)) / from}%`;
  slider.value = time;
  clockText.textContent = `${digits(time)} of ${digits(clock.end)} s`;
  if (Math.abs(time - announced) > 1 || !clock.playing) { // a screen reader announces it once a second
    announced = time;
    slider.setAttribute("aria-valuetext", `${time.toFixed(1)} of ${clock.end.toFixed(1)} seconds`);
    keep();
  }
}

function seek(time) {
  clock.time = Math.min(Math.max(time, clock.start), clock.end);
  readings = null;
  buttons();
  show();
}
function play() {
  if (clock.time >= clock.end) clock.time = clock.start;
  clock.playing = true;
  buttons();
}
function pause() {
  clock.playing = false;
  readings = null;
  sharpen();
  buttons();
}
function toggle() { if (clock.playing) pause(); else play(); }
function buttons() {
  playButton.textContent = clock.playing ? "Pause" : "Play";
  wake();
}

const pace = { mean: 0, frames: 0, pixels: 1 }; // of the last frames [s]; share of the pixels' width
function spare(passed) { // a slow processor draws fewer pixels rather than fewer frames
  pace.mean += (Math.min(passed, 0.5) - pace.mean) / Math.min(++pace.frames, 15);
  if (pace.frames < 15 || pace.mean < SLOW || pace.pixels <= COARSEST) return;
  draw(Math.max(0.8 * pace.pixels, COARSEST));
}
function draw(pixels) {
  pace.pixels = pixels;
  pace.frames = 0;
  viewer.renderer.setPixelRatio(pixels * fullRatio);
  resize();
}
function sharpen() { if (viewer && pace.pixels < 1) draw(1); } // full resolution of a still picture

const EVERY = 22; // [ms] to the next frame of a playing page, which is the second one of 60 Hz
let last = null, isAsked = false, next = 0;
function wake() { // asks for one frame; nothing is drawn while nothing changes
  if (!isAsked) requestAnimationFrame(tick);
  isAsked = true;
}
function tick(now) {
  const passed = last === null ? 0 : (now - last) / 1000;
  last = now;
  clock.at = now;
  clock.frames++;
  if (clock.playing && viewer && onProcessor) spare(passed);
  if (clock.playing && clock.end > clock.start) {
    clock.time += passed * clock.speed;
    if (clock.time > clock.end) {
      const span = clock.end - clock.start;
      clock.time = clock.loop ? clock.start + ((clock.time - clock.start) % span) : clock.end;
      if (!clock.loop) pause();
    }
  }
  show();
  if (viewer && viewer.needs_render) {
    viewer.render();
    placeNames();
  }
  isAsked = false; // only now: what was changed above is drawn
  clearTimeout(next);
  if (clock.playing) next = setTimeout(wake, EVERY);
  else last = null;
}

// ---- the address stores time, joint and camera -------------------------------------------------

const hasAddress = location.protocol !== "about:"; // the frame of a notebook has none
let isRestored = false;

function keep() {
  if (!isRestored || !hasAddress) return;
  const state = { t: clock.time.toFixed(3) };
  if (chosen) state.model = models[chosen];
  if (picked) state.joint = data.scene.nodes[picked].name;
  if (isTurned) {
    const { position } = viewer.camera, { target } = viewer.controls;
    state.camera = [...position.toArray(), ...target.toArray()].map((x) => x.toPrecision(5)).join(" ");
  }
  history.replaceState(null, "", `#${new URLSearchParams(state)}`);
}

function restore() { // at the start, and when a link of another page changes the address
  const stored = Object.fromEntries(new URLSearchParams(location.hash.slice(1)));
  const isOther = stored.log && data.log && stored.log !== data.log;
  byId("state").textContent = isOther ? `The link is to ${stored.log}; this replay shows another recording.` : "";
  if (stored.t !== undefined && Number.isFinite(Number(stored.t))) { pause(); seek(Number(stored.t)); }
  const place = (stored.camera || "").split(" ").map(Number);
  if (viewer && place.length === 6 && place.every(Number.isFinite)) {
    aim(); // near and far of the camera
    viewer.camera.position.set(...place.slice(0, 3));
    viewer.controls.target.set(...place.slice(3));
    viewer.controls.update();
    isTurned = true;
  }
  const wanted = models.indexOf(stored.model);
  if (wanted >= 0 && wanted !== chosen) choose(wanted);
  if (stored.joint) pick(nodeOf(stored.joint));
  isRestored = true;
}
window.addEventListener("hashchange", restore);
