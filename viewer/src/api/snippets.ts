// SPDX-License-Identifier: Apache-2.0

export interface Snippets {
  readonly curl: string;
  readonly python: string;
  readonly shell: string;
}

const PYTHON_NAMES: Record<string, string> = { R: "ratio" };
const SHELL_NAMES: Record<string, string> = { R: "-R" };

/**
 * Write the request of this page as commands to copy.
 *
 * @param file name of the input.
 * @param query options, as the page sends them.
 * @param service address of the service.
 * @param keyed whether the service asks for a key.
 * @param format of the answer.
 * @param suffix of a file in this format, with the dot.
 */
export function snippets(
  file: string, query: URLSearchParams, service: URL, keyed: boolean, format: string, suffix: string,
): Snippets {
  const options = [...query].filter(([name]) => name !== "format");
  const dense = `dense${suffix}`;
  const address = new URL("upsample", service);
  address.search = new URLSearchParams([...options, ["format", format]]).toString();
  const key = keyed ? ` -H "Authorization: Bearer $PUGEO_API_KEY"` : "";
  const curl = `curl${key} --data-binary @${quote(file)} \\\n  ${quote(address.href)} \\\n  -o ${dense}`;
  const asked = format === "ply" ? options : [...options, ["format", format]];
  const given = asked.map(([name, value]) => `, ${PYTHON_NAMES[name] ?? name}=${literal(name, value)}`);
  const python =
    `from pugeo_client import Client\n\nwith Client(${JSON.stringify(trimmed(service))}) as client:\n` +
    `    dense = client.upsample(${JSON.stringify(file)}${given.join("")})\n` +
    `    dense.save(${JSON.stringify(dense)})`;
  const flags = options.map(([name, value]) => {
    const flag = SHELL_NAMES[name] ?? `--${name.replaceAll("_", "-")}`;
    if (value === "true") return ` ${flag}`;
    return value === "false" ? "" : ` ${flag} ${quote(value)}`;
  });
  const written = format === "ply-ascii" ? " --format ply-ascii" : "";
  const shell = `pugeo upsample ${quote(file)}${flags.join("")}${written} -o ${dense}`;
  return { curl, python, shell };
}

function trimmed(service: URL): string {
  return service.href.replace(/\/$/, "");
}

function quote(text: string): string {
  return /^[\w./:=-]+$/.test(text) ? text : `'${text.replaceAll("'", `'\\''`)}'`;
}

function literal(name: string, value: string): string {
  if (value === "true" || value === "false") return value === "true" ? "True" : "False";
  if (name === "viewpoint") {
    const places = value.split(";").map((place) => `(${place.split(",").map((part) => part.trim()).join(", ")})`);
    return places.length === 1 ? places[0] : `[${places.join(", ")}]`;
  }
  return value !== "" && Number.isFinite(Number(value)) ? value : JSON.stringify(value);
}
