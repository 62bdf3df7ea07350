// SPDX-License-Identifier: Apache-2.0
import type { Drawable, Slot, Values } from "../cloud/messages";
import { MOST_DRAWN } from "../cloud/messages";
import type { Reader } from "../cloud/reader";
import type { FrameInfo, Mode, Stage } from "../view/stage";
import { byId, make, segments } from "./dom";
import { count, figure } from "./format";

const SLOTS: Slot[] = ["before", "after"];
const TITLES = { before: "Before", after: "After" };
const DISTANCE = "distance";

/** The view of both clouds with its toolbar; without WebGL it keeps the figures alone. */
export class Viewer {
  private stage: Stage | null = null;
  private readonly clouds: Record<Slot, Drawable | null> = { before: null, after: null };
  private readonly cached = new Map<string, Promise<Values>>();
  private mode: Mode = "side";
  private shown: Slot = "after";
  private coloring = "normals";
  /** Whether the colouring was chosen by hand. */
  private chosen = false;
  /** Asks the service for the surface of a cloud; is told by the page. */
  fetchSurface: (slot: Slot, signal: AbortSignal) => Promise<Blob | null> = () => Promise.resolve(null);
  /** Whether surfaces are asked for, and those there are or will be. */
  private surfaces = false;
  private readonly asked: Record<Slot, AbortController | null> = { before: null, after: null };
  private up: "y" | "z" = "z";
  private readonly swipe = byId<HTMLInputElement>("swipe");
  private readonly select = byId<HTMLSelectElement>("coloring");

  constructor(private readonly reader: Reader) {
    const choose = segments(
      byId("modes"), { side: "Side by side", swipe: "Swipe", toggle: "Toggle" },
      (name) => { this.setMode(name as Mode); },
    );
    this.swipe.oninput = () => { this.moveSwipe(); };
    byId("divider").onpointerdown = (event) => { this.dragDivider(event); };
    this.select.onchange = () => { this.chosen = true; void this.setColoring(this.select.value); };
    const size = byId<HTMLInputElement>("size");
    size.oninput = () => { this.stage?.setPointScale(2 ** Number(size.value)); };
    press("hairs", (on) => { this.stage?.setHairs(on); });
    press("surface", (on) => {
      this.surfaces = on;
      this.stage?.showSurfaces(on);
      for (const slot of SLOTS) void this.askSurface(slot);
    });
    press("spin", (on) => { this.stage?.setSpin(on); });
    byId("fit").onclick = () => { this.stage?.fit(); };
    byId("up").onclick = () => { this.turnUp(); };
    addEventListener("keydown", (event) => {
      if (isTyping(event) || event.ctrlKey || event.metaKey || event.altKey) return;
      const mode = ({ "1": "side", "2": "swipe", "3": "toggle" } as const)[event.key];
      if (mode !== undefined) { choose(mode); this.setMode(mode); }
      else if (event.key === "t") this.flip();
      else if (event.key === "n") byId("hairs").click();
      else if (event.key === "f") this.stage?.fit();
    });
  }

  /** Begin to draw; a text stands in its place where the browser cannot. */
  async start(): Promise<void> {
    const { Stage: DrawingStage } = await import("../view/stage");
    try {
      this.stage = new DrawingStage(byId("stage"));
    } catch {
      byId("no-webgl").hidden = false;
      byId("hero").hidden = true;
      return;
    }
    this.stage.onFrame = (info) => { this.showRate(info); };
    this.recolor();
    // For tests and for measuring from the console.
    (globalThis as Record<string, unknown>).pugeoStage = this.stage;
  }

  /** Show a cloud in a pane, or nothing. */
  set(slot: Slot, cloud: Drawable | null): void {
    this.clouds[slot] = cloud;
    this.cached.clear();
    this.stage?.set(slot, cloud);
    this.asked[slot]?.abort();
    this.asked[slot] = null;
    void this.askSurface(slot);
    this.arrange();
    this.offerColorings();
    void this.setColoring(this.coloring);
    byId("stage-text").textContent = SLOTS.map((each) => this.describe(each)).join(" ");
  }

  /** Write a text in the pane that is empty, or none. */
  say(text: string): void {
    byId("waiting").textContent = text;
    this.arrange();
  }

  setSpacing(slot: Slot, spacing: number): void {
    this.stage?.setSpacing(slot, spacing);
  }

  /** Colours of the theme, from the style sheet. */
  recolor(): void {
    const style = getComputedStyle(document.documentElement);
    const [background, plain, hair] = ["--stage", "--point", "--hair"].map((name) =>
      style.getPropertyValue(name).trim());
    this.stage?.setTheme(background, plain, hair);
    void this.setColoring(this.coloring);
  }

  /** Ask for the surface of a cloud, once, where surfaces are to be shown. */
  private async askSurface(slot: Slot): Promise<void> {
    if (!this.surfaces || this.stage === null || this.clouds[slot] === null || this.asked[slot] !== null) return;
    const asked = this.asked[slot] = new AbortController();
    const line = byId("surface-state");
    line.textContent = "Making surfaces …";
    const file = await this.fetchSurface(slot, asked.signal);
    if (this.asked[slot] !== asked) return;
    const surface = file && await this.reader.call("surface", { slot, file });
    if (surface === null) byId("surface").click();
    // A new cloud, or a failure, ends what was asked for.
    if (this.asked[slot] !== asked) return;
    if (surface === null) this.asked[slot] = null;
    this.stage.setSurface(slot, surface);
    line.textContent = surface === null ? "" : `Surface of ${TITLES[slot].toLowerCase()}: ${count(surface.index.length / 3)} faces.`;
  }

  private arrange(): void {
    const { before, after } = this.clouds;
    const waiting = byId("waiting");
    waiting.hidden = waiting.textContent === "" || (before !== null && after !== null);
    waiting.className = `waiting ${before === null && after === null ? "both" : before === null ? "before" : "after"}`;
    const any = this.stage !== null && (before !== null || after !== null || !waiting.hidden);
    byId("hero").hidden = any || !byId("no-webgl").hidden;
    byId("toolbar").hidden = byId("rate").hidden = !any;
    byId("divider").hidden = before === null && after === null;
    for (const slot of SLOTS) this.label(slot);
  }

  private describe(slot: Slot): string {
    const cloud = this.clouds[slot];
    return cloud === null ? "" : `${TITLES[slot]}: ${count(cloud.count)} points.`;
  }

  private label(slot: Slot): void {
    const holder = byId(`label-${slot}`);
    const cloud = this.clouds[slot];
    holder.hidden = cloud === null || (this.mode === "toggle" && this.shown !== slot);
    const parts = [make("strong", { textContent: TITLES[slot] })];
    if (cloud !== null) {
      parts.push(make("span", { textContent: `${count(cloud.count)} points` }));
      if (cloud.drawn < cloud.count) {
        const thinned = `thinned to ${count(MOST_DRAWN)} for display`;
        parts.push(make("span", { className: "small-text", textContent: thinned }));
      }
    }
    holder.replaceChildren(...parts);
  }

  private setMode(mode: Mode): void {
    // The toggle pressed once more shows the other cloud.
    if (mode === "toggle" && this.mode === "toggle") this.shown = this.shown === "after" ? "before" : "after";
    this.mode = mode;
    this.stage?.setMode(mode, this.shown);
    byId("stage").dataset.mode = mode;
    this.swipe.hidden = mode !== "swipe";
    byId("divider").hidden = mode === "toggle";
    this.moveSwipe();
    for (const slot of SLOTS) this.label(slot);
  }

  private flip(): void {
    this.mode = "toggle";
    byId("modes").querySelector<HTMLElement>("[data-name=toggle]")?.click();
  }

  private moveSwipe(): void {
    const share = this.mode === "swipe" ? Number(this.swipe.value) / 100 : 0.5;
    byId("divider").style.left = `${100 * share}%`;
    this.stage?.setSwipe(share);
  }

  private dragDivider(event: PointerEvent): void {
    if (this.mode !== "swipe") return;
    event.stopPropagation();
    const divider = byId("divider");
    divider.setPointerCapture(event.pointerId);
    const box = byId("stage").getBoundingClientRect();
    divider.onpointermove = (move) => {
      this.swipe.value = String((100 * (move.clientX - box.left)) / box.width);
      this.moveSwipe();
    };
    divider.onpointerup = () => { divider.onpointermove = null; };
  }

  private turnUp(): void {
    this.up = this.up === "z" ? "y" : "z";
    const button = byId("up");
    button.textContent = `${this.up} up`;
    button.setAttribute("aria-label", `Axis that points up: ${this.up}`);
    this.stage?.setUp(this.up);
    void this.setColoring(this.coloring);
  }

  private offerColorings(): void {
    const { before, after } = this.clouds;
    const both = [before, after].filter((cloud) => cloud !== null);
    const choices: [string, string][] = [["normals", "Shaded normals"]];
    if (both.some(({ colors }) => colors !== null)) choices.push(["rgb", "RGB"]);
    choices.push(["height", "Height"]);
    if (before !== null && after !== null) choices.push([DISTANCE, "Distance to the input"]);
    const names = new Set(both.flatMap(({ scalars }) => scalars));
    for (const name of names) {
      choices.push([`scalar:${name}`, name.charAt(0).toUpperCase() + name.slice(1).replaceAll("_", " ")]);
    }
    this.select.replaceChildren(...choices.map(([value, text]) => make("option", { value, textContent: text })));
    const [first] = choices.some(([value]) => value === "rgb") ? ["rgb"] : ["normals"];
    if (!this.chosen || !choices.some(([value]) => value === this.coloring)) this.coloring = first;
    this.select.value = this.coloring;
  }

  private async setColoring(coloring: string): Promise<void> {
    this.coloring = coloring;
    const values: Partial<Record<Slot, Values>> = {};
    const scalar = coloring.startsWith("scalar:") ? coloring.slice(7) : null;
    if (coloring === DISTANCE) values.after = await this.cache("after", () => this.reader.call("distance", null));
    else if (scalar !== null) {
      for (const slot of SLOTS) {
        if (this.clouds[slot]?.scalars.includes(scalar) !== true) continue;
        values[slot] = await this.cache(`${slot}:${scalar}`, () =>
          this.reader.call("scalar", { slot, name: scalar }));
      }
    }
    if (this.coloring !== coloring || this.stage === null) return;
    const found = Object.values(values);
    if (found.length > 1) {
      // One scale for both panes, so that equal colours are equal values.
      const [low, high] = [Math.min(...found.map((v) => v.low)), Math.max(...found.map((v) => v.high))];
      for (const slot of SLOTS) if (values[slot]) values[slot] = { ...values[slot], low, high };
    }
    const kind = coloring === "normals" || coloring === "rgb" || coloring === "height" ? coloring : "value";
    this.stage.setColoring(kind, values);
    const range = coloring === "height" ? this.heights() : found.length > 0 ? Object.values(values)[0] : null;
    byId("legend").hidden = range === null;
    if (range === null) return;
    byId("legend-title").textContent = this.select.selectedOptions.item(0)?.textContent ?? "";
    byId("legend-low").textContent = figure(range.low);
    byId("legend-high").textContent = figure(range.high);
  }

  private heights(): { low: number; high: number } {
    const origin = (this.clouds.before ?? this.clouds.after)?.origin[this.up === "z" ? 2 : 1] ?? 0;
    const [low, high] = this.stage?.heights ?? [0, 1];
    return { low: low + origin, high: high + origin };
  }

  private cache(key: string, make_: () => Promise<Values>): Promise<Values> {
    const found = this.cached.get(key) ?? make_();
    this.cached.set(key, found);
    return found;
  }

  private showRate({ drawn, total, rate, moving }: FrameInfo): void {
    const frames = rate === null ? "" : `${Math.round(rate)} frames a second · `;
    const points = total === 0 ? "surfaces drawn" : drawn < total ? `${count(drawn)} of ${count(total)} points${moving ? " while moving" : " so far"}` : `${count(total)} points drawn`;
    const line = byId("rate");
    line.textContent = frames + points;
    line.dataset.moving = String(moving);
  }
}

function press(id: string, onChange: (on: boolean) => void): void {
  const button = byId(id);
  button.onclick = () => {
    const on = button.getAttribute("aria-pressed") !== "true";
    button.setAttribute("aria-pressed", String(on));
    onChange(on);
  };
}

function isTyping(event: KeyboardEvent): boolean {
  const { target } = event;
  const text = target instanceof HTMLInputElement && ["text", "password"].includes(target.type);
  return text || target instanceof HTMLSelectElement;
}
