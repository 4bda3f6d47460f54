// The floor from above, x to the right and y up; 100 units are one metre.
import { element } from "./make.js";

const UNITS = 100, PAD = 30;

// lab: references, floor; found: result of the check; done: points measured so far; choose(side): callback.
export function drawFloor(svg, lab, found, done, colours, choose) {
  const [width, depth, x0, y0] = extent(lab);
  const at = ([x, y]) => [(x - x0) * UNITS, (depth + y0 - y) * UNITS];
  const circle = (point, r, kind, more = {}) => {
    const [cx, cy] = at(point);
    return element("circle", { cx, cy, r, class: kind, ...more });
  };
  svg.setAttribute("viewBox", `${-PAD} ${-PAD} ${width * UNITS + 2 * PAD} ${depth * UNITS + 2 * PAD}`);
  const [w, h] = [width * UNITS, depth * UNITS];
  const parts = [element("rect", { x: 0, y: 0, width: w, height: h, class: lab.floor ? "ground" : "plain" })];
  for (let m = Math.ceil(x0); m < x0 + width; m++) {
    const [x] = at([m, 0]);
    if (x > 0) parts.push(element("line", { x1: x, x2: x, y1: 0, y2: h, class: "grid" }));
  }
  for (let m = Math.ceil(y0); m < y0 + depth; m++) {
    const [, y] = at([0, m]);
    if (y < h) parts.push(element("line", { x1: 0, x2: w, y1: y, y2: y, class: "grid" }));
  }
  const clip = element("clipPath", { id: "on-map" }, element("rect", { x: -PAD, y: -PAD, width: w + 2 * PAD, height: h + 2 * PAD }));
  const points = lab.references.map((r) => [r.x_m, r.y_m]);
  const [ax, ay] = at(points[0]), [bx, by] = at(points[1]);
  parts.push(clip, element("line", { x1: ax, y1: ay, x2: bx, y2: by, class: "line" }));
  for (const point of done) parts.push(circle(point, 6, "done"));
  lab.references.forEach((reference, n) => {
    const tape = found.tapes?.[reference.name];
    if (tape > 0) parts.push(circle(points[n], tape * UNITS, "tape", { "clip-path": "url(#on-map)" }));
    const [x, y] = at(points[n]);
    parts.push(element("rect", { x: x - 7, y: y - 7, width: 14, height: 14, class: "reference" }));
    parts.push(element("text", { x: x - 8, y: y - 16 }, reference.name));
  });
  for (const { side, point_m } of found.sides ?? []) {
    const dot = circle(point_m, 16, "maybe", { role: "button", tabindex: 0, "aria-label": `The point is on the ${side}` });
    dot.addEventListener("click", () => choose(side));
    dot.addEventListener("keydown", (event) => event.key === "Enter" && choose(side));
    const [x, y] = at(point_m);
    parts.push(dot, element("text", { x: x + 22, y: y + 5 }, `${side}?`));
  }
  if (found.point_m) {
    const [x, y] = at(found.point_m);
    const off = found.warnings.length || !found.ready;
    parts.push(circle(found.point_m, 12, off ? "place off" : "place"));
    for (const one of found.predictions) {
      const [px, py] = at(one.point_m), stroke = colours[one.camera];
      const d = `M${x},${y}L${px},${py}m-9,-9l18,18m0,-18l-18,18`;
      parts.push(element("path", { d, class: "halo" }), element("path", { d, class: "predicted", stroke }));
    }
    parts.push(element("text", { x: x + 16, y: y - 12 }, found.id));
  }
  svg.replaceChildren(...parts);
}

// Return width and depth in m, and the corner: of the floor, or of the area around the reference points.
function extent(lab) {
  if (lab.floor) return [...lab.floor, 0, 0];
  const reach = 3;
  const xs = lab.references.map((r) => r.x_m), ys = lab.references.map((r) => r.y_m);
  const [x0, y0] = [Math.min(...xs) - reach, Math.min(...ys) - reach];
  return [Math.max(...xs) + reach - x0, Math.max(...ys) + reach - y0, x0, y0];
}
