// The language of the filter: words are looked for in all cells; lr<0.001 compares a column; status=failed too.
const COMPARE = {
  "<": (a, b) => a < b,
  "<=": (a, b) => a <= b,
  ">": (a, b) => a > b,
  ">=": (a, b) => a >= b,
  "=": (a, b) => a === b,
  "!=": (a, b) => a !== b,
};

export function filterOf(query, columns) {
  const tests = query
    .trim()
    .split(/\s+/)
    .filter(Boolean)
    .map((word) => testOf(word, columns));
  return (row) => tests.every((test) => test(row));
}

function testOf(word, columns) {
  const [, name, sign, limit] = /^([^<>=!]+)(<=|>=|!=|<|>|=)(.+)$/.exec(word) ?? [];
  const column = name && columns.find((known) => nameOf(known) === name.toLowerCase());
  if (!column) {
    const wanted = word.toLowerCase();
    return (row) => columns.some((known) => known.text(row).toLowerCase().includes(wanted));
  }
  const isUnset = column.isUnset ?? (() => false);
  if (limit.trim() === "" || Number.isNaN(Number(limit))) {
    // As the sweep file writes it.
    const wantsUnset = limit.toLowerCase() === "null";
    const same = (row) => column.text(row).toLowerCase() === limit.toLowerCase() || (wantsUnset && isUnset(row));
    if (sign === "=") return same;
    return sign === "!=" ? (row) => !same(row) : () => false;
  }
  return (row) => {
    const value = column.value(row);
    if (typeof value === "number") return COMPARE[sign](value, Number(limit));
    if (isUnset(row)) return sign === "!=";
    return value !== null && ["=", "!="].includes(sign) && COMPARE[sign](column.text(row), limit);
  };
}

const nameOf = (column) => column.label.toLowerCase().replace(/\s+/g, "_");
