"use strict";
// The replay at the lower edge of the window. It has the clock of the charts of its recording.
(() => {
const PATIENCE = 1500; // [ms] after which a frame that does not answer has no replay
const place = document.getElementById("replay");
const { file } = place.dataset, clips = JSON.parse(place.dataset.clips);
const dock = element("aside", { id: "dock", "aria-label": "Replay" });
const state = element("p", { role: "status" }), command = element("div");
let frame = null, opener = null; // the loaded page; where the focus was
let asked = {}; // time, joint and log of the last link
let own = []; // the recordings that the replay shows, and their links, once it has answered
let isHeard = false;

function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

function button(words, act) {
  const made = element("button", { type: "button" }, words);
  made.onclick = act;
  return made;
}

const copy = button("Copy", () => window.copyText(command.textContent, copy));
const reload = button("Reload", () => {
  load(new URLSearchParams(asked).toString());
  describe();
});

// ---- the frame -------------------------------------------------------------------------------

function show(at) { // "t=…&joint=…&log=…", or "" for the start
  asked = Object.fromEntries(new URLSearchParams(at));
  opener = document.activeElement;
  if (!dock.isConnected) document.body.append(dock);
  document.body.classList.add("docked");
  if (!isHeard) load(at);
  else if (at) tell({ robotid: "seek", time: Number(asked.t), joint: asked.joint, how: "click" });
  describe();
}

function load(at) {
  leave();
  frame = element("iframe", { title: "Replay", src: at ? `${file}#${at}` : file });
  frame.onload = () => setTimeout(describe, PATIENCE, true);
  dock.append(frame);
}

function leave() { // without frame, the charts have no clock
  for (const { off, link } of own) { off(); link.set(NaN); }
  [own, isHeard] = [[], false];
  if (frame) frame.remove();
}

function close() {
  leave();
  frame = null;
  dock.remove();
  document.body.classList.remove("docked");
  if (opener) opener.focus();
}

function describe(isLate = false) {
  const { log } = dock.dataset, isOther = asked.log && asked.log !== log;
  const [clip = {}] = clips.filter((one) => !asked.log || one.log === asked.log);
  let words = "Loading the replay.";
  if (isHeard && isOther) words = `The replay shows ${log}. This command writes that of ${asked.log}:`;
  else if (isHeard) words = own.length ? `Replay of ${log}` : `The replay shows ${log}, which has no chart here.`;
  else if (isLate) words = `${decodeURI(file)} is missing, or another version of robotid wrote it. This command writes it; then reload.`;
  const needs = isHeard ? isOther : isLate;
  state.textContent = words;
  command.innerHTML = clip.command || "";
  command.hidden = copy.hidden = !needs || !clip.command;
  reload.hidden = isHeard;
  dock.classList.toggle("missing", isLate && !isHeard);
}

// ---- one clock -------------------------------------------------------------------------------

function tell(message) { frame.contentWindow.postMessage(message, "*"); }

function greet({ log, start, end }) { // the replay is there
  isHeard = true;
  dock.dataset.log = log;
  own = clips.filter((clip) => clip.log === log && clip.start < end && clip.end > start).map((clip) => {
    const link = window.charts.link(clip.link);
    const off = link.on((time, how) => {
      if (how !== "set" && Number.isFinite(time)) tell({ robotid: "seek", time, how });
    });
    return { ...clip, link, off };
  });
  tell({ robotid: "report" });
  describe();
}

function follow(time) { // the charts' cursor, except one under the pointer
  for (const { link, start, end } of own) {
    const there = start <= time && time <= end ? time : NaN;
    const isHovered = link.shown !== link.time && Number.isFinite(link.shown);
    if (isHovered) link.time = there; else link.set(there);
  }
}

window.addEventListener("message", ({ source, data }) => {
  if (!frame || source !== frame.contentWindow || !data) return;
  if (data.robotid === "replay") greet(data);
  if (data.robotid === "time" && Number.isFinite(data.time)) follow(data.time);
});

// ---- links and buttons -----------------------------------------------------------------------

const bar = element("div", { class: "bar" }, state, command, copy, reload,
  element("a", { href: file, target: "replay" }, "Open in a tab"), button("Close", close));
dock.append(bar);
const opens = place.querySelector("button");
opens.onclick = () => show("");
opens.hidden = false;
document.addEventListener("click", (event) => {
  const link = event.target.closest && event.target.closest("a[data-at]");
  if (!link || event.ctrlKey || event.metaKey || event.shiftKey) return;
  event.preventDefault();
  show(link.dataset.at);
});
})();
