// The newest image of each camera with the detected markers.
import { element, make } from "./make.js";
import { isMany } from "./map.js";

const tiles = new Map();
// Size of an id as a share of the image, and the least size that can be read.
const LABEL_SHARE = 0.045, LEAST_LABEL_PX = 9;

// select(camera): the user has chosen a tile.
export function showTiles(data, select) {
  const where = document.getElementById("tiles");
  document.getElementById("tiles-panel").classList.toggle("many", isMany(data.cameras));
  for (const camera of data.cameras) {
    if (!tiles.has(camera.name)) {
      const svg = element("svg", { role: "img", "aria-label": `No image of camera ${camera.name} yet` }), note = make("small");
      tiles.set(camera.name, { svg, note, picture: null, loading: false });
      where.append(make("figure", { onclick: () => select(camera.name) }, svg, make("figcaption", {}, camera.name, note)));
    }
    show(tiles.get(camera.name), camera);
  }
}

// Decode an image before it is shown; images that arrive meanwhile are left out.
async function show(tile, camera) {
  if (!camera.picture || camera.picture === tile.picture || tile.loading) return;
  tile.loading = true;
  const picture = new Image();
  picture.src = camera.picture;
  try {
    await picture.decode();
  } catch {
    tile.note.textContent = "no image";
    return;
  } finally {
    tile.loading = false;
  }
  tile.picture = camera.picture;
  const [width, height] = camera.size_px ?? [picture.naturalWidth, picture.naturalHeight];
  tile.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  tile.svg.replaceChildren(
    element("image", { href: camera.picture, width, height }),
    ...camera.markers.flatMap((marker) => outline(marker, labelSize(tile.svg, width))),
  );
  const count = camera.markers.length;
  tile.note.textContent = camera.size_px ? `${count} ${count === 1 ? "marker" : "markers"}` : "not processed";
  const ids = camera.markers.map((marker) => marker.id).join(", ");
  tile.svg.setAttribute("aria-label", `Image of camera ${camera.name}, ${ids ? `with markers ${ids}` : "without markers"}`);
}

// The size of an id, in pixels of the image.
const labelSize = (svg, width) => width * Math.max(LABEL_SHARE, LEAST_LABEL_PX / (svg.clientWidth || Infinity));

function outline(marker, size) {
  const corners = marker.corners_px.map(([x, y]) => [x + 0.5, y + 0.5]);
  const x = Math.max(...corners.map((c) => c[0])), y = Math.min(...corners.map((c) => c[1]));
  return [
    element("polygon", { points: corners.join(" ") }),
    element("text", { x, y, "font-size": size }, String(marker.id)),
  ];
}
