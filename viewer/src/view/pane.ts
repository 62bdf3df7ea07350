// SPDX-License-Identifier: Apache-2.0
import {
  BufferAttribute, BufferGeometry, Color, DataTexture, DoubleSide, GLSL3, InstancedBufferAttribute,
  InstancedBufferGeometry, LineSegments, Mesh, Points, RawShaderMaterial, Scene, Vector2, Vector3,
} from "three"; // prettier-ignore
import type { Drawable, Surface, Values } from "../cloud/messages";
import {
  type Coloring, COLORINGS, FACE_FRAGMENT, HAIR_FRAGMENT, HAIR_VERTEX, POINT_FRAGMENT, POINT_VERTEX,
} from "./shaders"; // prettier-ignore

const MOST_HAIRS = 8_000;
const HAIR_SPACINGS = 2.5;

/** One of the two views: a cloud, and its normals as hairs. */
export class Pane {
  readonly scene = new Scene();
  cloud: Drawable | null = null;
  /** Ranges that height and values are coloured in. */
  heights: [number, number] = [0, 1];
  values: Values | null = null;
  spacing = 0;
  private points: Points<BufferGeometry, RawShaderMaterial> | null = null;
  private hairs: LineSegments<InstancedBufferGeometry, RawShaderMaterial> | null = null;
  private hairsShown = false;
  private surface: Mesh<BufferGeometry, RawShaderMaterial> | null = null;
  private surfaceShown = false;
  private readonly uniforms = {
    uColor: { value: 0 as number },
    uHasNormals: { value: false },
    uHasColors: { value: false },
    uDiameter: { value: 1 },
    uPixels: { value: 1 },
    uLeast: { value: 1 },
    uRange: { value: new Vector2(0, 1) },
    uUp: { value: new Vector3(0, 0, 1) },
    uPlain: { value: new Color() },
    uDepth: { value: new Vector2(0, 1) },
  };
  private readonly hairUniforms = { uLength: { value: 1 }, uHair: { value: new Color() } };
  private readonly material: RawShaderMaterial;
  private readonly hairMaterial: RawShaderMaterial;
  private readonly faceMaterial: RawShaderMaterial;

  constructor(ramp: DataTexture) {
    this.material = new RawShaderMaterial({
      glslVersion: GLSL3,
      vertexShader: POINT_VERTEX,
      fragmentShader: POINT_FRAGMENT,
      uniforms: { ...this.uniforms, uRamp: { value: ramp } },
    });
    this.faceMaterial = new RawShaderMaterial({
      glslVersion: GLSL3,
      vertexShader: POINT_VERTEX,
      fragmentShader: FACE_FRAGMENT,
      side: DoubleSide,
      uniforms: {
        ...this.uniforms, uRamp: { value: ramp },
        uColor: { value: COLORINGS.normals }, uHasNormals: { value: true }, uHasColors: { value: false },
      },
    });
    this.hairMaterial = new RawShaderMaterial({
      glslVersion: GLSL3,
      vertexShader: HAIR_VERTEX,
      fragmentShader: HAIR_FRAGMENT,
      uniforms: this.hairUniforms,
    });
  }

  /** Show a cloud in the place of the one before. */
  set(cloud: Drawable | null): void {
    this.clear();
    this.cloud = cloud;
    if (cloud === null) return;
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(cloud.positions, 3));
    if (cloud.normals !== null) {
      geometry.setAttribute("normal", new BufferAttribute(cloud.normals, 4, true));
    }
    if (cloud.colors !== null) {
      geometry.setAttribute("color", new BufferAttribute(cloud.colors, 4, true));
    }
    this.points = new Points(geometry, this.material);
    this.points.frustumCulled = false;
    this.scene.add(this.points);
    const { uniforms } = this;
    uniforms.uHasNormals.value = cloud.normals !== null;
    uniforms.uHasColors.value = cloud.colors !== null;
  }

  /** Points to draw: none where a surface is in their place. */
  get drawn(): number {
    return this.surface !== null && this.surfaceShown ? 0 : (this.cloud?.drawn ?? 0);
  }

  /** Keep a surface of the cloud, or none. */
  setSurface(surface: Surface | null): void {
    if (this.surface !== null) {
      this.scene.remove(this.surface);
      this.surface.geometry.dispose();
    }
    this.surface = null;
    if (surface === null) return;
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(surface.positions, 3));
    geometry.setAttribute("normal", new BufferAttribute(surface.normals, 4, true));
    geometry.setIndex(new BufferAttribute(surface.index, 1));
    this.surface = new Mesh(geometry, this.faceMaterial);
    this.surface.frustumCulled = false;
    this.scene.add(this.surface);
  }

  /** Show the surface in the place of the points, where there is one. */
  showSurface(shown: boolean): void {
    this.surfaceShown = shown;
  }

  /** Colour the points; `values` are theirs where the colouring is `value`. */
  color(coloring: Coloring, up: Vector3, values: Values | null, plain: Color): void {
    const { uniforms } = this;
    uniforms.uColor.value = COLORINGS[coloring];
    uniforms.uUp.value.copy(up);
    uniforms.uPlain.value.copy(plain);
    const [low, high] = values === null ? this.heights : [values.low, values.high];
    uniforms.uRange.value.set(low, high);
    if (values !== null && values !== this.values) {
      this.points?.geometry.setAttribute("value", new BufferAttribute(values.values, 1));
    }
    if (values === null) this.points?.geometry.deleteAttribute("value");
    this.values = values;
    // Where nothing but the colour tells points apart, those without it are drawn plain.
    if (coloring === "value" && values === null) uniforms.uColor.value = COLORINGS.normals;
  }

  /** Draw each point with this diameter, in units of the cloud, and at least `least` pixels. */
  size(diameter: number, pixelsPerUnit: number, least: number): void {
    const { uniforms } = this;
    uniforms.uDiameter.value = diameter;
    uniforms.uPixels.value = pixelsPerUnit;
    uniforms.uLeast.value = least;
  }

  /** Nearest and farthest distance from the eye, between which points without normals fade. */
  depth(near: number, far: number): void {
    this.uniforms.uDepth.value.set(near, far);
  }

  /** Draw these shares of the points alone, from 0 to 1; the rest of the scene with the first. */
  part(from: number, to: number): void {
    const { drawn } = this;
    if (this.points !== null) this.points.visible = drawn > 0;
    if (this.surface !== null) this.surface.visible = this.surfaceShown && from === 0;
    const [start, end] = [Math.floor(from * drawn), Math.ceil(to * drawn)];
    this.points?.geometry.setDrawRange(start, end - start);
    if (this.hairs !== null) this.hairs.visible = this.hairsShown && from === 0;
  }

  /** Show or hide normals as hairs. */
  showHairs(shown: boolean, color: Color): void {
    this.hairsShown = shown;
    if (shown && this.hairs === null && this.cloud?.normals) this.hairs = this.makeHairs(this.cloud);
    if (this.hairs === null) return;
    this.hairUniforms.uHair.value.copy(color);
    this.hairUniforms.uLength.value = HAIR_SPACINGS * this.spacing;
  }

  private makeHairs(cloud: Drawable): LineSegments<InstancedBufferGeometry, RawShaderMaterial> {
    const count = Math.min(cloud.drawn, MOST_HAIRS);
    const geometry = new InstancedBufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(new Float32Array([0, 0, 0, 1, 0, 0]), 3));
    const offsets = cloud.positions.slice(0, 3 * count);
    geometry.setAttribute("offset", new InstancedBufferAttribute(offsets, 3));
    const normals = (cloud.normals ?? new Int8Array()).slice(0, 4 * count);
    geometry.setAttribute("normal", new InstancedBufferAttribute(normals, 4, true));
    geometry.instanceCount = count;
    const hairs = new LineSegments(geometry, this.hairMaterial);
    hairs.frustumCulled = false;
    this.scene.add(hairs);
    return hairs;
  }

  private clear(): void {
    this.setSurface(null);
    for (const drawn of [this.points, this.hairs]) {
      if (drawn === null) continue;
      this.scene.remove(drawn);
      drawn.geometry.dispose();
    }
    this.points = this.hairs = null;
    this.values = null;
  }
}
