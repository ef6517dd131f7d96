// What the acts of the node are called for people.

const WORDS = {
  take: "take control",
  leave: "give control back",
  hold: "hold to drive",
  release: "let go of the button",
  let_go: "button let go",
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

export const wordsOf = (act) => WORDS[act] ?? act.replaceAll("_", " ");
