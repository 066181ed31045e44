"use strict";
(() => {
  // Shows the run of the point that was chosen: the view moves along with the ego.
  const { points } = JSON.parse(document.getElementById("data").textContent);
  const at = (id) => document.getElementById(id);
  const shape = (name, attributes) => {
    const made = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    return made;
  };
  const ALONG = 90, ACROSS = 26; // the part of the road that is seen [m]
  let point = null, vehicles = [], timer = null;

  function draw() {
    const frame = Number(at("time").value), [ego] = point.frames[frame];
    at("scene").setAttribute("viewBox", `${ego[0] - ALONG / 3} ${ego[1] - ACROSS / 2} ${ALONG} ${ACROSS}`);
    point.frames[frame].forEach(([x, y, heading], index) => {
      vehicles[index].setAttribute("transform", `translate(${x} ${y}) rotate(${heading * 180 / Math.PI})`);
    });
    at("clock").textContent = `${point.times[frame].toFixed(1)} s, ego ${ego[3].toFixed(1)} m/s`;
  }

  function pause() {
    clearInterval(timer);
    timer = null;
    at("play").textContent = "Play";
  }

  function play() {
    if (timer) { pause(); return; }
    if (Number(at("time").value) >= point.frames.length - 1) at("time").value = 0;
    at("play").textContent = "Pause";
    timer = setInterval(() => {
      at("time").value = Number(at("time").value) + 1;
      draw();
      if (Number(at("time").value) >= point.frames.length - 1) pause();
    }, 1000 * (point.times[1] - point.times[0]));
  }

  function choose(button) {
    pause();
    document.querySelectorAll("[aria-pressed]").forEach((each) => each.removeAttribute("aria-pressed"));
    button.setAttribute("aria-pressed", "true");
    point = points[Number(button.dataset.point)];
    at("run").hidden = false;
    at("where").textContent = point.where;
    at("words").textContent = point.words;
    at("still").hidden = Boolean(point.frames);
    at("player").hidden = !point.frames;
    if (!point.frames) return;
    const lanes = point.lanes.map((lane) => ({ width: lane[lane.length - 1][0], line: lane.slice(0, -1).map((each) => each.join(",")).join(" ") }));
    vehicles = point.sizes.map(([length, width], index) => {
      const group = shape("g", {});
      group.append(shape("rect", { x: -length / 2, y: -width / 2, width: length, height: width, rx: 0.4, class: index ? "npc" : "ego" }));
      return group;
    });
    at("scene").replaceChildren(
      ...lanes.map(({ width, line }) => shape("polyline", { points: line, class: "edge", "stroke-width": width + 0.3 })),
      ...lanes.map(({ width, line }) => shape("polyline", { points: line, class: "lane", "stroke-width": width - 0.2 })),
      ...vehicles,
    );
    at("time").max = point.frames.length - 1;
    at("time").value = 0;
    draw();
  }

  document.querySelectorAll("[data-point]").forEach((button) => button.addEventListener("click", () => choose(button)));
  at("play").addEventListener("click", play);
  at("time").addEventListener("input", draw);
  const worst = document.querySelector(".preventable button") || document.querySelector("[data-point]");
  if (worst) choose(worst);
})();
