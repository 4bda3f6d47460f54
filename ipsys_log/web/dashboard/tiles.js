// The newest image of each camera with the detected markers.
import { element, make } from "./make.js";

const tiles = new Map();
const LABEL_SHARE = 0.045;

export function showTiles(data) {
  const where = document.getElementById("tiles");
  for (const camera of data.cameras) {
    if (!tiles.has(camera.name)) {
      const svg = element("svg", { role: "img", "aria-label": `No image of camera ${camera.name} yet` }), note = make("small");
      tiles.set(camera.name, { svg, note, picture: null, loading: false });
      where.append(make("figure", {}, svg, make("figcaption", {}, camera.name, note)));
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
    ...camera.markers.flatMap((marker) => outline(marker, width)),
  );
  const count = camera.markers.length;
  tile.note.textContent = camera.size_px ? `${count} ${count === 1 ? "marker" : "markers"}` : "not processed";
  const ids = camera.markers.map((marker) => marker.id).join(", ");
  tile.svg.setAttribute("aria-label", `Image of camera ${camera.name}, ${ids ? `with markers ${ids}` : "without markers"}`);
}

function outline(marker, width) {
  const corners = marker.corners_px.map(([x, y]) => [x + 0.5, y + 0.5]);
  const x = Math.max(...corners.map((c) => c[0])), y = Math.min(...corners.map((c) => c[1]));
  return [
    element("polygon", { points: corners.join(" ") }),
    element("text", { x, y, "font-size": LABEL_SHARE * width }, String(marker.id)),
  ];
}
