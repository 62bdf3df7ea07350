// SPDX-License-Identifier: Apache-2.0
import type { Description } from "../api/description";
import { byId, segments } from "./dom";
import { count, figure } from "./format";

const MOST_RATIO = 32;
const FALLBACK = 4;

interface Kind {
  readonly label: string;
  readonly long: string;
  readonly unit: string;
  readonly option: string;
}

const KINDS: Record<string, Kind> = {
  ratio: { label: "Ratio", long: "Points out for each point in", unit: "×", option: "R" },
  points: { label: "Points", long: "Points out", unit: "points", option: "n_points" },
  spacing: {
    label: "Spacing", long: "Distance between neighbouring points, in units of the scan", unit: "units",
    option: "spacing",
  },
};

/** How many points are wanted: as a ratio, a number, or a spacing where the service takes one. */
export class Density {
  private kind = "ratio";
  private points: number | null = null;
  private spacing: number | null = null;
  private readonly field = byId<HTMLInputElement>("density");
  private readonly slider = byId<HTMLInputElement>("ratio-slider");
  private readonly choose: (name: string) => void;

  /** @param onChange is called whenever the answer would be another one. */
  constructor(description: Description, private readonly onChange: () => void) {
    const offered = Object.entries(KINDS).filter(([, { option }]) => description.options.has(option));
    const labels = Object.fromEntries(offered.map(([name, { label }]) => [name, label]));
    this.choose = segments(byId("density-kinds"), labels, (name) => { this.switchTo(name); });
    this.slider.oninput = () => {
      this.field.value = String(ratioAt(Number(this.slider.value) / 100));
      this.changed();
    };
    this.field.oninput = () => { this.changed(); };
    this.show();
  }

  /** Take the number of points and their spacing from a scan; `null` where unknown. */
  setScan(points: number | null, spacing: number | null): void {
    this.points = points;
    this.spacing = spacing;
    this.show();
  }

  /** The option of the request and its value; `null` where what was typed is no number. */
  get query(): [string, string] | null {
    const { value } = this;
    return value === null ? null : [KINDS[this.kind].option, String(value)];
  }

  /** Whether as many points are wanted as there are. */
  get unchanged(): boolean {
    return this.kind === "ratio" && this.value === 1;
  }

  /** Take over what a job was asked for. */
  set(options: Readonly<Record<string, unknown>>): void {
    const given = Object.entries(KINDS).find(([, { option }]) => typeof options[option] === "number");
    this.kind = given?.[0] ?? "ratio";
    this.choose(this.kind);
    this.field.value = String(given === undefined ? FALLBACK : options[given[1].option]);
    this.changed();
  }

  /** Points that the answer will have, as far as this is known. */
  private get expected(): number | null {
    const { value, points } = this;
    if (value === null || points === null) return null;
    if (this.kind === "points") return value;
    if (this.kind === "ratio") return points * value;
    // On a surface, half the spacing takes four times the points.
    return this.spacing === null ? null : points * (this.spacing / value) ** 2;
  }

  private get value(): number | null {
    const value = Number(this.field.value.replaceAll(/[\s,_](?=\d{3})/g, "").replace(",", "."));
    return Number.isFinite(value) && value > 0 ? value : null;
  }

  private switchTo(kind: string): void {
    const expected = this.expected;
    this.kind = kind;
    if (kind === "ratio") {
      this.field.value = this.points === null || expected === null ? "8" : figure(expected / this.points);
    } else if (kind === "points") this.field.value = String(Math.round(expected ?? 100_000));
    else this.field.value = this.spacing === null ? "" : figure(this.spacing / 2);
    this.changed();
  }

  private changed(): void {
    this.show();
    this.onChange();
  }

  private show(): void {
    const { long, unit } = KINDS[this.kind];
    const { value, points, expected } = this;
    byId("density-label").textContent = long;
    byId("density-unit").textContent = unit;
    this.slider.hidden = this.kind !== "ratio";
    if (value !== null) this.slider.value = String((100 * Math.log(value)) / Math.log(MOST_RATIO));
    this.field.setAttribute("aria-invalid", String(value === null));
    byId("count").replaceChildren(...this.sentence(value, points, expected));
  }

  private sentence(value: number | null, points: number | null, expected: number | null): string[] {
    if (value === null) return [`${KINDS[this.kind].long}: a number above 0.`];
    if (points === null) return [`${KINDS[this.kind].long}.`];
    if (expected === null) return [`${count(points)} points in.`];
    const about = this.kind === "spacing" ? "about " : "";
    return [`${count(points)} points in, ${about}${count(expected)} out.`];
  }
}

function ratioAt(share: number): number {
  const ratio = MOST_RATIO ** share;
  if (ratio < 4) return Math.round(ratio * 10) / 10;
  return ratio < 10 ? Math.round(ratio * 2) / 2 : Math.round(ratio);
}
