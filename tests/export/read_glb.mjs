// SPDX-License-Identifier: Apache-2.0
// What three.js finds in a glTF file, as JSON: type, place and colour of every node that has a name.

import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { dirname, join, resolve } from "node:path";
import { pathToFileURL } from "node:url";

// Found as CommonJS finds it, which looks into NODE_PATH; `import` does not.
const addon = createRequire(join(process.cwd(), "x.js")).resolve("three/examples/jsm/loaders/GLTFLoader.js");
const main = resolve(dirname(addon), "../../../build/three.module.js");
const { Box3, Vector3 } = await import(pathToFileURL(main));
const { GLTFLoader } = await import(pathToFileURL(addon));

const file = readFileSync(process.argv[2]);
const data = file.buffer.slice(file.byteOffset, file.byteOffset + file.byteLength);
const { scene } = await new Promise((done, failed) => new GLTFLoader().parse(data, "", done, failed));
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
