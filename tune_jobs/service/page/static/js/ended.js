// When to ask again for what the service makes of all ended trials, which takes it a while to read.
const ENDED = ["completed", "failed", "stopped"];

export class Ended {
  constructor() {
    this.forget();
  }

  // What was asked for did not come, or is of another sweep now: it is due as if it was never asked for.
  forget() {
    this.seen = -1;
    this.state = "";
  }

  // Whether it is worth it: a tenth more trials have ended, or the sweep has come to an end or goes on.
  isDue(sweep) {
    const count = ENDED.reduce((sum, status) => sum + (sweep.counts[status] ?? 0), 0);
    const isOther = this.seen >= 0 && sweep.state !== this.state;
    const isLast = count === sweep.num_trials && count !== this.seen;
    if (count === 0 || !(isLast || isOther || this.seen < 0 || count >= 1.1 * this.seen + 1)) return false;
    this.seen = count;
    this.state = sweep.state;
    return true;
  }
}
