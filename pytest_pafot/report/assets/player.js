// One finding on stage: time, controls, and the drawing at that time.

const SPEEDS = [0.25, 0.5, 1, 2, 4];
const REPLAY_SECONDS = 6;
const CALM_STEP = 0.5;

class Player {
  constructor(finding, place, time, announce) {
    this.finding = finding;
    this.place = place;
    this.announce = announce;
    this.duration = finding.times[finding.times.length - 1];
    this.time = clamp(time === null ? momentOf(finding) : time, 0, this.duration);
    this.rate = 1;
    this.zoom = null;  // As the picture likes it, until the reader zooms.
    this.isPlaying = false;
    this.onSettle = () => {};
    this.build();
    this.layout();
    this.forget = onResize(this.stage, () => this.layout());
  }

  build() {
    this.checked = this.finding.check && this.finding.check.values.length ? html("div", { class: "charts checked" }) : null;
    this.stage = html("div", { class: "stage" });
    this.charts = html("div", { class: "charts" });
    this.button = html("button", { type: "button", class: "play" });
    this.button.addEventListener("click", () => this.toggle());
    this.clock = html("output", { class: "clock", "aria-live": "off" });
    this.scrubber = html("input", { type: "range", min: 0, max: this.duration, step: 0.01, "aria-label": "Time" });
    this.scrubber.addEventListener("input", () => {
      const time = Number(this.scrubber.value);  // before the pause, which draws, and moves the scrubber back
      this.pause();
      this.seek(time);
    });
    this.scrubber.addEventListener("change", () => this.settle());
    const event = html("button", { type: "button" }, "Go to the event");
    event.addEventListener("click", () => this.jump(momentOf(this.finding)));
    const rates = html("select", { "aria-label": "Speed of play" }, SPEEDS.map((rate) => html("option", { value: rate }, `${rate}\u00d7`)));
    rates.value = 1;
    rates.addEventListener("change", () => { this.rate = Number(rates.value); });
    const zooms = [["Zoom in", "+", 1.25], ["Zoom out", "\u2212", 0.8]].map(([name, sign, factor]) => {
      const button = html("button", { type: "button", "aria-label": name, title: name }, sign);
      button.addEventListener("click", () => this.zoomBy(factor));
      return button;
    });
    this.readout = html("tbody");
    const heads = ["", "speed [m/s]", isCrossed(this.finding) ? "place" : "in cell", "gap [m]", "contact in [s]", this.finding.decisions.length ? "decision, instruction" : "instruction"];
    const table = html("div", { class: "scroll" }, html("table", { class: "readout" }, [
      html("caption", { class: "unseen" }, "All vehicles at the time shown"),
      html("thead", {}, html("tr", {}, heads.map((head) => html("th", { scope: "col" }, head)))), this.readout,
    ]));
    this.rows = this.finding.vehicles.map((vehicle, index) => this.row(vehicle, index));
    this.place.replaceChildren(
      ...(this.checked ? [this.checked] : []),
      this.stage,
      html("div", { class: "controls" }, [this.button, this.clock, this.scrubber, event, rates, html("span", { class: "zoom" }, zooms)]),
      table, this.charts,
    );
    this.bindCharts(this.charts);
    if (this.checked) this.bindCharts(this.checked);
  }

  row(vehicle, index) {
    const chip = svg("svg", { class: "chip", viewBox: "0 0 26 14", "aria-hidden": "true" });
    if (index) {
      const [pattern, reference] = bodyPattern(index - 1);
      chip.append(svg("defs", {}, pattern), svg("rect", { x: 1, y: 1, width: 24, height: 12, rx: 2, fill: reference, class: stroke(index), "stroke-width": 1.5 }));
    } else {
      chip.append(svg("rect", { x: 1, y: 1, width: 24, height: 12, rx: 2, class: "ego-body" }));
    }
    const cells = Array.from({ length: 5 }, () => html("td"));
    this.readout.append(html("tr", {}, [html("th", { scope: "row" }, [chip, vehicle.name]), ...cells]));
    return cells;
  }

  bindCharts(place) {
    let isDragging = false;
    const seek = (event) => {
      const box = place.firstChild.getBoundingClientRect();
      this.seek(this.curves.time((event.clientX - box.left) * (this.curves.width / box.width)));
    };
    place.addEventListener("pointerdown", (event) => {
      isDragging = true;
      place.setPointerCapture(event.pointerId);
      this.pause();
      seek(event);
    });
    place.addEventListener("pointermove", (event) => { if (isDragging) seek(event); });
    for (const end of ["pointerup", "pointercancel"]) {
      place.addEventListener(end, () => { if (isDragging) this.settle(); isDragging = false; });
    }
  }

  layout() {
    const width = this.stage.clientWidth;
    const close = this.closeUp();
    if (!width || (width === this.drawnWidth && this.zoom === this.drawnZoom && close === this.drawnClose)) return;
    [this.drawnWidth, this.drawnZoom, this.drawnClose] = [width, this.zoom, close];
    this.scene = new Scene(this.finding, width, this.zoom ?? 1, close);
    this.curves = new Charts(this.finding, width);
    this.checkCurve = this.checked ? new Charts(this.finding, width, this.finding.check) : null;
    if (this.checked) this.checked.replaceChildren(this.checkCurve.root);
    const rows = this.finding.instructions;
    const isLaned = !this.scene.isWorld && rows.some((row) => row.lane);
    const isOnGrid = rows.some((row) => row.cell) || !(this.scene.isCrossed || rows.some((row) => row.lane));
    const goals = [isOnGrid ? "cell" : "", isLaned ? "lane" : ""].filter(Boolean).join(" or ");
    this.stage.replaceChildren(this.scene.root, html("p", { class: "legend" },
      `E is the ego; NPCs carry their number and a pattern. Dotted trails: the last 4 s${this.scene.isWorld ? "" : " relative to the ego"}. ` +
      (this.finding.grid.length || !this.scene.isWorld ? "Numbered boxes: the cells around the ego; 2 is ahead of it, 6 behind. " : "") +
      (goals ? `Dashed line: to the ${goals} that an NPC is to drive to. ` : "") +
      (this.scene.isCrossed ? "Dotted lines: the ways of NPCs that cross; shaded: the zones in which they meet the ego's; the text at an NPC says when it is to be there. " : "") +
      "Bars at the rear: braking."));
    this.charts.replaceChildren(this.curves.root);
    this.draw();
  }

  // A junction is drawn larger around the moment, if an NPC is near then.
  closeUp() {
    const moment = momentOf(this.finding);
    const frame = frameAt(this.finding.times, moment);
    const gaps = this.finding.vehicles.slice(1).map((vehicle) => held(vehicle.gap, frame));
    const isNear = Math.abs(this.time - moment) <= CLOSE_SECONDS && gaps.some((gap) => gap !== null && gap < CLOSE_GAP);
    return isNear && isCrossed(this.finding) && this.zoom === null ? CLOSE_UP : 1;
  }

  draw() {
    if (!this.scene) return;
    if (this.closeUp() !== this.drawnClose) { this.layout(); return; }
    const states = this.scene.draw(this.time);
    this.curves.draw(this.time);
    if (this.checkCurve) this.checkCurve.draw(this.time);
    this.scrubber.value = this.time;
    this.scrubber.setAttribute("aria-valuetext", `${fixed(this.time, 2)} s of ${fixed(this.duration, 2)} s`);
    this.clock.textContent = `${fixed(this.time, 2)} / ${fixed(this.duration, 2)} s`;
    this.button.textContent = this.isPlaying ? "Pause" : this.isAtEnd() ? `Replay ${REPLAY_SECONDS} s` : "Play";
    this.place.dataset.time = fixed(this.time, 3);
    states.forEach((state, index) => this.fillRow(state, index));
  }

  fillRow(state, index) {
    const instruction = index ? instructionAt(this.finding, index - 1, this.time) : null;
    const texts = state ? [
      fixed(state.speed, 1),
      index ? placeName(state, this.finding.vehicles[index].zone) : "",
      index ? fixed(state.gap, 1) : "",
      index ? fixed(state.ttc, 2) : "",
      index ? (instruction ? PHASES[instruction.zone ? "crossing" : instruction.phase](instruction) : "") : decisionAt(this.finding, this.time),
    ] : ["-", "-", "-", "-", ""];
    this.rows[index].forEach((cell, column) => { if (cell.textContent !== tied(texts[column])) cell.textContent = tied(texts[column]); });
  }

  isAtEnd() { return this.time >= this.duration - 1e-6; }

  seek(time) {
    this.time = clamp(Math.round(time * 1000) / 1000, 0, this.duration);
    this.draw();
  }

  jump(time) {
    this.pause();
    this.seek(time);
    this.settle();
  }

  settle() {
    this.onSettle();
    this.announce(`${fixed(this.time, 1)} seconds`);
  }

  toggle() {
    if (this.isPlaying) { this.pause(); this.settle(); } else this.play();
  }

  play() {
    if (this.isAtEnd()) this.time = Math.max(0, this.duration - REPLAY_SECONDS);
    this.isPlaying = true;
    const isCalm = matchMedia("(prefers-reduced-motion: reduce)").matches;
    let last = null;
    let owed = 0;
    const tick = (now) => {
      if (!this.isPlaying) return;
      owed += last === null ? 0 : Math.min(0.25, (now - last) / 1000) * this.rate;
      last = now;
      // With reduced motion the picture changes in steps instead of gliding.
      const due = isCalm ? Math.floor(owed / CALM_STEP) * CALM_STEP : owed;
      owed -= due;
      if (due > 0) this.seek(this.time + due);
      if (this.isAtEnd()) { this.pause(); this.settle(); } else this.request = requestAnimationFrame(tick);
    };
    this.draw();
    this.request = requestAnimationFrame(tick);
  }

  pause() {
    this.isPlaying = false;
    cancelAnimationFrame(this.request);
    this.draw();
  }

  zoomBy(factor) {
    this.zoom = clamp((this.zoom ?? this.closeUp()) * factor, 0.4, 3);
    this.layout();
  }

  close() {
    this.pause();
    this.forget();
    this.place.replaceChildren();
  }
}
