// Reads the file of a sweep, as `tune-jobs export --format sweep` writes it, in the browser alone. It comes from anybody:
// its sizes are bounded before and while it is inflated, and its shape is checked before anything is shown.
import * as is from "./file_shape.js";
import { bytes } from "./format.js";
import { TRIAL_STATUSES } from "./states.js";

const FORMAT = "tune-jobs sweep";
const VERSION = 1;
const MOST_PACKED_BYTES = 64 * 2 ** 20;
// `MAX_BYTES` of tune_jobs/sweeps/sweep_file.py.
const MOST_BYTES = 256 * 2 ** 20;
const MOST_TRIALS = 100_000;
const MOST_HYPERPARAMS = 200;
const MAKE_ONE = "Make one with `tune-jobs export SWEEP --format sweep`, or on the sweep's page.";
const GET_IT_AGAIN = "Get it once more from whoever made it.";

export class CannotOpen extends Error {
  constructor(message, hint) {
    super(message);
    this.hint = hint;
  }
}

const maybe = is.optional;
const point = is.mapOf(is.plain, MOST_HYPERPARAMS);
const trialId = is.matching(/^t[0-9]{4,9}$/, "a trial's id");
const names = is.listOf(is.text, 1000);
const counts = is.object(Object.fromEntries(TRIAL_STATUSES.map((status) => [status, maybe(is.count, 0)])));
const evaluation = is.object({ solved: maybe(is.flag), mean_return: maybe(is.number), num_episodes: is.count });

// A list of values, or the bounds of a range: {"grid": [...]}, {"loguniform": [1e-5, 0.1]}.
function domain(value, place) {
  const found = is.plain(value, place);
  const isDomain = typeof found === "object" && found !== null && !Array.isArray(found);
  if (!isDomain) return found;
  for (const type of ["grid", "choice"]) if (type in found) is.listOf(is.plain)(found[type], `${place}.${type}`);
  return found;
}

// Words stand for a section's type: "objective: area".
const section = (fields) => (value, place) =>
  typeof value === "string" || value === null || value === undefined ? {} : is.object(fields)(value, place);

const spec = is.object({
  algorithm: is.text,
  env: (value, place) => (typeof value === "string" ? { id: value } : is.object({ id: is.text })(value, place)),
  space: maybe(is.mapOf(domain, MOST_HYPERPARAMS), Object.create(null)),
  objective: section({ threshold: maybe(is.number), cost: maybe(is.text) }),
  stop: section({ evaluation_return: maybe(is.number), training_return: maybe(is.number) }),
});

const sweep = is.object({
  name: is.text,
  spec,
  created_at: maybe(is.moment),
  started_at: maybe(is.moment),
  ended_at: maybe(is.moment),
  num_trials: is.count,
  run_time_s: maybe(is.number),
});

const status = is.object({
  state: is.oneOf("created", "running", "interrupted", "completed"),
  counts,
  num_env_steps: is.count,
  max_env_steps: maybe(is.count),
  env_steps_per_s: maybe(is.number),
  time_left_s: maybe(is.number),
  best: maybe(is.object({ trial_id: trialId, score: maybe(is.number), num_env_steps: is.count, point })),
});

const trial = is.object({
  trial_id: trialId,
  index: is.count,
  point_index: is.count,
  seed_index: is.count,
  seed: is.count,
  point,
  // The files of older versions have none.
  score_point: maybe(point),
  hyperparams: maybe(is.mapOf(is.plain, 1000), Object.create(null)),
  engine: maybe(is.text),
  status: is.oneOf(...TRIAL_STATUSES),
  stop_reason: maybe(is.text),
  error: maybe(is.text),
  notes: maybe(names, []),
  node: maybe(is.text),
  pid: maybe(is.count),
  score: maybe(is.number),
  training_return: maybe(is.number),
  evaluation_return: maybe(is.number),
  num_failures: maybe(is.count, 0),
  num_iterations: is.count,
  num_env_steps: is.count,
  num_episodes: maybe(is.count),
  time_s: maybe(is.number, 0),
  started_at: maybe(is.moment),
  ended_at: maybe(is.moment),
  checkpoints: maybe(is.listOf(is.object({ iteration: is.count, num_env_steps: is.count }), 10_000), []),
});

const isCount = (value) => Number.isInteger(value) && value >= 0;
const returns = is.numbersOf(Number.isFinite, "a finite number or null", true);
const columns = is.object({
  iteration: is.numbersOf(isCount, "a whole number from 0 on"),
  num_env_steps: is.numbersOf(isCount, "a whole number from 0 on"),
  training_return: returns,
  evaluation_return: returns,
});

function curve(value, place) {
  const found = columns(value, place);
  const length = found.iteration.length;
  for (const [name, column] of Object.entries(found)) {
    if (column.length !== length)
      throw new is.Unfit(`${place}.${name} has ${column.length} numbers, and iteration has ${length}.`);
  }
  return found;
}

const share = maybe(is.number);
const importance = is.object({
  hyperparams: is.listOf(
    is.object({ name: is.text, share, low: share, high: share, is_clear: is.flag }),
    MOST_HYPERPARAMS,
  ),
  too_few: maybe(is.text, ""),
  interactions: is.listOf(is.object({ names }), 1000),
  edges: is.listOf(is.object({ text: is.text }), 1000),
  notes: names,
});

// A mean of counts; drawn to a log scale it is above 0.
function cost(value, place) {
  if (is.number(value, place) < 0) throw new is.Unfit(`${place} is below 0.`);
  return value;
}

const frontPoint = is.object({
  rank: is.count,
  point_index: is.count,
  point,
  num_seeds: is.count,
  score: maybe(is.number),
  expected: is.number,
  num_env_steps: cost,
  lower: maybe(is.number),
  upper: maybe(is.number),
});

const frontPoints = is.listOf(frontPoint, 1000);
const frontOf = is.object({
  points: frontPoints,
  num_on_front: is.count,
  undecided: maybe(frontPoints, []),
  num_undecided: maybe(is.count),
  cheapest_near: frontPoint,
});

function someFront(value, place) {
  const found = frontOf(value, place);
  if (!found.points.length) throw new is.Unfit(`${place}.points is empty.`);
  return found;
}

const otherSettings = is.listOf(
  is.object({ rank: is.count, point_index: is.count, expected: is.number, num_env_steps: cost }),
);
const front = is.object({
  num_settings: is.count,
  front: maybe(someFront),
  // The files of older versions have none.
  more_on_front: maybe(otherSettings, []),
  others: otherSettings,
  costs_lie_far_apart: is.flag,
  cheapest_near: is.text,
  about: names,
});

const setting = is.object({
  point,
  scores: is.listOf(maybe(is.number)),
  score: maybe(is.number),
  expected: maybe(is.number),
  lower: maybe(is.number),
  upper: maybe(is.number),
});

function settings(value, place) {
  const found = is.object({ objective: is.text, num_may_be_best: is.count, ranking: is.listOf(setting) })(value, place);
  if (!found.ranking.length) throw new is.Unfit(`${place}.ranking is empty.`);
  return found;
}

const best = is.object({
  checkpoint: is.object({ trial_id: trialId, num_env_steps: is.count }),
  confirmation: evaluation,
  random: evaluation,
  settings: maybe(settings),
});

const document = is.object({
  as_of: is.moment,
  sweep,
  status,
  trials: is.listOf(trial, MOST_TRIALS),
  curves: is.mapOf(curve),
  importance: maybe(importance),
  front: maybe(front),
  best: maybe(best),
});

function checked(value) {
  const found = document(value, "");
  const ids = new Set(found.trials.map((item) => item.trial_id));
  if (ids.size !== found.trials.length) throw new is.Unfit("trials has an id twice.");
  const searched = new Set(found.trials.flatMap((item) => Object.keys(item.score_point ?? item.point)));
  if (searched.size > MOST_HYPERPARAMS)
    throw new is.Unfit(`trials search ${searched.size} hyperparameters, and no more than ${MOST_HYPERPARAMS} are shown.`);
  return found;
}

// At most so many bytes of a file, inflated, as a text: what is more is never held.
async function inflated(file, label) {
  const reader = file.stream().pipeThrough(new DecompressionStream("gzip")).getReader();
  const decoder = new TextDecoder("utf-8", { fatal: true });
  const parts = [];
  let total = 0;
  for (;;) {
    let step;
    try {
      step = await reader.read();
    } catch {
      throw new CannotOpen(`${label} is damaged: it ends too early, or was changed on its way.`, GET_IT_AGAIN);
    }
    total += step.value?.length ?? 0;
    if (total > MOST_BYTES) {
      reader.cancel().catch(() => {});
      const most = `${bytes(MOST_BYTES)} are read`;
      throw new CannotOpen(`${label} is refused: there is more in it than the ${most} at most.`, MAKE_ONE);
    }
    try {
      parts.push(decoder.decode(step.value, { stream: !step.done }));
    } catch {
      throw new CannotOpen(`${label} is no sweep file: what is in it is no text.`, MAKE_ONE);
    }
    if (step.done) return parts.join("");
  }
}

// Returns the sweep in a file, as `FileSource` has it; a CannotOpen says what is wrong with the file.
export async function readSweepFile(file) {
  const label = file.name.length > 80 ? `${file.name.slice(0, 77)}…` : file.name;
  let start;
  try {
    start = new Uint8Array(await file.slice(0, 2).arrayBuffer());
  } catch {
    throw new CannotOpen(`${label} can't be read: it is a folder, or it is no more there.`, "Choose a file.");
  }
  if (start.length < 2) throw new CannotOpen(`${label} is no sweep file: it is empty.`, MAKE_ONE);
  if (start[0] !== 0x1f || start[1] !== 0x8b) throw new CannotOpen(`${label} is no sweep file.`, MAKE_ONE);
  if (file.size > MOST_PACKED_BYTES) {
    const sizes = `it has ${bytes(file.size)}, and no more than ${bytes(MOST_PACKED_BYTES)} are read`;
    throw new CannotOpen(`${label} is refused: ${sizes}.`, MAKE_ONE);
  }
  const content = await inflated(file, label);
  let value;
  try {
    value = JSON.parse(content);
  } catch {
    throw new CannotOpen(`${label} is no sweep file: what is in it is no JSON.`, MAKE_ONE);
  }
  if (value?.format !== FORMAT) throw new CannotOpen(`${label} is no sweep file: it is another format.`, MAKE_ONE);
  if (!Number.isInteger(value.version) || value.version < 1)
    throw new CannotOpen(`${label} is damaged: it has no version of its format.`, GET_IT_AGAIN);
  if (value.version > VERSION) {
    const both = `its format is ${value.version}, and this page reads ${VERSION}`;
    throw new CannotOpen(`${label} was made by a newer tune-jobs: ${both}.`, "Update the service that this page is of.");
  }
  try {
    return checked(value);
  } catch (error) {
    if (!(error instanceof is.Unfit)) throw error;
    throw new CannotOpen(`${label} is damaged: ${error.message}`, GET_IT_AGAIN);
  }
}
