"use strict";
// Plays the drives: robot, prediction and samples move over the drawing of the course.
for (const box of document.querySelectorAll(".film")) {
  const film = JSON.parse(box.querySelector("script").textContent);
  const svg = box.closest("figure").querySelector("svg");
  const [button, slider, says, readings] = box.children;
  const last = film.times.length - 1, seconds = film.times[last];
  const fast = Math.max(1, seconds / 15);
  const size = 0.022 * svg.viewBox.baseVal.width;
  const add = (name, attributes, parent) => {
    const made = document.createElementNS(svg.namespaceURI, name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    return parent.appendChild(made);
  };
  const layer = add("g", {class: "moving"}, svg);
  const count = film.samples.length ? film.samples[0].length / 2 : 0;
  const samples = Array.from({length: count}, () =>
    add("circle", {r: 0.3 * size, style: "fill: var(--muted); opacity: .55"}, layer));
  const arrow = (ink) => add("path", {
    d: "M 1 0 L -.6 .6 L -.25 0 L -.6 -.6 Z",
    style: `fill: var(--${ink}); stroke: var(--paper); stroke-width: .12`,
  }, layer);
  const arrows = [[arrow("predicted"), film.predicted], [arrow("actual"), film.robot]];
  const meters = film.names.map((name) => {
    const label = readings.appendChild(document.createElement("label"));
    label.textContent = `${name} `;
    return label.appendChild(document.createElement("meter"));
  });
  const show = (frame) => {
    for (const [shape, poses] of arrows) {
      const pose = poses[frame];
      shape.style.display = pose ? "" : "none";
      if (pose) {
        const [x, y, turn] = pose;
        shape.setAttribute("transform", `translate(${x} ${y}) rotate(${turn}) scale(${size})`);
      }
    }
    samples.forEach((dot, which) => {
      dot.setAttribute("cx", film.samples[frame][2 * which]);
      dot.setAttribute("cy", film.samples[frame][2 * which + 1]);
    });
    meters.forEach((meter, which) => { meter.value = film.readings[frame][which]; });
    slider.value = frame;
    const speed = fast > 1.05 ? `, ${fast.toFixed(1)} times as fast` : "";
    says.textContent = `${film.times[frame].toFixed(1)} of ${seconds.toFixed(1)} s${speed}`;
  };
  let begun = null;
  const stop = () => { begun = null; button.textContent = "Play"; };
  const step = (now) => {
    if (begun === null) return;
    const frame = Math.min(last, Math.floor((now - begun) / 1000 * fast / seconds * last));
    show(Math.max(0, frame));
    if (frame < last) requestAnimationFrame(step); else stop();
  };
  button.addEventListener("click", () => {
    if (begun !== null) return stop();
    const from = Number(slider.value) >= last ? 0 : Number(slider.value);
    begun = performance.now() - from / last * seconds / fast * 1000;
    button.textContent = "Pause";
    requestAnimationFrame(step);
  });
  slider.max = last;
  slider.addEventListener("input", () => { stop(); show(Number(slider.value)); });
  box.hidden = false;
  show(0);
}
