// The moving subject of a report, to be turned, played and taken apart. Draws motion.glb with three.js (THREE), and what
// `viz.turntable` puts beside it: names, cameras with pictures, paths. Nothing is fetched; text goes in as text only.
(() => {
"use strict";
const box = document.getElementById("turntable");
if (!box) return;
const byId = (id) => document.getElementById(id);
const data = JSON.parse(byId("turntable-data").textContent);
const canvas = document.createElement("canvas");
if (!canvas.getContext("webgl2")) return;  // the still picture stays
const { Vector3, Color } = THREE;

const bytesOf = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
const vector = (a) => new Vector3(a[0], a[1], a[2]);
const bodyColor = (node) => new Color(data.nodes[node] ? data.nodes[node].color : "#b0b2b6");
const element = (tag, name, text) => {
  const made = document.createElement(tag);
  if (name) made.className = name;
  if (text !== undefined) made.textContent = text;
  return made;
};

// --- what the user has set ---
const state = {
  time: 0, playing: false, speed: 1, through: -1, hovered: 0, chosen: 0,
  surface: "glass", paint: "bodies",
  layers: { skeleton: true, trails: true, names: false, cameras: false, points: false, floor: true },
};
const duration = (data.frames.length - 1) / data.fps;
const frameNow = () => Math.min(data.frames.length - 1, Math.round(state.time * data.fps));

// --- stage ---
const renderer = new THREE.WebGLRenderer({ canvas, context: canvas.getContext("webgl2", { antialias: true, alpha: true, preserveDrawingBuffer: true }) });
renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
renderer.shadowMap.enabled = true;
const scene = new THREE.Scene();
const eye = new THREE.PerspectiveCamera(28, 1.6, 0.01 * data.diagonal, 60 * data.diagonal);
const controls = new THREE.OrbitControls(eye, canvas);
controls.enableDamping = false;
controls.enableZoom = false;  // until the picture is clicked, so that the page scrolls
controls.minDistance = 0.25 * data.diagonal;
controls.maxDistance = 30 * data.diagonal;
controls.maxPolarAngle = 0.62 * Math.PI;
canvas.style.touchAction = "pan-y";
canvas.tabIndex = 0;
canvas.setAttribute("role", "img");
canvas.setAttribute("aria-label", "The subject in three dimensions. Drag to turn, space to play, arrow keys for single frames.");

const sky = new THREE.HemisphereLight(0xffffff, 0xb9bcc4, 1.9);
const sun = new THREE.DirectionalLight(0xffffff, 1.9);
sun.castShadow = true;
sun.shadow.mapSize.set(1024, 1024);
sun.shadow.radius = 5;
sun.shadow.bias = -0.0015;
const reach = 0.75 * data.diagonal;
Object.assign(sun.shadow.camera, { left: -reach, right: reach, top: reach, bottom: -reach, near: 0.1 * reach, far: 8 * reach });
sun.shadow.normalBias = 0.012 * data.diagonal;
scene.add(sky, sun, sun.target);

const ground = new THREE.Group();
ground.position.y = data.floor;
scene.add(ground);
const shade = new THREE.Mesh(new THREE.PlaneGeometry(8 * reach, 8 * reach), new THREE.ShadowMaterial({ opacity: 0.2, depthWrite: false }));
shade.rotation.x = -Math.PI / 2;
shade.receiveShadow = true;
ground.add(shade);
let grid = null;
const makeGrid = (ink) => {
  if (grid) { ground.remove(grid); grid.geometry.dispose(); }
  const positions = [], colors = [], step = data.step, span = Math.ceil((1.6 * data.diagonal) / step), fade = span * step;
  const c = new Color(ink);
  const corner = (x, z) => {
    positions.push(x, 0, z);
    colors.push(c.r, c.g, c.b, 0.8 * Math.max(0, 1 - Math.hypot(x, z) / fade));
  };
  for (let i = -span; i <= span; i++) {
    for (let j = -span; j < span; j++) {
      corner(i * step, j * step); corner(i * step, (j + 1) * step);
      corner(j * step, i * step); corner((j + 1) * step, i * step);
    }
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(positions), 3));
  geometry.setAttribute("color", new THREE.BufferAttribute(new Float32Array(colors), 4));
  grid = new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ vertexColors: true, transparent: true, depthWrite: false }));
  ground.add(grid);
};

// --- the subject, once motion.glb is read ---
let subject = null;  // { root, surface, nodes, mixer, action, paths, angles }
const pick = { layer: 1, target: new THREE.WebGLRenderTarget(1, 1) };
const idColor = (id) => new Color().setRGB((id & 255) / 255, (id >> 8) / 255, 0);  // linear, as the target is

const setTime = (seconds) => {
  subject.action.time = Math.min(Math.max(seconds, 0), duration);
  subject.mixer.update(0);
  subject.root.updateMatrixWorld(true);
};

function begin(gltf) {
  const root = gltf.scene;
  let surface = null;
  root.traverse((o) => { if (o.isSkinnedMesh) surface = o; });
  const nodes = surface.skeleton.bones;
  const mixer = new THREE.AnimationMixer(root);
  const action = mixer.clipAction(gltf.animations[0]);
  action.play();
  subject = { root, surface, nodes, mixer, action };
  scene.add(root);
  setTime(0);
  dressSurface();
  endBones();
  rememberMotion();
  makeSkeleton();
}

// A bone without a child ends where the surface of its body does, seen along it.
function endBones() {
  const { surface, nodes, main } = subject, p = new Vector3(), along = nodes.map(() => []);
  const tips = data.nodes.map((node) => (node.tip ? vector(node.tip) : null));
  const lengths = tips.map((tip) => (tip ? tip.length() : 0));
  for (let v = 0; v < main.length; v++) {
    const n = main[v];
    if (!lengths[n]) continue;
    surface.getVertexPosition(v, p);  // as it is posed now
    along[n].push(nodes[n].worldToLocal(surface.localToWorld(p)).dot(tips[n]) / lengths[n]);
  }
  tips.forEach((tip, n) => {
    if (!tip || along[n].length < 8) return;
    const sorted = along[n].sort((a, b) => a - b), end = sorted[Math.floor(0.96 * (sorted.length - 1))];
    if (end > 0.2 * lengths[n]) data.nodes[n].tip = tip.multiplyScalar(end / lengths[n]).toArray();
  });
}

// Where nodes and ends of bones are in every frame, and how far each node has turned since the first.
function rememberMotion() {
  const { nodes } = subject, T = data.frames.length, P = 2 * nodes.length;
  const paths = new Float32Array(T * P * 3), angles = new Float32Array(T * nodes.length), p = new Vector3();
  const first = nodes.map((n) => n.quaternion.clone());
  for (let t = 0; t < T; t++) {
    setTime(t / data.fps);
    nodes.forEach((node, n) => {
      node.getWorldPosition(p).toArray(paths, 3 * (t * P + n));
      const tip = data.nodes[n].tip;
      (tip ? node.localToWorld(p.fromArray(tip)) : p).toArray(paths, 3 * (t * P + nodes.length + n));
      const dot = Math.min(1, Math.abs(node.quaternion.dot(first[n])));
      angles[t * nodes.length + n] = (2 * Math.acos(dot) * 180) / Math.PI;
    });
  }
  Object.assign(subject, { paths, angles, places: P });
  setTime(0);
}

let clear = null, solid = null, behind = null;
function dressSurface() {
  const { surface } = subject, geometry = surface.geometry, count = geometry.attributes.position.count;
  const joints = geometry.attributes.skinIndex, weights = geometry.attributes.skinWeight;
  const main = new Uint16Array(count), ids = new Float32Array(3 * count);
  for (let v = 0; v < count; v++) {
    let best = 0;
    for (let k = 1; k < 4; k++) if (weights.getComponent(v, k) > weights.getComponent(v, best)) best = k;
    main[v] = joints.getComponent(v, best);
    idColor(main[v] + 1).toArray(ids, 3 * v);
  }
  const painted = new THREE.BufferAttribute(new Float32Array(3 * count), 3);
  geometry.setAttribute("color", painted);
  Object.assign(subject, { main, painted, own: data.colors ? bytesOf(data.colors) : null });

  solid = new THREE.MeshStandardMaterial({ vertexColors: true, roughness: 0.75, metalness: 0, side: THREE.DoubleSide });
  clear = new THREE.MeshStandardMaterial({ vertexColors: true, roughness: 0.6, metalness: 0, transparent: true, opacity: 0.42, depthWrite: false });
  surface.material = solid;
  surface.castShadow = true;
  surface.frustumCulled = false;
  const twin = (material, layer) => {
    const made = new THREE.SkinnedMesh(geometry, material);
    made.bind(surface.skeleton, surface.bindMatrix);
    made.frustumCulled = false;
    made.layers.set(layer);
    surface.parent.add(made);
    return made;
  };
  behind = twin(new THREE.MeshBasicMaterial({ colorWrite: false }), 0);  // so that glass shows its front only
  behind.renderOrder = 1;
  const shape = geometry.clone();
  shape.setAttribute("color", new THREE.BufferAttribute(ids, 3));
  subject.touch = twin(new THREE.MeshBasicMaterial({ vertexColors: true, toneMapped: false, side: THREE.DoubleSide }), pick.layer);
  subject.touch.geometry = shape;
}

function makeSkeleton() {
  const { nodes } = subject, thick = 0.0095 * data.diagonal, bones = [];
  const rod = new THREE.CylinderGeometry(0.55, 1, 1, 14, 1).translate(0, 0.5, 0);
  const ball = new THREE.SphereGeometry(1, 20, 14);
  const up = new Vector3(0, 1, 0);
  const add = (node, shape, material, id) => {
    const mesh = new THREE.Mesh(shape, material), touch = new THREE.Mesh(shape, new THREE.MeshBasicMaterial({ color: idColor(id), depthTest: false, toneMapped: false }));
    touch.layers.set(pick.layer);
    touch.renderOrder = 5;
    mesh.castShadow = true;
    node.add(mesh);
    mesh.add(touch);
    bones.push(mesh);
    return mesh;
  };
  const lay = (mesh, end) => {
    const length = end.length();
    mesh.visible = length > 1e-5;
    if (!mesh.visible) return;
    mesh.quaternion.setFromUnitVectors(up, end.clone().divideScalar(length));
    mesh.scale.set(Math.min(thick, 0.25 * length), length, Math.min(thick, 0.25 * length));
  };
  const dark = new THREE.MeshStandardMaterial({ roughness: 0.6 });
  subject.joints = dark;
  subject.moving = [];
  nodes.forEach((node, n) => {
    const material = new THREE.MeshStandardMaterial({ color: bodyColor(n), roughness: 0.55 });
    data.nodes.forEach((other, k) => {
      if (other.parent === n) subject.moving.push([add(node, rod, material, n + 1), nodes[k]]);
    });
    if (data.nodes[n].tip) lay(add(node, rod, material, n + 1), vector(data.nodes[n].tip));
    if (data.nodes[n].joint) add(node, ball, dark, nodes.length + n + 1).scale.setScalar(1.15 * thick);
  });
  subject.bones = bones;
  subject.layBones = () => subject.moving.forEach(([mesh, child]) => lay(mesh, child.position));
}

const turbo = (x) => new Color().setHSL(0.02 + 0.36 * x, 0.72, 0.34 + 0.16 * x);  // red: doubtful, green: sure
function paintSurface() {
  const { main, painted, own, nodes } = subject, c = new Color();
  const owner = (id) => (id ? (id - 1) % nodes.length : -1), hovered = owner(state.hovered), chosen = owner(state.chosen);
  const bodies = nodes.map((_, n) => {
    const sure = data.nodes[n].confidence;
    if (state.paint === "confidence") return sure === null ? new Color("#b0b2b6") : turbo(Math.min(1, Math.max(0, sure)));
    return state.paint === "plain" ? new Color("#b9c2ce") : bodyColor(n);
  });
  for (let v = 0; v < main.length; v++) {
    if (state.paint === "own" && own) c.setRGB(own[3 * v] / 255, own[3 * v + 1] / 255, own[3 * v + 2] / 255, THREE.SRGBColorSpace);
    else c.copy(bodies[main[v]]);
    if (main[v] === hovered) c.multiplyScalar(0.72);
    else if (chosen >= 0 && main[v] !== chosen) c.lerp(paper, 0.6);
    c.toArray(painted.array, 3 * v);
  }
  painted.needsUpdate = true;
}

// --- cameras with their pictures ---
const rig = { group: new THREE.Group(), cameras: [] };
function makeCameras() {
  scene.add(rig.group);
  data.cameras.forEach((camera, c) => {
    const center = vector(camera.center), depth = 0.2 * center.distanceTo(vector(data.centers[0]).setY(data.middle));
    const corners = camera.corners.map((d) => vector(d));
    const quad = new THREE.BufferGeometry();
    quad.setAttribute("uv", new THREE.BufferAttribute(new Float32Array([0, 1, 1, 1, 1, 0, 0, 0]), 2));
    quad.setAttribute("position", new THREE.BufferAttribute(new Float32Array(12), 3));
    quad.setIndex([0, 2, 1, 0, 3, 2]);
    const picture = new THREE.Mesh(quad, new THREE.MeshBasicMaterial({ side: THREE.DoubleSide, toneMapped: false, transparent: true }));
    picture.frustumCulled = false;
    const segments = new THREE.LineSegmentsGeometry();
    const at = corners.map((d) => center.clone().addScaledVector(d, depth));
    const ends = [];
    at.forEach((p, k) => ends.push(center, p, p, at[(k + 1) % 4]));
    segments.setPositions(ends.flatMap((p) => p.toArray()));
    const wires = new THREE.LineSegments2(segments, new THREE.LineMaterial({ linewidth: 1.5 }));
    const label = addLabel(camera.doubtful ? `${camera.name} contradicts the others` : camera.name, camera.doubtful ? "camera doubtful" : "camera", () => (state.layers.cameras && state.through < 0 ? center : null));
    rig.group.add(wires, picture);
    const entry = { ...camera, center, corners, picture, wires, label, depth, loaded: new Map() };
    entry.place = (d) => {
      corners.forEach((direction, k) => center.clone().addScaledVector(direction, d).toArray(quad.attributes.position.array, 3 * k));
      quad.attributes.position.needsUpdate = true;
    };
    entry.place(depth);
    rig.cameras.push(entry);
  });
}
function showPictures() {
  const frame = frameNow();
  rig.group.visible = state.layers.cameras || state.through >= 0;
  rig.cameras.forEach((camera, c) => {
    const through = state.through === c;
    camera.wires.visible = state.layers.cameras && state.through < 0;
    camera.place(through ? 1.4 * camera.center.distanceTo(controls.target) : camera.depth);
    const number = data.pictured.reduce((best, f, k) => (Math.abs(f - frame) < Math.abs(data.pictured[best] - frame) ? k : best), 0);
    const source = camera.pictures[number];
    camera.picture.visible = Boolean(source) && (through || (state.layers.cameras && state.through < 0));
    camera.picture.material.opacity = through ? 1 : 0.96;
    if (!camera.picture.visible) return;
    if (!camera.loaded.has(number)) {
      const texture = new THREE.Texture(new Image());
      texture.colorSpace = THREE.SRGBColorSpace;
      texture.image.onload = () => { texture.needsUpdate = true; texture.ready = true; invalidate(); };
      texture.image.src = source;
      camera.loaded.set(number, texture);
    }
    const texture = camera.loaded.get(number);
    if (texture.ready && camera.picture.material.map !== texture) {
      camera.picture.material.map = texture;
      camera.picture.material.needsUpdate = true;
    }
    if (!camera.picture.material.map) camera.picture.visible = false;
  });
}

// --- trails and followed points ---
const TRAIL = 24;
const trails = { mesh: null, points: null };
function fatLines(width) {
  const mesh = new THREE.LineSegments2(new THREE.LineSegmentsGeometry(), new THREE.LineMaterial({ linewidth: width, vertexColors: true }));
  mesh.frustumCulled = false;
  mesh.visible = false;
  scene.add(mesh);
  return mesh;
}
let track = null;
function makeTrails() {
  trails.mesh = fatLines(2.2);
  trails.points = fatLines(1.3);
  if (!data.tracks) return;
  const raw = bytesOf(data.tracks.places), places = new Uint16Array(raw.buffer, 0, raw.byteLength / 2);
  const positions = new Float32Array(places.length);
  for (let i = 0; i < places.length; i++) positions[i] = places[i] === 65535 ? NaN : data.tracks.low[i % 3] + data.tracks.step * places[i];
  track = { count: data.tracks.count, positions };
}
const paper = new Color();
function drawTrails() {
  const t = state.time * data.fps, last = Math.floor(t + 1e-6), from = Math.max(0, last - TRAIL);
  const line = (mesh, shown, count, place, color) => {
    const positions = [], colors = [], c = new Color();
    if (shown) {
      for (let k = 0; k < count; k++) {
        const own = color(k);
        if (!own) continue;
        for (let f = from; f < last; f++) {
          const a = place(f, k), b = place(f + 1, k);
          if (!(a[0] === a[0] && b[0] === b[0])) continue;
          positions.push(...a, ...b);
          for (const g of [f, f + 1]) {
            c.copy(own);
            if (state.through < 0) c.lerp(paper, Math.min(1, (last - g) / TRAIL));
            colors.push(c.r, c.g, c.b);
          }
        }
      }
    }
    mesh.visible = positions.length > 0;
    if (!mesh.visible) return;
    mesh.geometry.dispose();
    mesh.geometry = new THREE.LineSegmentsGeometry();
    mesh.geometry.setPositions(positions);
    mesh.geometry.setColors(colors);
  };
  const { nodes, paths, places } = subject;
  const colors = nodes.map((_, n) => bodyColor(n));
  line(trails.mesh, state.layers.trails, places, (f, k) => paths.subarray(3 * (f * places + k), 3 * (f * places + k) + 3),
    (k) => (k < nodes.length ? (data.nodes[k].joint ? colors[k] : null) : data.nodes[k - nodes.length].tip ? colors[k - nodes.length] : null));
  const plain = new Color("#5f86ad");
  if (track) {
    line(trails.points, state.layers.points, track.count, (f, k) => track.positions.subarray(3 * (f * track.count + k), 3 * (f * track.count + k) + 3),
      (k) => (data.tracks.nodes[k] >= 0 ? colors[data.tracks.nodes[k]] : plain));
  }
}

// --- names ---
const labels = [];
const overlay = element("div", "labels");
function addLabel(text, kind, where) {
  const label = { where, dom: element("span", kind, text) };
  overlay.append(label.dom);
  labels.push(label);
  return label;
}
function makeLabels() {
  data.nodes.forEach((node, n) => {
    const tip = node.tip ? subject.nodes.length + n : n;
    const at = new Vector3(), end = new Vector3();
    addLabel(node.name, "body", () => {
      if (!state.layers.names) return null;
      subject.nodes[n].getWorldPosition(at);
      const child = data.nodes.findIndex((o) => o.parent === n);
      if (node.tip) subject.nodes[n].localToWorld(end.fromArray(node.tip));
      else if (child >= 0) subject.nodes[child].getWorldPosition(end);
      else return at;
      return at.lerp(end, 0.55);
    });
  });
  (data.keypoints || []).forEach((point, k) => {
    const places = point.places;
    const mark = new THREE.Mesh(new THREE.SphereGeometry(Math.max(point.radius * 0.5, 0.006 * data.diagonal), 16, 12), new THREE.MeshStandardMaterial({ color: 0xd6285a }));
    scene.add(mark);
    point.mark = mark;
    addLabel(point.name, "keypoint", () => {
      const p = places[frameNow()];
      mark.visible = Boolean(p);
      return p && state.layers.names ? mark.position : null;
    });
  });
}
function placeLabels() {
  const width = canvas.clientWidth, height = canvas.clientHeight, p = new Vector3();
  (data.keypoints || []).forEach((point) => { const q = point.places[frameNow()]; if (q) point.mark.position.fromArray(q); });
  const taken = [];
  labels.forEach((label) => {
    const place = label.where();
    let shown = Boolean(place);
    if (shown) {
      p.copy(place).project(eye);
      const x = ((p.x + 1) / 2) * width, y = ((1 - p.y) / 2) * height;
      shown = p.z < 1 && x > 0 && x < width && y > 0 && y < height && !taken.some(([a, b]) => Math.abs(a - x) < 46 && Math.abs(b - y) < 15);
      if (shown) {
        taken.push([x, y]);
        label.dom.style.transform = `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px) translate(-50%, -50%)`;
      }
    }
    label.dom.hidden = !shown;
  });
}

// --- what is pointed at ---
function touched(x, y) {
  const width = canvas.clientWidth, height = canvas.clientHeight;
  const before = eye.view ? { ...eye.view } : null;
  eye.setViewOffset(width, height, x, y, 1, 1);
  eye.layers.set(pick.layer);
  subject.touch.visible = state.surface !== "off";
  const keep = renderer.getClearAlpha();
  renderer.setRenderTarget(pick.target);
  renderer.setClearColor(0x000000, 0);
  renderer.clear();
  renderer.shadowMap.autoUpdate = false;
  renderer.render(scene, eye);
  renderer.shadowMap.autoUpdate = true;
  const pixel = new Uint8Array(4);
  renderer.readRenderTargetPixels(pick.target, 0, 0, 1, 1, pixel);
  renderer.setRenderTarget(null);
  renderer.setClearColor(0x000000, keep);
  eye.layers.set(0);
  if (before && before.enabled) eye.setViewOffset(before.fullWidth, before.fullHeight, before.offsetX, before.offsetY, before.width, before.height);
  else eye.clearViewOffset();
  return pixel[0] + 256 * pixel[1];
}

const tip = element("div", "tip"), card = element("div", "card");
tip.hidden = card.hidden = true;
function words(id) {
  const count = subject.nodes.length, n = (id - 1) % count, node = data.nodes[n], isJoint = id > count;
  const angle = subject.angles[frameNow() * count + n];
  const lines = [];
  const percent = (v) => `${Math.round(100 * v)} %`;
  if (isJoint) lines.push([node.joint.kind, `${data.nodes[node.parent].name} – ${node.name}`]);
  node.angles.forEach((a) => {
    const value = a.values[frameNow()], std = a.std && a.std[frameNow()];
    if (value !== null) lines.push([a.name, `${value.toFixed(1)}°${std ? ` ± ${(2 * std).toFixed(1)}` : ""}`]);
  });
  lines.push([node.parent >= 0 ? "turned since the first frame" : "turned", `${angle.toFixed(1)}°`]);
  if (isJoint && node.joint.std !== null) lines.push(["joint known to", `± ${node.joint.std.toFixed(1)} mm`]);
  if (node.confidence !== null) lines.push(["confidence", percent(node.confidence)]);
  return { title: isJoint ? node.joint.name : node.name, color: node.color, lines, n };
}
function fill(dom, told) {
  const head = element("b"), dot = element("i");
  dot.style.background = told.color;
  head.append(dot, told.title);
  dom.replaceChildren(head, ...told.lines.map(([what, value]) => {
    const row = element("div");
    row.append(element("span", "", what), element("em", "", value));
    return row;
  }));
}
function curve(n) {
  const T = data.frames.length, N = subject.nodes.length, svg = (tag) => document.createElementNS("http://www.w3.org/2000/svg", tag);
  const told = data.nodes[n].angles[0];  // flexion, or the turn about a joint's own axis
  const values = told ? told.values : Array.from({ length: T }, (_, t) => subject.angles[t * N + n]);
  const known = values.filter((v) => v !== null), low = Math.min(0, ...known), high = Math.max(10, ...known);
  const made = svg("svg"), line = svg("polyline"), now = svg("line"), band = svg("polygon");
  made.setAttribute("viewBox", "0 0 200 46");
  made.setAttribute("preserveAspectRatio", "none");
  const x = (t) => (200 * t) / Math.max(1, T - 1);
  const y = (v) => (44 - (40 * (v - low)) / (high - low)).toFixed(1);
  const at = (t, v) => (v === null ? [] : [`${x(t).toFixed(1)},${y(v)}`]);
  line.setAttribute("points", values.flatMap((v, t) => at(t, v)).join(" "));
  line.setAttribute("stroke", data.nodes[n].color);
  if (told && told.std) {
    const edge = (sign) => values.flatMap((v, t) => (v === null || told.std[t] === null ? [] : at(t, v + sign * 2 * told.std[t])));
    band.setAttribute("points", [...edge(1), ...edge(-1).reverse()].join(" "));
    band.setAttribute("fill", data.nodes[n].color);
    band.setAttribute("opacity", "0.25");
    made.append(band);
  }
  now.setAttribute("x1", x(frameNow())); now.setAttribute("x2", x(frameNow())); now.setAttribute("y1", 0); now.setAttribute("y2", 46);
  now.setAttribute("class", "now");
  made.append(line, now);
  made.onclick = (event) => {
    const r = made.getBoundingClientRect();
    go(((event.clientX - r.left) / r.width) * duration);
  };
  return made;
}
function showCard() {
  card.hidden = !state.chosen;
  if (!state.chosen) return;
  const told = words(state.chosen);
  fill(card, told);
  if (data.frames.length > 1) card.append(curve(told.n));
  const close = element("button", "close", "×");
  close.setAttribute("aria-label", "Close");
  close.onclick = () => { state.chosen = 0; paintSurface(); invalidate(); };
  card.append(close);
}

// --- drawing, only when something has changed ---
let wanted = false, before = 0;
function invalidate() {
  if (wanted) return;
  wanted = true;
  requestAnimationFrame(draw);
}
let lastCenter = null;
function draw(now) {
  wanted = false;
  if (!subject) return;
  if (state.playing) {
    state.time += Math.min(0.1, (now - before) / 1000) * state.speed;
    if (state.time > duration) state.time = duration > 0 ? state.time % duration : 0;
    before = now;
    wanted = false;
    invalidate();
  }
  setTime(state.time);
  subject.layBones();
  follow();
  const { surface } = subject, through = state.through >= 0;
  surface.visible = state.surface !== "off";
  const glass = state.surface === "glass" || through;
  if (surface.material !== (glass ? clear : solid)) surface.material = glass ? clear : solid;
  surface.renderOrder = glass ? 2 : 0;
  clear.opacity = through ? 0.5 : 0.42;
  behind.visible = surface.visible && glass;
  subject.bones.forEach((mesh) => { if (!mesh.userData.flat) mesh.material.visible = true; });
  subject.bones.forEach((mesh) => { mesh.layers.set(state.layers.skeleton ? 0 : 31); mesh.children.forEach((t) => t.layers.set(state.layers.skeleton && (glass || !surface.visible) ? pick.layer : 31)); });
  ground.visible = state.layers.floor && !through;
  drawTrails();
  showPictures();
  const center = subjectCenter();
  sun.target.position.copy(center);
  sun.position.copy(center).add(new Vector3(1.1, 3.2, 1.5).multiplyScalar(reach));
  renderer.render(scene, eye);
  placeLabels();
  slider.value = String(state.time * data.fps);
  slider.style.setProperty("--done", `${(100 * state.time) / Math.max(duration, 1e-9)}%`);
  readout.textContent = `${state.time.toFixed(2)} s · frame ${data.frames[frameNow()]}`;
  showCard();
  box.dataset.frame = String(frameNow());
}
const subjectCenter = () => {
  const moving = data.centers;
  return vector(moving.length > 1 ? moving[frameNow()] : moving[0]).setY(data.middle);
};
function follow() {
  const center = subjectCenter();
  if (lastCenter && state.through < 0) {
    const by = center.clone().sub(lastCenter);
    eye.position.add(by);
    controls.target.add(by);
  }
  lastCenter = center;
  ground.position.set(Math.round(center.x / data.step) * data.step, data.floor, Math.round(center.z / data.step) * data.step);
}
function frameSubject() {
  const flat = vector(data.view), forward = flat.clone().negate().normalize(), right = forward.clone().cross(new Vector3(0, 1, 0)).normalize();
  const head = right.clone().cross(forward), center = subjectCenter(), offset = vector(data.centers[0]);
  const half = Math.tan((eye.fov * Math.PI) / 360), wide = half * eye.aspect;
  const tall = [Infinity, -Infinity], q = new Vector3();
  const shown = data.points.map((p) => vector(p).add(offset).sub(vector(data.centers[0])).add(vector(data.centers[frameNow() < data.centers.length ? frameNow() : 0])));
  if (state.layers.cameras) rig.cameras.forEach((c) => { shown.push(c.center); c.corners.forEach((d) => shown.push(c.center.clone().addScaledVector(d, c.depth))); });
  const low = new Vector3(Infinity, Infinity, Infinity), high = low.clone().negate();
  shown.forEach((p) => { low.min(p); high.max(p); });
  const target = low.add(high).multiplyScalar(0.5);
  let distance = 0.1;
  shown.forEach((p) => {
    q.copy(p).sub(target);
    const x = Math.abs(q.dot(right)), y = Math.abs(q.dot(head)), z = -q.dot(forward);
    distance = Math.max(distance, x / (0.87 * wide) + z, y / (0.82 * half) + z);
  });
  controls.target.copy(target);
  eye.position.copy(target).addScaledVector(forward, -distance);
  eye.up.set(0, 1, 0);
  controls.update();
}
function look(through) {
  state.through = through;
  controls.enabled = through < 0;
  if (through < 0) {
    eye.fov = 28;
    resize();
    frameSubject();
  } else {
    const camera = rig.cameras[through];
    lastCenter = null;
    eye.up.copy(vector(camera.up));
    eye.position.copy(camera.center);
    eye.lookAt(camera.center.clone().add(vector(camera.forward)));
    resize();
  }
  invalidate();
}
function resize() {
  const width = stage.clientWidth, height = stage.clientHeight;
  if (!width || !height) return;
  renderer.setSize(width, height, false);
  eye.aspect = width / height;
  if (state.through >= 0) {
    const camera = rig.cameras[state.through];
    eye.fov = (2 * Math.atan(Math.max(camera.half[1], camera.half[0] / eye.aspect)) * 180) / Math.PI;
  }
  eye.updateProjectionMatrix();
  invalidate();
}
function go(seconds) {
  state.time = Math.min(Math.max(seconds, 0), duration);
  invalidate();
}
function play(on) {
  state.playing = on && duration > 0;
  before = performance.now();
  playButton.classList.toggle("on", state.playing);
  playButton.setAttribute("aria-label", state.playing ? "Stop" : "Play");
  invalidate();
}

// --- the page's elements ---
const stage = element("div", "stage"), bar = element("div", "bar"), tools = element("div", "tools");
const playButton = element("button", "play"), slider = element("input"), readout = element("output");
const chip = (text, hint, on, act) => {
  const made = element("button", "chip", text);
  made.type = "button";
  made.title = hint;
  const set = (value) => { made.setAttribute("aria-pressed", String(value)); };
  set(on);
  made.onclick = () => { const value = made.getAttribute("aria-pressed") !== "true"; set(value); act(value); invalidate(); };
  return made;
};
const choice = (label, options, chosen, act) => {
  const made = element("select");
  made.setAttribute("aria-label", label);
  made.title = label;
  options.forEach(([value, text]) => {
    const option = element("option", "", text);
    option.value = value;
    made.append(option);
  });
  made.value = chosen;
  made.onchange = () => { act(made.value); invalidate(); };
  return made;
};
const layer = (name, text, hint) => chip(text, hint, state.layers[name], (on) => { state.layers[name] = on; });
function build() {
  playButton.type = "button";
  playButton.setAttribute("aria-label", "Play");
  playButton.onclick = () => play(!state.playing);
  Object.assign(slider, { type: "range", min: "0", max: String(data.frames.length - 1), step: "any", value: "0" });
  slider.setAttribute("aria-label", "Time");
  slider.oninput = () => { play(false); go(Math.round(Number(slider.value)) / data.fps); };
  const surface = element("div", "segments");
  [["solid", "Solid"], ["glass", "Glass"], ["off", "Off"]].forEach(([value, text]) => {
    const made = element("button", "", text);
    made.type = "button";
    made.title = `Surface: ${text.toLowerCase()}`;
    made.setAttribute("aria-pressed", String(state.surface === value));
    made.onclick = () => {
      state.surface = value;
      surface.querySelectorAll("button").forEach((b) => b.setAttribute("aria-pressed", String(b === made)));
      invalidate();
    };
    surface.append(made);
  });
  tools.append(element("span", "caption", "Surface"), surface);
  const paints = [["bodies", "Bodies"], ...(data.colors ? [["own", "Own colours"]] : []), ["plain", "One colour"]];
  if (data.nodes.some((n) => n.confidence !== null)) paints.push(["confidence", "Confidence"]);
  tools.append(choice("Colours of the surface", paints, "bodies", (value) => { state.paint = value; paintSurface(); }));
  tools.append(layer("skeleton", "Skeleton", "Bones and joints"), layer("trails", "Trails", "Ways of joints and ends"));
  if (data.tracks) tools.append(layer("points", "Points", "Points of the surface that were followed"));
  tools.append(layer("names", "Names", "Names of bodies and key-points"));
  if (data.cameras.length) {
    tools.append(chip("Cameras", "Cameras with their pictures", false, (on) => {
      state.layers.cameras = on;
      if (state.through < 0) frameSubject();
    }));
    const views = [["-1", "Free view"], ...data.cameras.map((c, k) => [String(k), `Through ${c.name}`])];
    tools.append(choice("Look through a camera", views, "-1", (value) => look(Number(value))));
  }
  const speed = choice("Speed", [["1", "1×"], ["0.5", "½×"], ["0.25", "¼×"], ["0.1", "⅒×"]], "1", (value) => { state.speed = Number(value); });
  const icon = (name, path) => {
    const made = element("button", `icon ${name}`), drawn = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    const line = document.createElementNS("http://www.w3.org/2000/svg", "path");
    made.type = "button";
    drawn.setAttribute("viewBox", "0 0 20 20");
    line.setAttribute("d", path);
    drawn.append(line);
    made.append(drawn);
    return made;
  };
  const home = icon("home", "M3 10 10 3.5 17 10M5 8.5V16.5H15V8.5"), full = icon("full", "M3 7V3H7M13 3H17V7M17 13V17H13M7 17H3V13");
  home.title = "Whole subject"; full.title = "Full screen";
  home.setAttribute("aria-label", home.title); full.setAttribute("aria-label", full.title);
  home.onclick = () => { if (state.through < 0) frameSubject(); invalidate(); };
  full.onclick = () => { if (document.fullscreenElement) document.exitFullscreen(); else box.requestFullscreen?.(); };
  if (!box.requestFullscreen) full.hidden = true;
  bar.append(playButton, slider, readout, speed, home, full);
  stage.append(canvas, overlay, tip, card);
  if (duration <= 0) bar.hidden = true;
  box.prepend(stage, bar, tools);
}
let pressed = null, asked = null;
function listen() {
  canvas.addEventListener("pointermove", (event) => {
    if (event.pointerType !== "mouse" || event.buttons) { tip.hidden = true; return; }
    asked = event;
    requestAnimationFrame(() => {
      if (asked !== event) return;
      const r = canvas.getBoundingClientRect(), x = event.clientX - r.left, y = event.clientY - r.top;
      const id = touched(x, y);
      if (id !== state.hovered) { state.hovered = id; paintSurface(); invalidate(); }
      tip.hidden = !id;
      if (!id) return;
      fill(tip, words(id));
      tip.style.transform = `translate(${Math.min(x + 14, r.width - tip.offsetWidth - 8)}px, ${Math.min(y + 14, r.height - tip.offsetHeight - 8)}px)`;
    });
  });
  canvas.addEventListener("pointerleave", () => {
    asked = null;
    tip.hidden = true;
    controls.enableZoom = Boolean(document.fullscreenElement);
    if (state.hovered) { state.hovered = 0; paintSurface(); invalidate(); }
  });
  canvas.addEventListener("pointerdown", (event) => { pressed = [event.clientX, event.clientY]; controls.enableZoom = true; });
  canvas.addEventListener("pointerup", (event) => {
    if (!pressed || Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) > 5) return;
    const r = canvas.getBoundingClientRect();
    state.chosen = touched(event.clientX - r.left, event.clientY - r.top);
    box.dataset.chosen = state.chosen ? words(state.chosen).title : "";
    paintSurface();
    invalidate();
  });
  box.addEventListener("keydown", (event) => {
    if (event.target.tagName === "SELECT" || (event.target.tagName === "BUTTON" && event.key === " ")) return;
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (event.key === " ") play(!state.playing);
    else if (step && event.target !== slider) { play(false); go((frameNow() + step) / data.fps); }
    else if (event.key === "Escape") { state.chosen = 0; paintSurface(); invalidate(); }
    else return;
    event.preventDefault();
  });
  controls.addEventListener("change", invalidate);
  new ResizeObserver(resize).observe(stage);
  document.addEventListener("fullscreenchange", () => { controls.enableZoom = Boolean(document.fullscreenElement); resize(); });
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  dark.addEventListener("change", () => { colors(); invalidate(); });
  canvas.addEventListener("webglcontextlost", () => box.classList.remove("alive"));
}
function colors() {
  const style = getComputedStyle(box), value = (name) => style.getPropertyValue(name).trim();
  makeGrid(value("--grid"));
  paper.set(value("--stage"));
  subject.joints.color.set(value("--joint"));
  shade.material.opacity = Number(value("--shade")) || 0.2;
  rig.cameras.forEach((camera) => camera.wires.material.color.set(value(camera.doubtful ? "--warn" : "--accent")));
}

new THREE.GLTFLoader().parse(bytesOf(byId("turntable-glb").textContent.trim()).buffer, "", (gltf) => {
  try {
    begin(gltf);
    build();
    box.classList.add("alive");
    makeCameras();
    makeTrails();
    makeLabels();
    colors();
    paintSurface();
    listen();
    resize();
    frameSubject();
    invalidate();
  } catch (error) {
    box.classList.remove("alive");
    throw error;
  }
}, (error) => { throw error; });
})();
