
// ---- centres of mass and equimomental ellipsoids ---------------------------------------------

const EDGES = viewer && principalCircles(48);
function principalCircles(steps) { // of the unit ball, in the planes of its axes
  const places = [];
  for (const [a, b] of [[0, 1], [1, 2], [2, 0]]) {
    for (let k = 0; k < 2 * steps; k++) { // each segment has two ends
      const angle = (2 * Math.PI * ((k + 1) >> 1)) / steps, place = [0, 0, 0];
      [place[a], place[b]] = [Math.cos(angle), Math.sin(angle)];
      places.push(...place);
    }
  }
  return new THREE.BufferGeometry().setAttribute("position", new THREE.Float32BufferAttribute(places, 3));
}

class Masses { // an ellipsoid is outlined, so that the link in it remains visible
  constructor(set, colour) {
    this.bodies = set.bodies.map((body) => ({ ...body, objects: [], isAsked: false }));
    this.colour = colour;
    if (!viewer) return;
    const ball = new THREE.SphereGeometry(1, 20, 12);
    const size = 0.012 * data.scene.reach;
    for (const body of this.bodies) {
      const node = robot.joints[body.node].object;
      if (body.com) {
        const dot = new THREE.Mesh(ball, new THREE.MeshBasicMaterial({ color: colour, depthTest: false }));
        dot.position.set(...body.com);
        dot.scale.setScalar(size);
        dot.renderOrder = 4;
        body.objects.push(dot);
      }
      if (body.semi_axes) {
        const solid = new THREE.Mesh(ball, new THREE.MeshBasicMaterial(
          { color: colour, transparent: true, opacity: 0.16, depthWrite: false }));
        const edges = new THREE.LineSegments(EDGES, new THREE.LineBasicMaterial(
          { color: colour, transparent: true, depthTest: false }));
        edges.renderOrder = 4;
        for (const part of [solid, edges]) {
          part.position.set(...body.com);
          part.quaternion.set(...body.quaternion);
          part.scale.set(...body.semi_axes.map((a) => Math.max(a, 1e-4)));
        }
        solid.renderOrder = 1;
        body.objects.push(solid, edges);
      }
      body.objects.forEach((object) => node.add(object));
    }
  }
}

const masses = data.masses.map((set, k) => new Masses(set, COLOURS[k % COLOURS.length]));

function showMasses() { // the requested ones, and those of the selected link
  if (!viewer) return;
  for (const set of masses) {
    for (const body of set.bodies) {
      const on = body.isAsked || body.node === picked;
      body.objects.forEach((object) => { object.visible = on; });
    }
  }
  viewer.set_dirty();
}
