// The buttons of the operator, and those of the player of a log.
import { make } from "./make.js";
import { Seat, post } from "./operator.js";

const $ = (id) => document.getElementById(id);
const NOTICE_MS = 8000;

export class Operation {
  constructor(may) {
    this.may = may;
    this.seat = new Seat("ipsys");
    this.segment = null;
    $("operate-panel").hidden = !may;
    if (!may) return;
    $("take").addEventListener("click", () => this.run(() => this.press()));
    this.handle("mark", () => post("mark", { operator: this.seat.number, text: $("mark").value }), "Marked in the log.");
    this.handle("segment", () => post("segment", { operator: this.seat.number, ...(this.segment ? {} : { start: $("segment").value }) }));
  }

  handle(name, work, done) {
    $(`${name}-form`).addEventListener("submit", (event) => {
      event.preventDefault();
      this.run(async () => {
        await work();
        $(name).value = "";
        if (done) this.tell(done);
      });
    });
  }

  async run(work) {
    try { await work(); } catch (error) { this.tell(error.message, true); }
  }

  async press() {
    await (this.seat.operates ? this.seat.release() : this.seat.take());
    this.draw();
  }

  show(data) {
    if (!this.may) return;
    this.seat.present = data.operator ?? 0;
    this.segment = data.segment ?? null;
    this.ended = data.end !== null;
    this.draw();
  }

  draw() {
    const { operates, isFree } = this.seat;
    const text = this.ended ? "The recording has ended." : operates ? "This device operates."
      : isFree ? "No device operates." : "Another device operates.";
    if ($("operation").textContent !== text) $("operation").textContent = text;
    $("take").textContent = operates ? "Stop operating" : isFree ? "Operate from this device" : "Take over";
    $("take").hidden = this.ended;
    for (const name of ["mark", "segment"]) {
      $(`${name}-form`).hidden = !operates || this.ended;
    }
    $("segment-save").textContent = this.segment ? `Stop ${this.segment.name}` : "Start";
    $("segment").hidden = this.segment !== null;
  }

  tell(text, bad = false) {
    clearTimeout(this.timer);
    $("notice").textContent = text;
    $("notice").className = bad ? "bad" : "";
    $("notice").hidden = false;
    this.timer = setTimeout(() => ($("notice").hidden = true), NOTICE_MS);
  }
}

const RATES = [0.1, 0.25, 0.5, 1, 2, 5, 10];

export function duration(seconds) {
  const whole = Math.floor(seconds), two = (value) => String(value).padStart(2, "0");
  return `${Math.floor(whole / 3600)}:${two(Math.floor(whole / 60) % 60)}:${two(whole % 60)}`;
}

export class PlayerBar {
  // changed(state): the server has carried out a command.
  constructor(changed) {
    this.changed = changed;
    this.dragged = false;
    $("play").addEventListener("click", () => this.send({ is_paused: !this.state.is_paused }));
    $("rate").addEventListener("change", () => this.send({ rate: Number($("rate").value) }));
    $("seek").addEventListener("input", () => { this.dragged = true; this.tell(Number($("seek").value)); });
    $("seek").addEventListener("change", () => { this.dragged = false; this.send({ seconds: Number($("seek").value) }); });
  }

  async send(command) {
    try { this.changed(await post("play", command)); } catch (error) { $("at").textContent = error.message; }
  }

  show(state) {
    $("player").hidden = !state;
    if (!state) return;
    this.state = state;
    const { is_paused, rate, seconds, of_seconds } = state;
    if (![...$("rate").options].some((option) => Number(option.value) === rate)) {
      const rates = [...new Set([...RATES, rate])].sort((a, b) => a - b);
      $("rate").replaceChildren(...rates.map((value) => make("option", { value: String(value) }, `× ${value}`)));
    }
    if (document.activeElement !== $("rate")) $("rate").value = String(rate);
    $("play").textContent = is_paused ? "Play" : "Pause";
    $("seek").max = of_seconds;
    if (this.dragged) return;
    $("seek").value = seconds;
    this.tell(seconds);
  }

  tell(seconds) {
    const text = `${duration(seconds)} of ${duration(this.state.of_seconds)}`;
    $("at").textContent = text;
    $("seek").setAttribute("aria-valuetext", text);
  }
}
