// SPDX-License-Identifier: Apache-2.0
import { ApiError, localProblem, type Problem } from "../api/types";
import { byId } from "./dom";

const TITLES: Record<number, string> = {
  0: "That did not work",
  400: "The file is broken",
  401: "A key is needed",
  404: "That is not there",
  410: "The result is gone",
  413: "That is too large",
  415: "This is not a point cloud",
  422: "That cannot be done",
  429: "Your share is used up",
  500: "The service failed",
  503: "The service is busy",
  504: "That took too long",
};

/** The card that tells what went wrong, with the id under which the log has it. */
export class ProblemCard {
  private readonly card = byId("problem");

  constructor() {
    byId("dismiss").onclick = () => { this.hide(); };
  }

  /** Show an error; `retry` does the same again, where that may help. */
  show(error: unknown, retry: (() => void) | null): void {
    const problem = problemOf(error);
    byId("problem-title").textContent = TITLES[problem.status] ?? problem.title;
    byId("problem-detail").textContent = problem.detail;
    const id = byId("problem-id");
    id.textContent = problem.request_id === "" ? "" : `Request ${problem.request_id}`;
    id.hidden = problem.request_id === "";
    const button = byId("retry");
    button.hidden = retry === null || !problem.retryable;
    button.onclick = () => {
      this.hide();
      retry?.();
    };
    this.card.hidden = false;
    this.card.scrollIntoView({ block: "nearest" });
  }

  hide(): void {
    this.card.hidden = true;
  }
}

function problemOf(error: unknown): Problem {
  if (error instanceof ApiError) return error.problem;
  const detail = error instanceof Error ? error.message : String(error);
  return { ...localProblem("page", detail), retryable: false };
}
