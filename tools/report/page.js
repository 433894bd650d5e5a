// Each mission of the page: one instant, moved by the slider, by play, by a click, shown everywhere.

const PICTURE_S = 15; // an older picture is not shown for an instant

function clockOf(t) {
  const whole = Math.max(Math.round(t), 0);
  const two = (value) => String(value).padStart(2, "0");
  const hours = Math.floor(whole / 3600);
  const rest = `${hours ? two(Math.floor(whole / 60) % 60) : Math.floor(whole / 60)}:${two(whole % 60)}`;
  return hours ? `${hours}:${rest}` : rest;
}

class Cameras {
  constructor(box, data) {
    this.byDrone = new Map();
    for (const picture of data.pictures) {
      if (!this.byDrone.has(picture.drone)) this.byDrone.set(picture.drone, []);
      this.byDrone.get(picture.drone).push(picture);
    }
    this.views = [...this.byDrone].map(([drone, pictures]) => this.makeView(box, drone, pictures));
  }

  makeView(box, drone, pictures) {
    const figure = document.createElement("figure");
    const frame = document.createElement("span");
    frame.className = "picture";
    frame.style.setProperty("--c", droneColour(drone));
    const image = document.createElement("img");
    const caption = document.createElement("figcaption");
    frame.append(image);
    const marks = make(frame, "svg", {});
    figure.append(frame, caption);
    box.append(figure);
    return { drone, pictures, image, marks, caption, shown: null };
  }

  show(t) {
    for (const view of this.views) {
      const near = view.pictures.reduce((best, one) => (Math.abs(one.t - t) < Math.abs(best.t - t) ? one : best));
      const isOld = Math.abs(near.t - t) > PICTURE_S;
      view.caption.textContent = isOld ? `drone ${view.drone}: no picture near this time` : `drone ${view.drone} at ${clockOf(near.t)}`;
      view.image.style.opacity = isOld ? 0.15 : 1;
      view.marks.style.display = isOld ? "none" : "";
      if (near !== view.shown) this.fill(view, near);
    }
  }

  fill(view, picture) {
    view.shown = picture;
    [view.image.width, view.image.height] = picture.size;
    view.image.alt = `What drone ${view.drone} saw at ${clockOf(picture.t)}`;
    view.image.src = picture.src;
    view.marks.replaceChildren();
    view.marks.setAttribute("viewBox", `0 0 ${picture.size.join(" ")}`);
    for (const [x, y, width, height, number, isOwn] of picture.marks) {
      make(view.marks, "rect", { x, y, width, height, class: isOwn ? "own" : "other" });
      if (number !== null) make(view.marks, "text", { x: x + 4, y: Math.max(y - 4, 16) }).textContent = number;
    }
  }
}

class Mission {
  constructor(section, data) {
    this.data = data;
    this.section = section;
    this.slider = section.querySelector(".time");
    this.playButton = section.querySelector(".play");
    this.speed = section.querySelector(".speed select");
    this.lanes = section.querySelector(".time-lanes");
    this.cursor = section.querySelector(".cursor");
    this.map = new FleetMap(section.querySelector(".map"), data);
    this.cameras = new Cameras(section.querySelector(".cameras"), data);
    this.charts = data.charts.map((chart) => new LineChart(section.querySelector(`[data-chart="${chart.key}"]`), chart, data.end, clockOf));
    this.frame = null;
    this.slider.addEventListener("input", () => this.show(Number(this.slider.value)));
    this.playButton.addEventListener("click", () => (this.frame === null ? this.play() : this.pause()));
    this.lanes.addEventListener("click", (event) => {
      const box = this.lanes.querySelector(".axis").getBoundingClientRect();
      this.goTo(((event.clientX - box.left) / box.width) * data.end);
    });
    this.goTo(this.firstWatch());
  }

  // The page opens on a moment at which there is something to see.
  firstWatch() {
    const begun = this.data.drones.flatMap((drone) => drone.watched.slice(0, 1).map((span) => (span[0] + span[1]) / 2));
    return begun.length ? Math.min(...begun) : this.data.end / 2;
  }

  goTo(t) {
    this.pause();
    this.slider.value = Math.min(Math.max(t, 0), this.data.end);
    this.show(Number(this.slider.value));
  }

  show(t) {
    this.t = t;
    this.section.querySelector(".now").textContent = clockOf(t);
    this.slider.setAttribute("aria-valuetext", clockOf(t));
    this.map.show(t);
    this.cameras.show(t);
    this.charts.forEach((chart) => chart.show(t));
    const axis = this.lanes.querySelector(".axis");
    this.cursor.style.transform = `translateX(${(t / this.data.end) * axis.clientWidth}px)`;
    this.section.querySelector(".doing").textContent = this.data.drones.map((drone) => this.doing(drone, t)).join(" · ");
  }

  doing(drone, t) {
    const state = spanAt(drone.states, t);
    const watched = spanAt(drone.watched, t);
    if (watched) return `Drone ${drone.id} watches animal ${watched[2]}`;
    return `Drone ${drone.id} ${state ? state[2] : "is silent"}`;
  }

  play() {
    if (this.t >= this.data.end) this.goTo(0);
    let before = null;
    const tick = (now) => {
      if (before !== null) {
        const t = Math.min(this.t + ((now - before) / 1000) * Number(this.speed.value), this.data.end);
        this.slider.value = t;
        this.show(t);
        if (t >= this.data.end) return this.pause();
      }
      before = now;
      this.frame = requestAnimationFrame(tick);
      return undefined;
    };
    this.frame = requestAnimationFrame(tick);
    this.playButton.textContent = "❚❚";
    this.playButton.setAttribute("aria-label", "Pause");
  }

  pause() {
    if (this.frame !== null) cancelAnimationFrame(this.frame);
    this.frame = null;
    this.playButton.textContent = "▶";
    this.playButton.setAttribute("aria-label", "Play");
  }
}

const missions = new Map();
const allData = JSON.parse(document.getElementById("data").textContent);
document.querySelectorAll(".mission").forEach((section, k) => missions.set(section.dataset.key, new Mission(section, allData[k])));
document.querySelectorAll(".look").forEach((button) => {
  button.addEventListener("click", () => {
    const mission = missions.get(button.dataset.mission);
    mission.goTo(Number(button.dataset.at));
    mission.section.querySelector(".stage").scrollIntoView({ block: "center", behavior: "smooth" });
  });
});
let unfolded = [];
addEventListener("beforeprint", () => {
  unfolded = [...document.querySelectorAll("details:not([open])")];
  unfolded.forEach((one) => (one.open = true));
});
addEventListener("afterprint", () => unfolded.forEach((one) => (one.open = false)));
addEventListener("resize", () => missions.forEach((mission) => mission.show(mission.t)));
