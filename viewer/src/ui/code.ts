// SPDX-License-Identifier: Apache-2.0
import type { Snippets } from "../api/snippets";
import { byId } from "./dom";

/** The same request as commands, ready to copy. */
export class CodeCard {
  private snippets: Snippets | null = null;
  private language: keyof Snippets = "curl";
  private readonly tabs = [...document.querySelectorAll<HTMLButtonElement>("[data-code]")];

  constructor() {
    for (const tab of this.tabs) {
      tab.onclick = () => { this.choose(tab.dataset.code as keyof Snippets); };
      tab.onkeydown = (event) => {
        const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
        if (step === undefined) return;
        const next = this.tabs[(this.tabs.indexOf(tab) + step + this.tabs.length) % this.tabs.length];
        next.focus();
        next.click();
      };
    }
    byId("copy").onclick = () => { void this.copy(); };
    this.choose("curl");
  }

  show(snippets: Snippets): void {
    this.snippets = snippets;
    byId("code").hidden = false;
    this.choose(this.language);
  }

  private choose(language: keyof Snippets): void {
    this.language = language;
    for (const tab of this.tabs) {
      const chosen = tab.dataset.code === language;
      tab.setAttribute("aria-selected", String(chosen));
      tab.tabIndex = chosen ? 0 : -1;
    }
    byId("snippet").textContent = this.snippets?.[language] ?? "";
  }

  private async copy(): Promise<void> {
    const button = byId("copy");
    try {
      await navigator.clipboard.writeText(this.snippets?.[this.language] ?? "");
      button.textContent = "Copied";
    } catch {
      // Without TLS browsers keep the clipboard closed; the text is marked, for Ctrl+C.
      getSelection()?.selectAllChildren(byId("snippet"));
      button.textContent = "Press Ctrl+C";
    }
    setTimeout(() => { button.textContent = "Copy"; }, 2000);
  }
}
