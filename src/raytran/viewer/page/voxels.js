// SPDX-License-Identifier: Apache-2.0
// The voxels of a volume that are likely to be occupied, as little cubes.

import { BoxGeometry, Color, InstancedMesh, Matrix4, MeshLambertMaterial } from "./vendor/three.js";
import { flatIndex, unflatten, voxelAt, voxelCenter } from "./data.js";

const MOST = 60000;
const FILL = 0.86;
const REACH = 30;
const NEVER_SEEN = new Color("#c0392b");

export class Voxels {
  constructor(volume) {
    this.volume = volume;
    const size = volume.extent.map((length, axis) => (FILL * length) / volume.resolution[axis]);
    this.mesh = new InstancedMesh(new BoxGeometry(...size), new MeshLambertMaterial(), Math.min(volume.occupancy.length, MOST));
    this.mesh.userData = {};
    this.update(0.5, "occupancy");
  }

  /** Show the voxels of at least this probability, coloured by it or by how many views saw them. */
  update(threshold, colorBy) {
    const { occupancy, seen } = this.volume;
    this.least = threshold * 255;
    const most = seen ? seen.reduce((a, b) => Math.max(a, b), 1) : 1;
    const color = new Color();
    let count = 0;
    for (let flat = 0; flat < occupancy.length && count < MOST; flat += 1) {
      if (occupancy[flat] < this.least) continue;
      const center = voxelCenter(this.volume, unflatten(this.volume, flat));
      this.mesh.setMatrixAt(count, new Matrix4().setPosition(...center));
      if (colorBy === "seen" && seen) {
        if (seen[flat]) color.setHSL(0.58 - 0.42 * (seen[flat] / most), 0.75, 0.5);
        else color.copy(NEVER_SEEN);
      } else {
        color.setHSL(0.6, 0.25, 0.85 - 0.55 * (occupancy[flat] / 255));
      }
      this.mesh.setColorAt(count, color);
      count += 1;
    }
    this.mesh.count = count;
    this.mesh.instanceMatrix.needsUpdate = true;
    if (this.mesh.instanceColor) this.mesh.instanceColor.needsUpdate = true;
    this.mesh.computeBoundingSphere();
  }

  /** The first point of a ray, in steps of a third of a voxel, that lies in a voxel of at least the probability shown. */
  firstOccupied(ray) {
    const { volume } = this;
    const step = Math.min(...volume.extent.map((length, axis) => length / volume.resolution[axis])) / 3;
    const point = ray.origin.clone();
    for (let along = 0; along < REACH; along += step) {
      point.addScaledVector(ray.direction, step);
      const index = voxelAt(volume, point.toArray());
      if (index && volume.occupancy[flatIndex(volume, index)] >= this.least) return point;
    }
    return null;
  }
}
