// Best so far against what was spent.
import { Chart, paintDot, paintStrong, valueUnder } from "./chart.js";
import { setText } from "./dom.js";
import { count, returnText } from "./format.js";
import { bestSoFar } from "./lines.js";
import { withAir } from "./plot.js";

export class BestChart extends Chart {
  constructor(host, { onOpen }) {
    super(host, {
      title: "Best so far against what was spent",
      label: "Best so far",
      xLabel: "env steps spent by all trials",
      onPick: onOpen,
    });
    this.line = null;
    this.steps = [];
  }

  show({ data }) {
    const { steps, spent, hasEvaluations } = bestSoFar(data.trials, data.curves, data.now());
    this.steps = steps;
    setText(this.caption, `The best ${hasEvaluations ? "evaluation" : "training"} return that any trial had shown.`);
    if (!this.showEither(steps.length > 0, "No return has been shown yet.")) return;
    this.goal = data.goal;
    this.line = {
      colour: "link",
      isStepped: true,
      x: [...steps.map((step) => step.spent), spent],
      y: [...steps.map((step) => step.best), steps.at(-1).best],
    };
    const tops = this.goal !== null && this.goal < 1.5 * Math.abs(this.line.y.at(-1)) ? [this.goal] : [];
    this.plot.setRange({ x: [0, spent || 1], y: withAir(this.line.y[0], Math.max(this.line.y.at(-1), ...tops)) });
    const last = steps.at(-1);
    this.plot.describe(
      `Best so far: ${returnText(last.best)}, by ${last.id}, after ${count(last.spent)} of ${count(spent)} env steps spent.`,
    );
  }

  paint(context, places) {
    this.paintGoal(context, places, true);
    if (!this.line) return;
    paintStrong(context, places, this.line, false);
    for (const step of this.steps) paintDot(context, places, step.spent, step.best, 2.5);
  }

  find(places, left) {
    const x = valueUnder(places, left);
    const step = this.steps.findLast((item) => item.spent <= x) ?? null;
    if (step === null || x > this.line.x.at(-1)) return null;
    return {
      key: step.id + step.at,
      id: step.id,
      lines: [
        returnText(step.best),
        `${step.id}, at ${count(step.at)} of its own env steps`,
        `after ${count(step.spent)} env steps of all`,
      ],
    };
  }
}
