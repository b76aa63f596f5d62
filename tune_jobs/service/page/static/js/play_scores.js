// What a policy makes of what it sees: a bar for each action, or for each component of an action.
import { el, setText } from "./dom.js";
import { NONE, significant } from "./format.js";

const TITLES = {
  probabilities: "Action probabilities",
  values: "Q values",
  advantages: "Advantages",
  gaussian: "Action, and the network's standard deviation σ",
};

export const actionName = (number, { first, names }) => names?.[number - first] ?? `action ${number}`;

export function actionText(action, actions) {
  if (action === null) return NONE;
  if (typeof action === "number") {
    const name = actions.names?.[action - actions.first];
    return name ? `${name} (${action})` : String(action);
  }
  const shown = action.slice(0, 3).map((value) => significant(value, 3));
  return `${shown.join(", ")}${action.length > 3 ? ", …" : ""}`;
}

export class Scores {
  constructor(host) {
    this.title = el("h3", {});
    this.list = el("ul", { class: "scores" });
    this.node = el("section", { hidden: true }, this.title, this.list);
    host.append(this.node);
    this.clear();
  }

  clear(actions = null) {
    this.actions = actions;
    this.rows = [];
    // Bars keep one scale through an episode, which has a zero.
    this.low = 0;
    this.high = 0;
    this.list.replaceChildren();
    this.node.hidden = true;
  }

  show({ action, scores, score_kind: kind }) {
    const isVector = Array.isArray(action);
    const values = isVector ? action : scores;
    this.node.hidden = values === null;
    if (values === null) return;
    setText(this.title, TITLES[kind] ?? "Action");
    if (this.rows.length !== values.length) this.makeRows(values.length, isVector);
    this.scaleTo(values, kind, isVector);
    const span = this.high - this.low || 1;
    const zero = -this.low / span;
    values.forEach((value, index) => {
      const { row, bar, told } = this.rows[index];
      const place = value === null ? zero : (Math.min(this.high, Math.max(this.low, value)) - this.low) / span;
      bar.style.left = `${100 * Math.min(zero, place)}%`;
      bar.style.width = `${100 * Math.abs(place - zero)}%`;
      const spread = isVector && scores ? `, σ ${significant(scores[index], 2)}` : "";
      setText(told, kind === "probabilities" ? share(value) : `${significant(value, 4)}${spread}`);
      const isChosen = !isVector && index === action - this.actions.first;
      row.classList.toggle("chosen", isChosen);
      if (isChosen) row.setAttribute("aria-current", "true");
      else row.removeAttribute("aria-current");
    });
  }

  scaleTo(values, kind, isVector) {
    if (kind === "probabilities") this.high = 1;
    const bounds = isVector ? [...this.actions.low, ...this.actions.high] : [];
    for (const value of [...values, ...bounds]) {
      if (value === null) continue;
      this.low = Math.min(this.low, value);
      this.high = Math.max(this.high, value);
    }
  }

  makeRows(number, isVector) {
    this.rows = Array.from({ length: number }, (_, index) => {
      const name = isVector ? `component ${index}` : actionName(this.actions.first + index, this.actions);
      const bar = el("i");
      const told = el("span", { class: "value" });
      const track = el("span", { class: "share", "aria-hidden": "true" }, bar);
      return { row: el("li", {}, el("span", { class: "name" }, name), track, told), bar, told };
    });
    this.list.replaceChildren(...this.rows.map(({ row }) => row));
    this.list.classList.toggle("many", number > 8);
  }
}

function share(value) {
  if (value === null) return NONE;
  // Never 100 % of what is not all, nor 0 % of what is not nothing.
  const percent = Math.min(99.9, Math.max(0.1, 100 * value));
  return value === 0 || value === 1 ? `${100 * value} %` : `${percent.toFixed(1)} %`;
}
