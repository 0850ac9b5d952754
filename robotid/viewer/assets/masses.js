
// ---- centres of mass and equimomental ellipsoids ---------------------------------------------

class Masses {
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
        dot.renderOrder = 3;
        body.objects.push(dot);
      }
      if (body.semi_axes) {
        const skin = new THREE.MeshPhongMaterial(
          { color: colour, transparent: true, opacity: 0.35, depthWrite: false });
        const solid = new THREE.Mesh(ball, skin);
        solid.position.set(...body.com);
        solid.quaternion.set(...body.quaternion);
        solid.scale.set(...body.semi_axes.map((a) => Math.max(a, 1e-4)));
        solid.renderOrder = 1;
        body.objects.push(solid);
      }
      body.objects.forEach((object) => node.add(object));
    }
  }
}

const masses = data.masses.map((set, k) => new Masses(set, COLOURS[k % COLOURS.length]));
let seeThrough = false;

function showMasses() { // the requested ones, and those of the selected link
  if (!viewer) return;
  const inside = new Set();
  for (const set of masses) {
    for (const body of set.bodies) {
      const on = body.isAsked || body.node === picked;
      if (on) inside.add(body.node);
      body.objects.forEach((object) => { object.visible = on; });
    }
  }
  robot.joints.forEach((_, i) => robot.fade(i, seeThrough ? 0.35 : inside.has(i) ? 0.5 : 1));
  viewer.set_dirty();
}
