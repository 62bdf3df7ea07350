// SPDX-License-Identifier: Apache-2.0
import { Color, PerspectiveCamera, Vector3, WebGLRenderer } from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import type { Drawable, Slot, Surface, Values } from "../cloud/messages";
import { Pacer } from "./pacer";
import { Pane } from "./pane";
import { rampTexture } from "./ramp";
import type { Coloring } from "./shaders";

export type Mode = "side" | "swipe" | "toggle";

/** Facts about the last frame. */
export interface FrameInfo {
  readonly drawn: number;
  readonly total: number;
  readonly rate: number | null;
  readonly moving: boolean;
}

const STILL_MS = 220;
const KEYS: Partial<Record<string, [number, number]>> = {
  ArrowLeft: [-0.12, 0], ArrowRight: [0.12, 0], ArrowUp: [0, -0.12], ArrowDown: [0, 0.12],
}; // prettier-ignore

/** Both clouds on one canvas, seen by one camera. */
export class Stage {
  readonly panes: Record<Slot, Pane>;
  /** Is called after each frame. */
  onFrame: (info: FrameInfo) => void = () => undefined;
  private readonly renderer: WebGLRenderer;
  private readonly camera = new PerspectiveCamera(40, 1, 0.01, 1000);
  private controls: OrbitControls;
  private readonly pacer = new Pacer();
  private readonly size = { width: 1, height: 1 };
  private mode: Mode = "side";
  private shown: Slot = "after";
  private swipe = 0.5;
  private radius = 1;
  private pointScale = 1;
  private scheduled = false;
  /** Share of the points that the picture has so far. */
  private painted = 0;
  private lastMotion = -Infinity;
  private colors = { background: new Color(), plain: new Color(), hair: new Color() };
  private hairs = false;
  /** Whether somebody has moved the camera since it was set to all there is. */
  private touched = false;

  /**
   * @param holder gets the canvas, and the focus for keys.
   * @throws Error where the browser has no WebGL 2.
   */
  constructor(private readonly holder: HTMLElement) {
    this.renderer = new WebGLRenderer({
      powerPreference: "high-performance",
      // A picture at rest is drawn in several frames, each on top of the one before.
      preserveDrawingBuffer: true,
    });
    this.renderer.autoClear = false;
    this.renderer.setPixelRatio(Math.min(2, devicePixelRatio));
    this.renderer.domElement.setAttribute("aria-hidden", "true");
    holder.prepend(this.renderer.domElement);
    const ramp = rampTexture();
    this.panes = { before: new Pane(ramp), after: new Pane(ramp) };
    this.camera.up.set(0, 0, 1);
    this.controls = this.makeControls();
    holder.addEventListener("keydown", (event) => { this.onKey(event); });
    new ResizeObserver(() => { this.resize(); }).observe(holder);
    this.resize();
  }

  /** Show a cloud in a pane, or nothing; look at it where it is the first one. */
  set(slot: Slot, cloud: Drawable | null): void {
    const first = this.panes.before.cloud === null && this.panes.after.cloud === null;
    this.panes[slot].set(cloud);
    this.measureHeights();
    if (first && cloud !== null) this.fit();
    this.applySizes();
    this.draw();
  }

  setMode(mode: Mode, shown: Slot = this.shown): void {
    this.mode = mode;
    this.shown = shown;
    this.resize();
  }

  setSwipe(share: number): void {
    this.swipe = share;
    this.draw();
  }

  setPointScale(scale: number): void {
    this.pointScale = scale;
    this.applySizes();
    this.draw();
  }

  setSpacing(slot: Slot, spacing: number): void {
    this.panes[slot].spacing = spacing;
    this.applySizes();
    this.setHairs(this.hairs);
  }

  setHairs(shown: boolean): void {
    this.hairs = shown;
    for (const pane of Object.values(this.panes)) pane.showHairs(shown, this.colors.hair);
    this.draw();
  }

  /** Keep a surface of a cloud, or none. */
  setSurface(slot: Slot, surface: Surface | null): void {
    this.panes[slot].setSurface(surface);
    this.draw();
  }

  /** Show surfaces in the place of the points, or the points. */
  showSurfaces(shown: boolean): void {
    for (const pane of Object.values(this.panes)) pane.showSurface(shown);
    this.draw();
  }

  setSpin(spinning: boolean): void {
    this.controls.autoRotate = spinning;
    this.moved();
  }

  setUp(axis: "y" | "z"): void {
    this.camera.up.set(0, axis === "y" ? 1 : 0, axis === "z" ? 1 : 0);
    // They read the axis once, when they are made.
    const spinning = this.controls.autoRotate;
    this.controls.dispose();
    this.controls = this.makeControls();
    this.controls.autoRotate = spinning;
    this.measureHeights();
    this.fit();
  }

  /** Colour both clouds; `values` are those of the panes that have any. */
  setColoring(coloring: Coloring, values: Partial<Record<Slot, Values>>): void {
    for (const slot of ["before", "after"] as const) {
      const found = coloring === "value" ? (values[slot] ?? null) : null;
      this.panes[slot].color(coloring, this.camera.up, found, this.colors.plain);
    }
    this.draw();
  }

  /** Heights of both clouds, lowest and highest, above the common origin. */
  get heights(): [number, number] {
    return this.panes.before.heights;
  }

  setTheme(background: string, plain: string, hair: string): void {
    // The renderer converts the background alone; the shaders write colours as they are.
    const [p, h] = [plain, hair].map((text) => new Color().setStyle(text, ""));
    this.colors = { background: new Color(background), plain: p, hair: h };
    this.setHairs(this.hairs);
  }

  /** Look at all there is, from a corner. */
  fit(): void {
    const clouds = Object.values(this.panes).flatMap(({ cloud }) => (cloud === null ? [] : [cloud]));
    if (clouds.length === 0) return;
    const low = new Vector3(...clouds[0].low);
    const high = new Vector3(...clouds[0].high);
    for (const cloud of clouds) {
      low.min(new Vector3(...cloud.low));
      high.max(new Vector3(...cloud.high));
    }
    this.radius = 0.5 * low.distanceTo(high) || 1;
    const center = low.add(high).multiplyScalar(0.5);
    const narrow = Math.min(1, this.camera.aspect);
    const distance = (0.86 * this.radius) / Math.tan((this.camera.fov * Math.PI) / 360) / narrow;
    const direction = this.camera.up.y > 0.5 ? new Vector3(0.62, 0.42, 1) : new Vector3(0.62, -1, 0.55);
    this.controls.target.copy(center);
    this.camera.position.copy(center).addScaledVector(direction.normalize(), distance);
    this.controls.minDistance = this.radius / 1000;
    this.controls.maxDistance = this.radius * 40;
    this.controls.update();
    this.touched = false;
    this.moved();
  }

  /** Milliseconds of frames that draw all points, one after the other, each waited for. */
  measure(frames: number): number {
    const start = performance.now();
    for (let i = 0; i < frames; i++) {
      this.camera.position.sub(this.controls.target).applyAxisAngle(this.camera.up, 0.02)
        .add(this.controls.target);
      this.camera.lookAt(this.controls.target);
      this.paint(0, 1);
      // Reading a pixel waits until all of them are there.
      const gl = this.renderer.getContext();
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    }
    return (performance.now() - start) / frames;
  }

  /** Draw anew. */
  draw(): void {
    this.painted = 0;
    this.schedule();
  }

  private schedule(): void {
    if (this.scheduled) return;
    this.scheduled = true;
    requestAnimationFrame((time) => { this.frame(time); });
  }

  private makeControls(): OrbitControls {
    const controls = new OrbitControls(this.camera, this.holder);
    controls.enableDamping = true;
    controls.dampingFactor = 0.12;
    controls.addEventListener("change", () => { this.moved(); });
    controls.addEventListener("start", () => { this.touched = true; });
    return controls;
  }

  private moved(): void {
    this.lastMotion = performance.now();
    this.draw();
  }

  private frame(time: number): void {
    this.scheduled = false;
    const moving = performance.now() - this.lastMotion < STILL_MS;
    if (moving || this.controls.autoRotate) this.controls.update();
    const total = this.visible().reduce((sum, slot) => sum + this.panes[slot].drawn, 0);
    const budget = this.pacer.points(total);
    const from = moving ? 0 : this.painted;
    const to = total === 0 ? 1 : Math.min(1, from + budget / total);
    this.paint(from, to);
    this.painted = to;
    this.pacer.frame(time, (to - from) * total, moving);
    if (moving || to < 1) this.schedule();
    else this.pacer.rest();
    const drawn = Math.round(to * total);
    this.onFrame({ drawn, total, rate: this.pacer.rate, moving });
  }

  private visible(): Slot[] {
    return this.mode === "toggle" ? [this.shown] : ["before", "after"];
  }

  /** Draw these shares of the points of each pane; from 0 on an empty ground, else on what is there. */
  private paint(from: number, to: number): void {
    const { renderer, camera, size } = this;
    const distance = camera.position.distanceTo(this.controls.target);
    camera.near = Math.max(distance / 1000, distance - 4 * this.radius);
    camera.far = distance + 4 * this.radius;
    camera.updateProjectionMatrix();
    if (from === 0) {
      renderer.setScissorTest(false);
      renderer.setClearColor(this.colors.background, 1);
      renderer.clear();
    }
    renderer.setScissorTest(true);
    const half = size.width / 2;
    const cut = this.swipe * size.width;
    for (const slot of this.visible()) {
      const pane = this.panes[slot];
      const after = slot === "after";
      if (this.mode === "side") {
        renderer.setViewport(after ? half : 0, 0, half, size.height);
        renderer.setScissor(after ? half : 0, 0, half, size.height);
      } else {
        renderer.setViewport(0, 0, size.width, size.height);
        if (this.mode === "toggle") renderer.setScissor(0, 0, size.width, size.height);
        else if (after) renderer.setScissor(cut, 0, size.width - cut, size.height);
        else renderer.setScissor(0, 0, cut, size.height);
      }
      pane.depth(distance - this.radius, distance + this.radius);
      pane.part(from, to);
      renderer.render(pane.scene, camera);
    }
  }

  private applySizes(): void {
    const { before, after } = this.panes;
    const guess = this.radius / 200;
    const pixels = this.renderer.getPixelRatio();
    const perUnit = (0.5 * pixels * this.size.height) / Math.tan((this.camera.fov * Math.PI) / 360);
    const least = 1.5 * pixels * Math.min(1, this.pointScale);
    // The input stays a set of points to the eye; the points of the output close up to a surface.
    before.size(0.5 * this.pointScale * (before.spacing || guess), perUnit, least);
    after.size(1.6 * this.pointScale * (after.spacing || guess), perUnit, least);
  }

  private measureHeights(): void {
    const axis = this.camera.up.y > 0.5 ? 1 : 2;
    const clouds = Object.values(this.panes).flatMap(({ cloud }) => (cloud === null ? [] : [cloud]));
    const range: [number, number] = [
      Math.min(...clouds.map(({ low }) => low[axis])),
      Math.max(...clouds.map(({ high }) => high[axis])),
    ];
    for (const pane of Object.values(this.panes)) pane.heights = range;
  }

  private resize(): void {
    const { clientWidth: width, clientHeight: height } = this.holder;
    if (width === 0 || height === 0) return;
    this.size.width = width;
    this.size.height = height;
    this.renderer.setSize(width, height);
    this.camera.aspect = (this.mode === "side" ? width / 2 : width) / height;
    this.applySizes();
    if (!this.touched) this.fit();
    this.draw();
  }

  private onKey(event: KeyboardEvent): void {
    const turn = KEYS[event.key];
    if (event.ctrlKey || event.metaKey || event.altKey || event.target !== this.holder) return;
    const offset = this.camera.position.clone().sub(this.controls.target);
    if (turn !== undefined) {
      const side = new Vector3().crossVectors(this.camera.up, offset).normalize();
      const steep = this.camera.up.angleTo(offset) + turn[1];
      offset.applyAxisAngle(this.camera.up, turn[0]);
      if (steep > 0.05 && steep < Math.PI - 0.05) offset.applyAxisAngle(side, turn[1]);
    } else if (event.key === "+" || event.key === "=") offset.multiplyScalar(0.85);
    else if (event.key === "-") offset.multiplyScalar(1 / 0.85);
    else return;
    event.preventDefault();
    this.touched = true;
    this.camera.position.copy(this.controls.target).add(offset);
    this.controls.update();
    this.moved();
  }
}
