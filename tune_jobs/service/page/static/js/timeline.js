// Which trial ran when, and where: bars on a canvas, as many as there are trials.
import { colour, el, setAttribute, setText } from "./dom.js";
import { count, counted, duration, moment, returnText } from "./format.js";
import { Plot } from "./plot.js";
import { keep } from "./route.js";
import { layOut } from "./timeline_layout.js";

const COLOURS = { completed: "series-2", stopped: "series-1", failed: "accent", running: "series-4" };
const LEGEND = ["running", "completed", "stopped", "failed", "paused"];
const DAY_S = 86_400;
const DAYS = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000];
const WITHIN_A_DAY = [0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 28800];
// The distances of ticks: where none of them is wide enough, there is no axis.
const INCREMENTS = [...WITHIN_A_DAY, ...DAYS.map((days) => days * DAY_S)];
const MOST_PX = 440;
const FIXED_PX = 70;
const ROW_PX = 18;
const NEAR_PX = 6;
const clock = new Intl.DateTimeFormat("en-GB", { hour: "2-digit", minute: "2-digit", second: "2-digit" });

export class Timeline {
  // `onOpen(trialId)` is called for the trial that the reader wants to see.
  constructor(host, { isOpen, onOpen }) {
    this.onOpen = onOpen;
    this.plot = null;
    this.of = null;
    this.chosen = null;
    this.found = layOut([]);
    this.matching = null;
    this.caption = el("p", { class: "quiet small" });
    this.none = el("p", { class: "missing quiet" });
    this.keys = el(
      "ul",
      { class: "keys" },
      LEGEND.map((status) => el("li", {}, el("i", { class: `mark ${status}` }), el("span", {}))),
    );
    this.room = el("div", { class: "plot-room" });
    // Its value is read out as the arrow keys change it.
    this.walker = el("div", {
      class: "walker",
      role: "slider",
      tabindex: 0,
      "aria-label": "Trial, by when it began",
      "aria-valuemin": 1,
      onkeydown: (event) => this.pressed(event),
      onfocus: () => this.choose(this.chosen ?? this.found.bars.at(0)),
      onblur: () => this.choose(null),
    });
    this.details = el(
      "details",
      { open: isOpen },
      el("summary", {}, el("h2", {}, "Timeline"), el("span", { class: "quiet small" }, "Which trial ran when, where")),
      this.caption,
      this.room,
      this.none,
      this.keys,
    );
    this.details.addEventListener("toggle", () => {
      keep({ timeline: this.details.open ? "open" : null });
      this.draw();
    });
    host.append(this.details);
  }

  setOpen(isOpen) {
    this.details.open = isOpen;
  }

  // `matching` are the trials that filter and ranges let through.
  show({ data, matching }) {
    this.data = data;
    this.matching = matching.length === data.trials.length ? null : new Set(matching.map((trial) => trial.trial_id));
    this.draw();
  }

  draw() {
    // Nobody sees it: ten thousand trials take a while to lay out.
    if (!this.details.open || !this.data) return;
    if (this.of !== this.data.trials) {
      this.of = this.data.trials;
      this.found = layOut(this.of);
      const id = this.chosen?.trial.trial_id;
      this.chosen = id ? (this.found.bars.find((bar) => bar.trial.trial_id === id) ?? null) : null;
      this.byRow = Array.from({ length: this.found.numRows }, () => []);
      for (const bar of this.found.bars) this.byRow[bar.row].push(bar);
      this.tell();
    }
    const { bars, numRows, lasted } = this.found;
    this.room.hidden = this.keys.hidden = bars.length === 0;
    if (!bars.length) return;
    this.plot ??= this.makePlot();
    this.plot.host.parentElement.style.minHeight = `${Math.min(MOST_PX, FIXED_PX + ROW_PX * numRows)}px`;
    // With room for the last label.
    this.plot.setRange({ x: [0, 1.02 * lasted || 1], y: [0, numRows] });
  }

  makePlot() {
    const plot = new Plot(this.room, {
      label: "Timeline",
      xLabel: "since the first trial began",
      height: FIXED_PX + ROW_PX,
      paint: (context, places) => this.paint(context, places),
      find: (places, left, top) => this.find(places, left, top),
      onPick: this.onOpen,
      axes: [
        { incrs: INCREMENTS, values: (_, values) => values.map(shortTime) },
        {
          size: 96,
          grid: { show: false },
          // From the lowest up.
          splits: () => this.found.nodes.map((node) => this.found.numRows - node.first - 0.5).reverse(),
          values: () => this.found.nodes.map((node) => shortName(node.name)).reverse(),
        },
      ],
    });
    plot.u.over.addEventListener("pointermove", () => {
      this.chosen = null;
    });
    plot.host.parentElement.append(this.walker);
    return plot;
  }

  tell() {
    const { bars, nodes, first, cuts, paused, numWithout } = this.found;
    const begun = this.of.some((trial) => trial.status !== "pending");
    setText(this.none, bars.length ? "" : begun ? "The records hold no times of trials." : "No trial has begun.");
    const sentences = [
      `Each bar is a trial, from its first start to its last end; the first began ${moment(first)}.`,
      "A row is one of the places that a node's trials had side by side; a process keeps its own.",
      cuts.length ? `${counted(cuts.length, "pause")} left out: ${duration(paused)} in which no trial ran.` : "",
      numWithout ? `${counted(numWithout, "trial")} without times left out.` : "",
    ];
    setText(this.caption, bars.length ? sentences.filter(Boolean).join(" ") : "");
    const counts = new Map();
    for (const { trial } of bars) counts.set(trial.status, (counts.get(trial.status) ?? 0) + 1);
    LEGEND.forEach((status, index) => {
      const item = this.keys.children[index];
      item.hidden = !counts.has(status);
      setText(item.lastElementChild, `${count(counts.get(status) ?? 0)} ${status}`);
    });
    setAttribute(this.walker, "aria-valuemax", Math.max(1, bars.length));
    setAttribute(this.walker, "aria-valuenow", Math.max(1, bars.indexOf(this.chosen) + 1));
    if (!this.walker.hasAttribute("aria-valuetext")) setAttribute(this.walker, "aria-valuetext", "none chosen");
    this.plot?.describe(`Timeline of ${counted(bars.length, "trial")} on ${counted(nodes.length, "node")}.`);
  }

  // The edges of a bar on the canvas; what is too thin to be seen is a pixel wide.
  edges(bar, places) {
    const height = places.height / (this.found.numRows || 1);
    const left = places.x(bar.from);
    const isRoomy = places.x(bar.to) - left > 4 * places.ratio;
    const gap = height > 8 * places.ratio ? 2 * places.ratio : 0;
    return {
      left,
      width: Math.max(places.ratio, places.x(bar.to) - left - (isRoomy ? places.ratio : 0)),
      top: places.y(this.found.numRows - bar.row) + gap / 2,
      height: Math.max(places.ratio, height - gap),
    };
  }

  paint(context, places) {
    const { bars, blocks, cuts, nodes, numRows } = this.found;
    const all = places.height / (numRows || 1);
    context.fillStyle = colour("chip");
    for (const block of blocks)
      context.fillRect(
        places.x(block.from),
        places.y(numRows - block.row),
        places.x(block.to) - places.x(block.from),
        all * block.size,
      );
    const inks = new Map(Object.entries(COLOURS).map(([status, name]) => [status, colour(name)]));
    const muted = colour("muted");
    const right = places.left + places.width;
    for (const bar of bars) {
      const { left, width, top, height } = this.edges(bar, places);
      if (left + width < places.left || left > right) continue;
      context.globalAlpha = this.matching === null || this.matching.has(bar.trial.trial_id) ? 1 : 0.2;
      context.fillStyle = inks.get(bar.trial.status) ?? muted;
      context.fillRect(left, top, width, height);
    }
    context.globalAlpha = 1;
    context.strokeStyle = muted;
    context.lineWidth = places.ratio;
    context.beginPath();
    for (const node of nodes.slice(1)) {
      context.moveTo(places.left, places.y(numRows - node.first));
      context.lineTo(right, places.y(numRows - node.first));
    }
    context.stroke();
    context.setLineDash([3 * places.ratio, 3 * places.ratio]);
    context.beginPath();
    for (const cut of cuts) {
      context.moveTo(places.x(cut), places.top);
      context.lineTo(places.x(cut), places.top + places.height);
    }
    context.stroke();
    context.setLineDash([]);
    const id = this.plot?.found?.id;
    const near = id ? bars.find((bar) => bar.trial.trial_id === id) : null;
    if (!near) return;
    const { left, width, top, height } = this.edges(near, places);
    context.strokeStyle = colour("ink");
    context.lineWidth = 2 * places.ratio;
    context.strokeRect(left - places.ratio, top, width + 2 * places.ratio, height);
  }

  find(places, left, top) {
    const bar = this.chosen ?? this.barAt(places, left, top);
    return bar ? { id: bar.trial.trial_id, key: bar.trial.trial_id, lines: linesOf(bar) } : null;
  }

  barAt(places, left, top) {
    const row = Math.floor(((top - places.top) / places.height) * this.found.numRows);
    const bars = this.byRow?.[row] ?? [];
    const at = places.min + ((left - places.left) / places.width) * (places.max - places.min);
    // Those of one row come one after the other.
    let low = 0;
    let high = bars.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (bars[middle].from <= at) low = middle + 1;
      else high = middle;
    }
    const near = (NEAR_PX * places.ratio * (places.max - places.min)) / places.width;
    const distance = (bar) => Math.max(0, bar.from - at, at - bar.to);
    const nearest = [bars[low - 1], bars[low]].filter(Boolean).sort((a, b) => distance(a) - distance(b))[0];
    return nearest && distance(nearest) <= near ? nearest : null;
  }

  // Show a trial as if the cursor were on it; null: none.
  choose(bar) {
    this.chosen = bar ?? null;
    if (!this.plot) return;
    if (!bar) {
      this.plot.moved(null);
      return;
    }
    setAttribute(this.walker, "aria-valuenow", this.found.bars.indexOf(bar) + 1);
    setAttribute(this.walker, "aria-valuetext", linesOf(bar).join(", "));
    const { u } = this.plot;
    if (bar.to < u.scales.x.min || bar.from > u.scales.x.max) this.plot.unzoom();
    const places = this.plot.places(u);
    const edges = this.edges(bar, places);
    const inSight = Math.min(Math.max(edges.left + edges.width / 2, places.left), places.left + places.width);
    u.setCursor({
      left: (inSight - places.left) / places.ratio,
      top: (edges.top + edges.height / 2 - places.top) / places.ratio,
    });
  }

  pressed(event) {
    if (event.altKey || event.ctrlKey || event.metaKey) return;
    const { bars } = this.found;
    const place = bars.indexOf(this.chosen);
    const steps = {
      ArrowRight: () => bars[Math.min(bars.length - 1, place + 1)],
      ArrowLeft: () => bars[Math.max(0, place - 1)],
      ArrowDown: () => this.beside(1),
      ArrowUp: () => this.beside(-1),
      PageDown: () => bars[Math.min(bars.length - 1, place + 10)],
      PageUp: () => bars[Math.max(0, place - 10)],
      Home: () => bars[0],
      End: () => bars.at(-1),
    };
    if (event.key in steps) this.choose(steps[event.key]());
    else if (event.key === "Enter" && this.chosen) this.onOpen(this.chosen.trial.trial_id);
    else return;
    event.preventDefault();
  }

  // The trial of a neighbouring row that is nearest in time.
  beside(by) {
    if (!this.chosen) return this.found.bars[0];
    const middle = (this.chosen.from + this.chosen.to) / 2;
    const distance = (bar) => Math.max(0, bar.from - middle, middle - bar.to);
    const others = this.byRow[this.chosen.row + by] ?? [];
    return others.reduce((best, bar) => (distance(bar) < distance(best) ? bar : best), others[0] ?? this.chosen);
  }

  close() {
    this.plot?.close();
  }
}

function linesOf({ trial, start, end }) {
  const process = Number.isInteger(trial.pid) ? `, process ${trial.pid}` : "";
  const lines = [
    `${trial.trial_id}, ${trial.status}`,
    `${timeText(start)} to ${trial.ended_at === null ? "now" : timeText(end)}, ${duration(end - start)}`,
    `${count(trial.num_env_steps)} env steps`,
  ];
  if (trial.score !== null && trial.score !== undefined) lines.push(`score ${returnText(trial.score)}`);
  return [...lines, `${trial.node ?? "node not known"}${process}`];
}

const timeText = (unixTime) => clock.format(new Date(unixTime * 1000));

// Such as "30 s", "5 min", "1:30 h".
function shortTime(seconds) {
  if (seconds === 0) return "0";
  if (seconds < 60) return `${Number(seconds.toFixed(1))} s`;
  const minutes = Math.floor(seconds / 60);
  const rest = Math.round(seconds % 60);
  if (minutes < 60) return rest ? `${minutes}:${String(rest).padStart(2, "0")} min` : `${minutes} min`;
  const hours = Math.floor(minutes / 60);
  if (hours >= 48 && hours % 24 === 0 && minutes % 60 === 0) return `${hours / 24} d`;
  return minutes % 60 ? `${hours}:${String(minutes % 60).padStart(2, "0")} h` : `${hours} h`;
}

const shortName = (name) => (name.length > 15 ? `${name.slice(0, 14)}…` : name);
