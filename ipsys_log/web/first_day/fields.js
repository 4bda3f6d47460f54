// Requests to the server, and fields with their faults.
import { make } from "./make.js";

export async function post(path, body = {}) {
  let answer;
  try {
    answer = await fetch(`api/${path}`, {
      method: "POST", headers: { "Content-Type": "application/json", "X-Ipsys": "1" }, body: JSON.stringify(body),
    });
  } catch {
    throw new Error("ipsys does not answer. Is it still running in the terminal?");
  }
  const kind = answer.headers.get("content-type") ?? "";
  const content = kind.includes("json") ? await answer.json() : { error: await answer.text() };
  if (content.faults) return content.faults;
  if (!answer.ok) throw new Error(content.error || `error ${answer.status}`);
  return [];
}

// A text field; its fault is below it, and a screen reader reads it with the field.
export function field(id, label, value, properties = {}) {
  const input = make("input", { id, name: id, value, autocomplete: "off", spellcheck: false, ...properties });
  input.defaultValue = value;
  input.setAttribute("aria-describedby", `${id}-fault`);
  return make("div", {}, make("label", { htmlFor: id, textContent: label }), input, make("p", { id: `${id}-fault`, className: "fault" }));
}

// Show faults at their fields, and move the focus to the first one.
export function showFaults(form, faults, idOf) {
  for (const input of form.querySelectorAll("input")) {
    input.setAttribute("aria-invalid", "false");
    document.getElementById(`${input.id}-fault`).textContent = "";
  }
  for (const fault of [...faults].reverse()) {
    const input = document.getElementById(idOf(fault.field));
    input.setAttribute("aria-invalid", "true");
    document.getElementById(`${input.id}-fault`).textContent = fault.text;
    input.focus();
  }
}
