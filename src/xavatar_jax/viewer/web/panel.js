// What the person at the page does: playing, sliders, turning the view.

const $ = (id) => document.getElementById(id);
const SHADINGS = { avatar: 0, normals: 1, weights: 2 };
const canvas = $("canvas");

let rig, scene;
try {
  rig = await readData();
  rig.rest = restVertices(rig);
  rig.normals = new Float32Array(rig.rest.length);
  vertexNormals(rig.rest, rig.faces, rig.normals);
  scene = makeScene(canvas, rig);
} catch (error) {
  $("message").textContent = error.message;
  $("message").hidden = false;
  throw error;
}

const jointCount = rig.parents.length;
const state = {
  time: 0, playing: false, speed: 1, shading: "avatar", bone: -1, inPlace: false,
  turns: {}, expression: new Float32Array(rig.expression_scales.length),
  yaw: rig.yaw, pitch: 0.1, distance: 1, target: [0, 0, 0], drawn: 0,
};
const shaped = { points: new Float32Array(rig.rest), normals: new Float32Array(rig.normals), by: "" };
let wanted = true, last = null;

function frameWhole() {
  const slope = Math.tan(0.5 * rig.fov), aspect = canvas.clientWidth / Math.max(canvas.clientHeight, 1);
  const [low, high] = [rig.bounds.slice(0, 3), rig.bounds.slice(3)];
  const wide = Math.hypot(high[0] - low[0], high[2] - low[2]);
  const tall = high[1] - low[1];
  state.target = low.map((v, i) => 0.5 * (v + high[i]));
  state.target[1] -= 0.03 * tall; // room for the bar below
  state.distance = 1.14 * Math.max(tall / 2 / slope, wide / 2 / slope / aspect) + 0.2 * wide;
}

function cameraNow(root) {
  const [cp, sp] = [Math.cos(state.pitch), Math.sin(state.pitch)];
  const toward = [cp * Math.sin(state.yaw), sp, cp * Math.cos(state.yaw)];
  const eye = state.target.map((v, i) => v + state.distance * toward[i]);
  const view = lookAlong(eye, toward, [0, 1, 0]);
  const aspect = canvas.width / canvas.height;
  const lens = perspective(Math.tan(0.5 * rig.fov), aspect, 0.05, 60);
  const rotation = [0, 1, 2, 4, 5, 6, 8, 9, 10].map((k) => view[k]);
  return { eye, rotation, view, camera: times(lens, view) };
}

function coefficients() {
  const count = rig.target_names.length;
  const now = count ? between(rig.coefficients, count, state.time) : new Float32Array(0);
  state.expression.forEach((value, e) => {
    const total = now[e] - now[e + count / 2] + value / rig.expression_scales[e];
    now[e] = Math.max(total, 0);
    now[e + count / 2] = Math.max(-total, 0);
  });
  return now;
}

function draw() {
  const ratio = Math.min(window.devicePixelRatio || 1, 2);
  const [w, h] = [canvas.clientWidth, canvas.clientHeight].map((v) => Math.max(Math.round(v * ratio), 1));
  if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
  const now = coefficients();
  const key = now.join();
  if (key !== shaped.by) {
    shapeVertices(rig, now, shaped.points);
    vertexNormals(shaped.points, rig.faces, shaped.normals);
    scene.setPoints(shaped.points, shaped.normals);
    shaped.by = key;
  }
  const pose = poseBones(rig, state.time, state.turns, state.inPlace);
  const view = cameraNow(pose.root);
  scene.draw(pose, view, SHADINGS[state.shading], state.bone);
  Object.assign(state, { pose, view, drawn: state.drawn + 1 });
}

function tick(at) {
  if (state.playing && last !== null) {
    const frames = rig.frames - 1;
    state.time += ((at - last) / 1000) * rig.fps * state.speed;
    if (state.time > frames) state.time = frames > 0 ? state.time % frames : 0;
    showTime();
    wanted = true;
  }
  last = state.playing ? at : null;
  if (wanted) { wanted = false; draw(); }
  requestAnimationFrame(tick);
}

function showTime() {
  $("frame").value = Math.round(state.time);
  const digits = rig.fps > 0 ? (state.time / rig.fps).toFixed(2) : "";
  $("time").textContent = `${digits} s · ${Math.round(state.time)}`;
}

function setPlaying(on) {
  state.playing = on && rig.frames > 1;
  $("play").textContent = state.playing ? "❚❚" : "▶";
  $("play").setAttribute("aria-label", state.playing ? "Pause" : "Play");
  if (!state.playing) state.time = Math.round(state.time);
}

function addSlider(parent, name, low, high, step, changed) {
  const row = document.createElement("label");
  row.className = "slider";
  row.innerHTML = `<span>${name}</span><input type="range" min="${low}" max="${high}" step="${step}" value="0"><output>0</output>`;
  const [, input, output] = row.children;
  input.id = `slider-${name}`;
  input.addEventListener("input", () => {
    output.textContent = input.value;
    changed(Number(input.value));
    wanted = true;
  });
  parent.append(row);
  return (value) => { input.value = value; output.textContent = value; };
}

function fill(select, names, first) {
  if (first) select.add(new Option(first, -1));
  names.forEach((name, k) => select.add(new Option(name.replaceAll("_", " "), k)));
}

fill($("bone"), rig.names, "all");
fill($("joint"), rig.names);
$("joint").value = Math.max(rig.names.indexOf("left_shoulder"), 0);
const degrees = Math.PI / 180;
const turnSliders = ["x", "y", "z"].map((axis, k) =>
  addSlider($("turns"), axis, -120, 120, 1, (value) => {
    const joint = Number($("joint").value);
    state.turns[joint] ||= [0, 0, 0];
    state.turns[joint][k] = value * degrees;
  }));
const expressionSliders = rig.expression_scales.length ? [...rig.expression_scales].map((_, e) =>
  addSlider($("expressions"), String(e), -3, 3, 0.1, (value) => { state.expression[e] = value; })) : [];
$("expressions").hidden = !rig.expression_scales.length;
$("player").hidden = rig.frames < 2;
$("frame").max = rig.frames - 1;
$("about").textContent = rig.about;

function showTurns() {
  const turn = state.turns[Number($("joint").value)] || [0, 0, 0];
  turnSliders.forEach((set, k) => set(Math.round(turn[k] / degrees)));
}

$("joint").addEventListener("change", showTurns);
$("shading").addEventListener("change", (event) => {
  state.shading = event.target.value;
  $("bone-row").hidden = state.shading !== "weights";
  wanted = true;
});
$("bone").addEventListener("change", (event) => { state.bone = Number(event.target.value); wanted = true; });
$("in-place").addEventListener("change", (event) => { state.inPlace = event.target.checked; wanted = true; });
$("frame").addEventListener("input", (event) => {
  setPlaying(false);
  state.time = Number(event.target.value);
  showTime();
  wanted = true;
});
$("play").addEventListener("click", () => setPlaying(!state.playing));
$("speed").addEventListener("change", (event) => { state.speed = Number(event.target.value); });
$("reset").addEventListener("click", () => {
  state.turns = {};
  state.expression.fill(0);
  showTurns();
  expressionSliders.forEach((set) => set(0));
  Object.assign(state, { yaw: rig.yaw, pitch: 0.1 });
  frameWhole();
  wanted = true;
});
window.addEventListener("keydown", (event) => {
  if (event.code === "Space" && !/BUTTON|SELECT/.test(event.target.tagName)) {
    event.preventDefault();
    setPlaying(!state.playing);
  }
});

const fingers = new Map();
canvas.addEventListener("pointerdown", (event) => {
  fingers.set(event.pointerId, [event.clientX, event.clientY]);
  canvas.setPointerCapture(event.pointerId);
  canvas.classList.add("turning");
});
canvas.addEventListener("pointermove", (event) => {
  const before = fingers.get(event.pointerId);
  if (!before) return;
  const [dx, dy] = [event.clientX - before[0], event.clientY - before[1]];
  if (fingers.size === 2) {
    const other = [...fingers].find(([id]) => id !== event.pointerId)[1];
    const span = (at) => Math.hypot(at[0] - other[0], at[1] - other[1]);
    zoom(span(before) / Math.max(span([event.clientX, event.clientY]), 1));
  } else if (event.shiftKey || event.buttons & 6) {
    const size = (2 * state.distance * Math.tan(0.5 * rig.fov)) / canvas.clientHeight;
    const { view } = state.view;
    state.target = state.target.map((v, i) => v + size * (dy * view[4 * i + 1] - dx * view[4 * i]));
  } else {
    state.yaw -= 0.008 * dx;
    state.pitch = Math.min(Math.max(state.pitch + 0.008 * dy, -1.5), 1.5);
  }
  fingers.set(event.pointerId, [event.clientX, event.clientY]);
  wanted = true;
});
for (const name of ["pointerup", "pointercancel"]) {
  canvas.addEventListener(name, (event) => {
    fingers.delete(event.pointerId);
    if (!fingers.size) canvas.classList.remove("turning");
  });
}
canvas.addEventListener("contextmenu", (event) => event.preventDefault());
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  zoom(Math.exp(0.0012 * event.deltaY));
}, { passive: false });
function zoom(factor) {
  state.distance = Math.min(Math.max(state.distance * factor, 0.15), 30);
  wanted = true;
}
new ResizeObserver(() => { wanted = true; }).observe(canvas);

window.avatar = { rig, state, redraw() { wanted = true; } };
frameWhole();
showTime();
requestAnimationFrame(tick);
