// Two fields that choose a policy: whose, and of which iteration.
import { el } from "./dom.js";
import { counted, returnText } from "./format.js";
import { settled } from "./play_policies.js";

export class PolicyPicker {
  // `onChange(policy)` is called with the choice, which is null where `none` (a label) was chosen.
  constructor(host, { id, label, none = null, onChange }) {
    Object.assign(this, { none, onChange, known: null, policy: null });
    this.whose = el("select", { id, onchange: () => this.choose(this.whose.value) });
    this.which = el("select", {
      id: `${id}-checkpoint`,
      onchange: () => onChange({ ...this.policy, iteration: Number(this.which.value) }),
    });
    this.checkpoint = el(
      "div",
      { class: "field" },
      el("label", { for: `${id}-checkpoint` }, "Checkpoint", el("span", { class: "for-readers" }, ` of ${label}`)),
      this.which,
    );
    host.append(el("div", { class: "field" }, el("label", { for: id }, label), this.whose), this.checkpoint);
  }

  choose(text) {
    if (text === "") this.onChange(null);
    else if (text === "best" || text === "random") this.onChange({ kind: text });
    else this.onChange(settled({ kind: "trial", trial: text, iteration: null }, this.known));
  }

  show(known, policy) {
    this.policy = policy;
    const isTrial = policy?.kind === "trial";
    const own = isTrial ? known.trials.find((trial) => trial.trial_id === policy.trial) : null;
    const option = (value, text) => el("option", { value }, text);
    if (known !== this.known || (isTrial && !own)) {
      this.known = known;
      const trials = known.trials.map((trial) =>
        option(trial.trial_id, `${trial.trial_id}, score ${returnText(trial.score)}`),
      );
      // A link may name what is not there: it stays in sight, and the service says what is wrong with it.
      if (isTrial && !own) trials.push(option(policy.trial, policy.trial));
      this.whose.replaceChildren(
        ...(this.none === null ? [] : [option("", this.none)]),
        ...(known.hasBest || policy?.kind === "best" ? [option("best", "Best policy")] : []),
        option("random", "Random policy"),
        ...(trials.length ? [el("optgroup", { label: "Trials, best first" }, trials)] : []),
      );
    }
    this.whose.value = policy === null ? "" : isTrial ? policy.trial : policy.kind;
    this.checkpoint.hidden = !isTrial;
    if (!isTrial) return;
    const kept = (own?.checkpoints ?? []).map((item) => [item.iteration, counted(item.num_env_steps, "env step")]);
    if (policy.iteration !== null && !kept.some(([iteration]) => iteration === policy.iteration))
      kept.push([policy.iteration, "not there"]);
    kept.sort(([a], [b]) => b - a);
    this.which.replaceChildren(...kept.map(([iteration, told]) => option(iteration, `iteration ${iteration}, ${told}`)));
    this.which.value = policy.iteration ?? "";
  }
}
