// SPDX-License-Identifier: Apache-2.0
import { readEvents } from "./sse";
import { ApiError, type Job, localProblem, type Problem, type Progress } from "./types";

const KEY = "pugeo-api-key";
const RECONNECT_MS = 2000;
const NOT_REACHED = localProblem(
  "unreachable",
  "The service cannot be reached. Check the network, and whether the service runs.",
);

/** The REST service that this page came from. */
export class Api {
  /** Address of the service, also behind the path prefix of a proxy. */
  readonly base = new URL("./", document.baseURI);

  /** API key of this tab; it is forgotten when the tab is closed. */
  get key(): string {
    return sessionStorage.getItem(KEY) ?? "";
  }

  set key(value: string) {
    if (value === "") sessionStorage.removeItem(KEY);
    else sessionStorage.setItem(KEY, value);
  }

  /** Send a request; raise ApiError unless it succeeded. */
  async fetch(path: string, init: RequestInit = {}): Promise<Response> {
    const headers = new Headers(init.headers);
    if (this.key !== "") headers.set("Authorization", `Bearer ${this.key}`);
    let response: Response;
    try {
      response = await fetch(new URL(path, this.base), { ...init, headers });
    } catch (error) {
      if (init.signal?.aborted === true) throw error;
      throw new ApiError(NOT_REACHED);
    }
    if (!response.ok) throw new ApiError(problemOf(response.status, await response.text()));
    return response;
  }

  /** Get a JSON document. */
  async json<T>(path: string, init: RequestInit = {}): Promise<T> {
    return (await (await this.fetch(path, init)).json()) as T;
  }

  /**
   * Submit a job, telling how much of the file has been sent.
   *
   * @param query options of the job.
   * @param onProgress is told the bytes sent and those in all.
   * @param signal gives the upload up.
   */
  submit(
    query: URLSearchParams, file: Blob, onProgress: (sent: number, total: number) => void,
    signal: AbortSignal,
  ): Promise<Job> {
    // XMLHttpRequest, since fetch does not tell how much it has sent.
    const request = new XMLHttpRequest();
    return new Promise((resolve, reject) => {
      request.open("POST", new URL(`jobs?${query}`, this.base));
      if (this.key !== "") request.setRequestHeader("Authorization", `Bearer ${this.key}`);
      request.setRequestHeader("Content-Type", "application/octet-stream");
      request.setRequestHeader("Idempotency-Key", randomName());
      request.upload.onprogress = (event) => { onProgress(event.loaded, event.total); };
      request.onload = () => {
        if (request.status < 300) resolve(JSON.parse(request.responseText) as Job);
        else reject(new ApiError(problemOf(request.status, request.responseText)));
      };
      request.onerror = () => { reject(new ApiError(NOT_REACHED)); };
      request.onabort = () => { reject(new DOMException("The upload was given up.", "AbortError")); };
      signal.addEventListener("abort", () => { request.abort(); });
      request.send(file);
    });
  }

  /**
   * Follow a job to its end, through broken connections.
   *
   * @returns the job as it ended.
   */
  async follow(
    id: string, onChange: (job: Job | null, progress: Progress) => void, signal: AbortSignal,
  ): Promise<Job> {
    let seen = "";
    for (;;) {
      try {
        const headers: Record<string, string> = seen === "" ? {} : { "Last-Event-ID": seen };
        const response = await this.fetch(`jobs/${id}/events`, { headers, signal });
        if (response.body === null) throw new ApiError(NOT_REACHED);
        for await (const { event, data, id: revision } of readEvents(response.body)) {
          seen = revision;
          if (event === "progress") onChange(null, JSON.parse(data) as Progress);
          else {
            const job = JSON.parse(data) as Job;
            onChange(job, job.progress);
            if (event === "end") return job;
          }
        }
      } catch (error) {
        const lost = error instanceof TypeError ||
          (error instanceof ApiError && (error.problem.retryable || error.problem.status === 0));
        if (signal.aborted || !lost) throw error;
      }
      await new Promise((resolve) => setTimeout(resolve, RECONNECT_MS));
      signal.throwIfAborted();
    }
  }

  job(id: string): Promise<Job> {
    return this.json(`jobs/${encodeURIComponent(id)}`);
  }

  async jobs(limit: number): Promise<Job[]> {
    return (await this.json<{ jobs: Job[] }>(`jobs?limit=${limit}`)).jobs;
  }

  /** Cancel a job that has not ended, or delete the result of one that has. */
  withdraw(id: string): Promise<Job> {
    return this.json(`jobs/${encodeURIComponent(id)}`, { method: "DELETE" });
  }
}

function problemOf(status: number, body: string): Problem {
  try {
    const found = JSON.parse(body) as Partial<Problem>;
    if (typeof found.detail === "string" && typeof found.code === "string") return found as Problem;
  } catch {
    // Not from the service, but from a proxy before it.
  }
  const detail = `The answer was ${status}, and not from the service. A proxy may be in between.`;
  return { ...localProblem("proxy", detail), status };
}

/** A random name; `crypto.randomUUID` is missing where a page comes over plain HTTP. */
function randomName(): string {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  return Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("");
}
