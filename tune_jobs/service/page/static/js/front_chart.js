// A dot for each setting, by its cost and its score, and the front as steps.
import { paintDot } from "./chart.js";
import { colour, el, setText } from "./dom.js";
import { count, counted, pointText, returnText, tickTexts } from "./format.js";
import { drawLine } from "./lines.js";
import { Plot, withAir } from "./plot.js";

const HEIGHT_PX = 300;
const NEAR_PX = 24;
const MOST_TICKS = 60;
// In the order in which they are painted, so that the last lie over the others. As in the report, analysis/charts/front.py.
const KINDS = {
  other: { name: "other settings", colour: "muted", radius: 2.5 },
  undecided: { name: "may be on the front", colour: "series-1", radius: 4, isHollow: true },
  front: { name: "the front", colour: "series-0", radius: 4.5 },
  near: { name: "the cheapest near the best", colour: "series-2", radius: 6.5 },
  best: { name: "the best", colour: "accent", radius: 6.5 },
};

export class FrontChart {
  // `onOpen(trialId)` is called for a setting that the reader wants to see more of.
  constructor(host, { onOpen }) {
    this.dots = [];
    this.line = { x: [], y: [] };
    this.isLog = false;
    this.body = el("div", { class: "plot-room" });
    this.keys = el("ul", { class: "keys" });
    this.items = Object.fromEntries(
      Object.entries(KINDS).map(([kind, { name, colour: of, isHollow }]) => {
        const mark = el("i", { class: `dot ${of} ${isHollow ? "hollow" : ""}`, "aria-hidden": "true" });
        return [kind, el("li", { hidden: true }, mark, el("span", {}, name))];
      }),
    );
    this.keys.append(...Object.values(this.items));
    host.append(this.body, this.keys);
    this.plot = new Plot(this.body, {
      label: "Score against cost",
      xLabel: "env steps of a training, mean over seeds",
      yLabel: "return",
      height: HEIGHT_PX,
      paint: (context, places) => this.paint(context, places),
      find: (places, left, top) => this.find(places, left, top),
      onPick: onOpen,
      axes: [
        {
          splits: (_u, _axis, low, high, increment) => (this.isLog ? decades(low, high, increment) : steps(low, high, increment)),
          values: (_u, values) => tickTexts(values.map((value) => (this.isLog ? 10 ** value : value))),
        },
      ],
    });
  }

  // `view` is the service's answer; `firstTrials` are the ids of the points' first trials, and `points` their values, by point.
  show(view, { points, firstTrials }) {
    const { front, others } = view;
    // All of it, of which the table has the cheapest.
    const whole = [...front.points, ...view.more_on_front];
    const costs = [...others, ...front.undecided, ...whole].map((item) => item.num_env_steps);
    this.isLog = view.costs_lie_far_apart && Math.min(...costs) > 0;
    const near = front.cheapest_near.point_index;
    const kindOf = (item, kind) => (item.rank === 1 ? "best" : item.point_index === near ? "near" : kind);
    const dots = [
      ...others.map((item) => this.dot(item, "other")),
      ...front.undecided.map((item) => this.dot(item, kindOf(item, "undecided"))),
      ...whole.map((item) => this.dot(item, kindOf(item, "front"))),
    ];
    for (const dot of dots) {
      dot.id = firstTrials.get(dot.item.point_index) ?? null;
      dot.text = pointText(dot.item.point ?? points.get(dot.item.point_index), 4) || "no searched values";
    }
    const order = Object.keys(KINDS);
    this.dots = dots.sort((a, b) => order.indexOf(a.kind) - order.indexOf(b.kind));
    for (const [kind, item] of Object.entries(this.items)) item.hidden = !dots.some((dot) => dot.kind === kind);
    const xs = this.dots.map((dot) => dot.x);
    const ys = this.dots.map((dot) => dot.y);
    const [low, high] = [Math.min(...xs), Math.max(...xs)];
    const on = whole.map((item) => this.dot(item, "front"));
    // Drawn on to the greatest cost, as more is not to be had for more.
    this.line = { x: [...on.map((dot) => dot.x), high], y: [...on.map((dot) => dot.y), on.at(-1).y] };
    const x = this.isLog ? withAir(low, high) : [0, high * 1.03 || 1];
    this.plot.setRange({ x, y: withAir(Math.min(...ys), Math.max(...ys)) });
    const ends = `from ${told(whole[0])} to ${told(whole.at(-1))}`;
    const listed = whole.length === 1 ? `: ${told(whole[0])}` : ` ${ends}`;
    this.plot.describe(
      `Score against cost of ${counted(view.num_settings, "setting")}; on the front ${counted(front.num_on_front, "setting")}${listed}.`,
    );
  }

  dot(item, kind) {
    return { item, kind, x: this.isLog ? Math.log10(item.num_env_steps) : item.num_env_steps, y: item.expected };
  }

  paint(context, places) {
    // While the plot is made it is painted once already.
    if (!this.dots?.length) return;
    context.strokeStyle = colour("series-0");
    context.lineWidth = 1.75 * places.ratio;
    context.beginPath();
    drawLine(context, places, this.line, true);
    context.stroke();
    const found = this.plot?.found?.key ?? null;
    for (const dot of this.dots) {
      const { radius, colour: of, isHollow } = KINDS[dot.kind];
      context.fillStyle = isHollow ? colour("card") : colour(of);
      context.globalAlpha = dot.kind === "other" ? 0.75 : 1;
      paintDot(context, places, dot.x, dot.y, radius);
      context.globalAlpha = 1;
      context.lineWidth = (isHollow ? 1.75 : 1) * places.ratio;
      context.strokeStyle = colour(isHollow ? of : "card");
      context.stroke();
      if (found === dot.item.point_index) {
        context.strokeStyle = colour("ink");
        context.lineWidth = 2 * places.ratio;
        context.stroke();
      }
    }
  }

  find(places, left, top) {
    let nearest = null;
    let least = NEAR_PX * places.ratio;
    for (const dot of this.dots) {
      const distance = Math.hypot(places.x(dot.x) - left, places.y(dot.y) - top);
      // Of those at one place the one that lies above.
      if (distance <= least) [least, nearest] = [distance, dot];
    }
    if (nearest === null) return null;
    const { item, kind, id, text } = nearest;
    const cost = `${count(Math.round(item.num_env_steps))} env steps a training`;
    const place = kind === "other" ? `rank ${item.rank}` : `rank ${item.rank}, ${KINDS[kind].name}`;
    return { key: item.point_index, id, lines: [returnText(item.expected), cost, place, text] };
  }

  close() {
    this.plot.close();
  }
}

const told = (item) => `${returnText(item.expected)} for ${count(Math.round(item.num_env_steps))} env steps`;

// Multiples of what uPlot takes for the distance of ticks.
function steps(low, high, increment) {
  const first = Math.ceil(low / increment);
  const found = Array.from({ length: MOST_TICKS }, (_, index) => (first + index) * increment);
  return found.filter((value) => value >= low && value <= high);
}

// Of a range of decimal logarithms: 1, 2 and 5 times the powers of ten.
function decades(low, high, increment) {
  const powers = Array.from({ length: MOST_TICKS }, (_, index) => Math.floor(low) + index);
  const found = powers.flatMap((power) => [1, 2, 5].map((factor) => power + Math.log10(factor)));
  const seen = found.filter((value) => value >= low && value <= high);
  return seen.length > 1 ? seen : steps(low, high, increment);
}
