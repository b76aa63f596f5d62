// Which hyperparameters the scores depend on, as it firms up.
import { Again } from "./again.js";
import { el, reconcile, setAttribute, setText } from "./dom.js";
import { Ended } from "./ended.js";

const width = (share) => `${100 * share}%`;
const percentText = (share) => `${Math.round(100 * share)} %`;

export class ImportanceCard {
  constructor(card, source) {
    Object.assign(this, { card, source });
    this.ended = new Ended();
    this.isAsking = false;
    this.sweep = null;
    this.generation = 0;
    this.again = new Again(() => this.follow(this.sweep));
    this.caption = el("p", { class: "quiet small" });
    this.rows = el("ul", { class: "shares" });
    this.notes = el("div", { class: "quiet small" });
    card.append(el("div", { class: "card-head" }, el("h2", {}, "What mattered")), this.caption, this.rows, this.notes);
  }

  // It is asked for again as trials end, and where it did not come.
  async follow(sweep) {
    this.sweep = sweep;
    setText(this.caption, this.caption.textContent || "Said once some trials have ended.");
    if (this.isAsking || this.again.isWaiting || !this.ended.isDue(sweep)) return;
    this.isAsking = true;
    const { generation } = this;
    try {
      const found = await this.source.importance();
      this.again.reset();
      if (generation === this.generation) this.show(found);
    } catch (error) {
      if (generation === this.generation) this.refuse(error);
    } finally {
      this.isAsking = false;
    }
    // Meanwhile the sweep has become another one, of which nothing is asked yet.
    if (generation !== this.generation) this.follow(this.sweep);
  }

  refuse(error) {
    // The shares of before stay, with what they are.
    if (!this.rows.children.length) setText(this.caption, error.message);
    if (!this.source.isFile && this.again.failed(error)) this.ended.forget();
  }

  // The sweep is another one of the same name: what is shown is not its.
  forget() {
    this.generation += 1;
    this.again.reset();
    this.ended.forget();
    this.show({ hyperparams: [], too_few: "", interactions: [], edges: [], notes: [] });
  }

  close() {
    this.again.close();
  }

  show({ hyperparams, too_few: tooFew, interactions, edges, notes }) {
    const known = hyperparams.filter((item) => item.share !== null);
    setText(
      this.caption,
      known.length
        ? "The share of the points' ranks that each accounts for by itself, with its 95 % interval; grey: may be chance."
        : "",
    );
    const together = interactions.map(({ names }) => `${names.join(" and ")} matter together.`);
    const sentences = tooFew ? [tooFew, ...notes] : [...together, ...edges.map((edge) => edge.text), ...notes];
    this.rows.hidden = known.length === 0;
    reconcile(this.rows, known, (item) => item.name, makeRow, updateRow);
    reconcile(
      this.notes,
      sentences,
      (sentence) => sentence,
      (sentence) => el("p", {}, sentence),
      () => {},
    );
  }
}

function makeRow(item) {
  return el(
    "li",
    {},
    el("span", { class: "name" }, item.name),
    el("span", { class: "share", "aria-hidden": "true" }, el("i"), el("b")),
    el("span", { class: "value" }),
  );
}

function updateRow(row, item) {
  const [, bar, value] = row.children;
  setAttribute(row, "class", item.is_clear ? null : "unclear");
  bar.firstElementChild.style.width = width(item.share);
  const hasRange = item.low !== null && item.high !== null;
  bar.lastElementChild.hidden = !hasRange;
  if (hasRange) {
    bar.lastElementChild.style.left = width(Math.max(0, item.low));
    bar.lastElementChild.style.width = width(Math.max(0, Math.min(1, item.high) - Math.max(0, item.low)));
  }
  setText(value, percentText(item.share));
  setAttribute(
    row,
    "title",
    `${item.name}: ${percentText(item.share)}${hasRange ? `, ${percentText(item.low)} to ${percentText(item.high)}` : ""}${item.is_clear ? "" : "; may be chance"}`,
  );
}
