// SPDX-License-Identifier: Apache-2.0

/**
 * A point cloud in memory.
 *
 * `points` are relative to `origin`, which stays in double precision: single precision alone
 * would lose the millimetres of georeferenced coordinates.
 */
export interface Cloud {
  /** Number of points. */
  readonly count: number;
  /** Subtracted from every coordinate. */
  readonly origin: readonly [number, number, number];
  /** x, y, z of each point, `3 * count`. */
  readonly points: Float32Array;
  /** Unit vectors times 127, `3 * count`. */
  readonly normals: Int8Array | null;
  /** Red, green, blue, `3 * count`. */
  readonly colors: Uint8Array | null;
  /** Further values of each point by name, `count` each. */
  readonly scalars: ReadonlyMap<string, Float32Array>;
}

/** A file that cannot be drawn in the browser; the service may read it all the same. */
export class UnreadableCloudError extends Error {
  override readonly name = "UnreadableCloudError";
}

/** Columns of numbers by name, as the readers of the formats deliver them. */
export type Columns = Map<string, ArrayLike<number>>;

const ROLES: Record<string, readonly string[]> = {
  x: ["x"],
  y: ["y"],
  z: ["z"],
  nx: ["nx", "normal_x", "normalx"],
  ny: ["ny", "normal_y", "normaly"],
  nz: ["nz", "normal_z", "normalz"],
  red: ["red", "r", "diffuse_red"],
  green: ["green", "g", "diffuse_green"],
  blue: ["blue", "b", "diffuse_blue"],
};
const NOT_SHOWN = new Set(["alpha", "a", "diffuse_alpha"]);

/** Build a cloud from named columns; points with a coordinate that is not finite are left out. */
export function fromColumns(columns: Columns): Cloud {
  const named = new Map([...columns].map(([name, values]) => [name.toLowerCase(), values]));
  const used = new Set<string>();
  const find = (role: string): ArrayLike<number> | undefined => {
    const name = ROLES[role].find((candidate) => named.has(candidate));
    if (name === undefined) return undefined;
    used.add(name);
    return named.get(name);
  };
  const xyz = ["x", "y", "z"].map(find);
  if (xyz.includes(undefined)) {
    throw new UnreadableCloudError("The file names no columns x, y and z.");
  }
  const [x, y, z] = xyz as ArrayLike<number>[];
  const kept = finiteRows(x, y, z);
  const count = kept.length;
  if (count === 0) throw new UnreadableCloudError("The file has no point with finite coordinates.");
  const origin = [x[kept[0]], y[kept[0]], z[kept[0]]] as const;
  const points = new Float32Array(3 * count);
  for (let i = 0; i < count; i++) {
    const row = kept[i];
    points[3 * i] = x[row] - origin[0];
    points[3 * i + 1] = y[row] - origin[1];
    points[3 * i + 2] = z[row] - origin[2];
  }
  const normal = ["nx", "ny", "nz"].map(find);
  const color = ["red", "green", "blue"].map(find);
  const scalars = new Map<string, Float32Array>();
  for (const [name, values] of columns) {
    const key = name.toLowerCase();
    if (used.has(key) || NOT_SHOWN.has(key)) continue;
    scalars.set(name, Float32Array.from(kept, (row) => values[row]));
  }
  return {
    count,
    origin,
    points,
    normals: normal.includes(undefined) ? null : packNormals(normal as ArrayLike<number>[], kept),
    colors: color.includes(undefined) ? null : packColors(color as ArrayLike<number>[], kept),
    scalars,
  };
}

function finiteRows(x: ArrayLike<number>, y: ArrayLike<number>, z: ArrayLike<number>): Uint32Array {
  const rows = new Uint32Array(x.length);
  let count = 0;
  for (let i = 0; i < x.length; i++) {
    if (Number.isFinite(x[i] + y[i] + z[i])) rows[count++] = i;
  }
  return rows.subarray(0, count);
}

function packNormals([x, y, z]: ArrayLike<number>[], kept: Uint32Array): Int8Array {
  const packed = new Int8Array(3 * kept.length);
  for (let i = 0; i < kept.length; i++) {
    const row = kept[i];
    const scale = 127 / (Math.hypot(x[row], y[row], z[row]) || 1);
    packed[3 * i] = Math.round(x[row] * scale);
    packed[3 * i + 1] = Math.round(y[row] * scale);
    packed[3 * i + 2] = Math.round(z[row] * scale);
  }
  return packed;
}

/** Colours are 0 to 255 in bytes, 0 to 1 in floating point, and 0 to 65535 in 16-bit integers. */
function packColors(channels: ArrayLike<number>[], kept: Uint32Array): Uint8Array {
  const [first] = channels;
  let scale = 1;
  if (first instanceof Uint16Array) scale = 255 / 65535;
  else if (!(first instanceof Uint8Array) && channels.every(withinOne)) scale = 255;
  const packed = new Uint8Array(3 * kept.length);
  for (let i = 0; i < kept.length; i++) {
    for (let c = 0; c < 3; c++) {
      packed[3 * i + c] = Math.min(255, Math.max(0, Math.round(channels[c][kept[i]] * scale)));
    }
  }
  return packed;
}

function withinOne(values: ArrayLike<number>): boolean {
  return Array.prototype.every.call(values, (value: number) => value <= 1);
}
