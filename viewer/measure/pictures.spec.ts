// SPDX-License-Identifier: Apache-2.0
// Takes a picture of each state of the page into out/pictures, to be looked at.
import { readFileSync } from "node:fs";
import { fileURLToPath } from "node:url";
import type { Page } from "@playwright/test";
import { choose, expect, run, sphere, test } from "../tests/service";

const FOLDER = fileURLToPath(new URL("../../out/pictures/", import.meta.url));
const KNOT = readFileSync(new URL("../../examples/knot.ply", import.meta.url));

test.use({ viewport: { width: 1440, height: 860 } });

async function take(page: Page, name: string): Promise<void> {
  await page.screenshot({ path: `${FOLDER}${name}.png` });
}

test("states", async ({ watched: page }) => {
  await take(page, "first-light");
  await page.emulateMedia({ colorScheme: "dark" });
  await take(page, "first-dark");
  await choose(page, "knot.ply", KNOT);
  await expect(page.locator("#rate")).toContainText("4,000 points drawn");
  await page.click("#more summary");
  await take(page, "options");
  await page.click("#more summary");
  await run(page);
  await expect(page.locator("#rate")).toContainText("36,000 points drawn");
  await page.locator("#scan-title").scrollIntoViewIfNeeded();
  await take(page, "page");
  await page.selectOption("#coloring", "distance");
  await expect(page.locator("#legend")).toBeVisible();
  await take(page, "distance");
  await page.selectOption("#coloring", "normals");
  await page.click("#hairs");
  await expect(page.locator("#rate")).toContainText("36,000 points drawn");
  await take(page, "hairs");
  await page.click("#hairs");
  await page.click("[data-name=swipe]");
  await expect(page.locator("#rate")).toContainText("36,000 points drawn");
  await take(page, "swipe");
  await page.click("[data-name=side]");
  await page.click("#surface");
  await expect(page.locator("#rate")).toContainText("surfaces drawn");
  await take(page, "surfaces");
  await page.click("#code summary");
  await page.locator("#snippet").scrollIntoViewIfNeeded();
  await take(page, "code");
  await page.emulateMedia({ colorScheme: "light" });
  await take(page, "surfaces-light");
  await page.setViewportSize({ width: 390, height: 844 });
  await take(page, "phone");
});

test("errors and progress", async ({ watched: page }) => {
  await choose(page, "few.xyz", sphere(5));
  await page.click("#run");
  await expect(page.locator("#problem-id")).toBeVisible();
  await take(page, "error");
  await choose(page, "long.xyz", sphere(60_000));
  await page.click("#run");
  await expect(page.locator("#stage-name")).toHaveText("Finding the surface");
  await take(page, "progress");
  await page.click("#cancel");
});
