// The texts of the page, from the state that the node sends.

import { sentenceOf } from "./words.js";

const element = (id) => document.getElementById(id);
const SILENT_S = 1.5;

export function text(id, value) {
  const node = element(id);
  if (node.textContent !== value) node.textContent = value;
}

const number = (value, digits, unit) => (value === null || value === undefined ? "-" : `${value.toFixed(digits)} ${unit}`);
const degrees = (value) => (value === null || value === undefined ? "-" : `${(value * 180 / Math.PI).toFixed(1)}°`);
const fresh = (part) => Boolean(part) && part.age_s !== null && part.age_s < SILENT_S;
const show = (id, visible) => { element(id).hidden = !visible; };

export function showState(state, me) {
  showSafety(state);
  showPlace(state);
  showSteering(state.steering);
  showAttack(state);
  showRecording(state.recording, state.nodes);
  showHealth(state);
  showTrial(state.trial);
  showActs(state.acts);
  showLease(state, me);
  show("hint", state.hint !== "");
  text("hint", state.hint);
}

function showSafety({ safety, estop, not_confirmed: notConfirmed }) {
  const pill = element("armed");
  const known = fresh(safety);
  const armed = known && safety.armed;
  // A latched stop is the state of everything: nothing else on the page may look as if the car could drive.
  const stopped = !armed && (estop || (known && safety.reason.startsWith("e-stop")));
  text("armed", !safety ? "no safety node" : !known ? "safety node is silent" : armed ? "ARMED" : stopped ? "EMERGENCY STOP" : "disarmed");
  pill.classList.toggle("armed", Boolean(armed));
  document.body.classList.toggle("stopped", Boolean(stopped));
  const late = notConfirmed ? `${notConfirmed}. ` : "";
  text("reason", late + (safety ? (armed ? `by ${safety.source}` : safety.reason) : ""));
  element("reason").classList.toggle("bad", late !== "");
}

function showPlace({ car, motor, latency }) {
  text("cte", fresh(car) ? number(car.cte_m, 3, "m") : "-");
  text("speed", fresh(motor) ? number(motor.speed_mps, 2, "m/s") : "-");
  text("motor-ms", number(latency.motor_ms, 0, "ms"));
  text("page-ms", number(latency.page_ms, 0, "ms"));
  const where = fresh(car) ? `Car at ${car.x_m.toFixed(2)}, ${car.y_m.toFixed(2)} m` : "No pose of the car";
  element("map").setAttribute("aria-label", `${where}. Path, fence and trail from above.`);
}

function showSteering(steering) {
  const now = fresh(steering) ? steering : null;
  text("clean", degrees(now?.clean_rad));
  text("attacked", degrees(now?.attacked_rad));
  const compared = now && steering.clean_rad !== null && steering.attacked_rad !== null;
  const why = now || !steering ? "no counterfactual node" : "-";
  text("delta", compared ? degrees(steering.attacked_rad - steering.clean_rad) : why);
}

function showAttack({ attack, chosen, search }) {
  const parts = [];
  if (!attack) parts.push("No node shows attacks.");
  else if (!fresh(attack)) parts.push(`Unknown: the node that shows attacks has been silent for ${attack.age_s.toFixed(1)} s.`);
  else if (attack.drawn) parts.push(`Attack ${attack.id} is shown.${attack.reason ? ` ${attack.reason}.` : ""}`);
  else parts.push(`Not shown: ${attack.reason || "no attack"}.`);
  if (chosen.trouble) parts.push(`${chosen.id}: ${chosen.trouble}.`);
  if (search) parts.push(`Search ${search}.`);
  text("attack-text", parts.join(" "));
  for (const button of document.querySelectorAll("#attacks button")) {
    const on = Boolean(attack) && attack.id === button.dataset.id && chosen.show;
    button.setAttribute("aria-pressed", String(on));
  }
}

function showRecording(recording, nodes) {
  const launch = nodes.find((node) => node.name === "recorder" && node.state === "active" && fresh(node));
  let state = launch ? "The launch records." : "Nothing is recorded.";
  if (recording.stopping) state = `Finishing ${recording.folder}.`;
  else if (recording.records) state = `Recording to ${recording.folder}.`;
  else if (recording.on) state = "Starting a recorder. Nothing is recorded yet.";
  text("record-text", `${state} ${recording.disk_left_gb.toFixed(1)} GB left.${recording.trouble ? ` ${recording.trouble}` : ""}`);
  show("record", !recording.on);
  show("record_stop", recording.on && !recording.stopping);
}

function showHealth({ nodes, motor, rows }) {
  const battery = rows.find((row) => row.name.endsWith("battery"));
  text("battery", battery ? battery.text || number(motor?.voltage_v, 1, "V") : number(motor?.voltage_v, 1, "V"));
  text("motor", !motor ? "-" : !fresh(motor) ? "silent" : motor.braking ? `brakes: ${motor.reason || "stopped"}` : "drives");
  const faults = rows.filter((row) => row.level !== "ok" && row !== battery).map((row) => `${row.name}: ${row.text}`);
  if (motor?.fault) faults.unshift(motor.fault);
  text("faults", faults.join("; ") || "none");
  const body = element("nodes");
  while (body.rows.length > nodes.length) body.deleteRow(-1);
  nodes.forEach((node, index) => {
    const row = body.rows[index] ?? newRow(body);
    const late = node.age_s === null || node.age_s > SILENT_S;
    const cells = [node.name, late ? "silent" : node.state, node.age_s === null ? "-" : `${node.age_s.toFixed(1)} s`, node.text];
    cells.forEach((value, column) => {
      if (row.cells[column].textContent !== value) row.cells[column].textContent = value;
    });
    row.cells[1].className = `state-${cells[1]}`;
  });
}

function newRow(body) {
  const row = body.insertRow();
  const head = document.createElement("th");
  head.scope = "row";
  row.append(head, ...Array.from({ length: 3 }, () => document.createElement("td")));
  return row;
}

function showTrial(trial) {
  const running = trial.phase === "waiting" || trial.phase === "running";
  show("trial", !running);
  show("trial_end", running);
  const begin = `Trial ${trial.number}`;
  if (trial.phase === "idle") text("trial-text", "");
  else if (trial.phase === "waiting") text("trial-text", `${begin}: hold the button to begin.`);
  else if (trial.phase === "running") text("trial-text", `${begin}: ${trial.ticks} of ${trial.of_ticks} ticks.`);
  else if (!trial.counts) text("trial-text", `${begin} is no result, after ${trial.ticks} of ${trial.of_ticks} ticks: ${trial.stopped}.`);
  else if (trial.total_cte_m === undefined) text("trial-text", `${begin} has ended.`);
  else {
    const off = trial.off_track ? ", off the track" : "";
    const shown = trial.attack_id ? `attack ${trial.attack_id}` : "no attack";
    const driven = `${trial.ticks} of ${trial.of_ticks} ticks${trial.stopped ? `, stopped: ${trial.stopped}` : ""}`;
    text("trial-text", `${begin} (${shown}, ${driven}): total cross-track error ${trial.total_cte_m.toFixed(2)} m, largest ${trial.max_cte_m.toFixed(2)} m${off}.`);
  }
}

function showActs(acts) {
  const list = element("acts");
  const rows = acts.map((act) => {
    const time = new Date(act.real_ms).toLocaleTimeString();
    return `${time} ${sentenceOf(act)}`;
  });
  while (list.children.length > rows.length) list.lastElementChild.remove();
  rows.forEach((row, index) => {
    const item = list.children[index] ?? list.appendChild(document.createElement("li"));
    if (item.textContent !== row) item.textContent = row;
  });
}

function showLease({ lease, viewers, estop }, { operates, mine, session }) {
  const others = `${viewers} ${viewers === 1 ? "page is" : "pages are"} open.`;
  if (!operates) text("lease", `This page only watches. ${others}`);
  else if (mine) text("lease", `You operate as ${lease.name}. ${others}`);
  else if (lease) text("lease", `${lease.name} operates; you watch. Free after ${lease.left_s} s without an act. ${others}`);
  else text("lease", `Nobody operates. ${others}`);
  show("take-form", operates && (!lease || (!mine && lease.session === session)));
  show("leave", mine);
  show("reset_estop", operates && estop);
  element("estop").classList.toggle("latched", estop);
  text("estop", estop ? "Stopped" : "Emergency stop");
  allow(mine, estop);
}

/** Disable what cannot be done now. The stops are never disabled. */
export function allow(mine, estop = false) {
  const acts = "#hold, #reset_estop, #trial, #trial_end, #attack_off, #record, #record_stop, #attacks button, #label-form button";
  for (const button of document.querySelectorAll(acts)) button.disabled = !mine || (estop && ["hold", "trial"].includes(button.id));
}

export function showAttacks(attacks, onChoose) {
  const list = element("attacks");
  list.replaceChildren(...attacks.map((attack) => {
    const item = document.createElement("li");
    const button = document.createElement("button");
    button.type = "button";
    button.dataset.id = attack.id;
    button.setAttribute("aria-pressed", "false");
    button.disabled = true;
    const picture = document.createElement("img");
    picture.src = `/attack/${attack.id}`;
    picture.alt = "";
    picture.width = picture.height = 128;
    const name = document.createElement("strong");
    name.textContent = attack.name;
    const facts = document.createElement("span");
    const predicted = attack.predicted_m === null ? "not predicted" : `predicted ${attack.predicted_m.toFixed(1)} m`;
    const clean = attack.clean_m === null ? "" : ` (${attack.clean_m.toFixed(1)} m without)`;
    facts.textContent = `${attack.id}, ${attack.method}, seed ${attack.seed}: total cross-track error ${predicted}${clean}`;
    button.append(picture, name, facts);
    button.addEventListener("click", () => onChoose(attack.id));
    item.append(button);
    return item;
  }));
}
