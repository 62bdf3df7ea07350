// SPDX-License-Identifier: Apache-2.0
import { type Columns, UnreadableCloudError } from "./cloud";

const NEWLINE = 10;
const RETURN = 13;
const MINUS = 45;
const PLUS = 43;
const DOT = 46;
const HASH = 35;
const SLASH = 47;

/**
 * Read rows of numbers from ASCII bytes, without making a string of each.
 *
 * @param width numbers in a row that are kept; further ones are ignored.
 * @param most rows at most; all by default.
 * @returns one column for each number of a row, as long as there are rows.
 */
export function readRows(bytes: Uint8Array, width: number, most = Infinity): Float64Array[] {
  let capacity = Math.min(most, Math.max(1024, Math.ceil(bytes.length / (4 * width))));
  let columns = Array.from({ length: width }, () => new Float64Array(capacity));
  let rows = 0;
  let offset = 0;
  while (offset < bytes.length && rows < most) {
    let found = 0;
    const comment = bytes[offset] === HASH || bytes[offset] === SLASH;
    while (offset < bytes.length && bytes[offset] !== NEWLINE && bytes[offset] !== RETURN) {
      const start = comment ? -1 : startOfNumber(bytes[offset]);
      if (start < 0) {
        offset++;
        continue;
      }
      let end = offset + 1;
      while (end < bytes.length && bytes[end] > 32 && bytes[end] !== 44 && bytes[end] !== 59) end++;
      if (found < width) columns[found][rows] = parse(bytes, offset, end);
      found++;
      offset = end;
    }
    offset++;
    if (found >= width) rows++;
    if (rows === capacity && rows < most) {
      capacity *= 2;
      columns = columns.map((column) => {
        const larger = new Float64Array(capacity);
        larger.set(column);
        return larger;
      });
    }
  }
  return columns.map((column) => column.subarray(0, rows));
}

function startOfNumber(byte: number): number {
  // Digits, signs, a point, and the letters of nan and inf.
  const number = (byte >= 48 && byte <= 57) || byte === MINUS || byte === PLUS || byte === DOT;
  return number || byte === 110 || byte === 78 || byte === 105 || byte === 73 ? 0 : -1;
}

function parse(bytes: Uint8Array, start: number, end: number): number {
  let offset = start;
  const negative = bytes[offset] === MINUS;
  if (negative || bytes[offset] === PLUS) offset++;
  let value = 0;
  let scale = 0;
  let seenDot = false;
  for (; offset < end; offset++) {
    const byte = bytes[offset];
    if (byte >= 48 && byte <= 57) {
      value = value * 10 + (byte - 48);
      if (seenDot) scale++;
    } else if (byte === DOT && !seenDot) seenDot = true;
    else return Number(String.fromCharCode(...bytes.subarray(start, end)));
  }
  // Beyond 2^53 digits were lost above; the engine's own parser keeps what there is to keep.
  if (value > Number.MAX_SAFE_INTEGER || scale > 22) {
    return Number(String.fromCharCode(...bytes.subarray(start, end)));
  }
  const found = value / 10 ** scale;
  return negative ? -found : found;
}

/** Read a text file with a point in each line; its first line may name the columns. */
export function readText(bytes: Uint8Array): Columns {
  const head = new TextDecoder("utf-8").decode(bytes.subarray(0, 8192)).replace(/^\uFEFF/, "");
  const lines = head.split(/\r\n|\n|\r/).filter((line) => line.trim() !== "");
  const isData = (line: string): boolean => /^[\s]*[-+.\d]/.test(line);
  const first = lines.findIndex((line) => isData(line) && words(line).length >= 3);
  if (first < 0) throw new UnreadableCloudError("No line begins with three numbers.");
  const width = words(lines[first]).length;
  const title = lines.slice(0, first).reverse().map((line) => words(line.replace(/^[#/\s]+/, "")));
  const names = title.find((found) => found.length === width && found.includes("x"));
  // Names come from the lines before the first point, and must not be taken for numbers.
  const start = names === undefined ? 0 : head.indexOf(lines[first]);
  const columns = readRows(bytes.subarray(start), width);
  return new Map((names ?? guessNames(columns)).map((name, i) => [name, columns[i]]));
}

function words(line: string): string[] {
  return line.trim().split(/[\s,;]+/).filter((word) => word !== "");
}

/** Name columns by their values: unit vectors are normals, whole numbers to 255 are colours. */
function guessNames(columns: Float64Array[]): string[] {
  const names = columns.map((_, i) => `column ${i + 1}`);
  names.splice(0, 3, "x", "y", "z");
  for (let i = 3; i + 3 <= columns.length; ) {
    const three = columns.slice(i, i + 3);
    const unit = !names.includes("nx") && looksLike(three, (a, b, c) =>
      Math.abs(Math.hypot(a, b, c) - 1) < 0.02);
    const color = !names.includes("red") && looksLike(three, (...values) =>
      values.every((value) => Number.isInteger(value) && value >= 0 && value <= 255));
    if (unit) names.splice(i, 3, "nx", "ny", "nz");
    else if (color) names.splice(i, 3, "red", "green", "blue");
    i += unit || color ? 3 : 1;
  }
  return names;
}

function looksLike(
  [a, b, c]: Float64Array[], test: (a: number, b: number, c: number) => boolean,
): boolean {
  for (let i = 0; i < Math.min(a.length, 200); i++) if (!test(a[i], b[i], c[i])) return false;
  return true;
}
