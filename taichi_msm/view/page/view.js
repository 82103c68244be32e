// Page of a live session: receives pictures and readings by a WebSocket, and sends events of pointer, keys and sliders.
"use strict";

const element = id => document.getElementById(id);
const canvas = element("picture");
const picture = canvas.getContext("2d");

// The plot over time shows these last seconds; the one over depth all readings, up to this number.
const WINDOW_S = 8, MAX_READINGS = 3000;
const MATERIAL_INTERVAL_MS = 80;
const WHEEL_NOTCH_PX = 100, WHEEL_NOTCH_LINES = 3;
const RETRY_MS = 1000;

let socket = null, session = null, state = null, ended = false, mode = "press";
let readings = [];

// A reloaded page keeps its name, and so the tool.
const pageName = sessionStorage.getItem("name") ?? crypto.getRandomValues(new Uint32Array(4)).join("-");
sessionStorage.setItem("name", pageName);

// ---- numbers

const PREFIXES = [[1e9, "G"], [1e6, "M"], [1e3, "k"], [1, ""], [1e-3, "m"], [1e-6, "µ"]];

function withPrefix(value, unit) {
  const size = Math.abs(value);
  const [factor, prefix] = size === 0 ? [1, ""] : PREFIXES.find(([factor]) => size >= factor * 0.9995) ?? PREFIXES.at(-1);
  return [digits(value / factor), prefix + unit];
}

function digits(value) {
  const size = Math.abs(value);
  return value.toFixed(size >= 99.95 ? 0 : size >= 9.995 ? 1 : 2).replace("-", "−");
}

function physical(value, unit) {
  return unit === "1/s" ? `${Number(value.toPrecision(3))} ${unit}` : withPrefix(value, unit).join(" ");
}

function showNumber(id, number, unit) {
  const small = document.createElement("small");
  small.textContent = ` ${unit}`;
  element(id).replaceChildren(number, small);
}

// ---- connection

function send(...message) {
  if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}

function steer(...message) {
  if (state?.steers) send(...message);
}

function connect() {
  const url = new URL(`socket?name=${pageName}`, location.href);
  url.protocol = url.protocol.replace("http", "ws");
  socket = new WebSocket(url);
  socket.binaryType = "arraybuffer";
  let drawn = Promise.resolve();
  socket.onmessage = ({data}) => {
    if (typeof data === "string") receive(JSON.parse(data));
    else drawn = drawn.then(() => receivePicture(data));
  };
  socket.onclose = () => {
    state = null;
    showRole();
    if (!ended) setTimeout(connect, RETRY_MS);
  };
}

function receive(message) {
  if (message.size) describe(message);
  else if (message.scenes) { ended = true; setTimeout(() => location.reload(), RETRY_MS); }
  else if (message.ended) { ended = true; showNotice("the session has ended"); }
  else if (message.notice) showNotice(message.notice);
  else if (message.error) console.error(message.error);
}

async function receivePicture(data) {
  const length = new DataView(data).getUint32(0);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
  if (data.byteLength > 4 + length) {
    const image = await createImageBitmap(new Blob([new Uint8Array(data, 4 + length)], {type: "image/jpeg"}));
    [canvas.width, canvas.height] = [image.width, image.height];
    picture.drawImage(image, 0, 0);
    image.close();
  }
  send("shown");
  update(header);
}

// ---- state

function describe(message) {
  session = message;
  readings = [];
  document.title = element("title").textContent = session.title;
  sendWidth();
  document.documentElement.style.setProperty("--ratio", session.size[0] / session.size[1]);
  document.querySelectorAll(".material").forEach(row => row.remove());
  session.material.forEach(entry => element("sliders").append(materialRow(entry)));
  for (const button of document.querySelectorAll("button[data-key]")) {
    button.title = `${session.keys[button.dataset.key]} (${button.dataset.key})`;
  }
  element("keys").replaceChildren(...Object.entries(session.keys).map(pair => {
    const row = document.createElement("tr");
    row.append(...pair.map(text => Object.assign(document.createElement("td"), {textContent: text})));
    return row;
  }));
}

function update(next) {
  state = next;
  for (const reading of state.readings) {
    if (readings.length && reading[0] <= readings.at(-1)[0]) readings = [];
    readings.push(reading);
  }
  if (state.time === 0) readings = [];
  readings.splice(0, Math.max(0, readings.length - MAX_READINGS));
  const [, force, depth] = readings.at(-1) ?? [0, 0, 0];
  showNumber("force", ...withPrefix(Math.abs(force) < 1e-6 ? 0 : force, "N"));
  showNumber("depth", digits(1e3 * depth), "mm");
  showNumber("time", state.time.toFixed(1), "s");
  element("pacing").textContent = state.speed < 0.95 ? `too slow: ${state.speed.toFixed(2)} × real time` : `${state.rate} pictures/s`;
  element("pacing").classList.toggle("slow", state.speed < 0.95);
  showSaved();
  showNotice(state.notice);
  showRole();
  showControls();
  plotSoon();
}

function showNotice(text) {
  if (text) element("notice").textContent = text;
  element("notice").classList.toggle("shown", Boolean(text));
}

function showSaved() {
  const names = state.saved.join("/"), list = element("saved");
  if (list.dataset.names === names) return;
  list.dataset.names = names;
  list.hidden = !names;
  list.replaceChildren("Download: ", ...state.saved.map(name => Object.assign(document.createElement("a"), {
    textContent: name, download: name, href: `saved/${encodeURIComponent(name)}`,
  })));
}

function showRole() {
  const others = state?.watching ?? 0, role = element("role");
  role.textContent = ended ? "ended" : !state ? "no connection" : state.asks ? "asking the page that steers" : state.was_refused && !state.steers ? "refused; the next time it cannot" : !state.steers ? "watching"
    : others ? `you steer, ${others} watching` : "you steer";
  role.className = ended || !state ? "lost" : state.steers ? "steers" : "";
  element("take-over").hidden = !state || state.steers || state.asks;
  element("scenes").hidden = !session?.has_scenes || !state?.steers;
  element("question").hidden = !state?.is_asked;
  document.body.classList.toggle("watching", !state?.steers);
  for (const id of ["controls", "sliders", "view"]) element(id).disabled = !state?.steers;
}

function showControls() {
  const pressed = {pause: state.paused, film: state.filming, "by-position": state.by_position, mesh: state.mesh, light: state.light};
  for (const [id, on] of Object.entries(pressed)) element(id).setAttribute("aria-pressed", on);
  element("pause").lastChild.textContent = state.paused ? "Go on" : "Pause";
  const strength = element("strength");
  element("strength-name").textContent = state.by_position ? "Tool depth" : "Tool force";
  element("strength-value").textContent = `${Math.round(state.strength)} %`;
  strength.min = state.strength < 0 ? -100 : 0;
  if (!held.has(strength)) strength.value = state.strength;
  for (const {key, unit, initial} of session.material) {
    const [slider, output] = [element(key), element(`${key}-value`)], value = state.material[key];
    output.textContent = physical(value, unit);
    output.classList.toggle("changed", Math.abs(value / initial - 1) > 1e-3);
    if (!held.has(slider)) slider.value = Math.log10(value / initial);
  }
}

// ---- sliders: a held one does not follow the session

const held = new Set();

function hold(slider) {
  slider.addEventListener("pointerdown", () => held.add(slider));
  slider.addEventListener("input", () => held.add(slider));
  slider.addEventListener("change", () => setTimeout(() => held.delete(slider), 400));
}

function materialRow({key, name, initial}) {
  const row = document.createElement("label");
  row.className = "material";
  row.title = `${key}; a double click sets the scene's value`;
  const slider = Object.assign(document.createElement("input"), {id: key, type: "range", step: 0.005});
  slider.max = Math.log10(session.max_factor);
  slider.min = -slider.max;
  const label = Object.assign(document.createElement("span"), {textContent: name[0].toUpperCase() + name.slice(1)});
  row.append(label, Object.assign(document.createElement("output"), {id: `${key}-value`}), slider);
  let waiting = false;
  const apply = () => {
    // Every value restarts the solver.
    if (waiting) return;
    waiting = true;
    setTimeout(() => { waiting = false; steer("material", key, initial * 10 ** slider.value); }, MATERIAL_INTERVAL_MS);
  };
  slider.addEventListener("input", apply);
  slider.addEventListener("dblclick", () => { slider.value = 0; apply(); });
  hold(slider);
  return row;
}

hold(element("strength"));
element("strength").addEventListener("input", ({target}) => steer("strength", Number(target.value)));

// ---- pointer, wheel and touch

const pointers = new Map();
let action = null, last = null;

function pixel(event) {
  // Pixels of the scene's picture; whole numbers are their centres.
  const box = canvas.getBoundingClientRect(), scale = session.size[0] / box.width;
  return [event.clientX - box.left, event.clientY - box.top].map(length => Math.round(100 * (scale * length - 0.5)) / 100);
}

function centre() {
  const places = [...pointers.values()];
  return [0, 1].map(axis => places.reduce((sum, place) => sum + place[axis], 0) / places.length);
}

function letGo() {
  if (action === "press") steer("release");
  action = null;
}

canvas.addEventListener("pointerdown", event => {
  document.activeElement?.blur();
  try { canvas.setPointerCapture(event.pointerId); } catch { /* a pointer that has gone */ }
  pointers.set(event.pointerId, pixel(event));
  const turns = event.button === 2 || mode === "turn" || pointers.size > 1;
  if (turns) {
    letGo();
    action = "turn";
    last = centre();
  } else if (event.button === 0) {
    action = "press";
    steer("press", ...pixel(event), event.shiftKey !== (mode === "pull"));
  }
  event.preventDefault();
});

canvas.addEventListener("pointermove", event => {
  const place = pixel(event);
  if (pointers.has(event.pointerId)) pointers.set(event.pointerId, place);
  if (action === "turn") {
    const now = centre();
    steer("turn", now[0] - last[0], now[1] - last[1]);
    last = now;
  } else if (action === "press") {
    if (pointers.has(event.pointerId)) steer("drag", ...place);
  } else {
    steer("hover", ...place);
  }
});

for (const name of ["pointerup", "pointercancel"]) {
  canvas.addEventListener(name, event => {
    pointers.delete(event.pointerId);
    // After a turn, a remaining finger does nothing.
    if (pointers.size === 0) letGo();
    else last = centre();
  });
}

window.addEventListener("blur", () => { pointers.clear(); letGo(); });
canvas.addEventListener("contextmenu", event => event.preventDefault());
canvas.addEventListener("wheel", event => {
  event.preventDefault();
  const notches = event.deltaY / (event.deltaMode === WheelEvent.DOM_DELTA_LINE ? WHEEL_NOTCH_LINES : WHEEL_NOTCH_PX);
  steer("strengthchange", -session.strength_step * notches);
}, {passive: false});

// ---- keys and buttons

const NAMES = {" ": "space", "=": "up", "+": "up", ArrowUp: "up", "-": "down", ArrowDown: "down"};

function keyName(event) {
  // A key that types no Latin letter is named by its position.
  const typed = event.key.length === 1 && event.key > "\x7f" ? event.code.replace("Key", "") : event.key;
  const name = NAMES[typed] ?? typed.toLowerCase();
  return session && name in session.keys ? name : null;
}

window.addEventListener("keydown", event => {
  const name = keyName(event), {target} = event;
  const taken = (target.tagName === "BUTTON" && name === "space") || (target.tagName === "INPUT" && event.key.startsWith("Arrow"));
  if (!name || taken || event.ctrlKey || event.metaKey || event.altKey || (element("help").open && name !== "h")) return;
  event.preventDefault();
  // Only keys of the strength repeat.
  if (!event.repeat || name === "up" || name === "down") press(name);
});

function press(name) {
  if (name === "h") element("help").open ? element("help").close() : element("help").showModal();
  else if (name === "i") document.body.classList.toggle("bare");
  else steer("key", name);
}

for (const button of document.querySelectorAll("button[data-key]")) {
  button.addEventListener("click", () => press(button.dataset.key));
}

for (const button of document.querySelectorAll("button[data-mode]")) {
  button.addEventListener("click", () => {
    mode = button.dataset.mode;
    document.querySelectorAll("button[data-mode]").forEach(each => each.setAttribute("aria-pressed", each === button));
  });
}

for (const [id, ...message] of [["take-over", "takeover"], ["give", "answer", true], ["refuse", "answer", false], ["scenes", "scenes"]]) {
  element(id).addEventListener("click", () => send(...message));
}

element("full-screen").hidden = !document.fullscreenEnabled;
element("full-screen").addEventListener("click", () => {
  if (document.fullscreenElement) document.exitFullscreen();
  else document.documentElement.requestFullscreen();
});

// The server draws the picture with the pixels of this screen if it is fast enough.
function sendWidth() {
  if (session) send("width", Math.round(canvas.clientWidth * devicePixelRatio));
}

new ResizeObserver(sendWidth).observe(canvas);

// ---- plots

let isPending = false;

function plotSoon() {
  if (isPending) return;
  isPending = true;
  requestAnimationFrame(() => { isPending = false; drawPlots(); });
}

function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`);
}

// About `count` multiples of a round step between two values.
function ticks(low, high, count) {
  const rough = (high - low) / count, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map(digit => digit * power).find(step => step >= rough * 0.999);
  const result = [];
  for (let n = Math.ceil(low / step - 1e-9); n * step <= high + 1e-9 * step; n++) result.push(n * step);
  return result;
}

// Limits of an axis: 0 or a round number below the values, and a round number above them; at least minLength apart.
function range(values, minLength) {
  const low = Math.min(0, ...values), high = Math.max(low + minLength, ...values);
  const step = ticks(low, high, 3)[1] - ticks(low, high, 3)[0];
  return [low < -1e-9 ? Math.floor(low / step) * step : 0, Math.ceil(high / step - 1e-9) * step];
}

function drawPlot(id, points, [left, right], [bottom, top], {x, y, fades}) {
  const plot = element(id), width = plot.clientWidth, height = plot.clientHeight, ratio = devicePixelRatio;
  if (plot.width !== Math.round(width * ratio) || plot.height !== Math.round(height * ratio)) {
    [plot.width, plot.height] = [width * ratio, height * ratio];
  }
  const pen = plot.getContext("2d"), edge = {left: 40, right: 10, top: 8, bottom: 20};
  const column = value => edge.left + (value - left) / (right - left) * (width - edge.left - edge.right);
  const row = value => height - edge.bottom - (value - bottom) / (top - bottom) * (height - edge.top - edge.bottom);
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  pen.font = "11px system-ui, sans-serif";
  pen.fillStyle = colour("quiet");
  pen.strokeStyle = colour("line");
  pen.lineWidth = 1;
  const text = value => Number(value.toPrecision(6)).toString().replace("-", "−");
  pen.textAlign = "right";
  pen.textBaseline = "middle";
  const rows = ticks(bottom, top, 3), columns = ticks(left, right, 4);
  rows.forEach((value, n) => {
    pen.beginPath();
    pen.moveTo(edge.left, row(value));
    pen.lineTo(width - edge.right, row(value));
    pen.stroke();
    pen.fillText(n === rows.length - 1 ? `${text(value)} ${y}` : text(value), edge.left - 6, row(value));
  });
  pen.textBaseline = "alphabetic";
  columns.forEach((value, n) => {
    pen.textAlign = n === columns.length - 1 && column(value) > width - 30 ? "right" : "center";
    const end = pen.textAlign === "right" ? width - edge.right + 6 : column(value);
    pen.fillText(n === columns.length - 1 ? `${text(value)} ${x}` : text(value), end, height - 5);
  });
  if (points.length === 0) return;
  pen.save();
  pen.beginPath();
  pen.rect(edge.left, 0, width - edge.left, height);
  pen.clip();
  pen.lineJoin = pen.lineCap = "round";
  pen.lineWidth = 2;
  pen.strokeStyle = colour("force");
  if (fades) {
    // Older pieces of the line are more transparent.
    const pieces = 24, size = Math.ceil(points.length / pieces);
    for (let begin = 0; begin < points.length; begin += size) {
      pen.globalAlpha = 0.35 + 0.65 * Math.min(1, (begin + size) / points.length);
      pen.beginPath();
      points.slice(begin, begin + size + 1).forEach(([a, b]) => pen.lineTo(column(a), row(b)));
      pen.stroke();
    }
  } else {
    pen.beginPath();
    points.forEach(([a, b]) => pen.lineTo(column(a), row(b)));
    pen.stroke();
    pen.lineTo(column(points.at(-1)[0]), row(0));
    pen.lineTo(column(points[0][0]), row(0));
    pen.fillStyle = colour("force");
    pen.globalAlpha = 0.12;
    pen.fill();
  }
  pen.globalAlpha = 1;
  pen.fillStyle = colour(fades ? "depth" : "force");
  pen.beginPath();
  pen.arc(column(points.at(-1)[0]), row(points.at(-1)[1]), 3.5, 0, 2 * Math.PI);
  pen.fill();
  pen.restore();
}

function drawPlots() {
  if (!state) return;
  const largest = Math.max(0, ...readings.map(([, force]) => force));
  const [factor, unit] = largest > 0 && largest < 0.1 ? [1e3, "mN"] : largest >= 1000 ? [1e-3, "kN"] : [1, "N"];
  const forces = readings.map(([, force]) => force * factor), depths = readings.map(([, , depth]) => 1e3 * depth);
  const axis = range(forces, factor === 1 ? 0.1 : 1), end = Math.max(WINDOW_S, state.time);
  drawPlot("by-time", readings.map(([time], n) => [time, forces[n]]), [end - WINDOW_S, end], axis, {x: "s", y: unit});
  drawPlot("by-depth", depths.map((depth, n) => [depth, forces[n]]), range(depths, 1), axis, {x: "mm", y: unit, fades: true});
}

window.addEventListener("resize", plotSoon);
connect();
