// The table of trials: its headings sort it, a field filters it, and a button shows all of it. Without scripts it is the
// table of the first trials, best first.
const FIRST_ROWS = 50;
const notKnownLast = (a, b) => (a === "") - (b === "");
const byValue = (a, b) => (isNaN(a) || isNaN(b) ? String(a).localeCompare(b, undefined, { numeric: true }) : a - b);

// A row is a list of cells [value, text, kind, href].
function cellOf(cell) {
  const [value, text = "", kind = "", href = ""] = cell;
  return { value: value === null ? "" : value, text, kind, href };
}

function readRow(row) {
  return [...row.cells].map((cell) => ({
    value: cell.dataset.value,
    text: cell.textContent,
    kind: cell.className.replace("number", "").trim(),
    href: cell.firstElementChild ? cell.firstElementChild.getAttribute("href") : "",
  }));
}

function writeRow(cells, numeric) {
  const row = document.createElement("tr");
  cells.forEach((cell, column) => {
    const box = row.insertCell();
    box.className = numeric[column] ? `${cell.kind} number` : cell.kind;
    box.dataset.value = cell.value;
    let place = box;
    if (cell.href) {
      place = document.createElement("a");
      place.href = cell.href;
      box.append(place);
    }
    place.textContent = cell.text;
  });
  return row;
}

// Words are looked for in all cells; lr<0.001 compares a column.
function filterOf(query, names) {
  const compare = { "<": (a, b) => a < b, "<=": (a, b) => a <= b, ">": (a, b) => a > b, ">=": (a, b) => a >= b, "=": (a, b) => a === b };
  const tests = query.toLowerCase().split(/\s+/).filter(Boolean).map((word) => {
    const [, name, sign, limit] = /^(.+?)(<=|>=|<|>|=)(.+)$/.exec(word) || [];
    const column = names.findIndex((known) => known.replace(/\s+/g, "_") === name);
    if (column < 0) return (cells) => cells.some((cell) => cell.text.toLowerCase().includes(word));
    if (isNaN(limit)) return (cells) => sign === "=" && cells[column].text.toLowerCase() === limit;
    return (cells) => cells[column].value !== "" && compare[sign](Number(cells[column].value), Number(limit));
  });
  return (cells) => tests.every((test) => test(cells));
}

function manage(table) {
  const headings = [...table.tHead.rows[0].cells];
  const names = headings.map((heading) => heading.textContent.trim().toLowerCase());
  const numeric = headings.map((heading) => heading.classList.contains("number"));
  const more = document.getElementById("more-trials");
  const rows = [...table.tBodies[0].rows].map(readRow);
  if (more) rows.push(...JSON.parse(more.textContent).map((row) => row.map(cellOf)));
  const view = { query: "", chosen: null, column: -1, rising: false, all: false };
  const trial = names.indexOf("trial");
  const count = document.createElement("span");
  const field = document.createElement("input");
  const button = document.createElement("button");

  function show() {
    const wanted = filterOf(view.query, names);
    const found = rows.filter((cells) => wanted(cells) && (view.chosen === null || view.chosen.has(cells[trial].value)));
    if (view.column >= 0) {
      found.sort((one, two) => {
        const a = one[view.column].value, b = two[view.column].value;
        if (a === "" || b === "") return notKnownLast(a, b);
        return view.rising ? byValue(a, b) : byValue(b, a);
      });
    }
    const shown = view.all ? found : found.slice(0, FIRST_ROWS);
    table.tBodies[0].replaceChildren(...shown.map((cells) => writeRow(cells, numeric)));
    const among = found.length < rows.length ? ` (${found.length.toLocaleString("en")} match)` : "";
    count.textContent = `${shown.length.toLocaleString("en")} of ${rows.length.toLocaleString("en")} trials${among}`;
    button.hidden = found.length <= FIRST_ROWS;
    button.textContent = view.all ? `Show the first ${FIRST_ROWS}` : `Show all ${found.length.toLocaleString("en")}`;
  }

  headings.forEach((heading, column) => {
    const press = document.createElement("button");
    press.type = "button";
    press.append(...heading.childNodes);
    heading.append(press);
    press.addEventListener("click", () => {
      view.rising = heading.getAttribute("aria-sort") !== "ascending";
      view.column = column;
      headings.forEach((other) => other.removeAttribute("aria-sort"));
      heading.setAttribute("aria-sort", view.rising ? "ascending" : "descending");
      show();
    });
  });
  field.type = "search";
  field.placeholder = "Filter: relu score>150";
  field.setAttribute("aria-label", "Filter trials");
  field.addEventListener("input", () => { view.query = field.value; show(); });
  // A range that is chosen in a chart keeps the table to its trials.
  document.addEventListener("trials-chosen", ({ detail }) => { view.chosen = detail; show(); });
  button.type = "button";
  button.addEventListener("click", () => { view.all = !view.all; show(); });
  document.getElementById("trial-controls").append(field, count, button);
  document.getElementById("sorting").textContent = "; press a heading to sort";
  const shown = document.getElementById("shown");
  if (shown) shown.remove();
  show();
}

document.querySelectorAll("table.sortable").forEach(manage);

// A link to an error opens it.
function openTarget() {
  const target = location.hash ? document.getElementById(location.hash.slice(1)) : null;
  if (target && target.tagName === "DETAILS") target.open = true;
}
addEventListener("hashchange", openTarget);
openTarget();

// In print all folds are open.
const opened = [];
addEventListener("beforeprint", () => {
  for (const fold of document.querySelectorAll("details:not([open])")) {
    fold.open = true;
    opened.push(fold);
  }
});
addEventListener("afterprint", () => {
  while (opened.length) opened.pop().open = false;
});

// Copy buttons, which only make sense with scripts.
async function copyText(text) {
  try {
    await navigator.clipboard.writeText(text);
  } catch {
    // A page that was opened as a file may not have the clipboard's interface.
    const area = document.createElement("textarea");
    area.value = text;
    document.body.append(area);
    area.select();
    document.execCommand("copy");
    area.remove();
  }
}

for (const block of document.querySelectorAll(".copyable")) {
  const button = document.createElement("button");
  button.type = "button";
  button.className = "copy";
  button.textContent = "Copy";
  button.addEventListener("click", async () => {
    await copyText(block.querySelector("pre").textContent);
    button.textContent = "Copied";
    setTimeout(() => { button.textContent = "Copy"; }, 1500);
  });
  block.append(button);
}
