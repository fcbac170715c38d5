// SPDX-License-Identifier: Apache-2.0
// The objects' meshes out of scene.glb, turned back from glTF's +y up to the world's +z up.

import { DoubleSide, GLTFLoader, Group, MeshLambertMaterial } from "./vendor/three.js";

const NAME = /^(\d{2,})_[a-z]+$/;

/** Read the meshes whose nodes are called NN_category: a map from NN to a three.js object. */
export async function readMeshes(url) {
  const { scene } = await new GLTFLoader().loadAsync(url);
  const found = new Map();
  scene.updateMatrixWorld(true);
  scene.traverse((node) => {
    const number = NAME.exec(node.name)?.[1];
    if (number !== undefined) found.set(Number(number), node);
  });
  const meshes = new Map();
  for (const [number, node] of found) {
    const material = new MeshLambertMaterial({ side: DoubleSide });
    const upright = new Group();
    upright.rotation.x = Math.PI / 2;
    upright.material = material;
    const turned = new Group();
    turned.applyMatrix4(node.parent.matrixWorld);
    node.traverse((part) => {
      if (!part.isMesh) return;
      part.material = material;
      if (!part.geometry.attributes.normal) part.geometry.computeVertexNormals();
    });
    turned.add(node);
    upright.add(turned);
    meshes.set(number, upright);
  }
  return meshes;
}
