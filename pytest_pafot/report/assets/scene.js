// The bird's-eye view: pure functions for the state at a time, and the picture. Lengths are in metres until they are drawn.

const CELL_NAMES = ["the ego's own", "1 front-left", "2 front", "3 front-right", "4 right", "5 rear-right", "6 rear", "7 rear-left", "8 left"];
const ROWS = [0, 1, 1, 1, 0, -1, -1, -1, 0];
const COLUMNS = [0, -1, 0, 1, 1, 1, 0, -1, -1];

// The time of the check or the event that a finding is about.
const momentOf = (finding) => finding.check?.time ?? finding.event.time;
const isCrossed = (finding) => finding.vehicles.some((vehicle) => vehicle.zone);
// The goal of an instruction: a zone, a lane relative to the ego's, or a cell.
const goalName = (row) => (row.zone || row.lane ? row.words : `cell ${CELL_NAMES[row.cell]}`);

function frameAt(times, time) {
  // Returns [index, share]: the frame before a time, and how much of the time to the next frame has passed, from 0 to 1.
  const index = Math.max(0, Math.min(times.length - 2, times.findLastIndex((each) => each <= time)));
  const span = (times[index + 1] ?? times[index]) - times[index];
  return [index, span > 0 ? clamp((time - times[index]) / span, 0, 1) : 0];
}

function between(values, [index, share]) {
  const [a, b] = [values[index], values[Math.min(index + 1, values.length - 1)]];
  return a === null || b === null ? null : a + (b - a) * share;
}

const held = (values, [index, share]) => values[share > 0.999 && index + 1 < values.length ? index + 1 : index];

function stateAt(finding, vehicle, frame) {
  const track = finding.vehicles[vehicle];
  const [along, across] = [between(track.along, frame), between(track.across, frame)];
  if (along === null || across === null) return null;
  return {
    along, across, length: track.length, width: track.width,
    heading: between(track.heading, frame) ?? 0,
    speed: between(track.speed, frame),
    acceleration: held(track.acceleration, frame),
    gap: vehicle ? held(track.gap, frame) : null,
    ttc: vehicle ? held(track.ttc, frame) : null,
    cell: vehicle ? held(track.cells, frame) : null,
  };
}

function nearestLane(road, across) {
  const away = road.lanes.map((centre) => Math.abs(centre - across));
  return away.indexOf(Math.min(...away));
}

function instructionAt(finding, npc, time) {
  const all = finding.instructions.filter((row) => row.npc === npc);
  const started = all.filter((row) => row.started);
  const rows = started.length ? started : all;  // The user's world may not report which instructions started.
  const row = rows.find((each) => time < each.end - 1e-9) ?? rows[rows.length - 1];
  if (!row) return null;
  let phase = "approach";
  if (row.arrived !== null && time >= row.arrived - 1e-9) phase = "arrived";
  const isLast = !row.zone && finding.times[finding.times.length - 1] > row.end;
  if (isLast && time >= row.end - 1e-9) phase = "ended";
  return { ...row, phase };
}

function wordsOf(row) {
  if (row.phase === "ended") return "keeps its lane and speed after its last instruction";
  let words = `${goalName(row)}, target ${fixed(row.speed, 1)} m/s`;
  const isCell = !row.zone && !row.lane;
  if (isCell && row.requested !== row.cell) words += ` (requested: cell ${CELL_NAMES[row.requested]})`;
  const reached = row.zone ? "entered" : "reached";
  if (row.phase === "arrived" && row.lane !== "keep") words += `; ${reached} at ${fixed(row.arrived, 1)} s`;
  return words;
}

const decisionAt = (finding, time) => finding.decisions.findLast(([start]) => start <= time + 1e-6)?.[2] ?? "";

function cellCentre(finding, ego, cell) {
  // Returns the centre of a cell around the ego on a straight road, and whether there is a lane.
  const { road, vehicles } = finding;
  let [least, start, seconds] = ROWS[cell] > 0 ? road.ahead : road.behind;
  if (COLUMNS[cell]) [least, start, seconds] = [0, 0, 0];
  const gap = Math.max(road.clearance, least, start + seconds * ego.speed);
  const row = (ego.length + (vehicles[1] ?? vehicles[0]).length) / 2 + gap;
  const [own, lane] = [nearestLane(road, ego.across), nearestLane(road, ego.across) + COLUMNS[cell]];
  return {
    along: ego.along + ROWS[cell] * row,
    across: road.lanes[lane] ?? road.lanes[own] + COLUMNS[cell] * road.lane_width,
    exists: lane in road.lanes,
  };
}

function targetOf(finding, states, npc, row) {
  // Returns the target of an NPC: a cell, or a lane relative to the one in which the instruction started.
  if (!row || row.phase !== "approach" || row.zone) return null;
  if (!row.lane) return row.cell ? cellCentre(finding, states[0], row.cell) : null;
  const start = stateAt(finding, npc + 1, frameAt(finding.times, row.start));
  const lane = start && nearestLane(finding.road, start.across) + ({ left: -1, right: 1 }[row.lane] ?? 0);
  return lane in finding.road.lanes ? { along: states[npc + 1].along, across: finding.road.lanes[lane] } : null;
}

const TRAIL_SECONDS = 4;
const RULER = 24;
const SHOULDER = 1.4;
const HALF_HEIGHT = 18; // Half of the height of the picture of a curved road [m].
const CROSSED_HALF_HEIGHT = 32; // The same with a crossing vehicle, which would otherwise appear only 2 s before the contact.
const STAR = "M0 -13L3 -5L10 -9L6 -2L13 0L6 3L10 9L3 5L0 13L-3 5L-10 9L-6 3L-13 0L-6 -2L-10 -9L-3 -5Z";

class Scene {
  constructor(finding, width, zoom) {
    const { road } = finding;
    this.finding = finding;
    this.width = width;
    this.isWorld = road.shapes.length > 0;  // a curved road is drawn in world coordinates
    const isWide = this.isWorld && isCrossed(finding);
    this.scale = (isWide ? clamp(width / 130, 4.5, 7) : clamp(width / 96, 6.5, 10)) * zoom;
    const reach = isWide ? CROSSED_HALF_HEIGHT : HALF_HEIGHT;
    this.top = this.isWorld ? -reach : Math.min(...road.lanes) - road.lane_width / 2 - SHOULDER;
    this.bottom = this.isWorld ? reach : Math.max(...road.lanes) + road.lane_width / 2 + SHOULDER;
    this.height = (this.bottom - this.top) * this.scale + RULER;
    this.middle = width * (width < 600 || isWide ? 0.5 : 0.42);
    this.ego = { along: 0, across: 0 };
    this.root = svg("svg", {
      viewBox: `0 0 ${px(width)} ${px(this.height)}`, height: px(this.height), role: "img",
      "aria-label": "Bird's-eye view of the ego and the NPCs. The table below gives the same information in numbers.",
    });
    this.build();
  }

  x(along) { return this.middle + (along - this.ego.along) * this.scale; }
  y(across) { return (across - (this.isWorld ? this.ego.across : 0) - this.top) * this.scale; }

  build() {
    const { road, vehicles } = this.finding;
    this.shapes = svg("g", {}, this.isWorld ? [...this.lanes(), ...this.zones()] : []);
    const [y0, y1] = [SHOULDER * this.scale, (this.bottom - this.top - SHOULDER) * this.scale];
    const ground = this.isWorld ? [this.shapes] : [
      svg("rect", { x: 0, y: px(y0), width: px(this.width), height: px(y1 - y0), class: "road" }),
      ...[y0, y1].map((y) => svg("line", { x1: 0, x2: px(this.width), y1: px(y), y2: px(y), class: "edge" })),
    ];
    const names = road.lanes.map((centre, lane) => svg("text", { x: 6, y: px(this.y(centre) + 4), class: "small soft halo" }, `lane ${lane}`));
    this.dashes = road.lanes.slice(1).map((centre) => {
      const y = px(this.y(centre - road.lane_width / 2));
      return svg("line", { x1: 0, x2: px(this.width), y1: y, y2: y, class: "dash", "stroke-dasharray": `${px(3 * this.scale)} ${px(9 * this.scale)}` });
    });
    this.cells = this.isWorld ? [] : [1, 2, 3, 4, 5, 6, 7, 8].map((cell) => [svg("rect", { class: "cell", rx: 3 }), svg("text", { class: "cell-number" }, `${cell}`)]);
    this.trails = vehicles.map((_, index) => svg("path", { class: `trail ${index ? stroke(index) : "ego-trail"}`, "stroke-dasharray": index ? "1 5" : null, "stroke-linecap": "round" }));
    this.targets = vehicles.slice(1).map((_, npc) => [svg("path", { class: `target-line ${stroke(npc + 1)}` }), svg("rect", { class: `target ${stroke(npc + 1)}`, rx: 4 })]);
    this.bodies = vehicles.map((vehicle, index) => this.vehicle(vehicle, index));
    const [length, width] = [vehicles[0].length * this.scale, vehicles[0].width * this.scale];
    this.ghost = svg("rect", { class: "ghost", x: px(-length / 2), y: px(-width / 2), width: px(length), height: px(width), visibility: "hidden" });
    this.pointers = vehicles.map((_, index) => svg("text", { class: `label strong halo ${fill(index)}` }));
    this.impact = svg("g", {}, [svg("path", { d: STAR, class: "impact" }), svg("text", { class: "impact-label", "text-anchor": "middle" }, this.impactText())]);
    this.root.append(
      ...ground, ...this.dashes, ...this.cells.flat(), ...this.trails, ...names, ...this.targets.flat(), this.ghost, ...this.bodies.map((body) => body.group),
      this.ruler(), ...this.pointers, this.impact,
    );
  }

  scaled(points) { return linePath(points.map(([x, y]) => [x * this.scale, y * this.scale])); }

  lanes() {
    // Every lane, with an edge around all lanes and a line between neighbours.
    return [[0.5, "lane-edge"], [0, "lane-line"], [-0.3, "lane-ground"]].flatMap(([more, name]) => this.finding.road.shapes.map(
      (lane) => svg("path", { class: name, "stroke-width": px((lane.width + more) * this.scale), d: this.scaled(lane.points) })));
  }

  zones() {
    // The path of each crossing NPC, and its conflict zone with the ego's path.
    return this.finding.vehicles.flatMap(({ name, zone }, index) => (zone ? [
      svg("path", { class: `zone ${stroke(index)}`, "stroke-width": px(zone.width * this.scale), d: this.scaled(zone.area) }, svg("title", {}, `zone of ${name}, ${zone.name}`)),
      svg("path", { class: `way ${stroke(index)}`, d: this.scaled(zone.way) }),
    ] : []));
  }

  vehicle(vehicle, index) {
    const [length, width] = [vehicle.length * this.scale, vehicle.width * this.scale];
    const box = { x: px(-length / 2), y: px(-width / 2), width: px(length), height: px(width), rx: px(0.35 * this.scale) };
    const brake = svg("g", {}, [-1, 1].map((side) => svg("rect", { class: "brake", x: px(-length / 2 - 3), y: px(side * width * 0.3 - 3), width: 5, height: 6 })));
    const body = svg("g", {}, [
      svg("rect", { ...box, class: index ? `npc-body ${stroke(index)}` : "ego-body" }),
      // The windscreen marks the front.
      svg("path", { class: "glass", d: `M${px(length * 0.2)} ${px(-width * 0.36)}L${px(length * 0.34)} ${px(-width * 0.28)}V${px(width * 0.28)}L${px(length * 0.2)} ${px(width * 0.36)}Z` }),
      brake,
    ]);
    const label = svg("text", { class: `vehicle-label ${index ? fill(index) : "ego-label"}` }, index ? `${index - 1}` : "E");
    const group = svg("g", { "data-vehicle": vehicle.name }, [svg("title", {}, vehicle.name), body, label]);
    return { group, body, brake };
  }

  impactText() {
    const { kind, side } = this.finding.event;
    return kind === "collision" ? `contact, ${side} of the ego` : kind.replace("ads_", "policy ");
  }

  ruler() {
    const y = this.height - RULER;
    const marks = [svg("rect", { x: 0, y: px(y), width: px(this.width), height: RULER, class: "paper" })];
    const step = niceStep(this.width / this.scale, this.width / 80);
    for (let metres = Math.ceil(-this.middle / this.scale / step) * step; metres * this.scale + this.middle < this.width; metres += step) {
      const x = px(metres * this.scale + this.middle);
      const text = metres === 0 ? "ego" : `${metres > 0 ? "+" : "\u2212"}${Math.abs(metres)} m`;
      marks.push(svg("line", { x1: x, x2: x, y1: px(y), y2: px(y + 5), class: "axis" }));
      if (x > 22 && x < this.width - 22) marks.push(svg("text", { x, y: px(y + 17), class: "small soft", "text-anchor": "middle" }, text));
    }
    return svg("g", {}, marks);
  }

  draw(time) {
    const frame = frameAt(this.finding.times, time);
    const states = this.finding.vehicles.map((_, index) => stateAt(this.finding, index, frame));
    if (!states[0]) return states;
    this.ego = states[0];
    this.shapes.setAttribute("transform", `translate(${px(this.x(0))} ${px(this.y(0))})`);
    const offset = px((this.ego.along * this.scale - this.middle) % (12 * this.scale));
    for (const dash of this.dashes) dash.setAttribute("stroke-dashoffset", offset);
    if (!this.isWorld) this.drawCells(states, time);
    this.taken = [];
    states.forEach((state, index) => this.drawVehicle(state, index));
    this.drawTrails(time, frame);
    this.drawImpact(states, time);
    this.drawGhost(frame);
    return states;
  }

  drawGhost([index, share]) {
    // The ego after a careful driver has taken over.
    const { ghost } = this.finding;
    const at = [index - (ghost?.first ?? 0), share];
    this.ghost.setAttribute("visibility", ghost && at[0] in ghost.along ? "visible" : "hidden");
    if (!ghost || !(at[0] in ghost.along)) return;
    const [along, across, heading] = [ghost.along, ghost.across, ghost.heading].map((values) => between(values, at));
    this.ghost.setAttribute("transform", `translate(${px(this.x(along))} ${px(this.y(across))}) rotate(${px(heading * 180 / Math.PI)})`);
  }

  box(along, across, more) {
    // The box of a cell or a target: as long as a vehicle, as wide as a lane, and larger by some pixels.
    const [length, width] = [this.ego.length * this.scale + more, this.finding.road.lane_width * this.scale - 4 + more];
    return { x: px(this.x(along) - length / 2), y: px(this.y(across) - width / 2), width: px(length), height: px(width) };
  }

  drawCells(states, time) {
    const wanted = new Set();
    this.targets.forEach(([line, ring], npc) => {
      const row = states[npc + 1] && instructionAt(this.finding, npc, time);
      const goal = targetOf(this.finding, states, npc, row);
      for (const each of [line, ring]) each.setAttribute("visibility", goal ? "visible" : "hidden");
      if (!goal) return;
      wanted.add(row.cell);
      line.setAttribute("d", linePath([states[npc + 1], goal].map((each) => [this.x(each.along), this.y(each.across)])));
      change(ring, this.box(goal.along, goal.across, 4));
    });
    this.cells.forEach(([box, number], index) => {
      const centre = cellCentre(this.finding, this.ego, index + 1);
      const place = { ...this.box(centre.along, centre.across, 0), visibility: centre.exists ? "visible" : "hidden" };
      change(box, place);
      change(number, { x: Number(place.x) + 8, y: Number(place.y) + 9, visibility: place.visibility, class: `cell-number${wanted.has(index + 1) ? " wanted" : ""}` });
    });
  }

  drawVehicle(state, index) {
    const { group, body, brake } = this.bodies[index];
    const isInside = state !== null && this.isInside(state);
    group.setAttribute("visibility", isInside ? "visible" : "hidden");
    this.pointers[index].setAttribute("visibility", state && !isInside ? "visible" : "hidden");
    if (!state) return;
    change(group, { transform: `translate(${px(this.x(state.along))} ${px(this.y(state.across))})`, "data-along": fixed(state.along, 3), "data-across": fixed(state.across, 3) });
    body.setAttribute("transform", `rotate(${px(state.heading * 180 / Math.PI)})`);
    brake.setAttribute("visibility", isInside && state.acceleration < -1 ? "inherit" : "hidden");
    if (!isInside) this.drawPointer(state, index);
  }

  isInside(state) {
    const [x, y, reach] = [this.x(state.along), this.y(state.across), state.length * this.scale / 2];
    return x > -reach && x < this.width + reach && (!this.isWorld || (y > 0 && y < this.height - RULER));
  }

  drawPointer(state, index) {
    // A label at the edge points to a vehicle outside the picture. Labels do not overlap.
    const isLeft = state.along < this.ego.along;
    let y = clamp(this.y(state.across) + 4, 14, this.height - RULER - 8);
    while (this.taken.some((other) => other.isLeft === isLeft && Math.abs(other.y - y) < 14)) y += 14;
    this.taken.push({ isLeft, y });
    const away = `NPC ${index - 1}, ${Math.hypot(state.along - this.ego.along, state.across - this.ego.across).toFixed(0)} m`;
    change(this.pointers[index], { x: isLeft ? 54 : this.width - 6, y: px(y), "text-anchor": isLeft ? "start" : "end" });
    this.pointers[index].textContent = isLeft ? `\u25c2 ${away}` : `${away} \u25b8`;
  }

  drawTrails(time, frame) {
    // The ego's path is drawn on the road. The NPCs' paths are relative to the ego, as their instructions are.
    const moments = [];
    for (let at = Math.ceil(Math.max(0, time - TRAIL_SECONDS) * 8) / 8; at < time; at += 0.125) moments.push(frameAt(this.finding.times, at));
    moments.push(frame);
    this.trails.forEach((trail, index) => trail.setAttribute("d", linePath(moments.map((moment) => {
      const [state, origin] = [stateAt(this.finding, index, moment), stateAt(this.finding, 0, moment)];
      if (!state || !origin) return null;
      return [this.x(index && !this.isWorld ? state.along - origin.along + this.ego.along : state.along), this.y(state.across)];
    }))));
  }

  drawImpact(states, time) {
    const { event } = this.finding;
    const isDrawn = time >= event.time - 0.006 && ["collision", "ads_error", "hang"].includes(event.kind);
    this.impact.setAttribute("visibility", isDrawn ? "visible" : "hidden");
    const other = event.npc === null ? null : states[event.npc + 1];
    const place = event.kind === "collision" && other ? this.contact(other) : this.ego;
    const [x, y, side] = [this.x(place.along), this.y(place.across), other && other.along > place.along ? "end" : "start"];
    this.impact.setAttribute("transform", `translate(${px(x)} ${px(y)})`);
    // If vehicles come from all sides, the words are next to the impact, on the side away from the other vehicle.
    change(this.impact.children[1], this.isWorld ? { x: side === "end" ? -18 : 18, y: 4, "text-anchor": side } : { y: y > 40 ? -20 : 30 });
  }

  contact(other) {
    // The point of the ego's box that is nearest to the other vehicle.
    const [cos, sin] = [Math.cos(this.ego.heading), Math.sin(this.ego.heading)];
    const [dx, dy] = [other.along - this.ego.along, other.across - this.ego.across];
    const ahead = clamp(dx * cos + dy * sin, -this.ego.length / 2, this.ego.length / 2);
    const right = clamp(dy * cos - dx * sin, -this.ego.width / 2, this.ego.width / 2);
    return { along: this.ego.along + ahead * cos - right * sin, across: this.ego.across + ahead * sin + right * cos };
  }
}
