// The return so far, as a line over the episode's env steps.
import { colour, el } from "./dom.js";
import { count, counted, returnText } from "./format.js";
import { drawLine, valueAt } from "./lines.js";
import { Plot, withAir } from "./plot.js";

const MOST_POINTS = 600;
const LEAST_STEPS = 50;

export class ReturnLine {
  constructor(host) {
    this.body = el("div", {});
    host.append(el("section", {}, el("h3", {}, "Return so far, by env step"), this.body));
    // The plot paints at once.
    this.line = { x: [], y: [] };
    this.plot = new Plot(this.body, {
      label: "Return so far",
      height: 130,
      paint: (context, places) => this.paint(context, places),
      find: (places, left) => this.find(places, left),
    });
    this.clear();
  }

  clear() {
    this.line = { x: [], y: [] };
    this.low = 0;
    this.high = 0;
    this.show();
  }

  add({ num_env_steps: steps, total }) {
    this.line.x.push(steps);
    this.line.y.push(total);
    this.low = Math.min(this.low, total);
    this.high = Math.max(this.high, total);
  }

  show() {
    const last = this.line.x.at(-1) ?? 0;
    this.plot.setRange({ x: [0, Math.max(LEAST_STEPS, last)], y: withAir(this.low, this.high) });
  }

  // Said once an episode is over: readers don't hear each step.
  describe() {
    const { x, y } = this.line;
    this.plot.describe(x.length ? `Return ${returnText(y.at(-1))} after ${counted(x.at(-1), "env step")}` : "No return");
  }

  paint(context, places) {
    context.strokeStyle = colour("series-0");
    context.lineWidth = 2 * places.ratio;
    context.beginPath();
    drawLine(context, places, thinned(this.line));
    context.stroke();
  }

  find(places, left) {
    const x = Math.round(places.min + ((left - places.left) / places.width) * (places.max - places.min));
    const value = valueAt(this.line, x);
    return value === null ? null : { key: x, lines: [`${count(x)} env steps`, `return ${returnText(value)}`] };
  }

  close() {
    this.plot.close();
  }
}

function thinned({ x, y }) {
  const every = Math.ceil(x.length / MOST_POINTS);
  if (every <= 1) return { x, y };
  const isKept = (_, index) => index % every === 0 || index === x.length - 1;
  return { x: x.filter(isKept), y: y.filter(isKept) };
}
