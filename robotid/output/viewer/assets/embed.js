
// ---- in the frame of a report: one clock ------------------------------------------------------

const report = window.parent === window ? null : window.parent;
let isHeard = false, told = null; // the report has answered; the time that it has set

function tellReport(time) {
  if (isHeard && time !== told) report.postMessage({ robotid: "time", time }, "*");
}

function obey({ time, joint, how }) { // a cursor that passes does not stop the motion
  if (!Number.isFinite(time) || (how === "hover" && clock.playing)) return;
  pause();
  told = Math.min(Math.max(time, clock.start), clock.end);
  seek(time);
  if (joint) pick(nodeOf(joint));
}

function greetReport() {
  if (!report) return;
  window.addEventListener("message", ({ source, data: message }) => {
    if (source !== report || !message) return;
    if (message.robotid === "seek") obey(message);
    if (message.robotid !== "report") return;
    isHeard = true;
    document.body.classList.add("embedded"); // without heading, switches and charts
    readings = null;
    wake();
  });
  report.postMessage({ robotid: "replay", log: data.log, start: clock.start, end: clock.end }, "*");
}
