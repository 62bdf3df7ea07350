// SPDX-License-Identifier: Apache-2.0
import { UnreadableCloudError } from "./cloud";
import type { Surface } from "./messages";
import { readHeader, readPly, skip, TYPES } from "./ply";

/**
 * Read the triangles of a binary PLY file.
 *
 * @param origin is subtracted from every coordinate.
 */
export function readMesh(bytes: Uint8Array, origin: readonly [number, number, number]): Surface {
  const columns = readPly(bytes);
  const [x, y, z] = ["x", "y", "z"].map((name) => columns.get(name) ?? []);
  const positions = new Float32Array(3 * x.length);
  for (let i = 0; i < x.length; i++) positions.set([x[i] - origin[0], y[i] - origin[1], z[i] - origin[2]], 3 * i);
  const index = readFaces(bytes);
  return { positions, normals: vertexNormals(positions, index), index };
}

function readFaces(bytes: Uint8Array): Uint32Array {
  const { format, elements, end } = readHeader(bytes);
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const little = format === "binary_little_endian";
  let offset = end;
  for (const element of elements) {
    if (element.name !== "face") {
      offset = skip(view, offset, element, little);
      continue;
    }
    const [{ type, countType }] = element.properties;
    if (countType === null || element.properties.length !== 1) break;
    const [before, corner] = [TYPES[countType], TYPES[type]];
    const index = new Uint32Array(3 * element.count);
    for (let i = 0; i < index.length; offset += corner.size) {
      if (i % 3 === 0) {
        if (before.get(view, offset, little) !== 3) throw new UnreadableCloudError("The mesh has faces that are no triangles.");
        offset += before.size;
      }
      index[i++] = corner.get(view, offset, little);
    }
    return index;
  }
  throw new UnreadableCloudError("The mesh has no list of faces.");
}

/** Sums of the normals of the faces around each vertex, by area; unit vectors times 127, four bytes each. */
function vertexNormals(positions: Float32Array, index: Uint32Array): Int8Array {
  const sums = new Float32Array(positions.length);
  for (let i = 0; i < index.length; i += 3) {
    const [a, b, c] = [3 * index[i], 3 * index[i + 1], 3 * index[i + 2]];
    const [ux, uy, uz] = [0, 1, 2].map((axis) => positions[b + axis] - positions[a + axis]);
    const [vx, vy, vz] = [0, 1, 2].map((axis) => positions[c + axis] - positions[a + axis]);
    const normal = [uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx];
    for (const corner of [a, b, c]) for (let axis = 0; axis < 3; axis++) sums[corner + axis] += normal[axis];
  }
  const packed = new Int8Array((4 * positions.length) / 3);
  for (let i = 0; i < sums.length / 3; i++) {
    const scale = 127 / (Math.hypot(sums[3 * i], sums[3 * i + 1], sums[3 * i + 2]) || 1);
    for (let axis = 0; axis < 3; axis++) packed[4 * i + axis] = Math.round(scale * sums[3 * i + axis]);
  }
  return packed;
}
