// SPDX-License-Identifier: Apache-2.0
// What this browser can draw.

export const hasWebGL = () => document.createElement("canvas").getContext("webgl2") !== null;

/** Whether the processor draws, for which smooth edges take three times as long. */
export function drawsInSoftware() {
  const context = document.createElement("canvas").getContext("webgl2");
  const extension = context.getExtension("WEBGL_debug_renderer_info");
  return extension !== null && /swiftshader|llvmpipe|software|basic render/i.test(context.getParameter(extension.UNMASKED_RENDERER_WEBGL));
}
