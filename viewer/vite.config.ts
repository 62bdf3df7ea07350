// SPDX-License-Identifier: Apache-2.0
import { readFileSync } from "node:fs";
import { fileURLToPath } from "node:url";
import { defineConfig, type Plugin } from "vite";

const EXAMPLES = ["knot.ply", "block.ply"];

/** Copy the examples of the repository beside the page, so that each is one click away. */
function examples(): Plugin {
  return {
    name: "examples",
    apply: "build",
    generateBundle() {
      for (const name of EXAMPLES) {
        const source = readFileSync(new URL(`../examples/${name}`, import.meta.url));
        this.emitFile({ type: "asset", fileName: `assets/${name}`, source });
      }
    },
  };
}

export default defineConfig({
  // Relative addresses: the page also works behind the path prefix of a proxy.
  base: "./",
  plugins: [examples()],
  build: {
    outDir: fileURLToPath(new URL("../service/pugeo_service/static", import.meta.url)),
    emptyOutDir: true,
    target: "es2022",
    modulePreload: { polyfill: false },
    // A data: address would be refused by the page's Content-Security-Policy.
    assetsInlineLimit: 0,
  },
  worker: { format: "es" },
});
