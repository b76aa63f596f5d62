// What a finished sweep has come to: the policy to deploy, the setting to train with, its report and films.
import { Again } from "./again.js";
import { el } from "./dom.js";
import { count, counted, pointText, rangeText, returnText } from "./format.js";
import { playLink } from "./play_links.js";
import { isLive, isWaiting, stateOf } from "./states.js";

const CAPTIONS = { before_mp4: "Before: a random policy", after_mp4: "After: the best policy" };
const SCORES = {
  final: "return in the later half of training",
  area: "return over all of training",
  best: "best evaluation return",
  steps_to_threshold: "env steps to the threshold",
};

export class Finished {
  // `onOpen(trialId)` is called when the reader wants to see the policy's trial.
  constructor(card, source, { onOpen }) {
    Object.assign(this, { card, source, onOpen });
    this.card.hidden = true;
    this.stamp = "";
    this.sweep = null;
    this.again = new Again(() => this.follow(this.sweep));
  }

  // Asked for once each time the sweep has come to an end, or goes on: what it came to before is shown until then.
  async follow(sweep) {
    this.sweep = sweep;
    // Its group is another one when the process has ended, which writes the result after the trials.
    const stamp = `${stateOf(sweep).group} ${sweep.state} ${sweep.ended_at} ${sweep.job?.ended_at}`;
    if (stamp === this.stamp || this.again.isWaiting) return;
    this.stamp = stamp;
    try {
      const { files, best } = await this.source.outcome();
      if (stamp !== this.stamp) return;
      this.again.reset();
      this.show(files, best, toldAsEarlier(sweep, this.source.isFile));
    } catch (error) {
      if (stamp !== this.stamp) return;
      // The next look asks again: of a sweep that has ended there is none but this one.
      this.stamp = "";
      this.again.failed(error);
    }
  }

  close() {
    this.again.close();
  }

  // `earlier` says that all this may be of before, if so.
  show(files, best, earlier) {
    const hasReport = files.has("report/index.html");
    this.card.hidden = best === null && !hasReport;
    this.card.replaceChildren(
      el(
        "div",
        { class: "card-head" },
        el("h2", {}, "Result"),
        hasReport ? this.reportLinks() : null,
      ),
      earlier ? el("p", { class: "notice" }, earlier) : "",
      el(
        "div",
        { class: "answers" },
        best ? this.policyAnswer(best) : null,
        best?.settings ? settingAnswer(best.settings) : null,
        Object.keys(CAPTIONS)
          .filter((name) => files.has(`films/${name}`))
          .map((name) => this.film(name)),
      ),
    );
  }

  reportLinks() {
    const { name } = this.source;
    const link = { class: "button", href: this.source.address("/report/") };
    const open = el("a", { ...link, target: "_blank", rel: "noopener" }, "Open the report");
    open.append(el("span", { class: "for-readers" }, " in a new tab"));
    return [open, el("a", { ...link, download: `${name}-report.html` }, "Download the report")];
  }

  policyAnswer({ checkpoint, confirmation, random }) {
    const { solved } = confirmation;
    const badge = el("span", { class: `badge ${solved ? "good" : ""}` }, solved ? "solved" : "not solved");
    const trial = el("button", { type: "button", class: "link", onclick: () => this.onOpen(checkpoint.trial_id) });
    trial.append(checkpoint.trial_id);
    const episodes = counted(confirmation.num_episodes, "fresh episode");
    return el(
      "div",
      {},
      el("h3", {}, "The policy to deploy"),
      el("p", { class: "score" }, returnText(confirmation.mean_return), " ", solved === null ? null : badge),
      el("p", { class: "quiet small" }, `mean over ${episodes}; a random policy has ${returnText(random.mean_return)}`),
      el("p", { class: "small" }, trial, ` at ${counted(checkpoint.num_env_steps, "env step")}`),
      this.source.isFile ? null : el("p", { class: "head-links" }, playLink(this.source.name), this.policyLink()),
    );
  }

  policyLink() {
    const title = "An archive of the policy's files, which need no training code to act";
    return el("a", { class: "button", href: this.source.address("/policy"), download: "", title }, "Download it");
  }

  film(name) {
    const options = { src: this.source.address(`/films/${name}`), controls: true, loop: true, playsinline: true, preload: "metadata" };
    const video = el("video", { ...options, "aria-label": CAPTIONS[name] });
    // As an attribute it says how a film begins alone.
    video.muted = true;
    return el("figure", {}, video, el("figcaption", {}, CAPTIONS[name]));
  }
}

// What to say of a result that may not be the last one; empty: it is.
function toldAsEarlier(sweep, isFile) {
  if (sweep.state === "completed")
    return isLive(sweep) ? "A new result is being made. Until it is here, an earlier one may be shown." : "";
  const text = "An earlier result, from before the trials that have not ended yet.";
  // A file stays as it is.
  if (isFile) return text;
  const next = isLive(sweep) || isWaiting(sweep) ? "A new one comes when they have." : "Resume the sweep for a new one.";
  return `${text} ${next}`;
}

function settingAnswer({ objective, num_may_be_best: numAsGood, ranking: [setting] }) {
  // Env steps are written as negative numbers, as fewer are better.
  const inSteps = objective === "steps_to_threshold";
  const steps = (value) => count(Math.max(0, -value));
  const text = inSteps ? steps : returnText;
  const { lower, upper } = setting;
  const ends = inSteps ? `${steps(upper)} to ${steps(lower)}` : rangeText(lower, upper);
  const range = lower === null || upper === null ? "" : ` (95 % interval ${ends})`;
  // The number of the report and of the command line: the mean over its seeds.
  const score = `${text(setting.score)} ${SCORES[objective] ?? "score"}${range}`;
  const others = numAsGood - 1;
  return el(
    "div",
    {},
    el("h3", {}, "The setting to train with"),
    el("p", { class: "point" }, pointText(setting.point, 4) || "no searched values"),
    el("p", { class: "quiet small" }, `${score}, from ${counted(setting.scores.length, "seed")}`),
    others > 0 ? el("p", { class: "quiet small" }, `${counted(others, "other setting")} may be as good`) : null,
  );
}
