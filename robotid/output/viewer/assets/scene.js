
// ---- the scene -------------------------------------------------------------------------------

const { THREE } = MeshCat;
const onProcessor = (() => { // without a graphics card neither antialiasing nor a graded sky
  const context = document.createElement("canvas").getContext("webgl");
  const info = context && context.getExtension("WEBGL_debug_renderer_info");
  const name = info ? context.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
})();

const pane = byId("meshcat-pane");
let viewer = null, fullRatio = 1; // pixels of the view per pixel of the page
try {
  const renderer = new THREE.WebGLRenderer({ antialias: !onProcessor, alpha: false });
  pane.append(renderer.domElement);
  viewer = new MeshCat.Viewer(pane, false, renderer); // this page's clock draws the frames
  fullRatio = onProcessor ? 1 : window.devicePixelRatio;
  renderer.setPixelRatio(fullRatio);
} catch (error) { // the plots work without it
  pane.append(element("p", { class: "fault" }, `This browser shows no 3-D view: ${error.message}`));
}

// ---- the bodies: one mesh per joint, with the colours of its parts at its corners --------------

const meshes = data.scene.meshes.map(({ vertices, faces, closed }) => {
  const made = new THREE.BufferGeometry();
  made.setAttribute("position", new THREE.BufferAttribute(unpack(vertices), 3));
  made.setIndex(new THREE.BufferAttribute(unpack(faces), 1));
  made.computeVertexNormals();
  made.userData.isOpen = !closed;
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

function merged(parts) { // one geometry in the frame of the node
  const shapes = parts.map((part) => {
    const shape = geometry(part).clone().applyMatrix4(new THREE.Matrix4().fromArray(part.matrix));
    const { count } = shape.attributes.position, { r, g, b } = visible(part.colour);
    const colours = new Float32Array(3 * count).map((_, i) => [r, g, b][i % 3]);
    return { shape, count, colours };
  });
  const made = new THREE.BufferGeometry(), index = [];
  let start = 0;
  for (const { shape, count } of shapes) {
    for (const corner of shape.index.array) index.push(start + corner);
    start += count;
  }
  const joined = (arrays) => {
    const all = new Float32Array(3 * start);
    arrays.reduce((from, array) => { all.set(array, from); return from + array.length; }, 0);
    return new THREE.BufferAttribute(all, 3);
  };
  made.setIndex(index);
  made.setAttribute("position", joined(shapes.map(({ shape }) => shape.attributes.position.array)));
  made.setAttribute("normal", joined(shapes.map(({ shape }) => shape.attributes.normal.array)));
  made.setAttribute("color", joined(shapes.map(({ colours }) => colours)));
  made.computeBoundingBox();
  return made;
}

const bodies = []; // of all robots: { node, shape, side }
data.scene.nodes.forEach((_, node) => {
  const own = data.scene.parts.filter((part) => part.node === node);
  const isOpen = (part) => part.shape === "mesh" && meshes[part.size[0]].userData.isOpen;
  for (const [parts, side] of [[own.filter((part) => !isOpen(part)), THREE.FrontSide],
    [own.filter(isOpen), THREE.DoubleSide]])
    if (parts.length) bodies.push({ node, side, shape: merged(parts) });
});

// The sky's light and that of two lamps beside the camera, at the corners of triangles: a
// processor draws it in half the time of three's own materials. A ghost is behind what is as near.
const LIGHT = `
  #ifdef FLAT
  vColor = vec3(1.0);
  #ifdef DOUBLE_SIDED
  vBack = vColor;
  #endif
  #else
  vec3 normalSeen = normalize(normalMatrix * normal);
  float sky = 0.5 + 0.5 * dot(normalSeen, (viewMatrix * vec4(0.0, 1.0, 0.0, 0.0)).xyz);
  float key = dot(normalSeen, vec3(-0.54, 0.65, 0.54)), fill = dot(normalSeen, vec3(0.92, 0.07, 0.39));
  vec3 soil = vec3(0.37, 0.34, 0.32), own = mix(vec3(1.0), vColor, ownColour);
  vColor = own * (mix(soil, vec3(0.68), sky) + 0.58 * max(key, 0.0) + 0.28 * max(fill, 0.0)) + glow;
  #ifdef DOUBLE_SIDED
  vBack = own * (mix(vec3(0.68), soil, sky) + 0.58 * max(-key, 0.0) + 0.28 * max(-fill, 0.0)) + glow;
  #endif
  #endif
  mvPosition.xyz *= 1.0 + behind;
  gl_Position = projectionMatrix * mvPosition;`;
const HEAD = "uniform vec3 glow;\nuniform float ownColour, behind;\nvarying vec3 vBack;\n";

function skin(side, { behind = 0, ...settings } = {}) {
  const made = new THREE.MeshBasicMaterial({ side, vertexColors: true, ...settings });
  made.userData = { ownColour: { value: 1 }, behind: { value: behind },
    glow: { value: new THREE.Color("#000") } };
  made.onBeforeCompile = (shader) => {
    Object.assign(shader.uniforms, made.userData);
    shader.vertexShader = HEAD + shader.vertexShader.replace("#include <project_vertex>",
      `#include <project_vertex>${LIGHT}`);
    shader.fragmentShader = `varying vec3 vBack;\n${shader.fragmentShader}`.replace(
      "#include <color_fragment>", `#ifdef DOUBLE_SIDED
      diffuseColor.rgb *= gl_FrontFacing ? vColor : vBack;
      #else
      diffuseColor.rgb *= vColor;
      #endif`);
  };
  return made;
}

class Robot { // the nodes of one robot in the viewer's tree, posed by a row of a motion
  constructor(root, meshOf) { // meshOf: makes the mesh of a body
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
    this.solids = bodies.map((body) => {
      const mesh = meshOf(body), { skins, object } = this.joints[body.node];
      skins.set(body.side, mesh.material);
      mesh.userData.node = body.node;
      object.add(mesh);
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
  dress(node, act) { this.joints[node].skins.forEach(act); }
  fade(opacity) {
    for (const { skins } of this.joints) {
      for (const own of skins.values()) {
        own.transparent = opacity < 1;
        own.opacity = opacity;
        own.depthWrite = opacity === 1;
        own.needsUpdate = true;
      }
    }
  }
  tint(node, colour) { // null: its own
    this.dress(node, (own) => {
      own.color.set(colour || "#fff");
      own.userData.ownColour.value = colour ? 0 : 1;
    });
  }
  glow(node, on) {
    this.dress(node, (own) => own.userData.glow.value.set(on ? "#5a2c00" : "#000"));
  }
}

const GHOSTS = ["#3b82f6", "#d9820f", "#3a9d5d"];
const BOOST = 10;
const BEHIND = 0.008; // of the distance of the camera: a ghost this near to the robot is hidden by it
let boost = 1; // factor on the distance of a ghost from the robot
const robot = viewer && new Robot("robot", ({ shape, side }) => new THREE.Mesh(shape, skin(side)));

function ghostly(k) { // one even colour, drawn once at each pixel: no parts show through
  const color = GHOSTS[k % GHOSTS.length];
  return ({ shape, side }) => {
    const made = skin(side, { color, behind: BEHIND, opacity: 0.4, depthWrite: false,
      blending: THREE.CustomBlending, // sides of transparent materials would be drawn one by one
      stencilWrite: true, stencilRef: k + 1, stencilFunc: THREE.NotEqualStencilFunc,
      stencilZPass: THREE.ReplaceStencilOp });
    made.defines = { FLAT: "" };
    const mesh = new THREE.Mesh(shape, made);
    mesh.renderOrder = 2 + k / 100;
    return mesh;
  };
}
const ghosts = !viewer ? [] : ghostMotions.map((_, k) => new Robot(`ghost ${k}`, ghostly(k)));
const floats = data.scene.nodes.some((node) => node.kind === "free");

// ---- sky and ground --------------------------------------------------------------------------

const SKIES = { light: { top: [0.93, 0.95, 0.97], low: [0.72, 0.77, 0.82], line: "#8d98a3" },
  dark: { top: [0.22, 0.25, 0.29], low: [0.11, 0.12, 0.14], line: "#46515c" } };
const darkness = matchMedia("(prefers-color-scheme: dark)");
const cell = data.view.cell;
let ground = null;

function paint() { // the colours of the page's scheme, also when it changes
  const sky = SKIES[darkness.matches ? "dark" : "light"];
  viewer.set_property(["Background"], "top_color", sky.top);
  viewer.set_property(["Background"], "bottom_color", sky.low);
  if (onProcessor) viewer.scene.background = new THREE.Color(...sky.top.map((x, k) => (x + sky.low[k]) / 2));
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

// ---- contact shadow of the ellipsoid in the box of each body -----------------------------------

const DARKEST = 0.5, SPREAD = 1.6; // opacity at the ground; size with its soft edge
let shadow = null;

function softDisc() {
  const sheet = document.createElement("canvas"), size = sheet.width = sheet.height = 64;
  const pen = sheet.getContext("2d"), half = size / 2;
  const tones = pen.createRadialGradient(half, half, 0, half, half, half);
  [1, 0.9, 0.5, 0.15, 0].forEach((share, k) => tones.addColorStop(k / 4, `rgba(255, 255, 255, ${share})`));
  pen.fillStyle = tones;
  pen.fillRect(0, 0, size, size);
  return new THREE.CanvasTexture(sheet);
}

function makeShadow() {
  const shape = new THREE.BufferGeometry();
  const add = (name, size) => shape.setAttribute(name,
    new THREE.BufferAttribute(new Float32Array(4 * size * bodies.length), size));
  add("position", 3);
  add("color", 4);
  add("uv", 2);
  bodies.forEach((_, k) => shape.attributes.uv.array.set([0, 0, 1, 0, 1, 1, 0, 1], 8 * k));
  shape.setIndex(bodies.flatMap((_, k) => [0, 1, 2, 0, 2, 3].map((corner) => 4 * k + corner)));
  shadow = new THREE.Mesh(shape, new THREE.MeshBasicMaterial(
    { map: softDisc(), vertexColors: true, transparent: true, depthWrite: false }));
  shadow.frustumCulled = false;
  viewer.scene.add(shadow);
}

function castShadow() { // below the lowest point of each ellipsoid, darker the nearer it is
  const { position, color } = shadow.geometry.attributes, centre = new THREE.Vector3();
  const half = new THREE.Vector3(), axis = new THREE.Vector3();
  const upright = viewer.scene.matrixWorld.clone().invert(); // the axes of the robot, z upwards
  robot.root.updateMatrixWorld(true);
  bodies.forEach(({ node, shape }, k) => {
    const pose = upright.clone().multiply(robot.joints[node].object.matrixWorld);
    shape.boundingBox.getCenter(centre).applyMatrix4(pose);
    shape.boundingBox.getSize(half).multiplyScalar(0.5);
    let [xx, xy, yy, xz, yz, zz] = [1e-9, 0, 1e-9, 0, 0, 1e-9]; // sums of products of the half axes
    for (let i = 0; i < 3; i++) {
      const { x, y, z } = axis.setFromMatrixColumn(pose, i).multiplyScalar(half.getComponent(i));
      [xx, xy, yy, xz, yz, zz] = [xx + x * x, xy + x * y, yy + y * y, xz + x * z, yz + y * z, zz + z * z];
    }
    const low = Math.sqrt(zz), x = centre.x - xz / low, y = centre.y - yz / low;
    // half axes of its cross-section about the lowest point, (a, b) and (0, c), by Cholesky's factor
    const a = Math.sqrt(xx - xz * xz / zz), b = (xy - xz * yz / zz) / a;
    const c = Math.sqrt(Math.max(yy - yz * yz / zz - b * b, 1e-9));
    const high = Math.max(0, centre.z - low - data.view.ground) / (0.15 * data.scene.reach);
    [[-1, -1], [1, -1], [1, 1], [-1, 1]].forEach(([u, v], corner) => {
      position.setXYZ(4 * k + corner, x + SPREAD * a * u, y + SPREAD * (b * u + c * v),
        data.view.ground + 1e-3 * data.view.radius);
      color.setXYZW(4 * k + corner, 0, 0, 0, DARKEST / (1 + high * high));
    });
  });
  position.needsUpdate = color.needsUpdate = true;
}

// ---- camera ----------------------------------------------------------------------------------

const base = [0, 0, 0]; // where a floating base is, 0 if it is fixed
const [middle, spans] = [(low, high) => (low + high) / 2, (low, high) => high - low].map((of) =>
  [0, 1, 2].map((k) => { // of the points that must be in sight
    const along = data.view.points.map((point) => point[k]);
    return of(Math.min(...along), Math.max(...along));
  }));
let follows = floats, isTurned = false; // by hand: the view then remains when the window changes
// the viewer's camera has y upwards: (x, y, z) of the robot is (x, z, -y) there
const upward = ([x, y, z]) => new THREE.Vector3(x, z, -y);

const TALL = Math.tan((20 * Math.PI) / 180); // of half the view's angle
const FILLED = 0.9; // share of the view
const AZIMUTHS = [35, 60, -35, -60]; // [degrees] from the front; the first, unless another is closer
// height of the camera over its distance along the ground: larger for a motion that is flat, as of a planar arm
const RISE = 0.39 + 1.2 * Math.max(0, 1 - (3 * spans[2]) / Math.max(spans[0], spans[1]));

function covered(id) { // share of the view's height that controls cover on narrow pages
  const { width, height } = byId(id).getBoundingClientRect();
  return width > pane.clientWidth / 2 ? height / pane.clientHeight : 0;
}

function framed(azimuth) { // the nearest camera of a direction with all points in sight
  const turn = (azimuth * Math.PI) / 180, up = new THREE.Vector3(0, 1, 0);
  const away = new THREE.Vector3(Math.cos(turn), RISE, Math.sin(turn)).normalize();
  const right = up.clone().cross(away).normalize();
  up.copy(away).cross(right);
  const [x, y, z] = [right, up, away].map((axis) =>
    data.view.points.map((point) => upward(point.map((value, k) => value + base[k])).dot(axis)));
  const depth = Math.max(...z) / 2 + Math.min(...z) / 2;
  const fit = (across, share) => { // of the planes at both sides of the view
    const side = (sign) => Math.max(...across.map((value, k) => sign * value + share * (z[k] - depth)));
    return { far: (side(1) + side(-1)) / (2 * share), centre: (side(1) - side(-1)) / 2 };
  };
  const shape = pane.clientWidth / Math.max(pane.clientHeight, 1);
  const above = covered("tools"), below = covered("models");
  const wide = fit(x, FILLED * TALL * shape), tall = fit(y, FILLED * TALL * (1 - above - below));
  const far = Math.max(wide.far, tall.far, 1e-3);
  const target = new THREE.Vector3().addScaledVector(right, wide.centre)
    .addScaledVector(up, tall.centre + (above - below) * TALL * far).addScaledVector(away, depth);
  return { away, target, far };
}

function aim() { // from the front and above, the whole motion as large as it fits
  const { camera } = viewer;
  const views = AZIMUTHS.map(framed), nearest = Math.min(...views.map(({ far }) => far));
  const { away, target, far } = views[0].far < 1.1 * nearest ? views[0]
    : views.find((view) => view.far === nearest);
  camera.fov = 40;
  camera.near = far / 100;
  camera.far = 100 * Math.max(far, data.view.radius);
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
  for (const name of ["Axes", "Lights"]) viewer.set_property([name], "visible", false);
  makeShadow();
  paint();
  darkness.addEventListener("change", paint);
  new ResizeObserver(() => {
    if (!isTurned) aim();
    resize();
  }).observe(pane);
  byId("view").onclick = () => { isTurned = false; aim(); keep(); };
  viewer.controls.addEventListener("end", () => { isTurned = true; keep(); });
}
