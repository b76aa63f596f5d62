// The axes of parallel coordinates: where a value lies on its axis (0 below, 1 at the top), and which values a range has.
// A value that has no place on it, as it does not act in a trial, has `undefined` for one.
import { enoughDigits, returnText, settingText } from "./format.js";
import { shownPoint } from "./shown_point.js";

const NUM_TICKS = 4;

export function axesOf(searchedOnes, trials) {
  const axes = searchedOnes.map((searched) =>
    axisOf(
      searched,
      trials.map((trial) => valueIn(trial, searched.name)).filter((value) => value !== undefined),
    ),
  );
  const scores = trials.map((trial) => trial.score).filter((score) => score !== null);
  if (scores.length)
    axes.push({
      ...rangeAxis("score", "linear", scores),
      isScore: true,
      valueOf: (trial) => trial.score,
      text: returnText,
    });
  return axes.map((axis) => ({ valueOf: (trial) => valueIn(trial, axis.name), ...axis }));
}

// undefined: it does not act. null is a value like others, as that of a gradient that is not clipped.
function valueIn(trial, name) {
  const point = shownPoint(trial);
  return Object.hasOwn(point, name) ? point[name] : undefined;
}

function axisOf({ name, kind, values }, given) {
  const found = given.filter((value) => value !== null);
  const isNumeric = found.length > 0 && found.every((value) => typeof value === "number");
  if (kind === "listed" || !isNumeric) return listedAxis(name, [...values, ...given]);
  if (kind === "near one" && found.every((value) => value < 1)) return rangeAxis(name, kind, found);
  return rangeAxis(name, kind === "log" && found.every((value) => value > 0) ? "log" : "linear", found);
}

function listedAxis(name, values) {
  const texts = [...new Set(values.map((value) => settingText(value)))];
  const isNumeric = values.every((value) => typeof value === "number");
  if (isNumeric) texts.sort((a, b) => Number(a) - Number(b));
  const places = new Map(texts.map((text, index) => [text, texts.length === 1 ? 0.5 : index / (texts.length - 1)]));
  const place = (value) => (value === undefined ? undefined : places.get(settingText(value)));
  return {
    name,
    kind: "listed",
    texts,
    place,
    text: (value) => settingText(value),
    ticks: texts.map((text) => ({ text, at: place(text) })),
    // A range of the axis as its values, and the other way round.
    rangeText: (low, high) => texts.filter((text) => place(text) >= low - 1e-9 && place(text) <= high + 1e-9).join("|"),
    test: (range) => {
      const wanted = new Set(range.split("|"));
      return (value) => wanted.has(settingText(value));
    },
    ends: (range) => {
      const at = range
        .split("|")
        .filter((text) => texts.includes(text))
        .map(place);
      return at.length ? [Math.min(...at), Math.max(...at)] : null;
    },
  };
}

function rangeAxis(name, kind, values) {
  let [low, high] = values.reduce(([a, b], value) => [Math.min(a, value), Math.max(b, value)], [Infinity, -Infinity]);
  const { by, back, ticks, around } = SCALES[kind];
  if (low === high) [low, high] = around(low);
  const place = (value) => (typeof value === "number" ? (by(value) - by(low)) / (by(high) - by(low)) : undefined);
  const marks = ticks(low, high);
  const digits = enoughDigits(marks);
  const valueAt = (at) => back(by(low) + at * (by(high) - by(low)));
  return {
    name,
    kind,
    place,
    valueAt,
    text: (value) => settingText(value, 3),
    ticks: marks.map((value) => ({ text: settingText(value, digits), at: place(value) })),
    // An end of the axis is the value of a trial, which rounding would leave out.
    rangeText: (from, to) =>
      `${from <= 0 ? low : rounded(valueAt(from))}..${to >= 1 ? high : rounded(valueAt(to))}`,
    test: (range) => {
      const [from, to] = range.split("..").map(Number);
      return (value) => value >= from && value <= to;
    },
    ends: (range) => {
      const ends = range.split("..").map(Number).map(place);
      return ends.every(Number.isFinite) ? ends.map((at) => Math.max(0, Math.min(1, at))) : null;
    },
  };
}

const SCALES = {
  linear: { by: (value) => value, back: (at) => at, ticks: linearTicks, around: (value) => [value - 1, value + 1] },
  log: { by: Math.log10, back: (at) => 10 ** at, ticks: logTicks, around: (value) => [value / 2, value * 2] },
  // 0.9, 0.99 and 0.999 lie equally apart.
  "near one": {
    by: (value) => -Math.log10(1 - value),
    back: (at) => 1 - 10 ** -at,
    ticks: (low, high) => logTicks(1 - high, 1 - low).map((distance) => Number((1 - distance).toPrecision(12))),
    around: (value) => [1 - 2 * (1 - value), 1 - (1 - value) / 2],
  },
};

const rounded = (value) => Number(value.toPrecision(value > 0.99 && value < 1 ? 8 : 4));

function logTicks(low, high) {
  const decades = [];
  for (let power = Math.ceil(Math.log10(low) - 1e-9); power <= Math.floor(Math.log10(high) + 1e-9); power += 1)
    decades.push(10 ** power);
  if (decades.length < 2) return finerLogTicks(low, high);
  const step = Math.ceil(decades.length / (NUM_TICKS + 1));
  return decades.filter((_, index) => index % step === 0);
}

// 1, 2 and 5 of each decade; where not even two of them lie within, the ends.
function finerLogTicks(low, high) {
  const ticks = [];
  for (let power = Math.floor(Math.log10(low)); power <= Math.log10(high); power += 1) {
    for (const factor of [1, 2, 5]) {
      const value = Number(`${factor}e${power}`);
      if (value >= low * 0.999 && value <= high * 1.001) ticks.push(value);
    }
  }
  return ticks.length > 1 ? ticks : [low, high];
}

function linearTicks(low, high) {
  const rough = (high - low) / NUM_TICKS;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((candidate) => candidate >= rough * 0.999);
  const first = Math.ceil(low / step);
  // Counted before: a step that is too small beside its value would never arrive at the end.
  const number = Math.min(3 * NUM_TICKS, Math.floor((high + step * 1e-6) / step) - first + 1) || 0;
  return Array.from({ length: Math.max(0, number) }, (_, index) => Number(((first + index) * step).toPrecision(12)));
}
