// Arrays of the page, and the skeleton: rotations of a frame, chained down the tree.

async function readData() {
  const manifest = JSON.parse(document.getElementById("manifest").textContent);
  const text = document.getElementById("data").textContent.trim();
  const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const buffer = await new Response(stream).arrayBuffer();
  const kinds = { "|u1": Uint8Array, "<u2": Uint16Array, "<i2": Int16Array, "<u4": Uint32Array,
    "<f4": Float32Array };
  const arrays = {};
  for (const [name, { dtype, shape, offset }] of Object.entries(manifest.arrays)) {
    arrays[name] = new kinds[dtype](buffer, offset, shape.reduce((a, b) => a * b, 1));
  }
  return { ...manifest, ...arrays };
}

// Quaternions are x y z w.
function fromAxisAngle([x, y, z]) {
  const angle = Math.hypot(x, y, z);
  const s = angle < 1e-9 ? 0.5 : Math.sin(angle / 2) / angle;
  return [s * x, s * y, s * z, Math.cos(angle / 2)];
}

function product(a, b) {
  return [
    a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1],
    a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0],
    a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3],
    a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2],
  ];
}

// Values between two frames; quaternions of neighbours lie on one side, so this is a rotation.
function between(array, size, time) {
  const last = array.length / size - 1;
  const k = Math.min(Math.floor(time), last);
  const next = Math.min(k + 1, last);
  const part = time - k;
  const out = new Float32Array(size);
  for (let i = 0; i < size; i++) {
    out[i] = (1 - part) * array[k * size + i] + part * array[next * size + i];
  }
  return out;
}

// Rows of world * inverse bind of every bone (J, 3, 4), and where the root stands.
function poseBones(rig, time, turns, inPlace) {
  const count = rig.parents.length;
  const rotations = between(rig.rotations, 4 * count, time);
  const shifts = between(rig.translations, 3 * count, time);
  const world = new Float64Array(12 * count);
  const bones = new Float32Array(12 * count);
  for (let j = 0; j < count; j++) {
    let q = rotations.subarray(4 * j, 4 * j + 4);
    const norm = Math.hypot(...q);
    q = [q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm];
    if (turns[j]) q = product(q, fromAxisAngle(turns[j]));
    const [x, y, z, w] = q;
    const local = [
      1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), shifts[3 * j],
      2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), shifts[3 * j + 1],
      2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), shifts[3 * j + 2],
    ];
    if (j === 0 && inPlace) {
      local[3] = rig.translations[0];
      local[11] = rig.translations[2];
    }
    const own = world.subarray(12 * j, 12 * j + 12);
    const parent = rig.parents[j];
    if (parent < 0) own.set(local);
    else affine(world.subarray(12 * parent, 12 * parent + 12), local, own);
    affine(own, rig.inverse_bind.subarray(12 * j, 12 * j + 12), bones.subarray(12 * j, 12 * j + 12));
  }
  return { bones, root: [world[3], world[7], world[11]] };
}

// Product of two 3x4 matrices by rows.
function affine(a, b, out) {
  for (let r = 0; r < 3; r++) {
    for (let c = 0; c < 4; c++) {
      out[4 * r + c] = a[4 * r] * b[c] + a[4 * r + 1] * b[4 + c] + a[4 * r + 2] * b[8 + c] +
        (c === 3 ? a[4 * r + 3] : 0);
    }
  }
}

// Vertices before skinning: the neutral ones and what the blend shapes add. Only some vertices move.
function shapeVertices(rig, coefficients, out) {
  out.set(rig.rest);
  for (let e = 0; e < rig.target_names.length; e++) {
    const weight = coefficients[e];
    if (!weight) continue;
    const scale = weight * rig.target_steps[e];
    for (let k = rig.target_starts[e]; k < rig.target_starts[e + 1]; k++) {
      const v = 3 * rig.target_vertices[k];
      out[v] += scale * rig.target_moves[3 * k];
      out[v + 1] += scale * rig.target_moves[3 * k + 1];
      out[v + 2] += scale * rig.target_moves[3 * k + 2];
    }
  }
}

function restVertices(rig) {
  const rest = new Float32Array(rig.positions.length);
  for (let i = 0; i < rest.length; i++) {
    rest[i] = rig.low[i % 3] + rig.positions[i] * rig.step;
  }
  return rest;
}

// Area-weighted normals.
function vertexNormals(points, faces, out) {
  out.fill(0);
  for (let k = 0; k < faces.length; k += 3) {
    const [a, b, c] = [3 * faces[k], 3 * faces[k + 1], 3 * faces[k + 2]];
    const ux = points[b] - points[a], uy = points[b + 1] - points[a + 1], uz = points[b + 2] - points[a + 2];
    const vx = points[c] - points[a], vy = points[c + 1] - points[a + 1], vz = points[c + 2] - points[a + 2];
    const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
    for (const i of [a, b, c]) { out[i] += x; out[i + 1] += y; out[i + 2] += z; }
  }
  for (let i = 0; i < out.length; i += 3) {
    const length = Math.hypot(out[i], out[i + 1], out[i + 2]) || 1;
    out[i] /= length; out[i + 1] /= length; out[i + 2] /= length;
  }
}
