// What a page of a run that goes on has besides: it follows the run, and sends what the user wants.
"use strict";

(() => {
  const shown = window.approxjac;
  const box = document.getElementById("live");
  const socket = new WebSocket(`ws://${location.host}${location.pathname}socket`);
  const send = (command) => {
    if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(command));
  };

  // A mouse moves faster than anybody needs to know: at most one message in 50 ms, the last one
  // always.
  const sparing = (tell) => {
    let waiting = null;
    let timer = null;
    return (...values) => {
      waiting = values;
      if (timer !== null) return;
      timer = setTimeout(() => {
        timer = null;
        tell(...waiting);
      }, 50);
    };
  };
  shown.ontarget = sparing((point) => send({ point }));
  shown.onpixel = sparing((i, [u, v]) => send({ pixel: [i, u, v] }));

  const add = (tag, properties = {}, parent = box) =>
    parent.appendChild(Object.assign(document.createElement(tag), properties));
  const button = (text, act) => {
    const made = add("button", { type: "button", textContent: text });
    made.addEventListener("click", act);
    return made;
  };

  // a second pair of buttons plays what has been shown so far
  document.querySelector("footer label").firstChild.textContent = "Replay speed ";
  document.getElementById("play").title = "Replay what has been shown, or pause that (space)";
  const badge = add("span", { textContent: "live", className: "badge" });
  let paused = false;
  const pause = button("Pause the run", () => send({ [paused ? "go" : "pause"]: true }));
  const stop = button("Stop the run", () => send({ stop: true }));
  const labelled = (text, input) => {
    const label = add("label", { textContent: text });
    label.append(input);
    return input;
  };
  const number = (properties) =>
    Object.assign(document.createElement("input"), { type: "number", ...properties });

  const speed = labelled("run at × real time", number({ min: 0.05, step: 0.25, value: 1, id: "live-speed" }));
  // what was typed is sent, and then the field shows what holds
  const typed = (field, tell) => field.addEventListener("change", () => {
    if (field.value !== "") tell();
    field.blur();
  });
  typed(speed, () => send({ speed: Number(speed.value) }));

  // the target as numbers; with the mouse it is moved in the picture
  const target = add("span", { id: "live-target" });
  const fields = [];
  const offer = (point) => {
    if (!point || !point.every(Number.isFinite)) return;
    if (fields.length === 0) {
      target.append("target x, y, z [m]");
      for (const axis of "xyz") {
        const field = number({ step: 0.01, ariaLabel: `target ${axis}`, id: `live-target-${axis}` });
        typed(field, () => {
          if (fields.every((each) => each.value !== "")) {
            send({ point: fields.map((each) => Number(each.value)) });
          }
        });
        target.append(field);
        fields.push(field);
      }
    }
    fields.forEach((field, i) => {
      if (document.activeElement !== field) field.value = point[i].toFixed(3);
    });
  };

  let length = null;
  const believed = (value) => {
    if (value === null) return;
    if (length === null) {
      const slider = Object.assign(document.createElement("input"), {
        type: "range", min: 0, max: Math.max(0.5, 2 * value), step: 0.01, id: "live-length",
      });
      length = labelled("believed length", slider);
      length.told = add("output", {}, length.parentElement);
      length.addEventListener("input", sparing(() => send({ length: Number(length.value) })));
    }
    if (document.activeElement !== length) length.value = value;
    length.told.textContent = `${Number(value).toFixed(2)} m`;
  };

  const note = add("p", { id: "live-note", role: "status" });
  const known = (value) =>
    value === null ? NaN : Array.isArray(value) ? value.map(known) : value;

  socket.addEventListener("message", ({ data }) => {
    const told = JSON.parse(data);
    for (const row of told.rows ?? []) {
      shown.append(Object.fromEntries(Object.entries(row).map(([name, v]) => [name, known(v)])));
    }
    if (told.rows?.length) offer(known(told.rows.at(-1).target ?? null));
    if (told.controls) {
      paused = told.controls.paused;
      pause.textContent = paused ? "Go on" : "Pause the run";
      if (told.controls.speed !== null && document.activeElement !== speed) {
        speed.value = told.controls.speed;
      }
      believed(told.controls.length);
      note.textContent = told.note ?? "";
    }
    if (told.redraw) shown.redraw(told.redraw);
    if (told.ended) end(told.ended);
  });
  const end = (text) => {
    for (const input of box.querySelectorAll("input, button")) input.disabled = true;
    shown.ontarget = shown.onpixel = null;
    badge.textContent = "ended";
    note.textContent = text;
    box.classList.add("ended");
  };
  socket.addEventListener("close", () => {
    if (!box.classList.contains("ended")) end("The program that runs this is gone.");
  });
})();
