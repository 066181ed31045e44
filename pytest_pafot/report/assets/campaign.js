// A search: fitness over its generations, with local searches and restarts marked.

class FitnessChart {
  constructor(campaign, width) {
    this.rows = campaign.generations;
    this.width = width;
    this.left = 74;
    this.right = width - 16;
    this.parts = [];
    this.top = this.legend() + 42;
    this.bottom = this.top + 180;
    const values = this.rows.flatMap((row) => [row.best, row.mean, row.local_best]).filter((value) => value !== null);
    const high = Math.max(...values, 0);
    const low = Math.min(...values, 0);
    this.step = niceStep(Math.max(high - low, 1e-6), 4);
    this.high = Math.max(Math.ceil(high / this.step - 1e-9) * this.step, low + this.step);
    this.low = Math.floor(low / this.step + 1e-9) * this.step;
    this.axes();
    this.marks();
    this.curves();
    this.failing();
    this.height = this.bottom + 62;
    this.root = svg("svg", {
      viewBox: `0 0 ${px(width)} ${px(this.height)}`, height: px(this.height), role: "img",
      "aria-label": "Fitness over the generations of the search; the table below has the numbers.",
    }, this.parts);
  }

  x(generation) {
    const last = Math.max(1, this.rows[this.rows.length - 1].generation);
    return this.left + 8 + (generation / last) * (this.right - this.left - 16);
  }

  y(value) { return this.bottom - ((value - this.low) / (this.high - this.low)) * (this.bottom - this.top); }

  axes() {
    const digits = Math.max(0, -Math.floor(Math.log10(this.step) + 1e-9));
    for (let value = this.low; value <= this.high + this.step / 100; value += this.step) {
      const y = px(this.y(value));
      this.parts.push(svg("line", { x1: this.left, x2: px(this.right), y1: y, y2: y, class: "axis" }));
      this.parts.push(svg("text", { x: this.left - 6, y: px(this.y(value) + 4), class: "small soft", "text-anchor": "end" }, value.toFixed(digits)));
    }
    const last = this.rows[this.rows.length - 1].generation;
    const step = Math.max(1, niceStep(Math.max(1, last), this.width / 80));
    for (let generation = 0; generation <= last; generation += step) {
      this.parts.push(svg("text", { x: px(this.x(generation)), y: px(this.bottom + 50), class: "small soft", "text-anchor": "middle" }, `${generation}`));
    }
    this.parts.push(svg("text", { x: this.left - 6, y: px(this.bottom + 50), class: "small soft", "text-anchor": "end" }, "generation"));
  }

  marks() {
    for (const row of this.rows) {
      const x = this.x(row.generation);
      if (row.restarted) {
        this.parts.push(svg("line", { x1: px(x), x2: px(x), y1: px(this.top - 12), y2: px(this.bottom), class: "restart" }));
        this.parts.push(svg("text", { x: px(x), y: px(this.top - 15), class: "small strong", "text-anchor": "middle" }, ["R", svg("title", {}, `restart: generation ${row.generation} is random`)]));
      }
      if (row.local_best !== null) {
        const y = this.y(row.local_best);
        const title = `local search after generation ${row.generation}: ${row.local_best.toFixed(3)}, ${row.local_replaced ? "better" : "nothing better"}`;
        this.parts.push(svg("path", { d: `M${px(x)} ${px(y - 14)}l6 10h-12Z`, class: `local${row.local_replaced ? " replaced" : ""}` }, svg("title", {}, title)));
      }
    }
  }

  curves() {
    // A restart begins a new line, because it begins a new population.
    const points = (key) => this.rows.flatMap((row) => {
      const point = row[key] === null ? null : [this.x(row.generation), this.y(row[key])];
      return row.restarted ? [null, point] : [point];
    });
    const radius = clamp((this.right - this.left) / this.rows.length / 4, 1.2, 3.2);
    this.parts.push(svg("path", { d: linePath(points("mean")), class: "mean-line" }));
    this.parts.push(svg("path", { d: linePath(points("best")), class: "best-line" }));
    for (const row of this.rows) {
      const title = () => svg("title", {}, `generation ${row.generation}: best ${fixed(row.best, 3)}, mean ${fixed(row.mean, 3)}, ${row.failing} of ${row.population} failing`);
      const x = this.x(row.generation);
      if (row.mean !== null && radius > 2) this.parts.push(svg("rect", { x: px(x - 2), y: px(this.y(row.mean) - 2), width: 4, height: 4, class: "mean-dot" }, title()));
      if (row.best !== null) this.parts.push(svg("circle", { cx: px(x), cy: px(this.y(row.best)), r: radius, class: "best-dot" }, title()));
    }
  }

  failing() {
    const top = Math.max(1, ...this.rows.map((row) => row.population));
    const width = clamp(((this.right - this.left) / this.rows.length) * 0.55, 1, 12);
    const base = this.bottom + 30;
    for (const row of this.rows) {
      const height = (row.failing / top) * 22;
      if (row.failing) this.parts.push(svg("rect", { x: px(this.x(row.generation) - width / 2), y: px(base - height), width: px(width), height: px(height), class: "failing" }));
    }
    this.parts.push(svg("line", { x1: this.left, x2: px(this.right), y1: px(base), y2: px(base), class: "axis" }));
    this.parts.push(svg("text", { x: this.left - 6, y: px(base), class: "small soft", "text-anchor": "end" }, "failing"));
  }

  legend() {
    // Returns the place of its last line.
    const items = [
      [svg("path", { d: "M0 0h22", class: "best-line" }), svg("circle", { cx: 11, cy: 0, r: 3, class: "best-dot" }), "best"],
      [svg("path", { d: "M0 0h22", class: "mean-line" }), svg("rect", { x: 9, y: -2, width: 4, height: 4, class: "mean-dot" }), "mean"],
      [svg("path", { d: "M11 -5l6 10h-12Z", class: "local replaced" }), "local search, better"],
      [svg("path", { d: "M11 -5l6 10h-12Z", class: "local" }), "local search, nothing better"],
      [svg("path", { d: "M11 -7V7", class: "restart" }), "R restart"],
    ];
    let x = 12;
    let y = 16;
    const group = svg("g");
    for (const item of items) {
      const label = item.pop();
      const wide = 32 + label.length * 6.2 + 14;
      if (x + wide > this.width && x > 12) { x = 12; y += 17; }
      group.append(svg("g", { transform: `translate(${px(x)} ${px(y)})` }, [...item, svg("text", { x: 28, y: 4, class: "small" }, label)]));
      x += wide;
    }
    this.parts.push(group);
    return y;
  }
}

function mountCampaign(campaign, place) {
  if (!campaign.generations.length) return;
  let drawn = 0;
  const layout = () => {
    const width = place.clientWidth || place.parentElement.clientWidth;
    if (width && width !== drawn) {
      drawn = width;
      place.replaceChildren(new FitnessChart(campaign, width).root);
    }
  };
  layout();
  onResize(place, layout);
}
