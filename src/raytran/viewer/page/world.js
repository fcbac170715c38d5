// SPDX-License-Identifier: Apache-2.0
// The scene in three dimensions: +z up, metres, drawn only when something changed.

import {
  Box3, Color, DirectionalLight, Group, HemisphereLight, LineBasicMaterial, OrbitControls, PerspectiveCamera, Raycaster, Scene,
  SRGBColorSpace, TextureLoader, Vector2, Vector3, WebGLRenderer,
} from "./vendor/three.js";
import { colorOf, corners } from "./data.js";
import { readMeshes } from "./meshes.js";
import { intersections } from "./picking.js";
import { boxBars, cameraCubes, frustumLines, highest, outline, picturePlane, positionOf, segments } from "./shapes.js";
import { Voxels } from "./voxels.js";
import { contextOf } from "./webgl.js";

const IMAGE_DEPTH = 0.4;
const BACKDROP_DEPTH = 15;
const FIELD_OF_VIEW = 0.87;
const FRUSTUM_DEPTH = 0.16;
const CHOSEN = 0xffb000;
const LAYERS = ["meshes", "boxes", "truth", "cameras", "picture", "voxels", "chosen"];

export class World {
  /** canvas: where to draw; labels: element over it for names; onPick({object | frame | point}). */
  constructor(canvas, labels, onPick) {
    this.canvas = canvas;
    this.labels = labels;
    this.onPick = onPick;
    this.renderer = new WebGLRenderer({ canvas, context: contextOf(canvas) });
    this.camera = new PerspectiveCamera(50, 1, 0.02, 500);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => this.redraw());
    this.controls.addEventListener("start", () => this.#leaveBackdrop());
    this.headlight = new DirectionalLight(0xffffff, 1.6);
    this.pending = false;
    new ResizeObserver(() => this.#resize()).observe(canvas.parentElement);
    this.#listen();
    this.clear();
  }

  clear() {
    this.scene = new Scene();
    this.scene.add(new HemisphereLight(0xffffff, 0x8890a0, 1.7), this.headlight, this.headlight.target);
    this.layers = Object.fromEntries(LAYERS.map((name) => [name, new Group()]));
    this.scene.add(...Object.values(this.layers));
    this.labels.replaceChildren();
    this.objects = [];
    this.voxels = [];
    this.frames = null;
    this.shown = null;
    this.backdrop = false;
    this.wanted = {};
  }

  /** Show a scene as data.js read it, its meshes later. */
  show(data) {
    this.clear();
    this.data = data;
    for (const object of data.objects) this.#addObject(object);
    for (const truth of data.truth ?? []) this.layers.truth.add(outline(truth));
    this.#addCameras(data.frames, data.imageSize);
    this.voxels = data.volumes.filter((volume) => volume.occupancy).map((volume) => new Voxels(volume));
    this.layers.voxels.add(...this.voxels.map((voxels) => voxels.mesh));
    this.home();
  }

  /** Add the objects' meshes; resolves to a sentence if they could not be read, else to null. */
  async addMeshes() {
    const { data, layers } = this;
    try {
      const meshes = await readMeshes(`${data.base}scene.glb`);
      if (data !== this.data) return null;
      for (const [index, mesh] of meshes) {
        const object = this.objects[index];
        if (!object) continue;
        mesh.material.color.set(colorOf(object.data.category));
        mesh.traverse((part) => { part.userData = { object: index }; });
        object.mesh = mesh;
        layers.meshes.add(mesh);
      }
    } catch (error) {
      return `no meshes: ${error.message}`;
    }
    this.redraw();
    return null;
  }

  #addObject(data) {
    const box = boxBars(data, colorOf(data.category));
    box.userData = { object: data.index };
    const label = document.createElement("span");
    label.textContent = `${data.category} ${data.score.toFixed(2)}`;
    label.style.background = colorOf(data.category);
    label.style.color = readableOn(colorOf(data.category));
    this.labels.append(label);
    this.layers.boxes.add(box);
    this.objects.push({ data, box, label, mesh: null, top: new Vector3(...data.center).setZ(highest(data)) });
  }

  #addCameras(frames, [height, width]) {
    if (!frames.length) return;
    const lines = frames.flatMap((frame) => frustumLines(frame, height, width, FRUSTUM_DEPTH));
    this.layers.cameras.add(segments(lines, new LineBasicMaterial({ color: 0x8a94a3 })));
    this.frames = cameraCubes(frames);
    this.layers.cameras.add(this.frames);
  }

  /** Show some layers: {meshes, boxes, labels, truth, cameras, voxels}, true or false. */
  setShown(shown) {
    this.wanted = shown;
    for (const name of ["meshes", "boxes", "truth", "voxels"]) this.layers[name].visible = shown[name];
    this.layers.cameras.visible = shown.cameras && !this.backdrop;
    this.layers.picture.visible = shown.cameras || this.backdrop;
    this.labels.hidden = !shown.labels;
    this.redraw();
  }

  setScore(least) {
    for (const { data, box, mesh, label } of this.objects) {
      const visible = data.score >= least;
      box.visible = visible;
      if (mesh) mesh.visible = visible;
      label.hidden = !visible;
    }
    this.redraw();
  }

  setVoxels(threshold, colorBy) {
    for (const voxels of this.voxels) voxels.update(threshold, colorBy);
    this.redraw();
  }

  /** Mark an object: its box is drawn in the ink of the page; null marks none. */
  selectObject(index) {
    for (const { data, box } of this.objects) {
      box.material.color.set(data.index === index ? this.#ink() : colorOf(data.category));
    }
    this.redraw();
  }

  /** Put the picture of a frame where its camera saw it. */
  selectFrame(frame, size) {
    const texture = new TextureLoader().load(frame.url, () => this.redraw());
    texture.colorSpace = SRGBColorSpace;
    this.shown = { frame, size, texture };
    this.#placePicture(IMAGE_DEPTH);
  }

  #placePicture(depth) {
    const { frame, size, texture } = this.shown;
    const rim = segments(frustumLines(frame, ...size, depth), new LineBasicMaterial({ color: CHOSEN }));
    this.layers.picture.clear();
    this.layers.picture.add(picturePlane(frame, size, depth, texture), rim);
    this.backdrop = depth === BACKDROP_DEPTH;
    this.layers.cameras.visible = this.wanted.cameras && !this.backdrop;
    this.layers.picture.visible = this.wanted.cameras || this.backdrop;
    this.redraw();
  }

  /** Mark a voxel and join it with the cameras of the frames that it read: [{frame, share}]; null marks none. */
  selectVoxel(center, size, shares) {
    this.layers.chosen.clear();
    if (center) {
      const box = boxBars({ center, size, rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]] }, CHOSEN, 0.012);
      const most = Math.max(...shares.map(({ share }) => share), 1e-6);
      const rays = shares.map(({ frame, share }) => {
        const ends = [center, positionOf(this.data.frames[frame])];
        return segments(ends, new LineBasicMaterial({ color: CHOSEN, transparent: true, opacity: 0.15 + 0.85 * (share / most) }));
      });
      this.layers.chosen.add(box, ...rays);
    }
    this.redraw();
  }

  /** Look at all of the scene from above one corner. */
  home() {
    const bounds = new Box3();
    for (const item of [...this.data.objects, ...(this.data.truth ?? [])]) {
      for (const corner of corners(item)) bounds.expandByPoint(new Vector3(...corner));
    }
    for (const frame of this.data.frames) bounds.expandByPoint(new Vector3(...positionOf(frame)));
    if (bounds.isEmpty()) bounds.set(new Vector3(-1, -1, -1), new Vector3(1, 1, 1));
    const radius = Math.max(bounds.getSize(new Vector3()).length() / 2, 0.5);
    bounds.getCenter(this.controls.target);
    this.#leaveBackdrop();
    this.#setFieldOfView(FIELD_OF_VIEW);
    const away = radius / Math.sin(FIELD_OF_VIEW / 2) / Math.min(this.camera.aspect, 1);
    this.camera.position.set(-0.55, -0.85, 1.0).normalize().multiplyScalar(away).add(this.controls.target);
    this.controls.update();
    this.redraw();
  }

  /** Look from the camera of the frame that is shown, its picture behind everything until one turns away. */
  fly() {
    const { frame, size } = this.shown;
    const pose = frame.world_from_camera;
    const forward = new Vector3(pose[0][2], pose[1][2], pose[2][2]);
    this.camera.position.set(...positionOf(frame));
    this.controls.target.copy(this.camera.position).addScaledVector(forward, 1.5);
    this.#setFieldOfView(2 * Math.atan(size[0] / 2 / frame.intrinsics[1][1]));
    this.controls.update();
    this.#placePicture(BACKDROP_DEPTH);
  }

  #leaveBackdrop() {
    if (this.backdrop) this.#placePicture(IMAGE_DEPTH);
  }

  #setFieldOfView(radians) {
    this.camera.fov = (radians * 180) / Math.PI;
    this.camera.updateProjectionMatrix();
  }

  /** Where a point of the world is on the canvas, CSS pixels, or null behind the camera. */
  project(point) {
    this.camera.updateMatrixWorld();
    const at = new Vector3(...point).project(this.camera);
    if (at.z > 1 || at.z < -1) return null;
    return [((at.x + 1) / 2) * this.canvas.clientWidth, ((1 - at.y) / 2) * this.canvas.clientHeight];
  }

  /** What a ray first meets of the layers that are shown: {point, object?, frame?} or null. */
  cast(ray) {
    const { meshes, boxes, cameras, voxels } = this.layers;
    const hits = intersections(ray, [meshes, boxes, cameras, voxels]);
    if (!hits.length) return null;
    const { object, instanceId, point } = hits[0];
    if (object === this.frames) return { frame: instanceId };
    if (object.userData.object === undefined) return this.castToVoxel(ray);
    return { point: point.toArray(), object: object.userData.object };
  }

  /** Where a ray first meets a mesh or an occupied voxel, shown or not: {point} or null. */
  castToVoxel(ray) {
    const mesh = intersections(ray, [this.layers.meshes])[0];
    const inside = mesh?.point.clone().addScaledVector(ray.direction, 1e-3);
    const places = this.voxels.map((voxels) => voxels.firstOccupied(ray)).concat(inside ?? []);
    const [nearest] = places.filter(Boolean).sort((a, b) => a.distanceTo(ray.origin) - b.distanceTo(ray.origin));
    return nearest ? { point: nearest.toArray() } : null;
  }

  redraw() {
    if (this.pending) return;
    this.pending = true;
    requestAnimationFrame(() => {
      this.pending = false;
      this.draw();
    });
  }

  /** Resolves when what has changed is on the screen. */
  drawn() {
    return new Promise((done) => requestAnimationFrame(() => setTimeout(done)));
  }

  draw() {
    this.headlight.position.copy(this.camera.position);
    this.headlight.target.position.copy(this.controls.target);
    this.scene.background = new Color(getComputedStyle(document.body).getPropertyValue("--sky"));
    this.renderer.render(this.scene, this.camera);
    for (const { label, top } of this.objects) {
      const at = label.hidden ? null : this.project(top.toArray());
      label.style.visibility = at ? "visible" : "hidden";
      if (at) label.style.transform = `translate(calc(${at[0]}px - 50%), calc(${at[1]}px - 110%))`;
    }
  }

  #ink() {
    return getComputedStyle(document.body).getPropertyValue("--ink");
  }

  #resize() {
    const { clientWidth, clientHeight } = this.canvas.parentElement;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.camera.aspect = clientWidth / Math.max(clientHeight, 1);
    this.camera.updateProjectionMatrix();
    if (this.data) this.draw(); // at once: a canvas of a new size is empty
  }

  #listen() {
    let start = null;
    this.canvas.addEventListener("pointerdown", (event) => { start = event.button === 0 ? [event.clientX, event.clientY] : null; });
    this.canvas.addEventListener("pointerup", (event) => {
      if (!start || Math.hypot(event.clientX - start[0], event.clientY - start[1]) > 4) return;
      const area = this.canvas.getBoundingClientRect();
      const x = ((event.clientX - area.left) / area.width) * 2 - 1;
      const y = 1 - ((event.clientY - area.top) / area.height) * 2;
      const caster = new Raycaster();
      caster.setFromCamera(new Vector2(x, y), this.camera);
      this.onPick(event.shiftKey ? this.castToVoxel(caster.ray) : this.cast(caster.ray), event.shiftKey);
    });
  }
}

function readableOn(color) {
  const { r, g, b } = new Color(color).convertLinearToSRGB();
  return 0.2126 * r + 0.7152 * g + 0.0722 * b > 0.55 ? "#000" : "#fff";
}
