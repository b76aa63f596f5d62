// All sweeps: what runs, waits and ended; it keeps itself up to date.
import { askAll } from "./api.js";
import { CompareChoice, makeBox, namesOf } from "./compare_choice.js";
import { notYet } from "./dialogs.js";
import { el, reconcile, setAttribute, setText } from "./dom.js";
import { ago, count, counted, duration, moment, percent, pointText, returnText, timeLeft } from "./format.js";
import { follow } from "./follow.js";
import { keep, sweepAddress } from "./route.js";
import { stateOf, stateReason } from "./states.js";
import { maySubmit } from "./who.js";

const FIRST_ROWS = 100;
const GROUPS = [
  ["", "All"],
  ["running", "Running"],
  ["waiting", "Waiting"],
  ["ended", "Ended"],
];
const COLUMNS = [
  { key: "name", label: "Sweep", value: (sweep) => sweep.name },
  { key: "state", label: "State", value: (sweep) => stateOf(sweep).word },
  { key: "num_env_steps", label: "Progress", value: (sweep) => sweep.num_env_steps },
  { key: "best", label: "Best so far", value: (sweep) => sweep.best?.score ?? null, number: true },
  { key: "trials", label: "Trials", value: (sweep) => sweep.num_trials, number: true },
  { key: "owner", label: "Owner", value: (sweep) => sweep.owner },
  { key: "created_at", label: "Created", value: (sweep) => sweep.created_at, falls: true },
];

export function openSweeps(main, route) {
  const seen = { search: "", state: "", sort: "created_at", order: "desc", ...route.params };
  let sweeps = null;
  let isAll = false;

  const search = el("input", {
    type: "search",
    "aria-label": "Search sweeps",
    placeholder: "Search name, env, owner, tag or note",
    value: seen.search,
  });
  const groups = el(
    "div",
    { class: "segments", role: "group", "aria-label": "Filter by state" },
    GROUPS.map(([key, label]) =>
      el(
        "button",
        { type: "button", dataset: { group: key }, onclick: () => change({ state: key }) },
        el("span", {}, label),
        " ",
        el("span", { class: "tally" }),
      ),
    ),
  );
  const heads = COLUMNS.map((column) =>
    el(
      "th",
      { scope: "col", class: column.number ? "number" : null, dataset: { column: column.key } },
      el("button", { type: "button", onclick: () => sortBy(column) }, column.label),
    ),
  );
  const body = el("tbody");
  const table = el(
    "table",
    { class: "sweeps", role: "table" },
    el("caption", { class: "for-readers" }, "Sweeps"),
    el("thead", {}, el("tr", {}, heads)),
    body,
  );
  const empty = el("div", { class: "empty", hidden: true });
  const more = el("button", {
    type: "button",
    class: "more",
    hidden: true,
    onclick: () => {
      isAll = true;
      show();
    },
  });
  const told = el("p", { class: "quiet small", role: "status" }, "Loading…");
  const card = el("div", { class: "card table-card", hidden: true }, table, empty);
  const problem = el("div", { role: "alert" });
  main.append(
    el(
      "div",
      { class: "title-row" },
      el("h1", {}, "Sweeps"),
      maySubmit() ? el("a", { class: "button primary", href: "#/new" }, "New sweep") : null,
    ),
    el("div", { class: "controls" }, groups, search, told),
    problem,
    card,
    more,
  );
  const choice = new CompareChoice({ place: main, body, names: namesOf(seen.compare), onChange: show });
  search.addEventListener("input", () => change({ search: search.value }));

  function change(changes) {
    Object.assign(seen, changes);
    keep({
      search: seen.search,
      state: seen.state,
      sort: seen.sort === "created_at" ? "" : seen.sort,
      order: seen.order === "desc" ? "" : seen.order,
    });
    show();
  }

  function sortBy(column) {
    const first = column.number || column.falls ? "desc" : "asc";
    const order = seen.sort === column.key ? (seen.order === "asc" ? "desc" : "asc") : first;
    change({ sort: column.key, order });
  }

  function isFound(sweep) {
    const text =
      `${sweep.name} ${sweep.env} ${sweep.algorithm} ${sweep.owner ?? ""} ${sweep.note} ${sweep.tags.join(" ")}`.toLowerCase();
    return seen.search
      .toLowerCase()
      .split(/\s+/)
      .every((word) => text.includes(word));
  }

  function show() {
    if (sweeps !== null) choice.show(new Map(sweeps.map((sweep) => [sweep.name, sweep])));
    for (const button of groups.children)
      setAttribute(button, "aria-pressed", String(button.dataset.group === seen.state));
    for (const head of heads) {
      const order = seen.order === "asc" ? "ascending" : "descending";
      setAttribute(head, "aria-sort", head.dataset.column === seen.sort ? order : null);
    }
    if (sweeps === null) return;
    card.hidden = false;
    const matching = sweeps.filter(isFound);
    for (const button of groups.children) {
      const group = button.dataset.group;
      setText(
        button.lastElementChild,
        count(matching.filter((sweep) => !group || stateOf(sweep).group === group).length),
      );
    }
    const found = sorted(
      matching.filter((sweep) => !seen.state || stateOf(sweep).group === seen.state),
      seen,
    );
    const shown = isAll ? found : found.slice(0, FIRST_ROWS);
    const update = (row, sweep) => {
      updateRow(row, sweep);
      choice.updateBox(row.querySelector(".to-compare"), sweep.name);
    };
    reconcile(body, shown, (sweep) => sweep.name, makeRow, update);
    more.hidden = shown.length === found.length;
    setText(more, `Show all ${counted(found.length, "sweep")}`);
    setText(told, found.length === sweeps.length ? "" : `${count(found.length)} of ${counted(sweeps.length, "sweep")}`);
    table.hidden = found.length === 0;
    empty.hidden = found.length > 0;
    if (!found.length) showEmpty(empty, sweeps.length);
  }

  const known = new Map();
  // The names that events came for since the list was last asked for: what it says of them may be older.
  let touched = new Set();
  async function fetchAll() {
    touched = new Set();
    const own = touched;
    const found = await askAll("sweeps", "sweeps");
    // A later one is on its way, or was here first.
    if (own !== touched) return;
    for (const name of known.keys()) if (!own.has(name)) known.delete(name);
    for (const sweep of found) if (!own.has(sweep.name)) known.set(sweep.name, sweep);
  }
  const followed = follow({
    kinds: ["sweeps", "deleted"],
    async load() {
      await fetchAll();
      return "events";
    },
    opened: fetchAll,
    apply(kind, data) {
      for (const name of data.names ?? data.sweeps.map((sweep) => sweep.name)) touched.add(name);
      if (kind === "sweeps") for (const sweep of data.sweeps) known.set(sweep.name, sweep);
      else for (const name of data.names) known.delete(name);
    },
    show(error) {
      if (error === null) sweeps = [...known.values()];
      else setText(told, sweeps === null ? "" : "as it was");
      problem.replaceChildren(...(error === null ? [] : [notYet(error)]));
      show();
    },
  });
  show();
  return {
    close: followed.close,
    follow(params) {
      Object.assign(seen, { search: "", state: "", sort: "created_at", order: "desc" }, params);
      search.value = seen.search;
      choice.names = namesOf(params.compare);
      show();
    },
  };
}

function sorted(sweeps, { sort, order }) {
  const column = COLUMNS.find(({ key }) => key === sort) ?? COLUMNS.at(-1);
  const sign = order === "asc" ? 1 : -1;
  return sweeps.slice().sort((one, two) => {
    const a = column.value(one);
    const b = column.value(two);
    if (a === null || b === null) return (a === null) - (b === null);
    return (
      sign * (typeof a === "string" ? a.localeCompare(b, "en", { numeric: true }) : a - b) ||
      one.name.localeCompare(two.name)
    );
  });
}

function showEmpty(box, numAll) {
  box.replaceChildren(
    numAll
      ? el("p", {}, "No sweep matches.")
      : el(
          "div",
          {},
          el("p", { class: "strong" }, "No sweeps yet."),
          el(
            "p",
            { class: "quiet" },
            maySubmit()
              ? "Start from a preset: New sweep has them. Sweeps launched from a terminal into the same storage folder show up here too."
              : "Once somebody submits one, it shows up here.",
          ),
        ),
  );
}

function makeRow(sweep) {
  const cell = (name, ...children) => el("td", { role: "cell", class: name }, ...children);
  return el(
    "tr",
    { role: "row" },
    el(
      "th",
      { scope: "row", role: "rowheader", class: "name" },
      el("a", { href: sweepAddress(sweep.name) }, sweep.name),
      el("span", { class: "under" }),
      el("span", { class: "tags" }),
      makeBox(sweep.name),
    ),
    cell("c-state", el("span", { class: "state" }), el("span", { class: "under" })),
    cell(
      "c-progress",
      el("div", { class: "progress", role: "progressbar", "aria-valuemin": 0, "aria-valuemax": 100 }, el("i")),
      el("span", { class: "under" }),
    ),
    cell("best number", el("b"), el("span", { class: "under" })),
    cell("trials number", el("span"), el("span", { class: "under bad-text" })),
    cell("owner"),
    cell("created", el("time")),
  );
}

function updateRow(row, sweep) {
  const [name, state, progress, best, trials, owner, created] = row.children;
  setText(name.children[1], `${sweep.env} · ${sweep.algorithm}`);
  reconcile(
    name.children[2],
    sweep.tags,
    (tag) => tag,
    (tag) => el("span", { class: "tag" }, tag),
    () => {},
  );
  const { word, tone } = stateOf(sweep);
  setAttribute(state.firstElementChild, "class", `state ${tone}`);
  setText(state.firstElementChild, word);
  setText(
    state.lastElementChild,
    word === "running" && sweep.time_left_s !== null
      ? `${timeLeft(sweep.time_left_s)} left`
      : word === "failed"
        ? stateReason(sweep)
        : sweep.waiting
          ? "for nodes"
          : "",
  );
  setAttribute(state.lastElementChild, "title", (sweep.waiting ? stateReason(sweep) : state.lastElementChild.textContent) || null);
  const share = percent(sweep.num_env_steps, sweep.max_env_steps ?? 0);
  const bar = progress.firstElementChild;
  bar.firstElementChild.style.width = `${share}%`;
  bar.classList.toggle("ended", tone !== "live");
  setAttribute(bar, "aria-valuenow", share);
  setAttribute(bar, "aria-label", `Progress of ${sweep.name}`);
  setText(
    progress.lastElementChild,
    sweep.max_env_steps
      ? `${share} % of ${count(sweep.max_env_steps)} env steps`
      : `${count(sweep.num_env_steps)} env steps`,
  );
  setText(best.firstElementChild, returnText(sweep.best?.score));
  const point = sweep.best ? pointText(sweep.best.point) : "";
  setText(best.lastElementChild, point);
  setAttribute(best.lastElementChild, "title", point || null);
  const failed = sweep.counts.failed ?? 0;
  const ended = failed + (sweep.counts.completed ?? 0) + (sweep.counts.stopped ?? 0);
  setText(
    trials.firstElementChild,
    ended === sweep.num_trials ? count(ended) : `${count(ended)} / ${count(sweep.num_trials)}`,
  );
  setText(trials.lastElementChild, failed ? `${count(failed)} failed` : "");
  setText(owner, sweep.owner ?? "");
  const time = created.firstElementChild;
  setText(time, ago(sweep.created_at));
  setAttribute(
    time,
    "title",
    moment(sweep.created_at) + (sweep.run_time_s ? `; ran for ${duration(sweep.run_time_s)}` : ""),
  );
}
