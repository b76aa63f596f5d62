// One policy at play: its picture, its action and what it made of it, and the return so far.
import { ofSweep, Unreachable } from "./api.js";
import { refusal } from "./dialogs.js";
import { el, setAttribute, setText } from "./dom.js";
import { eventsOf } from "./event_reader.js";
import { count, counted, returnText } from "./format.js";
import { Observations } from "./play_observations.js";
import { Picture } from "./play_picture.js";
import { queryOf, textOf, titleOf } from "./play_policies.js";
import { ReturnLine } from "./play_return.js";
import { actionText, Scores } from "./play_scores.js";

const LINE_MS = 100;
// How far behind its time a picture may be before the time is let go.
const MOST_BEHIND = 5;
const MOST_TRIES = 5;
const TRY_AGAIN_MS = 500;
const STATES = {
  idle: ["not begun", ""],
  starting: ["starting", "wait"],
  playing: ["playing", "live"],
  paused: ["paused", "wait"],
  over: ["over", ""],
  failed: ["failed", "bad"],
};
const ENDS = {
  terminated: "the episode ended in this state (terminated)",
  truncated: "the environment's limit cut it off (truncated)",
  cap: "10,000 env steps are the most that are played",
};
let number = 0;

export class Player {
  // `onChange()` is called when its state changes, `onRefused()` when the service would not play the policy.
  constructor(host, { sweep, onChange, onRefused }) {
    Object.assign(this, { sweep, onChange, onRefused, stream: null, resumed: null, frame: 0 });
    const id = `player-${(number += 1)}`;
    this.title = el("h2", { id });
    this.word = el("span", { class: "state" });
    this.what = el("p", { class: "quiet small" });
    this.problem = el("div", { class: "notice bad", hidden: true });
    const fact = (name) => {
      const value = el("dd", {});
      return [value, el("div", {}, el("dt", {}, name), value)];
    };
    const [total, totalRow] = fact("Return so far");
    const [steps, stepsRow] = fact("Env steps");
    const [action, actionRow] = fact("Action");
    Object.assign(this, { total, steps, action });
    this.ending = el("p", { class: "ending", role: "status" });
    const stage = el("div", { class: "stage" });
    const told = el("div", { class: "told" }, el("dl", { class: "facts" }, totalRow, stepsRow, actionRow));
    this.node = el(
      "section",
      { class: "card player", "aria-labelledby": id },
      el("div", { class: "card-head" }, this.title, this.word),
      this.what,
      el("div", { role: "alert" }, this.problem),
      el("div", { class: "player-body" }, stage, told),
    );
    host.append(this.node);
    this.picture = new Picture(stage);
    this.observations = new Observations(stage);
    this.scores = new Scores(told);
    this.line = new ReturnLine(told);
    told.append(this.ending);
    this.tell("idle");
  }

  get isOver() {
    return this.state === "over";
  }

  get isStreaming() {
    return this.stream !== null;
  }

  tell(state) {
    this.state = state;
    const [word, tone] = STATES[state];
    setText(this.word, word);
    setAttribute(this.word, "class", `state ${tone}`);
    this.onChange();
  }

  // Get ready for an episode from its beginning.
  load({ policy, seed, speed }) {
    this.halt();
    Object.assign(this, { policy, seed, speed, step: null, info: null, isPaused: false, drawnAt: 0 });
    setText(this.title, titleOf(policy));
    this.node.dataset.policy = textOf(policy);
    for (const node of [this.what, this.ending]) setText(node, "");
    for (const node of [this.total, this.steps, this.action]) setText(node, "–");
    this.problem.hidden = true;
    for (const part of [this.picture, this.observations, this.scores, this.line]) part.clear();
    this.picture.describe(`${titleOf(policy)}, not begun`);
    this.line.describe();
    this.tell("idle");
  }

  // Play on from where it is. `meet()` is called once when its first picture could be shown; what it returns is waited
  // for, as another player may take longer.
  async play(meet) {
    const stream = new AbortController();
    this.stream = stream;
    this.isPaused = false;
    this.problem.hidden = true;
    this.tell("starting");
    let isMet = false;
    const meetOnce = () => {
      if (isMet) return undefined;
      isMet = true;
      return meet();
    };
    const isOurs = () => this.stream === stream;
    const start = this.step === null ? 0 : this.step.num_env_steps + 1;
    const query = { ...queryOf(this.policy), seed: this.seed, speed: this.speed, start };
    try {
      let hasEnded = false;
      for await (const [kind, data] of this.events(query, stream.signal)) {
        if (!isOurs()) return;
        if (kind === "info") {
          this.begin(data);
          await meetOnce();
          this.due = performance.now();
          if (isOurs() && !this.isPaused) this.tell("playing");
        } else if (kind === "step") {
          await this.turn();
          if (!isOurs()) return;
          this.take(data);
        } else if (kind === "end") {
          hasEnded = true;
          this.end(data);
        } else if (kind === "problem") {
          hasEnded = true;
          this.fail({ message: data.detail, hint: data.hint });
        }
      }
      if (!hasEnded && isOurs()) throw new Unreachable();
    } catch (error) {
      if (!isOurs() || error.name === "AbortError") return;
      this.fail(error);
      this.onRefused(error);
    } finally {
      meetOnce();
      if (isOurs()) {
        this.stream = null;
        this.onChange();
      }
    }
  }

  // Those that were closed a moment ago may still count among the episodes that are played at once.
  async *events(query, signal) {
    for (let left = MOST_TRIES; ; left -= 1) {
      try {
        yield* eventsOf(ofSweep(this.sweep, "/play"), { query, signal });
        return;
      } catch (error) {
        if (error.status !== 429 || left <= 1) throw error;
        await new Promise((resolve) => setTimeout(resolve, TRY_AGAIN_MS));
      }
    }
  }

  begin(info) {
    const isFirst = this.info === null;
    this.info = info;
    if (!isFirst) return;
    setText(this.what, info.description);
    this.scores.clear(info.actions);
    this.observations.clear(info.is_drawn ? "" : info.why_not);
    this.showEither(info.is_drawn);
    this.picture.describe(`${info.env_id}, played by ${titleOf(this.policy)} with seed ${this.seed}`);
  }

  showEither(isDrawn) {
    this.picture.canvas.hidden = !isDrawn;
    this.observations.node.hidden = isDrawn;
  }

  // Wait until the next step is to be seen: the service keeps the environment's time, but what was held up comes at once.
  async turn() {
    do {
      while (this.isPaused) {
        await new Promise((resolve) => {
          this.resumed = resolve;
        });
        this.due = performance.now();
      }
      const pause = 1000 / (this.info.fps * this.speed);
      // A little faster than it comes, so that nothing piles up.
      this.due = Math.max(this.due + 0.95 * pause, performance.now() - MOST_BEHIND * pause);
      const wait = this.due - performance.now();
      if (wait > 4) await new Promise((resolve) => setTimeout(resolve, wait));
      // It may have been held still while this waited.
    } while (this.isPaused);
  }

  take(step) {
    this.step = step;
    this.line.add(step);
    this.observations.add(step.observation);
    this.frame ||= requestAnimationFrame(() => {
      this.frame = 0;
      this.draw();
    });
  }

  draw() {
    const { step } = this;
    if (step === null) return;
    setText(this.total, returnText(step.total));
    setText(this.steps, count(step.num_env_steps));
    setText(this.action, actionText(step.action, this.info.actions));
    // Right after the reset there was no action yet.
    if (step.action !== null) this.scores.show(step);
    if (step.picture) this.picture.show(step.picture);
    else if (this.info.is_drawn) this.showEither(false);
    this.observations.draw();
    if (!this.observations.node.hidden && step.num_env_steps > 0 && step.observation === null)
      this.observations.sayNone();
    const now = performance.now();
    if (now - this.drawnAt < LINE_MS && this.state === "playing") return;
    this.drawnAt = now;
    this.line.show();
  }

  end({ num_env_steps: steps, total, ended_by: by }) {
    this.tell("over");
    this.draw();
    this.line.describe();
    const why = ENDS[by] ?? ENDS.cap;
    setText(this.ending, `Return ${returnText(total)} after ${counted(steps, "env step")}: ${why}.`);
  }

  fail(error) {
    this.problem.replaceChildren(...refusal(error));
    this.problem.hidden = false;
    this.tell("failed");
  }

  // Hold still; the service waits, too.
  pause() {
    if (!this.isStreaming) return;
    this.isPaused = true;
    this.tell("paused");
    this.draw();
  }

  resume() {
    this.isPaused = false;
    if (this.isStreaming && this.state === "paused") this.tell("playing");
    this.resumed?.();
    this.resumed = null;
  }

  // Close the connection; `play` goes on from the step that is seen.
  halt() {
    const { stream } = this;
    this.stream = null;
    stream?.abort();
    this.resume();
    if (stream && !this.isOver) this.tell(this.step === null ? "idle" : "paused");
  }

  close() {
    this.onChange = () => {};
    this.halt();
    cancelAnimationFrame(this.frame);
    this.observations.close();
    this.line.close();
    this.node.remove();
  }
}
