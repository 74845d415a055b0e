"use strict";
// Plays the episodes of a page. Each `figure.player` holds its films as JSON, one for each of its canvases.
// experiments/page/player.py writes them: lengths in millimetres, relative to the middle of the picture.

function play(figure) {
  const films = JSON.parse(figure.querySelector("script").textContent);
  const canvases = [...figure.querySelectorAll("canvas")];
  const [button, slider, clock] = ["button", "input", ".clock"].map((name) => figure.querySelector(name));
  const longest = films.reduce((a, b) => (b.steps.length > a.steps.length ? b : a));
  const last = longest.steps.length - 1;
  let frame = 0, startedAt = null, startedFrom = 0;
  slider.max = last;

  function show() {
    films.forEach((film, i) => {
      const own = Math.min(frame, film.steps.length - 1);
      draw(canvases[i], film, own);
      const pane = canvases[i].parentNode;
      pane.querySelector(".return").textContent = film.returns[own] === null ? "-" : film.returns[own].toFixed(1);
      pane.querySelector(".cost").textContent = film.costs[own].toFixed(film.decimals);
      pane.querySelector(".ended").textContent = own < frame ? `ended after ${film.steps[own]} steps` : "";
      pane.classList.toggle("paid", film.paid[own] === 1 && own === frame);
    });
    const step = longest.steps[frame];
    slider.value = frame;
    slider.setAttribute("aria-valuetext", `step ${step}`);
    clock.textContent = `step ${step} of ${longest.steps[last]}, ${(step * longest.dt).toFixed(1)} s`;
  }

  function pause() {
    startedAt = null;
    button.textContent = "Play";
  }

  function tick(now) {
    if (startedAt === null) return;
    const passed = (now - startedAt) / 1000 + longest.steps[startedFrom] * longest.dt;
    while (frame < last && longest.steps[frame + 1] * longest.dt <= passed) frame++;
    show();
    if (frame === last) pause();
    else requestAnimationFrame(tick);
  }

  button.addEventListener("click", () => {
    if (startedAt !== null) return pause();
    startedFrom = frame = frame === last ? 0 : frame;
    startedAt = performance.now();
    show();
    button.textContent = "Pause";
    requestAnimationFrame(tick);
  });
  slider.addEventListener("input", () => {
    pause();
    frame = Number(slider.value);
    show();
  });
  new ResizeObserver(show).observe(figure);
  show();
}

function draw(canvas, film, frame) {
  const ratio = window.devicePixelRatio || 1, pen = canvas.getContext("2d");
  const width = canvas.clientWidth, height = width / film.aspect, scale = height / film.span;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  pen.scale(ratio, ratio);
  const [cx, cy] = film.centre[frame];
  const x = (v) => width / 2 + v * scale, y = (v) => height / 2 - v * scale;
  const line = (x1, y1, x2, y2) => { pen.beginPath(); pen.moveTo(x1, y1); pen.lineTo(x2, y2); pen.stroke(); };

  pen.lineWidth = 1;
  pen.strokeStyle = "#e3e6ea"; // lines one metre apart
  const first = (c, half) => Math.ceil((c - half) / 1000) * 1000 - c;
  for (let v = first(cx, width / 2 / scale); x(v) < width; v += 1000) line(x(v), 0, x(v), height);
  if (film.view === "side") {
    pen.strokeStyle = "#8a8f98"; // the floor
    line(0, y(-cy), width, y(-cy));
  } else {
    for (let v = first(cy, film.span / 2); y(v) > 0; v += 1000) line(0, y(v), width, y(v));
  }
  film.way.slice(0, frame + 1).forEach((end, i, way) => {
    if (i === 0) return;
    pen.strokeStyle = film.paid[i] ? film.red : "#8a8f98";
    pen.lineWidth = film.paid[i] ? 3 : 1.5;
    line(x(way[i - 1][0]), y(way[i - 1][1]), x(end[0]), y(end[1]));
  });
  film.shapes.forEach(([color, thickness, isRound, isBody], i) => {
    const still = film.still[i], moving = film.moving[frame];
    const [x1, y1, x2, y2] = still === null ? moving.slice(4 * film.place[i], 4 * film.place[i] + 4) : still;
    pen.strokeStyle = isBody && film.paid[frame] ? film.red : color;
    pen.lineCap = isRound ? "round" : "butt";
    pen.lineWidth = Math.max(2, thickness * scale);
    line(x(x1), y(y1), x(x2) + 0.01, y(y2)); // a line of no length at all would not be drawn
  });
}

document.querySelectorAll("figure.player").forEach(play);
