"use strict";
// Three orthogonal slices with a linked cross. Arrays are (z, y, x), x fastest; values stand at voxel centres.

const PLANES = { z: ["x", "y"], y: ["x", "z"], x: ["y", "z"] };
const AXES = ["x", "y", "z"];

function makeSlices(scene, onMove) {
  const [nz, ny, nx] = scene.shape;
  const count = { x: nx, y: ny, z: nz };
  const edge = Object.fromEntries(AXES.map((a, i) => [a, scene.upper[i] - scene.lower[i]]));
  const lower = Object.fromEntries(AXES.map((a, i) => [a, scene.lower[i]]));
  const stride = { x: 1, y: nx, z: nx * ny };
  const at = { x: nx >> 1, y: ny >> 1, z: nz >> 1 };
  let shown = null;
  const place = (a, i) => lower[a] + ((i + 0.5) * edge[a]) / count[a];
  const panels = {};

  for (const normal of "zyx") {
    const canvas = document.getElementById("slice-" + normal);
    const slider = document.getElementById("at-" + normal);
    slider.value = at[normal];
    slider.addEventListener("input", () => move({ [normal]: Number(slider.value) }));
    panels[normal] = { canvas, slider, text: document.getElementById("at-" + normal + "-text"), image: document.createElement("canvas") };
    const pick = (event) => {
      const p = panels[normal];
      const [across, up] = PLANES[normal];
      const box = canvas.getBoundingClientRect();
      const u = (event.clientX - box.left - p.left) / p.width;
      const v = 1 - (event.clientY - box.top - p.top) / p.height;
      move({ [across]: Math.floor(u * count[across]), [up]: Math.floor(v * count[up]) });
    };
    canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); pick(event); });
    canvas.addEventListener("pointermove", (event) => { if (event.buttons) pick(event); });
    canvas.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && document.activeElement !== canvas) return;  // the page scrolls, unless this one is in use
      event.preventDefault();
      move({ [normal]: at[normal] + (event.deltaY < 0 ? 1 : -1) });
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const [across, up] = PLANES[normal];
      const step = event.shiftKey ? 10 : 1;
      const moves = { ArrowLeft: [across, -step], ArrowRight: [across, step], ArrowDown: [up, -step], ArrowUp: [up, step], PageUp: [normal, step], PageDown: [normal, -step] };
      const change = moves[event.key];
      if (!change) return;
      event.preventDefault();
      move({ [change[0]]: at[change[0]] + change[1] });
    });
  }

  function move(to) {
    for (const a in to) at[a] = Math.min(count[a] - 1, Math.max(0, to[a]));
    draw();
    onMove(at);
  }

  function paint(normal) {
    const [across, up] = PLANES[normal];
    const w = count[across], h = count[up];
    const image = panels[normal].image;
    image.width = w; image.height = h;
    const context = image.getContext("2d");
    const data = context.createImageData(w, h);
    const { values, low, high, table } = shown;
    const scale = 255 / (high - low || 1);
    for (let j = 0; j < h; j++) for (let i = 0; i < w; i++) {
      const value = values[at[normal] * stride[normal] + j * stride[up] + i * stride[across]];
      const o = 4 * ((h - 1 - j) * w + i);
      if (Number.isNaN(value)) { data.data[o] = data.data[o + 1] = data.data[o + 2] = 190; }
      else {
        const c = 3 * Math.max(0, Math.min(255, Math.round((value - low) * scale)));
        data.data[o] = table[c]; data.data[o + 1] = table[c + 1]; data.data[o + 2] = table[c + 2];
      }
      data.data[o + 3] = 255;
    }
    context.putImageData(data, 0, 0);
  }

  function layout() {
    const line = document.querySelector(".slices");
    const left = 52, bottom = 44, top = 8, right = 6;
    const stacked = window.innerWidth <= 900;
    const total = line.clientWidth - (stacked ? left + right : 3 * (left + right) + 28);
    let perMm = stacked ? Infinity : total / (2 * edge.x + edge.y);
    if (stacked) for (const normal of "zyx") perMm = Math.min(perMm, total / edge[PLANES[normal][0]]);
    perMm = Math.min(perMm, (stacked ? 560 : 470) / Math.max(edge.y, edge.z));
    for (const normal of "zyx") {
      const p = panels[normal];
      const [across, up] = PLANES[normal];
      p.width = edge[across] * perMm; p.height = edge[up] * perMm; p.left = left; p.top = top;
      const w = p.width + left + right, h = p.height + top + bottom, ratio = window.devicePixelRatio || 1;
      p.canvas.width = Math.round(w * ratio); p.canvas.height = Math.round(h * ratio);
      p.canvas.style.width = w + "px"; p.canvas.style.height = h + "px";
      p.canvas.parentElement.style.width = w + "px";
      p.ratio = ratio;
    }
  }

  function draw() {
    if (!shown) return;
    const smooth = !document.getElementById("voxels").checked;
    for (const normal of "zyx") {
      const p = panels[normal];
      const [across, up] = PLANES[normal];
      paint(normal);
      p.slider.value = at[normal];
      const where = normal + " = " + place(normal, at[normal]).toFixed(2) + " mm";
      p.text.textContent = place(normal, at[normal]).toFixed(2) + " mm";
      p.slider.setAttribute("aria-valuetext", where);
      const c = p.canvas.getContext("2d");
      c.setTransform(p.ratio, 0, 0, p.ratio, 0, 0);
      c.clearRect(0, 0, p.canvas.width, p.canvas.height);
      c.imageSmoothingEnabled = smooth;
      c.imageSmoothingQuality = "high";
      c.drawImage(p.image, p.left, p.top, p.width, p.height);
      c.strokeStyle = "#46535f"; c.lineWidth = 1; c.strokeRect(p.left, p.top, p.width, p.height);
      c.fillStyle = "#16202b"; c.font = "13px system-ui, sans-serif";
      const bottom = p.top + p.height;
      c.textAlign = "center"; c.textBaseline = "top";
      for (const t of ticksBetween(lower[across], lower[across] + edge[across], Math.max(2, p.width / 70))) {
        const x = p.left + ((t - lower[across]) / edge[across]) * p.width;
        c.beginPath(); c.moveTo(x, bottom); c.lineTo(x, bottom + 5); c.stroke();
        c.fillText(plain(t), x, bottom + 7);
      }
      c.fillText(across + " [mm]", p.left + p.width / 2, bottom + 24);
      c.textAlign = "right"; c.textBaseline = "middle";
      for (const t of ticksBetween(lower[up], lower[up] + edge[up], Math.max(2, p.height / 60))) {
        const y = bottom - ((t - lower[up]) / edge[up]) * p.height;
        c.beginPath(); c.moveTo(p.left, y); c.lineTo(p.left - 5, y); c.stroke();
        c.fillText(plain(t), p.left - 8, y);
      }
      c.save(); c.translate(11, p.top + p.height / 2); c.rotate(-Math.PI / 2); c.textAlign = "center"; c.fillText(up + " [mm]", 0, 0); c.restore();
      const x = p.left + ((at[across] + 0.5) / count[across]) * p.width;
      const y = bottom - ((at[up] + 0.5) / count[up]) * p.height;
      for (const [colour, width] of [["rgba(0,0,0,.55)", 2.5], ["rgba(255,255,255,.9)", 1]]) {
        c.strokeStyle = colour; c.lineWidth = width; c.beginPath();
        c.moveTo(x, p.top); c.lineTo(x, y - 6); c.moveTo(x, y + 6); c.lineTo(x, bottom);
        c.moveTo(p.left, y); c.lineTo(x - 6, y); c.moveTo(x + 6, y); c.lineTo(p.left + p.width, y); c.stroke();
      }
    }
  }

  layout();
  window.addEventListener("resize", () => { layout(); draw(); });
  document.getElementById("voxels").addEventListener("change", draw);
  return {
    at, place,
    show(next) { shown = next; draw(); },
    value() { return shown.values[at.x + nx * (at.y + ny * at.z)]; },
  };
}

function ticksBetween(low, high, count) {
  const raw = (high - low) / count, power = Math.pow(10, Math.floor(Math.log10(raw)));
  const step = power * ([1, 2, 5, 10].find((m) => m * power >= raw * 0.999) || 10);
  const ticks = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) ticks.push(k * step);
  return ticks;
}

function plain(value) { return String(Number(value.toPrecision(6))).replace("-", "−"); }
