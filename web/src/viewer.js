// A canvas that shows a stream, a sequence or a file of Gaussians: levels appear as they arrive, drag, wheel and touch move
// the camera.

const FASTEST = 50;
const LEAST_SCALE = 0.25;

/** Where the eye is: degrees, and a distance in units of the cube frame, which reaches from −1 to 1. */
const START = { azimuth: 20, elevation: 20, distance: 2.6, fov: 45 };

export class Viewer extends EventTarget {
  #canvas;
  #context;
  #worker;
  #ready;
  #camera = { ...START };
  #background;
  #stream = 0;
  #cancel = null;
  #waiting = new Map();
  /** Of the pixels of the canvas along each side, so many are drawn while the camera moves. */
  #scale = 1;
  #drawing = false;
  #again = null;
  /** Whether frames come by themselves, each with the camera that was sent last. */
  #playing = false;
  /** Tells of threads that fail, for which the worker would wait. */
  #defects = new BroadcastChannel(`b2p-${crypto.randomUUID?.() ?? Math.random()}`);
  /** What is shown on the canvas, one picture after the other. */
  #shown = Promise.resolve();
  #rest = 0;
  #touches = new Map();

  /**
   * `wasm` and `worker` are addresses of the library and of `worker.js`; `threads` that of the library with threads,
   * which is taken where the page is isolated from other origins, or `null`; `heads` that of a model file of learned
   * heads, without which streams are drawn as surfels. `background` is a colour in [0, 1] or `null` for none.
   */
  constructor(canvas, { wasm, threads, worker, heads = null, background = [1, 1, 1] } = {}) {
    super();
    this.#canvas = canvas;
    this.#context = canvas.getContext("2d");
    this.#background = background;
    this.#worker = new Worker(worker ?? new URL("./worker.js", import.meta.url), { type: "module" });
    this.#worker.onmessage = ({ data }) => this.#hear(data);
    this.#worker.onerror = (event) => this.#fail("internal", event.message ?? "the worker cannot be started");
    const beside = (given, name) => (given === undefined ? new URL(name, import.meta.url) : given);
    const shared = globalThis.crossOriginIsolated ? beside(threads, "../b2p-threads.wasm") : null;
    this.#ready = this.#load(beside(wasm, "../b2p.wasm"), shared, heads);
    this.#ready.catch(({ kind = "internal", message }) => this.#tell("failure", { kind, message }));
    this.#defects.onmessage = ({ data }) => this.#end(data.message);
    this.#listen();
  }

  get camera() {
    return { ...this.#camera };
  }

  set camera(camera) {
    Object.assign(this.#camera, camera);
    this.draw();
  }

  /**
   * Shows a stream, a sequence or a file of Gaussians: its address, a `Response`, a `Blob`, bytes, or a `ReadableStream`
   * of bytes. Ends when its last level is there, with that level, or with `null` if it has none; the event `level` reports
   * levels that arrive. A sequence stands at its first frame when the event `sequence` tells of it. Another call ends the
   * one before.
   */
  async open(source, { heads = null, level = -1 } = {}) {
    this.#cancel?.();
    const number = ++this.#stream;
    this.#playing = false;
    await this.#ready;
    const done = new Promise((resolve, reject) => this.#waiting.set(number, { resolve, reject }));
    this.#worker.postMessage({ type: "view", view: this.#view() });
    this.#worker.postMessage({ type: "open", number, heads, level });
    try {
      await this.#feed(number, await readable(source));
    } catch (error) {
      if (number === this.#stream) {
        // The levels that came are shown before the fault.
        this.#worker.postMessage({ type: "broken", number });
        await done.catch(() => {});
      }
      this.#waiting.delete(number);
      throw error;
    }
    return done;
  }

  /** Draws the picture in full: `milliseconds`, or `null` if there is nothing to draw yet. */
  draw() {
    return this.#draw(1);
  }

  get playing() {
    return this.#playing;
  }

  /** Plays the sequence: frames are dropped and levels are coarser, so that it keeps its time. It begins again at the end. */
  play() {
    this.#playing = true;
    this.#worker.postMessage({ type: "play" });
  }

  /** Stays at the frame that is shown, at its finest level. */
  pause() {
    this.#playing = false;
    this.#worker.postMessage({ type: "pause" });
  }

  /** Goes to the frame at a time in seconds. */
  seek(time) {
    this.#worker.postMessage({ type: "seek", time });
  }

  /** Pauses so many frames further on, or back. */
  step(by) {
    this.#playing = false;
    this.#worker.postMessage({ type: "step", by });
  }

  /** Plays so many times as fast as it was recorded, from ⅛ to 8. */
  set speed(speed) {
    this.#worker.postMessage({ type: "speed", speed });
  }

  /** The camera as at first. */
  reset() {
    this.camera = START;
  }

  /** Ends the worker. */
  close() {
    this.#cancel?.();
    this.#defects.close();
    this.#worker.terminate();
  }

  /** Ends the worker after a defect. */
  #end(message) {
    this.#worker.terminate();
    this.#ready = Promise.reject(Object.assign(new Error("the library has failed: load it again"), { kind: "internal" }));
    this.#ready.catch(() => {});
    // Pictures that were asked for do not come any more.
    this.#waiting.get("picture")?.resolve(null);
    this.#again?.resolve(null);
    this.#fail("internal", message);
  }

  async #load(wasm, threads, heads) {
    const get = async (address) => {
      const response = await fetch(address);
      if (!response.ok) throw new Error(`${address}: ${response.status} ${response.statusText}`);
      return response;
    };
    const compile = (address) => {
      return get(address).then((response) => response.arrayBuffer()).then((bytes) => WebAssembly.compile(bytes));
    };
    const learned = heads && get(heads).then((response) => response.arrayBuffer());
    const start = async (address) => {
      const [module, bytes] = await Promise.all([compile(address), learned]);
      const ready = new Promise((resolve, reject) => this.#waiting.set("ready", { resolve, reject }));
      const model = bytes && new Uint8Array(bytes);
      this.#worker.postMessage({ type: "load", module, channel: this.#defects.name, heads: model });
      return ready;
    };
    // Without threads if they, or their memory, cannot be had.
    return threads ? start(threads).catch(() => start(wasm)) : start(wasm);
  }

  async #feed(number, stream) {
    const reader = stream.getReader();
    this.#cancel = () => reader.cancel().catch(() => {});
    for (;;) {
      const { done, value } = await reader.read();
      if (number !== this.#stream) throw new DOMException("another stream was opened", "AbortError");
      if (done) break;
      this.#worker.postMessage({ type: "bytes", number, bytes: value });
    }
    this.#worker.postMessage({ type: "end", number });
  }

  #hear(message) {
    switch (message.type) {
      case "ready":
        this.#waiting.get("ready")?.resolve(message.version);
        break;
      case "level":
        if (message.stream !== this.#stream) break;
        this.#tell("level", message);
        this.draw();
        break;
      case "broken":
        this.#waiting.get(message.stream)?.resolve(null);
        break;
      case "done":
        this.#waiting.get(message.stream)?.resolve(message.level);
        this.#waiting.delete(message.stream);
        break;
      case "error":
        if (message.stream === "ready") {
          this.#waiting.get("ready")?.reject(Object.assign(new Error(message.message), { kind: message.kind }));
          break;
        }
        this.#fail(message.kind, message.message, message.stream);
        break;
      case "sequence":
      case "skipped":
        if (message.stream === this.#stream) this.#tell(message.type, message);
        break;
      case "picture":
        if (message.frame && message.stream !== this.#stream) break;
        this.#shown = this.#shown.then(() => this.#show(message));
        break;
    }
  }

  #fail(kind, text, stream = this.#stream) {
    const error = Object.assign(new Error(text), { kind });
    this.#waiting.get(stream)?.reject(error);
    this.#waiting.delete(stream);
    this.#playing = false;
    this.#tell("failure", { kind, message: text });
  }

  #tell(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }

  /** Asks for a picture of `scale` times the canvas' pixels; if one is being drawn, after it, and only the last. */
  #draw(scale) {
    if (this.#playing) {
      this.#worker.postMessage({ type: "view", view: this.#view() });
      return Promise.resolve(null);
    }
    if (this.#drawing) {
      this.#again?.resolve(null);
      return new Promise((resolve) => (this.#again = { scale, resolve }));
    }
    this.#drawing = true;
    return new Promise((resolve) => {
      this.#waiting.set("picture", { resolve });
      this.#worker.postMessage({ type: "draw", view: this.#view(), ticket: scale });
    });
  }

  #view() {
    const { width, height } = this.#canvas;
    return { ...this.#camera, width, height, background: this.#background };
  }

  async #show({ pixels, width, height, milliseconds, ticket: scale, frame }) {
    if (pixels) {
      const image = await createImageBitmap(new ImageData(pixels, width, height));
      this.#context.clearRect(0, 0, this.#canvas.width, this.#canvas.height);
      this.#context.drawImage(image, 0, 0, this.#canvas.width, this.#canvas.height);
    }
    if (frame) {
      this.#tell("frame", frame);
      return this.#tell("picture", { milliseconds, scale: frame.scale });
    }
    if (pixels) {
      // While the camera moves, as many pixels as a frame has time for.
      const wanted = scale * Math.sqrt(FASTEST / Math.max(1, milliseconds));
      this.#scale = Math.min(1, Math.max(LEAST_SCALE, wanted));
      this.#tell("picture", { milliseconds, scale });
    }
    this.#drawing = false;
    this.#waiting.get("picture")?.resolve(milliseconds ?? null);
    const again = this.#again;
    this.#again = null;
    if (again) this.#draw(again.scale).then(again.resolve);
  }

  #move(change) {
    const camera = this.#camera;
    change(camera);
    camera.elevation = Math.min(89, Math.max(-89, camera.elevation));
    camera.distance = Math.min(50, Math.max(0.2, camera.distance));
    this.#draw(this.#scale);
    clearTimeout(this.#rest);
    this.#rest = setTimeout(() => this.draw(), 150);
  }

  #turn(dx, dy) {
    const degrees = 180 / this.#canvas.clientHeight;
    this.#move((camera) => {
      camera.azimuth -= dx * degrees;
      camera.elevation += dy * degrees;
    });
  }

  #listen() {
    const canvas = this.#canvas;
    const touches = this.#touches;
    canvas.style.touchAction = "none";
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      touches.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = touches.get(event.pointerId);
      if (!before) return;
      const now = [event.clientX, event.clientY];
      const spread = () => {
        const [[x0, y0], [x1, y1]] = [...touches.values()];
        return Math.hypot(x1 - x0, y1 - y0);
      };
      if (touches.size === 2) {
        const from = spread();
        touches.set(event.pointerId, now);
        const to = Math.max(1, spread());
        this.#move((camera) => (camera.distance *= from / to));
      } else {
        touches.set(event.pointerId, now);
        this.#turn(now[0] - before[0], now[1] - before[1]);
      }
    });
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => touches.delete(event.pointerId));
    }
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.#move((camera) => (camera.distance *= Math.exp(event.deltaY / 1000)));
    }, { passive: false });
    canvas.addEventListener("dblclick", () => this.reset());
  }
}

/** The bytes of a source. */
async function readable(source) {
  if (source instanceof ReadableStream) return source;
  if (source instanceof Blob) return source.stream();
  if (source instanceof ArrayBuffer || ArrayBuffer.isView(source)) return new Blob([source]).stream();
  const response = source instanceof Response ? source : await fetch(source);
  if (!response.ok) throw new Error(`${response.url}: ${response.status} ${response.statusText}`);
  return response.body;
}
