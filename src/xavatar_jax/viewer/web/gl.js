// Matrices by columns, and what WebGL needs many lines for.

function unit(v) { const n = Math.hypot(...v); return v.map((x) => x / n); }
function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}
function dot(a, b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// World to camera for an eye at `middle` that looks against `toward`.
function lookAlong(middle, toward, up) {
  const right = unit(cross(up, toward)), over = cross(toward, right);
  return [
    right[0], over[0], toward[0], 0, right[1], over[1], toward[1], 0, right[2], over[2], toward[2], 0,
    -dot(right, middle), -dot(over, middle), -dot(toward, middle), 1,
  ];
}

function ortho(x, y, near, far) {
  return [1 / x, 0, 0, 0, 0, 1 / y, 0, 0, 0, 0, -2 / (far - near), 0,
    0, 0, -(far + near) / (far - near), 1];
}

function perspective(slope, aspect, near, far) {
  return [1 / (slope * aspect), 0, 0, 0, 0, 1 / slope, 0, 0, 0, 0, -(far + near) / (far - near), -1,
    0, 0, (-2 * far * near) / (far - near), 0];
}

function times(a, b) {
  const out = new Array(16).fill(0);
  for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) for (let k = 0; k < 4; k++) {
    out[4 * c + r] += a[4 * k + r] * b[4 * c + k];
  }
  return out;
}

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  const places = {};
  const count = gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS);
  for (let k = 0; k < count; k++) {
    const { name } = gl.getActiveUniform(made, k);
    places[name] = gl.getUniformLocation(made, name);
  }
  return { made, places };
}

function use(gl, { made, places }) { gl.useProgram(made); return places; }

function bind(gl, place, unitNumber, which) {
  gl.activeTexture(gl.TEXTURE0 + unitNumber);
  gl.bindTexture(gl.TEXTURE_2D, which);
  gl.uniform1i(place, unitNumber);
  gl.activeTexture(gl.TEXTURE0);
}

function attribute(gl, place, values, size, kind, normalized = false) {
  const buffer = gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
  gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
  gl.enableVertexAttribArray(place);
  gl.vertexAttribPointer(place, size, kind, normalized, 0, 0);
  return buffer;
}

// Eight values a vertex, as two attributes of four.
function bones(gl, place, values, kind, integers) {
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
  const size = values.BYTES_PER_ELEMENT;
  for (let k = 0; k < 2; k++) {
    gl.enableVertexAttribArray(place + k);
    if (integers) gl.vertexAttribIPointer(place + k, 4, kind, 8 * size, 4 * k * size);
    else gl.vertexAttribPointer(place + k, 4, kind, true, 8 * size, 4 * k * size);
  }
}

function texture(gl, format, width, height, filter) {
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
  for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, filter);
  for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
  return made;
}

function target(gl, color, depth, size) {
  const made = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, made);
  if (color) gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, color, 0);
  else { gl.drawBuffers([gl.NONE]); gl.readBuffer(gl.NONE); }
  if (depth) gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, depth, 0);
  else {
    const buffer = gl.createRenderbuffer();
    gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, size, size);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, buffer);
  }
  return made;
}

function opaque(colors) {
  const out = new Uint8Array((colors.length / 3) * 4).fill(255);
  for (let k = 0; k < colors.length; k++) out[4 * Math.floor(k / 3) + (k % 3)] = colors[k];
  return out;
}
