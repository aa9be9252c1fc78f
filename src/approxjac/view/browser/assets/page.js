"use strict";
// The page: the run's rows, the cursor in time, and everything that follows it.

// Columns of numbers, a row an instant; rows can be added.
approxjac.Rows = class {
  constructor(columns, shapes) {
    this.columns = {};
    for (const [name, packed] of Object.entries(columns)) {
      const bytes = Uint8Array.from(atob(packed), (c) => c.charCodeAt(0));
      const width = shapes[name].reduce((a, b) => a * b, 1);
      this.columns[name] = { data: new Float32Array(bytes.buffer), width, largest: 0, looked: 0 };
    }
    this.length = this.columns.t.data.length;
  }

  // Values of one column at row i.
  row(name, i) {
    const { data, width } = this.columns[name];
    i = Math.max(0, Math.min(this.length - 1, i));
    return Array.from(data.subarray(i * width, (i + 1) * width));
  }

  // The same between two rows.
  at(name, s) {
    const i = Math.floor(s), share = s - i, a = this.row(name, i);
    if (share < 1e-9) return a;
    return this.row(name, i + 1).map((b, k) => a[k] + share * (b - a[k]));
  }

  // Where t is, as a row that may lie between two.
  find(t) {
    const { data } = this.columns.t;
    let low = 0, high = this.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (data[middle] <= t) low = middle; else high = middle;
    }
    if (high <= low || t <= data[low]) return low;
    return Math.min(high, low + (t - data[low]) / (data[high] - data[low]));
  }

  // The longest vector of a column so far.
  largest(name) {
    const column = this.columns[name];
    for (; column.looked < this.length; column.looked++) {
      const length = Math.hypot(...this.row(name, column.looked));
      if (length > column.largest) column.largest = length;
    }
    return column.largest;
  }

  append(row) {
    const again = this.length > 0 && row.t <= this.row("t", this.length - 1)[0];
    if (again) this.length -= 1; // the same instant, with another target
    const last = this.length ? this.row("joints", this.length - 1) : null;
    for (const [name, column] of Object.entries(this.columns)) {
      const needed = (this.length + 1) * column.width;
      if (needed > column.data.length) {
        const grown = new Float32Array(2 * needed);
        grown.set(column.data.subarray(0, this.length * column.width));
        column.data = grown;
      }
      let values = [row[name] ?? []].flat(Infinity);
      if (name === "joints" && last) { // continuous ones come back at −π; they must not spin
        values = values.map((q, k) => q - 2 * Math.PI * Math.round((q - last[k]) / (2 * Math.PI)));
      }
      for (let k = 0; k < column.width; k++) {
        column.data[this.length * column.width + k] = values[k] ?? NaN;
      }
    }
    this.length += 1;
  }
};

(function () {
  const data = JSON.parse(document.getElementById("data").textContent);
  const rows = new approxjac.Rows(data.columns, data.shapes);
  const part = (id) => document.getElementById(id);
  const slider = part("slider"), button = part("play"), speed = part("speed");
  const WINDOW = 20; // of a live page's plots [s]
  let t = 0, playing = false, before = 0, unread = false;

  // -- what does not change --------------------------------------------------------------

  for (const [name, text] of data.facts) {
    const line = document.createElement("div"), term = document.createElement("dt");
    const value = document.createElement("dd");
    term.textContent = name;
    value.textContent = text;
    line.append(term, value);
    part("facts").append(line);
  }
  const legend = data.legend.map(([what, colour, kind, text]) => {
    const item = document.createElement("li"), mark = document.createElement("i");
    mark.style.background = colour === "#000000" ? "var(--black)" : colour;
    mark.className = kind;
    item.append(mark, text);
    part("legend").append(item);
    return { what, item };
  });
  const tell = (missing) => {
    part("notes").hidden = missing.length === 0;
    part("notes").textContent = missing.length ? `Drawn without: ${missing.join("; ")}` : "";
  };
  tell(data.missing);

  let scene;
  try {
    scene = new approxjac.Scene(data, part("canvas"));
  } catch (error) { // without WebGL there are the plots
    part("canvas").textContent = `This browser cannot draw the arm: ${error.message}`;
    scene = { show() {}, build() {}, paint() {}, reset() {}, differs: data.differs, project: () => ({ x: NaN, y: NaN }), viewer: null };
  }
  const image = data.image && new approxjac.ImagePlane(data, part("plots"));
  const end = () => (rows.length ? rows.row("t", rows.length - 1)[0] : 0);
  const start = () => (rows.length ? rows.row("t", 0)[0] : 0);
  const plots = data.plots
    .filter(({ column }) => data.live || rows.columns[column].data.some(Number.isFinite))
    .map((spec) => new approxjac.Plot({ ...spec, events: data.events }, part("plots"), (to) => { pause(); seek(to); }));

  // -- what occurs is in the legend ---------------------------------------------------------

  const occurred = new Set(["arm", "object", "true", "target", "wall"]);
  let looked = 0;

  function explain() {
    const far = (a, b, least) => Math.hypot(...a.map((x, i) => x - b[i])) > least * data.size;
    for (; looked < rows.length; looked++) {
      const [tip, measured] = [rows.row("tip", looked), rows.row("measured", looked)];
      if (far(tip, rows.row("believed_tip", looked), 1e-6)) occurred.add("believed_tip");
      if (far(tip, measured, 2e-3)) occurred.add("measured");
      if (Math.hypot(...rows.row("force", looked)) > 0) occurred.add("force");
      if (rows.row("load", looked).some((share) => share > 0.8)) occurred.add("saturated");
      if (rows.row("at_limit", looked).some((there) => there >= 1)) occurred.add("at_limit");
    }
    if (scene.differs) occurred.add("believed");
    if (data.events.length) occurred.add("event");
    for (const { what, item } of legend) item.hidden = !occurred.has(what);
  }

  approxjac.darkness.addEventListener("change", () => {
    scene.paint();
    if (image) image.draw();
    for (const plot of plots) plot.paint();
  });
  part("reset").addEventListener("click", () => scene.reset());

  // -- the cursor ------------------------------------------------------------------------

  function show() {
    const s = rows.find(t), span = end() - start();
    scene.show(rows, s);
    if (image) image.show(rows, s);
    for (const plot of plots) plot.show(t, rows.length ? rows.at(plot.spec.column, s) : []);
    slider.value = span > 0 ? 1000 * (t - start()) / span : 0;
    slider.setAttribute("aria-valuetext", `${t.toFixed(2)} seconds`);
    part("time").textContent = `${t.toFixed(2)} / ${end().toFixed(2)} s`;
    part("state").textContent = state(s);
  }

  // What colours and arrow say, in words.
  function state(s) {
    if (!rows.length) return "";
    const said = [], force = Math.hypot(...rows.at("force", s));
    const [tip, believed] = [rows.at("tip", s), rows.at("believed_tip", s)];
    const apart = 1000 * Math.hypot(...tip.map((x, i) => x - believed[i]));
    if (apart >= 1e-3) said.push(`${data.tip} ${approxjac.number(apart)} mm away`);
    if (Number.isFinite(force)) said.push(`force of the control ${approxjac.number(force)} N`);
    const named = (values, least) => {
      const names = data.jointNames.filter((_, k) => values[k] >= least);
      return names.slice(0, 3).join(", ") + (names.length > 3 ? ` and ${names.length - 3} more` : "");
    };
    const saturated = named(rows.row("load", Math.ceil(s)), 0.999);
    const stopped = named(rows.row("at_limit", Math.round(s)), 1);
    if (saturated) said.push(`torque at its limit: ${saturated}`);
    if (stopped) said.push(`at a position limit: ${stopped}`);
    said.push(...data.events.filter((event) => event.from <= t && t <= event.to).map((event) => event.name));
    return said.join(" · ");
  }

  function seek(to) {
    t = Math.max(start(), Math.min(end(), to));
    if (data.live) read();
    show();
  }

  function play() {
    if (t >= end()) t = start();
    playing = true;
    before = performance.now();
    button.classList.add("playing");
    button.setAttribute("aria-label", "Pause");
    requestAnimationFrame(step);
  }

  function pause() {
    playing = false;
    button.classList.remove("playing");
    button.setAttribute("aria-label", "Play");
  }

  function step(now) {
    if (!playing) return;
    t += Number(speed.value) * Math.max(0, now - before) / 1000;
    before = now;
    if (t >= end()) { t = end(); pause(); }
    show();
    if (playing) requestAnimationFrame(step);
  }

  function read() {
    unread = false;
    // of a live page the last seconds, or those around the instant that is looked at
    const to = data.live && t < end() - WINDOW ? t + 0.5 * WINDOW : end();
    const first = start() < 0.01 * end() ? Math.min(start(), 0) : start(); // where 0 has a tick
    const from = data.live ? Math.max(start(), to - WINDOW) : first;
    for (const plot of plots) plot.read(rows, from, to);
    explain();
  }

  button.addEventListener("click", () => (playing ? pause() : play()));
  slider.addEventListener("input", () => {
    pause();
    seek(start() + slider.value / 1000 * (end() - start()));
  });
  document.addEventListener("keydown", (event) => {
    const on = event.target;
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (on.matches("select, button, textarea, input:not(#slider)")) return; // they have their own
    const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (event.key === " ") {
      if (playing) pause(); else play();
    } else if (by && rows.length) {
      pause();
      const i = Math.round(rows.find(t)) + by * (event.shiftKey ? 10 : 1);
      seek(rows.row("t", i)[0]);
    } else return;
    event.preventDefault();
  });

  // -- what scripts may use ----------------------------------------------------------------

  Object.assign(approxjac, {
    data,
    viewer: scene.viewer,
    image,
    seek, play, pause,
    state: () => ({ t, index: Math.round(rows.find(t)), playing, length: rows.length }),
    project: (point) => scene.project(point),
    column: (name) => Array.from({ length: rows.length }, (_, i) => rows.row(name, i)),
    // Add one instant: name → number or array, as the columns are called. A cursor at the end
    // stays there.
    append(row) {
      const follows = t >= end();
      rows.append(row);
      if (follows) t = end();
      if (!unread) { // plots are drawn anew ten times a second, not for each instant
        unread = true;
        setTimeout(() => { read(); show(); }, 100);
      }
      scene.show(rows, rows.find(t));
    },
    // What Stage.data gives, of a robot that has changed.
    redraw(changed) {
      scene.build(changed);
      explain();
      if (changed.missing) tell(changed.missing);
      show();
    },
    ontarget() {}, // called with [x, y, z] while the target is dragged
    onpixel() {}, // called with the number of a point and [u, v] while its target is dragged
  });

  t = start();
  read();
  show();
  const quiet = matchMedia("(prefers-reduced-motion: reduce)").matches;
  if (!data.live && !document.hidden && !quiet) play();
})();
