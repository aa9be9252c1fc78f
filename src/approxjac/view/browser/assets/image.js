"use strict";
// The image plane: what the camera sees, what the controller believes it sees, and the targets.

approxjac.ImagePlane = class {
  constructor(data, parent) {
    this.image = data.image;
    this.colours = data.colours;
    this.looked = 0; // rows whose images are within the bounds
    const c = data.colours;
    const box = approxjac.panel(parent, "Image plane",
      [[c.true, this.image.seen], [c.believed, "believed to be seen"], [c.target, "target"]]);
    box.box.classList.add("image");
    this.area = box.area;
    this.canvas = document.createElement("canvas");
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", "Paths of the points through the image");
    this.area.append(this.canvas);
    new ResizeObserver(() => this.draw()).observe(this.area);
    if (data.live) this._dragTarget();
  }

  show(rows, s) {
    this.rows = rows;
    this.s = s;
    this.draw();
  }

  // What the plot shows of the image: its border, or where points and targets are.
  _bounds() {
    if (this.image.border) return this.image.border;
    const found = this.bounds || [Infinity, Infinity, -Infinity, -Infinity];
    for (const name of ["pixels", "target_pixels", "believed_pixels"]) {
      for (let i = this.looked; i < this.rows.length; i++) {
        this.rows.row(name, i).forEach((value, j) => {
          if (!Number.isFinite(value)) return;
          found[j % 2] = Math.min(found[j % 2], value);
          found[2 + j % 2] = Math.max(found[2 + j % 2], value);
        });
      }
    }
    return found;
  }

  draw() {
    const { canvas, area, image, rows } = this, ratio = devicePixelRatio;
    const width = area.clientWidth, height = area.clientHeight;
    if (!rows || !rows.length || width < 40 || height < 40) return;
    canvas.width = width * ratio;
    canvas.height = height * ratio;
    canvas.style.width = width + "px";
    canvas.style.height = height + "px";
    this.bounds = this._bounds();
    this.looked = rows.length;
    const [u0, v0, u1, v1] = this.bounds, edge = { left: 56, right: 12, top: 8, bottom: 36 };
    const room = 0.06 * Math.max(u1 - u0, v1 - v0) || 1;
    // one scale for both, as in the image
    const scale = Math.min((width - edge.left - edge.right) / (u1 - u0 + 2 * room),
      (height - edge.top - edge.bottom) / (v1 - v0 + 2 * room));
    const x0 = edge.left + 0.5 * (width - edge.left - edge.right), y0 = edge.top + 0.5 * (height - edge.top - edge.bottom);
    const side = image.down ? 1 : -1;
    this.toPage = (u, v) => [x0 + scale * (u - 0.5 * (u0 + u1)), y0 + side * scale * (v - 0.5 * (v0 + v1))];
    this.fromPage = (x, y) => [(x - x0) / scale + 0.5 * (u0 + u1), side * (y - y0) / scale + 0.5 * (v0 + v1)];
    const halfWidth = scale * (0.5 * (u1 - u0) + room), halfHeight = scale * (0.5 * (v1 - v0) + room);
    Object.assign(edge, { left: x0 - halfWidth, right: width - x0 - halfWidth,
      top: y0 - halfHeight, bottom: height - y0 - halfHeight });
    const ctx = canvas.getContext("2d"), theme = this.theme = approxjac.theme();
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.clearRect(0, 0, width, height);
    this._axes(ctx, width, height, edge);
    ctx.save();
    ctx.beginPath();
    ctx.rect(edge.left, edge.top, width - edge.left - edge.right, height - edge.top - edge.bottom);
    ctx.clip();
    if (image.border) {
      const [a, b] = this.toPage(u0, v0), [c, d] = this.toPage(u1, v1);
      ctx.strokeStyle = theme.ink;
      ctx.lineWidth = 1;
      ctx.strokeRect(a, b, c - a, d - b);
    }
    for (let k = 0; k < image.points; k++) this._point(ctx, k);
    ctx.restore();
  }

  _point(ctx, k) {
    const { rows, s, colours } = this, now = Math.floor(s);
    const at = (name) => {
      const x = rows.at(name, s).slice(2 * k, 2 * k + 2);
      return x.every(Number.isFinite) ? this.toPage(...x) : null;
    };
    const path = (to, alpha) => {
      ctx.globalAlpha = alpha;
      ctx.beginPath();
      let gap = true; // after instants at which there was no image
      for (let i = Math.max(0, to - 2000); i <= to; i++) {
        const [u, v] = rows.row("pixels", i).slice(2 * k, 2 * k + 2);
        if (!Number.isFinite(u + v)) { gap = true; continue; }
        ctx[gap ? "moveTo" : "lineTo"](...this.toPage(u, v));
        gap = false;
      }
      const end = to === now && !gap ? at("pixels") : null; // between two rows
      if (end) ctx.lineTo(...end);
      ctx.stroke();
      ctx.globalAlpha = 1;
    };
    ctx.strokeStyle = colours.true;
    ctx.lineWidth = 1.5;
    path(rows.length - 1, 0.25);
    path(now, 1);
    const disc = (p, r, colour, filled) => {
      if (!p) return;
      ctx.beginPath();
      ctx.arc(p[0], p[1], r, 0, 2 * Math.PI);
      ctx.fillStyle = filled ? colour : this.theme.paper;
      ctx.strokeStyle = colour;
      ctx.lineWidth = 1.5;
      ctx.fill();
      ctx.stroke();
    };
    const target = at("target_pixels"), seen = at("pixels"), believed = at("believed_pixels");
    if (target) {
      ctx.strokeStyle = colours.target;
      ctx.lineWidth = 2.5;
      ctx.beginPath();
      for (const [a, b] of [[1, 1], [1, -1]]) {
        ctx.moveTo(target[0] - 6 * a, target[1] - 6 * b);
        ctx.lineTo(target[0] + 6 * a, target[1] + 6 * b);
      }
      ctx.stroke();
    }
    disc(believed, 5, colours.believed, false);
    disc(at("measured_pixels"), 3, colours.measured, true);
    disc(seen, 4, colours.true, true);
    if (this.image.points > 1) {
      ctx.font = "11px sans-serif";
      for (const [p, colour] of [[target, colours.target], [believed, colours.believed]]) {
        ctx.fillStyle = colour;
        if (p) ctx.fillText(String(k + 1), p[0] + 8, p[1] - 6);
      }
    }
  }

  _axes(ctx, width, height, edge) {
    const { image } = this, right = width - edge.right, bottom = height - edge.bottom;
    ctx.font = "11px sans-serif";
    ctx.lineWidth = 1;
    const [left, top] = this.fromPage(edge.left, edge.top), [far, low] = this.fromPage(right, bottom);
    const step = (span, room) => { // 1, 2 or 5 times a power of ten
      const least = image.scale * span / Math.max(2, room), power = 10 ** Math.floor(Math.log10(least));
      return power * [1, 2, 5, 10].find((n) => n * power >= least);
    };
    const ticks = (a, b, room, draw) => {
      const [from, to] = [image.scale * Math.min(a, b), image.scale * Math.max(a, b)];
      const by = step(Math.abs(b - a), room);
      for (let n = Math.ceil(from / by); n * by <= to; n++) {
        draw(n * by / image.scale, String(+(n * by).toPrecision(6)).replace("-", "−"));
      }
    };
    ticks(left, far, (right - edge.left) / 45, (u, text) => {
      const x = Math.round(this.toPage(u, 0)[0]) + 0.5;
      ctx.strokeStyle = this.theme.faint;
      ctx.strokeRect(x, edge.top, 0, bottom - edge.top);
      ctx.fillStyle = this.theme.soft;
      ctx.textAlign = "center";
      ctx.fillText(text, x, bottom + 13);
    });
    ticks(top, low, (bottom - edge.top) / 34, (v, text) => {
      const y = Math.round(this.toPage(0, v)[1]) + 0.5;
      ctx.strokeStyle = this.theme.faint;
      ctx.strokeRect(edge.left, y, right - edge.left, 0);
      ctx.fillStyle = this.theme.soft;
      ctx.textAlign = "right";
      ctx.fillText(text, edge.left - 5, y + 4);
    });
    ctx.textAlign = "center";
    this._name(ctx, 0, 0.5 * (edge.left + right), bottom + 29);
    ctx.save();
    ctx.translate(edge.left - 44, 0.5 * (edge.top + bottom));
    ctx.rotate(-Math.PI / 2);
    this._name(ctx, 1, 0, 0);
    ctx.restore();
    ctx.textAlign = "left";
  }

  // The name of an axis with its middle at (x, y), an index below its letter.
  _name(ctx, axis, x, y) {
    const [symbol, index] = approxjac.indexed(this.image.labels[axis]), font = "11px sans-serif";
    const parts = [[symbol, font, 0], [index, "8px sans-serif", 3], [` [${this.image.unit}]`, font, 0]];
    const widths = parts.map(([text, kind]) => { ctx.font = kind; return ctx.measureText(text).width; });
    let at = x - 0.5 * widths.reduce((a, b) => a + b);
    ctx.textAlign = "left";
    parts.forEach(([text, kind, down], i) => {
      ctx.font = kind;
      ctx.fillText(text, at, y + down);
      at += widths[i];
    });
    ctx.font = font;
  }

  _dragTarget() {
    const { canvas } = this;
    let dragged = -1;
    const at = (event) => {
      const box = canvas.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    canvas.addEventListener("pointerdown", (event) => {
      if (!this.toPage) return;
      const [x, y] = at(event), targets = this.rows.at("target_pixels", this.s);
      for (let k = 0; k < this.image.points; k++) {
        const [a, b] = this.toPage(...targets.slice(2 * k, 2 * k + 2));
        if (Math.hypot(a - x, b - y) < 14) dragged = k;
      }
      if (dragged >= 0) canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (dragged >= 0) approxjac.onpixel?.(dragged, this.fromPage(...at(event)));
    });
    const release = () => { dragged = -1; };
    canvas.addEventListener("pointerup", release);
    canvas.addEventListener("pointercancel", release);
  }
};
