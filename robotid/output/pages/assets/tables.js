"use strict";
(() => {
// ---- content of a cell: the full number, or its text

const MINUS = /\u2212/g;

function numberOf(cell) {
  const value = cell.dataset.value;
  return value === undefined ? NaN : Number(value);
}

function wordsOf(cell) {
  const words = cell.textContent.trim().replace(MINUS, "-");
  return words === "\u2013" ? "" : words;
}

function plain(cell) {
  return cell.dataset.value === undefined ? wordsOf(cell) : cell.dataset.value;
}

// ---- rows that are shown, as text

function shownRows(table) {
  return [...table.tBodies[0].rows].filter((row) => !row.hidden);
}

function lines(table, join) {
  const head = [...table.tHead.rows[0].cells].map(wordsOf);
  return [head, ...shownRows(table).map((row) => [...row.cells].map(plain))].map(join);
}

function quoted(words) {
  return /[",\n]/.test(words) ? `"${words.replace(/"/g, '""')}"` : words;
}

function toCsv(table) {
  return lines(table, (cells) => cells.map(quoted).join(",")).join("\r\n") + "\r\n";
}

function toTabs(table) {
  return lines(table, (cells) => cells.join("\t")).join("\n");
}

function saveCsv(table) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([toCsv(table)], { type: "text/csv" }));
  link.download = `${table.caption.textContent.replace(/[^\w]+/g, "_")}.csv`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

// ---- sorting: by number, cells without number last, then by text

function compare(one, other, sign) {
  const [a, b] = [numberOf(one), numberOf(other)];
  if (!Number.isNaN(a) && !Number.isNaN(b)) return sign * (a - b);
  if (Number.isNaN(a) !== Number.isNaN(b)) return Number.isNaN(a) ? 1 : -1;
  return sign * wordsOf(one).localeCompare(wordsOf(other), "en", { numeric: true });
}

function sort(table, column) {
  const heads = [...table.tHead.rows[0].cells], head = heads[column];
  const sign = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
  for (const other of heads) other.setAttribute("aria-sort", "none");
  head.setAttribute("aria-sort", sign > 0 ? "ascending" : "descending");
  const rows = [...table.tBodies[0].rows];
  rows.sort((a, b) => compare(a.cells[column], b.cells[column], sign));
  table.tBodies[0].append(...rows);
}

// ---- the tools of one table

function tool(label, run) {
  const button = document.createElement("button");
  button.type = "button";
  button.textContent = label;
  button.addEventListener("click", () => run(button));
  return button;
}

function equip(table) {
  const bar = document.createElement("div"), filter = document.createElement("input");
  const count = document.createElement("output"), total = table.tBodies[0].rows.length;
  const name = table.caption.textContent;
  bar.className = "tools";
  filter.type = "search";
  filter.placeholder = "Filter rows";
  filter.setAttribute("aria-label", `Filter the rows of: ${name}`);
  filter.addEventListener("input", () => {
    const wanted = filter.value.toLowerCase().split(/\s+/).filter(Boolean);
    for (const row of table.tBodies[0].rows) {
      const words = row.textContent.toLowerCase();
      row.hidden = !wanted.every((word) => words.includes(word));
    }
    count.textContent = `${shownRows(table).length} of ${total} rows`;
  });
  count.textContent = `${total} rows`;
  bar.append(
    filter,
    count,
    tool("Copy", (button) => window.copyText(toTabs(table), button)),
    tool("Save CSV", () => saveCsv(table)),
  );
  table.parentElement.before(bar);
  [...table.tHead.rows[0].cells].forEach((head, column) => {
    const button = tool(head.textContent, () => sort(table, column));
    head.setAttribute("aria-sort", "none");
    head.replaceChildren(button);
  });
}

for (const table of document.querySelectorAll("table.data")) equip(table);
})();
