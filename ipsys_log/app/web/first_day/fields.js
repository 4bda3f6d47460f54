// Changes on the server, and fields with their faults.
import { make } from "./make.js";
import { Seat, post } from "./operator.js";

// The seat of this device; a request names its number.
export const seat = new Seat("ipsys");

// Ask for a change, as the operator; return the faults of the fields.
export async function change(path, body = {}) {
  if (!seat.operates && seat.isFree) await seat.take();
  return (await post(path, { ...body, operator: seat.number })).faults ?? [];
}

// A text field; its fault is below it, and a screen reader reads it with the field.
export function field(id, label, value, properties = {}) {
  const input = make("input", { id, name: id, value, autocomplete: "off", spellcheck: false, ...properties });
  input.defaultValue = value;
  input.setAttribute("aria-describedby", `${id}-fault`);
  return make("div", {}, make("label", { htmlFor: id, textContent: label }), input, make("p", { id: `${id}-fault`, className: "fault" }));
}

// A choice of texts.
export function choice(id, label, value, texts) {
  const select = make("select", { id, name: id }, ...texts.map((text) => make("option", { value: text, selected: text === value, defaultSelected: text === value }, text)));
  select.setAttribute("aria-describedby", `${id}-fault`);
  return make("div", {}, make("label", { htmlFor: id, textContent: label }), select, make("p", { id: `${id}-fault`, className: "fault" }));
}

// Show faults at their fields, and move the focus to the first one.
export function showFaults(form, faults, idOf) {
  for (const input of form.querySelectorAll("input, select")) {
    input.setAttribute("aria-invalid", "false");
    document.getElementById(`${input.id}-fault`).textContent = "";
  }
  for (const fault of [...faults].reverse()) markFault(form, fault, idOf).focus();
}

// Show a fault at its field of a form; return the field.
export function markFault(form, fault, idOf) {
  const input = form.querySelector(`#${idOf(fault.field)}`);
  input.setAttribute("aria-invalid", "true");
  input.closest("details")?.setAttribute("open", "");
  form.querySelector(`#${input.id}-fault`).textContent = fault.text;
  return input;
}
