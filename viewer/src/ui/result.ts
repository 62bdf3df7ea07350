// SPDX-License-Identifier: Apache-2.0
import type { Job } from "../api/types";
import { byId, make } from "./dom";
import { count, figure, seconds } from "./format";

/** Distances between neighbouring points, median, as far as they are known. */
export interface Spacings {
  readonly before: number | null;
  readonly after: number | null;
}

/** Show the figures of a job that succeeded. */
export function showFigures(job: Job, spacings: Spacings): void {
  const report = job.report;
  if (report === null) return;
  const spent = (Date.parse(job.finished_at ?? "") - Date.parse(job.started_at ?? "")) / 1000;
  const noise = report.noise;
  const dropped = Object.values(report.dropped).reduce((sum, value) => sum + value, 0);
  const rows: [string, string, string][] = [
    ["Points in", count(report.points_in), dropped > 0 ? `${count(dropped)} dropped` : ""],
    ["Points out", count(report.points_out), `${figure(report.points_out / report.points_in)} × as many`],
    ["Spacing before", spacings.before === null ? "–" : figure(spacings.before), "median, scan units"],
    ["Spacing after", spacings.after === null ? "–" : figure(spacings.after), "median, scan units"],
    ["Noise found", noise === null || noise === undefined ? "–" : `${figure(100 * noise)} %`, "of the spacing"],
    ["Time", seconds(spent), `${count(report.points_out / Math.max(spent, 0.001))} points a second`],
  ];
  byId("figures").replaceChildren(...rows.map(([name, value, note]) =>
    make("div", {}, make("dt", { textContent: name }), make("dd", { textContent: value }),
      make("dd", { className: "muted small-text", textContent: note }))));
  byId("notes").replaceChildren(...report.notes.map((note) => make("li", { textContent: note })));
  byId("result").hidden = false;
}

const STATES: Record<string, string> = {
  queued: "waiting", running: "running", succeeded: "done", failed: "failed",
  cancelled: "cancelled", expired: "expired",
}; // prettier-ignore

/**
 * List jobs, newest first.
 *
 * @param names file names by the id of the job, where this browser knows them.
 * @param current id of the job that is shown.
 */
export function listJobs(jobs: readonly Job[], names: ReadonlyMap<string, string>, current: string,
  describe: (job: Job) => string): void {
  byId("recent").hidden = jobs.length === 0;
  byId("jobs").replaceChildren(...jobs.map((job) => {
    const link = make("a", { href: `#job=${job.id}` });
    if (job.id === current) link.setAttribute("aria-current", "true");
    const state = make("span", { className: `state ${job.state}`, textContent: STATES[job.state] ?? job.state });
    const name = names.get(job.id) ?? `Job ${job.id.slice(0, 8)}`;
    link.append(
      make("span", { className: "strong", textContent: name }), state,
      make("span", { className: "muted small-text", textContent: describe(job) }),
    );
    return make("li", {}, link);
  }));
}
