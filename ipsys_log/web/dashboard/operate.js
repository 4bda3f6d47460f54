// The buttons of the operator. One device operates; the server refuses all others.
const $ = (id) => document.getElementById(id);
const KEY = "ipsys-operator", NOTICE_MS = 8000;

export class Operation {
  constructor(may) {
    this.may = may;
    // A reloaded page is still the same device.
    this.number = Number(sessionStorage.getItem(KEY)) || 0;
    this.present = 0;
    this.segment = null;
    $("operate-panel").hidden = !may;
    if (!may) return;
    $("take").addEventListener("click", () => this.run(() => (this.operates ? this.release() : this.take())));
    this.handle("mark", () => this.post("mark", { operator: this.number, text: $("mark").value }), "Marked in the log.");
    this.handle("segment", () => this.post("segment", { operator: this.number, ...(this.segment ? {} : { start: $("segment").value }) }));
  }

  get operates() { return this.number !== 0 && this.number === this.present; }

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

  async post(path, body) {
    let answer;
    try {
      answer = await fetch(`api/${path}`, {
        method: "POST", headers: { "Content-Type": "application/json", "X-Ipsys": "1" }, body: JSON.stringify(body),
      });
    } catch {
      throw new Error("ipsys does not answer. Is this device in its network?");
    }
    const kind = answer.headers.get("content-type") ?? "";
    const content = kind.includes("json") ? await answer.json() : { error: await answer.text() };
    if (!answer.ok) throw new Error(content.error || `error ${answer.status}`);
    return content;
  }

  async take() {
    const { operator } = await this.post("operate", { take_over: this.present !== 0 });
    this.number = this.present = operator;
    sessionStorage.setItem(KEY, operator);
    this.draw();
  }

  async release() {
    await this.post("operate", { release: this.number });
    this.number = this.present = 0;
    this.draw();
  }

  show(data) {
    if (!this.may) return;
    this.present = data.operator ?? 0;
    this.segment = data.segment ?? null;
    this.ended = data.end !== null;
    this.draw();
  }

  draw() {
    const free = this.present === 0;
    const text = this.ended ? "The recording has ended." : this.operates ? "This device operates."
      : free ? "No device operates." : "Another device operates.";
    if ($("operation").textContent !== text) $("operation").textContent = text;
    $("take").textContent = this.operates ? "Stop operating" : free ? "Operate from this device" : "Take over";
    $("take").hidden = this.ended;
    for (const name of ["mark", "segment"]) {
      $(`${name}-form`).hidden = !this.operates || this.ended;
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
