// SPDX-License-Identifier: Apache-2.0

const SAMPLE = 10_000;
const MOST_RINGS = 24;

/** Finds the nearest of many points: a uniform grid whose cells are found by hashing. */
export class Grid {
  private readonly heads: Int32Array;
  private readonly following: Int32Array;
  private readonly mask: number;

  /**
   * @param points x, y, z of each point.
   * @param cell side of a cell, best about the spacing of the points.
   */
  constructor(private readonly points: Float32Array, private readonly cell: number) {
    const count = points.length / 3;
    const size = 2 ** Math.ceil(Math.log2(Math.max(16, count)));
    this.mask = size - 1;
    this.heads = new Int32Array(size).fill(-1);
    this.following = new Int32Array(count);
    for (let i = 0; i < count; i++) {
      const [x, y, z] = [points[3 * i], points[3 * i + 1], points[3 * i + 2]];
      const slot = this.slot(this.index(x), this.index(y), this.index(z));
      this.following[i] = this.heads[slot];
      this.heads[slot] = i;
    }
  }

  /** Distance to the nearest point other than `except`; infinite where none is near. */
  distance(x: number, y: number, z: number, except = -1): number {
    const [i, j, k] = [this.index(x), this.index(y), this.index(z)];
    let best = Infinity;
    for (let ring = 0; ring <= MOST_RINGS; ring++) {
      // All that is nearer than this was in the rings before.
      const passed = (ring - 1) * this.cell;
      if (passed > 0 && best <= passed * passed) break;
      best = this.searchRing(i, j, k, ring, [x, y, z], except, best);
    }
    return Math.sqrt(best);
  }

  private searchRing(
    i: number, j: number, k: number, ring: number,
    [x, y, z]: [number, number, number], except: number, start: number,
  ): number {
    let best = start;
    const { points } = this;
    for (let a = -ring; a <= ring; a++) {
      for (let b = -ring; b <= ring; b++) {
        const edge = Math.abs(a) === ring || Math.abs(b) === ring;
        for (let c = -ring; c <= ring; c += edge || ring === 0 ? 1 : 2 * ring) {
          let n = this.heads[this.slot(i + a, j + b, k + c)];
          for (; n >= 0; n = this.following[n]) {
            const dx = points[3 * n] - x;
            const dy = points[3 * n + 1] - y;
            const dz = points[3 * n + 2] - z;
            const square = dx * dx + dy * dy + dz * dz;
            if (square < best && n !== except) best = square;
          }
        }
      }
    }
    return best;
  }

  private index(value: number): number {
    return Math.floor(value / this.cell);
  }

  private slot(i: number, j: number, k: number): number {
    // Teschner et al., Optimized Spatial Hashing (2003).
    const hash = Math.imul(i, 73856093) ^ Math.imul(j, 19349663) ^ Math.imul(k, 83492791);
    return hash & this.mask;
  }
}

/** Guess the spacing of points on a surface that fills a box of this diagonal. */
export function expectedSpacing(diagonal: number, count: number): number {
  return diagonal / Math.sqrt(count) || 1;
}

/** Median distance from a point to its nearest neighbour, over a sample of the points. */
export function medianSpacing(points: Float32Array, grid: Grid): number {
  const count = points.length / 3;
  const step = Math.max(1, Math.floor(count / SAMPLE));
  const found: number[] = [];
  for (let i = 0; i < count; i += step) {
    const distance = grid.distance(points[3 * i], points[3 * i + 1], points[3 * i + 2], i);
    if (Number.isFinite(distance)) found.push(distance);
  }
  found.sort((a, b) => a - b);
  return found.length === 0 ? NaN : found[found.length >> 1];
}
