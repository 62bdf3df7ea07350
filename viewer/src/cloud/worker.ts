// SPDX-License-Identifier: Apache-2.0
// Reads clouds and computes their figures, beside the thread that draws.
import { type Cloud, UnreadableCloudError } from "./cloud";
import { readMesh } from "./mesh";
import { type Drawable, MOST_DRAWN, type Request, type Slot, type Values } from "./messages";
import { expectedSpacing, Grid, medianSpacing } from "./neighbours";
import { countOf, readCloud } from "./read";

interface Loaded {
  readonly cloud: Cloud;
  /** Numbers of the points drawn, in the order in which they are drawn. */
  readonly order: Uint32Array;
  readonly diagonal: number;
  grid: Grid | null;
  spacing: number | null;
}

const loaded = new Map<Slot, Loaded>();

async function load(slot: Slot, file: Blob): Promise<Drawable> {
  const cloud = await readCloud(new Uint8Array(await file.arrayBuffer()));
  // Both clouds share one origin, so that one camera looks at both.
  const other = loaded.get(slot === "before" ? "after" : "before");
  const shared = other === undefined ? cloud : moved(cloud, other.cloud.origin);
  const order = shuffled(shared.count, MOST_DRAWN);
  const [low, high] = box(shared.points, order);
  const diagonal = Math.hypot(...low.map((value, axis) => high[axis] - value));
  loaded.set(slot, { cloud: shared, order, diagonal, grid: null, spacing: null });
  return {
    slot,
    count: shared.count,
    drawn: order.length,
    origin: shared.origin,
    positions: gather(shared.points, order, 3, 3),
    normals: shared.normals && gather(shared.normals, order, 3, 4),
    colors: shared.colors && gather(shared.colors, order, 3, 4),
    low,
    high,
    scalars: [...shared.scalars.keys()],
  };
}

function moved(cloud: Cloud, origin: readonly [number, number, number]): Cloud {
  const shift = cloud.origin.map((value, axis) => value - origin[axis]);
  const points = cloud.points.map((value, i) => value + shift[i % 3]);
  return { ...cloud, origin, points };
}

/** Choose numbers below `count` at random, each once: at most `most`, by Fisher and Yates. */
function shuffled(count: number, most: number): Uint32Array {
  const order = Uint32Array.from({ length: count }, (_, i) => i);
  const chosen = Math.min(count, most);
  // A fixed seed: the same cloud looks the same each time (xorshift32, Marsaglia 2003).
  let state = 0x9e3779b9;
  for (let i = 0; i < chosen; i++) {
    state ^= state << 13;
    state ^= state >>> 17;
    state ^= state << 5;
    const j = i + ((state >>> 0) % (count - i));
    [order[i], order[j]] = [order[j], order[i]];
  }
  return order.slice(0, chosen);
}

function gather<T extends Float32Array | Int8Array | Uint8Array>(
  source: T, order: Uint32Array, from: number, to: number,
): T {
  const target = new (source.constructor as new (length: number) => T)(to * order.length);
  for (let i = 0; i < order.length; i++) {
    for (let c = 0; c < from; c++) target[to * i + c] = source[from * order[i] + c];
  }
  return target;
}

type Corner = [number, number, number];

function box(points: Float32Array, order: Uint32Array): [Corner, Corner] {
  const sample = order.subarray(0, 20_000);
  const [low, high]: [Corner, Corner] = [[0, 0, 0], [0, 0, 0]];
  for (let axis = 0; axis < 3; axis++) {
    const range = quantiles(Float32Array.from(sample, (i) => points[3 * i + axis]), 0.005);
    [low[axis], high[axis]] = range;
  }
  return [low, high];
}

function quantiles(values: Float32Array, share: number): [number, number] {
  const sorted = values.filter((value) => Number.isFinite(value)).sort();
  if (sorted.length === 0) return [0, 1];
  const cut = Math.floor(share * (sorted.length - 1));
  return [sorted[cut], sorted[sorted.length - 1 - cut]];
}

function find(slot: Slot): Loaded {
  const found = loaded.get(slot);
  if (found === undefined) throw new Error(`There is no cloud in the pane ${slot}.`);
  return found;
}

function gridOf(entry: Loaded): Grid {
  const { cloud, diagonal } = entry;
  entry.grid ??= new Grid(cloud.points, expectedSpacing(diagonal, cloud.count));
  return entry.grid;
}

function spacing(slot: Slot): number {
  const entry = find(slot);
  entry.spacing ??= medianSpacing(entry.cloud.points, gridOf(entry));
  return entry.spacing;
}

function ranged(values: Float32Array, low?: number): Values {
  const [least, most] = quantiles(values.slice(0, 50_000), 0.02);
  return { values, low: low ?? least, high: most };
}

function scalar(slot: Slot, name: string): Values {
  const { cloud, order } = find(slot);
  const values = cloud.scalars.get(name);
  if (values === undefined) throw new Error(`The cloud has no values called ${name}.`);
  return ranged(Float32Array.from(order, (i) => values[i]));
}

/** Distance of each drawn point of the output to the nearest point of the input. */
function distance(): Values {
  const { cloud, order } = find("after");
  const grid = gridOf(find("before"));
  const { points } = cloud;
  const values = Float32Array.from(order, (i) =>
    grid.distance(points[3 * i], points[3 * i + 1], points[3 * i + 2]));
  return ranged(values, 0);
}

async function answer(request: Request): Promise<unknown> {
  switch (request.call) {
    case "load":
      return load(request.args.slot, request.args.file);
    case "forget":
      loaded.delete(request.args.slot);
      return null;
    case "spacing":
      return spacing(request.args.slot);
    case "scalar":
      return scalar(request.args.slot, request.args.name);
    case "distance":
      return distance();
    case "surface": {
      const { origin } = find(request.args.slot).cloud;
      return readMesh(new Uint8Array(await request.args.file.arrayBuffer()), origin);
    }
    case "count":
      return countOf(new Uint8Array(await request.args.file.slice(0, 4096).arrayBuffer()));
  }
}

function transferable(result: unknown): Transferable[] {
  if (typeof result !== "object" || result === null) return [];
  return Object.values(result)
    .filter((value) => ArrayBuffer.isView(value))
    .map((view) => view.buffer as ArrayBuffer);
}

self.onmessage = async ({ data }: MessageEvent<Request>): Promise<void> => {
  try {
    const result = await answer(data);
    self.postMessage({ id: data.id, result }, { transfer: transferable(result) });
  } catch (error) {
    const unreadable = error instanceof UnreadableCloudError || error instanceof SyntaxError;
    self.postMessage({ id: data.id, error: (error as Error).message, unreadable });
  }
};
