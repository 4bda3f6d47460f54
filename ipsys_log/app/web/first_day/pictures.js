// The image of a camera, and the arrow of its alignment.
import { element, make } from "./make.js";

// Small angles are hard to see: the arrow is longer than the distance in the image.
const GROWTH = 5;

export function cameraImage(address, name, missing) {
  if (!address) return make("div", { className: "image", textContent: missing });
  return make("div", { className: "image" }, make("img", { src: address, alt: `Image of ${name}` }));
}

export function alignedImage(one) {
  const [width, height] = one.size_px;
  const svg = element("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `${one.camera}: ${one.advice}` });
  if (one.picture) svg.append(element("image", { href: one.picture, width, height }));
  for (const [x, y] of one.markers_px) svg.append(element("circle", { cx: x, cy: y, r: width / 60 }));
  svg.append(arrow(one, width, height));
  return make("div", { className: "image" }, svg);
}

function arrow(one, width, height) {
  const [x, y] = one.centre_px;
  const group = element("g", { class: one.level ? "level" : "tilted" });
  const paths = [`M${x - width / 50} ${y}h${width / 25}M${x} ${y - width / 50}v${width / 25}`];
  if (one.plumb_px && !one.level) {
    const [dx, dy] = [one.plumb_px[0] - x, one.plumb_px[1] - y].map((d) => d * GROWTH);
    const length = Math.hypot(dx, dy), scale = Math.min(1, (height * 0.45) / Math.max(length, 1));
    const [ex, ey] = [x + dx * scale, y + dy * scale];
    if (length > width / 100) {
      const head = Math.min(length * scale, width / 25), turn = Math.atan2(dy, dx);
      const [a, b] = [turn + 2.6, turn - 2.6].map((angle) => `${ex + head * Math.cos(angle)} ${ey + head * Math.sin(angle)}`);
      paths.push(`M${x} ${y}L${ex} ${ey}`, `M${a}L${ex} ${ey}L${b}`);
    }
  }
  for (const kind of ["shadow", "shaft"]) for (const d of paths) group.append(element("path", { class: kind, d }));
  return group;
}

// The present image of a camera with the board, and the boards of all kept pictures.
export function boardImage(board) {
  const [width, height] = board.size_px;
  const svg = element("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `${board.count} pictures of the board` });
  svg.append(element("image", { href: `picture/board/${board.number}`, width, height }));
  for (const outline of board.kept_px) svg.append(element("polygon", { class: "kept", points: outline.join(" ") }));
  if (board.board_px) svg.append(element("polygon", { class: "present", points: board.board_px.join(" ") }));
  return [make("div", { className: "image" }, svg), make("p", { className: "text", textContent: `${board.count} pictures; ${board.advice.join("; ")}.` })];
}

// The floor with its two reference points as typed; nothing while a value is missing.
export function floorSketch(typed) {
  const { width_m: width, depth_m: depth } = typed;
  const points = [["A", typed.first_x_m, typed.first_y_m], ["B", typed.second_x_m, typed.second_y_m]];
  if (!(width > 0 && depth > 0) || points.flat().some((value) => Number.isNaN(value))) return [];
  const unit = Math.max(width, depth) / 20, edge = 2.5 * unit;
  const text = (x, y, content) => element("text", { x, y: depth - y, "font-size": 1.7 * unit }, content);
  const svg = element("svg", { viewBox: `${-edge} ${-edge} ${width + 2 * edge} ${depth + 2 * edge}`, role: "img", "aria-label": "The floor from above, with the reference points A and B" });
  svg.append(element("rect", { width, height: depth }), element("path", { d: `M${unit * 4} ${depth}H0V${depth - unit * 4}`, class: "axes" }), text(unit * 4.4, -unit * 0.4, "x"), text(-unit * 0.4, unit * 4.6, "y"));
  for (const [name, x, y] of points) svg.append(element("circle", { cx: x, cy: depth - y, r: unit / 2 }), text(x + unit, y + unit / 2, name));
  return [svg];
}

// The image of each camera during a drive; the cells in which a robot was are marked.
export function driveImages(views) {
  return views.map(({ camera, picture, cells, share }) => {
    const text = `${camera}: ${Math.round(share * 100)} % of the image covered`;
    const [width, height] = [16, 9], [w, h] = [width / cells[0].length, height / cells.length];
    const svg = element("svg", { viewBox: `0 0 ${width} ${height}`, preserveAspectRatio: "none", role: "img", "aria-label": text });
    if (picture) svg.append(element("image", { href: picture, width, height, preserveAspectRatio: "none" }));
    cells.forEach((row, y) => row.forEach((is, x) => { if (is) svg.append(element("rect", { x: x * w, y: y * h, width: w, height: h, class: "covered" })); }));
    return make("div", { className: "card" }, make("div", { className: "image" }, svg), make("div", {}, make("p", { textContent: text })));
  });
}

// The floor from above: A and B, measured points, numbered places for further ones, and the part to drive through.
export function floorMap({ floor: [width, depth], references, done, proposed }, gap) {
  const unit = Math.max(width, depth) / 20;
  const text = (x, y, content) => element("text", { x: x + unit * 0.7, y: depth - y + unit * 0.4, "font-size": unit }, content);
  const svg = element("svg", { viewBox: `${-unit} ${-unit} ${width + 2 * unit} ${depth + 2 * unit}`, role: "img",
    "aria-label": `The floor from above: ${done.length} measured, ${proposed.length} proposed` });
  svg.append(element("rect", { width, height: depth, class: "ground" }));
  if (gap) {
    const [[x0, y0], [x1, y1]] = gap;
    svg.append(element("rect", { x: x0, y: depth - y1, width: x1 - x0, height: y1 - y0, class: "gap" }), text(x0, (y0 + y1) / 2, "drive here"));
  }
  for (const { name, x_m: x, y_m: y } of references) svg.append(element("rect", { x: x - unit / 3, y: depth - y - unit / 3, width: unit / 1.5, height: unit / 1.5, class: "reference" }), text(x, y, name));
  for (const [x, y] of done) svg.append(element("circle", { cx: x, cy: depth - y, r: unit / 2.5, class: "done" }));
  proposed.forEach(({ point_m: [x, y] }, n) => svg.append(element("circle", { cx: x, cy: depth - y, r: unit / 2, class: "proposed" }), text(x, y, String(n + 1))));
  const rows = proposed.map(({ tapes }) => make("li", { textContent: Object.entries(tapes).map(([name, cm]) => `${name} ${cm} cm`).join(", ") }));
  return make("div", { className: "map" }, svg, ...(rows.length ? [make("div", {}, make("p", { textContent: "Points to measure, at about these distances:" }), make("ol", {}, ...rows))] : []));
}
