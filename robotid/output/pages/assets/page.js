"use strict";
(() => {
// ---- folded parts: opened by links and in print

const folds = [...document.querySelectorAll("details")];

function reveal() {
  const target = document.getElementById(location.hash.slice(1));
  if (!target) return;
  for (let at = target; at; at = at.parentElement) if (at.localName === "details") at.open = true;
  target.scrollIntoView();
}

window.addEventListener("hashchange", reveal);
document.addEventListener("click", (event) => {  // a link to the current address
  const link = event.target.closest && event.target.closest('a[href^="#"]');
  if (link && link.hash === location.hash) reveal();
});

let closed = [];
window.addEventListener("beforeprint", () => {
  closed = folds.filter((fold) => !fold.open);
  for (const fold of closed) fold.open = true;
});
window.addEventListener("afterprint", () => { for (const fold of closed) fold.open = false; });

// ---- copying of commands and lines of a job file

window.copyText = async (text, button) => {
  const label = button.dataset.label ??= button.textContent;
  try {
    await navigator.clipboard.writeText(text);
    button.textContent = "Copied";
  } catch (error) {
    button.textContent = "Not allowed: select it and press Ctrl-C";
  }
  setTimeout(() => { button.textContent = label; }, 1500);
};

for (const block of document.querySelectorAll("pre.command")) {
  const button = document.createElement("button");
  button.type = "button";
  button.textContent = "Copy";
  button.setAttribute("aria-label", `Copy: ${block.textContent.trim().split("\n")[0]}`);
  button.addEventListener("click", () => window.copyText(block.textContent.trim(), button));
  block.after(button);
}

reveal();
})();
