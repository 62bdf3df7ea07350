// SPDX-License-Identifier: Apache-2.0
import { type Cloud, type Columns, fromColumns, UnreadableCloudError } from "./cloud";
import { readNpy, readNpz } from "./numpy";
import { readPly } from "./ply";
import { readText } from "./text";

// Text in which not each row of numbers is a point: PTX, with two counts and a matrix in front; STL,
// with normals; OBJ, with faces.
const NOT_ROWS = [
  /^\s*\d+[ \t]*\r?\n[ \t]*\d+[ \t]*\r?\n[ \t]*\S+[ \t]+\S+[ \t]+\S+[ \t]*\r?\n/,
  /^\s*solid\b/,
  /^[ \t]*(v|vn|vt|f|o|g|mtllib|usemtl)[ \t]/m,
];

/** Read a file that the browser can draw; its content decides on the format, as in the service. */
export async function readCloud(bytes: Uint8Array): Promise<Cloud> {
  const head = new TextDecoder("latin1").decode(bytes.subarray(0, 64));
  if (head.startsWith("ply")) return fromColumns(readPly(bytes));
  // Its first byte, 0x93, is no character of Latin-1.
  if (head.startsWith("NUMPY", 1)) return fromColumns(readNpy(bytes));
  if (head.startsWith("PK")) return fromColumns(await readNpz(bytes));
  if (/^(\xef\xbb\xbf)?\s*[{[]/.test(head)) return fromColumns(readJson(bytes));
  const start = new TextDecoder("latin1").decode(bytes.subarray(0, 4096));
  // A byte that no text has: LAS, LAZ, E57 and the like.
  const binary = bytes.subarray(0, 512).some((byte) => byte < 9);
  if (binary || head.startsWith("# .PCD") || NOT_ROWS.some((rows) => rows.test(start))) {
    throw new UnreadableCloudError("This format is read by the service, and not by the browser.");
  }
  return fromColumns(readText(bytes));
}

function readJson(bytes: Uint8Array): Columns {
  const found = JSON.parse(new TextDecoder().decode(bytes)) as unknown;
  const object = (Array.isArray(found) ? { points: found } : found) as Record<string, unknown>;
  const columns: Columns = new Map();
  const triples = { points: "x y z", normals: "nx ny nz", colors: "red green blue" };
  for (const [key, names] of Object.entries(triples)) {
    const rows = object[key];
    if (!Array.isArray(rows)) continue;
    names.split(" ").forEach((name, i) => {
      columns.set(name, Float64Array.from(rows as number[][], (row) => row[i]));
    });
  }
  for (const [name, values] of Object.entries(object.scalars ?? {})) {
    if (Array.isArray(values)) columns.set(name, Float64Array.from(values as number[]));
  }
  return columns;
}

/**
 * Find the number of points in the header of a format that only the service reads.
 *
 * @returns null where the header does not tell.
 */
export function countOf(bytes: Uint8Array): number | null {
  const head = new TextDecoder("latin1").decode(bytes.subarray(0, 4096));
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (head.startsWith("LASF") && bytes.length > 255) {
    const minor = bytes[25];
    return minor >= 4 ? Number(view.getBigUint64(247, true)) : view.getUint32(107, true);
  }
  const pcd = /^POINTS\s+(\d+)/m.exec(head);
  return pcd === null ? null : Number(pcd[1]);
}
