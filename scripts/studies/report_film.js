"use strict";
// The film: membranes of all runs on a canvas, the reference filled, the others as outlines. Smooth in time between the frames that are kept.

const FILM = (() => {
  const film = DATA.film, canvas = document.getElementById("film"), M = DATA.vesicles, P = film.points;
  const last = film.times.length - 1;
  const bytes = (text) => Uint8Array.from(atob(text), (sign) => sign.charCodeAt(0)).buffer;
  const runs = film.runs.map((run) => run && { ...run, centers: new Float32Array(bytes(run.centers)), shapes: new Int16Array(bytes(run.shapes)) });
  const listeners = [];
  let at = 0, playing = false, before = 0, follow = -1, speed = 1;
  const whole = bounds();
  let view = { ...whole };

  /** Centre and half extent that hold all frames of all runs, and the walls. */
  function bounds() {
    const low = [Infinity, Infinity], high = [-Infinity, -Infinity];
    for (const run of runs) {
      if (!run) continue;
      const reach = [0, 0];
      for (let i = 0; i < run.shapes.length; i++) reach[i & 1] = Math.max(reach[i & 1], Math.abs(run.shapes[i]) * run.step);
      for (let i = 0; i < run.centers.length; i++) {
        low[i & 1] = Math.min(low[i & 1], run.centers[i] - reach[i & 1]);
        high[i & 1] = Math.max(high[i & 1], run.centers[i] + reach[i & 1]);
      }
    }
    for (const p of film.walls.flat()) for (const c of [0, 1]) [low[c], high[c]] = [Math.min(low[c], p[c]), Math.max(high[c], p[c])];
    return { x: (low[0] + high[0]) / 2, y: (low[1] + high[1]) / 2, halfX: 0.53 * (high[0] - low[0]), halfY: 0.53 * (high[1] - low[1]), zoom: 1 };
  }

  /** The centroid of a vesicle of a run at the time `at`, and how its two frames are weighed; null where the run has ended. */
  function sample(run, m) {
    if (!run || at > run.frames - 1 + 1e-6) return null;
    const k = Math.min(Math.floor(at + 1e-9), run.frames - 1), w = k + 1 < run.frames ? at - k : 0;
    const i = 2 * (k * M + m), j = w > 0 ? i + 2 * M : i, c = run.centers;
    return { x: (1 - w) * c[i] + w * c[j], y: (1 - w) * c[i + 1] + w * c[j + 1], k, w };
  }

  function scale() {
    return Math.min(canvas.clientWidth / (2 * view.halfX), canvas.clientHeight / (2 * view.halfY)) * view.zoom;
  }

  function origin() {
    const c = follow >= 0 ? sample(runs[0], follow) : null;
    return c ? [c.x + view.x - whole.x, c.y + view.y - whole.y] : [view.x, view.y];
  }

  /** A closed smooth curve through points in pixels (Catmull and Rom's). */
  function smooth(pen, points) {
    const n = points.length, p = (i) => points[(i + n) % n];
    pen.beginPath();
    pen.moveTo(p(0)[0], p(0)[1]);
    for (let i = 0; i < n; i++) {
      const [a, b, c, d] = [p(i - 1), p(i), p(i + 1), p(i + 2)];
      pen.bezierCurveTo(b[0] + (c[0] - a[0]) / 6, b[1] + (c[1] - a[1]) / 6, c[0] - (d[0] - b[0]) / 6, c[1] - (d[1] - b[1]) / 6, c[0], c[1]);
    }
    pen.closePath();
  }

  function draw() {
    const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    const pen = canvas.getContext("2d"), style = getComputedStyle(document.documentElement), colour = (name) => style.getPropertyValue(name).trim();
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.fillStyle = colour("--ground");
    pen.fillRect(0, 0, width, height);
    const s = scale(), [x0, y0] = origin(), X = (x) => width / 2 + (x - x0) * s, Y = (y) => height / 2 - (y - y0) * s;
    pen.lineWidth = 1.5;
    pen.strokeStyle = colour("--quiet");
    for (const wall of film.walls) {
      smooth(pen, wall.map(([x, y]) => [X(x), Y(y)]));
      pen.stroke();
    }
    runs.forEach((run, r) => {
      if (!run || !SHOWN[r]) return;
      pen.strokeStyle = r ? colour(`--run-${r - 1}`) : colour("--truth");
      pen.fillStyle = colour("--fill");
      pen.lineWidth = r ? 1.6 : 4;
      pen.setLineDash(r ? DATA.dashes[(r - 1) % DATA.dashes.length].map((d) => 1.6 * d) : []);
      for (let m = 0; m < M; m++) {
        const c = sample(run, m);
        if (!c) return;
        const i = 2 * P * (c.k * M + m), j = c.w > 0 ? i + 2 * P * M : i, q = run.shapes, f = run.step, points = [];
        for (let n = 0; n < 2 * P; n += 2) {
          points.push([X(c.x + f * ((1 - c.w) * q[i + n] + c.w * q[j + n])), Y(c.y + f * ((1 - c.w) * q[i + n + 1] + c.w * q[j + n + 1]))]);
        }
        smooth(pen, points);
        if (!r) pen.fill();
        pen.stroke();
      }
    });
    bar(pen, s, height, colour("--ink"), colour("--ground"));
    canvas.dataset.at = at.toFixed(3);
  }

  /** A bar of a round length. */
  function bar(pen, s, height, ink, ground) {
    const most = 120 / s, power = 10 ** Math.floor(Math.log10(most)), size = power * [5, 2, 1].find((f) => f * power <= most);
    pen.setLineDash([]);
    pen.fillStyle = ground;
    pen.globalAlpha = 0.8;
    pen.fillRect(8, height - 36, size * s + 16, 28);
    pen.globalAlpha = 1;
    pen.strokeStyle = pen.fillStyle = ink;
    pen.lineWidth = 2;
    pen.beginPath();
    pen.moveTo(16, height - 14);
    pen.lineTo(16 + size * s, height - 14);
    pen.stroke();
    pen.font = "12px system-ui, sans-serif";
    pen.fillText(`${readable(size)} R`, 16, height - 20);
  }

  function go(to) {
    at = Math.min(Math.max(to, 0), last);
    draw();
    for (const listener of listeners) listener(at, playing);
  }

  function play(on) {
    playing = on && last > 0;
    if (playing && at >= last) at = 0;
    before = 0;
    if (playing) requestAnimationFrame(advance);
    go(at);
  }

  function advance(now) {
    if (!playing) return;
    if (before) go(at + ((now - before) / 1000) * speed * (last / 20)); // at speed 1 all of it takes 20 s
    before = now;
    if (at >= last) play(false);
    else requestAnimationFrame(advance);
  }

  /** Zooms by a factor about a point of the canvas, in pixels from its middle. */
  function zoom(factor, dx = 0, dy = 0) {
    const old = scale();
    view.zoom = Math.min(Math.max(view.zoom * factor, 0.2), 2000);
    const s = scale();
    view.x += dx * (1 / old - 1 / s);
    view.y -= dy * (1 / old - 1 / s);
    draw();
  }

  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const box = canvas.getBoundingClientRect();
    zoom(Math.exp(-0.0015 * event.deltaY), event.clientX - box.left - box.width / 2, event.clientY - box.top - box.height / 2);
  }, { passive: false });
  canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    if (!canvas.hasPointerCapture(event.pointerId)) return;
    view.x -= event.movementX / scale();
    view.y += event.movementY / scale();
    draw();
  });
  canvas.addEventListener("keydown", (event) => {
    const actions = {
      " ": () => play(!playing),
      ArrowRight: () => go(Math.floor(at + 1e-6) + 1),
      ArrowLeft: () => go(Math.ceil(at - 1e-6) - 1),
      Home: () => go(0),
      End: () => go(last),
      "+": () => zoom(1.25),
      "=": () => zoom(1.25),
      "-": () => zoom(0.8),
      0: reset,
    };
    if (!actions[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    actions[event.key]();
  });

  function reset() {
    view = { ...whole };
    follow = -1;
    document.getElementById("camera").value = "-1";
    draw();
  }

  /** The camera goes with a vesicle of the reference, and shows some radii about it; or stands still for -1. */
  function camera(m) {
    reset();
    follow = m;
    document.getElementById("camera").value = String(m);
    if (m >= 0) view.zoom = Math.max(1, Math.min(canvas.clientWidth, canvas.clientHeight) / 5 / scale());
    draw();
  }

  return {
    last, runs, draw, go, zoom, reset, camera,
    toggle: () => play(!playing),
    faster: (value) => { speed = value; },
    listen: (listener) => listeners.push(listener),
  };
})();
