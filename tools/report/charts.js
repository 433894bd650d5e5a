// Lines over time: one chart a figure, with a hand at the slider's instant and the values there in its legend.

const MARGIN = { left: 40, right: 10, top: 8, bottom: 20 };

class LineChart {
  constructor(figure, chart, end, clock) {
    this.figure = figure;
    this.chart = chart;
    this.end = end;
    this.clock = clock;
    this.svg = figure.querySelector("svg");
    this.t = 0;
    this.items = chart.curves.map((curve, k) => this.makeItem(curve, k));
    new ResizeObserver(() => this.draw()).observe(this.svg);
  }

  makeItem(curve, k) {
    const colour = curve.drone ? droneColour(curve.drone) : droneColour(k + 1);
    const item = document.createElement("li");
    const swatch = document.createElement("i");
    swatch.style.background = colour;
    const words = document.createElement("span");
    item.append(swatch, words);
    this.figure.querySelector(".legend").append(item);
    return { curve, colour, words };
  }

  get top() {
    const values = this.chart.curves.flatMap((curve) => curve.values).filter((value) => value !== null);
    const most = Math.max(...values, this.chart.mark ? this.chart.mark[0] : 0, 1e-9);
    if (this.chart.top) return this.chart.top;
    const power = 10 ** Math.floor(Math.log10(most));
    return [1, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10, 12].map((step) => step * power).find((top) => top >= most * 1.05);
  }

  draw() {
    const width = this.svg.clientWidth;
    const height = this.svg.clientHeight;
    if (!width || !height) return;
    this.width = width;
    this.height = height;
    this.svg.replaceChildren();
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    const top = this.top;
    const x = (this.x = (t) => MARGIN.left + (t / this.end) * (width - MARGIN.left - MARGIN.right));
    const y = (value) => height - MARGIN.bottom - (value / top) * (height - MARGIN.top - MARGIN.bottom);
    for (const share of [0, 0.5, 1]) {
      make(this.svg, "path", { class: "rule", d: `M${MARGIN.left} ${y(share * top)}H${width - MARGIN.right}` });
      const text = make(this.svg, "text", { x: MARGIN.left - 6, y: y(share * top) + 4, "text-anchor": "end" });
      text.textContent = String(Number((share * top).toPrecision(3)));
    }
    const steps = [10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200];
    const step = steps.find((one) => this.end / one <= 5) || 14400;
    for (let t = 0; t < this.end * 0.95; t += step) {
      const text = make(this.svg, "text", { x: x(t), y: height - 5, "text-anchor": t ? "middle" : "start" });
      text.textContent = this.clock(t);
    }
    if (this.chart.mark) {
      const [level, words] = this.chart.mark;
      make(this.svg, "path", { class: "level", d: `M${MARGIN.left} ${y(level)}H${width - MARGIN.right}` });
      make(this.svg, "text", { x: width - MARGIN.right, y: y(level) - 5, "text-anchor": "end" }).textContent = words;
    }
    for (const { curve, colour } of this.items) this.drawCurve(curve, colour, y);
    this.hand = make(this.svg, "path", { class: "hand" });
    this.show(this.t);
  }

  drawCurve(curve, colour, y) {
    const group = make(this.svg, "g", { style: `--c:${colour}` });
    let d = "";
    let last = null;
    curve.values.forEach((value, k) => {
      if (value !== null) {
        const place = `${this.x(Math.min((k + 0.5) * this.chart.bin, this.end)).toFixed(1)} ${y(value).toFixed(1)}`;
        d += `${last === null ? "M" : "L"}${place}`;
        const isAlone = last === null && (k + 1 >= curve.values.length || curve.values[k + 1] === null);
        if (isAlone) make(group, "circle", { class: "dot", r: 2, cx: place.split(" ")[0], cy: place.split(" ")[1] });
      }
      last = value;
    });
    make(group, "path", { class: "curve", d });
  }

  show(t) {
    this.t = t;
    if (this.hand) this.hand.setAttribute("d", `M${this.x(t)} ${MARGIN.top}V${this.height - MARGIN.bottom}`);
    const bin = Math.floor(t / this.chart.bin);
    for (const { curve, words } of this.items) {
      const value = curve.values[Math.min(bin, curve.values.length - 1)];
      const unit = this.chart.unit.length < 3 ? ` ${this.chart.unit}` : "";
      const shown = value === null ? "–" : `${value < 10 ? Number(value.toPrecision(2)) : Math.round(value)}${unit}`;
      words.textContent = `${curve.name}: ${shown}`;
    }
  }
}
