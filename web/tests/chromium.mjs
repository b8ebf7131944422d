// Drives a headless Chromium over a pipe, by its DevTools protocol.

import { spawn, spawnSync } from "node:child_process";
import { mkdtempSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { setTimeout } from "node:timers/promises";

import { Waiting } from "./waiting.mjs";

const NAMES = [process.env.CHROMIUM, "chromium", "chromium-browser", "google-chrome"].filter(Boolean);

/** The name of one that is installed, or `undefined`. */
export const installed = NAMES.find((name) => spawnSync(name, ["--version"]).status === 0);

export class Browser {
  #process;
  #folder = mkdtempSync(join(tmpdir(), "b2p-chromium-"));
  #calls = new Map();
  #next = 1;
  #rest = "";

  constructor() {
    const options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe", "--mute-audio"];
    this.#process = spawn(installed, [...options, `--user-data-dir=${this.#folder}`, "about:blank"], {
      stdio: ["ignore", "ignore", "ignore", "pipe", "pipe"],
    });
    this.#process.stdio[4].setEncoding("utf8").on("data", (text) => this.#read(text));
  }

  #read(text) {
    const messages = (this.#rest + text).split("\0");
    this.#rest = messages.pop();
    for (const { id, result, error } of messages.map((message) => JSON.parse(message))) {
      const call = this.#calls.get(id);
      this.#calls.delete(id);
      if (error) call?.reject(new Error(error.message));
      else call?.resolve(result);
    }
  }

  call(method, params = {}, sessionId = undefined) {
    const id = this.#next++;
    const answer = new Promise((resolve, reject) => this.#calls.set(id, { resolve, reject }));
    this.#process.stdio[3].write(`${JSON.stringify({ id, method, params, sessionId })}\0`);
    return answer;
  }

  /** A page of `width × height` pixels at an address. */
  async page(url, width, height) {
    const { targetId } = await this.call("Target.createTarget", { url: "about:blank" });
    const { sessionId } = await this.call("Target.attachToTarget", { targetId, flatten: true });
    const page = new Page(this, sessionId);
    const size = { width, height, deviceScaleFactor: 1, mobile: false };
    await page.call("Emulation.setDeviceMetricsOverride", size);
    await page.call("Page.navigate", { url });
    return page;
  }

  async close() {
    const ended = new Promise((resolve) => this.#process.once("exit", resolve));
    this.#process.kill();
    await ended;
    // Its other processes write a little longer, and `rmSync` does not look again for files that are new. What stays is
    // in the folder for temporary files, and no fault of the page.
    for (let tries = 0; tries < 50; tries++) {
      try {
        return rmSync(this.#folder, { recursive: true, force: true });
      } catch {
        await setTimeout(100);
      }
    }
  }
}

class Page extends Waiting {
  constructor(browser, session) {
    super();
    this.browser = browser;
    this.session = session;
  }

  call(method, params) {
    return this.browser.call(method, params, this.session);
  }

  /** The value of an expression, awaited. */
  async evaluate(expression) {
    const options = { expression, awaitPromise: true, returnByValue: true };
    const { result, exceptionDetails } = await this.call("Runtime.evaluate", options);
    if (exceptionDetails) throw new Error(exceptionDetails.exception?.description ?? exceptionDetails.text);
    return result.value;
  }

  async drag([x0, y0], [x1, y1]) {
    const mouse = (type, x, y) =>
      this.call("Input.dispatchMouseEvent", { type, x, y, button: "left", buttons: 1, clickCount: 1 });
    await mouse("mousePressed", x0, y0);
    await mouse("mouseMoved", (x0 + x1) / 2, (y0 + y1) / 2);
    await mouse("mouseMoved", x1, y1);
    await mouse("mouseReleased", x1, y1);
  }
}
