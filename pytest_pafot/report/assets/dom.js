// Small helpers: elements, numbers, patterns. Nothing here depends on what is drawn.

const SVG = "http://www.w3.org/2000/svg";

function node(namespace, tag, attributes, children) {
  const element = namespace ? document.createElementNS(namespace, tag) : document.createElement(tag);
  for (const [name, value] of Object.entries(attributes || {})) {
    if (value !== null && value !== undefined) element.setAttribute(name, value);
  }
  for (const child of [].concat(children === undefined ? [] : children)) {
    element.append(child);  // Strings are appended as text nodes, so that no string of a report is ever parsed as markup.
  }
  return element;
}

const html = (tag, attributes, children) => node(null, tag, attributes, children);
const svg = (tag, attributes, children) => node(SVG, tag, attributes, children);

function change(element, attributes) {
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
}

function onResize(element, layout) {
  // Wait for the next frame: a layout inside the notification could resize the element again, and browsers report that.
  let request = 0;
  const observer = new ResizeObserver(() => {
    cancelAnimationFrame(request);
    request = requestAnimationFrame(layout);
  });
  observer.observe(element);
  return () => { observer.disconnect(); cancelAnimationFrame(request); };
}

const clamp = (value, low, high) => Math.min(high, Math.max(low, value));
// The text with spaces that do not break between each number and its unit, in a vehicle's or a lane's name, and after a sign.
const tied = (text) => text.replace(/(\d) (?=(?:s|m|m\/s|m\/s\^[23]|rad|%|runs?|times)(?![\w/]))|\b(NPC|lane|cell) (?=\d)|([<>]=?) (?=[-\d])/g, "$1$2$3\u00a0");
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

// NPCs differ even without colour: by number, by the pattern of their body and by the dashes of their curve.
const DASHES = ["", "8 4", "2 3", "10 3 2 3", "5 2", "12 4 2 4 2 4", "3 6", "1 2"];
const dashes = (npc) => DASHES[npc % DASHES.length] || null;
const stroke = (vehicle) => (vehicle === 0 ? "c-ego" : `c${(vehicle - 1) % 8}`);
const fill = (vehicle) => (vehicle === 0 ? "f-ego" : `f${(vehicle - 1) % 8}`);

let patternCount = 0;

function bodyPattern(npc) {
  // Returns [the <pattern>, its reference]. Ids are unique in the page, because each picture has a different prefix.
  const id = `body-${(patternCount += 1)}`;
  const tint = { class: fill(npc + 1), opacity: 0.28, width: 8, height: 8 };
  const line = (d) => svg("path", { d, class: stroke(npc + 1), "stroke-width": 1.6, fill: "none" });
  const dot = (cx, cy) => svg("circle", { cx, cy, r: 1.3, class: fill(npc + 1) });
  const kinds = [
    () => [line("M-2 2L2 -2M0 8L8 0M6 10L10 6")],
    () => [dot(2, 2), dot(6, 6)],
    () => [line("M0 4H8")],
    () => [line("M4 0V8")],
    () => [line("M0 4H8M4 0V8")],
    () => [line("M0 0L8 8M0 8L8 0")],
    () => [line("M0 6L4 2L8 6")],
    () => [],
  ];
  const pattern = svg("pattern", { id, width: 8, height: 8, patternUnits: "userSpaceOnUse" }, [
    svg("rect", tint), ...kinds[npc % kinds.length](),
  ]);
  return [pattern, `url(#${id})`];
}

// The time of the moment that a finding is about.
const momentOf = (finding) => (finding.check && finding.check.time !== null ? finding.check.time : finding.event.time);

function niceStep(span, count) {
  // Returns the step of 1, 2 or 5 times a power of ten that gives about the requested number of ticks.
  const rough = span / Math.max(1, count);
  const power = 10 ** Math.floor(Math.log10(rough));
  return [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= rough * 0.999);
}

const CELL_NAMES = ["own", "front-left", "front", "front-right", "right", "rear-right", "rear", "rear-left", "left"];
const ROWS = [0, 1, 1, 1, 0, -1, -1, -1, 0];
const COLUMNS = [0, -1, 0, 1, 1, 1, 0, -1, -1];
const isCrossed = (finding) => finding.vehicles.some((vehicle) => vehicle.zone);
const cellName = (cell) => `${cell} ${CELL_NAMES[cell]}`;
// The goal of an instruction: a cell, or, without one, a zone, or a lane relative to the ego's.
const goalName = (row) => row.zone ? row.slot : row.lane ? row.words : cellName(row.cell);
