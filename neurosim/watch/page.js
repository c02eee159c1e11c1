"use strict";

const element = (id) => document.getElementById(id);
const canvas = element("picture");
const pen = canvas.getContext("2d");
const loupe = element("loupe");
const CORNERS = ["top left", "top right", "bottom right", "bottom left"];
const TRAIL = 150;

let state = null; // what the server said last
let picture = null; // the newest picture, as a bitmap
let drawing = { number: 0, free: [], solid: [], clicks: [] }; // the place, as lines of pixels
let mode = null; // what the next click sets: front, rear, a corner, or a part of the place
let cross = null; // where the cross is, in pixels of the picture
let trail = [];

// The newest picture, again and again: the next is asked for when this one is drawn.

async function follow() {
  let after = 0;
  for (;;) {
    try {
      const reply = await fetch(`picture?after=${after}`, { cache: "no-store" });
      if (!reply.ok) throw new Error(reply.statusText);
      state = JSON.parse(reply.headers.get("Neurosim-State"));
      const data = await reply.blob();
      if (data.size) {
        const next = await createImageBitmap(data);
        if (picture) picture.close();
        picture = next;
        remember();
      }
      after = state.number;
      if (drawing.number !== state.drawing) drawing = await (await fetch("drawing")).json();
      draw();
      tell();
      if (state.ended) return;
    } catch {
      status("bad", "neurosim has ended; start it again and open its new address");
      document.body.dataset.ended = "true";
      return;
    }
  }
}

function remember() {
  const middle = state.in_view ? [0, 1].map((i) => (state.front[i] + state.rear[i]) / 2) : null;
  trail.push(middle);
  if (trail.length > TRAIL) trail.shift();
}

// The picture and what is drawn over it

function draw() {
  if (!picture) return;
  if (canvas.width !== picture.width || canvas.height !== picture.height) {
    canvas.width = picture.width;
    canvas.height = picture.height;
    // As large as the window is wide, or high.
    canvas.parentElement.style.maxWidth = `${(66 * canvas.width) / canvas.height}vh`;
  }
  pen.drawImage(picture, 0, 0);
  const unit = canvas.width / 640;
  pen.lineJoin = "round";
  for (const line of state.grid) path(line, "rgba(0, 114, 178, .55)", unit);
  for (const line of drawing.free) path(line, "#00e0d0", 1.5 * unit);
  for (const line of drawing.solid) path(line, "#ff7a1a", 2 * unit);
  path(drawing.clicks, "#ffd400", 1.5 * unit);
  for (const [u, v] of drawing.clicks) plus(u, v, 5 * unit, "#ffd400", 1.5 * unit);
  for (const [name, [u, v]] of Object.entries(state.corners)) {
    plus(u, v, 7 * unit, name === mode ? "#ffd400" : "#00a0ff", 2 * unit);
  }
  let part = [];
  for (const place of [...trail, null]) {
    if (place) part.push(place);
    else {
      if (part.length > 1) path(part, "rgba(255, 220, 0, .9)", 1.5 * unit);
      part = [];
    }
  }
  if (state.in_view) drawRobot(unit);
  if (cross) plus(cross[0], cross[1], 12 * unit, "#ffd400", 1.5 * unit);
}

function drawRobot(unit) {
  const [front, rear] = [state.front, state.rear];
  const axis = [front[0] - rear[0], front[1] - rear[1]];
  const radius = Math.max(4 * unit, 0.28 * Math.hypot(...axis));
  for (const [which, place] of [["front", front], ["rear", rear]]) {
    pen.lineWidth = 2 * unit;
    pen.strokeStyle = state.colours[which].swatch;
    pen.beginPath();
    pen.arc(place[0] + 0.5, place[1] + 0.5, radius, 0, 2 * Math.PI);
    pen.stroke();
    plus(place[0], place[1], 2 * unit, "#000", unit);
  }
  const at = (share) => [front[0] + share * axis[0], front[1] + share * axis[1]];
  const [tip, foot] = [at(0.9), at(0.35)];
  const side = [-0.15 * axis[1], 0.15 * axis[0]];
  const neck = at(0.65);
  path([foot, tip], "#fff", 2 * unit);
  path(
    [[neck[0] + side[0], neck[1] + side[1]], tip, [neck[0] - side[0], neck[1] - side[1]]],
    "#fff",
    2 * unit,
  );
}

// Pixel (0, 0) is the middle of the top left one, a canvas counts from its corner.
function path(points, colour, width) {
  pen.strokeStyle = colour;
  pen.lineWidth = width;
  pen.beginPath();
  for (const [u, v] of points) pen.lineTo(u + 0.5, v + 0.5);
  pen.stroke();
}

function plus(u, v, reach, colour, width) {
  path([[u - reach, v], [u + reach, v]], colour, width);
  path([[u, v - reach], [u, v + reach]], colour, width);
}

function magnify() {
  loupe.hidden = !(mode && cross && picture);
  if (loupe.hidden) return;
  const glass = loupe.getContext("2d");
  const reach = 11 * (canvas.width / 640);
  glass.imageSmoothingEnabled = false;
  glass.fillRect(0, 0, loupe.width, loupe.height);
  const span = 2 * reach;
  glass.drawImage(
    picture, cross[0] + 0.5 - reach, cross[1] + 0.5 - reach, span, span, 0, 0, loupe.width, loupe.height,
  );
  const middle = loupe.width / 2;
  glass.strokeStyle = "#ffd400";
  glass.beginPath();
  for (const [a, b, c, d] of [[-20, 0, -5, 0], [5, 0, 20, 0], [0, -20, 0, -5], [0, 5, 0, 20]]) {
    glass.moveTo(middle + a, middle + b);
    glass.lineTo(middle + c, middle + d);
  }
  glass.stroke();
  const scale = canvas.clientWidth / canvas.width;
  const [x, y] = [(cross[0] + 0.5) * scale, (cross[1] + 0.5) * scale];
  const size = 132 + 24;
  loupe.style.left = `${x + size < canvas.clientWidth ? x + 24 : x - size}px`;
  loupe.style.top = `${y > size ? y - size : y + 24}px`;
}

// Words and figures

function status(kind, text) {
  const line = element("status");
  line.className = `status ${kind}`;
  if (line.textContent !== text) line.textContent = text;
}

function text(id, words) {
  if (element(id).textContent !== words) element(id).textContent = words;
}

function tell() {
  text("label", state.label);
  if (state.ended) status("bad", state.ended);
  else if (state.seen_by === "nobody") status("good", "no camera");
  else if (state.stale) status("bad", "the camera gives no pictures");
  else if (state.seen_by === "camera") status("good", "filmed, not tracked");
  else if (state.lost) status("bad", `the robot is lost, for ${state.lost_for.toFixed(1)} s`);
  else if (!state.apart) status("bad", "the two markers' colours are too much alike");
  else if (!state.ever_seen) {
    status("bad", `the robot was not found yet; ${state.tag ? `is ${state.tag} in view?` : "are the colours right?"}`);
  }
  else status("good", "the robot is seen");
  const pose = state.pose;
  text("place", pose ? `${pose.x.toFixed(3)}, ${pose.y.toFixed(3)} m` : "–");
  text("heading", pose ? `${pose.degrees.toFixed(1)}°` : "–");
  text("quality", state.in_view ? state.quality.toFixed(2) : "–");
  text("fps", state.fps.toFixed(1));
  element("tag").hidden = !state.tag;
  element("how").hidden = element("colours").hidden = Boolean(state.tag);
  const others = state.others.length ? ` Other tags in view are ignored: ${state.others.join(", ")}.` : "";
  if (state.tag) text("tag", `The robot carries ${state.tag}.${others}`);
  for (const which of ["front", "rear"]) {
    const colour = state.colours[which];
    element(`${which}-swatch`).style.background = colour.swatch;
    text(`${which}-name`, colour.name);
    const found = colour.seen_as ? `found as ${colour.seen_as}` : "not found";
    const percent = colour.confidence === null ? "" : `, confidence ${Math.round(100 * colour.confidence)} %`;
    text(`${which}-confidence`, found + percent + (colour.reason ? `: ${colour.reason}` : ""));
  }
  for (const what of ["markers", "calibration", "place"]) {
    text(`${what}-file`, `${state.saved.includes(what) ? "saved in" : "goes to"} ${state.files[what]}`);
  }
  for (const button of document.querySelectorAll("[data-mode]")) {
    button.classList.toggle("set", button.dataset.mode in state.corners);
  }
  element("panel").hidden = !state.settable;
  element("keys").hidden = element("says").hidden = !state.settable;
  document.querySelector("main").classList.toggle("alone", !state.settable && !state.hand);
  document.querySelector(".view").hidden = state.seen_by === "nobody";
  if (state.hand) showHand(state.hand); // hand.js
  for (const name of ["length", "width", "height"]) {
    const field = element(name);
    if (field.dataset.touched || document.activeElement === field) continue;
    field.value = state.board[name] ?? "";
  }
  document.title = state.lost || state.ended ? "LOST · neurosim watch" : "neurosim watch";
}

function say(words, wrong, action) {
  const line = element("says");
  line.replaceChildren(words);
  line.classList.toggle("wrong", Boolean(wrong));
  if (!action) return;
  const button = document.createElement("button");
  button.type = "button";
  button.textContent = action.label;
  button.addEventListener("click", action.run);
  line.append(button);
}

// What is set

async function send(what, content) {
  let answer;
  try {
    const reply = await fetch(what, {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify(content),
    });
    answer = reply.ok ? await reply.json() : { error: await reply.text() };
  } catch {
    answer = { error: "neurosim does not answer; is it still running?" };
  }
  if (answer.error) {
    const again = what === "save" && answer.error.endsWith("replace it?");
    say(answer.error, true, again && { label: "Replace", run: () => send("save", { ...content, replace: true }) });
  } else {
    state.corners = answer.corners;
    say(answer.message);
  }
  return !answer.error;
}

function choose(next) {
  mode = next;
  for (const button of document.querySelectorAll("[data-mode]")) {
    button.setAttribute("aria-pressed", String(button.dataset.mode === mode));
  }
  canvas.classList.toggle("setting", mode !== null);
  magnify();
}

let setting = false; // a second click waits until the first is answered
async function set(u, v) {
  if (setting) return;
  setting = true;
  await take(u, v);
  setting = false;
}

async function take(u, v) {
  if (mode === "front" || mode === "rear") {
    const which = mode;
    if (await send("colour", { which, u, v })) {
      trail = [];
      choose(which === "front" ? "rear" : null);
    }
  } else if (CORNERS.includes(mode)) {
    if (await send("corner", { corner: mode, u, v })) {
      choose(CORNERS.find((name) => !(name in state.corners)) ?? null);
    }
  } else if (mode) await send("draw", { part: mode, u, v, width: lineWidth() });
  else if (state && state.settable) say("choose first what to set: a marker, a corner or a part of the place");
}

function placeOf(event) {
  const box = canvas.getBoundingClientRect();
  const scale = box.width / canvas.width;
  const [u, v] = [(event.clientX - box.left) / scale - 0.5, (event.clientY - box.top) / scale - 0.5];
  return [Math.min(Math.max(u, 0), canvas.width - 1), Math.min(Math.max(v, 0), canvas.height - 1)];
}

for (const button of document.querySelectorAll("[data-mode]")) {
  button.addEventListener("click", () => choose(mode === button.dataset.mode ? null : button.dataset.mode));
}
for (const button of document.querySelectorAll("[data-save]")) {
  button.addEventListener("click", () => send("save", { what: button.dataset.save }));
}
const read = (name) => Number(element(name).value.trim().replace(",", "."));
const lineWidth = () => read("line-width") || 0; // JSON has no NaN
element("finish").addEventListener("click", () => send("finish", { width: lineWidth() }));
element("undo").addEventListener("click", () => send("undo", {}));
element("clear").addEventListener("click", async () => {
  if (await send("clear", {})) choose(CORNERS[0]);
});
element("board").addEventListener("submit", async (event) => {
  event.preventDefault();
  const height = element("height").value.trim() === "" ? null : read("height");
  if ([read("length"), read("width"), height ?? 1].some((value) => !(value > 0))) {
    say("length and width are numbers of metres, such as 2.76; so is the height, if known", true);
    return;
  }
  if (await send("board", { length: read("length"), width: read("width"), height })) {
    for (const name of ["length", "width", "height"]) delete element(name).dataset.touched;
    const next = CORNERS.find((name) => !(name in state.corners));
    if (next) choose(next);
  }
});
for (const name of ["length", "width", "height"]) {
  element(name).addEventListener("input", (event) => { event.target.dataset.touched = "true"; });
}
canvas.addEventListener("pointermove", (event) => {
  if (!mode) return;
  cross = placeOf(event);
  draw();
  magnify();
});
canvas.addEventListener("pointerleave", () => { cross = null; draw(); magnify(); });
canvas.addEventListener("click", (event) => { if (picture) set(...placeOf(event)); });
canvas.addEventListener("keydown", (event) => {
  if (!state || !state.settable) return;
  const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  if (event.key === "Enter" && cross && picture) set(...cross);
  else if (event.key === "Escape") choose(null);
  else if (event.key in steps) {
    const length = event.shiftKey ? 10 : 1;
    const [u, v] = cross ?? [canvas.width / 2, canvas.height / 2];
    const limit = (value, size) => Math.min(Math.max(value, 0), size - 1);
    cross = [
      limit(u + length * steps[event.key][0], canvas.width),
      limit(v + length * steps[event.key][1], canvas.height),
    ];
    draw();
    magnify();
  } else return;
  event.preventDefault();
});

follow();
