// Assembles the page: the selected finding, links, keys, copying.

const findings = JSON.parse(document.getElementById("data").textContent);
const articles = [...document.querySelectorAll("#articles > article")];
const links = [...document.querySelectorAll("#list a[data-key]")];
const status = document.getElementById("status");
let current = -1;
let player = null;

document.documentElement.classList.add("js");

function settle() {
  history.replaceState(null, "", `#${new URLSearchParams({ finding: links[current].dataset.key, ...(player && !player.isOpening && { t: fixed(player.time, 2) }) })}`);
  if (player) status.textContent = `${fixed(player.time, 1)} seconds`;
}

function show(index, time) {
  if (!findings.length) return;
  player?.close();
  current = clamp(index, 0, findings.length - 1);
  articles.forEach((article, place) => article.classList.toggle("current", place === current));
  links.forEach((link, place) => link.setAttribute("aria-current", `${place === current}`));
  links[current].scrollIntoView({ block: "nearest" });
  player = findings[current].times.length ? new Player(findings[current], articles[current].querySelector(".player"), time, settle) : null;
}

function follow() {
  // Shows the finding and the time that the address requests.
  const asked = new URLSearchParams(location.hash.slice(1));
  const index = links.findIndex((link) => link.dataset.key === asked.get("finding"));
  const time = Number.parseFloat(asked.get("t"));
  if (index >= 0 || current < 0) show(Math.max(index, 0), Number.isFinite(time) && index >= 0 ? time : null);
}

function step(by) {
  if (!(current + by in findings)) return;
  show(current + by, null);
  settle();
  status.textContent = `Finding ${current + 1} of ${findings.length}: ${findings[current].headline}`;
}

function toggleKeys() {
  const list = document.getElementById("key-list");
  list.hidden = !list.hidden;
  document.getElementById("keys").setAttribute("aria-expanded", `${!list.hidden}`);
}

function actionOf(key, isFar) {
  const anywhere = { j: () => step(1), k: () => step(-1), "?": toggleKeys }[key];
  if (anywhere || !player) return anywhere;
  const small = isFar ? 1 : 0.1;
  return {
    " ": () => player.toggle(),
    ArrowRight: () => player.jump(player.time + small),
    ArrowLeft: () => player.jump(player.time - small),
    Home: () => player.jump(0),
    End: () => player.jump(player.duration),
    e: () => player.jump(momentOf(player.finding)),
    "+": () => player.zoomBy(1.25),
    "-": () => player.zoomBy(0.8),
  }[key];
}

function onKey(event) {
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  if (event.target.matches?.("select") || (event.key === " " && event.target.matches?.("button, summary"))) return;
  if (event.target.matches?.("pre") && !"jk".includes(event.key)) return;
  const action = actionOf(event.key, event.shiftKey);
  if (!action) return;
  event.preventDefault();
  action();
}

async function copy(button) {
  const source = button.parentElement.parentElement.querySelector(button.dataset.copy);
  const label = button.textContent;
  try {
    await navigator.clipboard.writeText(source.textContent);
    button.textContent = "Copied";
  } catch {
    // Some browsers do not allow access to the clipboard for local files.
    getSelection().selectAllChildren(source);
    button.textContent = "Selected, press Ctrl+C";
  }
  status.textContent = button.textContent;
  setTimeout(() => { button.textContent = label; }, 2000);
}

document.getElementById("keys").addEventListener("click", toggleKeys);
document.addEventListener("keydown", onKey);
for (const button of document.querySelectorAll("button[data-copy]")) button.addEventListener("click", () => copy(button));
addEventListener("hashchange", follow);
follow();
