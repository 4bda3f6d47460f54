// What each camera sees: the marker close up, or, after a tap, whole pictures.
import { element, make } from "./make.js";

export function drawCameras(where, view) {
  where.replaceChildren(...view.cameras.map((camera) => tile(camera, view, where)));
}

function tile(camera, view, where) {
  const chosen = camera.markers.find((one) => one.id === view.marker);
  const svg = element("svg", { class: view.state, role: "img", preserveAspectRatio: "xMidYMid slice" });
  const says = chosen ? `sees marker ${view.marker}` : "does not see it";
  svg.setAttribute("aria-label", `Camera ${camera.name} ${says}`);
  const [width, height] = camera.size_px ?? [16, 9];
  const whole = where.classList.contains("whole");
  svg.setAttribute("viewBox", chosen && !whole ? closeUp(chosen.corners_px, width, height) : `0 0 ${width} ${height}`);
  if (!whole) svg.setAttribute("preserveAspectRatio", chosen ? "xMidYMid slice" : "xMidYMid meet");
  svg.style.aspectRatio = whole ? `${width} / ${height}` : "1";
  if (camera.picture) svg.append(element("image", { href: camera.picture, width, height }));
  for (const one of camera.markers)
    svg.append(element("polygon", { points: one.corners_px.map((c) => c.map((v) => v + 0.5)).join(" "), class: one === chosen ? "chosen" : "" }));
  const name = make("span", {}, camera.name, make("small", {}, chosen ? "sees it" : "no"));
  name.style.borderColor = camera.colour;
  const made = make("button", { type: "button", title: "Close up, or the whole picture" }, svg, name);
  made.addEventListener("click", () => {
    where.classList.toggle("whole");
    drawCameras(where, view);
  });
  return made;
}

// A square about the marker, five times as wide, within the picture as far as it goes.
function closeUp(corners, width, height) {
  const xs = corners.map((c) => c[0]), ys = corners.map((c) => c[1]);
  const size = Math.min(5 * Math.max(Math.max(...xs) - Math.min(...xs), Math.max(...ys) - Math.min(...ys), 8), width, height);
  const from = (values, most) => {
    const middle = (Math.max(...values) + Math.min(...values)) / 2;
    return Math.min(Math.max(middle - size / 2, 0), most - size);
  };
  return `${from(xs, width)} ${from(ys, height)} ${size} ${size}`;
}
