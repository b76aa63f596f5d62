// A sweep from a file that the reader has opened: all of it is here, nothing changes, and the service is asked for nothing.
const TEXTS = { owner: null, note: "", tags: [], job: null };

export class FileSource {
  // `file` is what `readSweepFile` returned.
  constructor(file) {
    this.file = file;
    this.name = file.sweep.name;
    this.isFile = true;
    this.byId = new Map(file.trials.map((trial) => [trial.trial_id, trial]));
  }

  now() {
    return this.file.as_of;
  }

  async summary() {
    const { sweep, status } = this.file;
    const { spec, ...record } = sweep;
    return { ...TEXTS, ...record, ...status, algorithm: spec.algorithm, env: spec.env.id };
  }

  async spec() {
    return this.file.sweep.spec;
  }

  async curves() {
    return { trials: this.file.curves };
  }

  async trials() {
    return this.file.trials;
  }

  async importance() {
    if (this.file.importance === null) throw new Error("The file says nothing of it.");
    return this.file.importance;
  }

  async front() {
    if (this.file.front === null) throw new Error("The file says nothing of it.");
    return this.file.front;
  }

  async outcome() {
    return { files: new Set(), best: this.file.best };
  }

  async trial(id, after) {
    const trial = this.byId.get(id);
    if (!trial) throw new Error(`The file has no trial ${id}.`);
    const curve = this.file.curves[id] ?? { iteration: [] };
    const rows = curve.iteration.map((iteration, index) => ({
      iteration,
      num_env_steps: curve.num_env_steps[index],
      training_return: curve.training_return[index],
      evaluation_return: curve.evaluation_return[index],
    }));
    return { trial, log: "", iterations: rows.filter((row) => row.iteration > after) };
  }

  follow({ load, show }) {
    let isClosed = false;
    load().then(
      () => isClosed || show(null),
      (error) => isClosed || show(error),
    );
    return {
      close() {
        isClosed = true;
      },
    };
  }

  // Once is enough.
  repeat(act) {
    return {
      // Who asks has shown what went wrong.
      now: () => act().catch(() => {}),
      close() {},
    };
  }
}
