// The domains of a search space as sweep files have them: { loguniform: [1e-5, 0.1], when: { replay: "prioritized" } }.
export const LISTED = ["grid", "choice"];
export const WHOLE = ["randint", "lograndint", "qrandint", "qlograndint", "power_of_two"];
export const NEAR_ONE = "one_minus_loguniform";
const LOG = ["loguniform", "qloguniform", "lograndint", "qlograndint", "power_of_two"];
// Beyond so many combinations of grids nobody counts them.
const MOST_COMBINATIONS = 10_000;

export const isLog = (kind) => LOG.includes(kind);

export const kindOf = (domain) =>
  domain && typeof domain === "object" ? (Object.keys(domain).find((key) => key !== "when") ?? null) : null;

// As the sweep file means it: one layer may be written as its number, [64] as 64.
function meaning(value) {
  if (!Array.isArray(value)) return value;
  const items = value.map(meaning);
  return items.length === 1 && typeof items[0] === "number" ? items[0] : items;
}

const isSame = (one, other) => JSON.stringify(meaning(one)) === JSON.stringify(meaning(other));

// The values that a condition names: a list is several, unless the domain lists it as one value.
function namedValues(domain, given) {
  const isOne = LISTED.includes(kindOf(domain)) && domain[kindOf(domain)].some((value) => isSame(value, given));
  return Array.isArray(given) && !isOne ? given : [given];
}

// Whether a hyperparameter acts in a point; what its conditions name must act too.
export function acts(space, name, values, depth = 0) {
  return Object.entries(space[name]?.when ?? {}).every(
    ([other, given]) =>
      depth < 100 &&
      other in space &&
      namedValues(space[other], given).some((value) => isSame(value, values[other])) &&
      acts(space, other, values, depth + 1),
  );
}

// What a hyperparameter needs to act, in words; empty: nothing.
export const neededText = (space, name, textOf) =>
  Object.entries(space[name]?.when ?? {})
    .map(([other, given]) => `${other} ${namedValues(space[other], given).map(textOf).join(" or ")}`)
    .join(" and ");

// How many combinations of the grids' values there are, of those that act.
export function numCombinations(space) {
  const grids = Object.keys(space).filter((name) => kindOf(space[name]) === "grid");
  const all = grids.reduce((product, name) => product * (space[name].grid.length ?? 1), 1);
  if (all > MOST_COMBINATIONS || !grids.some((name) => space[name].when)) return all;
  let found = [{}];
  for (const name of grids)
    found = found.flatMap((values) => space[name].grid.map((value) => ({ ...values, [name]: value })));
  const acting = (values) => grids.filter((name) => acts(space, name, values)).map((name) => [name, values[name]]);
  return new Set(found.map((values) => JSON.stringify(acting(values)))).size;
}
