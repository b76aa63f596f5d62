// Learning curves: the leading and the chosen ones strong, the others pale; median and range where there are seeds.
import { colour, el, reconcile, setAttribute, setText } from "./dom.js";
import { count, counted, pointText, returnText } from "./format.js";
import { bandOf, drawLine, lineOf, valueAt } from "./lines.js";
import { Plot, withAir } from "./plot.js";

export const NUM_LEADING = 5;
// Without the light blue, which on a dark page is too near to the blue.
export const COLOURS = ["series-0", "series-1", "series-2", "series-3", "series-5"];
const MOST_PALE = 400;
const NEAR_PX = 24;

export class CurvesChart {
  // `onOpen(trialId)` and `onMetric(metric)` are called for what the reader does.
  constructor(host, { onOpen, onMetric }) {
    this.strong = [];
    this.pale = [];
    this.hovered = null;
    this.onOpen = onOpen;
    this.metrics = el(
      "div",
      { class: "segments", role: "group", "aria-label": "Return" },
      [
        ["training", "Training"],
        ["evaluation", "Evaluation"],
      ].map(([key, label]) =>
        el("button", { type: "button", dataset: { metric: key }, onclick: () => onMetric(key) }, label),
      ),
    );
    this.caption = el("p", { class: "quiet small" });
    this.none = el("p", { class: "missing quiet" });
    this.keys = el("ul", { class: "keys" });
    const body = el("div", { class: "plot-room" });
    host.append(
      el("div", { class: "card-head" }, el("h2", {}, "How the leading settings learn"), this.metrics),
      this.caption,
      body,
      this.none,
      this.keys,
    );
    this.body = body;
    this.plot = new Plot(body, {
      label: "Learning curves",
      xLabel: "env steps of a trial",
      height: 300,
      paint: (context, places) => this.paint(context, places),
      find: (places, left, top) => this.find(places, left, top),
      onPick: onOpen,
    });
  }

  // `matching` are the trials that filter and ranges let through; `chosen` a Map of ids to colours.
  show({ data, matching, chosen, metric }) {
    for (const button of this.metrics.children)
      setAttribute(button, "aria-pressed", String(button.dataset.metric === metric));
    const points = data.rankedPoints(matching);
    const several = data.hasSeveralSeeds;
    this.strong = chosen.size ? chosenLines(data, chosen, metric) : leadingLines(data, points, metric);
    const inStrong = new Set(this.strong.flatMap((line) => line.ids));
    const others = matching.filter((trial) => !inStrong.has(trial.trial_id) && data.curves.has(trial.trial_id));
    const step = Math.max(1, others.length / MOST_PALE);
    const picks = Array.from(
      { length: Math.ceil(others.length / step) },
      (_, index) => others[Math.floor(index * step)],
    );
    this.pale = picks
      .map((trial) => ({ id: trial.trial_id, trial, ...lineOf(data.curves.get(trial.trial_id), metric, 60) }))
      .filter((line) => line.x.length);
    this.goal = data.goal;
    const what =
      metric === "training"
        ? "Training return (mean of the last 100 episodes, exploring)"
        : "Evaluation return (greedy, fixed seeds)";
    const who = chosen.size
      ? "the chosen trials"
      : several
        ? "each leading setting: median and range over its seeds"
        : "the leading trials";
    const left =
      others.length > picks.length
        ? `; ${count(picks.length)} of ${count(others.length)} others are drawn`
        : "; the others are pale";
    setText(this.caption, `${what} of ${who}${left}.`);
    this.showRange();
    this.showKeys();
  }

  showRange() {
    const lines = [...this.pale, ...this.strong.flatMap((line) => [line, ...line.seeds])];
    const has = lines.some((line) => line.x.length);
    this.body.hidden = !has;
    setText(this.none, has ? "" : "No return has been shown yet.");
    if (!has) return;
    let [right, low, high] = [0, Infinity, -Infinity];
    for (const line of lines) {
      for (const x of line.x) if (x > right) right = x;
      for (const y of line.y) {
        if (y < low) low = y;
        if (y > high) high = y;
      }
    }
    if (this.goal !== null && this.goal > low && this.goal < high + 0.3 * (high - low))
      high = Math.max(high, this.goal);
    this.plot.setRange({ x: [0, right || 1], y: withAir(low, high) });
    const best = this.strong[0];
    this.plot.describe(
      `Learning curves of ${counted(this.pale.length + this.strong.length, "line")}${best ? `; ${best.name} is at ${returnText(best.y.at(-1))} now` : ""}. The table of trials has the same numbers.`,
    );
  }

  showKeys() {
    reconcile(
      this.keys,
      this.strong,
      (line) => line.key,
      (line) => {
        const mark = el("i", { class: "mark" });
        const item = el(
          "li",
          {},
          el("button", { type: "button", onclick: () => this.onOpen(line.ids[0]) }, mark, el("span", {}), el("b", {})),
        );
        item.addEventListener("pointerenter", () => this.highlight(line.key));
        item.addEventListener("pointerleave", () => this.highlight(null));
        return item;
      },
      (item, line) => {
        const [mark, name, value] = item.firstElementChild.children;
        mark.style.backgroundColor = colour(line.colour);
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
    const near = this.plot?.found?.key ?? this.hovered;
    context.lineWidth = ratio;
    context.strokeStyle = colour("muted");
    context.globalAlpha = Math.max(0.12, Math.min(0.45, 12 / Math.sqrt(1 + this.pale.length) / 5));
    context.beginPath();
    for (const line of this.pale) drawLine(context, places, line);
    context.stroke();
    context.globalAlpha = 1;
    if (this.goal !== null) this.paintGoal(context, places);
    // The first lies over the others.
    for (const line of this.strong.toReversed())
      this.paintStrong(context, places, line, near !== null && near !== undefined && near !== line.key);
    const pale = this.pale.find((line) => line.id === near);
    if (!pale) return;
    context.strokeStyle = colour("ink");
    context.lineWidth = 1.75 * ratio;
    context.beginPath();
    drawLine(context, places, pale);
    context.stroke();
  }

  paintGoal(context, places) {
    context.strokeStyle = colour("accent");
    context.setLineDash([5 * places.ratio, 4 * places.ratio]);
    context.beginPath();
    context.moveTo(places.left, places.y(this.goal));
    context.lineTo(places.left + places.width, places.y(this.goal));
    context.stroke();
    context.setLineDash([]);
  }

  paintStrong(context, places, line, isBehind) {
    const ink = colour(line.colour);
    context.strokeStyle = ink;
    context.fillStyle = ink;
    if (line.low) {
      context.globalAlpha = isBehind ? 0.06 : 0.16;
      context.beginPath();
      drawLine(context, places, { x: line.x, y: line.high });
      for (let index = line.x.length - 1; index >= 0; index -= 1)
        context.lineTo(places.x(line.x[index]), places.y(line.low[index]));
      context.fill();
    }
    context.globalAlpha = isBehind ? 0.15 : 0.4;
    context.lineWidth = places.ratio;
    context.beginPath();
    for (const seed of line.seeds) drawLine(context, places, seed);
    context.stroke();
    context.globalAlpha = isBehind ? 0.4 : 1;
    context.lineWidth = 2.25 * places.ratio;
    context.beginPath();
    drawLine(context, places, line);
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
    for (const line of [...this.strong, ...this.pale]) {
      const y = valueAt(line, x);
      if (y === null) continue;
      // A strong line is meant where a pale one is as near.
      const distance = Math.abs(places.y(y) - top) * (line.key ? 0.6 : 1);
      if (distance < least) [least, nearest] = [distance, { line, y }];
    }
    if (nearest === null) return null;
    const { line, y } = nearest;
    const range = line.low ? [`${counted(line.numSeeds, "seed")}, median and range`] : [];
    const lines = [returnText(y), line.name ?? nameOf(line.trial), `at ${count(Math.round(x))} env steps`, ...range];
    return { key: line.key ?? line.id, id: line.ids?.[0] ?? line.id, lines };
  }

  close() {
    this.plot.close();
  }
}

function nameOf(trial) {
  return [trial.trial_id, pointText(trial.point)].filter(Boolean).join("  ");
}

function chosenLines(data, chosen, metric) {
  return data.trials
    .filter((trial) => chosen.has(trial.trial_id))
    .map((trial) => ({
      key: trial.trial_id,
      ids: [trial.trial_id],
      colour: chosen.get(trial.trial_id),
      name: nameOf(trial),
      seeds: [],
      ...lineOf(data.curves.get(trial.trial_id), metric),
    }));
}

function leadingLines(data, points, metric) {
  const begun = points
    .filter((point) => point.trials.some((trial) => data.curves.has(trial.trial_id)))
    .slice(0, NUM_LEADING);
  return begun.map((point, rank) => {
    const seeds = point.trials
      .map((trial) => lineOf(data.curves.get(trial.trial_id), metric))
      .filter((line) => line.x.length);
    const band = bandOf(seeds);
    const ids = point.trials
      .toSorted((a, b) => (b.score ?? -Infinity) - (a.score ?? -Infinity))
      .map((trial) => trial.trial_id);
    const text = pointText(point.point) || "no searched values";
    return {
      key: `point ${point.index}`,
      ids,
      colour: COLOURS[rank % COLOURS.length],
      name: `${rank + 1}. ${text}`,
      seeds: band ? seeds : [],
      ...(band ?? seeds[0] ?? { x: [], y: [] }),
    };
  });
}
