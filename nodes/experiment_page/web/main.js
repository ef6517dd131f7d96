// Asks for the state once a second and puts the page together.

import { showCurves, showSearches } from "./charts.js";
import { element, listOf, show, text } from "./common.js";
import { showParts, tick } from "./parts.js";

const PERIOD_MS = 1000;
const REPORT_MS = 1500;
const PICTURE_MS = 250;
const WORDS = { waiting: "waiting", running: "running", finished: "finished", failed: "failed" };
const METADATA_OF = 12; // of more films only the shown ones are loaded

let tag = "";
let state = null;
let offsetMs = 0; // of the experiment's clock before ours
let lastPhase = "";

const nowS = () => (Date.now() + offsetMs) / 1000;

async function ask() {
  try {
    const response = await fetch("/state.json", { headers: tag ? { "if-none-match": tag } : {}, cache: "no-store" });
    if (response.status === 200) {
      tag = response.headers.get("etag");
      state = await response.json();
      offsetMs = Date.parse(response.headers.get("date")) - Date.now();
      update();
    } else if (response.status !== 304) throw new Error(`status ${response.status}`);
    else if (lastPhase === "no connection") update();
  } catch {
    lastPhase = "no connection";
    text("phase", lastPhase);
    element("phase").className = "badge failed";
    text("said", "The page's server does not answer. The experiment may have been ended.");
  }
}

function update() {
  document.title = `${WORDS[state.phase]}: ${state.name}`;
  text("name", state.setting ? `${state.name} (${state.setting})` : state.name);
  text("phase", WORDS[state.phase]);
  element("phase").className = `badge ${state.phase}`;
  show("failure", Boolean(state.failure));
  text("failure", state.failure ? `The experiment ended with an error. ${state.failure}` : "");
  show("report-link", Boolean(state.report));
  show("nothing-yet", state.curves.length + state.searches.length === 0 && !state.films?.length);
  showParts(state, nowS());
  showCurves(state.curves);
  showSearches(state.searches);
  showRecorded(state.recorded ?? null);
  showPictures();
  showLog(state.log ?? []);
  say();
  if (lastPhase === "running" && state.report) setTimeout(() => location.assign("/"), REPORT_MS);
  lastPhase = state.phase;
}

/** What a screen reader hears: only when a part begins or ends. */
function say() {
  const running = state.parts.filter((part) => part.state === "running").map((part) => part.title);
  const finished = state.parts.filter((part) => part.state === "done" || part.state === "reused").length;
  const failed = state.parts.filter((part) => part.state === "failed").length;
  const counts = `${finished} of ${state.parts.length} parts are finished${failed ? `, ${failed} failed` : ""}.`;
  if (state.phase === "running") text("said", running.length ? `${counts} Running: ${running.join(", ")}.` : counts);
  else if (state.report) text("said", `${counts} The report is ready.`);
  else text("said", state.phase === "finished" ? `${counts} There is no report yet.` : counts);
}

/** A drive that is not of this run, until there is one that is: its newest picture, then its film. */
function showRecorded(recorded) {
  show("recorded-section", Boolean(recorded));
  text("recorded-label", recorded?.label ?? "");
  listOf(element("recorded"), recorded ? [recorded] : [], ({ label, file, film, text: words }) => {
    if (!file) return figure("", words);
    const shown = document.createElement(film ? "video" : "img");
    const autoplay = !matchMedia("(prefers-reduced-motion: reduce)").matches;
    if (film) Object.assign(shown, { controls: true, muted: true, loop: true, autoplay });
    else Object.assign(shown, { id: "recorded-now", alt: label });
    shown.src = `/${file}`;
    shown.setAttribute("aria-label", label);
    return figure(shown, words);
  });
}

/** The newest picture of a drive that goes on. */
function refreshRecorded() {
  const picture = element("recorded-now");
  if (picture?.complete) picture.src = `/${state.recorded.file}?${Date.now()}`;
}

function showPictures() {
  const { films = [], pictures = [] } = state;
  show("pictures-section", films.length + pictures.length > 0);
  listOf(element("films"), films, (path, index) => {
    const name = titleOf(path.split("/")[1]);
    const film = document.createElement("video");
    Object.assign(film, { controls: true, muted: true, loop: true, src: `/${path}` });
    film.preload = index < METADATA_OF ? "metadata" : "none";
    film.setAttribute("aria-label", `Film of ${name}`);
    return figure(film, name);
  });
  listOf(element("pictures"), pictures, (path) => {
    const words = path.replace(/\.\w+$/, "").replaceAll("/", ", ").replaceAll("_", " ");
    const picture = document.createElement("img");
    Object.assign(picture, { loading: "lazy", src: `/${path}`, alt: words });
    return figure(picture, words);
  });
}

const titleOf = (name) => state.parts.find((part) => part.name === name)?.title ?? name;

function figure(content, caption) {
  const made = document.createElement("figure");
  made.className = "card";
  const words = document.createElement("figcaption");
  words.textContent = caption;
  made.append(content, words);
  return made;
}

function showLog(lines) {
  const box = element("log-box");
  const follows = box.scrollTop + box.clientHeight >= box.scrollHeight - 8;
  const changed = listOf(element("log"), lines, ([atS, line]) => {
    const item = document.createElement("li");
    const when = document.createElement("time");
    when.textContent = new Date(atS * 1000).toLocaleTimeString([], { hour12: false });
    item.append(when, ` ${line}`);
    return item;
  });
  if (changed && follows) box.scrollTop = box.scrollHeight;
}

setInterval(ask, PERIOD_MS);
setInterval(refreshRecorded, PICTURE_MS);
setInterval(() => {
  if (state) tick(state, nowS());
}, PERIOD_MS);
ask();

