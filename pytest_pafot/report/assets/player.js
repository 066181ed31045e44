// The player of one finding: the time, the controls, and the drawing at that time.

const SPEEDS = [0.25, 0.5, 1, 2, 4];
const CALM_STEP = 0.5;
const isCalm = () => matchMedia("(prefers-reduced-motion: reduce)").matches;

class Player {
  constructor(finding, place, time, onSettle) {
    this.finding = finding;
    this.place = place;
    this.onSettle = onSettle;
    this.duration = finding.times[finding.times.length - 1];
    // If the address has no time, show the moment of the finding. If motion is allowed, play the second before it.
    this.isOpening = time === null;
    this.time = clamp(time ?? momentOf(finding) - (isCalm() ? 0 : 1), 0, this.duration);
    this.rate = this.zoom = 1;
    this.isPlaying = false;
    this.build();
    this.layout();
    // Wait for the next frame: a layout inside the notification could resize the element again.
    this.observer = new ResizeObserver(() => requestAnimationFrame(() => { if (this.stage.clientWidth !== this.width) this.layout(); }));
    this.observer.observe(this.stage);
    if (this.isOpening) this.play(momentOf(finding));
  }

  control(tag, attributes, children, type, listener) {
    const element = html(tag, attributes, children);
    element.addEventListener(type, listener);
    return element;
  }

  build() {
    this.stage = this.control("div", { class: "stage" }, [], "click", () => this.toggle());
    this.legend = html("p", { class: "legend" });
    this.charts = html("div", { class: "charts" });
    this.button = this.control("button", { type: "button", class: "play" }, [], "click", () => this.toggle());
    this.clock = html("output", { class: "clock", "aria-live": "off" });
    this.scrubber = this.control("input", { type: "range", min: 0, max: this.duration, step: 0.01, "aria-label": "Time" }, [], "input", () => this.jump(Number(this.scrubber.value)));
    const event = this.control("button", { type: "button" }, "Go to the event", "click", () => this.jump(momentOf(this.finding)));
    const rates = this.control("select", { "aria-label": "Playback speed" }, SPEEDS.map((rate) => html("option", { value: rate }, `${rate}\u00d7`)), "change", () => { this.rate = Number(rates.value); });
    rates.value = 1;
    const zooms = [["Zoom in", "+", 1.25], ["Zoom out", "\u2212", 0.8]].map(
      ([name, sign, factor]) => this.control("button", { type: "button", "aria-label": name }, sign, "click", () => this.zoomBy(factor)));
    const heads = ["", "speed [m/s]", "cell", "gap [m]", "time to contact [s]", "decision or instruction"];
    this.rows = this.finding.vehicles.map(() => Array.from({ length: 5 }, () => html("td")));
    const body = this.finding.vehicles.map((vehicle, index) => {
      const chip = svg("svg", { class: "chip", viewBox: "0 0 26 14", "aria-hidden": "true" }, svg("rect", { x: 1, y: 1, width: 24, height: 12, rx: 2, class: index ? `npc-body ${stroke(index)}` : "ego-body" }));
      return html("tr", {}, [html("th", { scope: "row" }, [chip, vehicle.name]), ...this.rows[index]]);
    });
    const table = html("table", { class: "readout" }, [
      html("caption", { class: "unseen" }, "All vehicles at the time shown"),
      html("thead", {}, html("tr", {}, heads.map((head) => html("th", { scope: "col" }, head)))), html("tbody", {}, body),
    ]);
    this.place.replaceChildren(
      this.stage, html("div", { class: "controls" }, [this.button, this.clock, this.scrubber, event, rates, ...zooms]),
      html("div", { class: "scroll" }, table), this.legend, this.charts,
    );
    const seek = (pointer) => {
      if (pointer.type === "pointermove" && !pointer.buttons) return;
      const box = this.charts.getBoundingClientRect();
      this.jump(this.curves.time((pointer.clientX - box.left) * (this.curves.width / box.width)));
    };
    for (const type of ["pointerdown", "pointermove"]) this.charts.addEventListener(type, seek);
  }

  layout() {
    this.width = this.stage.clientWidth;
    if (!this.width) return;
    this.scene = new Scene(this.finding, this.width, this.zoom);
    this.curves = new Charts(this.finding, this.width);
    const isRelative = !this.scene.isWorld;
    this.stage.replaceChildren(this.scene.root);
    const trails = isRelative ? ", relative to the ego" : "";
    const told = [`E is the ego, which the policy drives. Numbers are the NPCs, the other vehicles. Dotted trails show the last ${TRAIL_SECONDS} s${trails}.`];
    if (isRelative) told.push("Numbered boxes are the cells around the ego. Dashed lines lead to the targets of NPCs.");
    if (isCrossed(this.finding)) told.push("Dotted lines are the paths of crossing NPCs. Shaded areas are their conflict zones with the ego's path.");
    told.push("Bars at the rear mean braking.");
    if (this.finding.ghost) told.push("The shaded box shows the ego if a careful driver takes over shortly before the impact.");
    this.legend.textContent = told.join(" ");
    this.charts.replaceChildren(this.curves.root);
    this.draw();
  }

  draw() {
    if (!this.scene) return;
    const states = this.scene.draw(this.time);
    this.curves.draw(this.time);
    this.scrubber.value = this.time;
    this.scrubber.setAttribute("aria-valuetext", `${fixed(this.time, 2)} s of ${fixed(this.duration, 2)} s`);
    this.clock.textContent = `${fixed(this.time, 2)} / ${fixed(this.duration, 2)} s`;
    this.button.textContent = this.isPlaying ? "Pause" : "Play";
    if (this.isOpening || this.isAtEnd()) this.button.textContent = "Play the whole run";
    this.place.dataset.time = fixed(this.time, 3);
    states.forEach((state, index) => {
      const row = index && instructionAt(this.finding, index - 1, this.time);
      const told = index ? row && wordsOf(row) : decisionAt(this.finding, this.time);
      const [gap, ttc] = index && state ? [fixed(state.gap, 1), fixed(state.ttc, 2)] : ["", ""];
      const texts = [state ? fixed(state.speed, 1) : "-", index && state ? CELL_NAMES[state.cell] ?? "" : "", gap, ttc, state && told ? told : ""];
      this.rows[index].forEach((cell, column) => { cell.textContent = texts[column]; });
    });
  }

  isAtEnd() { return this.time >= this.duration - 0.006; } // times in addresses have two decimals

  seek(time) {
    this.time = clamp(Math.round(time * 1000) / 1000, 0, this.duration);
    this.draw();
  }

  jump(time, isOpening = false) {
    this.isPlaying = false;
    this.isOpening = isOpening;
    cancelAnimationFrame(this.request);
    this.seek(time);
    this.onSettle();
  }

  toggle() {
    if (this.isPlaying && !this.isOpening) { this.jump(this.time); return; }
    if (this.isOpening || this.isAtEnd()) this.jump(0);
    this.play(this.duration);
  }

  play(until) {
    this.isPlaying = true;
    this.draw();
    let last = null;
    let owed = 0;
    const tick = (now) => {
      owed += last === null ? 0 : Math.min(0.25, (now - last) / 1000) * this.rate;
      last = now;
      // With reduced motion, the picture changes in steps and does not glide.
      const due = isCalm() ? Math.floor(owed / CALM_STEP) * CALM_STEP : owed;
      owed -= due;
      if (due > 0) this.seek(Math.min(this.time + due, until));
      if (this.time < until - 1e-6) this.request = requestAnimationFrame(tick); else this.jump(this.time, this.isOpening);
    };
    this.request = requestAnimationFrame(tick);
  }

  zoomBy(factor) {
    this.zoom = clamp(this.zoom * factor, 0.4, 3);
    this.layout();
  }

  close() {
    this.isPlaying = false;
    cancelAnimationFrame(this.request);
    this.observer.disconnect();
    this.place.replaceChildren();
  }
}
