// The library in a thread of its own, for `Viewer`. Messages in: load, open, bytes, end, draw; out: ready, level, picture,
// done, error.

import { B2p, B2pError } from "./b2p.js";

/** Bytes that tell what a file is. */
const ENOUGH = 4096;
/** Bytes of a file that is read as a whole, at most: as the limits of the library. */
const MOST = 2 ** 31;

let library;
let model = null;
let gaussians = null;
/** What takes the bytes of the file that is open, until it is read. */
let source = null;
/** The number of the file that is open: messages about others are late. */
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
  if (library) source?.free();
  source = null;
}

function show(next, level, milliseconds) {
  gaussians?.free();
  gaussians = next;
  postMessage({ type: "level", stream, level, count: next.arrays().count, milliseconds });
}

/** A file of which too little is there to know what it is. */
class Unknown {
  start = [];
  length = 0;

  constructor(options) {
    this.options = options;
  }

  push(bytes) {
    this.start.push(bytes);
    this.length += bytes.length;
    if (this.length >= ENOUGH) this.begin();
  }

  /** Gives way to what reads the file. */
  begin() {
    const content = library.content(this.start);
    source = content === "splats" ? new Splats() : new Stream(this.options);
    for (const bytes of this.start) source.push(bytes);
  }

  end() {
    this.begin();
    return source.end();
  }

  free() {}
}

/** A stream or a scene, whose levels are shown as they arrive. */
class Stream {
  constructor({ heads, level }) {
    this.decoding = library.decoding({ model, heads, level });
  }

  push(bytes) {
    this.decoding.push(bytes);
    for (;;) {
      const start = performance.now();
      const level = this.decoding.advance();
      if (level === null) return;
      show(this.decoding.gaussians(), level, performance.now() - start);
    }
  }

  end() {
    const { decoding } = this;
    const before = decoding.level;
    const start = performance.now();
    decoding.finish();
    if (decoding.level !== before) show(decoding.gaussians(), decoding.level, performance.now() - start);
    return decoding.level;
  }

  free() {
    this.decoding.free();
  }
}

/** A file of Gaussians, which is read when all of it is there. */
class Splats {
  parts = [];
  length = 0;

  push(bytes) {
    this.length += bytes.length;
    if (this.length > MOST) throw new B2pError("limit", `the file has more than ${MOST} bytes`);
    this.parts.push(bytes);
  }

  end() {
    const start = performance.now();
    show(library.splats(this.parts), null, performance.now() - start);
    return null;
  }

  free() {}
}

const on = {
  async load({ module, heads }) {
    try {
      library = await B2p.load(module);
    } catch (error) {
      return postMessage({ type: "error", stream: "ready", kind: "internal", message: error.message });
    }
    if (heads) attempt(() => (model = library.headsModel(heads)));
    postMessage({ type: "ready", version: library.version });
  },
  open({ number, heads, level }) {
    close();
    stream = number;
    if (library) source = new Unknown({ heads, level });
    else postMessage({ type: "error", stream, kind: "internal", message: "the library has failed: load it again" });
  },
  bytes({ number, bytes }) {
    if (number === stream && source) attempt(() => source.push(bytes));
  },
  end({ number }) {
    if (number !== stream || !source) return;
    attempt(() => {
      const level = source.end();
      postMessage({ type: "done", stream, level });
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
