// The browser that tests run in: Chromium, or what B2P_BROWSER names.

import * as chromium from "./chromium.mjs";
import * as firefox from "./firefox.mjs";

const name = process.env.B2P_BROWSER || "chromium";
const browsers = { chromium, firefox };
if (!browsers[name]) throw new Error(`B2P_BROWSER is chromium or firefox, not ${name}`);

export const { Browser } = browsers[name];
/** Why tests cannot run, or `false`. */
export const skip = browsers[name].installed ? false : `no ${name} is installed`;
