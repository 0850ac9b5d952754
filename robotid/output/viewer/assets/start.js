
// ---- start -----------------------------------------------------------------------------------

slider.min = clock.start;
slider.max = clock.end;
clockText.style.minWidth = `${2 * digits(clock.end).length + 3}ch`; // nothing moves while the time changes
timeLine.whole = span();
if (torques) drawTorques();
if (bands) drawBands();
byId("side").hidden = false;
drawSwitches();
drawModels();
data.marks.forEach(addMark);
restore();
showMasses();
chooseArcs();
buttons();
show();
greetReport();
if (viewer) viewer.set_dirty = () => { viewer.needs_render = true; wake(); };
wake();

// for scripts and notebooks: the clock, and the world pose of every node as 16 numbers by columns
window.replay = { clock, seek, choose, play, pause, pick, draw, pace, viewer, motion, arcs, masses,
  level, bins, torqueCharts, bandCharts,
  ghosts, robot, shadow, get picked() { return picked && data.scene.nodes[picked].name; },
  poses: (which = robot) => {
    which.root.updateMatrixWorld(true);
    const inverse = viewer.scene.matrixWorld.clone().invert();
    return which.joints.map(({ object }) =>
      inverse.clone().multiply(object.matrixWorld).toArray());
  } };
