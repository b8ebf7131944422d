// Runs a WASI program in Node: `node tests/wasi.mjs PROGRAM.wasm [ARGUMENT …]`, with the working folder as all that it sees.
import { readFile } from "node:fs/promises";
import { argv, cwd, exit } from "node:process";
import { WASI } from "node:wasi";

const args = argv.slice(2);
const folder = cwd();
const wasi = new WASI({ version: "preview1", args, preopens: { [folder]: folder }, env: { RUST_BACKTRACE: "1" } });
const module = await WebAssembly.compile(await readFile(args[0]));
exit(wasi.start(await WebAssembly.instantiate(module, wasi.getImportObject())));
