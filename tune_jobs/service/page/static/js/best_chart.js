// Best so far against what was spent.
import { colour, el, setText } from "./dom.js";
import { count, returnText } from "./format.js";
import { bestSoFar, drawLine } from "./lines.js";
import { Plot, withAir } from "./plot.js";

export class BestChart {
  constructor(host, { onOpen }) {
    this.line = { x: [], y: [] };
    this.steps = [];
    this.goal = null;
    this.caption = el("p", { class: "quiet small" });
    this.none = el("p", { class: "missing quiet" });
    this.body = el("div", { class: "plot-room" });
    host.append(
      el("div", { class: "card-head" }, el("h2", {}, "Best so far against what was spent")),
      this.caption,
      this.body,
      this.none,
    );
    this.plot = new Plot(this.body, {
      label: "Best so far",
      xLabel: "env steps spent by all trials",
      height: 300,
      paint: (context, places) => this.paint(context, places),
      find: (places, left) => this.find(places, left),
      onPick: onOpen,
    });
  }

  show({ data }) {
    const { steps, spent, hasEvaluations } = bestSoFar(data.trials, data.curves, data.now());
    this.steps = steps;
    this.body.hidden = steps.length === 0;
    setText(this.none, steps.length ? "" : "No return has been shown yet.");
    setText(this.caption, `The best ${hasEvaluations ? "evaluation" : "training"} return that any trial had shown.`);
    if (!steps.length) return;
    this.goal = data.goal;
    this.line = {
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
    const { ratio } = places;
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
    context.strokeStyle = colour("link");
    context.fillStyle = colour("link");
    context.lineWidth = 2.25 * ratio;
    context.beginPath();
    drawLine(context, places, this.line, true);
    context.stroke();
    for (const step of this.steps) {
      context.beginPath();
      context.arc(places.x(step.spent), places.y(step.best), 2.5 * ratio, 0, 7);
      context.fill();
    }
  }

  find(places, left) {
    const x = places.min + ((left - places.left) / places.width) * (places.max - places.min);
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

  close() {
    this.plot.close();
  }
}
