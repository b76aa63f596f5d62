// Where a reader finds the way to a policy at play.
import { el, reconcile, setAttribute, setText } from "./dom.js";
import { counted, returnText } from "./format.js";
import { playAddress } from "./route.js";

export const playLink = (sweep, params = {}) =>
  el("a", { class: "button", href: playAddress(sweep, params) }, "Watch it play");

// The checkpoints of a trial, each with the way to its policy at play.
export class CheckpointLinks {
  constructor(source) {
    this.source = source;
    this.list = el("ul", { class: "checkpoints" });
    this.node = el("section", { "aria-label": "Checkpoints", hidden: true }, el("h3", {}, "Checkpoints"), this.list);
  }

  show(trial) {
    // A file has records, and no policies.
    const kept = this.source.isFile ? [] : (trial?.checkpoints ?? []);
    this.node.hidden = kept.length === 0;
    reconcile(
      this.list,
      kept.slice().reverse(),
      (item) => item.iteration,
      () => el("li", {}, el("a"), el("span", { class: "quiet small" })),
      (node, { iteration, num_env_steps: steps, evaluation_return: score }) => {
        const [link, told] = node.children;
        setAttribute(link, "href", playAddress(this.source.name, { trial: trial.trial_id, iteration }));
        setText(link, `Watch iteration ${iteration} play`);
        const scored = score === null ? "" : `, evaluation return ${returnText(score)}`;
        setText(told, `${counted(steps, "env step")}${scored}`);
      },
    );
  }
}
