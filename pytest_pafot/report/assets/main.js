// Assembles the page: the selected finding, links, keys, copying.

const report = JSON.parse(document.getElementById("data").textContent);
const articles = [...document.querySelectorAll("#articles > article")];
const links = [...document.querySelectorAll("#list a[data-index]")].sort((a, b) => a.dataset.index - b.dataset.index);
const keys = links.map((link) => link.dataset.key);
const status = document.getElementById("status");
let current = -1;
let player = null;

document.documentElement.classList.add("js");

for (const article of articles) {
  // A number and its unit stay on one line.
  const words = document.createTreeWalker(article, NodeFilter.SHOW_TEXT, (text) => (text.parentElement.closest("code, pre") ? NodeFilter.FILTER_SKIP : NodeFilter.FILTER_ACCEPT));
  while (words.nextNode()) words.currentNode.data = tied(words.currentNode.data);
  // The line above the picture breaks only between its phrases.
  const headline = article.querySelector("h2").childNodes[1];
  const phrases = headline.textContent.split(/(?<=[:,;]) /);
  headline.replaceWith(...phrases.flatMap((phrase, place) => {
    const shown = document.createElement("span");
    shown.className = "phrase";
    shown.textContent = phrase.trim();
    return [" ", shown].slice(place || phrase.startsWith(" ") ? 0 : 1);
  }));
}

const announce = (text) => { status.textContent = text; };

function readLink() {
  const parameters = new URLSearchParams(location.hash.slice(1));
  const key = parameters.get("finding");
  const time = parameters.has("t") ? Number.parseFloat(parameters.get("t")) : null;
  return { index: keys.indexOf(key), time: Number.isFinite(time) ? time : null };
}

function writeLink() {
  const parameters = new URLSearchParams({ finding: keys[current], t: player ? fixed(player.time, 2) : "0" });
  try {
    history.replaceState(null, "", `#${parameters}`);
  } catch (error) {
    // A page inside a srcdoc frame has no address that could change.
    if (!(error instanceof DOMException)) throw error;
  }
}

function show(index, time) {
  if (!report.findings.length) return;
  const chosen = clamp(index, 0, report.findings.length - 1);
  if (player) player.close();
  player = null;
  articles.forEach((article, place) => article.classList.toggle("current", place === chosen));
  links.forEach((link, place) => link.setAttribute("aria-current", place === chosen ? "true" : "false"));
  current = chosen;
  reveal(links[chosen]);
  const finding = report.findings[chosen];
  if (finding.times.length) {
    player = new Player(finding, articles[chosen].querySelector(".player"), time, announce);
    player.onSettle = writeLink;
  }
}

function reveal(link) {
  // Scroll only inside the list, so that the page itself stays where the reader is.
  const place = link.getBoundingClientRect();
  const frame = rows.getBoundingClientRect();
  const heading = link.closest(".rows > .group")?.firstChild.offsetHeight ?? 0;
  const bottom = Math.max(Math.min(frame.bottom, innerHeight), frame.top + heading + place.height);
  if (place.top < frame.top + heading) rows.scrollTop -= frame.top + heading - place.top;  // the heading stays on top
  else if (place.bottom > bottom) rows.scrollTop += place.bottom - bottom;
  countHidden();
}

// Lines above and below the list say how many findings are out of sight there, if it is longer than its place.
const rows = document.querySelector("#list .rows");
const ends = rows ? ["beforebegin", "afterend"].map((place) => {
  const line = document.createElement("p");
  line.className = "more";
  rows.insertAdjacentElement(place, line);
  return line;
}) : [];

function countHidden() {
  const frame = rows.getBoundingClientRect();
  const places = listed().map((each) => each.getBoundingClientRect());
  const counts = [places.filter((each) => each.top < frame.top - 1).length, places.filter((each) => each.bottom > frame.bottom + 1).length];
  ends.forEach((line, place) => {
    line.classList.toggle("needed", rows.scrollHeight > rows.clientHeight + 1);
    line.classList.toggle("shown", counts[place] > 0);
    line.textContent = `${place ? "\u25be" : "\u25b4"} ${counts[place]} more ${place ? "below" : "above"}`;
  });
}

const listed = () => [...document.querySelectorAll("#list li:not([hidden]) a[data-index]")];

function step(by) {
  // The order is that of the list, which is by test, among the findings that pass the filter.
  const order = listed();
  const next = order.indexOf(links[current]) + by;
  if (next < 0 || next >= order.length) return;
  const index = links.indexOf(order[next]);
  show(index, null);
  writeLink();
  announce(`Finding ${next + 1} of ${order.length}: ${report.findings[index].headline}`);
}

function applyFilter() {
  const words = filter.value.toLowerCase().split(/\s+/).filter(Boolean);
  for (const link of links) {
    const isKind = !outcome.value || link.dataset.outcome === outcome.value;
    link.parentElement.hidden = !(isKind && words.every((word) => link.dataset.words.includes(word)));
  }
  for (const group of document.querySelectorAll("#list .group")) group.hidden = !group.querySelector("li:not([hidden])");
  const left = listed();
  document.getElementById("nothing").hidden = left.length > 0;
  document.querySelector("#list h2 .count").textContent = left.length === links.length ? `${links.length}` : `${left.length} of ${links.length}`;
  announce(`${left.length} of ${links.length} findings`);
  countHidden();
  if (left.length && !left.includes(links[current])) { show(links.indexOf(left[0]), null); writeLink(); }
}

function clearFilter() {
  filter.value = "";
  outcome.value = "";
  applyFilter();
}

function onKey(event) {
  if (event.ctrlKey || event.altKey || event.metaKey || event.defaultPrevented) return;
  const target = event.target;
  const isField = target.matches && target.matches("select, textarea, input:not([type=range])");
  const isText = target.matches && target.matches("pre");
  const isPressed = event.key === " " && target.matches && target.matches("button, summary");
  if (isField || isPressed || (isText && event.key !== "j" && event.key !== "k")) return;
  const action = keyAction(event);
  if (!action) return;
  event.preventDefault();
  action();
}

function keyAction(event) {
  if (event.key === "j") return () => step(1);
  if (event.key === "k") return () => step(-1);
  if (event.key === "?") return toggleKeys;
  if (event.key === "/" && filter) return () => filter.focus();
  if (!player) return null;
  const small = event.shiftKey ? 1 : 0.1;
  return {
    " ": () => player.toggle(),
    ArrowRight: () => player.jump(player.time + small),
    ArrowLeft: () => player.jump(player.time - small),
    Home: () => player.jump(0),
    End: () => player.jump(player.duration),
    e: () => player.jump(momentOf(player.finding)),
    "+": () => player.zoomBy(1.25),
    "=": () => player.zoomBy(1.25),
    "-": () => player.zoomBy(0.8),
  }[event.key];
}

function toggleKeys() {
  const list = document.getElementById("key-list");
  list.hidden = !list.hidden;
  document.getElementById("keys").setAttribute("aria-expanded", String(!list.hidden));
}

async function copy(button) {
  const kind = button.dataset.copy;
  const source = kind === "pre" ? button.closest(".yaml").querySelector("pre") : button.parentElement.querySelector("code");
  const label = button.textContent;
  const isDone = await copied(source);
  button.textContent = isDone ? "Copied" : "Selected, press Ctrl+C";
  announce(button.textContent);
  setTimeout(() => { button.textContent = label; }, 2000);
}

async function copied(source) {
  try {
    await navigator.clipboard.writeText(source.textContent);
    return true;
  } catch (error) {
    // Some browsers allow no clipboard for files and frames: select the text and try the old command.
    const range = document.createRange();
    range.selectNodeContents(source);
    getSelection().removeAllRanges();
    getSelection().addRange(range);
    return document.execCommand("copy");
  }
}

const filter = document.getElementById("filter");
const outcome = document.getElementById("outcome");
if (filter) {
  filter.addEventListener("input", applyFilter);
  outcome.addEventListener("change", applyFilter);
  for (const field of [filter, outcome]) {
    field.addEventListener("keydown", (event) => { if (event.key === "Escape") { clearFilter(); links[current].focus(); } });
  }
}
document.getElementById("keys").addEventListener("click", toggleKeys);
document.addEventListener("keydown", onKey);
for (const button of document.querySelectorAll("button.copy")) button.addEventListener("click", () => copy(button));
addEventListener("hashchange", () => {
  const { index, time } = readLink();
  if (index < 0) return;
  if (index === current && player && time !== null) { player.pause(); player.seek(time); } else show(index, time);
});
const link = readLink();
show(link.index < 0 ? 0 : link.index, link.index < 0 ? null : link.time);
if (rows) {
  reveal(links[current]);  // again, in the place that is left beside these lines
  rows.addEventListener("scroll", countHidden);
  addEventListener("resize", countHidden);
}
