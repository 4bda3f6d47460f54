// The table of the cameras and their warnings. With many cameras, it has those with faults, and a row for the others.
import { make } from "./make.js";
import { isMany } from "./map.js";
import { count, fill, table } from "./tables.js";

const HEADINGS = ["camera", "rate", "dropped", "skipped", "delay", "age"];
// A frame is late after this time, in ms; a camera is slow below this share of the usual rate.
const LATE_MS = 2000, SLOW = 0.8;
const MOST_FAULTY = 8;

const isLate = (camera) => camera.age_ms > LATE_MS && camera.state !== "ended";

function row(camera) {
  return [camera.name,
    camera.state !== "up" ? [camera.state, camera.state === "lost" ? "bad" : ""] : camera.rate_hz === undefined ? "–" : `${camera.rate_hz.toFixed(1)} Hz`,
    count(camera.dropped),
    camera.skipped ? [String(camera.skipped), "warn"] : "0", camera.delay_ms === undefined ? "–" : `${camera.delay_ms.toFixed(0)} ms`,
    camera.age_ms === undefined ? "–" : [`${(camera.age_ms / 1000).toFixed(1)} s`, isLate(camera) ? "bad" : ""]];
}

// The faults of a camera, the worst one first; cameras are sorted by them.
function faults(camera, usual) {
  return [camera.state === "lost", isLate(camera), (camera.dropped ?? 0) > 0, camera.skipped > 0,
    camera.state === "up" && camera.rate_hz < SLOW * usual, camera.warnings.length > 0];
}

const known = (cameras, key) => cameras.map((camera) => camera[key]).filter((value) => value !== undefined);
const span = (values, digits, unit, factor = 1) => {
  const [low, high] = [Math.min(...values), Math.max(...values)].map((value) => (value * factor).toFixed(digits));
  return !values.length ? "–" : low === high ? `${low} ${unit}` : `${low} to ${high} ${unit}`;
};

// One row for several cameras.
function together(cameras, name) {
  const sum = (key) => known(cameras, key).reduce((all, value) => all + value, 0);
  const dropped = known(cameras, "dropped").length ? sum("dropped") : undefined, skipped = sum("skipped");
  return [name, span(known(cameras, "rate_hz"), 1, "Hz"), count(dropped), skipped ? [String(skipped), "warn"] : "0",
    span(known(cameras, "delay_ms"), 0, "ms"), span(known(cameras, "age_ms"), 1, "s", 1e-3)];
}

export function showCameras(cameras) {
  const whole = document.getElementById("all-cameras"), shown = document.getElementById("cameras");
  const many = isMany(cameras);
  whole.hidden = !many;
  table(shown, HEADINGS, many ? summary(cameras) : cameras.map(row), "There are no cameras.");
  if (many) {
    fill(whole.querySelector("summary"), cameras.length, () => [`All ${cameras.length} cameras`]);
    table(whole.querySelector("table"), HEADINGS, cameras.map(row), "");
  }
  const texts = many ? sharedWarnings(cameras) : cameras.flatMap((camera) => camera.warnings.map((text) => `${camera.name}: ${text}`));
  fill(document.getElementById("warnings"), texts, () => texts.map((text) => make("li", {}, text)));
}

// The cameras with the worst faults, and one row for the others.
function summary(cameras) {
  const rates = known(cameras, "rate_hz").sort((a, b) => a - b), usual = rates[Math.floor(rates.length / 2)] ?? 0;
  const rank = new Map(cameras.map((camera) => [camera, faults(camera, usual).indexOf(true)]));
  const faulty = cameras.filter((camera) => rank.get(camera) >= 0).sort((a, b) => rank.get(a) - rank.get(b)).slice(0, MOST_FAULTY);
  const others = cameras.filter((camera) => !faulty.includes(camera));
  const name = faulty.length ? `${others.length} others` : `all ${others.length}`;
  return [...faulty.map(row), ...(others.length ? [together(others, name)] : [])];
}

// A line for each warning, with all cameras that have it.
function sharedWarnings(cameras) {
  const names = new Map();
  for (const camera of cameras) for (const text of camera.warnings) names.set(text, [...(names.get(text) ?? []), camera.name]);
  return [...names].map(([text, those]) => `${those.join(", ")}: ${text}`);
}
