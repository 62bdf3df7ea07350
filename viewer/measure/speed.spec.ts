// SPDX-License-Identifier: Apache-2.0
// Prints how long the first view takes, by its parts, and the frames a second with a million points.
import { expect, sphere, test } from "../tests/service";

const VIEWS = 5;
const POINTS = 1_000_000;
const FRAMES = 20;

interface View {
  readonly painted: number;
  readonly scripts: number;
  readonly described: number;
  readonly ready: number;
  readonly example: number;
}

function median(values: number[]): number {
  return values.sort((a, b) => a - b)[values.length >> 1];
}

test("first view", async ({ browser, service }) => {
  const views: View[] = [];
  for (let i = 0; i < VIEWS; i++) {
    // A context of its own has nothing in its cache.
    const context = await browser.newContext();
    const page = await context.newPage();
    await page.goto(service.url);
    await expect(page.locator("html[data-ready]")).toBeVisible();
    // The page may be ready before anything is painted.
    await page.waitForFunction(() => performance.getEntriesByName("first-contentful-paint").length > 0);
    const times = await page.evaluate(() => {
      const loaded = performance.getEntriesByType("resource") as PerformanceResourceTiming[];
      const end = (part: RegExp): number =>
        Math.max(...loaded.filter(({ name }) => part.test(name)).map(({ responseEnd }) => responseEnd));
      return {
        painted: performance.getEntriesByName("first-contentful-paint")[0].startTime,
        scripts: end(/\.js$/),
        described: end(/openapi\.json$/),
        ready: performance.getEntriesByName("pugeo-ready")[0].startTime,
      };
    });
    const example = await page.evaluate(() => new Promise<number>((resolve) => {
      const start = performance.now();
      const look = (): void => {
        if (/\d points drawn/.test(document.getElementById("rate")?.textContent ?? "")) resolve(performance.now() - start);
        else requestAnimationFrame(look);
      };
      document.querySelector<HTMLElement>("[data-example]")?.click();
      look();
    }));
    views.push({ ...times, example });
    await context.close();
  }
  const parts = Object.keys(views[0]) as (keyof View)[];
  for (const part of parts) {
    const found = views.map((view) => view[part]);
    console.log(`${part}: median ${median(found).toFixed(0)} ms of ${found.map((ms) => ms.toFixed(0)).join(", ")}`);
  }
  expect(views).toHaveLength(VIEWS);
});

test("frames with a million points", async ({ page, service }) => {
  await page.goto(service.url);
  await expect(page.locator("html[data-ready]")).toBeVisible();
  await page.setInputFiles("#file", { name: "million.xyz", mimeType: "text/plain", buffer: sphere(POINTS) });
  await expect(page.locator("#rate")).toContainText(`${POINTS.toLocaleString("en")} points drawn`);
  const still = await page.evaluate((frames) =>
    (globalThis as unknown as { pugeoStage: { measure(frames: number): number } }).pugeoStage.measure(frames), FRAMES);
  console.log(`all ${POINTS} points: ${still.toFixed(0)} ms a frame, ${(1000 / still).toFixed(1)} frames a second`);
  await page.click("#spin");
  await page.waitForTimeout(5000);
  const rate = await page.locator("#rate").innerText();
  console.log(`turning: ${rate}`);
  expect(rate).toContain("frames a second");
});
