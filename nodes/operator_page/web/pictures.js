// Pictures, newest only. Each is drawn in an animation frame and then acknowledged; the node sends no more than two ahead.

export const CHANNELS = [0, 1, 2];
const HEAD_BYTES = 9;
const LIVE_MS = 60000;
const OLD_MS = 1000; // age from which a picture no longer shows what the car sees; the node lets go of the button then

export class Pictures {
  #waiting = new Map();
  #frame = 0;
  #stamp = 0n;
  #clockMs = null;
  #drawn = new Map(); // per channel: when it was drawn, and how old it was then; null for a recording

  /** @param {(channel: number, stamp: string) => void} onDrawn */
  constructor(onDrawn) {
    this.onDrawn = onDrawn;
    this.canvases = CHANNELS.map((channel) => document.getElementById(`picture-${channel}`));
    this.ages = CHANNELS.map((channel) => document.getElementById(`age-${channel}`));
  }

  /** Show how old each picture is now, also while no new one comes; an old one turns grey. */
  showAges() {
    const now = performance.now();
    for (const [channel, { drawnMs, ageMs }] of this.#drawn) {
      const since = now - drawnMs;
      const age = ageMs === null ? since : ageMs + since;
      const old = age > OLD_MS;
      this.canvases[channel].classList.toggle("old", old);
      this.ages[channel].classList.toggle("bad", old);
      const seconds = (age / 1000).toFixed(1);
      if (old) this.ages[channel].textContent = ageMs === null ? `no new picture for ${seconds} s` : `${seconds} s old`;
      else this.ages[channel].textContent = ageMs === null ? "recorded" : `${Math.round(age)} ms`;
    }
  }

  /** Capture stamp of the newest picture on the screen, in nanoseconds, as text. */
  get stamp() {
    return String(this.#stamp);
  }

  /** Whether no picture on the screen shows what the car sees. */
  get old() {
    return this.canvases.every((canvas, channel) => !this.#drawn.has(channel) || canvas.classList.contains("old"));
  }

  /** Forget what was shown on an earlier connection. */
  reset() {
    this.#stamp = 0n;
    this.#clockMs = null;
  }

  /** Note the node's clock, which tells how old a picture is. The message with the shortest way counts. */
  clock(realMs) {
    const offset = Date.now() - realMs;
    this.#clockMs = this.#clockMs === null ? offset : Math.min(this.#clockMs + 0.01, offset);
  }

  /** Take a picture from the node. */
  async take(data) {
    const view = new DataView(data);
    const channel = view.getUint8(0);
    const stamp = view.getBigInt64(1);
    let bitmap = null;
    try {
      bitmap = await createImageBitmap(new Blob([new Uint8Array(data, HEAD_BYTES)], { type: "image/jpeg" }));
    } catch {
      this.onDrawn(channel, String(stamp));
      return;
    }
    const before = this.#waiting.get(channel);
    if (before) {
      before.bitmap.close();
      this.onDrawn(channel, String(before.stamp));
    }
    this.#waiting.set(channel, { bitmap, stamp });
    if (!this.#frame) this.#frame = requestAnimationFrame(() => this.#draw());
  }

  #draw() {
    this.#frame = 0;
    for (const [channel, { bitmap, stamp }] of this.#waiting) {
      const canvas = this.canvases[channel];
      if (canvas.width !== bitmap.width || canvas.height !== bitmap.height) {
        canvas.width = bitmap.width;
        canvas.height = bitmap.height;
      }
      canvas.getContext("2d").drawImage(bitmap, 0, 0);
      bitmap.close();
      canvas.dataset.stamp = String(stamp);
      canvas.closest("figure").classList.add("seen");
      if (stamp > this.#stamp) this.#stamp = stamp;
      const age = this.#clockMs === null ? 0 : Math.max(0, Date.now() - this.#clockMs - Number(stamp / 1000000n));
      this.#drawn.set(channel, { drawnMs: performance.now(), ageMs: age < LIVE_MS ? age : null });
      this.onDrawn(channel, String(stamp));
    }
    this.#waiting.clear();
    this.showAges();
  }
}
