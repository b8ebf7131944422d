// b2p in WebAssembly: streams to Gaussians and pictures, in whatever thread imports this module.
//
// The module is the C interface (capi/include/b2p.h) compiled for WASI. Sizes and offsets of its structs below are those
// of 32-bit addresses.

import { B2pError } from "./error.js";
import { system } from "./system.js";
import { Threads, cores, sharedMemory, usesThreads } from "./threads.js";

export { B2pError };

const STATUS = [
  "ok", "io", "truncated", "checksum", "model", "determinism", "limit", "unsupported", "malformed", "cancelled",
  "usage", "internal",
];
const HEADS = { best: 0, quick: 1, surfels: 2 };
const CONTENT = ["stream", "scene", "sequence", "splats"];
const MESSAGE = 1024;

function headsNumber(heads) {
  if (heads in HEADS) return HEADS[heads];
  throw new B2pError("usage", `no heads \`${heads}\`, but ${Object.keys(HEADS).join(", ")}`);
}

/** The library. One instance has one memory; after an `internal` error it must not be used any more. */
export class B2p {
  #exports;
  #threads;
  #message;

  /**
   * From a `Response`, its promise, bytes, or a compiled module. A module with threads takes as many as there are cores,
   * or `threads`; in a browser it has to be loaded in a worker of a page that is isolated from other origins. If one of
   * them fails, the library waits for ever: the `BroadcastChannel` of the name `channel` tells.
   */
  static async load(source, { report = console.error, threads = null, channel = "b2p" } = {}) {
    source = await source;
    const isResponse = typeof Response !== "undefined" && source instanceof Response;
    if (isResponse) source = await source.arrayBuffer();
    const module = source instanceof WebAssembly.Module ? source : await WebAssembly.compile(source);
    let memory;
    let pool = null;
    let count = 0;
    const imports = {};
    const environment = [];
    if (usesThreads(module)) {
      if (globalThis.document) throw new B2pError("usage", "a module with threads needs a worker");
      count = threads ?? (await cores());
      memory = sharedMemory();
      imports.env = { memory };
      imports.wasi = { "thread-spawn": (argument) => pool.spawn(argument) };
      environment.push(`RAYON_NUM_THREADS=${count}`);
    }
    imports.wasi_snapshot_preview1 = system({ memory: () => memory, report, environment });
    const { exports } = await WebAssembly.instantiate(module, imports);
    memory = exports.memory;
    // After the instance of this thread: the first one takes the memory that is the first thread's own.
    if (count > 0) pool = await Threads.start(count, { module, memory, report, channel });
    exports._initialize?.();
    return new B2p(exports, pool);
  }

  constructor(exports, threads) {
    this.#exports = exports;
    this.#threads = threads;
    this.#message = this._alloc(MESSAGE);
  }

  /** Ends its threads, if it has any. It must not be used any more. */
  close() {
    this.#threads?.end();
  }

  get version() {
    return this.#text(this.#exports.b2p_version());
  }

  /** Learned heads from the bytes of a model file. */
  headsModel(bytes) {
    const copy = this._copy(bytes);
    try {
      const at = this._out((out) => this._call("b2p_heads_model_from_bytes", copy.at, copy.length, out));
      return new HeadsModel(this, at);
    } finally {
      copy.free();
    }
  }

  /** Begins to decode a stream, down to `level` or to the finest. */
  decoding({ level = -1, model = null, heads = null } = {}) {
    const at = this._out((out) => this._call("b2p_decoding_start", 0, 0, 0, level, out));
    const decoding = new Decoding(this, at);
    if (model) this._call("b2p_decoding_use_heads_model", at, model.at);
    if (heads) this._call("b2p_decoding_use_heads", at, headsNumber(heads));
    return decoding;
  }

  /** A sequence of frames, whole or in an array of parts, to be played at the levels and with the heads there is time for. */
  player(bytes, { level = -1, model = null, heads = null } = {}) {
    const copy = this._copy(bytes);
    const chosen = heads ? headsNumber(heads) : -1;
    try {
      return new Player(this, this._out((out) => {
        this._call("b2p_player_open", copy.at, copy.length, model?.at ?? 0, level, chosen, out);
      }));
    } finally {
      copy.free();
    }
  }

  /** All of a stream: the Gaussians of its finest level, or of `level`. */
  decode(bytes, options) {
    const decoding = this.decoding(options);
    try {
      decoding.push(bytes);
      decoding.finish();
      return decoding.gaussians();
    } finally {
      decoding.free();
    }
  }

  /**
   * What a file holds by its first 4096 bytes, or all of them: `stream`, `scene`, `sequence`, or `splats`, which may be
   * Gaussians as other programs write them. Whatever else it is, the error says.
   */
  content(bytes) {
    const copy = this._copy(bytes);
    try {
      return CONTENT[this._out((out) => this._call("b2p_content", copy.at, copy.length, out))];
    } finally {
      copy.free();
    }
  }

  /** The Gaussians of a PLY, SPZ, SOG, .splat, glTF, CSV or NumPy file: its bytes, whole or in an array of parts. */
  splats(bytes) {
    const copy = this._copy(bytes);
    try {
      const at = this._out((out) => this._call("b2p_gaussians_from_file", copy.at, copy.length, 0, out));
      return new Gaussians(this, at);
    } finally {
      copy.free();
    }
  }

  /** Calls a function of the C interface that returns a status, and throws what is not ok. */
  _call(name, ...args) {
    const status = this.#exports[name](...args, this.#message, MESSAGE);
    if (status !== 0) throw new B2pError(STATUS[status] ?? "internal", this.#text(this.#message));
  }

  /** A function of the C interface that returns something else. */
  _plain(name, ...args) {
    return this.#exports[name](...args);
  }

  /** The number that `run` has written where it was told to. */
  _out(run) {
    const at = this._alloc(4);
    try {
      this._view().setUint32(at, 0, true);
      run(at);
      return this._view().getInt32(at, true);
    } finally {
      this._free(at, 4);
    }
  }

  _alloc(size) {
    const at = this.#exports.b2p_alloc(size);
    if (at === 0) throw new B2pError("limit", `no memory for ${size} bytes`);
    return at;
  }

  _free(at, size) {
    this.#exports.b2p_dealloc(at, size);
  }

  /** Bytes, or an array of parts, in the library's memory. */
  _copy(bytes) {
    const parts = (Array.isArray(bytes) ? bytes : [bytes]).map((part) => {
      return part instanceof Uint8Array ? part : new Uint8Array(part);
    });
    const length = parts.reduce((sum, part) => sum + part.length, 0);
    const at = this._alloc(length);
    const to = new Uint8Array(this.#buffer(), at, length);
    let place = 0;
    for (const part of parts) {
      to.set(part, place);
      place += part.length;
    }
    return { at, length, free: () => this._free(at, length) };
  }

  _view() {
    return new DataView(this.#buffer());
  }

  _array(Type, at, length) {
    return new Type(this.#buffer(), at, length);
  }

  /** The memory as it is now: V8 tells a thread late of what another has let grow, unless it grows itself. */
  #buffer() {
    const { memory } = this.#exports;
    if (this.#threads) memory.grow(0);
    return memory.buffer;
  }

  #text(at) {
    const bytes = new Uint8Array(this.#buffer(), at);
    // Copied: memory that threads share is not decoded.
    return new TextDecoder().decode(bytes.slice(0, bytes.indexOf(0)));
  }
}

/** What the library made, until it is freed. */
class Handle {
  constructor(library, at, free) {
    this.library = library;
    this.at = at;
    this.release = free;
  }

  free() {
    if (this.at) this.library._plain(this.release, this.at);
    this.at = 0;
  }
}

export class HeadsModel extends Handle {
  constructor(library, at) {
    super(library, at, "b2p_heads_model_free");
  }
}

/** A stream that is decoded as its bytes arrive. */
export class Decoding extends Handle {
  constructor(library, at) {
    super(library, at, "b2p_decoding_free");
  }

  push(bytes) {
    const copy = this.library._copy(bytes);
    try {
      this.library._call("b2p_decoding_push", this.at, copy.at, copy.length);
    } finally {
      copy.free();
    }
  }

  /** Decodes the next level if all of it has come: its number, or `null`. To be called until it is `null`. */
  advance() {
    const level = this.library._out((out) => this.library._call("b2p_decoding_advance", this.at, out));
    return level < 0 ? null : level;
  }

  /** Decodes what is left, knowing that no more bytes will come. */
  finish() {
    this.library._call("b2p_decoding_finish", this.at);
  }

  /** The finest level decoded so far, or `null`. */
  get level() {
    const level = this.library._plain("b2p_decoding_level", this.at);
    return level < 0 ? null : level;
  }

  /** The Gaussians of the finest level decoded so far. */
  gaussians() {
    const at = this.library._out((out) => this.library._call("b2p_decoding_gaussians", this.at, out));
    return new Gaussians(this.library, at);
  }

  /** Coordinates (3 numbers a voxel) and colours (3 bytes a voxel) of the finest level decoded so far, copied. */
  points() {
    const { library } = this;
    const points = library._out((out) => library._call("b2p_decoding_points", this.at, out));
    const arrays = library._alloc(56);
    try {
      library._call("b2p_points_arrays", points, arrays);
      const view = library._view();
      const [count, coordinate, colour] = [0, 4, 8].map((offset) => view.getUint32(arrays + offset, true));
      return {
        count,
        level: view.getUint8(arrays + 12),
        origin: [16, 24, 32].map((offset) => view.getFloat64(arrays + offset, true)),
        voxelSize: view.getFloat64(arrays + 40, true),
        coordinates: library._array(Uint32Array, coordinate, 3 * count).slice(),
        colours: library._array(Uint8Array, colour, 3 * count).slice(),
      };
    } finally {
      library._free(arrays, 56);
      library._plain("b2p_points_free", points);
    }
  }
}

/**
 * A sequence that is played. `next` decodes a frame; its user draws it when it is due, and says by `took` how long that
 * took. It stands at first.
 */
export class Player extends Handle {
  constructor(library, at) {
    super(library, at, "b2p_player_free");
  }

  /** Length in seconds, number of frames, and the levels that can be drawn. */
  info() {
    const { library } = this;
    const at = library._alloc(24);
    try {
      library._call("b2p_player_info", this.at, at);
      const view = library._view();
      const [frames, base, top] = [8, 12, 16].map((offset) => view.getUint32(at + offset, true));
      return { seconds: view.getFloat64(at, true), frames, base, top };
    } finally {
      library._free(at, 24);
    }
  }

  play() {
    this.library._plain("b2p_player_play", this.at);
  }

  /** Stays at the frame that was shown last, which is then decoded as accurately as it can be. */
  pause() {
    this.library._plain("b2p_player_pause", this.at);
  }

  /** Goes to the frame at a time in seconds. */
  seek(time) {
    this.library._plain("b2p_player_seek", this.at, time);
  }

  /** Pauses so many frames further on, or back. */
  step(by) {
    this.library._plain("b2p_player_step", this.at, by);
  }

  /** How many times as fast as it was recorded it is played, from ⅛ to 8. */
  set speed(speed) {
    this.library._plain("b2p_player_speed", this.at, speed);
  }

  /**
   * Decodes the next frame: its number, time, level, heads and Gaussians, which are `null` if it is not to be shown; the
   * seconds until it is `due` and those that there are for a frame (`budget`, 0 if it stands); how many were `dropped`.
   * `error` says why it is skipped. `null`: there is nothing to do until something else is wanted.
   */
  next() {
    const { library } = this;
    const frame = library._alloc(48);
    let error = null;
    try {
      const gaussians = library._out((out) => {
        try {
          library._call("b2p_player_next", this.at, frame, out);
        } catch (thrown) {
          if (thrown.kind === "internal" || !(thrown instanceof B2pError)) throw thrown;
          error = thrown;
        }
      });
      const view = library._view();
      if (view.getUint8(frame + 40) === 0) {
        if (error) throw error;
        return null;
      }
      const [time, due, budget] = [0, 8, 16].map((offset) => view.getFloat64(frame + offset, true));
      const [number, dropped, level, heads] = [24, 28, 32, 36].map((offset) => view.getUint32(frame + offset, true));
      return {
        number, time, due, budget, dropped, level, error,
        heads: Object.keys(HEADS)[heads],
        gaussians: gaussians ? new Gaussians(library, gaussians) : null,
      };
    } finally {
      library._free(frame, 48);
    }
  }

  /** How long the last frame took, decoded and drawn, in seconds. */
  took(seconds) {
    this.library._plain("b2p_player_took", this.at, seconds);
  }
}

/** Gaussians of a level, in the cube frame, where the voxel cube reaches from −1 to 1. */
export class Gaussians extends Handle {
  constructor(library, at) {
    super(library, at, "b2p_gaussians_free");
  }

  /**
   * Views of their numbers, valid until the library is next called: `position`, `scale` and `colour` (3 each),
   * `rotation` (w, x, y, z), `opacity`; world = origin + (position + 1) · unit.
   */
  arrays() {
    const { library } = this;
    const at = library._alloc(56);
    try {
      library._call("b2p_gaussians_arrays", this.at, at);
      const view = library._view();
      const [count, ...places] = [0, 4, 8, 12, 16, 20].map((offset) => view.getUint32(at + offset, true));
      const widths = { position: 3, scale: 3, rotation: 4, opacity: 1, colour: 3 };
      const arrays = Object.entries(widths).map(([name, width], i) => {
        return [name, library._array(Float32Array, places[i], width * count)];
      });
      return {
        count,
        ...Object.fromEntries(arrays),
        origin: [24, 32, 40].map((offset) => view.getFloat64(at + offset, true)),
        unit: view.getFloat64(at + 48, true),
      };
    } finally {
      library._free(at, 56);
    }
  }

  /**
   * A picture: `width × height` pixels of red, green, blue, alpha (8 bits each, premultiplied), as `ImageData` takes.
   * `background` is a colour in [0, 1] or `null` for none.
   */
  render({ azimuth = 20, elevation = 20, distance = 2.6, fov = 45, width, height, background = [1, 1, 1] }) {
    const { library } = this;
    const [camera, length] = [library._alloc(56), 4 * width * height];
    const pixels = library._alloc(length);
    try {
      const view = library._view();
      [azimuth, elevation, distance, fov].forEach((x, i) => view.setFloat64(camera + 8 * i, x, true));
      [width, height].forEach((x, i) => view.setUint32(camera + 32 + 4 * i, x, true));
      (background ?? [0, 0, 0]).forEach((x, i) => view.setFloat32(camera + 40 + 4 * i, x, true));
      view.setUint8(camera + 52, background ? 0 : 1);
      library._call("b2p_render", this.at, camera, 0, pixels, length);
      return library._array(Uint8ClampedArray, pixels, length).slice();
    } finally {
      library._free(pixels, length);
      library._free(camera, 56);
    }
  }
}
