// SPDX-License-Identifier: Apache-2.0

const TARGET_MS = 1000 / 30;
const FEWEST = 20_000;
const AT_FIRST = 500_000;
const REMEMBERED = 12;

/**
 * Keeps the page quick: decides how many points are drawn in one frame.
 *
 * The time from frame to frame is what people see, also where a processor draws in the place of
 * a graphics card. Points come in random order, so any first part of them is an even one.
 */
export class Pacer {
  private budget = AT_FIRST;
  private last: number | null = null;
  private readonly recent: number[] = [];

  /** Frames a second, by the median of the last frames in motion; null before there were any. */
  get rate(): number | null {
    if (this.recent.length < 3) return null;
    const sorted = [...this.recent].sort((a, b) => a - b);
    return 1000 / sorted[sorted.length >> 1];
  }

  /** Points to draw of `total` in the next frame. */
  points(total: number): number {
    return Math.min(total, Math.max(FEWEST, Math.round(this.budget)));
  }

  /** Note that a frame began at a time, in milliseconds, and drew so many points. */
  frame(time: number, drawn: number, moving: boolean): void {
    if (this.last !== null) {
      const spent = time - this.last;
      if (moving) this.recent.push(spent);
      if (this.recent.length > REMEMBERED) this.recent.shift();
      // Slower than wanted: fewer at once. Faster: more, in small steps, so that it does not swing.
      if (spent > 1.15 * TARGET_MS) {
        this.budget = Math.max(FEWEST, drawn * Math.max(0.5, TARGET_MS / spent));
      } else if (spent < 0.8 * TARGET_MS) this.budget = Math.max(this.budget, drawn * 1.05);
    }
    this.last = time;
  }

  /** Note that no frame follows. */
  rest(): void {
    this.last = null;
  }
}
