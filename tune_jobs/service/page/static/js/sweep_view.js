// One sweep, live. What is looked at is in the address: sort, filter, ranges, the chosen trials and the opened one.
import { makeActions } from "./actions.js";
import { BestChart } from "./best_chart.js";
import { COLOURS, CurvesChart } from "./curves_chart.js";
import { makeAlert, notYet, refusal } from "./dialogs.js";
import { colour, el, isTyping, setAttribute } from "./dom.js";
import { filterOf } from "./filter.js";
import { Finished } from "./finished.js";
import { FrontCard } from "./front_card.js";
import { ImportanceCard } from "./importance.js";
import { Parallel } from "./parallel.js";
import { keep } from "./route.js";
import { ServerSource } from "./server_source.js";
import { SweepData } from "./sweep_data.js";
import { SweepHead } from "./sweep_head.js";
import { Timeline } from "./timeline.js";
import { columnsOf, sortRows } from "./trial_columns.js";
import { TrialPanel } from "./trial_panel.js";
import { TrialTable } from "./trial_table.js";

const RANGE = "in.";
const NO_ACTIONS = { node: null, show() {}, close() {} };

function seenOf(params) {
  const ranges = Object.entries(params)
    .filter(([key]) => key.startsWith(RANGE))
    .map(([key, text]) => [key.slice(RANGE.length), text]);
  return {
    sort: params.sort ?? "score",
    isRising: params.order === "asc",
    filter: params.filter ?? "",
    metric: params.metric === "evaluation" ? "evaluation" : "training",
    chosen: (params.chosen ?? "").split(",").filter(Boolean),
    trial: params.trial ?? null,
    ranges: Object.fromEntries(ranges),
  };
}

// `source` is where the sweep comes from: a ServerSource, or a FileSource, which can only be looked at.
export function openSweep(main, route, source = new ServerSource(route.name)) {
  const data = new SweepData(source);
  let seen = seenOf(route.params);
  let columns = [];
  let columnKey = "";
  let shown = [];
  let isClosed = false;
  let frame = 0;
  let isGone = false;
  let madeAt = null;

  const alert = makeAlert();
  const actions = source.isFile
    ? NO_ACTIONS
    : makeActions({
        state: () => data.summary,
        data,
        alert,
        onDone: refreshHead,
        onGone: () => {
          location.hash = "#/";
        },
      });
  const page = el("div", { class: "sweep-page", hidden: true });
  const loading = el("div", { class: "empty quiet", role: "status" }, "Loading…");
  const content = el("div", { class: "sweep-content" });
  page.append(content);
  main.append(loading, page);
  const open = (id) => {
    if (id) change({ trial: id });
  };
  const head = new SweepHead(content, { source, actions, alert, onOpen: open });
  const card = (label, kind) => el("section", { class: `card ${kind}`, "aria-label": label });
  const cards = {
    finished: card("Result", "finished"),
    curves: card("Learning curves", "curves"),
    best: card("Best so far", "best-card"),
    front: card("Score against cost", "front"),
    parallel: card("Values and scores", "values"),
    importance: card("Importance", "importance"),
    timeline: card("Timeline", "timeline"),
    table: card("Trials", "table-card trials-card"),
  };
  content.append(el("div", { class: "grid" }, ...Object.values(cards)));
  const finished = new Finished(cards.finished, source, { onOpen: open });
  const curves = new CurvesChart(cards.curves, { onOpen: open, onMetric: (metric) => change({ metric }) });
  const best = new BestChart(cards.best, { onOpen: open });
  const front = new FrontCard(cards.front, source, { onOpen: open });
  const parallel = new Parallel(cards.parallel, { onRange: setRange, onOpen: open });
  const importance = new ImportanceCard(cards.importance, source);
  const timeline = new Timeline(cards.timeline, { isOpen: route.params.timeline === "open", onOpen: open });
  const filter = el("input", {
    type: "search",
    "aria-label": "Filter trials",
    placeholder: "Filter: relu score>150 status=failed",
    value: seen.filter,
  });
  const clear = el("button", { type: "button", hidden: true, onclick: () => change({ chosen: [] }) });
  const bar = el("div", { class: "card-head" }, el("h2", {}, "Trials"), filter, clear);
  cards.table.append(bar);
  const table = new TrialTable(cards.table, {
    onSort: (key) =>
      change({
        sort: key,
        isRising: seen.sort === key ? !seen.isRising : !columns.find((column) => column.key === key)?.isNumber,
      }),
    onOpen: open,
    onChoose: choose,
    onHover: (id) => parallel.highlight(id),
  });
  bar.append(table.told);
  const panel = new TrialPanel(page, {
    source,
    onClose: () => {
      const id = seen.trial;
      change({ trial: null });
      // The focus goes back to where it came from.
      table.focus(shown.findIndex((row) => row.trial_id === id));
    },
    onStep: (by) => {
      const place = shown.findIndex((row) => row.trial_id === seen.trial) + by;
      if (shown[place]) change({ trial: shown[place].trial_id });
    },
  });
  filter.addEventListener("input", () => change({ filter: filter.value }));
  const shortcut = (event) => {
    if (event.key !== "/" || isTyping(event.target) || event.ctrlKey || event.metaKey) return;
    event.preventDefault();
    filter.focus();
  };
  addEventListener("keydown", shortcut);

  function change(changes) {
    Object.assign(seen, changes);
    const ranges = Object.fromEntries(
      Object.keys(route.params)
        .filter((key) => key.startsWith(RANGE))
        .map((key) => [key, null]),
    );
    for (const [name, text] of Object.entries(seen.ranges)) ranges[RANGE + name] = text;
    keep({
      sort: seen.sort === "score" ? null : seen.sort,
      order: seen.isRising ? "asc" : null,
      filter: seen.filter,
      metric: seen.metric === "training" ? null : seen.metric,
      chosen: seen.chosen.join(","),
      trial: seen.trial,
      ...ranges,
    });
    Object.assign(route.params, ranges);
    show();
  }

  function setRange(name, text) {
    const { [name]: _, ...others } = seen.ranges;
    change({ ranges: text === null ? others : { ...others, [name]: text } });
  }

  function choose(id) {
    change({ chosen: seen.chosen.includes(id) ? seen.chosen.filter((known) => known !== id) : [...seen.chosen, id] });
  }

  function matchingTrials() {
    const tests = Object.entries(seen.ranges).flatMap(([name, text]) => {
      const axis = data.axes.find((known) => known.name === name);
      if (!axis) return [];
      const test = axis.test(text);
      return [(trial) => axis.place(axis.valueOf(trial)) !== undefined && test(axis.valueOf(trial))];
    });
    const wanted = filterOf(seen.filter, columns);
    return data.trials.filter((trial) => wanted(trial) && tests.every((test) => test(trial)));
  }

  function show() {
    if (data.summary === null) return;
    const searched = data.searched;
    const key = JSON.stringify([searched, data.hasSeveralSeeds]);
    if (key !== columnKey) {
      columnKey = key;
      columns = columnsOf(searched, data.hasSeveralSeeds);
    }
    const matching = matchingTrials();
    const column = columns.find((known) => known.key === seen.sort) ?? columns.find((known) => known.key === "score");
    shown = sortRows(matching, column, seen.isRising);
    const chosen = new Map(seen.chosen.map((id, index) => [id, colour(COLOURS[index % COLOURS.length])]));
    clear.hidden = seen.chosen.length === 0;
    clear.textContent = `Clear ${seen.chosen.length} chosen`;
    table.show({
      rows: shown,
      numAll: data.trials.length,
      columns,
      sort: column.key,
      isRising: seen.isRising,
      chosen,
      opened: seen.trial,
    });
    // The table answers at once, the charts with the next frame.
    cancelAnimationFrame(frame);
    frame = requestAnimationFrame(() => showCharts(matching, chosen));
    if (seen.trial === null) panel.hide();
    else panel.open(seen.trial);
    page.classList.toggle("with-panel", seen.trial !== null);
  }

  function showCharts(matching, chosen) {
    if (isClosed) return;
    const named = new Map(seen.chosen.map((id, index) => [id, COLOURS[index % COLOURS.length]]));
    curves.show({ data, matching, chosen: named, metric: seen.metric });
    best.show({ data });
    timeline.show({ data, matching });
    parallel.show({ data, matching: new Set(matching.map((trial) => trial.trial_id)), ranges: seen.ranges, chosen });
  }

  // The events tell it too, a moment later.
  async function refreshHead() {
    try {
      data.summary = await source.summary();
      showHead();
    } catch (error) {
      alert.show(error);
    }
  }

  function showHead() {
    head.show(data.summary);
    actions.show();
  }

  const followed = source.follow({
    kinds: ["status", "trials", "iterations", "deleted"],
    load,
    apply(kind, changes) {
      if (kind !== "deleted") return data.apply(kind, changes);
      isGone = true;
      return alert.show({ message: `Sweep ${source.name} was deleted.`, hint: "What is shown is how it was." });
    },
    show(error) {
      if (error === null) return showAll();
      const isMissing = error.status === 404;
      isGone ||= isMissing;
      if (page.hidden) {
        const back = el("p", {}, el("a", { href: "#/" }, "To all sweeps"));
        setAttribute(loading, "class", isMissing ? "empty quiet" : null);
        loading.replaceChildren(...(isMissing ? [...refusal(error), back] : [el("h1", {}, source.name), notYet(error)]));
      } else if (isMissing) alert.show(error);
      return undefined;
    },
  });

  async function load() {
    const curves = await data.load(() => showAll());
    // It is there again, or another one of its name is.
    if (isGone) alert.hide();
    isGone = false;
    return curves;
  }

  async function showAll() {
    if (madeAt !== null && data.specOf !== madeAt) for (const card of [importance, front]) card.forget();
    madeAt = data.specOf;
    // What a finished sweep came to stands above the rest, which would jump if it came later.
    const told = finished.follow(data.summary);
    if (page.hidden) await told;
    if (isClosed) return;
    loading.hidden = true;
    page.hidden = false;
    cards.importance.hidden = data.searched.length === 0;
    showHead();
    show();
    importance.follow(data.summary);
    front.follow(data);
  }

  return {
    follow(params) {
      seen = seenOf(params);
      route.params = { ...params };
      filter.value = seen.filter;
      timeline.setOpen(params.timeline === "open");
      show();
    },
    close() {
      isClosed = true;
      followed.close();
      removeEventListener("keydown", shortcut);
      for (const part of [actions, finished, curves, best, front, parallel, importance, timeline, table, panel]) part.close();
    },
  };
}
