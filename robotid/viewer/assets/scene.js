
// ---- the scene -------------------------------------------------------------------------------

const { THREE } = MeshCat;
const onProcessor = (() => { // without a graphics card antialiasing halves the frame rate
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
  viewer = new MeshCat.Viewer(pane, false, renderer); // this page's clock draws the frames
  fullRatio = onProcessor ? 1 : window.devicePixelRatio;
  renderer.setPixelRatio(fullRatio);
} catch (error) { // the plots work without it
  pane.append(element("p", { class: "fault" }, `This browser shows no 3-D view: ${error.message}`));
}

const meshes = data.scene.meshes.map(({ low, step, vertices, faces, closed }) => {
  const made = new THREE.BufferGeometry();
  const places = Float32Array.from(unpack(vertices), (x, i) => low[i % 3] + step[i % 3] * x);
  made.setAttribute("position", new THREE.BufferAttribute(places, 3));
  made.setIndex(new THREE.BufferAttribute(unpack(faces), 1));
  made.computeVertexNormals();
  made.userData.side = closed ? THREE.FrontSide : THREE.DoubleSide;
  return made;
});

function geometry(part) {
  const [a, b, c] = part.size;
  if (part.shape === "sphere") return new THREE.SphereGeometry(a, 24, 16);
  if (part.shape === "cylinder") return new THREE.CylinderGeometry(a, a, b, 28);
  if (part.shape === "box") return new THREE.BoxGeometry(a, b, c);
  return meshes[a];
}

function visible(colour) { // almost black shapes look like holes in the picture
  const made = new THREE.Color(colour), hsl = made.getHSL({});
  return hsl.l < 0.27 ? made.setHSL(hsl.h, hsl.s, 0.27) : made;
}

class Robot { // the nodes of one robot in the viewer's tree, posed by a row of a motion
  constructor(root, material) {
    this.root = viewer.scene_tree.find([root]).object;
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
      const axis = new THREE.Vector3(...node.axis);
      return { ...node, object, rest, axis, skins: new Map() };
    });
    this.solids = data.scene.parts.map((part, k) => {
      const shape = geometry(part), { skins } = this.joints[part.node];
      const side = shape.userData.side ?? THREE.FrontSide, key = `${part.colour} ${side}`;
      if (!skins.has(key)) {
        const skin = material(visible(part.colour), side);
        skin.userData.colour = skin.color.clone();
        skins.set(key, skin);
      }
      const mesh = new THREE.Mesh(shape, skins.get(key));
      mesh.userData.node = part.node;
      new THREE.Matrix4().fromArray(part.matrix).decompose(mesh.position, mesh.quaternion, mesh.scale);
      viewer.set_object([...paths[part.node], `part ${k}`], mesh);
      return mesh;
    });
  }
  pose(row) {
    if (!row) return;
    const turn = new THREE.Quaternion();
    for (const { kind, column, axis, object, rest } of this.joints) {
      if (kind === "revolute") {
        object.quaternion.copy(rest.quaternion).multiply(turn.setFromAxisAngle(axis, row[column]));
      } else if (kind === "prismatic") {
        object.position.copy(axis).multiplyScalar(row[column]);
        object.position.applyQuaternion(rest.quaternion).add(rest.position);
      } else if (kind === "free") {
        object.position.set(row[0], row[1], row[2]);
        object.quaternion.set(row[3], row[4], row[5], row[6]).normalize();
      }
    }
  }
  fade(node, opacity) {
    for (const skin of this.joints[node].skins.values()) {
      if (skin.opacity === opacity) continue;
      skin.transparent = opacity < 1;
      skin.opacity = opacity;
      skin.depthWrite = opacity === 1;
      skin.needsUpdate = true;
    }
  }
  tint(node, colour) { // null: its own
    for (const skin of this.joints[node].skins.values())
      if (colour) skin.color.set(colour); else skin.color.copy(skin.userData.colour);
  }
  glow(node, on) {
    for (const skin of this.joints[node].skins.values()) skin.emissive.set(on ? "#5a2c00" : "#000");
  }
}

const robot = viewer && new Robot("robot", (color, side) => new THREE.MeshLambertMaterial({ color, side }));
const GHOSTS = ["#3b82f6", "#d9820f", "#3a9d5d"];
const BOOST = 10;
let boost = 1; // factor on the distance of a ghost from the robot
const ghosts = !viewer ? [] : ghostMotions.map((_, k) => new Robot(`ghost ${k}`,
  () => new THREE.MeshPhongMaterial({ color: GHOSTS[k % GHOSTS.length], transparent: true,
    opacity: 0.3, depthWrite: false })));
const floats = data.scene.nodes.some((node) => node.kind === "free");

// ---- light and ground ------------------------------------------------------------------------

const SKIES = { light: { top: [0.93, 0.95, 0.97], low: [0.72, 0.77, 0.82], line: "#8d98a3" },
  dark: { top: [0.22, 0.25, 0.29], low: [0.11, 0.12, 0.14], line: "#46515c" } };
const darkness = matchMedia("(prefers-color-scheme: dark)");
const cell = data.view.cell;
let ground = null;

function light() {
  for (const name of ["PointLightNegativeX", "PointLightPositiveX", "AmbientLight", "FillLight"])
    viewer.set_property(["Lights", name], "visible", false);
  const sky = new THREE.HemisphereLight("#ffffff", "#8a8078", 0.68);
  sky.position.set(0, 0, 1);
  viewer.set_object(["Lights", "Sky"], sky);
  for (const [name, power, ...place] of [["key", 0.58, -1, 1.2, 1], ["fill", 0.28, 1.4, 0.1, 0.6]]) {
    const lamp = new THREE.DirectionalLight("#ffffff", power); // beside the camera, wherever it is
    lamp.name = name;
    lamp.position.set(...place);
    lamp.target.position.set(0, 0, 0);
    viewer.camera.add(lamp, lamp.target);
  }
}

function paint() { // the colours of the page's scheme, also when it changes
  const sky = SKIES[darkness.matches ? "dark" : "light"];
  viewer.set_property(["Background"], "top_color", sky.top);
  viewer.set_property(["Background"], "bottom_color", sky.low);
  const shown = ground ? ground.visible : true;
  ground = new THREE.GridHelper(40 * cell, 40, sky.line, sky.line);
  ground.rotateX(Math.PI / 2);
  ground.visible = shown;
  viewer.set_object(["Grid"], ground);
  if (motion.rows.length) placeGround();
  viewer.set_dirty();
}

function placeGround() { // under the robot, in whole cells
  const [x, y] = [0, 1].map((k) => cell * Math.round((middle[k] + base[k]) / cell));
  ground.position.set(x, y, data.view.ground);
}

// ---- camera ----------------------------------------------------------------------------------

const base = [0, 0, 0]; // where a floating base is, 0 if it is fixed
const middle = [0, 1, 2].map((k) => { // of the points that must be in sight
  const along = data.view.points.map((point) => point[k]);
  return (Math.min(...along) + Math.max(...along)) / 2;
});
let follows = floats, isTurned = false; // by hand: the view then remains when the window changes
// the viewer's camera has y upwards: (x, y, z) of the robot is (x, z, -y) there
const upward = ([x, y, z]) => new THREE.Vector3(x, z, -y);

function aim() { // from the front and above, the whole motion in sight
  const { camera } = viewer;
  const away = new THREE.Vector3(0.76, 0.36, 0.54).normalize(), up = new THREE.Vector3(0, 1, 0);
  const right = up.clone().cross(away).normalize();
  up.copy(away).cross(right);
  const tall = Math.tan((20 * Math.PI) / 180);
  const wide = tall * (pane.clientWidth / Math.max(pane.clientHeight, 1));
  let far = 1e-3;
  for (const point of data.view.points) { // each needs a distance
    const place = upward(point.map((x, k) => x - middle[k]));
    const needs = Math.max(Math.abs(place.dot(right)) / wide, Math.abs(place.dot(up)) / tall);
    far = Math.max(far, place.dot(away) + 1.15 * needs);
  }
  camera.fov = 40;
  camera.near = far / 100;
  camera.far = 100 * Math.max(far, data.view.radius);
  const target = upward(middle.map((x, k) => x + base[k]));
  viewer.controls.target.copy(target);
  camera.position.copy(target).addScaledVector(away, far);
  viewer.controls.update();
  viewer.set_dirty();
}

function follow(row) { // the camera goes where the base goes
  if (!floats || !row) return;
  const moved = upward([0, 1, 2].map((k) => row[k] - base[k]));
  row.slice(0, 3).forEach((x, k) => { base[k] = x; });
  placeGround();
  if (!follows) return;
  viewer.camera.position.add(moved);
  viewer.controls.target.add(moved);
}

function resize() { // and draw immediately: a resized canvas is empty
  viewer.set_3d_pane_size();
  viewer.render();
}

if (viewer) {
  viewer.gui.domElement.remove(); // the switches of this page are named and reached by keyboard
  viewer.renderer.domElement.setAttribute("aria-hidden", "true"); // the pane has the label
  const size = viewer.set_3d_pane_size.bind(viewer);
  viewer.set_3d_pane_size = () => size(pane.clientWidth, pane.clientHeight);
  viewer.set_property(["Axes"], "visible", false);
  light();
  paint();
  darkness.addEventListener("change", paint);
  new ResizeObserver(() => {
    if (!isTurned) aim();
    resize();
  }).observe(pane);
  byId("view").onclick = () => { isTurned = false; aim(); keep(); };
  viewer.controls.addEventListener("end", () => { isTurned = true; keep(); });
}
