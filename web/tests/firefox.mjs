// Drives a headless Firefox over a socket, by WebDriver BiDi. Node 20 has sockets with `--experimental-websocket`.

import { spawn, spawnSync } from "node:child_process";
import { mkdtempSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { createInterface } from "node:readline";

import { Waiting } from "./waiting.mjs";

const NAMES = [process.env.FIREFOX, "firefox-esr", "firefox"].filter(Boolean);

/** The name of one that is installed, or `undefined`. */
export const installed = NAMES.find((name) => spawnSync(name, ["--version"]).status === 0);

export class Browser {
  #process;
  #folder = mkdtempSync(join(tmpdir(), "b2p-firefox-"));
  #calls = new Map();
  #next = 1;
  #socket;

  constructor() {
    const options = ["--headless", "--no-remote", "--profile", this.#folder, "--remote-debugging-port", "0"];
    this.#process = spawn(installed, options, { stdio: ["ignore", "ignore", "pipe"] });
    this.#socket = this.#connect();
  }

  /** The socket, once the browser has said where it listens, and a session has begun. */
  async #connect() {
    let address;
    for await (const line of createInterface({ input: this.#process.stderr })) {
      address = /WebDriver BiDi listening on (ws:\S+)/.exec(line)?.[1];
      if (address) break;
    }
    if (!address) throw new Error("Firefox has ended");
    this.#process.stderr.resume();
    const socket = new WebSocket(`${address}/session`);
    await new Promise((resolve, reject) => Object.assign(socket, { onopen: resolve, onerror: reject }));
    socket.onmessage = ({ data }) => this.#read(JSON.parse(data));
    await this.#send(socket, "session.new", { capabilities: {} });
    return socket;
  }

  #read({ id, result, error, message }) {
    const call = this.#calls.get(id);
    this.#calls.delete(id);
    if (error) call?.reject(new Error(`${error}: ${message}`));
    else call?.resolve(result);
  }

  #send(socket, method, params) {
    const id = this.#next++;
    const answer = new Promise((resolve, reject) => this.#calls.set(id, { resolve, reject }));
    socket.send(JSON.stringify({ id, method, params }));
    return answer;
  }

  async call(method, params = {}) {
    return this.#send(await this.#socket, method, params);
  }

  /** A page of `width × height` pixels at an address. */
  async page(url, width, height) {
    const { context } = await this.call("browsingContext.create", { type: "tab" });
    await this.call("browsingContext.setViewport", { context, viewport: { width, height } });
    await this.call("browsingContext.navigate", { context, url, wait: "none" });
    return new Page(this, context);
  }

  async close() {
    await this.#socket.catch(() => undefined);
    const ended = new Promise((resolve) => this.#process.once("exit", resolve));
    this.#process.kill();
    await ended;
    rmSync(this.#folder, { recursive: true, force: true, maxRetries: 50, retryDelay: 100 });
  }
}

class Page extends Waiting {
  constructor(browser, context) {
    super();
    this.browser = browser;
    this.context = context;
  }

  /** The value of an expression, awaited. */
  async evaluate(expression) {
    const { exceptionDetails, result } = await this.browser.call("script.evaluate", {
      // Numbers by the million travel best as text.
      expression: `Promise.resolve(${expression}).then((value) => JSON.stringify(value))`,
      target: { context: this.context },
      awaitPromise: true,
    });
    if (exceptionDetails) throw new Error(exceptionDetails.text);
    return result.value === undefined ? undefined : JSON.parse(result.value);
  }

  async drag(from, to) {
    const move = ([x, y]) => ({ type: "pointerMove", x, y });
    const middle = from.map((x, axis) => Math.round((x + to[axis]) / 2));
    const [down, up] = ["pointerDown", "pointerUp"].map((type) => ({ type, button: 0 }));
    const actions = [move(from), down, move(middle), move(to), up];
    const mouse = { type: "pointer", id: "mouse", parameters: { pointerType: "mouse" }, actions };
    await this.browser.call("input.performActions", { context: this.context, actions: [mouse] });
  }
}
