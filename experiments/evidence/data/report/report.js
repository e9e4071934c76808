"use strict";

// A click on a header sorts by its column: ascending, descending, then in the original order.
const NEXT = { none: "ascending", ascending: "descending", descending: "none" };
const WORDS = new Intl.Collator("en", { numeric: true });

// The number in a cell, its words without footnotes, or null where it is empty.
function keyOf(cell) {
  const number = cell.dataset.sort;
  if (number === undefined) return cell.firstElementChild.firstChild.textContent;
  return number === "" ? null : Number(number);
}

function sorted(rows, column, direction) {
  const keyed = rows.map((row) => ({ row, key: keyOf(row.cells[column]) }));
  const empty = keyed.filter(({ key }) => key === null);
  const filled = keyed.filter(({ key }) => key !== null);
  const numbers = filled.every(({ key }) => typeof key === "number");
  const sign = direction === "ascending" ? 1 : -1;
  filled.sort((a, b) => sign * (numbers ? a.key - b.key : WORDS.compare(a.key, b.key)));
  return [...filled, ...empty].map(({ row }) => row); // empty cells stay last
}

function makeSortable(table) {
  const places = [...table.tBodies].map((body) => ({ body, rows: [...body.rows] }));
  const apart = ({ body }) => body.classList.contains("apart");
  const parts = [places.filter((place) => !apart(place)), places.filter(apart)];
  if (places.flatMap(({ rows }) => rows).length < 2) return;
  const headers = [...table.tHead.rows[0].cells];
  headers.forEach((header, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...header.childNodes);
    header.append(button);
    header.setAttribute("aria-sort", "none");
    button.addEventListener("click", () => {
      const direction = NEXT[header.getAttribute("aria-sort")];
      for (const other of headers) other.setAttribute("aria-sort", "none");
      header.setAttribute("aria-sort", direction);
      for (const { body, rows } of places) body.append(...rows);
      if (direction === "none") return;
      for (const part of parts) {
        const rows = part.flatMap((place) => place.rows);
        part[0]?.body.append(...sorted(rows, column, direction));
      }
    });
  });
}

function selectAll(element) {
  const range = document.createRange();
  range.selectNodeContents(element);
  const selection = getSelection();
  selection.removeAllRanges();
  selection.addRange(range);
}

function makeCopyable(block) {
  const button = document.createElement("button");
  button.type = "button";
  button.textContent = "Copy";
  button.addEventListener("click", async () => {
    selectAll(block); // without a clipboard, the text can be copied by hand
    try {
      await navigator.clipboard.writeText(block.textContent);
      button.textContent = "Copied";
    } catch {
      button.textContent = "Selected";
    }
    setTimeout(() => (button.textContent = "Copy"), 2000);
  });
  block.parentElement.after(button);
}

document.querySelectorAll("table.sortable").forEach(makeSortable);
document.querySelectorAll("pre > code").forEach(makeCopyable);
