// Where a sweep's page has its sweep from: here the service, which tells what changes. `FileSource` has the same calls.
import { address, ask, askAll, ofSweep } from "./api.js";
import { follow } from "./follow.js";
import { repeat } from "./repeat.js";

const LOG_LINES = 400;

export class ServerSource {
  constructor(name) {
    this.name = name;
    // Whether it is a file: nothing can be done with its sweep, nothing downloaded, and no log read.
    this.isFile = false;
  }

  // Unix time, seconds, that what is told is of.
  now() {
    return Date.now() / 1000;
  }

  // Where a part of it is downloaded: "/report/".
  address(part) {
    return address(ofSweep(this.name, part));
  }

  summary() {
    return ask(ofSweep(this.name));
  }

  spec() {
    return ask(ofSweep(this.name, "/spec"));
  }

  // { trials: columns by trial, last_event_id }.
  curves() {
    return ask(ofSweep(this.name, "/curves"));
  }

  // By index; `onPart(trials)` is called with what is there so far, if there is more.
  trials(fields, onPart) {
    const query = { fields, sort: "index", order: "asc" };
    return askAll(ofSweep(this.name, "/trials"), "trials", query, onPart);
  }

  importance() {
    return ask(ofSweep(this.name, "/importance"));
  }

  // Score against cost, as far as trials have ended.
  front() {
    return ask(ofSweep(this.name, "/front"));
  }

  // What a finished sweep has come to: the paths of its files, and both answers; null: there is no policy yet.
  async outcome() {
    const files = new Set((await ask(ofSweep(this.name, "/files"))).map((file) => file.path));
    const hasBest = [...files].some((path) => path.startsWith("policy/"));
    return { files, best: hasBest ? await ask(ofSweep(this.name, "/best")) : null };
  }

  // One trial with all that is known of it, the end of its log, and its iterations after one that is known.
  async trial(id, after) {
    const path = ofSweep(this.name, `/trials/${encodeURIComponent(id)}`);
    const [trial, log, iterations] = await Promise.all([
      ask(path),
      ask(`${path}/log`, { query: { lines: LOG_LINES } }),
      ask(`${path}/iterations`, { query: { after } }),
    ]);
    return { trial, log: log.text, iterations };
  }

  // Keep a view up to date; `load()` returns what `curves()` returned. See `follow`.
  follow({ load, ...others }) {
    const events = async () => {
      const { last_event_id: last } = await load();
      return ofSweep(this.name, `/events?last_event_id=${encodeURIComponent(last)}`);
    };
    return follow({ load: events, ...others });
  }

  // Ask for something again and again. See `repeat`.
  repeat(act, pauseMs) {
    return repeat(act, pauseMs);
  }
}
