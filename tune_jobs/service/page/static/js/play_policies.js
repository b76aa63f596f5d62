// Which policies of a sweep can be watched, and how an address names one: "best", "random", "t0003:40".
import { ask, ofSweep } from "./api.js";

const MOST_TRIALS = 1000;

const wholeOf = (text) => (/^\d{1,9}$/.test(text ?? "") ? Number(text) : null);

// What a text of an address names; null: nothing.
export function policyOf(text, iteration = null) {
  if (!text) return null;
  if (text === "best" || text === "random") return { kind: text };
  const [trial, own] = text.split(":");
  return { kind: "trial", trial, iteration: wholeOf(own ?? iteration) };
}

export function textOf(policy) {
  if (policy === null) return "";
  if (policy.kind !== "trial") return policy.kind;
  return policy.iteration === null ? policy.trial : `${policy.trial}:${policy.iteration}`;
}

export function titleOf(policy) {
  if (policy.kind !== "trial") return policy.kind === "best" ? "Best policy" : "Random policy";
  return policy.iteration === null ? policy.trial : `${policy.trial}, iteration ${policy.iteration}`;
}

// What the service is asked with.
export function queryOf(policy) {
  if (policy.kind === "random") return { random: "true" };
  return policy.kind === "best" ? {} : { trial: policy.trial, iteration: policy.iteration };
}

// The policies of a sweep: whether it has chosen a best one, and its trials that have checkpoints, best first. Of
// thousands of trials these are the first, and those that are `wanted`.
export async function policiesOf(name, wanted = []) {
  const query = { fields: "trial_id,score,checkpoints", sort: "score", limit: MOST_TRIALS };
  const [files, { trials }] = await Promise.all([
    ask(ofSweep(name, "/files")),
    ask(ofSweep(name, "/trials"), { query }),
  ]);
  const known = new Set(trials.map((trial) => trial.trial_id));
  const missing = wanted.filter((policy) => policy?.kind === "trial" && !known.has(policy.trial));
  const others = await Promise.all(
    // The service says what is wrong with one that is not there when it is asked to play it.
    missing.map(({ trial }) => ask(ofSweep(name, `/trials/${encodeURIComponent(trial)}`)).catch(() => null)),
  );
  return {
    hasBest: files.some((file) => file.path.startsWith("policy/")),
    trials: [...trials, ...others].filter((trial) => trial?.checkpoints.length),
  };
}

// A policy with the iteration that is meant where none is named: the latest.
export function settled(policy, { trials }) {
  if (policy?.kind !== "trial" || policy.iteration !== null) return policy;
  const trial = trials.find((known) => known.trial_id === policy.trial);
  return trial ? { ...policy, iteration: trial.checkpoints.at(-1).iteration } : policy;
}

// What is watched where nobody has chosen.
export function usual(known) {
  if (known.hasBest) return { kind: "best" };
  const [first] = known.trials;
  return first ? settled({ kind: "trial", trial: first.trial_id, iteration: null }, known) : { kind: "random" };
}
