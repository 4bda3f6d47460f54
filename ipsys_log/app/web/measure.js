// The measuring page. It shows data and sends requests. Only the server checks the data.
import { drawCameras } from "./cameras.js";
import { drawFloor } from "./floor.js";
import { make } from "./make.js";

const $ = (id) => document.getElementById(id);
const POLL_MS = 700, WAIT_MS = 250, NOTICE_MS = 6000;
const cm = (value, digits = 1) => value.toFixed(digits);
let lab, history, view = { cameras: [] }, found = {}, stop = null, asked = 0, looks = 0, timer, noticeTimer;

async function ask(path, body) {
  const options = body && {
    method: "POST",
    headers: { "Content-Type": "application/json", "X-Ipsys": "1" },
    body: JSON.stringify(body),
  };
  let answer;
  try {
    answer = await fetch(`api/${path}`, options);
  } catch {
    throw new Error("The computer does not answer. Is ipsys still running? Is this device in its network?");
  }
  const kind = answer.headers.get("content-type") ?? "";
  const content = kind.includes("json") ? await answer.json() : { error: await answer.text() };
  if (!answer.ok && answer.status !== 409) throw new Error(content.error || `error ${answer.status}`);
  return { ...content, refused: answer.status === 409 };
}

// A write may fail because another program has written to the log. Then the page reads the history again.
async function write(path, body) {
  try {
    return await ask(path, body);
  } catch (error) {
    try { ({ history } = await ask("scene")); refresh(); } catch { /* only the first error is shown */ }
    throw error;
  }
}

function tell(text, bad = false) {
  clearTimeout(noticeTimer);
  $("notice").textContent = text;
  $("notice").className = bad ? "bad" : "";
  $("notice").hidden = false;
  noticeTimer = setTimeout(() => ($("notice").hidden = true), NOTICE_MS);
}

const guarded = (work) => async (...given) => {
  try { await work(...given); } catch (error) { tell(error.message, true); }
};

// --- entry ------------------------------------------------------------------------------------

const inputs = () => lab.references.map((r) => $(`d-${r.name}`));
const side = () => document.querySelector("[name=side]:checked")?.value ?? "";
const marker = () => (stop === null ? $("marker").value || String(view.marker ?? "") : String(lab.stops[stop].marker));

function typed() {
  const distances = Object.fromEntries(lab.references.map((r) => [r.name, $(`d-${r.name}`).value]));
  return { stop, marker: marker(), distances, side: side(), height: $("height").value, split: $("split").value };
}

function buildFields() {
  $("fields").replaceChildren(...lab.references.map((reference, n) => {
    const input = make("input", { id: `d-${reference.name}`, inputMode: "decimal", enterKeyHint: "next" });
    const label = make("label", { htmlFor: input.id }, `Distance to ${reference.name}`);
    const fault = make("p", { className: "fault", id: `fault-d_${reference.name}` });
    input.setAttribute("aria-describedby", fault.id);
    return make("div", { className: "field" }, label, make("span", { className: "cm" }, input, make("i", {}, "cm")), fault);
  }));
  $("height").setAttribute("aria-describedby", "fault-height");
  offerSides([]);
}

// Show the choice of the side if the reference points are on one line, or only two distances are given.
function offerSides(faults) {
  const given = lab.references.map((r) => r.name).filter((name) => $(`d-${name}`).value);
  const [from, to] = given.length > 1 ? given : lab.references.map((r) => r.name);
  $("from").textContent = from;
  $("to").textContent = to;
  $("sides").hidden = !lab.one_line && given.length !== 2 && !faults.some((fault) => fault.field === "side");
}

function clear() {
  for (const input of [...inputs(), $("height")]) input.value = "";
  for (const radio of document.querySelectorAll("[name=side]")) radio.checked = false;
}

// --- check while typing -----------------------------------------------------------------------

function soon() {
  clearTimeout(timer);
  $("save").disabled = true;
  $("verdict").ariaBusy = "true";
  timer = setTimeout(guarded(check), WAIT_MS);
}

async function check() {
  const number = ++asked;
  const answer = await ask("check", typed());
  if (number !== asked) return;
  show(answer);
  $("verdict").ariaBusy = "false";
}

function show(answer) {
  const now = typed(), tapes = {};
  for (const [name, text] of Object.entries(now.distances)) tapes[name] = parseFloat(text.replace(",", ".")) / 100;
  found = { ...answer, tapes };
  offerSides(answer.faults);
  // A missing value is no fault.
  const empty = (field) =>
    field === "marker" ? !now.marker : field === "side" ? !now.side
      : field === "height" ? !now.height : field.startsWith("d_") && !now.distances[field.slice(2)];
  const wrong = answer.faults.filter((fault) => !empty(fault.field));
  const missing = answer.faults.filter((fault) => empty(fault.field)).map((fault) => fault.text.split("?")[0]);
  const any = Object.values(now.distances).some(Boolean) || now.height;
  for (const part of document.querySelectorAll("#form .field")) {
    const place = part.querySelector(".fault"), field = place.id.slice("fault-".length);
    place.textContent = wrong.find((fault) => fault.field === field)?.text ?? "";
    part.classList.toggle("bad", Boolean(place.textContent));
  }
  const isUnseen = $("marker").value && !view.visible?.includes(Number($("marker").value));
  const rest = wrong.filter((fault) => !$(`fault-${fault.field}`) && (fault.field || any) && (fault.field !== "marker" || isUnseen));
  $("verdict").replaceChildren(
    ...rest.map((fault) => make("p", { className: "bad" }, upper(fault.text))),
    ...verdict(answer),
    ...answer.warnings.map((text) => make("p", { className: "warn" }, upper(text))),
  );
  const save = $("save"), doubtful = answer.warnings.length > 0;
  // The verdict may be scrolled out of view. The bar shows a short form: the point to save, or the objections.
  const against = [...rest.map((fault) => fault.text), ...answer.warnings].map(upper);
  $("bar").className = rest.length ? "bad" : doubtful ? "warn" : "";
  $("short").replaceChildren(...against.map((text) => make("span", {}, text)));
  if (!against.length && answer.ready && answer.point_m) $("short").textContent = short(answer);
  save.disabled = !answer.ready;
  save.textContent = answer.ready ? `Save ${answer.id}${doubtful ? " despite the warning" : ""}`
    : wrong.length && wrong.every((fault) => fault.field === "marker") && !missing.length ? "Wait: the marker must not move"
    : wrong.length && any ? "Correct the errors above" : missing.length && any ? `Still missing: ${missing.join(", ")}` : "Save";
  draw();
}

const upper = (text) => text.charAt(0).toUpperCase() + text.slice(1);

function short({ point_m: [x, y, z], sigma_cm }) {
  const known = sigma_cm === null ? "" : ` ± ${cm(sigma_cm)} cm`;
  return `x ${cm(x * 100)}, y ${cm(y * 100)} cm${known}, height ${cm(z * 100)} cm`;
}

function verdict(answer) {
  if (!answer.point_m) return [];
  const [x, y, z] = answer.point_m;
  const known = answer.sigma_cm === null ? "" : ` ± ${cm(answer.sigma_cm)} cm`;
  const where = answer.on_floor === null ? "" : answer.on_floor ? ", inside the floor" : ", outside the floor";
  const parts = [make("p", { className: answer.on_floor === false ? "warn" : "point" },
    make("b", {}, `x ${cm(x * 100)}, y ${cm(y * 100)} cm`), `${known}, height ${cm(z * 100)} cm${where}`)];
  if (answer.residuals.length)
    parts.push(table("Residuals of the distances", answer.residuals.map((r) => [r.name, `${cm(r.cm)} cm`])));
  if (answer.predictions.length)
    parts.push(table("Difference from the present model", answer.predictions.map((p) => [p.camera, `${cm(p.cm)} cm`, p.camera])));
  return parts;
}

function table(caption, rows) {
  return make("table", {}, make("caption", {}, caption), ...rows.map(([name, value, camera]) => {
    const head = make("th", { scope: "row" }, name);
    if (camera) {
      const dot = make("i");
      dot.style.background = colours()[camera];
      head.prepend(dot);
    }
    return make("tr", {}, head, make("td", {}, value));
  }));
}

const colours = () => Object.fromEntries(view.cameras.map((camera) => [camera.name, camera.colour]));

function draw() {
  const done = history.places.filter((place) => place.point_m).map((place) => place.point_m);
  drawFloor($("floor"), lab, found, done, colours(), (chosen) => {
    document.querySelector(`[name=side][value=${chosen}]`).checked = true;
    soon();
  });
  $("floor").setAttribute("aria-label", found.point_m
    ? `Floor map: the point is at x ${cm(found.point_m[0] * 100)}, y ${cm(found.point_m[1] * 100)} cm` : "Floor map");
}

// --- views of the cameras ---------------------------------------------------------------------

async function look() {
  const query = new URLSearchParams(stop === null ? { marker: $("marker").value } : { stop, marker: lab.stops[stop].marker });
  const state = view.state, number = ++looks, answer = await ask(`views?${query}`);
  if (number !== looks) return;
  view = answer;
  const drawn = drawCameras($("cameras"), view, stop === null ? choose : undefined);
  $("sight").textContent = upper(view.text);
  $("sight").className = `chip ${view.state}`;
  if (stop === null) offerMarkers();
  count();
  await drawn;
  if (state !== view.state) soon();
}

// A tap on a marker in an image chooses it.
const choose = guarded(async (id) => {
  $("marker").value = String(id);
  await look();
  soon();
});

function offerMarkers() {
  const [only, ...others] = view.visible;
  $("marker").placeholder = only !== undefined && !others.length ? `${only}, the only visible marker` : "tap it, or type its id";
}

// --- calibration points -----------------------------------------------------------------------

async function go(to) {
  stop = Math.min(Math.max(to, 0), lab.stops.length - 1);
  clear();
  showStop();
  await look();
  await check();
}

function showStop() {
  const { marker: id, seconds } = lab.stops[stop], as = history.measured[stop];
  const open = history.measured.filter((one) => one === null).length;
  const state = as === null ? `stationary ${seconds.toFixed(1)} s, not measured` : `measured as ${as}`;
  $("stop").replaceChildren(`Marker ${id}, interval ${stop + 1}/${lab.stops.length}`, make("small", {}, state));
  $("before").disabled = stop === 0;
  $("after").disabled = stop === lab.stops.length - 1;
  $("open").disabled = open === 0;
  $("open").textContent = open ? `Next unmeasured (${open} left)` : "All are measured";
}

function nextOpen() {
  const count = lab.stops.length;
  for (let n = 1; n <= count; n++) if (history.measured[(stop + n) % count] === null) return (stop + n) % count;
  return stop;
}

// The number of points, and how many of them each camera has seen.
function count() {
  const points = history.places.filter((place) => place.counts && place.marker !== null).length;
  const cameras = Object.entries(view.measured ?? {});
  const seen = cameras.some(([, number]) => number) ? ` (${cameras.map(([camera, number]) => `${camera} ${number}`).join(", ")})` : "";
  $("count").textContent = points ? `: ${points} ${points === 1 ? "point" : "points"}${seen}` : "";
}

function list() {
  const rows = history.places.map((place) => {
    const where = place.point_m ? `at x ${cm(place.point_m[0] * 100)}, y ${cm(place.point_m[1] * 100)} cm` : place.counts ? "" : place.reason ? `withdrawn: ${place.reason}` : "withdrawn";
    const text = make("div", {}, make("b", {}, place.id), make("span", {}, place.marker === null ? "" : ` marker ${place.marker}`), " ", make("em", {}, where), make("small", {}, place.tapes));
    if (!place.counts) return make("li", { className: "gone" }, text);
    const undo = make("button", { type: "button" }, "Undo");
    undo.setAttribute("aria-label", `Undo ${place.id}`);
    undo.addEventListener("click", guarded(async () => {
      history = (await write("undo", { id: place.id })).history;
      tell(`${place.id} is withdrawn. It stays in the log, but no stage uses it.`);
      refresh();
    }));
    return make("li", {}, text, undo);
  });
  $("places").replaceChildren(...(rows.length ? rows : [make("li", { className: "none" }, "Nothing yet.")]));
  count();
}

function refresh() {
  list();
  if (stop !== null) showStop();
  soon();
  draw();
}

const save = guarded(async () => {
  $("save").disabled = true;
  let answer;
  try {
    answer = await write("measure", { ...typed(), accepted: found.warnings ?? [] });
  } catch (error) {
    soon();
    throw error;
  }
  if (answer.refused) return show(answer);
  history = answer.history;
  tell(`${answer.saved} is in the log`);
  clear();
  refresh();
  inputs()[0].focus({ preventScroll: true });
  for (const part of [document.querySelector("main"), $("entry")]) part.scrollTo(0, 0);
  if (stop !== null) await go(nextOpen());
});

// The distance between the reference points, with this tape: it shows the scale of the tape.
function buildBaseline() {
  const [from, to] = lab.baseline.names;
  document.querySelector("#ab summary").textContent = `Distance from ${from} to ${to} with this tape`;
  document.querySelector("#ab label").textContent = `Distance from ${from} to ${to}`;
  $("ab-use").textContent = lab.baseline.counts ? "It shows the scale of the tape."
    : "It counts if lab.toml has ab_sigma_m: another instrument has measured the reference points.";
  $("ab").open = lab.baseline.counts && !history.places.some((place) => place.counts && place.marker === null);
}

const saveBaseline = guarded(async () => {
  const answer = await write("baseline", { distance: $("ab-distance").value });
  history = answer.history;
  tell(`${answer.saved} is in the log`);
  $("ab-distance").value = "";
  $("ab").open = false;
  refresh();
});

// --- start ------------------------------------------------------------------------------------

async function watch() {
  try { await look(); } catch (error) { $("sight").textContent = error.message; $("sight").className = "chip"; }
  setTimeout(watch, POLL_MS);
}

guarded(async () => {
  ({ history, ...lab } = await ask("scene"));
  if (lab.setup) {
    $("setup").href = lab.setup;
    $("setup").hidden = false;
  }
  $("lab").textContent = lab.model ? `${lab.lab}, model ${lab.model}` : lab.lab;
  buildFields();
  buildBaseline();
  list();
  draw();
  $("form").addEventListener("input", soon);
  $("ab-form").addEventListener("submit", (event) => {
    event.preventDefault();
    saveBaseline();
  });
  $("form").addEventListener("submit", (event) => {
    event.preventDefault();
    if (!$("save").disabled) save();
  });
  $("before").addEventListener("click", guarded(() => go(stop - 1)));
  $("after").addEventListener("click", guarded(() => go(stop + 1)));
  $("open").addEventListener("click", guarded(() => go(nextOpen())));
  if (lab.stops.length) {
    $("stops").hidden = false;
    const first = history.measured.indexOf(null);
    await go(Math.max(first, 0));
  } else {
    $("chosen").hidden = false;
    watch();
  }
})();
