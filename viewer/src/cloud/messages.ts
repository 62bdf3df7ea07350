// SPDX-License-Identifier: Apache-2.0

/** The input and the output of an upsampling. */
export type Slot = "before" | "after";

/** Points drawn at most in one pane; of larger clouds a random part is drawn. */
export const MOST_DRAWN = 5_000_000;

/** One cloud as the graphics processor takes it, in random order: any first part is an even one. */
export interface Drawable {
  readonly slot: Slot;
  /** Points of the cloud. */
  readonly count: number;
  /** Points drawn, at most `MOST_DRAWN`. */
  readonly drawn: number;
  /** Subtracted from every coordinate; the same for both clouds. */
  readonly origin: readonly [number, number, number];
  /** x, y, z of each point. */
  readonly positions: Float32Array;
  /** Unit vectors times 127, with a fourth byte that aligns them. */
  readonly normals: Int8Array | null;
  /** Red, green, blue and a fourth byte. */
  readonly colors: Uint8Array | null;
  /** Corners of the box that holds all but the outermost hundredth on each side. */
  readonly low: readonly [number, number, number];
  readonly high: readonly [number, number, number];
  /** Names of the values that each point carries. */
  readonly scalars: readonly string[];
}

/** Values of the points of a `Drawable`, in its order, with the range to be coloured. */
export interface Values {
  readonly values: Float32Array;
  readonly low: number;
  readonly high: number;
}

/** A triangle mesh as the graphics processor takes it. */
export interface Surface {
  /** x, y, z of each vertex, without the origin of the clouds. */
  readonly positions: Float32Array;
  /** Unit vectors times 127, with a fourth byte that aligns them. */
  readonly normals: Int8Array;
  /** Three vertices of each face. */
  readonly index: Uint32Array;
}

/** Calls that the worker answers, with their arguments and results. */
export interface Calls {
  load: { args: { slot: Slot; file: Blob }; result: Drawable };
  forget: { args: { slot: Slot }; result: null };
  spacing: { args: { slot: Slot }; result: number };
  scalar: { args: { slot: Slot; name: string }; result: Values };
  distance: { args: null; result: Values };
  surface: { args: { slot: Slot; file: Blob }; result: Surface };
  count: { args: { file: Blob }; result: number | null };
}

export type Request = {
  [K in keyof Calls]: { id: number; call: K; args: Calls[K]["args"] };
}[keyof Calls];

export type Reply =
  | { id: number; result: unknown }
  | { id: number; error: string; unreadable: boolean };
