// Which sweeps of the list are to be compared; the choice is in the address.
import { el, setAttribute, setText } from "./dom.js";
import { counted } from "./format.js";
import { compareAddress, keep } from "./route.js";

export const MOST_COMPARED = 6;

export const namesOf = (text) => [...new Set((text ?? "").split(",").filter(Boolean))];

// A box for a row of the list; `updateBox` says whether it is chosen.
export const makeBox = (name) =>
  el(
    "label",
    { class: "to-compare" },
    el("input", { type: "checkbox", dataset: { compare: name }, "aria-label": `Choose ${name} to compare` }),
  );

export class CompareChoice {
  // `onChange()` is called when the reader chooses; `place` is where the bar with the choice goes, `body` has the rows.
  constructor({ place, body, names, onChange }) {
    Object.assign(this, { names, onChange });
    this.sweeps = new Map();
    this.text = el("p", { class: "grow", role: "status" });
    this.link = el("a", { class: "button primary" }, "Compare");
    this.clear = el("button", { type: "button", onclick: () => this.set([]) }, "Clear");
    this.bar = el("div", { class: "compare-bar card", hidden: true }, this.text, this.clear, this.link);
    place.append(this.bar);
    body.addEventListener("change", (event) => {
      const name = event.target.dataset.compare;
      if (name === undefined) return;
      this.set(event.target.checked ? [...this.names, name] : this.names.filter((known) => known !== name));
    });
  }

  set(names) {
    this.names = names;
    keep({ compare: names.join(",") });
    this.onChange();
  }

  updateBox(label, name) {
    const box = label.firstElementChild;
    const isChosen = this.names.includes(name);
    box.checked = isChosen;
    const isFull = !isChosen && this.names.length >= MOST_COMPARED;
    box.disabled = isFull;
    setAttribute(label, "title", isFull ? `At most ${MOST_COMPARED} are compared.` : null);
  }

  // `sweeps` are all sweeps by name: those that were deleted are chosen no more.
  show(sweeps) {
    this.names = this.names.filter((name) => sweeps.has(name)).slice(0, MOST_COMPARED);
    this.bar.hidden = this.names.length === 0;
    const envs = new Set(this.names.map((name) => sweeps.get(name).env));
    const isReady = this.names.length > 1 && envs.size === 1;
    const told =
      envs.size > 1
        ? `They are on different environments (${[...envs].join(", ")}), whose returns can't be compared.`
        : this.names.length === 1
          ? "Choose another to compare it with."
          : "";
    setText(this.text, `${counted(this.names.length, "sweep")} chosen: ${this.names.join(", ")}. ${told}`.trim());
    setAttribute(this.link, "href", isReady ? compareAddress(this.names) : null);
    setAttribute(this.link, "aria-disabled", isReady ? null : "true");
    // A link that leads nowhere is one to screen readers only by its role.
    setAttribute(this.link, "role", isReady ? null : "link");
  }
}
