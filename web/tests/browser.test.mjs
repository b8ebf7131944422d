// The page in a headless browser. Skipped where there is none.

import assert from "node:assert/strict";
import { existsSync, readFileSync } from "node:fs";
import test from "node:test";

import { B2p } from "../src/index.js";
import { Browser, skip } from "./browser.mjs";
import { SHOWN, digest } from "./page.mjs";
import { broken, paused, serve, whole } from "./server.mjs";

const read = (path) => readFileSync(new URL(`../../${path}`, import.meta.url));
const scene = read("models/scene.b2p");
const blocks = read("tests/data/conformance/scenes/ball.b2p");
const SIZE = [640, 480];

const damaged = Buffer.from(scene);
damaged[scene.length - 100] ^= 1;
const waiting = paused(scene, 30_000);
const streams = {
  "whole.b2p": whole(scene),
  "cut.b2p": broken(scene, 20_000),
  "damaged.b2p": whole(damaged),
  "late.b2p": waiting.answer,
  "blocks.b2p": whole(blocks),
  "cut-blocks.b2p": whole(blocks.subarray(0, blocks.length - 1)),
};
const server = skip ? null : await serve(streams);
const browser = skip ? null : new Browser();
test.after(async () => {
  await browser?.close();
  server?.close();
});

const show = (name) => browser.page(`${server.address}/?src=streams/${name}`, ...SIZE);
/** The pixels of the canvas. */
const PIXELS = `(() => {
  const canvas = document.querySelector("canvas");
  return [...canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data];
})()`;
const STATE = "document.getElementById('state').textContent";

test("a stream is shown as the library draws it", { skip }, async () => {
  const page = await show("whole.b2p");
  await page.until("document.body.dataset.done === '9'");
  const library = await B2p.load(read("web/b2p.wasm"));
  const gaussians = library.decode(scene);
  const expected = [...gaussians.render({ width: SIZE[0], height: SIZE[1] })];
  await page.until("!document.getElementById('time').textContent.startsWith('drawn in 0')");
  let shown;
  for (let i = 0; i < 100; i++) {
    shown = await page.evaluate(PIXELS);
    if (Buffer.from(shown).equals(Buffer.from(expected))) break;
    await new Promise((resolve) => setTimeout(resolve, 100));
  }
  assert.ok(Buffer.from(shown).equals(Buffer.from(expected)), "the canvas has the library's pixels");
  const count = gaussians.arrays().count.toLocaleString("en").replaceAll(",", " ");
  assert.ok((await page.evaluate(STATE)).startsWith(`Level 9: ${count} Gaussians`));
});

test("a scene of blocks is shown as the library draws it, and one that is cut is reported", { skip }, async () => {
  const library = await B2p.load(read("web/b2p.wasm"));
  const expected = library.decode(blocks).render({ width: SIZE[0], height: SIZE[1] });
  const page = await show("blocks.b2p");
  await page.until(`${SHOWN}.then((sum) => sum === "${digest(expected)}")`);
  const cut = await show("cut-blocks.b2p");
  await cut.until("document.body.dataset.state === 'error'");
});

test("a picture is there before the download ends", { skip }, async () => {
  const page = await show("late.b2p");
  await page.until(`${STATE}.startsWith("Level 8")`);
  await page.until("Number(document.body.dataset.pictures) > 0");
  assert.equal(await page.evaluate("document.body.dataset.done ?? null"), null);
  waiting.go();
  await page.until("document.body.dataset.done === '9'");
});

test("dragging turns the scene, and a double click turns it back", { skip }, async () => {
  const page = await show("whole.b2p");
  await page.until("document.body.dataset.done === '9'");
  await page.until("Number(document.body.dataset.pictures) > 0");
  const settle = () => new Promise((resolve) => setTimeout(resolve, 1500));
  await settle();
  const before = await page.evaluate(PIXELS);
  await page.drag([320, 240], [420, 260]);
  await settle();
  const turned = await page.evaluate(PIXELS);
  assert.notDeepEqual(turned, before);
  await page.evaluate("document.querySelector('canvas').dispatchEvent(new MouseEvent('dblclick')), 0");
  await settle();
  assert.deepEqual(await page.evaluate(PIXELS), before);
});

test("a cut download and a damaged file are reported, and the levels that came stay", { skip }, async () => {
  for (const name of ["cut.b2p", "damaged.b2p"]) {
    const page = await show(name);
    await page.until("document.body.dataset.state === 'error'");
    await page.until("Number(document.body.dataset.pictures) > 0");
    assert.equal(await page.evaluate("document.body.dataset.state"), "error", `${name}: the fault stays`);
    const pixels = await page.evaluate(PIXELS);
    assert.ok(pixels.some((x, i) => i % 4 !== 3 && x !== 255), `${name}: the picture stays`);
  }
});

const unthreaded = skip || (existsSync(new URL("../b2p-threads.wasm", import.meta.url)) ? false : "b2p-threads.wasm is not there");

test("a page that is isolated from other origins has threads, and the same pixels", { skip: unthreaded }, async () => {
  const isolated = await serve(streams, { isolated: true });
  try {
    const page = await browser.page(`${isolated.address}/?src=streams/whole.b2p`, ...SIZE);
    await page.until("document.body.dataset.done === '9'");
    assert.equal(await page.evaluate("crossOriginIsolated"), true);
    const loaded = "performance.getEntriesByType('resource').map(({ name }) => name.split('/').at(-1))";
    const names = await page.evaluate(loaded);
    assert.ok(names.includes("b2p-threads.wasm") && !names.includes("b2p.wasm"), names.join(" "));
    const library = await B2p.load(read("web/b2p.wasm"));
    const expected = library.decode(scene).render({ width: SIZE[0], height: SIZE[1] });
    await page.until(`${SHOWN}.then((sum) => sum === "${digest(expected)}")`);
  } finally {
    isolated.close();
  }
});

test("a page whose threads cannot be had does without them", { skip }, async () => {
  for (const missing of ["/src/thread.js", "/b2p-threads.wasm"]) {
    const isolated = await serve(streams, { isolated: true, missing: [missing] });
    try {
      const page = await browser.page(`${isolated.address}/?src=streams/whole.b2p`, ...SIZE);
      await page.until("document.body.dataset.done === '9'");
      assert.equal(await page.evaluate("crossOriginIsolated"), true);
    } finally {
      isolated.close();
    }
  }
});

test("a thread that fails ends the library, and who waits for a file hears of it", { skip }, async () => {
  const page = await browser.page(server.address, ...SIZE);
  await page.until("document.body?.dataset.state === 'ready'");
  const heard = await page.evaluate(`(async () => {
    const { Viewer } = await import("/src/viewer.js");
    const names = [];
    const Channel = BroadcastChannel;
    globalThis.BroadcastChannel = class extends Channel {
      constructor(name) {
        super(name);
        names.push(name);
      }
    };
    const viewer = new Viewer(document.createElement("canvas"));
    // A file that does not end.
    viewer.open(new ReadableStream({})).catch(() => {});
    await new Promise((resolve) => setTimeout(resolve, 1000));
    new Channel(names[0]).postMessage({ message: "lost" });
    const failure = await new Promise((resolve) => viewer.addEventListener("failure", ({ detail }) => resolve(detail)));
    const again = await viewer.open(new Uint8Array(9)).catch(({ kind }) => kind);
    return [failure.kind, failure.message, again].join();
  })()`);
  assert.equal(heard, "internal,lost,internal");
});

test("the page needs no cross-origin isolation", { skip }, async () => {
  const page = await show("whole.b2p");
  await page.until("document.body.dataset.done === '9'");
  assert.equal(await page.evaluate("crossOriginIsolated"), false);
});
