// What pages have in common, whatever browser shows them.

import { setTimeout } from "node:timers/promises";

/** A page that says when an expression is true. */
export class Waiting {
  /** Waits until an expression is true; after `seconds`, fails with what the page says. */
  async until(expression, seconds = 60) {
    const end = Date.now() + 1000 * seconds;
    while (!(await this.evaluate(expression).catch(() => false))) {
      if (Date.now() > end) {
        throw new Error(`not ${expression}; the page says: ${await this.evaluate("document.body?.innerText")}`);
      }
      await setTimeout(50);
    }
  }
}
