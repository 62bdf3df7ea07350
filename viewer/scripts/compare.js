// SPDX-License-Identifier: Apache-2.0
// Fails where the built page is not the one that the sources build, or is too large.
import { readdirSync, readFileSync } from "node:fs";
import { gzipSync } from "node:zlib";

const MOST_BYTES = 250_000;
const shipped = new URL("../../service/pugeo_service/static/", import.meta.url);
const built = new URL("../../out/page-check/", import.meta.url);

function files(folder) {
  return readdirSync(folder, { recursive: true, withFileTypes: true })
    .filter((entry) => entry.isFile())
    .map((entry) => `${entry.parentPath}/${entry.name}`.replaceAll("//", "/").replace(folder.pathname, ""))
    .sort();
}

const names = files(built);
const differs = [...new Set([...names, ...files(shipped)])].filter((name) => {
  try {
    return !readFileSync(new URL(name, built)).equals(readFileSync(new URL(name, shipped)));
  } catch {
    return true;
  }
});
if (differs.length > 0) {
  console.error(`The built page is not what viewer/ builds; run make page. Differing: ${differs.join(", ")}`);
  process.exit(1);
}
const page = names.filter((name) => !name.endsWith(".ply"));
const size = page.reduce((sum, name) => sum + gzipSync(readFileSync(new URL(name, built)), { level: 9 }).length, 0);
console.log(`The built page is up to date: ${size} bytes compressed, of at most ${MOST_BYTES}.`);
if (size > MOST_BYTES) process.exit(1);
