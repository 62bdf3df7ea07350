// SPDX-License-Identifier: Apache-2.0
import { createHash } from "node:crypto";
import { chromium } from "@playwright/test";
import { choose, expect, READY_MS, run, sphere, startProxy, startService, test } from "./service";

test("behind a path prefix, with an API key", async ({ page }) => {
  test.setTimeout(2 * READY_MS);
  const key = "pugeo_only-for-this-test";
  const entry = `tester:${createHash("sha256").update(key).digest("hex")}`;
  const service = await startService(["--workers", "1"], { PUGEO_API_KEYS: entry });
  const proxy = await startProxy(service.url, "/tools/pugeo/");
  const strangers: string[] = [];
  page.on("request", (request) => {
    const url = new URL(request.url());
    if (url.protocol.startsWith("http") && !request.url().startsWith(proxy.url)) strangers.push(request.url());
  });
  try {
    await page.goto(proxy.url);
    await expect(page.locator("#key-dialog")).toBeVisible();
    await page.fill("#key", "wrong");
    await page.keyboard.press("Enter");
    await expect(page.locator("#key-text")).toContainText("does not know this key");
    await page.fill("#key", key);
    await page.keyboard.press("Enter");
    await expect(page.locator("#key-dialog")).toBeHidden();
    await choose(page, "ball.xyz", sphere(2_000));
    await run(page);
    await expect(page.locator("#label-after")).toContainText("16,000 points");
    await expect(page.locator("#jobs li")).toHaveCount(1);
    await page.click("#code summary");
    await expect(page.locator("#snippet")).toContainText(`${proxy.url}upsample`);
    await expect(page.locator("#snippet")).toContainText("$PUGEO_API_KEY");
    expect(strangers).toEqual([]);
  } finally {
    await proxy.stop();
    await service.stop();
  }
});

test("without WebGL the page says so, and still makes results", async ({ service }) => {
  const browser = await chromium.launch({
    executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
    args: ["--no-sandbox", "--disable-gpu", "--disable-3d-apis"],
  });
  const page = await browser.newPage();
  await page.goto(service.url);
  await expect(page.locator("#no-webgl")).toBeVisible();
  await choose(page, "ball.xyz", sphere(2_000));
  await run(page);
  await expect(page.locator("#figures")).toContainText("Points out16,000");
  const saved = page.waitForEvent("download");
  await page.click("#download");
  expect((await saved).suggestedFilename()).toBe("ball-dense.ply");
  await browser.close();
});

test("the policy of the page lets nothing else in", async ({ service }) => {
  for (const path of ["", "assets/icon.svg"]) {
    const answer = await fetch(service.url + path);
    expect(answer.status).toBe(200);
    const policy = answer.headers.get("content-security-policy") ?? "";
    expect(policy).toContain("default-src 'self'");
    expect(policy).not.toContain("unsafe");
    expect(policy).not.toContain("http");
  }
  expect((await fetch(`${service.url}assets/..%2findex.html`)).status).toBe(404);
});
