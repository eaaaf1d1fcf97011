// The table sorted by any column, and runs ranked by any metric: pictures and the line that names the best follow. Without it the page stands as it is.
"use strict";
const table = document.querySelector("table.runs");
const rows = () => Array.from(table.tBodies[0].rows);
const value = (row, column) => {
  const cell = row.cells[column];
  return cell.dataset.value === undefined ? cell.textContent.trim() : cell.dataset.value === "" ? null : Number(cell.dataset.value);
};
const compare = (a, b) => (typeof a === "number" && typeof b === "number" ? a - b : String(a).localeCompare(String(b), undefined, { numeric: true }));

function sort(column, up) {
  const known = [], missing = [];
  for (const row of rows()) (value(row, column) === null ? missing : known).push(row);
  known.sort((a, b) => (up ? 1 : -1) * compare(value(a, column), value(b, column)));
  table.tBodies[0].append(...known, ...missing);
  Array.from(table.tHead.rows[0].cells).forEach((head, place) => {
    if (place === column) head.setAttribute("aria-sort", up ? "ascending" : "descending");
    else head.removeAttribute("aria-sort");
  });
}

function rank(metric) {
  const heads = Array.from(table.tHead.rows[0].cells);
  const column = heads.findIndex((head) => head.dataset.metric === metric);
  sort(column, heads[column].dataset.better === "less");
  const order = new Map(rows().map((row, place) => [row.dataset.run, place]));
  for (const grid of document.querySelectorAll(".pictures")) {
    const shown = Array.from(grid.querySelectorAll("figure[data-run]"));
    shown.sort((a, b) => order.get(a.dataset.run) - order.get(b.dataset.run));
    grid.append(...shown);
  }
  const first = rows()[0];
  document.getElementById("best").textContent = value(first, column) === null ? "" : first.cells[0].textContent.trim() + ": " + first.cells[column].textContent.trim();
  rows().forEach((row) => row.classList.toggle("front", row === first));
}

if (table) {
  Array.from(table.tHead.rows[0].cells).forEach((head, column) => {
    const button = document.createElement("button");
    button.textContent = head.textContent;
    head.replaceChildren(button);
    button.addEventListener("click", () => sort(column, head.getAttribute("aria-sort") ? head.getAttribute("aria-sort") !== "ascending" : head.dataset.better === "less" || !head.dataset.metric));
  });
  const choice = document.getElementById("metric");
  if (choice) {
    choice.closest(".choose").hidden = false;
    choice.addEventListener("change", () => rank(choice.value));
    rank(choice.value);
  }
}
