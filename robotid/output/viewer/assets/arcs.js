
// ---- torque arcs -----------------------------------------------------------------------------

const FULL = 1.5 * Math.PI; // [rad] arc of the largest torque of a joint

class Arc { // around a joint's axis, or a bar along it; grows with the torque from a tick at zero
  constructor(joint, radius, thickness, colour, hasHead) {
    const skin = (color) => new THREE.MeshBasicMaterial(
      { color, depthTest: false, transparent: true });
    this.material = skin(colour);
    this.isPrismatic = joint.kind === "prismatic";
    this.around = 5;
    this.along = 45;
    this.radius = radius;
    const shape = this.isPrismatic
      ? new THREE.CylinderGeometry(thickness, thickness, 1, 12).translate(0, 0.5, 0).rotateX(Math.PI / 2)
      : this.ring(radius, thickness);
    this.mesh = new THREE.Mesh(shape, this.material);
    this.length = 2 * radius;
    this.holder = new THREE.Group();
    this.holder.quaternion.setFromUnitVectors(new THREE.Vector3(0, 0, 1), joint.axis);
    this.holder.add(this.mesh);
    if (hasHead) {
      this.head = new THREE.Mesh(new THREE.ConeGeometry(2.6 * thickness, 5 * thickness, 12), this.material);
      const wide = 5 * thickness, thin = 0.7 * thickness;
      const tick = new THREE.Mesh(
        new THREE.BoxGeometry(wide, thin, thin), skin("#1c2126")); // where the torque is zero
      if (!this.isPrismatic) tick.position.x = radius;
      this.holder.add(this.head, tick);
    }
    this.holder.children.forEach((mesh) => { mesh.renderOrder = 3; });
    joint.object.add(this.holder);
  }
  ring(radius, thickness) {
    const shape = new THREE.TorusGeometry(radius, thickness, this.around, this.along, FULL);
    const index = [], across = this.along + 1; // its triangles, in the order of the sweep
    for (let i = 0; i < this.along; i++) {
      for (let j = 0; j < this.around; j++) {
        const a = across * j + i, b = across * (j + 1) + i;
        index.push(a, b, a + 1, b, b + 1, a + 1);
      }
    }
    shape.setIndex(index);
    return shape;
  }
  show(share) { // of the largest torque, -1 to 1
    const parts = this.head ? [this.mesh, this.head] : [this.mesh];
    parts.forEach((part) => { part.visible = Number.isFinite(share); });
    if (!Number.isFinite(share)) return;
    const size = Math.min(Math.abs(share), 1), sense = share < 0 ? -1 : 1;
    if (this.isPrismatic) {
      this.mesh.scale.z = this.length * Math.max(size, 1e-3) * sense;
    } else {
      this.mesh.scale.y = sense;
      this.mesh.geometry.setDrawRange(0, Math.max(1, Math.round(size * this.along)) * this.around * 6);
    }
    if (this.head) this.point(size, sense);
  }
  point(size, sense) { // the head at the end, hidden for small torques
    const { head } = this;
    head.visible = size > 0.02;
    if (this.isPrismatic) {
      head.position.set(0, 0, sense * this.length * size);
      head.rotation.set(sense * Math.PI / 2, 0, 0);
    } else {
      const angle = sense * FULL * size;
      head.position.set(this.radius * Math.cos(angle), this.radius * Math.sin(angle), 0);
      head.rotation.set(0, 0, sense > 0 ? angle : angle + Math.PI);
    }
  }
}

const arcs = [];
let showsArcs = true, tints = false;
const inkOfArcs = () => (darkness.matches ? "#e9edf2" : "#1c2126");
if (isTorque && viewer) {
  const crowd = Math.min(1, 3 / Math.sqrt(count)); // many joints have small arcs
  const radius = crowd * Math.max(0.06 * data.scene.reach, 0.05 * data.view.radius);
  torques.joints.forEach(({ node }) => {
    const joint = robot.joints[node];
    arcs.push({
      measured: new Arc(joint, radius, 0.12 * radius, UNSURE, true),
      predicted: predictions ? new Arc(joint, 0.72 * radius, 0.06 * radius, inkOfArcs(), false) : null,
    });
  });
  darkness.addEventListener("change", () => {
    arcs.forEach(({ predicted }) => predicted && predicted.material.color.set(inkOfArcs()));
    viewer.set_dirty();
  });
}

function showArcs(row) {
  torques.joints.forEach(({ node }, j) => {
    const colour = residualColour(residualShare(row, j));
    if (tints) robot.tint(node, colour);
    if (!arcs.length) return;
    const { measured, predicted } = arcs[j];
    measured.show(row[j] / (largest[j] || 1));
    if (predicted) predicted.show(predictedOf(row, j) / (largest[j] || 1));
    measured.material.color.set(colour);
  });
}

function chooseArcs() { // all, or the selected joint's and faint others
  const isChosen = torques && torques.joints.some(({ node }) => node === picked);
  arcs.forEach(({ measured, predicted }, j) => {
    const isPicked = torques.joints[j].node === picked;
    for (const arc of [measured, predicted]) {
      if (!arc) continue;
      arc.holder.visible = showsArcs || isPicked;
      arc.holder.children.forEach((mesh) => {
        mesh.material.opacity = isChosen && !isPicked ? 0.25 : 1;
      });
    }
  });
  if (viewer) viewer.set_dirty();
}
