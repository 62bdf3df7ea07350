// SPDX-License-Identifier: Apache-2.0

/** An error as the service tells it (RFC 9457). */
export interface Problem {
  readonly status: number;
  readonly title: string;
  readonly detail: string;
  readonly code: string;
  readonly request_id: string;
  readonly retryable: boolean;
}

export type State = "queued" | "running" | "succeeded" | "failed" | "cancelled" | "expired";

export interface Progress {
  readonly stage: string;
  readonly done: number;
  readonly total: number | null;
}

export interface Report {
  readonly points_in: number;
  readonly points_out: number;
  readonly dropped: Readonly<Record<string, number>>;
  readonly notes: readonly string[];
  readonly noise?: number | null;
  readonly orient?: string;
}

/** A job as the service tells it. */
export interface Job {
  readonly id: string;
  readonly state: State;
  readonly progress: Progress;
  readonly options: Readonly<Record<string, string | number | boolean | null>>;
  readonly input: { readonly bytes: number };
  readonly result: { readonly bytes: number; readonly media_type: string } | null;
  readonly report: Report | null;
  readonly problem: Problem | null;
  readonly request_id: string;
  readonly created_at: string;
  readonly started_at: string | null;
  readonly finished_at: string | null;
  readonly expires_at: string | null;
}

/** A call that the service refused, or that did not reach it. */
export class ApiError extends Error {
  override readonly name = "ApiError";

  constructor(readonly problem: Problem) {
    super(problem.detail);
  }
}

/** Make a problem of what happened before the service could answer. */
export function localProblem(code: string, detail: string): Problem {
  return { status: 0, title: "", detail, code, request_id: "", retryable: true };
}
