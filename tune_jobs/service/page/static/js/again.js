// Ask again for what did not come, where nothing else tells that it is time: after five seconds, then after twice as long.
import { Refused } from "./api.js";

const AGAIN_MS = 5000;
const MOST_MS = 80_000;

// Whether the same question may have an answer in a while: the service was away, broke down, or had no turn for it.
export const mayPass = (error) => !(error instanceof Refused) || error.status === 429 || error.status >= 500;

export class Again {
  // `look()` asks for it.
  constructor(look) {
    Object.assign(this, { look, timer: 0, failures: 0, isClosed: false });
  }

  // Whether it is still to be asked for, and not before its time.
  get isWaiting() {
    return this.timer !== 0;
  }

  // It did not come. Returns whether it will be asked for again: other refusals stay as they are.
  failed(error) {
    if (this.isClosed || !mayPass(error)) return false;
    clearTimeout(this.timer);
    this.timer = setTimeout(
      () => {
        this.timer = 0;
        this.look();
      },
      Math.min(MOST_MS, AGAIN_MS * 2 ** this.failures),
    );
    this.failures += 1;
    return true;
  }

  // It came, or is of no use any more.
  reset() {
    clearTimeout(this.timer);
    this.timer = this.failures = 0;
  }

  close() {
    this.isClosed = true;
    this.reset();
  }
}
