"use strict";
// The map: metres to pixels, pan and zoom, and where everything is at one instant.

const SVG = "http://www.w3.org/2000/svg";
const TAIL_S = 30;
const AHEAD_S = 5; // an animal lies along its way from so long ago to so long after
const LEAST_SPAN_M = 15;

function make(parent, name, attributes) {
  const element = document.createElementNS(SVG, name);
  for (const key in attributes) element.setAttribute(key, attributes[key]);
  parent.appendChild(element);
  return element;
}

function set(element, attributes) {
  for (const key in attributes) element.setAttribute(key, attributes[key]);
}

const droneColour = (id) => `var(--d${((id - 1) % 7) + 1})`;
const animalColour = (number) => `var(--a${(number % 8) + 1})`;

// The value of a track at t, straight between its samples; null where nobody knows it.
function valueAt(values, step, t) {
  const place = Math.min(Math.max(t / step, 0), values.length - 1);
  const before = Math.floor(place);
  const a = values[before];
  const b = values[Math.min(before + 1, values.length - 1)];
  if (a === null || b === null) return place === before ? a : null;
  return a + (b - a) * (place - before);
}

// [east, north] in metres at t, null where nobody knows.
function placeAt(thing, step, t) {
  const east = valueAt(thing.e, step, t);
  const north = valueAt(thing.n, step, t);
  return east === null || north === null ? null : [east / 10, north / 10];
}

function spanAt(spans, t) {
  return spans.find((span) => span[0] <= t && t <= span[1]) || null;
}

function niceLength(length) {
  const power = 10 ** Math.floor(Math.log10(length));
  return [5, 2, 1].map((step) => step * power).find((step) => step <= length) || power;
}

class FleetMap {
  constructor(box, data) {
    this.box = box;
    this.data = data;
    this.svg = box.querySelector("svg");
    this.t = 0;
    this.width = this.height = 0;
    this.scale = 1; // px a metre
    this.middle = [0, 0]; // east, north in the middle of the picture
    this.layers = {};
    for (const name of ["grid", "ways", "views", "watches", "animals", "drones", "frame"]) this.layers[name] = make(this.svg, "g", {});
    this.drones = data.drones.map((drone) => this.makeDrone(drone));
    this.animals = data.animals.map((animal) => this.makeAnimal(animal));
    this.bindPointer();
    new ResizeObserver(() => this.resize()).observe(box);
    this.resize();
  }

  makeDrone(drone) {
    const style = `--c:${droneColour(drone.id)}`;
    const group = make(this.layers.drones, "g", { style, "data-drone": drone.id });
    const nose = make(group, "path", { d: "M0 -17L6 -8H-6Z", class: "nose" });
    make(group, "circle", { r: 10, class: "rotor" });
    make(group, "text", { class: "drone-number" }).textContent = drone.id;
    return {
      ...drone, group, nose,
      way: make(this.layers.ways, "path", { class: "way", style }),
      tail: make(this.layers.ways, "path", { class: "tail", style }),
      view: make(this.layers.views, "polygon", { class: "view", style }),
      watch: make(this.layers.watches, "path", { class: "watch", style }),
    };
  }

  makeAnimal(animal) {
    const style = `--c:${animalColour(animal.id)}`;
    const group = make(this.layers.animals, "g", { style, "data-animal": animal.id });
    const body = make(group, "ellipse", { class: "body" });
    const number = make(group, "text", { class: "animal-number" });
    number.textContent = animal.id;
    return { ...animal, group, body, number, way: make(this.layers.ways, "path", { class: "way water" }) };
  }

  resize() {
    const width = this.box.clientWidth;
    const height = this.box.clientHeight;
    if (!width || !height || (width === this.width && height === this.height)) return;
    const isFirst = !this.width;
    this.width = width;
    this.height = height;
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    if (isFirst) this.fit("watch");
    else this.moved();
  }

  // Show all that is worth it: the "animals", everything while somebody watched ("watch"), or "all".
  fit(what) {
    const things = what === "animals" && this.animals.length ? this.animals : [...this.drones, ...this.animals];
    const spans = what === "all" ? [] : this.drones.flatMap((drone) => drone.watched);
    const from = spans.length ? Math.min(...spans.map((span) => span[0])) : 0;
    const to = spans.length ? Math.max(...spans.map((span) => span[1])) : this.data.end;
    const first = Math.floor(from / this.data.step);
    const last = Math.ceil(to / this.data.step) + 1;
    const east = things.flatMap((thing) => thing.e.slice(first, last)).filter((value) => value !== null);
    const north = things.flatMap((thing) => thing.n.slice(first, last)).filter((value) => value !== null);
    if (east.length && north.length) {
      const low = [Math.min(...east) / 10, Math.min(...north) / 10];
      const high = [Math.max(...east) / 10, Math.max(...north) / 10];
      this.middle = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2];
      const span = [Math.max(high[0] - low[0], LEAST_SPAN_M), Math.max(high[1] - low[1], LEAST_SPAN_M)];
      this.scale = Math.min((this.width - 70) / span[0], (this.height - 90) / span[1]);
    }
    this.moved();
  }

  toPx(place) {
    return [
      this.width / 2 + (place[0] - this.middle[0]) * this.scale,
      this.height / 2 - (place[1] - this.middle[1]) * this.scale,
    ];
  }

  // Zoom by `factor`, with the point at (x, y) px staying where it is.
  zoom(factor, x = this.width / 2, y = this.height / 2) {
    const scale = Math.min(Math.max(this.scale * factor, 0.005), 400);
    const real = scale / this.scale;
    const east = this.middle[0] + (x - this.width / 2) / this.scale;
    const north = this.middle[1] - (y - this.height / 2) / this.scale;
    this.middle = [east - (east - this.middle[0]) / real, north - (north - this.middle[1]) / real];
    this.scale = scale;
    this.moved();
  }

  pan(dx, dy) {
    this.middle = [this.middle[0] - dx / this.scale, this.middle[1] + dy / this.scale];
    this.moved();
  }

  // The path in px of a thing between two instants, broken where nobody knows its place.
  path(thing, from, to) {
    const parts = [];
    let isDown = false;
    const step = this.data.step;
    const instants = [from];
    for (let k = Math.ceil(from / step); k * step < to; k++) instants.push(k * step);
    instants.push(to);
    for (const t of instants) {
      const place = placeAt(thing, step, t);
      if (place) {
        const [x, y] = this.toPx(place);
        parts.push(`${isDown ? "L" : "M"}${x.toFixed(1)} ${y.toFixed(1)}`);
      }
      isDown = place !== null;
    }
    return parts.join("");
  }

  moved() {
    if (!this.width) return;
    for (const thing of [...this.drones, ...this.animals]) thing.way.setAttribute("d", this.path(thing, 0, this.data.end));
    this.drawFrame();
    this.show(this.t);
  }

  drawFrame() {
    const { grid, frame } = this.layers;
    grid.replaceChildren();
    frame.replaceChildren();
    const step = niceLength(Math.min(this.width, 500) / 3 / this.scale);
    const low = [this.middle[0] - this.width / 2 / this.scale, this.middle[1] - this.height / 2 / this.scale];
    for (let east = Math.ceil(low[0] / step) * step; this.toPx([east, 0])[0] < this.width; east += step) {
      const x = this.toPx([east, 0])[0];
      make(grid, "path", { class: "grid", d: `M${x} 0V${this.height}` });
    }
    for (let north = Math.ceil(low[1] / step) * step; this.toPx([0, north])[1] > 0; north += step) {
      const y = this.toPx([0, north])[1];
      make(grid, "path", { class: "grid", d: `M0 ${y}H${this.width}` });
    }
    const length = step * this.scale;
    make(frame, "path", { class: "scale", d: `M14 ${this.height - 18}v5h${length}v-5` });
    make(frame, "text", { class: "outside", x: 14 + length / 2, y: this.height - 24 }).textContent =
      step >= 1000 ? `${step / 1000} km` : `${step} m`;
    make(frame, "path", { class: "north", d: "M24 14L31 36L24 31L17 36Z" });
    make(frame, "text", { class: "outside", x: 24, y: 46 }).textContent = "N";
  }

  show(t) {
    this.t = t;
    const step = this.data.step;
    const places = new Map();
    for (const animal of this.animals) {
      const place = placeAt(animal, step, t);
      places.set(animal.id, place);
      animal.group.style.display = place ? "" : "none";
      if (place) this.showAnimal(animal, place, t);
    }
    for (const drone of this.drones) this.showDrone(drone, places, t);
  }

  showAnimal(animal, place, t) {
    const [x, y] = this.toPx(place);
    const before = placeAt(animal, step(this), Math.max(t - AHEAD_S, 0)) || place;
    const after = placeAt(animal, step(this), Math.min(t + AHEAD_S, this.data.end)) || place;
    const way = [after[0] - before[0], after[1] - before[1]];
    const swims = Math.hypot(...way) > 1;
    const turn = (-Math.atan2(way[1], way[0]) * 180) / Math.PI;
    const half = Math.max((animal.length * this.scale) / 2, 5);
    const isRoomy = half * (swims ? 0.56 : 1) > 16;
    set(animal.group, { transform: `translate(${x.toFixed(1)} ${y.toFixed(1)})` });
    set(animal.body, {
      rx: half, ry: half * (swims ? 0.28 : 1), "fill-opacity": swims ? 1 : 0.5,
      transform: `rotate(${turn.toFixed(0)})`,
    });
    set(animal.number, { class: isRoomy ? "animal-number" : "outside", y: isRoomy ? 0 : -Math.min(half, 14) - 7 });
  }

  showDrone(drone, animals, t) {
    const place = placeAt(drone, step(this), t);
    const isThere = place !== null;
    for (const part of [drone.group, drone.tail, drone.view, drone.watch]) part.style.display = isThere ? "" : "none";
    if (!isThere) return;
    const [x, y] = this.toPx(place);
    const yaw = drone.yaw[nearest(drone.yaw, step(this), t)] || 0;
    set(drone.group, { transform: `translate(${x.toFixed(1)} ${y.toFixed(1)})` });
    set(drone.nose, { transform: `rotate(${yaw.toFixed(0)})` });
    set(drone.tail, { d: this.path(drone, Math.max(t - TAIL_S, 0), t) });
    const height = (valueAt(drone.h, step(this), t) || 0) / 10;
    const [right, front] = this.data.view.map((share) => share * Math.max(height, 0) * this.scale);
    const turn = (yaw * Math.PI) / 180;
    const corners = [[-right, -front], [right, -front], [right, front], [-right, front]].map(([a, b]) => [
      x + a * Math.cos(turn) - b * Math.sin(turn), y + a * Math.sin(turn) + b * Math.cos(turn),
    ]);
    set(drone.view, { points: height > 3 ? corners.map((corner) => corner.map((v) => v.toFixed(1)).join()).join(" ") : "" });
    const watched = spanAt(drone.watched, t);
    const target = watched && animals.get(watched[2]);
    const end = target && this.toPx(target);
    set(drone.watch, { d: end ? `M${x.toFixed(1)} ${y.toFixed(1)}L${end[0].toFixed(1)} ${end[1].toFixed(1)}` : "" });
  }

  bindPointer() {
    const down = new Map();
    const at = (event) => {
      const box = this.svg.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    this.svg.addEventListener("pointerdown", (event) => {
      this.svg.setPointerCapture(event.pointerId);
      down.set(event.pointerId, at(event));
    });
    this.svg.addEventListener("pointermove", (event) => {
      if (!down.has(event.pointerId)) return;
      const before = [...down.values()];
      const here = at(event);
      const was = down.get(event.pointerId);
      down.set(event.pointerId, here);
      if (before.length === 1) this.pan(here[0] - was[0], here[1] - was[1]);
      else if (before.length === 2) this.pinch(before, [...down.values()]);
    });
    const up = (event) => down.delete(event.pointerId);
    this.svg.addEventListener("pointerup", up);
    this.svg.addEventListener("pointercancel", up);
    this.svg.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), ...at(event));
    }, { passive: false });
    this.box.querySelectorAll("[data-zoom]").forEach((button) => {
      const how = button.dataset.zoom;
      button.addEventListener("click", () => (how === "in" ? this.zoom(1.5) : how === "out" ? this.zoom(1 / 1.5) : this.fit(how)));
    });
    this.box.addEventListener("keydown", (event) => {
      const pans = { ArrowLeft: [40, 0], ArrowRight: [-40, 0], ArrowUp: [0, 40], ArrowDown: [0, -40] };
      if (event.target !== this.box) return;
      if (event.key === "+" || event.key === "=") this.zoom(1.3);
      else if (event.key === "-") this.zoom(1 / 1.3);
      else if (event.key in pans) this.pan(...pans[event.key]);
      else return;
      event.preventDefault();
    });
  }

  pinch(before, after) {
    const spread = ([a, b]) => Math.hypot(a[0] - b[0], a[1] - b[1]);
    const middle = ([a, b]) => [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
    const [from, to] = [middle(before), middle(after)];
    this.pan(to[0] - from[0], to[1] - from[1]);
    this.zoom(spread(after) / Math.max(spread(before), 1), ...to);
  }
}

const step = (map) => map.data.step;

// Directions are not mixed: between two samples the nearer one holds.
function nearest(values, step, t) {
  return Math.min(Math.max(Math.round(t / step), 0), values.length - 1);
}
