// SPDX-License-Identifier: Apache-2.0
import { UnreadableCloudError } from "./cloud";
import type { Calls, Reply } from "./messages";

interface Waiting {
  resolve: (value: never) => void;
  reject: (error: Error) => void;
}

/** The worker that reads clouds, as a function that returns promises. */
export class Reader {
  private readonly worker = new Worker(new URL("./worker.ts", import.meta.url), { type: "module" });
  private readonly waiting = new Map<number, Waiting>();
  private next = 0;

  constructor() {
    this.worker.onmessage = ({ data }: MessageEvent<Reply>) => {
      const waiting = this.waiting.get(data.id);
      this.waiting.delete(data.id);
      if ("result" in data) waiting?.resolve(data.result as never);
      else {
        const kind = data.unreadable ? UnreadableCloudError : Error;
        waiting?.reject(new kind(data.error));
      }
    };
    this.worker.onerror = () => {
      for (const { reject } of this.waiting.values()) {
        reject(new UnreadableCloudError("The file is too large for the memory of this browser."));
      }
      this.waiting.clear();
    };
  }

  /** Call the worker; calls are answered in order. */
  call<K extends keyof Calls>(call: K, args: Calls[K]["args"]): Promise<Calls[K]["result"]> {
    const id = this.next++;
    return new Promise((resolve, reject) => {
      this.waiting.set(id, { resolve, reject });
      this.worker.postMessage({ id, call, args });
    });
  }
}
