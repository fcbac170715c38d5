// SPDX-License-Identifier: Apache-2.0
// One frame with the boxes drawn over it, and the cells that a voxel read.

import { EDGES, colorOf, corners } from "./data.js";

const NEAR = 0.05;

export class FramePanel {
  /** canvas: where to draw; onPick(ray {origin, direction}, camera coordinates of the frame's pixel). */
  constructor(canvas, onPick) {
    this.canvas = canvas;
    this.pen = canvas.getContext("2d");
    this.image = new Image();
    this.image.addEventListener("load", () => this.draw());
    canvas.addEventListener("click", (event) => {
      if (!this.frame) return;
      const area = canvas.getBoundingClientRect();
      const u = ((event.clientX - area.left) / area.width) * this.size[1];
      const v = ((event.clientY - area.top) / area.height) * this.size[0];
      onPick(this.#ray(u, v));
    });
  }

  /** Show a frame of images of size [H, W]. */
  show(frame, size) {
    this.frame = frame;
    this.size = size;
    this.canvas.height = Math.round((this.canvas.width * size[0]) / size[1]);
    this.image.src = frame.url;
    this.draw();
  }

  /** What to draw over it: objects, true ones, reads ([{frame, row, column, weight}] or null), feature size [h, w]. */
  setOverlay(overlay) {
    this.overlay = overlay;
    this.draw();
  }

  draw() {
    const { pen, canvas, frame, overlay } = this;
    if (!frame) return;
    pen.clearRect(0, 0, canvas.width, canvas.height);
    if (this.image.complete && this.image.naturalWidth) pen.drawImage(this.image, 0, 0, canvas.width, canvas.height);
    if (!overlay) return;
    if (overlay.reads) this.#drawReads(overlay);
    for (const truth of overlay.truth) this.#drawBox(truth, [5, 4], 1.5);
    for (const object of overlay.objects) this.#drawBox(object, [], object.index === overlay.selected ? 4 : 2);
  }

  #drawReads({ reads, featureSize: [height, width] }) {
    const here = reads.filter((read) => read.frame === this.frame.index);
    const { pen, canvas } = this;
    pen.fillStyle = "rgba(0, 0, 0, .55)";
    pen.fillRect(0, 0, canvas.width, canvas.height);
    const most = Math.max(...reads.map((read) => read.weight));
    const [w, h] = [canvas.width / width, canvas.height / height];
    for (const { row, column, weight } of here) {
      pen.save();
      pen.beginPath();
      pen.rect(column * w, row * h, w, h);
      pen.clip();
      pen.drawImage(this.image, 0, 0, canvas.width, canvas.height);
      pen.restore();
      pen.fillStyle = `rgba(255, 176, 0, ${0.15 + 0.75 * (weight / most)})`;
      pen.fillRect(column * w, row * h, w, h);
    }
  }

  #drawBox(box, dash, thick) {
    const { pen } = this;
    const points = corners(box).map((corner) => this.#inCamera(corner));
    pen.strokeStyle = colorOf(box.category);
    pen.setLineDash(dash);
    for (const [from, to, front] of EDGES) {
      const line = clip(points[from], points[to]);
      if (!line) continue;
      pen.lineWidth = dash.length ? thick : thick * (front ? 1.8 : 1);
      pen.beginPath();
      for (const point of line) pen.lineTo(...this.#onCanvas(point));
      pen.stroke();
    }
    pen.setLineDash([]);
  }

  #inCamera(point) {
    const pose = this.frame.world_from_camera;
    const from = point.map((value, axis) => value - pose[axis][3]);
    return [0, 1, 2].map((column) => from.reduce((sum, value, row) => sum + value * pose[row][column], 0));
  }

  #onCanvas([x, y, z]) {
    const [[fx, skew, cx], [, fy, cy]] = this.frame.intrinsics;
    const scale = this.canvas.width / this.size[1];
    return [((fx * x + skew * y) / z + cx) * scale, ((fy * y) / z + cy) * scale];
  }

  #ray(u, v) {
    const [[fx, , cx], [, fy, cy]] = this.frame.intrinsics;
    const pose = this.frame.world_from_camera;
    const ray = [(u - cx) / fx, (v - cy) / fy, 1];
    return {
      origin: [0, 1, 2].map((row) => pose[row][3]),
      direction: [0, 1, 2].map((row) => pose[row][0] * ray[0] + pose[row][1] * ray[1] + pose[row][2] * ray[2]),
    };
  }
}

/** The part of a line before the camera, or null. */
function clip(from, to) {
  if (from[2] < NEAR && to[2] < NEAR) return null;
  const cut = (near, far) => {
    const share = (NEAR - near[2]) / (far[2] - near[2]);
    return near.map((value, axis) => value + share * (far[axis] - value));
  };
  return [from[2] < NEAR ? cut(from, to) : from, to[2] < NEAR ? cut(to, from) : to];
}
