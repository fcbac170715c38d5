// SPDX-License-Identifier: Apache-2.0
// What a ray meets.

import { Raycaster } from "./vendor/three.js";

/** What of some layers a ray meets, the nearest first. */
export function intersections(ray, layers) {
  const caster = new Raycaster(ray.origin, ray.direction);
  return caster.intersectObjects(layers, true).filter(({ object }) => object.isMesh && isShown(object));
}

function isShown(object) {
  for (let part = object; part; part = part.parent) if (!part.visible) return false;
  return true;
}
