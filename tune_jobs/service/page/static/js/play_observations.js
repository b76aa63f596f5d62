// The observations of an environment that can't be drawn: a line for each number, over the last steps.
import { colour, el, onThemeChange, setText } from "./dom.js";
import { significant } from "./format.js";

const MOST_LINES = 16;
const MOST_STEPS = 200;
const HEIGHT = 28;

export class Observations {
  constructor(host) {
    this.told = el("p", { class: "quiet small" });
    this.list = el("ol", { class: "observations", start: 0 });
    this.node = el("div", { hidden: true }, this.told, this.list);
    this.rows = [];
    this.past = [];
    this.forgetTheme = onThemeChange(() => this.draw());
    this.watch = new ResizeObserver(() => this.draw());
    this.watch.observe(this.list);
    host.append(this.node);
  }

  // Begin with an episode; `why` is why it is not drawn.
  clear(why = "") {
    this.why = why;
    this.past = [];
    this.rows = [];
    this.list.replaceChildren();
    setText(this.told, why);
  }

  add(observation) {
    if (observation === null) return;
    this.past.push(observation);
    if (this.past.length > MOST_STEPS) this.past.shift();
  }

  draw() {
    const last = this.past.at(-1);
    if (this.node.hidden || last === undefined) return;
    const number = Math.min(MOST_LINES, last.length);
    if (this.rows.length !== number) this.makeRows(number, last.length);
    this.rows.forEach(({ value, canvas }, index) => {
      setText(value, significant(last[index], 3));
      drawLine(
        canvas,
        this.past.map((observation) => observation[index]),
      );
    });
  }

  makeRows(number, all) {
    this.rows = Array.from({ length: number }, () => ({ value: el("span"), canvas: el("canvas") }));
    this.list.replaceChildren(
      ...this.rows.map(({ value, canvas }, index) => {
        canvas.setAttribute("aria-hidden", "true");
        value.className = "value";
        return el("li", {}, el("span", { class: "name" }, `observation ${index}`), canvas, value);
      }),
    );
    const few = number < all ? ` The first ${number} of ${all} numbers are shown.` : "";
    setText(this.told, `${this.why} What the policy sees, over the last ${MOST_STEPS} env steps.${few}`.trim());
  }

  // There is nothing to draw a line of.
  sayNone() {
    setText(this.told, `${this.why} Its observations are images, or too many numbers, to be shown as lines.`.trim());
  }

  close() {
    this.forgetTheme();
    this.watch.disconnect();
  }
}

function drawLine(canvas, values) {
  const ratio = devicePixelRatio;
  const width = Math.round(canvas.clientWidth * ratio);
  const height = Math.round(HEIGHT * ratio);
  if (width === 0) return;
  if (canvas.width !== width) canvas.width = width;
  if (canvas.height !== height) canvas.height = height;
  const context = canvas.getContext("2d");
  context.clearRect(0, 0, width, height);
  const known = values.filter((value) => value !== null);
  if (!known.length) return;
  const low = known.reduce((a, b) => Math.min(a, b));
  const high = known.reduce((a, b) => Math.max(a, b));
  const air = 3 * ratio;
  const y = (value) => (high > low ? height - air - ((value - low) / (high - low)) * (height - 2 * air) : height / 2);
  context.strokeStyle = colour("series-0");
  context.lineWidth = 1.5 * ratio;
  context.lineJoin = "round";
  context.beginPath();
  let isOn = false;
  values.forEach((value, index) => {
    if (value === null) isOn = false;
    else {
      const x = (index / (MOST_STEPS - 1)) * (width - air);
      if (isOn) context.lineTo(x, y(value));
      else context.moveTo(x, y(value));
      isOn = true;
    }
  });
  context.stroke();
}
