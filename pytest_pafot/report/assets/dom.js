// Small helpers for elements, numbers and colours. They do not depend on what is drawn.

const SVG = "http://www.w3.org/2000/svg";

function node(namespace, tag, attributes, children) {
  const element = namespace ? document.createElementNS(namespace, tag) : document.createElement(tag);
  for (const [name, value] of Object.entries(attributes ?? {})) {
    if (value !== null && value !== undefined) element.setAttribute(name, value);
  }
  // Strings are appended as text nodes, so that no string of a report is ever parsed as markup.
  element.append(...[children ?? []].flat());
  return element;
}

const html = (tag, attributes, children) => node(null, tag, attributes, children);
const svg = (tag, attributes, children) => node(SVG, tag, attributes, children);

function change(element, attributes) {
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
}

const clamp = (value, low, high) => Math.min(high, Math.max(low, value));
const fixed = (value, digits) => (value === null || value === undefined ? "-" : value.toFixed(digits));
const px = (value) => (Math.round(value * 100) / 100).toString();

function linePath(points) {
  // Points of [x, y]; null lifts the pen.
  let isDown = false;
  let path = "";
  for (const point of points) {
    if (point) path += `${isDown ? "L" : "M"}${px(point[0])} ${px(point[1])}`;
    isDown = Boolean(point);
  }
  return path;
}

// NPCs can be distinguished without colour, by their numbers and by the dashes of their curves.
const DASHES = ["", "8 4", "2 3", "10 3 2 3", "5 2", "12 4 2 4 2 4", "3 6", "1 2"];
const dashes = (vehicle) => (vehicle === 0 ? null : DASHES[(vehicle - 1) % DASHES.length] || null);
const stroke = (vehicle) => (vehicle === 0 ? "c-ego" : `c${(vehicle - 1) % 8}`);
const fill = (vehicle) => (vehicle === 0 ? "f-ego" : `f${(vehicle - 1) % 8}`);

function niceStep(span, count) {
  // Returns the step of 1, 2 or 5 times a power of ten that gives about the requested number of ticks.
  const rough = span / Math.max(1, count);
  const power = 10 ** Math.floor(Math.log10(rough));
  return [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= rough * 0.999);
}
