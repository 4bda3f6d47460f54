// Requests that change something, and the device that may send them: one at a time. The server decides.
const PATIENCE_MS = 20000;

export async function post(path, body = {}) {
  let answer;
  try {
    answer = await fetch(`api/${path}`, {
      method: "POST", headers: { "Content-Type": "application/json", "X-Ipsys": "1" }, body: JSON.stringify(body),
      signal: AbortSignal.timeout(PATIENCE_MS),
    });
  } catch {
    throw new Error("ipsys does not answer. Does it still run, and is this device in its network?");
  }
  const kind = answer.headers.get("content-type") ?? "";
  const content = kind.includes("json") ? await answer.json() : { error: await answer.text() };
  if (!answer.ok && !content.faults) throw new Error(content.error || `error ${answer.status}`);
  return content;
}

export class Seat {
  // key: the name of the number in the store of the browser: all tabs, and a reloaded page, are the same device.
  constructor(key) {
    this.key = key;
    this.present = 0;
  }

  get number() { return Number(localStorage.getItem(this.key)) || 0; }

  get operates() { return this.number !== 0 && this.number === this.present; }

  get isFree() { return this.present === 0; }

  async take() {
    const { operator } = await post("operate", { take_over: !this.isFree });
    localStorage.setItem(this.key, operator);
    this.present = operator;
  }

  async release() {
    await post("operate", { release: this.number });
    localStorage.removeItem(this.key);
    this.present = 0;
  }
}
