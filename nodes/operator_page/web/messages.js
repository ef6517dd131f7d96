// Sentences about a moment. Each goes when its cause is gone, and after ten seconds in any case: none stays under what is shown later.

import { text } from "./panels.js";

const LONGEST_MS = 10000;

// What stands in the way of an act. A refusal goes once one of these held and holds no longer.
export const OBSTACLES = {
  take: ["taken"],
  hold: ["not_mine", "latched", "old"],
  reset_estop: ["not_mine", "not_latched"],
  trial: ["not_mine", "armed", "latched"],
  attack: ["not_mine", "trial"],
  attack_off: ["not_mine", "trial"],
  trial_end: ["not_mine", "no_trial"],
  label: ["not_mine", "not_recorded"],
  record: ["not_mine", "recorder"],
  record_stop: ["not_mine", "no_recorder"],
};
// What an act brings about. Its answer goes with it.
export const EFFECTS = {
  take: ["mine"],
  leave: ["not_mine"],
  estop: ["latched"],
  disarm: ["not_armed"],
  reset_estop: ["not_latched"],
  trial: ["trial"],
  record: ["recorder"],
};

/** What is so now, by the names above. */
export function factsOf(state, mine, old) {
  const { estop, lease, safety, recording, trial } = state;
  const runs = trial.phase === "waiting" || trial.phase === "running";
  const armed = Boolean(safety?.armed);
  return {
    mine, not_mine: !mine, taken: Boolean(lease) && !mine, latched: estop, not_latched: !estop, armed, not_armed: !armed, old,
    trial: runs, no_trial: !runs, recorder: recording.on, no_recorder: !recording.on, not_recorded: !recording.records,
  };
}

export class Messages {
  #said = new Map();

  /** Say something in an element until one of its causes has been and is gone. */
  say(id, value, causes = []) {
    text(id, value);
    this.#said.set(id, { sinceMs: performance.now(), causes, seen: new Set() });
  }

  /** Take back what is no longer so. */
  look(facts) {
    for (const [id, { causes, seen }] of this.#said) {
      if (causes.some((cause) => seen.has(cause) && !facts[cause])) this.#drop(id);
      else causes.filter((cause) => facts[cause]).forEach((cause) => seen.add(cause));
    }
  }

  /** Take back what is old. */
  age() {
    for (const [id, { sinceMs }] of this.#said) if (performance.now() - sinceMs >= LONGEST_MS) this.#drop(id);
  }

  /** Take back everything. */
  clear() {
    for (const id of [...this.#said.keys()]) this.#drop(id);
  }

  #drop(id) {
    text(id, "");
    this.#said.delete(id);
  }
}
