// SPDX-License-Identifier: Apache-2.0
import type { Description, Option } from "../api/description";
import { byId, make } from "./dom";

interface Wording {
  readonly label: string;
  readonly hint?: string;
  /** A sentence for each choice. */
  readonly choices?: Partial<Record<string, [label: string, hint: string]>>;
}

// Options with their own control; all others of the service get one by their type.
const DENSITY = new Set(["R", "n_points", "spacing"]);
const MAIN = ["orient", "viewpoint", "density", "denoise", "confidence"];
const WORDS: Partial<Record<string, Wording>> = {
  orient: {
    label: "Normals point",
    choices: {
      auto: ["by what is known", "By the file's own normals, else to the scanner, else as a closed surface."],
      input: ["as in the file", "To the side of the normals that the file has."],
      viewpoint: ["to the scanner", "Towards the position of the scanner. Best for a scan from one place."],
      mst: ["outward, as a whole", "As their neighbours do, then each part as a whole outward. Best for closed objects."],
      outward: ["away from the centre", "Away from the centre of the cloud. For convex shapes."],
      none: ["to either side", "To no particular side. For uses that ignore the sign."],
    },
  },
  viewpoint: { label: "Scanner position", hint: "x, y, z in the coordinates of the scan." },
  density: {
    label: "Spread",
    choices: {
      input: ["as the scan", "Dense where the scan is dense, and sparse where it is sparse."],
      even: ["evenly", "One spacing over the whole surface."],
    },
  },
  denoise: {
    label: "Denoise alone",
    hint: "Moves the points of the scan onto the surface and adds none: the ratio becomes 1.",
  },
  max_gap: { label: "Largest gap" },
  confidence: {
    label: "Expected error",
    hint: "Each point gets its expected distance from the true surface, to colour by.",
  },
  seed: { label: "Seed", hint: "Another seed gives another, equally even set of points." },
  keep_input: {
    label: "Keep the input points",
    hint: "The answer begins with them, unmoved, noise and all.",
  },
};

type Control = HTMLInputElement | HTMLSelectElement;

/** The options of an upsampling, as far as the running service lists them. */
export class Options {
  private readonly controls = new Map<string, { control: Control; option: Option; row: HTMLElement }>();

  /** @param onChange is called whenever the answer would be another one. */
  constructor(description: Description, private readonly onChange: () => void) {
    const names = [...description.options.keys()].filter((name) => !DENSITY.has(name));
    const main = MAIN.filter((name) => names.includes(name));
    const more = names.filter((name) => !MAIN.includes(name));
    for (const [folder, list] of [["options-main", main], ["options-more", more]] as const) {
      byId(folder).replaceChildren(...list.map((name) => this.row(description.options.get(name))));
    }
    byId("more").hidden = more.length === 0;
    this.link();
  }

  /** Options that differ from the service's own choice. */
  get query(): [string, string][] {
    return [...this.controls].flatMap(([name, { control, option }]) => {
      if (name === "viewpoint" && !this.viewpointUsed) return [];
      const value = read(control);
      const fallback = option.fallback || (option.type === "boolean" ? "false" : "");
      return value === "" || value === fallback ? [] : [[name, value] as [string, string]];
    });
  }

  /** The value of an option as text; `undefined` where the service does not list it. */
  get(name: string): string | undefined {
    const found = this.controls.get(name);
    return found && read(found.control);
  }

  /** Set one option, as far as the service lists it. */
  put(name: string, value: string): void {
    const found = this.controls.get(name);
    if (found !== undefined) write(found.control, value);
  }

  /** Take over what a job was asked for. */
  set(options: Readonly<Record<string, string | number | boolean | null>>): void {
    for (const [name, { control, option }] of this.controls) {
      const given = name in options ? options[name] : null;
      write(control, given === null ? option.fallback : String(given));
    }
    this.link();
    this.onChange();
  }

  private get viewpointUsed(): boolean {
    const orient = this.controls.get("orient")?.control.value;
    return orient === undefined || orient === "viewpoint";
  }

  private row(option: Option | undefined): HTMLElement {
    if (option === undefined) throw new Error("An option is listed without a description.");
    const { name } = option;
    const words = WORDS[name] ?? { label: sentence(name) };
    const id = `option-${name}`;
    const hint = make("span", { className: "muted small-text", id: `${id}-hint` });
    hint.textContent = words.hint ?? option.description;
    const control = makeControl(option, words);
    control.id = id;
    control.setAttribute("aria-describedby", hint.id);
    const check = control instanceof HTMLInputElement && control.type === "checkbox";
    const label = make("label", { className: check ? "check" : "field", htmlFor: id });
    const text = make("span", { textContent: words.label });
    label.append(...(check ? [control, text] : [text, control]));
    const row = make("div", { className: "option" }, label, hint);
    this.controls.set(name, { control, option, row });
    control.oninput = () => { this.link(); this.onChange(); };
    return row;
  }

  /** Show what depends on another option, and the sentence of the choice. */
  private link(): void {
    const viewpoint = this.controls.get("viewpoint");
    if (viewpoint !== undefined) viewpoint.row.hidden = !this.viewpointUsed;
    for (const [name, { control }] of this.controls) {
      const chosen = WORDS[name]?.choices?.[control.value];
      if (chosen !== undefined) byId(`option-${name}-hint`).textContent = chosen[1];
    }
  }
}

function makeControl({ name, type, choices, description, fallback }: Option, words: Wording): Control {
  // A plain string that lists its choices in its description: "...: auto, input or none."
  const listed = words.choices === undefined ? [] : (/:\s*(.+?)\.?$/.exec(description)?.[1] ?? "")
    .split(/,\s*|\s+or\s+/).filter((word) => word in (words.choices ?? {}));
  const offered = choices.length > 0 ? choices : listed;
  if (offered.length > 0) {
    const select = make("select", { name });
    select.append(...offered.map((value) =>
      make("option", { value, textContent: words.choices?.[value]?.[0] ?? sentence(value) })));
    select.value = fallback || offered[0];
    return select;
  }
  if (type === "boolean") return make("input", { name, type: "checkbox", checked: fallback === "true" });
  const field = make("input", { name, type: "text", autocomplete: "off", value: fallback });
  if (type === "integer" || type === "number") field.inputMode = "decimal";
  return field;
}

function read(control: Control): string {
  const box = control instanceof HTMLInputElement && control.type === "checkbox";
  return box ? String(control.checked) : control.value.trim();
}

function write(control: Control, value: string): void {
  if (control instanceof HTMLInputElement && control.type === "checkbox") {
    control.checked = value === "true";
  } else control.value = value;
}

function sentence(name: string): string {
  const words = name.replaceAll("_", " ");
  return words.charAt(0).toUpperCase() + words.slice(1);
}
