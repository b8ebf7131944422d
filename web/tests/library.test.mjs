// The WebAssembly module from JavaScript, in Node.

import assert from "node:assert/strict";
import { createHash } from "node:crypto";
import { existsSync, readFileSync } from "node:fs";
import test from "node:test";

import { B2p, B2pError } from "../src/index.js";
import { Threads, sharedMemory } from "../src/threads.js";

const root = new URL("../..", import.meta.url);
const read = (path) => readFileSync(new URL(path, root));
const library = await B2p.load(read("web/b2p.wasm"));
// With more threads than there may be cores.
const threads = new URL("web/b2p-threads.wasm", root);
const threaded = existsSync(threads) ? await B2p.load(readFileSync(threads), { threads: 3, channel: "tests" }) : null;
const scene = read("models/scene.b2p");
test.after(() => threaded?.close());

/** The digests of colours and of Gaussians, as the conformance suite takes them; its first is of Morton keys. */
function digests(decoding) {
  const hash = (...arrays) => {
    const sum = createHash("sha256");
    for (const array of arrays) sum.update(new Uint8Array(array.buffer, array.byteOffset, array.byteLength));
    return sum.digest("hex");
  };
  const points = decoding.points();
  const gaussians = decoding.gaussians();
  const { position, scale, rotation, opacity, colour } = gaussians.arrays();
  const found = [hash(points.colours), hash(position, scale, rotation, opacity, colour)];
  gaussians.free();
  return found;
}

const suites = [library, threaded].filter(Boolean).flatMap((library) => [[library, "version-3", 20], [library, "scenes", 7]]);
for (const [library, suite, least] of suites) test(`every stream of the suite ${suite} decodes to its digests`, () => {
  const folder = `tests/data/conformance/${suite}`;
  const lines = read(`${folder}/suite.txt`).toString().trim().split("\n");
  let levels = 0;
  for (const line of lines) {
    const [name, ...expected] = line.split(" ");
    // A block of a scene.
    if (name.includes("/")) continue;
    if (!expected.every((level) => /^\d+=/.test(level))) continue;
    const bytes = read(`${folder}/${name}.b2p`);
    for (const entry of expected) {
      const [level, sums] = entry.split("=");
      const decoding = library.decoding({ level: Number(level) });
      decoding.push(bytes);
      decoding.finish();
      assert.deepEqual(digests(decoding), sums.split(",").slice(1), `${name}, level ${level}`);
      decoding.free();
      levels += 1;
    }
  }
  assert.ok(levels >= least, `${levels} levels`);
});

test("levels arrive one by one, whatever the pieces", () => {
  const decoding = library.decoding();
  const levels = [];
  for (let at = 0; at < scene.length; at += 1000) {
    decoding.push(scene.subarray(at, at + 1000));
    for (let level = decoding.advance(); level !== null; level = decoding.advance()) levels.push(level);
  }
  decoding.finish();
  assert.deepEqual(levels, [7, 8, 9]);
  decoding.free();
});

test("learned heads draw a stream with a model file", () => {
  const model = library.headsModel(read("models/heads.safetensors"));
  const [plain, learned] = [null, "quick"].map((heads) => {
    const gaussians = library.decode(scene, { model: heads && model, heads, level: 7 });
    const { count, scale } = gaussians.arrays();
    const sum = scale.reduce((sum, x) => sum + x, 0);
    gaussians.free();
    return { count, sum };
  });
  assert.ok(plain.count > 0 && learned.count > 0 && plain.sum !== learned.sum);
  model.free();
});

test("what is no stream, cut or damaged is refused by kind", () => {
  const kind = (bytes) => {
    try {
      library.decode(bytes).free();
      return "ok";
    } catch (error) {
      assert.ok(error instanceof B2pError, String(error));
      return error.kind;
    }
  };
  const damaged = Buffer.from(scene);
  damaged[scene.length >> 1] ^= 1;
  assert.equal(kind(scene), "ok");
  assert.equal(kind(Buffer.from("ply\nformat")), "malformed");
  assert.equal(kind(scene.subarray(0, 20_000)), "truncated");
  assert.equal(kind(damaged), "checksum");
});

test("a picture has the size that was asked for, and shows something on the background", () => {
  const gaussians = library.decode(scene, { level: 7 });
  const pixels = gaussians.render({ width: 64, height: 48, background: [0, 0, 1] });
  assert.equal(pixels.length, 4 * 64 * 48);
  assert.deepEqual([...pixels.subarray(0, 4)], [0, 0, 255, 255]);
  assert.notDeepEqual([...pixels.subarray(4 * (24 * 64 + 32), 4 * (24 * 64 + 33))], [0, 0, 255, 255]);
  assert.throws(() => gaussians.render({ width: 0, height: 48 }), B2pError);
  gaussians.free();
});

test("memory is given back", () => {
  const once = () => library.decode(scene, { level: 8 }).free();
  once();
  const before = library._view().byteLength;
  for (let i = 0; i < 10; i++) once();
  assert.equal(library._view().byteLength, before);
});

const unthreaded = threaded ? false : "b2p-threads.wasm is not there";

test("threads draw what one thread draws, with every kind of heads", { skip: unthreaded }, () => {
  const draw = (library, heads) => {
    const model = library.headsModel(read("models/heads.safetensors"));
    const gaussians = library.decode(scene, { model, heads });
    const pixels = gaussians.render({ width: 320, height: 240 });
    gaussians.free();
    model.free();
    return Buffer.from(pixels);
  };
  for (const heads of ["surfels", "quick", "best"]) assert.ok(draw(threaded, heads).equals(draw(library, heads)), heads);
});

test("a thread that fails reports its error, and no more threads start than there are workers", { skip: unthreaded }, async () => {
  const module = await WebAssembly.compile(readFileSync(threads));
  const memory = sharedMemory();
  const lost = await Threads.start(1, { module, memory, report: () => {}, channel: "lost" });
  const channel = new BroadcastChannel("lost");
  const heard = new Promise((resolve) => (channel.onmessage = ({ data }) => resolve(data.message)));
  // There is no such thread to start.
  assert.ok(lost.spawn(-1) > 0);
  assert.ok(lost.spawn(-1) < 0);
  assert.match(await heard, /memory access out of bounds|unreachable/);
  channel.close();
  lost.end();
});
