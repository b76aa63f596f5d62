// What state a sweep is in for people: its own, and that of the job which the service has for it.
import { waitText } from "./waits.js";

const TONES = { running: "live", stopping: "live", waiting: "wait", completed: "good", failed: "bad" };

// What is being written by the service is held by a process too, and does not run yet.
const isDriven = (sweep) => Boolean(sweep.alive) && sweep.job?.state !== "creating";
export const isLive = (sweep) =>
  sweep.state === "running" || sweep.job?.state === "running" || Boolean(sweep.waiting) || isDriven(sweep);
export const isWaiting = (sweep) => !isLive(sweep) && ["waiting", "creating"].includes(sweep.job?.state);

// Who has resumed it from a terminal has made of it what its last job did not.
const isResumedSince = (sweep) => sweep.state === "completed" && sweep.ended_at > sweep.job?.ended_at;
// Whether all that comes after the trials was made, too: the policy was chosen, and where that can be, filmed.
export const isDone = (sweep) =>
  stateWord(sweep) === "completed" && (isResumedSince(sweep) || !sweep.job?.finish_failed);

export function stateOf(sweep) {
  const word = stateWord(sweep);
  return { word, tone: TONES[word] ?? "quiet", group: groupOf(word) };
}

function stateWord(sweep) {
  const job = sweep.job;
  if (isLive(sweep)) return job?.stop_requested ? "stopping" : sweep.waiting ? "waiting" : "running";
  if (isWaiting(sweep)) return "waiting";
  if (job?.outcome === "failed" && !isResumedSince(sweep)) return "failed";
  if (sweep.state === "completed") return "completed";
  if (job?.outcome === "stopped" || job?.outcome === "cancelled") return "stopped";
  return sweep.state;
}

function groupOf(word) {
  if (word === "running" || word === "stopping") return "running";
  return word === "waiting" || word === "created" ? "waiting" : "ended";
}

// What there is to say of a state, as a sentence; empty: the word says it.
export function stateReason(sweep) {
  const { word } = stateOf(sweep);
  if (word === "failed") return sweep.job?.message || "Its driver failed; the service's log has more.";
  // Which trials failed, why no policy was chosen, or what could not be made of it.
  if (word === "completed") return (!isResumedSince(sweep) && sweep.job?.message) || "";
  if (word === "stopping") return "Its trials save first.";
  if (sweep.waiting) return waitText(sweep.waiting);
  if (word === "waiting")
    return sweep.job?.verb === "drive" ? "It starts when its turn has come." : `${sweep.job.verb} waits for its turn.`;
  if (word === "interrupted") return "Its process is gone: resume it, and it goes on from what was saved.";
  if (word === "created") return "It is written, but was never started: resume it.";
  return "";
}

export const TRIAL_STATUSES = ["running", "pending", "paused", "completed", "stopped", "failed"];

export const trialTone = (status) =>
  ({ running: "live", completed: "good", failed: "bad", pending: "wait" })[status] ?? "quiet";
