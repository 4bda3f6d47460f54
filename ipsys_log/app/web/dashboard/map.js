// The floor from above, x to the right and y up: fields of view, robots, trails and ellipses.
import { element, make } from "./make.js";

const PAD = { left: 34, right: 12, top: 12, bottom: 40 };
const TRAIL_MS = 10000, STALE_MS = 500;
// A legend of more cameras is longer than the map, and their outlines hide the robots: their names are on the
// map instead, and the outline of a selected one.
const MOST_IN_LEGEND = 6;
// More names of robots overlap on a map that is less wide, in px; the table has them, too.
const MOST_NAMES = 6, ROOM_FOR_NAMES = 560;
const STEPS_M = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50];

export const isMany = (cameras) => cameras.length > MOST_IN_LEGEND;

export class FloorMap {
  constructor(svg, legend, growth, view, scene) {
    Object.assign(this, { svg, growth, view, floor: scene.floor, trails: new Map(), robots: new Map(), data: null });
    for (const [name, points] of Object.entries(scene.trails)) this.trails.set(name, points);
    this.still = element("g");
    this.moving = element("g", { "clip-path": "url(#on-map)" });
    svg.replaceChildren(this.still, this.moving);
    this.fillLegend(legend);
    this.fillViews();
    growth.addEventListener("change", () => this.data && this.move(this.data));
    new ResizeObserver(() => this.resize()).observe(svg.parentElement);
    this.resize();
  }

  // Fit the map to the width of its panel; on a desktop it also fits the height of the window.
  resize() {
    const [x0, y0, x1, y1] = this.floor.bounds;
    const wide = this.svg.clientWidth, most = Math.max(0.7 * innerHeight, 260);
    const inner = wide - PAD.left - PAD.right;
    const scale = Math.min(inner / (x1 - x0), (most - PAD.top - PAD.bottom) / (y1 - y0));
    if (!(scale > 0)) return; // the page has no layout yet
    this.scale = scale;
    const high = (y1 - y0) * this.scale + PAD.top + PAD.bottom;
    const left = PAD.left + (inner - (x1 - x0) * this.scale) / 2;
    this.at = (x, y) => [left + (x - x0) * this.scale, PAD.top + (y1 - y) * this.scale];
    this.svg.style.height = `${high}px`;
    this.svg.setAttribute("viewBox", `0 0 ${wide} ${high}`);
    this.drawStill();
    if (this.data) this.move(this.data);
  }

  drawStill() {
    const [x0, y0, x1, y1] = this.floor.bounds, at = this.at;
    const [left, top] = at(x0, y1), [right, bottom] = at(x1, y0);
    const path = (points) => points.map(([x, y]) => at(x, y).map((v) => v.toFixed(1)).join(",")).join(" ");
    const step = STEPS_M.find((one) => one * this.scale >= 44) ?? 100;
    const digits = step < 1 ? 1 : 0;
    const parts = [
      element("clipPath", { id: "on-map" }, element("rect", { x: left - PAD.left, y: 0, width: right - left + PAD.left + PAD.right, height: bottom + PAD.top })),
      element("clipPath", { id: "on-floor" }, element("rect", { x: left, y: top, width: right - left, height: bottom - top })),
      element("rect", { x: left, y: top, width: right - left, height: bottom - top, class: this.floor.has_floor ? "ground" : "plain" }),
    ];
    for (let n = Math.ceil(x0 / step - 1e-9); n * step <= x1 + 1e-9; n++) {
      const [x] = at(n * step, 0);
      parts.push(element("line", { x1: x, x2: x, y1: top, y2: bottom, class: "grid" }),
        element("text", { x, y: bottom + 14, class: "tick middle" }, (n * step).toFixed(digits)));
    }
    for (let n = Math.ceil(y0 / step - 1e-9); n * step <= y1 + 1e-9; n++) {
      const [, y] = at(0, n * step);
      parts.push(element("line", { x1: left, x2: right, y1: y, y2: y, class: "grid" }),
        element("text", { x: left - 6, y: y + 4, class: "tick end" }, (n * step).toFixed(digits)));
    }
    const inside = element("g", { "clip-path": "url(#on-floor)" });
    if (this.floor.measured.length) inside.append(element("polygon", { points: path(this.floor.measured), class: "measured" }));
    const many = isMany(this.floor.views), selected = this.view.value;
    for (const view of this.floor.views) {
      const points = path(view.outline);
      inside.append(element("polygon", { points, ...(many ? { class: "view-area shared" } : { class: "view-area", fill: view.colour }) }));
      if (many && view.camera !== selected) continue;
      inside.append(element("polygon", { points, class: "view-halo" }), element("polygon", { points, class: "view", stroke: view.colour }));
    }
    for (const view of many ? this.floor.views : []) {
      const middle = (axis) => view.outline.reduce((sum, point) => sum + point[axis], 0) / view.outline.length;
      const [x, y] = at(middle(0), middle(1));
      inside.append(element("text", { x, y: y + 4, class: `camera middle${view.camera === selected ? " selected" : ""}` }, view.camera));
    }
    parts.push(inside);
    for (const point of this.floor.references) {
      const [x, y] = at(point.x, point.y);
      parts.push(element("path", { d: `M${x - 5},${y}h10M${x},${y - 5}v10`, class: "reference" }),
        element("text", { x: x + 6, y: y - 6, class: "tick" }, point.name));
    }
    // The scale, and the names of the axes.
    const bar = step * this.scale, low = bottom + 28;
    parts.push(element("path", { d: `M${left},${low - 4}v8m0,-4h${bar}m0,-4v8`, class: "scale" }),
      element("text", { x: left + bar + 6, y: low + 4, class: "tick" }, `${step} m`),
      element("text", { x: right, y: low + 4, class: "tick end" }, "x, y in m"));
    this.still.replaceChildren(...parts);
  }

  // Show the newest poses. data: now in ms, and the robots.
  move(data) {
    // A playback that goes to another time begins new trails.
    if (this.data && data.session !== this.data.session) this.trails.clear();
    this.data = data;
    if (!this.at) return;
    const growth = Number(this.growth.value), present = new Set();
    this.named = this.svg.clientWidth >= ROOM_FOR_NAMES || data.robots.filter((robot) => robot.colour).length <= MOST_NAMES;
    for (const robot of data.robots) {
      present.add(robot.name);
      this.extend(robot);
      let drawn = this.robots.get(robot.name);
      if (!drawn) {
        drawn = robotElement(robot);
        this.robots.set(robot.name, drawn);
        // Robots are above the other markers.
        if (robot.colour) this.moving.append(drawn.whole);
        else this.moving.prepend(drawn.whole);
      }
      this.place(drawn, robot, data.now, growth);
    }
    for (const [name, drawn] of this.robots) {
      if (present.has(name)) continue;
      drawn.whole.remove();
      this.robots.delete(name);
      this.trails.delete(name);
    }
  }

  extend(robot) {
    const trail = this.trails.get(robot.name) ?? [];
    this.trails.set(robot.name, trail);
    if (!trail.length || robot.t > trail.at(-1)[0]) trail.push([robot.t, robot.x, robot.y]);
    while (trail.length && robot.t - trail[0][0] > TRAIL_MS) trail.shift();
  }

  place(drawn, robot, now, growth) {
    const [x, y] = this.at(robot.x, robot.y);
    const set = (part, attributes) => { for (const [key, value] of Object.entries(attributes)) part.setAttribute(key, value); };
    drawn.body.setAttribute("transform", `translate(${x.toFixed(1)},${y.toFixed(1)})`);
    const unseen = Math.max(now - robot.seen, 0);
    drawn.whole.setAttribute("class", `${robot.colour ? "robot" : "other"}${unseen > STALE_MS ? " stale" : ""}${robot.outside ? " outside" : ""}`);
    drawn.age.textContent = robot.colour && unseen > 1000 ? ` ${Math.round(unseen / 1000)} s ago` : "";
    if (drawn.arrow) drawn.arrow.setAttribute("visibility", robot.heading === undefined ? "hidden" : "visible");
    if (drawn.arrow && robot.heading !== undefined) drawn.arrow.setAttribute("transform", `rotate(${(-robot.heading * 180) / Math.PI})`);
    if (!robot.colour) return;
    drawn.label.textContent = this.named ? robot.name : "";
    // The name does not cover the arrow.
    drawn.name.setAttribute("y", Math.sin(robot.heading ?? -1) > 0.2 ? 26 : -16);
    const [long, short, angle] = robot.ellipse ?? [0, 0, 0], k = this.scale * growth;
    set(drawn.ellipse, { rx: (long * k).toFixed(1), ry: (short * k).toFixed(1), transform: `rotate(${(-angle * 180) / Math.PI})` });
    drawn.trail.setAttribute("points", this.trails.get(robot.name).map(([, a, b]) => this.at(a, b).map((v) => v.toFixed(1)).join(",")).join(" "));
  }

  fillLegend(legend) {
    const swatch = (kind, colour) => {
      const line = element("line", { x1: 0, x2: 22, y1: 6, y2: 6, class: kind, ...(colour && { stroke: colour }) });
      const halo = element("line", { x1: 0, x2: 22, y1: 6, y2: 6, class: "view-halo" });
      return element("svg", { width: 22, height: 12, "aria-hidden": "true" }, ...(kind === "view" ? [halo, line] : [line]));
    };
    const views = this.floor.views, few = views.length <= MOST_IN_LEGEND ? views : [];
    const rows = few.map((view) => [swatch("view", view.colour), `view of ${view.camera}`]);
    if (views.length > few.length) rows.push([swatch("view-edge"), "views of the cameras, with their names; stronger where they overlap"]);
    if (this.floor.measured.length) rows.push([swatch("measured-edge"), "calibrated area"]);
    legend.replaceChildren(...rows.map((row) => make("li", {}, ...row)));
  }

  // The list of many cameras selects the one whose outline is drawn.
  fillViews() {
    this.view.parentElement.hidden = !isMany(this.floor.views);
    for (const view of this.floor.views) this.view.append(make("option", { value: view.camera }, view.camera));
    this.view.addEventListener("change", () => this.drawStill());
  }

  // Draw the field of view of a camera; without a list, all of them are drawn.
  select(camera) {
    if (this.view.parentElement.hidden || !this.floor.views.some((view) => view.camera === camera)) return;
    this.view.value = camera;
    this.drawStill();
  }
}

function robotElement(robot) {
  const body = element("g"), whole = element("g");
  const age = element("tspan", { class: "age" });
  if (!robot.colour) {
    body.append(element("rect", { x: -3, y: -3, width: 6, height: 6 }), element("text", { x: 6, y: 3 }, String(robot.id)));
    whole.append(body);
    return { whole, body, age };
  }
  const trail = element("polyline", { class: "trail", stroke: robot.colour });
  const ellipse = element("ellipse", { class: "ellipse", stroke: robot.colour });
  const label = element("tspan"), name = element("text", { x: 0, class: "name" }, label, age);
  const arrow = element("path", { d: "M12,0L24,0M18,-5L25,0L18,5", class: "arrow" });
  body.append(ellipse, arrow, element("circle", { r: 11, stroke: robot.colour }),
    element("text", { y: 4, class: "id" }, String(robot.id)), name);
  whole.append(trail, body);
  return { whole, body, trail, ellipse, arrow, name, label, age };
}
