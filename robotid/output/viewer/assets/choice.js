
// ---- the shown prediction: URDF, URDF + drives, identified ------------------------------------

const models = isTorque && predictions > 1 ? torques.labels.slice(1) : [];

function drawModels() { // the first prediction is the last of the switch
  byId("models").hidden = !models.length;
  [...models.entries()].reverse().forEach(([k, label]) => {
    const input = element("input", { type: "radio", name: "model", value: k });
    input.checked = k === chosen;
    input.onchange = () => choose(k);
    byId("models").append(element("label", {}, input, element("span", {}, label)));
  });
}

function choose(k) { // arcs, links, heat strip and charts show it
  chosen = k;
  byId("models").querySelector(`[value="${k}"]`).checked = true;
  levels = unpack(torques.strips[k]);
  drawStrip();
  torqueCharts.forEach(({ chart, below }, j) => {
    models.forEach((_, i) => { if (chart.hidden.has(1 + i) === (i === k)) chart.toggle(1 + i); });
    below.setData(torqueTable.t, [torqueRows(j)[1]]);
  });
  shown = readings = null;
  keep();
  wake();
}
