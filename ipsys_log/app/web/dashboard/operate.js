// The buttons of the operator.
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
