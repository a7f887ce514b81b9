// Run by Node in a folder where `three` is installed: load a GLB with three.js, pose it, save.
//
//     node three_pose.mjs FILE.glb OUT.f32 FPS FRAME [FRAME ...]
//
// Writes vertices of the frames one after another, float32, and prints counts as JSON.

import fs from 'node:fs';
import { createRequire } from 'node:module';
import { pathToFileURL } from 'node:url';

const require = createRequire(process.cwd() + '/');
const load = (name) => import(pathToFileURL(require.resolve(name)).href);
globalThis.self = globalThis;
const THREE = await import(pathToFileURL(require.resolve('three').replace('three.cjs', 'three.module.js')).href);
const { GLTFLoader } = await load('three/examples/jsm/loaders/GLTFLoader.js');

const [path, out, fps, ...frames] = process.argv.slice(2);
const bytes = fs.readFileSync(path);
const buffer = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
const gltf = await new GLTFLoader().parseAsync(buffer, '');
const mesh = gltf.scene.getObjectByProperty('isSkinnedMesh', true);
const mixer = new THREE.AnimationMixer(gltf.scene);
const action = mixer.clipAction(gltf.animations[0]);
action.setLoop(THREE.LoopOnce);
action.clampWhenFinished = true;
action.play();
const count = mesh.geometry.attributes.position.count;
const posed = new Float32Array(frames.length * count * 3);
const point = new THREE.Vector3();
frames.forEach((frame, k) => {
  mixer.setTime(Number(frame) / Number(fps));
  gltf.scene.updateMatrixWorld(true);
  mesh.skeleton.update();
  for (let i = 0; i < count; i++) {
    mesh.getVertexPosition(i, point).applyMatrix4(mesh.matrixWorld);
    posed.set([point.x, point.y, point.z], 3 * (k * count + i));
  }
});
fs.writeFileSync(out, new Uint8Array(posed.buffer));
console.log(JSON.stringify({
  vertices: count,
  bones: mesh.skeleton.bones.length,
  targets: Object.keys(mesh.morphTargetDictionary ?? {}),
  clips: gltf.animations.map((clip) => clip.name),
  revision: THREE.REVISION,
}));
