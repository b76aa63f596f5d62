// A point that somebody chooses: a dialog with a field for each searched hyperparameter, filled with the best trial's.
import { acts, isLog, kindOf, LISTED, NEAR_ONE, neededText, WHOLE } from "./domains.js";
import { counted, settingText } from "./format.js";


const PREFIX = "point-";

// Whether a point can be added to a sweep: something is searched, and trials keep their values while they train.
export const takesPoints = (spec) => Object.keys(spec?.space ?? {}).length > 0 && !["pbt", "pb2"].includes(spec.scheduler?.type);

export function pointDialog({ name, spec, trials, post }) {
  const start = bestPoint(trials);
  const told = Object.keys(start).length ? " The values below are those of the best trial: change at least one." : "";
  const { space } = spec;
  const names = Object.keys(space);
  const pointOf = (values) => Object.fromEntries(names.map((each) => [each, values[PREFIX + each]]));
  const isActing = (each, values) => acts(space, each, pointOf(values));
  return {
    title: `Add a point to ${name}`,
    text: `It is trained with ${counted(spec.seeds_per_point ?? 1, "seed")}, then compared and chosen like any other.${told}`,
    label: "Add and train",
    fields: names.map((each) => ({
      ...fieldOf(each, space, start[each]),
      acts: space[each].when ? (values) => isActing(each, values) : null,
    })),
    act: (values) => {
      const point = Object.entries(pointOf(values)).filter(([each]) => isActing(each, values));
      return post({ point: Object.fromEntries(point.map(([each, value]) => [each, read(space[each], value)])) });
    },
  };
}

function bestPoint(trials) {
  const known = trials.filter((trial) => Object.keys(trial.point).length > 0);
  const score = (trial) => trial.score ?? -Infinity;
  const best = known.reduce((found, trial) => (found === null || score(trial) > score(found) ? trial : found), null);
  return best?.point ?? {};
}

function fieldOf(name, space, known) {
  const domain = space[name];
  const kind = kindOf(domain);
  const value = known === undefined ? middleOf(domain) : known;
  const common = { name: PREFIX + name, label: name, value };
  const needs = neededText(space, name, (each) => settingText(each));
  const when = needs ? ` Acts only with ${needs}.` : "";
  if (LISTED.includes(kind)) {
    return { ...common, type: "select", options: optionsOf(domain[kind], value), hint: when.trim() || undefined };
  }
  if (kind === "layers") {
    const text = Array.isArray(value) ? value.join(", ") : value;
    return { ...common, value: text, type: "text", max: 200, hint: `The size of each layer, such as 64, 32.${when}` };
  }
  const [low, high, step] = domain[kind];
  // Whole ranges without a step leave their upper end out.
  const last = kind.endsWith("randint") && (step ?? 1) === 1 ? high - 1 : high;
  const range = `${settingText(low)} to ${settingText(last)}${step ? ` in steps of ${settingText(step)}` : ""}`;
  return {
    ...common,
    type: "number",
    step: WHOLE.includes(kind) ? 1 : "any",
    hint: `Searched from ${range}${scaleText(kind)}. Other values may be tried.${when}`,
  };
}

function scaleText(kind) {
  if (kind === "power_of_two") return ", powers of two";
  if (kind === NEAR_ONE) return ", 1 - value on a log scale";
  return isLog(kind) ? ", on a log scale" : "";
}

// A value to begin with, of what does not act in the best trial; undefined: the first of a list.
function middleOf(domain) {
  const kind = kindOf(domain);
  if (domain.when === undefined || LISTED.includes(kind) || kind === "layers") return undefined;
  const [low, high] = domain[kind];
  if (kind === "power_of_two") return low;
  if (kind === NEAR_ONE) return Number((1 - Math.sqrt((1 - low) * (1 - high))).toPrecision(4));
  const middle = Number((isLog(kind) ? Math.sqrt(low * high) : (low + high) / 2).toPrecision(3));
  return WHOLE.includes(kind) ? Math.round(middle) : middle;
}

// What is sent for what was typed: the sizes of layers as a list.
function read(domain, value) {
  if (kindOf(domain) !== "layers" || typeof value !== "string") return value;
  const sizes = value.split(/[\s,x]+/).filter(Boolean).map(Number);
  return sizes.every(Number.isInteger) ? sizes : value;
}

// The listed values; one that was tried though it is not among them stays what it is.
function optionsOf(listed, value) {
  const known = new Set(listed.map((each) => JSON.stringify(each)));
  const all = value === undefined || known.has(JSON.stringify(value)) ? listed : [...listed, value];
  return all.map((each) => ({ value: each, text: typeof each === "number" ? String(each) : settingText(each) }));
}
