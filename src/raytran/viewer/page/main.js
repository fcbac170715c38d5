// SPDX-License-Identifier: Apache-2.0
// The page: what is shown where, and what happens when one clicks.

import { flatIndex, ownerOf, readScene, readsOf, voxelAt, voxelCenter } from "./data.js";
import { FramePanel } from "./frame.js";
import { Objects } from "./objects.js";
import { World } from "./world.js";
import { Vector3 } from "./vendor/three.js";

const element = (id) => document.getElementById(id);
const LAYERS = ["meshes", "boxes", "labels", "cameras", "truth", "voxels"];
const state = { data: null, frame: 0, object: null, reads: null, volume: null };

globalThis.addEventListener("error", ({ message }) => say(message, true));

const world = new World(element("canvas"), element("labels"), (hit, wantsVoxel) => {
  if (wantsVoxel) return selectVoxel(hit?.point);
  if (!hit) return selectObject(null);
  if (hit.frame !== undefined) return selectFrame(hit.frame);
  return hit.object === undefined ? selectVoxel(hit.point) : selectObject(hit.object);
});
const panel = new FramePanel(element("frame"), ({ origin, direction }) => {
  const ray = { origin: new Vector3(...origin), direction: new Vector3(...direction).normalize() };
  selectVoxel(world.castToVoxel(ray)?.point);
});
const objects = new Objects(element("columns"), element("objects"), element("details"), (index) => selectObject(index));

let opened = 0;

async function open(number) {
  const turn = ++opened;
  const started = turn > 1 ? performance.now() : 0; // the first time counts from the click that led here
  say("loading…");
  delete document.documentElement.dataset.ready;
  try {
    const data = await readScene(number);
    if (turn !== opened) return; // another was chosen meanwhile
    Object.assign(state, { data, frame: 0, object: null, reads: null, volume: null });
    element("title").textContent = document.title = data.id || "raytran";
    for (const part of document.querySelectorAll("[data-needs]")) part.hidden = !has(data, part.dataset.needs);
    setUpSliders(data);
    objects.show(data);
    fillStrip(data);
    world.show(data);
    applyVoxels();
    applySwitches();
    applyScore();
    if (data.frames.length) selectFrame(0);
    const trouble = await world.addMeshes();
    if (turn !== opened) return;
    applyScore();
    await world.drawn();
    const missing = data.frames.length ? "" : "frames and voxels are not in this folder: predict again with viewer=true";
    say(trouble ?? missing, Boolean(trouble));
    document.documentElement.dataset.ready = String(Math.round(performance.now() - started));
  } catch (error) {
    say(error.message, true);
    throw error;
  }
}

function has(data, what) {
  const known = {
    truth: data.truth !== null,
    frames: data.frames.length > 0,
    voxels: data.volumes.some((volume) => volume.occupancy),
    reads: data.volumes.some((volume) => volume.reads),
  };
  return known[what];
}

function say(text, bad = false) {
  element("status").textContent = text;
  element("status").classList.toggle("bad", bad);
}

function setUpSliders(data) {
  const scores = data.objects.map((object) => object.score);
  const slider = element("score");
  slider.min = scores.length ? String(Math.floor(Math.min(...scores) * 100) / 100) : "0";
  slider.value = slider.min;
}

function fillStrip(data) {
  element("strip").replaceChildren(
    ...data.frames.map((frame) => {
      const button = document.createElement("button");
      const image = new Image();
      image.loading = "lazy";
      image.alt = `frame ${frame.name}`;
      image.width = Math.round((62 * data.imageSize[1]) / data.imageSize[0]);
      image.height = 62;
      image.src = frame.url;
      button.title = frame.name;
      button.append(image, document.createElement("i"));
      button.addEventListener("click", () => selectFrame(frame.index));
      return button;
    }),
  );
}

function applySwitches() {
  const shown = Object.fromEntries(LAYERS.map((name) => [name, element(`show-${name}`).checked]));
  world.setShown(shown);
  refreshOverlay();
}

function applyScore() {
  const least = Number(element("score").value);
  element("score-value").textContent = least.toFixed(2);
  world.setScore(least);
  const { shown, found } = objects.setScore(least);
  element("count").textContent = `${shown} of ${state.data.objects.length}`;
  if (state.data.truth) element("found").textContent = sayFound(state.data.truth, found);
  refreshOverlay();
}

function sayFound(truth, found) {
  const missed = truth.filter((_, index) => !found.has(index)).map((object) => object.category);
  const text = `${found.size} of ${truth.length} true objects found within 20 cm, 20° and 20 % of size`;
  if (!missed.length) return `${text}.`;
  const counts = [...new Set(missed)].map((name) => [missed.filter((other) => other === name).length, name]);
  return `${text}; missed: ${counts.map(([count, name]) => (count > 1 ? `${count} × ${name}` : name)).join(", ")}.`;
}

function applyVoxels() {
  element("occupancy-value").textContent = Number(element("occupancy").value).toFixed(2);
  world.setVoxels(Number(element("occupancy").value), element("voxel-color").value);
}

function refreshOverlay() {
  const least = Number(element("score").value);
  const boxes = element("show-boxes").checked ? state.data.objects.filter((object) => object.score >= least) : [];
  panel.setOverlay({
    objects: boxes,
    truth: element("show-truth").checked ? (state.data.truth ?? []) : [],
    selected: state.object,
    reads: state.reads,
    featureSize: state.volume?.reads?.feature_size,
  });
}

function selectObject(index) {
  state.object = index;
  objects.select(index);
  world.selectObject(index);
  refreshOverlay();
}

function selectFrame(index) {
  const { frames, imageSize } = state.data;
  if (!frames.length) return;
  state.frame = (index + frames.length) % frames.length;
  const frame = frames[state.frame];
  element("frame-name").textContent = `${frame.name}, ${state.frame + 1} of ${frames.length}`;
  const buttons = [...element("strip").children];
  buttons.forEach((button, number) => button.classList.toggle("selected", number === state.frame));
  buttons[state.frame].scrollIntoView({ block: "nearest", inline: "nearest" });
  panel.show(frame, imageSize);
  world.selectFrame(frame, imageSize);
}

async function selectVoxel(point) {
  const volume = point && ownerOf(state.data.volumes.filter((some) => some.reads), point);
  if (!volume) {
    element("voxel").textContent = "There is no mesh and no occupied voxel: lower the threshold of voxels, or choose another place.";
    return;
  }
  const index = voxelAt(volume, point);
  const flat = flatIndex(volume, index);
  const reads = await readsOf(volume, flat);
  Object.assign(state, { reads, volume });
  const shares = sharesByFrame(reads);
  const size = volume.extent.map((length, axis) => length / volume.resolution[axis]);
  world.selectVoxel(voxelCenter(volume, index), size, shares);
  markStrip(shares);
  element("voxel").textContent = describe(volume, index, reads, shares);
  if (shares.length) selectFrame(shares[0].frame);
  refreshOverlay();
}

/** The share of each frame in what a voxel read, the largest first. */
function sharesByFrame(reads) {
  const sums = new Map();
  for (const { frame, weight } of reads) sums.set(frame, (sums.get(frame) ?? 0) + weight);
  return [...sums].map(([frame, share]) => ({ frame, share })).sort((a, b) => b.share - a.share);
}

function markStrip(shares) {
  const most = shares[0]?.share ?? 1;
  for (const bar of element("strip").querySelectorAll("i")) bar.style.width = "0";
  for (const { frame, share } of shares) {
    element("strip").children[frame].querySelector("i").style.width = `${Math.max((100 * share) / most, 6)}%`;
  }
}

function describe(volume, index, reads, shares) {
  const shown = ownerOf(state.data.volumes.filter((some) => some.occupancy), voxelCenter(volume, index));
  const at = shown && flatIndex(shown, voxelAt(shown, voxelCenter(volume, index)));
  const occupied = shown ? `, occupied ${(shown.occupancy[at] / 255).toFixed(2)}` : "";
  const seen = shown?.seen ? `, seen by ${shown.seen[at]} of ${shown.frames.length} views` : "";
  const where = `Voxel (${index.join(", ")})${occupied}${seen}. `;
  if (!reads.length) return `${where}No ray meets it: it read nothing.`;
  const { frame, share } = shares[0];
  const name = state.data.frames[frame].name;
  const least = volume.reads.cut > 1.5 / 255 ? `; pixels below ${Math.round(100 * volume.reads.cut)} % of its strongest are not kept` : "";
  return `${where}It read ${reads.length} pixels of ${shares.length} ${shares.length === 1 ? "frame" : "frames"}, most of frame ${name} (${Math.round(100 * share)} %)${least}.`;
}

for (const name of LAYERS) element(`show-${name}`).addEventListener("change", applySwitches);
element("score").addEventListener("input", applyScore);
element("occupancy").addEventListener("input", applyVoxels);
element("voxel-color").addEventListener("change", applyVoxels);
element("previous").addEventListener("click", () => selectFrame(state.frame - 1));
element("next").addEventListener("click", () => selectFrame(state.frame + 1));
element("fly").addEventListener("click", () => world.fly());
element("home").addEventListener("click", () => world.home());
element("scenes").addEventListener("change", (event) => open(Number(event.target.value)));
document.addEventListener("keydown", (event) => {
  if (/INPUT|SELECT/.test(event.target.tagName) || !state.data) return;
  if (event.key === "ArrowLeft") selectFrame(state.frame - 1);
  if (event.key === "ArrowRight") selectFrame(state.frame + 1);
});

const names = await (await fetch("scenes.json")).json();
element("scenes-label").hidden = names.length < 2;
element("scenes").replaceChildren(...names.map((name, number) => new Option(name, String(number))));
globalThis.raytran = { world, state, open, pickVoxel: selectVoxel }; // for the console, and for tests
await open(0);
