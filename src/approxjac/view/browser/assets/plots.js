"use strict";
// Plots over time, with a cursor at the instant that the scene shows.

approxjac.Plot = class {
  constructor(spec, parent, seek) {
    this.spec = spec;
    const box = approxjac.panel(parent, spec.title, spec.labels.map((label, i) => [spec.colours[i % spec.colours.length], label]));
    const colour = (name) => () => approxjac.theme()[name]; // as it is when it is drawn
    this.values = box.values;
    this.area = box.area;
    this.arrays = [[], ...spec.labels.map(() => [])];
    const axis = { stroke: colour("soft"), grid: { stroke: colour("faint"), width: 1 }, font: "11px sans-serif",
      labelFont: "11px sans-serif", ticks: { stroke: colour("line"), width: 1, size: 4 }, gap: 3,
      values: (u, splits) => splits.map((value) => String(+value.toPrecision(6)).replace("-", "−")) };
    this.plot = new uPlot({
      width: 300, height: 120, padding: [8, 10, 0, 0],
      legend: { show: false }, cursor: { show: false }, select: { show: false },
      scales: { x: { time: false }, y: { range: (u, low, high) => this._range(low, high) } },
      axes: [
        { ...axis, size: 24, label: "time [s]", labelSize: 15, space: 60 },
        { ...axis, size: 46, label: spec.unit, labelSize: 16, space: 26 },
      ],
      series: [{}, ...spec.labels.map((label, i) => ({
        label, stroke: () => approxjac.shown(spec.colours[i % spec.colours.length]), width: 1.5, points: { show: false }, pxAlign: 0,
      }))],
      hooks: { drawAxes: [(u) => this._lines(u)], setSize: [() => this.mark()], setScale: [() => this.mark()] },
    }, this.arrays, this.area);
    this.now = document.createElement("div");
    this.now.className = "now";
    this.plot.over.append(this.now);
    this._seeks(seek);
    new ResizeObserver(() => this.resize()).observe(this.area);
    this.resize();
  }

  paint() { this.plot.redraw(false); }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.area;
    if (width > 60 && height > 40) this.plot.setSize({ width, height });
  }

  _range(low, high) {
    if (low === null || high === null) return [-1, 1];
    // what is no more than round-off of the largest value so far is not blown up
    this.largest = Math.max(this.largest ?? 0, Math.abs(low), Math.abs(high));
    low = Math.min(low, -1e-3 * this.largest);
    high = Math.max(high, 1e-3 * this.largest);
    for (const line of this.spec.lines) { low = Math.min(low, line); high = Math.max(high, line); }
    const margin = 0.06 * (high - low || Math.abs(high) || 1);
    return [low - margin, high + margin];
  }

  // Bands of what happened, zero, and limits.
  _lines(u) {
    u.ctx.save();
    u.ctx.fillStyle = approxjac.theme().dark ? "#E69F0038" : "#E69F0030";
    for (const event of this.spec.events) {
      const [from, to] = [event.from, event.to].map((t) => Math.min(Math.max(u.valToPos(t, "x", true), u.bbox.left), u.bbox.left + u.bbox.width));
      u.ctx.fillRect(from, u.bbox.top, Math.max(to - from, devicePixelRatio), u.bbox.height);
    }
    u.ctx.strokeStyle = approxjac.theme().soft;
    u.ctx.lineWidth = devicePixelRatio;
    for (const line of this.spec.lines) {
      u.ctx.setLineDash(line === 0 ? [] : [5 * devicePixelRatio, 4 * devicePixelRatio]);
      const y = Math.round(u.valToPos(line, "y", true)) + 0.5;
      u.ctx.beginPath();
      u.ctx.moveTo(u.bbox.left, y);
      u.ctx.lineTo(u.bbox.left + u.bbox.width, y);
      u.ctx.stroke();
    }
    u.ctx.restore();
  }

  _seeks(seek) {
    const over = this.plot.over;
    const to = (event) => {
      const x = event.clientX - over.getBoundingClientRect().left;
      seek(this.plot.posToVal(x, "x"));
    };
    over.addEventListener("pointerdown", (event) => {
      over.setPointerCapture(event.pointerId);
      to(event);
    });
    over.addEventListener("pointermove", (event) => { if (event.buttons & 1) to(event); });
  }

  // Take the rows that are new. One that came in its predecessor's place is taken again.
  read(rows, from, to) {
    const [t, ...series] = this.arrays;
    for (const one of this.arrays) one.length = Math.max(0, Math.min(one.length, rows.length) - 1);
    for (let i = t.length; i < rows.length; i++) {
      t.push(rows.row("t", i)[0]);
      const values = rows.row(this.spec.column, i);
      series.forEach((one, k) => one.push(Number.isFinite(values[k]) ? values[k] : null));
    }
    this.plot.setData(this.arrays, false);
    this.plot.batch(() => {
      this.plot.setScale("x", { min: from, max: to > from ? to : from + 1 });
    });
  }

  show(t, values) {
    this.t = t;
    this.mark();
    this.values.forEach((out, k) => { out.textContent = approxjac.number(values[k]); });
  }

  mark() {
    if (this.t === undefined || !this.now) return;
    const x = this.plot.valToPos(this.t, "x");
    this.now.style.transform = `translateX(${x}px)`;
    this.now.hidden = !(x >= -1 && x <= this.plot.over.clientWidth + 1);
  }
};

// A titled box with a legend; returns its area and where the legend's values go.
approxjac.panel = function (parent, title, keys) {
  const box = document.createElement("section"), head = document.createElement("h2");
  const list = document.createElement("div"), area = document.createElement("div");
  box.className = "plot";
  box.setAttribute("aria-label", title);
  head.textContent = title;
  list.className = "keys";
  area.className = "area";
  const values = keys.map(([colour, label]) => {
    const key = document.createElement("span"), mark = document.createElement("i");
    const value = document.createElement("span");
    mark.style.background = colour === "#000000" ? "var(--black)" : colour;
    const [symbol, index] = approxjac.indexed(label), below = document.createElement("sub");
    below.textContent = index;
    key.append(mark, symbol, ...(index ? [below] : []), " ", value);
    list.append(key);
    return value;
  });
  box.append(head, list, area);
  parent.append(box);
  return { box, area, values };
};

// A symbol such as x_s as its letter and its index, or another name as it is.
approxjac.indexed = (name) => {
  const found = /^(\p{L})_(\w{1,2})$/u.exec(name);
  return found ? [found[1], found[2]] : [name, ""];
};

// A number to three digits, with a true minus sign.
approxjac.number = function (value) {
  if (!Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  const text = size !== 0 && (size < 1e-3 || size >= 1e5) ? value.toExponential(1)
    : value.toFixed(size < 1 ? 3 : size < 10 ? 2 : size < 100 ? 1 : 0);
  return text.replaceAll("-", "−");
};
