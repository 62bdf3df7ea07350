// SPDX-License-Identifier: Apache-2.0
// A real service for the tests of the page, and a page that watches for faults.
import { spawn } from "node:child_process";
import { once } from "node:events";
import { mkdtempSync } from "node:fs";
import { createServer, request as send } from "node:http";
import type { AddressInfo } from "node:net";
import { tmpdir } from "node:os";
import { createInterface } from "node:readline";
import { fileURLToPath } from "node:url";
import { expect, type Page, test as base } from "@playwright/test";

const ROOT = fileURLToPath(new URL("../../", import.meta.url));
/** The first start of all compiles kernels. */
export const READY_MS = 240_000;

interface Running {
  readonly url: string;
  stop(): Promise<void>;
}

/** Start a service on a free port, and wait until it is ready. */
export async function startService(options: string[], env: Record<string, string> = {}): Promise<Running> {
  const folder = mkdtempSync(`${tmpdir()}/pugeo-page-`);
  const python = process.env.PUGEO_PYTHON ?? `${ROOT}.venv/bin/python`;
  const paths = ["client", "model", "service"].map((part) => ROOT + part).join(":");
  const child = spawn(python, ["-m", "pugeo_service", "--port", "0", "--log-level", "warning", ...options], {
    env: { ...process.env, PYTHONPATH: paths, PUGEO_SPOOL_DIR: folder, ...env },
    stdio: ["ignore", "pipe", "inherit"],
  });
  const lines = createInterface({ input: child.stdout });
  const [line] = (await once(lines, "line")) as [string];
  const url = `${line.split(" ").at(-1) ?? ""}/`;
  const end = Date.now() + READY_MS;
  while (!(await fetch(`${url}health/ready`).then((r) => r.ok, () => false))) {
    if (Date.now() > end || child.exitCode !== null) throw new Error("The service did not become ready.");
    await new Promise((resolve) => setTimeout(resolve, 200));
  }
  return {
    url,
    async stop() {
      child.kill("SIGTERM");
      if (child.exitCode === null) await once(child, "exit");
    },
  };
}

/** Serve a service under a path prefix, as a proxy does. */
export async function startProxy(target: string, prefix: string): Promise<Running> {
  const proxy = createServer((incoming, outgoing) => {
    const path = incoming.url ?? "";
    if (!path.startsWith(prefix)) {
      outgoing.writeHead(404).end();
      return;
    }
    const { method, headers } = incoming;
    const upstream = send(new URL(path.slice(prefix.length), target), { method: method ?? "GET", headers }, (answer) => {
      outgoing.writeHead(answer.statusCode ?? 502, answer.headers);
      answer.pipe(outgoing);
    });
    upstream.on("error", () => outgoing.destroy());
    outgoing.on("close", () => upstream.destroy());
    incoming.pipe(upstream);
  });
  proxy.listen(0, "127.0.0.1");
  await once(proxy, "listening");
  const { port } = proxy.address() as AddressInfo;
  return {
    url: `http://127.0.0.1:${port}${prefix}`,
    stop() {
      proxy.closeAllConnections();
      return new Promise((resolve) => proxy.close(() => { resolve(); }));
    },
  };
}

/** Points spread evenly on a sphere, one a line. */
export function sphere(count: number): Buffer {
  const lines = Array.from({ length: count }, (_, i) => {
    const polar = Math.acos(1 - (2 * (i + 0.5)) / count);
    const turn = Math.PI * (1 + Math.sqrt(5)) * (i + 0.5);
    return [Math.cos(turn) * Math.sin(polar), Math.sin(turn) * Math.sin(polar), Math.cos(polar)]
      .map((value) => value.toFixed(6)).join(" ");
  });
  return Buffer.from(lines.join("\n"));
}

/** Share of lit pixels in the left and the right half of the view. */
export function lit(page: Page): Promise<[number, number]> {
  return page.evaluate(() => {
    const canvas = document.querySelector<HTMLCanvasElement>("#stage canvas");
    if (canvas === null) throw new Error("Nothing is drawn.");
    const copy = document.createElement("canvas");
    [copy.width, copy.height] = [canvas.width, canvas.height];
    const context = copy.getContext("2d");
    if (context === null) throw new Error("There is no second canvas.");
    context.drawImage(canvas, 0, 0);
    const { data } = context.getImageData(0, 0, copy.width, copy.height);
    const found: [number, number] = [0, 0];
    for (let i = 0; i < data.length; i += 4) {
      const differs = [0, 1, 2].some((c) => Math.abs(data[i + c] - data[c]) > 24);
      if (differs) found[(i / 4) % copy.width < copy.width / 2 ? 0 : 1]++;
    }
    const half = (copy.width * copy.height) / 2;
    return [found[0] / half, found[1] / half] as [number, number];
  });
}

/** Choose a file in the page. */
export async function choose(page: Page, name: string, buffer: Buffer): Promise<void> {
  await page.setInputFiles("#file", { name, mimeType: "application/octet-stream", buffer });
}

/** Drop a file onto the page, as from a file manager. */
export async function drop(page: Page, name: string, buffer: Buffer): Promise<void> {
  const transfer = await page.evaluateHandle(({ name: file, base64 }) => {
    const bytes = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
    const made = new DataTransfer();
    made.items.add(new File([bytes], file));
    return made;
  }, { name, base64: buffer.toString("base64") });
  await page.dispatchEvent("#stage", "drop", { dataTransfer: transfer });
}

/** Press the button and wait until result and figures are there. */
export async function run(page: Page): Promise<void> {
  await page.click("#run");
  await expect(page.locator("#result")).toBeVisible();
  await expect(page.locator("#figures")).not.toContainText("–");
}

export const test = base.extend<{ watched: Page }, { service: Running }>({
  service: [
    // eslint-disable-next-line no-empty-pattern -- Playwright asks for this form
    async ({}, use) => {
      const running = await startService(["--max-points", "100000"]);
      await use(running);
      await running.stop();
    },
    { scope: "worker", timeout: READY_MS },
  ],
  // The page, opened; at the end it must have asked nobody else, and logged no error.
  watched: async ({ page, service }, use) => {
    const faults: string[] = [];
    page.on("console", (message) => {
      // Chromium itself logs each answer that is an error; the tests of errors expect them.
      const own = message.text().startsWith("Failed to load resource");
      if (message.type() === "error" && !own) faults.push(message.text());
    });
    page.on("pageerror", (error) => faults.push(error.message));
    page.on("request", (request) => {
      const url = new URL(request.url());
      if (url.protocol.startsWith("http") && url.origin !== new URL(service.url).origin) faults.push(request.url());
    });
    await page.goto(service.url);
    await expect(page.locator("html[data-ready]")).toBeVisible();
    await use(page);
    expect(faults).toEqual([]);
  },
});

export { expect };
