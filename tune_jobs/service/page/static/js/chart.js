// What the charts of returns over env steps have in common: the card's parts, the keys below, the goal, lines and bands.
import { colour, el, reconcile, setText } from "./dom.js";
import { returnText } from "./format.js";
import { drawLine } from "./lines.js";
import { FONT_FAMILY, Plot, withAir } from "./plot.js";

const HEIGHT_PX = 300;
const NEAR_PX = 24;

// A chart in a card. Who extends it has `paint(context, places)` and `find(places, left, top)`, as a Plot asks for them.
export class Chart {
  // `controls` stand beside the title; `onPick(id)` is called for what the reader clicks.
  constructor(host, { title, label, xLabel, controls = [], onPick }) {
    this.goal = null;
    this.hovered = null;
    this.label = label;
    this.onPick = onPick;
    this.caption = el("p", { class: "quiet small" });
    this.none = el("p", { class: "missing quiet" });
    this.keys = el("ul", { class: "keys" });
    this.body = el("div", { class: "plot-room" });
    const head = el("div", { class: "card-head" }, el("h2", {}, title), controls);
    host.append(head, this.caption, this.body, this.none, this.keys);
    this.plot = new Plot(this.body, {
      label,
      xLabel,
      yLabel: "return",
      height: HEIGHT_PX,
      paint: (context, places) => this.paint(context, places),
      find: (places, left, top) => this.find(places, left, top),
      onPick,
    });
  }

  // Say `none` in place of the plot, unless there is something to show; returns whether there is.
  showEither(isThere, none) {
    this.body.hidden = !isThere;
    setText(this.none, isThere ? "" : none);
    return isThere;
  }

  // A button for each line: its colour, its name and where it ends. `idOf(line)` is what `onPick` is called with.
  showKeys(lines, idOf) {
    const make = (line) => {
      const mark = el("i", { class: "mark" });
      const button = el("button", { type: "button" }, mark, el("span"), el("b"));
      const item = el("li", {}, button);
      const over = (key) => () => this.highlight(key);
      item.addEventListener("pointerenter", over(line.key));
      item.addEventListener("pointerleave", over(null));
      item.addEventListener("focusin", over(line.key));
      item.addEventListener("focusout", over(null));
      return item;
    };
    const update = (item, line) => {
      const button = item.firstElementChild;
      const [mark, name, value] = button.children;
      // The leading trial of a setting changes while it trains.
      button.onclick = () => this.onPick(idOf(line));
      mark.className = `mark ${line.colour}`;
      setText(name, line.name);
      setText(value, returnText(line.y.at(-1)));
    };
    reconcile(this.keys, lines, (line) => line.key, make, update);
  }

  highlight(key) {
    if (key === this.hovered) return;
    this.hovered = key;
    this.plot.redraw();
  }

  // The line that the cursor or the focus is on. While the plot is made it is painted once already.
  get near() {
    return this.plot?.found?.key ?? this.hovered;
  }

  // Show all of the lines, and the goal where it is not far above them.
  showRange(lines) {
    let [right, low, high] = [0, Infinity, -Infinity];
    for (const line of lines) {
      for (const x of line.x) if (x > right) right = x;
      for (const values of [line.y, line.low ?? [], line.high ?? []])
        for (const value of values) {
          if (value < low) low = value;
          if (value > high) high = value;
        }
    }
    if (this.goal !== null && this.goal > low && this.goal < high + 0.3 * (high - low))
      high = Math.max(high, this.goal);
    this.plot.setRange({ x: [0, right || 1], y: withAir(low, high) });
  }

  // Its name is on the left, where learning curves are still low; lines of the best rise there: it is on their right.
  paintGoal(context, places, isStepped = false) {
    if (this.goal === null) return;
    context.strokeStyle = colour("accent");
    context.lineWidth = places.ratio;
    context.setLineDash([5 * places.ratio, 4 * places.ratio]);
    context.beginPath();
    context.moveTo(places.left, places.y(this.goal));
    context.lineTo(places.left + places.width, places.y(this.goal));
    context.stroke();
    context.setLineDash([]);
    // Below it, where it would leave the plot; with a rim, as lines go through it.
    const isHigh = isStepped || places.y(this.goal) - places.top < 18 * places.ratio;
    context.font = `${12 * places.ratio}px ${FONT_FAMILY}`;
    context.textAlign = isStepped ? "right" : "left";
    context.textBaseline = isHigh ? "top" : "bottom";
    context.lineWidth = 4 * places.ratio;
    context.strokeStyle = colour("card");
    context.fillStyle = colour("accent");
    const text = `goal ${returnText(this.goal)}`;
    const inset = 6 * places.ratio;
    const left = isStepped ? places.left + places.width - inset : places.left + inset;
    const place = [left, places.y(this.goal) + (isHigh ? 4 : -3) * places.ratio];
    context.strokeText(text, ...place);
    context.fillText(text, ...place);
  }

  // The line nearest to a place on the canvas, as { line, x, y }; null: none is near. `valueOf(line, x)` is a line's value, or
  // null where it has none, and `weightOf(line)` makes it nearer than it is.
  nearest(lines, places, left, top, valueOf, weightOf = () => 1) {
    const x = valueUnder(places, left);
    let nearest = null;
    let least = NEAR_PX * places.ratio;
    for (const line of lines) {
      const y = valueOf(line, x);
      if (y === null) continue;
      const distance = Math.abs(places.y(y) - top) * weightOf(line);
      if (distance < least) [least, nearest] = [distance, { line, x, y }];
    }
    return nearest;
  }

  close() {
    this.plot.close();
  }
}

export const valueUnder = (places, left) =>
  places.min + ((left - places.left) / places.width) * (places.max - places.min);

// A line that is strong, with its band and its seeds, where it has them; pale where another is looked at.
export function paintStrong(context, places, line, isBehind) {
  context.strokeStyle = context.fillStyle = colour(line.colour);
  if (line.low) {
    context.globalAlpha = isBehind ? 0.05 : 0.15;
    context.beginPath();
    drawLine(context, places, { x: line.x, y: line.high });
    for (let index = line.x.length - 1; index >= 0; index -= 1)
      context.lineTo(places.x(line.x[index]), places.y(line.low[index]));
    context.fill();
  }
  if (line.seeds?.length) {
    context.globalAlpha = isBehind ? 0.15 : 0.4;
    context.lineWidth = places.ratio;
    context.beginPath();
    for (const seed of line.seeds) drawLine(context, places, seed);
    context.stroke();
  }
  context.globalAlpha = isBehind ? 0.35 : 1;
  context.lineWidth = 2.25 * places.ratio;
  context.beginPath();
  drawLine(context, places, line, line.isStepped);
  context.stroke();
  if (line.x.length === 1) paintDot(context, places, line.x[0], line.y[0], 3);
  context.globalAlpha = 1;
}

export function paintDot(context, places, x, y, radiusPx) {
  context.beginPath();
  context.arc(places.x(x), places.y(y), radiusPx * places.ratio, 0, 7);
  context.fill();
}
