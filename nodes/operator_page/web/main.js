// Puts the page together.

import { HoldButton } from "./hold.js";
import { Link } from "./link.js";
import { EFFECTS, Messages, OBSTACLES, factsOf } from "./messages.js";
import { allow, showAttacks, showState, text } from "./panels.js";
import { CHANNELS, Pictures } from "./pictures.js";
import { PlaceMap, SteeringPlot } from "./plots.js";
import { wordsOf } from "./words.js";

const element = (id) => document.getElementById(id);
const DRAW_MS = 100;

let welcome = null;
let state = null;
let heldPress = 0; // the press that the node has confirmed
const messages = new Messages();
const pictures = new Pictures((channel, stamp) => link.tell({ t: "seen", c: channel, s: stamp }));
const map = new PlaceMap(element("map"));
const plot = new SteeringPlot(element("steering"));
const link = new Link({
  frame: () => pictures.stamp,
  onPicture: (data) => pictures.take(data),
  onMessage: hear,
  onOpen: opened,
  onClose: closed,
  onLocked: locked,
});
const hold = new HoldButton(element("hold"), link, showHold);

function opened() {
  pictures.reset();
  element("enter").hidden = true;
  element("main").hidden = false;
  text("link", "");
}

function closed() {
  hold.release();
  state = null;
  heldPress = 0;
  messages.clear();
  allow(false); // only a stop also goes without a connection
  text("armed", "no connection");
  element("armed").classList.remove("armed");
  document.body.classList.remove("stopped");
  text("reason", "The page shows the last state that it received.");
  text("link", "connecting again");
}

function locked() {
  element("enter").hidden = false;
  element("main").hidden = true;
  text("armed", "locked");
  text("link", "");
  element("code").focus();
}

function hear(message) {
  if (message.t === "beat") hold.beat(message.beat);
  else if (message.t === "state") update(message);
  else if (message.t === "answer") answer(message);
  else if (message.t === "welcome") begin(message);
  else if (message.t === "refused") messages.say("answer", `Refused: ${message.text}`);
}

function begin(message) {
  welcome = message;
  map.set(message);
  element("policy-figure").hidden = !message.policy_view;
  document.body.classList.toggle("watch", !message.operates);
  document.body.classList.toggle("still", !message.stops); // a recording has no car
  showAttacks(message.attacks, (id) => link.act("attack", { id }));
  link.tell({ t: "wants", c: CHANNELS.filter((channel) => channel !== 2 || message.policy_view) });
}

function update(message) {
  state = message;
  pictures.clock(message.real_ms);
  map.move(message.car);
  plot.add(message.steering);
  showState(message, me());
  messages.look(factsOf(message, me().mine, pictures.old));
  showHold();
}

function me() {
  return { operates: welcome.operates, session: welcome.session, mine: Boolean(state.lease) && state.lease.client === welcome.client };
}

/** Say what the button does now, and stop holding when the node has ended the hold. */
function showHold() {
  const button = element("hold");
  const held = hold.held;
  button.classList.toggle("held", held);
  if (!state) return;
  if (held && heldPress === hold.press && state.press !== hold.press) {
    hold.release();
    messages.say("hold-answer", `Released: ${state.ended}. Hold the button again.`, OBSTACLES.hold);
  }
  heldPress = hold.held && state.press === hold.press ? hold.press : 0;
  const armed = state.safety?.armed;
  text("hold", !hold.held ? "Hold to drive" : armed ? "Let go to stop" : state.held ? "Held, not armed" : "Asking");
}

function answer(message) {
  const words = wordsOf(message.act);
  if (message.act === "hold") {
    if (message.refused) hold.release();
    messages.say("hold-answer", message.refused ? `Not held: ${message.refused}.` : "", OBSTACLES.hold);
    return;
  }
  if (message.act === "release") return;
  // The node starts a recorder, and says when it records.
  const done = message.act === "record" ? "Asked to start recording." : `Done: ${words}.`;
  const causes = (message.refused ? OBSTACLES : EFFECTS)[message.act];
  messages.say("answer", message.refused ? `Not done: ${words}: ${message.refused}.` : done, causes);
}

function drawPlots() {
  pictures.showAges();
  messages.age();
  if (!document.hidden && welcome) {
    map.draw();
    plot.draw();
  }
}

element("take-form").addEventListener("submit", (event) => {
  event.preventDefault();
  link.act("take", { name: element("name").value });
  element("hold").focus();
});
element("label-form").addEventListener("submit", (event) => {
  event.preventDefault();
  if (link.act("label", { text: element("label").value }) !== null) element("label").value = "";
});
for (const id of ["leave", "disarm", "reset_estop", "trial", "trial_end", "attack_off", "record", "record_stop"]) {
  element(id).addEventListener("click", () => link.act(id));
}
// The e-stop acts when the finger goes down, not when it goes up.
element("estop").addEventListener("pointerdown", () => { hold.release(); link.act("estop"); });
element("estop").addEventListener("keydown", (event) => {
  if (event.key !== " " && event.key !== "Enter") return;
  event.preventDefault(); // no click beside it
  if (!event.repeat) { hold.release(); link.act("estop"); }
});
element("estop").addEventListener("click", (event) => {
  // A screen reader clicks without a pointer and without a key.
  if (event.detail === 0) { hold.release(); link.act("estop"); }
});
window.addEventListener("keydown", (event) => {
  if (event.key === "Escape" && !event.repeat) { hold.release(); link.act("estop"); }
});
element("enter-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  const [code, name] = [element("code").value, element("who").value.trim()];
  text("enter-answer", "");
  let wrong = "This code is wrong, was used, or has expired. Run advnerf car page on the robot for a new one.";
  try {
    const response = await fetch("/enter", {
      method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify({ code, name }),
    });
    if (response.ok) {
      element("code").value = "";
      element("name").value = name;
      link.connect();
      return;
    }
    if (response.status === 400) wrong = "This is no code, or the name has characters that cannot be printed.";
    if (response.status === 429) wrong = `Too many wrong codes. Try again in ${(await response.json()).wait_s} s.`;
  } catch {
    text("enter-answer", "No answer from the robot.");
    return;
  }
  text("enter-answer", wrong);
});

element("enter-form").addEventListener("input", () => text("enter-answer", ""));

// What sticks below the header, and what is scrolled to, must know how high it is.
new ResizeObserver(([entry]) => {
  document.documentElement.style.setProperty("--head", `${entry.target.offsetHeight}px`);
}).observe(document.querySelector("header"));
setInterval(drawPlots, DRAW_MS);
link.connect();
