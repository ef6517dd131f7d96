// What the acts of the node are called for people.

const WORDS = {
  take: "take control",
  leave: "give control back",
  hold: "hold to drive",
  release: "let go of the button",
  estop: "emergency stop",
  reset_estop: "release the emergency stop",
  disarm: "disarm",
  trial: "start a trial",
  trial_end: "end the trial",
  attack: "show an attack",
  attack_off: "attack off",
  record: "start recording",
  record_stop: "stop recording",
  label: "label",
};
// The same as a sentence of the log, after the name of the person.
const DONE = {
  take: () => "took control",
  leave: () => "gave control back",
  hold: () => "held the button",
  armed: () => "armed the car",
  release: () => "let go of the button",
  let_go: (why) => `was made to let go: ${why}`,
  estop: () => "pressed the emergency stop",
  reset_estop: () => "released the emergency stop",
  disarm: () => "disarmed the car",
  trial: () => "started a trial",
  trial_end: () => "ended the trial",
  attack: (id) => `showed attack ${id}`,
  attack_off: () => "switched the attack off",
  record: () => "started recording",
  record_stop: () => "stopped recording",
  label: (words) => `labelled “${words}”`,
};

export const wordsOf = (act) => WORDS[act] ?? act.replaceAll("_", " ");

/** One line of the log: who did what, or what this person was refused. */
export function sentenceOf({ operator, act, detail, refused }) {
  if (refused) return `${operator} was refused: ${wordsOf(act)}: ${refused}`;
  return `${operator} ${DONE[act]?.(detail) ?? `${wordsOf(act)} ${detail}`}`;
}
