
// ---- the selected joint is highlighted everywhere -------------------------------------------------

let picked = null; // its node

function pick(node) { // null: none
  const chosen = node && data.scene.nodes[node].kind !== "fixed" ? node : null;
  if (robot && picked) robot.glow(picked, false);
  picked = chosen;
  if (robot && picked) robot.glow(picked, true);
  showMasses();
  chooseArcs();
  for (const place of document.querySelectorAll("[data-node]")) {
    const isPicked = Number(place.dataset.node) === picked;
    place.classList.toggle("picked", isPicked);
    if (isPicked && place.matches("section, tr")) place.scrollIntoView({ block: "nearest" });
  }
  const words = picked ? data.scene.nodes[picked].name : "";
  byId("picked").textContent = words;
  byId("picked").hidden = !words;
  readings = null;
  keep();
}
const nodeOf = (name) => data.scene.nodes.findIndex((node, i) => i && node.name === name);

function hit(event) { // the node of the link under the pointer, null outside the robot
  const box = pane.getBoundingClientRect();
  const at = new THREE.Vector2(((event.clientX - box.left) / box.width) * 2 - 1,
    1 - ((event.clientY - box.top) / box.height) * 2);
  const ray = new THREE.Raycaster();
  viewer.scene.updateMatrixWorld(true);
  ray.setFromCamera(at, viewer.camera);
  const [first] = ray.intersectObjects(robot.solids, false);
  return first ? first.object.userData.node : null;
}

if (viewer) {
  let pressed = null;
  pane.addEventListener("pointerdown", (event) => { pressed = [event.clientX, event.clientY]; }, true);
  pane.addEventListener("pointerup", (event) => { // a click, not the end of a camera rotation
    const [x, y] = pressed || [Infinity, 0];
    if (Math.hypot(event.clientX - x, event.clientY - y) < 5) pick(hit(event));
  }, true);
}

// ---- frames and names of the links -----------------------------------------------------------

const frames = [], names = [];
function showFrames(on) {
  if (on && !frames.length) {
    for (const { object } of robot.joints) {
      const axes = new THREE.AxesHelper(0.09 * data.scene.reach);
      axes.material.depthTest = false;
      axes.renderOrder = 5;
      frames.push(axes);
      object.add(axes);
    }
  }
  frames.forEach((axes) => { axes.visible = on; });
}

let showsNames = false;
function showNames(on) {
  showsNames = on;
  if (on && !names.length) {
    robot.joints.slice(1).forEach(({ name, object }) => {
      const label = element("span", { class: "name" }, name);
      names.push({ object, label });
      byId("names").append(label);
    });
  }
  byId("names").hidden = !on;
}
function placeNames() { // after a frame was drawn
  if (!showsNames) return;
  const spot = new THREE.Vector3(), placed = [];
  for (const name of names) {
    spot.setFromMatrixPosition(name.object.matrixWorld).project(viewer.camera);
    name.width ||= name.label.offsetWidth;
    name.height ||= name.label.offsetHeight;
    name.x = ((spot.x + 1) / 2) * pane.clientWidth;
    name.y = ((1 - spot.y) / 2) * pane.clientHeight;
  }
  for (const name of [...names].sort((a, b) => a.y - b.y)) { // below each other rather than over
    for (const { x, y, width, height } of placed)
      if (name.x < x + width && x < name.x + name.width && name.y < y + height) name.y = y + height;
    placed.push(name);
    name.label.style.transform = `translate(${name.x.toFixed(1)}px, ${name.y.toFixed(1)}px)`;
  }
}
