// SPDX-License-Identifier: Apache-2.0
// What three.js finds in a glTF or OBJ file, as JSON: type, place and colour of every node that has a name.

import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { dirname, join, resolve } from "node:path";
import { pathToFileURL } from "node:url";

// Found as CommonJS finds it, which looks into NODE_PATH; `import` does not.
const addon = createRequire(join(process.cwd(), "x.js")).resolve("three/examples/jsm/loaders/GLTFLoader.js");
const three = (path) => import(pathToFileURL(resolve(dirname(addon), path)));
const { Box3, Vector3 } = await three("../../../build/three.module.js");

async function readGlb(path) {
  const { GLTFLoader } = await three("GLTFLoader.js");
  const file = readFileSync(path);
  const data = file.buffer.slice(file.byteOffset, file.byteOffset + file.byteLength);
  const { scene } = await new Promise((done, failed) => new GLTFLoader().parse(data, "", done, failed));
  return scene;
}

async function readObj(path) {
  const { OBJLoader } = await three("OBJLoader.js");
  const { MTLLoader } = await three("MTLLoader.js");
  const text = readFileSync(path, "utf8");
  const library = text.match(/^mtllib (.+)$/m)[1];
  const materials = new MTLLoader().parse(readFileSync(join(dirname(path), library), "utf8"), "");
  return new OBJLoader().setMaterials(materials).parse(text);
}

const path = process.argv[2];
const scene = await (path.endsWith(".obj") ? readObj(path) : readGlb(path));
scene.updateMatrixWorld(true);

const found = {};
scene.traverse((node) => {
  if (!node.name) return;
  const entry = { type: node.type, position: node.getWorldPosition(new Vector3()).toArray() };
  if (node.isMesh) {
    const box = new Box3().setFromObject(node, true);
    Object.assign(entry, { low: box.min.toArray(), high: box.max.toArray(), color: node.material.color.getHexString() });
  }
  if (node.isCamera) {
    Object.assign(entry, { forward: node.getWorldDirection(new Vector3()).toArray(), aspect: node.aspect });
  }
  found[node.name] = entry;
});
process.stdout.write(JSON.stringify(found));
