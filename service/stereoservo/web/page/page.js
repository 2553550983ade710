// The operators' page: what the cell publishes comes over one WebSocket, and what the page asks goes back over it. What
// a page may do is decided on the server; the buttons only show it.

import { drawPicture, drawPlot, drawReasons, drawScene, hull, inside } from "/drawing.js";

const $ = (id) => document.getElementById(id);
const views = new Map();
const history = { error: [], velocity: [], loop: [], reasons: [] };
const answers = new Map();
const stats = (window.stats = { pictures: 0, latencies: [], answers: [], events: [] });
stats.middle = (camera) => {
  const pixels = views.get(camera)?.predicted ?? [];
  return pixels.length ? [0, 1].map((i) => pixels.reduce((sum, p) => sum + p[i], 0) / pixels.length) : null;
};
let socket, number = 0, rights = {}, state, scene, sceneGoal = null, joints = [], turn = [0.6, 0.4], drag = null, hasDraft = false, lastCamera = null, flight = null, arrived = 0, sought = null;
let drawDue = false;
const LOST_S = 0.6, HUNG_S = 5, STOP_S = 0.5, AGAIN_S = 0.5;
// Of the link, in ms of performance.now(): when the server was heard last, when it said for how long the cell had been
// silent [s], when it was connected to, and when the page looked at all this last; by how much this computer's clock is ahead of the server's [ms].
const link = { heard: performance.now(), ticked: 0, silent: 0, opened: 0, looked: 0, closed: true, why: "", lost: false, ahead: [] };
let stopping = null; // a stop that is not confirmed yet

function view(camera) {
  if (views.has(camera)) return views.get(camera);
  const figure = document.createElement("figure"), canvas = document.createElement("canvas");
  const caption = document.createElement("figcaption"), name = document.createElement("span"), note = document.createElement("span");
  name.textContent = camera;
  caption.append(name, note);
  figure.append(canvas, caption);
  canvas.dataset.camera = camera;
  $("pictures").append(figure);
  const made = { camera, figure, canvas, note, width: 640, height: 480, image: null, features: [], ids: new Set(), predicted: [],
    setPoints: [], path: [], draft: null, lines: null, frame: "", rate: 30, shot: 0, heard: 0, seen: 0 };
  views.set(camera, made);
  listen(made);
  return made;
}

function redraw() {
  if (drawDue) return;
  drawDue = true;
  requestAnimationFrame(() => {
    drawDue = false;
    for (const v of views.values()) drawPicture(v.canvas, v);
  });
}

// -- the link ------------------------------------------------------------------------------------------------------

function connect() {
  const made = socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/socket`);
  link.opened = performance.now();
  made.binaryType = "arraybuffer";
  made.onmessage = ({ data }) => {
    if (socket !== made) return;
    link.heard = performance.now();
    link.closed = false;
    typeof data === "string" ? take(JSON.parse(data)) : picture(data);
  };
  made.onclose = () => { if (socket === made) disconnect(); };
}

function disconnect() {
  const old = socket;
  socket = null;
  old.close();
  link.closed = true;
  link.why = "";
  rights = {};
  state = undefined;
  $("events").replaceChildren(); // they are all told again
  showRights();
  for (const settle of answers.values()) settle({ ok: false, message: "the page's server does not answer" });
  answers.clear();
  watch();
  setTimeout(connect, 1000);
}

function request(tree) {
  return new Promise((settle) => {
    if (socket?.readyState !== WebSocket.OPEN) return settle({ ok: false, message: "the page's server does not answer" });
    const n = ++number;
    answers.set(n, settle);
    socket.send(JSON.stringify({ ...tree, n }));
  });
}

function watch() {
  // What is shown grows old where nothing comes: it says so, and counts on.
  const now = performance.now(), server = (now - link.heard) / 1000;
  if (now - link.looked > 2000) link.opened = now; // this page itself stood still
  link.looked = now;
  const hung = Math.min(server, (now - link.opened) / 1000);
  const cell = link.ticked && !flight ? link.silent + (now - link.ticked) / 1000 : 0;
  link.lost = link.closed ? link.ticked > 0 || server > LOST_S : Math.max(server, cell) > LOST_S;
  link.age = Math.max(server, cell);
  const means = flight ? "" : ": what is shown is old. Stop the arm with the emergency stop, or `stereoservo stop`.";
  banner("link", link.why ? `The daemon does not answer: ${link.why}` : !link.lost ? ""
    : server > LOST_S / 2 ? `No word from the page's server${means}` : `No word from the cell${means}`, true);
  document.body.classList.toggle("lost", link.lost);
  $("commands").disabled = !rights.holds || link.lost;
  showHead();
  for (const v of views.values()) showCaption(v, now);
  if (socket && hung > HUNG_S) disconnect(); // a connection that hangs may do so for minutes
  watchStop(now);
}

async function command(tree) {
  const answer = await request(tree);
  const lines = [answer.message || ""];
  for (const problem of answer.reply?.problems ?? []) if (!answer.message.includes(problem)) lines.push(problem);
  for (const reason of answer.reply?.reasons ?? []) if (reason.hint && !answer.message.includes(reason.hint)) lines.push(`${reason.code}: ${reason.hint}`);
  banner("answer", `${tree.do}: ${lines.join("\n")}`, !answer.ok);
  stats.answers.push([tree.do, answer.ok, lines.join("\n")]);
  return answer;
}

function banner(id, text, bad) {
  if ($(id).textContent !== text) $(id).textContent = text;
  $(id).hidden = !text;
  $(id).className = `banner ${bad ? "bad" : "good"}`;
}

async function picture(buffer) {
  const size = new DataView(buffer).getUint32(0, true);
  const info = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, size)));
  const k = ++arrived; // pictures are decoded in any order
  const image = await createImageBitmap(new Blob([new Uint8Array(buffer, 4 + size)], { type: "image/jpeg" }));
  const v = view(info.camera);
  if (k < v.arrived) return image.close();
  v.image?.close();
  Object.assign(v, { image, arrived: k, t_ns: info.t_shutter_ns, width: info.width, height: info.height });
  const late = Date.now() - (link.ahead.length ? Math.min(...link.ahead) : 0) - 1000 * info.t_wall;
  stats.pictures += 1;
  stats.latencies.push(late);
  if (stats.latencies.length > 600) stats.latencies.shift();
  v.heard = performance.now();
  v.shot = v.heard - late;
  v.frame = `frame ${info.seq}, `;
  showCaption(v, v.heard);
  redraw();
}

function showCaption(v, now) {
  // A camera that delivers nothing any more: its last picture grows old, and its markers are nowhere.
  const limit = Math.max(LOST_S, 3 / v.rate), told = state?.camera_age_s?.[v.camera] ?? 0;
  const since = (t) => (flight || !t ? 0 : Math.max((now - t) / 1000, told));
  const silent = since(v.image ? v.heard : v.seen), old = silent > limit;
  v.figure.classList.toggle("old", old);
  if (since(v.seen) > limit && v.features.length) { v.features = []; redraw(); }
  v.note.textContent = !v.heard && !v.seen ? "no picture yet" : old ? `nothing for ${silent.toFixed(1)} s: what is shown is old`
    : `${v.frame}${flight || !v.shot ? "" : `${(now - v.shot).toFixed(0)} ms old, `}${v.features.length} markers`;
}

// -- what the cell says --------------------------------------------------------------------------------------------

function take(message) {
  if (message.answer) { answers.get(message.answer.n)?.(message.answer); answers.delete(message.answer.n); }
  else if (message.rights) { rights = message.rights; showRights(); }
  else if (message.state) showState(message);
  else if (message.features) {
    const { camera, ids, pixels, t_shutter_ns } = message.features;
    const v = view(camera);
    if (flight && v.image && Math.abs(t_shutter_ns - v.t_ns) > 1e9) { v.image.close(); v.image = null; } // none was recorded there
    v.features = ids.map((id, i) => [id, ...pixels[i]]);
    v.ids = new Set(ids);
    v.seen = performance.now();
    if (!v.image) v.frame = `frame ${message.features.seq}, `;
    redraw();
  } else if (message.info) showInfo(message.info);
  else if (message.event) showEvent(message.event);
  else if (message.goal) showGoal(message.goal);
  else if (message.flight) showFlight(message.flight);
  else if (message.plots) Object.assign(history, message.plots);
  else if (message.events) {
    $("events").replaceChildren();
    $("calibration").textContent = "";
    for (const { event } of message.events) showEvent(event);
  }
  else if (message.tick) {
    Object.assign(link, { ticked: performance.now(), silent: message.tick.silent_s });
    link.ahead.push(Date.now() - 1000 * message.tick.t_wall);
    if (link.ahead.length > 50) link.ahead.shift();
  }
  else if ("up" in message) { link.why = message.up ? "" : message.why; watch(); }
  else if (message.notice) showNotice(message);
}

function showRights() {
  $("cell").textContent = rights.cell ?? "stereoservo";
  $("commands").disabled = !rights.holds || link.lost;
  $("take").hidden = !rights.operator || rights.holds;
  $("rights-text").textContent = rights.holds ? `This page holds the arm as ${rights.operator}.`
    : !rights.operator ? "This page is read-only: it may stop the arm, nothing else."
    : rights.taken ? `Another page holds the arm as ${rights.operator}; this one may stop it.`
    : "Give the token that stands in the terminal to command the arm; stop works without.";
}

function badge(id, text, kind = "") {
  if ($(id).textContent !== text) $(id).textContent = text; // a screen reader says what changes
  $(id).className = `badge ${kind}`;
}

function showState({ state: s, predicted, scene: shape, refinement }) {
  state = s;
  showHead();
  const unseen = s.health.verdict === "unknown" && s.health.text;
  const readiness = s.model === "unconfirmed" ? "kept, not confirmed" : s.model;
  badge("model", `model ${readiness}${unseen ? ", unseen" : ""}`, unseen ? "warn" : { valid: "good", suspect: "warn", unconfirmed: "warn" }[s.model]);
  badge("error", s.error_px !== null ? `error ${s.error_px.toFixed(2)} px` : s.goal ? "error unknown" : "no error");
  badge("activity", s.goal ? `${s.source} ${s.progress === null ? "" : Math.round(100 * s.progress) + " %"}` : s.source);
  const texts = s.reasons.map((r) => `${r.code}${r.subject ? ` ${r.subject}` : ""}: ${r.hint}`).concat(s.notes, s.health.text && s.health.verdict !== "ok" ? [s.health.text] : []);
  if ($("reasons").dataset.shown !== texts.join("\n")) {
    $("reasons").dataset.shown = texts.join("\n");
    $("reasons").replaceChildren(...(texts.length ? texts : ["none"]).map((text) => Object.assign(document.createElement("li"), { textContent: text })));
  }
  showLearning(s.learning);
  $("refinement").textContent = refinement ? `Refinement: ${refinement}` : ""; // a flight tells none
  $("refinement").hidden = !refinement;
  for (const v of views.values()) {
    const markers = Object.entries(predicted[v.camera] ?? {}); // none where the joints are unknown
    v.predicted = markers.filter(([id]) => !v.ids.size || v.ids.has(Number(id))).map(([, p]) => p);
  }
  scene = shape;
  redraw();
  const t = s.t_ns * 1e-9;
  const last = history.error.at(-1);
  if (last && t <= last[0]) return; // the plots hold it
  history.error.push([t, s.error_px]);
  history.velocity.push([t, ...joints.map((name) => s.velocities[name] ?? null)]);
  history.loop.push([t, s.loop.lateness_us.p99 ?? null]);
  history.reasons.push([t, s.reasons.map((r) => r.code)]);
  for (const rows of Object.values(history)) if (rows.length > 1300) rows.splice(0, rows.length - 1300);
}

function showLearning(l) {
  // A tile a joint, empty at 10 px and full at 0.001 px of predicted error; the text says the same.
  $("learning").hidden = !l;
  if (!l) return;
  const px = (x) => `${x.toPrecision(2)} px`, n = l.motions - 1;
  const motion = l.doing === "fitting" ? "fitting the model" : !l.motion ? "to the base" : l.motion > n ? "all joints at once" : `joint ${l.motion} of ${n}`;
  const known = l.predicted_px === null ? `accuracy not known yet${l.note && `: ${l.note}`}` : `predicted ${px(l.predicted_px)}`;
  const seen = Object.entries(l.coverage).map(([camera, share]) => `, ${Math.round(100 * share)} % of ${camera} seen`).join("");
  const head = `Learning the arm: ${motion}, ${known}`; // a screen reader says what changes
  if ($("learning-head").textContent !== head) $("learning-head").textContent = head;
  const left = l.seconds_left === null ? "" : `, ${l.seconds_left.toFixed(0)} s left`;
  $("learning-count").textContent = `${l.images} images${seen}${left}`;
  $("learning-joints").replaceChildren(...l.joints.map((joint, k) => {
    const p = joint.predicted_px, item = document.createElement("li");
    item.textContent = `${joint.name}: ${p !== null ? px(p) : joint.moved ? "not known yet" : "not moved yet"}`;
    item.className = l.doing === "moving" && (k + 1 === l.motion || l.motion > n) ? "now" : "";
    item.style.setProperty("--known", p === null ? "0%" : `${Math.min(100, Math.max(0, 25 * (1 - Math.log10(p))))}%`);
    return item;
  }));
}

function showHead() {
  const cell = `${rights.cell ?? ""} stereoservo`, s = state;
  let text = "no state yet", kind = "", title = "";
  if (link.lost) [text, kind, title] = [`LOST for ${link.age.toFixed(1)} s`, "bad", "LOST "];
  else if (s?.servo_alive === false) [text, kind, title] = ["UNKNOWN: the servo process is silent", "bad", "UNKNOWN "];
  else if (s) {
    const codes = s.reasons.map((r) => r.code), halted = ["STOPPED", "HELD"].find((code) => codes.includes(code));
    text = s.dry_run ? `${s.lifecycle}, dry run` : s.lifecycle;
    kind = { active: s.level === "hold" || codes.includes("CAMERA_SILENT") ? "warn" : "good", fault: "bad" }[s.lifecycle];
    if (halted && s.lifecycle === "active") {
      [text, kind, title] = [halted, halted === "STOPPED" ? "bad" : "warn", `${halted} `];
      if (s.halt) text = `${s.halt.words.replace(/^[a-z]+/, (word) => word.toUpperCase())}, ${new Date(1000 * s.halt.t_wall).toLocaleTimeString()}`;
    }
  }
  badge("lifecycle", text, kind);
  document.title = title + cell;
}

function showInfo(info) {
  joints = info.joints.map((joint) => joint.name);
  for (const { name, width, height, rate_hz: rate } of info.cameras) Object.assign(view(name), { width, height, rate });
  const frames = ["tool", "base", ...info.cameras.map((camera) => `camera:${camera.name}`)], chosen = $("step-frame").value;
  $("step-frame").replaceChildren(...frames.map((name) => new Option(name, name, false, name === chosen)));
  $("taught").replaceChildren(...info.taught.map((goal) => {
    const button = document.createElement("button");
    button.textContent = `Check “${goal.name}”`;
    button.onclick = () => check({ name: goal.name });
    return button;
  }));
  redraw();
}

function list(t_wall, text, attributes = {}) {
  const item = Object.assign(document.createElement("li"), attributes);
  item.textContent = `${new Date(1000 * t_wall).toLocaleTimeString()} ${text}`;
  if (flight) { // a place in the recording
    item.tabIndex = 0;
    item.onclick = () => request({ do: "seek", at: Math.max(0, t_wall - flight.begin) });
    item.onkeydown = (event) => { if (event.key === "Enter") item.onclick(); };
  }
  $("events").prepend(item);
  while ($("events").childElementCount > 200) $("events").lastChild.remove();
}

function showNotice({ notice, t_wall }) {
  list(t_wall, notice);
  if (state) banner("answer", notice, true); // before the first state a page is told the past
}

function showEvent(event) {
  const reasons = event.reasons.map((r) => `${r.code}${r.subject ? ` ${r.subject}` : ""}${r.hint && r.hint !== event.message ? `: ${r.hint}` : ""}`);
  const by = event.kind === "stopped" && event.operator ? `by ${event.operator}` : "";
  const why = [...new Set([by, event.message, ...reasons])].filter(Boolean).join("\n") ||
    (/_aborted$|_failed$/.test(event.kind) ? "the daemon gave no reason, which is a fault of it" : "");
  const what = `${event.kind.replaceAll("_", " ")} ${event.id.slice(0, 8)}`;
  list(event.t_wall, `${what} ${why}`, { value: event.seq });
  if (state && !flight && /_aborted$|_failed$/.test(event.kind)) banner("answer", `${what}: ${why}`, true);
  stats.events.push([event.kind, event.id, event.error_px, why]);
  const done = event.progress === null ? "" : ` (${Math.round(100 * event.progress)} %)`;
  if (event.kind !== "calibration_report" && /^(calibrat|fit_|check|trial|zeros)/.test(event.kind)) {
    const c = event.calibration;
    $("calibration").textContent = c
      ? `Calibrated: ${c.verdict}\nrms ${c.rms_px.toFixed(3)} px, ${c.images} images of ${c.joints} joints, stratum ${c.stratum}, grade ${c.grade}\n` +
        Object.entries(c.per_joint_px).map(([name, px]) => `${name} ${px.toFixed(3)} px`).join(", ") + `\nmodel ${c.model}\nreport on the daemon's host: ${c.report}`
      : event.check ? `Check of the model: ${event.message}` : `${event.kind.replaceAll("_", " ")}${done}: ${event.message}`;
  }
}

function showFlight(now) {
  // A recording in the place of a live cell: there is nothing to command, and nothing to stop.
  if (!flight) {
    $("stop").hidden = $("controls").hidden = true;
    $("playback").hidden = false;
    document.body.classList.add("recording");
    $("loop-title").textContent = "Cycles longer than their period, p99 of the last 250 [µs]";
  }
  flight = now;
  $("play").textContent = now.playing ? "Pause" : "Play";
  $("time").max = now.seconds;
  if (document.activeElement !== $("time") || now.playing) $("time").value = sought ?? now.at;
  if (document.activeElement !== $("speed")) $("speed").value = String(now.speed);
  $("at").textContent = `${now.at.toFixed(2)} of ${now.seconds.toFixed(2)} s, ${new Date(1000 * (now.begin + now.at)).toLocaleString()}` +
    (now.reading ? `; read up to ${now.read.toFixed(0)} s` : "");
  $("flight-notes").textContent = now.notes.join("\n");
  $("flight-notes").hidden = !now.notes.length;
}

async function seek() {
  // One request at a time, as for drags.
  if (sought !== null) return;
  while (sought !== Number($("time").value)) {
    sought = Number($("time").value);
    const answer = await request({ do: "seek", at: sought });
    stats.answers.push(["seek", answer.ok, answer.message]);
  }
  sought = null;
}

function showGoal({ id, plan, set_points: stated, scene: markers }) {
  sceneGoal = markers;
  if (!id) $("plan").textContent = "";
  else showPlan(plan, `goal ${id.slice(0, 8)}`);
  for (const v of views.values()) {
    if (!plan) { v.path = []; v.setPoints = Object.values(stated[v.camera] ?? {}); }
  }
  redraw();
}

function showPlan(plan, what) {
  for (const v of views.values()) {
    const shown = Object.values(plan?.pixels[v.camera] ?? {});
    v.path = shown;
    v.setPoints = shown.map((way) => way[way.length - 1]);
  }
  $("plan").textContent = plan
    ? `${what}: law ${plan.law}, path ${plan.way}, ${plan.seconds.toFixed(1)} s\n` + plan.approaches
      .map((a) => `${a.code} ${a.subject}: ${a.room.toPrecision(3)} ${a.unit} clear at ${Math.round(100 * a.share)} % of the path`).join("\n")
    : `${what}: the law plans no path that could be shown`;
  redraw();
}

// -- goals ---------------------------------------------------------------------------------------------------------

async function check(what = {}, name = what.name) {
  const answer = await command({ do: "check", ...what });
  if (answer.ok) showPlan(answer.plan, `checked, nothing moves yet${name ? ` (${name})` : ""}`);
}

function checkStep(event) {
  event.preventDefault();
  const [kind, axis] = $("step-axis").value.split(" "), by = Number($("step-by").value), frame = $("step-frame").value;
  const vector = [0, 0, 0];
  vector[axis] = kind === "move" ? by / 1000 : (by * Math.PI) / 180;
  const id = Array.from(crypto.getRandomValues(new Uint8Array(16)), (byte) => byte.toString(16).padStart(2, "0")).join("");
  check({ goal: { id, target: { kind: "step", frame, [kind]: vector } } }, `${kind} ${"xyz"[axis]} by ${by} ${$("step-unit").textContent} in ${frame}`);
}

function pixelOf(v, event) {
  const box = v.canvas.getBoundingClientRect();
  return [((event.clientX - box.left) / box.width) * v.width - 0.5, ((event.clientY - box.top) / box.height) * v.height - 0.5];
}

function listen(v) {
  v.canvas.onpointerdown = (event) => {
    if (!rights.holds) return;
    const p = pixelOf(v, event), margin = (14 * v.width) / v.canvas.clientWidth;
    const onDraft = hasDraft && v.draft && inside(hull(v.draft), p, margin);
    if (!onDraft && !inside(hull(v.predicted), p, margin)) return;
    v.canvas.setPointerCapture(event.pointerId);
    drag = { v, from: p, to: p, draft: onDraft, busy: false, ended: false };
    event.preventDefault();
  };
  v.canvas.onpointermove = (event) => { if (drag?.v === v && !drag.ended) { drag.to = pixelOf(v, event); follow(drag); } };
  v.canvas.onpointerup = v.canvas.onpointercancel = (event) => {
    if (drag?.v !== v || drag.ended) return;
    drag.to = pixelOf(v, event);
    drag.ended = true;
    follow(drag);
  };
}

async function follow(d) {
  // One request at a time: the newest position waits for the answer to the last one.
  if (d.busy) return;
  d.busy = true;
  for (let sent = null; sent === null || sent.to !== d.to || sent.ended !== d.ended;) {
    sent = { to: d.to, ended: d.ended };
    await dragged({ camera: d.v.camera, shift: [d.to[0] - d.from[0], d.to[1] - d.from[1]], draft: d.draft, done: sent.ended });
  }
  d.busy = false;
}

async function dragged(tree) {
  const answer = await request({ do: "drag", ...tree });
  if (!answer.ok) return banner("answer", `drag: ${answer.message}`, true);
  lastCamera = tree.camera;
  hasDraft = true;
  for (const v of views.values()) {
    const markers = answer.pixels[v.camera] ?? {};
    v.draft = Object.entries(markers).filter(([id]) => !v.ids.size || v.ids.has(Number(id))).map(([, p]) => p);
    v.lines = answer.lines[v.camera] ?? null;
    v.path = []; v.setPoints = [];
  }
  $("plan").textContent = answer.left_px > 0.5
    ? `The arm cannot follow the drag all the way: ${answer.left_px.toFixed(1)} px are left in ${answer.camera}.` : "Dragged; check it, then go.";
  if (tree.done) stats.dragged = answer;
  redraw();
}

// By buttons: of the dragged outline, in the picture in which it was dragged last, or of the body in the first one.
const changed = (change) => dragged({ camera: lastCamera ?? views.keys().next().value, shift: [0, 0], draft: hasDraft, done: true, ...change });

async function go() {
  const answer = await command({ do: "go" });
  if (!answer.ok) return;
  stats.goal = answer.id;
  hasDraft = false;
  for (const v of views.values()) v.draft = v.lines = null;
  redraw();
}

// -- the controls --------------------------------------------------------------------------------------------------

async function stop() {
  stopping ??= { since: performance.now(), why: "", asked: 0, answered: 0 };
  const mine = stopping;
  mine.asked += 1;
  setTimeout(watch, 1000 * STOP_S);
  const answer = await command({ do: "stop" });
  if (answer.ok) stopping = null;
  else Object.assign(mine, { why: answer.message, answered: performance.now() });
  mine.asked -= 1;
  watch();
}

function watchStop(now) {
  // A stop is asked for again until it is confirmed; who looks at the page is told meanwhile what stops the arm.
  const seconds = stopping ? (now - stopping.since) / 1000 : 0;
  const shown = stopping !== null && (seconds >= STOP_S || stopping.why !== "");
  if (shown) {
    $("unconfirmed-since").textContent = `${seconds.toFixed(1)} s`;
    $("unconfirmed-why").textContent = stopping.why;
    if (stopping.asked === 0 && socket?.readyState === WebSocket.OPEN && now - stopping.answered > 1000 * AGAIN_S) stop();
  }
  if ($("unconfirmed").hidden === shown) {
    $("unconfirmed").hidden = !shown;
    if (shown) $("stop-again").focus();
  }
}

$("stop").onclick = $("stop-again").onclick = stop;
$("stop-close").onclick = () => { stopping = null; watch(); };
addEventListener("keydown", (event) => { if (event.key === "Escape" && !flight) { event.preventDefault(); stop(); } });
for (const button of document.querySelectorAll("[data-do]")) {
  const verb = button.dataset.do;
  button.onclick = () => command(verb === "check-model" ? { do: "calibrate", check: true } : { do: verb });
}
$("check").onclick = () => check();
$("step").onsubmit = checkStep;
$("step-axis").onchange = () => { $("step-unit").textContent = $("step-axis").value.startsWith("move") ? "mm" : "°"; };
$("go").onclick = go;
$("turn-left").onclick = () => changed({ turn: -Math.PI / 36 });
$("turn-right").onclick = () => changed({ turn: Math.PI / 36 });
$("nearer").onclick = () => changed({ nearer: 0.98 });
$("farther").onclick = () => changed({ nearer: 1 / 0.98 });
$("take").onsubmit = (event) => { event.preventDefault(); command({ do: "take", token: $("token").value.trim() }); $("token").value = ""; };
$("teach").onsubmit = (event) => { event.preventDefault(); command({ do: "teach", name: $("teach-name").value }); };
$("play").onclick = () => command({ do: "play", playing: !flight.playing });
$("speed").onchange = () => request({ do: "play", playing: flight.playing, speed: Number($("speed").value) });
$("time").oninput = seek;
let orbit = null;
$("scene").onpointerdown = (event) => { orbit = [event.clientX, event.clientY]; $("scene").setPointerCapture(event.pointerId); };
$("scene").onpointermove = (event) => {
  if (!orbit) return;
  turn = [turn[0] + (event.clientX - orbit[0]) / 100, turn[1] + (event.clientY - orbit[1]) / 100];
  orbit = [event.clientX, event.clientY];
};
$("scene").onpointerup = () => { orbit = null; };
setInterval(watch, 100);
setInterval(() => {
  drawPlot($("plot-error"), history.error, ["error"], true);
  drawPlot($("plot-velocity"), history.velocity, joints, false);
  drawPlot($("plot-loop"), history.loop, ["lateness"], false);
  drawReasons($("plot-reasons"), history.reasons);
  $("scene-box").hidden = !scene;
  if (scene) drawScene($("scene"), scene, sceneGoal, turn);
}, 250);
connect();
