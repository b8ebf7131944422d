// The library in a thread of its own, for `Viewer`. Messages in: open, bytes, end, fail, draw; out: ready, level,
// picture, done, error.

import { B2p } from "./b2p.js";

let library;
let model = null;
let decoding = null;
let gaussians = null;
/** The number of the stream that is open: messages about others are late. */
let stream = 0;

/** Runs `step`; an error of it goes to the page. After a defect the instance cannot be used any more. */
function attempt(step) {
  try {
    return step();
  } catch (error) {
    const kind = error.kind ?? "internal";
    if (kind === "internal") library = null;
    postMessage({ type: "error", stream, kind, message: error.message });
    close();
    return null;
  }
}

function close() {
  if (library) decoding?.free();
  decoding = null;
}

function show(next, level, milliseconds) {
  gaussians?.free();
  gaussians = next;
  postMessage({ type: "level", stream, level, count: next.arrays().count, milliseconds });
}

/** Decodes and shows what has come. */
function advance() {
  for (;;) {
    const start = performance.now();
    const level = decoding.advance();
    if (level === null) return;
    show(decoding.gaussians(), level, performance.now() - start);
  }
}

const on = {
  async load({ module, heads }) {
    library = await B2p.load(module);
    if (heads) attempt(() => (model = library.headsModel(heads)));
    postMessage({ type: "ready", version: library.version });
  },
  open({ number, heads, level }) {
    close();
    stream = number;
    if (library) attempt(() => (decoding = library.decoding({ model, heads, level })));
    else postMessage({ type: "error", stream, kind: "internal", message: "the library has failed: load it anew" });
  },
  bytes({ number, bytes }) {
    if (number !== stream || !decoding) return;
    attempt(() => (decoding.push(bytes), advance()));
  },
  end({ number }) {
    if (number !== stream || !decoding) return;
    attempt(() => {
      const before = decoding.level;
      const start = performance.now();
      decoding.finish();
      if (decoding.level !== before) show(decoding.gaussians(), decoding.level, performance.now() - start);
      postMessage({ type: "done", stream, level: decoding.level });
      close();
    });
  },
  draw({ view, ticket }) {
    if (!library || !gaussians) return postMessage({ type: "picture", ticket, pixels: null });
    attempt(() => {
      const start = performance.now();
      const pixels = gaussians.render(view);
      const { width, height } = view;
      const milliseconds = performance.now() - start;
      postMessage({ type: "picture", ticket, pixels, width, height, milliseconds }, [pixels.buffer]);
    });
  },
};

// One message after the other: loading is asynchronous.
let last = Promise.resolve();
onmessage = ({ data }) => {
  last = last.then(() => on[data.type](data));
};
