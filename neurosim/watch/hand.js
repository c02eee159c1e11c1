"use strict";

// Driving by hand: keys, buttons and game pads move levers; the server is told where these are ten
// times a second, and at once when one moves. It stops the robot when it hears nothing.

const TELL_EVERY = 100; // ms
const DEAD_BAND = 0.12; // of a game pad's stick
const PAGE = Array.from(crypto.getRandomValues(new Uint32Array(2)), (n) => n.toString(36)).join("");

let levers = []; // name, keys and axis of each, as the server said
let driving = false; // whether the robot may be driven
let speed = 100; // of a lever at its end, percent
let told = ""; // what was sent last
let telling = false; // a request is under way
const down = new Set(); // keys and buttons that are pressed, by code

function showHand(hand) {
  if (hand.levers.length !== levers.length) {
    levers = hand.levers;
    makeKeys();
    makeGiven(hand.given);
  }
  driving = hand.phase === "driving";
  element("hand").hidden = false;
  const waits = { starting: "wait: the robot stands still for its first pictures", over: "the recording has ended" };
  const standing = waits[hand.phase] ?? hand.standing;
  text("standing", standing || "driving");
  element("standing").classList.toggle("wrong", driving && !["", "ready"].includes(standing));
  text("elapsed", `${hand.seconds.toFixed(1)} s`);
  text("count", String(hand.commands));
  for (const one of hand.given) {
    text(`given-${one.name}`, `${one.name}: ${Number(one.value.toPrecision(3))} ${one.unit}`);
    element(`meter-${one.name}`).value = one.value;
  }
  element("end").disabled = !driving;
}

function makeKeys() {
  element("levers").replaceChildren(...levers.map((lever) => {
    const line = document.createElement("li");
    line.append(lever.name, makeKey(lever.push, "+"), makeKey(lever.pull, "−"));
    return line;
  }));
}

function makeKey(codes, sign) {
  const button = document.createElement("button");
  const names = { ArrowUp: "↑", ArrowDown: "↓", ArrowLeft: "←", ArrowRight: "→" };
  button.type = "button";
  button.tabIndex = -1; // the keys themselves are there for who has no mouse
  button.dataset.codes = codes.join(" ");
  button.textContent = [...codes.map((code) => names[code] ?? code.replace("Key", "")), sign].join(" ");
  const own = `button ${codes[0]}`;
  button.addEventListener("pointerdown", (event) => {
    button.setPointerCapture(event.pointerId);
    press(own, true);
  });
  for (const kind of ["pointerup", "pointercancel", "lostpointercapture"]) {
    button.addEventListener(kind, () => press(own, false));
  }
  return button;
}

function makeGiven(given) {
  element("given").replaceChildren(...given.map((one) => {
    const line = document.createElement("li");
    const words = document.createElement("span");
    const meter = document.createElement("meter");
    [words.id, meter.id] = [`given-${one.name}`, `meter-${one.name}`];
    [meter.min, meter.max, meter.value] = [one.low, one.high, 0];
    meter.setAttribute("aria-label", one.name);
    line.append(words, meter);
    return line;
  }));
}

// Where the levers are

function isDown(codes) {
  return codes.some((code) => down.has(code) || down.has(`button ${code}`));
}

function stick(lever, pads) {
  if (lever.axis === null) return 0;
  let most = 0;
  for (const pad of pads) {
    const value = -(pad.axes[lever.axis] ?? 0); // up and left are negative
    const beyond = Math.max(Math.abs(value) - DEAD_BAND, 0) / (1 - DEAD_BAND);
    if (beyond > Math.abs(most)) most = Math.sign(value) * beyond;
  }
  return most;
}

function positions() {
  const pads = Array.from(navigator.getGamepads()).filter((pad) => pad && pad.connected);
  text("pad", pads.length ? `game pad: ${pads.map((pad) => pad.id).join(", ")}` : "no game pad");
  return levers.map((lever) => {
    const keys = Number(isDown(lever.push)) - Number(isDown(lever.pull));
    const value = keys || stick(lever, pads);
    return Math.round(Math.min(Math.max(value, -1), 1) * 1000) / 1000;
  });
}

function press(code, pressed) {
  if (pressed) down.add(code);
  else down.delete(code);
  for (const button of document.querySelectorAll("[data-codes]")) {
    button.classList.toggle("down", isDown(button.dataset.codes.split(" ")));
  }
  tellHand();
}

// To the server

async function tellHand(again = false) {
  if (!driving || document.hidden || document.body.dataset.ended) return;
  const share = (speed / 100) * (down.has("Shift") ? 0.5 : 1);
  const body = JSON.stringify({ page: PAGE, levers: positions(), speed: share });
  if (telling || (!again && body === told)) return;
  telling = true;
  told = body;
  try {
    const reply = await fetch("drive", {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body,
    });
    const answer = await reply.json();
    if (answer.error) {
      text("standing", answer.error);
      element("standing").classList.add("wrong");
    } else showHand(answer);
  } catch {
    text("standing", "neurosim does not answer; the robot was stopped");
    element("standing").classList.add("wrong");
  }
  telling = false;
  tellHand(); // what was pressed meanwhile
}

function leave() {
  down.clear();
  told = "";
  if (!levers.length) return;
  fetch("drive", {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify({ page: PAGE, levers: null }),
    keepalive: true,
  }).catch(() => {});
}

setInterval(() => tellHand(true), TELL_EVERY);
setInterval(tellHand, TELL_EVERY / 3); // sticks say nothing when they move
window.addEventListener("pagehide", leave);
document.addEventListener("visibilitychange", () => { if (document.hidden) leave(); });
// Keys that are let go elsewhere are never heard of.
window.addEventListener("blur", () => { down.clear(); tellHand(); });

function key(event, pressed) {
  if (event.key === "Meta") down.clear(); // while it is down, some systems hide that others go up
  if (event.code.startsWith("Shift")) press("Shift", pressed);
  const ours = levers.some((lever) => [...lever.push, ...lever.pull].includes(event.code));
  if (!ours || (pressed && (event.ctrlKey || event.altKey || event.metaKey))) return;
  event.preventDefault();
  if (!event.repeat) press(event.code, pressed);
}

document.addEventListener("keydown", (event) => key(event, true));
document.addEventListener("keyup", (event) => key(event, false));
for (const [id, step] of [["slower", -10], ["faster", 10]]) {
  element(id).addEventListener("click", () => {
    speed = Math.min(Math.max(speed + step, 10), 100);
    text("speed", `${speed} %`);
  });
}
element("end").addEventListener("click", async () => {
  leave();
  driving = false;
  await fetch("end", { method: "POST", headers: { "Content-Type": "application/json" }, body: "{}" });
});
