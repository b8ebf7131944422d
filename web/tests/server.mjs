// Serves `web/`, and streams under `/streams/` as tests give them.

import { createServer } from "node:http";
import { readFile } from "node:fs/promises";
import { extname, join, normalize } from "node:path";

const TYPES = { ".html": "text/html", ".js": "text/javascript", ".wasm": "application/wasm", ".json": "application/json" };
const web = new URL("..", import.meta.url).pathname;

const ISOLATION = { "cross-origin-opener-policy": "same-origin", "cross-origin-embedder-policy": "require-corp" };

/**
 * A server and its address. `streams` maps a name to a function that answers with it. Its pages may be isolated from
 * other origins, and files of the page may be missing.
 */
export async function serve(streams, { isolated = false, missing = [] } = {}) {
  const server = createServer(async (request, response) => {
    const path = normalize(new URL(request.url, "http://localhost").pathname);
    const stream = streams[path.replace("/streams/", "")];
    if (path.startsWith("/streams/") && stream) return stream(response);
    try {
      const file = path === "/" ? "/index.html" : path;
      if (missing.includes(file)) throw new Error("missing");
      const bytes = await readFile(join(web, file));
      const type = TYPES[extname(file)] ?? "application/octet-stream";
      response.writeHead(200, { "content-type": type, ...(isolated ? ISOLATION : {}) }).end(bytes);
    } catch {
      response.writeHead(404).end();
    }
  });
  await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
  return { address: `http://127.0.0.1:${server.address().port}`, close: () => server.close() };
}

/** Answers with all bytes. */
export const whole = (bytes) => (response) => response.end(bytes);

/** Answers with some bytes, and then breaks the connection, before a level of them is decoded. */
export const broken = (bytes, length) => (response) => {
  response.writeHead(200, { "content-length": bytes.length });
  response.write(bytes.subarray(0, length), () => setTimeout(() => response.destroy(), 50));
};

/** Answers with some bytes, and with the others when `go` is called. */
export function paused(bytes, length) {
  let go;
  const waiting = new Promise((resolve) => (go = resolve));
  const answer = async (response) => {
    response.writeHead(200, { "content-length": bytes.length });
    response.write(bytes.subarray(0, length));
    await waiting;
    response.end(bytes.subarray(length));
  };
  return { answer, go };
}
