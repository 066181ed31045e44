// The bird's-eye view: the places of everything at a time (pure), and the picture of them. Lengths are in metres until drawn.

function frameAt(times, time) {
  // Returns [index, share]: the frame before a time, and the share of the time to the next frame that has passed.
  let low = 0;
  let high = times.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (times[middle] <= time) low = middle; else high = middle;
  }
  const span = times[high] - times[low];
  return [low, span > 0 ? clamp((time - times[low]) / span, 0, 1) : 0];
}

function between(values, [index, share]) {
  const a = values[index];
  const b = index + 1 < values.length ? values[index + 1] : a;
  return a === null || b === null ? null : a + (b - a) * share;
}

const held = (values, [index, share]) => values[share > 0.999 && index + 1 < values.length ? index + 1 : index];

function stateAt(finding, vehicle, frame) {
  const track = finding.vehicles[vehicle];
  const along = between(track.along, frame);
  const across = between(track.across, frame);
  if (along === null || across === null) return null;
  const [index] = frame;
  const next = Math.min(index + 1, finding.times.length - 1);
  const span = finding.times[next] - finding.times[index];
  const gained = (track.speed[next] || 0) - (track.speed[index] || 0);
  return {
    along, across,
    heading: between(track.heading, frame) || 0,
    speed: between(track.speed, frame),
    acceleration: span > 0 ? gained / span : 0,
    length: track.length,
    width: track.width,
    gap: vehicle ? held(track.gap, frame) : null,
    ttc: vehicle ? held(track.ttc, frame) : null,
    cell: vehicle ? held(track.cells, frame) : null,
    onWay: track.zone ? held(track.on_way, frame) : null,
  };
}

function nearestLane(road, across) {
  let best = 0;
  road.lanes.forEach((centre, lane) => {
    if (Math.abs(centre - across) < Math.abs(road.lanes[best] - across) - 1e-9) best = lane;
  });
  return best;
}

function instructionAt(finding, npc, time) {
  const all = finding.instructions.filter((row) => row.npc === npc);
  const started = all.filter((row) => row.started);
  const rows = started.length ? started : all;  // A world of the user's may not say which began.
  const row = rows.find((each) => time < each.end - 1e-9) || rows[rows.length - 1];
  if (!row) return null;
  if (!row.zone && time >= row.end - 1e-9 && finding.times[finding.times.length - 1] > row.end) {
    return { ...row, phase: "ended" };
  }
  return { ...row, phase: row.arrived !== null && time >= row.arrived - 1e-9 ? "arrived" : "approach" };
}

function decisionAt(finding, time) {
  const decision = finding.decisions.findLast(([start]) => start <= time + 1e-6);
  return decision ? decision[2] : "";
}

function cellCentre(finding, ego, cell, [index, share]) {
  const road = finding.road;
  if (road.shapes.length) {
    // The cell is recorded for the nearest frame; between frames it moves with the ego.
    const frame = share > 0.5 && index + 1 < finding.times.length ? index + 1 : index;
    const place = finding.grid.length ? finding.grid[frame][cell - 1] : null; // There is no grid if all NPCs cross.
    if (!place) return { along: ego.along, across: ego.across, heading: 0, exists: false };
    const track = finding.vehicles[0];
    const [dx, dy] = [ego.along - track.along[frame], ego.across - track.across[frame]];
    return { along: place[0] + dx, across: place[1] + dy, heading: place[2], exists: true };
  }
  const other = finding.vehicles[1] || finding.vehicles[0];
  const [least, start, seconds] = COLUMNS[cell] ? [0, 0, 0] : ROWS[cell] > 0 ? road.ahead : road.behind;
  const gap = Math.max(road.clearance, least, start + seconds * ego.speed);
  const row = (ego.length + other.length) / 2 + gap;
  const lane = nearestLane(road, ego.across) + COLUMNS[cell];
  const exists = lane >= 0 && lane < road.lanes.length;
  const across = exists ? road.lanes[lane] : road.lanes[nearestLane(road, ego.across)] + COLUMNS[cell] * road.lane_width;
  return { along: ego.along + ROWS[cell] * row, across, heading: 0, exists };
}

function targetLane(finding, npc, row) {
  // Returns where the lane of a Lane-Instruction is: next to the lane in which the NPC was when the instruction began.
  const start = stateAt(finding, npc + 1, frameAt(finding.times, row.start));
  return start ? finding.road.lanes[nearestLane(finding.road, start.across) + ({ left: -1, right: 1 }[row.lane] || 0)] : undefined;
}

function placeName(state, zone) {
  // Returns the place of an NPC: a cell or, until it has left the zone in which it meets the ego's way, its place relative to that zone.
  const [enters, leaves] = zone ? zone.stretch : [null, null];
  if (zone && state.onWay !== null && state.onWay < enters) return `${fixed(enters - state.onWay, 0)} m before the zone`;
  if (zone && state.onWay !== null && state.onWay <= leaves) return "in the zone";
  if (state.cell === null) return zone ? "past the zone" : "";
  return state.cell ? cellName(state.cell) : "the ego's own";
}

const PHASES = {
  crossing: (row) => `${row.words}, ${fixed(row.speed, 1)} m/s` + (row.phase === "arrived" ? `; entered at ${fixed(row.arrived, 1)} s` : ""),
  approach: (row) => (row.lane ? `${goalName(row)} at ${fixed(row.speed, 1)} m/s` : `drives to cell ${cellName(row.cell)}, then ${fixed(row.speed, 1)} m/s`),
  arrived: (row) => row.lane === "keep" ? PHASES.approach(row) : `reached ${row.lane ? "its lane" : `cell ${cellName(row.cell)}`} at ${fixed(row.arrived, 1)} s, keeps that lane at ${fixed(row.speed, 1)} m/s`,
  ended: () => "keeps its lane and speed, its instructions are over",
};

const TRAIL_SECONDS = 4;
const RULER = 24;
const LANE_NAME = 50;
const NAME_WIDTH = 40;
const POINTER_ROOM = 210;
const SHOULDER = 1.4;
const LABEL = 7; // Half of the height and of the width of a vehicle's number [px].
const HALF_HEIGHT = 18; // Half of the height [m] that the picture of a bent road shows ...
const CROSSED_HALF_HEIGHT = 45; // ... and if a vehicle crosses, which would otherwise come into sight only 2 s before contact.
const CLOSE_UP = 2.2; // So much larger is the picture of such a road around the moment that a finding is about ...
const CLOSE_SECONDS = 1; // ... for so long before and after it [s] ...
const CLOSE_GAP = 15; // ... if the gap to an NPC is smaller then [m], so that both are in the picture.

// Places that move with the road and turn with it: a bent road is drawn in world coordinates.
const turned = (heading, x, y) => `rotate(${px(heading * 180 / Math.PI)} ${px(x)} ${px(y)})`;

class Scene {
  constructor(finding, width, zoom, close = 1) {
    this.finding = finding;
    this.width = width;
    const road = finding.road;
    this.isWorld = road.shapes.length > 0;
    this.isCrossed = this.isWorld && isCrossed(finding);
    this.scale = (this.isCrossed ? clamp(width / 130, 4.5, 7) : clamp(width / 96, 6.5, 10)) * zoom * close;
    const half = road.lane_width / 2;
    const reach = (this.isCrossed ? CROSSED_HALF_HEIGHT : HALF_HEIGHT) / close;
    this.top = this.isWorld ? SHOULDER - reach : Math.min(...road.lanes) - half;
    this.bottom = this.isWorld ? reach - SHOULDER : Math.max(...road.lanes) + half;
    this.height = (this.bottom - this.top + 2 * SHOULDER) * this.scale + RULER;
    this.middle = width * (width < 600 || this.isCrossed ? 0.5 : 0.42);
    this.root = svg("svg", {
      viewBox: `0 0 ${px(width)} ${px(this.height)}`, height: px(this.height), role: "img",
      "aria-label": "Bird's-eye view of the ego and the NPCs; the table below says the same in numbers.",
    });
    this.egoAlong = 0;
    this.egoAcross = 0;
    this.build();
  }

  x(along) { return this.middle + (along - this.egoAlong) * this.scale; }
  y(across) { return (across - this.egoAcross - this.top + SHOULDER) * this.scale; }

  build() {
    const road = this.finding.road;
    const defs = svg("defs");
    this.shapes = svg("g", {}, this.isWorld ? [...this.lanes(), ...this.zones()] : []);
    const y0 = this.y(this.top);
    const y1 = this.y(this.bottom);
    const ground = this.isWorld ? [this.shapes] : [svg("rect", { x: 0, y: px(y0), width: px(this.width), height: px(y1 - y0), class: "road" })];
    for (const y of this.isWorld ? [] : [y0, y1]) ground.push(svg("line", { x1: 0, x2: px(this.width), y1: px(y), y2: px(y), class: "edge" }));
    this.dashes = road.lanes.slice(1).map((centre) => {
      const y = px(this.y(centre - road.lane_width / 2));
      return svg("line", {
        x1: 0, x2: px(this.width), y1: y, y2: y, class: "dash",
        "stroke-dasharray": `${px(3 * this.scale)} ${px(9 * this.scale)}`,
      });
    });
    // A plate keeps trails out of the name of a lane. On a bent road the names move with their lanes.
    const count = this.isWorld ? road.shapes.length : road.lanes.length;
    this.names = Array.from({ length: this.isCrossed ? 0 : count }, (_, lane) => svg("g", { class: "lane-name" }, [
      svg("rect", { x: 0, y: -8, width: NAME_WIDTH, height: 15, class: "plate" }), svg("text", { x: 3, y: 4, class: "small soft" }, `lane ${lane}`),
    ]));
    this.cells = [1, 2, 3, 4, 5, 6, 7, 8].map(() => [svg("rect", { class: "cell", rx: 3 }), svg("text", { class: "cell-number" })]);
    this.trails = this.finding.vehicles.map((vehicle, index) => svg("path", {
      class: `trail ${index ? stroke(index) : "ego-trail"}`, "stroke-dasharray": index ? "1 5" : null, "stroke-linecap": "round",
    }));
    this.lines = this.finding.vehicles.slice(1).map((vehicle, npc) => [
      svg("path", { class: `target-line ${stroke(npc + 1)}` }), svg("rect", { class: `target ${stroke(npc + 1)}`, rx: 4 }),
    ]);
    this.bodies = this.finding.vehicles.map((vehicle, index) => this.vehicle(vehicle, index, defs));
    this.pointers = this.finding.vehicles.slice(1).map((vehicle, npc) => svg("g", {}, [
      svg("rect", { height: 16, rx: 3, class: "plate" }), svg("path", { class: fill(npc + 1) }), svg("text", { class: "label strong halo" }),
    ]));
    this.offsets = [];
    for (let dx = -320; dx <= 320; dx += 16) for (let dy = -90; dy <= 90; dy += 3) if (Math.abs(dy - 4) > 22 || dx) this.offsets.push([dx, dy]);
    this.offsets.sort((a, b) => Math.hypot(...a) - Math.hypot(...b));
    this.star = clamp(1.3 * this.scale, 8, 13);  // its radius [px]
    this.impact = svg("g", { class: "impact-group" }, [
      svg("path", { class: "leader c-ego" }),
      svg("path", { transform: `scale(${px(this.star / 13)})`, d: "M0 -13L3 -5L10 -9L6 -2L13 0L6 3L10 9L3 5L0 13L-3 5L-10 9L-6 3L-13 0L-6 -2L-10 -9L-3 -5Z", class: "impact" }),
      svg("text", { class: "impact-label" }, this.impactText()),
    ]);
    this.root.append(
      defs, ...ground, ...this.dashes, ...this.cells.flat(), ...this.trails, ...this.lines.flat(), ...this.names,
      ...this.bodies.map((body) => body.group), this.ruler(), ...this.pointers, this.impact,
    );
  }

  lanes() {
    // Every lane, with an edge around all lanes and a line between neighbours.
    const layers = [[0.5, "lane-edge"], [0, "lane-line"], [-0.3, "lane-ground"]];
    return layers.flatMap(([more, name]) => this.finding.road.shapes.map((lane) => svg("path", {
      class: name, "stroke-width": px((lane.width + more) * this.scale),
      d: linePath(lane.points.map(([x, y]) => [x * this.scale, y * this.scale])),
    })));
  }

  zones() {
    // The way of each NPC that crosses, and the part of it that is in the ego's way.
    const line = (points) => linePath(points.map(([x, y]) => [x * this.scale, y * this.scale]));
    return this.finding.vehicles.flatMap(({ name, zone }, index) => (zone ? [
      svg("path", { class: `zone ${stroke(index)}`, "stroke-width": px(zone.width * this.scale), d: line(zone.area) }, svg("title", {}, `zone of ${name}, ${zone.name}`)),
      svg("path", { class: `way ${stroke(index)}`, d: line(zone.way) }),
    ] : []));
  }

  vehicle(vehicle, index, defs) {
    const length = vehicle.length * this.scale;
    const width = vehicle.width * this.scale;
    const box = { x: px(-length / 2), y: px(-width / 2), width: px(length), height: px(width), rx: px(0.35 * this.scale) };
    const parts = [];
    if (index === 0) {
      parts.push(svg("rect", { ...box, class: "ego-body" }));
    } else {
      const [pattern, reference] = bodyPattern(index - 1);
      defs.append(pattern);
      parts.push(svg("rect", { ...box, class: "glass" }), svg("rect", { ...box, fill: reference }), svg("rect", { ...box, class: `vehicle-edge ${stroke(index)}` }));
    }
    // The windscreen marks the front.
    parts.push(svg("path", {
      class: "glass", d: `M${px(length * 0.2)} ${px(-width * 0.36)}L${px(length * 0.34)} ${px(-width * 0.28)}V${px(width * 0.28)}L${px(length * 0.2)} ${px(width * 0.36)}Z`,
    }));
    const brake = svg("g", { visibility: "hidden" }, [-1, 1].map((side) => svg("rect", {
      class: "brake", x: px(-length / 2 - 3), y: px(side * width * 0.3 - 3), width: 5, height: 6,
    })));
    const body = svg("g", {}, [...parts, brake]);
    const label = svg("text", { class: `vehicle-label ${index ? "npc-label" : "ego-label"}` }, index ? `${index - 1}` : "E");
    const row = vehicle.zone ? this.finding.instructions.find((each) => each.npc === index - 1) : null;
    const title = row ? `${vehicle.name}, ${row.words}` : vehicle.name;
    const slot = row ? [svg("text", { class: "zone-label halo", y: px(-length / 2 - 6) }, row.slot)] : [];
    const leader = svg("path", { class: "leader c-ego" });
    const group = svg("g", { "data-vehicle": vehicle.name }, [svg("title", {}, title), body, leader, label, ...slot]);
    return { group, body, brake, leader, label };
  }

  impactText() {
    const event = this.finding.event;
    if (event.kind === "collision") return `contact, ${event.side} of the ego`;
    return event.kind.replace("_", " ");
  }

  ruler() {
    const y = this.height - RULER;
    const marks = this.isWorld ? [svg("rect", { x: 0, y: px(y), width: px(this.width), height: RULER, class: "glass solid" })] : [];
    const reach = this.width / this.scale;
    const step = niceStep(reach, this.width / 80);
    for (let metres = Math.ceil(-this.middle / this.scale / step) * step; metres * this.scale + this.middle < this.width; metres += step) {
      const x = this.middle + metres * this.scale;
      marks.push(svg("line", { x1: px(x), x2: px(x), y1: px(y), y2: px(y + 5) }));
      if (x > 22 && x < this.width - 22) {
        const text = metres === 0 ? "ego" : `${metres > 0 ? "+" : "\u2212"}${Math.abs(metres)} m`;
        marks.push(svg("text", { x: px(x), y: px(y + 17), class: "small soft", "text-anchor": "middle" }, text));
      }
    }
    return svg("g", { class: "ruler" }, marks);
  }

  draw(time) {
    const frame = frameAt(this.finding.times, time);
    const states = this.finding.vehicles.map((_, index) => stateAt(this.finding, index, frame));
    const ego = states[0];
    if (!ego) return states;
    this.egoAlong = ego.along;
    if (this.isWorld) {
      this.egoAcross = ego.across;
      this.shapes.setAttribute("transform", `translate(${px(this.x(0))} ${px(this.y(0))})`);
    }
    const offset = px((this.egoAlong * this.scale - this.middle) % (12 * this.scale));
    for (const dash of this.dashes) dash.setAttribute("stroke-dashoffset", offset);
    const wanted = this.drawTargets(states, time, frame);
    this.drawCells(states, wanted, frame, time);
    this.taken = [];
    this.texts = [];
    this.drawNames(states);
    states.forEach((state, index) => this.drawVehicle(state, index));
    states.forEach((state, index) => { if (index && state) this.drawPointer(state, index); });
    this.hideCovered();
    this.drawTrails(time, frame, ego);
    this.drawImpact(states, time);
    return states;
  }

  drawNames(states) {
    // Names at the left, on a bent road near there; none where a vehicle or another name would be in its place.
    const boxes = this.boxes(states);
    const isFree = ([x, y]) => [...boxes, ...this.texts].every(([bx, by, wide, high]) => Math.abs(bx - x - NAME_WIDTH / 2) > wide + NAME_WIDTH / 2 || Math.abs(by - y) > high + 8);
    this.names.forEach((name, lane) => {
      const places = this.isWorld ? this.placesOf(lane) : [[4, this.y(this.finding.road.lanes[lane])]];
      const place = places.find(isFree);
      name.setAttribute("visibility", place ? "visible" : "hidden");
      if (!place) return;
      name.setAttribute("transform", `translate(${px(place[0])} ${px(place[1])})`);
      this.texts.push([place[0] + NAME_WIDTH / 2, place[1], NAME_WIDTH / 2, 8]);
    });
  }

  placesOf(lane) {
    // The places for the name of a bent lane that are in sight, those at the left and near the ego's height first.
    const away = ([x, y]) => x + 2 * Math.abs(y - this.y(this.egoAcross));
    return this.finding.road.shapes[lane].points
      .map(([along, across]) => [this.x(along) - NAME_WIDTH / 2, this.y(across)])
      .filter(([x, y]) => x > 4 && x < this.width - NAME_WIDTH - 4 && y > 10 && y < this.height - RULER - 10)
      .sort((a, b) => away(a) - away(b));
  }

  // The centre of each vehicle, and half of the width and the height of the rectangle around it.
  boxes(states) {
    return states.filter(Boolean).map((state) => {
      const [cos, sin] = [Math.abs(Math.cos(state.heading)), Math.abs(Math.sin(state.heading))];
      const [wide, high] = [state.length * cos + state.width * sin, state.length * sin + state.width * cos];
      return [this.x(state.along), this.y(state.across), (wide / 2) * this.scale, (high / 2) * this.scale];
    });
  }

  drawCells(states, wanted, frame, time) {
    const ego = states[0];
    this.numbers = [];
    const boxes = this.boxes(states);
    const isFree = ([x, y]) => boxes.every(([bx, by, wide, high]) => Math.abs(bx - x) > wide + 6 || Math.abs(by - y) > high + 6);
    const [length, width] = [ego.length * this.scale, this.finding.road.lane_width * this.scale - 6];
    // At the contact only the cells that NPCs still drive to are of interest, and there is little room.
    const isOver = this.finding.event.kind === "collision" && time >= this.finding.event.time - 1e-6;
    this.cells.forEach(([box, number], index) => {
      const cell = index + 1;
      const centre = cellCentre(this.finding, ego, cell, frame);
      const isDrawn = centre.exists && (!isOver || wanted.has(cell));
      const visibility = isDrawn ? "visible" : "hidden";
      const [x, y] = [this.x(centre.along), this.y(centre.across)];
      change(box, { x: px(x - length / 2), y: px(y - width / 2), width: px(length), height: px(width), visibility });
      box.setAttribute("transform", turned(centre.heading, x, y));
      number.setAttribute("transform", turned(centre.heading, x, y));
      // The number is in a corner in which no vehicle is, the upper left one if it can be.
      const corners = [[-1, -1], [1, -1], [-1, 1], [1, 1]].map(([sideways, down]) => [sideways * (length / 2 - 7), down * (width / 2 - 9)]);
      const placed = corners.map(([dx, dy]) => [dx, dy, ...this.turnedPlace(centre, x, y, dx, dy)]);
      const free = placed.find((each) => isFree(each.slice(2)));
      const [dx, dy, ...place] = free ?? placed[0];
      change(number, { x: px(x + dx), y: px(y + dy), visibility: free ? visibility : "hidden", class: `cell-number${wanted.has(cell) ? " wanted" : ""}` });
      number.textContent = cell;
      if (isDrawn && free) this.numbers.push([...place, number]);
    });
  }

  hideCovered() {
    // The number of a cell gives way to the name of a lane and to an arrow's text.
    this.numbers = this.numbers.filter(([x, y, number]) => {
      const isFree = this.texts.every(([tx, ty, wide, high]) => Math.abs(tx - x) > wide + 6 || Math.abs(ty - y) > high + 8);
      if (!isFree) number.setAttribute("visibility", "hidden");
      return isFree;
    });
  }

  // A place in a cell, which turns with it.
  turnedPlace(centre, x, y, dx, dy) {
    const turn = this.isWorld ? centre.heading : 0;
    return [x + dx * Math.cos(turn) - dy * Math.sin(turn), y + dx * Math.sin(turn) + dy * Math.cos(turn)];
  }

  drawTargets(states, time, frame) {
    const wanted = new Set();
    this.lines.forEach(([line, ring], npc) => {
      const state = states[npc + 1];
      const row = instructionAt(this.finding, npc, time);
      const isSought = state && row && row.phase === "approach";
      let goal = isSought && row.cell ? cellCentre(this.finding, states[0], row.cell, frame) : null;
      // The target of an NPC that changes lanes is its place in the target lane.
      const across = isSought && row.lane && !this.isWorld ? targetLane(this.finding, npc, row) : undefined;
      if (across !== undefined) goal = { along: state.along, across, heading: 0, exists: true };
      const isDrawn = goal && (goal.exists || !this.isWorld);
      change(line, { visibility: isDrawn ? "visible" : "hidden" });
      change(ring, { visibility: isDrawn ? "visible" : "hidden" });
      if (!isDrawn) return;
      wanted.add(row.cell);
      const [x, y] = [this.x(goal.along), this.y(goal.across)];
      const [length, width] = [states[0].length * this.scale + 4, this.finding.road.lane_width * this.scale - 2];
      line.setAttribute("d", linePath([[this.x(state.along), this.y(state.across)], [x, y]]));
      change(ring, { x: px(x - length / 2), y: px(y - width / 2), width: px(length), height: px(width) });
      ring.setAttribute("transform", turned(goal.heading, x, y));
    });
    return wanted;
  }

  drawVehicle(state, index) {
    const { group, body, brake, leader, label } = this.bodies[index];
    const isInside = state && this.isInside(state);
    group.setAttribute("visibility", isInside ? "visible" : "hidden");
    if (!state) return;
    const [x, y] = [this.x(state.along), this.y(state.across)];
    change(group, { transform: `translate(${px(x)} ${px(y)})`, "data-along": fixed(state.along, 3), "data-across": fixed(state.across, 3) });
    body.setAttribute("transform", `rotate(${px(state.heading * 180 / Math.PI)})`);
    leader.setAttribute("d", "");
    change(label, { x: 0, y: 0 });
    label.classList.remove("away");
    brake.setAttribute("visibility", isInside && state.acceleration < -1 ? "inherit" : "hidden");
    if (isInside && x < POINTER_ROOM) this.taken.push({ isLeft: true, y, room: 20 });
    if (isInside && x > this.width - POINTER_ROOM) this.taken.push({ isLeft: false, y, room: 20 });
  }

  isInside(state) {
    const [x, reach] = [this.x(state.along), state.length * this.scale / 2];
    const y = this.y(state.across);
    const isHigh = this.isWorld && (y < 0 || y > this.height - RULER);
    return x > -reach && x < this.width + reach && !isHigh;
  }

  drawPointer(state, index) {
    // An arrow at the edge points to a vehicle that is out of sight. It is away from other arrows there, and above the ruler if it can be.
    const pointer = this.pointers[index - 1];
    const isInside = this.isInside(state);
    pointer.setAttribute("visibility", isInside ? "hidden" : "visible");
    if (isInside) return;
    const isLeft = this.isWorld ? state.along < this.egoAlong : this.x(state.along) < 0;
    const [plate, arrow, label] = pointer.children;
    const lowest = this.height - RULER - 12;
    const start = clamp(this.y(state.across), 12, lowest);
    const places = Array.from({ length: 400 }, (_, step) => start + (step % 2 ? 2 : -2) * Math.ceil(step / 2)).filter((y) => y >= 12
      && this.taken.every((other) => other.isLeft !== isLeft || Math.abs(other.y - y) >= other.room));
    const y = places.find((each) => each <= lowest) ?? places[0];
    this.taken.push({ isLeft, y, room: 15 });
    const edge = isLeft ? LANE_NAME : this.width - 4;
    const inward = isLeft ? 1 : -1;
    arrow.setAttribute("d", `M${edge} ${px(y)}l${9 * inward} -7v14Z`);
    change(label, { x: edge + 14 * inward, y: px(y + 4), "text-anchor": isLeft ? "start" : "end" });
    const away = Math.abs(state.along - this.egoAlong);
    const beside = Math.hypot(away, state.across - this.egoAcross);
    const where = this.isWorld ? `${beside.toFixed(0)} m away` : `${away.toFixed(0)} m ${isLeft ? "behind" : "ahead"}`;
    label.textContent = `NPC ${index - 1}, ${this.width < 600 ? where.replace(/ [a-z]+$/, "") : where}`;  // the arrow says where
    const half = 3.7 * label.textContent.length;
    change(plate, { x: px(Math.min(edge, edge + inward * (18 + 2 * half))), y: px(y - 8), width: px(18 + 2 * half) });  // keeps lines out of the text
    this.texts.push([edge + inward * (14 + half), y, half + 14, 9]);
  }

  drawTrails(time, frame, ego) {
    // The ego's path on the road, and the NPCs' paths relative to the ego, because instructions are relative to it.
    const from = Math.max(0, time - TRAIL_SECONDS);
    const moments = [];
    for (let at = Math.ceil(from * 8) / 8; at < time; at += 0.125) moments.push(frameAt(this.finding.times, at));
    moments.push(frame);
    this.trails.forEach((trail, index) => {
      const points = moments.map((moment) => {
        const state = stateAt(this.finding, index, moment);
        const origin = stateAt(this.finding, 0, moment);
        if (!state || !origin) return null;
        const along = index && !this.isWorld ? state.along - origin.along + ego.along : state.along;
        return [this.x(along), this.y(state.across)];
      });
      trail.setAttribute("d", linePath(points));
    });
  }

  drawImpact(states, time) {
    const event = this.finding.event;
    const other = event.npc === null ? null : states[event.npc + 1];
    const isDrawn = time >= event.time - 1e-6 && (event.kind === "collision" || event.kind === "ads_error" || event.kind === "hang");
    this.impact.setAttribute("visibility", isDrawn ? "visible" : "hidden");
    if (!isDrawn) return;
    const ego = states[0];
    const place = event.kind === "collision" && other ? this.contact(ego, other) : ego;
    const [x, y] = [this.x(place.along), this.y(place.across)];
    this.impact.setAttribute("transform", `translate(${px(x)} ${px(y)})`);
    if (event.kind === "collision") states.forEach((state, index) => { if (state && this.isInside(state)) this.moveLabel(states, index, x, y); });
    const [dx, dy] = this.labelOffset(states, x, y);
    const [line, , text] = this.impact.children;
    change(text, { x: px(dx), y: px(dy), "text-anchor": "middle" });
    // A text that is not at the contact has a line to it.
    const edge = [clamp(0, dx - 3.7 * this.impactText().length, dx + 3.7 * this.impactText().length), dy > 0 ? dy - 11 : dy + 3];
    line.setAttribute("d", Math.hypot(...edge) > 2.5 * this.star ? linePath([[0, 0], edge]) : "");
  }

  moveLabel(states, index, x, y) {
    // The number of a vehicle moves out of the mark at the contact and off other vehicles: along its own, else beside it, with a line to it.
    const state = states[index];
    const [cx, cy] = [this.x(state.along), this.y(state.across)];
    const others = this.boxes(states.filter((_, other) => other !== index));
    const isAway = ([dx, dy]) => Math.hypot(cx + dx - x, cy + dy - y) > this.star + LABEL
      && others.every(([bx, by, wide, high]) => Math.abs(bx - cx - dx) > wide + 4 || Math.abs(by - cy - dy) > high + 4);
    const { label, leader } = this.bodies[index];
    const end = Math.max(state.length * this.scale / 2 - LABEL, 0);
    const within = [0, 0.5, -0.5, 1, -1].map((share) => [share * end * Math.cos(state.heading), share * end * Math.sin(state.heading)]);
    let place = within.find(isAway);
    if (!place) {
      const own = this.boxes([state])[0];
      const isFree = ([dx, dy]) => isAway([dx, dy]) && cx + dx > LABEL && cx + dx < this.width - LABEL && cy + dy > LABEL && cy + dy < this.height - RULER - LABEL
        && (Math.abs(dx) > own[2] + LABEL || Math.abs(dy) > own[3] + LABEL)
        && this.texts.every(([tx, ty, wide, high]) => Math.abs(tx - cx - dx) > wide + LABEL || Math.abs(ty - cy - dy) > high + LABEL);
      place = this.offsets.find(isFree);
      if (!place) return;
      label.classList.add("away");
      leader.setAttribute("d", linePath([[0, 0], place.map((each) => each * (1 - LABEL / Math.hypot(...place)))]));
    }
    change(label, { x: px(place[0]), y: px(place[1]) });
    this.texts.push([cx + place[0], cy + place[1], LABEL, LABEL]);
  }

  contact(ego, other) {
    const [cos, sin] = [Math.cos(ego.heading), Math.sin(ego.heading)];
    const [dx, dy] = [other.along - ego.along, other.across - ego.across];
    const ahead = clamp(dx * cos + dy * sin, -ego.length / 2, ego.length / 2);
    const right = clamp(dy * cos - dx * sin, -ego.width / 2, ego.width / 2);
    return { along: ego.along + ahead * cos - right * sin, across: ego.across + ahead * sin + right * cos };
  }

  // The places of the texts at NPCs that cross, with room for a second text next to them.
  zoneLabels(states, half) {
    return states.flatMap((state, index) => {
      const label = state && this.bodies[index].group.querySelector(".zone-label");
      return label ? [[this.x(state.along), this.y(state.across) + Number(label.getAttribute("y")), half + 3.2 * label.textContent.length, 15]] : [];
    });
  }

  // The place of the text at the impact, relative to it: the nearest one that covers no vehicle, no cell's number and no slot.
  labelOffset(states, x, y) {
    const half = 3.7 * this.impactText().length;
    const boxes = this.boxes(states).map(([bx, by, wide, high]) => [bx, by, half + wide, 8 + high]).concat(
      this.numbers.map(([nx, ny]) => [nx, ny, half + 8, 15]), this.zoneLabels(states, half),
      this.texts.map(([tx, ty, wide, high]) => [tx, ty, half + wide, high + 8]),
    );
    // Better without edges of the road, and arrows' rings, in it.
    const edges = this.isWorld ? [] : [this.top, this.bottom].map((each) => [0, this.y(each), Infinity, 10]);
    const rings = this.lines.filter(([, ring]) => ring.getAttribute("visibility") === "visible").flatMap(([, ring]) => {
      const [rx, ry, wide, high] = ["x", "y", "width", "height"].map((name) => Number(ring.getAttribute(name)));
      return this.isWorld ? [] : [[rx, half, 8], [rx + wide, half, 8]].map(([at, wider]) => [at, ry + high / 2, wider, high / 2 + 8]);
    });
    const isFree = (boxes) => ([dx, dy]) => y + dy > 12 && y + dy < this.height - RULER && x + dx > half && x + dx < this.width - half
      && boxes.every(([bx, by, wide, high]) => Math.abs(bx - x - dx) > wide || Math.abs(by - y - dy + 4) > high);
    return this.offsets.find(isFree([...boxes, ...edges, ...rings])) ?? this.offsets.find(isFree([...boxes, ...edges])) ?? this.offsets.find(isFree(boxes)) ?? [0, 32];
  }
}
