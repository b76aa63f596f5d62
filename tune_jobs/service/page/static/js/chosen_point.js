// A point that somebody chooses: a dialog with a field for each searched hyperparameter, filled with the best trial's.
import { counted, settingText } from "./format.js";

const LISTED = ["grid", "choice"];
// Whole ranges without a step leave their upper end out.
const WHOLE = ["randint", "lograndint", "qrandint", "qlograndint"];
const PREFIX = "point-";

// Whether a point can be added to a sweep: something is searched, and trials keep their values while they train.
export const takesPoints = (spec) => Object.keys(spec?.space ?? {}).length > 0 && spec.scheduler?.type !== "pbt";

export function pointDialog({ name, spec, trials, post }) {
  const start = bestPoint(trials);
  const told = Object.keys(start).length ? " The values below are those of the best trial: change at least one." : "";
  const names = Object.keys(spec.space);
  return {
    title: `Add a point to ${name}`,
    text: `It is trained with ${counted(spec.seeds_per_point ?? 1, "seed")}, then compared and chosen like any other.${told}`,
    label: "Add and train",
    fields: names.map((each) => fieldOf(each, spec.space[each], start[each])),
    act: (values) => post({ point: Object.fromEntries(names.map((each) => [each, values[PREFIX + each]])) }),
  };
}

function bestPoint(trials) {
  const known = trials.filter((trial) => Object.keys(trial.point).length > 0);
  const score = (trial) => trial.score ?? -Infinity;
  const best = known.reduce((found, trial) => (found === null || score(trial) > score(found) ? trial : found), null);
  return best?.point ?? {};
}

function fieldOf(name, domain, value) {
  const kind = Object.keys(domain)[0];
  const common = { name: PREFIX + name, label: name, value };
  if (LISTED.includes(kind)) return { ...common, type: "select", options: optionsOf(domain[kind], value) };
  const [low, high, step] = domain[kind];
  const last = WHOLE.includes(kind) && (step ?? 1) === 1 ? high - 1 : high;
  const range = `${settingText(low)} to ${settingText(last)}${step ? ` in steps of ${settingText(step)}` : ""}`;
  return {
    ...common,
    type: "number",
    step: WHOLE.includes(kind) ? 1 : "any",
    hint: `Searched from ${range}${kind.includes("log") ? ", on a log scale" : ""}. Other values may be tried.`,
  };
}

// The listed values; one that was tried though it is not among them stays what it is.
function optionsOf(listed, value) {
  const known = new Set(listed.map((each) => JSON.stringify(each)));
  const all = value === undefined || known.has(JSON.stringify(value)) ? listed : [...listed, value];
  return all.map((each) => ({ value: each, text: typeof each === "number" ? String(each) : settingText(each) }));
}
