// Score against cost: the settings on their Pareto front, of a sweep that asks for it, as trials end.
import { Again } from "./again.js";
import { el, setAttribute, setText } from "./dom.js";
import { Ended } from "./ended.js";
import { FrontChart } from "./front_chart.js";
import { count, NONE, rangeText, returnText, valueText } from "./format.js";
import { shownPoint } from "./shown_point.js";

const TOO_FEW = "Said once trials of two settings have ended.";
const DRAWN = "Each dot is a setting, by its expected mean over seeds; none that was scored lies above the line.";

export class FrontCard {
  // `onOpen(trialId)` is called for a setting that the reader wants to see more of.
  constructor(card, source, { onOpen }) {
    Object.assign(this, { card, source, onOpen });
    this.ended = new Ended();
    this.isAsking = false;
    this.view = null;
    this.data = null;
    this.generation = 0;
    this.again = new Again(() => this.follow(this.data));
    this.near = el("p", {});
    this.missing = el("p", { class: "missing quiet" }, TOO_FEW);
    this.drawn = el("div", { class: "front-drawn" }, el("p", { class: "quiet small" }, DRAWN));
    this.table = el("table", {}, el("caption", { class: "for-readers" }, "Settings on the front, the cheapest first"));
    const scroller = { class: "sideways", role: "region", tabindex: 0, "aria-label": "Table of the front" };
    this.parts = el("div", { class: "front-parts", hidden: true }, this.drawn, el("div", scroller, this.table));
    this.about = el("p", { class: "quiet small" });
    card.append(
      el("div", { class: "card-head" }, el("h2", {}, "Score against cost")),
      this.near,
      this.missing,
      this.parts,
      this.about,
    );
    this.chart = null;
  }

  // Asked for again as trials end, and where it did not come; shown with the trials that there are now.
  async follow(data) {
    this.data = data;
    this.card.hidden = !data.spec?.objective?.cost;
    if (this.card.hidden || this.isAsking || this.again.isWaiting || !this.ended.isDue(data.summary)) return;
    this.isAsking = true;
    const { generation } = this;
    try {
      const view = await this.source.front();
      this.again.reset();
      if (generation === this.generation) this.show(view, data);
    } catch (error) {
      if (generation === this.generation) this.refuse(error);
    } finally {
      this.isAsking = false;
    }
    // Meanwhile the sweep has become another one, of which nothing is asked yet.
    if (generation !== this.generation) this.follow(this.data);
  }

  refuse(error) {
    // Asked for again with the next trials: what can't be made now may not be so in a second.
    if (this.view === null) setText(this.missing, error.message);
    if (!this.source.isFile && this.again.failed(error)) this.ended.forget();
  }

  // The sweep is another one of the same name: what is shown is not its.
  forget() {
    this.generation += 1;
    this.view = null;
    this.again.reset();
    this.ended.forget();
    this.missing.hidden = false;
    this.parts.hidden = this.near.hidden = this.about.hidden = true;
    setText(this.missing, TOO_FEW);
  }

  show(view, data) {
    if (this.isClosed) return;
    const isThere = view.front !== null && view.num_settings > 1;
    this.missing.hidden = isThere;
    this.parts.hidden = this.near.hidden = this.about.hidden = !isThere;
    setText(this.missing, TOO_FEW);
    if (!isThere) return;
    this.view = view;
    this.near.replaceChildren(el("b", {}, "The cheapest near the best: "), `${view.cheapest_near}.`);
    setText(this.about, view.about.join(" "));
    const points = new Map(data.trials.map((trial) => [trial.point_index, shownPoint(trial)]));
    const firstTrials = new Map(data.trials.toReversed().map((trial) => [trial.point_index, trial.trial_id]));
    this.chart ??= new FrontChart(this.drawn, { onOpen: this.onOpen });
    this.chart.show(view, { points, firstTrials });
    this.showTable(view.front, data.searched, firstTrials);
  }

  showTable(front, searched, firstTrials) {
    const near = front.cheapest_near.point_index;
    const onFront = (item) => (item.point_index === near ? "yes, the cheapest near the best" : "yes");
    const rows = [
      ...front.points.map((item) => ({ item, told: onFront(item) })),
      ...front.undecided.map((item) => ({ item, told: "may be" })),
    ].sort((a, b) => a.item.num_env_steps - b.item.num_env_steps || a.item.rank - b.item.rank);
    const hasSeveral = front.num_undecided !== null;
    // A name that acts in none of them has no column.
    const names = searched.filter(({ name }) => rows.some(({ item }) => name in item.point));
    const number = (text) => ({ text, isNumber: true });
    const headings = [
      number("env steps"),
      number("score"),
      ...(hasSeveral ? [number("95 % interval")] : []),
      number("rank"),
      { text: "on the front", isShort: true },
      ...names.map(({ name, isNumber }) => ({ text: name, isNumber })),
      ...(hasSeveral ? [number("seeds")] : []),
      { text: "first trial" },
    ];
    const cellsOf = ({ item, told }) => [
      count(Math.round(item.num_env_steps)),
      returnText(item.score),
      ...(hasSeveral ? [interval(item)] : []),
      String(item.rank),
      told,
      ...names.map(({ name }) => valueText(item.point, name)),
      ...(hasSeveral ? [count(item.num_seeds)] : []),
      this.trialLink(firstTrials.get(item.point_index)),
    ];
    const kind = ({ isNumber, isShort }) => (isNumber ? "number" : isShort ? "short" : null);
    const head = headings.map((heading) => el("th", { scope: "col", class: kind(heading) }, heading.text));
    const body = rows.map((row) =>
      el(
        "tr",
        { class: row.told === "may be" ? "quiet" : null },
        cellsOf(row).map((cell, index) =>
          el(index ? "td" : "th", { class: kind(headings[index]), scope: index ? null : "row" }, cell),
        ),
      ),
    );
    const [caption] = this.table.children;
    const focused = this.table.contains(document.activeElement) ? document.activeElement.textContent : null;
    this.table.replaceChildren(caption, el("thead", {}, el("tr", {}, head)), el("tbody", {}, body));
    setAttribute(this.table, "class", "front-table");
    // Who was on a link of a row is on the same trial's again.
    if (focused !== null) [...this.table.querySelectorAll("button")].find((link) => link.textContent === focused)?.focus();
  }

  trialLink(id) {
    if (id === undefined) return NONE;
    return el("button", { type: "button", class: "link", onclick: () => this.onOpen(id) }, id);
  }

  close() {
    this.isClosed = true;
    this.again.close();
    this.chart?.close();
  }
}

const interval = ({ lower, upper }) =>
  lower === null || upper === null ? NONE : rangeText(lower, upper);
