// Requests that change something, and the device that may send them: one at a time. The server decides.
export async function post(path, body = {}) {
  let answer;
  try {
    answer = await fetch(`api/${path}`, {
      method: "POST", headers: { "Content-Type": "application/json", "X-Ipsys": "1" }, body: JSON.stringify(body),
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
  // key: the name under which a reloaded page finds its number again.
  constructor(key) {
    this.key = key;
    this.number = Number(sessionStorage.getItem(key)) || 0;
    this.present = 0;
  }

  get operates() { return this.number !== 0 && this.number === this.present; }

  get isFree() { return this.present === 0; }

  async take() {
    const { operator } = await post("operate", { take_over: !this.isFree });
    this.number = this.present = operator;
    sessionStorage.setItem(this.key, operator);
  }

  async release() {
    await post("operate", { release: this.number });
    this.number = this.present = 0;
  }
}
