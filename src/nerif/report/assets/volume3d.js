"use strict";
// The field in three dimensions: rays cast through a 3-D texture, with box, slices, cameras and backgrounds as lines.
// Depth of the isosurface is written, so that lines behind it are hidden.

const RAY_VERTEX = `
out vec3 place;
void main() { place = (modelMatrix * vec4(position, 1.0)).xyz; gl_Position = projectionMatrix * viewMatrix * vec4(place, 1.0); }`;

const RAY_FRAGMENT = `
precision highp float;
precision highp sampler3D;
in vec3 place;
out vec4 colour;
uniform sampler3D field;
uniform sampler2D table;
uniform vec3 lower, upper;
uniform float level, ambient, opacity, steps;
uniform bool surface, volume;
uniform mat4 toClip;

float sampleField(vec3 p) { return texture(field, (p - lower) / (upper - lower)).r; }
vec3 tableAt(float t) { return texture(table, vec2(clamp(t, 0.0, 1.0) * 255.0 / 256.0 + 0.5 / 256.0, 0.5)).rgb; }
vec3 slope(vec3 p, float h) {
  vec2 d = vec2(h, 0.0);
  return vec3(sampleField(p + d.xyy) - sampleField(p - d.xyy), sampleField(p + d.yxy) - sampleField(p - d.yxy), sampleField(p + d.yyx) - sampleField(p - d.yyx));
}
void main() {
  vec3 eye = cameraPosition, ray = normalize(place - eye);
  vec3 a = (lower - eye) / ray, b = (upper - eye) / ray;
  vec3 first = min(a, b), last = max(a, b);
  float near = max(max(max(first.x, first.y), first.z), 0.0), far = min(min(last.x, last.y), last.z);
  if (far <= near) discard;
  float whole = length(upper - lower), h = whole / steps;
  // starting points differ from pixel to pixel, so that the steps do not show as rings
  float t = near + h * fract(sin(dot(gl_FragCoord.xy, vec2(12.9898, 78.233))) * 43758.5453) * 0.9;
  vec4 sum = vec4(0.0);
  float before = sampleField(eye + near * ray), depth = 1.0, tBefore = near;
  float scale = max(ambient, 1.0 - ambient);
  for (int i = 0; i < 2000; i++) {
    if (t >= far || sum.a > 0.985) break;
    vec3 p = eye + t * ray;
    float value = sampleField(p);
    if (surface && (value - level) * (before - level) < 0.0) {
      float low = tBefore, high = t;
      for (int k = 0; k < 6; k++) {
        float mid = 0.5 * (low + high);
        if ((sampleField(eye + mid * ray) - level) * (before - level) < 0.0) high = mid; else low = mid;
      }
      vec3 hit = eye + 0.5 * (low + high) * ray;
      vec3 g = slope(hit, whole / 170.0);
      float size = length(g);
      vec3 normal = size > 1e-9 ? g / size : -ray;
      if (dot(normal, ray) > 0.0) normal = -normal;
      vec3 light = normalize(-ray + vec3(-0.35, 0.2, 0.55));
      float diffuse = max(dot(normal, light), 0.0), rim = pow(1.0 - abs(dot(normal, ray)), 3.0);
      float gloss = pow(max(dot(normal, normalize(light - ray)), 0.0), 40.0);
      vec3 body = volume ? tableAt(level) : vec3(0.96, 0.66, 0.25);
      vec3 lit = body * (0.42 + 0.62 * diffuse) + 0.20 * gloss - 0.10 * rim;
      float cover = volume ? 0.75 : 1.0;
      sum.rgb += (1.0 - sum.a) * cover * clamp(lit, 0.0, 1.0);
      sum.a += (1.0 - sum.a) * cover;
      if (depth == 1.0) { vec4 clip = toClip * vec4(hit, 1.0); depth = clip.z / clip.w * 0.5 + 0.5; }
      if (!volume) break;
    }
    if (volume) {
      float strength = abs(value - ambient) / scale;
      float alpha = 1.0 - exp(-opacity * 110.0 * pow(strength, 1.6) * h / whole);
      sum.rgb += (1.0 - sum.a) * alpha * tableAt(value);
      sum.a += (1.0 - sum.a) * alpha;
    }
    before = value; tBefore = t;
    t += h;
  }
  if (sum.a < 0.003) discard;
  colour = sum;
  gl_FragDepth = depth;
}`;

const BODY_FRAGMENT = `
precision highp float;
in vec3 place;
out vec4 colour;
void main() {
  vec3 ray = normalize(place - cameraPosition), normal = normalize(cross(dFdx(place), dFdy(place)));
  if (dot(normal, ray) > 0.0) normal = -normal;
  float diffuse = max(dot(normal, normalize(-ray + vec3(-0.35, 0.2, 0.55))), 0.0);
  colour = vec4(vec3(0.50, 0.54, 0.58) * (0.45 + 0.6 * diffuse), 1.0);
}`;

function makeSpace(scene, canvas) {
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: false, preserveDrawingBuffer: true });
  renderer.setClearColor(0xffffff, 1);
  const world = new THREE.Scene();
  const eye = new THREE.PerspectiveCamera(28, 1, 1, 1e5);
  eye.up.set(0, 0, 1);
  const lower = new THREE.Vector3(...scene.lower), upper = new THREE.Vector3(...scene.upper);
  const middle = lower.clone().add(upper).multiplyScalar(0.5), size = upper.clone().sub(lower);
  const reach = size.length();
  const [nz, ny, nx] = scene.shape;

  const texture = new THREE.Data3DTexture(new Uint16Array(nx * ny * nz), nx, ny, nz);
  texture.format = THREE.RedFormat; texture.type = THREE.HalfFloatType;
  texture.minFilter = texture.magFilter = THREE.LinearFilter; texture.unpackAlignment = 1;
  const table = new THREE.DataTexture(new Uint8Array(1024), 256, 1, THREE.RGBAFormat, THREE.UnsignedByteType);
  table.minFilter = table.magFilter = THREE.LinearFilter;
  const uniforms = {
    field: { value: texture }, table: { value: table }, lower: { value: lower }, upper: { value: upper },
    level: { value: 0.5 }, ambient: { value: 0 }, opacity: { value: 0.35 }, steps: { value: 220 },
    surface: { value: true }, volume: { value: false }, toClip: { value: new THREE.Matrix4() },
  };
  const rays = new THREE.Mesh(
    new THREE.BoxGeometry(size.x, size.y, size.z),
    new THREE.ShaderMaterial({ vertexShader: RAY_VERTEX, fragmentShader: RAY_FRAGMENT, uniforms, glslVersion: THREE.GLSL3, side: THREE.BackSide, transparent: true, premultipliedAlpha: true }),
  );
  rays.position.copy(middle);
  world.add(rays);
  for (const body of scene.bodies) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.Float32BufferAttribute(body.faces.flatMap((i) => body.vertices.slice(3 * i, 3 * i + 3)), 3));
    world.add(new THREE.Mesh(geometry, new THREE.ShaderMaterial({ vertexShader: RAY_VERTEX, fragmentShader: BODY_FRAGMENT, glslVersion: THREE.GLSL3, side: 2 })));  // 2: THREE.DoubleSide
  }

  function lines(points, colour, opacity, dashed) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.Float32BufferAttribute(points.flat(), 3));
    const look = { color: colour, transparent: true, opacity };
    const material = dashed ? new THREE.LineDashedMaterial({ ...look, dashSize: reach / 12, gapSize: reach / 20 }) : new THREE.LineBasicMaterial(look);
    const segments = new THREE.LineSegments(geometry, material);
    if (dashed) segments.computeLineDistances();
    segments.renderOrder = 1;
    return segments;
  }
  const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((i) => [0, 1, 2].map((a) => ((i >> a) & 1 ? upper : lower).getComponent(a)));
  const edges = [];
  for (let i = 0; i < 8; i++) for (let a = 0; a < 3; a++) if (!((i >> a) & 1)) edges.push(corners[i], corners[i | (1 << a)]);
  world.add(lines(edges, 0x16202b, 0.8));

  function label(text, at, height, colour) {
    const image = document.createElement("canvas"), ratio = 4;
    let pen = image.getContext("2d");
    pen.font = 14 * ratio + "px system-ui, sans-serif";
    image.width = Math.ceil(pen.measureText(text).width) + 4 * ratio; image.height = 20 * ratio;
    pen = image.getContext("2d");
    pen.font = 14 * ratio + "px system-ui, sans-serif"; pen.fillStyle = colour; pen.textBaseline = "middle";
    pen.fillText(text, 2 * ratio, 10 * ratio);
    const map = new THREE.CanvasTexture(image);
    map.minFilter = THREE.LinearFilter; map.colorSpace = THREE.SRGBColorSpace;
    const sprite = new THREE.Sprite(new THREE.SpriteMaterial({ map, sizeAttenuation: false, depthTest: false, transparent: true }));
    sprite.position.set(...at);
    sprite.scale.set((height * image.width) / image.height, height, 1);
    sprite.renderOrder = 2;
    return sprite;
  }
  // names of the axes at the lower edges of the box; from afar they would only hide it
  const names = new THREE.Group();
  world.add(names);
  const off = 0.06 * reach;
  for (const [name, at] of [["x", [middle.x, lower.y - off, lower.z - off]], ["y", [upper.x + off, middle.y, lower.z - off]], ["z", [lower.x - off, lower.y - off, middle.z]]])
    names.add(label(name + " [mm]", at, 0.022, "#16202b"));
  for (const [at, text] of [[[lower.x, lower.y - off, lower.z - off], lower.x], [[upper.x, lower.y - off, lower.z - off], upper.x], [[upper.x + off, lower.y, lower.z - off], lower.y], [[upper.x + off, upper.y, lower.z - off], upper.y], [[lower.x - off, lower.y - off, lower.z], lower.z], [[lower.x - off, lower.y - off, upper.z], upper.z]])
    names.add(label(plain(text), at, 0.02, "#46535f"));

  const rig = new THREE.Group();
  let rigReach = reach;
  for (const camera of scene.cameras) {
    const colour = camera.withheld ? 0xb85c00 : 0x0b5a9c, mean = (four) => [0, 1, 2].map((a) => four.reduce((s, p) => s + p[a], 0) / 4);
    const c = mean(camera.starts), centre = mean(camera.ends);
    const away = middle.distanceTo(new THREE.Vector3(...c));
    rigReach = Math.max(rigReach, away);
    const tips = camera.directions.map((d, k) => d.map((v, a) => camera.starts[k][a] + 0.16 * away * v));
    const body = [], sight = [];
    for (let k = 0; k < 4; k++) {
      body.push(camera.starts[k], tips[k], tips[k], tips[(k + 1) % 4], camera.starts[k], camera.starts[(k + 1) % 4]);
      if (camera.background) sight.push(camera.ends[k], camera.ends[(k + 1) % 4]);
      rigReach = Math.max(rigReach, middle.distanceTo(new THREE.Vector3(...camera.ends[k])));
    }
    rig.add(lines(body, colour, 0.95, camera.withheld), lines(sight, colour, 0.7, camera.withheld), lines([c, centre], colour, 0.22, false));
    const beyond = c.map((v, a) => v + 0.07 * (v - middle.getComponent(a)));
    rig.add(label(camera.name, beyond, 0.021, camera.withheld ? "#8a4b00" : "#0b5a9c"));
  }
  world.add(rig);

  const planes = new THREE.Group();
  world.add(planes);

  const controls = new THREE.OrbitControls(eye, canvas);
  controls.enableDamping = false; controls.zoomSpeed = 1.2;

  // wheel and finger scroll the page unless this view is in use, that is, has the focus: a click or a tap gives it,
  // Escape, a second tap or a touch elsewhere takes it away
  const stage = canvas.parentElement, inUse = () => document.activeElement === canvas;
  let pointer = "mouse";
  stage.addEventListener("pointerdown", (event) => {
    pointer = event.pointerType;
    if (pointer !== "touch") canvas.focus();
    else if (!inUse()) event.stopPropagation();
  }, { capture: true });
  canvas.addEventListener("mousedown", (event) => { if (pointer === "touch") event.preventDefault(); });  // the tap decides
  canvas.addEventListener("click", () => { if (pointer === "touch") inUse() ? canvas.blur() : canvas.focus({ preventScroll: true }); });
  document.addEventListener("pointerdown", (event) => { if (!stage.contains(event.target)) canvas.blur(); });
  stage.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && !inUse()) event.stopPropagation();
  }, { capture: true });
  canvas.style.touchAction = "";  // report.css says who has the finger

  let pending = 0, coarse = false, settle = 0, slow = 0;
  let full = Math.min(window.devicePixelRatio || 1, 2);
  function resize() {
    const box = canvas.parentElement.getBoundingClientRect();
    renderer.setPixelRatio(coarse ? full / (slow > 60 ? 3 : slow > 25 ? 2 : 1) : full);
    renderer.setSize(box.width, box.height, false);
    eye.aspect = box.width / Math.max(box.height, 1);
    eye.updateProjectionMatrix();
  }
  function draw() {
    pending = 0; dirty = false;
    uniforms.steps.value = Math.min(240, 40 + 2.2 * Math.max(nx, ny, nz)) / (coarse && slow > 25 ? 2 : 1);
    names.visible = eye.position.distanceTo(middle) < 9 * reach;
    eye.updateMatrixWorld();
    uniforms.toClip.value.multiplyMatrices(eye.projectionMatrix, eye.matrixWorldInverse);
    const start = performance.now();
    renderer.render(world, eye);
    if (coarse) return;
    renderer.getContext().finish();
    slow = performance.now() - start;
    if (slow > 700 && full > 0.5) full = Math.max(0.5, full * 0.7);  // no GPU: a softer image rather than a wait
  }
  // drawn only while visible: without a GPU every image costs the slices their time
  let visible = false, dirty = false;
  function request() {
    dirty = true;
    if (visible && !pending) pending = requestAnimationFrame(draw);
  }
  new IntersectionObserver((entries) => {
    visible = entries[entries.length - 1].isIntersecting;
    if (visible && dirty) request();
  }, { rootMargin: "80px" }).observe(canvas);
  // while something moves, fewer pixels on slow machines; sharp again once it rests
  function moving() {
    if (!coarse) { coarse = true; resize(); }
    clearTimeout(settle);
    settle = setTimeout(() => { coarse = false; resize(); request(); }, 250);
    request();
  }
  controls.addEventListener("change", moving);
  window.addEventListener("resize", () => { resize(); request(); });

  function look(direction, distance) {
    controls.target.copy(middle);
    eye.position.copy(middle).add(new THREE.Vector3(...direction).normalize().multiplyScalar(distance));
    eye.near = distance / 200; eye.far = distance + 4 * rigReach + 4 * reach;
    eye.updateProjectionMatrix();
    controls.update();
    moving();
  }
  const oblique = [0.62, -1, 0.42];
  const near = () => (1.2 * reach) / (2 * Math.tan((eye.fov * Math.PI) / 360)) / Math.min(1, eye.aspect);
  const far = () => (1.6 * rigReach) / (2 * Math.tan((eye.fov * Math.PI) / 360)) / Math.min(1, eye.aspect);
  canvas.addEventListener("keydown", (event) => {
    const turn = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    const zoom = { "+": 0.9, "=": 0.9, "-": 1 / 0.9 }[event.key];
    if (event.key === "Escape") canvas.blur();
    if (!turn && !zoom) return;
    event.preventDefault();
    const arm = eye.position.clone().sub(controls.target);
    let r = arm.length(), polar = Math.acos(arm.z / r), azimuth = Math.atan2(arm.y, arm.x);
    if (zoom) r *= zoom;
    else { azimuth += turn[0] * 0.1; polar = Math.min(3.1, Math.max(0.04, polar + turn[1] * 0.1)); }
    eye.position.copy(controls.target).add(new THREE.Vector3(r * Math.sin(polar) * Math.cos(azimuth), r * Math.sin(polar) * Math.sin(azimuth), r * Math.cos(polar)));
    controls.update();
    moving();
  });

  resize();
  look(oblique, near());
  let range = [0, 1];
  return {
    show({ values, low, high, ambient, table: colours }) {
      range = [low, high];
      const span = high - low || 1, rest = (ambient - low) / span, half = texture.image.data;
      const empty = THREE.DataUtils.toHalfFloat(Math.min(1, Math.max(0, rest)));
      let last = empty;  // a masked voxel takes its neighbour's value, not to have a surface of its own
      for (let i = 0; i < values.length; i++) {
        const t = (values[i] - low) / span;
        if (i % nx === 0) last = empty;
        if (!Number.isNaN(t)) last = THREE.DataUtils.toHalfFloat(t < 0 ? 0 : t > 1 ? 1 : t);
        half[i] = last;
      }
      texture.needsUpdate = true;
      for (let i = 0; i < 256; i++) for (let k = 0; k < 4; k++) table.image.data[4 * i + k] = k < 3 ? colours[3 * i + k] : 255;
      table.needsUpdate = true;
      uniforms.ambient.value = Math.min(1, Math.max(0, rest));
      moving();
    },
    level(value) { uniforms.level.value = (value - range[0]) / (range[1] - range[0] || 1); moving(); },
    opacity(value) { uniforms.opacity.value = value; moving(); },
    mode(name) { uniforms.surface.value = name !== "volume"; uniforms.volume.value = name !== "surface"; moving(); },
    cameras(on) { rig.visible = on; request(); },
    planes(places) {
      planes.clear();
      for (const [axis, value] of places) {
        const ring = [0, 1, 2, 3].map((i) => [0, 1, 2].map((a) => {
          if (a === axis) return value;
          const others = [0, 1, 2].filter((b) => b !== axis);
          const far = a === others[0] ? i === 1 || i === 2 : i >= 2;
          return (far ? upper : lower).getComponent(a);
        }));
        planes.add(lines([0, 1, 2, 3].flatMap((i) => [ring[i], ring[(i + 1) % 4]]), [0xc0392b, 0x1e7d34, 0x1f4fbf][axis], 0.75));
      }
      moving();
    },
    look: { flow: () => look(oblique, near()), rig: () => look([0.5, -1, 0.75], far()), top: () => look([0, -0.001, 1], near()), front: () => look([0, -1, 0], near()) },
    image() { coarse = false; resize(); draw(); return canvas.toDataURL("image/png"); },
  };
}
