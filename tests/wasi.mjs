// SPDX-License-Identifier: MIT-0
// Runs a program that was compiled to WebAssembly, with WASI, under node:
//     node --no-warnings tests/wasi.mjs FILE [ARGUMENT...]
import { readFileSync } from "node:fs";
import { WASI } from "node:wasi";

const wasi = new WASI({
    version: "preview1",
    args: process.argv.slice(2),
    env: process.env,
    preopens: { "/": "/", ".": "." },
});
const program = await WebAssembly.compile(readFileSync(process.argv[2]));
// exit: node 20 crashes as it ends by itself after some programs
process.exit(wasi.start(await WebAssembly.instantiate(program, { wasi_snapshot_preview1: wasi.wasiImport })));
