// What tests of the page share: a browser, a server, and the pictures that the program draws.

import { createHash } from "node:crypto";
import { readFileSync } from "node:fs";

import { Browser, skip } from "./browser.mjs";
import { serve, whole } from "./server.mjs";

export const SIZE = [320, 240];
export { skip };

/** A file of the tests. */
export const data = (name) => readFileSync(new URL(`./data/${name}`, import.meta.url));

export const digest = (pixels) => createHash("sha256").update(pixels).digest("hex");

/**
 * Digests of pictures as the program draws them natively, by the name of a file, and of a sequence also the number of a
 * frame (`capi/tests/page.rs` holds them to the library).
 */
export const pictures = new Map(
  data("pictures.txt").toString().trim().split("\n").map((line) => {
    const [name, sum] = line.split(" ");
    return [name, sum];
  }),
);

/** The digest of what the canvas shows. */
export const SHOWN = `(async () => {
  const canvas = document.querySelector("canvas");
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  const sum = new Uint8Array(await crypto.subtle.digest("SHA-256", data));
  return [...sum].map((byte) => byte.toString(16).padStart(2, "0")).join("");
})()`;

/** Whether anything but the background is shown. */
export const DRAWN = `(() => {
  const canvas = document.querySelector("canvas");
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  return data.some((x, i) => i % 4 !== 3 && x !== 255);
})()`;

export const STATE = "document.getElementById('state').textContent";

/** A page for files by their names; `close` ends it. */
export async function open(files) {
  const streams = Object.fromEntries(Object.entries(files).map(([name, bytes]) => [name, whole(bytes)]));
  const server = await serve(streams);
  const browser = new Browser();
  return {
    show: (name) => browser.page(`${server.address}/?src=streams/${name}`, ...SIZE),
    empty: () => browser.page(server.address, ...SIZE),
    async close() {
      await browser.close();
      server.close();
    },
  };
}
