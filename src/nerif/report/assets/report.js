"use strict";
// The page: unpacks the arrays, and updates slices, colour bar and the 3-D view by the switches.

const MASKED = 65535;

async function unpack(name, about, count) {
  const text = document.getElementById("array-" + name).textContent.trim();
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const data = new Uint8Array(await new Response(stream).arrayBuffer());
  const values = new Float32Array(count);
  let code = 0;
  for (let i = 0; i < count; i++) {
    code = (code + data[i] + (data[count + i] << 8)) & 65535;
    values[i] = code === MASKED ? NaN : about.low + code * about.step;
  }
  return values;
}

// the quantity of an index excess; NaN where the relation breaks down
function quantityOf(relation, x) {
  if (relation.kind === "table") {
    const t = (x - relation.low) / relation.step, i = Math.min(Math.max(Math.floor(t), 0), relation.values.length - 2);
    const a = relation.values[i], b = relation.values[i + 1];
    return a === null || b === null ? NaN : a + (b - a) * (t - i);
  }
  const shifted = x + relation.offset;
  const q = relation.kind === "linear" ? shifted * relation.factor : relation.factor / shifted;
  if (relation.lower !== null && !(shifted > 0)) return NaN;
  if (relation.upper !== null && !(q >= relation.lower && q <= relation.upper)) return NaN;
  return q;
}

// the 0.1 and 99.9 % quantiles: a few outliers must not take all the colours
function limits(values, low, high) {
  const bins = new Uint32Array(4096), scale = 4095 / (high - low || 1);
  let count = 0;
  for (let i = 0; i < values.length; i++) if (!Number.isNaN(values[i])) { bins[Math.floor((values[i] - low) * scale)]++; count++; }
  const edge = count / 1000;
  let first = 0, last = 4095;
  for (let sum = bins[0]; sum < edge && first < 4095; sum += bins[++first]);
  for (let sum = bins[4095]; sum < edge && last > 0; sum += bins[--last]);
  return [low + first / scale, low + (last + 1) / scale];
}

function superscript(n) { return String(n).replace(/[-0-9]/g, (c) => "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"["-0123456789".indexOf(c)]); }

async function main() {
  for (const input of document.querySelectorAll("input[name=view]"))
    input.addEventListener("change", () => {
      for (const view of document.querySelectorAll(".view")) view.hidden = view.dataset.view !== input.value;
    });

  const element = document.getElementById("scene");
  if (!element) return;
  const scene = JSON.parse(element.textContent);
  const count = scene.shape[0] * scene.shape[1] * scene.shape[2];
  const names = Object.keys(scene.arrays);
  const unpacked = await Promise.all(names.map((name) => unpack(name, scene.arrays[name], count)));
  const arrays = Object.fromEntries(names.map((name, i) => [name, unpacked[i]]));
  const switches = { quantity: Object.keys(scene.quantities)[0], variant: "value" };
  const cache = {};

  function display(choice = switches) {
    const key = choice.quantity + " " + choice.variant;
    if (cache[key]) return cache[key];
    const q = scene.quantities[choice.quantity], r = q.relation, v = arrays.value, e = arrays.error;
    const values = new Float32Array(count);
    const packed = arrays[choice.quantity + "_" + choice.variant];  // not a linear function of the excess, or masked
    if (packed) values.set(packed);
    else if (choice.variant === "std") for (let i = 0; i < count; i++) values[i] = arrays.std[i] * r.factor;
    else if (choice.variant === "truth") for (let i = 0; i < count; i++) values[i] = quantityOf(r, v[i] - e[i]);
    else if (choice.variant === "error") for (let i = 0; i < count; i++) values[i] = quantityOf(r, v[i]) - quantityOf(r, v[i] - e[i]);
    else for (let i = 0; i < count; i++) values[i] = quantityOf(r, v[i]);
    let low = Infinity, high = -Infinity;
    for (let i = 0; i < count; i++) { if (values[i] < low) low = values[i]; if (values[i] > high) high = values[i]; }
    if (!(low <= high)) { low = 0; high = 1; }
    const lowest = low, highest = high;
    if (q.range) [low, high] = q.range;  // the same colours at all times
    const robust = limits(values, low, high);
    if (!q.range && high - low > 1.25 * (robust[1] - robust[0]) && robust[1] > robust[0]) [low, high] = robust;
    const spread = choice.variant === "std" || choice.variant === "error";
    let colours = q.colours, ambient = quantityOf(r, 0), level = q.level;
    if (choice.variant === "error") { high = Math.max(-low, high); low = -high; colours = scene.diverging; }
    if (choice.variant === "std") { low = 0; colours = "cividis"; }
    // the truth in the colours of the field, so that they can be compared
    if (choice.variant === "truth") ({ low, high } = display({ quantity: choice.quantity, variant: "value" }));
    if (spread) { ambient = 0; level = high / 2; }
    if (high === low) high = low + (Math.abs(low) || 1);
    const what = { std: "standard deviation of ", truth: "true ", error: "error of " }[choice.variant] || "";
    const borrowed = choice.variant === "truth";
    cache[key] = { borrowed, values, low, high, lowest, highest, ambient, level, table: scene.tables[colours], label: what + q.label, unit: q.unit };
    return cache[key];
  }

  function exponentOf(shown) {
    const e = Math.floor(Math.log10(Math.max(Math.abs(shown.low), Math.abs(shown.high)) || 1));
    return e < -2 || e > 4 ? e : 0;
  }

  function say(value, shown) {
    if (Number.isNaN(value)) return "masked";
    const e = exponentOf(shown);
    const mantissa = plain(Number((value / 10 ** e).toPrecision(4)));
    return mantissa + (e ? " × 10" + superscript(e) : "") + (shown.unit ? " " + shown.unit : "");
  }

  function drawBar(shown) {
    const canvas = document.getElementById("bar"), c = canvas.getContext("2d"), data = c.createImageData(512, 1);
    for (let i = 0; i < 512; i++) {
      for (let k = 0; k < 3; k++) data.data[4 * i + k] = shown.table[3 * (i >> 1) + k];
      data.data[4 * i + 3] = 255;
    }
    c.putImageData(data, 0, 0);
    const e = exponentOf(shown), unit = [e ? "10" + superscript(e) : "", shown.unit].filter(Boolean).join(" ");
    document.getElementById("bar-label").textContent = shown.label + (unit ? " [" + unit + "]" : " [1]");
    const beyond = shown.lowest < shown.low || shown.highest > shown.high;
    document.getElementById("bar-note").textContent = beyond ? (shown.borrowed ? "Colour range: that of the reconstruction" : "Colour range: 0.1 to 99.9 %") + "; values from " + say(shown.lowest, shown) + " to " + say(shown.highest, shown) + "." : "";
    const ticks = document.getElementById("bar-ticks");
    ticks.textContent = "";
    for (const t of ticksBetween(shown.low / 10 ** e, shown.high / 10 ** e, 5)) {
      const tick = document.createElement("span");
      tick.textContent = plain(t);
      tick.style.left = (100 * (t * 10 ** e - shown.low)) / (shown.high - shown.low) + "%";
      ticks.append(tick);
    }
  }

  let space = null;
  const slices = makeSlices(scene, moved);
  function moved() {
    const shown = display(), at = slices.at;
    const where = AXES.map((a) => a + " = " + plain(Number(slices.place(a, at[a]).toFixed(2)))).join(", ");
    document.getElementById("readout").textContent = "At the cross, " + where + " mm: " + shown.label + " = " + say(slices.value(), shown);
    if (space) space.planes(document.getElementById("planes").checked ? AXES.map((a, i) => [i, slices.place(a, at[a])]) : []);
  }

  const level = document.getElementById("level"), levelText = document.getElementById("level-text");
  function setLevel(fromSlider) {
    const shown = display();
    if (!fromSlider) level.value = Math.round((1000 * (shown.level - shown.low)) / (shown.high - shown.low));
    const value = shown.low + (level.value / 1000) * (shown.high - shown.low);
    levelText.textContent = say(value, shown);
    level.setAttribute("aria-valuetext", levelText.textContent);
    if (space) space.level(value);
  }

  function update(keepLevel) {
    const shown = display();
    slices.show(shown);
    drawBar(shown);
    if (space) space.show(shown);
    setLevel(keepLevel === true);
    moved();
  }

  for (const name of ["quantity", "variant"])
    for (const input of document.querySelectorAll("input[name=" + name + "]"))
      input.addEventListener("change", () => { switches[name] = input.value; update(false); });
  update();
  if (scene.frames) await makeTime();

  // frames are unpacked when first shown
  async function makeTime() {
    const slider = document.getElementById("time"), text = document.getElementById("time-text"), play = document.getElementById("play");
    const frames = [];
    let current = 0, timer = null;
    async function go(k) {
      current = k;
      slider.value = k;
      const frame = scene.frames[k];
      text.textContent = plain(Number((1e3 * frame.time).toPrecision(6))) + " ms, frame " + frame.index;
      slider.setAttribute("aria-valuetext", text.textContent);
      if (!frames[k]) frames[k] = unpack("frame-" + k, frame, count);
      const values = await frames[k];
      if (current !== k) return;  // the slider has moved on
      arrays.value = values;
      for (const key in cache) delete cache[key];
      update(true);
    }
    slider.addEventListener("input", () => go(Number(slider.value)));
    play.addEventListener("click", () => {
      if (timer) { clearInterval(timer); timer = null; } else timer = setInterval(() => go((current + 1) % scene.frames.length), 120);
      play.textContent = timer ? "Stop" : "Play";
      play.setAttribute("aria-pressed", String(Boolean(timer)));
    });
    await go(0);
  }

  try {
    if (!document.createElement("canvas").getContext("webgl2")) throw new Error("no WebGL 2");
    space = makeSpace(scene, document.getElementById("space"));
  } catch (error) {
    const message = document.getElementById("space-message");
    message.hidden = false;
    document.querySelector(".panel").hidden = true;
    message.textContent = "This browser has no WebGL 2, so the field cannot be shown in three dimensions here (" + error.message + "). The slices above hold the same values; volume.vti opens in ParaView.";
    return;
  }
  const on = (id, event, act) => { const found = document.getElementById(id); if (found) found.addEventListener(event, () => act(found)); };
  on("level", "input", () => setLevel(true));
  on("opacity", "input", (input) => space.opacity(input.value / 100));
  on("planes", "change", moved);
  on("cameras", "change", (input) => space.cameras(input.checked));
  for (const input of document.querySelectorAll("input[name=mode]")) input.addEventListener("change", () => space.mode(input.value));
  for (const name of ["flow", "rig", "top", "front"]) on("look-" + name, "click", () => space.look[name]());
  on("save", "click", () => {
    const link = document.createElement("a");
    link.download = document.querySelector("h1").textContent.replace(/[^\w.+-]+/g, "_") + ".png";
    link.href = space.image();
    link.click();
  });
  space.opacity(document.getElementById("opacity").value / 100);
  update();
  document.documentElement.dataset.ready = String(Math.round(performance.now()));
}

main().catch((error) => {
  const trouble = document.getElementById("trouble");
  if (!trouble) throw error;
  trouble.hidden = false;
  trouble.textContent = "This browser could not draw the field (" + error.message + "). Any browser from 2023 or later can; volume.vti opens in ParaView.";
});
