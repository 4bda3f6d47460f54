// The setup page. Every second it reads the state from the server, so that all devices show the same.
import { change, seat } from "./fields.js";
import { make } from "./make.js";
import { panel, shownPart } from "./panels.js";
import { boardImage, driveImages } from "./pictures.js";

const $ = (id) => document.getElementById(id);
const EVERY_MS = 1000, PATIENCE_MS = 15000;
const SAID = { done: "done", ready: "can be done now", waits: "waits" };
let state = null, shown = "", selected = null, told = "", lastFault = "null", timer = 0, request = null, isLost = false;

function chip(kind, text) {
  if ($("state").textContent === text) return;
  $("state").textContent = text;
  $("state").className = `chip ${kind}`;
}

function tell(text) {
  if (text && $("notice").textContent !== text) $("notice").textContent = text;
  $("notice").hidden = !text;
}

// Do something on the server, and show the new state at once.
async function act(work) {
  tell("");
  told = state.job?.error ?? "";
  // The server may need some seconds, before a job is known.
  if (!state.job || state.job.ended) {
    $("job").hidden = false;
    $("stop").hidden = true;
    $("job-text").textContent = $("job-text").dataset.said = "Working ...";
    $("job-progress").removeAttribute("value");
  }
  try { await work(); } catch (error) { tell(error.message); }
  await read();
}

function choose() {
  const wanted = location.hash.slice(1);
  const names = state.steps.map((step) => step.name);
  selected = names.includes(wanted) ? wanted : (selected ?? state.next ?? names.at(-1));
}

function drawSteps() {
  const rows = state.steps.map((step, n) => {
    const button = make("button", { type: "button", id: `step-${step.name}`, className: step.status },
      make("b", { textContent: String(n + 1) }),
      make("span", { className: "title", textContent: step.title }), make("small", { textContent: step.text || SAID[step.status] }));
    if (step.name === selected) button.setAttribute("aria-current", "step");
    button.addEventListener("click", () => { location.hash = step.name; });
    return make("li", {}, button);
  });
  const focused = document.activeElement?.id;
  $("steps").replaceChildren(...rows);
  if (focused?.startsWith("step-")) $(focused)?.focus();
}

const initial = (one) => one.defaultValue ?? [...one.options].find((option) => option.defaultSelected)?.value;

// isBack: images that could not be loaded are loaded again.
function drawPanel(isBack = false) {
  const part = shownPart(selected, state);
  if (part === shown && !isBack) return;
  // Typed texts and the focus survive a change by another device.
  const same = shown.startsWith(`["${selected}"`);
  const typed = same ? [...$("panel").querySelectorAll("input:not([type=checkbox]), select")].filter((one) => one.value !== initial(one)).map((one) => [one.id, one.name, one.value]) : [];
  const focused = same ? document.activeElement?.id : "", within = same && $("panel").contains(document.activeElement);
  shown = part;
  const unfolded = same && $("panel").querySelector("form details")?.open;
  $("panel").replaceChildren(...panel(selected, state, act));
  if (unfolded) $("panel").querySelector("form details")?.setAttribute("open", "");
  for (const [id, name, value] of typed) {
    if ($(id)?.name !== name) continue;
    $(id).value = value;
    $(id).dispatchEvent(new Event("input", { bubbles: true }));
  }
  if (focused && $("panel").contains($(focused))) $(focused).focus();
  // A fault that a job has found moves the keyboard to its field, as a fault of the typed text does.
  const { fault } = state.address, faulted = JSON.stringify(fault);
  if (fault && faulted !== lastFault && within) $(fault.field)?.focus();
  lastFault = faulted;
  // A button that has vanished leaves the keyboard in the panel.
  if (within && !$("panel").contains(document.activeElement)) $("panel").focus();
  drawSteps();
}

function drawJob() {
  const job = state.job, works = job && !job.ended;
  $("job").hidden = !works;
  $("stop").hidden = !state.may_change;
  if (job?.ended && job.error && job.error !== told) tell(job.error);
  if (!works) return;
  const text = `${job.stopping ? "Stopping" : "Working"}: ${job.name}`;
  const line = job.lines.at(-1) ?? "";
  const stage = job.stage ? `${job.stage}: ${job.done}${job.total ? ` of ${job.total}` : ""}` : "";
  const said = [text, stage, line].join("\n");
  if ($("job-text").dataset.said !== said) {
    $("job-text").dataset.said = said;
    $("job-text").replaceChildren(text, make("small", { textContent: stage || line }));
  }
  const bar = $("job-progress");
  if (job.total) { bar.max = job.total; bar.value = job.done; } else bar.removeAttribute("value");
}

// Show who operates. Without an operator, the first device that changes something operates.
function drawOperator() {
  const { operates, isFree } = seat;
  $("operate").hidden = state.may_operate && isFree;
  const text = !state.may_operate ? "This device only views." : operates ? "This device operates; others only view."
    : isFree ? "" : "Another device operates; this one only views.";
  if ($("operation").textContent !== text) $("operation").textContent = text;
  $("take").textContent = operates ? "Let others operate" : "Take over";
  $("take").hidden = !state.may_operate || isFree;
}

// Without an answer in time, the network may have lost the request: another one replaces it.
async function ask() {
  request?.abort();
  const own = request = new AbortController();
  const patience = setTimeout(() => own.abort(), PATIENCE_MS);
  try {
    const answer = await fetch("api/state", { signal: own.signal });
    if (!answer.ok) throw new Error(await answer.text());
    return await answer.json();
  } catch (error) {
    if (request !== own) return null;
    throw error instanceof TypeError || error.name === "AbortError" ? new Error("ipsys does not answer") : error;
  } finally {
    clearTimeout(patience);
  }
}

// Without the server, the buttons wait.
function drawLost() {
  if (!state) return;
  state.may_change = false;
  $("operate").hidden = false;
  $("operation").textContent = "ipsys does not answer: the buttons wait. If the command has ended, start it again.";
  $("take").hidden = $("stop").hidden = true;
  drawPanel();
}

async function read() {
  clearTimeout(timer);
  try {
    const present = await ask();
    if (!present) return;
    state = present;
    const isBack = isLost;
    isLost = false;
    if (isBack) tell("");
    seat.present = state.operator;
    state.may_change = state.may_operate && (seat.operates || seat.isFree);
    drawOperator();
    const count = state.steps.filter((step) => step.status === "done").length;
    chip(count === state.steps.length ? "good" : "", `${count} of ${state.steps.length} done`);
    $("folder").textContent = state.folder;
    choose();
    drawPanel(isBack);
    if (state.drive.views && $("drive-views")) {
      $("drive-views").replaceChildren(...driveImages(state.drive.views));
      $("drive-views").dataset.seconds = state.drive.seconds;
      $("drive-seconds").textContent = `${state.drive.seconds} s recorded. Green: a robot was in this part of the image.`;
    }
    if (state.board) $("board-image")?.replaceChildren(...boardImage(state.board));
    drawJob();
  } catch (error) {
    chip("bad", error.message.slice(0, 60));
    isLost = true;
  }
  clearTimeout(timer);
  timer = setTimeout(read, EVERY_MS);
  if (isLost) drawLost();
}

addEventListener("hashchange", () => {
  if (!state) return;
  choose();
  drawPanel();
  scrollTo(0, 0);
  $("panel").focus();
});
// A page that comes back does not wait for the next turn.
addEventListener("online", read);
addEventListener("pageshow", (event) => { if (event.persisted) read(); });
document.addEventListener("visibilitychange", () => { if (!document.hidden) read(); });
$("take").addEventListener("click", () => act(() => (seat.operates ? seat.release() : seat.take())));
$("stop").addEventListener("click", () => act(() => change("stop")));
read();
