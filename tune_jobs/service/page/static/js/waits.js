// What a sweep waits for: nodes of a cluster that have room for one of its trials.
import { counted, significant, timeLeft } from "./format.js";

const resource = ([name, number]) =>
  Number.isInteger(number) ? counted(number, name) : `${significant(number)} ${name}s`;

export function waitText({ since, until, resources, lacking }, now = Date.now() / 1000) {
  const wanted = Object.entries(resources)
    .filter(([, number]) => number)
    .map(resource)
    .join(" and ");
  const past = `for ${timeLeft(Math.max(0, now - since))}`;
  const limit = until === null ? "" : `, and at most ${timeLeft(Math.max(0, until - now))} more`;
  return `It waits for nodes with room for one trial (${wanted}): ${past}${limit}. ${lacking}`.trim();
}
