// What is drawn: overlays over the pictures, plots over time, and the scene in three dimensions.

const MARKER = "#39e06b", PREDICTED = "#ffd23f", SET_POINT = "#ff5ad1", DRAFT = "#4db8ff", PATH = "#ff9f1c";

export function hull(points) {
  // The convex hull of pixels, in order (Andrew's monotone chain).
  const sorted = [...points].sort((a, b) => a[0] - b[0] || a[1] - b[1]);
  if (sorted.length < 3) return sorted;
  const half = (list) => {
    const out = [];
    for (const p of list) {
      while (out.length > 1) {
        const [a, b] = out.slice(-2);
        if ((b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]) > 0) break;
        out.pop();
      }
      out.push(p);
    }
    return out.slice(0, -1);
  };
  return [...half(sorted), ...half(sorted.reverse())];
}

export function inside(outline, [x, y], margin) {
  // Whether a pixel is within an outline, or at most `margin` beside one of its corners.
  let odd = false;
  outline.forEach(([x1, y1], i) => {
    const [x2, y2] = outline[(i + 1) % outline.length];
    if ((y1 > y) !== (y2 > y) && x < ((x2 - x1) * (y - y1)) / (y2 - y1) + x1) odd = !odd;
  });
  return odd || outline.some(([u, v]) => Math.hypot(u - x, v - y) < margin);
}

function outline(ctx, points, colour, fill) {
  if (points.length < 2) return;
  ctx.beginPath();
  hull(points).forEach(([u, v], i) => (i ? ctx.lineTo(u, v) : ctx.moveTo(u, v)));
  ctx.closePath();
  ctx.strokeStyle = colour;
  ctx.stroke();
  if (fill) { ctx.fillStyle = colour + "33"; ctx.fill(); }
}

function line(ctx, points, colour, dash = []) {
  ctx.setLineDash(dash);
  ctx.beginPath();
  points.forEach(([u, v], i) => (i ? ctx.lineTo(u, v) : ctx.moveTo(u, v)));
  ctx.strokeStyle = colour;
  ctx.stroke();
  ctx.setLineDash([]);
}

export function drawPicture(canvas, view) {
  // view: image, width, height, features, predicted, setPoints, path, draft, lines.
  const { width, height } = view;
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  const ctx = canvas.getContext("2d");
  if (view.image) ctx.drawImage(view.image, 0, 0, width, height);
  else ctx.clearRect(0, 0, width, height);
  const unit = Math.max(1, width / 640);
  ctx.lineWidth = 1.5 * unit;
  for (const way of view.path) line(ctx, way, PATH);
  if (view.lines) line(ctx, view.lines, DRAFT, [6 * unit, 5 * unit]);
  for (const [u, v] of view.setPoints) {
    ctx.strokeStyle = SET_POINT;
    ctx.beginPath(); ctx.moveTo(u - 5 * unit, v); ctx.lineTo(u + 5 * unit, v);
    ctx.moveTo(u, v - 5 * unit); ctx.lineTo(u, v + 5 * unit); ctx.stroke();
  }
  for (const [u, v] of view.predicted) {
    ctx.strokeStyle = PREDICTED;
    ctx.strokeRect(u - 6 * unit, v - 6 * unit, 12 * unit, 12 * unit);
  }
  ctx.fillStyle = ctx.strokeStyle = MARKER;
  ctx.font = `${11 * unit}px system-ui, sans-serif`;
  for (const [id, u, v] of view.features) {
    ctx.beginPath(); ctx.arc(u, v, 3 * unit, 0, 7); ctx.stroke();
    ctx.fillText(id, u + 7 * unit, v - 5 * unit);
  }
  outline(ctx, view.predicted, PREDICTED, false);
  if (view.draft) outline(ctx, view.draft, DRAFT, true);
}

function fitted(canvas) {
  const scale = window.devicePixelRatio || 1;
  const [w, h] = [canvas.clientWidth, canvas.clientHeight];
  if (canvas.width !== Math.round(w * scale)) { canvas.width = Math.round(w * scale); canvas.height = Math.round(h * scale); }
  const ctx = canvas.getContext("2d");
  ctx.setTransform(scale, 0, 0, scale, 0, 0);
  ctx.clearRect(0, 0, w, h);
  return [ctx, w, h];
}

const COLOURS = ["#2f8fe8", "#e0663c", "#25a267", "#b35bd6", "#c9a013", "#d6457a", "#3fb3b3"];

export function drawPlot(canvas, history, names, logarithmic) {
  // history: [seconds, values…] rows, null where there is none; the last 60 s are shown.
  const [ctx, w, h] = fitted(canvas);
  const ink = getComputedStyle(canvas).getPropertyValue("--faint");
  const end = history.length ? history[history.length - 1][0] : 0;
  const shown = history.filter((row) => row[0] > end - 60);
  const all = shown.flatMap((row) => row.slice(1)).filter((v) => v !== null && (!logarithmic || v > 0));
  ctx.fillStyle = ink; ctx.font = "11px system-ui, sans-serif";
  if (!all.length) { ctx.fillText("nothing to show now", 4, 14); return; }
  const f = logarithmic ? Math.log10 : (v) => v;
  let [low, high] = [Math.min(...all.map(f)), Math.max(...all.map(f))];
  if (high - low < 1e-9) { low -= 0.5; high += 0.5; }
  const x = (t) => 44 + ((t - end + 60) / 60) * (w - 48), y = (v) => h - 6 - ((f(v) - low) / (high - low)) * (h - 14);
  const label = (v) => (logarithmic ? 10 ** v : v).toPrecision(3);
  ctx.fillText(label(high), 0, 10); ctx.fillText(label(low), 0, h - 2);
  names.forEach((name, k) => {
    ctx.strokeStyle = COLOURS[k % COLOURS.length]; ctx.lineWidth = 1.5; ctx.beginPath();
    let pen = false;
    for (const row of shown) {
      const v = row[k + 1];
      if (v === null || (logarithmic && v <= 0)) { pen = false; continue; }
      pen ? ctx.lineTo(x(row[0]), y(v)) : ctx.moveTo(x(row[0]), y(v)); pen = true;
    }
    ctx.stroke();
    if (names.length > 1) { ctx.fillStyle = ctx.strokeStyle; ctx.fillText(name, 52 + k * 34, 10); }
  });
}

export function drawReasons(canvas, history) {
  // history: [seconds, codes] rows; a bar for each code while it was given, over the last 60 s.
  const [ctx, w, h] = fitted(canvas);
  const end = history.length ? history[history.length - 1][0] : 0;
  const shown = history.filter((row) => row[0] > end - 60);
  const codes = [...new Set(shown.flatMap((row) => row[1]))];
  ctx.fillStyle = getComputedStyle(canvas).getPropertyValue("--faint"); ctx.font = "11px system-ui, sans-serif";
  if (!codes.length) { ctx.fillText("none", 4, 14); return; }
  const step = Math.min(16, h / codes.length), x = (t) => ((t - end + 60) / 60) * w;
  codes.forEach((code, k) => {
    ctx.fillStyle = COLOURS[k % COLOURS.length] + "66";
    shown.forEach(([t, given], i) => {
      const next = shown[i + 1]?.[0] ?? t + 0.05;
      if (given.includes(code)) ctx.fillRect(x(t), k * step + 1, Math.max(1, x(Math.min(next, t + 1)) - x(t)), step - 2);
    });
    ctx.fillStyle = getComputedStyle(canvas).getPropertyValue("--ink");
    ctx.fillText(code, 4, (k + 0.5) * step + 4);
  });
}

export function drawScene(canvas, scene, goal, turn) {
  // An orthographic view of axes, markers, cameras and the goal's markers (or null), turned by turn = [yaw, pitch]; the
  // model has no metres.
  const [ctx, w, h] = fitted(canvas);
  const centre = [0, 1, 2].map((i) => scene.markers.reduce((s, m) => s + m[i], 0) / scene.markers.length);
  const [cy, sy, cp, sp] = [Math.cos(turn[0]), Math.sin(turn[0]), Math.cos(turn[1]), Math.sin(turn[1])];
  const seen = (p) => {
    const [x, y, z] = p.map((v, i) => v - centre[i]);
    const [a, b] = [cy * x + sy * z, -sy * x + cy * z];
    return [a, cp * y - sp * b];
  };
  const size = Math.max(...scene.cameras.map((c) => Math.hypot(...c.centre.map((v, i) => v - centre[i]))));
  const scale = (0.45 * Math.min(w, h)) / size;
  const at = (p) => { const [a, b] = seen(p); return [w / 2 + scale * a, h / 2 + scale * b]; };
  const along = (p, d, s) => p.map((v, i) => v + s * size * d[i]);
  ctx.lineWidth = 2; ctx.font = "12px system-ui, sans-serif";
  scene.axes.forEach(([p, d], k) => {
    line(ctx, [at(along(p, d, -0.12)), at(along(p, d, 0.12))], COLOURS[k % COLOURS.length]);
    ctx.fillStyle = COLOURS[k % COLOURS.length];
    const [u, v] = at(along(p, d, 0.13));
    ctx.fillText(String(k + 1), u, v);
  });
  ctx.fillStyle = SET_POINT;
  for (const m of goal ?? []) { const [u, v] = at(m); ctx.fillRect(u - 3, v - 0.5, 7, 1.5); ctx.fillRect(u - 0.5, v - 3, 1.5, 7); }
  ctx.fillStyle = MARKER;
  for (const m of scene.markers) { const [u, v] = at(m); ctx.fillRect(u - 2, v - 2, 4, 4); }
  ctx.fillStyle = getComputedStyle(canvas).getPropertyValue("--ink");
  for (const c of scene.cameras) {
    const [u, v] = at(c.centre);
    ctx.fillRect(u - 4, v - 4, 8, 8);
    line(ctx, [[u, v], at(along(c.centre, c.axis, 0.15))], ctx.fillStyle);
    ctx.fillText(c.name, u + 7, v);
  }
}
