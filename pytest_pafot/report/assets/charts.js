// The instructions and the curves over a common time axis with one cursor; or only the curve of a check.

const CHART = { left: 46, right: 58, gap: 32, timeline: 24, curve: 104 };

const CURVES = [
  { key: "gap", title: "gap to the ego", unit: "m", top: 40, digits: 1, remark: ", not drawn beyond 40" },
  { key: "ttc", title: "time to contact", unit: "s", top: 8, digits: 2, remark: ", not drawn beyond 8, or where they are not on course to touch" },
  { key: "advantage", title: "expected time between the two at their zone", unit: "s", top: 4, digits: 2, isCrossed: true },
  { key: "speed", title: "speed", unit: "m/s", top: null, digits: 1 },
  { key: "acceleration", title: "acceleration", unit: "m/s^2", least: 4, digits: 1 },
  { key: "jerk", title: "jerk, peak of each frame", unit: "m/s^3", least: 10, digits: 0 },
];

const isText = (part) => part.tagName === "text";

class Charts {
  constructor(finding, width, check = null) {
    this.finding = finding;
    this.width = width;
    this.right = width - CHART.right;
    this.duration = Math.max(finding.times[finding.times.length - 1], 0.1);
    this.parts = [];
    this.dots = [];
    this.y = 30;
    if (check) this.check(check);
    else {
      this.timeline();
      for (const curve of CURVES) if (!curve.isCrossed || isCrossed(finding)) this.curve(curve);
    }
    this.axis();
    this.height = this.y + 24;
    this.cursor = svg("line", { class: "cursor", y1: 12, y2: px(this.height - 22) });
    this.root = svg("svg", {
      viewBox: `0 0 ${px(width)} ${px(this.height)}`, height: px(this.height), role: "img",
      "aria-label": check ? `${check.name} over time, with its bound.` : "Instructions of the NPCs, and gap, time to contact, speed, acceleration and jerk over time.",
    }, [...this.parts.filter((part) => !isText(part)), this.cursor, ...this.parts.filter(isText), ...this.dots.map((dot) => dot.mark)]);  // no line goes through a text
  }

  x(time) { return CHART.left + (time / this.duration) * (this.right - CHART.left); }
  time(x) { return clamp((x - CHART.left) / (this.right - CHART.left), 0, 1) * this.duration; }

  heading(title, unit, remark = "") {
    this.parts.push(svg("text", { x: CHART.left, y: px(this.y - 6), class: "label" }, [
      svg("tspan", { class: "strong" }, title), svg("tspan", { class: "soft" }, (unit ? ` [${unit}]` : "") + remark),
    ]));
  }

  timeline() {
    const zoned = isCrossed(this.finding);
    const laned = zoned && this.finding.instructions.some((row) => row.lane);
    const isNarrow = this.width < 600;
    const decided = this.finding.decisions.length ? `decisions${isNarrow ? "" : " of the ego"}; ` : "";
    this.heading(isNarrow ? `${decided}instructions, speed` : `${decided}instructions: cell${laned ? ", lane" : ""} or ${zoned ? "zone" : "lane"}, speed`, "m/s", (zoned && !isNarrow ? ", coloured: the NPC is in the zone, grey: the ego is" : "") +
      (this.finding.instructions.some((row) => row.started && row.requested !== row.cell) ? `, *: ${isNarrow ? "not as" : "another cell than"} requested` : ""));
    this.y += 2;
    this.decisions();
    this.finding.vehicles.slice(1).forEach((vehicle, npc) => {
      this.parts.push(svg("text", { x: CHART.left - 6, y: px(this.y + 15), class: "small", "text-anchor": "end" }, vehicle.name.split(",")[0]));
      for (const row of this.finding.instructions) if (row.npc === npc && row.started) this.block(row, npc);
      this.y += CHART.timeline;
    });
    this.y += CHART.gap;
  }

  decisions() {
    // What the ego's policy decided, each decision until the next other one.
    const { decisions } = this.finding;
    if (!decisions.length) return;
    const height = CHART.timeline - 4;
    this.parts.push(svg("text", { x: CHART.left - 6, y: px(this.y + 15), class: "small", "text-anchor": "end" }, "ego"));
    for (const [start, end, words] of decisions) {
      const [x0, x1] = [this.x(start), this.x(Math.min(end, this.duration))];
      const wide = Math.max(0, x1 - x0 - 1);
      this.parts.push(svg("rect", { x: px(x0 + 0.5), y: px(this.y), width: px(wide), height, rx: 3, class: "block decision" }, svg("title", {}, `${fixed(start, 1)} s: ${words}`)));
      this.blockText([words, words.split(",")[0]], x0, wide);
    }
    this.y += CHART.timeline;
  }

  block(row, npc) {
    const [x0, x1] = [this.x(row.start), this.x(Math.min(row.end, this.duration))];
    const height = CHART.timeline - 4;
    const box = { x: px(x0 + 0.5), y: px(this.y), height, rx: 3 };
    const wide = Math.max(0, x1 - x0 - 1);
    if (row.zone) { this.crossing(row, npc, x0, wide); return; }
    const what = `NPC ${npc}, ${fixed(row.start, 1)} s: ${row.lane ? "" : "cell "}${goalName(row)}, ${row.lane ? "" : "then "}${fixed(row.speed, 1)} m/s` +
      (row.lane === "keep" ? "" : row.arrived === null ? "; not reached" : `; reached at ${fixed(row.arrived, 1)} s`) +
      (row.requested === row.cell ? "" : `; requested was cell ${cellName(row.requested)}`);
    this.parts.push(svg("rect", { ...box, width: px(wide), class: "block" }, svg("title", {}, what)));
    if (row.arrived !== null && row.arrived < this.duration) {
      const x = this.x(row.arrived);
      this.parts.push(svg("rect", { ...box, x: px(x), width: px(Math.max(0, x1 - x - 0.5)), class: `${fill(npc + 1)} block-held`, "pointer-events": "none" }));
      this.parts.push(svg("path", { d: `M${px(x - 4)} ${px(this.y)}h8l-4 6Z`, class: fill(npc + 1), "pointer-events": "none" }));
    }
    this.parts.push(svg("rect", { ...box, width: px(wide), class: `block-edge ${stroke(npc + 1)}`, "pointer-events": "none" }));
    const mark = row.requested === row.cell ? "" : "*";
    const short = `${row.lane || `cell ${row.cell}`}${mark}`;
    const texts = [`${row.lane ? "" : "cell "}${goalName(row)}${mark}, ${fixed(row.speed, 1)} m/s`, `${goalName(row)}${mark}, ${fixed(row.speed, 1)}`, `${short}, ${fixed(row.speed, 1)} m/s`, short, `${row.lane || row.cell}${mark}`];
    this.blockText(texts, x0, wide);
  }

  blockText(texts, x, wide) {
    const text = texts.find((each) => each.length * 6.4 + 12 <= wide);
    if (text) this.parts.push(svg("text", { x: px(x + 7), y: px(this.y + 14.5), class: "small", "pointer-events": "none" }, text));
  }

  crossing(row, npc, left, wide) {
    // The time spans of the ego and the NPC in the zone, one above the other.
    const height = CHART.timeline - 4;
    const box = { x: px(left + 0.5), y: px(this.y), height, rx: 3 };
    const { zone } = this.finding.vehicles[npc + 1];
    this.parts.push(svg("rect", { ...box, width: px(wide), class: "block" }, svg("title", {}, `NPC ${npc}: ${row.words}, ${fixed(row.speed, 1)} m/s`)));
    for (const [window, name, top] of [[zone && zone.of_ego, "block-ego", 0], [zone && zone.of_npc, `${fill(npc + 1)} block-zone`, 0.5]]) {
      if (!window) continue;
      const [x0, x1] = [this.x(window[0]), this.x(Math.min(window[1] === null ? this.duration : window[1], this.duration))];
      this.parts.push(svg("rect", { x: px(x0), y: px(this.y + top * height), width: px(Math.max(2, x1 - x0)), height: px(height / 2), class: name, "pointer-events": "none" }));
    }
    this.parts.push(svg("rect", { ...box, width: px(wide), class: `block-edge ${stroke(npc + 1)}`, "pointer-events": "none" }));
    this.blockText([`${row.words}, ${fixed(row.speed, 1)} m/s`, `${row.slot}, ${fixed(row.speed, 1)} m/s`, row.slot], left, wide);
  }

  curve(curve) {
    const { finding } = this;
    const [low, top] = this.range(curve);
    const [y0, y1] = [this.y + CHART.curve, this.y];
    const y = (value) => y0 - ((value - low) / (top - low)) * (y0 - y1);
    const limit = curve.key === "speed" ? `, dotted: limit ${finding.road.speed_limit}` : this.width < 600 ? "" : curve.remark ?? "";
    this.heading(curve.title, curve.unit, limit);
    for (const value of [low, (low + top) / 2, top]) {
      this.parts.push(svg("line", { x1: CHART.left, x2: px(this.right), y1: px(y(value)), y2: px(y(value)), class: "axis" }));
      const label = curve.top && value === top ? `\u2265${top}` : `${value}`;
      this.parts.push(svg("text", { x: CHART.left - 6, y: px(y(value) + 4), class: "small soft", "text-anchor": "end" }, label));
    }
    if (curve.key === "speed") this.limit(y);
    const ends = [];
    finding.vehicles.forEach((vehicle, index) => {
      const values = vehicle[curve.key];
      if (!values.length) return;
      this.track(values, index, (value) => y(Math.min(value, top)), curve.top ? top : Infinity);
      const last = values[values.length - 1];
      if (last !== null && last <= top) ends.push({ y: y(last), index, name: vehicle.name.split(",")[0] });
    });
    this.ends(ends, y0);
    this.y = y0 + CHART.gap;
  }

  check(check) {
    const [y0, y1] = [this.y + CHART.curve, this.y];
    const y = (value) => y0 - ((value - check.low) / (check.high - check.low)) * (y0 - y1);
    this.heading(check.name, check.unit, this.width < 600 ? ", red: broken" : ", worst of each frame; red: beyond the bound");
    for (const [from, to] of check.broken) {
      const wide = Math.max(2, this.x(to) - this.x(from));
      this.parts.push(svg("rect", { x: px((this.x(from) + this.x(to) - wide) / 2), width: px(wide), y: px(y1), height: px(y0 - y1), class: "broken" }));
    }
    for (const [value, sign] of [[check.low, check.is_cut[0] ? "\u2264" : ""], [check.high, check.is_cut[1] ? "\u2265" : ""]]) {
      this.parts.push(svg("line", { x1: CHART.left, x2: px(this.right), y1: px(y(value)), y2: px(y(value)), class: "axis" }));
      this.parts.push(svg("text", { x: CHART.left - 6, y: px(y(value) + 4), class: "small soft", "text-anchor": "end" }, `${sign}${value}`));
    }
    for (const [bound, name] of [[check.at_most, "at most"], [check.at_least, "at least"]]) if (bound !== null) {
      this.parts.push(svg("line", { x1: CHART.left, x2: px(this.right), y1: px(y(bound)), y2: px(y(bound)), class: "bound" }));
      this.parts.push(svg("text", { x: px(this.right + 6), y: px(y(bound) - 2), class: "small" }, [svg("tspan", {}, name), svg("tspan", { x: px(this.right + 6), dy: 13 }, `${bound}`)]));
    }
    this.track(check.values, 0, y, Infinity);
    this.y = y0 + CHART.gap;
  }

  range(curve) {
    // The axis begins at 0, or is symmetric for values with a sign.
    if (curve.top) return [0, curve.top];
    const values = this.finding.vehicles.flatMap((vehicle) => vehicle[curve.key].filter((value) => value !== null));
    const limit = curve.least || this.finding.road.speed_limit;
    const most = values.reduce((high, value) => Math.max(high, Math.abs(value)), limit);
    const top = Math.ceil(most / (curve.least || 5)) * (curve.least || 5);
    return [curve.least ? -top : 0, top];
  }

  limit(y) {
    const at = y(this.finding.road.speed_limit);
    this.parts.push(svg("line", { x1: CHART.left, x2: px(this.right), y1: px(at), y2: px(at), class: "limit" }));
  }

  track(values, index, y, top) {
    const { times } = this.finding;
    const points = values.map((value, frame) => (value === null || value > top ? null : [this.x(times[frame]), y(value)]));
    this.parts.push(svg("path", {
      d: linePath(points), class: `curve ${stroke(index)}`, "stroke-dasharray": index ? dashes(index - 1) : null,
      "stroke-width": index ? null : 3, "stroke-linecap": "round",
    }));
    const mark = svg("circle", { r: 4, class: fill(index), visibility: "hidden" });
    this.dots.push({ mark, values, y, top });
  }

  ends(ends, lowest) {
    // Labels at the ends of the curves, pushed apart where they would overlap, and up again from below the chart. A line
    // leads from the end of each curve to its label.
    ends.sort((a, b) => a.y - b.y);
    ends.forEach((end, place) => { end.label = place ? Math.max(end.y, ends[place - 1].label + 13) : end.y; });
    ends.forEach((end, place) => { end.label = Math.min(end.label, lowest + 4 - 13 * (ends.length - 1 - place)); });
    for (const { y, label, index, name } of ends) {
      this.parts.push(svg("line", { x1: px(this.right + 4), x2: px(this.right + 17), y1: px(y), y2: px(label), class: `curve leader ${stroke(index)}` }));
      this.parts.push(svg("text", { x: px(this.right + 20), y: px(label + 4), class: "small" }, name));
    }
  }

  axis() {
    const y = this.y - CHART.gap;
    const step = niceStep(this.duration, this.width / 90);
    for (let time = 0; time <= this.duration + 1e-9; time += step) {
      const x = px(this.x(time));
      this.parts.push(svg("line", { x1: x, x2: x, y1: px(y), y2: px(y + 4), class: "axis" }));
      this.parts.push(svg("text", { x, y: px(y + 17), class: "small soft", "text-anchor": "middle" }, Number(time.toFixed(3)) + (time === 0 ? " s" : "")));
    }
    for (const start of new Set(this.finding.instructions.filter((row) => row.started && row.gene).map((row) => row.start))) {
      if (start < this.duration) this.parts.unshift(svg("line", { x1: px(this.x(start)), x2: px(this.x(start)), y1: 32, y2: px(y), class: "gene" }));
    }
    const { event } = this.finding;
    const moment = momentOf(this.finding);
    this.mark("event", moment, y, `the event, ${fixed(moment, 2)} s`);
    if (moment !== event.time && event.kind === "collision") this.mark("event", event.time, y, `the collision, ${fixed(event.time, 2)} s`);
    this.y = y;
  }

  mark(name, time, y, what) {
    const at = this.x(time);
    this.parts.push(svg("line", { x1: px(at), x2: px(at), y1: 10, y2: px(y), class: name }));
    this.parts.push(svg("path", { d: `M${px(at - 5)} 2h10l-5 8Z`, class: `${name}-mark` }, svg("title", {}, what)));
  }

  draw(time) {
    const x = px(this.x(time));
    change(this.cursor, { x1: x, x2: x });
    const frame = frameAt(this.finding.times, time);
    for (const dot of this.dots) {
      const value = between(dot.values, frame);
      const isDrawn = value !== null && value <= dot.top;
      dot.mark.setAttribute("visibility", isDrawn ? "visible" : "hidden");
      if (isDrawn) change(dot.mark, { cx: x, cy: px(dot.y(value)) });
    }
  }
}
