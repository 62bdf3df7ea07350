// SPDX-License-Identifier: Apache-2.0
import type { Api } from "../api/client";
import { byId } from "./dom";

/** The dialog that asks for an API key. */
export class KeyDialog {
  private readonly dialog = byId<HTMLDialogElement>("key-dialog");
  private readonly field = byId<HTMLInputElement>("key");

  /** @param onKey is called with a key that was entered. */
  constructor(private readonly api: Api, onKey: () => void) {
    byId("key-button").onclick = () => { this.ask(); };
    byId("key-cancel").onclick = () => { this.dialog.close(); };
    byId<HTMLFormElement>("key-form").onsubmit = () => {
      api.key = this.field.value.trim();
      onKey();
    };
  }

  /** Ask for a key; `refused` where there was one that the service does not know. */
  ask(refused = false): void {
    byId("key-button").hidden = false;
    if (refused) byId("key-text").textContent = "The service does not know this key, or no longer. Enter another one.";
    this.field.value = this.api.key;
    if (!this.dialog.open) this.dialog.showModal();
    this.field.select();
  }
}
