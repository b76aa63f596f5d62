// How many trials come of what is asked for, as the service counts them.
import { numCombinations } from "./domains.js";
import { counted } from "./format.js";

// Points of one more sample: a draw for each combination of the grids; models propose from those too.
function pointsPerSample(spec) {
  if ((spec.search?.type ?? "random") !== "random") return 1;
  return numCombinations(spec.space ?? {});
}

export function toldExtension(spec, numSamples) {
  const [points, seeds] = [numSamples * pointsPerSample(spec), spec.seeds_per_point ?? 1];
  return `Adds ${counted(points * seeds, "trial")}: ${counted(points, "point")}, each with ${counted(seeds, "seed")}.`;
}

// A race ends for a setting that falls behind, so there may be fewer.
export function toldRace(numPoints, { top, seeds }) {
  const settings = Math.min(top, numPoints);
  return `Adds at most ${counted(settings * seeds, "trial")}: ${counted(settings, "setting")}, each with up to ${counted(seeds, "more seed")}.`;
}
