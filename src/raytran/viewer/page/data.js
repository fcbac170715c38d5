// SPDX-License-Identifier: Apache-2.0
// What a scene's folder holds, read and put into the shapes that the page works with.

// As CLASS_COLORS in types.py; a test compares them.
export const CLASS_COLORS = {
  bathtub: "#17becf",
  bookshelf: "#8c564b",
  cabinet: "#ff7f0e",
  chair: "#1f77b4",
  display: "#9467bd",
  sofa: "#d62728",
  table: "#2ca02c",
  trashbin: "#e377c2",
  other: "#7f7f7f",
};

const SCENE_FORMAT = "raytran.scene/1";
const MOST_NUMBERS = 16_000_000;
const VIEW_FORMAT = "raytran.view/1";

export const colorOf = (category) => CLASS_COLORS[category] ?? CLASS_COLORS.other;

/** Read a scene: {base, id, objects, frames, imageSize, volumes, truth}; frames and volumes may be none. */
export async function readScene(number) {
  const base = `scenes/${number}/`;
  const scene = await readJson(`${base}scene.json`, true);
  if (scene.format !== SCENE_FORMAT) throw new Error(`scene.json has format ${scene.format}, expected ${SCENE_FORMAT}`);
  const view = await readJson(`${base}view/view.json`, false);
  if (view && view.format !== VIEW_FORMAT) throw new Error(`view.json has format ${view.format}, expected ${VIEW_FORMAT}`);
  const errors = view?.errors ?? null;
  const objects = scene.objects.map((object, index) => ({ ...object, index, error: errors?.[index] ?? null }));
  return {
    base,
    id: scene.scene_id,
    objects,
    truth: view?.truth ?? null,
    frames: (view?.frames ?? []).map((frame, index) => ({ ...frame, index, url: `${base}view/${frame.image}` })),
    imageSize: view?.image_size ?? [1, 1],
    volumes: await Promise.all((view?.volumes ?? []).map((volume) => readVolume(`${base}view/`, volume))),
  };
}

async function readVolume(base, volume) {
  const count = volume.resolution[0] * volume.resolution[1] * volume.resolution[2];
  if (!(count <= MOST_NUMBERS)) throw new Error("view.json tells of more voxels than a page can show");
  const [occupancy, seen] = await Promise.all([
    volume.occupancy && readArray(base + volume.occupancy, Uint8Array, count),
    volume.seen && readArray(base + volume.seen, Int16Array, count),
  ]);
  return { ...volume, base, occupancy, seen, packed: null };
}

/** Pixels that a voxel read: [{frame, row, column, weight}], weights adding up to 1; [] for one that no ray meets. */
export async function readsOf(volume, voxel) {
  const { reads, base } = volume;
  volume.packed ??= Promise.all([
    readArray(base + reads.offsets, Int32Array),
    readArray(base + reads.steps, Int32Array),
    readArray(base + reads.weights, Uint8Array),
  ]);
  const [offsets, steps, weights] = await volume.packed;
  const [height, width] = reads.feature_size;
  const found = [];
  let pixel = 0;
  let total = 0;
  for (let place = offsets[voxel]; place < offsets[voxel + 1]; place += 1) {
    pixel += steps[place];
    total += weights[place];
    const cell = pixel % (height * width);
    found.push({
      frame: volume.frames[Math.floor(pixel / (height * width))],
      row: Math.floor(cell / width),
      column: cell % width,
      weight: weights[place],
    });
  }
  for (const read of found) read.weight /= total;
  return found;
}

/** Voxel of a volume at a point in the world as [x, y, z], or null outside. */
export function voxelAt(volume, point) {
  const index = point.map((value, axis) => {
    const lower = volume.center[axis] - volume.extent[axis] / 2;
    return Math.floor(((value - lower) / volume.extent[axis]) * volume.resolution[axis]);
  });
  return index.every((value, axis) => value >= 0 && value < volume.resolution[axis]) ? index : null;
}

/** Of the volumes that hold a point the one whose middle is nearest, or undefined. */
export function ownerOf(volumes, point) {
  const distance = (volume) => Math.hypot(...point.map((value, axis) => (value - volume.center[axis]) / volume.extent[axis]));
  return volumes.filter((volume) => voxelAt(volume, point)).sort((a, b) => distance(a) - distance(b))[0];
}

export const flatIndex = (volume, [x, y, z]) => (x * volume.resolution[1] + y) * volume.resolution[2] + z;

export function unflatten(volume, flat) {
  const [, height, depth] = volume.resolution;
  return [Math.floor(flat / (height * depth)), Math.floor(flat / depth) % height, flat % depth];
}

/** Centre of a voxel in the world. */
export function voxelCenter(volume, index) {
  return index.map((value, axis) => {
    const size = volume.extent[axis] / volume.resolution[axis];
    return volume.center[axis] - volume.extent[axis] / 2 + (value + 0.5) * size;
  });
}

/** The eight corners of a box: signs of x, y, z count in binary, z fastest (CONVENTIONS.md). */
export function corners({ center, size, rotation }) {
  return Array.from({ length: 8 }, (_, corner) => {
    const local = [4, 2, 1].map((bit, axis) => ((corner & bit ? 0.5 : -0.5) * size[axis]));
    return rotation.map((row, axis) => center[axis] + row[0] * local[0] + row[1] * local[1] + row[2] * local[2]);
  });
}

/** Pairs of corners that an edge joins, and whether it belongs to the front face (-z). */
export const EDGES = [0, 1, 2, 3, 4, 5, 6, 7].flatMap((corner) =>
  [4, 2, 1].filter((bit) => !(corner & bit)).map((bit) => [corner, corner | bit, !(corner & 1) && bit !== 1]),
);

async function readJson(url, needed) {
  const response = await fetch(url);
  if (response.status === 404 && !needed) return null;
  if (!response.ok) throw new Error(`cannot read ${url} (${response.status})`);
  return response.json();
}

/** A gzipped array of `count` numbers, or of at most MOST_NUMBERS if that is not known. */
async function readArray(url, Type, count = null) {
  const response = await fetch(url);
  if (!response.ok) throw new Error(`cannot read ${url} (${response.status})`);
  const most = (count ?? MOST_NUMBERS) * Type.BYTES_PER_ELEMENT;
  const parts = [];
  let length = 0;
  const reader = response.body.pipeThrough(new DecompressionStream("gzip")).getReader();
  for (let part = await reader.read(); !part.done && length <= most; part = await reader.read()) {
    length += part.value.length;
    parts.push(part.value);
  }
  if (length > most) reader.cancel();
  if (length > most || (count !== null && length !== most)) throw new Error(`${url} is not as long as view.json says: predict again`);
  return new Type(await new Blob(parts).arrayBuffer());
}
