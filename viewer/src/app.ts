// SPDX-License-Identifier: Apache-2.0
import type { Api } from "./api/client";
import { type Description, suffixOf } from "./api/description";
import { snippets } from "./api/snippets";
import { ApiError, type Job } from "./api/types";
import { UnreadableCloudError } from "./cloud/cloud";
import type { Slot } from "./cloud/messages";
import type { Reader } from "./cloud/reader";
import { CodeCard } from "./ui/code";
import { Density } from "./ui/density";
import { byId, make } from "./ui/dom";
import { ago, bytes, count } from "./ui/format";
import { Inputs } from "./ui/inputs";
import { KeyDialog } from "./ui/key";
import { Options } from "./ui/options";
import { ProblemCard } from "./ui/problem";
import { ProgressCard } from "./ui/progress";
import { listJobs, showFigures } from "./ui/result";
import type { Viewer } from "./ui/viewer";

const LISTED = 12;
const DENOISE = "denoise";
// Formats whose results this browser draws.
const DRAWN = new Set(["ply", "ply-ascii", "npz", "npy", "json", "xyz"]);

/** The page: a scan, a request, a job, a result. */
export class App {
  private file: File | null = null;
  private points: number | null = null;
  private result: Blob | null = null;
  private job: Job | null = null;
  private readonly spacing: Record<Slot, number | null> = { before: null, after: null };
  private work = new AbortController();
  private readonly inputs = new Inputs();
  private readonly code = new CodeCard();
  private readonly problem = new ProblemCard();
  private readonly progress = new ProgressCard(() => { void this.cancel(); });
  private readonly keys: KeyDialog;
  private readonly density: Density;
  private readonly options: Options;
  private readonly format = byId<HTMLSelectElement>("format");

  constructor(
    private readonly api: Api, private readonly description: Description,
    private readonly reader: Reader, private readonly viewer: Viewer,
  ) {
    this.keys = new KeyDialog(api, () => { void this.openFromAddress(); });
    this.options = new Options(description, () => { this.onOptions(); });
    this.density = new Density(description, () => { this.onDensity(); });
    const written = description.formats.filter((format) => format.written);
    this.format.append(...written.map(({ name }) =>
      make("option", { value: name, textContent: name.toUpperCase().replace("-", " ") })));
    this.format.onchange = () => { this.showDownload(); this.showCode(); };
    byId<HTMLFormElement>("form").onsubmit = (event) => {
      event.preventDefault();
      void this.run();
    };
    byId("download").onclick = () => { void this.download(); };
    viewer.fetchSurface = (slot, signal) => this.fetchSurface(slot, signal);
    addEventListener("hashchange", () => { void this.openFromAddress(); });
    addEventListener("keydown", (event) => {
      if (event.key === "Enter" && (event.ctrlKey || event.metaKey)) void this.run();
    });
  }

  /** Take a scan that was dropped or chosen. */
  async choose(file: File): Promise<void> {
    this.leave();
    history.replaceState(null, "", location.pathname + location.search);
    await this.takeInput(file);
  }

  /** Take one of the examples that come with the page. */
  async chooseExample(name: string): Promise<void> {
    const response = await this.api.fetch(`assets/${name}`);
    await this.choose(new File([await response.blob()], name));
  }

  /** Show the job that the address names, and list the recent ones. */
  async openFromAddress(): Promise<void> {
    const id = /^#job=([\w-]+)$/.exec(location.hash)?.[1];
    try {
      if (id !== undefined && id !== this.job?.id) await this.open(id);
    } catch (error) {
      this.fail(error, () => { void this.openFromAddress(); });
    }
    await this.listJobs();
  }

  private async open(id: string): Promise<void> {
    this.leave();
    const signal = this.work.signal;
    const job = await this.api.job(id);
    this.job = job;
    this.density.set(job.options);
    this.options.set(job.options);
    const kept = await this.inputs.get(id);
    if (kept !== null) await this.takeInput(new File([kept.file], kept.name));
    else this.points = job.report?.points_in ?? null;
    if (signal.aborted) return;
    if (kept === null) {
      byId("file-name").textContent = "Job of another browser";
      byId("file-hint").textContent = "Its input is not here. Choose the file to see it beside the result.";
    }
    await this.follow(job, signal);
  }

  private async takeInput(file: File): Promise<void> {
    this.file = file;
    this.points = this.spacing.before = null;
    byId("file-name").textContent = file.name;
    byId("file-hint").textContent = bytes(file.size);
    byId<HTMLButtonElement>("run").disabled = false;
    this.density.setScan(null, null);
    try {
      const cloud = await this.reader.call("load", { slot: "before", file });
      if (this.file !== file) return;
      this.points = cloud.count;
      byId("file-hint").textContent = `${count(cloud.count)} points · ${bytes(file.size)}`;
      this.viewer.set("before", cloud);
      this.viewer.say("The dense cloud appears here.");
      this.density.setScan(cloud.count, null);
      await this.measure("before");
      this.density.setScan(cloud.count, this.spacing.before);
    } catch (error) {
      if (!(error instanceof UnreadableCloudError)) throw error;
      await this.reader.call("forget", { slot: "before" });
      this.points = await this.reader.call("count", { file });
      this.viewer.set("before", null);
      this.viewer.say(`${file.name} is not drawn here. ${error.message}`);
      this.density.setScan(this.points, null);
    }
    this.showCode();
  }

  private async run(): Promise<void> {
    const { file } = this;
    if (file === null || byId<HTMLButtonElement>("run").disabled) return;
    const query = this.query("ply");
    if (query === null) {
      byId("density").focus();
      return;
    }
    this.leave(false);
    const signal = this.work.signal;
    byId<HTMLButtonElement>("run").disabled = true;
    try {
      const since = performance.now();
      this.progress.sending(0, file.size || 1, since);
      const job = await this.api.submit(query, file, (sent, total) => {
        this.progress.sending(sent, total, since);
      }, signal);
      this.job = job;
      history.replaceState(null, "", `#job=${job.id}`);
      await this.inputs.put({ id: job.id, name: file.name, file, time: Date.now() });
      void this.listJobs();
      await this.follow(job, signal);
    } catch (error) {
      this.fail(error, () => { void this.run(); });
    } finally {
      byId<HTMLButtonElement>("run").disabled = false;
    }
  }

  /** Follow a job to its end, and show what came of it. */
  private async follow(job: Job, signal: AbortSignal): Promise<void> {
    let ended = job;
    if (job.state === "queued" || job.state === "running") {
      this.progress.working(job.progress);
      ended = await this.api.follow(job.id, (_, progress) => { this.progress.working(progress); }, signal);
    }
    this.progress.end();
    this.job = ended;
    void this.listJobs();
    if (ended.problem !== null) this.problem.show(new ApiError(ended.problem), () => { void this.run(); });
    else if (ended.state === "succeeded") await this.showResult(ended, signal);
    else {
      const said = { cancelled: "The job was cancelled.", expired: "The result was deleted: its time was over." };
      byId("spoken").textContent = said[ended.state as keyof typeof said];
      byId("count").textContent = byId("spoken").textContent;
    }
  }

  private async showResult(job: Job, signal: AbortSignal): Promise<void> {
    const format = String(job.options.format ?? "ply");
    byId("spoken").textContent = `Done: ${count(job.report?.points_out ?? 0)} points.`;
    this.format.value = format;
    this.showDownload();
    this.showCode();
    showFigures(job, this.spacing);
    byId("result").scrollIntoView({ block: "nearest" });
    if (!DRAWN.has(format)) {
      this.viewer.say(`Results in ${format.toUpperCase()} are not drawn here. Download it, or run it again.`);
      return;
    }
    const file = await (await this.api.fetch(`jobs/${job.id}/result`, { signal })).blob();
    const cloud = await this.reader.call("load", { slot: "after", file });
    if (this.job?.id !== job.id) return;
    this.result = file;
    this.viewer.set("after", cloud);
    await this.measure("after");
    showFigures(job, this.spacing);
  }

  private async measure(slot: Slot): Promise<void> {
    const spacing = await this.reader.call("spacing", { slot });
    this.spacing[slot] = spacing;
    this.viewer.setSpacing(slot, spacing);
  }

  /** Ask for the surface of a cloud; a failure is shown, and gives none. */
  private async fetchSurface(slot: Slot, signal: AbortSignal): Promise<Blob | null> {
    const body = slot === "before" ? this.file : this.result;
    try {
      return await (await this.api.fetch("preview", { method: "POST", body, signal })).blob();
    } catch (error) {
      this.fail(error, null);
      return null;
    }
  }

  private async cancel(): Promise<void> {
    const { job } = this;
    this.work.abort();
    this.progress.end();
    byId("spoken").textContent = "Cancelled.";
    if (job !== null) {
      try {
        this.job = await this.api.withdraw(job.id);
      } catch (error) {
        this.fail(error, null);
      }
    }
    await this.listJobs();
  }

  private async download(): Promise<void> {
    const { job, file } = this;
    if (job === null) return;
    const format = this.format.value;
    const note = byId("download-note");
    const button = byId<HTMLButtonElement>("download");
    button.disabled = true;
    try {
      let response: Response;
      if (format === job.options.format) response = await this.api.fetch(`jobs/${job.id}/result`);
      else {
        // Equal bytes in, equal options, equal points out: in the format that was asked for.
        note.textContent = `Making it as ${format.toUpperCase()} …`;
        const query = jobQuery(job, format);
        response = await this.api.fetch(`upsample?${query}`, { method: "POST", body: file });
      }
      const name = (file?.name ?? "cloud").replace(/\.[^.]*$/, "");
      save(await response.blob(), `${name}-dense${suffixOf(this.description.formats, format)}`);
      note.textContent = "";
    } catch (error) {
      note.textContent = "";
      this.fail(error, () => { void this.download(); });
    }
    this.showDownload();
  }

  private showDownload(): void {
    const { job, file } = this;
    const there = job === null || this.format.value === job.options.format;
    byId<HTMLButtonElement>("download").disabled = !there && file === null;
    const why = "The result is kept in one format. For another one, choose the file of the input again.";
    const again = "The result is kept in one format; in this one it is computed again.";
    byId("download-note").textContent = there ? "" : file === null ? why : again;
  }

  private query(format: string): URLSearchParams | null {
    const density = this.density.query;
    if (density === null) return null;
    return new URLSearchParams([density, ...this.options.query, ["format", format]]);
  }

  /** Points are denoised without new ones: with a ratio of 1. */
  private onOptions(): void {
    if (this.options.get(DENOISE) === "true" && !this.density.unchanged) this.density.set({ R: 1 });
    this.showCode();
  }

  private onDensity(): void {
    if (!this.density.unchanged) this.options.put(DENOISE, "false");
    this.showCode();
  }

  private showCode(): void {
    const format = this.format.value || "ply";
    const query = this.query(format);
    if (this.file === null || query === null) return;
    const keyed = this.api.key !== "";
    const suffix = suffixOf(this.description.formats, format);
    this.code.show(snippets(this.file.name, query, this.api.base, keyed, format, suffix));
  }

  private async listJobs(): Promise<void> {
    try {
      const [jobs, names] = await Promise.all([this.api.jobs(LISTED), this.inputs.names()]);
      listJobs(jobs, names, this.job?.id ?? "", (job) => {
        const size = job.report === null ? bytes(job.input.bytes)
          : `${count(job.report.points_in)} → ${count(job.report.points_out)} points`;
        return `${size} · ${ago(job.created_at)}`;
      });
    } catch (error) {
      if (error instanceof ApiError && error.problem.status === 401) this.keys.ask(this.api.key !== "");
    }
  }

  /** Stop following what was shown; the job itself goes on. */
  private leave(input = true): void {
    this.work.abort();
    this.work = new AbortController();
    this.job = null;
    this.progress.end();
    this.problem.hide();
    byId("result").hidden = true;
    this.spacing.after = null;
    this.viewer.set("after", null);
    void this.reader.call("forget", { slot: "after" });
    if (!input) return;
    this.file = null;
    this.spacing.before = null;
    byId<HTMLButtonElement>("run").disabled = true;
    this.viewer.set("before", null);
    this.viewer.say("");
    void this.reader.call("forget", { slot: "before" });
  }

  private fail(error: unknown, retry: (() => void) | null): void {
    if (error instanceof DOMException && error.name === "AbortError") return;
    this.progress.end();
    const unknown = error instanceof ApiError && error.problem.status === 401;
    if (unknown) this.keys.ask(this.api.key !== "");
    this.problem.show(error, retry);
  }
}

function jobQuery(job: Job, format: string): URLSearchParams {
  const given = Object.entries(job.options).filter(([name, value]) => value !== null && name !== "format");
  return new URLSearchParams([...given.map(([name, value]) => [name, String(value)]), ["format", format]]);
}

function save(blob: Blob, name: string): void {
  const link = make("a", { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => { URL.revokeObjectURL(link.href); }, 60_000);
}
