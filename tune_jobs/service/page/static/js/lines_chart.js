// A few named lines, each with a colour of its own, some with bands.
import { Chart, paintStrong } from "./chart.js";
import { setText } from "./dom.js";
import { count, returnText } from "./format.js";
import { valueAt } from "./lines.js";

export class LinesChart extends Chart {
  // `onPick(key)` is called for a line that the reader wants to see more of.
  constructor(host, options) {
    super(host, options);
    this.lines = [];
  }

  // Lines: { key, name, colour, x, y, low, high, isStepped, more }; `more(x)` returns further sentences of a place.
  show({ lines, goal, caption, none }) {
    Object.assign(this, { lines: lines.filter((line) => line.x.length), goal });
    setText(this.caption, caption);
    this.showKeys(this.lines, (line) => line.key);
    if (!this.showEither(this.lines.length > 0, none)) return;
    this.showRange(this.lines);
    const ends = this.lines.map((line) => `${line.name} ends at ${returnText(line.y.at(-1))}`);
    this.plot.describe(`${this.label}: ${ends.join(", ")}.`);
  }

  paint(context, places) {
    const { near } = this;
    this.paintGoal(context, places, Boolean(this.lines?.[0]?.isStepped));
    // The first lies over the others.
    for (const line of this.lines?.toReversed() ?? [])
      paintStrong(context, places, line, near !== null && near !== line.key);
  }

  find(places, left, top) {
    const valueOf = (line, x) => (line.isStepped ? stepAt(line, x) : valueAt(line, x));
    const found = this.nearest(this.lines, places, left, top, valueOf);
    if (found === null) return null;
    const { line, x, y } = found;
    const lines = [returnText(y), line.name, `at ${count(Math.round(x))} env steps`, ...(line.more?.(x) ?? [])];
    return { key: line.key, id: line.key, lines };
  }
}

function stepAt({ x: xs, y: ys }, x) {
  const place = xs.findLastIndex((known) => known <= x);
  return place < 0 || x > xs.at(-1) ? null : ys[place];
}
