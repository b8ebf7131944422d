// Files of Gaussians, in Node and in the page.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import test from "node:test";

import { B2p, B2pError } from "../src/index.js";
import { DRAWN, SHOWN, SIZE, STATE, data, digest, open, pictures, skip } from "./page.mjs";

const library = await B2p.load(readFileSync(new URL("../b2p.wasm", import.meta.url)));
const NAMES = ["ball.ply", "ball.compressed.ply", "ball.spz", "ball.sog", "ball.splat", "ball.glb"];

/** Each file with a fault that its reader must find. */
const cut = (name) => data(name).subarray(0, Math.floor(data(name).length / 2));
const damaged = { ply: cut("ball.ply"), compressed: cut("ball.compressed.ply"), spz: cut("ball.spz"), sog: cut("ball.sog") };
const points = Buffer.from("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n");

const files = {
  ...Object.fromEntries(NAMES.map((name) => [name, data(name)])),
  ...damaged,
  points,
  "demo.png": readFileSync(new URL("../../docs/demo.png", import.meta.url)),
};
const page = skip ? null : await open(files);
test.after(() => page?.close());

test("files of Gaussians are drawn as the program draws them", () => {
  for (const name of NAMES) {
    const bytes = data(name);
    assert.equal(library.content(bytes.subarray(0, 4096)), "splats", name);
    const gaussians = library.splats([bytes.subarray(0, 100), bytes.subarray(100)]);
    const pixels = gaussians.render({ width: SIZE[0], height: SIZE[1] });
    gaussians.free();
    assert.equal(digest(pixels), pictures.get(name), name);
  }
});

test("what holds no Gaussians, or is damaged, is refused by kind", () => {
  const refused = (bytes) => {
    try {
      library.splats(bytes).free();
    } catch (error) {
      assert.ok(error instanceof B2pError, String(error));
      return [error.kind, error.message];
    }
    return ["ok", ""];
  };
  for (const [name, bytes] of Object.entries(damaged)) {
    assert.match(refused(bytes)[0], /^(truncated|malformed|unsupported)$/, name);
  }
  assert.deepEqual(refused(points), [
    "unsupported",
    "this is a PLY file, no stream and no Gaussians: `b2p encode` makes a stream of a point cloud",
  ]);
  assert.throws(() => library.content(files["demo.png"].subarray(0, 4096)), /this is a PNG picture/);
  assert.throws(() => library.content(Buffer.from("LASF")), /this is a LAS or LAZ file/);
  assert.throws(() => library.content(Buffer.alloc(0)), /this is an empty file/);
});

test("the page draws files of Gaussians", { skip }, async () => {
  for (const name of NAMES) {
    const shown = await page.show(name);
    await shown.until("document.body.dataset.done === 'Gaussians'");
    await shown.until(`${SHOWN}.then((sum) => sum === "${pictures.get(name)}")`);
    assert.match(await shown.evaluate(STATE), /^[\d ]+ Gaussians, read in \d+ ms$/, name);
  }
});

test("a file that is dropped is drawn, and one that is none of Gaussians is named", { skip }, async () => {
  const shown = await page.empty();
  await shown.until("document.body.dataset.state === 'ready'");
  const drop = (name) => shown.evaluate(`(async () => {
    const response = await fetch("streams/${name}");
    const transfer = new DataTransfer();
    transfer.items.add(new File([await response.arrayBuffer()], "${name}"));
    dispatchEvent(new DragEvent("drop", { dataTransfer: transfer, cancelable: true }));
  })()`);
  await drop("ball.spz");
  await shown.until(`${SHOWN}.then((sum) => sum === "${pictures.get("ball.spz")}")`);
  await drop("demo.png");
  await shown.until("document.body.dataset.state === 'error'");
  assert.equal(await shown.evaluate(STATE), "this is a PNG picture, no stream and no Gaussians");
  assert.ok(await shown.evaluate(DRAWN), "the picture before stays");
  await drop("ball.ply");
  await shown.until(`${SHOWN}.then((sum) => sum === "${pictures.get("ball.ply")}")`);
});

test("damaged files are reported, and the page goes on", { skip }, async () => {
  for (const name of [...Object.keys(damaged), "points"]) {
    const shown = await page.show(name);
    await shown.until("document.body.dataset.state === 'error'");
    assert.notEqual(await shown.evaluate(STATE), "", name);
    assert.equal(await shown.evaluate("document.body.dataset.done ?? null"), null, name);
  }
});
