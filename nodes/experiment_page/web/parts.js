// The table of stages and cells, and the times.

import { duration, element, text } from "./common.js";

let followed = -1; // the running part that was brought into view

const FINISHED = new Set(["done", "reused", "failed"]);

export function showParts(state, nowS) {
  const body = element("parts");
  while (body.rows.length > state.parts.length) body.deleteRow(-1);
  state.parts.forEach((part, index) => {
    const row = body.rows[index] ?? newRow(body);
    row.className = part.state === "running" ? "running" : "";
    text(row.cells[0].firstChild, part.title);
    text(row.cells[1].firstChild, part.state);
    row.cells[1].firstChild.className = `state-${part.state}`;
    text(row.cells[1].lastChild, said(part));
    text(row.cells[2].lastChild, part.left_s === null ? "" : `${duration(part.left_s)} left`);
  });
  tick(state, nowS);
  follow(state.parts.findIndex((part) => part.state === "running"));
}

/** Bring a part that has begun into view within its box, unless a person is in there. */
function follow(index) {
  const box = element("parts-box");
  if (index < 0 || index === followed || box.contains(document.activeElement)) return;
  followed = index;
  box.scrollTop = element("parts").rows[index].offsetTop - box.clientHeight / 2;
}

/** What changes with the time alone. */
export function tick(state, nowS) {
  state.parts.forEach((part, index) => {
    const cell = element("parts").rows[index]?.cells[2];
    if (cell) text(cell.firstChild, elapsed(part, nowS));
  });
  showTimes(state, nowS);
}

export function showTimes(state, nowS) {
  const { parts } = state;
  const done = parts.reduce((sum, part) => sum + (FINISHED.has(part.state) ? 1 : part.fraction), 0);
  element("whole").value = parts.length ? done / parts.length : 0;
  if (!state.began_s) return;
  const spent = duration((state.ended_s || nowS) - state.began_s);
  if (state.phase !== "running") text("times", `Took ${spent}.`);
  else text("times", `${spent} so far, ${left(state)}.`);
}

function left({ left_s: leftS, left_known: known }) {
  if (known) return `about ${duration(leftS)} left`;
  return leftS > 1 ? `at least ${duration(leftS)} left: not every part can be estimated yet` : "time left is not known yet";
}

function elapsed(part, nowS) {
  if (part.state === "running") return duration(nowS - part.began_s);
  return part.seconds ? duration(part.seconds) : "";
}

function said(part) {
  if (part.state === "running") return `${Math.round(100 * part.fraction)} %${part.text ? `, ${part.text}` : ""}`;
  if (part.state === "failed") return part.text;
  const measured = Object.entries(part.measured ?? {}).map(([domain, [total, clean]]) => {
    const without = total === clean ? "" : ` (without attack ${clean.toFixed(1)} m)`;
    return `${domain === "surrogate" ? "learned" : domain} ${total.toFixed(1)} m${without}`;
  });
  return measured.length ? `total CTE ${measured.join(", ")}` : "";
}

function newRow(body) {
  const row = body.insertRow();
  const head = document.createElement("th");
  head.scope = "row";
  head.append(document.createElement("span"));
  const cells = ["", "number"].map((name) => {
    const cell = document.createElement("td");
    const detail = document.createElement("span");
    cell.className = name;
    detail.className = "quiet";
    cell.append(document.createElement("span"), detail);
    return cell;
  });
  row.append(head, ...cells);
  return row;
}
