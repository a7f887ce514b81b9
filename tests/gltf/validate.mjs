// Run by Node in a folder where `gltf-validator` is installed: the Khronos report as JSON.
//
//     node validate.mjs FILE.glb

import fs from 'node:fs';
import { createRequire } from 'node:module';

const require = createRequire(process.cwd() + '/');
const validator = require('gltf-validator');
const report = await validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2])));
console.log(JSON.stringify(report));
