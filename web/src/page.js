// The page: `?src=ADDRESS` opens a stream, a sequence or a file of Gaussians, `?heads=ADDRESS` is a model file of learned heads.

import { Controls } from "./controls.js";
import { Viewer } from "./viewer.js";

const parameters = new URLSearchParams(location.search);
const canvas = document.querySelector("canvas");
const [state, time, files, heads] = ["state", "time", "files", "heads"].map((id) => document.getElementById(id));

// `b2p serve` tells which files there are, and where learned heads are.
const listed = await list();
const model = parameters.get("heads") ?? listed.heads;
const viewer = new Viewer(canvas, { heads: model });
const controls = new Controls(viewer);
let source = null;
let milliseconds = 0;

heads.parentElement.hidden = !model;

async function list() {
  const response = await fetch("./streams.json").catch(() => null);
  return response?.ok ? response.json() : { streams: [], heads: null };
}

/** Tells what the page does: it is `ready` for a file, `busy`, shows a `level` or a `frame`, or has met an `error`. */
function say(text, what) {
  state.textContent = text;
  state.classList.toggle("error", what === "error");
  document.body.dataset.state = what;
}

async function open(next) {
  source = next;
  milliseconds = 0;
  delete document.body.dataset.done;
  controls.hide();
  say("Loading …", "busy");
  try {
    const level = await viewer.open(source, { heads: model ? heads.value : "surfels" });
    document.body.dataset.done = level ?? "Gaussians";
  } catch (error) {
    if (error.name !== "AbortError") say(error.message, "error");
  }
}

const counted = (count) => `${count.toLocaleString("en").replaceAll(",", " ")} Gaussians`;

viewer.addEventListener("level", ({ detail }) => {
  milliseconds += detail.milliseconds;
  const count = counted(detail.count);
  const took = `${milliseconds.toFixed(0)} ms`;
  say(detail.level === null ? `${count}, read in ${took}` : `Level ${detail.level}: ${count}, decoded in ${took}`, "level");
});
viewer.addEventListener("frame", ({ detail: { number, level, heads, count, dropped } }) => {
  document.body.dataset.frame = number;
  say(`Frame ${number}: level ${level}, ${heads}, ${counted(count)}${dropped ? `; ${dropped} dropped` : ""}`, "frame");
});
viewer.addEventListener("skipped", ({ detail: { number, message } }) => {
  say(`Frame ${number} is skipped with those that are predicted from it: ${message}`, "error");
});
viewer.addEventListener("failure", ({ detail }) => say(detail.message, "error"));
viewer.addEventListener("picture", ({ detail }) => {
  time.textContent = `drawn in ${detail.milliseconds.toFixed(0)} ms`;
  document.body.dataset.pictures = Number(document.body.dataset.pictures ?? 0) + 1;
});

function resize() {
  canvas.width = Math.round(canvas.clientWidth * devicePixelRatio);
  canvas.height = Math.round(canvas.clientHeight * devicePixelRatio);
  viewer.draw();
}
addEventListener("resize", resize);
resize();

document.getElementById("file").addEventListener("change", ({ target }) => target.files[0] && open(target.files[0]));
heads.addEventListener("change", () => source && open(source));
addEventListener("dragover", (event) => event.preventDefault());
addEventListener("drop", (event) => {
  event.preventDefault();
  if (event.dataTransfer.files[0]) open(event.dataTransfer.files[0]);
});
addEventListener("keydown", (event) => {
  if (event.key === "r") viewer.reset();
  else if (!event.target.closest("input, select, button")) controls.press(event);
});

for (const name of listed.streams) files.add(new Option(name, name));
files.hidden = listed.streams.length < 2;
files.addEventListener("change", () => open(encodeURIComponent(files.value)));
const first = parameters.get("src") ?? listed.streams[0];
if (first) open(parameters.has("src") ? first : encodeURIComponent(first));
else say("Drop a stream, a sequence or a file of Gaussians here.", "ready");
