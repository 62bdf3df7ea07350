// SPDX-License-Identifier: Apache-2.0
import { readFileSync } from "node:fs";
import { AxeBuilder } from "@axe-core/playwright";
import type { Page } from "@playwright/test";
import { choose, drop, expect, lit, run, sphere, test } from "./service";

const KNOT = readFileSync(new URL("../../examples/knot.ply", import.meta.url));

async function expectNoSeriousFault(page: Page): Promise<void> {
  const { violations } = await new AxeBuilder({ page }).analyze();
  const serious = violations.filter(({ impact }) => impact === "serious" || impact === "critical");
  expect(serious.map(({ id, nodes }) => `${id}: ${nodes.map(({ html }) => html).join()}`)).toEqual([]);
}

test("a dropped scan comes back dense, in both panes, with its figures", async ({ watched: page }) => {
  await drop(page, "knot.ply", KNOT);
  await expect(page.locator("#count")).toHaveText("4,000 points in, 32,000 out.");
  await run(page);
  const figures = page.locator("#figures");
  await expect(figures).toContainText("Points in4,000");
  await expect(figures).toContainText("Points out32,0008 × as many");
  await expect(page.locator("#label-before")).toContainText("4,000 points");
  await expect(page.locator("#label-after")).toContainText("32,000 points");
  await expect(page.locator("#rate")).toContainText("36,000 points drawn");
  const [left, right] = await lit(page);
  expect(left).toBeGreaterThan(0.02);
  // Eight times the points, each drawn so that they close up to a surface.
  expect(right).toBeGreaterThan(left);
  await expectNoSeriousFault(page);
});

/** What is drawn, as text. */
function picture(page: Page): Promise<string> {
  return page.evaluate(() => document.querySelector<HTMLCanvasElement>("#stage canvas")?.toDataURL() ?? "");
}

test("swipe and toggle show one cloud in the place of the other", async ({ watched: page }) => {
  await page.click("[data-example='knot.ply'] >> nth=0");
  await run(page);
  await page.click("[data-name=swipe]");
  const shares: number[] = [];
  for (const place of ["0", "100"]) {
    const former = await picture(page);
    await page.locator("#swipe").fill(place);
    // The next frame may take a while on a busy machine.
    await expect.poll(async () => (await picture(page)) !== former).toBe(true);
    await expect(page.locator("#rate")).toContainText("36,000 points drawn");
    shares.push((await lit(page)).reduce((sum, share) => sum + share));
  }
  const [after, before] = shares;
  expect(after).toBeGreaterThan(1.2 * before);
  await page.keyboard.press("3");
  await expect(page.locator("#rate")).toContainText("32,000 points drawn");
  await page.keyboard.press("t");
  await expect(page.locator("#label-before")).toBeVisible();
  await expect(page.locator("#rate")).toContainText("4,000 points drawn");
});

test("the expected error is a scalar to colour by", async ({ watched: page }) => {
  await page.click("[data-example='knot.ply'] >> nth=0");
  await page.getByLabel("Expected error").check();
  await run(page);
  const former = await picture(page);
  await page.selectOption("#coloring", "scalar:expected_error");
  await expect.poll(async () => (await picture(page)) !== former).toBe(true);
  await expect(page.locator("#legend")).toBeVisible();
});

test("colours, hairs and keys change the picture", async ({ watched: page }) => {
  await page.click("[data-example='knot.ply'] >> nth=0");
  await run(page);
  const seen = new Set<string>();
  for (const name of ["rgb", "normals", "height", "distance"]) {
    await page.selectOption("#coloring", name);
    await expect(page.locator("#legend")).toBeVisible({ visible: name === "height" || name === "distance" });
    await expect.poll(async () => !seen.has(await picture(page))).toBe(true);
    seen.add(await picture(page));
  }
  await page.click("#hairs");
  await expect.poll(async () => !seen.has(await picture(page))).toBe(true);
  seen.add(await picture(page));
  await page.focus("#stage");
  await page.keyboard.press("ArrowLeft");
  await expect.poll(async () => !seen.has(await picture(page))).toBe(true);
});

test("surfaces of both clouds take the place of the points", async ({ watched: page }) => {
  await page.click("[data-example='knot.ply'] >> nth=0");
  await run(page);
  await page.click("#surface");
  await expect(page.locator("#rate")).toContainText("surfaces drawn");
  const [left, right] = await lit(page);
  expect(left).toBeGreaterThan(0.05);
  expect(right).toBeGreaterThan(0.05);
  await expectNoSeriousFault(page);
  await page.click("#surface");
  await expect(page.locator("#rate")).toContainText("36,000 points drawn");
  await page.route("**/preview", (route) => route.fulfill({
    status: 501, contentType: "application/problem+json",
    json: { status: 501, title: "", code: "no_surfaces", detail: "There is no library.", request_id: "1234", retryable: false },
  }));
  await page.click("[data-example='block.ply'] >> nth=0");
  await page.click("#surface");
  await expect(page.locator("#problem-detail")).toHaveText("There is no library.");
  await expect(page.locator("#surface")).toHaveAttribute("aria-pressed", "false");
});

test("each format is downloaded, and is read again where the page reads it", async ({ watched: page }) => {
  await page.click("[data-example='block.ply'] >> nth=0");
  await run(page);
  const formats = await page.locator("#format option").evaluateAll((all) =>
    all.map((each) => (each as HTMLOptionElement).value));
  expect(formats).toEqual(expect.arrayContaining(["ply", "ply-ascii", "npz", "npy", "json", "xyz"]));
  const label = (await page.locator("#label-after").innerText()).replace(/^\D+/, "");
  const saved: [string, Buffer][] = [];
  for (const format of formats) {
    await page.selectOption("#format", format);
    const download = page.waitForEvent("download");
    await page.click("#download");
    const file = await download;
    expect(file.suggestedFilename()).toContain("block-dense.");
    saved.push([file.suggestedFilename(), readFileSync(await file.path())]);
    await expect(page.locator("#download")).toBeEnabled();
  }
  // Read again by the page's own readers, whichever of them the format takes.
  for (const [name, bytes] of saved) {
    await choose(page, name, bytes);
    await expect(page.locator("#file-name")).toHaveText(name);
    const drawn = /\.(ply|npz|npy|json|xyz)$/.test(name);
    if (drawn) await expect(page.locator("#label-before")).toContainText(label);
    else await expect(page.locator("#waiting")).toContainText(`${name} is not drawn here.`);
    await expect(page.locator("#problem")).toBeHidden();
  }
});

const NOT_DRAWN: [string, string][] = [
  ["scan.ptx", "2\n2\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n1 2 3 0.5\n1 2 4 0.5\n"],
  ["mesh.obj", "# made by hand\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"],
  ["mesh.stl", "solid one\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"],
];
for (const [name, text] of NOT_DRAWN) {
  test(`${name} is not drawn as rows of numbers`, async ({ watched: page }) => {
    await choose(page, name, Buffer.from(text));
    await expect(page.locator("#waiting")).toContainText(`${name} is not drawn here.`);
    await expect(page.locator("#run")).toBeEnabled();
  });
}

test("a long job is cancelled, here and in the service", async ({ watched: page, service }) => {
  await choose(page, "long.xyz", sphere(60_000));
  await page.locator("#density").fill("32");
  await page.click("#run");
  await expect(page.locator("#stage-name")).toHaveText("Finding the surface");
  const id = new URL(page.url()).hash.replace("#job=", "");
  await page.click("#cancel");
  await expect(page.locator("#progress")).toBeHidden();
  await expect.poll(async () => {
    const answer = await fetch(`${service.url}jobs/${id}`);
    return ((await answer.json()) as { state: string }).state;
  }).toBe("cancelled");
  await expect(page.locator("#jobs li").first()).toContainText("cancelled");
});

test("a reload finds the job again, with its input", async ({ watched: page }) => {
  await choose(page, "ball.xyz", sphere(3_000));
  await run(page);
  await page.reload();
  await expect(page.locator("#label-before")).toContainText("3,000 points");
  await expect(page.locator("#label-after")).toContainText("24,000 points");
  await expect(page.locator("#jobs li").first()).toContainText("ball.xyz");
  await expect(page.locator("#jobs li").first()).toContainText("3,000 → 24,000 points");
});

test("a running job is followed again after a reload", async ({ watched: page }) => {
  await choose(page, "long.xyz", sphere(12_000));
  await page.click("#run");
  await expect(page.locator("#stage-name")).toHaveText("Finding the surface");
  await page.reload();
  await expect(page.locator("#progress")).toBeVisible();
  await expect(page.locator("#label-after")).toContainText("96,000 points");
});

const BROKEN = "ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\n" +
  "property float y\nproperty float z\nend_header\nabc";
const ERRORS: [string, string, Buffer, string][] = [
  ["a truncated file", "broken.ply", Buffer.from(BROKEN), "ends too early"],
  ["what is no cloud", "picture.png", Buffer.from("\x89PNG\r\n\x1a\n\0\0\0\rIHDR", "latin1"), "no known format"],
  ["too few points", "few.xyz", sphere(5), "8"],
  ["points on a line", "line.xyz", Buffer.from(Array.from({ length: 50 }, (_, i) => `${i} 0 0`).join("\n")), "line"],
  ["too many points", "many.xyz", sphere(100_001), "100,000"],
  ["an empty file", "empty.ply", Buffer.from(""), "empty"],
];
for (const [what, name, bytes, said] of ERRORS) {
  test(`${what} is refused with a sentence and the id of the request`, async ({ watched: page }) => {
    await choose(page, name, bytes);
    await page.click("#run");
    await expect(page.locator("#problem-detail")).toContainText(said);
    await expect(page.locator("#problem-id")).toContainText(/Request [\w.:-]{8,}/);
    await expect(page.locator("#progress")).toBeHidden();
    await expectNoSeriousFault(page);
  });
}

test("an option out of its range, an unknown job, and a service that is gone", async ({ watched: page }) => {
  await page.click("[data-example='knot.ply'] >> nth=0");
  await page.locator("#density").fill("100");
  await page.click("#run");
  await expect(page.locator("#problem-detail")).toContainText("32");
  await page.evaluate(() => { location.hash = "#job=nothing"; });
  await expect(page.locator("#problem-title")).toHaveText("That is not there");
  await page.click("[data-example='knot.ply'] >> nth=0");
  await page.route("**/jobs?*", (route) => route.abort());
  await page.locator("#density").fill("2");
  await page.click("#run");
  await expect(page.locator("#problem-detail")).toContainText("cannot be reached");
  await page.unroute("**/jobs?*");
  await page.click("#retry");
  await expect(page.locator("#label-after")).toContainText("8,000 points");
});

test("the same request as code", async ({ watched: page, service }) => {
  await page.click("[data-example='knot.ply'] >> nth=0");
  await page.click("#code summary");
  await expect(page.locator("#snippet")).toContainText(`'${service.url}upsample?R=8&format=ply'`);
  await page.click("[data-code=python]");
  await expect(page.locator("#snippet")).toContainText('client.upsample("knot.ply", ratio=8)');
  await page.click("[data-code=shell]");
  await expect(page.locator("#snippet")).toHaveText("pugeo upsample knot.ply -R 8 -o dense.ply");
});

test("formats and options are those that the service describes", async ({ watched: page, service }) => {
  const address = `${service.url}openapi.json`;
  interface Named { name: string }
  const described = (await (await fetch(address)).json()) as
    { paths: Record<string, { post: { parameters: Named[]; requestBody: { "x-formats": unknown[] } } }> };
  const { post } = described.paths["/jobs"];
  const option = (name: string, schema: object): object =>
    ({ name, in: "query", schema, description: `The service says this of ${name}.` });
  const added = [
    option("spacing", { anyOf: [{ type: "number" }, { type: "null" }] }),
    option("density", { type: "string", enum: ["input", "even"], default: "input" }),
    option("max_gap", { anyOf: [{ type: "number" }, { type: "null" }] }),
    option("denoise", { type: "boolean", default: false }),
    option("of_tomorrow", { type: "string", enum: ["this", "that"], default: "this" }),
  ] as (Named & object)[];
  const names = new Set(added.map(({ name }) => name));
  post.parameters = [...post.parameters.filter(({ name }) => !names.has(name)), ...added];
  post.requestBody["x-formats"].push({ name: "lidar2", extensions: [".ld2"], written: false });
  await page.route("**/openapi.json", (route) => route.fulfill({ json: described }));
  await page.reload();
  await expect(page.locator("html[data-ready]")).toBeVisible();
  for (const name of ["PLY", "LAZ", "E57", "LIDAR2"]) await expect(page.locator("#formats")).toContainText(name);
  expect(await page.locator("#file").getAttribute("accept")).toMatch(/^\.ply,.*\.laz,.*\.ld2$/);
  await expect(page.locator("#format option[value=lidar2]")).toHaveCount(0);

  await page.click("[data-example='knot.ply'] >> nth=0");
  await page.click("#code summary");
  await page.click("#more summary");
  await expect(page.locator("#options-more")).toContainText("The service says this of of_tomorrow.");
  await page.getByLabel("Of tomorrow").selectOption("that");
  await page.getByLabel("Spread").selectOption("even");
  await page.getByLabel("Largest gap").fill("0.5");
  await page.getByLabel("Denoise alone").check();
  await expect(page.locator("#count")).toHaveText("4,000 points in, 4,000 out.");
  const snippet = page.locator("#snippet");
  for (const part of ["?R=1&", "denoise=true", "density=even", "max_gap=0.5", "of_tomorrow=that"]) {
    await expect(snippet).toContainText(part);
  }
  await page.getByRole("radio", { name: "Spacing" }).click();
  await expect(page.getByLabel("Denoise alone")).not.toBeChecked();
  await page.locator("#density").fill("0.07");
  await expect(snippet).toContainText("?spacing=0.07&");
  await expect(snippet).not.toContainText("R=");
  await expectNoSeriousFault(page);
});

for (const colorScheme of ["dark", "light"] as const) {
  test(`no serious accessibility fault: ${colorScheme}, wide and narrow`, async ({ watched: page }) => {
    await page.emulateMedia({ colorScheme });
    await expectNoSeriousFault(page);
    await page.setViewportSize({ width: 390, height: 800 });
    await page.click("[data-example='knot.ply'] >> nth=0");
    await expect(page.locator("#count")).toContainText("4,000");
    await expectNoSeriousFault(page);
    const wider = await page.evaluate(() => document.documentElement.scrollWidth - innerWidth);
    expect(wider).toBeLessThanOrEqual(0);
  });
}
