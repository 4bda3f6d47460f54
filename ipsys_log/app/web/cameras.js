// The view of each camera: the marker close up or, after a tap, the whole image.
import { element, make } from "./make.js";

let shown = { cameras: [] }, choose;

// New images do not replace the tiles, because a tile may have a tap or the focus. The tiles exist before the
// first image, so that the elements below them do not move while the user taps.
// pick: called with the id of a tapped marker, while no marker is chosen.
export async function drawCameras(where, view, pick) {
  choose = pick;
  const names = view.cameras.map((camera) => camera.name).join(" ");
  if (where.dataset.names !== names) {
    where.dataset.names = names;
    where.replaceChildren(...view.cameras.map(() => tile(where)));
  }
  await Promise.all(view.cameras.map((camera) => camera.picture && load(camera.picture)));
  shown = view;
  view.cameras.forEach((camera, n) => fill(where.children[n], camera, view, where.classList.contains("whole")));
}

// Decode an image before it is shown, so that a tile is not blank between two images.
async function load(source) {
  const picture = new Image();
  picture.src = source;
  try { await picture.decode(); } catch { /* the tile stays dark */ }
}

function tile(where) {
  const made = make("button", { type: "button", title: "Switch between close-up and whole image" }, element("svg", { role: "img" }), make("span"));
  made.addEventListener("click", ({ target }) => {
    const id = target.closest("[data-marker]")?.dataset.marker;
    if (choose && shown.marker === null && id !== undefined && shown.visible.includes(Number(id))) return choose(Number(id));
    where.classList.toggle("whole");
    drawCameras(where, shown, choose);
  });
  return made;
}

function fill(made, camera, view, whole) {
  const [svg, name] = made.children;
  const chosen = camera.markers.find((one) => one.id === view.marker);
  const sees = chosen || camera.sees;
  const [width, height] = camera.size_px ?? [16, 9];
  const close = chosen && !whole;
  svg.setAttribute("class", view.state);
  // Without a chosen marker, the text names the ids.
  const ids = view.marker === null ? camera.markers.map((one) => one.id).filter((id) => view.visible.includes(id)) : [];
  const what = view.marker !== null ? (sees ? "sees it" : "not visible") : ids.length ? `sees ${ids.join(", ")}` : "no marker";
  svg.setAttribute("aria-label", `Camera ${camera.name} ${view.marker === null ? what : sees ? `sees marker ${view.marker}` : `does not see marker ${view.marker}`}`);
  svg.setAttribute("viewBox", close ? closeUp(chosen.corners_px, width, height) : `0 0 ${width} ${height}`);
  svg.setAttribute("preserveAspectRatio", close ? "xMidYMid slice" : "xMidYMid meet");
  svg.style.aspectRatio = whole ? `${width} / ${height}` : "1";
  const outline = (one) => element("polygon", {
    points: one.corners_px.map((corner) => corner.map((value) => value + 0.5)).join(" "),
    class: one === chosen ? "chosen" : "",
    "data-marker": one.id,
  });
  const picture = camera.picture ? [element("image", { href: camera.picture, width, height })] : [];
  const middle = (values) => (Math.max(...values) + Math.min(...values)) / 2;
  const idOf = (one) => element("text", {
    x: middle(one.corners_px.map((corner) => corner[0])), y: middle(one.corners_px.map((corner) => corner[1])),
    "font-size": svg.viewBox.baseVal.width / (close ? 9 : 22),
  }, String(one.id));
  svg.replaceChildren(...picture, ...camera.markers.map(outline), ...camera.markers.map(idOf));
  name.replaceChildren(camera.name, make("small", {}, what));
  name.style.borderColor = camera.colour;
}

// Return the view box of a square around the marker: five times its size, and inside of the image.
function closeUp(corners, width, height) {
  const xs = corners.map((c) => c[0]), ys = corners.map((c) => c[1]);
  const size = Math.min(5 * Math.max(Math.max(...xs) - Math.min(...xs), Math.max(...ys) - Math.min(...ys), 8), width, height);
  const from = (values, most) => {
    const middle = (Math.max(...values) + Math.min(...values)) / 2;
    return Math.min(Math.max(middle - size / 2, 0), most - size);
  };
  return `${from(xs, width)} ${from(ys, height)} ${size} ${size}`;
}
