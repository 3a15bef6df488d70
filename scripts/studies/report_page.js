"use strict";
// The page: words and tables, and what the controls do to the figures.

const $ = (id) => document.getElementById(id);
const REFERENCE = DATA.reference, RUNGS = DATA.rungs;
const colourOf = (r) => (r < 0 ? "var(--truth)" : `var(--run-${r})`);
const dashOf = (r) => DATA.dashes[r % DATA.dashes.length].map((d) => 1.8 * d).join(" ");
const shapeOf = (r) => (r < 0 ? SQUARE : SHAPES[r % SHAPES.length]);
const LEAST = 1e-8; // error shown on a logarithmic axis
const breakable = (name) => name.replace(/[[,]\s*/g, "$&\u200b"); // a long name may go over several lines
const nameOf = (row) => (row === REFERENCE ? "reference" : breakable(row.name));

function tag(name, text, parent, attributes = {}) {
  const element = document.createElement(name);
  element.textContent = text;
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (parent) parent.append(element);
  return element;
}

function options(select, pairs, chosen) {
  for (const [value, text] of pairs) tag("option", text, select, { value });
  select.value = chosen;
}

function table(element, head, rows, bold = () => false) {
  const top = tag("tr", "", tag("thead", "", element));
  for (const text of head) tag("th", text, top, { scope: "col" });
  const body = tag("tbody", "", element);
  rows.forEach((cells, i) => {
    const row = tag("tr", "", body);
    cells.forEach((cell, k) => tag(k ? "td" : "th", cell ?? "\u2013", row, k ? { class: bold(i, k) || "" } : { scope: "row" }));
  });
}

const shown = (value, digits = 2) => (value === null || value === undefined ? null : readable(value, digits));
const valued = (value) => (value === null || value === undefined ? "\u2013" : typeof value === "object" ? JSON.stringify(value) : String(value));

function words() {
  $("about").textContent = `Commit ${(DATA.commit || "unknown").slice(0, 12)}; ${DATA.machine}; ${REFERENCE.threads} thread${REFERENCE.threads === 1 ? "" : "s"} a run`;
  DATA.summary.forEach((text, i) => tag("li", text, $("summary"), { class: i === 0 ? "first" : i === 1 ? "main" : "" }));
  for (const [name, text] of Object.entries(DATA.meaning)) {
    tag("dt", name, $("meaning"));
    tag("dd", text, $("meaning"));
  }
  const others = new Set(RUNGS.map((row) => row.commit).filter((commit) => commit && commit !== DATA.commit));
  $("origin").textContent = `Made by scripts/compare.py at commit ${DATA.commit || "unknown"}` +
    (others.size ? `, some runs at ${[...others].join(", ")}` : "") +
    `. One ${DATA.unit} is ${DATA.unit_value.toPrecision(6)}, R is ${DATA.R.toPrecision(6)} in the scene's units.`;
}

function tables() {
  const quantities = Object.keys(DATA.meaning), all = [REFERENCE, ...RUNGS], ran = all.filter((row) => row.cost);
  const state = (row) => (row === REFERENCE ? "its own error" : !row.cost ? "refused" : row.complete ? "" : `ended at ${readable(row.until)} ${DATA.unit}`);
  table($("numbers"),
    ["rung", "N", "steps", "rejected", ...quantities, `CPU s a ${DATA.unit}`, `wall s a ${DATA.unit}`, "CPU ms a step", "MB", "speed-up", ""],
    all.map((row) => [nameOf(row), row.nodes, row.cost ? row.steps : null, row.cost ? row.rejected : null,
      ...quantities.map((name) => shown(row.worst?.[name])), shown(row.cost?.cpu), shown(row.cost?.wall),
      row.cost ? shown(1000 * row.cpu_a_step) : null, row.cost ? Math.round(row.peak_bytes / 1e6) : null,
      row.cost && REFERENCE.cost ? `${shown(REFERENCE.cost.cpu / row.cost.cpu)} \u00d7` : null, state(row)]),
    (i, k) => (k === quantities.length + 9 ? "words" :
      k > 3 && k < 4 + quantities.length && DATA.front[quantities[k - 4]].cpu.includes(all[i].name) ? "best" : ""));
  const grid = (element, key, show) => {
    const names = [...new Set(ran.flatMap((row) => Object.keys(row[key])))].sort();
    table(element, ["", ...ran.map(nameOf)], names.map((name) => [name, ...ran.map((row) => show(row[key][name]))]));
  };
  grid($("stages"), "stages", (value) => shown(value === undefined ? null : 1000 * value));
  grid($("counts"), "counts", (value) => (value === undefined ? null : String(value)));
  const { runs, shared, different } = DATA.settings;
  table($("different"), ["key", ...runs.map((name, i) => (i ? breakable(name) : "reference"))], Object.entries(different).map(([key, values]) => [key, ...values.map(valued)]));
  table($("shared"), ["key", "value"], Object.entries(shared).map(([key, value]) => [key, valued(value)]));
}

function legend() {
  [REFERENCE, ...RUNGS].forEach((row, i) => {
    const label = tag("label", "", $("legend")), r = i - 1;
    const box = tag("input", "", label, { type: "checkbox", "data-run": i });
    box.checked = SHOWN[i] = Boolean(row.cost);
    box.disabled = !row.cost;
    const sample = make("svg", { width: 30, height: 14, "aria-hidden": "true" });
    make("line", { x1: 0, x2: 30, y1: 7, y2: 7, style: `stroke:${colourOf(r)};stroke-width:${r < 0 ? 4 : 2}`, "stroke-dasharray": r < 0 ? "" : dashOf(r) }, sample);
    marker(sample, shapeOf(r), 15, 7, colourOf(r), { r: 4.5 });
    label.append(sample);
    tag("span", nameOf(row) + (row.cost ? "" : " (refused)"), label);
    box.addEventListener("change", () => { SHOWN[i] = box.checked; figures(); });
  });
}

/** Low and high that hold values with some room, on a logarithmic axis. */
function around(values, room = 1.6) {
  const known = values.filter((value) => value > 0);
  if (!known.length) return [0.1, 1];
  return [Math.min(...known) / room, Math.max(...known) * room];
}

function trade(width) {
  const quantity = $("quantity").value, taken = $("taken").value, cost = $("cost").value;
  const points = [REFERENCE, ...RUNGS].map((row, i) => ({ row, r: i - 1, x: row.cost?.[cost], y: row[taken]?.[quantity] }))
    .filter((p) => p.x > 0 && p.y !== undefined && SHOWN[p.r + 1]).map((p) => ({ ...p, y: Math.max(p.y, LEAST) }));
  const [xl, xh] = around(points.map((p) => p.x), 2), [yl, yh] = around(points.map((p) => p.y));
  const height = Math.min(380, 0.78 * width);
  const plot = axes($("trade"), { low: xl, high: xh, log: true, title: `${DATA.costs[cost]} a ${DATA.unit}` },
    { low: yl, high: yh, log: true, title: `${quantity}, ${$("taken").selectedOptions[0].text}` },
    { width, height, label: `Error of ${quantity} against cost` });
  if (taken === "worst") {
    const best = DATA.front[quantity][cost].map((name) => points.find((p) => p.row.name === name)).filter(Boolean), steps = [];
    best.forEach((p, k) => {
      if (k) steps.push([plot.X(p.x), plot.Y(best[k - 1].y)]);
      steps.push([plot.X(p.x), plot.Y(p.y)]);
    });
    line(plot.inside, steps, { class: "front" });
  }
  const labels = [];
  for (const p of points) {
    const x = plot.X(p.x), y = plot.Y(p.y), dot = marker(plot.inside, shapeOf(p.r), x, y, colourOf(p.r), { open: !p.row.complete });
    make("title", {}, dot, `${p.row.name}: ${readable(p.y)}, ${readable(p.x)} ${DATA.costs[cost]} a ${DATA.unit}`);
    const text = p.r < 0 ? "reference, its own error" : p.row.name.length > 26 ? `${p.row.name.slice(0, 25)}\u2026` : p.row.name, long = 6.6 * text.length;
    labels.push({ text, width: long, x: x + 11 + long > plot.right ? x - 11 - long : x + 11, y: y + 4, end: x + 11 + long > plot.right });
  }
  apart(labels, 15, plot.top + 12, plot.bottom - 4);
  for (const l of labels) make("text", { class: "name", x: l.end ? l.x + l.width : l.x, y: l.y, "text-anchor": l.end ? "end" : "start" }, plot.svg, l.text);
  $("trade-caption").textContent = `${quantity}: ${DATA.meaning[quantity]}. ` +
    (taken === "worst" ? "Dashed: what no other rung beats in both. " : "") + "Open: did not reach the end.";
}

let history = null; // the plot of errors over time, for the mark of the film's time
function over(width) {
  const quantity = $("quantity").value, curves = [];
  DATA.errors.forEach((found, r) => {
    if (found?.values[quantity] && SHOWN[r + 1]) curves.push({ r, t: found.t, y: found.values[quantity] });
  });
  const floor = SHOWN[0] ? DATA.floor?.values[quantity] : undefined;
  const values = curves.flatMap((c) => c.y.slice(Math.ceil(c.y.length / 50))).concat(floor ? floor.slice(Math.ceil(floor.length / 50)) : []);
  const [low, high] = around(values.filter((value) => value > LEAST));
  history = axes($("history"), { low: 0, high: DATA.until || 1, log: false, title: `time, ${DATA.unit}` },
    { low, high, log: true, title: quantity }, { width, height: Math.min(380, 0.78 * width), label: `Error of ${quantity} over time` });
  const { X, Y, inside, bottom } = history;
  const pixels = (t, y) => t.map((time, k) => (y[k] > 0 ? [X(time), Y(Math.max(y[k], low / 10))] : null));
  if (floor) {
    const edge = pixels(DATA.floor.t, floor).filter(Boolean);
    if (edge.length) line(inside, [[edge[0][0], bottom], ...edge, [edge[edge.length - 1][0], bottom]], { class: "floor", fill: null });
  }
  for (const c of curves) {
    const path = line(inside, pixels(c.t, c.y), { style: `stroke:${colourOf(c.r)};stroke-width:1.8`, "stroke-dasharray": dashOf(c.r) });
    make("title", {}, path, RUNGS[c.r].name);
  }
  history.mark = make("line", { class: "now", y1: history.top, y2: bottom }, inside);
  history.svg.addEventListener("click", (event) => {
    const x = ((event.clientX - history.svg.getBoundingClientRect().left) * width) / history.svg.getBoundingClientRect().width;
    FILM.go((FILM.last * (x - history.left)) / (history.right - history.left));
  });
  mark();
}

function mark() {
  const x = history.X(DATA.film.times[Math.round(Number($("film").dataset.at || 0))]);
  history.mark.setAttribute("x1", x);
  history.mark.setAttribute("x2", x);
}

function paths(width) {
  const chosen = DATA.film.paths, found = [];
  FILM.runs.forEach((run, i) => {
    if (!run || !SHOWN[i]) return;
    for (const m of chosen) {
      found.push({ r: i - 1, points: Array.from({ length: run.frames }, (_, k) => [0, 1].map((c) => run.centers[2 * (k * DATA.vesicles + m) + c])) });
    }
  });
  const every = found.flatMap((p) => p.points).concat(DATA.film.walls.flat());
  const limits = (c) => {
    let low = Infinity, high = -Infinity;
    for (const p of every) [low, high] = [Math.min(low, p[c]), Math.max(high, p[c])];
    if (low > high) [low, high] = [-1, 1];
    const room = Math.max(0.05 * (high - low), 0.05);
    return { low: low - room, high: high + room, log: false };
  };
  const x = { ...limits(0), title: "x / R" }, y = { ...limits(1), title: "y / R" };
  const ratio = (y.high - y.low) / (x.high - x.low), height = Math.min(Math.max(54 + ratio * (width - 72), 190), 560);
  const plot = axes($("paths"), x, y, { width, height, equal: true, label: "Paths of the centroids" });
  for (const wall of DATA.film.walls) line(plot.inside, [...wall, wall[0]].map((p) => [plot.X(p[0]), plot.Y(p[1])]), { class: "wall" });
  for (const { r, points } of found) {
    const pixels = points.map((p) => [plot.X(p[0]), plot.Y(p[1])]);
    const path = line(plot.inside, pixels, r < 0 ? { class: "truth" } : { style: `stroke:${colourOf(r)};stroke-width:1.5`, "stroke-dasharray": dashOf(r) });
    make("title", {}, path, r < 0 ? "reference" : RUNGS[r].name);
    marker(plot.inside, shapeOf(r), ...pixels[pixels.length - 1], colourOf(r), { r: 4 });
  }
  $("paths-caption").textContent = "Wide and grey: the reference. Markers: where the vesicles are at the end." +
    (chosen.length < DATA.vesicles ? ` ${chosen.length} of ${DATA.vesicles} vesicles.` : "");
}

function figures() {
  trade(Math.max(300, $("trade").clientWidth));
  over(Math.max(300, $("history").clientWidth));
  paths(Math.max(300, $("paths").clientWidth));
  FILM.draw();
}

function controls() {
  const quantities = Object.keys(DATA.meaning);
  options($("quantity"), quantities.map((name) => [name, name]), quantities[0]);
  options($("cost"), Object.entries(DATA.costs), "cpu");
  for (const id of ["quantity", "taken", "cost"]) $(id).addEventListener("change", figures);
  options($("speed"), [[0.25, "\u00bc \u00d7"], [0.5, "\u00bd \u00d7"], [1, "1 \u00d7"], [2, "2 \u00d7"], [4, "4 \u00d7"]], "1");
  $("speed").addEventListener("change", () => FILM.faster(Number($("speed").value)));
  options($("camera"), [[-1, "stands still"], ...DATA.film.paths.map((m) => [m, `goes with vesicle ${m + 1}`])], "-1");
  $("camera").addEventListener("change", () => FILM.camera(Number($("camera").value)));
  $("scrub").max = FILM.last;
  $("scrub").addEventListener("input", () => FILM.go(Number($("scrub").value)));
  $("play").addEventListener("click", FILM.toggle);
  $("closer").addEventListener("click", () => FILM.zoom(1.4));
  $("farther").addEventListener("click", () => FILM.zoom(1 / 1.4));
  $("reset").addEventListener("click", FILM.reset);
  FILM.listen((at, playing) => {
    const k = Math.round(at), text = `${readable(DATA.film.times[k])} ${DATA.unit}`;
    $("scrub").value = k;
    $("scrub").setAttribute("aria-valuetext", text);
    $("clock").textContent = text;
    $("play").textContent = playing ? "Pause" : "Play";
    $("play").setAttribute("aria-pressed", String(playing));
    mark();
  });
  let width = window.innerWidth;
  window.addEventListener("resize", () => {
    if (window.innerWidth !== width) figures();
    width = window.innerWidth;
  });
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", FILM.draw);
}

words();
tables();
legend();
controls();
figures();
FILM.go(0);
