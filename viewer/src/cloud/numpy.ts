// SPDX-License-Identifier: Apache-2.0
import { type Columns, UnreadableCloudError } from "./cloud";

interface NumpyArray {
  readonly shape: number[];
  readonly values: ArrayLike<number>;
}

const READERS: Record<string, [number, (v: DataView, o: number, l: boolean) => number]> = {
  f4: [4, (v, o, l) => v.getFloat32(o, l)],
  f8: [8, (v, o, l) => v.getFloat64(o, l)],
  i1: [1, (v, o) => v.getInt8(o)],
  u1: [1, (v, o) => v.getUint8(o)],
  i2: [2, (v, o, l) => v.getInt16(o, l)],
  u2: [2, (v, o, l) => v.getUint16(o, l)],
  i4: [4, (v, o, l) => v.getInt32(o, l)],
  u4: [4, (v, o, l) => v.getUint32(o, l)],
  i8: [8, (v, o, l) => Number(v.getBigInt64(o, l))],
  u8: [8, (v, o, l) => Number(v.getBigUint64(o, l))],
  b1: [1, (v, o) => v.getUint8(o)],
};

/** Read an NPY file: points as `(N, 3)`, with normals as `(N, 6)`. */
export function readNpy(bytes: Uint8Array): Columns {
  const array = parseNpy(bytes);
  const width = array.shape[1] ?? 0;
  if (array.shape.length !== 2 || width < 3) {
    throw new UnreadableCloudError(`The array has the shape (${array.shape.join(", ")}).`);
  }
  const names = ["x", "y", "z", ...(width === 6 ? ["nx", "ny", "nz"] : [])];
  return new Map(names.map((name, i) => [name, column(array, i)]));
}

/** Read an NPZ file with the arrays `points`, `normals`, `colors` and one for each scalar. */
export async function readNpz(bytes: Uint8Array): Promise<Columns> {
  const columns: Columns = new Map();
  const triples: Partial<Record<string, string[]>> = {
    points: ["x", "y", "z"],
    normals: ["nx", "ny", "nz"],
    colors: ["red", "green", "blue"],
  };
  for (const [file, data] of await unzip(bytes)) {
    const name = file.replace(/\.npy$/, "");
    const array = parseNpy(data);
    const parts = triples[name];
    if (parts !== undefined && array.shape.length === 2 && array.shape[1] >= 3) {
      parts.forEach((part, i) => columns.set(part, column(array, i)));
    } else if (array.shape.length === 1) columns.set(name, array.values);
  }
  return columns;
}

function column({ shape, values }: NumpyArray, index: number): ArrayLike<number> {
  const [rows, width] = shape;
  const make = values.constructor as new (length: number) => Float64Array;
  const found = new make(rows);
  for (let i = 0; i < rows; i++) found[i] = values[i * width + index];
  return found;
}

function parseNpy(bytes: Uint8Array): NumpyArray {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const long = bytes[6] >= 2;
  const start = long ? 12 : 10;
  const length = long ? view.getUint32(8, true) : view.getUint16(8, true);
  const header = new TextDecoder("latin1").decode(bytes.subarray(start, start + length));
  const descr = /'descr':\s*'([<>|=])(\w\d)'/.exec(header);
  const shape = /'shape':\s*\(([^)]*)\)/.exec(header);
  const reader = descr === null ? undefined : READERS[descr[2]];
  if (descr === null || shape === null || reader === undefined) {
    throw new UnreadableCloudError("The array is of a type that cannot be drawn.");
  }
  const sizes = shape[1].split(",").filter((part) => part.trim() !== "").map(Number);
  const count = sizes.reduce((product, size) => product * size, 1);
  const [size, get] = reader;
  if (start + length + size * count > bytes.length) {
    throw new UnreadableCloudError("The array ends before its last number.");
  }
  const values = descr[2] === "u1" ? new Uint8Array(count) : new Float64Array(count);
  const little = descr[1] !== ">";
  const fortran = header.includes("'fortran_order': True") && sizes.length === 2;
  for (let i = 0, offset = start + length; i < count; i++, offset += size) {
    const place = fortran ? (i % sizes[0]) * sizes[1] + Math.floor(i / sizes[0]) : i;
    values[place] = get(view, offset, little);
  }
  return { shape: sizes, values };
}

const END_OF_DIRECTORY = 0x06054b50;
const STORED = 0;
const DEFLATED = 8;

async function unzip(bytes: Uint8Array): Promise<Map<string, Uint8Array>> {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  let end = bytes.length - 22;
  while (end >= 0 && view.getUint32(end, true) !== END_OF_DIRECTORY) end--;
  if (end < 0) throw new UnreadableCloudError("The archive has no directory.");
  const files = new Map<string, Uint8Array>();
  let entry = view.getUint32(end + 16, true);
  for (let left = view.getUint16(end + 10, true); left > 0; left--) {
    const [method, packed] = [view.getUint16(entry + 10, true), view.getUint32(entry + 20, true)];
    const [nameLength, extraLength, commentLength] = [28, 30, 32].map((at) =>
      view.getUint16(entry + at, true));
    const name = new TextDecoder().decode(bytes.subarray(entry + 46, entry + 46 + nameLength));
    const local = view.getUint32(entry + 42, true);
    const start = local + 30 + view.getUint16(local + 26, true) + view.getUint16(local + 28, true);
    const data = bytes.subarray(start, start + packed);
    if (method === STORED) files.set(name, data);
    else if (method === DEFLATED) files.set(name, await inflate(data));
    entry += 46 + nameLength + extraLength + commentLength;
  }
  return files;
}

async function inflate(data: Uint8Array): Promise<Uint8Array> {
  const stream = new Blob([data as Uint8Array<ArrayBuffer>])
    .stream()
    .pipeThrough(new DecompressionStream("deflate-raw"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}
