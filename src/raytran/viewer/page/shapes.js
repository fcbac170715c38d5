// SPDX-License-Identifier: Apache-2.0
// Boxes, outlines and cameras as things that three.js draws.

import {
  BoxGeometry, BufferAttribute, BufferGeometry, InstancedMesh, LineBasicMaterial, LineSegments, Matrix4, Mesh, MeshBasicMaterial,
  PlaneGeometry, Quaternion, Vector3,
} from "./vendor/three.js";
import { EDGES, colorOf, corners } from "./data.js";

const EDGE_WIDTH = 0.01;
const FRONT_WIDTH = 0.024;
const CAMERA_SIZE = 0.05;
const BAR = new BoxGeometry(1, 1, 1);

/** The camera's place in the world. */
export const positionOf = ({ world_from_camera }) => [0, 1, 2].map((row) => world_from_camera[row][3]);

export const matrixOf = (rows) => new Matrix4().set(...rows.flat());
export const highest = (box) => Math.max(...corners(box).map((corner) => corner[2]));

/** The edges of a box as bars, those of its front thicker. */
export function boxBars(box, color, width = null) {
  const bars = new InstancedMesh(BAR, new MeshBasicMaterial({ color }), EDGES.length);
  const points = corners(box).map((corner) => new Vector3(...corner));
  const along = new Vector3();
  EDGES.forEach(([from, to, front], index) => {
    along.subVectors(points[to], points[from]);
    const thick = width ?? (front ? FRONT_WIDTH : EDGE_WIDTH);
    const turn = new Quaternion().setFromUnitVectors(new Vector3(1, 0, 0), along.clone().normalize());
    const middle = points[from].clone().addScaledVector(along, 0.5);
    bars.setMatrixAt(index, new Matrix4().compose(middle, turn, new Vector3(along.length() + thick, thick, thick)));
  });
  return bars;
}

/** A true box: thin lines, dashed by hand so that they look the same at any distance. */
export function outline(box) {
  const points = corners(box);
  const dashes = EDGES.flatMap(([from, to]) => {
    const at = (share) => points[from].map((value, axis) => value + share * (points[to][axis] - value));
    const length = Math.hypot(...points[from].map((value, axis) => points[to][axis] - value));
    const count = Math.max(Math.round(length / 0.08), 1);
    return Array.from({ length: count }, (_, n) => [at(n / count), at((n + 0.6) / count)]).flat();
  });
  return segments(dashes, new LineBasicMaterial({ color: colorOf(box.category) }));
}

export function segments(points, material) {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(new Float32Array(points.flat()), 3));
  return new LineSegments(geometry, material);
}

/** Ends of the eight lines of a camera's pyramid. */
export function frustumLines({ intrinsics, world_from_camera: pose }, height, width, depth) {
  const [[fx, , cx], [, fy, cy]] = intrinsics;
  const rim = [[0, 0], [width, 0], [width, height], [0, height]].map(([u, v]) => {
    const ray = [((u - cx) / fx) * depth, ((v - cy) / fy) * depth, depth];
    return pose.slice(0, 3).map((row) => row[0] * ray[0] + row[1] * ray[1] + row[2] * ray[2] + row[3]);
  });
  const eye = positionOf({ world_from_camera: pose });
  return rim.flatMap((corner, index) => [eye, corner, corner, rim[(index + 1) % 4]]);
}

/** A little cube where each camera stands; its instances are the frames. */
export function cameraCubes(frames) {
  const cubes = new InstancedMesh(BAR, new MeshBasicMaterial({ color: 0x5b6676 }), frames.length);
  frames.forEach((frame, index) => {
    const matrix = new Matrix4().makeScale(CAMERA_SIZE, CAMERA_SIZE, CAMERA_SIZE);
    cubes.setMatrixAt(index, matrix.setPosition(...positionOf(frame)));
  });
  return cubes;
}

/** The picture of a frame as its camera would see it at some depth, in the world. */
export function picturePlane(frame, [height, width], depth, texture) {
  const [[fx, , cx], [, fy, cy]] = frame.intrinsics;
  const plane = new Mesh(new PlaneGeometry(width / fx, height / fy), new MeshBasicMaterial({ map: texture, side: 2 }));
  plane.scale.set(depth, -depth, depth);
  plane.position.set((width / 2 - cx) / fx, (height / 2 - cy) / fy, 1).multiplyScalar(depth);
  plane.updateMatrix();
  plane.applyMatrix4(matrixOf(frame.world_from_camera));
  return plane;
}
