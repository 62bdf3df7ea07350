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

/** The part of /openapi.json that the page goes by. */
export interface Description {
  readonly options: ReadonlyMap<string, Option>;
  /** Formats that can be asked for as `format=`. */
  readonly formats: readonly string[];
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
    readonly responses?: Record<string, { readonly content?: Record<string, unknown> }>;
  }>>;
}

/** Ask the running service for its options, formats and routes. */
export async function describe(api: Api): Promise<Description> {
  const document = await api.json<OpenApi>("openapi.json");
  const parameters = document.paths["/jobs"].post.parameters ?? [];
  const options = new Map(
    parameters.filter(({ in: place }) => place === "query").map((found) => [found.name, option(found)]),
  );
  const format = options.get("format");
  const media = document.paths["/jobs/{job_id}/result"].get.responses?.["200"].content ?? {};
  options.delete("format");
  return {
    options,
    formats: format === undefined ? ["ply"] : formats(format, Object.keys(media)),
  };
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

/** Formats are listed as choices, or named at the beginning of the description. */
function formats({ choices, description }: Option, media: string[]): string[] {
  if (choices.length > 0) return [...choices];
  const [listed] = description.split(";");
  const named = listed.split(/[\s,]+|\bor\b/).filter((word) => /^[a-z][a-z0-9-]*$/.test(word));
  const npy = media.includes("application/x-npy") ? ["npy"] : [];
  return [...new Set([...named, ...npy])].filter((word) => word !== "or");
}
