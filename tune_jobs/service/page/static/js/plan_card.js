// The plan beside the sweep file: what would run, or what is wrong.
import { el, setAttribute, setText } from "./dom.js";
import { bytes, count, counted, returnText, valueText } from "./format.js";

const FIRST_POINTS = 6;

export class PlanCard {
  constructor({ onLine }) {
    this.onLine = onLine;
    this.state = el("span", { class: "state" });
    this.body = el("div", { class: "plan-body" }, el("p", { class: "quiet" }, "What would run is shown here."));
    this.told = el("p", { class: "for-readers", role: "status" });
    this.node = el(
      "section",
      { class: "card plan", "aria-label": "Plan" },
      el("div", { class: "card-head" }, el("h2", {}, "Plan"), this.state),
      this.body,
      this.told,
    );
  }

  // The plan before stays in sight meanwhile.
  wait() {
    this.node.classList.add("waiting");
  }

  tell(tone, word, spoken) {
    this.node.classList.remove("waiting");
    setAttribute(this.state, "class", `state ${tone}`);
    setText(this.state, word);
    setText(this.told, spoken);
  }

  show({ plan }) {
    const numSeeds = plan.num_points ? plan.num_trials / plan.num_points : 1;
    const engines = Object.entries(plan.engines)
      .map(([engine, number]) => (Object.keys(plan.engines).length > 1 ? `${engine} (${count(number)})` : engine))
      .join(", ");
    const cpus = plan.packs
      ? `${counted(plan.packs.num_packs, "pack")} of ${counted(plan.packs.cpus_per_pack, "CPU")}`
      : `${counted(plan.cpus_per_trial, "CPU")} a trial`;
    const facts = [
      [
        "Trials",
        count(plan.num_trials),
        `${counted(plan.num_points, "point")}${numSeeds > 1 ? ` × ${counted(numSeeds, "seed")}` : ""}`,
      ],
      [
        "At once",
        count(Math.min(plan.max_concurrent, plan.num_trials)),
        `${cpus}, on ${plan.machine.num_cpus ? counted(plan.machine.num_cpus, "CPU") : "the cluster"}`,
      ],
      ["Engine", engines, ""],
      [
        "Env steps, at most",
        count(plan.max_env_steps),
        plan.num_trials ? `${count(Math.round(plan.max_env_steps / plan.num_trials))} a trial` : "",
      ],
      ["Disk, at most", bytes(plan.max_disk_bytes), ""],
      ["Solved at", plan.env.threshold === null ? "no threshold" : returnText(plan.env.threshold), plan.env.id],
    ];
    const notes = [...plan.notes, ...(plan.packs?.notes ?? [])];
    this.body.replaceChildren(
      el(
        "dl",
        { class: "plan-facts" },
        facts.map(([name, value, more]) =>
          el("div", {}, el("dt", {}, name), el("dd", {}, el("b", {}, value), more ? el("small", {}, more) : null)),
        ),
      ),
      ...notes.map((note) => el("p", { class: "quiet small note" }, note)),
      ...pointsTable(plan),
    );
    this.tell(
      "good",
      "valid",
      `Valid: ${counted(plan.num_trials, "trial")}, at most ${counted(plan.max_env_steps, "env step")}.`,
    );
  }

  refuse(problems, hint) {
    this.body.replaceChildren(
      el(
        "ul",
        { class: "problems" },
        problems.map((item) =>
          el(
            "li",
            {},
            item.line === null
              ? null
              : el(
                  "button",
                  { type: "button", class: "link", onclick: () => this.onLine(item.line) },
                  `line ${item.line + 1}`,
                ),
            el("p", {}, item.path ? el("code", {}, `${item.path}:`) : null, item.path ? " " : null, item.text),
            item.hint ? el("p", { class: "quiet small" }, item.hint) : null,
          ),
        ),
      ),
      hint ? el("p", { class: "quiet small" }, hint) : "",
    );
    this.tell(
      "bad",
      counted(problems.length, "problem"),
      `${counted(problems.length, "problem")}: ${problems[0].path} ${problems[0].text}`,
    );
  }
}

function pointsTable(plan) {
  const points = plan.trials.filter((trial) => trial.seed_index === 0 && trial.has_point !== false);
  const names = [...new Set(points.flatMap((trial) => Object.keys(trial.point)))];
  if (!names.length) return [];
  const shown = points.slice(0, FIRST_POINTS);
  const numeric = (name) => points.every((trial) => ["number", "undefined"].includes(typeof trial.point[name]));
  return [
    el(
      "div",
      { class: "sideways" },
      el(
        "table",
        { class: "points" },
        el(
          "caption",
          { class: "quiet small" },
          shown.length < points.length
            ? `The first ${shown.length} of ${counted(points.length, "point")}`
            : counted(points.length, "point"),
        ),
        el(
          "thead",
          {},
          el(
            "tr",
            {},
            names.map((name) => el("th", { scope: "col", class: numeric(name) ? "number" : null }, name)),
          ),
        ),
        el(
          "tbody",
          {},
          shown.map((trial) =>
            el(
              "tr",
              {},
              names.map((name) => el("td", { class: numeric(name) ? "number" : null }, valueText(trial.point, name))),
            ),
          ),
        ),
      ),
    ),
  ];
}
