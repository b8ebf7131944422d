// The library in a thread of its own, for `Viewer`. Messages in: load, open, bytes, end, view, draw, play, pause, seek,
// step, speed; out: ready, level, sequence, picture, skipped, done, error.

import { B2p, B2pError } from "./b2p.js";
import { Playing } from "./playing.js";

/** Bytes that tell what a file is. */
const ENOUGH = 4096;
/** Bytes of a file that is read as a whole, at most: as the limits of the library. */
const MOST = 2 ** 31;

let library;
let model = null;
let gaussians = null;
/** What takes the bytes of the file that is open, until it is read. */
let source = null;
/** The sequence that is played. */
let playing = null;
/** The number of the file that is open: messages about others are late. */
let stream = 0;
/** The camera, and the size of the canvas. */
let view = null;

/** Runs `step`; an error of it goes to the page. After a defect the instance cannot be used any more. */
function attempt(step) {
  if (!library) return null;
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
  if (library) {
    source?.free();
    playing?.free();
  }
  source = playing = null;
}

function replace(next) {
  gaussians?.free();
  gaussians = next;
}

function show(next, level, milliseconds) {
  replace(next);
  postMessage({ type: "level", stream, level, count: next.arrays().count, milliseconds });
}

/** A picture with `scale` times the canvas' pixels along each side. */
function draw(what, scale) {
  const start = performance.now();
  const [width, height] = [view.width, view.height].map((pixels) => Math.max(1, Math.round(pixels * scale)));
  const pixels = what.render({ ...view, width, height });
  return { pixels, width, height, milliseconds: performance.now() - start };
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
    source = new (READERS[content])(this.options);
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

/** A file that is read when all of it is there. */
class Whole {
  parts = [];
  length = 0;

  push(bytes) {
    this.length += bytes.length;
    if (this.length > MOST) throw new B2pError("limit", `the file has more than ${MOST} bytes`);
    this.parts.push(bytes);
  }

  free() {}
}

/** A file of Gaussians. */
class Splats extends Whole {
  end() {
    const start = performance.now();
    show(library.splats(this.parts), null, performance.now() - start);
    return null;
  }
}

/** A sequence, which stands at its first frame until it is played. */
class Sequence extends Whole {
  constructor({ heads, level }) {
    super();
    this.options = { model, heads, level };
  }

  end() {
    const player = library.player(this.parts, this.options);
    const info = player.info();
    postMessage({ type: "sequence", stream, ...info });
    playing = new Playing(player, { attempt, draw, hand });
    playing.go();
    return info.top;
  }
}

const READERS = { stream: Stream, scene: Stream, splats: Splats, sequence: Sequence };

/** Shows what was played: a frame with its picture, or why there is none. */
function hand({ gaussians: next, picture, error, ...frame }) {
  if (error) {
    return postMessage({ type: "skipped", stream, number: frame.number, kind: error.kind, message: error.message });
  }
  if (next !== gaussians) replace(next);
  frame.count = next.arrays().count;
  postMessage({ type: "picture", stream, frame, ...picture }, [picture.pixels.buffer]);
}

const on = {
  async load({ module, channel, heads }) {
    try {
      library = await B2p.load(module, { channel });
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
  broken({ number }) {
    postMessage({ type: "broken", stream: number });
  },
  end({ number }) {
    if (number !== stream || !source) return;
    attempt(() => {
      const level = source.end();
      postMessage({ type: "done", stream, level });
      source.free();
      source = null;
    });
  },
  view(message) {
    ({ view } = message);
  },
  draw({ view: wanted, ticket }) {
    view = wanted;
    if (!library || !gaussians) return postMessage({ type: "picture", ticket, pixels: null });
    attempt(() => {
      const picture = draw(gaussians, ticket);
      postMessage({ type: "picture", ticket, ...picture }, [picture.pixels.buffer]);
    });
  },
  play: () => playing?.play(),
  pause: () => playing?.pause(),
  seek: ({ time }) => playing?.seek(time),
  step: ({ by }) => playing?.step(by),
  speed: ({ speed }) => playing?.setSpeed(speed),
};

// One message after the other: loading is asynchronous.
let last = Promise.resolve();
onmessage = ({ data }) => {
  last = last.then(() => on[data.type](data));
};
