// SPDX-License-Identifier: Apache-2.0
import { type Columns, UnreadableCloudError } from "./cloud";
import { readRows } from "./text";

interface Property {
  readonly name: string;
  readonly type: string;
  /** Type of the count in front, for lists. */
  readonly countType: string | null;
}

interface Element {
  readonly name: string;
  readonly count: number;
  readonly properties: Property[];
}

interface Header {
  readonly format: string;
  readonly elements: Element[];
  /** Where the data begin, in bytes. */
  readonly end: number;
}

type Getter = (view: DataView, offset: number, little: boolean) => number;
type Maker = new (count: number) => Float32Array | Float64Array | Int32Array | Uint32Array |
  Int16Array | Uint16Array | Int8Array | Uint8Array;

export const TYPES: Record<string, { size: number; get: Getter; make: Maker }> = {
  int8: { size: 1, get: (v, o) => v.getInt8(o), make: Int8Array },
  uint8: { size: 1, get: (v, o) => v.getUint8(o), make: Uint8Array },
  int16: { size: 2, get: (v, o, l) => v.getInt16(o, l), make: Int16Array },
  uint16: { size: 2, get: (v, o, l) => v.getUint16(o, l), make: Uint16Array },
  int32: { size: 4, get: (v, o, l) => v.getInt32(o, l), make: Int32Array },
  uint32: { size: 4, get: (v, o, l) => v.getUint32(o, l), make: Uint32Array },
  float32: { size: 4, get: (v, o, l) => v.getFloat32(o, l), make: Float32Array },
  float64: { size: 8, get: (v, o, l) => v.getFloat64(o, l), make: Float64Array },
};
const ALIASES: Record<string, string> = {
  char: "int8", uchar: "uint8", short: "int16", ushort: "uint16",
  int: "int32", uint: "uint32", float: "float32", double: "float64",
}; // prettier-ignore
const LONGEST_HEADER = 1 << 20;

/** Read the vertices of a PLY file (ASCII, binary in either byte order). */
export function readPly(bytes: Uint8Array): Columns {
  const header = readHeader(bytes);
  const place = header.elements.findIndex((element) => element.name === "vertex");
  if (place < 0) throw new UnreadableCloudError("The PLY file has no element called vertex.");
  const vertex = header.elements[place];
  if (vertex.properties.some((property) => property.countType !== null)) {
    throw new UnreadableCloudError("The vertices of this PLY file carry lists.");
  }
  const before = header.elements.slice(0, place);
  return header.format === "ascii"
    ? readAscii(bytes, header, before, vertex)
    : readBinary(bytes, header, before, vertex);
}

export function readHeader(bytes: Uint8Array): Header {
  const head = new TextDecoder("latin1").decode(bytes.subarray(0, LONGEST_HEADER));
  const end = /^end_header[ \t]*(\r\n|\n|\r)/m.exec(head);
  if (end === null) throw new UnreadableCloudError("The header of the PLY file has no end.");
  const elements: Element[] = [];
  let format = "";
  for (const line of head.slice(0, end.index).split(/\r\n|\n|\r/)) {
    const words = line.trim().split(/\s+/);
    if (words[0] === "format") format = words[1];
    if (words[0] === "element") {
      elements.push({ name: words[1], count: Number(words[2]), properties: [] });
    }
    if (words[0] === "property") {
      const list = words[1] === "list";
      const [type, name] = list ? words.slice(3) : words.slice(1);
      const countType = list ? typeName(words[2]) : null;
      elements.at(-1)?.properties.push({ name, type: typeName(type), countType });
    }
  }
  return { format, elements, end: end.index + end[0].length };
}

function typeName(word: string): string {
  const name = ALIASES[word] ?? word;
  if (!(name in TYPES)) throw new UnreadableCloudError(`The PLY file has a type ${word}.`);
  return name;
}

function readAscii(bytes: Uint8Array, header: Header, before: Element[], vertex: Element): Columns {
  let offset = header.end;
  for (let lines = before.reduce((sum, element) => sum + element.count, 0); lines > 0; lines--) {
    offset = bytes.indexOf(10, offset) + 1;
  }
  const names = vertex.properties.map((property) => property.name);
  const columns = readRows(bytes.subarray(offset), names.length, vertex.count);
  return new Map(names.map((name, i) => [name, columns[i]]));
}

function readBinary(bytes: Uint8Array, header: Header, before: Element[], vertex: Element): Columns {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const little = header.format === "binary_little_endian";
  let start = header.end;
  for (const element of before) start = skip(view, start, element, little);
  const stride = vertex.properties.reduce((sum, property) => sum + TYPES[property.type].size, 0);
  if (start + stride * vertex.count > bytes.length) {
    throw new UnreadableCloudError("The PLY file ends before its last point.");
  }
  const columns: Columns = new Map();
  let within = 0;
  for (const { name, type } of vertex.properties) {
    const { size, get, make: Values } = TYPES[type];
    const values = new Values(vertex.count);
    for (let i = 0, offset = start + within; i < vertex.count; i++, offset += stride) {
      values[i] = get(view, offset, little);
    }
    columns.set(name, values);
    within += size;
  }
  return columns;
}

export function skip(view: DataView, start: number, element: Element, little: boolean): number {
  let offset = start;
  for (let i = 0; i < element.count; i++) {
    for (const { type, countType } of element.properties) {
      let items = 1;
      if (countType !== null) {
        items = TYPES[countType].get(view, offset, little);
        offset += TYPES[countType].size;
      }
      offset += items * TYPES[type].size;
    }
  }
  return offset;
}
