// SPDX-License-Identifier: Apache-2.0

export interface ServerEvent {
  readonly event: string;
  readonly data: string;
  readonly id: string;
}

/**
 * Split a stream into server-sent events.
 *
 * The browser's own EventSource cannot send an Authorization header.
 */
export async function* readEvents(stream: ReadableStream<Uint8Array>): AsyncGenerator<ServerEvent> {
  const reader = stream.pipeThrough(new TextDecoderStream() as never).getReader() as
    ReadableStreamDefaultReader<string>;
  let buffer = "";
  let id = "";
  try {
    for (;;) {
      const { done, value } = await reader.read();
      if (done) return;
      buffer = (buffer + value).replace(/\r\n?/g, "\n");
      let end = buffer.indexOf("\n\n");
      for (; end >= 0; end = buffer.indexOf("\n\n")) {
        const found = parse(buffer.slice(0, end));
        buffer = buffer.slice(end + 2);
        id = found.id || id;
        if (found.data !== "") yield { ...found, id };
      }
    }
  } finally {
    await reader.cancel().catch(() => undefined);
  }
}

function parse(block: string): ServerEvent {
  const fields: Record<string, string> = { event: "message", data: "", id: "" };
  const data: string[] = [];
  for (const line of block.split("\n")) {
    const found = /^(\w+):? ?(.*)$/.exec(line);
    if (found === null) continue;
    if (found[1] === "data") data.push(found[2]);
    else fields[found[1]] = found[2];
  }
  return { event: fields.event, id: fields.id, data: data.join("\n") };
}
