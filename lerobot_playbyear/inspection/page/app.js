// Puts the page together: head, list of episodes, stage, timeline, keys.

const settings = { own: {}, hidden: {}, toggleScale };
const player = new Player(byId("video"), showTime);
let episode = null;
let axis = null;
let panels = [];
let wanted = 0; // position of the episode chosen last
let hovered = null; // time under the pointer

function showHead() {
  const { facts } = dataset;
  const number = (value) => value.toLocaleString("en");
  const lines = [
    `${number(facts.episodes)} episode${facts.episodes === 1 ? "" : "s"}`,
    `${number(facts.frames)} frames, ${number(Math.round(facts.seconds))} s at ${fps} Hz`,
    ...Object.entries(facts.cameras).map(([key, shape]) => `${shortName(key)} ${shape.filter((n) => n > 4).reverse().join(" × ")}`),
    ...Object.entries(facts.microphones).map(([key, rate]) => `${shortName(key)} ${rate ? `${number(rate)} Hz` : "without a sample rate"}`),
  ];
  if (!Object.keys(facts.microphones).length) lines.push("no sound");
  byId("facts").append(...lines.map((line) => make("li", {}, line)));
  byId("verdict").classList.add(dataset.worst === "info" ? "ok" : dataset.worst);
  const counts = ["error", "warning"].map((level) => [level, dataset.verdicts.filter((v) => v.level === level).length]);
  byId("verdict").textContent = counts.filter(([, n]) => n).map(([level, n]) => `${n} ${level}${n > 1 ? "s" : ""}`).join(", ") || `${dataset.verdicts.length} checks`;
  byId("summary").textContent = dataset.summary;
  const order = ["error", "warning", "info", "ok"];
  const sorted = [...dataset.verdicts].sort((a, b) => order.indexOf(a.level) - order.indexOf(b.level));
  for (const verdict of sorted) {
    const subject = verdict.feature ? `${shortName(verdict.feature)}: ` : "";
    const line = make("li", { className: verdict.level }, make("span", {}, verdict.check), make("span", {}, subject + verdict.message));
    line.episodes = ["warning", "error"].includes(verdict.level) ? verdict.episodes : [];
    byId("verdicts").append(line);
  }
  const decibels = 20 * Math.log10(dataset.gain);
  const heard = dataset.microphones.length > 1 ? [`L ${shortName(dataset.microphones[0].key)}, R ${shortName(dataset.microphones[1].key)}`] : [];
  if (dataset.microphones.length && Math.abs(decibels) >= 1) heard.push(`${Math.abs(decibels).toFixed(0)} dB ${decibels > 0 ? "louder" : "quieter"} than recorded`);
  byId("heard").textContent = heard.join(", ");
  byId("volume-label").hidden = !dataset.microphones.length;
}

function showList() {
  const list = dataset.episodes.map((head, position) => {
    const [mark, name] = head.success === null ? ["", ""] : head.success < 0 ? ["✕", "failure"] : ["✓", "success"];
    const button = make(
      "button",
      { role: "option", title: head.task, onclick: () => open(position) },
      make("b", {}, String(head.index)),
      make("canvas", { height: 36 }),
      make("span", { className: "length" }, `${(head.frames / fps).toFixed(1)} s`),
      make("span", { className: `mark ${name}`, title: name }, mark),
    );
    button.setAttribute("role", "option");
    return button;
  });
  byId("episodes").append(...list);
  paintPreviews();
}

// How loud each episode was over its time.
function paintPreviews() {
  const longest = Math.max(...dataset.episodes.map((head) => head.frames));
  [...byId("episodes").children].forEach((button, position) => {
    const { preview, frames } = dataset.episodes[position];
    const canvas = button.querySelector("canvas");
    const { context, width, height } = contextOf(canvas, 18);
    const extent = (width * frames) / longest;
    context.fillStyle = css("--line");
    context.fillRect(0, height / 2 - 0.5, extent, 1);
    context.fillStyle = css("--accent");
    preview.forEach((level, i) => {
      const size = Math.max((level / 99) * height, 1);
      context.fillRect((i / preview.length) * extent, (height - size) / 2, Math.max(extent / preview.length - 0.5, 0.5), size);
    });
  });
}

async function open(position, frame = 0, play = player.wantsToPlay) {
  if (position < 0 || position >= dataset.episodes.length) return;
  wanted = position;
  const opened = await episodeOf(position);
  if (wanted !== position) return; // another one was chosen meanwhile
  episode = opened;
  axis = new TimeAxis(episode);
  panels = panelsOf(episode, axis, settings);
  byId("panels").replaceChildren(...panels.map((panel) => panel.element));
  showEpisodeHead();
  [...byId("episodes").children].forEach((button, i) => button.setAttribute("aria-selected", String(i === position)));
  byId("episodes").children[position].scrollIntoView({ block: "nearest" });
  drawPanels();
  await player.load(episode, frame, play);
  document.documentElement.dataset.episode = String(episode.index);
  document.documentElement.dataset.ready = "true";
}

function showEpisodeHead() {
  const seconds = episode.duration.toFixed(2);
  const facts = [["Length", `${seconds} s, ${episode.frames} frames`]];
  if (episode.success !== null) facts.push(["Success", episode.success < 0 ? "no" : `at ${(episode.success / fps).toFixed(2)} s`]);
  if (episode.interventions) {
    const frames = episode.interventions.reduce((sum, [first, last]) => sum + last - first + 1, 0);
    const share = frames / episode.frames;
    facts.push(["Expert acts", share === 1 ? "throughout" : share === 0 ? "never" : `${(100 * share).toFixed(0)} %, ${episode.interventions.length} span${episode.interventions.length > 1 ? "s" : ""}`]);
  }
  if (episode.microphones.length) facts.push(["Sudden sounds", String(episode.microphones.reduce((sum, m) => sum + m.onsets.length, 0))]);
  byId("episode-title").textContent = `Episode ${episode.index}`;
  byId("task").textContent = episode.task;
  byId("episode-facts").replaceChildren(...facts.map(([name, value]) => make("li", {}, make("span", {}, name), make("b", {}, value))));
  for (const line of byId("verdicts").children) line.classList.toggle("here", line.episodes.includes(episode.index));
  byId("screen").hidden = !dataset.cameras.length;
  const original = Object.values(dataset.facts.cameras).map((shape) => Math.max(...shape.filter((n) => n > 4)));
  byId("screen").classList.toggle("pixels", Math.max(...original) < 160);
  byId("cameras").replaceChildren(
    ...dataset.cameras.map((key, i) => {
      const label = make("span", {}, make("i", {}, shortName(key)));
      label.style.flex = `${episode.widths[i]} 0 0`;
      return label;
    }),
  );
}

function drawPanels() {
  axis.width = panels[0].canvas.clientWidth;
  panels.forEach((panel) => panel.draw());
  showTime(player.episode === episode ? player.frame / fps : 0);
}

function showTime(time) {
  if (!episode || player.episode !== episode) return;
  const frame = Math.min(Math.floor(time * fps + 1e-6), episode.frames - 1);
  byId("cursor").style.transform = `translateX(${axis.x(time)}px)`;
  byId("cursor").dataset.time = time.toFixed(4);
  byId("time").replaceChildren(`${time.toFixed(2)} / ${episode.duration.toFixed(2)} s`, make("small", {}, `frame ${frame} of ${episode.frames - 1}`));
  byId("play").classList.toggle("playing", player.playing);
  if (hovered === null) panels.forEach((panel) => panel.read(time));
}

function toggleScale(key) {
  const keys = typeof key === "string" ? [key] : Object.keys(settings.own);
  const own = !keys.some((one) => settings.own[one]);
  for (const one of keys) settings.own[one] = own;
  drawPanels();
}

function toggleTheme() {
  const root = document.documentElement;
  root.dataset.theme = root.dataset.theme === "dark" ? "light" : "dark";
  paintPreviews();
  if (episode) drawPanels();
}

function toggleChecks() {
  const hidden = byId("checks").toggleAttribute("hidden");
  byId("checks").parentElement.classList.toggle("plain", hidden);
}

function changeSpeed(by) {
  const select = byId("speed");
  select.selectedIndex = Math.min(Math.max(select.selectedIndex + by, 0), select.options.length - 1);
  select.onchange();
}

function toNextSound() {
  const times = episode.microphones.flatMap((m) => m.onsets).map((time) => Math.floor(time * fps + 1e-6)).sort((a, b) => a - b);
  const next = times.find((frame) => frame > player.frame) ?? times[0];
  if (next !== undefined) player.show(next);
}

const KEYS = {
  " ": () => player.toggle(),
  k: () => player.toggle(),
  ArrowLeft: (event) => player.show(player.frame - (event.shiftKey ? 10 : 1)),
  ArrowRight: (event) => player.show(player.frame + (event.shiftKey ? 10 : 1)),
  ArrowUp: () => open(wanted - 1),
  ArrowDown: () => open(wanted + 1),
  Home: () => player.show(0),
  End: () => player.show(episode.frames - 1),
  o: toNextSound,
  ",": () => changeSpeed(-1),
  ".": () => changeSpeed(1),
  m: () => (player.video.muted = !player.video.muted),
  l: () => (player.loop = !player.loop),
  s: () => toggleScale(),
  c: toggleChecks,
  t: toggleTheme,
  "?": () => byId("keys").showModal(),
};

document.addEventListener("keydown", (event) => {
  const action = KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (!action || !episode || event.ctrlKey || event.metaKey || event.altKey || byId("keys").open) return;
  event.preventDefault();
  action(event);
});

const timeAt = (event) => Math.min(Math.max(axis.time(event.clientX - byId("tracks").getBoundingClientRect().left), 0), episode.duration);

byId("panels").addEventListener("pointerdown", (event) => {
  if (event.target.tagName !== "CANVAS" || event.target.className) return;
  event.target.setPointerCapture(event.pointerId);
  player.seek(timeAt(event));
});
byId("panels").addEventListener("pointermove", (event) => {
  if (event.target.tagName !== "CANVAS" || event.target.className) return byId("panels").onpointerleave();
  if (event.buttons) player.seek(timeAt(event));
  hovered = timeAt(event);
  byId("hover").hidden = false;
  byId("hover").style.transform = `translateX(${axis.x(hovered)}px)`;
  const y = event.clientY - event.target.getBoundingClientRect().top;
  for (const panel of panels) panel.read(hovered, panel.canvas === event.target && panel.hertz ? panel.hertz(y) : undefined);
});
byId("panels").onpointerleave = () => {
  hovered = null;
  byId("hover").hidden = true;
  if (episode) showTime(player.frame / fps);
};

byId("play").onclick = () => player.toggle();
byId("verdict").onclick = toggleChecks;
byId("theme").onclick = toggleTheme;
byId("help").onclick = () => byId("keys").showModal();
byId("speed").onchange = () => (player.video.playbackRate = player.video.defaultPlaybackRate = Number(byId("speed").value));
byId("volume").oninput = () => (player.video.volume = Number(byId("volume").value));
for (const control of document.querySelectorAll("select, input")) control.addEventListener("change", () => control.blur());
document.addEventListener("click", (event) => event.detail && event.target.closest("button")?.blur()); // keys go to the player
new ResizeObserver(() => episode && panels[0].canvas.clientWidth !== axis.width && drawPanels()).observe(byId("timeline"));

document.documentElement.dataset.theme = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
const start = new URLSearchParams(location.hash.slice(1));
showHead();
showList();
open(Math.max(dataset.episodes.findIndex((head) => head.index === Number(start.get("episode") ?? -1)), 0), Number(start.get("frame") ?? 0), false);
