// What is known of one sweep: its summary, its sweep file, its trials and their curves.
import { isLog, kindOf, LISTED, NEAR_ONE } from "./domains.js";
import { axesOf } from "./parallel_axes.js";
import { shownPoint } from "./shown_point.js";

const FIELDS = [
  "trial_id",
  "index",
  "point_index",
  "seed_index",
  "seed",
  "point",
  "score_point",
  "status",
  "score",
  "training_return",
  "evaluation_return",
  "num_iterations",
  "num_env_steps",
  "time_s",
  "stop_reason",
  "started_at",
  "ended_at",
  "node",
  "pid",
  "num_failures",
].join(",");

export class SweepData {
  // `source` is where it comes from: a ServerSource or a FileSource.
  constructor(source) {
    this.source = source;
    this.summary = null;
    this.spec = null;
    // When the sweep was made that the spec is of: another one may come under its name.
    this.specOf = null;
    this.trials = [];
    // By trial, in columns: env steps, training returns, evaluation returns, and the iterations that they are of.
    this.curves = new Map();
    this.places = new Map();
    this.kept = {};
  }

  // Fetch all; the curves come first, as the events continue from them. `onPart()` is called when there is something to
  // show, and more to come. Returns what the source said with the curves.
  async load(onPart = () => {}) {
    const { source } = this;
    const curves = await source.curves();
    const [summary, known] = await Promise.all([source.summary(), this.spec ?? source.spec()]);
    const isFirst = this.summary === null;
    const isOther = this.spec !== null && summary.created_at !== this.specOf;
    const spec = isOther ? await source.spec() : known;
    const specOf = summary.created_at;
    Object.assign(this, { summary, spec, specOf, curves: new Map(Object.entries(curves.trials)) });
    const trials = await source.trials(FIELDS, (some) => {
      // Later on there is more to be seen than a part.
      if (!isFirst || this.trials.length) return;
      this.trials = some.slice();
      onPart();
    });
    this.trials = trials;
    this.places = new Map(trials.map((trial, place) => [trial.trial_id, place]));
    return curves;
  }

  // Unix time, seconds, that all this is of.
  now() {
    return this.source.now();
  }

  // What is worked out of the trials, kept until there are others.
  keep(name, make) {
    if (this.kept.of !== this.trials) this.kept = { of: this.trials };
    this.kept[name] ??= make();
    return this.kept[name];
  }

  apply(kind, data) {
    if (kind === "status") this.summary = data;
    else if (kind === "trials") this.setTrials(data.trials);
    else if (kind === "iterations") for (const [id, rows] of Object.entries(data.trials)) this.addRows(id, rows);
  }

  setTrials(changed) {
    // Another list, so that who has drawn the old one sees that there is a new one.
    this.trials = this.trials.slice();
    for (const trial of changed) {
      if (!this.places.has(trial.trial_id)) this.places.set(trial.trial_id, this.trials.length);
      this.trials[this.places.get(trial.trial_id)] = trial;
    }
  }

  // New points of a curve: those that are known of later iterations than `after` are no more.
  addRows(id, rows) {
    const known = this.curves.get(id) ?? {
      iteration: [],
      num_env_steps: [],
      training_return: [],
      evaluation_return: [],
    };
    const length = known.iteration.findLastIndex((iteration) => iteration <= rows.after) + 1;
    this.curves.set(
      id,
      Object.fromEntries(
        Object.keys(known).map((column) => [column, [...known[column].slice(0, length), ...rows[column]]]),
      ),
    );
  }

  // The searched hyperparameters in the order of the sweep file, each with how it is drawn.
  get searched() {
    return this.keep("searched", () => this.findSearched());
  }

  // The axes of parallel coordinates.
  get axes() {
    return this.keep("axes", () => axesOf(this.searched, this.trials));
  }

  findSearched() {
    const space = this.spec?.space ?? {};
    const inPoints = new Set(this.trials.flatMap((trial) => Object.keys(shownPoint(trial))));
    const names = [
      ...Object.keys(space).filter((name) => inPoints.has(name)),
      ...[...inPoints].filter((name) => !(name in space)),
    ];
    const isNumber = (name) =>
      this.trials.every((trial) => ["number", "undefined"].includes(typeof shownPoint(trial)[name]));
    return names.map((name) => ({ name, isNumber: isNumber(name), ...scaleOf(space[name]) }));
  }

  get hasSeveralSeeds() {
    return this.keep("hasSeveralSeeds", () => this.trials.some((trial) => trial.seed_index > 0));
  }

  // The return at which the sweep file calls a trial done; null: it names none.
  get goal() {
    return (
      this.spec?.objective?.threshold ?? this.spec?.stop?.evaluation_return ?? this.spec?.stop?.training_return ?? null
    );
  }

  // Points by their mean scores over seeds, best first; those with a failed seed come after, as in the report.
  rankedPoints(trials) {
    const points = new Map();
    for (const trial of trials) {
      const point = points.get(trial.point_index) ?? { index: trial.point_index, point: shownPoint(trial), trials: [] };
      point.trials.push(trial);
      points.set(trial.point_index, point);
    }
    for (const point of points.values()) {
      const scores = point.trials.map((trial) => trial.score).filter((score) => score !== null);
      point.score = scores.length ? scores.reduce((sum, score) => sum + score, 0) / scores.length : null;
      point.hasFailed = point.trials.some((trial) => trial.status === "failed");
    }
    return [...points.values()].sort(
      (a, b) =>
        a.hasFailed - b.hasFailed || (a.score === null) - (b.score === null) || b.score - a.score || a.index - b.index,
    );
  }
}

function scaleOf(domain) {
  const type = kindOf(domain);
  if (type === null || type === "layers") return { kind: "listed", values: [] };
  if (LISTED.includes(type)) return { kind: "listed", values: domain[type] };
  return { kind: isLog(type) ? "log" : type === NEAR_ONE ? "near one" : "linear", values: [] };
}
