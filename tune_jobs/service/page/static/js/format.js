// Numbers, times and values as texts, as the report and the command line write them.
export const NONE = "–";
// A value that is searched and is none: the report has the same words for it.
export const NOT_SET = "not set";
const whole = new Intl.NumberFormat("en", { maximumFractionDigits: 0 });
const tenths = new Intl.NumberFormat("en", { minimumFractionDigits: 1, maximumFractionDigits: 1 });
const thousandths = new Intl.NumberFormat("en", { minimumFractionDigits: 3, maximumFractionDigits: 3 });
const tiny = new Intl.NumberFormat("en", { minimumSignificantDigits: 3, maximumSignificantDigits: 3 });
const short = new Intl.NumberFormat("en", { notation: "compact", maximumSignificantDigits: 3 });
const MOST_DIGITS = 12;
const day = new Intl.DateTimeFormat("en-GB", { day: "numeric", month: "short", hour: "2-digit", minute: "2-digit" });
const date = new Intl.DateTimeFormat("en-GB", { dateStyle: "long", timeStyle: "medium" });

const isNumber = (value) => typeof value === "number" && Number.isFinite(value);
export const count = (value) => (isNumber(value) ? whole.format(value) : NONE);
export const compact = (value) => (isNumber(value) ? short.format(value) : NONE);

// The digits of numbers beside each other, as at an axis: three, or as many as it takes to say where each of them lies.
export function enoughDigits(values) {
  const numbers = [...new Set(values.filter(isNumber))].sort((a, b) => a - b);
  const least = Math.min(...numbers.slice(1).map((value, index) => value - numbers[index]));
  // To be told apart is not enough: 495, 497.5 and 500 would be 495, 498 and 500.
  const isNear = (value, digits) => Math.abs(Number(value.toPrecision(digits)) - value) <= 0.05 * least;
  let digits = 3;
  while (digits < MOST_DIGITS && !numbers.every((value) => isNear(value, digits))) digits += 1;
  return digits;
}

export function tickTexts(values) {
  const maximumSignificantDigits = enoughDigits(values);
  const form = new Intl.NumberFormat("en", { notation: "compact", maximumSignificantDigits });
  return values.map((value) => (isNumber(value) ? form.format(value) : NONE));
}

// With one decimal; returns of 0 to 1 are told apart by their second and third. With as many as what it is read beside.
export function returnText(value, ...beside) {
  if (!isNumber(value)) return NONE;
  const size = Math.max(...[value, ...beside].filter(isNumber).map(Math.abs));
  const form = size === 0 || size >= 2 ? tenths : size >= 0.01 ? thousandths : tiny;
  return form.format(value === 0 ? 0 : value);
}

export const rangeText = (low, high) => `${returnText(low, high)} to ${returnText(high, low)}`;
export const counted = (number, noun, plural = `${noun}s`) => `${count(number)} ${number === 1 ? noun : plural}`;

export function significant(value, digits = 4) {
  if (!isNumber(value)) return NONE;
  if (Number.isInteger(value) && Math.abs(value) < 1e6) return String(value);
  // As many digits of what it lacks: a gamma of 0.9904 is not 0.99, and 0.99987 is not 1.
  if (value >= 0.9 && value < 1) {
    const decimals = Math.max(digits, digits - 1 - Math.floor(Math.log10(1 - value)));
    return String(Number(value.toFixed(decimals)));
  }
  const text = value.toPrecision(digits);
  if (/e/.test(text) || Math.abs(value) < 1e-3) {
    const [mantissa, exponent] = value.toExponential(digits - 1).split("e");
    return `${Number(mantissa)}e${Number(exponent)}`;
  }
  return String(Number(text));
}

// A hyperparameter's value: 64x64 for lists, 16x8x4 32x4x2 for lists in a list.
export function settingText(value, digits = 4) {
  if (value === undefined) return NONE;
  if (value === null) return NOT_SET;
  if (Array.isArray(value)) {
    const texts = value.map((item) => (item === null ? NONE : settingText(item, digits)));
    return texts.join(value.some(Array.isArray) ? " " : "x");
  }
  if (typeof value === "number") return significant(value, digits);
  return typeof value === "object" ? JSON.stringify(value) : String(value);
}

// The value of a point; empty where it does not act. Of a point that is not chosen yet nothing is known.
export const valueText = (point, name) =>
  name in point ? settingText(point[name]) : Object.keys(point).length ? "" : NONE;

export const pointText = (point, digits = 3) =>
  Object.entries(point ?? {})
    .map(([name, value]) => `${name} ${settingText(value, digits)}`)
    .join(", ");

export function duration(seconds) {
  if (!isNumber(seconds)) return NONE;
  const all = Math.round(seconds);
  if (all < 60) return seconds < 10 ? `${tenths.format(seconds)} s` : `${all} s`;
  const minutes = Math.floor(all / 60);
  if (minutes < 60) return `${minutes} min ${all % 60} s`;
  const hours = Math.floor(minutes / 60);
  return hours < 48 ? `${hours} h ${minutes % 60} min` : `${Math.floor(hours / 24)} d ${hours % 24} h`;
}

// An estimate: what is finer than it is known is left out.
export function timeLeft(seconds) {
  if (!isNumber(seconds)) return NONE;
  if (seconds < 60) return `${Math.max(1, Math.round(seconds))} s`;
  const minutes = Math.round(seconds / 60);
  return minutes < 60 ? `${minutes} min` : duration(minutes * 60);
}

export function ago(unixTime, now = Date.now() / 1000) {
  if (!isNumber(unixTime)) return NONE;
  const seconds = Math.max(0, now - unixTime);
  if (seconds < 45) return "just now";
  if (seconds < 3600) return `${Math.max(1, Math.round(seconds / 60))} min ago`;
  if (seconds < 86400) return `${Math.round(seconds / 3600)} h ago`;
  return day.format(new Date(unixTime * 1000));
}

export const moment = (unixTime) => (isNumber(unixTime) ? date.format(new Date(unixTime * 1000)) : NONE);

export function bytes(number) {
  if (!isNumber(number)) return NONE;
  const units = ["bytes", "kB", "MB", "GB", "TB"];
  let unit = 0;
  for (; number >= 1000 && unit < units.length - 1; unit += 1) number /= 1000;
  return `${unit ? tenths.format(number) : number} ${units[unit]}`;
}

// Rounded down, so that 100 % means done.
export const percent = (part, all) => (all > 0 ? Math.min(100, Math.floor((100 * part) / all)) : 0);
