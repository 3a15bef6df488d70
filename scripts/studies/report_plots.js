"use strict";
// Plots as SVG: scales with round ticks, curves, points. Colours are custom properties of the page, so that a dark page needs no new drawing.

const SVG = "http://www.w3.org/2000/svg";

function make(name, attributes = {}, parent = null, text = null) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (text !== null) element.textContent = text;
  if (parent) parent.append(element);
  return element;
}

/** Round values between two: powers of ten (with 2 and 5 where there are few) on a logarithmic axis, multiples of 1, 2 or 5 on a linear one. */
function ticks(low, high, log, wanted = 6) {
  const found = [];
  if (log) {
    const decades = Math.log10(high / low);
    const factors = decades < 1.6 ? [1, 2, 5] : [1];
    const every = Math.max(1, Math.ceil(decades / wanted));
    for (let e = Math.floor(Math.log10(low)); e <= Math.ceil(Math.log10(high)); e++) {
      for (const f of factors) {
        const value = f * 10 ** e;
        if ((f > 1 || e % every === 0) && value >= low * 0.999 && value <= high * 1.001) found.push(value);
      }
    }
    return found;
  }
  const raw = (high - low) / wanted;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = power * [1, 2, 5, 10].find((f) => f * power >= raw * 0.999);
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push(k * step);
  return found;
}

const RAISED = { "-": "\u207b", 0: "\u2070", 1: "\u00b9", 2: "\u00b2", 3: "\u00b3", 4: "\u2074", 5: "\u2075", 6: "\u2076", 7: "\u2077", 8: "\u2078", 9: "\u2079" };

/** A number in few digits; as a power of ten from 10^least down and from 10^5 up. */
function readable(value, digits = 3, least = -5) {
  if (value === 0) return "0";
  const e = Math.floor(Math.log10(Math.abs(value)) + 1e-9);
  if (e > least && e < 5) return e < 0 ? value.toFixed(digits - 1 - e).replace(/0+$/, "") : String(Number(value.toPrecision(digits)));
  const front = Number((value / 10 ** e).toPrecision(digits));
  return (front === 1 ? "" : `${front}\u00b7`) + "10" + [...String(e)].map((sign) => RAISED[sign]).join("");
}

/** An empty plot in a container. x, y: {low, high, log, title}. equal: one scale for both axes, which widens one of them. */
function axes(container, x, y, { width, height, equal = false, label }) {
  const left = 64, right = 14, top = 10, bottom = 44;
  if (equal) {
    const scale = Math.max((x.high - x.low) / (width - left - right), (y.high - y.low) / (height - top - bottom));
    for (const [axis, pixels] of [[x, width - left - right], [y, height - top - bottom]]) {
      const spare = (scale * pixels - (axis.high - axis.low)) / 2;
      axis.low -= spare;
      axis.high += spare;
    }
  }
  container.replaceChildren();
  const svg = make("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": label });
  const scaled = (axis, from, to) => {
    const f = axis.log ? Math.log10 : (value) => value;
    return (value) => from + ((f(value) - f(axis.low)) / (f(axis.high) - f(axis.low))) * (to - from);
  };
  const X = scaled(x, left, width - right), Y = scaled(y, height - bottom, top);
  for (const value of ticks(x.low, x.high, x.log, Math.round(width / 85))) {
    make("line", { class: "grid", x1: X(value), x2: X(value), y1: top, y2: height - bottom }, svg);
    make("text", { x: X(value), y: height - bottom + 17, "text-anchor": "middle" }, svg, readable(value, 3, x.log ? -3 : -5));
  }
  for (const value of ticks(y.low, y.high, y.log, Math.round(height / 55))) {
    make("line", { class: "grid", x1: left, x2: width - right, y1: Y(value), y2: Y(value) }, svg);
    make("text", { x: left - 7, y: Y(value) + 4, "text-anchor": "end" }, svg, readable(value, 3, y.log ? -3 : -5));
  }
  make("rect", { class: "frame", x: left, y: top, width: width - left - right, height: height - top - bottom }, svg);
  make("text", { class: "axis-title", x: (left + width - right) / 2, y: height - 8, "text-anchor": "middle" }, svg, x.title);
  const middle = (top + height - bottom) / 2;
  make("text", { class: "axis-title", x: 14, y: middle, "text-anchor": "middle", transform: `rotate(-90 14 ${middle})` }, svg, y.title);
  const id = `inside-${container.id}`;
  const clip = make("clipPath", { id }, make("defs", {}, svg));
  make("rect", { x: left, y: top, width: width - left - right, height: height - top - bottom }, clip);
  const inside = make("g", { "clip-path": `url(#${id})` }, svg);
  container.append(svg);
  return { svg, inside, X, Y, left, right: width - right, top, bottom: height - bottom };
}

/** A polyline through points given in pixels; null breaks it. */
function line(parent, points, attributes) {
  let d = "", pen = "M";
  for (const p of points) {
    if (p === null) { pen = "M"; continue; }
    d += `${pen}${p[0].toFixed(1)} ${p[1].toFixed(1)}`;
    pen = "L";
  }
  return make("path", { fill: "none", d, ...attributes }, parent);
}

const SHAPES = [
  (r) => `M${-r} 0A${r} ${r} 0 1 0 ${r} 0A${r} ${r} 0 1 0 ${-r} 0Z`,
  (r) => `M0 ${-1.2 * r}L${1.2 * r} 0L0 ${1.2 * r}L${-1.2 * r} 0Z`,
  (r) => `M0 ${-1.15 * r}L${1.1 * r} ${0.85 * r}L${-1.1 * r} ${0.85 * r}Z`,
  (r) => `M0 ${1.15 * r}L${1.1 * r} ${-0.85 * r}L${-1.1 * r} ${-0.85 * r}Z`,
  (r) => `M${-r} ${-0.4 * r}H${-0.4 * r}V${-r}H${0.4 * r}V${-0.4 * r}H${r}V${0.4 * r}H${0.4 * r}V${r}H${-0.4 * r}V${0.4 * r}H${-r}Z`,
  (r) => `M${-r} ${-r}L0 ${-0.35 * r}L${r} ${-r}L${0.35 * r} 0L${r} ${r}L0 ${0.35 * r}L${-r} ${r}L${-0.35 * r} 0Z`,
  (r) => `M${-1.15 * r} 0L${0.85 * r} ${1.1 * r}L${0.85 * r} ${-1.1 * r}Z`,
  (r) => `M${1.15 * r} 0L${-0.85 * r} ${1.1 * r}L${-0.85 * r} ${-1.1 * r}Z`,
];
const SQUARE = (r) => `M${-r} ${-r}H${r}V${r}H${-r}Z`;

function marker(parent, shape, x, y, colour, { open = false, r = 6 } = {}) {
  const style = open ? `fill:var(--ground);stroke:${colour};stroke-width:2` : `fill:${colour};stroke:var(--ground);stroke-width:1`;
  return make("path", { d: shape(r), transform: `translate(${x.toFixed(1)} ${y.toFixed(1)})`, style }, parent);
}

/** Heights of labels, in pixels, none nearer than `gap` to one that it would cover. labels: {x, y, width}; changes y. */
function apart(labels, gap, top, bottom) {
  labels.sort((a, b) => a.y - b.y);
  for (let round = 0; round < 60; round++) {
    let moved = false;
    for (let i = 0; i < labels.length; i++) {
      for (let j = i + 1; j < labels.length; j++) {
        const [a, b] = [labels[i], labels[j]];
        if (a.x + a.width < b.x || b.x + b.width < a.x) continue;
        const lack = gap - Math.abs(b.y - a.y);
        if (lack <= 0.1) continue;
        const [upper, lower] = a.y <= b.y ? [a, b] : [b, a];
        upper.y = Math.max(top, upper.y - lack / 2 - 0.05);
        lower.y = Math.min(bottom, lower.y + lack / 2 + 0.05);
        moved = true;
      }
    }
    if (!moved) return;
  }
}
