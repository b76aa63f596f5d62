// One trial: its point, its curve, why it failed, and its log, which follows while it runs.
import { colour, el, reconcile, setAttribute, setText } from "./dom.js";
import { count, counted, duration, moment, returnText, settingText } from "./format.js";
import { drawLine, lineOf, valueAt } from "./lines.js";
import { CheckpointLinks } from "./play_links.js";
import { Plot, withAir } from "./plot.js";
import { shownPoint } from "./shown_point.js";
import { trialTone } from "./states.js";

const POLL_MS = 2000;
const ENDED_POLL_MS = 15_000;
const KEYS = [
  ["training return", "series-0"],
  ["evaluation return", "series-1"],
];
const WIDE = matchMedia("(min-width: 75rem)");

export class TrialPanel {
  // `onClose()` is called when the reader closes it, `onStep(1 | -1)` when they want the next one in the table.
  constructor(host, { source, onClose, onStep }) {
    Object.assign(this, { source, onClose });
    this.id = null;
    this.curve = [];
    this.lines = [];
    const close = el("button", { type: "button", class: "plain", onclick: () => this.dismiss() }, "Close");
    const step = (label, by) =>
      el(
        "button",
        { type: "button", class: "plain", "aria-label": `${label} trial in the table`, onclick: () => onStep(by) },
        by > 0 ? "↓" : "↑",
      );
    this.title = el("h2", { id: "trial-title", tabindex: -1 });
    this.state = el("span", { class: "state" });
    this.problem = el("p", { class: "problem", role: "alert" });
    this.why = el(
      "section",
      { class: "why", "aria-label": "Why it failed", hidden: true },
      el("h3", {}, "Why it failed"),
      el("pre", { tabindex: 0, role: "region", "aria-label": "Error" }),
    );
    this.point = el("dl", { class: "pairs" });
    this.facts = el("dl", { class: "pairs" });
    this.notes = el("ul", { class: "small" });
    this.fixed = el("dl", { class: "pairs" });
    this.log = el("pre", { class: "log", role: "log", tabindex: 0, "aria-label": "Log", "aria-live": "off" });
    this.chart = el("div", {});
    this.checkpoints = new CheckpointLinks(source);
    this.dialog = el(
      "dialog",
      { class: "panel", "aria-labelledby": "trial-title" },
      el(
        "div",
        { class: "panel-head" },
        this.title,
        this.state,
        el("span", { class: "gap" }),
        step("Previous", -1),
        step("Next", 1),
        close,
      ),
      el(
        "div",
        { class: "panel-body" },
        this.problem,
        this.why,
        el("section", { "aria-label": "Values" }, el("h3", {}, "Values"), this.point),
        el(
          "section",
          { "aria-label": "Curve" },
          el("h3", {}, "Curve"),
          this.chart,
          el(
            "ul",
            { class: "keys", "aria-hidden": "true" },
            KEYS.map(([name, colours]) => el("li", {}, el("i", { class: `mark ${colours}` }), name)),
          ),
        ),
        el("section", { "aria-label": "Facts" }, el("h3", {}, "Facts"), this.facts, this.notes),
        this.checkpoints.node,
        el("section", { "aria-label": "Log", hidden: source.isFile }, el("h3", {}, "Log"), this.log),
        el("details", {}, el("summary", {}, "All hyperparameters"), this.fixed),
      ),
    );
    this.dialog.addEventListener("cancel", (event) => {
      event.preventDefault();
      this.dismiss();
    });
    this.dialog.addEventListener("keydown", (event) => {
      if (event.key === "Escape") this.dismiss();
    });
    this.place = () => {
      if (this.dialog.open) this.reopen();
    };
    WIDE.addEventListener("change", this.place);
    host.append(this.dialog);
  }

  get isOpen() {
    return this.id !== null;
  }

  open(id) {
    if (id === this.id) return;
    this.stopAsking();
    const isFirst = this.id === null;
    Object.assign(this, { id, curve: [], lines: [], trial: null });
    setText(this.title, id);
    for (const node of [this.problem, this.log, this.point, this.facts, this.notes, this.fixed]) node.replaceChildren();
    this.why.hidden = true;
    this.checkpoints.show(null);
    setAttribute(this.state, "class", "state");
    setText(this.state, "");
    if (isFirst) this.reopen();
    this.asked = this.source.repeat(
      () => this.refresh(id),
      () => (this.trial && ["completed", "failed", "stopped"].includes(this.trial.status) ? ENDED_POLL_MS : POLL_MS),
    );
    this.asked.now();
  }

  // Beside the tables where there is room, else over everything, with the focus kept inside.
  reopen() {
    const at = scrollY;
    if (this.dialog.open) this.dialog.close();
    if (WIDE.matches) this.dialog.show();
    else this.dialog.showModal();
    this.plot ??= this.makePlot();
    this.title.focus({ preventScroll: true });
    // The browser scrolls to what it opens; the panel stays in sight by itself.
    scrollTo({ top: at, behavior: "instant" });
  }

  makePlot() {
    return new Plot(this.chart, {
      label: "Curve of the trial",
      xLabel: "env steps",
      yLabel: "return",
      height: 190,
      paint: (context, places) => this.paint(context, places),
      find: (places, left) => this.find(places, left),
    });
  }

  async refresh(id) {
    try {
      const { trial, log, iterations } = await this.source.trial(id, this.curve.at(-1)?.iteration ?? 0);
      if (id !== this.id) return;
      this.curve.push(...iterations.filter((row) => row.iteration > (this.curve.at(-1)?.iteration ?? 0)));
      // A trial that was tried again begins anew.
      if (this.curve.length && trial.num_iterations < this.curve.at(-1).iteration && trial.status === "running")
        this.curve = this.curve.filter((row) => row.iteration <= trial.num_iterations);
      setText(this.problem, "");
      this.show(trial, log);
    } catch (error) {
      if (id === this.id) setText(this.problem, [error.message, error.hint].filter(Boolean).join(" "));
      throw error;
    }
  }

  show(trial, log) {
    this.trial = trial;
    setAttribute(this.state, "class", `state ${trialTone(trial.status)}`);
    setText(this.state, trial.status);
    this.why.hidden = !trial.error;
    setText(this.why.querySelector("pre"), trial.error);
    const values = Object.entries(shownPoint(trial)).map(([name, value]) => [name, told(value, trial.point[name])]);
    pairs(this.point, values.length ? values : [["", "nothing is searched"]]);
    pairs(this.facts, factsOf(trial));
    this.checkpoints.show(trial);
    reconcile(
      this.notes,
      trial.notes,
      (note) => note,
      (note) => el("li", {}, note),
      () => {},
    );
    pairs(
      this.fixed,
      Object.entries(trial.hyperparams).map(([name, value]) => [name, settingText(value)]),
    );
    this.showCurve();
    const isAtEnd = this.log.scrollHeight - this.log.scrollTop - this.log.clientHeight < 40;
    setText(this.log, log || "It has printed nothing.");
    // The log follows, unless the reader has scrolled up.
    if (isAtEnd || !this.hasScrolled) this.log.scrollTop = this.log.scrollHeight;
    this.hasScrolled = true;
  }

  showCurve() {
    const columns = Object.fromEntries(
      ["num_env_steps", "training_return", "evaluation_return"].map((name) => [
        name,
        this.curve.map((row) => row[name]),
      ]),
    );
    this.lines = KEYS.map(([name, key]) => ({ name, colour: key, ...lineOf(columns, name.split(" ")[0]) }));
    const values = this.lines.flatMap((line) => line.y);
    const right = Math.max(1, ...this.lines.map((line) => line.x.at(-1) ?? 0));
    if (values.length)
      this.plot.setRange({
        x: [0, right],
        y: withAir(
          values.reduce((a, b) => Math.min(a, b)),
          values.reduce((a, b) => Math.max(a, b)),
        ),
      });
    const last = this.lines[0].y.at(-1);
    this.plot.describe(
      values.length
        ? `Curve of ${this.id}: training return ${returnText(last)} after ${counted(right, "env step")}.`
        : `${this.id} has shown no return yet.`,
    );
  }

  paint(context, places) {
    for (const line of this.lines) {
      context.strokeStyle = context.fillStyle = colour(line.colour);
      context.lineWidth = 2 * places.ratio;
      context.beginPath();
      drawLine(context, places, line);
      context.stroke();
      if (line.x.length > 60 || line.name !== "evaluation return") continue;
      for (let index = 0; index < line.x.length; index += 1) {
        context.beginPath();
        context.arc(places.x(line.x[index]), places.y(line.y[index]), 2.5 * places.ratio, 0, 7);
        context.fill();
      }
    }
  }

  find(places, left) {
    const x = places.min + ((left - places.left) / places.width) * (places.max - places.min);
    const found = this.lines.map((line) => [line.name, valueAt(line, x)]).filter(([, value]) => value !== null);
    return found.length
      ? {
          key: Math.round(x),
          lines: [`${count(Math.round(x))} env steps`, ...found.map(([name, value]) => `${name} ${returnText(value)}`)],
        }
      : null;
  }

  dismiss() {
    this.hide();
    this.onClose();
  }

  hide() {
    this.stopAsking();
    this.id = null;
    this.hasScrolled = false;
    if (this.dialog.open) this.dialog.close();
  }

  stopAsking() {
    this.asked?.close();
    this.asked = null;
  }

  close() {
    this.hide();
    WIDE.removeEventListener("change", this.place);
    this.plot?.close();
  }
}

function pairs(list, items) {
  reconcile(
    list,
    items,
    ([name]) => name,
    () => el("div", {}, el("dt"), el("dd")),
    (node, [name, text]) => {
      setText(node.firstElementChild, name);
      setText(node.lastElementChild, text);
    },
  );
}

// A value that the score was reached with, and the newest, where a population has changed it since.
function told(value, newest) {
  const [text, now] = [settingText(value), settingText(newest)];
  return text === now ? text : `${text} (now ${now})`;
}

function factsOf(trial) {
  const checkpoints = trial.checkpoints.map((item) => count(item.num_env_steps)).join(", ");
  return [
    ["score", returnText(trial.score)],
    ["training return", returnText(trial.training_return)],
    ["evaluation return", returnText(trial.evaluation_return)],
    ["env steps", count(trial.num_env_steps)],
    ["iterations", count(trial.num_iterations)],
    ["episodes", count(trial.num_episodes)],
    ["time", duration(trial.time_s)],
    ["ended by", trial.stop_reason],
    ["failures", trial.num_failures ? count(trial.num_failures) : null],
    ["point, seed", `${trial.point_index}, ${trial.seed}`],
    ["engine", trial.engine],
    ["node", trial.node],
    ["started", trial.started_at ? moment(trial.started_at) : null],
    ["checkpoints", checkpoints ? `at ${checkpoints} env steps` : null],
  ].filter(([, text]) => text !== null && text !== undefined && text !== "–");
}
