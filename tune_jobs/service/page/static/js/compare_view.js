// Sweeps side by side: which is better, how each rose and learnt, and what their sweep files say differently.
import { ask } from "./api.js";
import { namesOf } from "./compare_choice.js";
import { refusal } from "./dialogs.js";
import { el, setText } from "./dom.js";
import { count, counted, returnText } from "./format.js";
import { LinesChart } from "./lines_chart.js";
import { repeat } from "./repeat.js";
import { sweepAddress } from "./route.js";

// One of each letter. Without the light blue, which on a dark page is too near to the blue.
const COLOURS = ["series-0", "series-1", "series-2", "series-3", "series-5", "ink"];
const LIVE_MS = 5_000;
const STILL_MS = 60_000;

export function openCompare(main, route) {
  let names = namesOf(route.params.sweeps);
  let shown = "";
  let found = null;
  let isClosed = false;
  const card = (label, kind) => el("section", { class: `card ${kind}`, "aria-label": label });
  const told = el("p", { class: "empty quiet", role: "status" }, "Loading…");
  const problem = el("div", { class: "notice bad", role: "alert", hidden: true });
  const cards = {
    verdicts: card("Which is better", "verdicts"),
    best: card("Best so far", "best-card"),
    curves: card("Learning curves", "curves"),
    facts: card("Side by side", "table-card"),
    differences: card("Sweep files", "table-card"),
    notes: card("To read the numbers", "notes"),
  };
  const grid = el("div", { class: "grid compare-grid", hidden: true }, ...Object.values(cards));
  const heading = el("h1", {}, "Compare");
  const back = el("a", { class: "button" }, "Choose others");
  main.append(el("div", { class: "title-row" }, heading, back), problem, told, grid);
  const open = (letter) => {
    const entry = found?.comparison.entries.find((item) => item.letter === letter);
    if (entry) location.hash = sweepAddress(entry.sweep);
  };
  const best = new LinesChart(cards.best, {
    title: "Best so far against what was spent",
    label: "Best so far",
    xLabel: "env steps spent by all trials of a sweep",
    onPick: open,
  });
  const curves = new LinesChart(cards.curves, {
    title: "How the leading settings learn",
    label: "Learning curves",
    xLabel: "env steps of a trial",
    onPick: open,
  });

  async function refresh() {
    const asked = names;
    try {
      const answer = await ask("comparisons", { query: { sweeps: asked.join(",") || "," } });
      if (isClosed || asked !== names) return;
      problem.hidden = true;
      show(answer);
    } catch (error) {
      if (isClosed || asked !== names) return;
      problem.hidden = false;
      problem.replaceChildren(...refusal(error));
      told.hidden = true;
      throw error;
    }
  }

  function show(answer) {
    told.hidden = true;
    grid.hidden = false;
    found = answer;
    // What stays keeps its focus and its scroll.
    const text = JSON.stringify(answer);
    if (text === shown) return;
    shown = text;
    const { entries, notes } = answer.comparison;
    setText(heading, `Compare ${entries.map((entry) => entry.name).join(", ")}`);
    showVerdicts(cards.verdicts, answer);
    showBest(best, answer);
    showCurves(curves, answer);
    // The headings name the sweeps.
    const facts = answer.facts.filter(({ title }) => title !== "sweep");
    showTable(cards.facts, "Side by side", entries, facts);
    const rows = answer.differences.map(({ path, texts }) => ({ title: path, cells: texts, isCode: true }));
    showTable(cards.differences, "What their sweep files say differently", entries, rows);
    if (!rows.length) cards.differences.append(el("p", { class: "quiet pad" }, "Nothing: they are the same."));
    cards.notes.hidden = notes.length === 0;
    cards.notes.replaceChildren(el("h2", {}, "To read the numbers"), ...notes.map(sentence));
  }

  function begin() {
    back.href = `#/?${new URLSearchParams({ compare: names.join(",") })}`;
    return repeat(refresh, () => (found !== null && isLive(found) ? LIVE_MS : STILL_MS));
  }
  let asking = begin();
  asking.now();
  return {
    follow(params) {
      const wanted = namesOf(params.sweeps);
      if (wanted.join() === names.join()) return;
      names = wanted;
      // Those of before are none of what the address says.
      grid.hidden = problem.hidden = true;
      told.hidden = false;
      asking.close();
      asking = begin();
      asking.now();
    },
    close() {
      isClosed = true;
      asking.close();
      best.close();
      curves.close();
    },
  };
}

const isLive = (answer) =>
  answer.facts.some(({ title, cells }) => title === "state" && cells.some((state) => state === "running"));

// Commands are in backticks, as on the terminal.
const withCode = (text) => text.split("`").map((part, index) => (index % 2 ? el("code", {}, part) : part));
const sentence = (text) => el("p", {}, withCode(text));

const look = (entries, letter) => COLOURS[entries.findIndex((entry) => entry.letter === letter) % COLOURS.length];

function showVerdicts(card, { verdicts }) {
  card.hidden = verdicts.length === 0;
  card.replaceChildren(
    el("h2", {}, "Which is better"),
    ...verdicts.map(({ verdict, lines }) => el("div", {}, el("h3", {}, withCode(verdict)), ...lines.map(sentence))),
  );
}

function showBest(chart, { comparison: { entries }, best_so_far: all, returns, goal }) {
  const lines = all.map((item, index) => {
    const { improvements, spent } = item;
    const xs = improvements.map((step) => step.spent);
    const ys = improvements.map((step) => step.value);
    return {
      key: entries[index].letter,
      name: `${entries[index].letter}: ${entries[index].name}`,
      colour: COLOURS[index % COLOURS.length],
      isStepped: true,
      x: xs.length ? [...xs, spent] : [],
      y: xs.length ? [...ys, ys.at(-1)] : [],
      more(x) {
        const step = improvements.findLast((known) => known.spent <= x);
        return step ? [`by ${step.trial_id}, at ${count(step.num_env_steps)} of its own env steps`] : [];
      },
    };
  });
  chart.show({
    lines,
    goal,
    caption: `The best ${returns} return that any trial of each sweep had shown, over the env steps that all its trials had trained for by then.`,
    none: "No return has been shown yet.",
  });
}

const seedsOf = ({ num_seeds: shown, num_without: without }) =>
  `${without ? `${count(shown)} of ` : ""}${counted(shown + without, "seed")}`;

function showCurves(chart, { comparison: { entries }, learning, returns, goal }) {
  const lines = learning.map((curve) => {
    const entry = entries.find((known) => known.letter === curve.letter);
    const range = curve.lower ? ", 95 % interval of the mean" : "";
    return {
      key: entry.letter,
      name: `${entry.letter}: ${entry.name}`,
      colour: look(entries, entry.letter),
      x: curve.num_env_steps,
      y: curve.mean,
      low: curve.lower,
      high: curve.upper,
      more: () => [`${seedsOf(curve)}${range}`],
    };
  });
  const missing = entries.filter((entry) => !learning.some((curve) => curve.letter === entry.letter));
  const without = missing.map((entry) => `${entry.letter} has none: ${entry.why_none || "no such returns"}.`).join(" ");
  const short = learning.filter((curve) => curve.num_without);
  const fewer = short.map((curve) => `${curve.letter} is of ${seedsOf(curve)}.`).join(" ");
  const what = returns === "evaluation" ? "greedy evaluation" : "training return";
  chart.show({
    lines,
    goal,
    caption: [
      `Mean ${what} of each one's leading setting over its training seeds; a seed that ended early is held at its last`,
      "value, and one that failed before it showed any is left out. Bands are 95 % intervals.",
      fewer,
      without,
    ]
      .filter(Boolean)
      .join(" "),
    none: "No setting has been judged yet.",
  });
}

// A table with a column a sweep; it scrolls by itself where there is no room.
function showTable(card, title, entries, rows) {
  const heads = entries.map((entry) =>
    el(
      "th",
      { scope: "col" },
      el("i", { class: `mark ${look(entries, entry.letter)}` }),
      `${entry.letter}: `,
      el("a", { href: sweepAddress(entry.sweep) }, entry.name),
    ),
  );
  const row = ({ title: name, cells, isCode }) =>
    el(
      "tr",
      {},
      el("th", { scope: "row", class: isCode ? "mono" : null }, name),
      ...cells.map((cell) => el("td", { class: isCode ? "mono" : null }, cell)),
    );
  const known = card.querySelector(".sideways");
  // What scrolls is reached by the Tab key.
  const options = { class: "sideways", tabindex: 0, role: "region", "aria-label": `${title}: table` };
  const scroller = known ?? el("div", options);
  const table = el(
    "table",
    { class: "compared" },
    el("thead", {}, el("tr", {}, el("td", {}), heads)),
    el("tbody", {}, rows.map(row)),
  );
  table.style.setProperty("--sweeps", entries.length);
  scroller.replaceChildren(table);
  scroller.hidden = rows.length === 0;
  if (known) {
    while (known.nextElementSibling) known.nextElementSibling.remove();
  } else card.replaceChildren(el("div", { class: "card-head pad" }, el("h2", {}, title)), scroller);
}
