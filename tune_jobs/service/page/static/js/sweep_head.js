// The head of a sweep's page: what it is, how far it is, and what there is to say of it.
import { el, reconcile, setAttribute, setText } from "./dom.js";
import { ago, compact, count, counted, duration, moment, percent, pointText, returnText, timeLeft } from "./format.js";
import { playLink } from "./play_links.js";
import { isLive, stateOf, stateReason, TRIAL_STATUSES } from "./states.js";

export class SweepHead {
  constructor(host, { source, actions, alert, onOpen }) {
    this.state = el("span", { class: "state" });
    this.what = el("p", { class: "quiet" });
    this.tags = el("p", { class: "tag-line" });
    this.note = el("p", { class: "note" });
    this.reason = el("div", { class: "notice", hidden: true }, el("p"));
    this.bar = el(
      "div",
      {
        class: "progress",
        role: "progressbar",
        "aria-label": "Progress in env steps",
        "aria-valuemin": 0,
        "aria-valuemax": 100,
      },
      el("i"),
    );
    this.progress = el("dd", {}, el("b"), " ", el("small"));
    this.left = el("dd");
    this.trials = el("dd", {}, el("b"), " ", el("small"));
    this.best = el(
      "dd",
      {},
      el("b"),
      " ",
      el("button", { type: "button", class: "link", onclick: () => onOpen(this.bestId) }),
      " ",
      el("small"),
    );
    this.play = playLink(source.name);
    this.isFile = source.isFile;
    this.leftName = el("dt", {}, "Time left");
    this.spoken = el("p", { class: "for-readers", role: "status" });
    host.append(
      el(
        "div",
        { class: "title-row sweep-title" },
        el("div", {}, el("div", { class: "with-state" }, el("h1", {}, source.name), this.state), this.what, this.tags),
        el("div", { class: "head-links" }, this.play, source.isFile ? null : saveLink(source), actions.node),
      ),
      alert.node,
      this.reason,
      this.note,
      el(
        "section",
        { class: "card summary", "aria-label": "Progress" },
        this.bar,
        el(
          "dl",
          { class: "facts" },
          el("div", {}, el("dt", {}, "Env steps"), this.progress),
          el("div", {}, this.leftName, this.left),
          el("div", {}, el("dt", {}, "Trials"), this.trials),
          el("div", { class: "wide" }, el("dt", {}, "Best so far"), this.best),
        ),
      ),
      this.spoken,
    );
  }

  show(sweep) {
    const { word, tone } = stateOf(sweep);
    setAttribute(this.state, "class", `state ${tone}`);
    setText(this.state, word);
    setText(
      this.what,
      [`${sweep.env} · ${sweep.algorithm}`, sweep.owner && `by ${sweep.owner}`, `created ${ago(sweep.created_at)}`]
        .filter(Boolean)
        .join(" · "),
    );
    setAttribute(this.what, "title", moment(sweep.created_at));
    reconcile(
      this.tags,
      sweep.tags,
      (tag) => tag,
      (tag) => el("span", { class: "tag" }, tag),
      () => {},
    );
    setText(this.note, sweep.note);
    const reason = stateReason(sweep);
    this.reason.hidden = !reason;
    this.reason.classList.toggle("bad", word === "failed");
    setText(this.reason.firstElementChild, reason);
    const share = percent(sweep.num_env_steps, sweep.max_env_steps ?? 0);
    this.bar.firstElementChild.style.width = `${share}%`;
    this.bar.classList.toggle("ended", !isLive(sweep));
    setAttribute(this.bar, "aria-valuenow", share);
    setText(this.progress.firstElementChild, sweep.max_env_steps ? `${share} %` : count(sweep.num_env_steps));
    setText(
      this.progress.lastElementChild,
      sweep.max_env_steps
        ? `${count(sweep.num_env_steps)} of ${sweep.num_env_steps < sweep.max_env_steps ? "at most " : ""}${count(sweep.max_env_steps)}`
        : "",
    );
    this.showTime(sweep);
    const ended = ["completed", "failed", "stopped"].reduce((sum, status) => sum + (sweep.counts[status] ?? 0), 0);
    setText(this.trials.firstElementChild, `${count(ended)} of ${count(sweep.num_trials)}`);
    setText(
      this.trials.lastElementChild,
      TRIAL_STATUSES.filter(
        (status) =>
          sweep.counts[status] &&
          !(status === "completed" && sweep.counts[status] === ended && ended === sweep.num_trials),
      )
        .map((status) => `${count(sweep.counts[status])} ${status}`)
        .join(", "),
    );
    this.showBest(sweep.best);
    // Each poll would be too much to listen to: the state, and each tenth of the way.
    setText(this.spoken, `${sweep.name} is ${word}${isLive(sweep) ? `, ${Math.floor(share / 10) * 10} % done` : ""}.`);
  }

  showTime(sweep) {
    if (!isLive(sweep)) {
      setText(this.leftName, "Run time");
      this.left.replaceChildren(el("b", {}, sweep.run_time_s ? duration(sweep.run_time_s) : "–"));
      return;
    }
    setText(this.leftName, "Time left");
    const speed = sweep.env_steps_per_s ? `  ${compact(sweep.env_steps_per_s)} env steps/s` : "";
    const left =
      sweep.state === "completed"
        ? "concluding"
        : sweep.waiting
          ? "waits for nodes"
          : sweep.time_left_s === null
            ? "not known yet"
            : `about ${timeLeft(sweep.time_left_s)}`;
    this.left.replaceChildren(el("b", {}, left), " ", el("small", {}, speed.trim()));
  }

  showBest(best) {
    // A file has records, and no policies.
    this.play.hidden = !best || this.isFile;
    const [score, trial, point] = this.best.children;
    this.bestId = best?.trial_id;
    setText(score, best ? returnText(best.score) : "no evaluation yet");
    trial.hidden = !best;
    setText(trial, best?.trial_id);
    setText(
      point,
      best ? [pointText(best.point), `at ${counted(best.num_env_steps, "env step")}`].filter(Boolean).join(" · ") : "",
    );
  }
}

function saveLink(source) {
  const title = "Curves, trials and what mattered, to look at on any service's page";
  return el("a", { class: "button", href: source.address("/file"), download: "", title }, "Save as a file");
}
