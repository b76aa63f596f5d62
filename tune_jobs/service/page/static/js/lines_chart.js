// A few named lines, each with a colour of its own, some with bands.
import { colour, el, reconcile, setText } from "./dom.js";
import { count, returnText } from "./format.js";
import { drawLine, valueAt } from "./lines.js";
import { Plot, withAir } from "./plot.js";

const NEAR_PX = 24;

export class LinesChart {
  // `onPick(key)` is called for a line that the reader wants to see more of.
  constructor(host, { title, label, xLabel, onPick }) {
    this.lines = [];
    this.goal = null;
    this.hovered = null;
    this.onPick = onPick;
    this.label = label;
    this.caption = el("p", { class: "quiet small" });
    this.none = el("p", { class: "missing quiet" });
    this.keys = el("ul", { class: "keys" });
    this.body = el("div", { class: "plot-room" });
    host.append(el("div", { class: "card-head" }, el("h2", {}, title)), this.caption, this.body, this.none, this.keys);
    this.plot = new Plot(this.body, {
      label,
      xLabel,
      height: 300,
      paint: (context, places) => this.paint(context, places),
      find: (places, left, top) => this.find(places, left, top),
      onPick,
    });
  }

  // Lines: { key, name, colour, x, y, low, high, isStepped, more }; `more(x)` returns further sentences of a place.
  show({ lines, goal, caption, none }) {
    Object.assign(this, { lines: lines.filter((line) => line.x.length), goal });
    setText(this.caption, caption);
    this.body.hidden = this.lines.length === 0;
    setText(this.none, this.lines.length ? "" : none);
    this.showKeys();
    if (!this.lines.length) return;
    const right = Math.max(...this.lines.map((line) => line.x.at(-1)));
    const all = this.lines.flatMap((line) => [...line.y, ...(line.low ?? []), ...(line.high ?? [])]);
    const low = Math.min(...all);
    let high = Math.max(...all);
    if (goal !== null && goal > low && goal < high + 0.3 * (high - low)) high = Math.max(high, goal);
    this.plot.setRange({ x: [0, right || 1], y: withAir(low, high) });
    const ends = this.lines.map((line) => `${line.name} ends at ${returnText(line.y.at(-1))}`);
    this.plot.describe(`${this.label}: ${ends.join(", ")}.`);
  }

  showKeys() {
    const make = (line) => {
      const mark = el("i", { class: "mark" });
      const button = el("button", { type: "button", onclick: () => this.onPick(line.key) }, mark, el("span"), el("b"));
      const item = el("li", {}, button);
      const over = (key) => () => this.highlight(key);
      item.addEventListener("pointerenter", over(line.key));
      item.addEventListener("pointerleave", over(null));
      item.addEventListener("focusin", over(line.key));
      item.addEventListener("focusout", over(null));
      return item;
    };
    reconcile(
      this.keys,
      this.lines,
      (line) => line.key,
      make,
      (item, line) => {
        const [mark, name, value] = item.firstElementChild.children;
        mark.className = `mark ${line.colour}`;
        setText(name, line.name);
        setText(value, returnText(line.y.at(-1)));
      },
    );
  }

  highlight(key) {
    if (key === this.hovered) return;
    this.hovered = key;
    this.plot.redraw();
  }

  paint(context, places) {
    const { ratio } = places;
    const near = this.plot?.found?.id ?? this.hovered;
    if (this.goal !== null) {
      context.strokeStyle = colour("accent");
      context.lineWidth = ratio;
      context.setLineDash([5 * ratio, 4 * ratio]);
      context.beginPath();
      context.moveTo(places.left, places.y(this.goal));
      context.lineTo(places.left + places.width, places.y(this.goal));
      context.stroke();
      context.setLineDash([]);
    }
    // The first lies over the others.
    for (const line of this.lines.toReversed())
      this.paintLine(context, places, line, near !== null && near !== line.key);
  }

  paintLine(context, places, line, isBehind) {
    context.strokeStyle = context.fillStyle = colour(line.colour);
    if (line.low) {
      context.globalAlpha = isBehind ? 0.04 : 0.14;
      context.beginPath();
      drawLine(context, places, { x: line.x, y: line.high });
      for (let index = line.x.length - 1; index >= 0; index -= 1)
        context.lineTo(places.x(line.x[index]), places.y(line.low[index]));
      context.fill();
    }
    context.globalAlpha = isBehind ? 0.3 : 1;
    context.lineWidth = 2.25 * places.ratio;
    context.beginPath();
    drawLine(context, places, line, line.isStepped);
    context.stroke();
    if (line.x.length === 1) {
      context.beginPath();
      context.arc(places.x(line.x[0]), places.y(line.y[0]), 3 * places.ratio, 0, 7);
      context.fill();
    }
    context.globalAlpha = 1;
  }

  // The line nearest to the cursor.
  find(places, left, top) {
    const x = places.min + ((left - places.left) / places.width) * (places.max - places.min);
    let nearest = null;
    let least = NEAR_PX * places.ratio;
    for (const line of this.lines) {
      const y = line.isStepped ? stepAt(line, x) : valueAt(line, x);
      if (y === null) continue;
      const distance = Math.abs(places.y(y) - top);
      if (distance < least) [least, nearest] = [distance, { line, y }];
    }
    if (nearest === null) return null;
    const { line, y } = nearest;
    const lines = [returnText(y), line.name, `at ${count(Math.round(x))} env steps`, ...(line.more?.(x) ?? [])];
    return { key: line.key, id: line.key, lines };
  }

  close() {
    this.plot.close();
  }
}

function stepAt({ x: xs, y: ys }, x) {
  const place = xs.findLastIndex((known) => known <= x);
  return place < 0 || x > xs.at(-1) ? null : ys[place];
}
