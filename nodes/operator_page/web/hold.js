// The button that lets the car drive while it is held. A beat of the node is answered at once, by a page that draws frames. A page
// that is hidden, frozen or busy does not answer, and the node counts the button as released.

const FRAME_MS = 400; // longest time without a frame of a page that counts as drawn

export class HoldButton {
  #press = 0;
  #held = false;
  #frameMs = 0;

  /** @param {HTMLButtonElement} button @param {import("./link.js").Link} link @param {() => void} onChange */
  constructor(button, link, onChange) {
    this.button = button;
    this.link = link;
    this.onChange = onChange;
    this.#listen();
  }

  get held() {
    return this.#held;
  }

  /** Number of the newest press. */
  get press() {
    return this.#press;
  }

  /** Answer a beat of the node. */
  beat(number) {
    if (!this.#held || document.hidden || performance.now() - this.#frameMs > FRAME_MS) return;
    this.link.act("hold", { beat: number, press: this.#press });
  }

  /** Let go, whatever the finger does. */
  release() {
    if (!this.#held) return;
    this.#held = false;
    this.link.act("release", { press: this.#press });
    this.onChange();
  }

  #draws() {
    this.#frameMs = performance.now();
    if (this.#held) requestAnimationFrame(() => this.#draws());
  }

  #begin() {
    if (this.#held || this.button.disabled || document.hidden) return;
    this.#press += 1;
    this.#held = true;
    this.#draws();
    this.onChange();
  }

  #listen() {
    const { button } = this;
    button.addEventListener("pointerdown", (event) => {
      if (!event.isPrimary || event.button !== 0) return;
      button.setPointerCapture(event.pointerId);
      button.focus();
      this.#begin();
    });
    button.addEventListener("pointermove", (event) => {
      const box = button.getBoundingClientRect();
      const inside = event.clientX >= box.left && event.clientX <= box.right && event.clientY >= box.top && event.clientY <= box.bottom;
      if (!inside) this.release();
    });
    for (const name of ["pointerup", "pointercancel", "lostpointercapture", "blur"]) {
      button.addEventListener(name, () => this.release());
    }
    button.addEventListener("contextmenu", (event) => event.preventDefault());
    button.addEventListener("keydown", (event) => {
      if (event.key !== " " && event.key !== "Enter") return;
      event.preventDefault();
      if (!event.repeat) this.#begin();
    });
    button.addEventListener("keyup", (event) => {
      if (event.key === " " || event.key === "Enter") this.release();
    });
    document.addEventListener("visibilitychange", () => document.hidden && this.release());
    document.addEventListener("freeze", () => this.release());
    window.addEventListener("pagehide", () => this.release());
    window.addEventListener("blur", () => this.release());
  }
}
