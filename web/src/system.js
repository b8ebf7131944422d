// The calls of WASI that the library makes: a clock, chance, and messages of defects. There are no files.

import { B2pError } from "./error.js";

const BADF = 8;

/**
 * Imports for a module whose memory `memory()` gives. `report` takes each line that the library prints; `environment`
 * are lines `NAME=VALUE`.
 */
export function system({ memory, report, environment = [] }) {
  const view = () => new DataView(memory().buffer);
  const none = () => BADF;
  const variables = environment.map((line) => new TextEncoder().encode(`${line}\0`));
  let line = "";
  return {
    environ_sizes_get(count, size) {
      view().setUint32(count, variables.length, true);
      view().setUint32(size, variables.reduce((sum, { length }) => sum + length, 0), true);
      return 0;
    },
    environ_get(places, to) {
      variables.forEach((bytes, i) => {
        view().setUint32(places + 4 * i, to, true);
        new Uint8Array(memory().buffer, to, bytes.length).set(bytes);
        to += bytes.length;
      });
      return 0;
    },
    // All threads have the same clock.
    clock_time_get(_clock, _precision, to) {
      const milliseconds = performance.timeOrigin + performance.now();
      view().setBigUint64(to, BigInt(Math.round(milliseconds * 1e6)), true);
      return 0;
    },
    // Chance for the keys of hash tables: 65,536 bytes at most are given at a time, and none into shared memory.
    random_get(to, length) {
      new Uint8Array(memory().buffer, to, length).set(crypto.getRandomValues(new Uint8Array(length)));
      return 0;
    },
    fd_write(_file, vectors, count, written) {
      let total = 0;
      for (let i = 0; i < count; i++) {
        const at = view().getUint32(vectors + 8 * i, true);
        const length = view().getUint32(vectors + 8 * i + 4, true);
        line += new TextDecoder().decode(new Uint8Array(memory().buffer, at, length).slice());
        total += length;
      }
      const lines = line.split("\n");
      line = lines.pop();
      lines.forEach(report);
      view().setUint32(written, total, true);
      return 0;
    },
    sched_yield: () => 0,
    proc_exit(code) {
      throw new B2pError("internal", `the library ended with ${code}`);
    },
    fd_close: none, fd_fdstat_get: none, fd_filestat_get: none, fd_prestat_get: none, fd_prestat_dir_name: none,
    fd_read: none, path_open: none,
  };
}
