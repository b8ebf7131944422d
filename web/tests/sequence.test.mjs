// Sequences, in Node and in the page.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import test from "node:test";

import { B2p } from "../src/index.js";
import { DRAWN, SHOWN, SIZE, STATE, data, digest, open, pictures, skip } from "./page.mjs";

const library = await B2p.load(readFileSync(new URL("../b2p.wasm", import.meta.url)));
// 24 frames in groups of 8, twelve a second.
const wave = data("wave.b2p");
const [FRAMES, RATE] = [24, 12];
// Frame 8 begins the group in the middle of the file.
const damaged = Buffer.from(wave);
damaged[wave.length >> 1] ^= 1;
const cut = wave.subarray(0, 40);

const heads = readFileSync(new URL("../../models/heads.safetensors", import.meta.url));
const LEARNED = ["quick", "best"];

const files = { "wave.b2p": wave, "damaged.b2p": damaged, "cut.b2p": cut, "heads.safetensors": heads };
const page = skip ? null : await open(files);
test.after(() => page?.close());

/** All that a player makes until it stands, with a digest in place of Gaussians. */
function made(player) {
  const frames = [];
  for (let frame = player.next(); frame !== null; frame = player.next()) {
    frames.push({ ...frame, gaussians: null, digest: frame.gaussians && digestOf(frame.gaussians) });
  }
  return frames;
}

function digestOf(gaussians) {
  const pixels = gaussians.render({ width: SIZE[0], height: SIZE[1] });
  gaussians.free();
  return digest(pixels);
}

/** The digest of a frame at its finest level. */
function picture(number, heads = "surfels", model = null) {
  const player = library.player(wave, { heads, model });
  player.seek((number + 0.5) / RATE);
  const last = made(player).at(-1);
  player.free();
  assert.deepEqual([last.number, last.heads], [number, heads]);
  return last.digest;
}

test("a frame that a player stands at is that of the program", () => {
  for (const number of [0, 6, 13, 23]) assert.equal(picture(number), pictures.get(`wave.b2p#${number}`), `frame ${number}`);
});

test("learned heads draw a sequence as the program does", () => {
  const model = library.headsModel(heads);
  for (const name of LEARNED) {
    for (const number of [0, 13]) {
      assert.equal(picture(number, name, model), pictures.get(`wave.b2p#${number}:${name}`), `${name}, frame ${number}`);
    }
  }
  // Without a choice, the quick ones where it stands: the best take too long to be played.
  const player = library.player(wave, { model });
  assert.equal(made(player).at(-1).heads, "quick");
  player.free();
  model.free();
  // A frame that cannot be drawn is no defect of the library, which goes on.
  const without = library.player(wave, { heads: "best" });
  assert.equal(without.next().error.kind, "unsupported");
  without.free();
});

test("a player drops frames and goes to coarser levels as its user is slow", () => {
  const player = library.player([wave.subarray(0, 99), wave.subarray(99)]);
  const info = player.info();
  assert.deepEqual(info, { seconds: FRAMES / RATE, frames: FRAMES, base: 7, top: 9 });
  player.play();
  const levels = [0, 1, 2].map(() => {
    const frame = player.next();
    frame.gaussians?.free();
    assert.ok(Math.abs(frame.budget - 1 / RATE) < 1e-6);
    player.took(5);
    return frame.level;
  });
  assert.deepEqual(levels, [9, 7, 7]);
  player.pause();
  assert.equal(made(player).at(-1).level, 9);
  player.free();
});

test("damage of a group leaves the others, and what is cut is refused by kind", () => {
  const player = library.player(damaged);
  player.seek(9 / RATE);
  assert.deepEqual(made(player).map(({ number, error }) => [number, error?.kind]), [[8, "malformed"]]);
  player.seek(17 / RATE);
  assert.equal(made(player).at(-1).error, null);
  player.free();
  assert.throws(() => library.player(cut), { kind: "truncated" });
  assert.throws(() => library.player(wave, { level: 3 }), { kind: "usage" });
});

const frame = (shown) => shown.evaluate("Number(document.body.dataset.frame)");
const click = (shown) => shown.evaluate("document.getElementById('toggle').click()");
const input = (shown, id, value, event) => shown.evaluate(`(() => {
  const element = document.getElementById("${id}");
  element.value = ${value};
  element.dispatchEvent(new Event("${event}"));
})()`);
const sleep = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));
const shows = (shown, sum) => shown.until(`${SHOWN}.then((sum) => sum === "${sum}")`);

test("a sequence plays, a pause holds, and seeking is exact", { skip }, async () => {
  const shown = await page.show("wave.b2p");
  await shown.until("document.body.dataset.frame !== undefined");
  const first = await frame(shown);
  await shown.until(`Number(document.body.dataset.frame) !== ${first}`);
  await click(shown);
  await sleep(500);
  const held = await frame(shown);
  await shows(shown, picture(held));
  await sleep(500);
  assert.equal(await frame(shown), held);
  await shows(shown, picture(held));
  for (const number of [13, 6, 23, 0]) {
    await input(shown, "when", (number + 0.5) / RATE, "input");
    await shows(shown, pictures.get(`wave.b2p#${number}`));
    assert.equal(await frame(shown), number);
  }
  await shown.evaluate("document.body.dispatchEvent(new KeyboardEvent('keydown', { key: 'ArrowRight', bubbles: true }))");
  await shows(shown, picture(1));
  await shown.evaluate("document.body.dispatchEvent(new KeyboardEvent('keydown', { key: ' ', bubbles: true }))");
  await shown.until("Number(document.body.dataset.frame) > 1");
});

test("learned heads are chosen while a sequence plays, and keep its clock", { skip }, async () => {
  const shown = await page.show("wave.b2p&heads=streams/heads.safetensors");
  await shown.until("document.body.dataset.frame !== undefined");
  for (const name of LEARNED) {
    await input(shown, "heads", `"${name}"`, "change");
    // It is opened again, and plays: frames are drawn with these heads.
    await shown.until(`${STATE}.includes(", ${name}, ")`);
    const first = await frame(shown);
    await shown.until(`Number(document.body.dataset.frame) !== ${first}`);
    assert.ok(await shown.evaluate(DRAWN), name);
    assert.ok((await shown.evaluate(STATE)).includes(`, ${name}, `));
    await click(shown);
    await input(shown, "when", 13.5 / RATE, "input");
    await shows(shown, pictures.get(`wave.b2p#13:${name}`));
  }
});

test("the clock is kept at any speed", { skip }, async () => {
  const shown = await page.show("wave.b2p");
  await shown.until("document.body.dataset.frame !== undefined");
  /** Frames that go by in a second, modulo a lap. */
  const passed = async () => {
    const before = await frame(shown);
    await sleep(1000);
    return ((await frame(shown)) - before + FRAMES) % FRAMES;
  };
  const usual = await passed();
  assert.ok(Math.abs(usual - RATE) <= 6, `${usual} frames in a second`);
  await input(shown, "speed", 0.125, "change");
  await sleep(500);
  const slow = await passed();
  assert.ok(slow <= 4, `${slow} frames in a second at an eighth of the speed`);
});

test("dragging turns a sequence that plays and one that stands", { skip }, async () => {
  const shown = await page.show("wave.b2p");
  await shown.until("document.body.dataset.frame !== undefined");
  await shown.drag([160, 120], [200, 130]);
  await click(shown);
  await input(shown, "when", 13.5 / RATE, "input");
  await shown.until("document.body.dataset.frame === '13'");
  await sleep(500);
  const turned = await shown.evaluate(SHOWN);
  assert.notEqual(turned, pictures.get("wave.b2p#13"));
  await shown.evaluate("document.querySelector('canvas').dispatchEvent(new MouseEvent('dblclick')), 0");
  await shows(shown, pictures.get("wave.b2p#13"));
});

test("a damaged group is reported and skipped, and a sequence that is cut is refused", { skip }, async () => {
  const shown = await page.show("damaged.b2p");
  await shown.until(`${STATE}.startsWith("Frame 8 is skipped")`);
  await shown.until("Number(document.body.dataset.frame) >= 16");
  const refused = await page.show("cut.b2p");
  await refused.until("document.body.dataset.state === 'error'");
});
