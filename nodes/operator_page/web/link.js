// The connection to the node: one WebSocket, opened again when it ends. Every act carries the key of the connection, a growing
// number, and the stamp of the newest picture on the screen.

const RETRY_MS = [200, 500, 1000, 2000];

export class Link {
  #socket = null;
  #key = "";
  #number = 0;
  #retries = 0;

  /** @param {{frame: () => string, onMessage: (m: object) => void, onPicture: (b: ArrayBuffer) => void,
   *           onOpen: () => void, onClose: () => void, onLocked: () => void}} hooks */
  constructor(hooks) {
    this.hooks = hooks;
  }

  get open() {
    return this.#socket !== null && this.#socket.readyState === WebSocket.OPEN && this.#key !== "";
  }

  async connect() {
    let session = null;
    try {
      session = await (await fetch("/session")).json();
    } catch {
      this.#again();
      return;
    }
    if (!session.open) {
      this.hooks.onLocked();
      return;
    }
    const scheme = location.protocol === "https:" ? "wss:" : "ws:";
    const socket = new WebSocket(`${scheme}//${location.host}/live`);
    socket.binaryType = "arraybuffer";
    socket.onmessage = (event) => this.#hear(event.data);
    socket.onclose = () => this.#closed(socket);
    this.#socket = socket;
  }

  /** Ask for an act. Returns its number, or null without a connection. */
  act(type, more = {}) {
    if (!this.open) {
      // A stop also goes without a WebSocket.
      if (type === "estop" || type === "disarm") fetch(`/stop/${type}`, { method: "POST" }).catch(() => {});
      return null;
    }
    this.#number += 1;
    this.#socket.send(JSON.stringify({ t: type, key: this.#key, n: this.#number, frame: this.hooks.frame(), ...more }));
    return this.#number;
  }

  /** Tell the node about pictures. */
  tell(message) {
    if (this.open) this.#socket.send(JSON.stringify(message));
  }

  #hear(data) {
    if (typeof data !== "string") {
      this.hooks.onPicture(data);
      return;
    }
    const message = JSON.parse(data);
    if (message.t === "welcome") {
      this.#key = message.key;
      this.#number = 0;
      this.#retries = 0;
      this.hooks.onOpen();
    }
    this.hooks.onMessage(message);
  }

  #closed(socket) {
    if (socket !== this.#socket) return;
    this.#socket = null;
    this.#key = "";
    this.hooks.onClose();
    this.#again();
  }

  #again() {
    const wait = RETRY_MS[Math.min(this.#retries, RETRY_MS.length - 1)];
    this.#retries += 1;
    setTimeout(() => this.connect(), wait);
  }
}
