// The picture: bones move the vertices on the graphics card; one light with a shadow, and a ground.

const SKIN = `
uniform highp sampler2D uBones;
layout(location = 0) in vec3 aPoint;
layout(location = 1) in vec3 aNormal;
layout(location = 2) in uvec4 aBones0;
layout(location = 3) in uvec4 aBones1;
layout(location = 4) in vec4 aWeights0;
layout(location = 5) in vec4 aWeights1;
layout(location = 6) in vec3 aColor;
vec4 row(int r) {
  vec4 m = vec4(0.0);
  for (int k = 0; k < 4; k++) {
    m += aWeights0[k] * texelFetch(uBones, ivec2(r, int(aBones0[k])), 0);
    m += aWeights1[k] * texelFetch(uBones, ivec2(r, int(aBones1[k])), 0);
  }
  return m / (dot(aWeights0, vec4(1.0)) + dot(aWeights1, vec4(1.0)));
}
`;

const BODY_VERTEX = `#version 300 es
precision highp float;
precision highp int;
${SKIN}
uniform mat4 uCamera;
uniform mat4 uLight;
uniform highp sampler2D uPalette;
uniform int uShading;
uniform int uBone;
out vec3 vPoint;
out vec3 vNormal;
out vec3 vColor;
out vec4 vLit;
void main() {
  vec4 x = row(0), y = row(1), z = row(2), p = vec4(aPoint, 1.0);
  vPoint = vec3(dot(x, p), dot(y, p), dot(z, p));
  vNormal = normalize(vec3(dot(x.xyz, aNormal), dot(y.xyz, aNormal), dot(z.xyz, aNormal)));
  vColor = aColor;
  if (uShading == 2) {
    vec3 blend = vec3(0.0);
    float own = 0.0;
    for (int k = 0; k < 4; k++) {
      blend += aWeights0[k] * texelFetch(uPalette, ivec2(int(aBones0[k]), 0), 0).rgb;
      blend += aWeights1[k] * texelFetch(uPalette, ivec2(int(aBones1[k]), 0), 0).rgb;
      own += (int(aBones0[k]) == uBone ? aWeights0[k] : 0.0);
      own += (int(aBones1[k]) == uBone ? aWeights1[k] : 0.0);
    }
    vec3 ramp = own < 0.5
      ? mix(texelFetch(uPalette, ivec2(0, 1), 0).rgb, texelFetch(uPalette, ivec2(1, 1), 0).rgb, 2.0 * own)
      : mix(texelFetch(uPalette, ivec2(1, 1), 0).rgb, texelFetch(uPalette, ivec2(2, 1), 0).rgb, 2.0 * own - 1.0);
    vColor = uBone < 0 ? blend : ramp;
  }
  vLit = uLight * vec4(vPoint, 1.0);
  gl_Position = uCamera * vec4(vPoint, 1.0);
}`;

const SHADOW = `
uniform mediump sampler2DShadow uShadow;
float lit(vec4 place, float slope) {
  vec3 p = 0.5 * place.xyz + 0.5;
  float sum = 0.0;
  for (int i = -2; i <= 2; i++) for (int j = -2; j <= 2; j++) {
    sum += texture(uShadow, vec3(p.xy + 2.2 * vec2(i, j) / 1024.0, p.z - slope));
  }
  return sum / 25.0;
}
`;

// sRGB in, linear light between, sRGB out.
const BODY_FRAGMENT = `#version 300 es
precision highp float;
precision highp int;
${SHADOW}
uniform vec3 uEye;
uniform vec3 uSun;
uniform int uShading;
uniform mat3 uView;
in vec3 vPoint;
in vec3 vNormal;
in vec3 vColor;
in vec4 vLit;
out vec4 color;
void main() {
  vec3 n = normalize(vNormal), eye = normalize(uEye - vPoint);
  if (uShading == 1) { color = vec4(0.5 + 0.5 * (uView * n), 1.0); return; }
  vec3 albedo = pow(vColor, vec3(2.2));
  float facing = dot(n, uSun);
  float sun = max(facing + 0.15, 0.0) / 1.15 * lit(vLit, 0.004 + 0.004 * (1.0 - facing));
  vec3 light = mix(vec3(0.50, 0.46, 0.43), vec3(0.82, 0.84, 0.88), 0.5 + 0.5 * n.y);
  light += sun * vec3(1.80, 1.74, 1.66);
  light += max(dot(n, normalize(vec3(-uSun.x, 0.25, 0.8 * uSun.z))), 0.0) * vec3(0.22, 0.25, 0.30);
  float rim = pow(1.0 - max(dot(n, eye), 0.0), 3.0);
  light += rim * vec3(0.20, 0.21, 0.23);
  float gloss = pow(max(dot(n, normalize(eye + uSun)), 0.0), 32.0);
  vec3 shown = 0.5 * albedo * light + (uShading == 0 ? 0.05 * gloss * sun : 0.0);
  if (uShading == 2) shown = mix(shown, albedo, 0.55);
  color = vec4(pow(clamp(shown, 0.0, 1.0), vec3(1.0 / 2.2)), 1.0);
}`;

const DEPTH_VERTEX = `#version 300 es
precision highp float;
precision highp int;
${SKIN}
uniform mat4 uCamera;
out float vHeight;
uniform float uGround;
void main() {
  vec4 p = vec4(aPoint, 1.0);
  vec3 q = vec3(dot(row(0), p), dot(row(1), p), dot(row(2), p));
  vHeight = q.y - uGround;
  gl_Position = uCamera * vec4(q, 1.0);
}`;

const DEPTH_FRAGMENT = `#version 300 es
precision highp float;
in float vHeight;
out vec4 color;
void main() { color = vec4(exp(-max(vHeight, 0.0) / 0.13)); }`;

const GROUND_VERTEX = `#version 300 es
precision highp float;
uniform mat4 uCamera;
uniform mat4 uLight;
uniform vec3 uMiddle;
layout(location = 0) in vec2 aPlace;
out vec3 vPoint;
out vec4 vLit;
void main() {
  vPoint = uMiddle + vec3(7.0 * aPlace.x, 0.0, 7.0 * aPlace.y);
  vLit = uLight * vec4(vPoint, 1.0);
  gl_Position = uCamera * vec4(vPoint, 1.0);
}`;

const GROUND_FRAGMENT = `#version 300 es
precision highp float;
${SHADOW}
uniform highp sampler2D uContact;
uniform vec3 uMiddle;
uniform vec3 uPaper;
uniform float uReach;
in vec3 vPoint;
in vec4 vLit;
out vec4 color;
void main() {
  vec2 away = vPoint.xz - uMiddle.xz;
  float far = length(away), contact = 0.0;
  for (int k = 0; k < 24; k++) {
    float r = 0.11 * sqrt((float(k) + 0.5) / 24.0), a = 2.39996 * float(k);
    contact += texture(uContact, 0.5 + 0.5 * (away + r * vec2(cos(a), sin(a))) / uReach).r / 24.0;
  }
  vec2 line = abs(fract(vPoint.xz / 0.5 + 0.5) - 0.5) * 0.5 / fwidth(vPoint.xz);
  float grid = 1.0 - clamp(min(line.x, line.y), 0.0, 1.0);
  float fade = 1.0 - smoothstep(1.5, 6.5, far);
  float dark = 1.0 - (1.0 - 0.55 * contact) * (1.0 - 0.16 * (1.0 - lit(vLit, 0.002)));
  float shade = (1.0 - dark) * (1.0 - 0.055 * grid * fade);
  color = vec4(uPaper * mix(1.0, shade, 1.0 - smoothstep(0.75, 1.0, far / 7.0)), 1.0);
}`;

const PAPER = [0.965, 0.965, 0.97];
const SHADOW_SIZE = 1024, CONTACT_SIZE = 256, REACH = 1.6;

function makeScene(canvas, rig) {
  const gl = canvas.getContext("webgl2", { antialias: true });
  if (!gl) throw new Error("This page needs WebGL 2, which this browser or its graphics driver lacks.");
  const programs = {
    body: program(gl, BODY_VERTEX, BODY_FRAGMENT),
    depth: program(gl, DEPTH_VERTEX, DEPTH_FRAGMENT),
    ground: program(gl, GROUND_VERTEX, GROUND_FRAGMENT),
  };
  const count = rig.parents.length;
  const body = gl.createVertexArray();
  gl.bindVertexArray(body);
  const points = attribute(gl, 0, rig.rest, 3, gl.FLOAT);
  const normals = attribute(gl, 1, rig.normals, 3, gl.FLOAT);
  const wide = rig.joints instanceof Uint16Array;
  bones(gl, 2, rig.joints, wide ? gl.UNSIGNED_SHORT : gl.UNSIGNED_BYTE, true);
  bones(gl, 4, rig.weights, gl.UNSIGNED_SHORT, false);
  if (rig.colors) attribute(gl, 6, rig.colors, 3, gl.UNSIGNED_BYTE, true);
  else gl.vertexAttrib3f(6, ...rig.color);
  const index = gl.createBuffer();
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, index);
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, rig.faces, gl.STATIC_DRAW);
  const indexKind = rig.faces instanceof Uint16Array ? gl.UNSIGNED_SHORT : gl.UNSIGNED_INT;
  const ground = gl.createVertexArray();
  gl.bindVertexArray(ground);
  attribute(gl, 0, new Float32Array([-1, -1, -1, 1, 1, -1, 1, 1]), 2, gl.FLOAT);
  const boneTexture = texture(gl, gl.RGBA32F, 3, count, gl.NEAREST);
  const palette = texture(gl, gl.RGBA8, Math.max(count, 3), 2, gl.NEAREST);
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, count, 1, gl.RGBA, gl.UNSIGNED_BYTE, opaque(rig.palette));
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 1, 3, 1, gl.RGBA, gl.UNSIGNED_BYTE, opaque(rig.ramp));
  const shadow = texture(gl, gl.DEPTH_COMPONENT24, SHADOW_SIZE, SHADOW_SIZE, gl.LINEAR);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_COMPARE_MODE, gl.COMPARE_REF_TO_TEXTURE);
  const contact = texture(gl, gl.RGBA8, CONTACT_SIZE, CONTACT_SIZE, gl.LINEAR);
  const shadowTarget = target(gl, null, shadow, SHADOW_SIZE);
  const contactTarget = target(gl, contact, null, CONTACT_SIZE);
  gl.enable(gl.DEPTH_TEST);

  function pass(which, camera, size, ground) {
    gl.bindFramebuffer(gl.FRAMEBUFFER, which);
    gl.viewport(0, 0, size, size);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const u = use(gl, programs.depth);
    gl.uniformMatrix4fv(u.uCamera, false, camera);
    gl.uniform1f(u.uGround, ground);
    bind(gl, u.uBones, 0, boneTexture);
    gl.bindVertexArray(body);
    gl.drawElements(gl.TRIANGLES, rig.faces.length, indexKind, 0);
  }

  return {
    setPoints(moved, turned) {
      for (const [buffer, values] of [[points, moved], [normals, turned]]) {
        gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
        gl.bufferSubData(gl.ARRAY_BUFFER, 0, values);
      }
    },
    draw(pose, view, shading, bone) {
      gl.bindTexture(gl.TEXTURE_2D, boneTexture);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 3, count, gl.RGBA, gl.FLOAT, pose.bones);
      const middle = [pose.root[0], rig.ground, pose.root[2]];
      const sun = unit(rig.sun);
      const aim = [pose.root[0], rig.ground + 0.5 * rig.height, pose.root[2]];
      const half = 0.85 * rig.height;
      const light = times(ortho(half, half, -4 * half, 4 * half), lookAlong(aim, sun, [0, 1, 0]));
      const below = times(ortho(REACH, REACH, -0.05, 4), lookAlong(middle, [0, -1, 0], [0, 0, 1]));
      pass(shadowTarget, light, SHADOW_SIZE, rig.ground);
      pass(contactTarget, below, CONTACT_SIZE, rig.ground);
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.viewport(0, 0, canvas.width, canvas.height);
      gl.clearColor(...PAPER, 1);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      let u = use(gl, programs.ground);
      gl.uniformMatrix4fv(u.uCamera, false, view.camera);
      gl.uniformMatrix4fv(u.uLight, false, light);
      gl.uniform3fv(u.uMiddle, middle);
      gl.uniform3fv(u.uPaper, PAPER);
      gl.uniform1f(u.uReach, REACH);
      bind(gl, u.uShadow, 1, shadow);
      bind(gl, u.uContact, 2, contact);
      if (view.eye[1] > rig.ground) {
        gl.bindVertexArray(ground);
        gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
      }
      u = use(gl, programs.body);
      gl.uniformMatrix4fv(u.uCamera, false, view.camera);
      gl.uniformMatrix4fv(u.uLight, false, light);
      gl.uniformMatrix3fv(u.uView, false, view.rotation);
      gl.uniform3fv(u.uEye, view.eye);
      gl.uniform3fv(u.uSun, sun);
      gl.uniform1i(u.uShading, shading);
      gl.uniform1i(u.uBone, bone);
      bind(gl, u.uBones, 0, boneTexture);
      bind(gl, u.uShadow, 1, shadow);
      bind(gl, u.uPalette, 3, palette);
      gl.bindVertexArray(body);
      gl.drawElements(gl.TRIANGLES, rig.faces.length, indexKind, 0);
    },
  };
}
