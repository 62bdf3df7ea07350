// SPDX-License-Identifier: Apache-2.0
import type { Progress } from "../api/types";
import { byId } from "./dom";
import { bytes, count, seconds } from "./format";

const STAGES: Record<string, string> = {
  queued: "Waiting for its turn",
  prepare: "Reading the scan",
  predict: "Finding the surface",
  finish: "Spreading the points",
  collect: "Writing the answer",
  done: "Done",
};
// After the network has seen all patches, about this share of its time is needed once more.
const AFTERWARDS = 0.8;
const BEFORE = 0.06;

/** The card that shows how far an upload or a job is. */
export class ProgressCard {
  private readonly card = byId("progress");
  private readonly bar = byId<HTMLProgressElement>("bar");
  private predicting: number | null = null;
  private ends: number | null = null;
  private spoken = "";
  private timer = 0;

  /** @param onCancel is called when the work is to be given up. */
  constructor(onCancel: () => void) {
    byId("cancel").onclick = onCancel;
  }

  /** Show how much of a file has been sent since a moment. */
  sending(sent: number, total: number, since: number): void {
    const passed = (performance.now() - since) / 1000;
    this.show("Sending the scan", sent / total, `${bytes(sent)} of ${bytes(total)}`);
    this.ends = sent > 0 ? performance.now() + 1000 * passed * (total / sent - 1) : null;
    this.tick();
  }

  /** Show how far a job is. */
  working({ stage, done, total }: Progress): void {
    const now = performance.now();
    if (stage === "predict") this.predicting ??= now;
    const share = total === null || total === 0 ? 0 : done / total;
    if (stage === "predict" && this.predicting !== null && done > 0) {
      const whole = (now - this.predicting) / share;
      this.ends = this.predicting + whole * (1 + AFTERWARDS);
    } else if (stage === "queued" || stage === "prepare") this.ends = null;
    const parts = { queued: 0, prepare: BEFORE / 2, predict: BEFORE + 0.5 * share };
    const at = stage in parts ? parts[stage as keyof typeof parts] : stage === "finish" ? 0.6 : 0.96;
    const detail = total === null ? "" : `${count(done)} of ${count(total)} patches`;
    this.show(STAGES[stage] ?? stage, stage === "queued" ? null : at, detail);
    this.tick();
    window.clearInterval(this.timer);
    this.timer = window.setInterval(() => { this.tick(); }, 1000);
  }

  /** Hide the card. */
  end(): void {
    window.clearInterval(this.timer);
    this.card.hidden = true;
    this.predicting = this.ends = null;
    this.spoken = "";
  }

  private show(stage: string, share: number | null, detail: string): void {
    this.card.hidden = false;
    byId("stage-name").textContent = stage;
    byId("stage-detail").textContent = detail;
    if (share === null) this.bar.removeAttribute("value");
    else this.bar.value = share;
    if (stage !== this.spoken) byId("spoken").textContent = this.spoken = stage;
  }

  private tick(): void {
    const left = this.ends === null ? null : (this.ends - performance.now()) / 1000;
    const text = left === null ? "" : left < 1 ? "nearly there" : `about ${seconds(Math.ceil(left)).replace(".0", "")} left`;
    byId("time-left").textContent = text;
  }
}
