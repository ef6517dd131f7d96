// Curves of training and of searches, drawn in SVG, each with its values as a table.

import { element, listOf, show, text } from "./common.js";

const SVG = "http://www.w3.org/2000/svg";
const [WIDTH, NARROW, HEIGHT] = [340, 250, 190]; // narrow: beside a texture
const [LEFT, RIGHT, TOP, BOTTOM] = [46, 8, 22, 34];

export function showCurves(curves) {
  show("curves-section", curves.length > 0);
  cards(element("curves"), curves, (curve) => `${curve.of} ${curve.name}`, drawTraining);
}

export function showSearches(searches) {
  show("searches-section", searches.length > 0);
  cards(element("searches"), searches, (search) => search.title, drawSearch);
}

/** One card for each item, drawn again only if the item changed. */
function cards(node, items, name, draw) {
  listOf(node, items.map(name), () => {
    const card = document.createElement("figure");
    card.className = "card";
    return card;
  });
  items.forEach((item, index) => {
    const [card, drawn] = [node.children[index], JSON.stringify(item)];
    if (card.drawn === drawn) return;
    card.drawn = drawn;
    draw(card, item);
  });
}

function drawTraining(card, { of, name, points }) {
  const unit = /\[(.*)\]/.exec(name)?.[1] ?? "";
  const bare = name.replace(/ *\[.*\]/, "");
  const [step, last] = points[points.length - 1];
  const words = `${bare}: ${Number(last.toPrecision(3))} ${unit} at step ${step}`;
  const chart = plot({ points, xLabel: "step", yLabel: unit, words, width: WIDTH });
  chart.line(points, "line", "--accent");
  fill(card, `${of}: ${bare}`, chart.svg, words, ["step", name], points);
}

function drawSearch(card, search) {
  const { values, measure } = search;
  const label = `${measure.name} [${measure.unit}]`;
  const said = (value) => `${Number(value.toPrecision(3))} ${measure.unit}`;
  const each = values.map((value, index) => [index + 1, value]);
  let top = -Infinity;
  const best = values.map((value, index) => [index + 1, (top = Math.max(top, value))]);
  const planned = Math.max(search.planned, values.length);
  const words = `${values.length}${search.planned ? ` of ${search.planned}` : ""} evaluations, last ${said(values[values.length - 1])}, best ${said(top)} at evaluation ${search.best + 1}`;
  const chart = plot({ points: [...each, [1, 0], [planned, 0]], xLabel: "evaluation", yLabel: label, words, width: search.texture ? NARROW : WIDTH });
  if (search.climbs) chart.line(each, "each", `--${search.colour}`);
  else chart.dots(each, `--${search.colour}`);
  chart.line(best, "line", `--${search.colour}`);
  fill(card, search.title, chart.svg, words, ["evaluation", label], each);
  if (search.texture) showTexture(card, search);
}

function showTexture(card, search) {
  card.classList.add("with-texture");
  const picture = card.querySelector("img") ?? new Image();
  picture.className = "pixels";
  picture.alt = `Texture of evaluation ${search.best + 1}`;
  picture.onerror = () => { picture.remove(); card.classList.remove("with-texture"); };
  const source = `/texture/${encodeURIComponent(search.name)}.png?${search.texture}-${search.best}`;
  if (picture.getAttribute("src") !== source) picture.src = source;
  card.querySelector("svg").after(picture);
}

/** Heading, drawing, words and values of a card. Open values stay open. */
function fill(card, title, svg, words, heads, rows) {
  const open = card.querySelector("details")?.open ?? false;
  const picture = card.querySelector("img");
  const heading = document.createElement("h3");
  heading.textContent = title;
  const caption = document.createElement("figcaption");
  caption.className = "quiet";
  caption.textContent = words;
  card.replaceChildren(heading, svg, ...(picture ? [picture] : []), caption, values(title, heads, rows, open));
}

function values(title, heads, rows, open) {
  const details = document.createElement("details");
  const summary = document.createElement("summary");
  summary.textContent = "Values";
  details.append(summary);
  const fillIn = () => {
    if (!details.open || details.children.length > 1) return;
    const box = document.createElement("div");
    box.className = "scroll";
    Object.assign(box, { tabIndex: 0, role: "region", ariaLabel: `Values: ${title}` });
    const table = document.createElement("table");
    const head = table.createTHead().insertRow();
    heads.forEach((words) => {
      const cell = document.createElement("th");
      Object.assign(cell, { scope: "col", className: "number", textContent: words });
      head.append(cell);
    });
    const body = table.createTBody();
    rows.forEach((row) => {
      const line = body.insertRow();
      row.forEach((value) => { Object.assign(line.insertCell(), { className: "number", textContent: value }); });
    });
    box.append(table);
    details.append(box);
  };
  details.addEventListener("toggle", fillIn);
  details.open = open;
  fillIn();
  return details;
}

/** Axes with labels for some points; gives what draws into them. */
function plot({ points, xLabel, yLabel, words, width }) {
  const svg = make("svg", { viewBox: `0 0 ${width} ${HEIGHT}`, role: "img" });
  svg.setAttribute("aria-label", words);
  const xTicks = ticks(points.map(([x]) => x), 4, 1);
  const yTicks = ticks(points.map(([, y]) => y), 4, 0);
  const x = scale(xTicks, LEFT, width - RIGHT);
  const y = scale(yTicks, HEIGHT - BOTTOM, TOP);
  yTicks.forEach((value) => {
    svg.append(make("line", { class: "rule", x1: LEFT, x2: width - RIGHT, y1: y(value), y2: y(value) }));
    svg.append(label(LEFT - 6, y(value) + 4, short(value), "end"));
  });
  xTicks.forEach((value) => svg.append(label(x(value), HEIGHT - BOTTOM + 15, short(value), "middle")));
  svg.append(make("line", { class: "axis", x1: LEFT, x2: width - RIGHT, y1: HEIGHT - BOTTOM, y2: HEIGHT - BOTTOM }));
  svg.append(label((LEFT + width - RIGHT) / 2, HEIGHT - 4, xLabel, "middle"), label(2, 9, yLabel, "start"));
  return {
    svg,
    line(row, name, colour) {
      const path = row.map(([a, b], index) => `${index ? "L" : "M"}${x(a).toFixed(1)} ${y(b).toFixed(1)}`).join("");
      const drawn = make("path", { class: name, d: row.length === 1 ? `${path}h0.1` : path });
      drawn.style.stroke = `var(${colour})`;
      drawn.style.strokeLinecap = "round";
      svg.append(drawn);
    },
    dots(row, colour) {
      row.forEach(([a, b]) => {
        const dot = make("circle", { class: "dot", cx: x(a).toFixed(1), cy: y(b).toFixed(1), r: 2.5 });
        dot.style.fill = `var(${colour})`;
        svg.append(dot);
      });
    },
  };
}

/** Round numbers that hold all values: about so many, steps of at least the smallest. */
function ticks(values, about, smallest) {
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const span = high - low || Math.abs(high) || 1;
  const rough = Math.max(span / about, smallest || 0);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((each) => each * power).find((each) => each >= rough * 0.999);
  const first = Math.floor(low / step + 1e-9);
  const last = Math.max(Math.ceil(high / step - 1e-9), first + 1);
  return Array.from({ length: last - first + 1 }, (_, index) => (first + index) * step);
}

const scale = (range, from, to) => {
  const [low, high] = [range[0], range[range.length - 1]];
  return (value) => from + ((value - low) / (high - low)) * (to - from);
};

const short = (value) => (Math.abs(value) >= 10000 ? `${Number((value / 1000).toPrecision(3))}k` : `${Number(value.toPrecision(4))}`);

function label(x, y, words, anchor) {
  const node = make("text", { class: "label", x, y, "text-anchor": anchor, "aria-hidden": "true" });
  text(node, words);
  return node;
}

function make(name, attributes) {
  const node = document.createElementNS(SVG, name);
  Object.entries(attributes).forEach(([key, value]) => node.setAttribute(key, value));
  return node;
}
