// A thread of the library. Messages in: load, run; out: ready, report, idle.

import { system } from "./system.js";

let send;
let instance;
let channel;

const on = {
  load(message) {
    const { module, memory } = message;
    channel = message.channel;
    instance = new WebAssembly.Instance(module, {
      env: { memory },
      wasi_snapshot_preview1: system({ memory: () => memory, report: (line) => send({ type: "report", line }) }),
      // Only the thread that loads the library starts others.
      wasi: { "thread-spawn": () => -1 },
    });
    send({ type: "ready" });
  },
  run({ number, argument }) {
    try {
      instance.exports.wasi_thread_start(number, argument);
    } catch (error) {
      const open = new BroadcastChannel(channel);
      open.postMessage({ message: error.message });
      open.close();
      return;
    }
    send({ type: "idle" });
  },
};

if (globalThis.WorkerGlobalScope) {
  send = (message) => postMessage(message);
  onmessage = ({ data }) => on[data.type](data);
} else {
  const { parentPort } = await import("node:worker_threads");
  send = (message) => parentPort.postMessage(message);
  parentPort.on("message", (message) => on[message.type](message));
}
