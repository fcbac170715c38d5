// SPDX-License-Identifier: Apache-2.0
// What this browser can draw.

/** WebGL 2 of a canvas; without smooth edges where the processor draws, for it takes three times as long with them. */
export function contextOf(canvas) {
  const context =
    canvas.getContext("webgl2", { failIfMajorPerformanceCaveat: true }) ?? canvas.getContext("webgl2", { antialias: false });
  if (!context) throw new Error("this browser cannot draw in three dimensions: it needs WebGL 2 (look at chrome://gpu or about:support)");
  return context;
}
