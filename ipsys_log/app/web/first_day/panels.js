// The content of each step. The server decides what can be done; the page only asks.
import { change, choice, field, markFault, showFaults } from "./fields.js";
import { make } from "./make.js";
import { alignedImage, cameraImage, floorMap, floorSketch } from "./pictures.js";

// More cards than these are compact, so that a page of them can be surveyed.
const MOST_LARGE = 6, MOST_HEIGHTS = 30;
const cards = (made) => make("div", { className: `cards${made.length > MOST_LARGE ? " many" : ""}` }, ...made);

const cameraId = (key) => `camera-${key.replace(/[^a-z0-9]/gi, (sign) => `_${sign.charCodeAt(0)}`)}`;

// The lines of a calibration that has ended.
function report(state) {
  const { job } = state;
  return job?.ended && job.action === "calibrate" && !job.error ? job.lines.slice(1) : [];
}

// The part of the state that a panel shows: the panel is drawn again only if it changes.
export function shownPart(name, state) {
  const parts = {
    rig: state.rig, cameras: [state.cameras, state.address], intrinsics: [state.intrinsics, state.board !== null, report(state)], alignment: state.alignment,
    drive: [state.drive.logs, state.drive.views !== null], points: [state.points, state.map, state.measured_now],
    accuracy: [state.accuracy, state.lab, state.map, state.points], live: state.tracked,
  };
  const busy = state.job && !state.job.ended ? state.job.action : null;
  return JSON.stringify([name, parts[name], state.steps, busy, state.pages, state.may_change, state.faults]);
}

export function panel(name, state, act) {
  const step = state.steps.find((one) => one.name === name);
  const number = state.steps.indexOf(step) + 1, later = state.steps.slice(number);
  const content = { rig, cameras, intrinsics, alignment, drive, points, accuracy, live }[name](state, act, step);
  // Finished steps are skipped: a simulated lab has its cameras and their intrinsics.
  const following = later.find((one) => one.status === "ready") ?? later[0];
  const onward = step.status === "done" && following
    ? [make("div", { className: "actions" }, button(`Next: ${following.title}`, () => { location.hash = following.name; }, "onward", { className: "main" }))] : [];
  return [
    make("h2", { textContent: `${number}. ${step.title}` }),
    ...(step.text ? [make("p", { className: "text", textContent: sentence(step.text) })] : []),
    ...lines(state.faults.map((fault) => ["bad", fault])),
    ...(step.status === "waits" ? [forward(state)] : content),
    ...onward,
    make("p", { className: "command" }, "The same in a terminal, in this folder: ", command(step.command)),
  ];
}

// A step that waits leads to the first step that can be done.
function forward(state) {
  const next = state.steps.find((one) => one.name === state.next);
  return make("div", { className: "actions" }, ...(next ? [button(`Go to: ${next.title}`, () => { location.hash = next.name; }, "forward", { className: "main" })] : []));
}

// A line ends between two words, never behind a hyphen.
const command = (text) => make("code", {}, ...text.split(" ").flatMap((word) => [make("span", { textContent: word }), " "]));

const sentence = (text) => `${text}.`.replace(/\.\.$/, ".");

function button(text, work, id, more = {}) {
  const made = make("button", { type: "button", textContent: text, ...(id ? { id } : {}), ...more });
  // A second tap does nothing while the server works on the first one.
  made.addEventListener("click", async () => {
    if (made.ariaBusy === "true") return;
    made.ariaBusy = "true";
    try { await work(); } finally { made.ariaBusy = "false"; }
  });
  return made;
}

// A button that starts a job; no other job may work.
function starter(text, action, state, act, isMain = true) {
  const busy = state.job && !state.job.ended;
  const properties = { disabled: busy || !state.may_change, className: isMain ? "main" : "" };
  return button(text, () => act(() => change("start", { action })), action, properties);
}

function lines(rows) {
  return rows.length ? [make("ul", { className: "lines" }, ...rows.map(([kind, text]) => make("li", { className: kind, textContent: text })))] : [];
}

// A button that downloads a PDF for a printer, and the paper; texts: the typed fields.
function printer(name, text, act, texts = () => ({})) {
  const paper = make("select", { id: `paper-${name}`, ariaLabel: "Paper" }, ...["A4", "Letter", "A3"].map((one) => make("option", {}, one)));
  return [button(text, () => act(async () => {
    const answer = await fetch(`print/${name}.pdf?${new URLSearchParams({ ...texts(), paper: paper.value })}`);
    if (!answer.ok) throw new Error((await answer.json()).error);
    make("a", { href: URL.createObjectURL(await answer.blob()), download: `${name}.pdf` }).click();
  }), `print-${name}`), paper];
}

function submit(form, state, act, isMain, work, { id = "save", text = "Save", disabled = false } = {}) {
  form.append(make("div", { className: "actions" }, make("button", { id, className: isMain ? "main" : "", textContent: text, disabled: disabled || !state.may_change })));
  form.noValidate = true;
  form.addEventListener("submit", (event) => { event.preventDefault(); act(work); });
  return form;
}

function rig(state, act, step) {
  const { values, labels, dictionaries, exists, name } = state.rig;
  if (exists && name === null) return lines([["bad", "Correct lab.toml with a text editor; this page sees the new file. Or move it away to begin again."]]);
  const form = make("form", { className: "grid" }), heights = make("div", { id: "heights", className: "grid" });
  let pair = form;
  for (const [key, label] of Object.entries(labels)) {
    const offered = [...new Set([...dictionaries, values[key]])];
    const made = key === "dictionary" ? choice(key, label, values[key], offered)
      : field(key, label, values[key], key.endsWith("_m") ? { inputMode: "decimal" } : {});
    // The two coordinates of a point are side by side.
    if (/(width|x)_m$/.test(key)) form.append((pair = make("div", { className: "pair" }, made)));
    else if (/(depth|y)_m$/.test(key)) pair.append(made);
    else form.append(made);
    if (key === "point_marker") form.append(make("details", { className: "single" }, make("summary", { textContent: "Markers at other heights" }), heights));
  }
  const input = (key) => form.querySelector(`#${key}`), number = (key) => Number((input(key)?.value ?? "").replace(",", "."));
  // One height for each typed id; a height that is there stays.
  const offerHeights = () => {
    const ids = [...new Set(input("robots").value.match(/\d{1,4}/g) ?? [])].slice(0, MOST_HEIGHTS).map(Number);
    heights.replaceChildren(...ids.map((id) => input(`height_${id}`)?.parentElement
      ?? field(`height_${id}`, `Height of marker ${id}, in m`, values[`height_${id}`] ?? "", { inputMode: "decimal" })));
  };
  offerHeights();
  submit(form, state, act, step.status !== "done", async () => {
    const typed = Object.fromEntries([...form.querySelectorAll("input, select")].map((one) => [one.id, one.value]));
    showFaults(form, await change("rig", { values: typed }), (key) => key);
  });
  const sketch = make("div", { id: "sketch" }), show = ({ target } = {}) => {
    if (target === input("robots")) offerHeights();
    const apart = Math.hypot(number("second_x_m") - number("first_x_m"), number("second_y_m") - number("first_y_m"));
    // Coordinates give the distance AB; a typed distance moves B.
    if (target && /_[xy]_m$/.test(target.id) && apart) input("ab_m").value = String(Number(apart.toFixed(4)));
    sketch.replaceChildren(...floorSketch(Object.fromEntries(Object.keys(labels).map((key) => [key, number(key)]))));
  };
  form.addEventListener("input", show);
  show();
  const help = [make("div", { className: "help" }, make("div", {},
    make("p", { textContent: "Measure the side of the black square of a printed marker, without its white margin. With an error of 2 % in it, all heights have an error of 2 %." }),
    make("p", { textContent: "The reference points A and B are two points on the floor that you can find again. You measure from them with a tape later: choose them some metres apart. x is to the right, y away from you. The distance from A to B, read with the tape, moves B." }),
    make("p", { textContent: "Measure the height of the robots' markers with a ruler: the calibration with a drive needs it." })), sketch)];
  if (exists) return [...help, form, ...lines(state.rig.warnings.map((text) => ["warn", sentence(text)])), make("div", { className: "actions" }, ...printer("markers", "Markers to print (PDF)", act))];
  const simulated = button("Use the simulated lab", () => act(() => change("simulate")), "simulate", { disabled: !state.may_change });
  return [
    make("h3", { textContent: "Without cameras" }),
    make("p", { textContent: "The simulated lab has three cameras and a sheet of tape measurements. Try all steps with it first." }),
    make("div", { className: "actions" }, simulated),
    make("h3", { textContent: "With your cameras" }),
    make("p", { textContent: "The fields have the values of an example: replace them by those of your lab." }),
    ...help,
    form,
  ];
}

// The form of a camera that no list shows. A camera that has been added leaves the fields empty.
function address(state, act) {
  const { labels, fault, added } = state.address;
  const form = make("form", { id: "address-form", className: "grid" });
  for (const [key, label] of Object.entries(labels)) {
    const type = key === "password" ? { type: "password", autocomplete: "new-password" } : {};
    form.append(field(key, label, "", { name: `${key}-${added}`, maxLength: 500, ...type }));
  }
  if (fault) markFault(form, fault, (key) => key);
  const busy = state.job && !state.job.ended;
  return submit(form, state, act, false, async () => {
    const values = Object.fromEntries(Object.keys(labels).map((key) => [key, document.getElementById(key).value]));
    showFaults(form, await change("address", { values }), (key) => key);
  }, { id: "add-camera", text: "Add the camera", disabled: busy });
}

// A box that uses a camera, with the proposed name, and the name; without a name, the camera is not used.
function use(one) {
  const id = cameraId(one.key), box = make("input", { type: "checkbox", id: `use-${id}`, checked: one.name !== "", defaultChecked: one.name !== "" });
  const named = field(id, "Name", one.name, { maxLength: 40 }), name = named.querySelector("input");
  box.addEventListener("change", () => { name.value = box.checked ? one.name || one.proposal : ""; });
  name.addEventListener("input", () => { box.checked = name.value.trim() !== ""; });
  return [make("label", { className: "use" }, box, "Use this camera"), named];
}

function cameras(state, act, step) {
  const form = make("form", {});
  const made = state.cameras.map((one) => make("div", { className: "card" },
    cameraImage(one.picture, one.name || one.key, one.fault ? "no picture" : "no picture yet"),
    make("div", {}, make("b", { textContent: one.key }), make("p", { className: "text", textContent: one.text }),
      ...(one.fault ? [make("p", { className: "fault", textContent: one.fault })] : []),
      ...use(one))));
  form.append(cards(made));
  const isSeen = state.cameras.some((one) => one.picture);
  submit(form, state, act, step.status !== "done" && isSeen, async () => {
    const names = Object.fromEntries(state.cameras.map((one) => [one.key, document.getElementById(cameraId(one.key)).value]));
    showFaults(form, await change("cameras", { names }), cameraId);
  });
  const unseen = state.cameras.filter((one) => one.fault).map((one) => one.name || one.key);
  return [
    make("p", { textContent: "Choose the cameras that the lab uses, and save. Names have small letters, digits and _." }),
    ...(state.attached ? [] : [make("p", { className: "text", textContent: "No USB camera is found. Plug one in, and search again." })]),
    make("div", { className: "actions" }, starter("Search and take pictures", "pictures", state, act, step.status !== "done" && !isSeen)),
    ...(state.cameras.length > MOST_LARGE && unseen.length ? lines([["warn", `No picture of: ${unseen.join(", ")}.`]]) : []),
    form,
    make("h3", { textContent: "Network camera" }),
    make("p", { textContent: "The address is in the manual of the camera. A camera of another computer with ipsys has the address zenoh:NAME. The password is only written into lab.toml." }),
    address(state, act),
  ];
}

function intrinsics(state, act) {
  const works = state.job && !state.job.ended;
  const fields = state.board_fields.map(([key, label, value, choices]) => (choices.length ? choice(key, label, value, choices) : field(key, label, value, { maxLength: 40 })));
  // Most users keep all but the first values: the board itself.
  const form = make("form", {}, make("div", { className: "grid" }, fields[0]),
    make("details", {}, make("summary", { textContent: "Square, lens model and ChArUco board" }), make("div", { className: "grid" }, ...fields.slice(1))));
  form.addEventListener("submit", (event) => event.preventDefault());
  const typed = () => Object.fromEntries(state.board_fields.map(([key]) => [key, document.getElementById(key).value]));
  const calibrate = (camera) => act(async () => {
    showFaults(form, await change("calibrate", { camera, options: typed() }), (key) => key);
  });
  const made = state.intrinsics.map((one) => make("div", { className: "card" }, make("div", {},
    make("b", { textContent: one.camera }),
    make("p", { className: one.known ? "text" : "fault", textContent: one.text }),
    make("div", { className: "actions" },
      ...(one.file ? [button(`Use ${one.file}`, () => act(() => change("intrinsics", { camera: one.camera })), `use-${one.camera}`, { className: "main", disabled: !state.may_change })] : []),
      button(one.known ? "Calibrate again" : "Calibrate", () => calibrate(one.camera), `calibrate-${one.camera}`,
        { className: one.known || one.file ? "" : "main", disabled: works || !state.may_change })))));
  const listed = cards(made);
  // The user who moves a board looks at its image: it is above all texts.
  const shown = state.board ? [make("div", { id: "calibration" }, make("div", { id: "board-image" }), listed)] : [];
  return [
    ...shown,
    make("p", { textContent: "The intrinsics describe the lens of a camera. Pictures of a chessboard determine them." }),
    make("p", { textContent: "Print the chessboard, and glue it on a flat plate. Press Calibrate, move the board through the whole image, and tilt it to all sides. Pictures are taken by themselves. Stop ends early and calibrates with the pictures so far. A board of 7 x 5 squares has 6x4 inner corners." }),
    make("div", { className: "actions" }, ...printer("board", "Board to print (PDF)", act, typed)),
    form,
    ...(state.board ? [] : [listed]),
    ...lines(report(state).map((text, n) => [n ? "" : "strong", text])),
  ];
}

function alignment(state, act) {
  const found = state.alignment;
  const parts = [
    make("p", { textContent: "Put four or more markers on the floor, up to the edges of each image, and leave them there. An arrow on the image shows where to turn a camera; it is drawn 5 times longer. A camera without an arrow is level." }),
    make("div", { className: "actions" }, starter(found ? "Measure again" : "Measure the alignment", "align", state, act, !found)),
  ];
  if (!found) return parts;
  const card = (one) => make("div", { className: "card" }, alignedImage(one),
    make("div", {}, make("b", { textContent: one.camera }), make("p", { textContent: `To do: ${sentence(one.advice)}` })));
  const floor = [
    ...(found.coverage.length ? [make("h3", { textContent: "Floor" })] : []),
    ...lines(found.coverage.map(([text, good]) => [good ? "good" : "warn", text])),
  ];
  const isMany = found.cameras.length > MOST_LARGE;
  // With many cameras, those to turn are shown, below the answer for the floor.
  const shown = isMany ? found.cameras.filter((one) => one.level !== true) : found.cameras;
  const level = found.cameras.filter((one) => !shown.includes(one));
  const levelled = level.length ? [make("details", {}, make("summary", { textContent: `Level cameras: ${level.length}` }), cards(level.map(card)))] : [];
  return [
    ...parts, ...(isMany ? floor : []), ...(shown.length ? [cards(shown.map(card))] : []), ...levelled, ...(isMany ? [] : floor),
    ...(found.notes.length ? [make("details", {}, make("summary", { textContent: `Remarks on markers and floor: ${found.notes.length}` }), ...lines(found.notes.map((text) => ["warn", text])))] : []),
  ];
}

const paragraph = (textContent) => make("p", { textContent });

// A button that ends the present job in order.
const finish = (text, state, act) => button(text, () => act(() => change("stop")), "finish", { disabled: !state.may_change });

const opener = (id, page, text) => make("a", { id, className: "button main", href: `${page}/`, target: "_blank", textContent: text });

const count = (number, noun) => `${number} ${noun}${number === 1 ? "" : "s"}`;

function table(rows, heads = []) {
  const cells = (row, kind) => make("tr", {}, ...row.map((text) => make(kind, {}, text)));
  return make("div", { className: "wide", tabIndex: 0 }, make("table", {}, make("thead", {}, ...(heads.length ? [cells(heads, "th")] : [])), make("tbody", {}, ...rows.map((row) => cells(row, "td")))));
}

function drive(state, act, step) {
  const { views, logs } = state.drive;
  const parts = [
    paragraph("Drive a robot, or carry its marker at its height, through all images for two minutes: in curves, through the overlaps, out to the edges. The drive replaces most work with the tape."),
    make("div", { className: "actions" }, views ? finish("Finish the drive", state, act) : starter(logs.length ? "Drive again" : "Start the drive", "drive", state, act, step.status !== "done")),
  ];
  if (views) parts.push(make("p", { id: "drive-seconds" }), make("div", { id: "drive-views", className: "cards" }));
  if (logs.length) parts.push(table(logs.map(([name, seconds]) => [make("code", { textContent: name }), `${seconds} s`])));
  parts.push(make("details", {}, make("summary", { textContent: "Without a drive: the tape alone" }),
    paragraph(`Skip this step, and measure more points: enough are ${state.points.enough}.`)));
  return parts;
}

function points(state, act, step) {
  const { sheet, logs, enough } = state.points;
  const now = state.measured_now, isFirst = step.status !== "done";
  const parts = [
    paragraph(`Put a marker that no robot carries on the floor, near a number on the map. Measure its distances from A and B with a tape, and type them on the measuring page. Enough are ${enough}; eight points after a drive are better.`),
  ];
  const actions = make("div", { className: "actions" });
  if (state.pages.measure) actions.append(opener("open-measure", "measure", "Open the measuring page"), finish("Finish measuring", state, act));
  else {
    if (sheet) actions.append(starter("Measure four points with the simulated tape", "sheet", state, act, isFirst));
    actions.append(starter("Start measuring", "measure", state, act, isFirst && !sheet));
  }
  parts.push(actions);
  if (now !== null) parts.push(paragraph(`${count(now, "point")} measured in this log so far.`));
  if (state.map) parts.push(floorMap(state.map, null));
  if (logs.length) {
    const cameras = [...new Set(logs.flatMap(([, , seen]) => Object.keys(seen)))].sort();
    parts.push(table(logs.map(([name, number, seen]) => [make("code", { textContent: name }), String(number), ...cameras.map((camera) => String(seen[camera] ?? "-"))]),
      ["log", "points", ...cameras]));
    parts.push(paragraph("The calibration uses all these logs. Measuring again writes a new log."));
  }
  if (sheet && !state.pages.measure) {
    parts.push(make("details", {}, make("summary", { textContent: "Without a drive: the tape alone" }),
      make("div", { className: "actions" }, starter(`Measure all points in ${sheet}`, "sheet-all", state, act, false))));
  }
  return parts;
}

function outlier(one, several, state, act) {
  const name = several ? `${one.point} in ${one.log}` : one.point;
  const exclude = button("Exclude", () => act(() => change("exclude", { log: one.log, point: one.point })), `exclude-${one.log}-${one.point}`.replace(/[^\w-]/g, "_"), { disabled: !state.may_change });
  exclude.setAttribute("aria-label", `Exclude ${name}`);
  const text = one.text || "no simple mistake explains it";
  return make("li", { className: "warn outlier" }, make("span", { textContent: `${name}, error ${one.error_cm.toFixed(1)} cm: ${text}.` }), exclude);
}

// The answer of a calibration with a drive: is it enough, and what to add.
function lab(state) {
  const { headline: [answer, ...faults], enough, advice, title, columns, rows, gap, notes } = state.lab;
  const leads = [["drive", "Drive there"], ["points", "Measure points"]];
  return [
    ...lines([[enough ? "good" : "warn", answer], ...faults.map((text) => ["warn", text.trim()]), ...advice.map((text) => ["", text])]),
    ...(enough ? [] : [make("div", { className: "actions" }, ...leads.map(([name, text]) => button(text, () => { location.hash = name; }, `to-${name}`)))]),
    ...(state.map ? [floorMap(state.map, gap)] : []),
    make("details", {}, make("summary", { textContent: "Details of each camera" }), paragraph(sentence(title)), table(rows, columns), ...lines(notes.map((text) => ["", text]))),
  ];
}

function accuracy(state, act, step) {
  const fit = state.accuracy;
  const parts = [
    paragraph(state.drive.logs.length
      ? "The calibration computes all cameras together, from the drive and the points. It tells the expected error over the floor, and whether it is enough."
      : "Without a drive, the model of each camera comes from its points alone."),
    make("div", { className: "actions" }, starter(fit ? "Calibrate again" : "Calibrate", "calibrate-lab", state, act, step.status !== "done")),
  ];
  if (state.lab) parts.push(...lab(state));
  else if (fit && !fit.figure) parts.push(paragraph("Calibrate again to see the expected errors."));
  if (!fit) return parts;
  if (fit.figure) parts.push(make("p", { className: "figure", textContent: fit.figure }));
  if (fit.outliers.length) {
    const several = new Set(state.points.logs.map(([name]) => name)).size > 1;
    parts.push(make("h3", { textContent: fit.outliers.length === 1 ? "A point contradicts the others" : `${fit.outliers.length} points contradict the others` }),
      paragraph("Measure it again, and exclude it here. An excluded point stays in the log."),
      make("ul", { className: "lines" }, ...fit.outliers.map((one) => outlier(one, several, state, act))));
  }
  if (fit.answer.length) parts.push(make("details", {}, make("summary", { textContent: "Details" }), ...lines(fit.answer.map((text) => ["", text]))));
  return parts;
}

function live(state, act, step) {
  const parts = [
    make("p", {}, "The robots are tracked and recorded. The dashboard shows them. Other devices can open it, too, after ", command("ipsys setup --host 0.0.0.0")),
    make("div", { className: "actions" }, ...(state.pages.live
      ? [opener("open-live", "live", "Open the dashboard"), finish("Finish the recording", state, act)]
      : [starter("Start the live view", "live", state, act, step.status !== "done")])),
  ];
  const log = state.tracked.at(-1);
  if (log) {
    parts.push(make("h3", { textContent: "Your positions" }),
      make("p", {}, "As a table: ", command(`ipsys export ${log} -o positions.csv`)),
      make("p", {}, "As a picture that moves: ", command(`ipsys view ${log}`)));
  }
  return parts;
}
