// The tables beside the map.
import { showCameras } from "./cameras_panel.js";
import { count, fill, table } from "./tables.js";
import { make } from "./make.js";
import { duration } from "./operate.js";

const $ = (id) => document.getElementById(id);
const ROBOTS_MS = 250;
let robotsShown = -Infinity, later = null;

export function showRobots(data) {
  const left = robotsShown + ROBOTS_MS - performance.now();
  clearTimeout(later);
  if (left > 0) {
    later = setTimeout(() => showRobots(data), left);
    return;
  }
  robotsShown = performance.now();
  const degrees = (angle) => (angle === undefined ? "–" : `${Math.round((angle * 180) / Math.PI)}°`);
  const tilts = data.robots.some((robot) => robot.colour && robot.tilt !== undefined);
  const rows = data.robots.filter((robot) => robot.colour).sort((a, b) => a.id - b.id).map((robot) => {
    const unseen = Math.max(data.now - robot.seen, 0);
    return [`${robot.id} ${robot.name}`, robot.x.toFixed(2), robot.y.toFixed(2), ...(tilts ? [robot.z?.toFixed(2) ?? "–"] : []),
      degrees(robot.heading), ...(tilts ? [degrees(robot.tilt)] : []),
      robot.ellipse ? (robot.ellipse[0] * 1000).toFixed(0) : "–",
      unseen > 1000 ? [`${Math.round(unseen / 1000)} s ago`, "bad"] : robot.outside ? ["outside", "warn"] : robot.cameras.join(", ") || "predicted"];
  });
  table($("robots"), ["robot", ...(tilts ? ["x", "y", "z / m", "heading", "tilt"] : ["x / m", "y / m", "heading"]), "± / mm", "seen by"], rows, "No robot is seen yet.");
}

export function showStatus(data) {
  showCameras(data.cameras);
  if (data.playback) showPlayback(data.playback);
  else showRecording(data);
  showEvents(data.events);
  table($("latency"), ["step", "median", "99 %"], data.latency.map((row) => [row.step, `${row.median_ms.toFixed(1)} ms`, `${row.p99_ms.toFixed(1)} ms`]),
    "No position is published yet.");
  const lines = data.overlap.length ? data.overlap : ["No robot is in the view of two cameras yet."];
  fill($("overlap"), lines, () => lines.map((line) => make("li", {}, line)));
  $("streams-panel").hidden = !data.streams.length;
  table($("streams"), ["stream", "clients", "dropped"], data.streams.map((row) => [row.name, String(row.clients ?? "–"), count(row.dropped)]), "");
}

const UNITS = ["B", "kB", "MB", "GB", "TB"];
function size(bytes) {
  let unit = 0;
  while (bytes >= 1000 && unit < UNITS.length - 1) { bytes /= 1000; unit += 1; }
  return `${unit ? bytes.toFixed(1) : bytes} ${UNITS[unit]}`;
}

function showPlayback({ file, seconds, of_seconds, rate, is_paused, loops }) {
  const rows = [["log", file], ["position", `${duration(seconds)} of ${duration(of_seconds)}`],
    ["rate", `× ${rate}${is_paused ? ", paused" : ""}`], ["at the end", loops ? "begins again" : "stops"]];
  fill($("recording"), rows, () => rows.flatMap(([name, value]) => [make("dt", {}, name), make("dd", {}, value)]));
}

function showRecording({ recording, segment }) {
  const rows = [["log", recording.file], ["duration", duration(recording.seconds)]];
  if (recording.bytes !== undefined) rows.push(["size", size(recording.bytes)], ["disk left", size(recording.free_bytes)]);
  if (recording.left_s !== undefined) rows.push(["enough for", recording.left_s > 360000 ? "more than 100 hours" : duration(recording.left_s)]);
  if (segment) rows.push(["segment", `${segment.name}, ${duration(segment.seconds)}`]);
  fill($("recording"), [rows, recording.is_short], () => rows.flatMap(([name, value]) => [make("dt", {}, name),
    make("dd", { className: recording.is_short && name === "enough for" ? "bad" : "" }, value)]));
}

function showEvents(events) {
  fill($("events"), events, () => events.length ? events.map((event) => make("li", { className: event.severity },
    make("time", { dateTime: new Date(event.time).toISOString() }, new Date(event.time).toLocaleTimeString("en-GB")),
    make("b", {}, event.severity), make("span", {}, event.text, event.count > 1 ? make("em", {}, ` ×${event.count}`) : "")))
    : [make("li", { className: "none" }, "No events yet.")]);
}
