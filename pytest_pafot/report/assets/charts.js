// The instructions and the curves, with a common time axis and one cursor.

const CHART = { left: 46, right: 58, gap: 32, timeline: 24, curve: 104 };

const CURVES = [
  { key: "gap", title: "gap to the ego", unit: "m", top: 40, remark: ", up to 40" },
  { key: "ttc", title: "time to contact", unit: "s", top: 8, remark: ", up to 8; no curve without a collision course" },
  { key: "advantage", title: "expected time between NPC and ego in the conflict zone", unit: "s", top: 4 },
  { key: "speed", title: "speed", unit: "m/s" },
  { key: "acceleration", title: "acceleration", unit: "m/s^2", least: 4 },
];

class Charts {
  constructor(finding, width) {
    this.finding = finding;
    this.width = width;
    this.right = width - CHART.right;
    this.duration = Math.max(finding.times[finding.times.length - 1], 0.1);
    this.parts = [];
    this.dots = [];
    this.y = 30;
    if (finding.check?.values.length) this.check(finding.check);
    this.timeline();
    for (const curve of CURVES) if (finding.vehicles.some((vehicle) => vehicle[curve.key].length)) this.curve(curve);
    this.axis();
    this.height = this.y + 24;
    this.cursor = svg("line", { class: "cursor", y1: 12, y2: px(this.height - 22) });
    this.root = svg("svg", {
      viewBox: `0 0 ${px(width)} ${px(this.height)}`, height: px(this.height), role: "img",
      "aria-label": "Instructions of the NPCs, and gap, time to contact, speed and acceleration over time.",
    }, [...this.parts, this.cursor, ...this.dots.map((dot) => dot.mark)]);
  }

  x(time) { return CHART.left + (time / this.duration) * (this.right - CHART.left); }
  time(x) { return clamp((x - CHART.left) / (this.right - CHART.left), 0, 1) * this.duration; }
  add(tag, attributes, children) { this.parts.push(svg(tag, attributes, children)); }
  level(y, name) { this.add("line", { x1: CHART.left, x2: px(this.right), y1: px(y), y2: px(y), class: name }); }
  side(y, text) { this.add("text", { x: CHART.left - 6, y: px(y + 4), class: "small soft", "text-anchor": "end" }, text); }

  heading(title, rest) {
    this.add("text", { x: CHART.left, y: px(this.y - 6), class: "label" }, [svg("tspan", { class: "strong" }, title), svg("tspan", { class: "soft" }, rest)]);
  }

  timeline() {
    const { decisions, instructions, vehicles } = this.finding;
    this.heading(decisions.length ? "decisions, instructions" : "instructions", "");
    this.y += 2;
    if (decisions.length) this.row("ego", decisions.map(([start, end, words]) => ({ start, end, words, name: "c-ego" })));
    vehicles.slice(1).forEach((vehicle, npc) => {
      const rows = instructions.filter((row) => row.npc === npc && row.started);
      this.row(vehicle.name.split(",")[0], rows.map((row) => ({ ...row, words: wordsOf(row), name: stroke(npc + 1) })));
    });
    this.y += CHART.gap;
  }

  row(name, blocks) {
    // Blocks over time, with as much of their text as fits, and a mark at the time when the goal was reached.
    this.side(this.y + 10, name);
    for (const { start, end, words, arrived = null, name: ink } of blocks) {
      const [x0, x1] = [this.x(start), this.x(Math.min(end, this.duration))];
      const wide = Math.max(0, x1 - x0 - 1);
      this.add("rect", { x: px(x0 + 0.5), y: px(this.y), width: px(wide), height: CHART.timeline - 4, rx: 3, class: `block ${ink}` }, svg("title", {}, `${fixed(start, 1)} s: ${words}`));
      if (arrived !== null && arrived < this.duration) this.add("path", { d: `M${px(this.x(arrived) - 4)} ${px(this.y)}h8l-4 6Z`, class: "event-mark" });
      const room = Math.floor((wide - 12) / 6.4);
      const text = words.length <= room ? words : `${words.slice(0, Math.max(room - 1, 0))}\u2026`;
      if (room > 3) this.add("text", { x: px(x0 + 7), y: px(this.y + 14.5), class: "small", "pointer-events": "none" }, text);
    }
    this.y += CHART.timeline;
  }

  plot(low, high, levels) {
    // Returns a function from a value to its height, and moves the position for the next element below the curve.
    const bottom = this.y + CHART.curve;
    const y = (value) => bottom - ((value - low) / (high - low)) * CHART.curve;
    for (const [value, text] of levels) { this.level(y(value), "axis"); this.side(y(value), text); }
    this.y = bottom + CHART.gap;
    return y;
  }

  curve({ key, title, unit, top = null, least = null, remark = "" }) {
    const { vehicles, road } = this.finding;
    let rest = ` [${unit}]`;
    if (key === "speed") rest += `, dotted: limit ${road.speed_limit}`;
    else if (this.width >= 600) rest += remark;
    this.heading(title, rest);
    // The axis starts at 0, or is symmetric for values with a sign.
    const most = Math.max(least ?? road.speed_limit, ...vehicles.flatMap((vehicle) => vehicle[key].map((value) => Math.abs(value ?? 0))));
    const high = top ?? Math.ceil(most / (least ?? 5)) * (least ?? 5);
    const low = least === null ? 0 : -high;
    const y = this.plot(low, high, [low, (low + high) / 2, high].map((value) => [value, top !== null && value === high ? `\u2265${high}` : `${value}`]));
    if (key === "speed") this.level(y(road.speed_limit), "limit");
    const ends = [];
    vehicles.forEach((vehicle, index) => {
      this.track(vehicle[key], index, y, high);
      const last = vehicle[key][vehicle[key].length - 1] ?? null;
      if (last !== null && last <= high) ends.push({ at: y(last), name: vehicle.name.split(",")[0] });
    });
    // Labels at the ends of the curves, pushed apart where they would overlap.
    ends.sort((a, b) => a.at - b.at).forEach((end, place) => {
      end.at = place ? Math.max(end.at, ends[place - 1].at + 13) : end.at;
      this.add("text", { x: px(this.right + 8), y: px(end.at + 4), class: "small" }, end.name);
    });
  }

  check(check) {
    let rest = check.unit ? ` [${check.unit}]` : "";
    rest += this.width < 600 ? ", red" : ", worst value per frame; red";
    this.heading(check.name, `${rest}: outside the bounds`);
    for (const [from, to] of check.broken) {
      this.add("rect", { x: px(this.x(from)), width: px(Math.max(2, this.x(to) - this.x(from))), y: px(this.y), height: CHART.curve, class: "broken" });
    }
    const y = this.plot(check.low, check.high, [[check.low, `${check.is_cut[0] ? "\u2264" : ""}${check.low}`], [check.high, `${check.is_cut[1] ? "\u2265" : ""}${check.high}`]]);
    for (const [bound, name] of [[check.at_most, "at most"], [check.at_least, "at least"]]) if (bound !== null) {
      this.level(y(bound), "bound");
      this.add("text", { x: px(this.right + 6), y: px(y(bound) - 2), class: "small" }, [svg("tspan", {}, name), svg("tspan", { x: px(this.right + 6), dy: 13 }, `${bound}`)]);
    }
    this.track(check.values, 0, y, Infinity);
  }

  track(values, index, y, top) {
    const points = values.map((value, frame) => (value === null || value > top ? null : [this.x(this.finding.times[frame]), y(value)]));
    this.add("path", { d: linePath(points), class: `curve ${stroke(index)}`, "stroke-dasharray": dashes(index), "stroke-linecap": "round" });
    if (values.length) this.dots.push({ mark: svg("circle", { r: 4, class: fill(index), visibility: "hidden" }), values, y, top });
  }

  axis() {
    const y = this.y - CHART.gap;
    const step = niceStep(this.duration, this.width / 90);
    for (let time = 0; time <= this.duration + 1e-9; time += step) {
      const x = px(this.x(time));
      this.add("line", { x1: x, x2: x, y1: px(y), y2: px(y + 4), class: "axis" });
      this.add("text", { x, y: px(y + 17), class: "small soft", "text-anchor": "middle" }, `${Number(time.toFixed(3))}${time ? "" : " s"}`);
    }
    const { event } = this.finding;
    const times = new Set([momentOf(this.finding), ...(event.kind === "collision" ? [event.time] : [])]);
    for (const time of times) {
      const x = this.x(time);
      this.add("line", { x1: px(x), x2: px(x), y1: 10, y2: px(y), class: "event" });
      this.add("path", { d: `M${px(x - 5)} 2h10l-5 8Z`, class: "event-mark" }, svg("title", {}, `the event, ${fixed(time, 2)} s`));
    }
    this.y = y;
  }

  draw(time) {
    change(this.cursor, { x1: px(this.x(time)), x2: px(this.x(time)) });
    const frame = frameAt(this.finding.times, time);
    for (const { mark, values, y, top } of this.dots) {
      const value = between(values, frame);
      const isDrawn = value !== null && value <= top;
      change(mark, { cx: px(this.x(time)), cy: px(y(isDrawn ? value : 0)), visibility: isDrawn ? "visible" : "hidden" });
    }
  }
}
