// SPDX-License-Identifier: Apache-2.0
import "./style.css";
import { Api } from "./api/client";
import { describe, type Format } from "./api/description";
import { App } from "./app";
import { Reader } from "./cloud/reader";
import { byId } from "./ui/dom";
import { ProblemCard } from "./ui/problem";
import { Viewer } from "./ui/viewer";

const THEME = "pugeo-theme";

function setTheme(theme: string | null): void {
  if (theme === null) document.documentElement.removeAttribute("data-theme");
  else document.documentElement.dataset.theme = theme;
}

async function start(): Promise<void> {
  setTheme(localStorage.getItem(THEME));
  const api = new Api();
  const reader = new Reader();
  const viewer = new Viewer(reader);
  const dark = matchMedia("(prefers-color-scheme: dark)");
  dark.addEventListener("change", () => { viewer.recolor(); });
  byId("theme").onclick = () => {
    const current = document.documentElement.dataset.theme ?? (dark.matches ? "dark" : "light");
    const next = current === "dark" ? "light" : "dark";
    localStorage.setItem(THEME, next);
    setTheme(next);
    viewer.recolor();
  };
  const [description] = await Promise.all([describe(api), viewer.start()]);
  const app = new App(api, description, reader, viewer);
  showFormats(description.formats);
  acceptFiles(app);
  await app.openFromAddress();
  performance.mark("pugeo-ready");
  document.documentElement.dataset.ready = "true";
}

function showFormats(formats: readonly Format[]): void {
  const withSuffix = formats.filter(({ extensions }) => extensions.length > 0);
  const names = withSuffix.map(({ name }) => name.toUpperCase()).join(", ");
  byId("file-hint").textContent = names;
  byId("formats").textContent = `Reads ${names}, by content.`;
  byId<HTMLInputElement>("file").accept = withSuffix.flatMap(({ extensions }) => extensions).join(",");
}

function acceptFiles(app: App): void {
  const field = byId<HTMLInputElement>("file");
  field.onchange = () => {
    const file = field.files?.[0];
    // The same file chosen again is a new choice.
    if (file !== undefined) void app.choose(file).finally(() => { field.value = ""; });
  };
  for (const button of document.querySelectorAll<HTMLElement>("[data-example]")) {
    button.onclick = () => { void app.chooseExample(button.dataset.example ?? ""); };
  }
  let depth = 0;
  const mark = (change: number): void => {
    depth = Math.max(0, depth + change);
    document.documentElement.toggleAttribute("data-dropping", depth > 0);
  };
  addEventListener("dragenter", () => { mark(1); });
  addEventListener("dragleave", () => { mark(-1); });
  addEventListener("dragover", (event) => { event.preventDefault(); });
  addEventListener("drop", (event) => {
    event.preventDefault();
    mark(-Infinity);
    const file = event.dataTransfer?.files[0];
    if (file !== undefined) void app.choose(file);
  });
}

start().catch((error: unknown) => { new ProblemCard().show(error, () => { location.reload(); }); });
