// The columns of the table of trials, which the filter and the sorting know by the same names.
import { count, duration, NONE, returnText, settingText, valueText } from "./format.js";
import { shownPoint } from "./shown_point.js";

const collator = new Intl.Collator("en", { numeric: true });

export function columnsOf(searched, hasSeveralSeeds) {
  const columns = [
    column("trial", "trial", (row) => row.trial_id),
    column("status", "status", (row) => row.status),
    column("score", "score", (row) => row.score, returnText, true),
    ...searched.map(({ name, isNumber }) => ({
      key: name,
      label: name,
      isNumber,
      value: (row) => plain(shownPoint(row)[name]),
      // Not the same as that it does not act.
      isUnset: (row) => Object.hasOwn(shownPoint(row), name) && shownPoint(row)[name] === null,
      text: (row) => valueText(shownPoint(row), name),
    })),
    column("training_return", "training return", (row) => row.training_return, returnText, true),
    column("num_env_steps", "env steps", (row) => row.num_env_steps, count, true),
    column("time_s", "time", (row) => row.time_s, duration, true),
  ];
  if (hasSeveralSeeds)
    columns.splice(
      1,
      0,
      column("point_index", "point", (row) => row.point_index, count, true),
    );
  return columns;
}

function column(key, label, value, text = String, isNumber = false) {
  return {
    key,
    label,
    value: (row) => value(row) ?? null,
    text: (row) => ((value(row) ?? null) === null ? NONE : text(value(row))),
    isNumber,
  };
}

function plain(value) {
  if (value === undefined || value === null) return null;
  return typeof value === "number" || typeof value === "string" ? value : settingText(value);
}

// Sorted by a column; what is not known comes last, whichever way.
export function sortRows(rows, column, isRising) {
  const sign = isRising ? 1 : -1;
  return rows
    .map((row) => [column.value(row), row])
    .sort(([a, one], [b, two]) => {
      if (a === null || b === null) return (a === null) - (b === null) || one.index - two.index;
      return (
        sign * (typeof a === "number" && typeof b === "number" ? a - b : collator.compare(a, b)) ||
        one.index - two.index
      );
    })
    .map(([, row]) => row);
}
