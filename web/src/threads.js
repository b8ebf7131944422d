// Threads of the library: workers that share its memory. They are there before it asks for the first one, since who asks
// then waits for it and lets no worker start.

/**
 * Pages of 64 KiB that the module starts with (`--initial-memory` in web/build.sh): 1 GiB, of which a machine gives what
 * is used. Memory seldom has to grow then. Where it does, V8 may still refuse another thread to fill or copy what is new.
 */
const INITIAL = 16384;
/** Most that there may be: what 32 bits can address, or where that much address space cannot be had, less. */
const MAXIMA = [65536, 32768, INITIAL];
/** What WASI answers if there is no thread. */
const NONE = -1;

/** Whether a module needs threads. */
export function usesThreads(module) {
  return WebAssembly.Module.imports(module).some((wanted) => wanted.module === "wasi" && wanted.name === "thread-spawn");
}

/** How many threads this machine runs at once, 16 at most. */
export async function cores() {
  const found = globalThis.navigator?.hardwareConcurrency ?? (await import("node:os")).availableParallelism();
  return Math.min(found, 16);
}

/** Memory that threads share. */
export function sharedMemory() {
  for (const maximum of MAXIMA) {
    try {
      return new WebAssembly.Memory({ initial: INITIAL, maximum, shared: true });
    } catch (error) {
      if (maximum === MAXIMA.at(-1)) throw error;
    }
  }
}

/** Workers, each of which is a thread of the library for as long as one runs in it. */
export class Threads {
  #workers;
  #idle;
  #last = 0;

  /**
   * Workers for `count` threads of a module. `report` takes each line that they print. A thread that fails reports
   * its error on the `BroadcastChannel` of the name `channel`: whoever waits for the thread waits for ever.
   */
  static async start(count, { module, memory, report, channel }) {
    const threads = new Threads();
    threads.#workers = await Promise.all(Array.from({ length: count }, newWorker));
    const ready = threads.#workers.map((worker) => new Promise((resolve, reject) => {
      worker.hear((message) => {
        if (message.type === "ready") resolve();
        else if (message.type === "report") report(message.line);
        else threads.#idle.push(worker);
      }, reject);
      worker.send({ type: "load", module, memory, channel });
    }));
    threads.#idle = [...threads.#workers];
    try {
      await Promise.all(ready);
    } catch (error) {
      threads.end();
      throw error;
    }
    // They hold no process that has nothing else to do.
    threads.#workers.forEach((worker) => worker.rest());
    return threads;
  }

  /** Starts a thread: its number, or a negative one if all are taken. */
  spawn(argument) {
    const worker = this.#idle.pop();
    if (!worker) return NONE;
    this.#last += 1;
    worker.send({ type: "run", number: this.#last, argument });
    return this.#last;
  }

  /** Ends all of them, wherever they are. */
  end() {
    this.#workers.forEach((worker) => worker.end());
  }
}

/** A worker of a browser or of Node. */
async function newWorker() {
  const address = new URL("./thread.js", import.meta.url);
  if (globalThis.Worker) {
    // Of a script that is not there, Firefox does not always tell.
    const script = await fetch(address);
    if (!script.ok) throw new Error(`${address}: ${script.status} ${script.statusText}`);
    const worker = new Worker(address, { type: "module" });
    return {
      hear(listen, fail) {
        worker.onmessage = ({ data }) => listen(data);
        worker.onerror = (event) => fail(new Error(event.message ?? "a thread cannot be started"));
      },
      rest() {},
      send: (message) => worker.postMessage(message),
      end: () => worker.terminate(),
    };
  }
  const worker = new (await import("node:worker_threads")).Worker(address);
  return {
    hear(listen, fail) {
      worker.on("message", listen);
      worker.on("error", fail);
    },
    rest: () => worker.unref(),
    send: (message) => worker.postMessage(message),
    end: () => worker.terminate(),
  };
}
