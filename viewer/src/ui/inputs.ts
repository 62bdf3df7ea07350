// SPDX-License-Identifier: Apache-2.0

/** The input of a job, which the service deletes once it is done. */
export interface KeptInput {
  readonly id: string;
  readonly name: string;
  readonly file: Blob;
  readonly time: number;
}

const STORE = "inputs";
const MOST = 12;
const MOST_BYTES = 500_000_000;

/** Keeps the inputs of recent jobs in this browser, so that a job can be looked at again. */
export class Inputs {
  private readonly database: Promise<IDBDatabase | null> = open();

  /** Return the input of a job, or `null` where this browser has not sent it. */
  async get(id: string): Promise<KeptInput | null> {
    const found = await this.run<KeptInput | undefined>("readonly", (store) => store.get(id));
    return found ?? null;
  }

  /** Keep an input, and let the oldest ones go where there are too many. */
  async put(input: KeptInput): Promise<void> {
    if (input.file.size > MOST_BYTES) return;
    await this.run("readwrite", (store) => store.put(input));
    let room = MOST_BYTES;
    for (const [place, kept] of (await this.all()).entries()) {
      room -= kept.file.size;
      if (place >= MOST || room < 0) await this.run("readwrite", (store) => store.delete(kept.id));
    }
  }

  /** File names by the id of the job. */
  async names(): Promise<Map<string, string>> {
    return new Map((await this.all()).map(({ id, name }) => [id, name]));
  }

  private async all(): Promise<KeptInput[]> {
    const found = await this.run<KeptInput[]>("readonly", (store) => store.getAll());
    return (found ?? []).sort((a, b) => b.time - a.time);
  }

  private async run<T>(
    mode: IDBTransactionMode, act: (store: IDBObjectStore) => IDBRequest,
  ): Promise<T | undefined> {
    const database = await this.database;
    if (database === null) return undefined;
    return new Promise((resolve) => {
      const request = act(database.transaction(STORE, mode).objectStore(STORE));
      request.onsuccess = () => { resolve(request.result as T); };
      // A full disk or a private window: the page works without, from the file in hand.
      request.onerror = () => { resolve(undefined); };
    });
  }
}

function open(): Promise<IDBDatabase | null> {
  return new Promise((resolve) => {
    const request = indexedDB.open("pugeo", 1);
    request.onupgradeneeded = () => { request.result.createObjectStore(STORE, { keyPath: "id" }); };
    request.onsuccess = () => { resolve(request.result); };
    request.onerror = () => { resolve(null); };
  });
}
