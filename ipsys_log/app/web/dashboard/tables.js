// Tables that change only with their content.
import { make } from "./make.js";

// Replace the content only if it changed, so that selected text and the focus stay.
export function fill(where, key, parts) {
  const text = JSON.stringify(key);
  if (where.dataset.content === text) return;
  where.dataset.content = text;
  where.replaceChildren(...parts());
}

export function table(where, headings, rows, empty) {
  fill(where, [headings, rows], () => rows.length
    ? [make("thead", {}, make("tr", {}, ...headings.map((text) => make("th", { scope: "col" }, text)))),
      make("tbody", {}, ...rows.map(([name, ...cells]) => make("tr", {}, make("th", { scope: "row" }, name),
        ...cells.map((cell) => (Array.isArray(cell) ? make("td", { className: cell[1] }, cell[0]) : make("td", {}, cell))))))]
    : [make("caption", {}, empty)]);
}

// A number of faults; one of them is already bad.
export const count = (number) => (number ? [String(number), "bad"] : String(number ?? "–"));
