// Parallel coordinates: a line a trial, on a canvas; the axes and the ranges that a reader sets on them are SVG.
import { colour, el, onThemeChange, reconcile, setAttribute, setText, svg } from "./dom.js";
import { returnText, settingText } from "./format.js";
import { HEIGHT, makeMarks, placeAt, placeMarks, showRange, SIDE, topOf } from "./parallel_marks.js";
import { shownPoint } from "./shown_point.js";

const LEAST_AXIS_PX = 110;
const STEP = 0.02;
const NEAR_PX = 12;
const RAMP = ["ramp-0", "ramp-1", "ramp-2", "ramp-3", "ramp-4"];

export class Parallel {
  // `onRange(name, text | null)`, `onOpen(trialId)` are called for what the reader does.
  constructor(host, { onRange, onOpen }) {
    this.act = { onRange, onOpen };
    this.axes = [];
    this.trials = [];
    this.ranges = {};
    this.hovered = null;
    this.drag = null;
    this.canvas = el("canvas", { "aria-hidden": "true" });
    this.over = el("canvas", { "aria-hidden": "true" });
    this.svg = svg("svg", { class: "axes", role: "group", "aria-label": "Ranges on the axes" });
    this.tip = el("div", { class: "tip", hidden: true });
    this.box = el("div", { class: "parallel" }, this.canvas, this.over, this.svg, this.tip);
    this.scroller = el("div", { class: "sideways" }, this.box);
    this.none = el("p", { class: "missing quiet" });
    this.clear = el(
      "button",
      { type: "button", hidden: true, onclick: () => Object.keys(this.ranges).forEach((name) => onRange(name, null)) },
      "Clear ranges",
    );
    this.legend = el("p", { class: "ramp small quiet" }, el("span"), el("i"), el("span"));
    host.append(
      el("div", { class: "card-head" }, el("h2", {}, "Values and scores"), this.clear, this.legend),
      el(
        "p",
        { class: "quiet small" },
        "A line is a trial. Drag along an axis to keep the table to a range; the arrow keys move its ends.",
      ),
      this.scroller,
      this.none,
    );
    this.svg.addEventListener("pointerdown", (event) => this.pressed(event));
    this.svg.addEventListener("pointermove", (event) => this.moved(event));
    this.svg.addEventListener("pointerup", (event) => this.released(event));
    this.svg.addEventListener("pointerleave", () => {
      if (!this.drag) this.hover(null);
    });
    this.watch = new ResizeObserver(() => {
      if (this.axes.length) this.layOut();
    });
    this.watch.observe(this.scroller);
    this.forgetTheme = onThemeChange(() => this.paint());
  }

  // `matching` is the set of ids that filter and ranges let through.
  show({ data, matching, ranges, chosen }) {
    const drawn = data.trials.filter((trial) => Object.keys(trial.point).length);
    const { axes } = data;
    Object.assign(this, { trials: drawn, axes, matching, ranges, chosen });
    const has = axes.some((axis) => !axis.isScore);
    this.scroller.hidden = this.legend.hidden = !has;
    setText(
      this.none,
      has
        ? ""
        : data.searched.length || !data.trials.length
          ? "No trial has values yet."
          : "Nothing is searched: all trials have the same values.",
    );
    this.clear.hidden = Object.keys(ranges).length === 0;
    if (!has) return;
    const score = axes.find((axis) => axis.isScore);
    this.colourOf = score
      ? (trial) =>
          trial.score === null
            ? "muted"
            : RAMP[Math.max(0, Math.min(RAMP.length - 1, Math.floor(score.place(trial.score) * RAMP.length)))]
      : () => "muted";
    const scores = drawn.map((trial) => trial.score).filter((value) => value !== null);
    setText(
      this.legend.firstElementChild,
      scores.length ? `score ${returnText(scores.reduce((a, b) => Math.min(a, b)))}` : "no scores yet",
    );
    this.legend.children[1].hidden = scores.length === 0;
    setText(this.legend.lastElementChild, scores.length ? returnText(scores.reduce((a, b) => Math.max(a, b))) : "");
    this.layOut();
  }

  layOut() {
    const width = Math.max(this.scroller.clientWidth, 2 * SIDE + LEAST_AXIS_PX * (this.axes.length - 1));
    this.width = width;
    this.box.style.width = `${width}px`;
    const ratio = devicePixelRatio;
    // To set it clears the canvas, and takes a while.
    for (const canvas of [this.canvas, this.over]) {
      if (canvas.width !== Math.round(width * ratio)) canvas.width = Math.round(width * ratio);
      if (canvas.height !== Math.round(HEIGHT * ratio)) canvas.height = Math.round(HEIGHT * ratio);
    }
    setAttribute(this.svg, "viewBox", `0 0 ${width} ${HEIGHT}`);
    const last = this.axes.length - 1;
    const gap = (width - 2 * SIDE) / Math.max(1, last);
    this.axes.forEach((axis, index) => {
      axis.left = last ? SIDE + gap * index : width / 2;
      axis.side = index === 0 ? "first" : index === last ? "last" : "middle";
    });
    const make = (axis) => makeMarks(axis.name, (event, name, end) => this.keyed(event, name, end));
    const place = (group, axis) => placeMarks(group, axis, axis.side);
    reconcile(this.svg, this.axes, (axis) => axis.name, make, place);
    this.showRanges();
    this.paint();
  }

  endsOf(axis) {
    // A name may be one that all objects have.
    const range = Object.hasOwn(this.ranges, axis.name) ? this.ranges[axis.name] : null;
    return (range && axis.ends(range)) || [0, 1];
  }

  axisOf(name) {
    return this.axes.find((axis) => axis.name === name);
  }

  showRanges() {
    for (const group of this.svg.children) {
      const axis = this.axisOf(group.dataset.axis);
      const isDragged = this.drag?.name === axis.name;
      const ends = isDragged && this.drag.ends ? this.drag.ends : this.endsOf(axis);
      showRange(group, axis, ends, isDragged || Object.hasOwn(this.ranges, axis.name));
    }
  }

  paint() {
    if (!this.axes.length) return;
    const ratio = devicePixelRatio;
    const context = this.canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, this.width, HEIGHT);
    context.lineJoin = "round";
    const isIn = (trial) => this.matching.has(trial.trial_id);
    const isAll = this.matching.size === this.trials.length;
    context.strokeStyle = colour("muted");
    if (!isAll) {
      context.globalAlpha = Math.max(0.05, Math.min(0.25, 20 / this.trials.length));
      this.stroke(
        context,
        this.trials.filter((trial) => !isIn(trial)),
        1,
      );
    }
    const byColour = Map.groupBy(this.trials.filter(isIn), (trial) => this.colourOf(trial));
    context.globalAlpha = Math.max(0.15, Math.min(0.85, 60 / Math.max(1, this.matching.size)));
    // Better ones lie over worse ones.
    for (const name of ["muted", ...RAMP]) {
      context.strokeStyle = colour(name);
      this.stroke(context, byColour.get(name) ?? [], 1.25);
    }
    context.globalAlpha = 1;
    for (const trial of this.trials.filter((known) => this.chosen.has(known.trial_id))) {
      context.strokeStyle = this.chosen.get(trial.trial_id);
      this.stroke(context, [trial], 2.5);
    }
    this.paintHovered();
  }

  // On a canvas of its own, as thousands of lines take longer than a pointer's move.
  paintHovered() {
    const context = this.over.getContext("2d");
    context.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
    context.clearRect(0, 0, this.width, HEIGHT);
    const near = this.trials.find((trial) => trial.trial_id === this.hovered);
    if (!near) return;
    context.lineJoin = "round";
    context.strokeStyle = colour("ink");
    this.stroke(context, [near], 2.5);
  }

  // A line is pale where it passes by the axes of what does not act in its trial.
  stroke(context, trials, width) {
    const alpha = context.globalAlpha;
    context.lineWidth = width;
    this.trace(context, trials, false);
    context.globalAlpha = 0.25 * alpha;
    this.trace(context, trials, true);
    context.globalAlpha = alpha;
  }

  trace(context, trials, isOverGaps) {
    context.beginPath();
    for (const trial of trials) {
      let last = null;
      this.axes.forEach((axis, index) => {
        const at = axis.place(axis.valueOf(trial));
        if (at === undefined) return;
        const [left, top] = [axis.left, topOf(at)];
        if (last !== null && index - last.index > 1 === isOverGaps) {
          if (isOverGaps) context.moveTo(last.left, last.top);
          context.lineTo(left, top);
        } else {
          context.moveTo(left, top);
        }
        last = { index, left, top };
      });
    }
    context.stroke();
  }

  // Where a pointer is: in pixels of the drawing.
  spot(event) {
    const box = this.svg.getBoundingClientRect();
    return { left: event.clientX - box.left, top: event.clientY - box.top };
  }

  pressed(event) {
    const axis = this.axisOf(event.target.dataset?.axis);
    if (!axis || event.button !== 0) return;
    const { top } = this.spot(event);
    const ends = this.endsOf(axis);
    const isSet = Object.hasOwn(this.ranges, axis.name);
    // The nearer end is moved; away from both, a new range begins.
    const near = isSet ? ends.findIndex((end) => Math.abs(topOf(end) - top) < 8) : -1;
    this.drag = { name: axis.name, start: near >= 0 ? ends[1 - near] : placeAt(top), from: top, ends: null };
    this.svg.setPointerCapture(event.pointerId);
    event.preventDefault();
  }

  moved(event) {
    const { left, top } = this.spot(event);
    if (!this.drag) {
      this.hover(this.nearest(left, top), left, top);
      return;
    }
    if (this.drag.ends === null && Math.abs(top - this.drag.from) < 4) return;
    const now = placeAt(top);
    this.drag.ends = [Math.min(this.drag.start, now), Math.max(this.drag.start, now)];
    this.setRange(this.axisOf(this.drag.name), this.drag.ends);
    this.showRanges();
  }

  released() {
    const { drag } = this;
    this.drag = null;
    // A click without a move takes the range away.
    if (drag && drag.ends === null) this.act.onRange(drag.name, null);
    this.showRanges();
    if (!drag && this.hovered) this.act.onOpen(this.hovered);
  }

  setRange(axis, [low, high]) {
    const text = low <= 0 && high >= 1 ? null : axis.rangeText(low, high);
    const { [axis.name]: _, ...others } = this.ranges;
    // Known at once, as the next key may come before the next frame.
    this.ranges = text ? { ...others, [axis.name]: text } : others;
    this.act.onRange(axis.name, text || null);
  }

  keyed(event, name, end) {
    const axis = this.axisOf(name);
    const ends = this.endsOf(axis);
    const index = end === "low" ? 0 : 1;
    const step = axis.texts ? 1 / Math.max(1, axis.texts.length - 1) : STEP;
    const moves = {
      ArrowUp: step,
      ArrowRight: step,
      ArrowDown: -step,
      ArrowLeft: -step,
      PageUp: 5 * step,
      PageDown: -5 * step,
      Home: -1,
      End: 1,
    };
    if (event.key === "Escape" && Object.hasOwn(this.ranges, axis.name)) this.act.onRange(axis.name, null);
    else if (event.key in moves) {
      const limits = index === 0 ? [0, ends[1]] : [ends[0], 1];
      ends[index] = Math.max(limits[0], Math.min(limits[1], ends[index] + moves[event.key]));
      this.setRange(axis, ends);
    } else return;
    event.preventDefault();
  }

  nearest(left, top) {
    const index = this.axes.findIndex((axis, place) => place > 0 && axis.left >= left);
    if (index < 1) return null;
    const [one, two] = [this.axes[index - 1], this.axes[index]];
    const share = (left - one.left) / (two.left - one.left);
    let found = null;
    let least = NEAR_PX;
    for (const trial of this.trials) {
      if (!this.matching.has(trial.trial_id)) continue;
      const [a, b] = [one, two].map((axis) => axis.place(axis.valueOf(trial)));
      if (a === undefined || b === undefined) continue;
      const distance = Math.abs(topOf(a) * (1 - share) + topOf(b) * share - top);
      if (distance < least) [least, found] = [distance, trial.trial_id];
    }
    return found;
  }

  hover(id, left = 0, top = 0) {
    const trial = this.trials.find((known) => known.trial_id === id);
    this.tip.hidden = !trial;
    this.svg.classList.toggle("can-pick", Boolean(trial));
    if (trial) {
      const values = Object.entries(shownPoint(trial)).map(([name, value]) =>
        el("span", {}, `${name} ${settingText(value)}`),
      );
      this.tip.replaceChildren(
        el("b", {}, `${trial.trial_id}  ${trial.score === null ? trial.status : returnText(trial.score)}`),
        ...values,
      );
      const isRight = left > this.width / 2;
      this.tip.style.left = isRight ? "auto" : `${left + 14}px`;
      this.tip.style.right = isRight ? `${this.width - left + 14}px` : "auto";
      this.tip.style.top = `${Math.max(0, Math.min(top - 10, HEIGHT - this.tip.offsetHeight))}px`;
    }
    this.highlight(trial ? id : null);
  }

  highlight(id) {
    if (id === this.hovered) return;
    this.hovered = id;
    if (this.axes.length) this.paintHovered();
  }

  close() {
    this.watch.disconnect();
    this.forgetTheme();
  }
}
