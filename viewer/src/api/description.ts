// SPDX-License-Identifier: Apache-2.0
import type { Api } from "./client";

interface Schema {
  readonly type?: string;
  readonly enum?: readonly string[];
  readonly default?: string | number | boolean | null;
  readonly minimum?: number;
  readonly maximum?: number;
  readonly anyOf?: readonly Schema[];
}

/** An option of an upsampling, as the running service describes it. */
export interface Option {
  readonly name: string;
  readonly description: string;
  readonly type: string;
  readonly choices: readonly string[];
  readonly fallback: string;
}

/** A file format that the running service reads. */
export interface Format {
  readonly name: string;
  /** Suffixes of file names, with the dot. */
  readonly extensions: readonly string[];
  /** Whether it can be asked for as `format=`. */
  readonly written: boolean;
}

/** The part of /openapi.json that the page goes by. */
export interface Description {
  readonly options: ReadonlyMap<string, Option>;
  readonly formats: readonly Format[];
}

interface Parameter {
  readonly name: string;
  readonly in: string;
  readonly description?: string;
  readonly schema: Schema;
}

interface OpenApi {
  readonly paths: Record<string, Record<string, {
    readonly parameters?: readonly Parameter[];
    readonly requestBody?: { readonly "x-formats": readonly Format[] };
  }>>;
}

/** Ask the running service for its options and formats. */
export async function describe(api: Api): Promise<Description> {
  const document = await api.json<OpenApi>("openapi.json");
  const { parameters = [], requestBody } = document.paths["/jobs"].post;
  const options = new Map(
    parameters.filter(({ in: place }) => place === "query").map((found) => [found.name, option(found)]),
  );
  options.delete("format");
  return { options, formats: requestBody?.["x-formats"] ?? [] };
}

/** Suffix of a file in a format, with the dot; PLY as text has that of PLY. */
export function suffixOf(formats: readonly Format[], name: string): string {
  return formats.find((format) => format.name === name)?.extensions[0] ?? ".ply";
}

function option({ name, description, schema }: Parameter): Option {
  const schemas = [schema, ...(schema.anyOf ?? [])];
  const given = schema.default;
  return {
    name,
    description: description ?? "",
    type: schemas.find((found) => found.type !== undefined && found.type !== "null")?.type ?? "string",
    choices: schemas.flatMap((found) => found.enum ?? []),
    fallback: given === undefined || given === null ? "" : String(given),
  };
}
