// SPDX-License-Identifier: Apache-2.0
import type { Cloud } from "./cloud";

/** Write some points of a cloud, with their normals, as binary PLY in double precision. */
export function writePly(cloud: Cloud, order: Uint32Array): Blob {
  const normals = cloud.normals;
  const header =
    `ply\nformat binary_little_endian 1.0\nelement vertex ${order.length}\n` +
    "property double x\nproperty double y\nproperty double z\n" +
    (normals === null ? "" : "property float nx\nproperty float ny\nproperty float nz\n") +
    "end_header\n";
  const stride = normals === null ? 24 : 36;
  const view = new DataView(new ArrayBuffer(stride * order.length));
  order.forEach((point, row) => {
    for (let axis = 0; axis < 3; axis++) {
      const value = cloud.points[3 * point + axis] + cloud.origin[axis];
      view.setFloat64(stride * row + 8 * axis, value, true);
      if (normals !== null) {
        view.setFloat32(stride * row + 24 + 4 * axis, normals[3 * point + axis] / 127, true);
      }
    }
  });
  return new Blob([header, view.buffer]);
}
