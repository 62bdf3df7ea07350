// SPDX-License-Identifier: Apache-2.0
import { defineConfig } from "@playwright/test";

export default defineConfig({
  projects: [{ name: "tests", testDir: "tests" }, { name: "measure", testDir: "measure" }],
  outputDir: "../out/page-tests",
  workers: 1,
  // A service on a busy machine, and a browser that draws without a graphics card.
  timeout: 240_000,
  globalTimeout: 30 * 60_000,
  expect: { timeout: 120_000 },
  reporter: "list",
  use: {
    viewport: { width: 1280, height: 800 },
    acceptDownloads: true,
    launchOptions: {
      executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
      args: ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"],
    },
  },
});
