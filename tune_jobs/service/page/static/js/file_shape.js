// What the parts of a file have to be. It comes from anybody: what is not as it has to be is said with its place, and
// what the page doesn't show is left out.
const MOST_CHARS = 200_000;
const MOST_ITEMS = 200_000;
const MOST_DEPTH = 6;

export class Unfit extends Error {}

function told(value) {
  if (value === undefined) return "missing";
  if (value === null) return "null";
  if (Array.isArray(value)) return "a list";
  return { object: "an object", string: "a text", number: "a number", boolean: "true or false" }[typeof value];
}

function refuse(value, place, wanted) {
  throw new Unfit(`${place} is ${told(value)}, not ${wanted}.`);
}

export function text(value, place) {
  if (typeof value !== "string") refuse(value, place, "a text");
  if (value.length > MOST_CHARS) throw new Unfit(`${place} has ${value.length} characters, too many.`);
  return value;
}

// JSON has 1e999, too.
export function number(value, place) {
  return Number.isFinite(value) ? value : refuse(value, place, "a finite number");
}

export function count(value, place) {
  return Number.isInteger(value) && value >= 0 ? value : refuse(value, place, "a whole number from 0 on");
}

// Dates end before that.
const MOST_SECONDS = 1e11;

export function moment(value, place) {
  return number(value, place) >= 0 && value < MOST_SECONDS ? value : refuse(value, place, "a Unix time in seconds");
}

export function flag(value, place) {
  return typeof value === "boolean" ? value : refuse(value, place, "true or false");
}

// Any plain value, such as one of a hyperparameter.
export function plain(value, place, depth = 0) {
  if (depth > MOST_DEPTH) throw new Unfit(`${place} is nested too deeply.`);
  if (value === null || typeof value === "boolean") return value;
  if (typeof value === "string") return text(value, place);
  if (typeof value === "number") return number(value, place);
  const inner = (item, where) => plain(item, where, depth + 1);
  return Array.isArray(value) ? listOf(inner)(value, place) : mapOf(inner)(value, place);
}

export const optional =
  (check, none = null) =>
  (value, place) =>
    value === null || value === undefined ? none : check(value, place);

export const oneOf =
  (...words) =>
  (value, place) =>
    words.includes(value) ? value : refuse(value, place, `one of ${words.join(", ")}`);

export const matching = (pattern, wanted) => (value, place) =>
  typeof value === "string" && pattern.test(value) ? value : refuse(value, place, wanted);

export const listOf =
  (check, most = MOST_ITEMS) =>
  (value, place) => {
    if (!Array.isArray(value)) refuse(value, place, "a list");
    if (value.length > most) throw new Unfit(`${place} has ${value.length} items, and no more than ${most} are shown.`);
    return value.map((item, index) => check(item, `${place}[${index}]`));
  };

// Numbers in a list, of which there are many: their places are worked out only where one is wrong.
export const numbersOf =
  (isRight, wanted, mayMiss = false) =>
  (value, place) => {
    if (!Array.isArray(value)) refuse(value, place, "a list");
    const wrong = value.findIndex((item) => !isRight(item) && !(mayMiss && item === null));
    return wrong < 0 ? value : refuse(value[wrong], `${place}[${wrong}]`, wanted);
  };

function entriesOf(value, place) {
  if (typeof value !== "object" || value === null || Array.isArray(value)) refuse(value, place, "an object");
  return Object.entries(value);
}

// Values by names that the file chooses: without the names that all objects have, such as "constructor".
export const mapOf =
  (check, most = MOST_ITEMS) =>
  (value, place) => {
    const entries = entriesOf(value, place);
    if (entries.length > most)
      throw new Unfit(`${place} has ${entries.length} names, and no more than ${most} are shown.`);
    const found = Object.create(null);
    for (const [name, item] of entries) found[text(name, place)] = check(item, `${place}.${name}`);
    return found;
  };

// Values by names that the page knows; others are left out.
export const object = (fields) => (value, place) => {
  const known = new Map(entriesOf(value, place));
  return Object.fromEntries(
    Object.entries(fields).map(([name, check]) => [name, check(known.get(name), place ? `${place}.${name}` : name)]),
  );
};
