// The dashboard. It shows the events of the server; only the server decides what a device may do.
import { FloorMap } from "./map.js";
import { Operation, PlayerBar } from "./operate.js";
import { showRobots, showStatus } from "./panels.js";
import { showTiles } from "./tiles.js";

const $ = (id) => document.getElementById(id);
// Without data for this time, the page says so.
const QUIET_MS = 3000;
const KINDS = { live: "good", late: "bad", stale: "bad" };
let map, operation, player = null, source, heard = 0, end = null, played = null, positions = null;

function show(kind, text) {
  const chip = $("state");
  if (chip.textContent === text) return;
  chip.textContent = text;
  chip.className = `chip ${kind}`;
}

function judge() {
  const quiet = performance.now() - heard;
  if (end === "ended") show("", played ? "playback ended" : "recording ended");
  else if (end === "failed") show("bad", "display failed: see the terminal");
  else if (heard && quiet < QUIET_MS && played) show(played.is_paused ? "" : "good", playing(played));
  else if (heard && quiet < QUIET_MS) show(KINDS[positions?.state] ?? "", positions?.summary ?? "no frame is processed yet");
  else if (heard) show("bad", `no data for ${Math.round(quiet / 1000)} s`);
}

// Why positions are late or stale, and what helps.
function showCause() {
  const text = end ? "" : [positions?.cause, positions?.remedy].filter(Boolean).join(". ");
  if ($("cause").textContent !== text) $("cause").textContent = text;
  $("cause").hidden = !text;
}

const playing = ({ is_paused, rate }) => (is_paused ? "paused" : rate === 1 ? "playing" : `playing × ${rate}`);

function listen(name, handle) {
  source.addEventListener(name, (message) => {
    heard = performance.now();
    handle(JSON.parse(message.data));
  });
}

function connect() {
  source = new EventSource("api/live");
  let waiting = null;
  listen("robots", (data) => {
    // Several updates may arrive before the browser draws.
    if (waiting === null) requestAnimationFrame(() => { map.move(waiting); showRobots(waiting); waiting = null; });
    waiting = data;
  });
  listen("tiles", (data) => showTiles(data, (camera) => map.select(camera)));
  listen("status", (data) => {
    end = data.end;
    played = data.playback ?? null;
    positions = data.positions ?? null;
    showCause();
    player?.show(end ? null : played);
    showStatus(data);
    operation.show(data);
    judge();
    if (end) source.close();
  });
  // A refused stream is not tried again by the browser.
  source.addEventListener("error", () => {
    if (source.readyState === EventSource.CLOSED && !end) setTimeout(reconnect, QUIET_MS);
  });
}

function reconnect() {
  if (!document.hidden && !end && (!source || source.readyState === EventSource.CLOSED)) connect();
}

async function begin() {
  let answer;
  try {
    answer = await fetch("api/scene");
    if (!answer.ok) throw new Error(await answer.text());
  } catch (error) {
    show("bad", error instanceof TypeError ? "ipsys does not answer" : error.message);
    setTimeout(begin, QUIET_MS);
    return;
  }
  const scene = await answer.json();
  $("lab").textContent = scene.floor.lab;
  if (scene.setup) {
    $("setup").href = scene.setup;
    $("setup").hidden = false;
  }
  if (scene.played) {
    document.title = "ipsys playback";
    $("kind").textContent = $("recording-title").textContent = "Playback";
  }
  map = new FloorMap($("floor"), $("legend"), $("growth"), $("view"), scene);
  operation = new Operation(scene.may_operate);
  if (scene.may_play) player = new PlayerBar((state) => { played = state; player.show(state); judge(); });
  reconnect();
  setInterval(judge, 500);
}

// A page that nobody sees needs no data, and a browser opens only six connections to a server.
document.addEventListener("visibilitychange", () => {
  if (document.hidden) source?.close();
  else if (map) reconnect();
});

begin();
