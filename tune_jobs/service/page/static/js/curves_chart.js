// Learning curves: the leading and the chosen ones strong, the others pale; median and range where there are seeds.
import { Chart, paintStrong } from "./chart.js";
import { colour, el, setAttribute, setText } from "./dom.js";
import { count, counted, pointText, returnText } from "./format.js";
import { bandOf, drawLine, lineOf, valueAt } from "./lines.js";
import { shownPoint } from "./shown_point.js";

export const NUM_LEADING = 5;
// Without the light blue, which on a dark page is too near to the blue.
export const COLOURS = ["series-0", "series-1", "series-2", "series-3", "series-5"];
const MOST_PALE = 400;
const METRICS = [
  ["training", "Training"],
  ["evaluation", "Evaluation"],
];

export class CurvesChart extends Chart {
  // `onOpen(trialId)` and `onMetric(metric)` are called for what the reader does.
  constructor(host, { onOpen, onMetric }) {
    const buttons = METRICS.map(([key, label]) =>
      el("button", { type: "button", dataset: { metric: key }, onclick: () => onMetric(key) }, label),
    );
    const metrics = el("div", { class: "segments", role: "group", "aria-label": "Return" }, buttons);
    super(host, {
      title: "How the leading settings learn",
      label: "Learning curves",
      xLabel: "env steps of a trial",
      controls: metrics,
      onPick: onOpen,
    });
    this.metrics = metrics;
    this.strong = [];
    this.pale = [];
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
    this.showKeys(this.strong, (line) => line.ids[0]);
    const all = [...this.pale, ...this.strong.flatMap((line) => [line, ...line.seeds])].filter((line) => line.x.length);
    if (!this.showEither(all.length > 0, "No return has been shown yet.")) return;
    this.showRange(all);
    const best = this.strong[0];
    this.plot.describe(
      `Learning curves of ${counted(this.pale.length + this.strong.length, "line")}${best ? `; ${best.name} is at ${returnText(best.y.at(-1))} now` : ""}. The table of trials has the same numbers.`,
    );
  }

  paint(context, places) {
    const { near } = this;
    const pale = this.pale ?? [];
    context.lineWidth = places.ratio;
    context.strokeStyle = colour("muted");
    context.globalAlpha = Math.max(0.12, Math.min(0.45, 12 / Math.sqrt(1 + pale.length) / 5));
    context.beginPath();
    for (const line of pale) drawLine(context, places, line);
    context.stroke();
    context.globalAlpha = 1;
    this.paintGoal(context, places);
    // The first lies over the others.
    for (const line of this.strong?.toReversed() ?? [])
      paintStrong(context, places, line, near !== null && near !== line.key);
    const found = pale.find((line) => line.id === near);
    if (!found) return;
    context.strokeStyle = colour("ink");
    context.lineWidth = 1.75 * places.ratio;
    context.beginPath();
    drawLine(context, places, found);
    context.stroke();
  }

  find(places, left, top) {
    // A strong line is meant where a pale one is as near.
    const weightOf = (line) => (line.key ? 0.6 : 1);
    const found = this.nearest([...this.strong, ...this.pale], places, left, top, valueAt, weightOf);
    if (found === null) return null;
    const { line, x, y } = found;
    const range = line.low ? [`${counted(line.numSeeds, "seed")}, median and range`] : [];
    const lines = [returnText(y), line.name ?? nameOf(line.trial), `at ${count(Math.round(x))} env steps`, ...range];
    return { key: line.key ?? line.id, id: line.ids?.[0] ?? line.id, lines };
  }
}

function nameOf(trial) {
  return [trial.trial_id, pointText(shownPoint(trial))].filter(Boolean).join("  ");
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
